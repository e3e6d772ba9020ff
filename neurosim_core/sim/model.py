# mypy: disable-error-code="attr-defined"
"""The model of a run, which does not change during it: the scene, the path, and what is computed of them."""

from __future__ import annotations

import contextlib
import functools
import math
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from neurosim_core.clock import Rate, to_ns
from neurosim_core.config import SimulationConfig
from neurosim_core.garbage import pause_collection
from neurosim_core.path_process import NotPlannedError, PlanningProcess
from neurosim_core.render.renderer import upload_scene
from neurosim_core.runtime.timing import timed
from neurosim_core.scene.bodies import Body, make_bodies
from neurosim_core.scene.freespace import FreeSpace, choose_seed, make_free_space, map_distances
from neurosim_core.scene.reader import NotReadError, SceneReader
from neurosim_core.scene.scene import Material, Scene, Texture
from neurosim_core.sensors.base import StateSensorConfig
from neurosim_core.sensors.render_plan import RenderGroup, plan_render_groups
from neurosim_core.sim.schedule import Schedule
from neurosim_core.trajectory import CollisionFreeConfig, Path, check_thrust, make_path
from neurosim_core.trajectory.shapes import HoverConfig, hover
from neurosim_core.vehicle import MultirotorConfig
from neurosim_core.warp_start import find_device

_POSE_RATE_HZ = 500.0
"""Least rate at which poses are recorded for rays with times of their own [Hz]: where rotors answer
within 20 ms, what is interpolated between is off by less than 1e-7 of an amplitude."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Model:
    """The data that do not change during a run."""

    config: SimulationConfig
    device: str
    scene: Scene
    bodies: tuple[Body, ...]
    """Bodies that move in the scene besides the vehicle; not loaded without cameras."""
    free_space: FreeSpace
    path: Path
    airframe: MultirotorConfig
    groups: tuple[RenderGroup, ...]
    schedule: Schedule
    samplers: tuple[str, ...]
    """Names of the sensors behind `schedule.samplers`."""
    scene_on_device: Any
    """The scene as the renderer keeps it on the device; None without cameras."""
    setup_s: Mapping[str, float]
    """Wall-clock time that each part of the set-up took [s]."""

    @functools.cached_property
    def duration_ns(self) -> int:
        """Length of the run [ns]."""
        return to_ns(self.config.duration_s)


def make_model(
    config: SimulationConfig,
    *,
    reader: SceneReader | None = None,
    on_phase: Callable[[str], None] | None = None,
    meanwhile: Callable[[Model, Callable[[], bool]], None] | None = None,
) -> Model:
    """Load or generate the scene, plan the path and decide what has to be computed.

    Args:
        config: What to fly; one vehicle.
        reader: Reads the scene in another process; None: it is read here.
        on_phase: Told the name of each part of the work when it begins.
        meanwhile: Called while the scene is lit and paths are planned (`warm_flight`) with a model that needs
            the same kernels: it hovers, and sees a triangle, or nothing by a renderer that is not `warp`. Its
            second argument says whether the scene is lit.

    Raises:
        ValueError: There are several vehicles, the scene cannot be loaded, no path exists, or the device is
            not there.
    """
    if len(config.vehicles) > 1:
        raise ValueError(
            f"this flies one vehicle, got {', '.join(config.vehicles)}: `neurosim up` flies several at once"
        )
    return next(iter(make_fleet(config, reader=reader, on_phase=on_phase, meanwhile=meanwhile).values()))


def refit(model: Model, config: SimulationConfig, *, replan: bool = False) -> Model:
    """Return a model with other sensors, rates and launches in the same scene and light.

    Vehicle, device and renderer of `config` are those of `model`; its scene is not looked at, and its path is
    flown if it is to `replan`.

    Raises:
        ValueError: No path exists.
    """
    config = config.model_copy(update={"scene": model.config.scene})
    return _make_member(
        config,
        model.device,
        model.scene,
        model.bodies,
        model.free_space,
        plan_path(config, model.free_space) if replan else model.path,
        model.scene_on_device,
        model.setup_s,
    )


def make_fleet(
    config: SimulationConfig,
    *,
    reader: SceneReader | None = None,
    on_phase: Callable[[str], None] | None = None,
    meanwhile: Callable[[Model, Callable[[], bool]], None] | None = None,
) -> dict[str, Model]:
    """Return a model for each vehicle by name; they share the scene, its free space and its light.

    Arguments and errors as for `make_model`.
    """
    with pause_collection():
        if reader is not None:
            with contextlib.suppress(NotReadError):
                return _make_fleet(config, reader, on_phase, meanwhile)
        return _make_fleet(config, None, on_phase, meanwhile)


def _make_fleet(
    config: SimulationConfig,
    reader: SceneReader | None,
    on_phase: Callable[[str], None] | None,
    meanwhile: Callable[[Model, Callable[[], bool]], None] | None,
) -> dict[str, Model]:
    """Do what `make_fleet` does, if the reader could read the scene."""
    setup_s: dict[str, float] = defaultdict(float)

    def phase(name: str) -> AbstractContextManager[None]:
        if on_phase is not None:
            on_phase(name)
        return timed(setup_s, name)

    device = find_device(config.device)
    members = {name: config.of(name) for name in config.vehicles}
    seeing = any(plan_render_groups(member.sensors) for member in members.values())
    bodies = make_bodies(config.bodies) if seeing else ()
    with ThreadPoolExecutor(max_workers=5) as aside:
        beginning = aside.submit(wp.zeros, 1, device=device)  # a CUDA context begins while the scene is read

        def map_scene() -> FreeSpace:
            geometry = reading.result()
            beginning.result()  # Warp makes a device's streams at its first use, which must be in one thread
            return map_distances(geometry, config.free_space, device)

        def plan_there() -> tuple[FreeSpace, dict[str, Path]]:
            if reader is None or reader.planner is None:
                raise NotPlannedError
            return _plan_there(members, reader.planner, reading.result(), mapping.result)

        def upload(scene: Scene) -> Any:
            beginning.result()
            return upload_scene(scene, config.render, device=device, renderer=config.renderer, bodies=bodies)

        with phase("scene"):
            if reader is None:  # in this thread, where Ctrl-C interrupts it
                scene = config.scene.load(pictures=seeing)
                reading = aside.submit(lambda: scene)
            else:
                reading = aside.submit(reader.geometry, config.scene)
            mapping = aside.submit(map_scene)
            planning = aside.submit(plan_there)
            scene = reading.result() if reader is None else reader.scene(config.scene)
            lighting = None
            if seeing:  # kernels that light needs, too, are loaded by the sketch: never in two threads
                sketch = upload(_sketch(scene)) if meanwhile and config.renderer.kind == "warp" else None
                lighting = aside.submit(upload, scene)
        with phase("free space"):
            room = mapping.result()
        with phase("kernels"):
            if meanwhile is not None and lighting is not None:
                first = next(iter(members.values()))
                if sketch is None:
                    blind = {key: s for key, s in first.sensors.items() if isinstance(s, StateSensorConfig)}
                    first = first.model_copy(update={"sensors": blind})
                path = hover(HoverConfig(), position=room.seed_m)
                warm = _make_member(first, device, scene, bodies, room, path, sketch, setup_s)
                meanwhile(warm, lighting.done)
        with phase("path"):
            try:
                free_space, paths = planning.result()
            except NotPlannedError:
                free_space, paths = _plan_here(members, room, scene)
        with phase("light"):
            on_device = None if lighting is None else lighting.result()
    return {
        name: _make_member(member, device, scene, bodies, free_space, paths[name], on_device, setup_s)
        for name, member in members.items()
    }


def _sketch(scene: Scene) -> Scene:
    """Return a triangle that is rendered by the same kernels as a scene."""
    glows = any(max(material.emission) > 0.0 for material in scene.materials)
    texture = Texture(name="", srgb=np.zeros((1, 1, 3), np.uint8))
    material = Material(
        name="",
        emission=(1.0, 1.0, 1.0) if glows else (0.0, 0.0, 0.0),
        texture=texture if any(m.texture is not None for m in scene.materials) else None,
    )
    triangle = np.eye(3, dtype=np.float32)
    return Scene(
        name="",
        vertices=triangle,
        faces=np.array([[0, 1, 2]], np.int32),
        normals=triangle,
        uv=triangle[:, :2],
        face_material=np.zeros(1, np.int32),
        face_instance=np.zeros(1, np.int32),
        instance_names=("",),
        materials=(material,),
        lights=scene.lights[:1],
    )


def plan_paths(config: SimulationConfig, vehicles: Sequence[str] | None = None) -> dict[str, Path]:
    """Return the paths of vehicles by name, as `make_fleet` plans them; without light and cameras.

    Args:
        config: What to fly.
        vehicles: Names of vehicles; None: all.

    Raises:
        KeyError: There is no such vehicle.
        ValueError: The scene cannot be loaded, or no path exists.
    """
    members = {name: config.of(name) for name in (vehicles or config.vehicles)}
    scene = config.scene.load(pictures=False)
    free_space = make_free_space(scene, config.free_space, device=find_device(config.device))
    return {name: plan_path(member, free_space) for name, member in members.items()}


def _plan_there(
    members: Mapping[str, SimulationConfig],
    planner: PlanningProcess,
    scene: Scene,
    mapped: Callable[[], FreeSpace],
) -> tuple[FreeSpace, dict[str, Path]]:
    """Have another process do what `_plan_here` does.

    Raises:
        NotPlannedError: It could not, or it would take longer than here.
    """
    flights = [(config.path, config.duration_s) for config in members.values()]
    if not all(isinstance(path, CollisionFreeConfig) for path, _ in flights):
        planner.close()  # or it would stay, with its libraries, as long as the flight
        raise NotPlannedError
    for config in members.values():
        check_thrust(config.path, config.vehicle.airframe())
    room = next(iter(members.values())).free_space
    free_space, paths = planner.plan(scene, room, flights, mapped=mapped)
    return free_space, dict(zip(members, paths, strict=True))


def _plan_here(
    members: Mapping[str, SimulationConfig], unseeded: FreeSpace, scene: Scene
) -> tuple[FreeSpace, dict[str, Path]]:
    """Return the map of a scene with its seed, and the path of each vehicle by name."""
    room = next(iter(members.values())).free_space
    free_space = choose_seed(unseeded, room, inside_m=scene.inside_m)
    return free_space, {name: plan_path(member, free_space) for name, member in members.items()}


def plan_path(config: SimulationConfig, free_space: FreeSpace) -> Path:
    """Return the path of the only vehicle.

    Args:
        config: What to fly.
        free_space: Where it can fly in the scene of `config`.

    Raises:
        ValueError: No path exists, or it begins inside a solid or below the ground.
    """
    check_thrust(config.path, config.vehicle.airframe())
    path = make_path(config.path, free_space, duration_s=config.duration_s)
    if not isinstance(config.path, CollisionFreeConfig):  # those begin in free space
        start = path.evaluate([0]).position[0]
        free_space.check_start(start)
        ground = None if config.path.kind == "poses" else config.vehicle.airframe().ground
        if ground is not None and start[2] < ground.height_m:
            raise ValueError(
                f"the path begins at z = {start[2]:g} m, below the ground at {ground.height_m:g} m"
            )
    return path


def _make_member(
    config: SimulationConfig,
    device: str,
    scene: Scene,
    bodies: tuple[Body, ...],
    free_space: FreeSpace,
    path: Path,
    scene_on_device: Any,
    setup_s: Mapping[str, float],
) -> Model:
    """Return the model of one vehicle in a scene."""
    groups = plan_render_groups(config.sensors)
    samplers = {name: s for name, s in config.sensors.items() if isinstance(s, StateSensorConfig)}
    return Model(
        config=config,
        device=device,
        scene=scene,
        bodies=bodies,
        free_space=free_space,
        path=path,
        airframe=config.vehicle.airframe(),
        groups=groups,
        schedule=Schedule(
            control=Rate(config.control.rate_hz),
            samplers=tuple(sampler.clock for sampler in samplers.values()),
            groups=tuple(group.rate for group in groups),
            images={name: config.sensors[name].clock for group in groups for name in group.image_sensors},
            instants_per_launch=config.instants_per_launch,
            poses=_pose_clocks(config, groups),
            sparse=frozenset(i for i, group in enumerate(groups) if group.max_displacement_px is not None),
        ),
        samplers=tuple(samplers),
        scene_on_device=scene_on_device if groups else None,
        setup_s=setup_s,
    )


def _pose_clocks(config: SimulationConfig, groups: Sequence[RenderGroup]) -> tuple[Rate, ...]:
    """Return a multiple of the control clock at which poses are recorded, if rays have times of their own."""
    if not any(group.window_ns for group in groups):
        return ()
    control_hz = config.control.rate_hz
    return (Rate(control_hz * math.ceil(_POSE_RATE_HZ / control_hz)),)
