# mypy: disable-error-code="index,attr-defined,misc,arg-type,no-untyped-call,call-overload,untyped-decorator"
"""Error against run time for a stream of events: fixed rates, adaptive sampling, and the naive scheme.

One flight is flown once, and rendered at 100 kHz. The events of all these renders are the reference. Every
candidate is given some of the same renders: each tick of a slower clock, or the ticks that adaptive sampling
asks for. So candidates differ in which instants they see and in nothing else.

The cost of a candidate is its number of renders, which says something about every machine, and the time that
choosing and rendering them takes here. Both are measured in the same run: the choice is timed when it is
made, and the renders of each candidate are timed once more by themselves. What the flight and the pixels cost
is not in it, as it is the same for all.

The naive scheme is what many simulators do: a pixel that has changed by a threshold since its last event
fires one event, stamped at the frame, and takes its new log radiance as reference.

Events of a candidate are matched with those of the reference pixel by pixel and polarity by polarity, by the
alignment behind the distance of Victor and Purpura; see `spike_distance`.
"""

# No `from __future__ import annotations`: Warp needs the annotations of kernels as objects.

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import warp as wp
from numpy.typing import NDArray

from neurosim_core.bench.events_chapter import events_chapter
from neurosim_core.bench.events_result import BINS_US, COST_PER_S, TIMED_MAX, EventStudy, Scheme, Score
from neurosim_core.bench.flown import SLOW_SHARE, Flown, fly
from neurosim_core.bench.spike_distance import Trains, align, make_trains
from neurosim_core.clock import NS_PER_US, Rate
from neurosim_core.config import load_config
from neurosim_core.render.camera import PinholeConfig
from neurosim_core.render.renderer import make_renderer
from neurosim_core.render.scene_arrays import SceneArrays, upload_scene
from neurosim_core.sensors.displacement import DisplacementRule
from neurosim_core.sensors.events import EventCamera
from neurosim_core.sensors.rig import EventSensorConfig

__all__ = ["events_chapter", "measure_events"]

Events = tuple[NDArray[Any], ...]
"""Times [us], columns, rows, polarities."""

FIXED_HZ = (250.0, 500.0, 1000.0, 2000.0, 5000.0, 10_000.0)
ADAPTIVE_PX = (2.0, 1.0, 0.5, 0.35, 0.2, 0.1)
_CHUNK = 128
"""Renders that are shown to all candidates at once."""


@dataclass(kw_only=True, eq=False)
class _Candidate:
    """A camera that sees some ticks of the reference."""

    scheme: Scheme | Literal["reference"]
    setting: float
    ticks: NDArray[np.int64]
    choice_s: float = 0.0
    render_s: float = 0.0
    sensor: Any = None
    """`EventCamera` or `_NaiveCamera`."""
    parts: list[Events] = field(default_factory=list)

    def events(self) -> Events:
        """Return all events so far."""
        return tuple(np.concatenate(column) for column in zip(*self.parts, strict=True))


@wp.kernel(enable_backward=False)
def _pick_frames(
    # In:
    frames: wp.array3d[float],
    picked: wp.array[int],
    # Out:
    frames_out: wp.array3d[float],
) -> None:
    frame, row, col = wp.tid()
    frames_out[frame, row, col] = frames[picked[frame], row, col]


@wp.kernel(enable_backward=False)
def _compare_frames(
    # Model:
    threshold_on: float,
    threshold_off: float,
    # In:
    frames: wp.array3d[float],
    frame_count: int,
    # In/out:
    reference: wp.array2d[float],
    # Out:
    fired_out: wp.array3d[wp.uint8],
) -> None:
    row, col = wp.tid()
    level = reference[row, col]
    for frame in range(frame_count):
        value = frames[frame, row, col]
        fired = wp.uint8(0)
        if value - level >= threshold_on:
            fired = wp.uint8(2)
        elif level - value >= threshold_off:
            fired = wp.uint8(1)
        if fired != wp.uint8(0):
            level = value
        fired_out[frame, row, col] = fired
    reference[row, col] = level


class _NaiveCamera:
    """At most one event per pixel and frame, stamped at the frame."""

    def __init__(self, config: EventSensorConfig, device: str) -> None:
        self._thresholds = (config.pixel.threshold_on, config.pixel.threshold_off)
        shape = (config.lens.height, config.lens.width)
        self._reference = wp.zeros(shape, dtype=float, device=device)
        self._fired = wp.zeros((_CHUNK, *shape), dtype=wp.uint8, device=device)

    def reset(self, frame: wp.array2d[float]) -> None:
        """Take a frame as reference."""
        wp.copy(self._reference, frame)

    def feed(self, frames: wp.array3d[float], stamps_ns: NDArray[np.int64]) -> Events:
        """Return the events of some frames."""
        count = len(stamps_ns)
        wp.launch(
            _compare_frames,
            dim=self._reference.shape,
            inputs=[*self._thresholds, frames, count],
            outputs=[self._reference, self._fired],
            device=self._reference.device,
        )
        fired = self._fired[:count].numpy()
        frame, y, x = np.nonzero(fired)
        return stamps_ns[frame] // NS_PER_US, x, y, (fired[frame, y, x] == 2).astype(np.uint8)


def measure_events(
    *,
    quick: bool = False,
    scene: Path | None = None,
    device: str = "auto",
    width: int | None = None,
    height: int | None = None,
    samples_per_pixel: int = 8,
    progress: Callable[[str], None] | None = None,
) -> EventStudy:
    """Fly, render at the rate of the reference, and compare candidates with it.

    Args:
        quick: A shorter flight, a smaller picture, a slower reference and fewer candidates: enough to see
            that it works.
        scene: A mesh file; None: the generated apartment.
        device: Where to compute.
        width: Columns of the event camera [px]; None: 346 on CUDA, 64 on a CPU, 32 if quick.
        height: Rows [px]; None: three quarters of the columns.
        samples_per_pixel: Rays per pixel. What is narrower than a pixel flickers if there are few, and
            flicker is light that no rate of renders samples well.
        progress: Told what is done next.

    Raises:
        ValueError: The scene cannot be loaded, or the device is not there.
        DynamicsError: The flight could not be integrated.
    """
    tell = progress or (lambda what: None)
    tell("fly")
    flown = fly(
        load_config(
            {
                "duration_s": 0.3 if quick else 1.0,
                "device": device,
                "render": {"samples_per_pixel": samples_per_pixel},
                **({} if scene is None else {"scene": {"kind": "mesh", "file": str(scene.resolve())}}),
            }
        ),
        Rate(10_000.0 if quick else 100_000.0),
    )
    columns = width or (32 if quick else 346 if wp.get_device(flown.model.device).is_cuda else 64)
    lens = PinholeConfig(width=columns, height=height or round(0.75 * columns), horizontal_fov_rad=1.5)
    sensor = EventSensorConfig(lens=lens, sampling_rate_hz=flown.rate.rate_hz)
    tell("upload the scene")
    arrays = upload_scene(flown.model.scene, flown.model.config.render, flown.model.device)
    reference = _Candidate(
        scheme="reference", setting=flown.rate.rate_hz, ticks=np.arange(len(flown.stamps_ns))
    )
    tell("choose the renders of adaptive sampling")
    candidates = list(_candidates(flown, arrays, sensor, quick=quick))
    _time_renders(flown, arrays, sensor, candidates, tell)
    _show(flown, arrays, sensor, [reference, *candidates], tell)
    right = make_trains(*reference.events(), width=columns)
    scores = []
    for candidate in candidates:
        tell(f"compare {candidate.scheme} {candidate.setting:g}")
        scores.append(_score(candidate, right, flown, columns))
    return EventStudy(
        quick=quick,
        scene=flown.model.scene.name,
        scene_file=scene,
        device=flown.model.device,
        width=columns,
        height=lens.height,
        samples_per_pixel=samples_per_pixel,
        duration_s=flown.model.config.duration_s,
        reference_hz=flown.rate.rate_hz,
        reference_count=len(right.t_us),
        scores=tuple(scores),
    )


def _candidates(
    flown: Flown, arrays: SceneArrays, sensor: EventSensorConfig, *, quick: bool
) -> Iterator[_Candidate]:
    """Yield who sees which ticks of the reference."""
    for rate_hz in FIXED_HZ[:5] if quick else FIXED_HZ:
        ticks = _ticks(flown, Rate(rate_hz))
        yield _Candidate(scheme="fixed", setting=rate_hz, ticks=ticks)
        yield _Candidate(scheme="naive", setting=rate_hz, ticks=ticks)
    _make_rule(flown, arrays, sensor, 1.0).choose(flown.trace.states, range(1), [0], [True])  # compiles
    forced = np.zeros(len(flown.stamps_ns), dtype=bool)
    forced[_ticks(flown, sensor.packets)] = True
    forced[-1] = True
    stamps_ns, must = flown.stamps_ns.tolist(), forced.tolist()
    for limit_px in ADAPTIVE_PX[1:] if quick else ADAPTIVE_PX:
        rule = _make_rule(flown, arrays, sensor, limit_px)
        begin_s = _busy_s(flown.model.device)
        chosen = rule.choose(flown.trace.states, range(len(stamps_ns)), stamps_ns, must)
        yield _Candidate(
            scheme="adaptive",
            setting=limit_px,
            ticks=np.array(chosen),
            choice_s=_busy_s(flown.model.device) - begin_s,
        )


def _make_rule(
    flown: Flown, arrays: SceneArrays, sensor: EventSensorConfig, limit_px: float
) -> DisplacementRule:
    return DisplacementRule(
        arrays,
        sensor.lens,
        max_displacement_px=limit_px,
        rate=flown.rate,
        p_BC=wp.vec3d(*sensor.mount.position_m),
        q_BC=wp.quatd(*sensor.mount.optical_quaternion()),
    )


def _busy_s(device: str) -> float:
    """Return a time of which differences count [s]: of all threads; on CUDA the wall clock, when idle."""
    if wp.get_device(device).is_cpu:
        return time.process_time()
    wp.synchronize_device(device)
    return time.perf_counter()


def _ticks(flown: Flown, rate: Rate) -> NDArray[np.int64]:
    """Return the ticks of the reference at which a slower clock ticks."""
    return np.flatnonzero([rate.has_tick(stamp_ns) for stamp_ns in flown.stamps_ns.tolist()])


class _Eye:
    """Renders ticks of a flight."""

    def __init__(self, flown: Flown, arrays: SceneArrays, sensor: EventSensorConfig) -> None:
        self._flown = flown
        self._device = device = flown.model.device
        self._mount = {
            "p_BC": wp.vec3d(*sensor.mount.position_m),
            "q_BC": wp.quatd(*sensor.mount.optical_quaternion()),
        }
        self._renderer = make_renderer(arrays, sensor.lens, outputs=["log_radiance"], instant_count=_CHUNK)
        self._p_WC = wp.zeros(_CHUNK, dtype=wp.vec3, device=device)
        self._q_WC = wp.zeros(_CHUNK, dtype=wp.quat, device=device)
        self._no_image = wp.full(_CHUNK, value=-1, dtype=int, device=device)
        self.frames = self._renderer.log_radiance

    def look(self, ticks: NDArray[np.int64]) -> None:
        """Render at most `_CHUNK` ticks into `frames`."""
        self._flown.trace.camera_poses(
            wp.array(ticks.astype(np.int32), dtype=int, device=self._device),
            count=len(ticks),
            **self._mount,
            p_WC=self._p_WC,
            q_WC=self._q_WC,
        )
        self._renderer.render(self._p_WC, self._q_WC, self._no_image, instant_count=len(ticks))


def _time_renders(
    flown: Flown,
    arrays: SceneArrays,
    sensor: EventSensorConfig,
    candidates: Sequence[_Candidate],
    tell: Callable[[str], None],
) -> None:
    """Measure what the renders of each candidate take; equal ticks are timed once."""
    eye = _Eye(flown, arrays, sensor)
    eye.look(np.arange(1))  # compiles
    known: dict[bytes, float] = {}
    for candidate in candidates:
        key = candidate.ticks.tobytes()
        if key not in known:
            tell(f"time the renders of {candidate.scheme} {candidate.setting:g}")
            some = candidate.ticks[:: -(-len(candidate.ticks) // TIMED_MAX)]
            begin_s = _busy_s(flown.model.device)
            for begin in range(0, len(some), _CHUNK):
                eye.look(some[begin : begin + _CHUNK])
            taken_s = _busy_s(flown.model.device) - begin_s
            known[key] = taken_s * len(candidate.ticks) / len(some)
        candidate.render_s = known[key]


def _show(
    flown: Flown,
    arrays: SceneArrays,
    sensor: EventSensorConfig,
    candidates: Sequence[_Candidate],
    tell: Callable[[str], None],
) -> None:
    """Render all ticks, and show each candidate its own."""
    device = flown.model.device
    lens = sensor.lens
    eye = _Eye(flown, arrays, sensor)
    frames, picked = eye.frames, wp.empty_like(eye.frames)
    for candidate in candidates:
        candidate.sensor = (
            _NaiveCamera(sensor, device)
            if candidate.scheme == "naive"
            else EventCamera(sensor.pixel, width=lens.width, height=lens.height, device=device, on_host=True)
        )
    count = len(flown.stamps_ns)
    for begin in range(0, count, _CHUNK):
        if begin % (_CHUNK * 32) == 0:
            tell(f"render {begin:,} of {count:,}")
        ticks = np.arange(begin, min(begin + _CHUNK, count))
        eye.look(ticks)
        for candidate in candidates:
            low, high = np.searchsorted(candidate.ticks, [begin, begin + len(ticks)])
            if high > low:
                _see(candidate, frames, picked, candidate.ticks[low:high] - begin, flown.stamps_ns, begin)


def _see(
    candidate: _Candidate,
    frames: Any,
    picked: Any,
    places: NDArray[np.int64],
    stamps_ns: NDArray[np.int64],
    begin: int,
) -> None:
    """Show some frames to a candidate; the very first is its reference."""
    seen = frames
    if candidate.scheme != "reference":
        seen = picked
        wp.launch(
            _pick_frames,
            dim=(len(places), *frames.shape[1:]),
            inputs=[frames, wp.array(places.astype(np.int32), dtype=int, device=frames.device)],
            outputs=[picked],
            device=frames.device,
        )
    stamps = stamps_ns[begin + places]
    first = int(begin == 0)
    if first:
        if isinstance(candidate.sensor, EventCamera):
            candidate.sensor.reset(seen[0], int(stamps[0]))
        else:
            candidate.sensor.reset(seen[0])
    if len(stamps) == first:
        return
    if isinstance(candidate.sensor, EventCamera):
        candidate.sensor.feed_device(seen[first:], stamps[first:])
        found = candidate.sensor.collect()
        candidate.parts.append((found.t, found.x, found.y, found.polarity))
    else:
        candidate.parts.append(candidate.sensor.feed(seen[first:], stamps[first:]))


def _score(candidate: _Candidate, right: Trains, flown: Flown, width: int) -> Score:
    """Compare a candidate with the reference."""
    assert candidate.scheme != "reference"
    trains = make_trains(*candidate.events(), width=width)
    aligned = align(right, trains, cost_per_s=COST_PER_S, device=flown.model.device)
    shifts = aligned.shifts_us
    median, high, worst = np.quantile(shifts, [0.5, 0.9, 1.0]) if len(shifts) else [math.nan] * 3
    slow = flown.stamps_ns[candidate.ticks] < SLOW_SHARE * flown.stamps_ns[-1]
    return Score(
        scheme=candidate.scheme,
        setting=candidate.setting,
        render_count=len(candidate.ticks),
        slow_render_count=int(slow.sum()),
        choice_s=candidate.choice_s,
        render_s=candidate.render_s,
        event_count=len(trains.t_us),
        missing_count=aligned.missing_count,
        spurious_count=aligned.spurious_count,
        distance=aligned.distance,
        median_us=float(median),
        high_us=float(high),
        worst_us=float(worst),
        histogram=tuple(np.histogram(np.maximum(shifts, BINS_US[0]), bins=BINS_US)[0].tolist()),
    )
