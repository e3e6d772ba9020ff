"""The overview of a flight as one picture: what the sensors saw at one moment, how fast it went, and where.

Drawn with matplotlib into a file; needs no display.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurosim_core.install import need
from neurosim_core.packets import Events, Packet, as_numpy, schema_of
from neurosim_core.scene.scene import Scene
from neurosim_core.view.overview import FlightSummary, Snapshot, Track
from neurosim_core.view.pictures import OFF_SRGB, ON_SRGB, color_picture, event_picture, picture_of
from neurosim_core.view.plan import cut_plan
from neurosim_core.view.rerun_layout import PICTURES, title

_SIZE_IN = (16.0, 9.0)
"""Of the picture for up to four panels [inch, 100 px]; each further row of three makes it higher."""
_ROW_IN = 4.0
_INK = "#1d2530"
_FAINT = "#6b7682"
_XYZ = ("#e03131", "#2f9e44", "#1c7ed6", "#f08c00", "#845ef7", "#12b886")
_STRIPS_MAX = 4
_ROUNDING = 1e-9
"""Numbers that are all smaller than this are drawn as 0: rates of a vehicle that stands, say."""
_NARROW = 0.5
"""A plan has less than this of its height as its width where its titles would run into each other."""
_STYLE: dict[Any, Any] = {
    "axes.edgecolor": _FAINT,
    "axes.labelcolor": _INK,
    "axes.linewidth": 0.8,
    "axes.titlesize": 11,
    "font.family": "DejaVu Sans",
    "font.size": 10,
    "text.color": _INK,
    "xtick.color": _FAINT,
    "ytick.color": _FAINT,
}


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
    that fills the picture better. `track`: where the vehicle was, if that is not in the packets; may be
    empty. `real_time_factor`: simulated time over wall-clock time, for the title.
    """
    mpl = need("the overview picture needs matplotlib", "view", "matplotlib", "matplotlib.figure")
    snapshot = summary.snapshot()
    track = summary.track() if track is None else track
    strips = _strips(summary, track)
    sensors = sorted(snapshot.packets, key=lambda name: _rank(snapshot.packets[name]))
    others = len(sensors) + bool(summary.texts)
    more_rows = max(0, -(-(others + -(-len(strips) // _STRIPS_MAX) - 4) // 3))
    together = max(1, -(-len(strips) // max(1, min(4 + 3 * more_rows - others, len(strips) // 2))))
    with mpl.rc_context(_STYLE):
        size_in = (_SIZE_IN[0], _SIZE_IN[1] + more_rows * _ROW_IN)
        place = (0.015, 0.015, 0.97, 0.97 - 0.9 / size_in[1])  # below the title
        layout = mpl.layout_engine.ConstrainedLayoutEngine(rect=place, wspace=0.04)
        figure = mpl.figure.Figure(figsize=size_in, dpi=100, layout=layout)
        _write_title(figure, scene, track, summary.event_count, real_time_factor)
        grid = figure.add_gridspec(2 + more_rows, 3, width_ratios=(1.0, 1.0, 1.25))
        places = iter([grid[row, k] for row in range(2 + more_rows) for k in range(2 + (row > 1))])
        for name in sensors:
            _draw_sensor(figure.add_subplot(next(places), anchor="N"), name, snapshot)
        if summary.texts:
            axes = figure.add_subplot(next(places))
            axes.set_title("Texts", loc="left", fontweight="bold")
            axes.axis("off")
            axes.text(0.0, 1.0, "\n".join(text[:62] for text in summary.texts), va="top", fontsize=9)
        for begin in range(0, len(strips), together):
            _draw_strips(figure, next(places), strips[begin : begin + together], snapshot.stamp_ns)
        _draw_plan(figure.add_subplot(grid[:2, 2], anchor="N"), scene, track, snapshot)
        figure.savefig(path)


def _rank(packet: Packet) -> int:
    if isinstance(packet, Events):
        return PICTURES.index("events")
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


def _write_title(
    figure: Any, scene: Scene, track: Track, event_count: int, real_time_factor: float | None
) -> None:
    facts = []
    if len(track.stamp_ns) > 1:
        length_m = float(np.linalg.norm(np.diff(track.position, axis=0), axis=1).sum())
        facts.append(f"{(track.stamp_ns[-1] - track.stamp_ns[0]) * 1e-9:.3g} s of flight")
        facts.append(f"{length_m:.1f} m")
        facts.append(f"up to {np.linalg.norm(track.velocity, axis=1).max():.1f} m/s")
    if event_count:
        facts.append(f"{_short(event_count)} events")
    if real_time_factor is not None:
        facts.append(f"{real_time_factor:.2g} × real time")
    height_in = figure.get_figheight()
    figure.text(0.025, 1.0 - 0.5 / height_in, scene.name, fontsize=21, fontweight="bold")
    figure.text(0.025, 1.0 - 0.8 / height_in, "   ·   ".join(facts), fontsize=12.5, color=_FAINT)


def _short(count: int) -> str:
    """Write a count with three digits: 1.23 M."""
    for unit, name in ((1e9, " G"), (1e6, " M"), (1e3, " k")):
        if count >= unit:
            return f"{count / unit:.3g}{name}"
    return str(count)


def _draw_sensor(axes: Any, name: str, snapshot: Snapshot) -> None:
    packet = snapshot.packets[name]
    if isinstance(packet, Events):
        _draw_events(axes, packet)
        return
    schema = schema_of(type(packet))
    axes.set_title(f"at {snapshot.stamp_ns * 1e-9:.2f} s", loc="right", color=_FAINT)
    if schema.display in PICTURES:
        axes.set_title(name, loc="left", fontweight="bold")
        _draw_picture(axes, packet)
        return
    varying = [f for f in schema.fields if f.varying]
    axes.set_title(f"{name}: {title(varying[0])}", loc="left", fontweight="bold")
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


def _draw_events(axes: Any, window: Events) -> None:
    on, length_ms = int(window.polarity.sum()), (window.stamp_ns - window.start_ns) * 1e-6
    axes.set_title(f"{window.sensor}, {length_ms:g} ms", loc="left", fontweight="bold")
    axes.set_title(f"{_short(on)} on", loc="center", color=np.array(ON_SRGB) / 255.0)
    axes.set_title(f"{_short(len(window) - on)} off", loc="right", color=np.array(OFF_SRGB) / 255.0)
    _show(axes, event_picture(window.numpy(), width=window.width, height=window.height))


def _draw_picture(axes: Any, packet: Packet) -> None:
    kind, data = picture_of(packet)
    if kind not in ("depth", "values"):
        _show(axes, color_picture(kind, data))
        return
    seen = data[np.isfinite(data)]
    low, high = (0.0, 1.0) if not seen.size else (float(seen.min()), float(np.percentile(seen, 99.5)))
    low = 0.0 if kind == "depth" else low
    unit = "metres" if kind == "depth" else schema_of(type(packet)).fields[0].unit
    nothing = "white: nothing hit" if kind == "depth" else "white: no value"
    unit = ", ".join(part for part in (unit, nothing if seen.size < data.size else "") if part)
    cmap = "turbo" if kind == "depth" else "viridis"
    shown = np.where(np.isfinite(data), data, np.nan)
    picture = _show(axes, shown, cmap=cmap, vmin=low, vmax=max(high, low + 1e-9))
    extend = "max" if seen.size and seen.max() > high else "neither"
    _add_bar(axes, picture, unit, extend=extend)


def _add_bar(axes: Any, colored: Any, label: str, **options: Any) -> None:
    """Add a bar of colours below a panel."""
    bar = axes.figure.colorbar(colored, ax=axes, orientation="horizontal", aspect=40, pad=0.02, **options)
    bar.outline.set_visible(False)
    bar.set_label(label, color=_FAINT)


def _show(axes: Any, picture: NDArray[Any], **options: Any) -> Any:
    axes.set(xticks=[], yticks=[])
    return axes.imshow(picture, interpolation="antialiased", **options)


def _draw_strips(figure: Any, place: Any, strips: list[tuple[str, Any, Any]], stamp_ns: int) -> None:
    """Draw numbers against time, one strip below the other."""
    for axes, (text, time_s, values) in zip(
        np.atleast_1d(place.subgridspec(len(strips), 1).subplots(sharex=True)), strips, strict=True
    ):
        count = values.shape[1]
        colors = (_INK,) if count == 1 else [_XYZ[k % len(_XYZ)] for k in range(count)]
        axes.set_title(text, loc="left", fontsize=10, fontweight="bold")
        for column, color in zip(values.T, colors, strict=True):
            axes.plot(time_s, column, color=color, linewidth=1.6 if count == 1 else 1.0)
        axes.margins(x=0.0, y=0.12)
        finite = values[np.isfinite(values)]
        if finite.size and max(abs(finite.min()), abs(finite.max())) < _ROUNDING:
            axes.set_ylim((0.0, 1.0) if finite.min() >= 0.0 else (-1.0, 1.0))
        elif finite.size and 0.0 <= finite.min() <= 0.5 * finite.max():  # else 0 would flatten the curve
            axes.set_ylim(0.0, 1.12 * float(finite.max()))
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(axis="y", color="#e3e7ea", linewidth=0.8)
        axes.ticklabel_format(axis="y", useOffset=False)  # it would be below the title
        axes.locator_params(axis="y", nbins=3 if len(strips) > 2 else 4)
        axes.axvline(stamp_ns * 1e-9, color=_INK, linewidth=0.9, linestyle=(0, (3, 3)))
        if 1 < count <= 3:
            above: dict[str, Any] = {"loc": "lower right", "bbox_to_anchor": (1.0, 0.95), "borderpad": 0.0}
            axes.legend("xyz"[:count], ncols=3, fontsize=8, frameon=False, handlelength=1.0, **above)
    axes.set_xlabel("s", labelpad=1)


def _draw_plan(axes: Any, scene: Scene, track: Track, snapshot: Snapshot) -> None:
    from matplotlib.collections import LineCollection, PolyCollection
    from mpl_toolkits.axes_grid1.anchored_artists import AnchoredSizeBar

    bounds = scene.bounds_m
    height_m = float(np.median(track.position[:, 2])) if len(track.position) else float(bounds[:, 2].mean())
    plan = cut_plan(scene, height_m=height_m)
    size = plan.bounds[1] - plan.bounds[0]
    turned = size[0] > size[1]  # the panel is higher than wide

    def place(points: NDArray[np.float64]) -> Any:
        """World (x, y) to the paper: x right and y up, or turned so that x is up and y left."""
        return np.stack([-points[..., 1], points[..., 0]], axis=-1) if turned else points

    axes.axis("off")
    axes.set_title("Path", loc="left", fontweight="bold")
    directions = "x up, y left" if turned else "x right, y up"
    cut = f"plan cut at {height_m:.2f} m, {directions}"
    if size.min() < _NARROW * size.max():  # both titles are wider than the plan
        behind: dict[str, Any] = {"xycoords": "axes fraction", "textcoords": "offset points"}
        axes.annotate(cut, (0.0, 1.0), (40.0, 6.0), **behind, fontsize=11, color=_FAINT)
    else:
        axes.set_title(cut, loc="right", color=_FAINT)
    light = 1.0 - 0.7 * (1.0 - plan.colors)  # paler than the path
    below = PolyCollection(place(plan.triangles), facecolors=light, edgecolors=light, linewidths=0.4)
    axes.add_collection(below, autolim=False)
    for outlines, ink, line_width in ((plan.low_outlines, _FAINT, 0.5), (plan.outlines, _INK, 1.1)):
        lines = LineCollection(place(outlines), colors=ink, linewidths=line_width, capstyle="round", zorder=2)
        axes.add_collection(lines, autolim=False)
    corners = place(plan.bounds)
    low, high = corners.min(axis=0) - 0.02 * size.max(), corners.max(axis=0) + 0.02 * size.max()
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    axes.set_aspect("equal", adjustable="box", anchor="N")
    lengths = [m * 10.0**power for power in range(-2, 3) for m in (1.0, 2.0, 5.0)]
    length_m = max((m for m in lengths if m <= size.max() / 5), default=lengths[0])
    below_left: dict[str, Any] = {"bbox_to_anchor": (0.0, 0.0), "bbox_transform": axes.transAxes}
    scale = AnchoredSizeBar(
        axes.transData, length_m, f"{length_m:g} m", "upper left", frameon=False, **below_left
    )
    axes.add_artist(scale)
    if len(track.position) > 1:
        _draw_path(axes, track, snapshot, place, float(size.max()))


def _draw_path(axes: Any, track: Track, snapshot: Snapshot, place: Any, size_m: float) -> None:
    from matplotlib.collections import LineCollection, PolyCollection
    from matplotlib.patches import Polygon

    step = max(1, len(track.position) // 2000)
    points = place(track.position[::step, :2])
    speed = np.linalg.norm(track.velocity[::step], axis=1)
    segments: Any = np.stack([points[:-1], points[1:]], axis=1)
    casing = LineCollection(segments, colors="white", linewidths=6.0, capstyle="round", zorder=3)
    line = LineCollection(segments, cmap="plasma", linewidths=3.2, capstyle="round", zorder=5)
    line.set_array(0.5 * (speed[:-1] + speed[1:]))
    line.set_clim(0.0, float(speed.max()) if speed.max() > 1e-3 else 1.0)
    axes.add_collection(casing)
    axes.add_collection(line)
    _add_bar(axes, line, "speed [m/s]", shrink=0.5, anchor=(1.0, 1.0))

    # Where the camera looks: arrow heads along the path, and its view at the moment of the pictures.
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(track.position, axis=0), axis=1))])
    spacing_m = max(along[-1] / 16, 0.04 * size_m)
    marks = np.unique(np.searchsorted(along, np.arange(0.5 * spacing_m, along[-1], spacing_m)))
    heading = track.heading / np.maximum(np.linalg.norm(track.heading, axis=1, keepdims=True), 1e-9)
    ahead = 0.011 * size_m * heading[marks]
    aside = 0.6 * np.stack([-ahead[:, 1], ahead[:, 0]], axis=1)
    corners = [ahead, aside - ahead, -0.5 * ahead, -aside - ahead]
    arrows = place(track.position[marks, None, :2] + np.stack(corners, axis=1))
    heads = PolyCollection(arrows, facecolors=_INK, edgecolors="white", linewidths=0.7, zorder=5.5)
    axes.add_collection(heads)
    now = int(np.argmin(np.abs(track.stamp_ns - snapshot.stamp_ns)))
    angle = np.arctan2(heading[now, 1], heading[now, 0]) + np.linspace(-0.6, 0.6, 13)
    arc = track.position[now, :2] + 0.09 * size_m * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    wedge = place(np.concatenate([track.position[now : now + 1, :2], arc]))
    axes.add_patch(Polygon(wedge, closed=True, facecolor="#f59f00", edgecolor="none", alpha=0.45, zorder=2.5))
    axes.plot(*wedge[0], marker="o", markersize=6, color=_INK, zorder=7)
    # The names stand on the far sides of the two ends, so that both can be read where a flight is short.
    far = np.where(points[0] <= points[-1], -1, 1)
    box = {"boxstyle": "round,pad=0.2", "facecolor": "white", "edgecolor": "none", "alpha": 0.75}
    for index, text, color, (right, up) in ((0, "start", "#2b8a3e", far), (-1, "end", "#c92a2a", -far)):
        axes.plot(*points[index], marker="o", markersize=9, color=color, mec="white", mew=1.6, zorder=6)
        align: dict[str, Any] = {"ha": "left" if right > 0 else "right", "va": "bottom" if up > 0 else "top"}
        at: dict[str, Any] = {"xytext": (9 * right, 9 * up), "textcoords": "offset points"}
        axes.annotate(text, points[index], **at, **align, fontweight="bold", color=color, zorder=8, bbox=box)
