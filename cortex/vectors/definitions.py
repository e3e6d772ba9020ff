"""The types that the test vectors are made of."""

from __future__ import annotations

from enum import Enum, IntEnum
from typing import Annotated

from cortex.message import (
    Array,
    Float32,
    Int8,
    Int16,
    Int32,
    Int64,
    UInt8,
    UInt16,
    UInt32,
    UInt64,
    Unit,
    message,
)


class Gear(IntEnum):
    """Values out of order, and the ends of the range."""

    LOW = 1
    REVERSE = -2147483648
    HIGH = 2147483647
    NEUTRAL = 0


class Mode(Enum):
    """A plain enum."""

    RATE = 3
    THRUST = 5


@message(name="vectors/Scalars")
class Scalars:
    """Each scalar type."""

    flag: bool
    i8: Int8
    i16: Int16
    i32: Int32
    i64: Int64
    u8: UInt8
    u16: UInt16
    u32: UInt32
    u64: UInt64
    f32: Float32
    f64: float


@message(name="vectors/Padding")
class Padding:
    """Alignment within the block, and of its end."""

    a: UInt8
    b: int
    c: bool
    d: Int16
    e: UInt8
    f: Float32
    g: UInt8


@message(name="vectors/Labels")
class Labels:
    """Units and frames, with characters beyond ASCII."""

    angle: Annotated[float, Unit("°")]
    delay: Annotated[Int64, Unit("µs")]
    velocity: Annotated[Array["float64", 3], Unit("m/s", frame="world")]
    pose: Annotated[float | None, Unit(frame="Körper")]


@message(name="vectors/Enums")
class Enums:
    """Enums alone, optional and in a list."""

    gear: Gear
    mode: Mode
    maybe: Mode | None
    many: list[Gear]


@message(name="vectors/Texts")
class Texts:
    """Text and bytes."""

    text: str
    data: bytes
    more: str


@message(name="vectors/FixedArrays")
class FixedArrays:
    """Arrays in the fixed block."""

    first: UInt8
    vector: Array["float32", 3]
    flags: Array["bool", 2, 2]
    scalar: Array["float64"]
    turns: Array["complex128", 2]
    last: UInt8


@message(name="vectors/LargeFixed")
class LargeFixed:
    """Fixed arrays just below and from 1024 bytes on, which changes their alignment."""

    first: UInt8
    small: Array["uint8", 1023]
    second: UInt8
    large: Array["uint8", 32, 32]
    wide: Array["uint16", 512]
    last: UInt8
    maybe: Array["uint8", 1024] | None


@message(name="vectors/Vector")
class Vector:
    """A stamp and an array."""

    stamp_ns: int
    data: Array["float32", "n"]


@message(name="vectors/Columns")
class Columns:
    """Arrays of one length."""

    stamp_ns: int
    x: Array["uint16", "n"]
    y: Array["uint16", "n"]
    t: Array["int64", "n"]
    polarity: Array["bool", "n"]
    width: UInt16


@message(name="vectors/Picture")
class Picture:
    """An array of open dtype, and one with a fixed dimension that shares a name with it."""

    data: Array["any", "height", "width", "channels"]
    mask: Array["uint8", "height", "width", 1]
    encoding: str


@message(name="vectors/Dtypes")
class Dtypes:
    """An open dtype, for every code."""

    data: Array["any", "n"]


@message(name="vectors/Inner")
class Inner:
    """A nested message with a tail and a scope of its own."""

    flag: bool
    name: str
    data: Array["int16", "n"]


@message(name="vectors/Point")
class Point:
    """A nested message of fixed size."""

    x: float
    y: Float32
    ok: bool


@message(name="vectors/Nested")
class Nested:
    """Messages in messages."""

    first: UInt8
    point: Point
    inner: Inner
    n: Array["float32", "n"]
    last: Point


@message(name="vectors/Optionals")
class Optionals:
    """What may be absent."""

    a: int | None
    b: UInt8 | None
    c: str | None
    d: Array["float32", "n"] | None
    e: Array["float32", "n"] | None
    f: Array["float64", 2] | None
    g: Point | None
    h: Inner | None
    i: list[int] | None


@message(name="vectors/FixedOptional")
class FixedOptional:
    """A type of fixed size in spite of optionals."""

    stamp_ns: int
    a: float | None
    b: Point | None


@message(name="vectors/Lists")
class Lists:
    """Lists of everything."""

    numbers: list[int]
    small: list[Int8]
    flags: list[bool]
    texts: list[str]
    points: list[Point]
    inners: list[Inner]
    arrays: list[Array["float32", "n"]]
    fixed: list[Array["uint8", 3]]
    maybe: list[Int16 | None]
    nested: list[list[UInt8]]


@message(name="vectors/Block")
class Block:
    """A message whose alignment is 64."""

    count: UInt8
    data: Array["uint8", 1024]


@message(name="vectors/Blocks")
class Blocks:
    """Elements of a list that must be aligned to 64."""

    name: str
    blocks: list[Block]


@message(name="vectors/Empty")
class Empty:
    """Nothing, as a trigger is."""


@message(name="vectors/Single")
class Single:
    """One byte, rounded up to 8."""

    flag: bool
