"""The study of dynamics: its oracle, its methods, and claims that see planted faults."""

from __future__ import annotations

import numpy as np
import pytest

from neurosim_core.bench import dynamics, dynamics_oracle
from neurosim_core.bench.dynamics import RKMK4
from neurosim_core.bench.dynamics_oracle import (
    EXTREMES,
    FLIGHTS,
    HOLD_NS,
    Equations,
    Flight,
    at_rest,
    compare,
    make_reference,
    short_flight,
    solve,
)
from neurosim_core.bench.engine import Multirotor, preset
from neurosim_core.bench.options import Options


@pytest.fixture(scope="module")
def flip():
    flight = FLIGHTS["flip"]()
    return flight, make_reference(flight)


@pytest.mark.parametrize("name", ["crazyflie", "hummingbird", "racer"])
def test_equations_are_those_of_the_vehicle(name):
    """Accelerations of random states: two independent statements of the same equations."""
    config = preset(name, wind_m_s=(2.0, -1.0, 0.5), flapping_kg_m=1e-6)
    rng, vehicle, equations = np.random.default_rng(0), Multirotor(config), Equations(config)
    for _ in range(5):
        q = rng.normal(size=4)
        y = np.concatenate([rng.normal(size=6), q / np.linalg.norm(q), 5.0 * rng.normal(size=3)])
        speed = rng.uniform(0.2, 0.9, 4) * config.rotor_speed_max_rad_s
        vehicle.reset(y[0:3], y[3:6], y[6:10], y[10:13], speed)
        vehicle.accelerate()
        rate = equations.rate(y, speed)
        linear, angular = (values[0] for values in vehicle.acceleration)
        assert rate[3:6] == pytest.approx(linear, rel=1e-9, abs=1e-9)
        assert rate[10:13] == pytest.approx(angular, rel=1e-8, abs=1e-8)


def test_a_fall_is_a_parabola():
    """Rotors that stand still, no drag: z = -g t^2 / 2."""
    config = preset("racer", motor_time_constant_s=0.0, rotor_speed_min_rad_s=0.0)
    start = at_rest(config, rotor_speed=np.zeros(4))
    flight = Flight(name="fall", config=config, start=start, commands=np.zeros((10, 4)))
    states = solve(flight, "DOP853", 1e-12)
    assert states[-1, 2] == pytest.approx(-0.5 * 9.81 * 0.1**2, abs=1e-13)


def test_a_wrong_integrator_of_the_vehicle_is_seen(monkeypatch):
    """Steps that are longer than they say miss the precision of an extreme flight."""
    cases = {"light": EXTREMES["mass 30 g, 100 m/s wind, quadratic drag"]}
    right = dynamics._hard(cases, Options(quick=True))
    limit_m = 2.0 * next(row["position [m]"] for row in right if row["method"] == RKMK4)
    assert dynamics._hard_claim("light", right, limit_m).met

    class Coarse(Multirotor):
        def __init__(self, config, **options):
            super().__init__(config, **{**options, "max_step_ns": HOLD_NS})

    monkeypatch.setattr(dynamics, "Multirotor", Coarse)
    wrong = dynamics._hard(cases, Options(quick=True))
    assert not dynamics._hard_claim("light", wrong, limit_m).met


def test_stiff_flights_are_judged_and_refusals_kept():
    cases = {
        "1e-6 s": (lambda: short_flight("hummingbird", motor_time_constant_s=1e-6), False),
        "slender": EXTREMES["inertia 1:10:100, 200 rad/s"],
    }
    rows = dynamics._hard(cases, Options(quick=True))
    outcome = {(row["flight"], row["method"]): row["outcome"] for row in rows}
    assert outcome["1e-6 s", RKMK4] == "flown"
    assert outcome["slender", RKMK4].startswith("refused: inertia_kg_m2: ")
    assert outcome["slender", RKMK4].endswith(", got [0.0001, 0.001, 0.01]")
    claim = dynamics._hard_claim("all", rows, 1e-8)
    assert claim.met
    assert "slender" in claim.measured
    silently_wrong = [{**row, "position [m]": 1.0} if row["outcome"] == "flown" else row for row in rows]
    assert not dynamics._hard_claim("all", silently_wrong, 1e-8).met
    told, refused = dynamics._pivot(rows)
    assert told[RKMK4] < 1e-8
    assert refused[RKMK4].startswith("refused")


@pytest.mark.skipif(dynamics_oracle.rotorpy_version() is None, reason="RotorPy is not installed")
def test_rotorpy_flies_the_same_equations(flip):
    """Its RK45 at 1 ms is at rounding where motors are slow: the equations are the same."""
    flight, reference = flip
    states, cpu_s = dynamics_oracle.fly_rotorpy(flight, 1e-3)
    assert compare(states, reference.states).position_m < 1e-12
    assert cpu_s > 0.0
    stopped, _ = dynamics_oracle.fly_rotorpy(flight, 1e-3, cpu_max_s=0.0)
    assert np.isnan(stopped[1:]).all()


def test_attitude_errors_are_exact_for_small_ones():
    half = np.array([0.5e-12, 0.05])
    turned, still = np.zeros((2, 17)), np.zeros((2, 17))
    turned[:, 6], turned[:, 9], still[:, 9] = np.sin(half), np.cos(half), 1.0
    for k in range(2):
        found = compare(turned[k : k + 1], still[k : k + 1])
        assert found.attitude_rad == pytest.approx(2.0 * half[k], rel=1e-12)
    assert not compare(np.full((2, 17), np.nan), still).finite
