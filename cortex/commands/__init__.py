"""The subcommands of `cortex`, one module for each kind of job; `cortex.cli` has its options."""
