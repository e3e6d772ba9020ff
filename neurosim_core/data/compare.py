"""Statistics of event files, and one page of plots that compares them: simulated against real, say."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurosim_core.install import need
from neurosim_core.io import open_events
from neurosim_core.packets import EventArrays
from neurosim_core.record.disk import naming_file

RATE_BIN_US = 10_000
"""Time between two points of the event rate [us]."""
FRAME_US = 20_000
"""Length of the windows whose spatial spectra are averaged [us]."""
INTERVAL_EDGES_US = np.geomspace(1.0, 1e7, 71)
"""Edges of the histogram of intervals between two events of a pixel [us]."""
_FRAMES_MAX = 400
_INK, _COLORS = "#1d2530", ("#1c7ed6", "#e8590c", "#2f9e44", "#845ef7", "#e03131", "#0c8599")


@dataclass(kw_only=True)
class EventStats:
    """Counts of one file, made in one pass and bounded memory."""

    name: str
    width: int
    """Of the sensor [px]."""
    height: int
    """Of the sensor [px]."""
    event_count: int = 0
    on_count: int = 0
    """Events that are brighter."""
    begin_us: int = 0
    """Time of the first event [us]."""
    end_us: int = 0
    """Time of the last event [us]."""
    rate_hz: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    """Events a second, in bins of `RATE_BIN_US` from the first event on [Hz]."""
    intervals: NDArray[np.int64] = field(
        default_factory=lambda: np.zeros(len(INTERVAL_EDGES_US) - 1, np.int64)
    )
    """Intervals between two events of a pixel, between `INTERVAL_EDGES_US`; 0 is in the first bin."""
    pixel_counts: NDArray[np.int64] = field(default_factory=lambda: np.zeros((0, 0), np.int64))
    """Events of each pixel, shape [H, W]."""
    spectrum: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    """Power of windows of `FRAME_US` by spatial frequency, averaged over directions; sums to 1."""
    frequency: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    """Of `spectrum` [cycles/px]."""
    notes: tuple[str, ...] = ()
    """Remarks on the file for the user."""

    @property
    def duration_s(self) -> float:
        """From the first to the last event [s]."""
        return (self.end_us - self.begin_us) * 1e-6

    @property
    def mean_rate_hz(self) -> float:
        """Events a second [Hz]."""
        return self.event_count / max(self.duration_s, 1e-6)

    @property
    def on_share(self) -> float:
        """Share of the events that are brighter."""
        return self.on_count / max(self.event_count, 1)

    @property
    def median_interval_us(self) -> float:
        """Median interval between two events of a pixel [us]; nan if none fires twice."""
        total = np.concatenate([[0], np.cumsum(self.intervals)])
        if not total[-1]:
            return float("nan")
        return float(np.exp(np.interp(0.5 * total[-1], total, np.log(INTERVAL_EDGES_US))))

    @property
    def silent_share(self) -> float:
        """Share of the pixels without events."""
        return float((self.pixel_counts == 0).mean()) if self.pixel_counts.size else 1.0

    @property
    def centroid(self) -> float:
        """Mean spatial frequency [cycles/px]: higher where edges are sharper, or noise is."""
        return float((self.frequency * self.spectrum).sum())


def measure_events(path: Path, *, size: tuple[int, int] | None = None, sensor: str = "") -> EventStats:
    """Return the statistics of a file of events of any format.

    `size`: width and height of the sensor [px], where the file does not say it. `sensor`: event camera, of
    files that hold several; empty: the first.
    """
    with closing(open_events(path, size=size, sensor=sensor)) as reader:
        stats = EventStats(name=path.name, width=reader.width, height=reader.height)
        counter = _Counter(stats)
        for events in reader.blocks():
            counter.add(events)
        counter.finish()
        stats.notes = tuple(reader.notes)
    return stats


class _Counter:
    """Counts the events of one file, block by block."""

    def __init__(self, stats: EventStats) -> None:
        self._stats = stats
        cells = stats.width * stats.height
        self._last_us = np.full(cells, -1, np.int64)
        self._pixels = np.zeros(cells, np.int64)
        self._rate = np.zeros(0, np.int64)
        self._frame: NDArray[np.float64] = np.zeros(cells)
        self._frame_number = 0
        self._power = np.zeros((stats.height, stats.width // 2 + 1))
        self._frame_count = 0

    def add(self, events: EventArrays) -> None:
        """Count a block."""
        stats = self._stats
        if not len(events.t):
            return
        if not stats.event_count:
            stats.begin_us = int(events.t[0])
        stats.event_count += len(events.t)
        stats.on_count += int(np.count_nonzero(events.polarity))
        stats.end_us = int(events.t[-1])
        after_us = events.t - stats.begin_us
        rate = np.bincount(after_us // RATE_BIN_US, minlength=len(self._rate))
        rate[: len(self._rate)] += self._rate
        self._rate = rate
        pixel = events.y.astype(np.intp) * stats.width + events.x
        self._pixels += np.bincount(pixel, minlength=len(self._pixels))
        self._add_intervals(events.t, pixel)
        self._add_frames(after_us // FRAME_US, pixel, events.polarity)

    def finish(self) -> None:
        """Work out what is not a plain count."""
        stats = self._stats
        self._end_frame()
        stats.rate_hz = self._rate / (RATE_BIN_US * 1e-6)
        stats.pixel_counts = self._pixels.reshape(stats.height, stats.width)
        stats.frequency, stats.spectrum = _radial(self._power, stats.width)

    def _add_intervals(self, t: NDArray[np.int64], pixel: NDArray[np.intp]) -> None:
        order = np.argsort(pixel, kind="stable")
        sorted_pixel, sorted_t = pixel[order], t[order]
        first = np.flatnonzero(np.diff(sorted_pixel, prepend=-1))
        before = np.concatenate([[0], sorted_t[:-1]])
        before[first] = self._last_us[sorted_pixel[first]]
        gap_us = np.maximum((sorted_t - before)[before >= 0], 1)
        counts, _ = np.histogram(np.minimum(gap_us, INTERVAL_EDGES_US[-1]), INTERVAL_EDGES_US)
        self._stats.intervals += counts
        last = np.append(first[1:], len(sorted_t)) - 1
        self._last_us[sorted_pixel[last]] = sorted_t[last]

    def _add_frames(
        self, number: NDArray[np.int64], pixel: NDArray[np.intp], polarity: NDArray[np.uint8]
    ) -> None:
        edges = np.flatnonzero(np.diff(number)) + 1
        sign = polarity * 2.0 - 1.0
        for begin, end in zip([0, *edges.tolist()], [*edges.tolist(), len(number)], strict=True):
            if int(number[begin]) != self._frame_number:
                self._end_frame()
                self._frame_number = int(number[begin])
            self._frame += np.bincount(pixel[begin:end], sign[begin:end], len(self._frame))

    def _end_frame(self) -> None:
        if self._frame_count < _FRAMES_MAX and self._frame.any():
            stats = self._stats
            frame = self._frame.reshape(stats.height, stats.width)
            window = np.hanning(stats.height)[:, None] * np.hanning(stats.width)[None]
            self._power += np.abs(np.fft.rfft2((frame - frame.mean()) * window)) ** 2
            self._frame_count += 1
        self._frame = np.zeros(len(self._frame))


def _radial(power: NDArray[np.float64], width: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the mean power in rings of spatial frequency up to 0.5 cycles/px, scaled to a sum of 1."""
    radius = np.hypot(np.fft.fftfreq(power.shape[0])[:, None], np.fft.rfftfreq(width)[None])
    count = max(4, min(power.shape[0], width) // 2)
    ring = np.minimum((radius * 2.0 * count).astype(int), count)
    sums, sizes = (np.bincount(ring.ravel(), weights, count) for weights in (power.ravel(), None))
    mean = (sums / np.maximum(sizes, 1))[:count]
    return (np.arange(count) + 0.5) / (2.0 * count), mean / max(float(mean.sum()), 1e-30)


def new_figure(width_in: float, height_in: float) -> Any:
    """Return an empty figure of matplotlib, of 100 px an inch."""
    figure = need("plots need matplotlib", "view", "matplotlib.figure")
    return figure.Figure(figsize=(width_in, height_in), dpi=100, layout="constrained")


def draw_comparison(stats: Sequence[EventStats], out: Path) -> None:
    """Draw a page that compares files, as PNG, PDF or SVG."""
    figure = new_figure(14.0, 9.0)
    grid = figure.add_gridspec(3, 6, height_ratios=[1.0, 1.0, 0.9])
    plots = [figure.add_subplot(grid[0, :]), figure.add_subplot(grid[1, :3]), figure.add_subplot(grid[1, 3:])]
    middles_us = np.sqrt(INTERVAL_EDGES_US[1:] * INTERVAL_EDGES_US[:-1])
    for one, color in zip(stats, _COLORS * len(stats), strict=False):
        label = f"{one.name}: {one.mean_rate_hz / 1e6:.3g} M/s, {100 * one.on_share:.0f} % brighter"
        times_s = (np.arange(len(one.rate_hz)) + 0.5) * RATE_BIN_US * 1e-6
        pixels = one.width * one.height
        plots[0].plot(times_s, np.maximum(one.rate_hz / pixels, 1e-9), color=color, lw=1.0, label=label)
        share = one.intervals / max(int(one.intervals.sum()), 1)
        plots[1].step(middles_us * 1e-3, share, color=color, where="mid", lw=1.4)
        plots[2].plot(one.frequency, np.maximum(one.spectrum, 1e-12), color=color, lw=1.4)
    label_axes(plots[0], "event rate of a pixel", "time since the first event [s]", "events a second")
    label_axes(plots[1], "time between two events of a pixel", "interval [ms]", "share", x="log")
    label_axes(plots[2], "spatial spectrum of 20 ms", "frequency [cycles/px]", "share of the power", y="log")
    plots[0].set_ylim(0.0, 1.25 * plots[0].get_ylim()[1])  # room for the legend
    plots[0].legend(loc="upper right", frameon=False, fontsize=9, ncols=-(-len(stats) // 3))
    shown = stats[: len(_COLORS)]
    width = 6 // max(1, min(len(shown), 6))
    for column, one in enumerate(shown):
        _draw_map(figure.add_subplot(grid[2, column * width : (column + 1) * width]), one)
    with naming_file(out):
        figure.savefig(out)


def label_axes(
    axes: Any, title: str, x_label: str, y_label: str, *, x: str = "linear", y: str = "linear"
) -> None:
    """Name a plot and its axes; `x` and `y` are their scales."""
    axes.set(xlabel=x_label, ylabel=y_label, xscale=x, yscale=y)
    axes.set_title(title, loc="left", color=_INK, fontsize=11, fontweight="bold")
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(color="#e9ecef")


def _draw_map(axes: Any, stats: EventStats) -> None:
    """Draw how often each pixel fires; black is the pixel at 99.5 %."""
    top = float(np.quantile(stats.pixel_counts, 0.995)) if stats.pixel_counts.size else 1.0
    axes.imshow(stats.pixel_counts, cmap="Greys", vmin=0.0, vmax=max(top, 1.0), interpolation="nearest")
    axes.set_title(f"{stats.name}\n{100 * stats.silent_share:.0f} % silent pixels", fontsize=10, color=_INK)
    axes.set_xticks([])
    axes.set_yticks([])
