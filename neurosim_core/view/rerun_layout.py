"""How the viewer is laid out: the scene large, pictures at its right, plots below."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurosim_core.record.header import SensorDescription
from neurosim_core.view.rerun_sdk import TIMELINE, import_rerun

ROLLING_PLOT_S = 10.0
"""How much time rolling plots show [s]."""
ROLLING_TRAIL_S = 30.0
"""How much of its way a vehicle then draws behind it [s]."""
_PICTURES = ("rgb", "event_camera", "depth")
_LOOK = np.array([0.2, 0.62, -0.76]) / np.linalg.norm([0.2, 0.62, -0.76])
"""From where the scene is seen at first: direction of the view in W."""
_FIELD_OF_VIEW_RAD = 0.9
"""Rerun's, from top to bottom, and a little room [rad]."""
_ASPECT = 1.6


def make_blueprint(
    vehicles: Mapping[str, tuple[SensorDescription, ...]],
    bounds_m: NDArray[np.float64] | None = None,
    *,
    live: bool = False,
    links: bool = False,
    rolling: bool = False,
) -> Any:
    """Lay the viewer out; see `rerun_log` for the entities.

    Args:
        vehicles: Sensors of each vehicle.
        bounds_m: Lowest and highest corner of the scene [m], shape [2, 3]; None: there is none.
        live: The plots of commands and of the simulator are there, and its status.
        links: The plot of link delays is there.
        rolling: Follow the newest data; plots show the last seconds only.
    """
    rrb = import_rerun().blueprint
    many = len(vehicles) > 1
    pictures: list[Any] = []
    plots: list[Any] = []
    camera_count = 0
    for name, sensors in vehicles.items():
        views = [
            rrb.Spatial2DView(
                origin=f"world/vehicles/{name}/{camera.name}", contents="$origin/image", name=camera.name
            )
            for camera in _cameras(sensors)
        ]
        camera_count = max(camera_count, len(views))
        if views and many:
            pictures.append(rrb.Vertical(*views, name=name))
        elif views:
            pictures = views
        views = _plots(name, sensors, live=live, links=links, rolling=rolling)
        if views:
            plots.append(rrb.Grid(*views, grid_columns=_columns(len(views)), name=name))
    if live:
        plots.append(rrb.Horizontal(*_simulator_plots(rolling=rolling), name="simulator"))
    right = [rrb.Tabs(*pictures)] if many and pictures else pictures
    shares = [3 * camera_count] if many and pictures else [3] * len(right)
    if live:
        right, shares = [*right, rrb.TextDocumentView(origin="status", name="status")], [*shares, 4]
    space = _space(vehicles, bounds_m, rolling=rolling)
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


def _columns(count: int) -> int:
    """Columns of a grid of plots that leaves few places empty."""
    return 2 if count == 4 else 3 if count <= 6 else 4


def _cameras(sensors: tuple[SensorDescription, ...]) -> list[SensorDescription]:
    cameras = [sensor for sensor in sensors if sensor.intrinsics is not None]
    return sorted(cameras, key=lambda sensor: _PICTURES.index(sensor.kind))


def _space(
    vehicles: Mapping[str, tuple[SensorDescription, ...]],
    bounds_m: NDArray[np.float64] | None,
    *,
    rolling: bool,
) -> Any:
    rrb = import_rerun().blueprint
    eye = None
    if bounds_m is not None:
        center = bounds_m.mean(axis=0)
        position = center - _distance_m(bounds_m) * _LOOK
        eye = rrb.EyeControls3D(position=position, look_target=center, eye_up=(0.0, 0.0, 1.0))
    until_now = _last_seconds(ROLLING_TRAIL_S if rolling else None)
    # One frustum is enough where cameras share a place; the others' pictures are at the right.
    hidden = [
        f"- /world/vehicles/{name}/{camera.name}/**"
        for name, sensors in vehicles.items()
        for camera in _cameras(sensors)[1:]
    ]
    return rrb.Spatial3DView(
        origin="world",
        name="scene",
        contents=["$origin/**", *hidden],
        overrides={
            **{f"world/trails/{name}": until_now for name in vehicles},
            **{f"world/collisions/{name}": until_now for name in vehicles},
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


def _plot(name: str, origin: str, contents: list[str] | None = None, *, rolling: bool) -> Any:
    rrb = import_rerun().blueprint
    return rrb.TimeSeriesView(
        origin=origin,
        contents=["$origin/**"] if contents is None else contents,
        name=name,
        time_ranges=_last_seconds(ROLLING_PLOT_S) if rolling else None,
        plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.LeftTop),
    )


def _plots(
    vehicle: str, sensors: tuple[SensorDescription, ...], *, live: bool, links: bool, rolling: bool
) -> list[Any]:
    root = f"plots/{vehicle}"
    plots = []
    for sensor in sensors:
        at = f"{root}/{sensor.name}"
        if sensor.kind == "imu":
            plots += [
                _plot(f"{sensor.name}: specific force [m/s²]", f"{at}/specific_force", rolling=rolling),
                _plot(f"{sensor.name}: angular rate [rad/s]", f"{at}/angular_rate", rolling=rolling),
            ]
    for sensor in sensors:
        at = f"{root}/{sensor.name}"
        if sensor.kind == "odometry":
            motion = [f"/{at}/speed", f"/{at}/height"] + ([] if live else [f"/{root}/clearance"])
            name = "speed [m/s], height" + (" [m]" if live else ", clearance [m]")
            plots += [
                _plot(name, at, motion, rolling=rolling),
                _plot("rotor speed [rad/s]", f"{at}/rotor_speed", rolling=rolling),
            ]
    if live:
        plots.append(_plot("command", f"{root}/command", rolling=rolling))
        plots.append(_timing_plot(rolling=rolling))
    if links:
        plots.append(_plot("link delay [ms]", f"{root}/links", rolling=rolling))
    return plots


def _timing_plot(*, rolling: bool) -> Any:
    return _plot("loop timing [ms]", "simulator/timing", rolling=rolling)


def _simulator_plots(*, rolling: bool) -> list[Any]:
    return [
        _timing_plot(rolling=rolling),
        _plot("real-time factor", "simulator/real_time_factor", rolling=rolling),
        _plot("lost messages", "simulator/losses", rolling=rolling),
    ]
