"""The messages that the tests of the C++ client send to and fro."""

from __future__ import annotations

from enum import Enum
from typing import Annotated

from cortex.message_types import (
    Array,
    Float32,
    Int8,
    Int16,
    Int32,
    UInt8,
    UInt16,
    UInt32,
    UInt64,
    Unit,
    message,
)


class Mode(Enum):
    IDLE = 0
    ACTIVE = -7
    NULL = 3  # a macro of C


@message
class Point:
    x: Float32
    name: str
    weights: Array["float64", "n"]


@message
class Rich:
    """Every kind of field."""

    stamp_ns: int
    truth: bool
    tiny: Int8
    small: UInt16
    middle: Int32
    large: UInt64
    real: Annotated[float, Unit("m/s²", frame='the robot\'s "body"'.replace('"', ""))]
    text: str
    data: bytes
    mode: Mode
    class_: int
    default: UInt8
    point: Point
    maybe: float | None
    maybe_point: Point | None
    maybe_mode: Mode | None
    numbers: list[Int16]
    truths: list[bool]
    words: list[str]
    points: list[Point]
    modes: list[Mode]
    ragged: list[Array["uint32", "k"]]
    pose: Array["float64", 3, 4]
    flags: Array["bool", 5]
    plane: Array["float32", 16, 32]
    image: Array["uint8", "height", "width", 3]
    depth: Array["float16", "height", "width"]
    waves: Array["complex128", "m"]
    anything: Array["any", "rows", "columns"]


@message(name="test/Picture")
class Picture:
    stamp_ns: int
    name: str
    pixels: Array["uint8", "height", "width"]
    depth: Array["any", "height", "width"]


@message
class Scan:
    stamp_ns: int
    ranges: Array["float32", "n"]


@message(name="Scan")
class OtherScan:
    """Another version of `Scan`."""

    stamp_ns: int
    ranges: Array["float64", "n"]
    maximum: UInt32
