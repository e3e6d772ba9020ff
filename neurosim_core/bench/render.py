"""Rendering: error against run time, and the false events that aliasing makes.

Two questions. How far is the log radiance of a picture from that of many samples per pixel, and what does it
cost to come nearer? And when a camera pans slowly over a checkerboard with squares down to a fraction of a
pixel, how many of the events are there only because too few samples were taken?

What was found is in `render_result`, and what is said of it in `render_chapter`.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from neurosim_core.bench.event_matching import match_events, take
from neurosim_core.bench.render_chapter import render_chapter
from neurosim_core.bench.render_result import (
    CHECK_PX,
    DEFAULT,
    POINT,
    REFERENCE,
    PanEvents,
    PictureError,
    RenderResult,
    Sampling,
)
from neurosim_core.packets import EventArrays
from neurosim_core.render.camera import PinholeConfig
from neurosim_core.render.config import LightingConfig, RenderConfig, TextureFilter
from neurosim_core.render.scene_arrays import SceneArrays, upload_scene
from neurosim_core.render.warp_renderer import WarpRenderer
from neurosim_core.scene.apartment import ApartmentConfig, make_apartment
from neurosim_core.scene.freespace import FreeSpaceConfig, make_free_space
from neurosim_core.scene.scene import Ambient, Material, Scene, Texture
from neurosim_core.sensors.events import EventCamera, EventCameraConfig

__all__ = ["checkerboard_floor", "first_pictures", "looking", "measure_render", "render_chapter"]

_FOV_RAD = 1.5
_TEXELS_PER_CHECK = 16
_FLOOR_M = 80.0
_HEIGHT_M = 1.5
_PITCH_RAD = math.radians(40.0)
_PLAIN = RenderConfig(lighting=LightingConfig(mode="unshadowed"), exposure=1.0)  # nothing to prepare


def measure_render(
    *, quick: bool = False, device: str = "auto", progress: Callable[[str], None] | None = None
) -> RenderResult:
    """Render with many settings, and pan over a checkerboard.

    Args:
        quick: Small pictures, few settings, a short pan.
        device: Where to render.
        progress: Told what is measured next.
    """
    tell = progress or (lambda _: None)
    device = ("cuda:0" if wp.get_cuda_device_count() else "cpu") if device == "auto" else device
    lens = _lens(96, 72) if quick else _lens(346, 260)
    pictures: list[PictureError] = []
    for name, make in (("apartment", _apartment), ("checkerboard", _checkerboard)):
        tell(f"the {name}")
        arrays, poses = make(quick, lens, device)
        pictures += _compare(name, arrays, lens, poses, _samplings(quick))
        reference_rms = _reference_error(arrays, lens, poses)  # of the last: the harder one
    tell("a pan over the checkerboard")
    pan_lens = _lens(64, 48) if quick else _lens(173, 130)
    arrays, _ = _checkerboard(quick, pan_lens, device)
    pan = _Pan(seconds=0.2 if quick else 0.5, rate_hz=250.0 if quick else 500.0, speed_px_s=20.0)
    events, false_per_pixel = _measure_pan(pan, arrays, pan_lens, quick)
    return RenderResult(
        device=str(wp.get_device(device).name),
        quick=quick,
        width=lens.width,
        height=lens.height,
        pictures=tuple(pictures),
        reference_rms=reference_rms,
        pan=events,
        pan_width=pan_lens.width,
        pan_height=pan_lens.height,
        pan_s=pan.seconds,
        pan_rate_hz=pan.rate_hz,
        pan_speed_px_s=pan.speed_px_s,
        tolerance_s=pan.tolerance_s,
        false_per_pixel=false_per_pixel,
        views=_views(pan, arrays, pan_lens),
    )


def _lens(width: int, height: int) -> PinholeConfig:
    return PinholeConfig(width=width, height=height, horizontal_fov_rad=_FOV_RAD)


def _samplings(quick: bool) -> list[Sampling]:
    samples = (1, 4) if quick else (1, 2, 4, 8, 16)
    biases = (-2.0, 0.0) if quick else (-2.0, -1.0, 0.0, 1.0, 2.0)
    filters: tuple[TextureFilter, ...] = ("bilinear", "nearest")
    return [
        *(Sampling(samples_per_pixel=n, mip_bias=bias) for bias in biases for n in samples),
        *(Sampling(samples_per_pixel=n, texture_filter=name) for name in filters for n in samples),
    ]


Poses = tuple[NDArray[np.float32], NDArray[np.float32]]
"""p_WC [m], shape [K, 3], and q_WC, xyzw, shape [K, 4]."""


def looking(yaw_rad: float, pitch_rad: float) -> NDArray[np.float64]:
    """Return q_WC of a camera that looks along a yaw, and down by a pitch; xyzw, its picture upright."""
    sy, cy, sp, cp = math.sin(yaw_rad), math.cos(yaw_rad), math.sin(pitch_rad), math.cos(pitch_rad)
    right, down = np.array([sy, -cy, 0.0]), np.array([-sp * cy, -sp * sy, -cp])
    R_WC = np.stack([right, down, np.cross(right, down)], axis=1)
    return np.asarray(Rotation.from_matrix(R_WC).as_quat())


def checkerboard_floor(check_m: float) -> Scene:
    """Return a floor of small squares [m] around the origin, evenly lit."""
    rows, columns = np.indices((2 * _TEXELS_PER_CHECK,) * 2) // _TEXELS_PER_CHECK
    grey = np.where((rows + columns) % 2 == 0, 230, 40).astype(np.uint8)
    texture = Texture(name="checkerboard", srgb=np.repeat(grey[..., None], 3, axis=2))
    half = 0.5 * _FLOOR_M
    corners = np.array([[-half, -half, 0.0], [half, -half, 0.0], [half, half, 0.0], [-half, half, 0.0]])
    return Scene(
        name="checkerboard",
        vertices=corners.astype(np.float32),
        faces=np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32),
        normals=np.tile(np.array([[0.0, 0.0, 1.0]], dtype=np.float32), (4, 1)),
        uv=(corners[:, :2] / (2.0 * check_m)).astype(np.float32),
        face_material=np.zeros(2, dtype=np.int32),
        face_instance=np.zeros(2, dtype=np.int32),
        instance_names=("floor",),
        materials=(Material(name="checkerboard", base_color=(1.0, 1.0, 1.0), texture=texture),),
        ambient=Ambient(up=(1.0, 1.0, 1.0), down=(1.0, 1.0, 1.0)),
    )


def _checkerboard(quick: bool, lens: PinholeConfig, device: str) -> tuple[SceneArrays, Poses]:
    """Return a floor whose squares are 3 pixels wide at the lower border, and smaller further away."""
    steepest_rad = _PITCH_RAD + math.atan(0.5 * lens.height / lens.intrinsics().fy)
    check_m = CHECK_PX / lens.intrinsics().fy * _HEIGHT_M / math.sin(steepest_rad)
    yaws = (0.1,) if quick else (0.1, 0.4, 0.8)
    return upload_scene(checkerboard_floor(check_m), _PLAIN, device), _poses(
        [((0.013, 0.007, _HEIGHT_M), looking(yaw, _PITCH_RAD)) for yaw in yaws]
    )


def _apartment(quick: bool, lens: PinholeConfig, device: str) -> tuple[SceneArrays, Poses]:
    """Return the default apartment and views from places with room around them."""
    scene = make_apartment(ApartmentConfig(rooms=1) if quick else ApartmentConfig())
    space = make_free_space(scene, FreeSpaceConfig(), device=device)
    rng = np.random.default_rng(6)
    low, high = scene.bounds_m
    points = rng.uniform([*low[:2], 0.8], [*high[:2], 1.8], (4000, 3))
    roomy = points[space.clearance(points) > 0.6]
    views = zip(roomy[: 2 if quick else 6], rng.uniform(-np.pi, np.pi, (6, 1)), strict=False)
    config = (
        _PLAIN if quick else RenderConfig(lighting=LightingConfig(ambient_ray_count=4, shadow_ray_count=1))
    )
    return upload_scene(scene, config, device), _poses(
        [(point, looking(yaw.item(), math.radians(10.0))) for point, yaw in views]
    )


def _poses(views: Sequence[tuple[Any, Any]]) -> Poses:
    position, orientation = zip(*views, strict=True)
    return np.array(position, dtype=np.float32), np.array(orientation, dtype=np.float32)


def resampled(arrays: SceneArrays, sampling: Sampling) -> SceneArrays:
    """Return a scene on its device as it is sampled in another way, but for the bias of its levels."""
    full = sampling.texture_filter != "trilinear"
    return dataclasses.replace(
        arrays,
        config=arrays.config.model_copy(update=dataclasses.asdict(sampling)),
        terms=arrays.terms._replace(
            supersampled=sampling.samples_per_pixel > 1,
            finest_level=full,
            nearest_texel=sampling.texture_filter == "nearest",
        ),
    )


class _Pictures:
    """Renders stacks of log radiance and takes the time of it."""

    def __init__(self, arrays: SceneArrays, lens: PinholeConfig, sampling: Sampling, count: int) -> None:
        self._arrays = resampled(arrays, sampling)
        self._bias = sampling.mip_bias
        self._device = arrays.device
        self._renderer = WarpRenderer(self._arrays, lens, outputs=["log_radiance"], instant_count=count)
        self._slots = wp.full(count, -1, dtype=int, device=self._device)

    def render(self, poses: Poses) -> tuple[Any, float]:
        """Return log radiance, shape [K, H, W], overwritten by the next call, and the time it took [s]."""
        self._arrays.data.mip_bias = self._bias
        position: Any = wp.array(poses[0], dtype=wp.vec3, device=self._device)
        orientation: Any = wp.array(poses[1], dtype=wp.quat, device=self._device)
        wp.synchronize_device(self._device)
        begin = time.perf_counter()
        self._renderer.render(position, orientation, self._slots, instant_count=len(poses[0]))
        wp.synchronize_device(self._device)
        return self._renderer.log_radiance, time.perf_counter() - begin


def first_pictures(scene: Scene) -> NDArray[np.float32]:
    """Return log radiance above a floor on the CPU, without shadows; shape [1, H, W]."""
    lens = _lens(96, 72)
    _, poses = _checkerboard(True, lens, "cpu")
    return np.asarray(
        _Pictures(upload_scene(scene, _PLAIN, "cpu"), lens, DEFAULT, 1).render(poses)[0].numpy()
    )


def _compare(
    name: str, arrays: SceneArrays, lens: PinholeConfig, poses: Poses, samplings: Sequence[Sampling]
) -> list[PictureError]:
    """Render views under each sampling, and take the difference from the reference."""
    count = len(poses[0])
    truth = _Pictures(arrays, lens, REFERENCE, count).render(poses)[0].numpy()
    found = []
    for sampling in samplings:
        pictures = _Pictures(arrays, lens, sampling, count)
        times_s = [pictures.render(poses)[1] for _ in range(4)][1:]  # the first one loads the kernel
        error = pictures.render(poses)[0].numpy().astype(np.float64) - truth
        found.append(
            PictureError(
                scene=name,
                sampling=sampling,
                rms=float(np.sqrt(np.mean(error**2))),
                p99=float(np.quantile(np.abs(error), 0.99)),
                picture_s=min(times_s) / count,
            )
        )
    return found


def _reference_error(arrays: SceneArrays, lens: PinholeConfig, poses: Poses) -> float:
    """Return the root mean square of the reference's error, against 16 times as many samples, in one view."""
    first = poses[0][:1], poses[1][:1]
    finer = _lens(4 * lens.width, 4 * lens.height)
    log = _Pictures(arrays, finer, REFERENCE, 1).render(first)[0].numpy()[0]
    floor = arrays.config.dark_floor
    radiance = np.exp(log.astype(np.float64)) - floor
    mean = radiance.reshape(lens.height, 4, lens.width, 4).mean(axis=(1, 3))
    reference = _Pictures(arrays, lens, REFERENCE, 1).render(first)[0].numpy()[0]
    return float(np.sqrt(np.mean((reference - np.log(mean + floor)) ** 2)))


@dataclass(frozen=True, kw_only=True)
class _Pan:
    """A camera that turns slowly about the vertical."""

    seconds: float
    rate_hz: float
    speed_px_s: float
    """Of the picture at the centre [px/s]."""

    @property
    def tolerance_s(self) -> float:
        """Largest difference in time of two events that are taken for the same: half a pixel [s]."""
        return 0.5 / self.speed_px_s

    @property
    def stamps_ns(self) -> NDArray[np.int64]:
        """When it is rendered [ns]."""
        return np.rint(np.arange(self.seconds * self.rate_hz + 1) * (1e9 / self.rate_hz)).astype(np.int64)

    def poses(self, lens: PinholeConfig) -> Poses:
        """Return where the camera is at the stamps, above the checkerboard."""
        ray = np.array([0.0, math.sin(_PITCH_RAD), math.cos(_PITCH_RAD)])  # the axis of the turn is oblique:
        rate_rad_s = self.speed_px_s / (lens.intrinsics().fx * ray[2])  # the centre moves by its cosine
        yaws = 0.1 + rate_rad_s * 1e-9 * self.stamps_ns
        return _poses([((0.013, 0.007, _HEIGHT_M), looking(yaw, _PITCH_RAD)) for yaw in yaws])


def _pan_samplings(quick: bool) -> list[Sampling]:
    """Return the samplings that pan; the first is that of a renderer which knows nothing of aliasing."""
    few = [POINT, Sampling(texture_filter="bilinear"), DEFAULT]
    if quick:
        return few
    return [
        *few,
        *(Sampling(mip_bias=bias) for bias in (-2.0, -1.0, 1.0, 2.0)),
        *(Sampling(samples_per_pixel=n) for n in (4, 16)),
        *(Sampling(samples_per_pixel=n, texture_filter="nearest") for n in (4, 16)),
    ]


def _measure_pan(
    pan: _Pan, arrays: SceneArrays, lens: PinholeConfig, quick: bool
) -> tuple[tuple[PanEvents, ...], NDArray[np.int64]]:
    """Return what each sampling makes of a pan, and the false events by pixel of `POINT` and the default."""
    truth, _ = _pan_events(pan, arrays, lens, REFERENCE)
    found, maps = [], {}
    for sampling in _pan_samplings(quick):
        events, picture_s = _pan_events(pan, arrays, lens, sampling)
        tolerance_us = round(1e6 * pan.tolerance_s)
        matching = match_events(truth, events, tolerance_us=tolerance_us)
        false, missing = take(events, matching.spurious), take(truth, matching.missing)
        flipped = missing._replace(polarity=1 - missing.polarity)
        wrong = len(match_events(flipped, false, tolerance_us=tolerance_us).reference)
        maps[sampling] = np.zeros((lens.height, lens.width), dtype=np.int64)
        np.add.at(maps[sampling], (false.y, false.x), 1)
        found.append(
            PanEvents(
                sampling=sampling,
                event_count=len(events.t),
                true_count=len(truth.t),
                missing_count=len(missing.t),
                wrong_polarity_count=wrong,
                spurious_count=len(false.t) - wrong,
                picture_s=picture_s,
            )
        )
    return tuple(found), np.stack([maps[POINT], maps[DEFAULT]])


def _views(pan: _Pan, arrays: SceneArrays, lens: PinholeConfig) -> NDArray[np.float32]:
    """Return the first picture of a pan: point-sampled, by default, and of the reference."""
    position, orientation = pan.poses(lens)
    first = position[:1], orientation[:1]
    samplings = (POINT, DEFAULT, REFERENCE)
    return np.concatenate([_Pictures(arrays, lens, s, 1).render(first)[0].numpy() for s in samplings])


def _pan_events(
    pan: _Pan, arrays: SceneArrays, lens: PinholeConfig, sampling: Sampling
) -> tuple[EventArrays, float]:
    """Return the events of a pan, and the time to render one picture [s]."""
    batch = 50
    position, orientation = pan.poses(lens)
    stamps_ns = pan.stamps_ns
    pictures = _Pictures(arrays, lens, sampling, batch)
    camera = EventCamera(
        EventCameraConfig(), width=lens.width, height=lens.height, device=arrays.device, sensor="pan"
    )
    parts, times_s = [], []
    for begin in range(0, len(stamps_ns), batch):
        rows = slice(begin, begin + batch)
        log, elapsed_s = pictures.render((position[rows], orientation[rows]))
        times_s.append(elapsed_s / len(stamps_ns[rows]))
        first = 0
        if begin == 0:
            camera.reset(log[0], int(stamps_ns[0]))
            first = 1
        count = len(stamps_ns[rows])
        if count > first:
            parts.append(camera.feed(log[first:count], stamps_ns[rows][first:]).numpy())
    return EventArrays(*(np.concatenate(columns) for columns in zip(*parts, strict=True))), min(times_s)
