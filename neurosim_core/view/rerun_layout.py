"""The layout of the Rerun viewer: the scene large, pictures at its right, plots below."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurosim_core.packets import FieldSchema, PacketSchema
from neurosim_core.record.header import SensorDescription
from neurosim_core.registry import find
from neurosim_core.view.rerun_sdk import TIMELINE, import_rerun

ROLLING_PLOT_S = 10.0
"""How much time rolling plots show [s]."""
ROLLING_TRAIL_S = 30.0
"""How much of its way a vehicle then draws behind it [s]."""
PICTURES = ("colour", "image", "events", "depth", "values", "segmentation", "normals", "flow")
"""Displays that have a picture, in the order in which they are laid out."""

_LOOK = np.array([0.2, 0.62, -0.76]) / np.linalg.norm([0.2, 0.62, -0.76])
"""From where the scene is seen at first: direction of the view in W."""
_FIELD_OF_VIEW_RAD = 0.9
"""Rerun's, from top to bottom, and a little room [rad]."""
_ASPECT = 1.6


class Panel(NamedTuple):
    """One view of the layout."""

    kind: Literal["picture", "plot", "bars", "text", "space"]
    name: str
    """Its title."""
    origin: str
    """Entity that it shows, with all below."""
    contents: tuple[str, ...] = ("$origin/**",)
    """Entities that it shows, if not those."""
    rank: int = 0
    """Pictures are laid out by rising rank."""
    beside: tuple[Panel, ...] = ()
    """Views of the same in tabs beside it."""
    legend: bool = False
    """A plot has a legend, which hides a part of it: only if neither its title nor the colours of x, y, z
    (red, green, blue) name the lines."""


def body(vehicle: str) -> str:
    """Return the entity of a vehicle's body frame."""
    return f"world/vehicles/{vehicle}"


def overlays(sensors: Sequence[SensorDescription]) -> dict[str, str]:
    """Return the cameras whose pictures are drawn over those of a colour camera, and which that is.

    The other one is at the same place, and has the same lens.
    """

    def view(camera: SensorDescription) -> tuple[Any, ...]:
        return (*camera.position, *camera.orientation, camera.intrinsics)

    kinds: dict[str, Any] = {s.kind: find("sensor", s.kind) for s in sensors}
    below = {view(s): s.name for s in sensors if getattr(kinds[s.kind], "encoding", "") == "rgb8"}
    return {s.name: below[view(s)] for s in sensors if kinds[s.kind].is_overlay and view(s) in below}


def picture_panel(vehicle: str, sensor: str, kind: str = "", *, below: str = "") -> Panel:
    """Return the panel of a camera.

    `kind`: what it shows, a key of `PICTURES`; empty: not yet known. `below`: the camera over whose picture
    it is drawn.
    """
    rank = PICTURES.index(kind) if kind else len(PICTURES)
    if below:
        contents = ("$origin/image", f"$origin/{sensor}/**")
        return Panel("picture", f"{sensor} over {below}", f"{body(vehicle)}/{below}", contents, rank)
    at = f"{body(vehicle)}/{sensor}"
    surface = Panel("picture", "surface", at, ("$origin/surface",))
    beside = (surface,) if kind == "events" else ()
    return Panel("picture", sensor, at, ("$origin/image", "$origin/arrows"), rank, beside)


def sensor_panels(
    vehicle: str, sensor: str, schema: PacketSchema, kind: str, *, live: bool, below: str = ""
) -> list[Panel]:
    """Return the panels in which the packets of a sensor are shown.

    `kind`: the display, or what a picture shows. `live`: the clearance, which only a flight in this process
    knows, is not plotted. `below`: the camera over whose picture that of the sensor is drawn.
    """
    at = f"plots/{vehicle}/{sensor}"
    numbers = [field for field in schema.fields if field.is_number]
    if kind == "events":
        cloud = [] if live else [Panel("space", f"{sensor}: x, y, time", cloud_entity(vehicle, sensor))]
        rate = Panel("plot", f"{sensor} [M events/s]", f"{at}/rate")
        return [picture_panel(vehicle, sensor, kind), rate, *cloud]
    if kind in PICTURES:
        return [picture_panel(vehicle, sensor, kind, below=below)]
    if kind == "time series":
        return [Panel("plot", f"{sensor}: {title(field)}", f"{at}/{field.name}") for field in numbers]
    if kind == "bars":
        return [Panel("bars", f"{sensor}: {title(f)}", f"{at}/{f.name}") for f in schema.fields if f.varying]
    if kind == "text":
        return [Panel("text", sensor, at)]
    if kind == "contact":
        return [Panel("text", "collisions", f"plots/{vehicle}/collisions")]
    if kind == "delay":
        return [Panel("plot", "link delay [ms]", f"plots/{vehicle}/links", legend=True)]
    if kind == "pose":
        motion = (f"/{at}/speed", f"/{at}/height") + (() if live else (f"/plots/{vehicle}/clearance",))
        name = "speed [m/s], height" + (" [m]" if live else ", clearance [m]")
        return [
            Panel("plot", name, at, motion, legend=True),
            Panel("plot", "rotor speed [rad/s]", f"{at}/rotor_speed"),
        ]
    return []


def cloud_entity(vehicle: str, sensor: str) -> str:
    """Return where the events of a camera are as points in x, y and time."""
    return f"events/{vehicle}/{sensor}"


def title(field: FieldSchema) -> str:
    """Return what a field of a packet is called on a plot, with its unit."""
    unit = field.unit.replace("^2", "²")
    name = field.name.removesuffix("_" + field.unit.replace("/", "_").replace("^", "").lower()).replace(
        "_", " "
    )
    return f"{name} [{unit}]" if unit else name


def make_blueprint(
    panels: Mapping[str, Sequence[Panel]],
    bounds_m: NDArray[np.float64] | None = None,
    *,
    live: bool = False,
    rolling: bool = False,
) -> Any:
    """Lay the viewer out; see `rerun_log` for the entities.

    `bounds_m`: lowest and highest corner of the scene [m], shape [2, 3]; None: there is none. `live`: the
    plots of commands and of the simulator are there, and its status. `rolling`: follow the newest data; plots
    show the last seconds only.
    """
    rrb = import_rerun().blueprint
    many = len(panels) > 1
    timing = Panel("plot", "loop timing [ms]", "simulator/timing", legend=True)
    pictures: list[Any] = []
    plots: list[Any] = []
    shares: list[int] = []
    cameras: dict[str, list[Panel]] = {}
    for name, shown in panels.items():
        cameras[name] = sorted((p for p in shown if p.kind == "picture"), key=lambda p: p.rank)
        others = [panel for panel in shown if panel.kind != "picture"]
        if live:
            others += [Panel("plot", "command", f"plots/{name}/command", legend=True), timing]
        views = [_view(panel, rolling=rolling) for panel in cameras[name]]
        if views:
            pictures += [rrb.Vertical(*views, name=name)] if many else views
        views = [_view(panel, rolling=rolling) for panel in others]
        if views:
            columns = 2 if len(views) == 4 else 3 if len(views) <= 6 else 4  # leaves few places empty
            plots.append(rrb.Grid(*views, grid_columns=columns, name=name))
    if pictures:
        shares = [3 * max(map(len, cameras.values()))] if many else [3] * len(pictures)
    right = [rrb.Tabs(*pictures)] if many and pictures else pictures
    if live:
        factor = Panel("plot", "real-time factor", "simulator/real_time_factor")
        losses = Panel("plot", "lost messages", "simulator/losses", legend=True)
        views = [_view(panel, rolling=rolling) for panel in (timing, factor, losses)]
        plots.append(rrb.Horizontal(*views, name="simulator"))
        right = [*right, rrb.TextDocumentView(origin="status", name="status")]
        shares = [*shares, 4]
    space = _space(cameras, bounds_m, rolling=rolling)
    below = rrb.Tabs(*plots) if len(plots) > 1 else plots[0] if plots else None
    left = space if below is None else rrb.Vertical(space, below, row_shares=[5, 4] if live else [5, 3])
    layout = (
        rrb.Horizontal(left, rrb.Vertical(*right, row_shares=shares), column_shares=[3, 1]) if right else left
    )
    return rrb.Blueprint(
        layout,
        rrb.TimePanel(timeline=TIMELINE, state="collapsed", play_state="following" if rolling else None),
        rrb.SelectionPanel(state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
        auto_views=False,
    )


def _view(panel: Panel, *, rolling: bool) -> Any:
    rrb = import_rerun().blueprint
    kinds = {
        "picture": rrb.Spatial2DView,
        "bars": rrb.BarChartView,
        "text": rrb.TextLogView,
        "space": rrb.Spatial3DView,
    }
    options: dict[str, Any] = {"origin": panel.origin, "contents": list(panel.contents), "name": panel.name}
    if panel.kind != "plot":
        view = kinds[panel.kind](**options)
        beside = [_view(other, rolling=rolling) for other in panel.beside]
        return rrb.Tabs(view, *beside, name=panel.name) if beside else view
    return rrb.TimeSeriesView(
        **options,
        time_ranges=_last_seconds(ROLLING_PLOT_S) if rolling else None,
        plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.LeftTop, visible=panel.legend),
    )


def _space(
    cameras: Mapping[str, Iterable[Panel]], bounds_m: NDArray[np.float64] | None, *, rolling: bool
) -> Any:
    rrb = import_rerun().blueprint
    eye = None
    if bounds_m is not None:
        center = bounds_m.mean(axis=0)
        position = center - _distance_m(bounds_m) * _LOOK
        eye = rrb.EyeControls3D(position=position, look_target=center, eye_up=(0.0, 0.0, 1.0))
    until_now = _last_seconds(ROLLING_TRAIL_S if rolling else None)
    # One frustum is enough where cameras share a place; the others' pictures are at the right.
    hidden = []
    for shown in cameras.values():
        parts = [panel for camera in shown for panel in (camera, *camera.beside)]
        for part in parts[1:]:
            entities = part.contents[-1] if part.origin == parts[0].origin else "$origin/**"
            hidden.append(entities.replace("$origin", f"- /{part.origin}"))
    return rrb.Spatial3DView(
        origin="world",
        name="scene",
        contents=["$origin/**", *hidden],
        overrides={
            **{f"world/trails/{name}": until_now for name in cameras},
            **{f"world/collisions/{name}": until_now for name in cameras},
            "world/scene/ceiling": rrb.EntityBehavior(visible=False),
        },
        eye_controls=eye,
        line_grid=False,
    )


def _distance_m(bounds_m: NDArray[np.float64]) -> float:
    """How far from its middle a box has to be looked at to be seen as a whole [m]."""
    corners = np.array(list(itertools.product(*bounds_m.T))) - bounds_m.mean(axis=0)
    right = np.cross(_LOOK, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    across = np.maximum(np.abs(corners @ np.cross(right, _LOOK)), np.abs(corners @ right) / _ASPECT)
    return float((across / np.tan(0.5 * _FIELD_OF_VIEW_RAD) - corners @ _LOOK).max())


def _last_seconds(seconds: float | None) -> Any:
    """The data of the last seconds before the cursor, or of all time before it."""
    rrb = import_rerun().blueprint
    boundary = rrb.TimeRangeBoundary
    start = boundary.infinite() if seconds is None else boundary.cursor_relative(seconds=-seconds)
    return rrb.VisibleTimeRanges(rrb.VisibleTimeRange(TIMELINE, start=start, end=boundary.cursor_relative()))
