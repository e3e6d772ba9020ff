"""`python -m cortex_ros2_bridge` is `cortex-ros2-bridge`."""

from __future__ import annotations

import sys

from cortex_ros2_bridge.cli import main

if __name__ == "__main__":
    sys.exit(main())
