# ruff: noqa: F821, UP037 - "n" names a dimension
"""The messages of the C++ examples; the build writes `scan.hpp` with `cortex cpp`."""

from __future__ import annotations

from typing import Annotated

from cortex.message_types import Array, Unit, message


@message(name="example/Scan")
class Scan:
    """One turn of a lidar."""

    stamp_ns: int
    ranges: Annotated[Array["float32", "n"], Unit("m")]


@message(name="example/Cmd")
class Cmd:
    """What the robot shall do."""

    stamp_ns: int
    speed: Annotated[float, Unit("m/s", frame="body")]
    turn: Annotated[float, Unit("rad/s", frame="body")]
