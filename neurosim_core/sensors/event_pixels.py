# mypy: disable-error-code="index,attr-defined,misc,var-annotated,call-overload"
"""The pixels of one event camera in some worlds: their states, in a ring, and the scans between them.

Scans may be under way one behind the other: each has the state before it and the state after it in the ring.
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Hashable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from neurosim_core.random import mix_seed
from neurosim_core.render.launch import core_count, share
from neurosim_core.runtime.cuda import Fence, HostCopy, HostInput
from neurosim_core.sensors import event_kernels, event_scan
from neurosim_core.sensors.event_config import EventCameraConfig
from neurosim_core.sensors.event_keys import keys_at_first
from neurosim_core.sensors.event_levels import make_layout
from neurosim_core.sensors.event_noise_model import CAUSE, CAUSE_BITS, PixelModel
from neurosim_core.sensors.event_scan import ALL, BLOCK_SIZE, COUNT, PixelState, Stack
from neurosim_core.warp_start import refuse_forked_process

_PIXELS_PER_THREAD_MIN = 16_384
_COUNTERS_ROOM = 16
"""Numbers from the counters of a slot to those of the next, which another core writes."""

_MEMORY = {
    "reference": ("refractory", "spontaneous", "jitter"),
    "event_count": ("jitter",),
    "filtered": ("low_pass",),
    "exposure_ns": ("light_leak",),
    "held_ns": ("refractory",),
    "next_ns": ("spontaneous",),
    "noise_count": ("spontaneous",),
    "voltage": ("stochastic",),
}
"""Terms by what pixels remember for them."""


def make_stack(world_count: int, frame_count: int, height: int, device: Any) -> Any:
    """Return a `Stack` without frames and keys, with a slot for each world."""

    def zeros(dtype: Any, *shape: int) -> Any:
        return wp.zeros(shape, dtype=dtype, device=device)

    stack: Any = Stack()
    stack.stamps = zeros(wp.int64, world_count, frame_count + 1)
    stack.origin_us = zeros(wp.int64, world_count)
    stack.since_reset_ns = zeros(wp.int64, world_count)
    stack.row_limit = wp.full((world_count, frame_count), height, dtype=wp.int32, device=device)
    stack.overflow = zeros(wp.int32, world_count)
    stack.table = zeros(wp.int32, world_count, frame_count, height)
    stack.counters = zeros(wp.int64, world_count, 3)
    stack.dropped = zeros(wp.int32, world_count)
    return stack


class PixelStates:
    """The states of pixels; those of a scan and of the one after it are two of the ring.

    Attributes:
        ring: A `PixelState` each, which share `base`.
        layout: Of the keys, a `KeyLayout`.
        terms: What is compiled in beyond ideal pixels: some of `event_noise_model.TERMS`.
        thresholds: Upwards and downwards, of ideal pixels, device array of vec2d, shape [world].
        models: What is not ideal, a `PixelModel` of each world; empty: nothing.
        screened: Frames that are quiet are skipped first, as is fast on a CPU.
        slot_count: How many launches on a CPU share the pixels of a single world, one for each core. Each
            writes keys and counters of its own; of many worlds each has a slot, and cores take some worlds.
    """

    def __init__(
        self,
        configs: Sequence[EventCameraConfig],
        *,
        width: int,
        height: int,
        ring_size: int,
        device: Any,
        sensor: str,
        seeds: Sequence[int],
        terms: Sequence[str],
        split_pixels: bool = False,
    ) -> None:
        self._configs, self._sensor, self._device = list(configs), sensor, device
        self.terms = tuple(terms)
        self.layout = make_layout(width, height, cause_bits=CAUSE_BITS if CAUSE in self.terms else 0)
        self.shape = (len(configs), width * height)
        self._split_pixels = split_pixels
        self.slot_count = len(configs)
        if split_pixels and device.is_cpu:
            self.slot_count = max(1, min(core_count(), height, self.shape[1] // _PIXELS_PER_THREAD_MIN))
        self._pixel_bounds = [height * slot // self.slot_count * width for slot in range(self.slot_count + 1)]
        base = self._empty(self.shape, wp.float32)
        self.ring = [self._make_state(base) for _ in range(ring_size)]
        thresholds = [(config.threshold_on, config.threshold_off) for config in configs]
        self.thresholds = wp.array(thresholds, dtype=wp.vec2d, device=device)
        self.screened = device.is_cpu and not self.terms
        scratch = (self.shape[0], self.shape[1] if self.screened else 0)
        self._quiet_range = [self._empty(scratch, wp.float32) for _ in range(2)]
        count_shape = (self.shape[0], 0 if self.terms else self.shape[1])
        self._quiet_count = wp.zeros(count_shape, dtype=wp.int32, device=device)
        self.models: list[Any] = []
        self._seeds: list[int] = []
        self._models: Any = None
        self._scan: Any = event_scan.scan
        modules = [event_kernels, event_scan]
        if self.terms:  # ideal pixels do without the kernels of noise
            from neurosim_core.sensors.event_noise_pixel import make_begin, signal_terms
            from neurosim_core.sensors.event_noise_scan import make_noisy_scan

            self._scan = make_noisy_scan(frozenset(self.terms))
            self._begin_noise = make_begin(signal_terms(self.terms))
            modules += [self._scan.module, self._begin_noise.module]
            self.seed(seeds)
        for module in modules:
            wp.load_module(module, device=device)

    def _make_state(self, base: Any) -> PixelState:
        state = PixelState()
        state.base, state.last = base, self._empty(self.shape, wp.float32)
        state.crossed = self._empty(self.shape, wp.vec2i)
        for name, needed_by in _MEMORY.items():
            shape = (self.shape[0], self.shape[1] if set(needed_by) & set(self.terms) else 0)
            dtype = PixelState.vars[name].type.dtype
            setattr(state, name, wp.zeros(shape, dtype=dtype, device=self._device))
        return state

    def seed(self, seeds: Sequence[int], worlds: Collection[int] | None = None, *, reset_ns: int = 0) -> None:
        """Draw what stays in some pixels anew, and let later noise have other seeds; waits for the device.

        Seeds are those of all worlds, of which `worlds` (None: all) get others; `reset_ns` is the time of the
        reset that follows, where it is not the origin of the world's time.
        """
        if not self.terms:
            return
        from neurosim_core.sensors.event_noise import make_model

        self._seeds = [*seeds]
        models = [*self.models] or [None] * len(seeds)
        for world in range(len(seeds)) if worlds is None else worlds:
            models[world] = make_model(
                self._configs[world],
                pixel_count=self.shape[1],
                seed=seeds[world],
                sensor=self._sensor,
                device=self._device,
                terms=self.terms,
            )
            models[world].seed = mix_seed(seeds[world], reset_ns)
        self.models = models
        self._upload_models()
        wp.synchronize_device(self._device)  # before what the copies were made of is freed

    def set_reset(self, stamp_ns: int) -> None:
        """Let the noise that follows be that after a reset at a stamp."""
        for model, seed in zip(self.models, self._seeds, strict=True):
            model.seed = mix_seed(seed, stamp_ns)
        if self.models:
            self._upload_models()

    def _upload_models(self) -> None:
        models = wp.array(self.models, dtype=PixelModel, device=self._device)
        if self._models is None:
            self._models = models
        else:
            wp.copy(self._models, models)  # graphs hold this array

    def begin_noise(self, mask: wp.array[wp.int32], slot: int) -> None:
        """Let what pixels remember begin anew where the mask is not 0, in a state of the ring."""
        if self.terms:
            inputs = [self._models, mask, self.ring[slot]]
            wp.launch(self._begin_noise, dim=self.shape, inputs=inputs, device=self._device)

    def launch(
        self,
        stack: Stack,
        before: int,
        after: int,
        *,
        frame_count: int,
        part: int = ALL,
        record_cmd: bool = False,
    ) -> Any:
        """Scan a stack from a state of the ring to another, on all cores of a CPU.

        With `record_cmd`, on CUDA, the launch is returned in place of launched.
        """
        extents = self._extents()
        for extent in extents:
            extent.frame_count, extent.part = frame_count, part
        if record_cmd:
            return self._launch(stack, before, after, extents[0], record_cmd=True)
        share(lambda extent: self._launch(stack, before, after, extent), extents)

    def _extents(self) -> list[Any]:
        """Return what each core scans: some pixels of the only world, or some worlds."""
        parts = self.slot_count if self._split_pixels else min(core_count(), self.shape[0])
        extents = []
        for part in range(parts if self._device.is_cpu else 1):
            extent: Any = event_scan.Extent()
            extent.world_count, extent.end_pixel = self.shape
            if self._split_pixels:
                extent.first_slot = part
                extent.first_pixel, extent.end_pixel = self._pixel_bounds[part : part + 2]
            elif self._device.is_cpu:
                first, end = (self.shape[0] * edge // parts for edge in (part, part + 1))
                extent.first_world, extent.world_count = first, end - first
            extents.append(extent)
        return extents

    def _launch(self, stack: Stack, before: int, after: int, extent: Any, *, record_cmd: bool = False) -> Any:
        state, next_state = self.ring[before], self.ring[after]
        pixel_count = extent.end_pixel - extent.first_pixel
        if self.screened:
            wp.launch(
                event_scan.screen,
                dim=(extent.world_count, -(-pixel_count // int(event_scan.TILE_SIZE))),
                inputs=[self.thresholds, extent, stack, state],
                outputs=[*self._quiet_range, self._quiet_count],
                device=self._device,
            )
        block = int(BLOCK_SIZE) if self._device.is_cuda else 1
        own, quiet = (self._models, []) if self.terms else (self.thresholds, [self._quiet_count])
        return wp.launch(
            self._scan,
            dim=(extent.world_count, -(-pixel_count // block) * block),  # whole blocks reserve slots together
            block_dim=BLOCK_SIZE,
            inputs=[own, self.layout, extent, *quiet, state, stack, next_state],
            device=self._device,
            record_cmd=record_cmd,
        )

    def _empty(self, shape: tuple[int, ...], dtype: Any) -> Any:
        return wp.empty(shape, dtype=dtype, device=self._device)


@dataclass(eq=False)
class Scan:
    """The scan of one stack of frames, and buffers: they are its own until its events have been taken over.

    Keys that are written to where they stay are not: other scans and the camera know that buffer.
    """

    number: int
    """Its own for ever: a graph may be made of its buffers."""
    stack: Any
    """The input of its kernels, a `Stack`."""
    done: Fence
    inputs: HostInput
    counters_on_host: HostCopy
    keys: wp.array[wp.int64]
    """Where keys go, of one slot after the other."""
    counters: NDArray[np.int64]
    """Of the inputs: the counters of each slot, as they begin."""
    times: NDArray[np.int64]
    """Of the inputs: time from the reset to the origin [ns]; then stamps of the state and of each frame, from
    the origin [ns]."""
    first_key: int = 0
    """Offset of its keys, behind those of others."""
    frames: Any = None
    """Shape [frame, row, column]; None: those of the last stack have been given back."""
    stamps_ns: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    origin_us: int = 0
    """Origin of its keys' time."""
    state: int = 0
    """Where in the ring the state before it is; the state after it comes next."""

    def begin(self) -> None:
        """Have each slot count from its first key on; the next launch brings it to the device."""
        self.counters[:, 0], self.counters[:, 1:] = self.first_key, 0

    @property
    def room(self) -> int:
        """For how many keys of a slot there is room."""
        return int(self.keys.shape[0]) // len(self.counters)

    def has_room(self, counts: Sequence[int]) -> bool:
        """Return whether all events were written, of which each slot has so many."""
        return self.first_key + max(counts) <= self.room


class Pixels:
    """The pixels of one camera that is fed stacks.

    `states` has one more than scans may be under way.
    """

    def __init__(self, states: PixelStates, *, width: int, height: int, device: Any) -> None:
        self.states = states
        self._width, self._height = width, height
        self._device = device
        self._all = wp.ones(1, dtype=wp.int32, device=device)
        self._key_room = keys_at_first(width * height, device)
        self._scan_number = itertools.count()

    def reset(self, log_radiance: wp.array2d[wp.float32], stamp_ns: int) -> None:
        """Make a frame every pixel's reference; the first state of the ring is the one that follows."""
        first: Any = self.states.ring[0]
        wp.copy(first.base.flatten(), log_radiance.flatten())
        wp.copy(first.last, first.base)
        first.crossed.zero_()
        self.states.set_reset(stamp_ns)
        self.states.begin_noise(self._all, 0)

    def next_state(self, state: int) -> int:
        """Return where in the ring the state after another is."""
        return (state + 1) % len(self.states.ring)

    def make_scan(self, frame_count: int, *, keys: wp.array[wp.int64] | None = None) -> Scan:
        """Return buffers for stacks of at most so many frames; keys of one slot go to `keys`, if given."""
        slots = self.states.slot_count
        first_time = slots * _COUNTERS_ROOM
        inputs = HostInput(wp.zeros(first_time + frame_count + 2, dtype=wp.int64, device=self._device))
        stack = make_stack(1, frame_count, self._height, self._device)
        stack.overflow = self._all
        stack.counters = inputs.array[:first_time].reshape((slots, _COUNTERS_ROOM))
        stack.since_reset_ns = inputs.array[first_time : first_time + 1]
        stack.stamps = inputs.array[first_time + 1 :].reshape((1, -1))
        return Scan(
            number=next(self._scan_number),
            stack=stack,
            done=Fence(self._device),
            inputs=inputs,
            counters_on_host=HostCopy(stack.counters),
            keys=self._empty(self._key_room) if keys is None else keys,
            counters=inputs.rows[:first_time].reshape(slots, _COUNTERS_ROOM),
            times=inputs.rows[first_time:],
        )

    def make_room(self, scan: Scan) -> None:
        """Have as much room for the keys of an idle scan as is expected of scans."""
        if scan.keys.shape[0] < self._key_room:
            scan.keys = self._empty(self._key_room)

    def grow(self, scan: Scan, counts: Sequence[int]) -> None:
        """Make room for the keys that a scan has counted; others get room for twice as many."""
        room = len(counts) << (max(counts) - 1).bit_length()
        scan.keys = self._empty(room)
        self._key_room = max(self._key_room, 2 * room)

    def launch_key(self, scan: Scan) -> Hashable:
        """Return the key of the launches of a scan: same key, same launches (`GraphCache`)."""
        frames = scan.frames.ptr, len(scan.stamps_ns)
        return scan.number, scan.state, *frames, scan.keys.ptr, scan.keys.shape[0]

    def limit_rows(self, scan: Scan, event_count_max: int) -> NDArray[np.int64]:
        """Let a scan keep of each frame the rows from the top that fit; return how many events it loses."""
        scan.stack.table.zero_()
        self.launch(scan, part=COUNT)
        counts = scan.stack.table.numpy()[0, : len(scan.stamps_ns)]
        until = np.cumsum(counts, axis=1, dtype=np.int64)
        fitting = until <= event_count_max
        rows: Any = wp.array(fitting.sum(axis=1), dtype=wp.int32, device=self._device)
        wp.copy(scan.stack.row_limit, rows, count=len(rows))
        lost: NDArray[np.int64] = until[:, -1] - (until * fitting).max(axis=1)
        return lost

    def launch(self, scan: Scan, *, part: int = ALL) -> None:
        """Scan a stack, after `scan.begin`, from the state before it; again, it gives the same one after it.

        With the part COUNT events are only counted, by frame and row, and counters stay as they are.
        """
        refuse_forked_process()
        stack, frames = scan.stack, scan.frames
        stack.keys = scan.keys[: scan.room * len(scan.counters)].reshape((len(scan.counters), scan.room))
        stack.log_radiance = frames.reshape((1, frames.shape[0], self._width * self._height))
        scan.inputs.upload()
        frame_count, after = len(scan.stamps_ns), self.next_state(scan.state)
        self.states.launch(stack, scan.state, after, frame_count=frame_count, part=part)
        scan.counters_on_host.fetch(0, len(scan.counters))

    def _empty(self, count: int) -> wp.array[wp.int64]:
        keys: wp.array[wp.int64] = wp.empty(count, dtype=wp.int64, device=self._device)
        return keys
