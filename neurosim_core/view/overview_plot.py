"""The overview of a flight as one picture: what the sensors saw at one moment, how fast it went, and where.

Drawn with matplotlib into a file; needs no display.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurosim_core.install import install_hint
from neurosim_core.packets import Packet, as_numpy, schema_of
from neurosim_core.scene.scene import Scene
from neurosim_core.view.overview import EventView, FlightSummary, Snapshot, Track
from neurosim_core.view.pictures import OFF_SRGB, ON_SRGB, color_picture, event_picture, picture_of
from neurosim_core.view.plan import cut_plan
from neurosim_core.view.rerun_layout import PICTURES, title

WIDTH_PX, HEIGHT_PX = 1600, 900
"""Size of the picture for up to four panels [px]; each further row of three makes it higher."""

_DPI = 100
_INK = "#1d2530"
_FAINT = "#6b7682"
_XYZ = ("#e03131", "#2f9e44", "#1c7ed6", "#f08c00", "#845ef7", "#12b886")
# Layout in pixels from the top left corner: two columns of panels, then the plan; rows of three below.
_MARGIN = 40
_TOP = 124
_PANEL_W, _PANEL_H = 416, 312
_ROW_H = _PANEL_H + 84
_COLUMN_X = (_MARGIN, _MARGIN + _PANEL_W + 64)
_PLAN_X = _COLUMN_X[1] + _PANEL_W + 60
_LEGEND_Y = HEIGHT_PX - 78
_STRIPS_MAX = 4


def save_overview(
    path: str | Path,
    summary: FlightSummary,
    *,
    scene: Scene,
    track: Track | None = None,
    real_time_factor: float | None = None,
) -> None:
    """Draw a flight as one PNG of 1600 x 900 pixels, higher if there are many sensors.

    Left is a panel for each camera, one for each other sensor as its packets declare it by `display`, and
    numbers against time. Right is the path in the plan of the scene: surfaces cut at the median height of the
    flight as dark lines, cut lower as thin lines, what is below in its own colours; turned by a quarter where
    that fills the picture better.

    Args:
        path: File to write.
        summary: What was collected of the flight.
        scene: The scene that was flown in.
        track: Where the vehicle was, if that is not in the packets; may be empty.
        real_time_factor: Simulated time over wall-clock time, for the title.

    Raises:
        OSError: The file cannot be written.
        ImportError: matplotlib is not installed.
    """
    try:
        import matplotlib as mpl
        import matplotlib.figure
    except ImportError as error:
        raise ImportError(f"the overview picture needs matplotlib: {install_hint('view')}") from error
    style: dict[Any, Any] = {
        "font.size": 11,
        "text.color": _INK,
        "axes.edgecolor": _FAINT,
        "axes.labelcolor": _INK,
    }
    style |= {"xtick.color": _FAINT, "ytick.color": _FAINT, "axes.linewidth": 0.8}
    style |= {"font.family": "DejaVu Sans"}
    snapshot = summary.snapshot()
    track = summary.track() if track is None else track
    strips = _strips(summary, track)
    sensors = sorted([*snapshot.packets, *snapshot.events], key=lambda name: _rank(snapshot, name))
    others = len(sensors) + bool(summary.texts)
    more_rows = max(0, -(-(others + -(-len(strips) // _STRIPS_MAX) - 4) // 3))
    place_count = 4 + 3 * more_rows
    together = -(-len(strips) // max(1, min(place_count - others, len(strips) // 2)))
    with mpl.rc_context(style):
        page = _Page(mpl.figure.Figure(dpi=_DPI), HEIGHT_PX + more_rows * _ROW_H)
        _draw_title(page, scene, track, summary.event_count, real_time_factor)
        columns = [_COLUMN_X] * 2 + [(*_COLUMN_X, _PLAN_X)] * more_rows
        places = iter([(x, _TOP + row * _ROW_H) for row, beside in enumerate(columns) for x in beside])
        for name in sensors:
            _draw_sensor(page, next(places), name, snapshot)
        if summary.texts:
            _draw_texts(page, next(places), list(summary.texts))
        for begin in range(0, len(strips), max(1, together)):
            _draw_strips(page, next(places), strips[begin : begin + together], snapshot.stamp_ns)
        _draw_plan(page, scene, track, snapshot)
        page.figure.savefig(path, dpi=_DPI)


class _Page:
    """A figure on which things are placed in pixels from the top left corner."""

    def __init__(self, figure: Any, height_px: int) -> None:
        self.figure = figure
        self.height_px = height_px
        figure.set_size_inches(WIDTH_PX / _DPI, height_px / _DPI)

    def axes(self, x: float, y: float, width: float, height: float) -> Any:
        """Add axes at a place."""
        place = (x / WIDTH_PX, 1.0 - (y + height) / self.height_px, width / WIDTH_PX, height / self.height_px)
        return self.figure.add_axes(place)

    def text(self, x: float, y: float, text: str, **options: Any) -> None:
        """Write a text whose base line is at a place."""
        self.figure.text(x / WIDTH_PX, 1.0 - y / self.height_px, text, **options)

    def heading(
        self, x: float, y: float, text: str, *details: tuple[str, Any], width: float = _PANEL_W
    ) -> None:
        """Write a panel's title 10 px above it, and coloured details flush with its right border."""
        right = x + width
        for detail, color in reversed(details):
            self.text(right, y - 10, detail, fontsize=10.5, color=color, va="bottom", ha="right")
            right -= 7.6 * len(detail) + 10
        longest = int((right - x) / 10.0)
        text = text if len(text) <= longest else f"{text[: longest - 1]}…"
        self.text(x, y - 10, text, fontsize=12, fontweight="bold", va="bottom")


def _rank(snapshot: Snapshot, name: str) -> int:
    if name in snapshot.events:
        return PICTURES.index("events")
    packet = snapshot.packets[name]
    shown = schema_of(type(packet)).display in PICTURES
    return PICTURES.index(picture_of(packet)[0]) if shown else len(PICTURES)


def _strips(summary: FlightSummary, track: Track) -> list[tuple[str, Any, Any]]:
    """Return what is plotted against time: titles, times [s] and values [n, items]."""
    strips: list[tuple[str, Any, Any]] = []
    if len(track.stamp_ns):
        time_s = track.stamp_ns * 1e-9
        strips.append(("speed [m/s]", time_s, np.linalg.norm(track.velocity, axis=1)[:, None]))
        strips.append(("height [m]", time_s, track.position[:, 2:]))
    for series in summary.series():
        strips.append((f"{series.sensor}: {title(series.field)}", series.stamp_ns * 1e-9, series.values))
    return strips


def _draw_title(
    page: _Page, scene: Scene, track: Track, event_count: int, real_time_factor: float | None
) -> None:
    page.text(_MARGIN, 50, scene.name, fontsize=21, fontweight="bold")
    facts = []
    if len(track.stamp_ns) > 1:
        length_m = float(np.linalg.norm(np.diff(track.position, axis=0), axis=1).sum())
        speed = np.linalg.norm(track.velocity, axis=1)
        facts.append(f"{(track.stamp_ns[-1] - track.stamp_ns[0]) * 1e-9:.3g} s of flight")
        facts.append(f"{length_m:.1f} m")
        facts.append(f"up to {speed.max():.1f} m/s")
    if event_count:
        facts.append(f"{_short(event_count)} events")
    if real_time_factor is not None:
        facts.append(f"{real_time_factor:.2g} × real time")
    page.text(_MARGIN, 78, "   ·   ".join(facts), fontsize=12.5, color=_FAINT)


def _short(count: int) -> str:
    """Write a count with three digits: 1.23 M."""
    for unit, name in ((1e9, " G"), (1e6, " M"), (1e3, " k")):
        if count >= unit:
            return f"{count / unit:.3g}{name}"
    return str(count)


def _draw_sensor(page: _Page, place: tuple[float, float], name: str, snapshot: Snapshot) -> None:
    picture = name in snapshot.events or schema_of(type(snapshot.packets[name])).display in PICTURES
    left = 0 if picture else 40  # for the numbers at the axis
    axes = page.axes(place[0] + left, place[1], _PANEL_W - left, _PANEL_H)
    axes.set_anchor("N")
    axes.tick_params(length=3, labelsize=9.5, pad=2)
    stamp = (f"at {snapshot.stamp_ns * 1e-9:.2f} s", _FAINT)
    if name in snapshot.events:
        _draw_events(page, axes, place, name, snapshot.events[name])
        return
    packet = snapshot.packets[name]
    schema = schema_of(type(packet))
    if picture:
        _draw_picture(page, axes, place, name, packet, stamp)
        return
    varying = [f for f in schema.fields if f.varying]
    page.heading(*place, f"{name}: {title(varying[0])}", stamp)
    axes.spines[["top", "right"]].set_visible(False)
    if schema.display == "points":
        points = as_numpy(getattr(packet, next(f.name for f in varying if f.shape[1:] == (3,))))
        seen = points if varying[0].unit != "px" else as_numpy(getattr(packet, varying[0].name))
        axes.scatter(seen[:, 0], seen[:, 1], c=points[:, 2], s=3.0, cmap="viridis", linewidths=0)
        axes.set_aspect("equal", adjustable="datalim")
        if seen is not points:  # rows go down
            axes.invert_yaxis()
    else:
        axes.plot(as_numpy(getattr(packet, varying[0].name)), color=_XYZ[2], linewidth=1.4)
        axes.margins(x=0.0)


def _draw_events(page: _Page, axes: Any, place: tuple[float, float], name: str, view: EventView) -> None:
    on = int(view.events.polarity.sum())
    off = len(view.events.polarity) - on
    details = []
    for count, what, color in ((on, "on", ON_SRGB), (off, "off", OFF_SRGB)):
        details.append((f"{_short(count)} {what}", tuple(np.array(color) / 255.0)))
    page.heading(*place, f"{name}, {view.window_ns * 1e-6:g} ms", *details)
    _show(axes, event_picture(view.events, width=view.width, height=view.height))


def _draw_picture(
    page: _Page, axes: Any, place: tuple[float, float], name: str, packet: Packet, stamp: tuple[str, str]
) -> None:
    kind, data = picture_of(packet)
    if kind not in ("depth", "values"):
        page.heading(*place, name, stamp)
        _show(axes, color_picture(kind, data))
        return
    seen = data[np.isfinite(data)]
    low, high = (0.0, 1.0) if not seen.size else (float(seen.min()), float(np.percentile(seen, 99.5)))
    low = 0.0 if kind == "depth" else low
    unit = "metres" if kind == "depth" else schema_of(type(packet)).fields[0].unit
    nothing = "white: nothing hit" if kind == "depth" else "white: no value"
    unit = ", ".join(part for part in (unit, nothing if seen.size < data.size else "") if part)
    page.heading(*place, name, (unit, _FAINT), stamp)
    shown = np.where(np.isfinite(data), data, np.nan)
    cmap = "turbo" if kind == "depth" else "viridis"
    picture = _show(axes, shown, cmap=cmap, vmin=low, vmax=max(high, low + 1e-9))
    bar = axes.inset_axes((0.0, -0.065, 1.0, 0.035))
    extend = "max" if seen.size and seen.max() > high else "neither"
    page.figure.colorbar(picture, cax=bar, orientation="horizontal", extend=extend).outline.set_visible(False)
    bar.tick_params(length=3, labelsize=9.5, pad=2)


def _show(axes: Any, picture: NDArray[Any], **options: Any) -> Any:
    axes.set_xticks([])
    axes.set_yticks([])
    return axes.imshow(picture, interpolation="antialiased", **options)


def _draw_texts(page: _Page, place: tuple[float, float], texts: list[str]) -> None:
    page.heading(*place, "Texts")
    for row, text in enumerate(texts):
        cut = text if len(text) <= 62 else f"{text[:61]}…"
        page.text(place[0], place[1] + 16 + 24 * row, cut, fontsize=9.5, va="baseline")


def _draw_strips(
    page: _Page, place: tuple[float, float], strips: list[tuple[str, Any, Any]], stamp_ns: int
) -> None:
    """Draw numbers against time, one strip below the other."""
    x, y = place[0] + 34, place[1] - 8
    pitch = (_PANEL_H + 8) / len(strips)
    for row, (text, time_s, values) in enumerate(strips):
        axes = page.axes(x, y + row * pitch, _PANEL_W - 34, pitch - 26)
        count = values.shape[1]
        one = count == 1
        names = list(zip("xyz"[:count], _XYZ, strict=False)) if 1 < count <= 3 else []
        page.text(x, y + row * pitch - 4, text, fontsize=10.5, fontweight="bold", va="bottom")
        for place_of, (name, color) in enumerate(names):
            at = x + _PANEL_W - 34 - 14 * (count - 1 - place_of)
            page.text(at, y + row * pitch - 4, name, fontsize=10.5, color=color, ha="right", va="bottom")
        for column, color in zip(values.T, (_INK,) if one else 3 * _XYZ, strict=False):
            axes.plot(time_s, column, color=color, linewidth=1.6 if one else 1.0, solid_capstyle="round")
        axes.margins(x=0.0, y=0.12)
        finite = values[np.isfinite(values)]
        if finite.size and 0.0 <= finite.min() <= 0.5 * finite.max():  # else 0 would flatten the curve
            axes.set_ylim(0.0, 1.12 * max(float(finite.max()), 1e-9))
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(axis="y", color="#e3e7ea", linewidth=0.8)
        axes.set_axisbelow(True)
        axes.ticklabel_format(axis="y", useOffset=False)  # it would be below the title
        axes.locator_params(axis="y", nbins=3 if len(strips) > 2 else 4)
        axes.tick_params(length=3, labelsize=9.5, labelbottom=row == len(strips) - 1)
        axes.axvline(stamp_ns * 1e-9, color=_INK, linewidth=0.9, linestyle=(0, (3, 3)))
    axes.set_xlabel("s", labelpad=1)


def _draw_plan(page: _Page, scene: Scene, track: Track, snapshot: Snapshot) -> None:
    from matplotlib.collections import LineCollection, PolyCollection

    width, height = WIDTH_PX - _PLAN_X - _MARGIN, _LEGEND_Y - _TOP - 22
    bounds = scene.bounds_m
    height_m = float(np.median(track.position[:, 2])) if len(track.position) else float(bounds[:, 2].mean())
    plan = cut_plan(scene, height_m=height_m)
    axes = page.axes(_PLAN_X, _TOP, width, height)
    axes.axis("off")

    size = plan.bounds[1] - plan.bounds[0]
    turned = _fit(size[::-1], width, height) > _fit(size, width, height)
    directions = "x up, y left" if turned else "x right, y up"
    detail = f"plan cut at {height_m:.2f} m, {directions}"
    page.heading(_PLAN_X, _TOP, "Path", (detail, _FAINT), width=width)

    def place(points: NDArray[np.float64]) -> Any:
        """World (x, y) to the paper: x right and y up, or turned so that x is up and y left."""
        return np.stack([-points[..., 1], points[..., 0]], axis=-1) if turned else points

    light = 1.0 - 0.7 * (1.0 - plan.colors)  # paler than the path
    below = PolyCollection(
        place(plan.triangles), facecolors=light, edgecolors=light, linewidths=0.4, zorder=1
    )
    axes.add_collection(below, autolim=False)
    for outlines, ink, line_width in ((plan.low_outlines, _FAINT, 0.5), (plan.outlines, _INK, 1.1)):
        lines = LineCollection(place(outlines), colors=ink, linewidths=line_width, capstyle="round", zorder=2)
        axes.add_collection(lines, autolim=False)
    corners = place(plan.bounds)
    low, high = corners.min(axis=0), corners.max(axis=0)
    axes.set_xlim(low[0] - 0.02 * size.max(), high[0] + 0.02 * size.max())
    axes.set_ylim(low[1] - 0.02 * size.max(), high[1] + 0.02 * size.max())
    axes.set_aspect("equal", adjustable="box", anchor="N")
    if len(track.position) > 1:
        _draw_path(page, axes, track, snapshot, place, float(size.max()))
    _draw_scale_bar(page, axes, float(size.max()))


def _fit(size: NDArray[np.float64], width: float, height: float) -> float:
    """How many pixels a metre gets if the whole is to fit."""
    return float(min(width / max(size[0], 1e-9), height / max(size[1], 1e-9)))


def _draw_path(page: _Page, axes: Any, track: Track, snapshot: Snapshot, place: Any, size_m: float) -> None:
    from matplotlib.collections import LineCollection, PolyCollection
    from matplotlib.patches import Polygon

    step = max(1, len(track.position) // 2000)
    points = place(track.position[::step, :2])
    speed = np.linalg.norm(track.velocity[::step], axis=1)
    segments: Any = np.stack([points[:-1], points[1:]], axis=1)
    casing = LineCollection(segments, colors="white", linewidths=6.0, capstyle="round", zorder=3)
    line = LineCollection(segments, cmap="plasma", linewidths=3.2, capstyle="round", zorder=5)
    line.set_array(0.5 * (speed[:-1] + speed[1:]))
    line.set_clim(0.0, max(float(speed.max()), 1e-3))
    axes.add_collection(casing)
    axes.add_collection(line)

    # Where the camera looks: arrow heads along the path, and its view at the moment of the pictures.
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(track.position, axis=0), axis=1))])
    spacing_m = max(along[-1] / 16, 0.04 * size_m)
    marks = np.unique(np.searchsorted(along, np.arange(0.5 * spacing_m, along[-1], spacing_m)))
    heading = track.heading / np.maximum(np.linalg.norm(track.heading, axis=1, keepdims=True), 1e-9)
    ahead = 0.011 * size_m * heading[marks]
    aside = 0.6 * np.stack([-ahead[:, 1], ahead[:, 0]], axis=1)
    corners = [ahead, aside - ahead, -0.5 * ahead, -aside - ahead]
    arrows = place(track.position[marks, None, :2] + np.stack(corners, axis=1))
    axes.add_collection(
        PolyCollection(arrows, facecolors=_INK, edgecolors="white", linewidths=0.7, zorder=5.5)
    )
    now = int(np.argmin(np.abs(track.stamp_ns - snapshot.stamp_ns)))
    angle = np.arctan2(heading[now, 1], heading[now, 0]) + np.linspace(-0.6, 0.6, 13)
    arc = track.position[now, :2] + 0.09 * size_m * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    wedge = place(np.concatenate([track.position[now : now + 1, :2], arc]))
    axes.add_patch(Polygon(wedge, closed=True, facecolor="#f59f00", edgecolor="none", alpha=0.45, zorder=2.5))
    axes.plot(*wedge[0], marker="o", markersize=6, color=_INK, zorder=7)
    # The names stand on the far sides of the two ends, so that both can be read where a flight is short.
    far = np.where(points[0] <= points[-1], -1, 1)
    for index, text, color, (right, up) in ((0, "start", "#2b8a3e", far), (-1, "end", "#c92a2a", -far)):
        axes.plot(*points[index], marker="o", markersize=9, color=color, mec="white", mew=1.6, zorder=6)
        axes.annotate(
            text,
            points[index],
            xytext=(9 * right, 9 * up),
            ha="left" if right > 0 else "right",
            va="bottom" if up > 0 else "top",
            textcoords="offset points",
            fontsize=10.5,
            fontweight="bold",
            color=color,
            zorder=8,
            bbox={"boxstyle": "round,pad=0.2", "facecolor": "white", "edgecolor": "none", "alpha": 0.75},
        )
    bar = page.axes(WIDTH_PX - _MARGIN - 180, _LEGEND_Y, 180, 10)
    page.figure.colorbar(line, cax=bar, orientation="horizontal").outline.set_visible(False)
    bar.tick_params(length=3, labelsize=9.5, pad=2)
    options = {"fontsize": 10.5, "color": _FAINT, "va": "center"}
    page.text(WIDTH_PX - _MARGIN - 190, _LEGEND_Y + 5, "speed [m/s]", ha="right", **options)


def _draw_scale_bar(page: _Page, axes: Any, size_m: float) -> None:
    """Draw a bar of a round length at the bottom left of the plan."""
    lengths = [m * 10.0**power for power in range(-2, 3) for m in (1.0, 2.0, 5.0)]
    length_m = max((m for m in lengths if m <= size_m / 5), default=lengths[0])
    axes.apply_aspect()
    shown = axes.get_window_extent().width / (axes.get_xlim()[1] - axes.get_xlim()[0])  # pixels a metre
    bar = page.axes(_PLAN_X, _LEGEND_Y + 2, length_m * shown, 6)
    bar.set_xticks([])
    bar.set_yticks([])
    bar.set_facecolor(_INK)
    options = {"fontsize": 10.5, "color": _FAINT, "va": "center"}
    page.text(_PLAN_X + length_m * shown + 10, _LEGEND_Y + 5, f"{length_m:g} m", **options)
