"""The standard messages: documented, with units, of fixed size where that matters, and what they carry."""

from __future__ import annotations

import ast
import dataclasses
import inspect
from dataclasses import MISSING

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from random_schemas import messages_of

import cortex.messages as standard
from cortex.codec import codec_of
from cortex.messages import (
    AttitudeCommand,
    Clock,
    Collision,
    CommandRanges,
    Events,
    Imu,
    Odometry,
    Parameter,
    Parameters,
    PoseCommand,
    RateThrustCommand,
    Reset,
    SensorStatus,
    Simulation,
    SimulatorReply,
    Step,
    Trigger,
    VehicleStatus,
    VelocityCommand,
)
from cortex.schema import ArrayType, schema_of

TYPES = [getattr(standard, name) for name in standard.__all__]
WITHOUT_HEADER = {
    *(Parameter, SensorStatus, VehicleStatus, Simulation, CommandRanges),
    *(Reset, Step, Trigger, SimulatorReply),
}
"""Parts of others, requests and their reply, and what does not change."""


@pytest.mark.parametrize("cls", TYPES, ids=lambda cls: cls.__name__)
@settings(max_examples=5, deadline=None)
@given(st.data())
def test_there_and_back(cls, data):
    """With values for all fields, and with those only that have no default."""
    codec, value = codec_of(cls), data.draw(messages_of(schema_of(cls), cls))
    needed = [field.name for field in dataclasses.fields(cls) if not has_default(field)]
    for message in (value, cls(**{name: getattr(value, name) for name in needed})):
        assert codec.decode(codec.encode(message, 1 << 30)) == message


def has_default(field: dataclasses.Field[object]) -> bool:
    return field.default is not MISSING or field.default_factory is not MISSING


@pytest.mark.parametrize("cls", TYPES, ids=lambda cls: cls.__name__)
def test_names_and_headers(cls):
    schema = schema_of(cls)
    assert schema.name == f"cortex/{cls.__name__}"
    by_name = {field.name: field for field in schema.fields}
    if cls not in WITHOUT_HEADER:
        assert by_name["stamp_ns"].type == "int64"
        assert by_name["stamp_ns"].unit == "ns"
        assert by_name["sequence"].type == "uint64"
        assert codec_of(cls).stamp_of is not None


@pytest.mark.parametrize("cls", TYPES, ids=lambda cls: cls.__name__)
def test_every_field_has_a_docstring_that_names_its_unit(cls):
    (tree,) = ast.parse(inspect.getsource(cls)).body
    assert isinstance(tree, ast.ClassDef)
    documented = {}
    for statement, following in zip(tree.body, tree.body[1:], strict=False):
        if isinstance(statement, ast.AnnAssign):
            assert isinstance(following, ast.Expr), ast.unparse(statement)
            documented[ast.unparse(statement.target)] = ast.literal_eval(following.value)
    fields = schema_of(cls).fields
    assert list(documented) == [field.name for field in fields]
    for field in fields:
        if field.unit:
            assert f"[{field.unit}]" in documented[field.name]
        if isinstance(field.type, ArrayType):
            assert "shape [" in documented[field.name]
        for suffix in ("_ns", "_n", "_m", "_rad", "_rad_s"):
            if field.name.endswith(suffix) and field.type in ("int64", "float64"):
                assert field.unit.replace("/", "_").lower() == suffix[1:]


@pytest.mark.parametrize(
    ("cls", "size"),
    [
        (Imu, 64),
        (Odometry, 120),
        (RateThrustCommand, 48),
        (AttitudeCommand, 56),
        (VelocityCommand, 48),
        (PoseCommand, 48),
        (Clock, 32),
        (Collision, 48),
    ],
    ids=lambda value: getattr(value, "__name__", value),
)
def test_small_messages_are_of_fixed_size(cls, size):
    assert codec_of(cls).fixed_size == size
    assert "of fixed size" in cls.__doc__


def test_event_arrays_have_one_length():
    three = np.arange(3, dtype=np.uint16)
    events = Events(2, three, three, np.arange(2), np.ones(3, np.uint8), 640, 480)
    with pytest.raises(ValueError, match=r"cortex/Events\.t: dimension n is 2, but 3"):
        codec_of(Events).encode(events, 1000)


def test_parameters():
    values = {"a": True, "b": 1, "c": 0.5, "d": "text"}
    sent = Parameters.of(values, stamp_ns=5)
    codec = codec_of(Parameters)
    received = codec.decode(codec.encode(sent, 1000))
    assert received.to_dict() == values
    assert [type(value) for value in received.to_dict().values()] == [bool, int, float, str]
    assert received.stamp_ns == 5
    assert Parameter("a").value is None
    with pytest.raises(TypeError, match=r"parameter e: \[\] is neither"):
        Parameters.of({"e": []})  # type: ignore[dict-item]
