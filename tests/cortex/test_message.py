"""The decorator: what is a message, how it behaves as a Python object, and what is refused."""

from __future__ import annotations

import dataclasses
import typing
from dataclasses import field
from enum import Enum, Flag, IntEnum
from typing import Annotated, Any, Optional, Union

import hypothesis
import numpy as np
import pytest
from hypothesis import given
from numpy.typing import NDArray
from random_schemas import any_message

from cortex.message_types import Array, Float32, Int16, UInt8, Unit, is_message, message
from cortex.schema import ArrayType, EnumType, Field, ListType, OptionalType, SchemaError, schema_of


class Mode(IntEnum):
    OFF = 0
    ON = 1


@message
class Point:
    x: float
    y: float = 0.0


@message(name="test/Scan")
class Scan:
    stamp_ns: int
    ranges: Annotated[Array["float32", "n"], Unit("m", frame="lidar")]
    mode: Mode = Mode.OFF
    at: Point = field(default_factory=lambda: Point(1.0))
    tags: list[str] = field(default_factory=list)


def scan(**changes: Any) -> Scan:
    return dataclasses.replace(Scan(1, np.arange(4, dtype=np.float32), tags=["a"]), **changes)


def test_schema_of_the_annotations():
    @message
    class All:
        flag: bool
        number: int
        real: Float32
        small: Int16
        text: str
        data: bytes
        mode: Mode
        fixed: Array["uint8", 2, 3]
        by_type: Array[np.float64, "n"]
        one: Array["float16"]
        anything: Array["any", "h", "w"]
        point: Point
        maybe: Optional[Annotated[float, Unit("rad")]]  # noqa: UP045
        also: UInt8 | None
        united: Annotated[list[Point], Unit("m", "world")]
        nested: list[list[int] | None]

    modes = EnumType("Mode", (("OFF", 0), ("ON", 1)))
    point = schema_of(Point)
    assert schema_of(All).name == "All"
    assert schema_of(All).fields == (
        Field("flag", "bool"),
        Field("number", "int64"),
        Field("real", "float32"),
        Field("small", "int16"),
        Field("text", "str"),
        Field("data", "bytes"),
        Field("mode", modes),
        Field("fixed", ArrayType("uint8", (2, 3))),
        Field("by_type", ArrayType("float64", ("n",))),
        Field("one", ArrayType("float16", ())),
        Field("anything", ArrayType("any", ("h", "w"))),
        Field("point", point),
        Field("maybe", OptionalType("float64"), "rad"),
        Field("also", OptionalType("uint8")),
        Field("united", ListType(point), "m", "world"),
        Field("nested", ListType(OptionalType(ListType("int64")))),
    )


def test_a_message_is_a_frozen_dataclass_with_slots():
    value = scan()
    assert [f.name for f in dataclasses.fields(Scan)] == ["stamp_ns", "ranges", "mode", "at", "tags"]
    assert not hasattr(value, "__dict__")
    with pytest.raises(dataclasses.FrozenInstanceError):
        value.stamp_ns = 2  # type: ignore[misc]
    with pytest.raises(dataclasses.FrozenInstanceError):
        del value.stamp_ns
    assert dataclasses.replace(value, stamp_ns=5).stamp_ns == 5
    assert dataclasses.asdict(value)["at"] == {"x": 1.0, "y": 0.0}
    assert value.at == Point(1.0)
    assert is_message(value)
    assert is_message(Scan)
    assert not is_message(5)
    assert not is_message(int)


@message
class Ragged:
    rows: list[Array["int64", "n"]]
    zero: Array["float64", 3] = field(default_factory=lambda: np.zeros(3))


def test_messages_compare_by_value():
    assert scan() == scan()
    for changes in (
        {"stamp_ns": 2},
        *(
            {"ranges": ranges}
            for ranges in (np.arange(5, dtype=np.float32), np.arange(1, 5, dtype=np.float32))
        ),
        *({"ranges": ranges} for ranges in (np.arange(4.0), [0.0, 1.0, 2.0, 3.0])),
        {"at": Point(2.0)},
        {"tags": ["a", "b"]},
    ):
        assert scan() != scan(**changes)
    assert scan() != (1, 2)
    assert Point(0.0) != object()
    assert Ragged([np.arange(2), np.arange(3)]) == Ragged([np.arange(2), np.arange(3)])
    assert Ragged([np.arange(2)]) != Ragged([np.arange(3)])
    assert Ragged([]).zero is not Ragged([]).zero
    with pytest.raises(TypeError, match="unhashable"):
        hash(scan())


@given(any_message())
def test_a_copy_is_equal_and_owns_its_arrays(value):
    hypothesis.assume("copy" not in value.__cortex_names__)
    copied = value.copy()
    assert type(copied) is type(value)
    assert copied == value
    for name in value.__cortex_names__:
        if isinstance(getattr(value, name), np.ndarray):
            assert getattr(copied, name).flags.owndata
            assert getattr(copied, name).flags.writeable


def test_a_copy_is_deep():
    value = scan(tags=["a"])
    copied = value.copy()
    copied.tags.append("b")
    copied.ranges[:] = -1.0
    assert value == scan()
    assert copied.at is not value.at
    with pytest.raises(dataclasses.FrozenInstanceError):
        copied.stamp_ns = 2


class Colours(Enum):
    RED = "red"


class Bits(Flag):
    A = 1


BAD_HINTS = {
    "complex": complex,
    "dict": dict[str, int],
    "tuple": tuple[int, int],
    "set": set[int],
    "any": Any,
    "union": Union[int, str],  # noqa: UP007
    "union of three": int | str | None,
    "bare array": np.ndarray,
    "ndarray": NDArray[np.float32],
    "bare list": list,
    "enum of text": Colours,
    "flags": Bits,
    "plain class": Exception,
    "two units": Annotated[Annotated[float, Unit("m")], Unit("s")],
    "two types": Annotated[Int16, UInt8.__metadata__[0]],
    "optional of optional": typing.Optional[Annotated[typing.Optional[int], "hidden"]],  # noqa: UP045
}


@pytest.mark.parametrize("hint", BAD_HINTS.values(), ids=BAD_HINTS.keys())
def test_annotations_that_have_no_place_in_a_message(hint):
    with pytest.raises(SchemaError, match=r"Wrong\.wrong"):
        message(wrong(wrong=hint))


@pytest.mark.parametrize(
    ("parameters", "text"),
    [
        (("float33", "n"), "dtype"),
        (("M8[s]", "n"), "dtype"),
        ((">f4", "n"), "byte order"),
        (("float32", "n m"), "dimension name"),
        (("float32", "__n"), "dimension name"),
        (("float32", 0), "dimension 0"),
        (("float32", 2**32), "dimension"),
        (("float32", 1.5), "dimension 1.5"),
        (("float32", True), "dimension True"),
        (("float32", *(["n"] * 33)), "33 dimensions"),
    ],
)
def test_arrays_that_are_refused(parameters, text):
    with pytest.raises(SchemaError, match=text):
        Array[parameters]


def test_annotations_that_cannot_be_resolved():
    with pytest.raises(SchemaError, match=r"Lost: .*Nowhere.*defined before it"):

        @message
        class Lost:
            a: Nowhere  # type: ignore[name-defined]

    with pytest.raises(SchemaError, match=r"Tree: .*cannot contain itself"):

        @message
        class Tree:
            children: list[Tree]


def wrong(**fields: Any) -> type:
    """A class with these annotations."""
    return type("Wrong", (), {"__annotations__": fields})


def test_names_and_defaults_that_are_refused():
    for cls, said in (
        (wrong(copy=int), r"Wrong\.copy: .*method"),
        (wrong(__a=int), "field name '__a'"),
        (wrong(**{f"a{k}": int for k in range(257)}), "257 fields"),
    ):
        with pytest.raises(SchemaError, match=said):
            message(cls)
    with pytest.raises(SchemaError, match="type name 'a b'"):
        message(name="a b")(wrong(a=int))
    for default in (np.zeros(3), [], {}):
        cls = wrong(a=Array["float64", 3])
        cls.a = default
        with pytest.raises((TypeError, ValueError), match="mutable default"):
            message(cls)
