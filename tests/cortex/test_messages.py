"""The standard messages: documented, with units, of fixed size where that matters, and what they carry."""

from __future__ import annotations

import ast
import dataclasses
import inspect

import numpy as np
import pytest

import cortex.messages as standard
from cortex.codec import codec_of
from cortex.messages import (
    AttitudeCommand,
    CameraInfo,
    Clock,
    Collision,
    CommandRanges,
    Delivery,
    Events,
    Image,
    Imu,
    MotorCommand,
    Odometry,
    Parameter,
    Parameters,
    Path,
    PointCloud,
    PoseCommand,
    RateThrustCommand,
    Reset,
    RotorSpeeds,
    SensorStatus,
    Simulation,
    SimulatorReply,
    SimulatorStatus,
    Step,
    Text,
    Transform,
    Trigger,
    VehicleStatus,
    VelocityCommand,
)
from cortex.schema import ArrayType, schema_of

TYPES = [getattr(standard, name) for name in standard.__all__]
V3, Q = np.array([1.0, 2.0, 3.0]), np.array([0.0, 0.0, 0.0, 1.0])
EXAMPLES = [
    AttitudeCommand(1, 9.81, Q),
    CameraInfo(1, 640, 480, np.eye(3), "plumb_bob", np.zeros(5), "cam"),
    Clock(1, 2),
    Collision(1, V3, -0.01),
    Events(
        2,
        np.arange(3, dtype=np.uint16),
        np.arange(3, dtype=np.uint16),
        np.arange(3),
        np.ones(3, np.uint8),
        640,
        480,
    ),
    Image(1, np.zeros((4, 5, 3), np.uint8), "rgb8", "cam", 7),
    Image(1, np.full((4, 5, 1), np.inf, np.float32), "32FC1"),
    Imu(1, V3, V3),
    MotorCommand(1, np.ones(4)),
    Odometry(1, V3, Q, V3, V3, 5),
    Parameters.of({"a": True, "b": 1, "c": 0.5, "d": "text"}),
    Parameter("a", integer=1),
    PointCloud(1, np.zeros((7, 3), np.float32), np.zeros(7, np.float32)),
    PointCloud(1, np.zeros((0, 3), np.float32), ring=np.zeros(0, np.uint16), t=np.zeros(0, np.uint32)),
    PoseCommand(1, V3),
    RateThrustCommand(1, 9.81, V3),
    RotorSpeeds(1, np.ones(6)),
    Text("hello"),
    Transform(1, "map", "base", V3, Q),
    VelocityCommand(1, V3, 0.5),
    Delivery(1, -1, 921_600, 5),
    Path(0, np.arange(3), np.ones((3, 3)), "world"),
    Reset(3, "drone", position=V3),
    Reset(),
    Simulation("seed: 0\n", "1.0", ["a", "b"], "lockstep", 200.0),
    CommandRanges(True, 1500.0, 50.0, 51.0, 35.0, 1e4),
    SimulatorReply(False, "why not", 1, "paused"),
    Step(5),
    Trigger(),
    SENSOR_STATUS := SensorStatus("drone", "rgb", True, 1, 20, 2),
    VEHICLE_STATUS := VehicleStatus("drone", "rates", 9, 1, 2, 3, 5_000_000, False, 0, 1),
    SimulatorStatus(
        1, 2, "running", "", "streaming", 1.0, 0.9, 7, 1, 2, 3, 4, 5, 6, [SENSOR_STATUS], [VEHICLE_STATUS]
    ),
]
WITHOUT_HEADER = {
    *(Parameter, SensorStatus, VehicleStatus, Simulation, CommandRanges),
    *(Reset, Step, Trigger, SimulatorReply),
}
"""Parts of others, requests and their reply, and what does not change."""


def test_there_is_an_example_of_each_type():
    assert {type(example) for example in EXAMPLES} == set(TYPES)


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda example: type(example).__name__)
def test_there_and_back(example):
    codec = codec_of(type(example))
    assert codec.decode(codec.encode(example, 10**6)) == example


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
    events = EXAMPLES[4]
    with pytest.raises(ValueError, match=r"cortex/Events\.t: dimension n is 2, but 3"):
        codec_of(Events).encode(dataclasses.replace(events, t=np.arange(2)), 1000)


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
