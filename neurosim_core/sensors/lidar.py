# mypy: disable-error-code="index,attr-defined,misc,call-overload,operator,assignment,arg-type,valid-type"
# mypy: disable-error-code="no-untyped-def"
# ruff: noqa: SIM102  (nested wp.static branches have a meaning in kernels)
"""LiDAR: points along the rays of a scan, each cast at a time of its own.

A ray finds the range r, the cosine of incidence and the albedo of the surface. The signal of a Lambertian
surface that is wider than the beam is albedo cos / r^2. Where `detection` is set, speckle multiplies it by
exp(s z), z normal, and a ray is lost if it falls below the signal of a target of given reflectivity at its
rated range: so half of the rays are lost there, and dark, far and grazing surfaces are seen less. Then come
Gaussian noise of the range, and its resolution.

Reference: Wagner, Ullrich, Ducic, Melzer, Studnicka (2006), Gaussian decomposition and calibration of a novel
small-footprint full-waveform digitising airborne laser scanner, eq. (3), for the signal.
"""

# No `from __future__ import annotations`: Warp needs the annotations of kernels in closures as objects.

import functools
from statistics import NormalDist
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
import warp as wp
from numpy.typing import NDArray
from pydantic import Field, model_validator

from neurosim_core.clock import NS_PER_S
from neurosim_core.packets import PointCloud
from neurosim_core.random import normal4, random_bits, stream_id
from neurosim_core.registry import register
from neurosim_core.render.launch import kernel_variant
from neurosim_core.render.ray_times import SweepTiming
from neurosim_core.sensors.base import PictureContext, PictureSensorConfig
from neurosim_core.sensors.lidar_scans import AnyScan, SpinningScan
from neurosim_core.sensors.pixel_process import Batch, PixelProcess, element_of
from neurosim_core.settings import BaseConfig, fill_from_preset
from neurosim_core.settings_file import read_table

NonNegative = Annotated[float, Field(ge=0.0)]
_RAY = np.complex128  # the four numbers of a ray as one: NumPy moves those three times as fast
_NEVER = -10.0  # |z| is at most 5.77


@functools.cache
def lidar_presets() -> dict[str, dict[str, Any]]:
    """Return the settings of each preset: the table `lidar_presets.yaml`, with all rings."""
    presets = {}
    for name, preset in read_table(__file__, "lidar_presets").items():
        scan = dict(preset["scan"])
        if (rings := scan.pop("elevations_deg", None)) is not None:
            scan["elevations_rad"] = np.radians(np.linspace(*rings)).round(6).tolist()
        presets[name] = {**preset, "scan": scan}
    return presets


class DetectionConfig(BaseConfig):
    """Signal-dependent detection: which rays return."""

    range_m: Annotated[float, Field(gt=0.0)]
    """Range at which half of the rays return [m], from a surface that faces the sensor."""
    reflectivity: Annotated[float, Field(gt=0.0, le=1.0)] = 0.1
    """Albedo of that surface."""
    speckle: Annotated[float, Field(gt=0.0, le=3.0)] = 0.3
    """Standard deviation of the natural logarithm of the signal."""


@register("sensor", "lidar")
class LidarConfig(PictureSensorConfig):
    """A LiDAR with one return per ray, without errors by default; x of its mount looks forward, z up."""

    kind: Literal["lidar"] = "lidar"
    preset: str | None = None
    """Name of a sensor whose settings apply where none are given here: velodyne_vlp16, ouster_os1_128,
    hesai_xt32, livox_mid40 (sources in lidar_presets.yaml)."""
    scan: AnyScan = SpinningScan(elevations_rad=tuple(round(-0.26 + 0.52 * k / 15.0, 6) for k in range(16)))
    """Directions and times of the rays: {kind: spinning, elevations_rad: [...], columns: 1024}, {kind:
    pattern, file: rays.npy}, {kind: rosette, ...}."""
    rate_hz: Annotated[float, Field(gt=0.0, le=1e4)] = 10.0
    """Sweep rate [Hz]."""
    sweep_s: NonNegative | None = None
    """Time from the first ray of a sweep to the last, which is cast at the stamp [s]; null: that of the scan,
    one period for a spinning one; 0: all rays at once."""
    deskew: bool = False
    """Whether all points are relative to the sensor's pose at the stamp; false: each point is relative to the
    pose at which its ray was cast, as in real sensors."""
    range_min_m: NonNegative = 0.1
    """Smallest measured range [m]."""
    range_max_m: Annotated[float, Field(gt=0.0)] = 100.0
    """Largest measured range [m]."""
    range_noise_m: NonNegative = 0.0
    """Standard deviation of the range, independent of the range [m]."""
    range_noise_ratio: NonNegative = 0.0
    """Standard deviation per metre of range; the two add as the root of the sum of squares."""
    range_resolution_m: NonNegative = 0.0
    """Quantisation step of the range [m]; 0: continuous."""
    detection: DetectionConfig | None = None
    """Loss of rays with little signal: {range_m: 100, reflectivity: 0.1, speckle: 0.3}; null: none."""
    dropout_probability: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.0
    """Probability that a ray is lost, whatever it hits."""

    packet_type = PointCloud
    output: ClassVar[str] = "returns"

    @model_validator(mode="before")
    @classmethod
    def _fill_from_preset(cls, given: Any) -> Any:
        return fill_from_preset(given, lidar_presets())

    @model_validator(mode="after")
    def _ranges_and_times_are_in_order(self) -> "LidarConfig":
        if self.range_min_m >= self.range_max_m:
            raise ValueError(
                f"range_min_m must be below range_max_m = {self.range_max_m:g}, got {self.range_min_m:g}"
            )
        if not self.span_s * self.rate_hz <= 1.0 + 1e-9:
            raise ValueError(
                f"a sweep takes {self.span_s:g} s, longer than 1 / rate_hz = {1 / self.rate_hz:g}"
            )
        return self

    @property
    def span_s(self) -> float:
        """Time from the first ray of a sweep to the last [s]."""
        return self.scan.span_s(1.0 / self.rate_hz) if self.sweep_s is None else self.sweep_s

    @property
    def optics(self) -> Any:
        """The scan."""
        return self.scan

    @property
    def timing(self) -> SweepTiming | None:
        """When rays are cast; None: all at the stamp."""
        return SweepTiming(round(self.span_s * NS_PER_S)) if self.span_s > 0.0 else None

    def make_process(self, context: PictureContext) -> PixelProcess:
        """Return what makes points of what rays find: x, y, z [m] and intensity, vec4, shape [M, H, W]."""
        model = _Model()
        model.stream = stream_id(f"{context.name}/lidar")
        model.range_min, model.range_max = self.range_min_m, self.range_max_m
        model.noise, model.noise_ratio = self.range_noise_m, self.range_noise_ratio
        model.resolution = self.range_resolution_m
        if self.detection is not None:
            model.speckle = self.detection.speckle
            model.signal_min = self.detection.reflectivity / self.detection.range_m**2
        lost = self.dropout_probability
        model.dropout = NormalDist().inv_cdf(lost) if lost > 0.0 else _NEVER
        device, times, rays = context.source.device, context.times, self.scan.ray_table().reshape(-1, 3)
        model.rays = wp.array(rays, dtype=wp.vec3, device=device)
        part = np.zeros(len(rays), np.int32) if times is None else times.instant[0]
        model.part = wp.array(part, dtype=int, device=device)
        terms = self._terms(moving=times is not None)
        return PixelProcess(context, _make_kernel(terms), model, context.source, dtype=wp.vec4, terms=terms)

    def _terms(self, *, moving: bool) -> tuple[str, ...]:
        present = {
            "detection": self.detection is not None,
            "dropout": self.dropout_probability > 0.0,
            "range noise": self.range_noise_m > 0.0 or self.range_noise_ratio > 0.0,
            "resolution": self.range_resolution_m > 0.0,
            "deskew": self.deskew and moving,
        }
        return tuple(term for term, needed in present.items() if needed)

    def packet(self, picture: NDArray[Any], **header: Any) -> PointCloud:
        """Return the points of a sweep, in the order of time; the picture has x, y, z, intensity."""
        span_ns = round(self.span_s * NS_PER_S)
        ring, t = _rings_and_times(self.scan, span_ns)
        in_time = np.ascontiguousarray(picture.view(_RAY)[..., 0].T)
        seen = np.flatnonzero(np.isfinite(in_time.view(np.float32).reshape(-1, 4)[:, 0]))
        rows = in_time.ravel().take(seen).view(np.float32).reshape(-1, 4)
        return PointCloud(
            points=rows[:, :3],
            intensity=rows[:, 3],
            ring=ring.take(seen),
            t=t.take(seen),
            start_ns=header["stamp_ns"] - span_ns,
            deskewed=self.deskew,
            **header,
        )


@functools.lru_cache(maxsize=8)
def _rings_and_times(scan: AnyScan, span_ns: int) -> tuple[NDArray[np.uint16], NDArray[np.uint32]]:
    """Return ring and time since the first ray [ns] of all rays of a sweep, column by column."""
    ring = np.tile(np.arange(scan.height, dtype=np.uint16), scan.width)
    return ring, np.rint(scan.fractions().T.ravel() * span_ns).astype(np.uint32)


@wp.struct
class _Model:
    rays: wp.array[wp.vec3]
    part: wp.array[int]  # Which of the times of a sweep each ray has
    stream: wp.uint32
    range_min: float
    range_max: float
    noise: float
    noise_ratio: float
    resolution: float
    signal_min: float
    speckle: float
    dropout: float  # quantile of the normal distribution


@functools.cache
def _make_kernel(terms: tuple[str, ...]) -> Any:
    """Return the kernel that makes points of returns, with what is in `terms`.

    Places of rays that do not come back have intensity 0 and points that are nan.
    """
    draws = bool({"range noise", "detection", "dropout"} & set(terms))

    @kernel_variant(__name__, *terms)
    def measure(
        first: int,
        model: _Model,
        returns: wp.array3d[wp.vec3],
        batch: Batch,
        # Out:
        points_out: wp.array3d[wp.vec4],
    ):
        at = element_of(batch, first + wp.tid())
        if at.slot < 0:
            return
        found = returns[at.slot, at.row, at.col]
        r = found[0]
        signal = found[2] * found[1] / (r * r)
        if wp.static(draws):
            stamp_ns = batch.here.stamps[at.last, 0]
            z = normal4(random_bits(batch.seeds[at.world], model.stream, stamp_ns, at.number))
            if wp.static("detection" in terms):
                signal *= wp.exp(model.speckle * z[1])
                if signal < model.signal_min:
                    r = wp.inf
            if wp.static("dropout" in terms):
                if z[2] < model.dropout:
                    r = wp.inf
            if wp.static("range noise" in terms):
                r += wp.sqrt(model.noise * model.noise + wp.pow(model.noise_ratio * r, 2.0)) * z[0]
        if wp.static("resolution" in terms):
            r = model.resolution * wp.rint(r / model.resolution)
        if not (r >= model.range_min and r <= model.range_max):
            points_out[at.slot, at.row, at.col] = wp.vec4(wp.nan, wp.nan, wp.nan, 0.0)
            return
        p = r * model.rays[at.number]
        if wp.static("deskew" in terms):
            then = at.view * batch.part_count + model.part[at.number]
            p_WC = batch.here.p_WC[then]
            moved = p_WC - batch.here.p_WC[at.last] + wp.quat_rotate(batch.here.q_WC[then], p)
            p = wp.quat_rotate_inv(batch.here.q_WC[at.last], moved)
        points_out[at.slot, at.row, at.col] = wp.vec4(p[2], -p[0], -p[1], signal)

    return measure
