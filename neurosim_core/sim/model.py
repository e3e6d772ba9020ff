# mypy: disable-error-code="attr-defined"
"""The model of a run: the scene, the path and the data derived from them, all constant during the run."""

from __future__ import annotations

import contextlib
import functools
import math
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path as FilePath
from typing import Any

import numpy as np

from neurosim_core.clock import Rate, to_ns
from neurosim_core.config import SimulationConfig, as_config
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
from neurosim_core.warp_start import find_device, start_device

_POSE_RATE_HZ = 500.0
"""Lowest rate at which poses are recorded for rays with times of their own [Hz]. For rotors with a time
constant of 20 ms, poses interpolated between them are off by less than 1e-7 of an amplitude."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Model:
    """The data that stay constant during a run."""

    config: SimulationConfig
    device: str
    scene: Scene
    bodies: tuple[Body, ...]
    """Bodies that move in the scene besides the vehicle; empty if there are no cameras."""
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
    config: SimulationConfig | Mapping[str, Any] | str | FilePath | None,
    *,
    reader: SceneReader | None = None,
    on_phase: Callable[[str], None] | None = None,
    meanwhile: Callable[[Model, Callable[[], bool]], None] | None = None,
) -> Model:
    """Load or generate the scene, plan the path, and derive render groups and the schedule.

    Args:
        config: Settings of a run with one vehicle, as `load_config` returns or accepts them.
        reader: Reads the scene in another process; None: this process reads it.
        on_phase: Called with the name of each part of the set-up when it begins.
        meanwhile: Called while light is baked and paths are planned, to compile kernels (`warm_flight`). Its
            first argument is a model that needs the same kernels: it hovers in front of one triangle, or has
            no cameras with renderers other than `warp`. Its second argument returns whether the light is
            ready.

    Raises:
        ValueError: There are several vehicles, the scene cannot be loaded, no path exists, or the device is
            not there.
    """
    config = as_config(config)
    if len(config.vehicles) > 1:
        raise ValueError(
            f"this flies one vehicle, got {', '.join(config.vehicles)}: `neurosim up` flies several at once"
        )
    return next(iter(make_fleet(config, reader=reader, on_phase=on_phase, meanwhile=meanwhile).values()))


def refit(model: Model, config: SimulationConfig, *, replan: bool = False) -> Model:
    """Return a model with other sensors, rates and launches in the same scene and light.

    Vehicle, device and renderer of `config` must be those of `model`. The scene of `config` is ignored; its
    path is planned with `replan`, else the path of `model` is kept.

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
    """Do the work of `make_fleet`; raises `NotReadError` if the reader cannot read the scene."""
    setup_s: dict[str, float] = defaultdict(float)

    def phase(name: str) -> AbstractContextManager[None]:
        if on_phase is not None:
            on_phase(name)
        return timed(setup_s, name)

    device = find_device(config.device)
    members = {name: config.of(name) for name in config.vehicles}
    has_cameras = any(plan_render_groups(member.sensors) for member in members.values())
    bodies = make_bodies(config.bodies) if has_cameras else ()
    with ThreadPoolExecutor(max_workers=5) as executor:
        context = executor.submit(start_device, device)  # creates the CUDA context

        def map_scene() -> FreeSpace:
            context.result()  # Warp makes a device's streams at its first use, which must be in one thread
            return map_distances(scene, config.free_space, device)

        def plan_in_other_process() -> tuple[FreeSpace, dict[str, Path]]:
            if reader is None or reader.planner is None:
                raise NotPlannedError
            return _plan_in_other_process(members, reader.planner, scene, mapping.result)

        def upload(scene: Scene) -> Any:
            context.result()
            return upload_scene(scene, config.render, device=device, renderer=config.renderer, bodies=bodies)

        with phase("scene"):
            if reader is None:  # in this thread, where Ctrl-C interrupts it
                scene = config.scene.load(pictures=has_cameras)
            else:
                scene = reader.scene(config.scene)
            mapping = executor.submit(map_scene)
            planning = executor.submit(plan_in_other_process)
            lighting = None
            if has_cameras:  # the placeholder loads the kernels of baked light: two threads must not
                placeholder = None
                if meanwhile is not None and config.renderer.kind == "warp":
                    placeholder = upload(_placeholder_scene(scene))
                lighting = executor.submit(upload, scene)
        with phase("free space"):
            unseeded = mapping.result()
        with phase("kernels"):
            if meanwhile is not None and lighting is not None:
                first = next(iter(members.values()))
                if placeholder is None:
                    sensors = {k: s for k, s in first.sensors.items() if isinstance(s, StateSensorConfig)}
                    first = first.model_copy(update={"sensors": sensors})
                path = hover(HoverConfig(), position=unseeded.seed_m)
                warm = _make_member(first, device, scene, bodies, unseeded, path, placeholder, setup_s)
                meanwhile(warm, lighting.done)
        with phase("path"):
            try:
                free_space, paths = planning.result()
            except NotPlannedError:
                free_space, paths = _plan_in_this_process(members, unseeded, scene)
        with phase("light"):
            on_device = None if lighting is None else lighting.result()
    return {
        name: _make_member(member, device, scene, bodies, free_space, paths[name], on_device, setup_s)
        for name, member in members.items()
    }


def _placeholder_scene(scene: Scene) -> Scene:
    """Return a scene of one triangle that needs the same render kernels as `scene`."""
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
        config: Settings of the run.
        vehicles: Names of vehicles; None: all.

    Raises:
        KeyError: There is no such vehicle.
        ValueError: The scene cannot be loaded, or no path exists.
    """
    members = {name: config.of(name) for name in (vehicles or config.vehicles)}
    scene = config.scene.load(pictures=False)
    free_space = make_free_space(scene, config.free_space, device=find_device(config.device))
    return {name: plan_path(member, free_space) for name, member in members.items()}


def _plan_in_other_process(
    members: Mapping[str, SimulationConfig],
    planner: PlanningProcess,
    scene: Scene,
    mapped: Callable[[], FreeSpace],
) -> tuple[FreeSpace, dict[str, Path]]:
    """Plan as `_plan_in_this_process` does, in another process.

    Raises:
        NotPlannedError: That process failed, or planning there takes longer than here.
    """
    flights = [(config.path, config.duration_s) for config in members.values()]
    if not all(isinstance(path, CollisionFreeConfig) for path, _ in flights):
        planner.close()  # its libraries would stay in memory during the flight
        raise NotPlannedError
    for config in members.values():
        check_thrust(config.path, config.vehicle.airframe())
    settings = next(iter(members.values())).free_space
    free_space, paths = planner.plan(scene, settings, flights, mapped=mapped)
    return free_space, dict(zip(members, paths, strict=True))


def _plan_in_this_process(
    members: Mapping[str, SimulationConfig], unseeded: FreeSpace, scene: Scene
) -> tuple[FreeSpace, dict[str, Path]]:
    """Return the map of a scene with its seed, and the path of each vehicle by name."""
    settings = next(iter(members.values())).free_space
    free_space = choose_seed(unseeded, settings, inside_m=scene.inside_m)
    return free_space, {name: plan_path(member, free_space) for name, member in members.items()}


def plan_path(config: SimulationConfig, free_space: FreeSpace) -> Path:
    """Return the path of the only vehicle.

    Args:
        config: Settings of a run with one vehicle.
        free_space: Free space of the scene of `config`.

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
    """Return the clock at which poses are recorded for rays with times of their own; empty without them."""
    if not any(group.window_ns for group in groups):
        return ()
    control_hz = config.control.rate_hz
    return (Rate(control_hz * math.ceil(_POSE_RATE_HZ / control_hz)),)
