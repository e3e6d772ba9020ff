"""All calls that the live stack makes into the engine: when names move there, only this module changes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection
from typing import Any, NamedTuple

import warp as wp
from numpy.typing import NDArray

from neurosim_core import packets as pkt
from neurosim_core.control import CommandMode
from neurosim_core.packets import Odometry, Packet
from neurosim_core.registry import find
from neurosim_core.runtime.pinned import PinError, PinnedMapping
from neurosim_core.sensors.event_camera import EventSensorConfig
from neurosim_core.sim import (
    COLLISION,
    Batch,
    Model,
    PendingStep,
    StartState,
    State,
    acquire_rooms,
    begin_step,
    end_step,
    finish,
    forget_controllers,
    free_lanes,
    integrate_period,
    make_fleet,
    make_state,
    move_bodies,
    observe,
    plan_paths,
    prepare_step,
    render_batch,
    select_cameras,
    settle,
    skip_batch,
    warm_flight,
    warm_up,
)
from neurosim_core.sim.schedule import batch_end_ns

__all__ = [
    "COLLISION",
    "DynamicsCounts",
    "FlownBatch",
    "Model",
    "PinError",
    "PinnedMapping",
    "StartState",
    "State",
    "VehicleEngine",
    "expected_bytes",
    "make_fleet",
    "packet_type",
    "plan_paths",
    "warm_flight",
    "warm_up",
]

AcquireBuffer = Callable[[str, int, NDArray[Any]], NDArray[Any] | None]
"""Gives memory for a picture: called with camera, stamp [ns] and an array of its shape and dtype."""

_PIXEL_EVENTS_HZ = 100.0
_EVENT_BYTES = 13
_RESERVED_MAX_BYTES = 8 << 20
_PENDING_PERIODS = (2, 100)
"""Bounds of how far the cameras may lag behind the flight, in control periods."""
_SPARE_PERIODS = 32
"""Further periods that are flown while one picture takes too long and frames are dropped."""


def packet_type(kind: str) -> type[Packet]:
    """Return the packet that sensors of a kind yield.

    Raises:
        ValueError: There is no such kind.
    """
    found: type[Packet] = find("sensor", kind).packet_type  # type: ignore[attr-defined]
    return found


def expected_bytes(sensor: object) -> int:
    """Return a size that messages of an event camera hardly exceed [bytes]; 0 for other sensors.

    Memory that is made before the flight delays no message in it: pixels fire at most about 100 times a
    second on average, also in fast flight.
    """
    if not isinstance(sensor, EventSensorConfig):
        return 0
    window_s = sensor.packets.stamp_ns(1) * 1e-9
    count = _PIXEL_EVENTS_HZ * window_s * sensor.lens.width * sensor.lens.height
    return min(round(count) * _EVENT_BYTES, _RESERVED_MAX_BYTES)


class FlownBatch(NamedTuple):
    """A stretch of one flight whose cameras have not been rendered yet."""

    state: State
    batch: Batch

    @property
    def end_ns(self) -> int:
        """The last stamp of it [ns]."""
        return self.batch.until_ns

    @property
    def frame_counts(self) -> Counter[str]:
        """Frames that it has to render: instants of an event camera, pictures of other cameras."""
        counts: Counter[str] = Counter()
        for index, group in enumerate(self.state.groups):
            boundaries = [b for b in self.batch.boundaries if index in b.groups]
            for name in self.batch.wanted.intersection(group.frames):
                counts[name] += len(boundaries)
            for name in self.batch.wanted.intersection(group.images):
                counts[name] += sum(group.images[name].rate.has_tick(b.stamp_ns) for b in boundaries)
        return +counts


class DynamicsCounts(NamedTuple):
    """What happened to the vehicle since the last reset."""

    collisions: int
    redone_intervals: int
    """Intervals that fixed steps could not resolve, and adaptive ones did."""


class VehicleEngine:
    """The simulation of one vehicle.

    In lockstep `begin_step` and `end_step` fly a control period, cameras included. In streaming `fly` flies
    one, and a second thread calls `render` or `skip` for each of its batches, in order.

    Attributes:
        model: What does not change during a run.
        camera_names: Its cameras.
        is_cuda: It runs on a CUDA device.
        period_count_max: Control periods that the cameras may lag behind the flight before they are late.
        writes_in_place: The device writes pictures into memory of `acquire`, and may still do so after
            `end_step`: `settle` waits for it.
    """

    def __init__(self, model: Model, *, lockstep: bool, acquire: AcquireBuffer) -> None:
        """Wrap a model; `reset` begins a run.

        Args:
            model: What is flown.
            lockstep: The cameras are rendered in the thread that flies.
            acquire: Gives memory for pictures, in lockstep on a CUDA device.
        """
        self.model = model
        self.camera_names = frozenset(name for group in model.groups for name in group.names)
        self.is_cuda = bool(wp.get_device(model.device).is_cuda)
        self.writes_in_place = lockstep and self.is_cuda
        self._lockstep = lockstep
        self._acquire = acquire
        period_ns = model.schedule.control.stamp_ns(1)
        slowest_ns = max((group.rate.stamp_ns(1) for group in model.groups), default=0)
        least, most = _PENDING_PERIODS
        self.period_count_max = min(max(-(-slowest_ns // period_ns), least), most)
        batch_ns = batch_end_ns(model.schedule, 0, period_ns)
        self._batches_per_period = -(-period_ns // max(batch_ns, 1)) + 1  # one more where rates do not divide
        self._state: State | None = None

    @property
    def state(self) -> State:
        """The state of the run."""
        assert self._state is not None, "reset() comes first"
        return self._state

    def make_state(self, *, seed: int, start: StartState | None) -> State:
        """Return the beginning of a run, for `reset`.

        Raises:
            ValueError: The start is of a wrong shape or not finite.
        """
        pending = 1 if self._lockstep else self._batches_per_period * (self.period_count_max + _SPARE_PERIODS)
        return make_state(
            self.model,
            in_flight=1,
            flight_lane_count=pending,
            borrow_pictures=self._lockstep,
            make_room=self._acquire if self.writes_in_place else None,
            seed=seed,
            start=start,
        )

    def reset(self, state: State) -> None:
        """Begin a run."""
        self._state = state

    def configure(self, model: Model) -> None:
        """Go on with other settings: gains, links, and bodies, for which nothing may be being rendered."""
        if model.config.control.gains != self.model.config.control.gains:
            forget_controllers(self.state)
        if model.config.bodies != self.model.config.bodies:
            self.forget_plan()
            move_bodies(self.state.groups, model.config.bodies)
        self.model = model

    def begin_step(self, mode: CommandMode, setpoint: NDArray[Any] | None) -> PendingStep:
        """Launch a control period, without waiting for a CUDA device; `end_step` has to follow.

        Raises:
            DynamicsError: The integration failed before.
        """
        return begin_step(self.model, self.state, setpoint, mode=mode)

    def end_step(self, pending: PendingStep) -> list[Packet]:
        """Wait for a control period, and return what its sensors yield in the order of time."""
        return end_step(self.model, self.state, pending)

    def prepare_step(self) -> None:
        """Plan the next control period, so that `begin_step` launches it sooner."""
        if not self.state.ended and self.state.failure is None:
            prepare_step(self.model, self.state)

    def acquire_buffers(self) -> None:
        """Acquire the memory for the pictures of the control period that was planned."""
        acquire_rooms(self.state)

    def forget_plan(self) -> None:
        """Forget the control period that was planned: its pictures go elsewhere."""
        self.state.planned = None

    def settle(self) -> None:
        """Wait until the device has written all pictures that `end_step` has returned."""
        settle(self.state)

    def fly(self, mode: CommandMode, setpoint: NDArray[Any] | None) -> tuple[list[Packet], list[FlownBatch]]:
        """Fly a control period; return what sensors of the state yield, and what remains to be rendered.

        Raises:
            DynamicsError: The integration failed.
            RuntimeError: Too many batches wait: see `can_fly`.
        """
        packets, batches = integrate_period(self.model, self.state, setpoint, mode=mode)
        return packets, [FlownBatch(self.state, batch) for batch in batches]

    def can_fly(self, *, drop: bool) -> bool:
        """Return whether a control period may be flown before more batches have been rendered.

        Args:
            drop: Late frames are dropped: the flight may go on for some more periods.
        """
        spare = 0 if drop else self._batches_per_period * _SPARE_PERIODS
        return free_lanes(self.state) >= self._batches_per_period + spare

    def render(self, flown: FlownBatch) -> list[Packet]:
        """Render the oldest batch that waits, in a thread other than the one that flies."""
        return render_batch(self.model, flown.state, flown.batch)

    def skip(self, flown: FlownBatch) -> None:
        """Drop the oldest batch that waits: the sequence of each camera shows the gap."""
        skip_batch(self.model, flown.state, flown.batch)

    def choose_cameras(self, names: Collection[str]) -> None:
        """Render these cameras, from the next control period on."""
        if self.state.wanted != (names := self.camera_names.intersection(names)):
            select_cameras(self.model, self.state, names)

    def observe(self) -> Odometry:
        """Return the true state at the end of what was flown."""
        return observe(self.state)

    def finish(self) -> list[Packet]:
        """Return the packets of windows that have not ended; for the end of a run."""
        return finish(self.state)

    def report_collision(self, clearance_m: float) -> pkt.Collision:
        """Count a collision with another vehicle and return its packet; it ends the run if so configured.

        Args:
            clearance_m: Distance between the two, minus their radii [m]; <= 0.
        """
        state, now = self.state, self.observe()
        packet = pkt.Collision(
            stamp_ns=now.stamp_ns,
            sequence=state.sequence[COLLISION],
            sensor=COLLISION,
            position=now.position,
            clearance_m=clearance_m,
        )
        state.sequence[COLLISION] += 1
        state.counts["collisions"] += 1
        state.ended |= self.model.config.vehicle.on_collision == "end"
        return packet

    @property
    def counts(self) -> DynamicsCounts:
        """What happened since the last reset."""
        counts = self.state.counts
        return DynamicsCounts(counts["collisions"], counts["redone intervals"])
