# mypy: disable-error-code="attr-defined,call-overload,index,assignment"
"""One event camera in many worlds: frames of all worlds in, events of all worlds out, on the device."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from neurosim_core.render.launch import core_count, share
from neurosim_core.runtime.cuda import Launches
from neurosim_core.sensors import event_kernels
from neurosim_core.sensors.base import FrameSensor
from neurosim_core.sensors.event_config import EventCameraConfig
from neurosim_core.sensors.event_frame_scan import PIXELS_PER_THREAD, scan_frame
from neurosim_core.sensors.event_pixels import PixelStates, make_stack
from neurosim_core.sensors.event_scan import AGAIN, ALL, BLOCK_SIZE, COUNT

_SORT_BLOCK_SIZE = 1024
"""Threads that sort the events of a world, where there may be many."""
_MANY_EVENTS = 8192
_OFFSETS_MAX = 4096
"""Largest number of cached lists of offsets."""


@dataclass(frozen=True, kw_only=True, eq=False)
class WorldEvents:
    """The events of a step in all worlds, on the device, valid until the next step or reset.

    World i has the slice `offsets[i]:offsets[i + 1]`; elements after the last slice are undefined. Events are
    sorted by (t, y, x, polarity) within each world, unless `Simulation(sorted=False)`.
    """

    t: wp.array[wp.int64]
    """Time since the reset of the world, floored to the microsecond [us], shape [room]."""
    x: wp.array[wp.uint16]
    """Column [px], shape [room]."""
    y: wp.array[wp.uint16]
    """Row [px], shape [room]."""
    polarity: wp.array[wp.uint8]
    """1: brighter, 0: darker, shape [room]."""
    offsets: wp.array[wp.int32]
    """Index of the first event of each world, and the number of events, shape [N + 1]."""
    counts: wp.array[wp.int32]
    """Number of events of each world, shape [N]."""
    dropped: wp.array[wp.int32]
    """Number of lost events of each world, beyond the capacity, shape [N]."""
    counters: wp.array2d[wp.int64]
    """Counters of the last step or reset of each world, shape [N, 3]: events; invalid values of log radiance
    (not finite or beyond +-1000; such pixels keep their last value, or begin at 0); and the number of values
    from the first invalid one to the end."""
    width: int
    """Width of the sensor [px]."""
    height: int
    """Height of the sensor [px]."""

    def numpy(self, world: int) -> tuple[Any, Any, Any, Any]:
        """Return t, x, y and polarity of one world on the host; waits for the device."""
        begin, end = (int(edge) for edge in self.offsets.numpy()[world : world + 2])
        columns = (self.t, self.x, self.y, self.polarity)
        if begin == end:  # Warp refuses an empty slice
            return tuple(np.empty(0, dtype=wp.dtype_to_numpy(column.dtype)) for column in columns)  # type: ignore[return-value]
        return tuple(np.array(column[begin:end].numpy()) for column in columns)  # type: ignore[return-value]


class WorldEventCamera(FrameSensor):
    """One event camera of the rig in all worlds.

    Each world yields the events of a single `EventCamera`. In a step with more than `capacity` events, each
    of its K renders keeps at most `capacity / K` events, those of the upper rows that fit; the others are
    counted in `dropped`.

    Args:
        configs: The pixels of each world.
        width: Width of the sensor [px].
        height: Height of the sensor [px].
        instant_count: K, the largest number of frames of a world in one step.
        device: Warp device of frames and events.
        capacity: Capacity for events of one world in one step.
        sensor: Name of the sensor: noise depends on it.
        seeds: Seed of each world.
        clock_ns: Time of each world at the end of a step [ns], int64, shape [world]; for `plan`.
        ordered: Sort the events of each world.
        decodes: Allocate `results`; False: the caller reads the keys.

    Attributes:
        present: Index of the current one of two pixel states; a scan writes the other.
    """

    def __init__(
        self,
        configs: Sequence[EventCameraConfig],
        *,
        width: int,
        height: int,
        instant_count: int,
        device: Any,
        capacity: int,
        sensor: str,
        seeds: Sequence[int],
        clock_ns: wp.array[wp.int64] | None = None,
        ordered: bool = True,
        decodes: bool = True,
    ) -> None:
        self.device: Any = wp.get_device(device)
        world_count = len(configs)
        self._ordered = ordered
        self._event_count_max: Any = wp.array(
            [config.event_count_max for config in configs], dtype=wp.int32, device=self.device
        )
        terms = tuple(sorted({term for config in configs for term in config.terms()}))
        self._states = PixelStates(
            configs,
            width=width,
            height=height,
            ring_size=2,
            device=self.device,
            sensor=sensor,
            seeds=seeds,
            terms=terms,
        )
        self.terms: tuple[str, ...] = terms
        """Terms beyond ideal pixels that some world needs: some of `event_noise_model.TERMS`."""
        self.layout = self._states.layout
        self._shape = (world_count, width * height)
        self.stack = make_stack(world_count, instant_count, height, self.device)
        """The input and the output of a step, `event_kernels.Stack`."""
        self.present = 0
        self._frames: Any = None
        self._seen_ns = 0
        self._clock_ns = clock_ns
        self.grow(capacity)
        self._sections = self._zeros(-(-world_count // int(event_kernels.SECTION)), wp.int64)
        self._offsets = functools.lru_cache(_OFFSETS_MAX)(self._upload_offsets)
        room = world_count * capacity if decodes else 0
        self.results = WorldEvents(
            t=self._empty(room, wp.int64),
            x=self._empty(room, wp.uint16),
            y=self._empty(room, wp.uint16),
            polarity=self._empty(room, wp.uint8),
            offsets=self._zeros(world_count + 1, wp.int32),
            counts=self._zeros(world_count, wp.int32),
            dropped=self.stack.dropped,
            counters=self.stack.counters,
            width=width,
            height=height,
        )

    @property
    def thresholds(self) -> Any:
        """Thresholds of each world, up and down, device array of vec2d, shape [world]; None: others count."""
        return None if self.terms else self._states.thresholds

    def begin(self, frames: wp.array3d[wp.float32], stamp_ns: int, mask: wp.array[wp.int32]) -> None:
        """Let worlds whose mask is not 0 take frame 0 as reference; forget all events; launches only."""
        self.look_at(frames)
        for array in (self.results.offsets, self.results.counts, self.stack.dropped, self.stack.counters):
            array.zero_()
        states = self._states
        wp.launch(
            event_kernels.begin_pixels,
            dim=self._shape,
            inputs=[mask, self.stack.log_radiance],
            outputs=[states.ring[self.present], self.stack.counters],
            device=self.device,
        )
        states.begin_noise(mask, self.present)
        self._seen_ns = stamp_ns

    def plan(self, frames: wp.array3d[wp.float32], stamps_ns: Sequence[int], end_ns: int) -> Launches:
        """Return what finds the events of a step; see `FrameSensor.plan`."""
        self.look_at(frames)
        offsets_ns = (self._seen_ns - end_ns, *(stamp_ns - end_ns for stamp_ns in stamps_ns))
        offsets, count, present = self._offsets(offsets_ns), len(stamps_ns), self.present
        if stamps_ns:
            self._seen_ns, self.present = stamps_ns[-1], 1 - present
        return Launches((offsets_ns, present, frames.ptr), lambda: self._find(offsets, count, present))

    def seed(self, seeds: Sequence[int], worlds: Collection[int] | None = None, *, reset_ns: int = 0) -> None:
        """Draw what stays in the pixels of some worlds anew; see `PixelStates.seed`."""
        self._states.seed(seeds, worlds, reset_ns=reset_ns)

    def look_at(self, frames: wp.array3d[wp.float32]) -> None:
        """Read frames, shape [world K, H, W], at the scans that follow."""
        if frames is not self._frames:
            self._frames = frames
            self.stack.log_radiance = frames.reshape((self._shape[0], -1, self._shape[1]))

    def _upload_offsets(self, offsets_ns: tuple[int, ...]) -> Any:
        return wp.array(np.array(offsets_ns, dtype=np.int64), dtype=wp.int64, device=self.device)

    def _find(self, offsets_ns: wp.array[wp.int64], frame_count: int, present: int) -> object:
        """Find the events of a step; launches only, on CUDA.

        Offsets are from the end of the step to the last frame before it, and to each frame [ns].
        """
        self._launch(event_kernels.begin_step, self._shape[0], [self._clock_ns, offsets_ns], [self.stack])
        if frame_count > 0:
            self.find_keys(frame_count, present)
        self._hand_out()
        return offsets_ns

    def find_keys(self, frame_count: int, present: int) -> None:
        """Scan the frames of a step that has begun, and drop the events that do not fit."""
        world_count = self._shape[0]
        self.take_frames(frame_count, ALL, present)
        self._launch(
            event_kernels.find_overflow, world_count, [self._capacity, self._event_count_max], [self.stack]
        )
        if self.device.is_cuda or self.stack.overflow.numpy().any():
            self.take_frames(frame_count, COUNT, present)
            each = self._capacity // frame_count
            self._launch(event_kernels.limit_rows, world_count, [each, self._event_count_max], [self.stack])
            self.take_frames(frame_count, AGAIN, present)

    def grow(self, capacity: int) -> None:
        """Have room for more keys; those there are are lost."""
        self._capacity = capacity
        self.stack.keys = self._empty((self._shape[0], capacity), wp.int64)

    def _hand_out(self) -> None:
        events, world_count = self.results, self._shape[0]
        lanes = BLOCK_SIZE if self.device.is_cuda else 1
        if self._ordered:
            self._sort()
        counters, sections = self.stack.counters, self._sections
        self._launch(event_kernels.add_up_sections, sections.shape[0], [counters], [sections])
        begun = [events.offsets, events.counts]
        self._launch(event_kernels.add_up, world_count + 1, [counters, sections], begun)
        wp.launch(
            event_kernels.decode,
            dim=(world_count, lanes),
            block_dim=BLOCK_SIZE,
            inputs=[self.layout, lanes, 0, self.stack, events.offsets],
            outputs=[events.t, events.x, events.y, events.polarity],
            device=self.device,
        )

    def _sort(self) -> None:
        world_count = self._shape[0]
        if self.device.is_cuda:
            block = _SORT_BLOCK_SIZE if self._capacity > _MANY_EVENTS else BLOCK_SIZE
            wp.launch(
                event_kernels.sort_keys,
                dim=(world_count, block),
                block_dim=block,
                inputs=[self.stack.counters, self.stack.keys],
                device=self.device,
            )
            return
        keys, counts = self.stack.keys.numpy(), self.stack.counters.numpy()[:, 0]

        def sort(worlds: tuple[int, int]) -> None:
            for world in range(*worlds):
                keys[world, : counts[world]].sort()  # several times as fast as the network on a CPU

        parts = min(core_count(), world_count)
        share(sort, list(itertools.pairwise(world_count * part // parts for part in range(parts + 1))))

    def take_frames(self, frame_count: int, part: int, present: int) -> None:
        """Scan all pixels from one of their two states to the other."""
        self._states.launch(self.stack, present, 1 - present, frame_count=frame_count, part=part)

    def record_scan(self, present: int) -> Any:
        """Return the launch of the scan of one frame of all worlds, on CUDA; `stack` may change meanwhile."""
        states = self._states
        if self.terms:
            return states.launch(self.stack, present, 1 - present, frame_count=1, record_cmd=True)
        world_count, pixel_count = self._shape
        blocks = -(-pixel_count // (BLOCK_SIZE * PIXELS_PER_THREAD))
        return wp.launch(
            scan_frame,
            dim=(world_count, blocks * BLOCK_SIZE),
            block_dim=BLOCK_SIZE,
            inputs=[states.thresholds, self.layout, states.ring[present], self.stack],
            outputs=[states.ring[1 - present]],
            device=self.device,
            record_cmd=True,
        )

    def _launch(self, kernel: Any, dim: int, inputs: list[Any], outputs: list[Any]) -> None:
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self.device)

    def _empty(self, shape: int | tuple[int, ...], dtype: Any) -> Any:
        return wp.empty(shape, dtype=dtype, device=self.device)

    def _zeros(self, shape: int | tuple[int, ...], dtype: Any) -> Any:
        return wp.zeros(shape, dtype=dtype, device=self.device)
