# mypy: disable-error-code="index,attr-defined,misc,call-overload,operator,assignment,arg-type,valid-type"
# mypy: disable-error-code="no-untyped-def"
"""Pictures as a camera makes them: exposure, electrons and their noise, colour filters, bits and a curve.

The electrons of a pixel are full_well gain L, with L the linear radiance times the exposure of the scene, of
which 1 is white: as many as that come, give or take the root of it (shot noise), plus the noise of reading.
They are cut at the full well, divided by it, curved, and rounded to whole numbers.

Automatic exposure looks at the mean logarithm of luma, as photographers do, and moves the logarithm of the
gain towards what would bring it to `target`, by 1 - exp(-dt / lag) from picture to picture; its gain is that
which the pictures before asked for. The first picture of an episode is exposed as if it had been on for long.

Shot noise is Gaussian, as it is to 2 % in its third moment above 100 electrons.

Reference: EMVA 1288 (2021), Standard for characterization of image sensors and cameras, for the linear model.
"""

# No `from __future__ import annotations`: Warp needs the annotations of kernels in closures as objects.

import functools
from typing import Annotated, Any, Literal

import numpy as np
import warp as wp
from numpy.typing import NDArray
from pydantic import Field

from neurosim_core.packets import Packet
from neurosim_core.random import normal4, random_bits, stream_id
from neurosim_core.registry import register
from neurosim_core.render.launch import kernel_variant
from neurosim_core.sensors.base import ImageSensorConfig, PictureContext, PictureViews
from neurosim_core.sensors.pixel_process import Batch, PixelProcess, element_of
from neurosim_core.settings import BaseConfig

NonNegative = Annotated[float, Field(ge=0.0)]
_FIXED = wp.constant(wp.float64(2.0**20))
"""Logarithms are summed in steps of 1e-6, as integers: the sum does not depend on the order."""
_DARKEST = wp.constant(1.0e-6)


class AutoExposureConfig(BaseConfig):
    """Automatic exposure."""

    target: Annotated[float, Field(gt=0.0, lt=1.0)] = 0.18
    """Target of the geometric mean of luma; 1 is white."""
    lag_s: NonNegative = 0.2
    """Time constant of the adaptation [s]."""
    gain_min: Annotated[float, Field(gt=0.0)] = 0.05
    """Smallest gain."""
    gain_max: Annotated[float, Field(gt=0.0)] = 50.0
    """Largest gain."""


@register("sensor", "frame_camera")
class FrameCameraConfig(ImageSensorConfig):
    """A camera with the exposure, noise, colour filter and number format of a real one.

    With the lens and mount of an event camera it shares its pixels: the frames of a DAVIS.
    """

    kind: Literal["frame_camera"] = "frame_camera"
    gain: Annotated[float, Field(gt=0.0)] = 1.0
    """Fixed factor of all light; ignored with `auto_exposure`."""
    auto_exposure: AutoExposureConfig | None = None
    """Automatic exposure: {target: 0.18, lag_s: 0.2}; null: the gain is fixed."""
    full_well_e: Annotated[float, Field(ge=100.0)] = 10000.0
    """Electrons of a white pixel; shot noise is the square root of the electrons."""
    shot_noise: bool = False
    """Whether pixels have shot noise."""
    read_noise_e: NonNegative = 0.0
    """Standard deviation of the read noise [electrons]."""
    color: Literal["rgb", "mono", "bayer_rggb", "bayer_bggr", "bayer_gbrg", "bayer_grbg"] = "rgb"
    """rgb: all colours at each pixel; mono: luma; bayer_*: one colour at each pixel, by a filter mosaic."""
    bits: Literal[8, 10, 12, 16] = 8
    """Bits of a pixel value; values of 10 and 12 bits are in the upper bits of 16."""
    curve: Literal["srgb", "linear"] | Annotated[float, Field(gt=0.2, lt=5.0)] = "srgb"
    """Transfer curve from light to pixel values: srgb, linear, or a gamma (exponent 1 / gamma)."""

    output = "radiance"
    encoding = "rgb8"

    @property
    def packet_encoding(self) -> str:
        """After the colours and bits of a pixel."""
        return f"{self.color}{8 if self.bits == 8 else 16}"

    @property
    def remembers(self) -> bool:
        """Automatic exposure follows the pictures before."""
        return self.auto_exposure is not None

    def make_process(self, context: PictureContext) -> "FrameProcess":
        """Return what makes frames of radiance."""
        return FrameProcess(self, context)

    def packet(self, picture: NDArray[Any], **header: Any) -> Packet:
        """Return a picture as a packet."""
        channels = 3 if self.color == "rgb" else 1
        if self.bits == 8:
            data = picture[..., :channels].astype(np.uint8)
        else:
            data = picture[..., :channels] << (16 - self.bits)
        return super().packet(data if channels == 3 else data[..., 0], **header)


@wp.struct
class _Model:
    stream: wp.uint32
    gain: float
    target: float
    lag_s: float
    log_gain_min: float
    log_gain_max: float
    full_well: float
    read_noise: float
    top: float
    gamma: float
    filter: wp.vec4i  # Colour of the pixels of a square of 2 x 2


@kernel_variant(__name__, "meter")
def _meter(
    first: int,
    radiance: wp.array3d[wp.vec3],
    batch: Batch,
    # In/out:
    total: wp.array[wp.int64],
) -> None:
    at = element_of(batch, first + wp.tid())
    if at.slot >= 0:
        light = radiance[at.slot, at.row, at.col]
        luma = 0.2126 * light[0] + 0.7152 * light[1] + 0.0722 * light[2]
        logarithm = wp.float64(wp.log(wp.max(luma, _DARKEST)))
        wp.atomic_add(total, at.slot, wp.int64(wp.rint(logarithm * _FIXED)))


@kernel_variant(__name__, "meter")
def _expose(
    first: int,
    model: _Model,
    batch: Batch,
    # In/out:
    total: wp.array[wp.int64],
    log_gain: wp.array[float],
    last_ns: wp.array[wp.int64],
    # Out:
    gain_out: wp.array[float],
) -> None:
    world = first + wp.tid()
    for instant in range(batch.instant_count):
        at = element_of(batch, (world * batch.instant_count + instant) * batch.element_count)
        if at.slot >= 0:
            stamp_ns = batch.here.stamps[at.last, 0]
            mean = float(wp.float64(total[at.slot]) / _FIXED) / float(batch.element_count)
            total[at.slot] = wp.int64(0)
            wanted = wp.clamp(wp.log(model.target) - mean, model.log_gain_min, model.log_gain_max)
            elapsed_s = float(stamp_ns - last_ns[world]) * 1.0e-9
            if last_ns[world] < wp.int64(0) or elapsed_s <= 0.0:  # the first of an episode
                log_gain[world] = wanted
            gain_out[at.slot] = wp.exp(log_gain[world])
            share = 1.0 - wp.exp(-wp.max(elapsed_s, 0.0) / model.lag_s)
            log_gain[world] += share * (wanted - log_gain[world])
            last_ns[world] = stamp_ns


@functools.cache
def _make_kernel(terms: tuple[str, ...], color: str, curve: str) -> Any:
    noisy = bool({"shot noise", "read noise"} & set(terms))

    @wp.func
    def develop(model: _Model, gain: float, light: float, z: float) -> wp.uint16:
        """Return the number of a pixel, of its light and a normal number."""
        electrons = model.full_well * gain * light
        if wp.static(noisy):
            variance = model.read_noise * model.read_noise
            if wp.static("shot noise" in terms):
                variance += wp.max(electrons, 0.0)
            electrons += wp.sqrt(variance) * z
        share = wp.clamp(electrons / model.full_well, 0.0, 1.0)
        if wp.static(curve == "srgb"):
            if share <= 0.0031308:
                share = 12.92 * share
            else:
                share = 1.055 * wp.pow(share, 1.0 / 2.4) - 0.055
        elif wp.static(curve == "gamma"):
            share = wp.pow(share, model.gamma)
        return wp.uint16(int(model.top * share + 0.5))

    @kernel_variant(__name__, *terms, color, curve)
    def make_frame(
        first: int,
        model: _Model,
        radiance: wp.array3d[wp.vec3],
        gain: wp.array[float],
        batch: Batch,
        # Out:
        frame_out: wp.array4d[wp.uint16],
    ):
        at = element_of(batch, first + wp.tid())
        if at.slot < 0:
            return
        light = radiance[at.slot, at.row, at.col]
        factor = model.gain
        if wp.static("auto exposure" in terms):
            factor = gain[at.slot]
        z = wp.vec4()
        if wp.static(noisy):
            stamp_ns = batch.here.stamps[at.last, 0]
            z = normal4(random_bits(batch.seeds[at.world], model.stream, stamp_ns, at.number))
        if wp.static(color == "rgb"):
            for channel in range(3):
                shown = develop(model, factor, light[channel], z[channel])
                frame_out[at.slot, at.row, at.col, channel] = shown
        else:
            one = 0.2126 * light[0] + 0.7152 * light[1] + 0.0722 * light[2]
            if wp.static(color == "bayer"):
                one = light[model.filter[2 * (at.row % 2) + at.col % 2]]
            frame_out[at.slot, at.row, at.col, 0] = develop(model, factor, one, z[0])

    return make_frame


class FrameProcess(PixelProcess):
    """Makes frames of radiance: uint16, shape [M, H, W, 3], or [M, H, W, 1] of one colour at each pixel."""

    def __init__(self, config: FrameCameraConfig, context: PictureContext) -> None:
        auto, source = config.auto_exposure, context.source
        present = {
            "auto exposure": auto is not None,
            "shot noise": config.shot_noise,
            "read noise": config.read_noise_e > 0.0,
        }
        terms = tuple(term for term, needed in present.items() if needed)
        model = self._model = _Model()
        model.stream = stream_id(f"{context.name}/frame")
        model.gain, model.full_well = config.gain, config.full_well_e
        model.read_noise, model.top = config.read_noise_e, float(2**config.bits - 1)
        if auto is not None:
            model.target, model.lag_s = auto.target, max(auto.lag_s, 1e-9)
            model.log_gain_min, model.log_gain_max = np.log(auto.gain_min), np.log(auto.gain_max)
        kind = config.curve if isinstance(config.curve, str) else "gamma"
        model.gamma = 1.0 if isinstance(config.curve, str) else 1.0 / config.curve
        color, _, pattern = config.color.partition("_")
        model.filter = wp.vec4i(*("rgb".index(letter) for letter in pattern or "rrrr"))
        self._world_count = len(context.lens_of_world) if auto is not None else 0
        slots = source.shape[0] if auto is not None else 0
        self._exposure: list[Any] = [
            wp.zeros(slots, dtype=wp.int64, device=source.device),
            wp.zeros(self._world_count, dtype=float, device=source.device),
            wp.full(self._world_count, -1, dtype=wp.int64, device=source.device),
            wp.zeros(slots, dtype=float, device=source.device),
        ]
        """Sum of the logarithms of each picture; logarithm of the next gain and time of the last picture of
        each world; gain of each picture."""
        super().__init__(
            context,
            _make_kernel(terms, color, kind),
            model,
            source,
            self._exposure[-1],
            dtype=wp.uint16,
            shape=(*source.shape, 3 if color == "rgb" else 1),
            terms=terms,
        )

    def launch(self, views: PictureViews) -> None:
        """Make the frames of a batch; launches only."""
        if self._world_count:
            _, source, _ = self._inputs
            self.run(_meter, views, source, outputs=self._exposure[:1])
            self.run(_expose, views, self._model, outputs=self._exposure, dim=self._world_count)
        super().launch(views)
