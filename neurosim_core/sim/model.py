# mypy: disable-error-code="attr-defined"
"""What does not change during a run: the scene, the path, and what has to be computed of them."""

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

import warp as wp

from neurosim_core.clock import Rate, to_ns
from neurosim_core.config import SimulationConfig
from neurosim_core.render.renderer import upload_scene
from neurosim_core.runtime.timing import timed
from neurosim_core.scene.bodies import Body, make_bodies
from neurosim_core.scene.freespace import FreeSpace, choose_seed, make_free_space, map_distances
from neurosim_core.scene.reader import NotReadError, SceneReader
from neurosim_core.scene.scene import Scene
from neurosim_core.sensors.base import StateSensorConfig
from neurosim_core.sensors.render_plan import RenderGroup, plan_render_groups
from neurosim_core.sim.schedule import Schedule
from neurosim_core.trajectory import CollisionFreeConfig, Path, load_scipy, make_path
from neurosim_core.vehicle import MultirotorConfig
from neurosim_core.warp_start import start_warp

_POSE_RATE_HZ = 500.0
"""Least rate at which poses are recorded for rays with times of their own [Hz]: where rotors answer
within 20 ms, what is interpolated between is off by less than 1e-7 of an amplitude."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Model:
    """What does not change during a run."""

    config: SimulationConfig
    device: str
    scene: Scene
    bodies: tuple[Body, ...]
    """What moves in the scene besides the vehicle; not loaded without cameras."""
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
        meanwhile: Called while the scene is lit with the model as it is without cameras (`warm_flight`), and
            with what says whether the scene is lit.

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
    with ThreadPoolExecutor(max_workers=4) as aside:
        beginning = aside.submit(wp.zeros, 1, device=device)  # a CUDA context begins while the scene is read

        def map_scene() -> FreeSpace:
            geometry = reading.result()
            beginning.result()  # Warp makes a device's streams at its first use, which must be in one thread
            return map_distances(geometry, config.free_space, device)

        def light_scene() -> tuple[Scene, Any]:
            whole = reading.result() if reader is None else reader.scene(config.scene)
            if not seeing:
                return whole, None
            beginning.result()
            return whole, upload_scene(
                whole, config.render, device=device, renderer=config.renderer, bodies=bodies
            )

        with phase("scene"):
            if reader is None:  # in this thread, where Ctrl-C interrupts it
                scene = config.scene.load(pictures=seeing)
                reading = aside.submit(lambda: scene)
            else:
                reading = aside.submit(reader.geometry, config.scene)
            mapping, lighting = aside.submit(map_scene), aside.submit(light_scene)
            if reader is not None:
                load_scipy()  # while the other process reads, and distances are mapped
            scene = reading.result()
        with phase("free space"):
            free_space = choose_seed(mapping.result(), scene, config.free_space)
        with phase("path"):
            paths = {name: plan_path(member, free_space) for name, member in members.items()}

        def model_of(name: str, config: SimulationConfig, scene_on_device: Any) -> Model:
            return _make_member(
                config, device, scene, bodies, free_space, paths[name], scene_on_device, setup_s
            )

        with phase("light"):
            if meanwhile is not None and seeing:
                name, first = next(iter(members.items()))
                blind = {key: s for key, s in first.sensors.items() if isinstance(s, StateSensorConfig)}
                meanwhile(model_of(name, first.model_copy(update={"sensors": blind}), None), lighting.done)
            scene, scene_on_device = lighting.result()
    return {name: model_of(name, config, scene_on_device) for name, config in members.items()}


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


def plan_path(config: SimulationConfig, free_space: FreeSpace) -> Path:
    """Return the path of the only vehicle.

    Args:
        config: What to fly.
        free_space: Where it can fly in the scene of `config`.

    Raises:
        ValueError: No path exists, or it begins inside a solid or below the ground.
    """
    path = make_path(config.path, free_space, config.vehicle.airframe(), duration_s=config.duration_s)
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


def find_device(name: str) -> str:
    """Return the device that is meant.

    Raises:
        ValueError: It is not on this machine.
        RuntimeError: This process was forked from one that had used a device.
    """
    start_warp()
    known = [str(device) for device in wp.get_devices()]
    if name == "auto":
        return "cuda:0" if "cuda:0" in known else "cpu"
    if name == "cuda":
        name = "cuda:0"
    if name not in known:
        raise ValueError(
            f"device {name!r} is not on this machine, known: {known}; cuda needs a GPU of NVIDIA and its "
            "driver (`nvidia-smi` lists it), and device: auto takes what there is"
        )
    return name
