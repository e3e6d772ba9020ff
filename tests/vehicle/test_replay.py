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
from neurosim_core.vehicle.presets import CRAZYFLIE
from neurosim_core.vehicle.replay import (
    _FADING_RAD_S2,
    _FADING_S,
    _FILTER_STEP_S,
    _NOISE_RAD_S2,
    PWM_MAX,
    PWM_THRUST_N,
    Replay,
    _missing,
    read_crazyflie_log,
    replay,
    rotor_thrust_n,
)

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


def test_rates_of_real_flights_are_followed():
    """About an axis where the flight is restless; the other flight hovers, and little but gusts turns it."""
    found = real_replay("log15")
    assert (found.rate_rms_rad_s[:2] < 0.7 * found.unchanged_rms_rad_s[:2]).all()
    position = np.array(CRAZYFLIE.rotor_position_m) * [1.0, 1.0, 0.0]
    for name in ("log10", "log15"):
        better = real_replay(name).rate_rms_rad_s[:2]
        assert (
            real_replay(name, rotor_position_m=tuple(map(tuple, position))).rate_rms_rad_s[:2] > 1.15 * better
        ).all()


def test_the_filter_tells_what_stays_from_what_fades():
    """It is fed with its own model, a Gauss-Markov process on a constant, with pauses on the ground."""
    rng = np.random.default_rng(3)
    steps, constant = 20_000, np.array([12.0, -7.0, 1.5])
    keep = np.exp(-_FILTER_STEP_S / _FADING_S)
    kick = _FADING_RAD_S2 * np.sqrt(1.0 - keep**2) * rng.standard_normal((steps, 3))
    gust = np.stack([lfilter([1.0], [1.0, -keep[axis]], kick[:, axis]) for axis in range(3)], axis=1)
    seen = constant + gust + _NOISE_RAD_S2 * rng.standard_normal((steps, 3))
    flying = np.arange(steps) % 1000 > 100
    seen[~flying] = 1e3  # what is no flight must not count
    steady, fading = _missing(np.repeat(seen, 10, axis=0), np.repeat(flying, 10))
    assert steady.shape == (steps + 1, 3)
    late = np.flatnonzero(flying)[2000:]
    assert (np.abs(steady[late + 1] - constant).mean(axis=0) < 0.35 * _FADING_RAD_S2).all()
    error = steady[late + 1] + fading[late + 1] - constant - gust[late]
    assert (error.std(axis=0) < _NOISE_RAD_S2).all()  # better than the last measurement alone
    assert (error.std(axis=0) < 0.8 * _FADING_RAD_S2).all()  # better than the mean alone


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
