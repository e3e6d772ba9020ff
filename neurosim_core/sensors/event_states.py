# mypy: disable-error-code="index,attr-defined,misc,var-annotated,call-overload"
"""The pixels of one event camera in some worlds: their states, in a ring, and the scans between them."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any

import warp as wp

from neurosim_core.sensors import event_kernels
from neurosim_core.sensors.event_config import EventCameraConfig
from neurosim_core.sensors.event_levels import SUB_BITS
from neurosim_core.sensors.event_noise import PixelNoise
from neurosim_core.sensors.event_noise_model import CAUSE, CAUSE_BITS, Memory, PixelModel
from neurosim_core.sensors.event_noise_pixel import make_begin, signal_terms
from neurosim_core.sensors.event_scan import BLOCK_SIZE


class PixelStates:
    """The states of pixels; those of a scan and of the one after it are two of the ring.

    Attributes:
        base: Log radiance of the reset, shape [world, pixel].
        last: Last sample, for each state of the ring; likewise `crossed`, the levels crossed.
        thresholds: Upwards and downwards, of ideal pixels, device array of vec2d, shape [world].
        row_shift: Bits of a key below its row; likewise `time_shift`, below its microseconds.
        terms: What is compiled in beyond ideal pixels: some of `event_noise_model.TERMS`.
        noise: What is not ideal, of each world; empty: nothing.
        screened: Frames that are quiet are skipped first, as is fast on a CPU.
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
    ) -> None:
        self._configs, self._sensor, self._device = list(configs), sensor, device
        self.terms = tuple(terms)
        self.row_shift = SUB_BITS + (CAUSE_BITS if CAUSE in self.terms else 0) + (width - 1).bit_length()
        self.time_shift = self.row_shift + (height - 1).bit_length() + 1
        self._layout = [width, self.row_shift, self.time_shift]
        shape = (len(configs), width * height)
        ring = range(ring_size)
        self.base = self._empty(shape, wp.float32)
        self.last = [self._empty(shape, wp.float32) for _ in ring]
        self.crossed = [self._empty(shape, wp.vec2i) for _ in ring]
        thresholds = [(config.threshold_on, config.threshold_off) for config in configs]
        self.thresholds = wp.array(thresholds, dtype=wp.vec2d, device=device)
        self.screened = device.is_cpu and not self.terms
        scratch = (shape[0], shape[1] if self.screened else 0)
        self._quiet_range = [self._empty(scratch, wp.float32) for _ in range(2)]
        self._lead = wp.zeros((shape[0], 0 if self.terms else shape[1]), dtype=wp.int32, device=device)
        self.noise: list[PixelNoise] = []
        self._models: Any = None
        self._memories: list[Any] = []
        self._scan: Any = event_kernels.scan
        modules = [event_kernels]
        if self.terms:
            self._scan = event_kernels.make_noisy_scan(frozenset(self.terms))
            self._begin_noise = make_begin(signal_terms(self.terms))
            modules += [self._scan.module, self._begin_noise.module]
            self.seed(seeds)
        for module in modules:
            wp.load_module(module, device=device)

    def seed(self, seeds: Sequence[int], worlds: Collection[int] | None = None, *, reset_ns: int = 0) -> None:
        """Draw what stays in some pixels anew, and let later noise have other seeds; waits for the device.

        Seeds are those of all worlds, of which `worlds` (None: all) get others; `reset_ns` is the time of the
        reset that follows, where it is not the origin of the world's time.
        """
        if not self.terms:
            return

        def draw(world: int) -> PixelNoise:
            noise = PixelNoise(
                self._configs[world],
                pixel_count=self.base.shape[1],
                ring_size=len(self.last),
                seed=seeds[world],
                sensor=self._sensor,
                device=self._device,
                terms=self.terms,
            )
            noise.set_reset(reset_ns)
            return noise

        self.noise = [
            draw(world) if worlds is None or world in worlds else self.noise[world]
            for world in range(len(self._configs))
        ]
        memories: list[Any] = [
            wp.array([each.memories[slot] for each in self.noise], dtype=Memory, device=self._device)
            for slot in range(len(self.last))
        ]
        if self._models is None:
            self._memories = memories
            self._phase_stream = self.noise[0].phase()[0]  # it hangs on the name of the sensor
            random_phase = [each.phase()[1] for each in self.noise]
            self._random_phase = wp.array(random_phase, dtype=wp.bool, device=self._device)
        else:  # graphs hold these arrays
            for array, values in zip(self._memories, memories, strict=True):
                wp.copy(array, values)
        self._upload_models()
        wp.synchronize_device(self._device)  # before what the copies were made of is freed

    def set_reset(self, stamp_ns: int) -> None:
        """Let the noise that follows be that after a reset at a stamp."""
        for each in self.noise:
            each.set_reset(stamp_ns)
        if self.noise:
            self._upload_models()

    def _upload_models(self) -> None:
        models = wp.array([each.model for each in self.noise], dtype=PixelModel, device=self._device)
        if self._models is None:
            self._models = models
        else:
            wp.copy(self._models, models)

    def begin_noise(self, mask: wp.array[wp.int32], slot: int) -> None:
        """Let what pixels remember begin anew where the mask is not 0, in a state of the ring."""
        if self.terms:
            wp.launch(
                self._begin_noise,
                dim=self.base.shape,
                inputs=[self._models, self._phase_stream, self._random_phase, mask, self.base],
                outputs=[self._memories[slot]],
                device=self._device,
            )

    def launch(
        self,
        stack: Any,
        before: int,
        after: int,
        *,
        frame_count: int,
        part: int = event_kernels.ALL,
        worlds: tuple[int, int] | None = None,
        pixels: tuple[int, int] | None = None,
        record_cmd: bool = False,
    ) -> Any:
        """Scan a `Stack` from a state of the ring to another, for some worlds and pixels (None: all)."""
        first_world, end_world = worlds or (0, self.base.shape[0])
        first_pixel, end_pixel = pixels or (0, self.base.shape[1])
        world_count, pixel_count = end_world - first_world, end_pixel - first_pixel
        extent = [first_world, first_pixel, end_pixel, frame_count]
        if self.screened:
            wp.launch(
                event_kernels.screen,
                dim=(world_count, -(-pixel_count // int(event_kernels.TILE_SIZE))),
                inputs=[self.thresholds, *extent, stack, self.base, self.crossed[before]],
                outputs=[*self._quiet_range, self._lead],
                device=self._device,
            )
        block = int(BLOCK_SIZE) if self._device.is_cuda else 1
        own, lead = (self._models, []) if self.terms else (self.thresholds, [self._lead])
        memory = [[self._memories[slot]] if self.terms else [] for slot in (before, after)]
        return wp.launch(
            self._scan,
            dim=(world_count, -(-pixel_count // block) * block),  # whole blocks reserve slots together
            block_dim=BLOCK_SIZE,
            inputs=[
                own,
                *self._layout,
                *extent,
                part,
                *lead,
                self.base,
                self.last[before],
                self.crossed[before],
                *memory[0],
                stack,
            ],
            outputs=[self.last[after], self.crossed[after], *memory[1]],
            device=self._device,
            record_cmd=record_cmd,
        )

    def _empty(self, shape: tuple[int, ...], dtype: Any) -> Any:
        return wp.empty(shape, dtype=dtype, device=self._device)
