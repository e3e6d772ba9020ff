# mypy: disable-error-code="attr-defined,no-untyped-call"
"""The data flow, readable top to bottom: config -> Model -> State -> packets.

A run is cut into batches (`schedule.py`). Within a batch the vehicle is integrated from boundary to boundary,
and its states stay on the device. Then every cast renders all its instants in one launch, every event camera
scans them in one launch, and everything is read back once.
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field
from pathlib import Path as FilePath
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from neurosim_core.clock import Rate, to_ns
from neurosim_core.config import SimulationConfig, load_config
from neurosim_core.control import Controller, make_controller
from neurosim_core.packets import Collision, Events, ImuSample, Odometry, Packet
from neurosim_core.render.renderer import SceneOnDevice, upload_scene
from neurosim_core.scene.apartment import ApartmentConfig, make_apartment
from neurosim_core.scene.freespace import FreeSpace, make_free_space
from neurosim_core.scene.mesh import MeshSceneConfig, load_mesh_scene
from neurosim_core.scene.scene import Scene
from neurosim_core.schedule import Boundary, Schedule, batch_end_ns, boundaries, boundary_count_max
from neurosim_core.sensors.cast import (
    CastState,
    flush_events,
    make_cast_state,
    read_events,
    read_images,
    render_instants,
    scan_events,
)
from neurosim_core.sensors.imu import Imu
from neurosim_core.sensors.rig import Cast, ImuSensorConfig, OdometrySensorConfig, plan_casts
from neurosim_core.trace import BODY_RATE, ORIENTATION, POSITION, ROTOR_SPEED, VELOCITY, Trace
from neurosim_core.trajectory import Path, make_path
from neurosim_core.vehicle import DynamicsError, Multirotor, MultirotorConfig

COLLISION = "collision"
"""Name under which collisions are reported."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Model:
    """What does not change during a run."""

    config: SimulationConfig
    device: str
    scene: Scene
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
        return (
            () if terms is None else tuple(name for name, value in terms._asdict().items() if value is True)
        )

    @property
    def duration_ns(self) -> int:
        """Length of the run [ns]."""
        return to_ns(self.config.duration_s)


@dataclass(kw_only=True, eq=False)
class State:
    """What changes during a run."""

    vehicle: Multirotor
    controller: Controller
    trace: Trace
    casts: list[CastState]
    imus: dict[str, Imu]
    stamp_ns: int = 0
    sequence: dict[str, int] = field(default_factory=lambda: defaultdict(int))
    touching: bool = False
    """The vehicle touched the scene at the last boundary."""
    ended: bool = False
    """A collision ended the run."""
    failure: DynamicsError | None = None
    """The integration failed; packets up to its stamp have been returned."""
    counts: dict[str, int] = field(default_factory=lambda: defaultdict(int))
    """steps, commands, renders, events dropped, collisions."""
    wall_s: dict[str, float] = field(default_factory=lambda: defaultdict(float))
    """Wall-clock time by phase [s]."""


def load_scene(config: ApartmentConfig | MeshSceneConfig) -> Scene:
    """Generate or read a scene.

    Raises:
        SceneError: A file cannot be used.
    """
    return make_apartment(config) if isinstance(config, ApartmentConfig) else load_mesh_scene(config)


def make_model(config: SimulationConfig, *, on_phase: Callable[[str], None] | None = None) -> Model:
    """Load or generate the scene, plan the path and decide what has to be computed.

    Args:
        config: What to fly.
        on_phase: Told the name of each part of the work when it begins.

    Raises:
        ValueError: The scene cannot be loaded, no path exists, or the device is not there.
    """
    setup_s: dict[str, float] = defaultdict(float)

    def phase(name: str) -> AbstractContextManager[None]:
        if on_phase is not None:
            on_phase(name)
        return timed(setup_s, name)

    device = _device(config.device)
    with phase("scene"):
        scene = load_scene(config.scene)
    with phase("free space"):
        free_space = make_free_space(scene, config.free_space, device=device)
    airframe = config.vehicle.airframe()
    with phase("path"):
        path = make_path(config.path, free_space, airframe, duration_s=config.duration_s)
    casts = plan_casts(config.sensors)
    with phase("light"):
        scene_on_device = upload_scene(scene, config.render, device=device) if casts else None
    samplers = {
        n: s for n, s in config.sensors.items() if isinstance(s, ImuSensorConfig | OdometrySensorConfig)
    }
    return Model(
        config=config,
        device=device,
        scene=scene,
        free_space=free_space,
        path=path,
        airframe=airframe,
        casts=casts,
        schedule=Schedule(
            control=Rate(config.control.rate_hz),
            samplers=tuple(Rate(s.rate_hz) for s in samplers.values()),
            casts=tuple(cast.rate for cast in casts),
            instants_per_launch=config.instants_per_launch,
        ),
        samplers=tuple(samplers),
        scene_on_device=scene_on_device,
        setup_s=setup_s,
    )


def make_state(model: Model) -> State:
    """Allocate everything a run needs, with the vehicle at rest at the start of the path."""
    config, device = model.config, model.device
    vehicle = Multirotor(model.airframe, count=1, device=device, max_step_ns=to_ns(config.vehicle.max_step_s))
    start = model.path.evaluate([0])
    half_yaw = 0.5 * start.yaw[0]
    vehicle.reset(
        position=start.position,
        velocity=start.velocity,
        orientation=[[0.0, 0.0, np.sin(half_yaw), np.cos(half_yaw)]],
    )
    capacity = boundary_count_max(model.schedule)
    return State(
        vehicle=vehicle,
        controller=make_controller(
            "path", model.airframe, config.control.gains, device=device, paths=model.path
        ),
        trace=Trace(
            capacity=capacity,
            vehicle_count=1,
            rotor_count=model.airframe.rotor_count,
            device=device,
        ),
        casts=[
            make_cast_state(
                cast,
                config.sensors,
                model.scene_on_device,
                capacity=config.instants_per_launch,
                device=device,
            )
            for cast in model.casts
            if model.scene_on_device is not None
        ],
        imus={
            name: Imu(sensor, vehicle, seed=config.seed, name=name, slot_count=capacity)
            for name, sensor in config.sensors.items()
            if isinstance(sensor, ImuSensorConfig)
        },
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
    """Yield every packet from the state's present stamp to the end of the run; see `run`."""
    if state.stamp_ns == 0:
        yield from start(model, state)
    while state.stamp_ns < model.duration_ns and not state.ended:
        yield from advance(model, state, batch_end_ns(model.schedule, state.stamp_ns, model.duration_ns))
        if state.failure is not None:
            raise state.failure
    yield from finish(state)


def step(model: Model, state: State, command: ArrayLike) -> list[Packet]:
    """Hold a command of an outside controller until the next tick of the control clock.

    Args:
        model: What does not change.
        state: Moved on by one control period.
        command: Rotor speeds [rad/s], shape [R].

    Returns:
        What the sensors yield in (stamp, next stamp], in the order of time; the first call also yields stamp
        0.

    Raises:
        DynamicsError: The integration failed.
    """
    packets = start(model, state) if state.stamp_ns == 0 else []
    control = model.schedule.control
    end_ns = control.stamp_ns(control.first_tick(state.stamp_ns + 1))
    state.vehicle.command(command)
    while state.stamp_ns < end_ns and not state.ended:
        until_ns = batch_end_ns(model.schedule, state.stamp_ns, end_ns)
        packets += advance(model, state, until_ns, closed_loop=False)
        if state.failure is not None:
            raise state.failure
    return packets


def start(model: Model, state: State) -> list[Packet]:
    """Sample every sensor at stamp 0; event cameras take it as their reference."""
    everything = Boundary(
        stamp_ns=0,
        control=True,
        samplers=tuple(range(len(model.schedule.samplers))),
        casts=tuple(range(len(model.casts))),
    )
    _pass(model, state, everything, slot=0, closed_loop=True)
    return _observe(model, state, [everything])


def advance(model: Model, state: State, end_ns: int, *, closed_loop: bool = True) -> list[Packet]:
    """Fly one batch, at most to what `batch_end_ns` gives, and return what the sensors yield in it.

    Args:
        model: What does not change.
        state: Moved on to `end_ns`, or to where a collision ended the run (`ended`) or the integration failed
            (`failure`).
        end_ns: End of the batch [ns], after the state's stamp.
        closed_loop: Let the path controller command; otherwise the last command is held.
    """
    batch = boundaries(model.schedule, state.stamp_ns, end_ns)
    with timed(state.wall_s, "dynamics and control"):
        for slot, boundary in enumerate(batch):
            elapsed_ns = boundary.stamp_ns - state.stamp_ns
            state.vehicle.advance(elapsed_ns)
            state.counts["steps"] += -(-elapsed_ns // state.vehicle.max_step_ns)
            state.stamp_ns = boundary.stamp_ns
            _pass(model, state, boundary, slot=slot, closed_loop=closed_loop)
    return _observe(model, state, batch)


def finish(state: State) -> list[Packet]:
    """Return the packets whose windows have begun and not ended; for the end of a run."""
    return [packet for cast in state.casts for packet in flush_events(cast, until_ns=state.stamp_ns)]


def _pass(model: Model, state: State, boundary: Boundary, *, slot: int, closed_loop: bool) -> None:
    """Do what is due at a boundary, on the device only."""
    state.trace.record(state.vehicle.arrays, slot)
    for index in boundary.samplers:
        if (imu := state.imus.get(model.samplers[index])) is not None:
            imu.measure(slot)
    if closed_loop and boundary.control:
        state.controller.update(state.vehicle.arrays)
        state.counts["commands"] += 1


def _observe(model: Model, state: State, batch: Sequence[Boundary]) -> list[Packet]:
    """Render and scan what the batch has seen, read everything back, and return it in the order of time."""
    seeing = []
    with timed(state.wall_s, "render"):
        for index, cast in enumerate(state.casts):
            slots = [slot for slot, boundary in enumerate(batch) if index in boundary.casts]
            if slots:
                render_instants(cast, state.trace, slots, [batch[slot].stamp_ns for slot in slots])
                seeing.append(cast)
                state.counts["renders"] += len(slots)
    with timed(state.wall_s, "events"):
        for cast in seeing:
            scan_events(cast)
    with timed(state.wall_s, "read-back"):
        states = state.trace.numpy(len(batch))[:, 0]
        try:
            state.vehicle.check()
        except DynamicsError as error:
            state.failure = error
            state.stamp_ns = min(state.stamp_ns, error.stamp_ns)
    with timed(state.wall_s, "collision check"):
        packets = _collide(model, state, batch, states)  # may end the run before the end of the batch
    with timed(state.wall_s, "events"):
        for cast in seeing:
            packets += read_events(cast, until_ns=state.stamp_ns)
        state.counts["events dropped"] += sum(p.dropped_count for p in packets if isinstance(p, Events))
    with timed(state.wall_s, "read-back"):
        for cast in seeing:
            packets += read_images(cast)
        packets += _read_samplers(model, state, batch, states)
    rank = {name: index for index, name in enumerate([*model.config.sensors, COLLISION])}
    kept = [packet for packet in packets if packet.stamp_ns <= state.stamp_ns]
    return sorted(kept, key=lambda packet: (packet.stamp_ns, rank[packet.sensor]))


def _read_samplers(
    model: Model, state: State, batch: Sequence[Boundary], states: NDArray[np.float64]
) -> list[Packet]:
    packets: list[Packet] = []
    for index, name in enumerate(model.samplers):
        imu = state.imus.get(name)
        if imu is not None:
            specific_force, angular_rate = imu.specific_force.numpy()[:, 0], imu.angular_rate.numpy()[:, 0]
        for slot, boundary in enumerate(batch):
            if index not in boundary.samplers:
                continue
            header: dict[str, Any] = {
                "stamp_ns": boundary.stamp_ns,
                "sequence": state.sequence[name],
                "sensor": name,
            }
            state.sequence[name] += 1
            if imu is not None:
                packets.append(
                    ImuSample(
                        **header,
                        specific_force=np.array(specific_force[slot]),
                        angular_rate=np.array(angular_rate[slot]),
                    )
                )
            else:
                row = states[slot]
                packets.append(
                    Odometry(
                        **header,
                        position=row[POSITION],
                        orientation=row[ORIENTATION],
                        velocity=row[VELOCITY],
                        body_rate=row[BODY_RATE],
                        rotor_speed=row[ROTOR_SPEED],
                    )
                )
    return packets


def _collide(
    model: Model, state: State, batch: Sequence[Boundary], states: NDArray[np.float64]
) -> list[Packet]:
    """Report each beginning of a touch; end the run at the first one if so configured."""
    radius_m = model.config.vehicle.collision_radius_m
    margins_m = model.free_space.clearance(states[:, POSITION]) - radius_m
    packets: list[Packet] = []
    for boundary, row, margin_m in zip(batch, states, margins_m, strict=True):
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


@contextmanager
def timed(wall_s: dict[str, float], phase: str) -> Iterator[None]:
    """Add the wall-clock time of a block to a phase."""
    begin = time.perf_counter()
    try:
        yield
    finally:
        wall_s[phase] += time.perf_counter() - begin


def _device(name: str) -> str:
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
