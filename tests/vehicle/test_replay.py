"""Replay: it follows simulated flights closely, and real ones in their specific force."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from neurosim_core.vehicle import Multirotor, preset
from neurosim_core.vehicle.replay import (
    _FADING_RAD_S2,
    _FADING_S,
    _FILTER_STEP_S,
    _GYRO_RAD_S,
    _KICK_RAD_S_PER_SQRT_S,
    PWM_MAX,
    PWM_THRUST_N,
    Replay,
    _missing,
    read_crazyflie_log,
    replay,
    rotor_thrust_n,
)

CRAZYFLIE = preset("crazyflie")

LOGS = Path(__file__).resolve().parents[3] / "shared" / "data" / "crazyflie"


def real_replay(name: str, **changes: object) -> Replay:
    path = LOGS / f"{name}.csv.gz"
    if not path.exists():
        pytest.skip(f"the log of a real flight is not at {path}")
    return replay(read_crazyflie_log(path), preset("crazyflie", **changes))


@pytest.mark.parametrize("name", ["log10", "log15"])
def test_the_specific_force_of_real_flights_is_followed(name):
    """Within 5 %: thrust, its lag and the battery are right; `neurosim bench replay` compares rates."""
    found = real_replay(name)
    assert found.window_count > 200
    assert found.force_error < 0.05


@pytest.mark.parametrize("name", ["log10", "log15"])
def test_rates_of_real_flights_are_followed(name):
    """0.3 s ahead they are nearer than unchanged ones, as the air and what was missed before tell."""
    found = real_replay(name)
    assert (found.rate_rms_rad_s < found.unchanged_rms_rad_s).all()
    flat = np.array(CRAZYFLIE.rotor_position_m) * [1.0, 1.0, 0.0]
    without_air = real_replay(name, rotor_position_m=tuple(map(tuple, flat)))
    assert (without_air.rate_rms_rad_s[:2] > 1.4 * found.rate_rms_rad_s[:2]).all()
    log = read_crazyflie_log(LOGS / f"{name}.csv.gz")
    untold = replay(log, CRAZYFLIE, missing_torque=False)
    assert (untold.rate_rms_rad_s > 1.1 * found.rate_rms_rad_s).all()


def test_the_filter_tells_what_stays_from_what_fades():
    """It is fed with its own model, on a constant that goes with a load, with pauses on the ground."""
    rng = np.random.default_rng(3)
    steps, constant = 20_000, np.array([12.0, -7.0, 1.5])
    keep = np.exp(-_FILTER_STEP_S / _FADING_S)
    drawn = _FADING_RAD_S2 * np.sqrt(1.0 - keep**2) * rng.standard_normal((steps, 3))
    gust = np.stack([lfilter([1.0], [1.0, -keep[axis]], drawn[:, axis]) for axis in range(3)], axis=1)
    load = np.stack([rng.uniform(0.8, 1.2, steps)] * 3, axis=1)
    told = rng.uniform(-50.0, 50.0, (steps, 3))  # what the model knows
    kick = _KICK_RAD_S_PER_SQRT_S * np.sqrt(_FILTER_STEP_S) * rng.standard_normal((steps, 3))
    change = _FILTER_STEP_S * (told + constant * load + gust) + kick
    rate = np.concatenate([np.zeros((1, 3)), np.cumsum(change, axis=0)[:-1]])
    seen = rate + _GYRO_RAD_S * rng.standard_normal((steps, 3))
    flying = np.arange(steps) % 1000 > 100
    seen[~flying] = 1e3  # what is no flight must not count
    rows = (np.repeat(values, 10, axis=0) for values in (seen, told, load, flying))
    steady, fading = _missing(*rows)
    assert steady.shape == fading.shape == (steps, 3)
    late = np.flatnonzero(flying & (np.arange(steps) % 1000 > 200))[2000:]
    assert (np.abs(steady[late] - constant).mean(axis=0) < 0.35 * _FADING_RAD_S2).all()
    error = steady[late] + fading[late] - constant - gust[late]
    assert (error.std(axis=0)[:2] < 0.5 * _FADING_RAD_S2[:2]).all()  # far better than the mean alone
    assert error.std(axis=0)[2] < _FADING_RAD_S2[2]


def test_a_strong_reaction_torque_is_found_out():
    """33.9 mm of torque over thrust, as in a widespread table, turns the vehicle away within 0.3 s."""
    strong = real_replay("log10", torque_coefficient_n_m_s2=0.0339 * CRAZYFLIE.thrust_coefficient_n_s2)
    assert strong.rate_rms_rad_s[2] > 3.0 * strong.unchanged_rms_rad_s[2]


def pwm_of(thrust_n: NDArray[np.float64]) -> NDArray[np.float64]:
    linear, squared = PWM_THRUST_N
    return PWM_MAX * (np.sqrt(linear**2 + 4.0 * squared * thrust_n) - linear) / (2.0 * squared)


def write_flight(path: Path, config, *, weak: float = 1.0, seconds: float = 5.0) -> None:
    """Log a simulated, restless hover with rotors that give `weak` times the thrust of the firmware's fit."""
    rng = np.random.default_rng(1)
    vehicle = Multirotor(config)
    vehicle.reset(rotor_speed=np.full(4, config.hover_rotor_speed_rad_s))
    hover = config.mass_kg * config.gravity_m_s2 / 4.0
    gain = 2e-3 * np.array([[-1, 1, -1], [1, 1, 1], [1, -1, -1], [-1, -1, 1]])
    rows, wanted = [], np.zeros(3)
    for k in range(round(seconds * 1000)):
        if k % 100 == 0:
            wanted = rng.uniform(-1.0, 1.0, 3)
        state = vehicle.state
        thrust = hover + gain @ (state.body_rate[0] - wanted)
        pwm = np.rint(pwm_of(np.clip(thrust / weak, 0.02, 0.15)))
        turned = Rotation.from_quat(state.orientation[0]).inv()
        felt = turned.apply(vehicle.acceleration.linear[0] + [0.0, 0.0, config.gravity_m_s2])
        rows.append([k * 1e-3, *felt / 9.80665, *np.degrees(state.body_rate[0]), *pwm[[1, 2, 3, 0]]])
        speed = np.sqrt(weak * rotor_thrust_n(pwm) / config.thrust_coefficient_n_s2)
        vehicle.step(speed, 1_000_000)
    text = "# t_s,acc,gyro,motors\n" + "\n".join(",".join(f"{v:.9g}" for v in row) for row in rows)
    path.write_bytes(gzip.compress(text.encode()))


@pytest.mark.parametrize("weak", [1.0, 0.8])
def test_a_simulated_flight_is_followed_closely(weak, tmp_path):
    """The same vehicle with a weak battery; what is left is the air speed, which is known 20 ms late."""
    write_flight(tmp_path / "flight.csv.gz", CRAZYFLIE, weak=weak)
    log = read_crazyflie_log(tmp_path / "flight.csv.gz")
    found = replay(log, CRAZYFLIE, delay_s=0.0)
    assert found.window_count > 20
    assert (found.rate_rms_rad_s < 0.5 * found.unchanged_rms_rad_s).all()
    assert found.force_error < 0.02
    heavy = preset("crazyflie", inertia_kg_m2=tuple(map(tuple, 3.0 * np.array(CRAZYFLIE.inertia_kg_m2))))
    assert (replay(log, heavy, delay_s=0.0).rate_rms_rad_s > 1.5 * found.rate_rms_rad_s).all()


def test_what_cannot_be_replayed_is_refused(tmp_path):
    (tmp_path / "short.csv").write_text("0,1,2\n1,1,2\n")
    with pytest.raises(ValueError, match="got 2 rows of 3 columns"):
        read_crazyflie_log(tmp_path / "short.csv")
    (tmp_path / "still.csv").write_text(
        "\n".join(f"{0.001 * k:.3f},0,0,1,0,0,0,0,0,0,0" for k in range(9000))
    )
    still = read_crazyflie_log(tmp_path / "still.csv")
    with pytest.raises(ValueError, match=r"no 0\.3 s of flight"):
        replay(still, CRAZYFLIE)
    with pytest.raises(ValueError, match=r"must have rotor drag .*got rotor_drag_kg = 0 "):
        replay(still, preset("racer"))
