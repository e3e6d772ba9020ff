# mypy: disable-error-code="attr-defined,call-overload"
"""The state of a run: the vehicles of all worlds, the buffers of their sensors, and its progress."""

from __future__ import annotations

import math
from collections import defaultdict, deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from neurosim_core.clock import to_ns
from neurosim_core.control import CommandMode, Controller, ControllerContext, PathController
from neurosim_core.frames import as_rows, normalised
from neurosim_core.packets import Odometry
from neurosim_core.runtime.cuda import HostCopy
from neurosim_core.runtime.pipeline import Pipeline
from neurosim_core.sensors.base import (
    Sampler,
    SamplerContext,
    StateSensorConfig,
)
from neurosim_core.sensors.state_sampler import make_sampler
from neurosim_core.sim.inputs import CommandBuffer, Start, begin_of_paths, restart
from neurosim_core.sim.model import Model
from neurosim_core.sim.parameters import WorldSettings
from neurosim_core.sim.render_group import PictureAllocator, RenderGroupState, make_render_groups
from neurosim_core.sim.scene_table import single_scene
from neurosim_core.sim.schedule import Stretch
from neurosim_core.sim.trace import Trace, WorldArrays, make_surfaces
from neurosim_core.vehicle import DynamicsError
from neurosim_core.vehicle.base import Vehicle, VehicleContext

if TYPE_CHECKING:
    from neurosim_core.sim.cameras import RenderJob

_IN_FLIGHT_ON_CUDA = 5
"""Batches in flight on CUDA. With three, one is flown and one rendered while the host reads a third."""


@dataclass(frozen=True, kw_only=True)
class StartState:
    """The state at the start of an episode, with rotors at hover. None: the start of the configured path."""

    position: ArrayLike | None = None
    """p_WB [m], shape [3]."""
    orientation: ArrayLike | None = None
    """q_WB, xyzw, shape [4]."""
    velocity: ArrayLike | None = None
    """v_WB in W [m/s], shape [3]."""
    body_rate: ArrayLike | None = None
    """w_WB in B [rad/s], shape [3]."""


@dataclass(kw_only=True, eq=False)
class Batch:
    """A stretch of a run that is launched as one unit: its motion, then its renders and scans."""

    stretch: Stretch
    """The boundaries of the batch, relative to its begin."""
    stamps_ns: Sequence[int]
    """Stamps of its boundaries in the run [ns]."""
    closed_loop: bool
    """The path controller commands; otherwise the last command is held."""
    step_count: int
    """Number of integration steps."""
    command_count: int
    """Number of commands of the path controller."""
    number: int
    """Index of the batch, counted from the start of the state."""
    slot: int
    """Slot of the first boundary in the trace, and of its first sample in the arrays of each sampler."""
    enabled_cameras: frozenset[str]
    """Cameras that are rendered."""
    reset_mask: Any
    """Worlds whose episode begins with this batch, device array of int32, shape [N]; None: none."""
    until_ns: int
    """Packets after this stamp are dropped [ns]. It is before the end of the batch if a collision ends the
    run."""
    jobs: Sequence[RenderJob] | None = None
    """The renders of all groups; None: not planned yet."""
    left_out_count: int = 0
    """Ticks that adaptive groups do not render."""
    coarse_count: int = 0
    """Renders after which a point moves further than `max_displacement_px` until the next tick."""


@dataclass(kw_only=True, eq=False)
class State:
    """The data that change during a run."""

    world_count: int
    on_host: bool
    """Results go to the host as packets; else they stay on the device."""
    wall_s: dict[str, float]
    """Wall-clock time by phase [s]."""
    vehicle: Vehicle
    worlds: Any
    """The vehicles and the clocks of their worlds as kernels see them (`trace.WorldArrays`)."""
    start: Any
    """Initial states of vehicles, one row for each world (`inputs.Start`)."""
    path_controller: PathController | None
    """Follows the path; None: the path prescribes the motion."""
    trace: Trace
    groups: list[RenderGroupState]
    samplers: dict[str, Sampler]
    sampler_copies: dict[str, dict[str, HostCopy]]
    """Host copies of the measurements of each sampler, in the slots of the trace; empty without `on_host`."""
    seeds: Any
    """Seed of each world, device array of uint64."""
    pipeline: Pipeline
    """The streams, fences and graphs of the device."""
    borrow_pictures: bool
    """Pictures are views that the next batch with the same buffers overwrites."""
    pictures_in_place: bool
    """Pictures in buffers of the caller are returned before the device has finished them (`settle` waits)."""
    enabled_cameras: frozenset[str]
    """Cameras that are rendered, from the next batch on."""
    stamp_ns: int = 0
    """Time up to which packets have been returned [ns]."""
    launched_ns: int = 0
    """Time up to which work has been launched [ns]."""
    launched_count: int = 0
    """Number of batches whose motion has been launched."""
    rendered_count: int = 0
    """Number of batches whose cameras were rendered or skipped; written by the thread that renders."""
    last: Odometry | None = None
    """The vehicle's state at the last boundary that was read back."""
    controllers: dict[str, Controller] = field(default_factory=dict)
    """Converters from setpoints to rotor speeds, by command mode, made at the first use of the mode."""
    commands: dict[str, CommandBuffer] = field(default_factory=dict)
    """Setpoint buffers by command mode, made at the first use of the mode."""
    command_mode: CommandMode | None = None
    """Mode of the setpoint that the next batch takes; None: no new setpoint."""
    in_flight: deque[Batch] = field(default_factory=deque)
    """Batches that are launched and not read, oldest first."""
    planned: Batch | None = None
    """The first batch of the next control period, if `prepare_step` has planned it."""
    sequence: dict[str, int] = field(default_factory=lambda: defaultdict(int))
    """Sequence number of the next packet of each sensor."""
    touching: bool = False
    """The vehicle touched the scene at the last boundary."""
    ended: bool = False
    """A collision ended the run."""
    failure: DynamicsError | None = None
    """The integration failed; packets up to its stamp have been returned."""
    counts: dict[str, int] = field(default_factory=lambda: defaultdict(int))
    """Counters of the run: steps, commands, redone intervals (integrated again with adaptive steps), renders,
    ticks left out, coarse ticks, events dropped, collisions."""


def make_state(
    model: Model,
    *,
    in_flight: int | None = None,
    render_backlog: int | None = None,
    borrow_pictures: bool = False,
    allocate_picture: PictureAllocator | None = None,
    seed: int | None = None,
    start: StartState | None = None,
    worlds: WorldSettings | None = None,
) -> State:
    """Allocate everything an episode needs, for one world with packets on the host, or for many worlds.

    Args:
        model: The model of the run.
        in_flight: Number of batches that `run_model` keeps in flight. By default 5 on a CUDA device, and 1
            where launches are synchronous. It does not change the packets.
        render_backlog: Number of batches of `integrate_period` that may wait for `render_batch`: at least
            `in_flight`, which is the default.
        borrow_pictures: Return pictures as views, without a copy. With one batch in flight, a picture is
            valid until the next `step` or `render_batch`; pictures that the same step overwrites are copied.
        allocate_picture: Returns a buffer of the caller for a picture, or None; called before pictures are
            rendered. The device copies the picture there asynchronously: `settle` waits for the copies.
        seed: Seed of sensor noise and turbulence; None: as configured.
        start: Initial state of the vehicle; None: as configured.
        worlds: Settings of many worlds, whose results stay on the device; None: one world with packets.

    Raises:
        ValueError: The start has a wrong shape or is not finite, or the path prescribes the motion.
    """
    config, device = model.config, model.device
    on_host = worlds is None
    if worlds is None:
        worlds = _single_world(model, seed)
    in_flight = _in_flight(model, in_flight, on_host=on_host)
    count = len(worlds.seeds)
    flown_ahead = max(in_flight, render_backlog or 0)
    slot_count = flown_ahead * worlds.slot_count
    seeds: Any = wp.array(np.array(worlds.seeds, dtype=np.uint64), dtype=wp.uint64, device=device)
    vehicle: Any = _make_vehicle(model, worlds, seeds)
    is_prescribed = model.path.attitude is not None
    if is_prescribed and start is not None:
        raise ValueError("path.kind poses prescribes the start of an episode: give no start")
    world_arrays = _make_world_arrays(vehicle)
    wall_s: dict[str, float] = defaultdict(float)
    ground = model.airframe.ground
    surfaces = make_surfaces(
        worlds.scenes.fields,
        worlds.scenes.scene,
        radius_m=-math.inf if is_prescribed else config.vehicle.collision_radius_m,  # it touches nothing
        ground_height_m=None if ground is None else ground.height_m,
        stop_on_contact=config.vehicle.on_collision == "end",
    )
    context = partial(
        SamplerContext,
        vehicle=vehicle,
        slot_count=slot_count,
        seeds=seeds,
        active=world_arrays.active,
        surfaces=surfaces,
    )
    samplers = {
        name: make_sampler(sensor, context(name=name))
        for name, sensor in config.sensors.items()
        if isinstance(sensor, StateSensorConfig)
    }
    trace = Trace(
        surfaces,
        world_arrays,
        vehicle,
        capacity=slot_count,
        history_length=_history_length(model, slot_count + worlds.slot_count),
        on_host=on_host,
    )
    state = State(
        world_count=count,
        on_host=on_host,
        vehicle=vehicle,
        worlds=world_arrays,
        start=_make_start(worlds, start, device),
        path_controller=None if is_prescribed else _path_controller(model, worlds),
        trace=trace,
        groups=make_render_groups(
            model,
            worlds,
            seeds=seeds,
            history=trace.arrays.history,
            clock_ns=world_arrays.clock_ns,
            in_flight=in_flight,
            on_host=on_host,
            allocate_picture=allocate_picture,
        ),
        samplers=samplers,
        sampler_copies={
            name: {field: HostCopy(array) for field, array in sampler.arrays.items()}
            for name, sampler in samplers.items()
            if on_host
        },
        seeds=seeds,
        pipeline=Pipeline(
            device,
            wall_s,
            in_flight=in_flight,
            flown_ahead=flown_ahead,
            single_graph=not on_host
            or (in_flight == 1 and allocate_picture is None and _is_one_graph(model)),
            adaptive=bool(model.schedule.sparse),
        ),
        wall_s=wall_s,
        borrow_pictures=borrow_pictures,
        pictures_in_place=allocate_picture is not None,
        enabled_cameras=frozenset(name for group in model.groups for name in group.names),
    )
    reset_vehicles(model, state, wp.ones(count, dtype=wp.int32, device=device))
    return state


def _in_flight(model: Model, asked: int | None, *, on_host: bool) -> int:
    """Return the number of batches in flight; `asked` is the argument of `make_state`."""
    if any(getattr(sensor, "remembers", False) for sensor in model.config.sensors.values()):
        return 1
    if asked is not None:
        return asked
    overlap = on_host and _is_cuda(model) and model.config.renderer.only_launches
    return _IN_FLIGHT_ON_CUDA if overlap else 1


def _is_one_graph(model: Model) -> bool:
    """Return whether all launches of a batch can form one CUDA graph, if no other batch is in flight."""
    return _is_cuda(model) and not model.schedule.sparse and model.config.renderer.only_launches


def _is_cuda(model: Model) -> bool:
    return bool(wp.get_device(model.device).is_cuda)


def _path_controller(model: Model, worlds: WorldSettings) -> PathController:
    """Return the controller that follows the paths of all worlds."""
    return model.config.control.make(
        ControllerContext(
            airframe=model.airframe,
            paths=[worlds.scenes.models[scene].path for scene in worlds.scenes.scene_of_world],
            device=model.device,
        )
    )


def _single_world(model: Model, seed: int | None) -> WorldSettings:
    """Return the settings of the one world of a single run."""
    return WorldSettings(
        scenes=single_scene(model),
        seeds=[model.config.seed if seed is None else seed],
        rigs=[model.config.sensors],
        instant_count=0,
        slot_count=model.schedule.boundary_count_max(),
    )


def _history_length(model: Model, slot_count: int) -> int:
    """Return the number of boundaries that the history keeps for cameras, besides those flown ahead."""
    window_ns = max((group.window_ns for group in model.groups), default=0)
    return model.schedule.boundary_count_max(1e-9 * window_ns) + slot_count


def _make_vehicle(model: Model, worlds: WorldSettings, seeds: Any) -> Vehicle:
    """Return the vehicles of all worlds."""
    max_step_ns = to_ns(model.config.vehicle.max_step_s)
    if model.path.attitude is not None:
        from neurosim_core.sim.kinematic_vehicle import KinematicVehicle

        return KinematicVehicle(
            model.airframe,
            [each.path for each in worlds.scenes.models],
            path_of_world=worlds.scenes.scene_of_world,
            device=model.device,
            max_step_ns=max_step_ns,
        )
    return model.config.vehicle.make(
        VehicleContext(count=len(worlds.seeds), device=model.device, max_step_ns=max_step_ns, seeds=seeds)
    )


def _make_start(worlds: WorldSettings, chosen: StartState | None, device: str) -> Any:
    """Allocate the initial states of all worlds."""
    rows: Mapping[str, Any] = begin_of_paths(worlds.scenes)
    start = Start()
    for name, configured in rows.items():
        given = None if chosen is None else getattr(chosen, name)
        value = configured
        if given is not None:
            value = as_rows(given, name=name, count=len(configured), width=configured.shape[1])
            value = normalised(value) if name == "orientation" else value
        setattr(start, name, wp.array(value, dtype=wp.float64, device=device))
    return start


def _make_world_arrays(vehicle: Vehicle) -> Any:
    arrays = WorldArrays()
    arrays.vehicles = vehicle.arrays
    arrays.clock_ns = wp.zeros(vehicle.count, dtype=wp.int64, device=vehicle.device)
    arrays.collided = wp.zeros(vehicle.count, dtype=wp.int32, device=vehicle.device)
    arrays.active = wp.ones(vehicle.count, dtype=wp.int32, device=vehicle.device)
    return arrays


def reset_vehicles(model: Model, state: State, mask: Any) -> None:
    """Reset vehicles whose mask [N] is not 0 to `State.start`, rotors at hover, time 0; launches only."""
    wp.launch(
        restart,
        dim=state.world_count,
        inputs=[model.airframe.hover_rotor_speed_rad_s, mask, state.start],
        outputs=[state.worlds],
        device=model.device,
    )
    state.vehicle.begin(mask)
    if state.path_controller is not None:
        state.path_controller.begin(mask)
    for sampler in state.samplers.values():
        sampler.reset(mask)
