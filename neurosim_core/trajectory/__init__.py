"""Paths of vehicles, and the planners that make them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import scipy  # which imports its parts when they are used
from pydantic import Field

from neurosim_core.scene.freespace import FreeSpace
from neurosim_core.trajectory.path import Path
from neurosim_core.trajectory.planner import (
    CollisionFreeConfig,
    PlanningError,
    TourConfig,
    WaypointsConfig,
    plan_tour,
    plan_waypoints,
)
from neurosim_core.trajectory.poses import PosesConfig, pose_path
from neurosim_core.trajectory.shapes import (
    CircleConfig,
    FigureEightConfig,
    HoverConfig,
    LineConfig,
    LissajousConfig,
    circle,
    figure_eight,
    hover,
    line,
    lissajous,
)

if TYPE_CHECKING:
    from neurosim_core.vehicle import MultirotorConfig

PathConfig = Annotated[
    TourConfig
    | WaypointsConfig
    | HoverConfig
    | LineConfig
    | CircleConfig
    | FigureEightConfig
    | LissajousConfig
    | PosesConfig,
    Field(discriminator="kind"),
]
"""Where to fly, as a user says it."""

__all__ = [
    "CollisionFreeConfig",
    "Path",
    "PathConfig",
    "PosesConfig",
    "TourConfig",
    "check_thrust",
    "load_scipy",
    "make_path",
]


def make_path(config: PathConfig, space: FreeSpace, *, duration_s: float) -> Path:
    """Plan the path that a configuration asks for; `check_thrust` says whether a vehicle can fly it.

    Tours and waypoints are proven to keep their clearance. Closed forms are flown as they are, through walls
    if so asked: collisions in flight are detected by the simulation.

    Args:
        config: What to fly.
        space: Where.
        duration_s: How long the run is [s].

    Raises:
        PlanningError: There is no path.
    """
    match config:
        case TourConfig():
            return plan_tour(space, config, duration_s=duration_s)
        case WaypointsConfig():
            return plan_waypoints(space, config)
        case HoverConfig():
            return hover(config, position=space.seed_m)
        case LineConfig():
            return line(config)
        case CircleConfig():
            return circle(config, center=space.seed_m)
        case FigureEightConfig():
            return figure_eight(config, center=space.seed_m)
        case LissajousConfig():
            return lissajous(config, center=space.seed_m)
        case PosesConfig():
            return pose_path(config)


def load_scipy() -> None:
    """Import what free space and paths take from SciPy, so that it is there when they need it."""
    _ = scipy.interpolate, scipy.linalg, scipy.ndimage, scipy.optimize


def check_thrust(config: PathConfig, airframe: MultirotorConfig) -> None:
    """Refuse a path whose limits allow more thrust than a vehicle has.

    Raises:
        PlanningError: They do.
    """
    if not isinstance(config, CollisionFreeConfig):
        return
    limits = config.limits
    thrust, weight = airframe.thrust_max_n, airframe.hover_thrust_n
    if limits.thrust_to_weight_max * weight > thrust:
        raise PlanningError(
            f"limits.thrust_to_weight_max = {limits.thrust_to_weight_max:g} is more than the vehicle has: "
            f"its rotors give {thrust:.3g} N at full speed, {thrust / weight:.3g} times its weight"
        )
