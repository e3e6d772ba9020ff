"""Small sensors against tables and closed forms; their errors by Allan deviation."""

from __future__ import annotations

import math

import numpy as np
import pytest
import warp as wp
from scipy import stats
from scipy.spatial.transform import Rotation
from small_room import room_scene

import neurosim_core as ns
from neurosim_core.packets import Odometry
from neurosim_core.sensors.barometer import BarometerConfig
from neurosim_core.sensors.base import SamplerContext
from neurosim_core.sensors.contact import ContactConfig
from neurosim_core.sensors.gps import GpsConfig, geodetic
from neurosim_core.sensors.imu import ImuConfig
from neurosim_core.sensors.magnetometer import MagnetometerConfig
from neurosim_core.sensors.state_estimate import StateEstimateConfig
from neurosim_core.settings_file import ConfigError
from neurosim_core.vehicle import Multirotor, preset

FALSE_ALARM = 1e-6
ISA = (
    (-500, 107_477.5),
    (0, 101_325.0),
    (1000, 89_874.6),
    (5000, 54_019.9),
    (11_000, 22_632.1),
    (15_000, 12_044.6),
)
"""Geopotential altitude [m] and pressure [Pa], ICAO Doc 7488, table 1 (to 0.1 Pa)."""


def sampler(config, *, count=1, slots=1, seeds=None, name="sensor", vehicle=None):
    """Return a sensor at work on vehicles at rest in the origin, and the vehicles."""
    vehicle = vehicle or Multirotor(preset("hummingbird"), count=count, device="cpu")
    context = SamplerContext(
        name=name,
        vehicle=vehicle,
        slot_count=slots,
        seeds=wp.array(np.arange(count) if seeds is None else seeds, dtype=wp.uint64, device="cpu"),
        active=wp.ones(count, dtype=wp.int32, device="cpu"),
    )
    return config.make(context), vehicle


def record(config, field, **options):
    """Return all samples of a field, shape [slot, world, ...]."""
    made, _ = sampler(config, **options)
    for slot in range(options["slots"]):
        made.measure(slot)
    return made.arrays[field].numpy()


def test_barometer_reads_the_standard_atmosphere():
    for geopotential_m, pressure_pa in ISA:
        altitude_m = 6_356_766.0 * geopotential_m / (6_356_766.0 - geopotential_m)
        made, vehicle = sampler(
            BarometerConfig(altitude_m=altitude_m - 3.0, mount={"position_m": (1.0, 0.0, 0.0)})
        )
        vehicle.reset(
            position=(0.0, 0.0, 4.0), orientation=Rotation.from_euler("y", 90, degrees=True).as_quat()
        )
        made.measure(0)
        assert made.arrays["pressure_pa"].numpy()[0, 0] == pytest.approx(pressure_pa, abs=0.1)


ERRORS = {
    "white": ({"white": 2.0}, lambda t, dt: 4.0 * dt / t),
    "walk": ({"walk": 0.5}, lambda t, dt: 0.25 / t * (2 * t**2 + dt**2) / 6.0),
    "markov": (
        {"markov": 3.0, "markov_time_s": 2.0},
        lambda t, dt: 9.0 * 4.0 / t * (1.0 - 1.0 / t * (3.0 - 4.0 * math.exp(-t / 2) + math.exp(-t))),
    ),
}
"""Settings and Allan variance of each error; that of a walk is the sum over its steps of dt."""


@pytest.mark.parametrize("name", ERRORS)
def test_allan_deviations(name):
    """Within 5 % over decades of averaging times: 3,000 receivers of 400 samples, three axes each."""
    errors, variance = ERRORS[name]
    config = GpsConfig(rate_hz=20.0, position_errors=errors)
    values = record(config, "position", count=3000, slots=400, seeds=np.arange(3000))
    total = np.cumsum(values, axis=0)
    total = np.concatenate([np.zeros_like(total[:1]), total])
    for samples in (1, 4, 16, 64, 128):
        mean = (total[samples:] - total[:-samples]) / samples
        allan = 0.5 * np.mean((mean[samples::samples] - mean[:-samples:samples]) ** 2)
        expected = variance(samples / 20.0, 1.0 / 20.0)
        if name == "markov" and samples < 16:
            continue  # the closed form is of the continuous process: samples need to be close together
        assert math.sqrt(allan) == pytest.approx(math.sqrt(expected), rel=0.05)


def test_errors_are_of_the_seed_the_name_and_the_number_of_the_sample():
    errors = {"white": 1.0, "walk": 1.0, "markov": 1.0}
    config = GpsConfig(position_errors=errors, velocity_errors=errors, dropout_probability=0.5)
    made, _ = sampler(config, count=3, slots=8, seeds=[5, 6, 5])
    for slot in range(8):
        made.measure(slot)
    first = {name: array.numpy().copy() for name, array in made.arrays.items()}
    for values in first.values():
        np.testing.assert_array_equal(values[:, 0], values[:, 2])
        assert (values[:, 0] != values[:, 1]).any()
    assert (first["position"] != first["velocity"]).all()
    made.reset(wp.array([1, 0, 0], dtype=wp.int32, device="cpu"))
    for slot in range(8):
        made.measure(slot)
    for name, values in first.items():
        np.testing.assert_array_equal(made.arrays[name].numpy()[:, 0], values[:, 0])
    assert (made.arrays["position"].numpy()[:, 2] != first["position"][:, 2]).all()
    other = record(config, "position", count=1, slots=8, seeds=[5], name="another")
    assert (other[:, 0] != first["position"][:, 0]).all()
    alone = record(config, "position", count=1, slots=8, seeds=[5])
    np.testing.assert_array_equal(alone[:, 0], first["position"][:, 0])


def test_errors_of_what_is_one_number_have_no_axes():
    with pytest.raises(ValueError, match=r"sensor 'air': white must be one number, got \[1.0, 2.0, 3.0\]"):
        sampler(BarometerConfig(errors={"white": [1, 2, 3]}), name="air")


def test_readings_have_a_resolution():
    values = record(BarometerConfig(errors={"white": 3.0, "resolution": 0.5}), "pressure_pa", slots=50)[:, 0]
    np.testing.assert_array_equal(values, 0.5 * np.rint(values / 0.5))
    assert len(set(values)) > 5


def test_magnetometer_turns_with_the_vehicle_and_its_iron():
    field = (1e-6, 2e-5, -4e-5)
    soft = ((1.1, 0.02, 0.0), (0.0, 0.9, 0.0), (0.01, 0.0, 1.0))
    config = MagnetometerConfig(
        earth_field_t=field,
        hard_iron_t=(1e-6, -2e-6, 3e-6),
        soft_iron=soft,
        mount={"rpy_rad": (0.1, 0.2, 0.3)},
    )
    made, vehicle = sampler(config)
    R_WB = Rotation.from_euler("xyz", [0.5, -0.4, 2.0])
    vehicle.reset(orientation=R_WB.as_quat())
    made.measure(0)
    R_WS = R_WB * Rotation.from_euler("xyz", [0.1, 0.2, 0.3])
    expected = np.array(soft) @ R_WS.inv().apply(field) + [1e-6, -2e-6, 3e-6]
    np.testing.assert_allclose(made.arrays["field"].numpy()[0, 0], expected, rtol=1e-12)


def ecef(latitude, longitude, altitude):
    """WGS84 to Earth-centred coordinates, written from the definition of the ellipsoid."""
    a, b = 6_378_137.0, 6_378_137.0 * (1.0 - 1.0 / 298.257223563)
    n = a**2 / math.hypot(a * math.cos(latitude), b * math.sin(latitude))
    level = (n + altitude) * math.cos(latitude)
    z = (b**2 / a**2 * n + altitude) * math.sin(latitude)
    return np.array([level * math.cos(longitude), level * math.sin(longitude), z])


@pytest.mark.parametrize("origin", [(0.83, 0.15, 450.0), (-1.2, 3.1, 10.0), (0.0, -2.0, 0.0)])
def test_geodetic_positions_are_those_of_the_ellipsoid(origin):
    latitude, longitude, _ = origin
    east = np.array([-math.sin(longitude), math.cos(longitude), 0.0])
    level = math.cos(latitude) * np.array([math.cos(longitude), math.sin(longitude)])
    up = np.array([*level, math.sin(latitude)])
    frame = np.stack([east, np.cross(up, east), up], axis=-1)
    for place in ([0.0, 0.0, 0.0], [1234.5, -678.9, 120.0], [-50_000.0, 80_000.0, 9000.0]):
        found = geodetic(np.array(place), *origin)
        np.testing.assert_allclose(ecef(*found), ecef(*origin) + frame @ place, atol=1e-6)


def test_a_fix_is_of_the_state_before_and_of_the_antenna():
    """A vehicle that turns at 2 rad/s in place: the antenna on its circle is seen two samples late."""
    mount = {"position_m": (0.5, 0.0, 0.0)}
    late, vehicle = sampler(GpsConfig(rate_hz=10, delay_s=0.2, mount=mount), slots=6)
    now, _ = sampler(GpsConfig(rate_hz=10, mount=mount), slots=6, vehicle=vehicle)
    for slot in range(6):
        angle = 0.2 * slot
        vehicle.reset(orientation=Rotation.from_euler("z", angle).as_quat(), body_rate=(0.0, 0.0, 2.0))
        late.measure(slot)
        now.measure(slot)
    for name in ("position", "velocity"):
        a, b = late.arrays[name].numpy()[:, 0], now.arrays[name].numpy()[:, 0]
        np.testing.assert_array_equal(a, b[[0, 0, 0, 1, 2, 3]])
    np.testing.assert_allclose(now.arrays["velocity"].numpy()[0, 0], [0.0, 1.0, 0.0], atol=1e-12)
    with pytest.raises(ConfigError, match="delay_s must be a multiple of 1 / rate_hz"):
        GpsConfig(rate_hz=10, delay_s=0.15)


@pytest.fixture(scope="module")
def settings(tmp_path_factory):
    """Return settings of a hover in a small room."""
    scene = room_scene(tmp_path_factory.mktemp("room"))

    def make(sensors, **more):
        path = {"kind": "hover", "position_m": [0.0, 0.0, 1.2]}
        return {"scene": scene, "duration_s": 2.0, "device": "cpu", "path": path, "sensors": sensors, **more}

    return make


def test_lost_estimates_leave_gaps_in_the_sequence(settings):
    sensors = {"estimate": {"kind": "state_estimate", "dropout_probability": 0.3}}
    found = [packet for packet in ns.run(settings(sensors)) if packet.sensor == "estimate"]
    low, high = stats.binom(401, 0.7).interval(1.0 - FALSE_ALARM)
    assert low <= len(found) <= high
    assert all(packet.stamp_ns == 5_000_000 * packet.sequence for packet in found)
    assert all(isinstance(packet, Odometry) for packet in found)


def test_a_drifting_yaw_turns_the_whole_estimate():
    config = StateEstimateConfig(yaw_errors={"white": 0.3}, body_rate_errors={"white": 0.01})
    made, vehicle = sampler(config, slots=1)
    R = Rotation.from_euler("xyz", [0.1, 0.2, 0.3])
    vehicle.reset(position=(3.0, 1.0, 2.0), velocity=(1.0, 0.0, 0.5), orientation=R.as_quat())
    made.measure(0)
    rows = {name: array.numpy()[0, 0] for name, array in made.arrays.items()}
    packet = made.packet(rows, stamp_ns=0)
    turn = Rotation.from_quat(packet.orientation) * R.inv()
    assert turn.as_rotvec()[:2] == pytest.approx([0.0, 0.0], abs=1e-12)
    assert 1e-3 < abs(turn.as_rotvec()[2]) < 1.5
    np.testing.assert_allclose(packet.position, turn.apply([3.0, 1.0, 2.0]), rtol=1e-12)
    np.testing.assert_allclose(packet.velocity, turn.apply([1.0, 0.0, 0.5]), rtol=1e-12)
    assert 0.0 < np.abs(packet.body_rate).max() < 0.1


def test_a_switch_closes_on_the_scene_and_on_the_ground(settings):
    down = {"kind": "contact", "rate_hz": 10.0}
    sensors = {
        "touching": down | {"mount": {"position_m": [0.0, 0.0, -1.18]}},
        "near": down | {"mount": {"position_m": [0.0, 0.0, -1.1]}},
        "far": down | {"radius_m": 0.0, "mount": {"position_m": [0.0, 0.0, -0.2]}},
    }
    first = {packet.sensor: packet for packet in ns.run(settings(sensors, duration_s=0.05))}
    assert {name: packet.closed for name, packet in first.items()} == {
        "touching": True,
        "near": False,
        "far": False,
    }
    assert first["touching"].distance_m == pytest.approx(-0.01, abs=1e-4)
    assert first["near"].distance_m == pytest.approx(0.07, abs=1e-4)
    parameters = {"ground": {"height_m": 0.95}}
    config = settings({"far": sensors["far"]}, duration_s=0.05, vehicle={"parameters": parameters})
    assert next(iter(ns.run(config))).distance_m == pytest.approx(0.05, abs=1e-4)
    assert ContactConfig().packet_type.__name__ == "Contact"


def test_worlds_measure_what_single_runs_measure(settings):
    errors = {"white": 1.0, "walk": 0.1, "markov": 1.0}
    sensors = {
        "barometer": {"kind": "barometer", "errors": errors},
        "estimate": {"kind": "state_estimate", "delay_s": 0.01, "position_errors": errors, "rate_hz": 100},
    }
    config = settings(sensors, duration_s=0.1, control={"rate_hz": 100})
    alone = {}
    for packet in ns.run({**config, "seed": 7}):
        alone.setdefault(packet.sensor, []).append(packet)
    worlds = ns.Simulation(config, worlds=3, seeds=[5, 6, 7])
    worlds.reset()
    for _ in range(9):
        worlds.rollout(1)
    seen = worlds.rollout(1)
    pressure = seen.samples["barometer"].arrays["pressure_pa"].numpy()
    assert pressure[-1, 2] == alone["barometer"][-1].pressure_pa
    assert pressure[-1, 1] != pressure[-1, 2]
    position = seen.samples["estimate"].arrays["position"].numpy()
    assert position[-1, 2].tobytes() == alone["estimate"][-1].position.tobytes()


@pytest.mark.parametrize("name", ["adis16448", "bmi088", "icm20948"])
def test_presets_of_imus_give_way_to_single_keys(name):
    config = ImuConfig.model_validate({"preset": name, "rate_hz": 500.0, "gyroscope_noise_density": 1.0})
    assert (config.rate_hz, config.gyroscope_noise_density) == (500.0, 1.0)
    steps = config.accelerometer_range_m_s2 / config.accelerometer_resolution_m_s2
    assert 20_000 < steps < 2**15 + 1  # to 6 digits
