# mypy: disable-error-code="index,attr-defined,misc,call-overload,operator,arg-type,valid-type,assignment"
"""The states of all vehicles at the boundaries of batches, on the device until they are read."""

import math
from collections import defaultdict
from typing import Any, NamedTuple

import numpy as np
import warp as wp
from numpy.typing import NDArray

from neurosim_core.runtime.cuda import HostCopy, RecordedLaunch
from neurosim_core.scene.freespace import DistanceField, clearance_around
from neurosim_core.vehicle.arrays import BLOCK_DIM, STATUS_COLLISION, STATUS_OK, MultirotorArrays
from neurosim_core.vehicle.base import Vehicle
from neurosim_core.vehicle.history import History, append_history, make_history, motion_at

wp.set_module_options({"enable_backward": False})

POSITION = slice(0, 3)
ORIENTATION = slice(3, 7)
VELOCITY = slice(7, 10)
BODY_RATE = slice(10, 13)
ROTOR_SPEED = slice(13, None)
"""Where each part of a state stands in a row of a `Trace`."""


@wp.struct
class Surfaces:
    """Surfaces that vehicles can touch: the scene of each world, and the ground."""

    fields: wp.array[DistanceField]  # Distance to each scene, shape [scene]
    scene: wp.array[int]  # Which of them a world is in, shape [world]
    radius_m: float  # Radius of the vehicle [m]
    ground_height_m: wp.float64  # z of the plane that it may land on [m]; -inf: there is none
    stop_on_contact: int  # 1: a vehicle that touches something is held until its world is reset


@wp.struct
class WorldArrays:
    """The vehicles and the clocks of all worlds."""

    vehicles: MultirotorArrays
    clock_ns: wp.array[wp.int64]  # Time of the world at the beginning of the batch [ns], shape [world]
    collided: wp.array[wp.int32]
    """1: the vehicle has touched something in this batch, or is held because it did, shape [world]."""
    active: wp.array[wp.int32]  # 0: the world is left alone by samplers and collisions, shape [world]


@wp.struct
class TraceArrays:
    """The slots of a trace."""

    states: wp.array3d[wp.float64]  # Shape [slot, world, 13 + R]; the others: [slot, world]
    status: wp.array2d[wp.int32]  # Why a vehicle is held (`MultirotorArrays.status`)
    clearance: wp.array2d[wp.float32]  # From the vehicle to the nearest surface [m], <= 0 where it touches
    redone: wp.array2d[wp.int64]  # Intervals redone so far (`MultirotorArrays.redone_count`)
    entries: wp.array2d[wp.int64]  # Number of the entry of each slot in `history`
    history: History  # Of all boundaries, as far back as some camera looks


@wp.struct
class TraceContext:
    """The arrays that `record_state` reads and writes."""

    surfaces: Surfaces
    worlds: WorldArrays
    rows: TraceArrays


@wp.func
def record_state(
    context: TraceContext, world: int, slot: int, elapsed_ns: wp.int64, is_first: wp.bool, is_last: wp.bool
) -> None:
    """Do for one vehicle what `Trace.record` does."""
    surfaces = context.surfaces
    worlds = context.worlds
    vehicles = worlds.vehicles
    rows_out = context.rows
    if is_first:  # touches of the batch before are forgotten, except of vehicles that are held by one
        worlds.collided[world] = wp.where(vehicles.status[world] == STATUS_COLLISION, 1, 0)
    position = vehicles.position[world]
    for axis in range(3):
        rows_out.states[slot, world, axis] = position[axis]
        rows_out.states[slot, world, 7 + axis] = vehicles.velocity[world][axis]
        rows_out.states[slot, world, 10 + axis] = vehicles.body_rate[world][axis]
    for part in range(4):
        rows_out.states[slot, world, 3 + part] = vehicles.orientation[world][part]
    for rotor in range(vehicles.rotor_speed.shape[1]):
        rows_out.states[slot, world, 13 + rotor] = vehicles.rotor_speed[world, rotor]
    rows_out.status[slot, world] = vehicles.status[world]
    rows_out.redone[slot, world] = vehicles.redone_count[world]
    moves = wp.where(vehicles.status[world] == STATUS_OK, wp.float64(1.0), wp.float64(0.0))
    rows_out.entries[slot, world] = append_history(
        rows_out.history,
        world,
        worlds.clock_ns[world] + elapsed_ns,
        position,
        moves * vehicles.velocity[world],
        vehicles.orientation[world],
        moves * vehicles.body_rate[world],
    )
    field = surfaces.fields[surfaces.scene[world]]
    clearance = clearance_around(
        field, surfaces.radius_m, surfaces.radius_m + field.voxel, surfaces.ground_height_m, position
    )
    rows_out.clearance[slot, world] = clearance
    if clearance <= 0.0 and worlds.active[world] != 0 and vehicles.status[world] == STATUS_OK:
        worlds.collided[world] = 1
        if surfaces.stop_on_contact != 0:
            vehicles.status[world] = STATUS_COLLISION
    if is_last:
        worlds.clock_ns[world] += elapsed_ns


@wp.kernel
def _record(context: TraceContext, slot: int, elapsed_ns: wp.int64, is_first: int, is_last: int) -> None:
    record_state(context, wp.tid(), slot, elapsed_ns, is_first != 0, is_last != 0)


@wp.kernel
def _camera_poses(
    # Model:
    p_BC: wp.array[wp.vec3d],
    q_BC: wp.array[wp.quatd],
    stride: int,
    offsets_ns: wp.array[wp.int64],
    # In:
    rows: TraceArrays,
    slots: wp.array[int],
    # Out:
    p_WC_out: wp.array[wp.vec3],
    q_WC_out: wp.array[wp.quat],
    stamps_out: wp.array2d[wp.int64],
) -> None:
    world, instant, part = wp.tid()
    history = rows.history
    last = rows.entries[slots[instant], world]
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
    rows: TraceArrays,
    slots: wp.array[int],
    # Out:
    twist_out: wp.array[wp.spatial_vectord],
) -> None:
    world, instant = wp.tid()
    slot = slots[instant]
    twist = wp.spatial_vectord()
    if rows.status[slot, world] == STATUS_OK:
        history = rows.history
        entry = int(rows.entries[slot, world] % wp.int64(history.stamp_ns.shape[1]))
        w_B = history.body_rate[world, entry]
        v_W = history.velocity[world, entry]
        v_W += wp.quat_rotate(history.orientation[world, entry], wp.cross(w_B, p_BC[world]))
        w_C = wp.quat_rotate_inv(q_BC[world], w_B)
        twist = wp.spatial_vectord(v_W[0], v_W[1], v_W[2], w_C[0], w_C[1], w_C[2])
    twist_out[world * stride + instant] = twist


@wp.kernel
def _copy_rows(
    # In:
    first: int,
    rows: TraceArrays,
    # Out:
    rows_out: TraceArrays,
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

    Args:
        surfaces: What vehicles can touch.
        worlds: The vehicles and their clocks as kernels see them.
        vehicle: What moves them.
        capacity: Number of slots.
        history_length: How many boundaries are kept for cameras, at least as many as there are slots.
        on_host: Slots are brought to the host, too: see `fetch`.

    Attributes:
        arrays: The slots on the device (`TraceArrays`).
    """

    def __init__(
        self,
        surfaces: Any,
        worlds: Any,
        vehicle: Vehicle,
        *,
        capacity: int,
        history_length: int,
        on_host: bool = True,
    ) -> None:
        world_count, rotor_count = worlds.vehicles.rotor_speed.shape
        self.device = worlds.clock_ns.device
        shape = (capacity, world_count)
        self.arrays = TraceArrays()
        self.arrays.states = wp.zeros((*shape, 13 + rotor_count), dtype=wp.float64, device=self.device)
        self.arrays.status = wp.zeros(shape, dtype=wp.int32, device=self.device)
        self.arrays.clearance = wp.zeros(shape, dtype=wp.float32, device=self.device)
        self.arrays.redone = wp.zeros(shape, dtype=wp.int64, device=self.device)
        self.arrays.entries = wp.zeros(shape, dtype=wp.int64, device=self.device)
        self.arrays.history = make_history(world_count, history_length, self.device)
        self._context = TraceContext()
        self._context.surfaces, self._context.worlds = surfaces, worlds
        self._context.rows = self.arrays
        self._copies = [HostCopy(getattr(self.arrays, name)) for name in TraceRows._fields if on_host]
        self._rows_on_host = TraceArrays()
        for name, copy in zip(TraceRows._fields, self._copies, strict=False):
            setattr(self._rows_on_host, name, copy.mapped())
        self._record = self._recorded(_record)
        self._vehicle = vehicle
        self._flight = vehicle.flight_kernel(record_state)
        if self._flight is not None:
            self._fly = self._recorded(self._flight.kernel)
        self._poses: dict[int, RecordedLaunch] = defaultdict(lambda: self._recorded(_camera_poses))
        """By the address of the poses: that of the buffers of one batch in flight."""

    def _recorded(self, kernel: wp.Kernel) -> RecordedLaunch:
        return RecordedLaunch(kernel, self.device, block_dim=BLOCK_DIM)

    def record(self, slot: int, elapsed_ns: int, *, first: bool, last: bool) -> None:
        """Copy the present state, status and time of all vehicles into a slot, and mark who touches what.

        Vehicles that touch something are held if so configured; `elapsed_ns` counts from the beginning of the
        batch. At the `first` slot of a batch vehicles touch nothing yet; at the `last` clocks of worlds move
        on to it.
        """
        arguments = [self._context, slot, elapsed_ns, int(first), int(last)]
        self._record.launch(self.arrays.states.shape[1], arguments)

    @property
    def joins_spans(self) -> bool:
        """Whether vehicles record their state on the way: several spans are one launch."""
        return self._flight is not None

    def advance(
        self,
        slot: int,
        elapsed_ns: int,
        span_ns: int,
        count: int,
        *,
        first: bool,
        last: bool,
    ) -> None:
        """Move all vehicles through equal spans, one unless `joins_spans`, and `record` the state after each.

        Slots are those from `slot` on, and `elapsed_ns` is the time before the first span. `first`: a batch
        begins with it; `last`: a batch ends with the last span.
        """
        if self._flight is not None and span_ns > 0:
            arguments = [self._context, count, slot, elapsed_ns, int(first), int(last)]
            self._fly.launch(self._vehicle.count, [*self._flight.inputs(span_ns), *arguments], key=span_ns)
            return
        if span_ns > 0:
            self._vehicle.advance(span_ns)
        self.record(slot, elapsed_ns + span_ns, first=first, last=last)

    def camera_poses(
        self,
        slots: wp.array[int],
        offsets_ns: wp.array[wp.int64],
        *,
        count: int,
        p_BC: Any,
        q_BC: Any,
        p_WC: wp.array[wp.vec3],
        q_WC: wp.array[wp.quat],
        stamps: Any,
    ) -> None:
        """Write the poses T_WC = T_WB T_BC of a camera when its rays are cast, in float32.

        These are J times of each of the first `count` slots: offsets from it [ns], <= 0 and not before the
        history begins, shape [J]. Before stamp 0 the camera stands still. Where it is on the body in each
        world is given as vec3d [m] and quatd, shape [world]. Positions, orientations, [world K J], and times
        [ns], [world K J, 1] or empty, are overwritten.
        """
        world_count, part_count = self.arrays.states.shape[1], offsets_ns.shape[0]
        stride = p_WC.shape[0] // (world_count * part_count)
        arguments = [p_BC, q_BC, stride, offsets_ns, self.arrays, slots, p_WC, q_WC, stamps]
        self._poses[p_WC.ptr].launch((world_count, count, part_count), arguments)

    def camera_twists(self, slots: wp.array[int], twist: Any, *, count: int, p_BC: Any, q_BC: Any) -> None:
        """Write velocities of a camera, in W [m/s] and angular in C [rad/s]; 0 where it is held.

        As `camera_poses`; `twist` is of spatial_vectord, shape [world K].
        """
        world_count = self.arrays.states.shape[1]
        wp.launch(
            _camera_twists,
            dim=(world_count, count),
            inputs=[p_BC, q_BC, twist.shape[0] // world_count, self.arrays, slots],
            outputs=[twist],
            device=self.device,
            block_dim=BLOCK_DIM,
        )

    def fetch(self, first: int, count: int) -> None:
        """Launch the copy of some slots to the host; one kernel copies all."""
        if self.device.is_cuda and self._copies:
            wp.launch(
                _copy_rows,
                dim=(count, *self.arrays.states.shape[1:]),
                inputs=[first, self.arrays],
                outputs=[self._rows_on_host],
                device=self.device,
                block_dim=BLOCK_DIM,
            )

    def numpy(self, first: int, count: int) -> TraceRows:
        """Return some slots that were fetched, and that the device has finished with."""
        return TraceRows(*(copy.rows(first, count) for copy in self._copies))


def make_surfaces(
    fields: Any, scene: Any, *, radius_m: float, ground_height_m: float | None, stop_on_contact: bool
) -> Surfaces:
    """Return what vehicles of a radius can touch: `DistanceField` of each scene, index of that of each world.

    `ground_height_m` is z of the plane that they may land on; None: there is none. With `stop_on_contact` a
    vehicle that touches something is held.
    """
    surfaces = Surfaces()
    surfaces.fields, surfaces.scene = fields, scene
    surfaces.radius_m = radius_m
    surfaces.ground_height_m = wp.float64(-math.inf if ground_height_m is None else ground_height_m)
    surfaces.stop_on_contact = int(stop_on_contact)
    return surfaces
