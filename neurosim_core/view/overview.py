"""One picture of a flight: what the cameras saw at one moment, how fast it went, and where it was.

Drawn with matplotlib into a file; needs no display.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from neurosim_core.install import install_hint
from neurosim_core.packets import EventArrays, Events, Image, Odometry, Packet
from neurosim_core.record.header import SensorDescription
from neurosim_core.scene.scene import Scene
from neurosim_core.view.pictures import OFF_SRGB, ON_SRGB, cut_events, event_picture, join_events
from neurosim_core.view.plan import cut_plan

WIDTH_PX, HEIGHT_PX = 1600, 900
_DPI = 100
_INK = "#1d2530"
_FAINT = "#6b7682"
_PAPER = "#ffffff"
_TRACK_ROWS = 20_000


@dataclass(frozen=True, kw_only=True, eq=False)
class Snapshot:
    """What the cameras of a vehicle saw at one moment; None where there is no such camera."""

    stamp_ns: int
    """The moment [ns]."""
    rgb: Image | None = None
    depth: Image | None = None
    events: EventArrays | None = None
    """Events of the window that ends at the moment."""
    event_width: int = 0
    """Columns of the event camera [px]."""
    event_height: int = 0
    """Rows of the event camera [px]."""
    event_window_ns: int = 20_000_000
    """Length of the window of events [ns]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Track:
    """Where the vehicle was, by time."""

    stamp_ns: NDArray[np.int64]
    """Times [ns], shape [n]."""
    position: NDArray[np.float64]
    """p_WB [m], shape [n, 3]."""
    velocity: NDArray[np.float64]
    """v_WB in W [m/s], shape [n, 3]."""
    heading: NDArray[np.float64]
    """Horizontal part of the direction in which the camera looks, in W, shape [n, 2]."""


class FlightSummary:
    """Collects from the packets of a flight what its overview shows, in bounded memory.

    The moment shown is a picture of great contrast and depth (up to 3 m) at which about a third of the pixels
    saw events: a view into a room, not the wall in front.
    """

    def __init__(
        self, sensors: tuple[SensorDescription, ...] = (), *, event_window_ns: int = 20_000_000
    ) -> None:
        """Start empty.

        Args:
            sensors: Sensors of the flight. The first camera of each kind is shown; if none of a kind is
                described, the first that sends a packet.
            event_window_ns: Length of the window of events that is shown [ns].
        """
        self._window_ns = event_window_ns
        cameras = [s for s in sensors if s.intrinsics is not None]
        self._q_BC = cameras[0].orientation if cameras else np.array([-0.5, 0.5, -0.5, 0.5])
        self._chosen: dict[str, str] = {}
        for sensor in sensors:
            self._chosen.setdefault(sensor.kind, sensor.name)
        self._rgb: Image | None = None
        self._depth: Image | None = None
        self._recent: deque[Events] = deque()
        self._waiting: Snapshot | None = None
        self._best: tuple[float, Snapshot] | None = None
        self._rows: list[NDArray[np.float64]] = []
        self._stride = 1
        self._odometry_count = 0
        self.event_count = 0
        """Events of all event cameras so far."""

    def log(self, packet: Packet) -> None:
        """Take one packet; packets come in the order of their stamps."""
        if self._waiting is not None and packet.stamp_ns > self._waiting.stamp_ns:
            self._consider()
        if isinstance(packet, Odometry):
            self._log_odometry(packet)
        elif isinstance(packet, Events):
            self.event_count += len(packet)
            if self._chosen.setdefault("event_camera", packet.sensor) == packet.sensor:
                self._recent.append(packet)
                while self._recent[0].stamp_ns <= packet.stamp_ns - self._window_ns:
                    self._recent.popleft()
        elif isinstance(packet, Image) and packet.encoding in ("rgb8", "mono8"):
            if self._chosen.setdefault("rgb", packet.sensor) == packet.sensor:
                self._rgb = packet
                self._waiting = Snapshot(stamp_ns=packet.stamp_ns)
        elif (
            isinstance(packet, Image)
            and packet.encoding == "32FC1"
            and self._chosen.setdefault("depth", packet.sensor) == packet.sensor
        ):
            self._depth = packet
            self._waiting = Snapshot(stamp_ns=packet.stamp_ns)

    def snapshot(self) -> Snapshot | None:
        """Return the moment to show; None if no camera has sent anything."""
        if self._waiting is not None:
            self._consider()
        if self._best is None and self._recent:
            return self._look(self._recent[-1].stamp_ns)
        return None if self._best is None else self._best[1]

    def track(self) -> Track:
        """Return where the vehicle was so far, at no more than 20 000 times."""
        table = np.array(self._rows).reshape(-1, 9)
        return Track(
            stamp_ns=table[:, 0].astype(np.int64),
            position=table[:, 1:4],
            velocity=table[:, 4:7],
            heading=table[:, 7:9],
        )

    def _log_odometry(self, packet: Odometry) -> None:
        if self._odometry_count % self._stride == 0:
            R_WC = Rotation.from_quat(packet.orientation) * Rotation.from_quat(self._q_BC)
            forward = R_WC.apply([0.0, 0.0, 1.0])
            self._rows.append(np.array([packet.stamp_ns, *packet.position, *packet.velocity, *forward[:2]]))
            if len(self._rows) > _TRACK_ROWS:
                self._rows = self._rows[::2]
                self._stride *= 2
        self._odometry_count += 1

    def _look(self, stamp_ns: int) -> Snapshot:
        begin_us, end_us = (stamp_ns - self._window_ns) // 1000, stamp_ns // 1000
        events = None
        if self._recent:
            joined = join_events([packet.numpy() for packet in self._recent])
            begin, end = np.searchsorted(joined.t, [begin_us + 1, end_us + 1])
            events = cut_events(joined, slice(begin, end))
        return Snapshot(
            stamp_ns=stamp_ns,
            rgb=self._rgb,
            depth=self._depth,
            events=events,
            event_width=self._recent[-1].width if self._recent else 0,
            event_height=self._recent[-1].height if self._recent else 0,
            event_window_ns=self._window_ns,
        )

    def _consider(self) -> None:
        assert self._waiting is not None
        snapshot = self._look(self._waiting.stamp_ns)
        self._waiting = None
        interest, covered = 1.0, 0.0
        if snapshot.rgb is not None:
            interest *= 1.0 + float(snapshot.rgb.data.std())
        if snapshot.events is not None:
            pixels = snapshot.events.y.astype(np.int64) * snapshot.event_width + snapshot.events.x
            covered = len(np.unique(pixels)) / max(1, snapshot.event_width * snapshot.event_height)
        interest *= 0.01 + covered * (1.0 - covered) ** 2  # most at a third: more is a thicket
        if snapshot.depth is not None:
            interest *= 0.1 + min(float(np.median(snapshot.depth.data)), 3.0)
        if self._best is None or interest > self._best[0]:
            self._best = (interest, snapshot)


def save_overview(
    path: str | Path,
    *,
    scene: Scene,
    track: Track,
    snapshot: Snapshot | None,
    event_count: int | None = None,
    real_time_factor: float | None = None,
) -> None:
    """Draw a flight as one PNG of 1600 x 900 pixels.

    Left, what the cameras saw at one moment and speed and height against time; right, the path in the plan of
    the scene: surfaces cut at the median height of the flight as dark lines, cut lower as thin lines, what is
    below in its own colours; turned by a quarter where that fills the picture better.

    Args:
        path: File to write.
        scene: The scene that was flown in.
        track: Where the vehicle was; may be empty.
        snapshot: The moment to show.
        event_count: Events of the whole flight, for the title.
        real_time_factor: Simulated time over wall-clock time, for the title.

    Raises:
        OSError: The file cannot be written.
        ImportError: matplotlib is not installed.
    """
    matplotlib = _import_matplotlib()
    style = {"font.size": 11, "text.color": _INK, "axes.edgecolor": _FAINT, "axes.labelcolor": _INK}
    style |= {
        "xtick.color": _FAINT,
        "ytick.color": _FAINT,
        "axes.linewidth": 0.8,
        "font.family": "DejaVu Sans",
    }
    with matplotlib.rc_context(style):
        figure = matplotlib.figure.Figure(
            figsize=(WIDTH_PX / _DPI, HEIGHT_PX / _DPI), dpi=_DPI, facecolor=_PAPER
        )
        _draw_title(figure, scene, track, event_count, real_time_factor)
        _draw_snapshot(figure, snapshot)
        _draw_profile(figure, track, snapshot)
        _draw_plan(figure, scene, track, snapshot)
        figure.savefig(path, dpi=_DPI)


# Layout in pixels from the top left corner: two columns of panels, then the plan.
_MARGIN = 40
_PANEL_W, _PANEL_H = 416, 312
_COLUMN_X = (_MARGIN, _MARGIN + _PANEL_W + 64)
_ROW_Y = (124, 124 + _PANEL_H + 72)
_PLAN_X = _COLUMN_X[1] + _PANEL_W + 60


def _axes(figure: Any, x: float, y: float, width: float, height: float) -> Any:
    """Add axes at a place in pixels from the top left corner."""
    place = (x / WIDTH_PX, 1.0 - (y + height) / HEIGHT_PX, width / WIDTH_PX, height / HEIGHT_PX)
    return figure.add_axes(place)


def _heading(figure: Any, x: float, y: float, text: str, detail: str = "", *, width: float = 0.0) -> None:
    """Write a panel's title 10 px above it, and a detail flush with its right border."""
    at = 1.0 - (y - 10) / HEIGHT_PX
    figure.text(x / WIDTH_PX, at, text, fontsize=12, fontweight="bold", va="bottom")
    if detail:
        figure.text((x + width) / WIDTH_PX, at, detail, fontsize=10.5, color=_FAINT, va="bottom", ha="right")


def _draw_title(
    figure: Any, scene: Scene, track: Track, event_count: int | None, real_time_factor: float | None
) -> None:
    figure.text(_MARGIN / WIDTH_PX, 1.0 - 50 / HEIGHT_PX, scene.name, fontsize=21, fontweight="bold")
    facts = []
    if len(track.stamp_ns) > 1:
        length_m = float(np.linalg.norm(np.diff(track.position, axis=0), axis=1).sum())
        speed = np.linalg.norm(track.velocity, axis=1)
        facts.append(f"{(track.stamp_ns[-1] - track.stamp_ns[0]) * 1e-9:.3g} s of flight")
        facts.append(f"{length_m:.1f} m")
        facts.append(f"up to {speed.max():.1f} m/s")
    if event_count is not None:
        facts.append(f"{_short(event_count)} events")
    if real_time_factor is not None:
        facts.append(f"{real_time_factor:.2g} × real time")
    text = "   ·   ".join(facts)
    figure.text(_MARGIN / WIDTH_PX, 1.0 - 78 / HEIGHT_PX, text, fontsize=12.5, color=_FAINT)


def _short(count: int) -> str:
    """Write a count with three digits: 1.23 M."""
    for unit, name in ((1e9, " G"), (1e6, " M"), (1e3, " k")):
        if count >= unit:
            return f"{count / unit:.3g}{name}"
    return str(count)


def _draw_snapshot(figure: Any, snapshot: Snapshot | None) -> None:
    stamp = "" if snapshot is None else f"at {snapshot.stamp_ns * 1e-9:.2f} s"
    rgb = None if snapshot is None or snapshot.rgb is None else snapshot.rgb.data
    _heading(figure, _COLUMN_X[0], _ROW_Y[0], "RGB", stamp if rgb is not None else "", width=_PANEL_W)
    axes = _axes(figure, _COLUMN_X[0], _ROW_Y[0], _PANEL_W, _PANEL_H)
    _show(axes, rgb, cmap="gray", vmin=0, vmax=255)

    x, y = _COLUMN_X[1], _ROW_Y[0]
    axes = _axes(figure, x, y, _PANEL_W, _PANEL_H)
    if snapshot is None or snapshot.events is None:
        _heading(figure, x, y, "Events")
        _show(axes, None)
    else:
        on = int(snapshot.events.polarity.sum())
        off = len(snapshot.events.polarity) - on
        _heading(figure, x, y, f"Events in {snapshot.event_window_ns * 1e-6:g} ms")
        right = 1.0 - (y - 10) / HEIGHT_PX
        for text, color, back in (
            (f"{_short(off)} darker", OFF_SRGB, 0),
            (f"{_short(on)} brighter", ON_SRGB, 122),
        ):
            figure.text(
                (x + _PANEL_W - back) / WIDTH_PX,
                right,
                text,
                fontsize=10.5,
                ha="right",
                va="bottom",
                color=np.array(color) / 255.0,
            )
        picture = event_picture(snapshot.events, width=snapshot.event_width, height=snapshot.event_height)
        _show(axes, picture)

    x, y = _COLUMN_X[0], _ROW_Y[1]
    axes = _axes(figure, x, y, _PANEL_W, _PANEL_H)
    if snapshot is None or snapshot.depth is None:
        _heading(figure, x, y, "Depth")
        _show(axes, None)
        return
    depth = snapshot.depth.data
    seen = depth[np.isfinite(depth)]
    far = float(np.percentile(seen, 99.5)) if seen.size else 1.0
    _heading(figure, x, y, "Depth", "metres", width=_PANEL_W)
    picture = _show(axes, np.where(np.isfinite(depth), depth, np.nan), cmap="turbo", vmin=0.0, vmax=far)
    bar = axes.inset_axes((0.0, -0.065, 1.0, 0.035))
    figure.colorbar(picture, cax=bar, orientation="horizontal").outline.set_visible(False)
    bar.tick_params(length=3, labelsize=9.5, pad=2)


def _show(axes: Any, picture: NDArray[Any] | None, **options: Any) -> Any:
    """Show a picture, or say that there is none."""
    axes.set_xticks([])
    axes.set_yticks([])
    axes.set_facecolor("#f1f3f5")
    if picture is None:
        axes.text(
            0.5, 0.5, "no such camera", ha="center", va="center", color=_FAINT, transform=axes.transAxes
        )
        return None
    axes.set_anchor("N")
    return axes.imshow(picture, interpolation="antialiased", **options)


def _draw_profile(figure: Any, track: Track, snapshot: Snapshot | None) -> None:
    x, y = _COLUMN_X[1], _ROW_Y[1]
    _heading(figure, x, y, "Speed and height")
    time_s = track.stamp_ns * 1e-9
    for part, (values, label, color) in enumerate(
        (
            (np.linalg.norm(track.velocity, axis=1), "m/s", "#d9480f"),
            (track.position[:, 2], "m", "#1864ab"),
        )
    ):
        height = 0.46 * _PANEL_H
        axes = _axes(figure, x + 34, y + part * 0.54 * _PANEL_H, _PANEL_W - 34, height)
        axes.plot(time_s, values, color=color, linewidth=1.8, solid_capstyle="round")
        axes.set_ylabel(label, labelpad=4)
        axes.yaxis.set_label_coords(-0.085, 0.5)
        axes.margins(x=0.0, y=0.12)
        axes.set_ylim(bottom=min(0.0, axes.get_ylim()[0]))
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(axis="y", color="#e3e7ea", linewidth=0.8)
        axes.set_axisbelow(True)
        axes.locator_params(axis="y", nbins=4)
        axes.tick_params(length=3, labelsize=9.5)
        if snapshot is not None:
            axes.axvline(snapshot.stamp_ns * 1e-9, color=_INK, linewidth=0.9, linestyle=(0, (3, 3)))
        if part == 0:
            axes.tick_params(labelbottom=False)
        else:
            axes.set_xlabel("s", labelpad=1)


def _draw_plan(figure: Any, scene: Scene, track: Track, snapshot: Snapshot | None) -> None:
    from matplotlib.collections import LineCollection, PolyCollection

    x, y = _PLAN_X, _ROW_Y[0]
    width, height = WIDTH_PX - _PLAN_X - _MARGIN, HEIGHT_PX - _ROW_Y[0] - 84
    bounds = scene.bounds_m
    height_m = float(np.median(track.position[:, 2])) if len(track.position) else float(bounds[:, 2].mean())
    plan = cut_plan(scene, height_m=height_m)
    axes = _axes(figure, x, y, width, height)
    axes.axis("off")

    size = plan.bounds[1] - plan.bounds[0]
    turned = _fit(size[::-1], width, height) > _fit(size, width, height)
    directions = "x up, y left" if turned else "x right, y up"
    _heading(figure, x, y, "Path", f"plan cut at {height_m:.2f} m, {directions}", width=width)

    def place(points: NDArray[np.float64]) -> Any:
        """World (x, y) to the paper: x right and y up, or turned so that x is up and y left."""
        return np.stack([-points[..., 1], points[..., 0]], axis=-1) if turned else points

    light = 1.0 - 0.7 * (1.0 - plan.colors)  # paler than the path
    axes.add_collection(
        PolyCollection(place(plan.triangles), facecolors=light, edgecolors=light, linewidths=0.4, zorder=1)
    )
    for outlines, ink, line_width in ((plan.low_outlines, _FAINT, 0.5), (plan.outlines, _INK, 1.1)):
        axes.add_collection(
            LineCollection(place(outlines), colors=ink, linewidths=line_width, capstyle="round", zorder=2)
        )
    corners = place(plan.bounds)
    low, high = corners.min(axis=0), corners.max(axis=0)
    axes.set_xlim(low[0] - 0.02 * size.max(), high[0] + 0.02 * size.max())
    axes.set_ylim(low[1] - 0.02 * size.max(), high[1] + 0.02 * size.max())
    axes.set_aspect("equal", adjustable="box", anchor="N")
    if len(track.position) > 1:
        _draw_path(figure, axes, track, snapshot, place, float(size.max()))
    _draw_scale_bar(figure, axes, float(size.max()))


def _fit(size: NDArray[np.float64], width: float, height: float) -> float:
    """How many pixels a metre gets if the whole is to fit."""
    return float(min(width / max(size[0], 1e-9), height / max(size[1], 1e-9)))


def _draw_path(
    figure: Any, axes: Any, track: Track, snapshot: Snapshot | None, place: Any, size_m: float
) -> None:
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
    if snapshot is not None:
        now = int(np.argmin(np.abs(track.stamp_ns - snapshot.stamp_ns)))
        angle = np.arctan2(heading[now, 1], heading[now, 0]) + np.linspace(-0.6, 0.6, 13)
        arc = track.position[now, :2] + 0.09 * size_m * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        wedge = place(np.concatenate([track.position[now : now + 1, :2], arc]))
        axes.add_patch(
            Polygon(wedge, closed=True, facecolor="#f59f00", edgecolor="none", alpha=0.45, zorder=2.5)
        )
        axes.plot(*wedge[0], marker="o", markersize=6, color=_INK, zorder=7)
    # the names stand on opposite sides, so that both can be read where a flight is short
    for index, text, color, side in ((0, "start", "#2b8a3e", -1), (-1, "end", "#c92a2a", 1)):
        axes.plot(*points[index], marker="o", markersize=9, color=color, mec="white", mew=1.6, zorder=6)
        axes.annotate(
            text,
            points[index],
            xytext=(8 * side, 8 * side),
            ha="left" if side > 0 else "right",
            va="bottom" if side > 0 else "top",
            textcoords="offset points",
            fontsize=10.5,
            fontweight="bold",
            color=color,
            zorder=8,
            bbox={"boxstyle": "round,pad=0.2", "facecolor": "white", "edgecolor": "none", "alpha": 0.75},
        )
    bar = _axes(figure, WIDTH_PX - _MARGIN - 180, HEIGHT_PX - 62, 180, 10)
    figure.colorbar(line, cax=bar, orientation="horizontal").outline.set_visible(False)
    bar.tick_params(length=3, labelsize=9.5, pad=2)
    figure.text(
        (WIDTH_PX - _MARGIN - 190) / WIDTH_PX,
        57 / HEIGHT_PX,
        "speed [m/s]",
        fontsize=10.5,
        color=_FAINT,
        ha="right",
        va="center",
    )


def _draw_scale_bar(figure: Any, axes: Any, size_m: float) -> None:
    """Draw a bar of a round length at the bottom left of the plan."""
    lengths = [m * 10.0**power for power in range(-2, 3) for m in (1.0, 2.0, 5.0)]
    length_m = max((m for m in lengths if m <= size_m / 5), default=lengths[0])
    axes.apply_aspect()
    shown = axes.get_window_extent().width / (axes.get_xlim()[1] - axes.get_xlim()[0])  # pixels a metre
    bar = _axes(figure, _PLAN_X, HEIGHT_PX - 60, length_m * shown, 6)
    bar.set_xticks([])
    bar.set_yticks([])
    bar.set_facecolor(_INK)
    figure.text(
        (_PLAN_X + length_m * shown + 10) / WIDTH_PX,
        57 / HEIGHT_PX,
        f"{length_m:g} m",
        fontsize=10.5,
        color=_FAINT,
        va="center",
    )


def _import_matplotlib() -> ModuleType:
    try:
        import matplotlib
        import matplotlib.figure
    except ImportError as error:
        raise ImportError(f"the overview picture needs matplotlib: {install_hint('view')}") from error
    return matplotlib
