"""Wind: gusts against their law, turbulence against the closed forms and statistics of Dryden's model."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import warp as wp
from multirotor_oracle import NO_AERO, angle, solve
from scipy import stats
from scipy.linalg import expm, solve_continuous_lyapunov

from neurosim_core import load_config, sim
from neurosim_core.settings_file import ConfigError
from neurosim_core.vehicle import (
    TERMS,
    GroundConfig,
    GustConfig,
    Multirotor,
    MultirotorState,
    TurbulenceConfig,
    preset,
    wind,
)

MS = 1_000_000
HUMMINGBIRD = preset("hummingbird")
FOOT_M = 0.3048
DRAG = {"rotor_drag_kg": 1e-12, "rotor_inflow_kg": 1e-12}
VANE = {
    "gravity_m_s2": 0.0,
    "thrust_coefficient_n_s2": 0.0,
    "torque_coefficient_n_m_s2": 0.0,
    **NO_AERO,
    **DRAG,
}
"""A body that feels the wind, and is not moved by it to speak of."""
FALSE_ALARM = 1e-6


def felt(vehicle: Multirotor) -> np.ndarray:
    """Wind at each vehicle in W: drag of rotors at a known speed is linear in it."""
    state, config = vehicle.state, vehicle.config
    scale = config.mass_kg / (config.rotor_drag_kg * state.rotor_speed.sum(axis=1, keepdims=True))
    return state.velocity + scale * vehicle.acceleration.linear


def make_vane(count: int = 1, *, device: str, seed: int = 0, **weather) -> Multirotor:
    config = preset("hummingbird", **{**VANE, **weather})
    # kernels of all terms: one set for all weather
    vehicle = Multirotor(config, count=count, device=device, seed=seed, max_step_ns=100 * MS, terms=TERMS)
    vehicle.reset(rotor_speed=np.full(4, 500.0))
    return vehicle


def listen(vehicle: Multirotor, interval_ns: int, count: int) -> np.ndarray:
    """Wind now and after each of `count` intervals, shape [count + 1, N, 3]."""
    heard = [felt(vehicle)]
    for _ in range(count):
        vehicle.step(np.full(4, 500.0), interval_ns)
        heard.append(felt(vehicle))
    return np.array(heard)


# Gusts


@pytest.mark.parametrize(("hold_s", "after"), [(None, 1.0), (0.0, 0.0), (0.03, 0.0)])
def test_gust_follows_its_law(hold_s, after, device):
    """1 - cos up, held, 1 - cos down, on top of the constant wind and of each other."""
    first = GustConfig(velocity_m_s=(4.0, -2.0, 1.0), start_s=0.05, rise_s=0.1, hold_s=hold_s)
    second = GustConfig(velocity_m_s=(0.0, 3.0, 0.0), start_s=0.12, rise_s=0.02)

    def share(t):
        if t <= 0.0:
            return 0.0
        if t <= 0.1:
            return 0.5 * (1.0 - np.cos(np.pi * t / 0.1))
        if hold_s is None or t <= 0.1 + hold_s:
            return 1.0
        fallen = min(t - 0.1 - hold_s, 0.1)
        return 0.5 * (1.0 + np.cos(np.pi * fallen / 0.1))

    vehicle = make_vane(device=device, wind_m_s=(1.0, 0.0, 0.0), gusts=(first, second))
    assert vehicle.config.terms()[-2:] == ("wind", "gusts")
    heard = listen(vehicle, 7 * MS, 50)[:, 0]
    for k, velocity in enumerate(heard):
        t = 0.007 * k
        expected = np.array([1.0, 0.0, 0.0]) + share(t - 0.05) * np.array(first.velocity_m_s)
        expected[1] += 3.0 * 0.5 * (1.0 - np.cos(np.pi * np.clip((t - 0.12) / 0.02, 0.0, 1.0)))
        assert velocity == pytest.approx(expected, abs=1e-12)
    assert share(0.3) == after


@pytest.mark.parametrize("integrator", ["rkmk4", "dormand_prince"])
def test_flight_through_a_gust(integrator, device):
    """Against the second multirotor in the same wind, integrated to 1e-12."""
    gust = GustConfig(velocity_m_s=(8.0, 3.0, -2.0), start_s=0.02, rise_s=0.04, hold_s=0.02)
    config = preset("hummingbird", gusts=(gust,), wind_m_s=(1.0, 0.0, 0.0))
    vehicle = Multirotor(config, device=device, integrator=integrator, rtol=1e-10, atol=1e-12)
    start = MultirotorState(*(rows[0] for rows in vehicle.state))

    def blows(t):
        rising = 0.5 * (1.0 - np.cos(np.pi * np.clip((t - 0.02) / 0.04, 0.0, 1.0)))
        falling = 0.5 * (1.0 - np.cos(np.pi * np.clip((t - 0.08) / 0.04, 0.0, 1.0)))
        return np.array([1.0, 0.0, 0.0]) + (rising - falling) * np.array([8.0, 3.0, -2.0])

    held = config.hover_rotor_speed_rad_s * np.array([[1.0, 1.02, 0.98, 1.0]] * 8)
    for expected in solve(config, start, held, 0.02, wind=blows):
        vehicle.step(held[0], 20 * MS)
        state = MultirotorState(*(rows[0] for rows in vehicle.state))
        assert state.position == pytest.approx(expected.position, abs=1e-9)
        assert angle(state.orientation, expected.orientation) < 1e-9


# Turbulence: the filters

_vec2 = wp.vec2d


@wp.kernel
def _filter_once(
    theta: wp.array[wp.float64], state: wp.array[wp.vec2d], noise: wp.array[wp.vec2d], out: wp.array[wp.vec2d]
) -> None:
    row = wp.tid()
    out[row] = wind._next_across(state[row], theta[row], noise[row])


@wp.kernel
def _filter_along(theta: wp.array[wp.float64], out: wp.array[wp.vec2d]) -> None:
    row = wp.tid()
    out[row] = wp.vec2d(
        wind._next_along(wp.float64(1.0), theta[row], wp.float64(0.0)),
        wind._next_along(wp.float64(0.0), theta[row], wp.float64(1.0)),
    )


THETAS = [1e-8, 1e-5, 1e-3, 0.03, 0.0499, 0.0501, 0.3, 1.0, 5.0, 50.0]


def test_filters_are_sampled_exactly(device):
    """Transition against expm; covariance against quadrature, or P - F P F' (Lyapunov)."""
    A, B = np.array([[-1.0, 0.0], [1.0, -1.0]]), np.array([[1.0], [0.0]])
    P = solve_continuous_lyapunov(A, -B @ B.T)
    for theta in THETAS:
        rows = wp.array(np.full(4, theta), dtype=wp.float64, device=device)
        states = wp.array([[1.0, 0.0], [0.0, 1.0], [0.0, 0.0], [0.0, 0.0]], dtype=_vec2, device=device)
        noises = wp.array([[0.0, 0.0], [0.0, 0.0], [1.0, 0.0], [0.0, 1.0]], dtype=_vec2, device=device)
        out = wp.zeros(4, dtype=_vec2, device=device)
        wp.launch(_filter_once, dim=4, inputs=[rows, states, noises], outputs=[out], device=device)
        columns = out.numpy().T
        transition, root = columns[:, :2], columns[:, 2:]
        assert transition == pytest.approx(expm(A * theta), rel=1e-13, abs=1e-15)
        covariance = root @ root.T
        if theta < 0.1:  # leading terms of the series: theta, theta^2 / 2, theta^3 / 3, each by exp(-2 s)
            s, weight = np.polynomial.legendre.leggauss(30)
            s, weight = 0.5 * theta * (s + 1.0), 0.5 * theta * weight
            response = np.exp(-s) * np.array([np.ones_like(s), s])
            expected = (weight * response) @ response.T
        else:
            expected = P - transition @ P @ transition.T
        assert covariance == pytest.approx(expected, rel=1e-11)
        assert root[1, 1] > 0.0  # theta^1.5 / 12^0.5 is not lost to rounding

        along = wp.zeros(1, dtype=_vec2, device=device)
        wp.launch(_filter_along, dim=1, inputs=[rows[:1]], outputs=[along], device=device)
        decay, noise = along.numpy()[0]
        assert decay == pytest.approx(np.exp(-theta), rel=1e-14)
        assert noise**2 == pytest.approx(-np.expm1(-2.0 * theta), rel=1e-13)


# Turbulence: the wind

ALTITUDE_M, AIRSPEED_M_S, WIND_20FT_M_S = 30.0, 25.0, 10.0
TICK_NS = 100 * MS
COUNT = 16_384
MODERATE = TurbulenceConfig(
    wind_20ft_m_s=WIND_20FT_M_S, altitude_m=ALTITUDE_M, airspeed_m_s=AIRSPEED_M_S, sample_s=0.1
)


def mil_f_8785c(altitude_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Standard deviations [m/s] and scale lengths [m] of u, v, w."""
    h = altitude_m / FOOT_M
    sigma_w = 0.1 * WIND_20FT_M_S
    sigma_u = sigma_w / (0.177 + 0.000823 * h) ** 0.4
    length_u = h / (0.177 + 0.000823 * h) ** 1.2 * FOOT_M
    return np.array([sigma_u, sigma_u, sigma_w]), np.array([length_u, length_u, altitude_m])


@pytest.fixture(scope="module")
def heard() -> np.ndarray:
    """Turbulence at many vehicles, which it meets independently: [tick, vehicle, axis]."""
    return listen(make_vane(COUNT, device="cpu", turbulence=MODERATE), TICK_NS, 40)


def variance_is(sample: np.ndarray, variance: float) -> bool:
    low, high = stats.chi2(len(sample)).interval(1.0 - FALSE_ALARM)
    return bool(low <= (sample**2).sum() / variance <= high)


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("tick", [0, 1, 40])
def test_variance_of_turbulence(tick, axis, heard):
    """Stationary from the start: chi^2 of 16,384 vehicles; 8 % too much would be noticed."""
    sigma = mil_f_8785c(ALTITUDE_M)[0][axis]
    sample = heard[tick, :, axis]
    assert variance_is(sample, sigma**2)
    assert not variance_is(1.04 * sample, sigma**2)
    assert abs(sample.mean()) < stats.norm.isf(0.5 * FALSE_ALARM) * sigma / np.sqrt(COUNT)
    assert stats.kstest(sample / sigma, "norm").pvalue > FALSE_ALARM


def correlation(sample: np.ndarray, other: np.ndarray) -> float:
    return float((sample * other).mean() / np.sqrt((sample**2).mean() * (other**2).mean()))


@pytest.mark.parametrize("lag", [1, 3, 10, 40])
def test_autocorrelation_of_turbulence(lag, heard):
    """exp(-s) along, (1 - s / 2) exp(-s) across and vertically, s = V t / L; nothing between the axes."""
    s = AIRSPEED_M_S * 0.1 * lag / mil_f_8785c(ALTITUDE_M)[1]
    expected = np.exp(-s) * np.array([1.0, 1.0 - 0.5 * s[1], 1.0 - 0.5 * s[2]])
    deviations = stats.norm.isf(0.5 * FALSE_ALARM)

    def agrees(found: float, r: float) -> bool:  # Fisher's z is normal
        return abs(np.arctanh(found) - np.arctanh(r)) < deviations / np.sqrt(COUNT - 3)

    for axis in range(3):
        found = correlation(heard[0, :, axis], heard[lag, :, axis])
        assert agrees(found, expected[axis])
        assert not agrees(found, expected[axis] - 0.08)
        assert agrees(correlation(heard[0, :, axis], heard[lag, :, (axis + 1) % 3]), 0.0)


def test_spectrum_of_turbulence(device):
    """Dryden's spectra, from 1 to 20 rad/s, of 64 long records; what is faster is bent by the sampling."""
    config = TurbulenceConfig(wind_20ft_m_s=WIND_20FT_M_S, altitude_m=ALTITUDE_M, airspeed_m_s=AIRSPEED_M_S)
    vehicle = make_vane(64, device=device, turbulence=config, seed=5)
    record = listen(vehicle, 20 * MS, 2047)
    sigma, length = mil_f_8785c(ALTITUDE_M)
    window = np.hanning(len(record))[:, None, None]
    power = np.abs(np.fft.rfft(window * record, axis=0)) ** 2 * 0.02 / (window**2).sum()  # two-sided, per Hz
    omega = 2.0 * np.pi * np.fft.rfftfreq(len(record), 0.02)
    for axis in range(3):
        x = length[axis] * omega / AIRSPEED_M_S
        shape = 1.0 / (1.0 + x**2) if axis == 0 else 0.5 * (1.0 + 3.0 * x**2) / (1.0 + x**2) ** 2
        density = sigma[axis] ** 2 * 2.0 * length[axis] / AIRSPEED_M_S * shape
        for low, high in ((1.0, 3.0), (3.0, 8.0), (8.0, 20.0)):
            band = (omega >= low) & (omega < high)
            ratio = power[band, :, axis].mean() / density[band].mean()
            # independent: each vehicle, every second line through the window
            share = stats.gamma(0.5 * 64 * band.sum()).interval(1.0 - FALSE_ALARM) / (0.5 * 64 * band.sum())
            assert share[0] < ratio < share[1] + 0.01


@pytest.mark.parametrize("height_m", [0.5, 3.048, 10.0, 100.0, 304.8, 2000.0])
def test_turbulence_depends_on_the_height(height_m, device):
    """Intensities of MIL-F-8785C at the height of the vehicle, held beyond 10 and 1000 ft."""
    turbulence, ground = TurbulenceConfig(wind_20ft_m_s=WIND_20FT_M_S), GroundConfig(height_m=-7.0)
    vehicle = make_vane(4096, device=device, turbulence=turbulence, ground=ground, seed=3)
    vehicle.reset(position=(0.0, 0.0, height_m - 7.0), rotor_speed=np.full(4, 500.0))
    sigma = mil_f_8785c(np.clip(height_m, 10.0 * FOOT_M, 1000.0 * FOOT_M))[0]
    for axis in range(3):
        assert variance_is(felt(vehicle)[:, axis], sigma[axis] ** 2)
        assert not variance_is(1.12 * felt(vehicle)[:, axis], sigma[axis] ** 2)


def test_scale_follows_height_and_air_speed(device):
    """Correlation over a tick gives L / V: 8 m/s against the wind are 11 m/s of air speed."""
    turbulence = TurbulenceConfig(wind_20ft_m_s=WIND_20FT_M_S, sample_s=0.1)
    vehicle = make_vane(COUNT, device=device, turbulence=turbulence, wind_m_s=(3.0, 0.0, 0.0))
    vehicle.reset(position=(0.0, 0.0, 50.0), velocity=(-8.0, 0.0, 0.0), rotor_speed=np.full(4, 500.0))
    record = listen(vehicle, TICK_NS, 1) - [3.0, 0.0, 0.0]
    s = 11.0 * 0.1 / mil_f_8785c(50.0)[1]
    noise = 1.0 - np.exp(-2.0 * s[0])
    change = record[1, :, 0] - np.exp(-s[0]) * record[0, :, 0]
    assert variance_is(change, mil_f_8785c(50.0)[0][0] ** 2 * noise)
    assert not variance_is(1.08 * change, mil_f_8785c(50.0)[0][0] ** 2 * noise)


def test_axes_follow_the_mean_wind(device):
    """With u along the wind: turned by 90 degrees, what was u is felt along y, and v along -x."""
    records = []
    for mean in ((2.0, 0.0, 0.0), (0.0, 2.0, 0.0)):
        vehicle = make_vane(3, device=device, turbulence=MODERATE, wind_m_s=mean)
        records.append(listen(vehicle, TICK_NS, 3) - mean)
    along, turned = records
    assert turned[..., 1] == pytest.approx(along[..., 0], abs=1e-9)
    assert turned[..., 0] == pytest.approx(-along[..., 1], abs=1e-9)
    assert turned[..., 2] == pytest.approx(along[..., 2], abs=1e-9)


def test_the_same_wind_whatever_the_steps_and_the_batch(device):
    """It is addressed by the tick; fixed altitude and air speed: no flight matters."""
    config = MODERATE.model_copy(update={"sample_s": 0.01})
    whole = make_vane(7, device=device, turbulence=config, seed=11)
    fine = listen(whole, 5 * MS, 200)[::20]  # every 0.1 s
    coarse = listen(make_vane(3, device=device, turbulence=config, seed=11), TICK_NS, 10)
    assert fine[:, :3] == pytest.approx(coarse, abs=1e-9)
    at_once = make_vane(3, device=device, turbulence=config, seed=11)
    at_once.step(np.full(4, 500.0), 1_000 * MS)
    assert felt(at_once) == pytest.approx(coarse[-1], abs=1e-9)
    other = make_vane(3, device=device, turbulence=config, seed=12)
    assert not np.isclose(felt(other), coarse[0]).any()
    assert len(np.unique(np.round(coarse[0], 9))) == 9  # vehicles and axes are independent


def climb(parts_ms, *, sample_s: float, device: str, **settings) -> np.ndarray:
    """Fly for 1 s out of trim at the vehicle's own height and air speed, in calls of the given lengths."""
    config = preset(
        "hummingbird",
        wind_m_s=(3.0, 1.0, 0.0),
        turbulence=TurbulenceConfig(wind_20ft_m_s=15.4, sample_s=sample_s),
        **settings,
    )
    vehicle = Multirotor(config, device=device, terms=TERMS if settings else None)
    vehicle.reset(position=(0.0, 0.0, 10.0), velocity=(4.0, -1.0, 6.0))
    for command in config.hover_rotor_speed_rad_s * np.array(
        [[1.01, 0.99, 1.0, 1.02], [1.0, 1.01, 1.0, 0.99]]
    ):
        vehicle.command(command)
        until_ns = vehicle.stamp_ns + 500 * MS
        for part_ms in itertools.cycle(parts_ms):
            vehicle.advance(min(round(part_ms * MS), until_ns - vehicle.stamp_ns))
            if vehicle.stamp_ns == until_ns:
                break
    vehicle.check()
    state = vehicle.state
    assert 12.0 < state.position[0, 2] < 20.0  # scale and intensity have changed on the way
    return np.concatenate(state, axis=1)[0]


@pytest.mark.parametrize("sample_s", [0.01, 0.003, 0.0237])
def test_the_same_wind_whatever_the_intervals(sample_s, device):
    """Height and air speed are those at the ticks, where intervals are cut, not those where calls begin."""
    whole = climb([500], sample_s=sample_s, device=device)
    for parts_ms in ([1], [10], [250], [3, 5, 2], [5, 3]):
        assert climb(parts_ms, sample_s=sample_s, device=device) == pytest.approx(whole, rel=1e-12, abs=1e-12)
    # steps of another length: their error, as without turbulence
    odd = climb([33.333333, 16.666667], sample_s=sample_s, device=device)
    assert odd == pytest.approx(whole, rel=1e-8, abs=1e-8)


def test_a_further_sensor_does_not_change_the_wind():
    """Control at 125 Hz; stamps at 200 Hz cut other intervals."""
    settings = {
        "device": "cpu",
        "duration_s": 1.0,
        "scene": {"kind": "hall", "size_m": [8, 6, 3]},
        "vehicle": {"parameters": {"turbulence": {"wind_20ft_m_s": 15.4}, "wind_m_s": [2.0, 0.0, 0.0]}},
        "control": {"rate_hz": 125},
        "path": {"kind": "hover"},
    }
    own = {"odometry": {"kind": "odometry", "rate_hz": 25}}
    ends = []
    for sensors in (own, {**own, "imu": {"kind": "imu", "rate_hz": 200}}):
        model = sim.make_model(load_config({**settings, "sensors": sensors}))
        state = sim.make_state(model)
        while state.stamp_ns < 1_000 * MS:
            sim.step(model, state, np.full(4, 1.01 * HUMMINGBIRD.hover_rotor_speed_rad_s))
        ends.append(np.concatenate(state.vehicle.state, axis=1)[0])
        assert state.stamp_ns == 1_000 * MS
    assert ends[1] == pytest.approx(ends[0], rel=1e-12, abs=1e-12)


def test_turbulence_is_linear_between_ticks(device):
    record = listen(make_vane(2, device=device, turbulence=MODERATE), 25 * MS, 8)
    for first in (0, 4):
        for part in (1, 2, 3):
            expected = record[first] + 0.25 * part * (record[first + 4] - record[first])
            assert record[first + part] == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("gusty", [False, True])
@pytest.mark.parametrize("turbulence", [None, MODERATE])
def test_the_velocity_of_the_air_is_what_the_vehicle_feels(gusty, turbulence, device):
    """At time 0, between ticks and on them; steady wind, gusts and turbulence add up."""
    gust = GustConfig(velocity_m_s=(0.0, 0.0, -4.0), start_s=0.01, rise_s=0.05)
    vehicle = make_vane(
        2, device=device, wind_m_s=(3.0, 1.0, 0.0), gusts=(gust,) if gusty else (), turbulence=turbulence
    )
    for _ in range(6):
        np.testing.assert_allclose(vehicle.arrays.air_velocity.numpy(), felt(vehicle), atol=1e-11)
        vehicle.step(np.full(4, 500.0), 7 * MS)
    vehicle.reset(rotor_speed=np.full(4, 500.0))
    np.testing.assert_allclose(vehicle.arrays.air_velocity.numpy(), felt(vehicle), atol=1e-11)
    vehicle.step(np.full(4, 500.0), 20 * MS)
    heard = vehicle.arrays.air_velocity.numpy()
    assert (heard[0] != heard[1]).all() == (turbulence is not None)


def test_reset_brings_the_same_wind_back(device):
    vehicle = make_vane(2, device=device, turbulence=MODERATE)
    first = listen(vehicle, 30 * MS, 12)
    vehicle.reset(rotor_speed=np.full(4, 500.0))
    assert np.array_equal(listen(vehicle, 30 * MS, 12), first)


def test_flight_in_turbulence(device):
    """Fixed and adaptive steps see one wind, the one at the ticks of which the second multirotor is told."""
    turbulence = TurbulenceConfig(wind_20ft_m_s=15.0, altitude_m=10.0, airspeed_m_s=8.0)
    weather = {"turbulence": turbulence, "wind_m_s": (3.0, 1.0, 0.0)}
    ticks = listen(make_vane(device=device, seed=2, **weather), 10 * MS, 12)[:, 0]

    def blows(t):
        place = min(t / 0.01, 11.999999)
        return ticks[int(place)] + (place - int(place)) * (ticks[int(place) + 1] - ticks[int(place)])

    config = preset("hummingbird", **weather)
    for integrator, tolerance_m in (("rkmk4", 1e-9), ("dormand_prince", 1e-9)):
        vehicle = Multirotor(config, device=device, seed=2, integrator=integrator, rtol=1e-9, atol=1e-11)
        start = MultirotorState(*(rows[0] for rows in vehicle.state))
        held = np.full((12, 4), config.hover_rotor_speed_rad_s)
        for expected in solve(config, start, held, 0.01, wind=blows):
            vehicle.step(held[0], 10 * MS)
            assert vehicle.state.position[0] == pytest.approx(expected.position, abs=tolerance_m)


def test_redone_intervals_meet_the_same_wind(device):
    """A light vehicle, of which intervals are redone, against adaptive steps alone."""
    turbulence = TurbulenceConfig(wind_20ft_m_s=15.0, altitude_m=10.0, airspeed_m_s=8.0)
    light = {"mass_kg": 3e-5, "translational_lift_kg_m": 0.0, "wind_m_s": (60.0, 0.0, 0.0)}
    ends = []
    for integrator in ("rkmk4", "dormand_prince"):
        vehicle = Multirotor(
            preset("hummingbird", turbulence=turbulence, **light), device=device, integrator=integrator
        )
        for _ in range(5):
            vehicle.step(np.full(4, 5.0), 17 * MS)
        ends.append(vehicle.state.position[0])
        assert (vehicle.effort.redone_count[0] > 0) == (integrator == "rkmk4")
    assert ends[0] == pytest.approx(ends[1], rel=1e-4)


def test_a_run_has_the_wind_of_its_seed():
    settings = {
        "device": "cpu",
        "scene": {"kind": "hall", "size_m": [8, 6, 3]},
        "vehicle": {"parameters": {"turbulence": {"wind_20ft_m_s": 5.0}}},
        "sensors": {"odometry": {"kind": "odometry", "rate_hz": 100}},
        "path": {"kind": "hover"},
    }
    model = sim.make_model(load_config({**settings, "seed": 3}))
    ends = []
    for seed in (None, 3, 4):
        state = sim.make_state(model, seed=seed)
        for _ in range(4):
            sim.step(model, state, np.full(4, HUMMINGBIRD.hover_rotor_speed_rad_s))
        ends.append(np.concatenate(state.vehicle.state, axis=1))
    assert np.array_equal(ends[0], ends[1])
    assert not np.isclose(ends[0][0, :3], ends[2][0, :3], rtol=1e-9, atol=0.0).any()


@pytest.mark.parametrize("name", ["wind_m_s", "gusts", "turbulence"])
def test_moving_air_that_nothing_feels_is_refused(name):
    """The racer has no drag of any kind."""
    gust = GustConfig(velocity_m_s=(1.0, 0.0, 0.0), start_s=0.0, rise_s=1.0)
    weather = {"wind_m_s": (1.0, 0.0, 0.0), "gusts": (gust,), "turbulence": MODERATE}[name]
    with pytest.raises(ConfigError, match=f"{name}: moving air does nothing to a vehicle without drag"):
        preset("racer", **{name: weather})
    felt = preset("racer", flapping_kg_m=1e-6, **{name: weather})
    assert name.removesuffix("_m_s") in felt.terms()


@pytest.mark.parametrize(
    ("kind", "values", "message"),
    [
        (GustConfig, {"rise_s": 0.0}, "greater than 0"),
        (GustConfig, {"start_s": -1.0}, "greater than or equal to 0"),
        (GustConfig, {"hold_s": -1.0}, "greater than or equal to 0"),
        (GustConfig, {"rise_s": np.inf}, "finite"),
        (GustConfig, {"velocity_m_s": (np.nan, 0.0, 0.0)}, "finite"),
        (TurbulenceConfig, {"wind_20ft_m_s": 0.0}, "greater than 0"),
        (TurbulenceConfig, {"wind_20ft_m_s": np.nan}, "finite"),
        (TurbulenceConfig, {"wind_20ft_m_s": 101.0}, "less than or equal to 100"),
        (TurbulenceConfig, {"altitude_m": 3.0}, "greater than or equal to 3.048"),
        (TurbulenceConfig, {"altitude_m": 305.0}, "less than or equal to 304.8"),
        (TurbulenceConfig, {"airspeed_m_s": 0.0}, "greater than 0"),
        (TurbulenceConfig, {"sample_s": 0.0}, "greater than or equal to 0.0001"),
        (TurbulenceConfig, {"sample_s": 1e-2 / 3.0}, "whole number of nanoseconds"),
        (TurbulenceConfig, {"altitude": 30.0}, "altitude"),
    ],
)
def test_weather_is_checked(kind, values, message):
    right = {
        GustConfig: {"velocity_m_s": (1.0, 0.0, 0.0), "start_s": 0.0, "rise_s": 1.0},
        TurbulenceConfig: {"wind_20ft_m_s": 5.0},
    }[kind]
    kind(**right)
    with pytest.raises(ConfigError, match=message):
        kind(**{**right, **values})
