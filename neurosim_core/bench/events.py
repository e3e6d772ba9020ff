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

import itertools
import math
import shlex
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import warp as wp
from numpy.typing import NDArray

from neurosim_core.bench.chapter import Bar, Chapter, Plot, Table
from neurosim_core.bench.figures import COLORS, MARKERS
from neurosim_core.bench.flown import SLOW_SHARE, Flown, fly
from neurosim_core.bench.spike_distance import Trains, align, make_trains
from neurosim_core.clock import NS_PER_US, Rate
from neurosim_core.config import load_config
from neurosim_core.render.camera import PinholeConfig
from neurosim_core.render.renderer import make_renderer
from neurosim_core.render.warp_renderer import SceneArrays, upload_scene
from neurosim_core.sensors.displacement import DisplacementRule
from neurosim_core.sensors.events import EventCamera
from neurosim_core.sensors.rig import EventSensorConfig

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Scheme = Literal["fixed", "adaptive", "naive"]
Events = tuple[NDArray[Any], ...]
"""Times [us], columns, rows, polarities."""

COST_PER_S = 200.0
"""q of the distance [1/s]: to shift an event by 5 ms costs as much as to lose it, and events that are further
apart than 10 ms are not the same."""
FIXED_HZ = (250.0, 500.0, 1000.0, 2000.0, 5000.0, 10_000.0)
ADAPTIVE_PX = (2.0, 1.0, 0.5, 0.35, 0.2, 0.1)
_CHUNK = 128
"""Renders that are shown to all candidates at once."""
_TIMED_MAX = 1000
"""Renders of a candidate that are timed, evenly spread over the flight."""
_BINS_US = np.geomspace(10.0, 1e4, 25)
"""Edges of the histogram of timing errors [us]; what is less than the first is in the first bin."""


@dataclass(frozen=True, kw_only=True)
class Score:
    """How the events of one candidate differ from those of the reference."""

    scheme: Scheme
    setting: float
    """Renders a second [Hz], or the displacement between two renders [px]."""
    render_count: int
    slow_render_count: int
    """Those before the manoeuvre."""
    choice_s: float
    """Time that it took to choose the renders among the ticks of the reference [s]: CPU time of all threads
    on a CPU, wall clock on CUDA; 0 for a fixed rate."""
    render_s: float
    """Time of all its renders [s], measured likewise, on some of them."""
    event_count: int
    missing_count: int
    spurious_count: int
    distance: float
    """Of Victor and Purpura, the sum over all pixels and polarities."""
    median_us: float
    """Median timing error of the events matched, without sign [us]; nan if there is none."""
    high_us: float
    """Nine tenths are below it [us]."""
    worst_us: float
    """The largest [us]; at most the window."""
    histogram: tuple[int, ...]
    """Events matched by timing error."""

    @property
    def run_s(self) -> float:
        """Time of choosing and rendering [s]."""
        return self.choice_s + self.render_s


@dataclass(frozen=True, kw_only=True)
class EventStudy:
    """What `measure_events` found."""

    quick: bool
    scene: str
    scene_file: Path | None
    """None: generated."""
    device: str
    width: int
    height: int
    samples_per_pixel: int
    duration_s: float
    reference_hz: float
    reference_count: int
    """Events of the reference."""
    scores: tuple[Score, ...]

    def of(self, scheme: Scheme) -> list[Score]:
        """Return the scores of a scheme, the one with the fewest renders first."""
        return sorted((s for s in self.scores if s.scheme == scheme), key=lambda s: s.render_count)

    @property
    def clock(self) -> str:
        """What run times are, in words."""
        return "wall-clock time" if wp.get_device(self.device).is_cuda else "CPU time"

    def error(self, score: Score) -> float:
        """Return the distance to the reference for each of its events."""
        return score.distance / self.reference_count


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
            some = candidate.ticks[:: -(-len(candidate.ticks) // _TIMED_MAX)]
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
        histogram=tuple(np.histogram(np.maximum(shifts, _BINS_US[0]), bins=_BINS_US)[0].tolist()),
    )


def saving(
    study: EventStudy, error: Callable[[Score], float], cost: Callable[[Score], float]
) -> dict[float, float]:
    """Return how many times as much the best fixed rate costs for the error of adaptive sampling.

    Between two rates the curve is interpolated in logarithms. Candidates that are better than the fastest
    rate or worse than the slowest are left out.

    Args:
        study: What was measured.
        error: What counts as the error of a score.
        cost: What counts as its cost.

    Returns:
        Factor by displacement [px].
    """
    fixed = sorted(study.of("fixed"), key=error)
    errors, costs = np.log([error(s) for s in fixed]), np.log([cost(s) for s in fixed])
    return {
        s.setting: float(np.exp(np.interp(np.log(error(s)), errors, costs)) / cost(s))
        for s in study.of("adaptive")
        if errors[0] <= np.log(error(s)) <= errors[-1]
    }


def timing_gain(study: EventStudy, ours: Scheme, error_us: Callable[[Score], float]) -> dict[float, float]:
    """Return how many times larger the timing error of the naive scheme is for as many renders.

    Our curve is interpolated in logarithms; rates beyond it are left out.

    Args:
        study: What was measured.
        ours: Fixed: at the same rate, thus of the same renders. Adaptive: of as many renders.
        error_us: Which timing error of a score [us]; less than 1 counts as 1, the resolution of stamps.

    Returns:
        Factor by rate of the naive scheme [Hz].
    """
    curve = study.of(ours)
    renders = np.log([s.render_count for s in curve])
    errors = np.log([max(error_us(s), 1.0) for s in curve])
    return {
        s.setting: float(error_us(s) / np.exp(np.interp(np.log(s.render_count), renders, errors)))
        for s in study.of("naive")
        if len(renders) and renders[0] <= np.log(s.render_count) <= renders[-1]
    }


def falls(study: EventStudy, scheme: Scheme) -> bool:
    """Return whether more renders always give a smaller error."""
    return all(a.distance > b.distance for a, b in itertools.pairwise(study.of(scheme)))


@dataclass(frozen=True, kw_only=True)
class _Answer:
    """What a study says about adaptive sampling and about the naive scheme: factors, by setting."""

    renders: dict[float, float]
    """Renders of a fixed rate against adaptive, for the same distance."""
    renders_by_count: dict[float, float]
    """The same, for as many missing and spurious events."""
    time: dict[float, float]
    """Run time of a fixed rate against adaptive, for the same distance."""
    naive: dict[tuple[Scheme, str], dict[float, float]]
    """Timing error of the naive scheme against ours, by our scheme and the measure of the error."""


def _answer(study: EventStudy) -> _Answer:
    measures: dict[str, Callable[[Score], float]] = {
        "median": lambda s: s.median_us,
        "90 %": lambda s: s.high_us,
    }
    ours: tuple[Scheme, ...] = ("adaptive", "fixed")
    return _Answer(
        renders=saving(study, study.error, lambda s: s.render_count),
        renders_by_count=saving(
            study, lambda s: s.missing_count + s.spurious_count, lambda s: s.render_count
        ),
        time=saving(study, study.error, lambda s: s.run_s),
        naive={
            (scheme, name): timing_gain(study, scheme, error_us)
            for scheme in ours
            for name, error_us in measures.items()
        },
    )


def events_chapter(study: EventStudy) -> Chapter:
    """Return what a study says, for the report."""
    answer = _answer(study)
    return Chapter(
        name="events",
        title="Events: error against run time",
        summary=_summary(study, answer),
        command=_command(study),
        bars=_bars(study, answer),
        tables=[_table(study, answer)],
        plots=[
            Plot(
                name="events-error",
                title="Error of the event stream against renders and run time",
                draw=lambda figure: _draw_error(study, figure),
            ),
            Plot(
                name="events-timing",
                title="Timing error of matched events",
                draw=lambda figure: _draw_timing(study, figure),
            ),
        ],
    )


def _command(study: EventStudy) -> str:
    """Return what measures the same again, whatever the defaults of a machine are."""
    words = ["neurosim bench events", *(["--quick"] if study.quick else [])]
    if study.scene_file is not None:
        words.append(f"--scene {shlex.quote(str(study.scene_file))}")
    return " ".join([*words, f"--device {study.device} --width {study.width} --height {study.height}"])


def _bars(study: EventStudy, answer: _Answer) -> list[Bar]:
    """Return what was promised, and what came of it."""
    both = [scheme for scheme in ("fixed", "adaptive") if falls(study, scheme)]
    small = " (quick: too small to judge)" if study.quick else ""
    judged = answer.naive["adaptive", "median"]
    return [
        Bar(
            text="For the same error adaptive sampling needs at most half the renders of the best fixed rate",
            measured=f"by the spike-train distance {_span(answer.renders)} times fewer"
            f"{_left_out(study, answer.renders)}; by missing and spurious events "
            f"{_span(answer.renders_by_count)} times fewer{_left_out(study, answer.renders_by_count)}"
            f"{small}",
            met=None if study.quick or not answer.renders else min(answer.renders.values()) >= 2.0,
        ),
        Bar(
            text="At the same number of renders the timing error of the naive scheme is at least 5 times "
            "ours: judged by the median of matched events, naive at a fixed rate against adaptive sampling",
            measured=f"{_span(judged)} times, at {_rates(judged)}; by what 90 % are below "
            f"{_span(answer.naive['adaptive', '90 %'])} times. Against our own pixels at the same fixed "
            f"rate, {_rates(answer.naive['fixed', 'median'])}: median "
            f"{_span(answer.naive['fixed', 'median'])}, 90 % {_span(answer.naive['fixed', '90 %'])} times"
            f"{small}",
            met=None if study.quick or not judged else min(judged.values()) >= 5.0,
        ),
        Bar(
            text="The error falls monotonically with the number of renders",
            measured=f"it does for {' and '.join(both) or 'none'}",
            met=len(both) == 2,
        ),
    ]


def _span(factors: dict[float, float]) -> str:
    if not factors:
        return "?"
    low, high = (f"{bound(factors.values()):.2g}" for bound in (min, max))
    return low if low == high else f"{low} to {high}"


def _rates(factors: dict[float, float]) -> str:
    """Name the rates of some factors."""
    if not factors:
        return "no rate"
    low, high = (f"{bound(factors):g}" for bound in (min, max))
    return f"{low} Hz" if low == high else f"{low} to {high} Hz"


def _left_out(study: EventStudy, factors: dict[float, float]) -> str:
    """Name the displacements that have no factor."""
    left = [f"{s.setting:g}" for s in study.of("adaptive") if s.setting not in factors]
    return f" (left out, as no fixed rate here is as bad or as good: {', '.join(left)} px)" if left else ""


def _summary(study: EventStudy, answer: _Answer) -> str:
    """Return the answer in words."""
    finest = study.of("adaptive")[-1:]
    missing = (
        f"At {finest[0].setting:g} px {finest[0].missing_count / study.reference_count:.1%} of the "
        "events are missing: details that pass a pixel between two renders."
        if finest
        else ""
    )
    return "\n\n".join(
        [
            f"A vehicle creeps through *{study.scene}* for {SLOW_SHARE * study.duration_s:.2g} s, dodges "
            f"with a roll of 640 degrees a second, and recovers: {study.duration_s:g} s in all. It was flown "
            f"once and rendered at {study.reference_hz / 1e3:g} kHz, {study.width} x {study.height} pixels, "
            f"{study.samples_per_pixel} rays each, on {study.device}. The {study.reference_count:,} events "
            "are the reference; candidates see some of the same renders.",
            f"For the same spike-train distance adaptive sampling needs {_span(answer.renders)} times fewer "
            f"renders than a fixed rate, and {_span(answer.time)} times less {study.clock} to choose and "
            f"render them; for as many missing and spurious events it needs {_span(answer.renders_by_count)} "
            f"times fewer renders. {missing}",
            _choosing(study, answer),
            f"With as many renders as adaptive sampling the naive scheme stamps events "
            f"{_span(answer.naive['adaptive', 'median'])} times worse (median of those matched); at the same "
            f"fixed rate {_span(answer.naive['fixed', 'median'])} times worse than our pixels.",
            f"Distance: Victor and Purpura (1996), q = {COST_PER_S:g}/s, of each pixel and polarity, summed, "
            "and divided by the events of the reference. Its alignment matches events at most "
            f"{2e3 / COST_PER_S:g} ms apart.",
        ]
    )


def _choosing(study: EventStudy, answer: _Answer) -> str:
    """Say what the choice costs, and where it does not pay."""
    ours = study.of("adaptive")
    if not ours:
        return "Adaptive sampling was not measured."
    tick_count = round(study.duration_s * study.reference_hz) + 1
    each_us = [1e6 * s.choice_s / tick_count for s in ours]
    shares = [s.choice_s / s.render_s for s in ours]
    render_ms = 1e3 * sum(s.render_s for s in ours) / sum(s.render_count for s in ours)
    worse = sorted((px for px, factor in answer.time.items() if factor < 1.0), reverse=True)
    verdict = (
        f"At {', '.join(f'{px:g}' for px in worse)} px it does not pay here: a fixed rate of the same error "
        "takes less time."
        if worse
        else "Choosing included, no setting that can be compared takes longer than a fixed rate here."
    )
    return (
        f"To choose takes {min(each_us):.2g} to {max(each_us):.2g} us for each tick of the clock that is "
        f"chosen from, here the {study.reference_hz / 1e3:g} kHz of the reference (a clock of 1 kHz "
        "has far fewer), which adds "
        f"{min(shares):.0%} to {max(shares):.0%} to the time of rendering ({render_ms:.3g} ms a render). "
        f"{verdict} It pays less the cheaper a render is (few pixels, few rays, a fast GPU), the finer the "
        "clock, and the more packets end, as their ends are always rendered. It does not pay at an even "
        "speed: adaptive sampling bounds how far things move between two renders, not the time; where the "
        "vehicle is slow, events are off by as much of a pixel, which is more microseconds."
    )


def _table(study: EventStudy, answer: _Answer) -> Table:
    total = study.reference_count
    rows = [
        {
            "scheme": s.scheme,
            "setting": s.setting,
            "renders": s.render_count,
            "slow": s.slow_render_count,
            "choice": s.choice_s,
            "render": s.render_s,
            "run": s.run_s,
            "count": 100.0 * (s.event_count / total - 1.0),
            "missing": 100.0 * s.missing_count / total,
            "spurious": 100.0 * s.spurious_count / total,
            "distance": study.error(s),
            "median": s.median_us,
            "high": s.high_us,
            "worst": s.worst_us,
            "fewer": answer.renders.get(s.setting) if s.scheme == "adaptive" else None,
            "faster": answer.time.get(s.setting) if s.scheme == "adaptive" else None,
        }
        for scheme in ("fixed", "adaptive", "naive")
        for s in study.of(scheme)
    ]
    return Table(
        name="events-schemes",
        title="Events of a flight by how it was sampled",
        columns={
            "scheme": "scheme",
            "setting": "Hz or px",
            "renders": "renders",
            "slow": "of these before the manoeuvre",
            "choice": "choosing [s]",
            "render": "rendering [s]",
            "run": "both [s]",
            "count": "events more or fewer [%]",
            "missing": "missing [%]",
            "spurious": "spurious [%]",
            "distance": "distance per event",
            "median": "timing error, median [us]",
            "high": "90 % [us]",
            "worst": "largest [us]",
            "fewer": "renders of a fixed rate / of this",
            "faster": "time of a fixed rate / of this",
        },
        rows=rows,
        note="Timing errors are those of matched events, without sign; they are below the window by "
        f"definition. Seconds are {study.clock} (on a CPU that of all threads), of at most {_TIMED_MAX:,} "
        "renders of each candidate, scaled to all. The last two columns compare with the fixed rate of the "
        "same distance, between two rates by interpolation; unknown where no fixed rate is as bad or as "
        "good. Adaptive sampling also renders the ends of packets, 100 a second.",
    )


_STYLE: dict[Scheme, tuple[str, str, str]] = {
    "fixed": (COLORS[0], MARKERS[0], "fixed rate"),
    "adaptive": (COLORS[1], MARKERS[1], "adaptive"),
    "naive": (COLORS[2], MARKERS[2], "naive"),
}
"""Colour, marker and name of each scheme."""


def _draw_error(study: EventStudy, figure: "Figure") -> None:
    """Draw the distance against renders and against run time, and the timing error against renders."""
    panels = figure.subplots(1, 3)
    for scheme, (color, marker, label) in _STYLE.items():
        scores = study.of(scheme)
        style = {"color": color, "marker": marker, "label": label}
        renders, run_s = [s.render_count for s in scores], [s.run_s for s in scores]
        errors, medians_us = [study.error(s) for s in scores], [max(s.median_us, 1.0) for s in scores]
        for axes, costs, values in zip(
            panels, (renders, run_s, renders), (errors, errors, medians_us), strict=True
        ):
            axes.plot(costs, values, **style)
            if scheme != "naive":
                _name_points(axes, scores, costs, values)
    panels[0].set(xlabel="renders", ylabel="spike-train distance per event")
    panels[1].set(xlabel=f"choosing and rendering [s]\n({study.clock})", ylabel=panels[0].get_ylabel())
    panels[2].set(xlabel="renders", ylabel="median timing error [us]")
    for axes in panels:
        axes.set(xscale="log", yscale="log")
        axes.margins(x=0.15)
        axes.legend(loc="lower left", fontsize=8)


def _name_points(axes: Any, scores: Sequence[Score], costs: Sequence[float], values: Sequence[float]) -> None:
    """Write the settings beside the points of a curve."""
    for score, place in zip(scores, zip(costs, values, strict=True), strict=True):
        text = f"{score.setting:g} px" if score.scheme == "adaptive" else f"{score.setting / 1e3:g} kHz"
        offset, side = ((-5, -9), "right") if score.scheme == "adaptive" else ((5, 4), "left")
        axes.annotate(text, place, fontsize=7, textcoords="offset points", xytext=offset, ha=side)


def _draw_timing(study: EventStudy, figure: "Figure") -> None:
    axes = figure.subplots()
    shown = study.of("adaptive")[len(study.of("adaptive")) // 2]
    edges = _BINS_US
    for scheme, (color, _, label) in _STYLE.items():
        score = min(study.of(scheme), key=lambda s: abs(math.log(s.render_count / shown.render_count)))
        share = 100.0 * np.array(score.histogram) / study.reference_count
        axes.stairs(
            share, edges, color=color, label=f"{label}, {score.render_count:,} renders", linewidth=1.8
        )
    axes.set(
        xscale="log",
        xlabel="timing error [us], in the first bin all that is less",
        ylabel="share of the reference's events [% per bin]",
    )
    axes.legend()
