"""What `neurosim bench dynamics` stands on: baselines, references, the free top, how errors are judged."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from multirotor_oracle import derivative
from multirotor_oracle import solve as solve_rotor_by_rotor
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from neurosim_core.bench.dynamics_extremes import CASES, Refusal, make_flight, measure_trials
from neurosim_core.bench.dynamics_long import measure_formats, unforced
from neurosim_core.bench.dynamics_methods import (
    DORMAND_PRINCE,
    EULER,
    FIXED_STEP,
    MIDPOINT,
    RK4,
    RKMK4,
    Method,
    first_state,
    fly,
    fly_called,
)
from neurosim_core.bench.dynamics_precision import Sample, fit_order
from neurosim_core.bench.dynamics_reference import Derivative, FreeTop, make_reference, solve
from neurosim_core.bench.dynamics_scenes import (
    HOLD_NS,
    SCENES,
    Errors,
    Flight,
    at_rest,
    attitude_errors,
    flight_errors,
    random_commands,
    stacked,
)
from neurosim_core.bench.dynamics_throughput import everything, in_wind
from neurosim_core.bench.rotorpy_peer import fly_rotorpy, quad_params
from neurosim_core.vehicle import TERMS, Multirotor, MultirotorState, preset
from neurosim_core.vehicle.aerodynamics import AIR_TERMS

NOTHING = Errors(position_m=0.0, attitude_rad=0.0, body_rate_rad_s=0.0)


def windy() -> Flight:
    """Return 30 ms of a hummingbird that uses every term, at some speed and spin."""
    config = in_wind()
    start = at_rest(config, velocity=(3.0, -2.0, 1.0), body_rate=(2.0, -3.0, 1.0))
    return Flight(
        name="windy", config=config, start=start, commands=random_commands(config, 3, share=0.2, seed=1)
    )


def pack(state: MultirotorState) -> np.ndarray:
    return np.concatenate(state[:4])


# Right-hand side and reference


def test_the_right_hand_side_is_that_of_the_rotors_one_by_one():
    config = in_wind()
    assert {"motor_lag", "wind", "full_inertia", *AIR_TERMS} <= set(config.terms())  # nothing is left out
    ours, rng = Derivative(config), np.random.default_rng(2)
    for _ in range(20):
        q = rng.normal(size=4)
        y = np.concatenate([10.0 * rng.normal(size=6), q / np.linalg.norm(q), 5.0 * rng.normal(size=3)])
        speed = rng.uniform(0.0, 1500.0, 4)
        exact = derivative(config, y, speed)
        assert ours(y, speed) == pytest.approx(exact, rel=1e-12, abs=1e-12 * np.abs(exact).max())


@pytest.mark.parametrize("solver", ["DOP853", "Radau"])
def test_the_reference_is_that_of_the_rotors_one_by_one(solver):
    flight = windy()
    exact = stacked(solve_rotor_by_rotor(flight.config, flight.start, flight.commands, HOLD_NS * 1e-9))
    errors = flight_errors(solve(flight, solver, rtol=1e-12), exact)
    assert errors.position_m < 1e-12
    assert errors.attitude_rad < 1e-11
    assert errors.body_rate_rad_s < 1e-10


def test_the_reference_lets_motors_follow_at_once():
    config = preset("hummingbird", motor_time_constant_s=0.0)
    flight = Flight(name="step", config=config, start=at_rest(config), commands=np.full((2, 4), 500.0))
    states = solve(flight)
    thrust = 4.0 * config.thrust_coefficient_n_s2 * 500.0**2 / config.mass_kg - 9.81
    drag = 4.0 * 500.0 * config.rotor_inflow_kg / config.mass_kg  # linear, beside a little quadratic drag
    assert states.velocity[0, 2] == pytest.approx(thrust * (1.0 - math.exp(-drag * 0.01)) / drag, rel=1e-4)
    assert np.array_equal(states.rotor_speed, np.full((2, 4), 500.0))


def test_make_reference_says_how_well_it_is_known():
    reference = make_reference(windy(), cross_check=True)
    assert [c.solver for c in reference.checks] == ["DOP853", "Radau"]
    assert 0.0 < reference.uncertainty.position_m < 1e-13
    assert reference.uncertainty.position_m == max(c.difference.position_m for c in reference.checks)


# Baselines


def test_euler_and_rk4_are_the_textbook_steps():
    """One step, the motor in the state, against the same in NumPy on the other right-hand side."""
    flight = windy()
    config, tau_s, h = flight.config, flight.config.motor_time_constant_s, HOLD_NS * 1e-9
    command = flight.commands[0]

    def rate(z):
        return np.concatenate([derivative(config, z[:13], z[13:]), (command - z[13:]) / tau_s])

    z = np.concatenate([pack(flight.start), flight.start.rotor_speed])
    k1 = rate(z)
    k2 = rate(z + 0.5 * h * k1)
    k3 = rate(z + 0.5 * h * k2)
    k4 = rate(z + h * k3)
    one = dataclasses.replace(flight, commands=flight.commands[:1])
    for method, end in ((EULER, z + h * k1), (RK4, z + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4))):
        end[6:10] /= np.linalg.norm(end[6:10])
        flown = fly(method.make(config, 1, h), one).states
        state = np.concatenate([pack(MultirotorState(*(rows[0] for rows in flown))), flown.rotor_speed[0]])
        assert state == pytest.approx(end, rel=1e-12, abs=1e-12), method.name


def next_to_no_inertia() -> Flight:
    """Return a crazyflie whose body rates are damped within 20 us."""
    return next(make_flight(case) for case in CASES if case.name == "inertia x 0.0001")


@pytest.mark.parametrize(
    ("make", "step_ns", "tolerance"),
    [
        (windy, 2_000_000, 1e-9),
        # by Newton's method: fixed-point iteration grows by a factor of 10^4 each time
        (next_to_no_inertia, 1_000_000, 1e-6),
    ],
)
def test_the_midpoint_rule_solves_its_equations(make, step_ns, tolerance):
    """v_1 - v_0 = h a(middle) and so on, with the other right-hand side, to rounding."""
    flight = make()
    config, tau_s, h = flight.config, flight.config.motor_time_constant_s, 1e-9 * step_ns
    flyer = MIDPOINT.make(config, 1, h)
    flyer.vehicle.reset(*flight.start)
    command = flight.commands[0]
    flyer.vehicle.command(command)
    flyer.advance(step_ns)
    start, end = flight.start, first_state(flyer.vehicle)
    middle = MultirotorState(*(0.5 * (a + b) for a, b in zip(start, end, strict=True)))
    q = middle.orientation / np.linalg.norm(middle.orientation)
    rate = derivative(
        config, np.concatenate([middle.position, middle.velocity, q, middle.body_rate]), middle.rotor_speed
    )
    assert end.position - start.position == pytest.approx(h * middle.velocity, rel=1e-12, abs=1e-18)
    assert end.velocity - start.velocity == pytest.approx(h * rate[3:6], rel=1e-9, abs=1e-12)
    assert end.body_rate - start.body_rate == pytest.approx(h * rate[10:13], rel=tolerance)
    assert end.rotor_speed - start.rotor_speed == pytest.approx(
        h * (command - middle.rotor_speed) / tau_s, rel=1e-10
    )
    # R_1 = R_0 cay(h w): a rotation by 2 atan(h |w| / 2) about w
    turn = (Rotation.from_quat(start.orientation).inv() * Rotation.from_quat(end.orientation)).as_rotvec()
    w = middle.body_rate
    angle = 2.0 * math.atan(0.5 * h * np.linalg.norm(w))
    assert turn == pytest.approx(angle * w / np.linalg.norm(w), rel=1e-11)


def test_copies_fly_as_one_does():
    """What copies are timed for has the bits of the vehicle alone."""
    flight = dataclasses.replace(SCENES["tumble"](), commands=SCENES["tumble"]().commands[:5])
    for method in (*FIXED_STEP, DORMAND_PRINCE):
        setting = 1e-3 if method.order is not None else 1e-6
        alone, beside = (fly(method.make(flight.config, count, setting), flight) for count in (1, 7))
        for a, b in zip(alone.states, beside.states, strict=True):
            assert np.array_equal(a, b), method.name


def test_called_once_a_command_is_the_same_flight():
    flight = windy()
    launched, called = fly(RKMK4.make(flight.config, 1, 1e-3), flight), fly_called(flight, step_s=1e-3)
    for a, b in zip(launched.states, called.states, strict=True):
        assert np.array_equal(a, b)


def test_baselines_are_for_four_rotors():
    config = preset(
        "hummingbird",
        rotor_position_m=tuple((math.cos(a), math.sin(a), 0.0) for a in np.arange(6) * math.pi / 3),
        rotor_direction=(1, -1) * 3,
    )
    with pytest.raises(ValueError, match="4 rotors, got 6"):
        EULER.make(config, 1, 1e-3)


def test_baselines_refuse_terms_that_they_do_not_have():
    config = everything()
    assert set(config.terms()) == set(TERMS)
    with pytest.raises(ValueError, match=r"got \['ground', .*'turbulence'\] as well"):
        EULER.make(config, 1, 1e-3)
    with pytest.raises(ValueError, match="as well"):
        Derivative(config)


# The free top


def test_the_free_top_obeys_eulers_equations():
    """Against DOP853 on J w' = Jw x w and q' = q w / 2, written out here."""
    top = FreeTop()
    inertia = np.array(top.inertia_kg_m2)

    def rate(_t, y):
        w, (a, b, c, d) = y[:3], y[3:]
        return np.concatenate(
            [
                np.cross(inertia * w, w) / inertia,
                0.5 * np.array([
                    d * w[0] + b * w[2] - c * w[1],
                    d * w[1] + c * w[0] - a * w[2],
                    d * w[2] + a * w[1] - b * w[0],
                    -a * w[0] - b * w[1] - c * w[2],
                ]),
            ]
        )  # fmt: skip

    start = np.concatenate([top.body_rate(0.0), top.orientation(0.0)])
    stamps_s = [0.05, 0.4, 3.0]
    exact = solve_ivp(rate, (0.0, 3.0), start, method="DOP853", t_eval=stamps_s, rtol=1e-13, atol=1e-13)
    for stamp_s, y in zip(stamps_s, exact.y.T, strict=True):
        # 1e-13 a step, a few hundred steps
        assert top.body_rate(stamp_s) == pytest.approx(y[:3], abs=1e-10)
        assert attitude_errors(top.orientation(stamp_s), y[3:] / np.linalg.norm(y[3:])) < 1e-11


def test_the_free_top_keeps_its_momentum_for_an_hour():
    top = FreeTop()
    for time_s in (0.0, 12.3, 3600.0):
        L_B = np.array(top.inertia_kg_m2) * top.body_rate(time_s)
        momentum = Rotation.from_quat(top.orientation(time_s)).apply(L_B)
        assert momentum == pytest.approx([0.0, 0.0, top.momentum], abs=1e-12)


def test_a_top_that_would_reverse_is_refused():
    with pytest.raises(ValueError, match="must not reverse"):
        FreeTop(rate_1_rad_s=30.0, rate_3_rad_s=5.0)


def test_nothing_acts_on_an_unforced_body():
    vehicle = Multirotor(unforced((1e-3, 2e-3, 2.5e-3)))
    vehicle.reset(velocity=(5.0, 6.0, 7.0), body_rate=(0.0, 0.0, 3.0))
    acceleration = vehicle.acceleration
    assert not acceleration.linear.any()
    assert not acceleration.angular.any()


# How errors are judged


@pytest.mark.parametrize("angle_rad", [0.0, 1e-12, 1e-5, 1.0, 3.1])
def test_attitude_errors_are_angles(angle_rad):
    axis = np.array([0.48, -0.6, 0.64])
    start = Rotation.from_rotvec([0.3, 2.0, -0.4])
    turned = start * Rotation.from_rotvec(angle_rad * axis)
    error = attitude_errors(start.as_quat(), turned.as_quat())
    assert error == pytest.approx(angle_rad, rel=1e-12, abs=3e-16)
    assert attitude_errors(start.as_quat(), -turned.as_quat()) == pytest.approx(error, abs=1e-15)


def test_flight_errors_are_the_largest():
    states = solve(windy())
    moved = states.position.copy()
    moved[1] += (0.0, 3.0, 4.0)
    errors = flight_errors(states._replace(position=moved), states)
    assert (errors.position_m, errors.attitude_rad, errors.body_rate_rad_s) == (5.0, 0.0, 0.0)
    assert not flight_errors(
        states._replace(velocity=states.velocity, body_rate=moved * np.nan), states
    ).finite


def samples(errors: dict[float, float]) -> list[Sample]:
    return [
        Sample(
            flight="x",
            method=RK4.name,
            setting=h,
            errors=Errors(position_m=e, attitude_rad=e, body_rate_rad_s=e),
            cpu_s_per_s=1.0,
        )
        for h, e in errors.items()
    ]


def test_order_is_fitted_where_it_has_settled():
    """h^4 for h <= 2 ms; something else above; rounding below 0.5 ms."""
    steps = (1e-2, 5e-3, 2e-3, 1e-3, 5e-4, 2e-4, 1e-4)
    errors = {h: 1e3 * h**4 + 1e6 * h**6 for h in steps}
    errors[1e-4] = 2e-12
    errors[1e-2] = 5.0
    fit = fit_order(samples(errors), RK4, "x", uncertainty=NOTHING)
    assert fit.position == pytest.approx(4.0, abs=0.02)  # h^6 is a fortieth at 5 ms
    assert fit.position_steps_s == (5e-4, 5e-3)
    known_to = dataclasses.replace(NOTHING, position_m=1e-11)  # errors above 3e-10: 1 ms and more
    fit = fit_order(samples(errors), RK4, "x", uncertainty=known_to)
    assert fit.position_steps_s == (1e-3, 5e-3)
    assert fit.attitude_steps_s == (5e-4, 5e-3)


def test_no_order_without_three_settled_errors():
    fit = fit_order(samples({1e-2: 1.0, 1e-3: 1e-4, 1e-4: 1e-20}), RK4, "x", uncertainty=NOTHING)
    assert (fit.position, fit.position_steps_s) == (None, None)


# Extreme flights


def test_every_case_makes_a_flight_or_is_refused():
    made = {case.name: make_flight(case) for case in CASES}
    assert [name for name, flight in made.items() if isinstance(flight, Refusal)] == [
        "inertia 1:10:100, 200 rad/s"
    ]
    for flight in made.values():
        if isinstance(flight, Flight):
            assert flight.duration_s == pytest.approx(0.2)


def test_trials_tell_flown_held_and_lost_apart():
    """A product that may not evaluate enough raises; Euler without a guard is lost."""
    flight = next(make_flight(case) for case in CASES if case.name == "inertia x 0.0001")

    class Starved:
        def __init__(self, config, count, _setting):
            self.vehicle = Multirotor(config, count=count, evaluation_count_max=7)

        def advance(self, duration_ns):
            self.vehicle.advance(duration_ns)

    starved = Method(name="starved", order=4, make=Starved)
    exact = solve(dataclasses.replace(flight, commands=flight.commands[:2]), "Radau", rtol=1e-10)
    short = dataclasses.replace(flight, commands=flight.commands[:2])
    trials = measure_trials(
        "x", short, exact, [(EULER, 1e-3), (starved, 1e-3), (RKMK4, 1e-3)], rotorpy_cpu_max_s=0.0
    )
    assert [t.outcome for t in trials] == ["not finite", "DynamicsError", "flown"]
    assert [t.errors is None for t in trials] == [True, True, False]
    assert trials[2].redone_count == 2
    assert trials[2].evaluation_count > 14


# Formats of number


def test_single_precision_is_what_is_lost():
    """29 rad/s for 2 s: the method's own error in float64, rounding instead in float32."""
    double, single, finer = measure_formats((1, 2))
    assert [d.method for d in (double, single, finer)] == [
        "float64, 1 ms",
        "float32, 1 ms",
        "float32, 0.1 ms",
    ]
    # exp(i x) against its Taylor polynomial of degree 4, x = w h / 2: a phase error of x^5 / 120 a step
    x = 0.5 * 29.0 * 1e-3
    assert double.attitude_rad[1] == pytest.approx(2.0 * 2000 * x**5 / 120, rel=0.02)
    assert double.position_m[1] < 1e-13
    assert 1e-7 < single.attitude_rad[1] < 1e-3
    assert 1e-7 < single.position_m[1] < 1e-3
    assert finer.position_m[1] > 0.3 * single.position_m[1]  # smaller steps do not help


# RotorPy


def test_rotorpy_gets_our_vehicle():
    pytest.importorskip("rotorpy")
    table = quad_params(in_wind())
    assert table["mass"] == 0.5
    assert (table["Ixx"], table["Ixy"], table["Iyz"]) == (3.65e-3, 2e-5, 1e-5)
    assert table["c_Dz"] == 1e-2
    assert [*table["rotor_pos"]["r2"]] == pytest.approx([0.1202, -0.1202, 0.0], abs=1e-4)


def test_rotorpy_flies_in_wind_with_every_term():
    pytest.importorskip("rotorpy")
    flight = windy()
    flown = fly_rotorpy(flight, "RK45", step_s=1e-3)
    # RK45 at its default tolerances, one to a few steps a millisecond
    assert flight_errors(flown.states, solve(flight)).position_m < 1e-7
    assert not flown.stopped


def test_rotorpy_is_stopped_when_it_takes_too_long():
    pytest.importorskip("rotorpy")
    flown = fly_rotorpy(SCENES["flip"](), "RK45", step_s=1e-2, cpu_max_s=0.0)
    assert flown.stopped
    assert np.isfinite(flown.states.position[0]).all()
    assert np.isnan(flown.states.position[1:]).all()


def test_rotorpy_is_not_asked_for_what_it_cannot_do():
    with pytest.raises(ValueError, match="motor time constant"):
        quad_params(preset("hummingbird", motor_time_constant_s=0.0))
    with pytest.raises(ValueError, match="turbulence"):
        quad_params(everything())
    with pytest.raises(ValueError, match="all alike"):
        quad_params(preset("hummingbird", rotor_thrust_scale=(1.0, 0.9, 1.0, 1.0)))
