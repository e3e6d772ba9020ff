"""Frames of light to events: the pixels of a simulated event camera look at a video.

    frames -> crop, area averages (linear light) -> log(luminance + dark floor) -> EventCamera -> HDF5

Between two frames log radiance is linear in time, as everywhere in Neurosim. So a video must be fast enough:
what moves by more than about a pixel between two frames makes the events of a cross-fade, not of a motion.
Whether it is fast enough is measured: a second camera looks at every second frame (`Conversion.halved_loss`),
and pixels that fire often in one interval are counted (`Conversion.burst_share`). Memory is bounded: frames
are read a few at a time, one stack ahead of the events.
"""

from __future__ import annotations

import itertools
import json
import math
import time
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
import warp as wp
import yaml
from numpy.typing import NDArray
from pydantic import Field, field_validator

from neurosim_core import __version__
from neurosim_core.clock import NS_PER_S, NS_PER_US
from neurosim_core.convert.frames import Description, Frame, Source, open_source, read_stamps
from neurosim_core.convert.geometry import Crop, Resizer, largest_crop, read_crop, read_size
from neurosim_core.convert.light import TRANSFERS, code_step, find_floor
from neurosim_core.io.event_file import check_new
from neurosim_core.packets import Events
from neurosim_core.record import RecordingHeader, RecordingWriter, SensorDescription
from neurosim_core.render.config import RenderConfig
from neurosim_core.sensors.event_config import EventCameraConfig, event_presets
from neurosim_core.sensors.events import EventCamera
from neurosim_core.settings import BaseConfig

SENSOR = "events"
"""Name of the camera in the file."""
BURST_COUNT = 4
"""So many events of a pixel between two frames are many."""

_STAMP_MAX_NS = 1 << 62
_OTHER_UNIT = "are the times in another unit? --time-unit says which"
_ENLARGE_MAX = 16
_STACK_BYTES = 64_000_000
_STACK_FRAMES_MAX = 32
_CODE_STEP_MAX = 0.5
"""Largest change of log radiance by one step of the stored numbers, in thresholds."""


class ConversionConfig(BaseConfig):
    """Conversion of a video to events."""

    pixel: EventCameraConfig = EventCameraConfig()
    """Pixel model: thresholds and noise."""
    size: str | None = None
    """Width and height of the sensor, such as 346x260: pictures are averaged to it, in linear light, or
    interpolated where they are smaller. "preset": those of the sensor that `pixel.preset` names. null: those
    of the video."""
    crop: str | None = None
    """Part of the picture to convert, WIDTHxHEIGHT+X+Y in pixels; null: all of it."""
    fit: Literal["crop", "stretch"] = "crop"
    """Where `size` has another aspect ratio than the picture: crop it around its middle, or stretch it."""
    fps: Annotated[float, Field(gt=0.0, le=1e6)] | None = None
    """Frame rate [Hz]; null: the times in the video."""
    timestamps: str | None = None
    """File with the time of each frame, one per line; null: see `fps`."""
    time_unit: Literal["s", "ms", "us", "ns"] = "s"
    """Unit of the numbers in `timestamps`."""
    slow_motion: Annotated[float, Field(gt=0.0, le=1e6)] = 1.0
    """Factor by which the video plays slower than the world: all times are divided by it. A video filmed at
    240 Hz that plays at 30 Hz has 8; one that plays faster has less than 1."""
    transfer: str = "auto"
    """Transfer function of pixel values: srgb, bt709, linear, gamma22, gamma28, smpte240m, log100, log316,
    pq, hlg; or auto: as the file says, else sRGB."""
    dark_floor: Annotated[float, Field(gt=0.0, le=1.0)] | None = None
    """Luminance that is added before the logarithm, white is 1. null: 0.001, as rendered scenes have, or as
    much more as it takes for one step of the stored numbers to be at most half a threshold."""
    seed: Annotated[int, Field(ge=0, lt=1 << 64)] = 0
    """Seed of the pixel noise."""

    @field_validator("transfer")
    @classmethod
    def _transfer_is_known(cls, name: str) -> str:
        if name not in ("auto", *TRANSFERS):
            raise ValueError(f"must be one of auto, {', '.join(TRANSFERS)}, got {name!r}")
        return name


class _Stack(NamedTuple):
    log_radiance: NDArray[np.float32]
    """Shape [K, H, W]."""
    stamps_ns: NDArray[np.int64]
    """From the first frame, shape [K]."""


@dataclass(frozen=True, kw_only=True)
class ConversionPlan:
    """The plan of a conversion, made before the first frame."""

    crop: Crop
    """What is taken of the pictures."""
    width: int
    """Of the sensor [px]."""
    height: int
    """Of the sensor [px]."""
    dark_floor: float
    """Luminance that is added before the logarithm, white is 1."""
    code_step: float
    """Largest change of log radiance by one step of the stored numbers."""
    threshold: float
    """The smaller of the two thresholds, in log radiance."""
    slow_motion: Fraction
    """How much slower than the world the video runs."""
    stack_length: int
    """Frames that are in memory at a time."""


@dataclass(kw_only=True)
class Conversion:
    """The result of a conversion."""

    source: Description
    plan: ConversionPlan
    pixel: EventCameraConfig
    """The law of the pixels."""
    frame_count: int = 0
    duration_ns: int = 0
    """From the first frame to the last."""
    interval_min_ns: int = 1 << 62
    """Shortest time between two frames."""
    interval_max_ns: int = 0
    """Longest time between two frames."""
    event_count: int = 0
    on_count: int = 0
    """Events of polarity 1."""
    dropped_count: int = 0
    active_count: int = 0
    """Pixels that fired between two frames, summed over the intervals."""
    burst_count: int = 0
    """Those of them that fired `BURST_COUNT` times or more."""
    halved_loss: float = math.nan
    """Share of the events that would be missing if every second frame were; nan if there are none. As many or
    more are missing now for want of the frames between these. On a flight through the default apartment, seen
    with 173x130 px, this was 6, 11, 20, 29, 31 % at 500, 250, 100, 50, 29 Hz; the events of the simulator at
    1 kHz show that 6, 12, 25, 40, 53 % were missing."""
    wall_s: float = 0.0
    """Time that it took [s]."""
    complete: bool = False
    """Whether it came to the end of the video."""

    @property
    def burst_share(self) -> float:
        """Share of the pixels that fire between two frames which do so `BURST_COUNT` times or more.

        What they saw took less than an interval, so their times are those of a cross-fade. nan if none fires.
        """
        return self.burst_count / self.active_count if self.active_count else math.nan

    @property
    def real_time_factor(self) -> float:
        """Time of the video over time that it took."""
        return self.duration_ns / NS_PER_S / self.wall_s

    def add(self, stack: _Stack, packets: list[Events]) -> None:
        """Count the frames of a stack and their events."""
        stamps = stack.stamps_ns if self.frame_count == 0 else np.append(self.duration_ns, stack.stamps_ns)
        intervals = np.diff(stamps)
        self.interval_min_ns = min(self.interval_min_ns, int(intervals.min()))
        self.interval_max_ns = max(self.interval_max_ns, int(intervals.max()))
        self.frame_count += len(stack.stamps_ns)
        self.duration_ns = int(stamps[-1])
        for events in packets:
            self.event_count += len(events)
            self.dropped_count += events.dropped_count
            arrays = events.numpy()
            self.on_count += int(np.count_nonzero(arrays.polarity))
            of_pixel = np.bincount(arrays.y.astype(np.int64) * events.width + arrays.x)
            self.active_count += int(np.count_nonzero(of_pixel))
            self.burst_count += int(np.count_nonzero(of_pixel >= BURST_COUNT))


def convert_video(
    path: str | Path,
    out: str | Path,
    config: ConversionConfig | None = None,
    *,
    overwrite: bool = False,
    device: str = "auto",
    stack_length: int | None = None,
    on_start: Callable[[Description], None] | None = None,
    on_stack: Callable[[int, int, int], None] | None = None,
    stopped: Callable[[], bool] | None = None,
) -> Conversion:
    """Write the events of a video or a folder of pictures as the HDF5 file that `neurosim run` writes.

    Times count from the first frame. There is one packet of events for each interval between two frames.
    What was converted stays in the file if `stopped` says so, or if there is an error later than in the first
    frames; after an error the file is marked as not complete.

    Args:
        path: A video of any kind that FFmpeg reads, or a folder of pictures.
        out: The file to write.
        config: How; None: the defaults.
        overwrite: Replace a file that is there.
        device: Where the pixels are; auto: a GPU if there is one.
        stack_length: Frames that are in memory at a time; None: as many as take 64 MB, at most 32. The
            events do not depend on it.
        on_start: Told about the source, once it is open.
        on_stack: Told how many frames and events there are so far, and the time of the last frame [ns].
        stopped: Asked after each stack whether to end here.
    """
    config = config or ConversionConfig()
    out = Path(out)
    if out.is_dir():
        raise IsADirectoryError(f"the events go to a file, got the folder {out}")
    check_new(out, overwrite=overwrite)
    begin = time.perf_counter()
    source = _open(Path(path), config)
    plan = _make_plan(source, config, stack_length)
    if on_start is not None:
        on_start(source.description)
    camera = _make_camera(config.pixel, plan, seed=config.seed, device=device)
    at_once = config.pixel.model_copy(update={"readout": None})
    every_second = _EverySecond(_make_camera(at_once, plan, seed=config.seed, device=device))
    stacks = _ahead(_stacks(source, plan))
    first = next(stacks)
    done = Conversion(source=source.description, plan=plan, pixel=config.pixel)
    _require_near(camera, done, first)
    writer = RecordingWriter(out, _header(source.description, config, plan, first))
    closed = False
    try:
        for stack in itertools.chain([first], stacks):
            _require_near(camera, done, stack)
            packets = _see(camera, stack)
            for events in packets:
                writer.write(events)
            done.add(stack, packets)
            every_second.add(stack, packets)
            if on_stack is not None:
                on_stack(done.frame_count, done.event_count, done.duration_ns)
            if stopped is not None and stopped():
                break
        else:
            done.complete = True
        closed = True
    finally:
        stacks.close()
        writer.close(complete=closed)
        if done.frame_count == 0:
            out.unlink()
    done.halved_loss = every_second.loss
    done.wall_s = time.perf_counter() - begin
    return done


def _make_camera(pixel: EventCameraConfig, plan: ConversionPlan, *, seed: int, device: str) -> EventCamera:
    if device == "auto":
        device = "cuda:0" if wp.get_cuda_device_count() else "cpu"
    return EventCamera(
        pixel,
        width=plan.width,
        height=plan.height,
        device=device,
        sensor=SENSOR,
        seed=seed,
        on_host=True,
    )


def _open(path: Path, config: ConversionConfig) -> Source:
    stamps_ns = None
    if config.timestamps is not None:
        stamps_ns = read_stamps(Path(config.timestamps), unit=config.time_unit)
    return open_source(path, fps=config.fps, stamps_ns=stamps_ns, transfer=config.transfer)


def _make_plan(source: Source, config: ConversionConfig, stack_length: int | None) -> ConversionPlan:
    known = source.description
    crop = Crop(known.width, known.height) if config.crop is None else read_crop(config.crop)
    size = _wanted_size(config, crop)
    if config.fit == "crop":
        crop = largest_crop(crop, size)
    threshold = _threshold(config.pixel)
    floor = config.dark_floor
    if floor is None:
        floor = find_floor(known.codes, _CODE_STEP_MAX * threshold, least=RenderConfig().dark_floor)
    length = max(1, min(_STACK_FRAMES_MAX, _STACK_BYTES // (4 * size[0] * size[1])))
    return ConversionPlan(
        crop=crop,
        width=size[0],
        height=size[1],
        dark_floor=floor,
        code_step=code_step(known.codes, floor),
        threshold=threshold,
        slow_motion=Fraction(str(config.slow_motion)),
        stack_length=length if stack_length is None else max(1, stack_length),
    )


def _wanted_size(config: ConversionConfig, crop: Crop) -> tuple[int, int]:
    if config.size is None:
        return crop.width, crop.height
    if config.size != "preset":
        size = read_size(config.size)
    elif config.pixel.preset is None:
        raise ValueError("size preset needs a preset: --preset davis346, or another")
    else:
        sensor = event_presets()[config.pixel.preset]
        size = sensor["width"], sensor["height"]
    if size[0] > _ENLARGE_MAX * crop.width or size[1] > _ENLARGE_MAX * crop.height:
        raise ValueError(
            f"size must be at most {_ENLARGE_MAX} times the {crop.width}x{crop.height} pixels there are, "
            f"got {size[0]}x{size[1]}"
        )
    return size


def _threshold(pixel: EventCameraConfig) -> float:
    """Return the smaller of the two thresholds, in log radiance."""
    if pixel.stochastic is not None:
        return 1.0 / pixel.stochastic.k1
    return min(pixel.threshold_on, pixel.threshold_off)


def _ahead(stacks: Iterator[_Stack]) -> Generator[_Stack, None, None]:
    """Yield what an iterator yields, while a thread already works on the next."""
    with ThreadPoolExecutor(1, thread_name_prefix="frames") as pool:
        coming = pool.submit(next, stacks, None)
        while (stack := coming.result()) is not None:
            coming = pool.submit(next, stacks, None)
            yield stack


def _stacks(source: Source, plan: ConversionPlan) -> Iterator[_Stack]:
    """Yield the frames of a source as stacks of log radiance; the first has two frames at least."""
    known = source.description
    resizer = Resizer((known.width, known.height), plan.crop, (plan.width, plan.height))
    frames = _in_order(source, plan.slow_motion)
    length = max(plan.stack_length, 2)
    while rows := list(itertools.islice(frames, length)):
        if len(rows) == 1 and rows[0].stamp_ns == 0:
            raise ValueError(f"{known.name} has one frame only; events need two or more")
        log = np.empty((len(rows), plan.height, plan.width), dtype=np.float32)
        for row, frame in zip(log, rows, strict=True):
            np.log(resizer.resize(frame.luminance) + np.float32(plan.dark_floor), out=row)
        yield _Stack(log, np.array([frame.stamp_ns for frame in rows], dtype=np.int64))
        length = plan.stack_length


def _in_order(source: Source, slow_motion: Fraction) -> Iterator[Frame]:
    """Yield frames with times in the world from the first, and see that these increase."""
    origin_ns = last_ns = 0
    for number, frame in enumerate(source.frames()):
        if number == 0:
            origin_ns = frame.stamp_ns
        stamp_ns = round((frame.stamp_ns - origin_ns) / slow_motion)
        if number > 0 and stamp_ns - last_ns < NS_PER_US:
            here_s, before_s = stamp_ns / NS_PER_S, last_ns / NS_PER_S
            raise ValueError(
                f"times must increase by at least 1 us from frame to frame: frame {number} of"
                f" {source.description.name} is at {here_s:.9g} s, after {before_s:.9g} s;"
                " --fps gives other times"
            )
        if stamp_ns > _STAMP_MAX_NS:
            raise ValueError(
                f"frame {number} of {source.description.name} is {stamp_ns / NS_PER_S:.6g} s after the first:"
                f" {_OTHER_UNIT}"
            )
        last_ns = stamp_ns
        yield Frame(stamp_ns, frame.luminance)


def _see(camera: EventCamera, stack: _Stack) -> list[Events]:
    """Return the events of a stack, a packet for each interval between two frames."""
    log, ends = stack.log_radiance, [int(stamp) for stamp in stack.stamps_ns]
    if ends[0] == 0:
        camera.reset(log[0], 0)
        log, ends = log[1:], ends[1:]
    if not ends:
        return []
    frames: Any = wp.array(log, dtype=wp.float32, device=camera.device, copy=False)
    camera.feed_device(frames, ends)
    return camera.collect_windows(ends)


def _require_near(camera: EventCamera, done: Conversion, stack: _Stack) -> None:
    """Raise ValueError if a stack reaches further than the camera can tell times apart."""
    spans_ns = stack.stamps_ns - done.duration_ns
    if spans_ns[-1] < camera.span_max_ns:
        return
    row = int(np.argmax(spans_ns >= camera.span_max_ns))
    limit_s = camera.span_max_ns / NS_PER_S
    raise ValueError(
        f"frame {done.frame_count + row} of {done.source.name} is {spans_ns[row] / NS_PER_S:.6g} s after "
        f"frame {max(done.frame_count - 1, 0)}, at most {limit_s:.4g} s are allowed: {_OTHER_UNIT}"
    )


class _EverySecond:
    """A camera that looks at every second frame, to see how many events that costs."""

    def __init__(self, camera: EventCamera) -> None:
        self._camera = camera
        self._frame_count = 0
        self._pending_count = 0
        self._full_count = 0
        self._half_count = 0

    @property
    def loss(self) -> float:
        """Share of the events that every second frame does not have."""
        return 1.0 - self._half_count / self._full_count if self._full_count else math.nan

    def add(self, stack: _Stack, packets: list[Events]) -> None:
        """Take a stack, and the packets of the camera that sees all of it."""
        counts = np.array([len(events) + events.dropped_count for events in packets])
        rows = np.arange(self._frame_count % 2, len(stack.stamps_ns), 2)
        self._frame_count += len(stack.stamps_ns)
        self._pending_count += int(counts.sum())
        if len(rows) == 0:
            return
        late = len(stack.stamps_ns) - 1 - int(rows[-1])  # frames after the last that is looked at
        late_count = int(counts[len(counts) - late :].sum())
        self._full_count += self._pending_count - late_count
        self._pending_count = late_count
        taken = _Stack(stack.log_radiance[rows], stack.stamps_ns[rows])
        self._half_count += sum(len(events) + events.dropped_count for events in _see(self._camera, taken))


def _header(
    source: Description, config: ConversionConfig, plan: ConversionPlan, first: _Stack
) -> RecordingHeader:
    """Return what goes with the events: what was converted, and how."""
    seen = {
        "source": source.name,
        "light": source.light,
        "width": source.width,
        "height": source.height,
        "crop": str(plan.crop),
        "dark_floor": plan.dark_floor,
    }
    settings = {"kind": "event_camera", "pixel": config.pixel.model_dump(mode="json")}
    rate_hz = (len(first.stamps_ns) - 1) * NS_PER_S / int(first.stamps_ns[-1])
    camera = SensorDescription(
        name=SENSOR, kind="event_camera", rate_hz=rate_hz, settings=json.dumps(settings)
    )
    return RecordingHeader(
        config_yaml=yaml.safe_dump(
            {"conversion": {**config.model_dump(mode="json"), **seen}}, sort_keys=False
        ),
        seed=config.seed,
        version=__version__,
        scene=source.name,
        sensors=(camera,),
    )
