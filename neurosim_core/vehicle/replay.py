"""Replay of a flight log: does a vehicle turn and push as the real one did, given the commands that it got?

The log is cut into windows. Each begins with the measured body rate and is flown open loop with the logged
commands. What differs from one specimen to the next is estimated from the flight before the window only: the
thrust for a command, which falls with the battery, and the torque that the model misses. A Kalman filter
takes that for the sum of two: one hardly changes, as of a battery that sits off centre, and one is forgotten,
as of a gust; within the window the first stays and the second fades. Nothing that was measured within a
window is used in it.
"""

from __future__ import annotations

import gzip
import io
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from neurosim_core.vehicle.airframe import MultirotorConfig
from neurosim_core.vehicle.arrays import MultirotorState
from neurosim_core.vehicle.multirotor import Multirotor

Array = NDArray[np.float64]

PWM_MAX = 65535.0
PWM_THRUST_N = (0.067673604, 0.091492681)
"""Thrust of a rotor [N] by the duty cycle, linear and squared.

Reference: Crazyflie firmware, power_distribution_quadrotor.c, pwmToThrustB and pwmToThrustA.
"""
_G_M_S2 = 9.80665  # the unit of the log's accelerometer
_STEP_S = 1e-3
_STRIDE = 50  # samples from the beginning of a window to that of the next
_PAST_S = 0.15  # flight before a window that tells the thrust for a command
_DELAY_S = 0.009  # output, flow and gyro filter; identified with the lag of the motors, see presets.yaml
_TILT_S = 10.0  # how slowly the mean direction of the specific force corrects the integrated attitude
_ROOM_S = 1.0  # over longer, the mean velocity of a flight in a room is nought
_FILTER_STEP_S = 0.01
# what the model misses, about x, y, z: maximum likelihood of the rates that the filter predicts for its next
# step, over two flights together, alike about x and y; in brackets each alone, about x and y, and about z
_FADING_RAD_S2 = np.array([7.3, 7.3, 0.87])  # (6.9 and 7.8; 1.0 and 1.1)
_FADING_S = np.array([0.20, 0.20, 0.028])  # (0.27 and 0.16; 0.007 and 0.018)
_DRIFT_RAD_S2_PER_SQRT_S = np.array([1.1, 1.1, 0.06])  # of the steady part (0.9 and 1.3; 1.1 and 0)
_KICK_RAD_S_PER_SQRT_S = np.array([0.0, 0.0, 0.078])  # too short to foresee (0; 0 and 0.055)
_GYRO_RAD_S = np.array([0.004, 0.009, 0.001])  # noise (x 0.006 and 0.001, y 0.010 and 0.008; z 0)
_STEADY_RAD_S2 = 20.0  # before anything is known
_FORCE_EVERY = 10
_FLYING_PWM = 15_000.0
_FORCE_MAX_M_S2 = 25.0  # more is a crash
_APART = 300  # samples around what is no flight that are left out


@dataclass(frozen=True, kw_only=True, eq=False)
class FlightLog:
    """The measurements of a Crazyflie at 1 kHz, with the commands that it gave to its motors."""

    specific_force: Array
    """Accelerometer in B, without its offset at rest [m/s^2], shape [n, 3]."""
    body_rate: Array
    """Gyroscope in B [rad/s], shape [n, 3]."""
    pwm: Array
    """Commands to front left, front right, rear right, rear left, 0 to 65535, shape [n, 4]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Replay:
    """The distance of a replay from its log, over all windows."""

    window_count: int
    rate_rms_rad_s: Array
    """RMS of the error of the body rate about x, y, z [rad/s], shape [3]."""
    unchanged_rms_rad_s: Array
    """The same of the guess that the body rate stays as it was when the window began, shape [3]."""
    force_error: float
    """RMS of the error of the specific force along body z, as a share of the RMS of what was measured."""


def read_crazyflie_log(path: str | Path) -> FlightLog:
    """Read a log of time [s], accelerometer [g], gyroscope [deg/s] and the commands of motors m1 to m4.

    Args:
        path: CSV file, or the same compressed by gzip (.gz); lines that begin with # are skipped.

    Raises:
        OSError: The file cannot be read.
        ValueError: It has not 11 columns of numbers, or its time does not increase.
    """
    raw = Path(path).read_bytes()
    text = gzip.decompress(raw) if str(path).endswith(".gz") else raw
    rows = np.loadtxt(io.BytesIO(text), delimiter=",", comments="#", ndmin=2)
    if rows.shape[1] != 11 or len(rows) < 2 or not (np.diff(rows[:, 0]) > 0.0).all():
        raise ValueError(
            f"{path}: a log has rows of increasing time, 3 accelerations, 3 rates and 4 motor commands, got "
            f"{len(rows)} rows of {rows.shape[1]} columns"
        )
    stamps_s = np.arange(rows[0, 0], rows[-1, 0], _STEP_S)
    measured = np.stack([np.interp(stamps_s, rows[:, 0], column) for column in rows[:, 1:7].T], axis=1)
    held = rows[np.searchsorted(rows[:, 0], stamps_s, side="right") - 1, 7:]
    force = measured[:, :3] * _G_M_S2
    resting = np.logical_and.accumulate((held == 0.0).all(axis=1))
    if resting.sum() > 100:
        force[:, :2] -= force[resting, :2].mean(axis=0)
    return FlightLog(specific_force=force, body_rate=np.radians(measured[:, 3:]), pwm=held[:, (3, 0, 1, 2)])


def rotor_thrust_n(pwm: Array) -> Array:
    """Return the steady thrust of rotors [N] for commands to their motors, with the firmware's battery."""
    duty = pwm / PWM_MAX
    return duty * (PWM_THRUST_N[0] + duty * PWM_THRUST_N[1])


def replay(
    log: FlightLog,
    config: MultirotorConfig,
    *,
    window_s: float = 0.3,
    delay_s: float = _DELAY_S,
    missing_torque: bool = True,
) -> Replay:
    """Fly a vehicle open loop through every window of a log in which the real one flew.

    The tilt at the beginning of a window is the integral of the gyroscope, and its velocity that of the tilt,
    over about the last second.

    Args:
        log: Of a Crazyflie.
        config: The vehicle; rotors front left, front right, rear right, rear left, with rotor drag.
        window_s: Length of a window [s].
        delay_s: From a logged command to its effect in the log, beside the lag of the motors [s].
        missing_torque: Whether the torque that the model missed before a window is added in it.

    Raises:
        ValueError: The vehicle has not these rotors or no rotor drag, or the log has no such flight.
    """
    position = np.array(config.rotor_position_m)
    corners = [[1, 1], [1, -1], [-1, -1], [-1, 1]]
    if np.sign(position[:, :2]).tolist() != corners or config.rotor_drag_kg == 0.0:
        raise ValueError(
            "the vehicle must have rotor drag and rotors front left, front right, rear right, rear left, got "
            f"rotor_drag_kg = {config.rotor_drag_kg:g} and rotor_position_m = {config.rotor_position_m}"
        )
    size = round(window_s / _STEP_S)
    late = round(delay_s / _STEP_S)
    log = replace(log, pwm=np.concatenate([np.repeat(log.pwm[:1], late, axis=0), log.pwm])[: len(log.pwm)])
    flying = _flying(log)
    flown = np.concatenate([[0], np.cumsum(flying)])
    past = round(_PAST_S / _STEP_S)
    first = np.arange(past, len(flying) - size, _STRIDE)
    first = first[flown[first + size] - flown[first] == size]
    first = first[flown[first] - flown[first - past] == past]
    if len(first) == 0:
        raise ValueError(f"the log has no {window_s:g} s of flight after {_PAST_S:g} s of it")

    begin = _states(log, config)
    calibration = _calibrate(log, config, begin, flying, first, past)
    vehicle = Multirotor(config, count=len(first))
    start = MultirotorState(*(rows[first] for rows in begin))
    speed = _speeds(config, start.rotor_speed, calibration.scale)
    vehicle.reset(**start._replace(rotor_speed=speed)._asdict())
    rates, forces, measured_forces = [], [], []
    for sample in range(size):
        now = first + sample
        rates.append(vehicle.state.body_rate - log.body_rate[now])
        if sample % _FORCE_EVERY == 0:
            forces.append(_specific_force(vehicle)[:, 2])
            measured_forces.append(log.specific_force[now, 2])
        command = np.sqrt(rotor_thrust_n(log.pwm[now]) / config.thrust_coefficient_n_s2)
        vehicle.step(_speeds(config, command, calibration.scale), round(_STEP_S * 1e9))
        load = _load(config, vehicle.state.rotor_speed)
        if missing_torque:
            turned = _STEP_S * calibration.missing((sample + 0.5) * _STEP_S, load)
            vehicle.arrays.body_rate.assign(vehicle.state.body_rate + turned)
    unchanged = [log.body_rate[first] - log.body_rate[first + sample] for sample in range(size)]
    pushed, felt = np.array(forces), np.array(measured_forces)
    return Replay(
        window_count=len(first),
        rate_rms_rad_s=np.sqrt((np.array(rates) ** 2).mean(axis=(0, 1))),
        unchanged_rms_rad_s=np.sqrt((np.array(unchanged) ** 2).mean(axis=(0, 1))),
        force_error=float(np.sqrt(((pushed - felt) ** 2).mean() / (felt**2).mean())),
    )


def _flying(log: FlightLog) -> NDArray[np.bool_]:
    """Return which samples are of flight, and not near a start, a landing or a crash, shape [n]."""
    grounded = log.pwm.min(axis=1) < _FLYING_PWM
    crashed = np.linalg.norm(log.specific_force, axis=1) > _FORCE_MAX_M_S2
    near = np.convolve(grounded | crashed, np.ones(2 * _APART + 1), mode="same")
    return np.asarray(near < 0.5)


def _lag(rows: Array, time_constant_s: float) -> Array:
    """Return rows [n, k] after a first-order lag that begins at rest in the first."""
    if time_constant_s == 0.0:
        return rows
    keep = float(np.exp(-_STEP_S / time_constant_s))
    return np.asarray(lfilter([1.0 - keep], [1.0, -keep], rows, axis=0, zi=keep * rows[:1])[0])


def _states(log: FlightLog, config: MultirotorConfig) -> MultirotorState:
    """Return the state at every sample as far as the log tells it; the velocity is that of still air."""
    command = np.sqrt(rotor_thrust_n(log.pwm) / config.thrust_coefficient_n_s2)
    up = _up(log)
    axis = np.cross(up, [0.0, 0.0, 1.0])
    sine = np.linalg.norm(axis, axis=1, keepdims=True)
    turned = axis / np.maximum(sine, 1e-9) * np.arctan2(sine, up[:, 2:])
    # thrust along z in B carries the weight, so the velocity in the plane of the rotors changes by -g up
    velocity = -config.gravity_m_s2 * _ROOM_S * _lag(up, _ROOM_S) * [1.0, 1.0, 0.0]
    orientation = Rotation.from_rotvec(turned)
    return MultirotorState(
        position=np.zeros_like(velocity),
        velocity=orientation.apply(velocity),
        orientation=orientation.as_quat(),
        body_rate=log.body_rate,
        rotor_speed=_lag(command, config.motor_time_constant_s),
    )


def _up(log: FlightLog) -> Array:
    """Return world z in B, shape [n, 3]: the gyroscope integrated, and drawn slowly to the specific force."""
    length = np.linalg.norm(log.specific_force, axis=1, keepdims=True)
    towards = (log.specific_force / np.maximum(length, 1e-9)).tolist()
    rates = log.body_rate.tolist()
    up = np.empty_like(log.body_rate)
    x, y, z = towards[0]
    share = _STEP_S / _TILT_S
    for sample, ((p, q, r), (a, b, c)) in enumerate(zip(rates, towards, strict=True)):
        x, y, z = (
            x + _STEP_S * (r * y - q * z) + share * (a - x),
            y + _STEP_S * (p * z - r * x) + share * (b - y),
            z + _STEP_S * (q * x - p * y) + share * (c - z),
        )
        norm = (x * x + y * y + z * z) ** 0.5
        x, y, z = x / norm, y / norm, z / norm
        up[sample] = x, y, z
    return up


def _specific_force(vehicle: Multirotor) -> Array:
    """Return what an accelerometer at the centre of mass reads now, in B [m/s^2], shape [N, 3]."""
    felt = vehicle.acceleration.linear + np.array([0.0, 0.0, vehicle.config.gravity_m_s2])
    return np.asarray(Rotation.from_quat(vehicle.state.orientation).inv().apply(felt))


class _Calibration(NamedTuple):
    """The corrections that make the model agree, in the mean, with the flight before each window."""

    scale: Array
    """Factor of the thrust for a command, shape [N]."""
    steady: Array
    """Missing angular acceleration that stays, under a load of 1 [rad/s^2], shape [N, 3]."""
    fading: Array
    """Missing angular acceleration that fades, as it is when the window begins [rad/s^2], shape [N, 3]."""

    def missing(self, elapsed_s: float, load: Array) -> Array:
        """Return the angular acceleration to add under a load [rad/s^2], shape [N, 3]."""
        return np.asarray(self.steady * load + self.fading * np.exp(-elapsed_s / _FADING_S))


def _calibrate(
    log: FlightLog,
    config: MultirotorConfig,
    states: MultirotorState,
    flying: NDArray[np.bool_],
    first: NDArray[np.int64],
    past: int,
) -> _Calibration:
    vehicle = Multirotor(config, count=len(flying))
    vehicle.reset(**states._asdict())
    drawn = np.where(flying, _specific_force(vehicle)[:, 2], 0.0)
    measured = np.where(flying, log.specific_force[:, 2], 0.0)

    def over_past(rows: Array) -> Array:
        total = np.concatenate([[0.0], np.cumsum(rows)])
        end = np.arange(len(rows))
        return np.asarray(total[end] - total[np.maximum(end - past, 0)])

    scale = over_past(measured) / np.where(over_past(drawn) > 0.0, over_past(drawn), np.inf)
    speed = _speeds(config, states.rotor_speed, scale)
    vehicle.reset(**states._replace(rotor_speed=speed)._asdict())
    load = _load(config, speed)
    steady, fading = _missing(log.body_rate, vehicle.acceleration.angular, load, flying)
    step = round(_FILTER_STEP_S / _STEP_S)
    return _Calibration(scale=scale[first], steady=steady[first // step], fading=fading[first // step])


def _missing(body_rate: Array, turning: Array, load: Array, flying: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Tell what the model misses, by a Kalman filter of rate, steady and fading part for each axis.

    Of n samples: measured rate [rad/s], angular acceleration of the model [rad/s^2] and load by which the
    steady part is multiplied, [n, 3] each, and which of them count, [n].

    Returns:
        The steady part under a load of 1 and the fading part at samples 0, 10, 20, ... [rad/s^2], shape [n /
        10, 3] each.
    """
    step = round(_FILTER_STEP_S / _STEP_S)
    count = len(turning) // step
    pushed = _FILTER_STEP_S * turning[: count * step].reshape(count, step, 3).mean(axis=1)
    loads = load[: count * step].reshape(count, step, 3).mean(axis=1)
    known = np.all(flying[: count * step].reshape(count, step), axis=1).tolist()
    keep = np.exp(-_FILTER_STEP_S / _FADING_S)
    transition = np.zeros((3, 3, 3))  # [axis, to, from] of rate, steady, fading
    transition[:, 0] = 1.0, _FILTER_STEP_S, _FILTER_STEP_S
    transition[:, 1, 1] = 1.0
    transition[:, 2, 2] = keep
    grown = np.zeros((3, 3, 3))
    grown[:, 0, 0] = _KICK_RAD_S_PER_SQRT_S**2 * _FILTER_STEP_S
    grown[:, 1, 1] = _DRIFT_RAD_S2_PER_SQRT_S**2 * _FILTER_STEP_S
    grown[:, 2, 2] = (1.0 - keep**2) * _FADING_RAD_S2**2
    state = np.zeros((3, 3))  # [axis, part]
    covariance = np.zeros((3, 3, 3))
    covariance[:, 1, 1], covariance[:, 2, 2] = _STEADY_RAD_S2**2, _FADING_RAD_S2**2
    parts = np.empty((count, 2, 3))
    begun = False
    for k in range(count):
        if known[k] and not begun:
            state[:, 0] = body_rate[k * step]
            covariance[:, 0, :] = covariance[:, :, 0] = 0.0
            covariance[:, 0, 0] = _GYRO_RAD_S**2
        elif known[k]:
            gain = covariance[:, :, 0] / (covariance[:, 0, 0] + _GYRO_RAD_S**2)[:, None]
            state += gain * (body_rate[k * step] - state[:, 0])[:, None]
            covariance -= gain[:, :, None] * covariance[:, None, 0, :]
        begun = known[k]
        parts[k] = state[:, 1:].T
        transition[:, 0, 1] = _FILTER_STEP_S * loads[k]
        state = (transition @ state[:, :, None])[:, :, 0]
        state[:, 0] += pushed[k]
        covariance = transition @ covariance @ transition.transpose(0, 2, 1) + grown
    return parts[:, 0], parts[:, 1]


def _speeds(config: MultirotorConfig, speed: Array, scale: Array) -> Array:
    """Return rotor speeds whose thrust is that of `speed` times `scale`."""
    wanted = np.sqrt(np.maximum(scale, 0.0))[:, None] * speed
    return np.clip(wanted, config.rotor_speed_min_rad_s, config.rotor_speed_max_rad_s)


def _load(config: MultirotorConfig, speed: Array) -> Array:
    """Return by what the steady part is multiplied, shape [N, 3].

    That about x and y grows with the thrust, as of a battery off centre: thrust over weight.
    """
    load = np.ones((len(speed), 3))
    load[:, :2] = (config.thrust_coefficient_n_s2 * speed**2).sum(axis=1)[:, None] / config.hover_thrust_n
    return load
