# mypy: disable-error-code="attr-defined,misc,arg-type,call-overload,index,assignment,no-untyped-def"
"""Command modes: what a setpoint is at each level, and the controller that turns it into rotor speeds.

    mode          setpoint row (float64)                          closes on
    ------------  ----------------------------------------------  ------------------------------------------
    motor_speeds  R rotor speeds [rad/s]                          nothing, only limits apply
    rates         collective thrust [N], body rate in B [rad/s]   body rate
    attitude      collective thrust [N], q_WB xyzw                attitude
    velocity      velocity in W [m/s], yaw rate [rad/s]           velocity; the heading turns at the yaw rate
    position      position in W [m], yaw [rad]                    position and yaw
    path          nothing: evaluated at the vehicle's stamp       position and yaw, with all derivatives

Each level sets up the one below it (se3.py). Yaw is that of a Z-X-Y sequence: y_B is orthogonal to (cos yaw,
sin yaw, 0). A mode is compiled when it is first used, and only then.
"""

import functools
import logging
import operator
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from neurosim_core.control.allocation import allocate, allocation_matrix, clip
from neurosim_core.control.flatness import AttitudeReference
from neurosim_core.control.se3 import (
    Se3Config,
    Se3Parameters,
    VehicleState,
    Wrench,
    attitude_wrench,
    make_parameters,
    point_wrench,
    present_heading,
    rate_wrench,
    scale_to_squarable,
    shorten,
    velocity_wrench,
)
from neurosim_core.frames import as_rows
from neurosim_core.runtime.cuda import RecordedLaunch
from neurosim_core.trajectory.path import Path, PathArrays, PathPoint, evaluate_path, upload_paths
from neurosim_core.vehicle.aerodynamics import AIR_TERMS, Airframe, Rotors, make_wrench, vec10d
from neurosim_core.vehicle.airframe import MultirotorConfig, make_airframe
from neurosim_core.vehicle.arrays import BLOCK_DIM, MultirotorArrays
from neurosim_core.vehicle.command_ranges import command_ranges

logger = logging.getLogger(__name__)
wp.set_module_options({"enable_backward": False})

CommandMode = Literal["motor_speeds", "rates", "attitude", "velocity", "position", "path"]
"""Names of the command modes."""


@wp.struct
class _Order:
    """The command of one vehicle."""

    path: PathArrays
    setpoint: wp.array2d[wp.float64]
    vehicle: int
    stamp_ns: wp.int64


@wp.func
def _vector3(order: _Order, first: int) -> wp.vec3d:
    rows = order.setpoint
    row = order.vehicle
    return wp.vec3d(rows[row, first], rows[row, first + 1], rows[row, first + 2])


@wp.func
def _thrust(parameters: Se3Parameters, order: _Order) -> wp.float64:
    return clip(order.setpoint[order.vehicle, 0], wp.float64(0.0), parameters.command_thrust_max_n)


@wp.func
def _rates(parameters: Se3Parameters, order: _Order, state: VehicleState) -> Wrench:
    rate_max = wp.min(parameters.body_rate_max_rad_s, parameters.command_rate_max_rad_s)
    rate = shorten(_vector3(order, 1), rate_max)
    return rate_wrench(parameters, state, _thrust(parameters, order), rate, wp.vec3d())


@wp.func
def _attitude(parameters: Se3Parameters, order: _Order, state: VehicleState) -> Wrench:
    v = _vector3(order, 1)
    w = order.setpoint[order.vehicle, 4]
    largest = wp.max(wp.max(wp.abs(v[0]), wp.abs(v[1])), wp.max(wp.abs(v[2]), wp.abs(w)))
    q = wp.quatd(v[0], v[1], v[2], w) * scale_to_squarable(largest)
    reference = AttitudeReference()
    reference.orientation = q / wp.length(q)  # `wp.normalize` would make the identity of nan
    return attitude_wrench(parameters, state, _thrust(parameters, order), reference)


@wp.func
def _velocity(parameters: Se3Parameters, order: _Order, state: VehicleState) -> Wrench:
    rate_max = parameters.command_rate_max_rad_s
    heading = present_heading(state.orientation, clip(order.setpoint[order.vehicle, 3], -rate_max, rate_max))
    velocity = shorten(_vector3(order, 0), parameters.command_speed_max_m_s)
    return velocity_wrench(parameters, state, velocity, wp.vec3d(), wp.vec3d(), wp.vec3d(), heading)


@wp.func
def _position(parameters: Se3Parameters, order: _Order, state: VehicleState) -> Wrench:
    point = PathPoint()
    limit = parameters.command_position_max_m
    p = _vector3(order, 0)
    point.position = wp.vec3d(clip(p[0], -limit, limit), clip(p[1], -limit, limit), clip(p[2], -limit, limit))
    point.yaw = order.setpoint[order.vehicle, 3]
    return point_wrench(parameters, state, point)


@wp.func
def _path(parameters: Se3Parameters, order: _Order, state: VehicleState) -> Wrench:
    index = wp.min(order.vehicle, order.path.first_knot.shape[0] - 2)  # one path serves all
    return point_wrench(parameters, state, evaluate_path(order.path, index, order.stamp_ns))


@dataclass(frozen=True, kw_only=True)
class Mode:
    """One row of the table of command modes."""

    layout: tuple[str, ...]
    """Name and unit of each element of a setpoint row; that of `motor_speeds` repeats for every rotor."""
    wrench: Any = None
    """Device function from setpoint and state to the wrench; None: a setpoint is rotor speeds."""


MODES: dict[str, Mode] = {
    "motor_speeds": Mode(layout=("rotor_speed_rad_s",)),
    "rates": Mode(layout=("thrust_N", "w_B_x_rad_s", "w_B_y_rad_s", "w_B_z_rad_s"), wrench=_rates),
    "attitude": Mode(layout=("thrust_N", "q_WB_x", "q_WB_y", "q_WB_z", "q_WB_w"), wrench=_attitude),
    "velocity": Mode(layout=("v_W_x_m_s", "v_W_y_m_s", "v_W_z_m_s", "yaw_rate_rad_s"), wrench=_velocity),
    "position": Mode(layout=("p_W_x_m", "p_W_y_m", "p_W_z_m", "yaw_rad"), wrench=_position),
    "path": Mode(layout=(), wrench=_path),
}
"""The command modes by name."""


@functools.cache
def mode_kernel(mode: str, terms: frozenset[str] = frozenset()) -> Any:
    """Return the kernel of a mode, made once; `mode_kernel(mode).module` can be compiled ahead of time.

    Args:
        mode: Name of the mode, a key of `MODES`.
        terms: Aerodynamic terms that it compensates, some of `vehicle.aerodynamics.AIR_TERMS`; `motor_speeds`
            only applies the limits.

    Raises:
        ValueError: There is no such mode.
    """
    if mode not in MODES:
        raise ValueError(f"unknown command mode {mode!r}, known: {sorted(MODES)}")
    wrench_of, air_wrench = MODES[mode].wrench, make_wrench(terms)
    allocates = wrench_of is not None
    compensates = allocates and len(terms) > 0

    @wp.kernel(module=wp.get_module(".".join((__name__, mode, *sorted(terms)))), enable_backward=False)
    def command(
        # Model:
        parameters: Se3Parameters,
        airframe: Airframe,
        rotors: Rotors,
        matrix: wp.array2d[wp.float64],
        path: PathArrays,
        # In:
        setpoint: wp.array2d[wp.float64],
        # In/out:
        vehicles: MultirotorArrays,
    ):
        vehicle = wp.tid()
        if wp.static(allocates):
            state = VehicleState()
            state.position = vehicles.position[vehicle]
            state.velocity = vehicles.velocity[vehicle]
            state.orientation = vehicles.orientation[vehicle]
            state.body_rate = vehicles.body_rate[vehicle]
            if wp.static(compensates):
                linear = vec10d()
                for rotor in range(matrix.shape[0]):
                    linear += vehicles.rotor_speed[vehicle, rotor] * rotors.linear_weight[rotor]
                air_B = wp.quat_rotate_inv(state.orientation, state.velocity)
                force, torque = air_wrench(airframe, wp.vec4d(), linear, air_B, state.body_rate)
                state.air_acceleration = wp.quat_rotate(state.orientation, force) / parameters.mass_kg
                state.air_torque = torque
            order = _Order()
            order.path = path
            order.setpoint = setpoint
            order.vehicle = vehicle
            order.stamp_ns = vehicles.stamp_ns[vehicle]
            wrench = wrench_of(parameters, order, state)
            allocate(
                matrix,
                parameters.motors,
                wrench.thrust_N,
                wrench.torque,
                vehicle,
                vehicles.rotor_speed,
                vehicles.rotor_speed_command,
            )
        else:
            for rotor in range(matrix.shape[0]):
                vehicles.rotor_speed_command[vehicle, rotor] = clip(
                    setpoint[vehicle, rotor],
                    parameters.motors.speed_min_rad_s,
                    parameters.motors.speed_max_rad_s,
                )

    return command


class Controller:
    """A controller for `count` vehicles of one kind, in one command mode.

    It has no memory: a command depends on the present state and setpoint only.

    Args:
        mode: What a setpoint is; see the table above.
        vehicle: The vehicle's parameters; the controller knows all of them but the wind.
        config: Gains and limits.
        count: Vehicles in the batch.
        device: Warp device; that of the vehicles.
        paths: For mode `path`, and only there: one for all, or one for each vehicle.

    Attributes:
        mode: Name of the command mode.
        layout: Name and unit of each element of a setpoint row.
        setpoint: The setpoints on the device, float64 [N, len(layout)]; written by whoever commands. What is
            finite and out of range is clamped where it is read.
        ranges: What the vehicles can be asked for.
        clamped_count: Setpoints out of range that came from the host so far.

    Raises:
        TypeError: The count is no integer.
        ValueError: The mode is unknown, paths are missing, superfluous or of the wrong number, or the rotors
            cannot produce every torque.
    """

    def __init__(
        self,
        mode: CommandMode,
        vehicle: MultirotorConfig,
        config: Se3Config | None = None,
        *,
        count: int = 1,
        device: Any = "cpu",
        paths: Path | Sequence[Path] | None = None,
    ) -> None:
        if mode not in MODES:
            raise ValueError(f"unknown command mode {mode!r}, known: {sorted(MODES)}")
        if operator.index(count) < 1:
            raise ValueError(f"count must be >= 1, got {count}")
        layout = MODES[mode].layout
        given = [] if paths is None else [paths] if isinstance(paths, Path) else list(paths)
        if mode == "path" and len(given) not in (1, count):
            raise ValueError(
                f"mode 'path' takes one path, or one for each of {count} vehicles, got {len(given)}"
            )
        if mode != "path" and given:
            raise ValueError(f"mode {mode!r} takes setpoints ({', '.join(layout)}), not paths")
        gains = config or Se3Config()
        self.mode = mode
        self.layout = layout * vehicle.rotor_count if mode == "motor_speeds" else layout
        self.ranges = command_ranges(vehicle)
        self.clamped_count = 0
        self.count = count
        self.rotor_count = vehicle.rotor_count
        self.device = wp.get_device(device)
        self.setpoint = wp.zeros((count, len(self.layout)), dtype=wp.float64, device=self.device)
        matrix = allocation_matrix(vehicle)
        terms = frozenset(vehicle.terms()).intersection(AIR_TERMS if gains.feed_forward_air else ())
        self._command = RecordedLaunch(mode_kernel(mode, terms), self.device, block_dim=BLOCK_DIM)
        airframe, rotors = make_airframe(vehicle, self.device)
        self._model = [
            make_parameters(vehicle, gains, matrix),
            airframe,
            rotors,
            wp.array(matrix, dtype=wp.float64, device=self.device),
            upload_paths(given, self.device) if given else PathArrays(),
        ]
        self._checked: Any = None

    def update(self, arrays: Any) -> None:
        """Write `arrays.rotor_speed_command` from the state in `arrays` and `setpoint`: one launch.

        It neither allocates nor waits (after the first call with the same `arrays`), so it can be captured in
        a graph. A setpoint that is not finite gives commands that are not, and the vehicle reports them.

        Args:
            arrays: The device arrays of a `Multirotor` (`vehicle.arrays`).

        Raises:
            ValueError: If the arrays are of another number of vehicles or rotors, or on another device.
        """
        shape = (self.count, self.rotor_count)
        if arrays is not self._checked:
            if arrays.rotor_speed.shape != shape or arrays.rotor_speed.device != self.device:
                raise ValueError(
                    f"the controller is for {shape[0]} vehicles of {shape[1]} rotors on {self.device}, got "
                    f"arrays of {arrays.rotor_speed.shape} on {arrays.rotor_speed.device}"
                )
            self._checked = arrays
        self._command.launch(self.count, [*self._model, self.setpoint, arrays])

    def begin(self, mask: Any) -> None:
        """Nothing is remembered."""

    def set(self, setpoint: ArrayLike) -> None:
        """Write all setpoints from the host.

        Args:
            setpoint: Rows as in `layout`, shape [N, len(layout)] or one row for all.

        Raises:
            ValueError: If the shape does not fit, an element is not finite, or a command is out of range and
                the vehicle's `command_ranges.beyond` is "refuse".
        """
        self.setpoint.assign(self.checked(setpoint))

    def checked(self, setpoint: ArrayLike) -> NDArray[np.float64]:
        """Return setpoints as rows, shape [N, len(layout)]; arguments and errors as for `set`.

        Rows out of range are counted and, the first time, logged; `update` clamps them.
        """
        try:
            rows = as_rows(setpoint, name="setpoint", count=self.count, width=len(self.layout))
        except ValueError as error:
            raise ValueError(
                f"mode {self.mode!r} takes rows of ({', '.join(self.layout)}): {error}"
            ) from None
        if self.mode == "attitude" and not (np.abs(rows[:, 1:]).max(axis=1) > 1e-6).all():
            raise ValueError(f"mode 'attitude' takes unit quaternions, got {rows[:, 1:].tolist()}")
        beyond = np.flatnonzero(self.ranges.beyond(self.mode, rows))
        if len(beyond):
            reason = self.ranges.excess(self.mode, rows[beyond[0]].tolist())
            if self.ranges.refuse:
                raise ValueError(f"setpoint of mode {self.mode!r}, vehicle {beyond[0]}: {reason}")
            if not self.clamped_count:
                logger.warning("mode %s, vehicle %d: %s; it is clamped", self.mode, beyond[0], reason)
            self.clamped_count += len(beyond)
        return rows
