"""The values that the test vectors are made of, and what makes their bodies malformed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cortex.schema import DTYPE_NAMES
from cortex.vectors.definitions import (
    Block,
    Blocks,
    Columns,
    Dtypes,
    Empty,
    Enums,
    FixedArrays,
    FixedOptional,
    Gear,
    Inner,
    Labels,
    LargeFixed,
    Lists,
    Mode,
    Nested,
    Optionals,
    Padding,
    Picture,
    Point,
    Scalars,
    Single,
    Texts,
    Vector,
)


@dataclass(frozen=True)
class Malformed:
    """A body with some bytes of a good one replaced."""

    name: str
    case: str
    """Name of the good body."""
    offset: int
    data: str
    """What is written there, in hexadecimal."""
    drop: int = 0
    """How many bytes to cut off the end, or to add (zeros) if negative."""


@dataclass(frozen=True)
class Entry:
    """One file of vectors."""

    type: type[Any]
    cases: dict[str, Any]
    malformed: Sequence[Malformed] = ()


def _ramp(dtype: str, *shape: int) -> NDArray[Any]:
    count = math.prod(shape)
    return (np.arange(count) % 251).astype(dtype).reshape(shape)


def _vector(count: int) -> Vector:
    return Vector(-count, _ramp("float32", count))


_NONE = Optionals(None, None, None, None, None, None, None, None, None)
_INNER = Inner(True, "inner", _ramp("int16", 3))
_POINT = Point(1.5, -0.25, True)

CATALOGUE: dict[str, Entry] = {
    "scalars": Entry(
        Scalars,
        {
            "zeros": Scalars(False, 0, 0, 0, 0, 0, 0, 0, 0, 0.0, 0.0),
            "least": Scalars(
                True, -(2**7), -(2**15), -(2**31), -(2**63), 0, 0, 0, 0, -math.inf, -1.7976931348623157e308
            ),
            "greatest": Scalars(
                True,
                2**7 - 1,
                2**15 - 1,
                2**31 - 1,
                2**63 - 1,
                2**8 - 1,
                2**16 - 1,
                2**32 - 1,
                2**64 - 1,
                math.inf,
                5e-324,
            ),
            "nan": Scalars(False, 1, 2, 3, 4, 5, 6, 7, 8, math.nan, math.nan),
        },
        [
            Malformed("bool is 2", "zeros", 0, "02"),
            Malformed("one byte short", "zeros", 0, "", 1),
            Malformed("longer than its fixed size", "zeros", 0, "", -8),
            Malformed("empty", "zeros", 0, "", 56),
        ],
    ),
    "padding": Entry(Padding, {"ones": Padding(1, 1, True, 1, 1, 1.0, 1)}),
    "labels": Entry(
        Labels,
        {"values": Labels(90.0, 5, np.array([1.0, 2.0, 3.0]), None)},
        [Malformed("optional is neither present nor absent", "values", 40, "ff")],
    ),
    "enums": Entry(
        Enums,
        {
            "values": Enums(Gear.REVERSE, Mode.THRUST, Mode.RATE, [Gear.HIGH, Gear.LOW]),
            "none": Enums(Gear.NEUTRAL, Mode.RATE, None, []),
        },
        [
            Malformed("value not listed", "none", 4, "00000000"),
            Malformed("value of a list element not listed", "values", 28, "07000000"),
        ],
    ),
    "texts": Entry(
        Texts,
        {
            "empty": Texts("", b"", ""),
            "unicode": Texts("Zürich \N{GRINNING FACE}", b"\x00\xff", "a\x00b"),
            "long": Texts("x" * 1100, bytes(range(256)), "end"),
        },
        [
            Malformed("not UTF-8", "unicode", 26, "ff"),
            Malformed("a surrogate in UTF-8", "unicode", 24, "eda080"),
            Malformed("beyond the body", "unicode", 4, "ff"),
            Malformed("offset wraps around", "unicode", 0, "f8ffffff"),
            Malformed("length wraps around", "unicode", 4, "ffffffff"),
            Malformed("last item cut", "unicode", 0, "", 1),
            Malformed("empty item beyond the body", "empty", 0, "19000000"),
            Malformed("shorter than the block", "empty", 0, "", 1),
            Malformed("items share bytes", "long", 8, "180000004c040000"),
        ],
    ),
    "fixed_arrays": Entry(
        FixedArrays,
        {
            "values": FixedArrays(
                1,
                np.array([1, 2, 3], np.float32),
                np.array([[True, False], [False, True]]),
                np.array(0.5),
                np.array([1 + 2j, -3j]),
                255,
            )
        },
    ),
    "large_fixed": Entry(
        LargeFixed,
        {
            "present": LargeFixed(
                1,
                _ramp("uint8", 1023),
                2,
                _ramp("uint8", 32, 32),
                _ramp("uint16", 512),
                3,
                _ramp("uint8", 1024),
            ),
            "absent": LargeFixed(
                1, _ramp("uint8", 1023), 2, _ramp("uint8", 32, 32), _ramp("uint16", 512), 3, None
            ),
        },
    ),
    "vector": Entry(
        Vector,
        {f"{count} items": _vector(count) for count in (0, 1, 10, 255, 256)},
        [
            Malformed("beyond the body", "10 items", 16, "0b000000"),
            Malformed("count wraps around in 32 bits", "10 items", 16, "0a000040"),
            Malformed("greatest count", "10 items", 16, "ffffffff"),
            Malformed("offset wraps around", "10 items", 8, "fcffffff"),
            Malformed("other dtype", "10 items", 12, "07"),
            Malformed("unknown dtype", "10 items", 12, "0e"),
            Malformed("other number of dimensions", "10 items", 13, "02"),
            Malformed("reserved bytes in use", "10 items", 14, "0100"),
            Malformed("empty array beyond the body", "0 items", 8, "19000000"),
            Malformed("last byte cut", "256 items", 0, "", 1),
            Malformed("block cut", "0 items", 0, "", 1),
        ],
    ),
    "columns": Entry(
        Columns,
        {
            "empty": Columns(
                1, _ramp("uint16", 0), _ramp("uint16", 0), _ramp("int64", 0), _ramp("bool", 0), 640
            ),
            "three": Columns(
                2, _ramp("uint16", 3), _ramp("uint16", 3), _ramp("int64", 3), _ramp("bool", 3), 640
            ),
            "many": Columns(
                3, _ramp("uint16", 130), _ramp("uint16", 130), _ramp("int64", 130), _ramp("bool", 130), 640
            ),
        },
        [
            Malformed("lengths differ", "three", 28, "02000000"),
            Malformed("lengths differ, one is empty", "three", 28, "00000000"),
        ],
    ),
    "picture": Entry(
        Picture,
        {
            "rgb8": Picture(_ramp("uint8", 2, 3, 3), _ramp("uint8", 2, 3, 1), "rgb8"),
            "32FC1": Picture(_ramp("float32", 20, 30, 1), _ramp("uint8", 20, 30, 1), "32FC1"),
            "no items": Picture(_ramp("float16", 0, 3, 3), _ramp("uint8", 0, 3, 1), ""),
        },
        [
            Malformed("unknown dtype", "rgb8", 4, "0e"),
            Malformed("other dtype needs more bytes", "rgb8", 4, "0d"),
            Malformed("fixed dimension differs", "rgb8", 36, "02000000"),
            Malformed("named dimensions differ", "rgb8", 8, "030000000200"),
            Malformed("dimensions multiply to more than 64 bits", "rgb8", 8, "ffffffffffffffffffffffff"),
            Malformed("dimensions multiply to 2^64", "rgb8", 8, "000000800000008004000000"),
        ],
    ),
    "dtypes": Entry(
        Dtypes,
        {name: Dtypes(np.array([0, 1], dtype=name)) for name in DTYPE_NAMES},
    ),
    "nested": Entry(
        Nested,
        {"values": Nested(7, _POINT, _INNER, _ramp("float32", 2), Point(0.0, 0.0, False))},
        [Malformed("bool of a nested message", "values", 20, "02")],
    ),
    "optionals": Entry(
        Optionals,
        {
            "none": _NONE,
            "all": Optionals(
                -1,
                255,
                "text",
                _ramp("float32", 2),
                _ramp("float32", 2),
                _ramp("float64", 2),
                _POINT,
                _INNER,
                [1, 2],
            ),
        },
        [
            Malformed("present is 2", "none", 0, "02"),
            Malformed("a present array says its dtype", "none", 32, "01"),
            Malformed("dimensions of two optional arrays differ", "all", 44, "01"),
        ],
    ),
    "fixed_optional": Entry(
        FixedOptional,
        {"none": FixedOptional(5, None, None), "all": FixedOptional(5, 0.5, _POINT)},
        [Malformed("present is 2", "none", 8, "02")],
    ),
    "lists": Entry(
        Lists,
        {
            "empty": Lists([], [], [], [], [], [], [], [], [], []),
            "values": Lists(
                [1, -1],
                [-128, 127, 0],
                [True, False, True],
                ["", "a", "bc"],
                [_POINT, Point(2.0, 3.0, False)],
                [_INNER, Inner(False, "", _ramp("int16", 1))],
                [_ramp("float32", 1), _ramp("float32", 300), _ramp("float32", 0)],
                [_ramp("uint8", 3), _ramp("uint8", 3)],
                [None, 5],
                [[], [1], [2, 3]],
            ),
        },
        [
            Malformed("count beyond the body", "empty", 4, "01000000"),
            Malformed("greatest count", "values", 4, "ffffffff"),
            Malformed("count times stride wraps around", "values", 4, "02000020"),
            Malformed("bool of an element", "values", 104, "02"),
            Malformed("text of an element beyond the body", "values", 124, "ffffff7f"),
        ],
    ),
    "blocks": Entry(
        Blocks,
        {"two": Blocks("blocks", [Block(1, _ramp("uint8", 1024)), Block(2, _ramp("uint8", 1024))])},
    ),
    "empty": Entry(Empty, {"empty": Empty()}, [Malformed("a byte too many", "empty", 0, "", -1)]),
    "single": Entry(
        Single,
        {"true": Single(True), "false": Single(False)},
        [Malformed("only the byte", "true", 0, "", 7), Malformed("bool is 255", "true", 0, "ff")],
    ),
}
"""Files by name."""
