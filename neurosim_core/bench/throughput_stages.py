# mypy: disable-error-code="index,arg-type,no-untyped-call,var-annotated,union-attr,type-arg"
"""What the parts of a step cost: in a run where they follow one another, and each alone.

The time of a part in a run is measured with CUDA events on a GPU and with the host's clock on a CPU. Alone, a
part is repeated until the clock is fine enough, and the device is waited for once at the end.
"""

from __future__ import annotations

import math
import time
from collections import defaultdict
from collections.abc import Callable, Hashable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, cast

import numpy as np
import warp as wp
from numpy.typing import NDArray

from neurosim_core.bench.naive_events import NaiveEventCamera
from neurosim_core.bench.step import fly_blind
from neurosim_core.bench.throughput_result import (
    BARE_CAST,
    PHYSICS_ALONE,
    READ_ALONE,
    RENDER_ALONE,
    SCAN,
    SCAN_ALONE,
    Comparison,
    Part,
    Split,
)
from neurosim_core.clock import NS_PER_US
from neurosim_core.render.scene_arrays import SceneArrays
from neurosim_core.render.warp_renderer import WarpRenderer
from neurosim_core.schedule import batch_end_ns
from neurosim_core.sensors.events import EventCamera, EventCameraConfig
from neurosim_core.simulation import Model, advance, make_state, run_model, start, want

FRAME_US = 1000
_SORT_PASSES = 5
"""Of a radix sort with 8 bits a pass: the microseconds of a window and the pixel have about 40."""
_COLUMN_BYTES = 13
"""Of an event that is handed out: 8 for time, 2 and 2 for the pixel, 1 for polarity."""
_LOUD = 0.35
"""Step of log radiance that makes an event or two in every pixel and frame."""
_LOUD_FRAMES = 16
"""Of a stack of such frames: more events than fit into the memory that is lent would be copied."""


class StageClock:
    """Adds up how long stages take on a device."""

    def __init__(self, device: Any) -> None:
        self._device = wp.get_device(device)
        self._host_s: dict[str, float] = defaultdict(float)
        self._events: list[tuple[str, Any, Any]] = []

    def _mark(self) -> Any:
        return self._device.stream.record_event(wp.Event(self._device, enable_timing=True))

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Count what is launched in a block, on the stream that it begins in."""
        begin = self._mark() if self._device.is_cuda else time.perf_counter()
        yield
        if self._device.is_cuda:
            self._events.append((name, begin, self._mark()))
        else:
            self._host_s[name] += time.perf_counter() - begin

    def clear(self) -> None:
        """Forget what was counted."""
        self._host_s.clear()
        self._events.clear()

    def seconds(self) -> dict[str, float]:
        """Return the time of each stage [s]; waits for the device."""
        total = dict(self._host_s)
        for name, begin, end in self._events:
            total[name] = total.get(name, 0.0) + 1e-3 * wp.get_event_elapsed_time(begin, end)
        return total


class _StagedGraphs:
    """`streams.Graphs` that counts flights and looks as stages."""

    def __init__(self, graphs: Any, clock: StageClock, casts: Sequence[object]) -> None:
        self._graphs = graphs
        self._clock = clock
        self._casts = frozenset(map(id, casts))

    def run(self, key: Hashable, launch: Callable[[], Any]) -> None:
        look = isinstance(key, tuple) and key[0] in self._casts
        with self._clock.stage("render" if look else "physics"):
            self._graphs.run(key, launch)


class _StagedCamera:
    """An `EventCamera` that counts the scan and the reading as stages."""

    def __init__(self, camera: EventCamera, clock: StageClock) -> None:
        self._camera = camera
        self._clock = clock

    def feed_device(self, *arguments: Any, **options: Any) -> None:
        with self._clock.stage("scan"):
            self._camera.feed_device(*arguments, **options)

    def collect_windows(self, *arguments: Any, **options: Any) -> Any:
        with self._clock.stage("sort and decode"):
            return self._camera.collect_windows(*arguments, **options)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._camera, name)


def measure_split(model: Model, *, batch_count: int, begin_s: float) -> Split:
    """Fly with one batch under way at a time, and return what each part of a step takes.

    The parts do not overlap: a run with several batches under way is faster than their sum.

    Args:
        model: With one event camera that is not adaptive, and nothing else.
        batch_count: How many batches to time.
        begin_s: Fly so long with closed eyes first [s].
    """
    state = make_state(model, lane_count=1)
    state.overlaps = True  # flight and look as graphs of their own
    (seeing,) = state.casts
    (channel,) = seeing.events.values()
    clock = StageClock(model.device)
    state.graphs = cast(Any, _StagedGraphs(state.graphs, clock, state.casts))
    channel.camera = cast(Any, _StagedCamera(channel.camera, clock))
    fly_blind(model, state, begin_s)
    packets = run_model(model, state)
    for _ in range(4):
        next(packets)  # kernels, buffers, graphs
    is_cuda = wp.get_device(model.device).is_cuda
    clock.clear()
    renders = state.counts["renders"]
    copied_s = 0.0
    if is_cuda:
        wp.timing_begin(cuda_filter=wp.TIMING_MEMCPY)
    begin = time.perf_counter()
    for _ in range(batch_count):
        next(packets)
    elapsed_s = time.perf_counter() - begin
    if is_cuda:
        copied_s = 1e-3 * sum(found.elapsed for found in wp.timing_end() if "DtoH" in found.name)
    renders = state.counts["renders"] - renders
    stages_s = clock.seconds()
    stages_s["copy"] = copied_s
    stages_s["sort and decode"] = max(stages_s.get("sort and decode", 0.0) - copied_s, 0.0)
    return Split(
        width=seeing.renderers[0].log_radiance.shape[2],
        height=seeing.renderers[0].log_radiance.shape[1],
        instants=model.config.instants_per_launch,
        step_us=1e6 * elapsed_s / renders,
        stages_us={name: 1e6 * seconds / renders for name, seconds in stages_s.items()},
    )


class Views:
    """Frames of a flight, and the poses that they are seen from.

    Attributes:
        p_WC: Positions of the camera [m], shape [K].
        q_WC: Orientations, xyzw, shape [K].
        frames: Log radiance, shape [K, H, W].
        back: The same in the other order: shown in turns, the picture never jumps.
    """

    def __init__(self, model: Model, begin_s: float) -> None:
        """Fly to a stamp [s] and render one launch."""
        state = make_state(model, lane_count=1)
        fly_blind(model, state, begin_s)
        packets = run_model(model, state)
        for _ in range(2):
            next(packets)
        (seeing,) = state.casts
        self.model = model
        self.device = model.device
        self.arrays = cast(SceneArrays, model.scene_on_device)
        self.lens = model.casts[0].lens
        self.count = model.config.instants_per_launch
        self.p_WC, self.q_WC = seeing.p_WC[0], seeing.q_WC[0]
        self._chosen: dict[tuple[int, int], tuple[wp.array, wp.array, wp.array]] = {}
        """Poses and image slots of renders, by their first view and number."""
        renderer = self.renderer("log_radiance")
        self.render(renderer)
        self.frames = renderer.log_radiance
        assert self.frames is not None
        self.back = wp.array(self.frames.numpy()[::-1].copy(), dtype=float, device=self.device)

    def renderer(self, output: str, *, instants: int | None = None) -> WarpRenderer:
        """Return a renderer of one output, with room for all views."""
        count = instants or self.count
        return WarpRenderer(self.arrays, self.lens, outputs=(output,), instant_count=count, image_count=count)

    def render(self, renderer: WarpRenderer, *, first: int = 0, count: int | None = None) -> None:
        """Launch the render of some views, into image slots from 0 on."""
        count = self.count if count is None else count
        if (first, count) not in self._chosen:
            seen = slice(first, first + count)
            slots = wp.array(np.arange(count, dtype=np.int32), device=self.device)
            self._chosen[first, count] = self.p_WC[seen], self.q_WC[seen], slots
        renderer.render(*self._chosen[first, count], instant_count=count)


def seconds_per_call(call: Callable[[], object], device: Any, *, seconds: float) -> float:
    """Return how long a call takes that is repeated for about so long, the device waited for at the end."""
    call()
    wp.synchronize_device(device)
    count, elapsed_s = 1, 0.0
    while True:
        begin = time.perf_counter()
        for _ in range(count):
            call()
        wp.synchronize_device(device)
        elapsed_s = time.perf_counter() - begin
        if elapsed_s >= 0.5 * seconds:
            return elapsed_s / count
        count = math.ceil(count * min(10.0, seconds / max(elapsed_s, 1e-6)))


def copy_gigabytes_per_s(device: Any, *, megabytes: int, seconds: float) -> float:
    """Return how many bytes a second a copy within the device's memory reads and writes [GB/s]."""
    a, b = (wp.zeros(megabytes << 20, dtype=wp.uint8, device=device) for _ in range(2))
    return 2e-9 * (megabytes << 20) / seconds_per_call(lambda: wp.copy(a, b), device, seconds=seconds)


def host_gigabytes_per_s(device: Any, *, megabytes: int, seconds: float) -> float:
    """Return how many bytes a second get from a CUDA device to pinned memory of the host [GB/s]."""
    there = wp.zeros(megabytes << 20, dtype=wp.uint8, device=device)
    here = wp.empty_like(there, device="cpu", pinned=True)
    return 1e-9 * (megabytes << 20) / seconds_per_call(lambda: wp.copy(here, there), device, seconds=seconds)


def cast_alone(views: Views, *, seconds: float) -> Part:
    """Return what it takes to find what the rays hit, and write depth."""
    return _render_alone(views, BARE_CAST, "depth", seconds)


def render_alone(views: Views, *, seconds: float) -> Part:
    """Return what it takes to render log radiance."""
    return _render_alone(views, RENDER_ALONE, "log_radiance", seconds)


def _render_alone(views: Views, name: str, output: str, seconds: float) -> Part:
    renderer = views.renderer(output)
    launch_s = seconds_per_call(lambda: views.render(renderer), views.device, seconds=seconds)
    pixels = views.lens.width * views.lens.height
    rays = pixels * (views.arrays.config.samples_per_pixel if output == "log_radiance" else 1)
    return Part(
        name=name,
        per_step_us=1e6 * launch_s / views.count,
        bytes_per_step=16 * rays / views.count + 4 * pixels,  # rays once per launch, a float for each pixel
        rays_per_step=rays,
    )


def physics_alone(model: Model, *, seconds: float) -> Part:
    """Return what flight and control take, with closed eyes."""
    state = make_state(model)
    want(model, state, ())
    start(model, state)

    def fly() -> None:
        advance(model, state, batch_end_ns(model.schedule, state.launched_ns, model.duration_ns))

    for _ in range(4):
        fly()
    begin, begin_ns = time.perf_counter(), state.stamp_ns
    while time.perf_counter() - begin < seconds and model.duration_ns - state.launched_ns > 1e8:
        fly()
    elapsed_s = time.perf_counter() - begin
    steps = 1e-9 * (state.stamp_ns - begin_ns) * model.casts[0].rate.rate_hz
    return Part(name=PHYSICS_ALONE, per_step_us=1e6 * elapsed_s / steps)


class _Show:
    """Shows the views to a camera, forth and back, as often as one likes."""

    def __init__(self, views: Views, camera: EventCamera) -> None:
        self._views = views
        self._camera = camera
        camera.reset(views.frames[0], 0)
        self._stamps = np.arange(1, views.count + 1, dtype=np.int64) * FRAME_US * NS_PER_US
        self._shown = 0

    def feed(self) -> None:
        stack = self._views.back if self._shown % 2 else self._views.frames
        self._camera.feed_device(stack, self._stamps + self._shown * self._stamps[-1])
        self._shown += 1


def make_camera(views: Views, *, scan_count_max: int, on_host: bool = True) -> EventCamera:
    """Return an event camera for views, as configured by default."""
    return EventCamera(
        EventCameraConfig(),
        width=views.lens.width,
        height=views.lens.height,
        device=views.device,
        sensor="bench",
        scan_count_max=scan_count_max,
        on_host=on_host,
    )


def scan_alone(views: Views, *, seconds: float) -> tuple[Part, float]:
    """Return what the scan of a frame takes, stamped, interpolated, several events a pixel; and its events.

    A burst of scans is launched and waited for; their events are then thrown away, off the clock.
    """
    burst = 16
    camera = make_camera(views, scan_count_max=burst)
    times_s: list[float] = []
    show = _Show(views, camera)
    show.feed()
    show.feed()
    events = len(camera.collect().numpy().t) / (2 * views.count)
    begin = time.perf_counter()
    while len(times_s) < 3 or time.perf_counter() - begin < seconds:
        show = _Show(views, camera)
        wp.synchronize_device(views.device)
        started = time.perf_counter()
        for _ in range(burst):
            show.feed()
        wp.synchronize_device(views.device)
        times_s.append((time.perf_counter() - started) / (burst * views.count))
        camera.collect()
    pixels = views.lens.width * views.lens.height
    moved = 4 * pixels + 32 * pixels / views.count + 8 * events  # samples; state in and out; keys
    return Part(name=SCAN_ALONE, per_step_us=1e6 * float(np.median(times_s)), bytes_per_step=moved), events


def read_alone(views: Views, *, seconds: float) -> Part:
    """Return what sorting, decoding and copying the events of a step take, waiting included."""
    camera = make_camera(views, scan_count_max=1)
    show = _Show(views, camera)
    times_s: list[float] = []
    counts: list[float] = []
    begin = time.perf_counter()
    while len(times_s) < 5 or time.perf_counter() - begin < seconds:
        show.feed()
        wp.synchronize_device(views.device)
        started = time.perf_counter()
        counts.append(len(camera.collect().numpy().t) / views.count)
        times_s.append((time.perf_counter() - started) / views.count)
    events = float(np.mean(counts[2:]))
    return Part(
        name=READ_ALONE,
        per_step_us=1e6 * float(np.median(times_s[2:])),
        bytes_per_step=events * (2 * 8 + _SORT_PASSES * 2 * 12 + 8 + 2 * _COLUMN_BYTES),
    )


def compare_scans(views: Views, ours_per_s: float, ours_events: float, *, seconds: float) -> Comparison:
    """Return frames a second of our scan and of the naive camera, which has the host read each count."""
    naive = make_naive(views)
    frames = [*(views.frames[k] for k in range(views.count)), *(views.back[k] for k in range(views.count))]
    shown, counts = 0, 0

    def show() -> None:
        nonlocal shown, counts
        counts += naive.feed(frames[shown % len(frames)], shown * FRAME_US)
        shown += 1

    frame_s = seconds_per_call(show, views.device, seconds=seconds)
    return Comparison(
        name=SCAN,
        ours_per_s=ours_per_s,
        naive_per_s=1.0 / frame_s,
        ours_events=ours_events,
        naive_events=counts / shown,
    )


def make_naive(views: Views) -> NaiveEventCamera:
    """Return a naive camera with the same thresholds, that has seen the first frame."""
    config = EventCameraConfig()
    naive = NaiveEventCamera(
        width=views.lens.width,
        height=views.lens.height,
        threshold_on=config.threshold_on,
        threshold_off=config.threshold_off,
        device=views.device,
    )
    naive.reset(views.frames[0])
    return naive


def events_to_host_per_s(views: Views, *, seconds: float) -> float:
    """Return how many events a second reach the host, sorted, where every pixel fires in every frame.

    Two stacks are under way: while the events of one are read, the next is scanned.
    """
    camera = make_camera(views, scan_count_max=2)
    base = views.frames.numpy()[0]
    count_of_frames = min(views.count, _LOUD_FRAMES)
    steps = np.arange(1, count_of_frames + 1, dtype=np.float32)[:, None, None] * np.float32(_LOUD)
    up = base + steps
    down = up[-1] - steps
    stacks = [wp.array(stack, dtype=float, device=views.device) for stack in (up, down)]
    camera.reset(views.frames[0], 0)
    stamps: NDArray[np.int64] = np.arange(1, count_of_frames + 1, dtype=np.int64) * FRAME_US * NS_PER_US
    fed = 0

    def feed() -> None:
        nonlocal fed
        seen = stamps + fed * stamps[-1]
        camera.feed_device(stacks[fed % 2], seen)
        fed += 1

    def read() -> int:
        feed()
        end_ns = int((fed - 1) * stamps[-1])
        (packet,) = camera.collect_windows([end_ns], scan_count=1)
        return len(packet.numpy().t)

    feed()
    for _ in range(2):
        read()
    begin, count, calls = time.perf_counter(), 0, 0
    while calls < 3 or time.perf_counter() - begin < seconds:
        count += read()
        calls += 1
    return count / (time.perf_counter() - begin)
