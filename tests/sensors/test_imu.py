"""The IMU: kinematics against closed forms and finite differences, noise against the Allan variances."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp
from scipy import stats
from scipy.spatial.transform import Rotation

from neurosim_core.sensors.base import SamplerContext
from neurosim_core.sensors.imu import CORRELATION_TIMES_S, ImuConfig
from neurosim_core.sensors.state_sampler import StateSampler
from neurosim_core.settings_file import ConfigError
from neurosim_core.vehicle import Multirotor, preset

MS = 1_000_000
FALSE_ALARM = 1e-6
AT_REST = {
    "thrust_coefficient_n_s2": 0.0,
    "torque_coefficient_n_m_s2": 0.0,
    "rotor_drag_kg": 0.0,
    "rotor_inflow_kg": 0.0,
    "translational_lift_kg_m": 0.0,
    "parasitic_drag_kg_m": (0.0, 0.0, 0.0),
    "gravity_m_s2": 0.0,
}
"""Nothing acts: the exact reading of a vehicle that does not turn is 0, so what is read is the error."""


def isolated(device: str, **overrides) -> Multirotor:
    return Multirotor(preset("hummingbird", **{**AT_REST, **overrides}), device=device)


def make(
    config: ImuConfig, vehicle: Multirotor, *, seed: int = 0, name: str = "imu", slot_count: int = 1
) -> StateSampler:
    """The IMU of each vehicle, with seeds from 1,000 `seed` on."""
    seeds = wp.array(1000 * seed + np.arange(vehicle.count), dtype=wp.uint64, device=vehicle.device)
    active = wp.ones(vehicle.count, dtype=wp.int32, device=vehicle.device)
    context = SamplerContext(name=name, vehicle=vehicle, slot_count=slot_count, seeds=seeds, active=active)
    return config.make(context)


def sample(imu: StateSampler) -> SimpleNamespace:
    """The next sample of every vehicle, each [count, 3]."""
    imu.measure(0)
    return SimpleNamespace(**{name: array.numpy()[0].copy() for name, array in imu.arrays.items()})


def read(vehicle: Multirotor, **config) -> SimpleNamespace:
    return sample(make(ImuConfig(**config), vehicle))


# Kinematics


def test_hover_reads_one_g_upwards(device):
    reading = read(Multirotor(preset("hummingbird"), device=device))
    assert reading.specific_force[0] == pytest.approx([0.0, 0.0, 9.81], abs=1e-14)
    assert not reading.angular_rate.any()


def test_free_fall_reads_nothing(device):
    vehicle = isolated(device, gravity_m_s2=9.81)
    vehicle.reset(orientation=(0.1, 0.2, 0.3, 0.9), velocity=(3.0, 2.0, 1.0))
    vehicle.step(np.zeros(4), 50 * MS)
    assert np.abs(read(vehicle).specific_force).max() < 1e-14


def test_steady_rotation_reads_the_centripetal_acceleration(device):
    """About z at 5 rad/s, mounted at (0.3, -0.1, 0.2): -25 times the offset from the axis."""
    vehicle = isolated(device)
    vehicle.reset(body_rate=(0.0, 0.0, 5.0))
    vehicle.step(np.zeros(4), 123 * MS)
    reading = read(vehicle, mount={"position_m": (0.3, -0.1, 0.2)})
    assert reading.specific_force[0] == pytest.approx([-7.5, 2.5, 0.0], abs=1e-13)
    assert reading.angular_rate[0] == pytest.approx([0.0, 0.0, 5.0], abs=1e-14)


def test_spin_up_reads_the_tangential_acceleration(device):
    """At rest, reaction torques wind the body up about z: dw/dt x r."""
    config = preset("hummingbird")
    vehicle = Multirotor(config, device=device)
    vehicle.reset(rotor_speed=(600.0, 400.0, 600.0, 400.0))
    torque = config.torque_coefficient_n_m_s2 * 2.0 * (600.0**2 - 400.0**2)
    thrust = config.thrust_coefficient_n_s2 * 2.0 * (600.0**2 + 400.0**2)
    reading = read(vehicle, mount={"position_m": (0.5, 0.0, 0.0)})
    expected = [0.0, 0.5 * torque / 7.03e-3, thrust / config.mass_kg]
    assert reading.specific_force[0] == pytest.approx(expected, rel=1e-13, abs=1e-13)


def test_both_sensors_turn_with_the_mount(device):
    """Yawed by 90 degrees, x of S is y of B, and y of S is -x of B."""
    vehicle = isolated(device)
    vehicle.reset(body_rate=(2.0, 0.0, 0.0))
    mount = {"position_m": (0.0, 0.5, 0.0), "rpy_rad": (0.0, 0.0, np.pi / 2)}
    reading = read(vehicle, mount=mount)
    assert reading.angular_rate[0] == pytest.approx([0.0, -2.0, 0.0], abs=1e-15)
    assert reading.specific_force[0] == pytest.approx([-2.0, 0.0, 0.0], abs=1e-15)


def test_readings_are_the_derivatives_of_the_path_of_the_mount(device):
    """Second and first differences of the pose of S along a tumbling flight in wind."""
    mount = {"position_m": (0.12, -0.07, 0.05), "rpy_rad": (0.4, -0.3, 1.1)}
    config = preset("hummingbird", wind_m_s=(3.0, -2.0, 1.0), motor_time_constant_s=0.05)
    vehicle = Multirotor(config, device=device, max_step_ns=MS // 2)
    vehicle.reset(velocity=(5.0, 1.0, -2.0), body_rate=(6.0, -4.0, 3.0))
    imu = make(ImuConfig(mount=mount), vehicle)
    R_BS = Rotation.from_euler("xyz", mount["rpy_rad"])
    step_s = 1e-3
    places, attitudes, readings = [], [], []
    for _ in range(41):
        state = vehicle.state
        R_WB = Rotation.from_quat(state.orientation[0])
        places.append(state.position[0] + R_WB.apply(mount["position_m"]))
        attitudes.append(R_WB * R_BS)
        readings.append(sample(imu))
        vehicle.step((500.0, 520.0, 470.0, 505.0), MS)
    for k in range(2, 39):
        p = places[k - 2 : k + 3]
        acceleration = (-p[0] + 16 * p[1] - 30 * p[2] + 16 * p[3] - p[4]) / (12.0 * step_s**2)
        force = attitudes[k].inv().apply(acceleration + np.array([0.0, 0.0, 9.81]))
        # h^4 / 90 times the sixth derivative, about 10 m/s^2 (10 rad/s)^4, and rounding of 1e-15 m / h^2
        assert readings[k].specific_force[0] == pytest.approx(force, abs=1e-7)
        one = (attitudes[k - 1].inv() * attitudes[k + 1]).as_rotvec() / (2.0 * step_s)
        two = (attitudes[k - 2].inv() * attitudes[k + 2]).as_rotvec() / (4.0 * step_s)
        assert readings[k].angular_rate[0] == pytest.approx((4.0 * one - two) / 3.0, abs=1e-7)


# Errors


def record(config: ImuConfig, *, samples: int, count: int, device: str, seed: int = 0, name: str = "imu"):
    """Readings of a body at rest without gravity: force and rate, each [samples, count, 3]."""
    vehicle = Multirotor(preset("hummingbird", **AT_REST), count=count, device=device)
    imu = make(config, vehicle, seed=seed, name=name, slot_count=samples)
    for slot in range(samples):
        imu.measure(slot)
    return imu.arrays["specific_force"].numpy(), imu.arrays["angular_rate"].numpy()


def allan_statistic(readings, variance: float) -> float:
    """Mean of the first half against the second, a pair per axis and vehicle: chi^2 if `variance` is true."""
    half = len(readings) // 2
    difference = readings[half:].mean(axis=0) - readings[:half].mean(axis=0)
    return float(np.sum(0.5 * difference**2) / variance)


def assert_allan_variance(readings, variance: float, *, detectable: float) -> None:
    """Null: the Allan variance is `variance`. A factor `detectable` on it, up or down, would be noticed."""
    low, high = stats.chi2(readings[0].size).interval(1.0 - FALSE_ALARM)
    statistic = allan_statistic(readings, variance)
    assert low <= statistic <= high
    assert not low <= statistic * detectable <= high
    assert not low <= statistic / detectable <= high


@pytest.mark.parametrize("half", [1, 16])
def test_white_noise_has_allan_variance_n2_over_t(half, device):
    config = ImuConfig(rate_hz=200.0, accelerometer_noise_density=2e-3, gyroscope_noise_density=1.5e-4)
    force, rate = record(config, samples=2 * half, count=2048, device=device)
    time_s = half / 200.0
    assert_allan_variance(force, 2e-3**2 / time_s, detectable=1.2)
    assert_allan_variance(rate, 1.5e-4**2 / time_s, detectable=1.2)


def test_random_walk_has_allan_variance_k2_t_over_3(device):
    config = ImuConfig(rate_hz=200.0, accelerometer_random_walk=3e-3, gyroscope_random_walk=2e-5)
    half = 20
    force, rate = record(config, samples=2 * half, count=2048, device=device)
    sampled = 0.1 / 3.0 * (1.0 + 0.5 / half**2)  # of a walk that is constant between samples
    assert_allan_variance(force, 3e-3**2 * sampled, detectable=1.2)
    assert_allan_variance(rate, 2e-5**2 * sampled, detectable=1.2)
    assert not force[0].any()  # it starts at 0


def instability_variance(time_s: float, rate_hz: float) -> float:
    """Allan variance of the sum of processes for B = 1, from their covariance."""
    half = round(time_s * rate_hz)
    lags = np.arange(2 * half)
    covariance = np.zeros(2 * half)
    for correlation_s in CORRELATION_TIMES_S:
        covariance += np.log(np.sqrt(10.0)) / np.pi * np.exp(-lags / (rate_hz * correlation_s))
    weight = np.repeat([-1.0 / half, 1.0 / half], half)
    # sum over pairs at each lag
    pairs = np.correlate(weight, weight, mode="full")[2 * half - 1 :]
    return float(0.5 * (pairs[0] * covariance[0] + 2.0 * pairs[1:] @ covariance[1:]))


@pytest.mark.parametrize("time_s", [0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 300.0])
def test_bias_instability_is_flat(time_s):
    """The definition of B: a floor of sqrt(2 ln 2 / pi) B = 0.664 B."""
    floor = np.sqrt(2.0 * np.log(2.0) / np.pi)
    assert np.sqrt(instability_variance(time_s, 10.0)) == pytest.approx(floor, rel=0.1)


@pytest.mark.parametrize("half", [3, 30])
def test_bias_instability_has_its_allan_variance(half, device):
    config = ImuConfig(
        rate_hz=10.0, accelerometer_bias_instability_m_s2=4e-4, gyroscope_bias_instability_rad_s=3e-5
    )
    force, rate = record(config, samples=2 * half, count=1024, device=device)
    variance = instability_variance(half / 10.0, 10.0)
    assert_allan_variance(force, 4e-4**2 * variance, detectable=1.25)
    assert_allan_variance(rate, 3e-5**2 * variance, detectable=1.25)
    # stationary from the first sample on: all processes have their variance
    total = len(CORRELATION_TIMES_S) * np.log(np.sqrt(10.0)) / np.pi * 4e-4**2
    low, high = stats.chi2(force[0].size).interval(1.0 - FALSE_ALARM)
    assert low <= np.sum(force[0] ** 2) / total <= high


NOISY = ImuConfig(
    rate_hz=100.0,
    accelerometer_noise_density=1e-2,
    accelerometer_random_walk=1e-2,
    accelerometer_bias_instability_m_s2=1e-2,
    gyroscope_noise_density=1e-2,
    gyroscope_random_walk=1e-2,
    gyroscope_bias_instability_rad_s=1e-2,
)


def test_noise_does_not_depend_on_the_batch(device):
    few = np.concatenate(record(NOISY, samples=5, count=2, device=device), axis=2)
    many = np.concatenate(record(NOISY, samples=5, count=6, device=device), axis=2)
    assert np.array_equal(many[:, :2], few)


def test_noise_is_addressed_by_seed_and_name_and_axis(device):
    """Every seed, name, sensor, axis and vehicle has its own noise: no two are correlated."""
    drawn = []
    for seed, name in ((0, "imu"), (1, "imu"), (0, "imu_2")):
        config = ImuConfig(accelerometer_noise_density=1.0, gyroscope_noise_density=1.0)
        drawn += [*record(config, samples=100, count=2, device=device, seed=seed, name=name)]
    rows = np.concatenate([d.transpose(1, 2, 0).reshape(6, 100) for d in drawn])
    correlation = np.corrcoef(rows) - np.eye(len(rows))
    # 630 pairs of 100 samples, each beyond 0.6 with probability 1e-11
    assert np.abs(correlation).max() < 0.6


def test_reset_starts_the_noise_again(device):
    vehicle = Multirotor(preset("hummingbird"), count=2, device=device)
    imu = make(NOISY, vehicle, seed=3, slot_count=4)
    everywhere = wp.ones(2, dtype=wp.int32, device=device)
    runs = []
    for _ in range(2):
        imu.reset(everywhere)
        for slot in range(4):
            imu.measure(slot)
        runs.append(np.concatenate([array.numpy() for array in imu.arrays.values()], axis=2))
    assert np.array_equal(*runs)
    assert len(np.unique(runs[0])) == runs[0].size


ERRORS = {
    "noise_density": 1e-2,
    "random_walk": 1e-2,
    "bias_instability_{}": 1e-2,
    "range_{}": 50.0,
    "resolution_{}": 1e-3,
}
UNITS = {"accelerometer": "m_s2", "gyroscope": "rad_s"}


@pytest.mark.parametrize("sensor", UNITS)
def test_errors_of_one_sensor_leave_the_other_exact(device, sensor):
    """Both are computed by one kernel: that of the other has all errors, of coefficients that are 0."""
    vehicle = isolated(device)
    vehicle.reset(body_rate=(1.0, 2.0, 5.0))
    mount = {"position_m": (0.3, -0.1, 0.2), "rpy_rad": (0.1, 0.2, 0.3)}
    named = {f"{sensor}_{name.format(UNITS[sensor])}": value for name, value in ERRORS.items()}
    exact, noisy = make(ImuConfig(mount=mount), vehicle), make(ImuConfig(mount=mount, **named), vehicle)
    assert len(noisy.terms) == 5
    for _ in range(20):
        vehicle.step(np.full(4, 500.0), 3 * MS)
        one, other = sample(exact), sample(noisy)
        same, erring = ("angular_rate", "specific_force")[:: 1 if sensor == "accelerometer" else -1]
        # a sum of float64 in another order
        assert getattr(one, same) == pytest.approx(getattr(other, same), abs=1e-12)
        assert np.abs(getattr(one, erring) - getattr(other, erring)).min() > 0.0


def test_saturation(device):
    vehicle = Multirotor(preset("hummingbird"), device=device)
    vehicle.reset(body_rate=(40.0, -40.0, 3.0))
    reading = read(vehicle, accelerometer_range_m_s2=5.0, gyroscope_range_rad_s=35.0)
    assert reading.specific_force[0, 2] == 5.0
    assert reading.angular_rate[0].tolist() == [35.0, -35.0, 3.0]


def test_quantisation(device):
    """Nearest multiple; after the noise."""
    config = ImuConfig(
        accelerometer_noise_density=0.1, accelerometer_resolution_m_s2=0.25, gyroscope_resolution_rad_s=0.5
    )
    vehicle = isolated(device)
    vehicle.reset(body_rate=(0.0, 0.0, 1.3))
    imu, plain = (
        make(c, vehicle) for c in (config, config.model_copy(update={"accelerometer_resolution_m_s2": 0.0}))
    )
    for _ in range(20):
        reading, smooth = sample(imu), sample(plain)
        assert np.array_equal(reading.specific_force, 0.25 * np.round(smooth.specific_force / 0.25))
        assert reading.angular_rate[0].tolist() == [0.0, 0.0, 1.5]


def test_errors_that_are_0_are_left_out(device):
    vehicle = Multirotor(preset("hummingbird"), device=device)
    assert make(ImuConfig(), vehicle).terms == ()
    assert make(NOISY, vehicle).terms == ("white", "walk", "instability")


@pytest.mark.parametrize(
    "wrong",
    [
        {"rate_hz": 0.0},
        {"accelerometer_noise_density": -1.0},
        {"gyroscope_range_rad_s": 0.0},
        {"accelerometer_resolution_m_s2": float("nan")},
        {"noise": 1.0},
    ],
)
def test_parameters_are_checked(wrong):
    with pytest.raises(ConfigError, match=next(iter(wrong))):
        ImuConfig(**wrong)
