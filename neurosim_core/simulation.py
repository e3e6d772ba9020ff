# mypy: disable-error-code="attr-defined,no-untyped-call"
"""The data flow, readable top to bottom: config -> Model -> State -> packets.

A run is cut into batches (`schedule.py`). Within a batch the vehicle is integrated from boundary to boundary,
and its states stay on the device. Then every cast renders all its instants in one launch, every event camera
scans them in one launch, and everything is read back once.

On a CUDA device `run_model` launches the next batch before it reads one back, so the device always has work.
Each batch under way has a lane: slots of the trace and buffers of the casts that no other batch writes to.
What was launched beyond the end of a run is never read.

Who commands from outside goes from one control period to the next: `step` flies one and returns its packets;
`fly_period` flies one and leaves the cameras to another thread, which calls `see` or `skip` for its batches.
"""

from __future__ import annotations

import itertools
import logging
import math
import time
from collections import defaultdict, deque
from collections.abc import Callable, Collection, Hashable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path as FilePath
from typing import Any, NamedTuple

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from neurosim_core.clock import Rate, to_ns
from neurosim_core.config import SimulationConfig, load_config
from neurosim_core.control import CommandMode, Controller, make_controller
from neurosim_core.frames import as_rows
from neurosim_core.packets import Collision, ImuSample, Odometry, Packet
from neurosim_core.render.renderer import SceneOnDevice, upload_scene
from neurosim_core.scene.apartment import ApartmentConfig, make_apartment
from neurosim_core.scene.bodies import Body, make_bodies
from neurosim_core.scene.freespace import FreeSpace, make_free_space
from neurosim_core.scene.mesh import MeshSceneConfig, load_mesh_scene
from neurosim_core.scene.scene import Scene
from neurosim_core.schedule import Boundary, Schedule, batch_end_ns, boundaries, boundary_count_max
from neurosim_core.sensors.cast import (
    CastState,
    Choice,
    Instants,
    Look,
    choose_ticks,
    close_eyes,
    flush_events,
    is_due,
    leave_out,
    make_cast_state,
    plan_look,
    read_events,
    read_images,
    scan_events,
)
from neurosim_core.sensors.imu import Imu
from neurosim_core.sensors.rig import Cast, ImuSensorConfig, OdometrySensorConfig, plan_casts
from neurosim_core.streams import Graphs, HostCopy, HostInput, Milestone, make_stream, on
from neurosim_core.trace import BODY_RATE, ORIENTATION, POSITION, ROTOR_SPEED, VELOCITY, Trace, TraceRows
from neurosim_core.trajectory import Path, make_path
from neurosim_core.vehicle import DynamicsError, Multirotor, MultirotorConfig

logger = logging.getLogger(__name__)

COLLISION = "collision"
"""Name under which collisions are reported."""

_LANES_ON_CUDA = 2


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
    casts: tuple[Cast, ...]
    schedule: Schedule
    samplers: tuple[str, ...]
    """Names of the sensors behind `schedule.samplers`."""
    scene_on_device: SceneOnDevice | None
    """The scene as the renderer keeps it on the device; None without cameras."""
    setup_s: Mapping[str, float]
    """Wall-clock time that each part of the set-up took [s]."""

    @property
    def render_terms(self) -> tuple[str, ...]:
        """What the renderer computes because of the scene and its settings."""
        terms = getattr(self.scene_on_device, "terms", None)
        present = {} if terms is None else terms._asdict()
        return tuple(name for name, value in present.items() if value)

    @property
    def duration_ns(self) -> int:
        """Length of the run [ns]."""
        return to_ns(self.config.duration_s)


@dataclass(frozen=True, kw_only=True)
class StartState:
    """Where an episode starts, with rotors at hover; what is None is as configured: the start of the path."""

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
    """A stretch of a run that was flown, and that cameras may have to look at."""

    boundaries: Sequence[Boundary]
    step_count: int
    """Steps of the integration."""
    command_count: int
    number: int
    """Counts the batches of a state."""
    slot: int
    """Slot of the first boundary in the trace."""
    wanted: frozenset[str]
    """Cameras that look."""
    until_ns: int
    """Packets up to here count [ns]: less than the whole batch where a collision ends the run."""
    seen: Sequence[tuple[CastState, Instants]] = ()
    choices: Sequence[Choice] = ()
    """What adaptive casts render of it."""


class Pilot(NamedTuple):
    """Turns the setpoints of one mode into rotor speeds."""

    controller: Controller
    setpoint: HostInput


@dataclass(kw_only=True, eq=False)
class State:
    """What changes during a run."""

    vehicle: Multirotor
    controller: Controller
    trace: Trace
    casts: list[CastState]
    imus: dict[str, Imu]
    imu_copies: dict[str, tuple[HostCopy, HostCopy]]
    """Specific force and angular rate of each IMU on the host, in the slots of the trace."""
    lanes: Sequence[Milestone]
    """For each batch that cameras may look at, the point where the device has finished it."""
    flight_lane_count: int
    """The most batches that may be flown and not looked at."""
    borrow_pictures: bool
    """Pictures are views that the next batch of their lane overwrites."""
    wanted: frozenset[str]
    """Cameras that look, from the next batch on."""
    flight_stream: wp.Stream | None
    """Where the vehicle moves, ahead of the renderers; with one lane nothing overlaps, one stream does."""
    render_stream: wp.Stream | None
    event_stream: wp.Stream | None
    """Where events are found, while the next batch is rendered."""
    choice_stream: wp.Stream | None
    """Where adaptive casts choose what to render, ahead of the renderers."""
    overlaps: bool
    """Parts of a batch are launched on their own; on a CUDA device with one lane, all as one graph, unless an
    adaptive cast has to wait for the flight."""
    flown: Sequence[Milestone]
    """For each batch that may be flown and not looked at, its end on `flight_stream`."""
    rendered: Milestone
    """End of the batch launched last on `render_stream`."""
    graphs: Graphs
    stamp_ns: int = 0
    """How far packets have been returned [ns]."""
    launched_ns: int = 0
    """How far the device has been told to go [ns]."""
    launched_count: int = 0
    """Batches flown so far."""
    looked_count: int = 0
    """Batches that cameras have looked at, or left out; written by the thread that does."""
    last: Odometry | None = None
    """The state at the end of what was flown and read."""
    rotor_speeds: HostInput
    """Where rotor speeds are commanded from outside."""
    pilots: dict[str, Pilot] = field(default_factory=dict)
    """Who flies in the command modes that were used."""
    order: CommandMode | None = None
    """Mode of the setpoint that the next batch begins with."""
    under_way: deque[Batch] = field(default_factory=deque)
    sequence: dict[str, int] = field(default_factory=lambda: defaultdict(int))
    touching: bool = False
    """The vehicle touched the scene at the last boundary."""
    ended: bool = False
    """A collision ended the run."""
    failure: DynamicsError | None = None
    """The integration failed; packets up to its stamp have been returned."""
    counts: dict[str, int] = field(default_factory=lambda: defaultdict(int))
    """steps, commands, redone intervals (of the dynamics, in adaptive steps), renders, ticks left out, coarse
    ticks, events dropped, collisions."""
    wall_s: dict[str, float] = field(default_factory=lambda: defaultdict(float))
    """Wall-clock time by phase [s]."""


def load_scene(config: ApartmentConfig | MeshSceneConfig, *, pictures: bool = True) -> Scene:
    """Generate or read a scene.

    Args:
        config: Which one.
        pictures: Decode the textures of a file now, or when they are first looked at, if ever.

    Raises:
        SceneError: A file cannot be used.
    """
    if isinstance(config, ApartmentConfig):
        return make_apartment(config)
    return load_mesh_scene(config, pictures=pictures)


def make_model(
    config: SimulationConfig,
    *,
    scene: Scene | None = None,
    on_phase: Callable[[str], None] | None = None,
) -> Model:
    """Load or generate the scene, plan the path and decide what has to be computed.

    Args:
        config: What to fly; one vehicle.
        scene: Where to fly, in place of what `config` says; None: as it says.
        on_phase: Told the name of each part of the work when it begins.

    Raises:
        ValueError: There are several vehicles, the scene cannot be loaded, no path exists, or the device is
            not there.
    """
    if len(config.vehicles) > 1:
        raise ValueError(
            f"this flies one vehicle, got {', '.join(config.vehicles)}: `neurosim up` flies several at once"
        )
    return next(iter(make_fleet(config, scene=scene, on_phase=on_phase).values()))


def refit(model: Model, config: SimulationConfig) -> Model:
    """Return a model with other sensors, rates and launches on the same path in the same scene and light.

    Args:
        model: What was made before.
        config: Its scene, path, vehicle, device and renderer are those of `model`, or are not looked at.
    """
    return _make_member(
        config,
        model.device,
        model.scene,
        model.bodies,
        model.free_space,
        model.path,
        model.scene_on_device,
        model.setup_s,
    )


def make_fleet(
    config: SimulationConfig,
    *,
    scene: Scene | None = None,
    on_phase: Callable[[str], None] | None = None,
) -> dict[str, Model]:
    """Return a model for each vehicle by name; they share the scene, its free space and its light.

    Arguments and errors as for `make_model`.
    """
    setup_s: dict[str, float] = defaultdict(float)

    def phase(name: str) -> AbstractContextManager[None]:
        if on_phase is not None:
            on_phase(name)
        return timed(setup_s, name)

    device = find_device(config.device)
    with phase("scene"):
        members = {name: config.of(name) for name in config.vehicles}
        seeing = any(plan_casts(member.sensors) for member in members.values())
        scene = load_scene(config.scene, pictures=seeing) if scene is None else scene
        bodies = make_bodies(config.bodies) if seeing else ()
    with phase("free space"):
        free_space = make_free_space(scene, config.free_space, device=device)
    with phase("path"):
        paths = {name: _plan(member, free_space) for name, member in members.items()}
    with phase("light"):
        scene_on_device = (
            upload_scene(scene, config.render, device=device, renderer=config.renderer, bodies=bodies)
            if seeing
            else None
        )
    return {
        name: _make_member(member, device, scene, bodies, free_space, paths[name], scene_on_device, setup_s)
        for name, member in members.items()
    }


def plan_paths(config: SimulationConfig, vehicles: Sequence[str] | None = None) -> dict[str, Path]:
    """Return the paths of vehicles by name, as `make_fleet` plans them; without light and cameras.

    Args:
        config: What to fly.
        vehicles: Names; None: all.

    Raises:
        KeyError: There is no such vehicle.
        ValueError: The scene cannot be loaded, or no path exists.
    """
    members = {name: config.of(name) for name in (vehicles or config.vehicles)}
    scene = load_scene(config.scene, pictures=False)
    free_space = make_free_space(scene, config.free_space, device=find_device(config.device))
    return {name: _plan(member, free_space) for name, member in members.items()}


def _plan(config: SimulationConfig, free_space: FreeSpace) -> Path:
    return make_path(config.path, free_space, config.vehicle.airframe(), duration_s=config.duration_s)


def _make_member(
    config: SimulationConfig,
    device: str,
    scene: Scene,
    bodies: tuple[Body, ...],
    free_space: FreeSpace,
    path: Path,
    scene_on_device: SceneOnDevice | None,
    setup_s: Mapping[str, float],
) -> Model:
    """Return the model of one vehicle in a scene."""
    casts = plan_casts(config.sensors)
    samplers = {
        n: s for n, s in config.sensors.items() if isinstance(s, ImuSensorConfig | OdometrySensorConfig)
    }
    return Model(
        config=config,
        device=device,
        scene=scene,
        bodies=bodies,
        free_space=free_space,
        path=path,
        airframe=config.vehicle.airframe(),
        casts=casts,
        schedule=Schedule(
            control=Rate(config.control.rate_hz),
            samplers=tuple(Rate(s.rate_hz) for s in samplers.values()),
            casts=tuple(cast.rate for cast in casts),
            instants_per_launch=config.instants_per_launch,
            sparse=frozenset(i for i, cast in enumerate(casts) if cast.max_displacement_px is not None),
        ),
        samplers=tuple(samplers),
        scene_on_device=scene_on_device if casts else None,
        setup_s=setup_s,
    )


def make_state(
    model: Model,
    *,
    lane_count: int | None = None,
    flight_lane_count: int | None = None,
    borrow_pictures: bool = False,
    seed: int | None = None,
    start: StartState | None = None,
) -> State:
    """Allocate everything an episode needs.

    Args:
        model: What does not change.
        lane_count: How many batches `run_model` keeps under way. By default 2 on a CUDA device, and 1 where a
            launch returns when it has finished. It changes no packet.
        flight_lane_count: How many batches of `fly_period` may wait for `see`; by default `lane_count`.
        borrow_pictures: Do not copy pictures: with one lane, each is valid until the next `step` or `see`.
        seed: Seed of the sensor noise and of turbulence; None: as configured.
        start: Where the vehicle starts; None: as configured.

    Raises:
        ValueError: The start is of a wrong shape or not finite.
    """
    config, device = model.config, model.device
    if lane_count is None:
        ahead = wp.get_device(device).is_cuda and config.renderer != "pyrender"
        lane_count = _LANES_ON_CUDA if ahead else 1
    vehicle = Multirotor(
        model.airframe,
        device=device,
        max_step_ns=to_ns(config.vehicle.max_step_s),
        integrator=config.vehicle.integrator,
        seed=config.seed if seed is None else seed,
    )
    begin = model.path.evaluate([0])
    half_yaw = 0.5 * begin.yaw[0]
    chosen = start or StartState()
    vehicle.reset(
        position=begin.position if chosen.position is None else chosen.position,
        velocity=begin.velocity if chosen.velocity is None else chosen.velocity,
        orientation=[0.0, 0.0, np.sin(half_yaw), np.cos(half_yaw)]
        if chosen.orientation is None
        else chosen.orientation,
        body_rate=chosen.body_rate,
    )
    flight_lane_count = max(lane_count, flight_lane_count or 0)
    slot_count = flight_lane_count * boundary_count_max(model.schedule)
    imus = {
        name: Imu(
            sensor,
            vehicle,
            seed=config.seed if seed is None else seed,
            name=name,
            slot_count=slot_count,
        )
        for name, sensor in config.sensors.items()
        if isinstance(sensor, ImuSensorConfig)
    }
    return State(
        vehicle=vehicle,
        rotor_speeds=HostInput(vehicle.arrays.rotor_speed_command),
        overlaps=lane_count > 1 or wp.get_device(device).is_cpu or bool(model.schedule.sparse),
        controller=make_controller(
            "path", model.airframe, config.control.gains, device=device, paths=model.path
        ),
        trace=Trace(
            capacity=slot_count,
            vehicle_count=1,
            rotor_count=model.airframe.rotor_count,
            device=device,
        ),
        casts=[
            make_cast_state(
                cast,
                config.sensors,
                model.scene_on_device,
                capacity=model.schedule.ticks_per_batch(index),
                lane_count=lane_count,
                device=device,
                seed=config.seed if seed is None else seed,
                bodies=config.bodies,
            )
            for index, cast in enumerate(model.casts)
            if model.scene_on_device is not None
        ],
        imus=imus,
        imu_copies={n: (HostCopy(i.specific_force), HostCopy(i.angular_rate)) for n, i in imus.items()},
        lanes=[Milestone(device) for _ in range(lane_count)],
        flight_lane_count=flight_lane_count,
        borrow_pictures=borrow_pictures,
        wanted=frozenset(name for cast in model.casts for name in cast.names),
        flight_stream=make_stream(device, urgent=True) if lane_count > 1 else None,
        render_stream=make_stream(device) if lane_count > 1 else None,
        event_stream=make_stream(device, urgent=True) if lane_count > 1 else None,
        choice_stream=make_stream(device, urgent=True) if lane_count > 1 and model.schedule.sparse else None,
        flown=[Milestone(device) for _ in range(flight_lane_count)],
        rendered=Milestone(device),
        graphs=Graphs(device),
    )


def run(config: SimulationConfig | Mapping[str, Any] | str | FilePath | None = None) -> Iterator[Packet]:
    """Yield every packet of a run in the order of time; packets with the same stamp come in the rig's order.

    Args:
        config: What `load_config` returns or accepts.

    Raises:
        DynamicsError: The integration failed; all packets before its stamp have been yielded.
    """
    model = make_model(config if isinstance(config, SimulationConfig) else load_config(config))
    yield from run_model(model, make_state(model))


def run_model(model: Model, state: State) -> Iterator[Packet]:
    """Yield every packet from the state's present stamp to the end of the run; see `run`.

    Where the state has several lanes, the vehicle is up to as many batches ahead of the packets.
    """
    if state.launched_count == 0:
        yield from start(model, state)
    while not state.ended:
        while len(state.under_way) < len(state.lanes) and state.launched_ns < model.duration_ns:
            launch(model, state, batch_end_ns(model.schedule, state.launched_ns, model.duration_ns))
        if not state.under_way:
            break
        yield from read(model, state)
        if state.failure is not None:
            raise state.failure
    yield from finish(state)


def step(
    model: Model, state: State, command: ArrayLike | None, *, mode: CommandMode = "motor_speeds"
) -> list[Packet]:
    """Hold a command of an outside controller until the next tick of the control clock.

    Args:
        model: What does not change.
        state: Moved on by one control period.
        command: Setpoint row of the mode (`control.modes.MODES`), by default rotor speeds [rad/s], shape [R].
            Modes above it are turned into rotor speeds once, at the beginning of the period. None: the rotor
            speeds that hold now.
        mode: What the command is.

    Returns:
        What the sensors yield in (stamp, next stamp], in the order of time; the first call also yields stamp
        0. Less where a collision ended the run (`state.ended`) or the integration failed (`state.failure`).

    Raises:
        ValueError: The command is of a wrong shape or not finite.
        DynamicsError: The integration has failed before; what was measured until then has been returned.
    """
    if state.failure is not None:
        raise state.failure
    packets = start(model, state) if state.launched_count == 0 else []
    _command(model, state, command, mode)
    for end_ns in _parts_of_period(model, state):
        packets += advance(model, state, end_ns, closed_loop=False)
        if state.ended or state.failure is not None:
            break
    return packets


def warm_up(model: Model) -> None:
    """Compile and load the kernels of all sensors: fly one control period of an episode that nobody sees."""
    step(model, make_state(model), None)


def fly_period(
    model: Model, state: State, command: ArrayLike | None, *, mode: CommandMode = "motor_speeds"
) -> tuple[list[Packet], list[Batch]]:
    """Fly one control period like `step`, and leave the cameras for later.

    Returns:
        Packets of the IMU and of odometry, and collisions, in the order of time; and what the cameras have to
        look at: each batch goes to `see` or `skip`, in order, from one thread at a time.

    Raises:
        RuntimeError: More batches wait for the cameras than there are lanes: see `free_lanes`.
        ValueError: The command is of a wrong shape or not finite.
        DynamicsError: The integration has failed before; what was measured until then has been returned.
    """
    if state.failure is not None:
        raise state.failure
    packets: list[Packet] = []
    batches: list[Batch] = []

    def fly(stretch: Sequence[Boundary]) -> None:
        if free_lanes(state) < 1:
            raise RuntimeError(f"{state.flight_lane_count} batches wait for see() or skip(): no lane is free")
        batch, key, flight = _plan_flight(model, state, stretch, closed_loop=False)
        _launch_flight(state, batch, key, flight)
        batches.append(batch)
        state.flown[batch.number % state.flight_lane_count].wait()
        packets.extend(_in_order(model, _read_flight(model, state, batch), state.stamp_ns))

    if state.launched_count == 0:
        fly([_everything(model)])
    _command(model, state, command, mode)
    for end_ns in _parts_of_period(model, state):
        fly(boundaries(model.schedule, state.launched_ns, end_ns))
        if state.ended or state.failure is not None:
            break
    return packets, batches


def free_lanes(state: State) -> int:
    """Return how many batches `fly_period` can fly before one of those that wait was looked at."""
    return state.flight_lane_count - (state.launched_count - state.looked_count)


def see(model: Model, state: State, batch: Batch) -> list[Packet]:
    """Render what the cameras see in a batch; return their packets in the order of time.

    Args:
        model: What does not change.
        state: Only what belongs to the cameras changes, so that another thread may fly on.
        batch: The oldest that was flown and not looked at.
    """
    _look(model, state, batch)
    packets = _read_cameras(state, batch)
    state.looked_count += 1
    return _in_order(model, packets, batch.until_ns)


def skip(model: Model, state: State, batch: Batch) -> int:
    """Render nothing of a batch, in place of `see`.

    The sequence of each image camera shows the gap; for an event camera log radiance is linear in time over
    the gap, and a window of events that should have ended there is as much longer.

    Returns:
        How many instants of casts were left out.
    """
    count = 0
    for index, cast in enumerate(state.casts):
        close_eyes(cast, batch.wanted)
        stamps = [b.stamp_ns for b in batch.boundaries if index in b.casts]
        due = [stamp_ns for stamp_ns in stamps if is_due(cast, stamp_ns, batch.wanted)]
        leave_out(cast, due, batch.wanted)
        count += len(due)
    state.looked_count += 1
    return count


def want(model: Model, state: State, names: Collection[str]) -> None:
    """Choose the cameras that look, from the next control period on; the others are not rendered.

    An event camera that comes back takes the first instant that it sees as its reference, and its packets
    count on.

    Raises:
        ValueError: There is no such camera.
    """
    known = {name for cast in model.casts for name in cast.names}
    if not known.issuperset(names):
        raise ValueError(f"unknown cameras {sorted(set(names) - known)}, known: {sorted(known)}")
    state.wanted = frozenset(names)


def observe(state: State) -> Odometry:
    """Return the true state of the vehicle at the end of what was flown, as a packet named `odometry`."""
    if state.last is None:
        now = state.vehicle.state
        state.last = Odometry(
            sensor="odometry",
            position=now.position[0],
            orientation=now.orientation[0],
            velocity=now.velocity[0],
            body_rate=now.body_rate[0],
            rotor_speed=now.rotor_speed[0],
        )
    return state.last


def start(model: Model, state: State) -> list[Packet]:
    """Sample every sensor at stamp 0; event cameras take it as their reference."""
    _launch(model, state, [_everything(model)], closed_loop=True)
    return read(model, state)


def advance(model: Model, state: State, end_ns: int, *, closed_loop: bool = True) -> list[Packet]:
    """Fly one batch, at most to what `batch_end_ns` gives, and return what the sensors yield in it.

    Args:
        model: What does not change.
        state: Moved on to `end_ns`, or to where a collision ended the run (`ended`) or the integration failed
            (`failure`).
        end_ns: End of the batch [ns], after the state's stamp.
        closed_loop: Let the path controller command; otherwise the last command is held.

    Raises:
        RuntimeError: `run_model` was broken off, and the vehicle is ahead of the state's stamp.
    """
    if state.under_way:
        raise RuntimeError("run_model() was broken off with batches under way: only it can go on")
    launch(model, state, end_ns, closed_loop=closed_loop)
    return read(model, state)


def launch(model: Model, state: State, end_ns: int, *, closed_loop: bool = True) -> None:
    """Launch one batch, at most to what `batch_end_ns` gives, without waiting for a CUDA device.

    Args:
        model: What does not change.
        state: A lane is free in it.
        end_ns: End of the batch [ns], after what was launched before.
        closed_loop: Let the path controller command; otherwise the last command is held.
    """
    _launch(model, state, boundaries(model.schedule, state.launched_ns, end_ns), closed_loop=closed_loop)


def read(model: Model, state: State) -> list[Packet]:
    """Wait for the oldest batch under way and return what the sensors yield in it, in the order of time.

    Args:
        model: What does not change.
        state: `stamp_ns` moves on to the end of the batch, or to where a collision ended the run (`ended`) or
            the integration failed (`failure`).
    """
    batch = state.under_way.popleft()
    with timed(state.wall_s, "read-back"):
        flown = state.flown if state.overlaps else state.lanes  # one graph has one end
        flown[batch.number % len(flown)].wait()
    packets = _read_flight(model, state, batch)  # may end the run before the end of the batch
    packets += _read_cameras(state, batch)
    state.looked_count += 1
    return _in_order(model, packets, batch.until_ns)


def finish(state: State) -> list[Packet]:
    """Return the packets whose windows have begun and not ended; for the end of a run."""
    return [packet for cast in state.casts for packet in flush_events(cast, until_ns=state.stamp_ns)]


def _everything(model: Model) -> Boundary:
    """Return the boundary at stamp 0."""
    return Boundary(
        stamp_ns=0,
        control=True,
        samplers=tuple(range(len(model.schedule.samplers))),
        casts=tuple(range(len(model.casts))),
    )


def _parts_of_period(model: Model, state: State) -> Iterator[int]:
    """Yield the ends of the batches that a control period is cut into, each when the one before was flown."""
    control = model.schedule.control
    end_ns = control.stamp_ns(control.first_tick(state.launched_ns + 1))
    while state.launched_ns < end_ns:
        yield batch_end_ns(model.schedule, state.launched_ns, end_ns)


def _command(model: Model, state: State, command: ArrayLike | None, mode: CommandMode) -> None:
    """Have the next batch begin with a setpoint, which becomes rotor speeds at the state of the vehicle then.

    The batch before has been read: what it took from the host is free.
    """
    if command is None:
        return
    if mode == "motor_speeds":
        rotor_count = model.airframe.rotor_count
        rows = as_rows(command, name="rotor_speed_command", count=1, width=rotor_count)
        state.rotor_speeds.rows[:] = rows
    else:
        if mode not in state.pilots:
            gains = model.config.control.gains
            controller = make_controller(mode, model.airframe, gains, device=model.device)
            state.pilots[mode] = Pilot(controller, HostInput(controller.setpoint))
        pilot = state.pilots[mode]
        pilot.setpoint.rows[:] = pilot.controller.checked(command)
    state.order = mode


def _launch(model: Model, state: State, stretch: Sequence[Boundary], *, closed_loop: bool) -> None:
    """Fly a stretch, let the cameras see it, and launch the copies to the host."""
    batch, key, flight = _plan_flight(model, state, stretch, closed_loop=closed_loop)
    if state.overlaps:
        _launch_flight(state, batch, key, flight)
        _look(model, state, batch)
    else:  # all of it as one graph
        looks = _plan_looks(state, batch, _choose(model, state, batch))
        with timed(state.wall_s, "flight and render"):
            state.graphs.run(
                (key, *(look.key for look in looks)), lambda: (flight(), *(look.render() for look in looks))
            )
        _scan(state, batch, looks)
    state.under_way.append(batch)


def _plan_flight(
    model: Model, state: State, stretch: Sequence[Boundary], *, closed_loop: bool
) -> tuple[Batch, Hashable, Callable[[], object]]:
    """Take the vehicle through a stretch: return the batch, and what launches it, with its key.

    A pilot may be replaced by another; a graph keeps the one that it was made with.
    """
    number = state.launched_count
    slot = number % state.flight_lane_count * (state.trace.states.shape[0] // state.flight_lane_count)
    stamps_ns = [state.launched_ns, *(boundary.stamp_ns for boundary in stretch)]
    elapsed_ns = [end - begin for begin, end in itertools.pairwise(stamps_ns)]
    order, state.order = state.order, None
    pattern = tuple(
        (span, boundary.control, boundary.samplers)
        for span, boundary in zip(elapsed_ns, stretch, strict=True)
    )

    pilot = None if order is None else state.pilots.get(order)

    def flight() -> Pilot | None:
        if pilot is not None:
            pilot.setpoint.upload()
            pilot.controller.update(state.vehicle.arrays)
        elif order is not None:
            state.rotor_speeds.upload()
        _fly(model, state, stretch, elapsed_ns, slot=slot, closed_loop=closed_loop)
        return pilot

    state.launched_count += 1
    state.launched_ns = stretch[-1].stamp_ns
    batch = Batch(
        boundaries=stretch,
        step_count=sum(-(-span // state.vehicle.max_step_ns) for span in elapsed_ns),
        command_count=sum(closed_loop and boundary.control for boundary in stretch),
        number=number,
        slot=slot,
        wanted=state.wanted,
        until_ns=state.launched_ns,
    )
    return batch, (order, id(pilot), slot, closed_loop, pattern), flight


def _launch_flight(state: State, batch: Batch, key: Hashable, flight: Callable[[], object]) -> None:
    with timed(state.wall_s, "dynamics and control"), on(state.flight_stream):
        state.graphs.run(key, flight)
        state.flown[batch.number % state.flight_lane_count].set()


def _fly(
    model: Model,
    state: State,
    stretch: Sequence[Boundary],
    elapsed_ns: Sequence[int],
    *,
    slot: int,
    closed_loop: bool,
) -> None:
    """Move the vehicle from boundary to boundary and do what is due there, on the device only."""
    for place, (boundary, span_ns) in enumerate(zip(stretch, elapsed_ns, strict=True), slot):
        if span_ns > 0:
            state.vehicle.advance(span_ns)
        state.trace.record(state.vehicle.arrays, place)
        for index in boundary.samplers:
            if (imu := state.imus.get(model.samplers[index])) is not None:
                imu.measure(place)
        if closed_loop and boundary.control:
            state.controller.update(state.vehicle.arrays)
    ground = state.vehicle.config.ground
    state.trace.check_room(
        model.free_space.arrays,
        slot,
        len(stretch),
        radius_m=model.config.vehicle.collision_radius_m,
        ground_height_m=-math.inf if ground is None else ground.height_m,
    )
    state.trace.fetch(slot, len(stretch))
    for copy in itertools.chain.from_iterable(state.imu_copies.values()):
        copy.fetch(slot, len(stretch))


def _look(model: Model, state: State, batch: Batch) -> None:
    """Let the cameras that are wanted see a batch, and launch the copies to the host."""
    due = _choose(model, state, batch)
    with timed(state.wall_s, "render"), on(state.render_stream):
        state.flown[batch.number % state.flight_lane_count].hold()
        looks = _plan_looks(state, batch, due)
        for look in looks:
            if look.key is None:
                look.render()
            else:
                state.graphs.run(look.key, look.render)
        state.rendered.set()
    with on(state.event_stream):
        state.rendered.hold()
        _scan(state, batch, looks)


def _choose(model: Model, state: State, batch: Batch) -> list[list[int]]:
    """Return which boundaries of a batch each cast has to render; adaptive casts wait for the flight."""
    chosen, choices = [], []
    for index, cast in enumerate(state.casts):
        close_eyes(cast, batch.wanted)
        due = [
            place
            for place, boundary in enumerate(batch.boundaries)
            if index in boundary.casts and is_due(cast, boundary.stamp_ns, batch.wanted)
        ]
        if cast.rule is not None:
            with timed(state.wall_s, "choice of renders"), on(state.choice_stream):
                state.flown[batch.number % state.flight_lane_count].hold()
                choice = choose_ticks(
                    cast,
                    state.trace,
                    slots=[batch.slot + place for place in due],
                    stamps_ns=[batch.boundaries[place].stamp_ns for place in due],
                    end_ns=model.duration_ns,
                    wanted=batch.wanted,
                )
            choices.append(choice)
            due = [due[place] for place in choice.places]
        chosen.append(due)
    batch.choices = choices
    return chosen


def _plan_looks(state: State, batch: Batch, chosen: Sequence[Sequence[int]]) -> list[Look]:
    """Return what the casts have to render of a batch: at the boundaries chosen for each."""
    return [
        plan_look(
            cast,
            state.trace,
            slots=[batch.slot + place for place in places],
            stamps_ns=[batch.boundaries[place].stamp_ns for place in places],
            lane=batch.number % len(state.lanes),
            wanted=batch.wanted,
        )
        for cast, places in zip(state.casts, chosen, strict=True)
        if places
    ]


def _scan(state: State, batch: Batch, looks: Sequence[Look]) -> None:
    """Let event cameras see what was rendered; that is the end of a batch on the device."""
    with timed(state.wall_s, "events"):
        for look in looks:
            scan_events(look.cast, look.instants)
        state.lanes[batch.number % len(state.lanes)].set()
    batch.seen = [(look.cast, look.instants) for look in looks]


def _read_flight(model: Model, state: State, batch: Batch) -> list[Packet]:
    """Return what was sampled in a batch that is flown, and collisions."""
    with timed(state.wall_s, "read-back"):
        rows = state.trace.numpy(batch.slot, len(batch.boundaries))
    state.stamp_ns = batch.boundaries[-1].stamp_ns
    state.counts["steps"] += batch.step_count
    state.counts["commands"] += batch.command_count
    _count_redone(state, int(rows.redone[-1].sum()))
    if rows.status[-1].any():
        state.failure = _failure(state.vehicle)
        state.stamp_ns = min(state.stamp_ns, state.failure.stamp_ns)
    with timed(state.wall_s, "collision check"):
        packets = _collide(model, state, batch, rows)  # may end the run before the end of the batch
    batch.until_ns = state.stamp_ns
    with timed(state.wall_s, "read-back"):
        packets += _read_samplers(model, state, batch, rows)
    reached = [b.stamp_ns for b in batch.boundaries if b.stamp_ns <= state.stamp_ns]
    if reached:
        header = {"stamp_ns": reached[-1], "sequence": 0, "sensor": "odometry"}
        state.last = _odometry(rows.states[len(reached) - 1, 0], header)
    return packets


def _count_redone(state: State, redone_count: int) -> None:
    if redone_count > 0 and not state.counts["redone intervals"]:
        logger.info(
            "vehicle: steps of %g ms are too long at times; such intervals are redone with adaptive steps",
            1e-6 * state.vehicle.max_step_ns,
        )
    state.counts["redone intervals"] = redone_count


def _read_cameras(state: State, batch: Batch) -> list[Packet]:
    """Wait until the cameras have seen a batch, and return what they yield."""
    packets: list[Packet] = []
    with timed(state.wall_s, "camera read-back"):
        state.lanes[batch.number % len(state.lanes)].wait()
    state.counts["renders"] += sum(len(instants.stamps_ns) for _, instants in batch.seen)
    for choice in batch.choices:
        state.counts["ticks left out"] += choice.left_out_count
        state.counts["coarse ticks"] += choice.coarse_count
    with timed(state.wall_s, "events"):
        for cast, instants in batch.seen:
            events = read_events(cast, instants, until_ns=batch.until_ns)
            state.counts["events dropped"] += sum(packet.dropped_count for packet in events)
            packets += events
    with timed(state.wall_s, "camera read-back"):
        for cast, instants in batch.seen:
            packets += read_images(cast, instants, borrow=state.borrow_pictures)
    return packets


def _in_order(model: Model, packets: list[Packet], until_ns: int) -> list[Packet]:
    """Return packets up to a stamp in the order of time, those of one stamp in that of the rig."""
    rank = {name: index for index, name in enumerate([*model.config.sensors, COLLISION])}
    kept = [packet for packet in packets if packet.stamp_ns <= until_ns]
    return sorted(kept, key=lambda packet: (packet.stamp_ns, rank[packet.sensor]))


def _failure(vehicle: Multirotor) -> DynamicsError:
    """Return why a vehicle is held."""
    try:
        vehicle.check()
    except DynamicsError as error:
        return error
    raise AssertionError("the status of a vehicle that is held does not change")


def _odometry(row: Any, header: Mapping[str, Any]) -> Odometry:
    return Odometry(
        **header,
        position=row[POSITION],
        orientation=row[ORIENTATION],
        velocity=row[VELOCITY],
        body_rate=row[BODY_RATE],
        rotor_speed=row[ROTOR_SPEED],
    )


def _read_samplers(model: Model, state: State, batch: Batch, rows: TraceRows) -> list[Packet]:
    packets: list[Packet] = []
    for index, name in enumerate(model.samplers):
        copies = state.imu_copies.get(name)
        if copies is not None:
            specific_force, angular_rate = (c.rows(batch.slot, len(batch.boundaries))[:, 0] for c in copies)
        for place, boundary in enumerate(batch.boundaries):
            if index not in boundary.samplers:
                continue
            header: dict[str, Any] = {
                "stamp_ns": boundary.stamp_ns,
                "sequence": state.sequence[name],
                "sensor": name,
            }
            state.sequence[name] += 1
            if copies is not None:
                packets.append(
                    ImuSample(
                        **header,
                        specific_force=specific_force[place],
                        angular_rate=angular_rate[place],
                    )
                )
            else:
                packets.append(_odometry(rows.states[place, 0], header))
    return packets


def _collide(model: Model, state: State, batch: Batch, rows: TraceRows) -> list[Packet]:
    """Report each beginning of a touch; end the run at the first one if so configured."""
    packets: list[Packet] = []
    for boundary, row, margin_m in zip(batch.boundaries, rows.states[:, 0], rows.clearance, strict=True):
        touching = bool(margin_m <= 0.0)
        if touching and not state.touching:
            packets.append(
                Collision(
                    stamp_ns=boundary.stamp_ns,
                    sequence=state.sequence[COLLISION],
                    sensor=COLLISION,
                    position=row[POSITION],
                    clearance_m=float(margin_m),
                )
            )
            state.sequence[COLLISION] += 1
            state.counts["collisions"] += 1
            if model.config.vehicle.on_collision == "end":
                state.ended = True
                state.stamp_ns = boundary.stamp_ns
                return packets
        state.touching = touching
    return packets


class timed:
    """Adds the wall-clock time of a block to a phase; a class, as it is entered ten times in a period."""

    __slots__ = ("_begin", "_phase", "_wall_s")

    def __init__(self, wall_s: dict[str, float], phase: str) -> None:
        self._wall_s = wall_s
        self._phase = phase

    def __enter__(self) -> None:
        self._begin = time.perf_counter()

    def __exit__(self, *_: object) -> None:
        self._wall_s[self._phase] += time.perf_counter() - self._begin


def find_device(name: str) -> str:
    """Return the device that is meant.

    Raises:
        ValueError: It is not on this machine.
    """
    wp.init()
    known = [str(device) for device in wp.get_devices()]
    if name == "auto":
        return "cuda:0" if "cuda:0" in known else "cpu"
    if name == "cuda":
        name = "cuda:0"
    if name not in known:
        raise ValueError(f"device {name!r} is not on this machine, known: {known}")
    return name
