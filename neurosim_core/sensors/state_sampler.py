# mypy: disable-error-code="index,attr-defined,misc,operator,arg-type,valid-type,assignment,call-overload"
# mypy: disable-error-code="no-untyped-def,no-untyped-call,no-any-return,untyped-decorator"
"""What small sensors share: errors of a measurement, delays, and a sampler of one kernel.

Errors are added per axis: a random walk from 0, a first-order Gauss-Markov process that is stationary from
the first sample on, white noise, and rounding. They are addressed by seed, name and number of the sample
since the reset, so that they depend on nothing else.

Reference: IEEE Std 952-1997, annex C, for their Allan variances over averaging times T of samples dt apart:
N^2 dt / T (white), K^2 T / 3 (walk, T >> dt), and of a Gauss-Markov process of time c, s^2 (2 c / T)
(1 - c / (2 T) (3 - 4 e^(-T/c) + e^(-2T/c))).
"""

# No `from __future__ import annotations`: Warp needs the annotations of functions in closures as objects.

import functools
import math
from collections.abc import Mapping
from typing import Annotated, Any

import numpy as np
import warp as wp
from numpy.typing import NDArray
from pydantic import Field

from neurosim_core.frames import Vector3
from neurosim_core.random import normal2, random_bits, stream_id, uniform2
from neurosim_core.sensors.base import Sampler, SamplerContext
from neurosim_core.settings import Settings

wp.set_module_options({"enable_backward": False})

NonNegative = Annotated[float, Field(ge=0.0)]
Axes = NonNegative | tuple[NonNegative, NonNegative, NonNegative]
Probability = Annotated[float, Field(ge=0.0, lt=1.0)]

_DROPOUT = 1 << 20
_MOTION = ("position", "velocity", "orientation", "body_rate", "air_velocity")


class ErrorConfig(Settings):
    """Errors of what is measured, in its unit: one number for all axes, or one for each; none by default."""

    white: Axes = 0.0
    """Standard deviation of a sample."""
    walk: Axes = 0.0
    """Random walk of the bias, from 0, in the unit / sqrt(s)."""
    markov: Axes = 0.0
    """Standard deviation of a bias that comes and goes: a first-order Gauss-Markov process."""
    markov_time_s: Annotated[float, Field(gt=0.0)] = 100.0
    """Its correlation time [s]."""
    resolution: Axes = 0.0
    """Step between values; 0: continuous."""

    def terms(self) -> tuple[str, ...]:
        """Return which errors there are."""
        return tuple(
            name for name in ("white", "walk", "markov", "resolution") if any(axes(getattr(self, name)))
        )


def axes(value: Any) -> Vector3:
    """Return a setting of one number, or of three, as three."""
    return (value, value, value) if isinstance(value, float | int) else tuple(value)


@wp.struct
class Errors:
    """Errors of one group of three axes; see `ErrorConfig`."""

    white: wp.vec3d
    walk: wp.vec3d
    """Standard deviation of its step from one sample to the next."""
    markov: wp.vec3d
    decay: wp.float64
    """Of the process from one sample to the next."""
    resolution: wp.vec3d
    stream: wp.uint32


def make_errors(config: ErrorConfig, *, rate_hz: float, name: str) -> Errors:
    """Return errors as kernels read them; `name` is that of the sensor and of what is measured."""
    errors = Errors()
    errors.white = wp.vec3d(*axes(config.white))
    errors.walk = wp.vec3d(*(value / math.sqrt(rate_hz) for value in axes(config.walk)))
    errors.markov = wp.vec3d(*axes(config.markov))
    errors.decay = wp.float64(math.exp(-1.0 / (rate_hz * config.markov_time_s)))
    errors.resolution = wp.vec3d(*axes(config.resolution))
    errors.stream = wp.uint32(stream_id(name))
    return errors


@wp.func
def _normal3(seed: wp.uint64, stream: wp.uint32, k: wp.int64, element: int) -> wp.vec3d:
    a = normal2(random_bits(seed, stream, k, element))
    b = normal2(random_bits(seed, stream, k, element + 1))
    return wp.vec3d(a[0], a[1], b[0])


@functools.cache
def error_adder(terms: tuple[str, ...]) -> Any:
    """Return the function that adds errors to a measurement, those in `terms`.

    Its parameters: the errors; the seed; the number k of the sample; the measurement; `memory`, vec3d of
    shape [world, groups * 2], the world, and the group.
    """

    @wp.func
    def add_errors(
        errors: Errors,
        seed: wp.uint64,
        k: wp.int64,
        value: wp.vec3d,
        memory: wp.array2d[wp.vec3d],
        world: int,
        group: int,
    ) -> wp.vec3d:
        if wp.static("walk" in terms):
            bias = wp.vec3d()
            if k > wp.int64(0):
                bias = memory[world, 2 * group] + wp.cw_mul(errors.walk, _normal3(seed, errors.stream, k, 2))
            memory[world, 2 * group] = bias
            value += bias
        if wp.static("markov" in terms):
            drift = wp.cw_mul(errors.markov, _normal3(seed, errors.stream, k, 4))
            if k > wp.int64(0):
                fresh = wp.sqrt(wp.float64(1.0) - errors.decay * errors.decay)
                drift = errors.decay * memory[world, 2 * group + 1] + fresh * drift
            memory[world, 2 * group + 1] = drift
            value += drift
        if wp.static("white" in terms):
            value += wp.cw_mul(errors.white, _normal3(seed, errors.stream, k, 0))
        if wp.static("resolution" in terms):
            for axis in range(3):
                step = errors.resolution[axis]
                if step > wp.float64(0.0):
                    value[axis] = step * wp.rint(value[axis] / step)
        return value

    return add_errors


@wp.func
def is_lost(seed: wp.uint64, stream: wp.uint32, k: wp.int64, probability: wp.float64) -> bool:
    """Return whether a sample is lost, with a probability."""
    return uniform2(random_bits(seed, stream, k, _DROPOUT))[0] < probability


@wp.kernel
def _restart(
    # In:
    mask: wp.array[wp.int32],
    # Out:
    sample_out: wp.array[wp.int64],
) -> None:
    world = wp.tid()
    if mask[world] != 0:
        sample_out[world] = wp.int64(0)


@wp.struct
class Motion:
    """States of all vehicles, shape [world]."""

    position: wp.array[wp.vec3d]
    velocity: wp.array[wp.vec3d]
    orientation: wp.array[wp.quatd]
    body_rate: wp.array[wp.vec3d]
    air_velocity: wp.array[wp.vec3d]


@wp.kernel
def _delay(
    # In:
    motion: Motion,
    sample: wp.array[wp.int64],
    active: wp.array[wp.int32],
    # In/out:
    ring: wp.array3d[wp.float64],
    # Out:
    delayed: Motion,
) -> None:
    world = wp.tid()
    if active[world] == 0:
        return
    k = sample[world]
    length = wp.int64(ring.shape[1])
    at = int(k % length)
    for axis in range(3):
        ring[world, at, axis] = motion.position[world][axis]
        ring[world, at, 3 + axis] = motion.velocity[world][axis]
        ring[world, at, 6 + axis] = motion.body_rate[world][axis]
        ring[world, at, 13 + axis] = motion.air_velocity[world][axis]
    for part in range(4):
        ring[world, at, 9 + part] = motion.orientation[world][part]
    at = int(wp.max(k - length + wp.int64(1), wp.int64(0)) % length)
    delayed.position[world] = wp.vec3d(ring[world, at, 0], ring[world, at, 1], ring[world, at, 2])
    delayed.velocity[world] = wp.vec3d(ring[world, at, 3], ring[world, at, 4], ring[world, at, 5])
    delayed.body_rate[world] = wp.vec3d(ring[world, at, 6], ring[world, at, 7], ring[world, at, 8])
    delayed.orientation[world] = wp.quatd(
        ring[world, at, 9], ring[world, at, 10], ring[world, at, 11], ring[world, at, 12]
    )
    delayed.air_velocity[world] = wp.vec3d(ring[world, at, 13], ring[world, at, 14], ring[world, at, 15])


class StateSampler(Sampler):
    """A state sensor of one kernel.

    The kernel's parameters are a model, `Motion`, then seeds, active, sample, memory, the slot, and one array
    of shape [slot, world] for each output. It returns at once where `active` is 0; else it uses the sample's
    number and increments it.
    """

    def __init__(
        self,
        context: SamplerContext,
        kernel: Any,
        model: Any,
        *,
        outputs: Mapping[str, Any],
        terms: tuple[str, ...] = (),
        group_count: int = 1,
        delay_count: int = 0,
        further: tuple[Any, ...] = (),
    ) -> None:
        """Allocate what it needs.

        Args:
            context: What it is made for.
            kernel: See above.
            model: Its first parameter.
            outputs: Names and types of what it measures.
            terms: What is computed.
            group_count: Groups of errors of three axes.
            delay_count: It measures the state of so many samples before; before the first, that one.
            further: Parameters of the kernel after `model`.
        """
        vehicle, device = context.vehicle, context.vehicle.device
        count = vehicle.count
        self.terms = terms
        self.arrays = {
            name: wp.zeros((context.slot_count, count), dtype=dtype, device=device)
            for name, dtype in outputs.items()
        }
        self._sample = wp.zeros(count, dtype=wp.int64, device=device)
        memory = wp.zeros((count if terms else 0, 2 * group_count), dtype=wp.vec3d, device=device)
        motion = Motion()
        for name in _MOTION:
            setattr(motion, name, getattr(vehicle.arrays, name))
        self._delay: Any = None
        if delay_count:
            ring = wp.zeros((count, delay_count + 1, 16), dtype=wp.float64, device=device)
            delayed = Motion()
            for name in _MOTION:
                setattr(delayed, name, wp.zeros_like(getattr(motion, name)))
            self._delay = wp.launch(
                _delay,
                dim=count,
                inputs=[motion, self._sample, context.active, ring, delayed],
                device=device,
                record_cmd=True,
            )
            motion = delayed
        inputs = [model, *further, motion, context.seeds, context.active, self._sample, memory]
        self._slot_parameter = len(inputs)
        self._launch: Any = wp.launch(
            kernel,
            dim=count,
            inputs=[*inputs, 0],
            outputs=list(self.arrays.values()),
            device=device,
            record_cmd=True,
        )

    def measure(self, slot: int) -> None:
        """Measure all vehicles at their present state."""
        if self._delay is not None:
            self._delay.launch()
        self._launch.set_param_at_index(self._slot_parameter, slot)
        self._launch.launch()

    def reset(self, mask: Any) -> None:
        """Begin again at sample 0 in some worlds: the kernel then takes nothing from its memory."""
        wp.launch(
            _restart, dim=mask.shape[0], inputs=[mask], outputs=[self._sample], device=self._sample.device
        )


def delay_count(delay_s: float, rate_hz: float) -> int:
    """Return how many samples a delay is.

    Raises:
        ValueError: It is no whole number of samples.
    """
    count = round(delay_s * rate_hz)
    if abs(count - delay_s * rate_hz) > 1e-6:
        raise ValueError(
            f"delay_s must be a multiple of 1 / rate_hz = {1 / rate_hz:g}, got {delay_s:g}: samples are of "
            "states at ticks of the sensor"
        )
    return count


def numbers(rows: Mapping[str, NDArray[Any]], name: str) -> NDArray[np.float64]:
    """Return a vector of a sample."""
    return np.array(rows[name], dtype=np.float64)
