# mypy: disable-error-code="index,attr-defined,misc,operator,arg-type,valid-type,assignment,call-overload"
# mypy: disable-error-code="no-untyped-def"
"""Shared by small sensors: errors of a measurement, delays, dropouts, and a sampler of one kernel.

The engine makes and reads state sensors by `make_sampler` and `sample_packet`, which say by the sensor's name
what the code of one lacks.

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
from collections.abc import Callable, Mapping
from typing import Annotated, Any

import numpy as np
import warp as wp
from numpy.typing import NDArray
from pydantic import Field, model_validator

from neurosim_core.frames import Vector3
from neurosim_core.packets import Packet
from neurosim_core.random import normal2, random_bits, stream_id, uniform2
from neurosim_core.render.launch import kernel_variant
from neurosim_core.sensors.base import RateHz, Sampler, SamplerContext, StateSensorConfig
from neurosim_core.settings import BaseConfig

wp.set_module_options({"enable_backward": False})

NonNegative = Annotated[float, Field(ge=0.0)]
Axes = NonNegative | tuple[NonNegative, NonNegative, NonNegative]
Probability = Annotated[float, Field(ge=0.0, lt=1.0)]

_DROPOUT = 1 << 20


class ErrorConfig(BaseConfig):
    """Errors in the unit of the measurement: one number for all axes, or one per axis; none by default."""

    white: Axes = 0.0
    """Standard deviation of white noise, per sample."""
    walk: Axes = 0.0
    """Random walk of a bias that begins at 0, in the unit / sqrt(s)."""
    markov: Axes = 0.0
    """Standard deviation of a bias that follows a first-order Gauss-Markov process."""
    markov_time_s: Annotated[float, Field(gt=0.0)] = 100.0
    """Correlation time of that process [s]."""
    resolution: Axes = 0.0
    """Quantisation step; 0: continuous."""

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
    walk: wp.vec3d  # Standard deviation of its step from one sample to the next
    markov: wp.vec3d
    decay: wp.float64  # Of the process from one sample to the next
    resolution: wp.vec3d
    stream: wp.uint32


def make_errors(config: ErrorConfig, *, rate_hz: float, name: str) -> Errors:
    """Return errors as kernels read them.

    Args:
        config: The errors, in the unit of what is measured.
        rate_hz: Samples a second [Hz].
        name: Names the random numbers, such as "SENSOR/velocity": two with one name have the same.
    """
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


class LateConfig(StateSensorConfig):
    """Settings of a state sensor with delay and dropouts."""

    rate_hz: RateHz = 100.0
    """Sample rate [Hz]."""
    delay_s: Annotated[float, Field(ge=0.0, le=60.0)] = 0.0
    """Time from the measurement to its delivery at the stamp [s]; a multiple of 1 / rate_hz."""
    dropout_probability: Probability = 0.0
    """Probability that a sample is not delivered."""

    @property
    def delay_count(self) -> int:
        """The delay in samples."""
        return round(self.delay_s * self.rate_hz)

    @model_validator(mode="after")
    def _delay_is_whole(self) -> "LateConfig":
        if abs(self.delay_count - self.delay_s * self.rate_hz) > 1e-6:
            raise ValueError(
                f"delay_s must be a multiple of 1 / rate_hz = {1 / self.rate_hz:g}, got {self.delay_s:g}: "
                "the sensor measures at its ticks only"
            )
        return self


@wp.struct
class Motion:
    """States of all vehicles, shape [world]."""

    position: wp.array[wp.vec3d]
    velocity: wp.array[wp.vec3d]
    orientation: wp.array[wp.quatd]
    body_rate: wp.array[wp.vec3d]
    air_velocity: wp.array[wp.vec3d]


@wp.struct
class Sampling:
    """What kernels of state sensors share; arrays of shape [world]."""

    motion: Motion
    seeds: wp.array[wp.uint64]
    active: wp.array[wp.int32]  # 0: the world is left alone
    sample: wp.array[wp.int64]  # Number of the sample since the reset
    memory: wp.array2d[wp.vec3d]  # Of errors, shape [world, groups * 2]


@functools.cache
def error_adder(terms: tuple[str, ...]) -> Any:
    """Return a Warp function that adds the errors in `terms` to a measurement.

    Its parameters are the errors, the measurement, `Sampling`, the world, and the index of the errors.
    """

    @wp.func
    def add_errors(errors: Errors, value: wp.vec3d, at: Sampling, world: int, group: int) -> wp.vec3d:
        seed = at.seeds[world]
        k = at.sample[world]
        if wp.static("walk" in terms):
            bias = wp.vec3d()
            if k > wp.int64(0):
                bias = at.memory[world, 2 * group] + wp.cw_mul(
                    errors.walk, _normal3(seed, errors.stream, k, 2)
                )
            at.memory[world, 2 * group] = bias
            value += bias
        if wp.static("markov" in terms):
            drift = wp.cw_mul(errors.markov, _normal3(seed, errors.stream, k, 4))
            if k > wp.int64(0):
                fresh = wp.sqrt(wp.float64(1.0) - errors.decay * errors.decay)
                drift = errors.decay * at.memory[world, 2 * group + 1] + fresh * drift
            at.memory[world, 2 * group + 1] = drift
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


@functools.cache
def _reading_kernel(read: Any, terms: tuple[str, ...], is_scalar: bool) -> Any:
    add_errors = error_adder(terms)
    model_type = next(iter(read.input_types.values()))
    dtype = wp.float64 if is_scalar else wp.vec3d

    @kernel_variant(f"{read.module.name}.{read.key}", *terms)
    def measure(
        model: model_type,
        errors: wp.array[Errors],
        at: Sampling,
        slot: int,
        # Out:
        readings_out: wp.array3d[dtype],
    ):
        world = wp.tid()
        if at.active[world] == 0:
            return
        for group in range(errors.shape[0]):
            value = add_errors(errors[group], read(model, at.motion, world, group), at, world, group)
            if wp.static(is_scalar):
                readings_out[group, slot, world] = value[0]
            else:
                readings_out[group, slot, world] = value
        at.sample[world] += wp.int64(1)

    return measure


@wp.kernel
def _lose(
    probability: wp.float64, stream: wp.uint32, at: Sampling, slot: int, came_out: wp.array2d[wp.int32]
):
    world = wp.tid()
    if at.active[world] != 0:
        draw = uniform2(random_bits(at.seeds[world], stream, at.sample[world], _DROPOUT))[0]
        came_out[slot, world] = wp.where(draw < probability, 0, 1)


@wp.kernel
def _restart(mask: wp.array[wp.int32], sample_out: wp.array[wp.int64]):
    world = wp.tid()
    if mask[world] != 0:
        sample_out[world] = wp.int64(0)


@wp.kernel
def _delay(motion: Motion, ring: Motion, length: int, at: Sampling):
    world = wp.tid()
    if at.active[world] == 0:
        return
    k = at.sample[world]
    new = world * length + int(k % wp.int64(length))
    ring.position[new] = motion.position[world]
    ring.velocity[new] = motion.velocity[world]
    ring.orientation[new] = motion.orientation[world]
    ring.body_rate[new] = motion.body_rate[world]
    ring.air_velocity[new] = motion.air_velocity[world]
    before = wp.max(k - wp.int64(length - 1), wp.int64(0))
    old = world * length + int(before % wp.int64(length))
    at.motion.position[world] = ring.position[old]
    at.motion.velocity[world] = ring.velocity[old]
    at.motion.orientation[world] = ring.orientation[old]
    at.motion.body_rate[world] = ring.body_rate[old]
    at.motion.air_velocity[world] = ring.air_velocity[old]


class StateSampler(Sampler):
    """A state sensor that launches one kernel.

    The kernel's parameters are the inputs, a `Sampling`, the slot, and the output arrays. It must return at
    once if `active` is 0; else it uses the number of the sample and increments it.
    """

    def __init__(
        self,
        context: SamplerContext,
        kernel: Any,
        inputs: tuple[Any, ...],
        packet: Callable[..., Packet | None],
        *,
        outputs: Mapping[str, Any],
        are_stacked: bool = False,
        terms: tuple[str, ...] = (),
        group_count: int = 1,
        late: LateConfig | None = None,
        before: Callable[[], None] | None = None,
    ) -> None:
        """Allocate the arrays.

        Args:
            context: Context of `StateSensorConfig.make`.
            kernel: See above.
            inputs: First parameters of the kernel.
            packet: Function that returns the packet of a sample, from its rows by name and the header; or the
                packet class, if its fields have the names of `outputs`.
            outputs: Warp types of the measurements, by name: each has an array of shape [slot, world];
                (type, n, ...) has one of shape [slot, world, n, ...].
            are_stacked: The kernel writes one array, shape [output, slot, world], in place of one per output.
            terms: Names of optional terms; with any, memory for errors is allocated.
            group_count: Number of groups of errors, of three axes each.
            late: Delay and dropouts; the state before the first sample equals that of the first sample.
            before: Function that launches work before each measurement.
        """
        vehicle = context.vehicle
        self.terms, self._packet, self._before = terms, packet, before
        self._count, self._device = vehicle.count, vehicle.device
        shape = (context.slot_count, self._count)
        if are_stacked:
            written = [self._zeros(next(iter(outputs.values())), len(outputs), *shape)]
            self.arrays = {name: written[0][index] for index, name in enumerate(outputs)}
        else:
            kinds = {name: kind if isinstance(kind, tuple) else (kind,) for name, kind in outputs.items()}
            self.arrays = {name: self._zeros(kind, *shape, *more) for name, (kind, *more) in kinds.items()}
            written = list(self.arrays.values())
        at = Sampling()
        at.seeds, at.active = context.seeds, context.active
        at.sample = self._sample = self._zeros(wp.int64, self._count)
        at.memory = self._zeros(wp.vec3d, self._count if terms else 0, 2 * group_count)
        motion = Motion()
        for name in Motion.vars:
            setattr(motion, name, getattr(vehicle.arrays, name))
        at.motion = motion
        self._launches: list[tuple[Any, int | None, Any]] = []
        if late is not None and late.delay_count:
            length = late.delay_count + 1
            ring, at.motion = self._motion(length), self._motion(1)
            self._add(_delay, motion, ring, length, at)
        if late is not None and late.dropout_probability > 0.0:
            stream = wp.uint32(stream_id(f"{context.name}/lost"))
            received = self._zeros(wp.int32, *shape)
            self._add(_lose, late.dropout_probability, stream, at, 0, received, slot_at=3)
            self.arrays |= {"received": received}
        self._add(kernel, *inputs, at, 0, *written, slot_at=len(inputs) + 1)

    def _zeros(self, dtype: Any, *shape: int) -> Any:
        return wp.zeros(shape, dtype=dtype, device=self._device)

    def _motion(self, length: int) -> Any:
        """Return a motion of as many states of each vehicle, one after the other."""
        motion = Motion()
        for name, kind in Motion.vars.items():
            setattr(motion, name, self._zeros(kind.type.dtype, self._count * length))
        return motion

    def _add(self, kernel: Any, *parameters: Any, slot_at: int | None = None) -> None:
        """Add a launch to each measurement, of which a parameter is the slot; it keeps its parameters."""
        launch = wp.launch(
            kernel, dim=self._count, inputs=list(parameters), device=self._device, record_cmd=True
        )
        self._launches.append((launch, slot_at, parameters))

    def measure(self, slot: int) -> None:
        """Measure all vehicles at their present state."""
        if self._before is not None:
            self._before()
        for launch, slot_at, _ in self._launches:
            if slot_at is not None:
                launch.set_param_at_index(slot_at, slot)
            launch.launch()

    def packet(self, rows: Mapping[str, NDArray[Any]], **header: Any) -> Packet | None:
        """Return one sample as a packet; None: the sample is lost."""
        values = {name: row if np.ndim(row) else row.item() for name, row in rows.items()}
        if not values.pop("received", True):
            return None
        return self._packet(**values, **header)

    def reset(self, mask: Any) -> None:
        """Begin again at sample 0 in some worlds: the kernel then takes nothing from its memory."""
        wp.launch(_restart, dim=mask.shape[0], inputs=[mask], outputs=[self._sample], device=self._device)


def make_reader(
    context: SamplerContext,
    read: Any,
    model: Any,
    errors: Mapping[str, ErrorConfig],
    packet: Callable[..., Packet | None],
    *,
    rate_hz: float,
    is_scalar: bool = False,
    late: LateConfig | None = None,
) -> StateSampler:
    """Return a sampler that calls a Warp function for each vehicle and adds errors.

    Args:
        context: Context of `StateSensorConfig.make`.
        read: A Warp function of the model, `Motion`, the index of the world and the index of an output; it
            returns a vec3d.
        model: First argument of `read`, of its Warp type.
        errors: Errors of each output, by name, in the order of their indices.
        packet: Packet class, or function that returns the packet of a sample; see `StateSampler`.
        rate_hz: Samples a second [Hz].
        is_scalar: Outputs are float64, the first number of the vec3d, in place of vec3d.
        late: Delay and dropouts; see `StateSampler`.
    """
    if not isinstance(read, wp.Function):
        raise TypeError(f"sensor {context.name!r}: it must read by a Warp function (@wp.func), got {read!r}")
    for each in errors.values() if is_scalar else ():
        for key in ("white", "walk", "markov", "resolution"):
            if isinstance(value := getattr(each, key), tuple):
                raise ValueError(f"sensor {context.name!r}: {key} must be one number, got {list(value)}")
    made = [
        make_errors(each, rate_hz=rate_hz, name=f"{context.name}/{name}") for name, each in errors.items()
    ]
    terms = tuple(dict.fromkeys(term for each in errors.values() for term in each.terms()))
    return StateSampler(
        context,
        _reading_kernel(read, terms, is_scalar),
        (model, wp.array(made, dtype=Errors, device=context.vehicle.device)),
        packet,
        outputs=dict.fromkeys(errors, wp.float64 if is_scalar else wp.vec3d),
        are_stacked=True,
        terms=terms,
        group_count=len(errors),
        late=late,
    )


def make_sampler(config: StateSensorConfig, context: SamplerContext) -> Sampler:
    """Make a state sensor and check its arrays.

    Raises:
        TypeError: It has no arrays.
        ValueError: An array has a wrong shape.
    """
    made, shape = config.make(context), (context.slot_count, context.vehicle.count)
    arrays = getattr(made, "arrays", None)
    if not isinstance(arrays, Mapping):
        raise TypeError(
            f"sensor {context.name!r}: {type(made).__qualname__} must set `self.arrays`, its measurements "
            f"by name: device arrays of shape [slot, world, ...], here {shape}; got {arrays!r}"
        )
    for field, array in arrays.items():
        if tuple(array.shape[:2]) != shape:
            raise ValueError(
                f"sensor {context.name!r}: arrays[{field!r}] needs shape [slot, world, ...], here "
                f"{shape}, got {tuple(array.shape)}: (context.slot_count, context.vehicle.count, ...)"
            )
    return made


class _Rows(dict[str, NDArray[Any]]):
    """The rows of a sample; the error of a missing row lists the known ones."""

    sensor = ""

    def __missing__(self, key: str) -> NDArray[Any]:
        raise KeyError(f"sensor {self.sensor!r}: no array {key!r} was measured, known: {sorted(self)}")


def sample_packet(
    sampler: Sampler, rows: Mapping[str, NDArray[Any]], *, stamp_ns: int, sequence: int, sensor: str
) -> Packet | None:
    """Return one sample of a state sensor as a packet, and check that it has the header.

    Raises:
        KeyError: It asks for an array that it does not measure.
        TypeError: It gives something else than a packet.
        ValueError: The packet has not the header that it was given.
    """
    known = _Rows(rows)
    known.sensor = sensor
    packet = sampler.packet(known, stamp_ns=stamp_ns, sequence=sequence, sensor=sensor)
    if packet is None:
        return None
    if not isinstance(packet, Packet):
        raise TypeError(f"sensor {sensor!r}: packet() must return a packet or None, got {packet!r:.80}")
    if packet.sensor != sensor:
        raise ValueError(
            f"sensor {sensor!r}: packet() must pass the header on: {type(packet).__qualname__}(..., **header)"
        )
    return packet
