"""The command `neurosim`, also as `python -m neurosim_core`: quiet at Ctrl-C from its first line on."""

import os
import signal
import sys


def main() -> int:
    """Run the command line, see `cli.main`; Ctrl-C during its imports ends the process with status 130."""
    signal.signal(signal.SIGINT, lambda *_: os._exit(130))
    from neurosim_core.cli import main as run

    return run()


if __name__ == "__main__":
    sys.exit(main())
