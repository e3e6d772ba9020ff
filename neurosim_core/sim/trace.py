# mypy: disable-error-code="index,attr-defined,misc,call-overload,operator,arg-type,valid-type"
"""The states of all vehicles at the boundaries of batches, on the device until they are read."""

import math
from typing import Any, NamedTuple

import numpy as np
import warp as wp
from numpy.typing import NDArray

from neurosim_core.runtime.cuda import HostCopy, RecordedLaunch
from neurosim_core.scene.freespace import DistanceField, room_around
from neurosim_core.vehicle import Multirotor
from neurosim_core.vehicle.arrays import BLOCK_DIM
from neurosim_core.vehicle.history import History, append_history, make_history, motion_at
from neurosim_core.vehicle.status import STATUS_COLLISION, STATUS_OK

wp.set_module_options({"enable_backward": False})

POSITION = slice(0, 3)
ORIENTATION = slice(3, 7)
VELOCITY = slice(7, 10)
BODY_RATE = slice(10, 13)
ROTOR_SPEED = slice(13, None)
"""Where each part of a state stands in a row of a `Trace`."""
_LAUNCHES_MAX = 256


@wp.struct
class Surfaces:
    """What vehicles can touch: the scene that each world is in, and the ground."""

    fields: wp.array[DistanceField]  # Distance to each scene, shape [scene]
    scene: wp.array[int]  # Which of them a world is in, shape [world]
    radius_m: float  # Radius of the vehicle [m]
    ground_height_m: wp.float64  # z of the plane that it may land on [m]; -inf: there is none
    holds: int  # 1: a vehicle that touches something is held until its world is reset


@wp.struct
class Fleet:
    """The state of the vehicles (`MultirotorArrays`) and of their worlds; all of shape [world, ...]."""

    position: wp.array[wp.vec3d]
    velocity: wp.array[wp.vec3d]
    orientation: wp.array[wp.quatd]
    body_rate: wp.array[wp.vec3d]
    rotor_speed: wp.array2d[wp.float64]
    rotor_speed_command: wp.array2d[wp.float64]
    stamp_ns: wp.array[wp.int64]
    status: wp.array[wp.int32]
    redone_count: wp.array[wp.int64]
    evaluation_count: wp.array[wp.int64]
    clock_ns: wp.array[wp.int64]  # Time of the world at the beginning of the batch [ns]
    collided: wp.array[wp.int32]
    """1: the vehicle has touched something in this batch, or is held because it did."""
    active: wp.array[wp.int32]  # 0: the world is left alone by samplers and collisions


@wp.struct
class Rows:
    """The slots of a trace."""

    states: wp.array3d[wp.float64]  # Shape [slot, world, 13 + R]; the others: [slot, world]
    status: wp.array2d[wp.int32]  # Why a vehicle is held (`MultirotorArrays.status`)
    clearance: wp.array2d[wp.float32]  # From the vehicle to the nearest surface [m], <= 0 where it touches
    redone: wp.array2d[wp.int64]  # Intervals redone so far (`MultirotorArrays.redone_count`)
    stamps: wp.array2d[wp.int64]  # Time since the reset of the world [ns]
    history: History  # Of all boundaries, as far back as rays with times of their own need it
    entries: wp.array2d[wp.int64]  # Number of the entry of each slot in `history`; empty without one


@wp.struct
class Log:
    """Where states are recorded, and what vehicles touch meanwhile."""

    surfaces: Surfaces
    fleet: Fleet
    rows: Rows


@wp.func
def note_state(
    log: Log, world: int, slot: int, elapsed_ns: wp.int64, is_first: wp.bool, is_last: wp.bool
) -> None:
    """Do for one vehicle what `Trace.record` does."""
    surfaces = log.surfaces
    fleet = log.fleet
    rows_out = log.rows
    if is_first:  # touches of the batch before are forgotten, except of vehicles that are held by one
        fleet.collided[world] = wp.where(fleet.status[world] == STATUS_COLLISION, 1, 0)
    position = fleet.position[world]
    for axis in range(3):
        rows_out.states[slot, world, axis] = position[axis]
        rows_out.states[slot, world, 7 + axis] = fleet.velocity[world][axis]
        rows_out.states[slot, world, 10 + axis] = fleet.body_rate[world][axis]
    for part in range(4):
        rows_out.states[slot, world, 3 + part] = fleet.orientation[world][part]
    for rotor in range(fleet.rotor_speed.shape[1]):
        rows_out.states[slot, world, 13 + rotor] = fleet.rotor_speed[world, rotor]
    rows_out.status[slot, world] = fleet.status[world]
    rows_out.stamps[slot, world] = fleet.clock_ns[world] + elapsed_ns
    rows_out.redone[slot, world] = fleet.redone_count[world]
    if rows_out.entries.shape[0] > 0:
        moves = wp.where(fleet.status[world] == STATUS_OK, wp.float64(1.0), wp.float64(0.0))
        rows_out.entries[slot, world] = append_history(
            rows_out.history,
            world,
            fleet.clock_ns[world] + elapsed_ns,
            position,
            moves * fleet.velocity[world],
            fleet.orientation[world],
            moves * fleet.body_rate[world],
        )
    field = surfaces.fields[surfaces.scene[world]]
    room = room_around(
        field, surfaces.radius_m, surfaces.radius_m + field.voxel, surfaces.ground_height_m, position
    )
    rows_out.clearance[slot, world] = room
    if room <= 0.0 and fleet.active[world] != 0 and fleet.status[world] == STATUS_OK:
        fleet.collided[world] = 1
        if surfaces.holds != 0:
            fleet.status[world] = STATUS_COLLISION
    if is_last:
        fleet.clock_ns[world] += elapsed_ns


@wp.kernel
def _record(log: Log, slot: int, elapsed_ns: wp.int64, is_first: int, is_last: int) -> None:
    note_state(log, wp.tid(), slot, elapsed_ns, is_first != 0, is_last != 0)


@wp.kernel
def _camera_poses(
    # Model:
    p_BC: wp.array[wp.vec3d],
    q_BC: wp.array[wp.quatd],
    stride: int,
    # In:
    states: wp.array3d[wp.float64],
    stamps: wp.array2d[wp.int64],
    slots: wp.array[int],
    # Out:
    p_WC_out: wp.array[wp.vec3],
    q_WC_out: wp.array[wp.quat],
    stamps_out: wp.array2d[wp.int64],
) -> None:
    world, instant = wp.tid()
    slot = slots[instant]
    row = world * stride + instant
    p_WB = wp.vec3d(states[slot, world, 0], states[slot, world, 1], states[slot, world, 2])
    q_WB = wp.quatd(
        states[slot, world, 3], states[slot, world, 4], states[slot, world, 5], states[slot, world, 6]
    )
    p_WC = p_WB + wp.quat_rotate(q_WB, p_BC[world])
    q_WC = q_WB * q_BC[world]
    p_WC_out[row] = wp.vec3(p_WC)
    q_WC_out[row] = wp.quat(q_WC)
    if stamps_out.shape[0] > 0:
        stamps_out[row, 0] = stamps[slot, world]


@wp.kernel
def _ray_poses(
    # Model:
    p_BC: wp.array[wp.vec3d],
    q_BC: wp.array[wp.quatd],
    stride: int,
    offsets_ns: wp.array[wp.int64],
    # In:
    history: History,
    entries: wp.array2d[wp.int64],
    slots: wp.array[int],
    # Out:
    p_WC_out: wp.array[wp.vec3],
    q_WC_out: wp.array[wp.quat],
    stamps_out: wp.array2d[wp.int64],
) -> None:
    world, instant, part = wp.tid()
    last = entries[slots[instant], world]
    length = wp.int64(history.stamp_ns.shape[1])
    stamp_ns = history.stamp_ns[world, int(last % length)] + offsets_ns[part]
    stamp_ns = wp.max(stamp_ns, wp.int64(0))
    at = motion_at(history, world, last, stamp_ns)
    p_WB = at.position
    q_WB = at.orientation
    row = (world * stride + instant) * offsets_ns.shape[0] + part
    p_WC_out[row] = wp.vec3(p_WB + wp.quat_rotate(q_WB, p_BC[world]))
    q_WC_out[row] = wp.quat(q_WB * q_BC[world])
    if stamps_out.shape[0] > 0:
        stamps_out[row, 0] = stamp_ns


@wp.kernel
def _camera_twists(
    # Model:
    p_BC: wp.array[wp.vec3d],
    q_BC: wp.array[wp.quatd],
    stride: int,
    # In:
    states: wp.array3d[wp.float64],
    status: wp.array2d[wp.int32],
    slots: wp.array[int],
    # Out:
    twist_out: wp.array[wp.spatial_vectord],
) -> None:
    world, instant = wp.tid()
    slot = slots[instant]
    q_WB = wp.quatd(
        states[slot, world, 3], states[slot, world, 4], states[slot, world, 5], states[slot, world, 6]
    )
    v_W = wp.vec3d(states[slot, world, 7], states[slot, world, 8], states[slot, world, 9])
    w_B = wp.vec3d(states[slot, world, 10], states[slot, world, 11], states[slot, world, 12])
    v_W += wp.quat_rotate(q_WB, wp.cross(w_B, p_BC[world]))
    w_C = wp.quat_rotate_inv(q_BC[world], w_B)
    twist = wp.spatial_vectord(v_W[0], v_W[1], v_W[2], w_C[0], w_C[1], w_C[2])
    if status[slot, world] != STATUS_OK:
        twist = wp.spatial_vectord()
    twist_out[world * stride + instant] = twist


@wp.kernel
def _copy_rows(
    # In:
    first: int,
    rows: Rows,
    # Out:
    rows_out: Rows,
) -> None:
    place, world, part = wp.tid()
    slot = first + place
    rows_out.states[slot, world, part] = rows.states[slot, world, part]
    if part == 0:
        rows_out.status[slot, world] = rows.status[slot, world]
        rows_out.redone[slot, world] = rows.redone[slot, world]
        rows_out.clearance[slot, world] = rows.clearance[slot, world]


class TraceRows(NamedTuple):
    """Slots of a `Trace` on the host."""

    states: NDArray[np.float64]
    """Shape [slot, world, 13 + R]."""
    status: NDArray[np.int32]
    """Shape [slot, world]."""
    clearance: NDArray[np.float32]
    """[m], shape [slot, world]."""
    redone: NDArray[np.int64]
    """Shape [slot, world]."""


class Trace:
    """Device buffers with one slot for each boundary of the batches in flight, and their copies on the host.

    Its arrays are those of `Rows`.
    """

    def __init__(
        self, *, capacity: int, world_count: int, rotor_count: int, device: str, history_length: int = 0
    ) -> None:
        shape = (capacity, world_count)

        def zeros(shape: Any, dtype: Any) -> Any:
            return wp.zeros(shape, dtype=dtype, device=device)

        self._rows = Rows()
        self._rows.states = self.states = zeros((*shape, 13 + rotor_count), wp.float64)
        self._rows.status = self.status = zeros(shape, wp.int32)
        self._rows.clearance = self.clearance = zeros(shape, wp.float32)
        self._rows.redone = self.redone = zeros(shape, wp.int64)
        self._rows.stamps = self.stamps = zeros(shape, wp.int64)
        self._rows.history = make_history(world_count, history_length, device)
        self._rows.entries = zeros(shape if history_length else (0, world_count), wp.int64)
        self._is_cuda = wp.get_device(device).is_cuda
        self._copies: list[HostCopy] = []
        self._rows_on_host = Rows()
        self._record = RecordedLaunch(_record, device, block_dim=BLOCK_DIM)
        self._flights: dict[int, tuple[RecordedLaunch, list[Any]]] = {}
        self._log: tuple[Any, Any, Any] = (None, None, None)
        self._pose_launches: dict[tuple[int, int, int], tuple[Any, wp.Launch]] = {}

    def record(
        self, surfaces: Any, fleet: Any, slot: int, elapsed_ns: int, *, first: bool, last: bool
    ) -> None:
        """Copy the present state, status and time of all vehicles into a slot, and note who touches what.

        Vehicles that touch something are marked in `fleet`, and held if so configured; `elapsed_ns` counts
        from the beginning of the batch. At the `first` slot of a batch vehicles touch nothing yet; at the
        `last` clocks of worlds move on to it.
        """
        log = self._log_of(surfaces, fleet)
        self._record.launch(self.states.shape[1], [log, slot, elapsed_ns, int(first), int(last)])

    def fly(
        self,
        vehicle: Multirotor,
        surfaces: Any,
        fleet: Any,
        slot: int,
        elapsed_ns: int,
        span_ns: int,
        count: int,
        *,
        first: bool,
        last: bool,
    ) -> None:
        """Move all vehicles through `count` equal spans; `record` the state after each, in one launch.

        Slots are those from `slot` on, and `elapsed_ns` is the time before the first span. `first`: a batch
        begins with it; `last`: a batch ends with the last span.
        """
        if span_ns not in self._flights:
            if len(self._flights) >= _LAUNCHES_MAX:
                self._flights.clear()
            kernel, model = vehicle.flight(span_ns, note_state)
            self._flights[span_ns] = RecordedLaunch(kernel, vehicle.device, block_dim=BLOCK_DIM), model
        launch, model = self._flights[span_ns]
        log = self._log_of(surfaces, fleet)
        launch.launch(vehicle.count, [*model, log, count, slot, elapsed_ns, int(first), int(last)])

    def _log_of(self, surfaces: Any, fleet: Any) -> Any:
        """Return the log of vehicles, the same each time."""
        if self._log[:2] != (surfaces, fleet):
            log = Log()
            log.surfaces, log.fleet, log.rows = surfaces, fleet, self._rows
            self._log = surfaces, fleet, log
        return self._log[2]

    def camera_poses(
        self,
        slots: wp.array[int],
        *,
        count: int,
        p_BC: Any,
        q_BC: Any,
        p_WC: wp.array[wp.vec3],
        q_WC: wp.array[wp.quat],
        stamps: Any,
    ) -> None:
        """Write the poses T_WC = T_WB T_BC of a camera at the first `count` of the given slots, in float32.

        Where the camera is on the body in each world is given as vec3d [m] and quatd, shape [world].
        Positions, orientations, [world K], and times [ns], [world K, 1] or empty, are overwritten.
        """
        key = (slots.ptr, count, p_WC.ptr)
        # another list of slots may have the memory of one that is gone
        if key not in self._pose_launches or self._pose_launches[key][0] is not slots:
            world_count = self.states.shape[1]
            launch = wp.launch(
                _camera_poses,
                dim=(world_count, count),
                inputs=[p_BC, q_BC, p_WC.shape[0] // world_count, self.states, self.stamps, slots],
                outputs=[p_WC, q_WC, stamps],
                device=self.states.device,
                block_dim=BLOCK_DIM,
                record_cmd=True,
            )
            if len(self._pose_launches) >= _LAUNCHES_MAX:
                self._pose_launches.clear()
            self._pose_launches[key] = (slots, launch)
        self._pose_launches[key][1].launch()

    def ray_poses(
        self,
        slots: wp.array[int],
        offsets_ns: Any,
        *,
        count: int,
        p_BC: Any,
        q_BC: Any,
        p_WC: wp.array[wp.vec3],
        q_WC: wp.array[wp.quat],
        stamps: Any,
    ) -> None:
        """Write the poses of a camera when its rays are cast; before stamp 0 it stands still.

        As `camera_poses`, for J times of each instant: offsets from it [ns], <= 0 and not before the history
        begins, int64, shape [J]. Arrays that are written have the shape [world K J].
        """
        world_count, part_count = self.states.shape[1], offsets_ns.shape[0]
        stride = p_WC.shape[0] // (world_count * part_count)
        rows = self._rows
        wp.launch(
            _ray_poses,
            dim=(world_count, count, part_count),
            inputs=[p_BC, q_BC, stride, offsets_ns, rows.history, rows.entries, slots],
            outputs=[p_WC, q_WC, stamps],
            device=p_WC.device,
            block_dim=BLOCK_DIM,
        )

    def camera_twists(self, slots: wp.array[int], twist: Any, *, count: int, p_BC: Any, q_BC: Any) -> None:
        """Write velocities of a camera, in W [m/s] and angular in C [rad/s]; 0 where it is held.

        As `camera_poses`; `twist` is of spatial_vectord, shape [world K].
        """
        world_count = self.states.shape[1]
        wp.launch(
            _camera_twists,
            dim=(world_count, count),
            inputs=[p_BC, q_BC, twist.shape[0] // world_count, self.states, self.status, slots],
            outputs=[twist],
            device=self.states.device,
            block_dim=BLOCK_DIM,
        )

    @property
    def history(self) -> Any:
        """The states at all boundaries, as far back as somebody needs (`vehicle.history`)."""
        return self._rows.history

    def bring_to_host(self) -> None:
        """Allocate the copies on the host that `fetch` writes to."""
        arrays = {name: getattr(self._rows, name) for name in TraceRows._fields}
        self._copies = [HostCopy(array) for array in arrays.values()]
        for name, copy in zip(arrays, self._copies, strict=True):
            setattr(self._rows_on_host, name, copy.mapped())

    def fetch(self, first: int, count: int) -> None:
        """Launch the copy of some slots to the host, after `bring_to_host`; one kernel copies all."""
        if self._is_cuda and self._copies:
            wp.launch(
                _copy_rows,
                dim=(count, *self.states.shape[1:]),
                inputs=[first, self._rows],
                outputs=[self._rows_on_host],
                device=self.states.device,
                block_dim=BLOCK_DIM,
            )

    def numpy(self, first: int, count: int) -> TraceRows:
        """Return some slots that were fetched, and that the device has finished with."""
        return TraceRows(*(copy.rows(first, count) for copy in self._copies))


def make_surfaces(
    fields: Any, scene: Any, *, radius_m: float, ground_height_m: float | None, holds: bool
) -> Surfaces:
    """Return what vehicles of a radius can touch: `DistanceField` of each scene, index of that of each world.

    `ground_height_m` is z of the plane that they may land on; None: there is none. With `holds` a vehicle
    that touches something is held.
    """
    surfaces = Surfaces()
    surfaces.fields, surfaces.scene = fields, scene
    surfaces.radius_m = radius_m
    surfaces.ground_height_m = wp.float64(-math.inf if ground_height_m is None else ground_height_m)
    surfaces.holds = int(holds)
    return surfaces
