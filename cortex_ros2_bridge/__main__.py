"""The command `cortex-ros2-bridge`, also as `python -m cortex_ros2_bridge`: quiet at Ctrl-C."""

import os
import signal
import sys


def main() -> int:
    """Run the command line, see `cli.main`; Ctrl-C during its imports ends the process with status 130."""
    signal.signal(signal.SIGINT, lambda *_: os._exit(130))
    try:
        from cortex_ros2_bridge.cli import main as run
    except ModuleNotFoundError as error:
        if error.name != "rosbags":
            raise
        install = "pip install -e '.[ros2]' in the folder of Neurosim"
        print(
            f"cortex-ros2-bridge: the bridge needs rosbags, which is not installed: {install}",
            file=sys.stderr,
        )
        return 1
    signal.signal(signal.SIGINT, signal.default_int_handler)  # `run` ends with 130, and closes what is open
    return run()


if __name__ == "__main__":
    sys.exit(main())
