"""Parameters that differ between worlds: arrays of camera settings -> the cameras of each world."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from pydantic import ValidationError

from neurosim_core.config_errors import explain
from neurosim_core.render.camera import Lens
from neurosim_core.sensors.base import CameraConfig, SensorConfig
from neurosim_core.sensors.render_plan import RenderGroup
from neurosim_core.sim.scene_table import SceneTable

Rig = dict[str, SensorConfig]
"""The sensors of one world by name."""


@dataclass(frozen=True, kw_only=True, eq=False)
class WorldSettings:
    """Settings of worlds that are stepped together: their differences and their results."""

    scenes: SceneTable
    seeds: Sequence[int]
    """Seed of each world."""
    rigs: Sequence[Rig]
    """The sensors of each world."""
    instant_count: int
    """Largest number of instants of a group in one step."""
    slot_count: int
    """Largest number of boundaries in one step."""
    lenses: Mapping[str, Sequence[Lens]] = field(default_factory=dict)
    """Lenses that worlds can switch between at resets, by camera, in place of those of `rigs`."""
    event_capacity: int | None = None
    """Capacity for the events of one world and camera in one step."""
    ordered: bool = True
    """Sort events."""


def vary_sensors(sensors: Rig, parameters: Mapping[str, ArrayLike], count: int) -> list[Rig]:
    """Return the sensors of each world: those of the configuration with the values of `parameters`.

    Parameters are one number for each world by name of the camera and key: "front.threshold_on",
    "front.shot_noise.rate_hz" (keys of the pixels of an event camera), "front.lens.horizontal_fov_rad".

    Raises:
        ValueError: There is no such camera or key, worlds cannot differ in it, or there is not one number for
            each world, in range.
    """
    columns = {key: _column(key, values, count) for key, values in parameters.items()}
    for key in columns:
        _place(sensors, key)
    if not columns:
        return [sensors] * count
    rigs = []
    for world in range(count):
        rig = dict(sensors)
        changes: dict[str, dict[str, Any]] = {}
        for key, column in columns.items():
            name, place = _place(sensors, key)
            changed = changes.setdefault(name, rig[name].model_dump())
            for part in place[:-1]:
                changed[part] = dict(changed.get(part) or {})
                changed = changed[part]
            changed[place[-1]] = column[world]
        for name, values in changes.items():
            kind = type(sensors[name])
            try:
                rig[name] = kind.model_validate(values)
            except ValidationError as error:
                lines = "; ".join(explain(kind, error))
                raise ValueError(f"parameters of {name!r} in world {world}: {lines}") from None
        rigs.append(rig)
    return rigs


def lenses_differ(rigs: Sequence[Rig]) -> bool:
    """Return whether some camera has different lenses in two worlds."""
    lenses = [{name: getattr(sensor, "lens", None) for name, sensor in rig.items()} for rig in rigs]
    return any(other != lenses[0] for other in lenses[1:])


def check_lenses(sensors: Rig, lenses: Mapping[str, Sequence[Lens]]) -> None:
    """Check the lenses that cameras can switch between.

    Raises:
        ValueError: A name is no camera, or a lens has another size than its pictures.
    """
    for name, table in lenses.items():
        camera = sensors.get(name)
        if not isinstance(camera, CameraConfig):
            raise ValueError(f"lenses: {name!r} is no camera, known: {', '.join(sensors)}")
        size = camera.optics.width, camera.optics.height
        if not table or any((lens.width, lens.height) != size for lens in table):
            raise ValueError(f"lenses of {name!r}: give at least one, all of {size[0]} x {size[1]} px")


def lens_tables(group: RenderGroup, worlds: WorldSettings) -> tuple[list[Any], list[int]]:
    """Return the lenses that a render group has in some world, and which of them it has in each.

    Raises:
        ValueError: Cameras of the group, which share their rays, differ in some world.
    """
    for name in group.names:
        if name in worlds.lenses:
            return list(worlds.lenses[name]), [0] * len(worlds.rigs)
    lenses: dict[Any, int] = {}
    chosen = []
    for world, rig in enumerate(worlds.rigs):
        found = {name: rig[name].optics for name in group.names}  # type: ignore[attr-defined]
        lens = found[group.names[0]]
        for name, other in found.items():
            if other != lens:
                raise ValueError(
                    f"{group.names[0]!r} and {name!r} share their rays but have different lenses in world "
                    f"{world}: give both the same"
                )
        chosen.append(lenses.setdefault(lens, len(lenses)))
    return list(lenses), chosen


def _column(key: str, values: ArrayLike, count: int) -> list[float]:
    column = np.asarray(values, dtype=np.float64)
    if column.shape != (count,):
        raise ValueError(f"parameters[{key!r}] must have shape [{count}], got {list(column.shape)}")
    return [float(value) for value in column]


def _place(sensors: Rig, key: str) -> tuple[str, tuple[str, ...]]:
    """Return the sensor and the path of keys below it that a parameter sets."""
    name, *place = key.split(".")
    if name not in sensors or not place:
        raise ValueError(f"parameters: {key!r} names no key of a camera, known: {', '.join(sensors)}")
    sensor = sensors[name]
    pixel = getattr(sensor, "pixel", None)
    if pixel is not None and place[0] in type(pixel).model_fields:
        place = ["pixel", *place]
    allowed = (["pixel"] if pixel is not None else []) + ["lens"]
    if not isinstance(sensor, CameraConfig) or place[0] not in allowed or len(place) < 2:
        raise ValueError(
            f"parameters: worlds cannot differ in {key!r}, only in pixels of event cameras and in lenses"
        )
    if place[0] == "lens" and place[1] in ("width", "height"):
        raise ValueError(f"parameters: all worlds have pictures of one size, {key!r} cannot differ")
    return name, tuple(place)
