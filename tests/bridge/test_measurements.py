"""Measurements of the simulator's sensors as standard messages, compressed pictures, and gamepads."""

from __future__ import annotations

import io
import math

import numpy as np
import pytest
from PIL import Image as Picture

from cortex import messages
from cortex.schema import schema_of
from cortex_ros2_bridge import cdr
from cortex_ros2_bridge.config import BridgeConfig
from cortex_ros2_bridge.convert import Context, ConvertError, camera, commands, registry
from cortex_ros2_bridge.msgs import Joy
from cortex_ros2_bridge.routes import Seen, SeenTopic, make_routes, rule_of
from neurosim_core.live.messages import message_type, to_message
from neurosim_core.sensors.barometer import Pressure
from neurosim_core.sensors.gps import GpsFix
from neurosim_core.sensors.magnetometer import MagneticField
from neurosim_core.sensors.range_finder import Range

HEADER = {"stamp_ns": 3_000_000_007, "sequence": 4, "sensor": "s"}
PACKETS = {
    "Range": Range(distance_m=math.inf, field_of_view_rad=0.25, range_min_m=0.5, range_max_m=40.0, **HEADER),
    "FluidPressure": Pressure(pressure_pa=101_300.5, **HEADER),
    "MagneticField": MagneticField(field=np.array([1e-6, 2e-5, -4e-5]), **HEADER),
    "NavSatFix": GpsFix(
        latitude_rad=math.radians(47.5),
        longitude_rad=math.radians(-8.25),
        altitude_m=450.0,
        velocity=np.zeros(3),
        position_std=np.array([1.0, 2.0, 3.0]),
        **HEADER,
    ),
}


@pytest.fixture(autouse=True)
def nothing_added():
    yield
    registry.ADDED.clear()


def sent(packet):
    """Send a packet through the route that its topic has, as it is discovered: by its schema alone."""
    schema = schema_of(message_type(type(packet)))
    topic = SeenTopic("/drone/s", schema.name, schema.fingerprint, True, schema=schema.to_json())
    (route,), problems = make_routes(Seen((topic,)), BridgeConfig())
    assert not problems
    message = to_message(packet, frame_id="drone/s")
    data = rule_of(route).convert(message, Context(vehicle="drone"))
    decoded = cdr.decode(data, route.ros_type)
    assert (decoded.header.stamp.sec, decoded.header.stamp.nanosec) == (3, 7)
    assert decoded.header.frame_id == "drone/s"
    return route.ros_type, decoded


def test_range():
    kind, got = sent(PACKETS["Range"])
    assert kind == "sensor_msgs/msg/Range"
    assert (got.radiation_type, got.field_of_view, got.min_range, got.max_range) == (1, 0.25, 0.5, 40.0)
    assert got.range == math.inf


def test_fluid_pressure():
    kind, got = sent(PACKETS["FluidPressure"])
    assert (kind, got.fluid_pressure, got.variance) == ("sensor_msgs/msg/FluidPressure", 101_300.5, 0.0)


def test_magnetic_field():
    kind, got = sent(PACKETS["MagneticField"])
    field = got.magnetic_field
    assert (kind, field.x, field.y, field.z) == ("sensor_msgs/msg/MagneticField", 1e-6, 2e-5, -4e-5)


def test_nav_sat_fix():
    kind, got = sent(PACKETS["NavSatFix"])
    assert kind == "sensor_msgs/msg/NavSatFix"
    assert (got.latitude, got.longitude, got.altitude) == pytest.approx((47.5, -8.25, 450.0), rel=1e-15)
    assert (got.status.status, got.status.service, got.position_covariance_type) == (0, 1, 2)
    assert got.position_covariance.tolist() == [1.0, 0.0, 0.0, 0.0, 4.0, 0.0, 0.0, 0.0, 9.0]


def test_a_type_of_that_name_with_other_fields_goes_out_field_by_field():
    schema = schema_of(message_type(Pressure)).to_json().replace("pressure_pa", "pressure_hpa")
    topic = SeenTopic("/drone/s", "neurosim/Pressure", 5, True, schema=schema)
    (route,), _ = make_routes(Seen((topic,)), BridgeConfig())
    assert route.ros_type == "neurosim/msg/Pressure"


@pytest.mark.parametrize(("kind", "error"), [("png", 0), ("jpeg", 12)])
@pytest.mark.parametrize("channels", [1, 3])
def test_compressed_pictures_are_what_they_were(kind, error, channels):
    rows, columns = np.indices((24, 32))
    data = np.stack([8 * rows, 4 * columns, 255 - 4 * rows], axis=-1)[:, :, :channels].astype(np.uint8)
    encoding = {1: "mono8", 3: "rgb8"}[channels]
    picture = messages.Image(5, data, encoding, "drone/rgb_optical_frame")
    got = camera.compressed_image(picture, Context(options={"compression": kind}))
    assert got.format == f"{encoding}; {kind} compressed {'mono8' if channels == 1 else 'bgr8'}"
    back = np.asarray(Picture.open(io.BytesIO(bytes(got.data)))).reshape(data.shape)
    assert np.abs(back.astype(int) - data).max() <= error
    depth = messages.Image(5, np.zeros((2, 2, 1), np.float32), "32FC1")
    with pytest.raises(ConvertError, match="only rgb8 and mono8 are compressed, not 32FC1"):
        camera.compressed_image(depth, Context())


def test_a_gamepad_flies():
    """Half forward, a quarter left, full down, turning right, for a nose that points to y."""
    half = math.sqrt(0.5)
    state = messages.Odometry(0, np.zeros(3), np.array([0.0, 0.0, half, half]), np.zeros(3), np.zeros(3))
    joy = Joy(axes=[-1.0, -1.0, 0.0, 0.25, 0.5, 0.0], buttons=[])
    joy.header.stamp.sec = 2
    given = Context(vehicle="drone", odometry=state, options={"stick_speed_m_s": 4.0})
    command = commands.joy(joy, given)
    np.testing.assert_allclose(command.velocity, [-1.0, 2.0, -4.0], atol=1e-12)
    assert (command.yaw_rate_rad_s, command.stamp_ns) == (-1.0, 2_000_000_000)
    with pytest.raises(ConvertError, match=r"Joy\.axes must be 5 or more from -1 to 1"):
        commands.joy(Joy(axes=[0.0, 0.0]), Context(odometry=state))
