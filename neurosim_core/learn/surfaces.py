# mypy: disable-error-code="index,attr-defined,misc,arg-type,operator,no-any-return,call-overload,valid-type"
# mypy: disable-error-code="no-untyped-call,no-redef,var-annotated"
"""Event surfaces: the events of a step of many worlds as pictures for a network, on the device.

A surface is [world, channel, row, column], float32 unless told otherwise, written in place by one or two
kernels after each step; nothing is allocated and nothing waits for the device. Sums are of fixed-point
numbers, so that the order in which threads add does not change a bit.
"""

# No `from __future__ import annotations`: Warp needs the annotations of kernels as objects.

from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal

import warp as wp

wp.set_module_options({"enable_backward": False})

_ONE = wp.constant(65536.0)  # of the fixed-point sums: a pixel has room for 32,767 events in a step
_NEVER_US = wp.constant(wp.int64(-(1 << 60)))
_THREADS_ON_CUDA = 256
"""Threads that share the events of a world."""
_DTYPES: dict[str, Any] = {"float32": wp.float32, "float16": wp.float16, "uint8": wp.uint8}


@dataclass(frozen=True, kw_only=True)
class _Shown:
    dtype: Literal["float32", "float16", "uint8"] = "float32"
    """Of the surface. What is remembered from step to step stays float32 or whole microseconds."""

    uint8_levels: ClassVar[tuple[float, float]] = (1.0, 0.0)
    """Levels that 1 and 0 are apart, and level of 0, in uint8: values are rounded, and held in [0, 255]."""

    def __post_init__(self) -> None:
        if self.dtype not in _DTYPES:
            raise ValueError(f"dtype must be {', '.join(_DTYPES)}, got {self.dtype!r}")


@dataclass(frozen=True, kw_only=True)
class _Fading(_Shown):
    tau_s: tuple[float, ...] = (0.01,)
    """Time constants [s]."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.tau_s or not all(0.0 < tau < float("inf") for tau in self.tau_s):
            raise ValueError(f"tau_s must be one or more numbers > 0, got {self.tau_s}")

    @property
    def channel_count(self) -> int:
        """Two for each time constant."""
        return 2 * len(self.tau_s)


@dataclass(frozen=True, kw_only=True)
class TimeSurface(_Fading):
    """exp(-(now - t) / tau) of the last event of each pixel: channels off and on for each tau.

    Reference: Lagorce et al. (2017), "HOTS", eq. (3).
    """

    tau_s: tuple[float, ...] = (0.01, 0.05)
    """Time constants [s]."""
    uint8_levels: ClassVar[tuple[float, float]] = (255.0, 0.0)


@dataclass(frozen=True, kw_only=True)
class LeakySurface(_Fading):
    """The sum of exp(-(now - t) / tau) over all events of a pixel: channels off and on for each tau.

    It shows how recent and how frequent events are.
    """

    uint8_levels: ClassVar[tuple[float, float]] = (16.0, 0.0)


@dataclass(frozen=True, kw_only=True)
class Counts(_Shown):
    """The events of the last step in each pixel: channels off and on."""

    @property
    def channel_count(self) -> int:
        """One for each polarity."""
        return 2


@dataclass(frozen=True, kw_only=True)
class VoxelGrid(_Shown):
    """Polarity (-1, 1) of the events of the last step, shared between the two nearest of B moments of it.

    Moment b is at b / (B - 1) of the step; with one bin all events are in it.

    Reference: Zhu et al. (2019), "Unsupervised Event-based Learning of Optical Flow, Depth, and Egomotion",
    eq. (1-2). With `split` it is an event spike tensor of the measurement 1 and a trilinear kernel, as in
    Gehrig et al. (2019), "End-to-End Learning of Representations for Asynchronous Event-Based Data".
    """

    bins: int = 5
    """B."""
    split: bool = False
    """Channels of their own for each polarity, B off and B on, where each event counts as 1."""

    uint8_levels: ClassVar[tuple[float, float]] = (16.0, 128.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 1 <= self.bins <= 64:
            raise ValueError(f"bins must be in [1, 64], got {self.bins}")

    @property
    def channel_count(self) -> int:
        """One for each bin, or one for each bin and polarity."""
        return self.bins * (2 if self.split else 1)


SurfaceConfig = TimeSurface | LeakySurface | Counts | VoxelGrid
"""What a surface shows."""

SURFACES: dict[str, type[SurfaceConfig]] = {
    "leaky": LeakySurface,
    "time": TimeSurface,
    "counts": Counts,
    "voxels": VoxelGrid,
}
"""Kinds of surfaces by their name on the command line."""


def surface_like(kind: str, surface: SurfaceConfig) -> SurfaceConfig:
    """Return a surface of a kind of `SURFACES`, with the time constants of another one if both have some."""
    made = SURFACES[kind]()
    if isinstance(made, _Fading) and isinstance(surface, _Fading):
        return replace(made, tau_s=surface.tau_s)
    return made


@wp.func
def _as_shown(value: wp.float32, zero: wp.float32, levels: wp.vec2) -> wp.float32:
    return value


@wp.func
def _as_shown(value: wp.float32, zero: wp.float16, levels: wp.vec2) -> wp.float16:
    return wp.float16(value)


@wp.func
def _as_shown(value: wp.float32, zero: wp.uint8, levels: wp.vec2) -> wp.uint8:
    return wp.uint8(int(wp.clamp(wp.rint(value * levels[0] + levels[1]), 0.0, 255.0)))


@wp.kernel
def _note_last(
    # In:
    t: wp.array[wp.int64],
    x: wp.array[wp.uint16],
    y: wp.array[wp.uint16],
    polarity: wp.array[wp.uint8],
    offsets: wp.array[wp.int32],
    stride: int,
    # In/out:
    last_us: wp.array4d[wp.int64],
) -> None:
    world, lane = wp.tid()
    event = offsets[world] + lane
    while event < offsets[world + 1]:
        wp.atomic_max(last_us, world, int(polarity[event]), int(y[event]), int(x[event]), t[event])
        event += stride


@wp.kernel
def _show_last(
    # Model:
    tau_us: wp.array[wp.float32],
    levels: wp.vec2,
    # In:
    last_us: wp.array4d[wp.int64],
    now_ns: wp.array[wp.int64],
    # Out:
    surface_out: wp.array4d[Any],
) -> None:
    world, channel, row, column = wp.tid()
    last = last_us[world, channel % 2, row, column]
    value = wp.float32(0.0)
    if last != _NEVER_US:
        value = wp.exp(-wp.float32(now_ns[world] / wp.int64(1000) - last) / tau_us[channel / 2])
    surface_out[world, channel, row, column] = _as_shown(value, surface_out.dtype(0), levels)


@wp.func
def _add(sums: wp.array4d[wp.int32], world: int, channel: int, row: int, column: int, weight: float) -> None:
    wp.atomic_add(sums, world, channel, row, column, wp.int32(wp.round(weight * _ONE)))


@wp.kernel
def _add_leaky(
    # Model:
    tau_us: wp.array[wp.float32],
    # In:
    t: wp.array[wp.int64],
    x: wp.array[wp.uint16],
    y: wp.array[wp.uint16],
    polarity: wp.array[wp.uint8],
    offsets: wp.array[wp.int32],
    now_ns: wp.array[wp.int64],
    stride: int,
    # In/out:
    sums: wp.array4d[wp.int32],
) -> None:
    world, lane = wp.tid()
    event = offsets[world] + lane
    while event < offsets[world + 1]:
        age_us = wp.float32(now_ns[world] / wp.int64(1000) - t[event])
        for scale in range(tau_us.shape[0]):
            channel = 2 * scale + int(polarity[event])
            _add(sums, world, channel, int(y[event]), int(x[event]), wp.exp(-age_us / tau_us[scale]))
        event += stride


@wp.kernel
def _add_voxels(
    # In:
    t: wp.array[wp.int64],
    x: wp.array[wp.uint16],
    y: wp.array[wp.uint16],
    polarity: wp.array[wp.uint8],
    offsets: wp.array[wp.int32],
    now_ns: wp.array[wp.int64],
    duration_us: float,
    bins: int,
    stride: int,
    # In/out:
    sums: wp.array4d[wp.int32],
) -> None:
    world, lane = wp.tid()
    event = offsets[world] + lane
    while event < offsets[world + 1]:
        sign = 2.0 * float(polarity[event]) - 1.0
        age_us = wp.float32(now_ns[world] / wp.int64(1000) - t[event])
        place = wp.clamp((1.0 - age_us / duration_us) * float(bins - 1), 0.0, float(bins - 1))
        first = wp.min(int(place), bins - 1)
        share = place - float(first)
        channel = int(first)
        if sums.shape[1] > bins:  # polarities are apart
            sign = 1.0
            channel += bins * int(polarity[event])
        _add(sums, world, channel, int(y[event]), int(x[event]), sign * (1.0 - share))
        if first + 1 < bins:
            _add(sums, world, channel + 1, int(y[event]), int(x[event]), sign * share)
        event += stride


@wp.kernel
def _show_sums(
    # Model:
    decay: wp.array[wp.float32],
    levels: wp.vec2,
    stride: int,
    # In/out:
    sums: wp.array2d[wp.int32],
    values: wp.array2d[wp.float32],
    # Out:
    surface_out: wp.array2d[Any],
) -> None:
    plane, lane = wp.tid()  # two axes: with four, CUDA spends more on indices than on sums
    share = decay[plane % decay.shape[0]]
    for pixel in range(lane, sums.shape[1], stride):
        added = sums[plane, pixel]
        if added != 0:
            sums[plane, pixel] = 0
        value = values[plane, pixel] * share + wp.float32(added) / _ONE
        values[plane, pixel] = value
        if surface_out.shape[0] > 0:  # else the values are what is shown
            surface_out[plane, pixel] = _as_shown(value, surface_out.dtype(0), levels)


@wp.kernel
def _forget(
    # In:
    mask: wp.array[wp.int32],
    levels: wp.vec2,
    stride: int,
    # In/out:
    last_us: wp.array4d[wp.int64],
    values: wp.array4d[wp.float32],
    surface: wp.array4d[Any],
    # Out:
    ended_out: wp.array4d[Any],
) -> None:
    world, lane = wp.tid()
    if mask[world] == 0:
        return
    columns = surface.shape[3]
    size = surface.shape[2] * columns
    place = lane
    while place < surface.shape[1] * size:
        channel = place / size
        row = place % size / columns
        column = place % columns
        if world < ended_out.shape[0]:
            ended_out[world, channel, row, column] = surface[world, channel, row, column]
        surface[world, channel, row, column] = _as_shown(0.0, surface.dtype(0), levels)
        if channel < values.shape[1]:
            values[world, channel, row, column] = 0.0
        if channel < last_us.shape[1]:
            last_us[world, channel, row, column] = _NEVER_US
        place += stride


for _dtype in _DTYPES.values():  # all at once: a module is built anew for each that is added later
    _planes, _worlds = wp.array2d(dtype=_dtype), wp.array4d(dtype=_dtype)
    wp.overload(_show_last, {"surface_out": _worlds})
    wp.overload(_show_sums, {"surface_out": _planes})
    wp.overload(_forget, {"surface": _worlds, "ended_out": _worlds})


class EventSurface:
    """The surfaces of one event camera in all worlds.

    `width`: of the sensor [px]. `height`: of the sensor [px]. `step_s`: how long a step is [s]. `keep_ended`:
    keep what `forget` clears.

    Attributes:
        array: The surfaces, of the dtype of the config, shape [N, channel, H, W]; overwritten by `update` and
            `forget`.
        ended: What each showed when it was cleared last, likewise; empty if it is not kept.
    """

    def __init__(
        self,
        config: SurfaceConfig,
        *,
        world_count: int,
        width: int,
        height: int,
        step_s: float,
        device: str,
        keep_ended: bool = False,
    ) -> None:
        self.config = config
        self._device = wp.get_device(device)
        self._step_us = 1e6 * step_s
        self._lanes = _THREADS_ON_CUDA if self._device.is_cuda else 1
        shape = (world_count, config.channel_count, height, width)
        none, dtype = (0, 0, 0, 0), _DTYPES[config.dtype]
        self._levels = wp.vec2(*config.uint8_levels)
        nothing = int(config.uint8_levels[1]) if config.dtype == "uint8" else 0
        self.array: Any = wp.full(shape, value=nothing, dtype=dtype, device=device)
        self.ended: Any = wp.zeros(shape if keep_ended else none, dtype=dtype, device=device)
        tau_us = [1e6 * tau for tau in getattr(config, "tau_s", ())]
        self._tau_us: Any = wp.array(tau_us, dtype=wp.float32, device=device)
        decays = [0.0] * config.channel_count
        if isinstance(config, LeakySurface):
            decays = [2.718281828459045 ** (-self._step_us / tau) for tau in tau_us for _ in range(2)]
        self._decay: Any = wp.array(decays, dtype=wp.float32, device=device)
        is_last = isinstance(config, TimeSurface)
        self._last: Any = wp.full(
            (world_count, 2, height, width) if is_last else none,
            value=wp.int64(-(1 << 60)), dtype=wp.int64, device=device,
        )  # fmt: skip
        self._sums: Any = wp.zeros(none if is_last else shape, dtype=wp.int32, device=device)
        self._values, converted = self.array, wp.zeros((0, 0), dtype=dtype, device=device)
        planes = (world_count * config.channel_count, height * width)
        if is_last or config.dtype != "float32":
            self._values = wp.zeros(none if is_last else shape, dtype=wp.float32, device=device)
            converted = self.array.reshape(planes)
        if not is_last:
            self._flat = [self._sums.reshape(planes), self._values.reshape(planes), converted]

    def update(self, events: Any, now_ns: Any) -> None:
        """Add the events of a step, and show them.

        `events`: of the camera in this step (`sensors.event_worlds.WorldEvents`). `now_ns`: time of each
        world at the end of the step [ns], device array of int64, shape [N].
        """
        self.add(events, now_ns)
        self.show(now_ns)

    def add(self, events: Any, end_ns: Any) -> None:
        """Add events of a part of a step that ends at `end_ns`; `show` shows all that were added."""
        dim = (self.array.shape[0], self._lanes)
        where = [events.x, events.y, events.polarity, events.offsets]
        if isinstance(self.config, TimeSurface):
            self._launch(_note_last, dim, [events.t, *where, self._lanes], [self._last])
        elif isinstance(self.config, LeakySurface):
            self._launch(_add_leaky, dim, [self._tau_us, events.t, *where, end_ns, self._lanes], [self._sums])
        else:  # counts are one bin with polarities apart
            bins = 1 if isinstance(self.config, Counts) else self.config.bins
            inputs = [events.t, *where, end_ns, self._step_us, bins, self._lanes]
            self._launch(_add_voxels, dim, inputs, [self._sums])

    def show(self, now_ns: Any) -> None:
        """Write the surfaces at the end of a step."""
        if isinstance(self.config, TimeSurface):
            self._launch(
                _show_last, self.array.shape, [self._tau_us, self._levels, self._last, now_ns], [self.array]
            )
            return
        count, size = self._flat[0].shape
        stride = -(-size // 4) if self._device.is_cuda else 1
        self._launch(_show_sums, (count, stride), [self._decay, self._levels, stride], self._flat)

    def forget(self, mask: Any) -> None:
        """Clear the surfaces of worlds that begin anew; `mask` is a device array of int32, shape [N]."""
        dim = (self.array.shape[0], self._lanes)
        changed = [self._last, self._values, self.array, self.ended]
        self._launch(_forget, dim, [mask, self._levels, self._lanes], changed)

    def _launch(self, kernel: Any, dim: Any, inputs: list[Any], outputs: list[Any]) -> None:
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self._device)
