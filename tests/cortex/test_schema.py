"""Schemas: canonical text, fingerprint, limits, and classes made from them."""

from __future__ import annotations

import builtins
import contextlib
import copy
import dataclasses
import hashlib
import json
from typing import Annotated, Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from random_schemas import schemas

from cortex.codec import codec_of
from cortex.message_types import Array, Unit, message
from cortex.schema import (
    ArrayType,
    EnumType,
    Field,
    ListType,
    OptionalType,
    Schema,
    SchemaError,
    TypeMismatch,
    describe,
    schema_of,
    type_from_schema,
)


@message(name="test/Scan")
class Scan:
    stamp_ns: int
    ranges: Annotated[Array["float32", "n", 2], Unit("m", frame="Körper")]


SCAN_TEXT = (
    '{"name":"test/Scan","fields":[{"name":"stamp_ns","type":"int64","unit":"","frame":""},'
    '{"name":"ranges","type":{"array":"float32","shape":["n",2]},"unit":"m","frame":"Körper"}]}'
)


def test_the_canonical_text_and_its_fingerprint():
    assert schema_of(Scan).to_json() == SCAN_TEXT
    assert Schema.from_json(SCAN_TEXT) == schema_of(Scan)
    digest = hashlib.blake2b(SCAN_TEXT.encode("utf-8"), digest_size=8).digest()
    # A value written down, so that a change of the format cannot go unseen.
    assert schema_of(Scan).fingerprint == int.from_bytes(digest, "little") == 0xA79F0BA004364C4


@given(schemas)
def test_text_and_back(schema):
    text = schema.to_json()
    assert Schema.from_json(text) == schema
    assert json.dumps(json.loads(text), ensure_ascii=False, separators=(",", ":")) == text


def field(kind: Any = "int64", name: str = "a", unit: str = "", frame: str = "") -> Field:
    return Field(name, kind, unit, frame)


def nested(depth: int) -> Any:
    kind: Any = "int64"
    for _ in range(depth):
        kind = ListType(kind)
    return kind


IN_PLACE_OF = {
    '"ranges"': ["5", '"ran ges"', '"__class__"', f'"{"r" * 65}"', '""', '"stamp_ns"', '"ranges\\n"'],
    ",2]": [",-2]", ",0]", ",4294967296]", ",2.0]", ",true]", f",{'9' * 5000}]", ",NaN]"],
    '"m"': ['"\\""', '"\\u0001"', f'"{"m" * 65}"', "null"],
    '"int64"': ["null", "[1]"],
}
BAD_TEXTS = {
    f"{place} {value[:20]}": SCAN_TEXT.replace(place, value)
    for place in IN_PLACE_OF
    for value in IN_PLACE_OF[place]
} | {
    "no JSON": "{",
    "not an object": "[]",
    "a number": "5",
    "white space": SCAN_TEXT.replace(",", ", "),
    "escaped": SCAN_TEXT.replace("ö", "\\u00f6"),
    "order of keys": '{"fields":[],"name":"a"}',
    "key missing": '{"name":"a"}',
    "key too many": '{"name":"a","fields":[],"x":1}',
    "key twice": '{"name":"a","name":"a","fields":[]}',
    "unit missing": '{"name":"a","fields":[{"name":"a","type":"int8","frame":""}]}',
    "unknown type": SCAN_TEXT.replace("int64", "int65"),
    "unknown dtype": SCAN_TEXT.replace("float32", "float8"),
    "dtype is a type": SCAN_TEXT.replace("float32", "str"),
    "type of unknown form": SCAN_TEXT.replace('"int64"', '{"map":"int64"}'),
    "type of two forms": SCAN_TEXT.replace('"int64"', '{"list":"int64","optional":"int64"}'),
    "type name": SCAN_TEXT.replace("test/Scan", "test Scan"),
    "type name too long": SCAN_TEXT.replace("test/Scan", "t" * 129),
    "half a surrogate pair": SCAN_TEXT.replace("ö", "\\ud800"),
    "enum without values": SCAN_TEXT.replace('"int64"', '{"enum":"E","values":{}}'),
    "enum value beyond 32 bits": SCAN_TEXT.replace('"int64"', '{"enum":"E","values":{"A":2147483648}}'),
    "enum value is a bool": SCAN_TEXT.replace('"int64"', '{"enum":"E","values":{"A":true}}'),
    "enum value name": SCAN_TEXT.replace('"int64"', '{"enum":"E","values":{"A B":1}}'),
    "enum values are a list": SCAN_TEXT.replace('"int64"', '{"enum":"E","values":[1]}'),
    "optional of optional": SCAN_TEXT.replace('"int64"', '{"optional":{"optional":"int64"}}'),
    "empty message within": SCAN_TEXT.replace('"int64"', '{"message":{"name":"E","fields":[]}}'),
    "list of empty messages": SCAN_TEXT.replace('"int64"', '{"list":{"message":{"name":"E","fields":[]}}}'),
    "too deep": SCAN_TEXT.replace('"int64"', '{"list":' * 8 + '"int64"' + "}" * 8),
    "far too deep": SCAN_TEXT.replace('"int64"', '{"list":' * 5000 + '"int64"' + "}" * 5000),
    "deep JSON": "[" * 100_000,
    "33 dimensions": SCAN_TEXT.replace('"n",2', ",".join(['"n"'] * 33)),
    "too many fields": json.dumps(
        {
            "name": "a",
            "fields": [{"name": f"a{k}", "type": "int8", "unit": "", "frame": ""} for k in range(257)],
        },
        separators=(",", ":"),
    ),
    "too long": SCAN_TEXT.replace("Körper", "k" * 2**20),
}


@pytest.mark.parametrize("text", BAD_TEXTS.values(), ids=BAD_TEXTS.keys())
def test_texts_that_are_refused(text):
    assert text != SCAN_TEXT
    with pytest.raises(SchemaError):
        Schema.from_json(text)


@given(st.data())
def test_damaged_texts_raise_nothing_else(data):
    text = schema_of(Scan).to_json()
    for _ in range(data.draw(st.integers(1, 3))):
        start = data.draw(st.integers(0, len(text)))
        end = data.draw(st.integers(start, min(len(text), start + 4)))
        piece = st.sampled_from(["", "{", "}", '"', ",", "0", "null", "a"]) | st.text(max_size=5)
        text = text[:start] + data.draw(piece) + text[end:]
    with contextlib.suppress(SchemaError):
        assert Schema.from_json(text).to_json() == text


def test_limits_are_inclusive():
    assert len(Schema("a", tuple(field(name=f"a{k}") for k in range(256))).fields) == 256
    assert Schema("a", (field(nested(7)),))
    with pytest.raises(SchemaError, match="9 levels deep, allowed are 8"):
        Schema("a", (field(nested(8)),))
    assert Schema("a" * 128, (field(name="b" * 64, unit="m" * 64),))
    values = tuple((f"A{k}" + "x" * 50, k) for k in range(2000))
    with pytest.raises(SchemaError, match="longer than 65536 bytes"):
        Schema("a", (field(EnumType("E", values)),))


@pytest.mark.parametrize(
    "make",
    [
        lambda: ArrayType("uint8", (2**30 + 1,)),
        lambda: ArrayType("float64", (2**14, 2**14)),
        lambda: ArrayType("complex128", (2**32 - 1,) * 32),
        lambda: Schema("a", (field(ArrayType("uint8", (2**30,))), field(name="last"))),
        lambda: Schema("a", (field(OptionalType(ArrayType("uint8", (2**30,)))),)),
        lambda: Schema("a", tuple(field(ArrayType("uint8", (2**29,)), name=f"a{k}") for k in range(3))),
    ],
)
def test_a_fixed_part_has_a_limit(make):
    with pytest.raises(SchemaError, match="allowed are 1073741824"):
        make()
    # At the limit it has a codec, built without touching any of that memory.
    schema = Schema("a", (field(ArrayType("uint8", (2**15, 2**15))),))
    assert codec_of(type_from_schema(schema)).fixed_size == 2**30
    assert Schema("a", (field(ArrayType("uint8", (2**31, "n"))),))


def test_description_shows_the_structure():
    @message
    class Inner:
        x: Annotated[float, Unit("m")]

    @message
    class Outer:
        stamp_ns: int
        inner: list[Inner]
        data: Annotated[Array["uint8", "n", 3], Unit(frame="world")]
        maybe: str | None

    assert describe(schema_of(Outer)).splitlines()[1:] == [
        "  stamp_ns  int64",
        "  inner     list of message Inner",
        "    x  float64 [m]",
        "  data      uint8[n, 3] in world",
        "  maybe     optional str",
    ]
    error = TypeMismatch("/scan has two types", schema_of(Outer), schema_of(Inner))
    assert error.expected is schema_of(Outer)
    assert error.actual is schema_of(Inner)
    for line in (
        "/scan has two types",
        "  inner     list of message Inner",
        "actual: Inner (",
        "  x  float64 [m]",
    ):
        assert line in str(error)
    assert "expected: unknown" in str(TypeMismatch("x", None, None))


def test_a_class_from_a_schema():
    cls: Any = type_from_schema(schema_of(Scan))
    assert cls is type_from_schema(Schema.from_json(SCAN_TEXT))
    assert cls is not Scan
    assert schema_of(cls) == schema_of(Scan)
    value = cls(5, ranges=np.zeros((2, 2), np.float32))
    assert value.stamp_ns == 5
    assert repr(value).startswith("Scan(stamp_ns=5, ranges=float32[2, 2]")
    assert value == value.copy() == copy.copy(value) == copy.deepcopy(value)
    assert [f.name for f in dataclasses.fields(cls)] == ["stamp_ns", "ranges"]
    assert dataclasses.replace(value, stamp_ns=6).stamp_ns == 6
    assert dataclasses.asdict(value)["stamp_ns"] == 5
    with pytest.raises(dataclasses.FrozenInstanceError):
        value.stamp_ns = 6
    with pytest.raises(dataclasses.FrozenInstanceError):
        del value.stamp_ns
    for args, kwargs in (((1, 2, 3), {}), ((1,), {}), ((1, 2), {"stamp_ns": 1}), ((1, 2), {"other": 1})):
        with pytest.raises(TypeError, match="Scan"):
            cls(*args, **kwargs)


@given(schemas)
def test_a_class_from_any_schema(schema):
    cls = type_from_schema(schema)
    assert schema_of(cls) is schema or schema_of(cls) == schema
    assert codec_of(cls).fingerprint == schema.fingerprint


@pytest.mark.parametrize(
    "name", ["class", "None", "import", "lambda", "self", "cls", "copy", "mro", "_", "_a"]
)
def test_names_that_mean_something_to_python(name):
    cls: Any = type_from_schema(Schema("a", (field(name=name), field(name="other"))))
    body = codec_of(cls).encode(cls(1, 2), 100)
    assert getattr(cls(1, 2), name) == getattr(codec_of(cls).decode(body), name) == 1
    if name in ("mro", "_"):
        values = (("A", 1), ("mro" if name == "mro" else "_ignore_", 2))
        with pytest.raises(SchemaError, match="cannot be an enum in Python"):
            type_from_schema(Schema("a", (field(EnumType("E", values)),)))


def test_no_code_is_generated_from_a_schema(monkeypatch):
    texts: list[str] = []
    run = builtins.exec
    monkeypatch.setattr(builtins, "exec", lambda text, *scopes: texts.append(text) or run(text, *scopes))
    monkeypatch.setattr(builtins, "eval", lambda text, *_: texts.append(text))
    fields = (
        field(name="from_wire"),
        field(EnumType("FromWire", (("from_wire", 1),)), "e"),
        field("str", "s"),
    )
    cls: Any = type_from_schema(Schema("only/from_wire", fields))
    monkeypatch.undo()
    assert cls(1, None, "x").s == "x"
    assert not any("wire" in text for text in texts)  # dataclasses runs an empty text, of no field
