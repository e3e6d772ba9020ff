"""A second multirotor, rotor by rotor in NumPy, and its solution to 1e-12: what ours is measured against."""

from __future__ import annotations

import numpy as np
from scipy.integrate import solve_ivp

from neurosim_core.vehicle import MultirotorConfig, MultirotorState

NO_AERO = {
    "rotor_drag_kg": 0.0,
    "rotor_inflow_kg": 0.0,
    "translational_lift_kg_m": 0.0,
    "flapping_kg_m": 0.0,
    "parasitic_drag_kg_m": (0.0, 0.0, 0.0),
}


def rotation_matrix(q):
    x, y, z, w = q / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def cross(a, b):  # np.cross costs ten times as much
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def each(common, scale, count):
    """A parameter of each rotor."""
    return [common * factor for factor in (scale or [1.0] * count)]


def push_of_ground(config: MultirotorConfig, y):
    """Force of the ground and its torque about the centre of mass, both in W."""
    force, torque = np.zeros(3), np.zeros(3)
    if config.ground is None:
        return force, torque
    ground, R = config.ground, rotation_matrix(y[6:10])
    feet = ground.foot_position_m or [(x, y, -0.05) for x, y, _ in config.rotor_position_m]
    for foot in feet:
        arm = R @ np.array(foot)
        depth = ground.height_m - (y[2] + arm[2])
        if depth <= 0.0:
            continue
        speed = y[3:6] + cross(R @ y[10:13], arm)
        normal = max(0.0, ground.stiffness_n_m * depth * (1.0 - ground.damping_s_m * speed[2]))
        slip = np.array([speed[0], speed[1], 0.0])
        size = np.sqrt(slip @ slip + ground.slip_speed_m_s**2)
        at_foot = np.array([0.0, 0.0, normal]) - ground.friction * normal * slip / size
        force = force + at_foot
        torque = torque + cross(arm, at_foot)
    return force, torque


def lift_of_ground(config: MultirotorConfig, height) -> float:
    """What the ground multiplies thrust with (Cheeseman and Bennett), rotors at `height` above it."""
    radius = 0.0 if config.ground is None else config.ground.rotor_radius_m
    return 1.0 if radius == 0.0 else 1.0 / (1.0 - (radius / (4.0 * max(height, 0.5 * radius))) ** 2)


def derivative(config: MultirotorConfig, y, rotor_speed, wind=None):
    """d/dt of (position, velocity, quaternion, body rate); `wind` in W [m/s] in place of the constant one."""
    v, q, w = y[3:6], y[6:10], y[10:13]
    R = rotation_matrix(q)
    inertia = np.array(config.inertia_kg_m2)
    air = R.T @ (v - np.array(config.wind_m_s if wind is None else wind))
    force = -np.linalg.norm(air) * np.array(config.parasitic_drag_kg_m) * air
    torque = np.zeros(3)
    drag = np.array([config.rotor_drag_kg, config.rotor_drag_kg, config.rotor_inflow_kg])
    hubs = np.array(config.rotor_position_m)
    floor = 0.0 if config.ground is None else config.ground.height_m
    lift = lift_of_ground(config, y[2] + hubs[:, 2].mean() - floor)
    for r, direction, speed, thrust, twist in zip(
        hubs,
        config.rotor_direction,
        rotor_speed,
        each(config.thrust_coefficient_n_s2, config.rotor_thrust_scale, len(hubs)),
        each(config.torque_coefficient_n_m_s2, config.rotor_torque_scale, len(hubs)),
        strict=True,
    ):
        u = air + cross(w, r)
        at_hub = -speed * drag * u
        at_hub[2] += lift * thrust * speed**2
        at_hub[2] += config.translational_lift_kg_m * (u[0] ** 2 + u[1] ** 2)
        force = force + at_hub
        torque = torque + cross(r, at_hub)
        torque = torque - config.flapping_kg_m * speed * np.array([u[1], -u[0], 0.0])
        torque[2] += direction * twist * speed**2
    x, yy, z, s = q
    q_rate = 0.5 * np.array(
        [
            s * w[0] + yy * w[2] - z * w[1],
            s * w[1] + z * w[0] - x * w[2],
            s * w[2] + x * w[1] - yy * w[0],
            -x * w[0] - yy * w[1] - z * w[2],
        ]
    )
    push, tilt = push_of_ground(config, y)
    torque = torque + R.T @ tilt
    a = (R @ force + push) / config.mass_kg - np.array([0.0, 0.0, config.gravity_m_s2])
    return np.concatenate([v, a, q_rate, np.linalg.solve(inertia, torque - cross(w, inertia @ w))])


def solve(
    config: MultirotorConfig,
    state: MultirotorState,
    commands,
    hold_s: float,
    *,
    stiff: bool = False,
    wind=None,
):
    """The state after each command, each held for `hold_s`, with the motor in closed form: list of states.

    DOP853 at 1e-12, or for stiff vehicles Radau at 1e-11. `wind` is a function of time [s], smooth while a
    command is held, in place of the constant one.
    """
    y = np.concatenate([state.position, state.velocity, state.orientation, state.body_rate])
    speed = np.array(state.rotor_speed)
    taus = np.full(len(speed), config.motor_time_constant_s)
    lags = taus > 0.0
    tau = taus[lags].min() if lags.any() else 0.0
    states = []
    for index, command in enumerate(commands):
        held = np.clip(command, config.rotor_speed_min_rad_s, config.rotor_speed_max_rad_s)

        def at(t, held=held, start=speed):
            return held + (start - held) * np.where(lags, np.exp(-t / np.where(lags, taus, 1.0)), 0.0)

        def blows(t, begin=index * hold_s):
            return None if wind is None else wind(begin + t)

        # at t = 0 the motor is where it was; with tau = 0 that is a jump, so integrate what follows it
        solution = solve_ivp(
            lambda t, y, at=at, blows=blows: derivative(config, y, at(t), blows(t)),
            (0.0, hold_s),
            y,
            method="Radau" if stiff else "DOP853",
            rtol=1e-11 if stiff else 1e-12,
            atol=1e-13,
            first_step=min(1e-4, 0.1 * tau) if tau > 0.0 else 1e-4,
        )
        y = solution.y[:, -1]
        y[6:10] /= np.linalg.norm(y[6:10])
        speed = at(hold_s)
        states.append(MultirotorState(y[0:3], y[3:6], y[6:10], y[10:13], speed))
    return states


def angle(q, p) -> float:
    """Angle between two attitudes [rad], exact for small ones."""
    difference = rotation_matrix(q).T @ rotation_matrix(p)
    return float(
        np.linalg.norm(
            [
                difference[2, 1] - difference[1, 2],
                difference[0, 2] - difference[2, 0],
                difference[1, 0] - difference[0, 1],
            ]
        )
        / 2.0
    )
