"""Flights that break integrators, flown by the product as it is, against the rotor-by-rotor oracle."""

from __future__ import annotations

import numpy as np
import pytest
from multirotor_oracle import NO_AERO, angle, solve

from neurosim_core.vehicle import DynamicsError, Multirotor, MultirotorConfig, MultirotorState, preset

HOLD_NS = 10_000_000
STORM = {"wind_m_s": (100.0, 0.0, 0.0), "parasitic_drag_kg_m": (5e-3, 5e-3, 1e-2)}


def diagonal(*moments: float) -> tuple[tuple[float, ...], ...]:
    return tuple(map(tuple, np.diag(moments).tolist()))


def one(state: MultirotorState) -> MultirotorState:
    return MultirotorState(*(rows[0] for rows in state))


def largest_errors(vehicle: Multirotor, commands, *, stiff: bool = False) -> tuple[float, float]:
    """Fly, and return the largest error of position [m] and attitude [rad] at the ends of the holds."""
    exact = solve(vehicle.config, one(vehicle.state), commands, HOLD_NS * 1e-9, stiff=stiff)
    position, attitude = 0.0, 0.0
    for command, e in zip(commands, exact, strict=True):
        vehicle.step(command, HOLD_NS)
        f = one(vehicle.state)
        position = max(position, float(np.linalg.norm(f.position - e.position)))
        attitude = max(attitude, angle(f.orientation, e.orientation))
    return position, attitude


def about_hover(vehicle: Multirotor, count: int) -> np.ndarray:
    spread = np.random.default_rng(7).uniform(-0.1, 0.1, (count, 4))
    return vehicle.config.hover_rotor_speed_rad_s * (1.0 + spread)


@pytest.mark.parametrize(
    ("mass_kg", "redone"), [(3e-2, 0), (3e-3, 1), (3e-4, 1), (3e-5, 1), (3e-6, 1)], ids=str
)
def test_light_vehicles_in_a_storm(mass_kg, redone, device):
    """Blown from rest to 100 m/s, in up to a microsecond: only the first hold is beyond fixed steps."""
    vehicle = Multirotor(preset("crazyflie", mass_kg=mass_kg, **STORM), device=device)
    position, attitude = largest_errors(vehicle, about_hover(vehicle, 3), stiff=mass_kg < 1e-3)
    assert position < 1e-5
    assert attitude < 1e-6
    assert vehicle.effort.redone_count.tolist() == [redone]


def tightly(config: MultirotorConfig, device: str) -> Multirotor:
    """The same in adaptive steps alone, far below what is asked; against the oracle in `test_adaptive`."""
    return Multirotor(
        config,
        device=device,
        integrator="dormand_prince",
        rtol=1e-12,
        atol=1e-14,
        evaluation_count_max=1_000_000,
    )


def silent_error(config: MultirotorConfig, device: str) -> tuple[float, int]:
    """Largest position error over 5 holds [m], and how many of them were redone."""
    vehicle, exact = Multirotor(config, device=device), tightly(config, device)
    error = 0.0
    for command in about_hover(vehicle, 5):
        for craft in (vehicle, exact):
            craft.step(command, HOLD_NS)
        error = max(error, float(np.linalg.norm(vehicle.state.position - exact.state.position)))
    return error, int(vehicle.effort.redone_count[0])


@pytest.mark.parametrize("airframe", ["crazyflie", "hummingbird"])
def test_no_mass_between_is_silently_off(airframe, device):
    """At masses 12 % apart; fixed steps are worst just above the mass at which the guard trips: see below."""
    errors, counts = [], []
    for mass_kg in np.geomspace(3e-6, 0.5, 100):
        error, redone = silent_error(preset(airframe, mass_kg=mass_kg, **STORM), device)
        errors.append(error)
        counts.append(redone)
    assert max(errors) < 5e-6
    assert counts[0] > 0
    assert counts[-1] == 0


@pytest.mark.parametrize("airframe", ["crazyflie", "hummingbird"])
def test_just_above_the_mass_that_trips_the_guard(airframe, device):
    """Found by bisection, and flown against the oracle."""
    trips_kg, passes_kg = 1e-4, 0.5
    while passes_kg > 1.0001 * trips_kg:
        mass_kg = float(np.sqrt(trips_kg * passes_kg))
        vehicle = Multirotor(preset(airframe, mass_kg=mass_kg, **STORM), device=device)
        vehicle.step(about_hover(vehicle, 1)[0], HOLD_NS)
        if vehicle.effort.redone_count[0] > 0:
            trips_kg = mass_kg
        else:
            passes_kg = mass_kg
    for mass_kg, redone in ((trips_kg, 1), (passes_kg, 0)):
        vehicle = Multirotor(preset(airframe, mass_kg=mass_kg, **STORM), device=device)
        position, attitude = largest_errors(vehicle, about_hover(vehicle, 5))
        assert vehicle.effort.redone_count[0] == redone
        assert position < 5e-6
        assert attitude < 1e-6


@pytest.mark.parametrize("parameter", ["inertia", "lag"])
def test_no_inertia_nor_lag_between_is_silently_off(parameter, device):
    inertia = np.array(preset("crazyflie").inertia_kg_m2)
    for share in np.geomspace(1e-6, 1.0, 60):
        if parameter == "inertia":
            config = preset("crazyflie", inertia_kg_m2=tuple(map(tuple, (share * inertia).tolist())))
        else:
            config = preset("hummingbird", motor_time_constant_s=0.1 * share)
        assert silent_error(config, device)[0] < (1e-6 if parameter == "inertia" else 1e-8)


def test_next_to_no_inertia(device):
    """A ten-thousandth: body rates are damped within 20 us."""
    moments = 1e-4 * np.diag(preset("crazyflie").inertia_kg_m2)
    vehicle = Multirotor(preset("crazyflie", inertia_kg_m2=diagonal(*moments)), device=device)
    position, attitude = largest_errors(vehicle, about_hover(vehicle, 2), stiff=True)
    assert position < 1e-9
    assert attitude < 1e-6
    assert vehicle.effort.redone_count.tolist() == [2]


@pytest.mark.parametrize("moments", [(1e-4, 1e-3, 1.09e-3), (1e-4, 1e-2, 1.009e-2)], ids=str)
def test_slender_bodies_at_200_rad_s(moments, device):
    vehicle = Multirotor(preset("hummingbird", inertia_kg_m2=diagonal(*moments)), device=device)
    vehicle.reset(body_rate=np.full(3, 200.0 / np.sqrt(3.0)))
    position, attitude = largest_errors(vehicle, about_hover(vehicle, 3))
    assert position < 1e-5
    assert attitude < 1e-4


def test_moments_that_no_body_has_are_refused():
    with pytest.raises(ValueError, match="no body has principal moments"):
        preset("hummingbird", inertia_kg_m2=diagonal(1e-4, 1e-3, 1e-2))


def test_bang_bang_commands(device):
    vehicle = Multirotor(preset("crazyflie"), device=device)
    commands = np.random.default_rng(3).choice([0.0, vehicle.config.rotor_speed_max_rad_s], (5, 4))
    position, attitude = largest_errors(vehicle, commands)
    assert position < 1e-10
    assert attitude < 1e-8


def test_200_rad_s_about_three_axes(device):
    vehicle = Multirotor(preset("crazyflie"), device=device)
    vehicle.reset(body_rate=np.array([1.0, -1.0, 1.0]) * 200.0 / np.sqrt(3.0))
    position, attitude = largest_errors(vehicle, about_hover(vehicle, 3))
    assert position < 1e-6
    assert attitude < 1e-4


def test_pitch_through_90_degrees(device):
    """Nothing happens there: no angle of the state is singular."""
    vehicle = Multirotor(preset("crazyflie"), device=device)
    vehicle.reset(orientation=(0.0, np.sin(0.75), 0.0, np.cos(0.75)), body_rate=(0.0, 20.0, 0.0))
    tilt_before = one(vehicle.state).orientation
    position, attitude = largest_errors(vehicle, about_hover(vehicle, 3))
    assert angle(tilt_before, one(vehicle.state).orientation) > 0.5  # from 86 degrees to 120
    assert position < 1e-10
    assert attitude < 1e-9


def test_an_hour_of_hover_does_not_drift(device):
    vehicle = Multirotor(preset("hummingbird"), device=device)
    vehicle.command(np.full(4, vehicle.config.hover_rotor_speed_rad_s))
    for _ in range(360):
        vehicle.advance(10_000_000_000)
    vehicle.check()
    state = one(vehicle.state)
    # a GPU rounds a product and a sum once: the torques of four rotors cancel but for the last bit there
    slack = 1.0 if device == "cpu" else 1e3
    assert np.linalg.norm(state.position) < 1e-9 * slack
    assert np.linalg.norm(state.velocity) < 1e-11 * slack
    assert vehicle.stamp_ns == 3_600_000_000_000


def test_ten_minutes_of_a_free_top_keep_energy_and_momentum(device):
    config = preset(
        "hummingbird",
        inertia_kg_m2=diagonal(1e-3, 2e-3, 2.5e-3),
        gravity_m_s2=0.0,
        thrust_coefficient_n_s2=0.0,
        torque_coefficient_n_m_s2=0.0,
        motor_time_constant_s=0.0,
        **NO_AERO,
    )
    vehicle = Multirotor(config, device=device)
    vehicle.reset(body_rate=(9.0, 0.0, 17.0), rotor_speed=np.zeros(4))
    moments = np.array([1e-3, 2e-3, 2.5e-3])
    energy = moments @ np.array([9.0, 0.0, 17.0]) ** 2
    momentum = np.linalg.norm(moments * [9.0, 0.0, 17.0])
    vehicle.step(np.zeros(4), 600_000_000_000)
    w = one(vehicle.state).body_rate
    # (w h)^5 of RK4 a step, one sign: 3e-12 of the energy a second, measured
    assert moments @ w**2 == pytest.approx(energy, rel=1e-8)
    assert np.linalg.norm(moments * w) == pytest.approx(momentum, rel=1e-8)
    assert abs(np.linalg.norm(one(vehicle.state).orientation) - 1.0) < 1e-14


@pytest.mark.parametrize("speed_m_s", [1e9, 1e30, 1e150])
def test_what_cannot_be_flown_raises_and_holds(speed_m_s, device):
    """Drag beyond all bounds of effort: a typed error, the last good state, no NaN."""
    vehicle = Multirotor(preset("hummingbird"), device=device, evaluation_count_max=1000)
    vehicle.reset(velocity=(speed_m_s, 0.0, 0.0))
    with pytest.raises(DynamicsError) as caught:
        vehicle.step(np.full(4, 500.0), HOLD_NS)
    assert caught.value.term in ("velocity", "body_rate")
    assert all(np.isfinite(field).all() for field in caught.value.state)
    assert caught.value.state.velocity[0] == speed_m_s
