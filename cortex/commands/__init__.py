"""What the command `cortex` does, one module for each kind of job; `cortex.cli` has its options."""
