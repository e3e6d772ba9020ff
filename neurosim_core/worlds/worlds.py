# mypy: disable-error-code="attr-defined,no-untyped-call,call-overload,union-attr"
"""N worlds, one vehicle each, stepped together; everything stays on the device.

On a CUDA device a step is one graph: flight, poses, one render of all instants of all worlds, one scan of all
their pixels. It allocates nothing and waits for nothing; results are arrays on the device that the next step
overwrites.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from neurosim_core.clock import Rate, to_ns
from neurosim_core.config import SimulationConfig, load_config
from neurosim_core.control import CommandMode, Controller, make_controller
from neurosim_core.frames import as_rows
from neurosim_core.sensors.imu import Imu
from neurosim_core.sensors.rig import ImuSensorConfig
from neurosim_core.simulation import Model
from neurosim_core.streams import Graphs
from neurosim_core.vehicle import Multirotor
from neurosim_core.worlds import flight
from neurosim_core.worlds.cameras import WorldCast
from neurosim_core.worlds.inputs import CommandBuffer, as_device_array, make_seeds
from neurosim_core.worlds.observation import ImuRows, Observation, VehicleStates
from neurosim_core.worlds.parameters import Rig, lenses_differ, vary_sensors
from neurosim_core.worlds.scenes import SceneSource, SceneTable, make_scene_table
from neurosim_core.worlds.timetable import PATTERN_COUNT_MAX, Pattern, Timetable

_logger = logging.getLogger(__name__)

COUNT_MAX = 4096
"""Most worlds."""


class Worlds:
    """N worlds that are stepped together; see `make_worlds`.

    All worlds share the clocks of the rig. World i gives what `simulation.step` gives with the same settings,
    its seed and its commands: the same bytes on a CPU.

    A vehicle that touches the scene, where `vehicle.on_collision` is `end`, or whose motion cannot be
    integrated, is held where it is until its world is reset; its cameras look on from there, and time passes.

    Attributes:
        count: Number of worlds N.
        device: Where everything is.
        seeds: Seed of each world.
        duration_ns: How long the last step was [ns].
    """

    def __init__(
        self,
        config: SimulationConfig,
        scenes: SceneTable,
        *,
        seeds: Sequence[int],
        rigs: Sequence[Rig],
        event_capacity: int | None,
        ordered: bool,
    ) -> None:
        self._model = model = scenes.model
        self._config = config
        self._scenes = scenes
        self.count = count = len(seeds)
        self.device = device = wp.get_device(model.device)
        self.seeds = [int(seed) for seed in seeds]
        images = tuple({n: Rate(config.sensors[n].rate_hz) for n in c.image_cameras} for c in model.casts)
        _check_image_rates(images, model.schedule.control)
        self._timetable = Timetable(model.schedule, images)
        self._seeds: Any = wp.array(np.array(self.seeds, dtype=np.uint64), dtype=wp.uint64, device=device)
        self._vehicle = Multirotor(
            model.airframe,
            count=count,
            device=model.device,
            max_step_ns=to_ns(config.vehicle.max_step_s),
            integrator=config.vehicle.integrator,
            seeds=self._seeds,
        )
        self._clock = wp.zeros(count, dtype=wp.int64, device=device)
        self._collided = wp.zeros(count, dtype=wp.int32, device=device)
        self._everybody = wp.ones(count, dtype=wp.int32, device=device)
        self._mask = wp.ones(count, dtype=wp.int32, device=device)
        self._imus = {
            name: Imu(
                sensor,
                self._vehicle,
                name=name,
                slot_count=self._timetable.sample_count_max(),
                seeds=self._seeds,
                active=self._everybody,
            )
            for name, sensor in config.sensors.items()
            if isinstance(sensor, ImuSensorConfig)
        }
        self._casts = [
            WorldCast(
                cast,
                rigs,
                scenes,
                instant_count=self._timetable.instant_count_max(),
                capacity=event_capacity,
                seeds=self.seeds,
                bodies=config.bodies,
                ordered=ordered,
            )
            for cast in model.casts
        ]
        self._start = self._make_start()
        self._fleet = self._make_fleet()
        self._pilots: dict[str, Controller] = {}
        self._inputs: dict[str, CommandBuffer] = {
            "motor_speeds": CommandBuffer(self._vehicle.arrays.rotor_speed_command)
        }
        self._graphs = Graphs(device)
        self._told = False
        """That there are too many patterns."""
        self._observations: dict[Pattern, Observation] = {}
        self._now_ns: int | None = None
        self.duration_ns = 0

    @property
    def width(self) -> Mapping[str, int]:
        """Numbers in a command of each mode that was used; of `motor_speeds`, rotors."""
        return {mode: int(buffer.array.shape[1]) for mode, buffer in self._inputs.items()}

    @property
    def common_ns(self) -> int:
        """Some worlds can be reset when all of them have flown for a multiple of this [ns]; 0: never."""
        return self._timetable.common_ns

    def reset(
        self,
        *,
        mask: Any = None,
        seed: int | ArrayLike | None = None,
        position: Any = None,
        velocity: Any = None,
        orientation: Any = None,
        body_rate: Any = None,
    ) -> Observation:
        """Begin anew, in all worlds or in some, with rotors at hover; sample all sensors at stamp 0.

        Event cameras take what they see as their reference; the events of the observation are none, in all
        worlds. Rows of worlds that are not reset do not count. With arrays of a CUDA device nothing waits for
        it.

        Args:
            mask: Which worlds, shape [N], of bool, uint8 or int32, on host or device; None: all.
            seed: New seeds, of world 0 (of the others: the next integers) or of each, shape [N]; None: the
                same. For all worlds only.
            position: p_WB [m], shape [N, 3] or [3]; None: where the configured path begins.
            velocity: v_WB in W [m/s], likewise.
            orientation: q_WB, xyzw, shape [N, 4] or [4]; normalised here.
            body_rate: w_WB in B [rad/s], shape [N, 3] or [3]; None: 0.

        Raises:
            ValueError: A shape is wrong or a number not finite; or only some worlds are to be reset, and
                clocks of the rig, which all worlds share, do not tick together now (see `common_ns`).
        """
        if mask is not None:
            self._check_partial(seed)
        seeds = None if seed is None else make_seeds(seed, self.count)
        chosen = None if mask is None else self._checked_mask(mask)
        start = self._checked_start(
            position=position, velocity=velocity, orientation=orientation, body_rate=body_rate
        )
        if seeds is not None:  # all is checked: nothing is half done
            self._reseed(seeds)
        self._take_mask(chosen)
        self._take_start(start)
        hover = self._model.airframe.hover_rotor_speed_rad_s
        self._launch(flight.restart, [hover, self._mask, self._start], [self._fleet])
        self._vehicle.begin(self._mask)
        for imu in self._imus.values():
            imu.reset(self._mask)
        pattern = self._timetable.first()
        wp.copy(self._everybody, self._mask)  # sensors of the others do not see this
        self._fly(pattern)
        for cast, names in zip(self._casts, pattern.pictures, strict=True):
            cast.prepare((0, 0), picture=bool(names))
            cast.begin(self._vehicle, self._clock)
            cast.render(1, names, self._mask)
            for camera in cast.events.values():
                camera.begin(self._mask, cast.parity)
        self._everybody.fill_(1)
        if mask is None:
            self._now_ns = 0
        self.duration_ns = 0
        return self._observe(pattern)

    def step(self, commands: Any = None, mode: CommandMode = "rates") -> Observation:
        """Hold a command in each world until the next tick of the control clock.

        On a CUDA device this only queues work. Commands on the device must come from the stream of Warp or
        from CUDA's default stream, which PyTorch uses unless told otherwise.

        Args:
            commands: Setpoints of the mode (`control.modes.MODES`), shape [N, width] or, on the host, one row
                for all. NumPy, PyTorch, Warp or what else has DLPack, float32 or float64. They are copied.
                None: the rotor speeds that hold now.
            mode: What they are; turned into rotor speeds once, at the begin of the step.

        Returns:
            What the sensors yield in (begin, end] of the step; overwritten by the next.

        Raises:
            RuntimeError: The worlds were not reset.
            ValueError: Commands on the host are of a wrong shape or not finite. Those on the device are not
                looked at: a vehicle whose command is not finite is held (`Observation.status`).
        """
        order, pattern, parities = self._plan(commands, mode)
        self._graphs.run(
            (order, pattern, parities),
            lambda: [launch() for launch in self._phases(order, pattern, parities).values()],
        )
        if self._graphs.dropped_count > 0 and not self._told:
            self._told = True
            _logger.warning(
                "steps of these worlds come in more patterns than there is room for graphs, and are launched "
                "one by one, which is slower: give sensors rates that are simple fractions of "
                "control.rate_hz = %g or multiples of it",
                self._config.control.rate_hz,
            )
        return self._observe(pattern)

    def time_step(self, commands: Any = None, mode: CommandMode = "rates") -> dict[str, float]:
        """Do what `step` does part by part, and wait for the device after each; return what each took [s].

        Arguments and errors as for `step`.
        """
        order, pattern, parities = self._plan(commands, mode)
        wall_s = {}
        wp.synchronize_device(self.device)
        for name, launch in self._phases(order, pattern, parities).items():
            begin = time.perf_counter()
            launch()
            wp.synchronize_device(self.device)
            wall_s[name] = time.perf_counter() - begin
        return wall_s

    def _plan(self, commands: Any, mode: CommandMode) -> tuple[str | None, Pattern, tuple[int, ...]]:
        """Take commands, and return what the next step is made of; the host's time moves on.

        The last is which of their two states the event cameras of each cast are in.
        """
        if self._now_ns is None:
            raise RuntimeError("reset() must be called before step()")
        order = None if commands is None else self._take_commands(commands, mode)
        pattern = self._timetable.at(self._now_ns)
        parities = tuple(cast.parity for cast in self._casts)
        for cast, offsets_ns, names in zip(self._casts, pattern.offsets_ns, pattern.pictures, strict=True):
            cast.prepare(offsets_ns, picture=bool(names))
            if len(offsets_ns) > 1:  # without a frame nothing is written, and the state stays where it is
                cast.parity = 1 - cast.parity
        self._now_ns += pattern.duration_ns
        self.duration_ns = pattern.duration_ns
        return order, pattern, parities

    def _phases(
        self, order: str | None, pattern: Pattern, parities: tuple[int, ...]
    ) -> dict[str, Callable[[], Any]]:
        """Return what launches the parts of a step, by name and in order.

        What they return has to be kept as long as a graph of them.
        """
        arrays = self._vehicle.arrays

        def fly() -> None:
            if order is not None and order != "motor_speeds":
                self._pilots[order].update(arrays)
            self._launch(flight.begin_period, [arrays.status], [self._collided])
            self._fly(pattern)

        def render() -> None:
            for cast, offsets_ns, names in zip(
                self._casts, pattern.offsets_ns, pattern.pictures, strict=True
            ):
                if len(offsets_ns) > 1:
                    cast.render(len(offsets_ns) - 1, names, self._everybody)

        def find_events() -> list[Any]:
            held = []
            for cast, offsets_ns, parity in zip(self._casts, pattern.offsets_ns, parities, strict=True):
                for camera in cast.events.values():
                    held.append(camera.offsets(offsets_ns))
                    camera.find(self._clock, offsets_ns, parity)
            self._launch(flight.end_period, [pattern.duration_ns], [self._clock])
            return held

        return {"flight": fly, "render": render, "events": find_events}

    def _fly(self, pattern: Pattern) -> None:
        """Move the vehicles from mark to mark, and note what is due there."""
        elapsed_ns = 0
        instants = [0] * len(self._casts)
        samples = [0] * len(self._model.samplers)
        for mark in pattern.marks:
            if mark.span_ns > 0:
                self._vehicle.advance(mark.span_ns)
            elapsed_ns += mark.span_ns
            for index in mark.samplers:
                if (imu := self._imus.get(self._model.samplers[index])) is not None:
                    imu.measure(samples[index])
                    samples[index] += 1
            for index in mark.casts:
                self._casts[index].place(self._vehicle, self._clock, instants[index], elapsed_ns)
                instants[index] += 1
            self._touch()

    def _touch(self) -> None:
        vehicle = self._config.vehicle
        ground = self._model.airframe.ground
        self._launch(
            flight.touch,
            [
                self._scenes.fields,
                self._scenes.scene,
                vehicle.collision_radius_m,
                -math.inf if ground is None else ground.height_m,
                int(vehicle.on_collision == "end"),
                self._everybody,
                self._vehicle.arrays.position,
            ],
            [self._collided, self._vehicle.arrays.status],
        )

    def _observe(self, pattern: Pattern) -> Observation:
        """Return the views of what a pattern yields: the same arrays each time."""
        if pattern not in self._observations:
            if len(self._observations) >= PATTERN_COUNT_MAX:
                self._observations.clear()
            self._observations[pattern] = self._make_observation(pattern)
        return self._observations[pattern]

    def _make_observation(self, pattern: Pattern) -> Observation:
        arrays = self._vehicle.arrays
        imus = {}
        for index, name in enumerate(self._model.samplers):
            if (imu := self._imus.get(name)) is not None:
                offsets_ns = _offsets_ns(pattern, index)
                count = len(offsets_ns)
                imus[name] = ImuRows(
                    specific_force=_first(imu.specific_force, count),
                    angular_rate=_first(imu.angular_rate, count),
                    offsets_ns=offsets_ns,
                )
        return Observation(
            state=VehicleStates(
                position=arrays.position,
                velocity=arrays.velocity,
                orientation=arrays.orientation,
                body_rate=arrays.body_rate,
                rotor_speed=arrays.rotor_speed,
                stamp_ns=arrays.stamp_ns,
            ),
            clock_ns=self._clock,
            events={name: camera.events for cast in self._casts for name, camera in cast.events.items()},
            images={name: picture for cast in self._casts for name, picture in cast.pictures.items()},
            fresh=frozenset(name for names in pattern.pictures for name in names),
            imu=imus,
            collided=self._collided,
            status=arrays.status,
        )

    def _take_commands(self, commands: Any, mode: CommandMode) -> str:
        """Copy commands into the fixed buffer that the graph reads."""
        if mode not in self._inputs:
            pilot = make_controller(
                mode,
                self._model.airframe,
                self._config.control.gains,
                count=self.count,
                device=self._model.device,
            )
            self._pilots[mode] = pilot
            self._inputs[mode] = CommandBuffer(pilot.setpoint)
        buffer = self._inputs[mode]
        on_device = as_device_array(commands, self.device)
        if on_device is not None:
            self._take_rows(on_device, buffer.array, "commands")
        elif mode == "motor_speeds":
            width = self._model.airframe.rotor_count
            buffer.write(as_rows(commands, name="rotor_speed_command", count=self.count, width=width))
        else:
            buffer.write(self._pilots[mode].checked(commands))
        return mode

    def _take_rows(self, rows: Any, out: Any, name: str) -> None:
        _check_rows(rows, out, name)
        wp.launch(flight.take_rows, dim=out.shape, inputs=[rows], outputs=[out], device=self.device)

    def _checked_mask(self, mask: Any) -> Any:
        """Return a mask of the right shape and type: an array of the device, or int32 on the host."""
        given = as_device_array(mask, self.device)
        kinds: tuple[Any, ...] = (wp.bool, wp.uint8, wp.int32)
        if given is None:
            given = np.asarray(mask)
            kinds = (np.bool_, np.uint8, np.int32)
        if given.shape != (self.count,) or given.dtype not in kinds:
            raise ValueError(
                f"mask must be bool, uint8 or int32 of shape [{self.count}], "
                f"got {getattr(given.dtype, '__name__', given.dtype)} of shape {list(given.shape)}"
            )
        return (given != 0).astype(np.int32) if isinstance(given, np.ndarray) else given

    def _take_mask(self, mask: Any) -> None:
        if mask is None:
            self._mask.fill_(1)
        elif isinstance(mask, np.ndarray):
            self._mask.assign(mask)
        else:
            self._launch(flight.take_mask, [mask], [self._mask])

    def _checked_start(self, **given: Any) -> dict[str, Any]:
        """Return where vehicles are to begin: arrays of the device, rows on the host, None: by default."""
        checked: dict[str, Any] = {}
        for name, value in given.items():
            array = getattr(self._start, name)
            if (on_device := as_device_array(value, self.device)) is not None:
                _check_rows(on_device, array, name)
                checked[name] = on_device
            elif value is None:
                checked[name] = None
            else:
                rows = as_rows(value, name=name, count=self.count, width=array.shape[1])
                checked[name] = _normalised(rows) if name == "orientation" else rows
        return checked

    def _take_start(self, checked: Mapping[str, Any]) -> None:
        for name, value in checked.items():
            array = getattr(self._start, name)
            if value is None:
                if name not in self._as_configured:
                    array.assign(self._begin[name])
                    self._as_configured.add(name)
                continue
            self._as_configured.discard(name)
            if isinstance(value, np.ndarray):
                array.assign(value)
                continue
            self._take_rows(value, array, name)
            if name == "orientation":
                self._launch(flight.normalise, [], [array])

    def _make_start(self) -> Any:
        """Allocate what says where vehicles begin, and look up where the paths do."""
        begins = [model.path.evaluate([0]) for model in self._scenes.models]
        half_yaw = [0.5 * begin.yaw[0] for begin in begins]
        of_scene: dict[str, NDArray[np.float64]] = {
            "position": np.array([np.ravel(begin.position) for begin in begins]),
            "velocity": np.array([np.ravel(begin.velocity) for begin in begins]),
            "orientation": np.array([[0.0, 0.0, np.sin(half), np.cos(half)] for half in half_yaw]),
            "body_rate": np.zeros((len(begins), 3)),
        }
        self._as_configured = set(of_scene)
        """What in `_start` is where vehicles begin by default."""
        self._begin = {name: rows[list(self._scenes.scene_of_world)] for name, rows in of_scene.items()}
        self._begin["orientation"] = _normalised(self._begin["orientation"])
        start = flight.Start()
        for name, rows in self._begin.items():
            setattr(start, name, wp.array(rows, dtype=wp.float64, device=self.device))
        return start

    def _make_fleet(self) -> Any:
        fleet = flight.Fleet()
        fleet.clock_ns, fleet.collided = self._clock, self._collided
        for name in (
            "position", "velocity", "orientation", "body_rate", "rotor_speed", "rotor_speed_command",
            "stamp_ns", "status", "redone_count", "evaluation_count",
        ):  # fmt: skip
            setattr(fleet, name, getattr(self._vehicle.arrays, name))
        return fleet

    def _check_partial(self, seed: Any) -> None:
        if self._now_ns is None:
            raise ValueError("mask: the first reset is of all worlds")
        if seed is not None:
            raise ValueError("seed: new seeds are for a reset of all worlds")
        common_ns = self._timetable.common_ns
        if common_ns == 0 or self._now_ns % common_ns != 0:
            when = f"every {common_ns} ns" if common_ns else "never"
            raise ValueError(
                "mask: a world that begins now would not be in step with the clocks of the rig, which tick "
                f"together {when}, and it is {self._now_ns} ns: give all sensors rates that are multiples of "
                f"control.rate_hz = {self._config.control.rate_hz:g}, or reset some worlds only then"
            )

    def _reseed(self, seeds: list[int]) -> None:
        self.seeds = seeds
        self._seeds.assign(np.array(seeds, dtype=np.uint64))
        for cast in self._casts:
            for camera in cast.events.values():
                camera.seed(seeds)

    def _launch(self, kernel: Any, inputs: list[Any], outputs: list[Any]) -> None:
        wp.launch(kernel, dim=self.count, inputs=inputs, outputs=outputs, device=self.device)


def make_worlds(
    config: SimulationConfig | Mapping[str, Any] | str | Path | None = None,
    *,
    count: int,
    device: str | None = None,
    seeds: int | ArrayLike | None = None,
    parameters: Mapping[str, ArrayLike] | None = None,
    scenes: Sequence[SceneSource] | None = None,
    models: Sequence[Model] | None = None,
    scene_of_world: ArrayLike | None = None,
    event_capacity: int | None = None,
    sorted: bool = True,
) -> Worlds:
    """Make worlds that are stepped together.

    Args:
        config: What `load_config` returns or accepts: scene, vehicle, sensors, control; one vehicle.
        count: Number of worlds N, 1 to 4096.
        device: Where to compute; None: as configured.
        seeds: Of world 0 (of the others: the next integers) or of each, shape [N]; None: as configured.
        parameters: What differs from world to world, one number for each, shape [N]: thresholds, noise and
            dead time of event cameras ("front.threshold_on", "front.shot_noise.rate_hz") and lenses
            ("front.lens.horizontal_fov_rad").
        scenes: Scenes to be in: settings files, mesh files or settings; None: the configured one.
        models: What `make_model` returned for each scene, in place of `scenes`: nothing is loaded twice. They
            must be on the same device, and have the bodies and `render` of `config`.
        scene_of_world: Which of them each world is in, shape [N]; by default they take turns.
        event_capacity: Room for the events of one world and camera in one step; by default two for each
            pixel. What does not fit is counted (`WorldEvents.dropped`).
        sorted: Sort events by (t, y, x, polarity) within each world; else those of one world come in an order
            that on a CUDA device differs from run to run.

    Raises:
        ValueError: A setting is not for worlds, out of range, or of the wrong shape; see the message.
    """
    if not 1 <= count <= COUNT_MAX:
        raise ValueError(f"count must be in [1, {COUNT_MAX}], got {count}")
    chosen = config if isinstance(config, SimulationConfig) else load_config(config)
    if len(chosen.vehicles) > 1:
        raise ValueError(f"a world holds one vehicle, got {', '.join(chosen.vehicles)}")
    chosen = chosen.of(next(iter(chosen.vehicles)))
    if device is not None:
        chosen = chosen.model_copy(update={"device": device})
    if event_capacity is not None and event_capacity < 1:
        raise ValueError(f"event_capacity must be 1 at least, got {event_capacity}")
    rigs = vary_sensors(chosen.sensors, parameters or {}, count)
    table = make_scene_table(
        chosen,
        count=count,
        scenes=scenes,
        models=models,
        scene_of_world=scene_of_world,
        lenses_differ=lenses_differ(rigs),
    )
    return Worlds(
        chosen,
        table,
        seeds=make_seeds(chosen.seed if seeds is None else seeds, count),
        rigs=rigs,
        event_capacity=event_capacity,
        ordered=sorted,
    )


def _check_image_rates(images: Sequence[Mapping[str, Rate]], control: Rate) -> None:
    for name, rate in (item for cameras in images for item in cameras.items()):
        ratio = control.rate_hz / rate.rate_hz
        if abs(ratio - round(ratio)) > 1e-9 * ratio or ratio < 1.0 - 1e-9:
            raise ValueError(
                f"sensors.{name}.rate_hz must divide control.rate_hz = {control.rate_hz:g} in worlds, where "
                f"pictures are taken at the end of steps, got {rate.rate_hz:g}"
            )


def _check_rows(rows: Any, out: Any, name: str) -> None:
    """Refuse an array of the device that cannot be copied to another."""
    if rows.ndim != 2 or tuple(rows.shape) != tuple(out.shape):
        raise ValueError(f"{name} must have shape {list(out.shape)}, got {list(rows.shape)}")
    if rows.dtype not in (wp.float32, wp.float64):
        raise ValueError(f"{name} must be float32 or float64, got {rows.dtype.__name__}")


def _normalised(orientation: NDArray[np.float64]) -> NDArray[np.float64]:
    norm: NDArray[np.float64] = np.linalg.norm(orientation, axis=1, keepdims=True)
    if not (norm > 1e-6).all():
        raise ValueError(f"orientation must not be 0, got {orientation.tolist()}")
    return orientation / norm


def _offsets_ns(pattern: Pattern, sampler: int) -> tuple[int, ...]:
    elapsed_ns, offsets = 0, []
    for mark in pattern.marks:
        elapsed_ns += mark.span_ns
        if sampler in mark.samplers:
            offsets.append(elapsed_ns)
    return tuple(offsets)


def _first(rows: Any, count: int) -> Any:
    """Return the first rows; Warp refuses an empty slice."""
    if count == 0:
        return wp.empty((0, *rows.shape[1:]), dtype=rows.dtype, device=rows.device)
    return rows[:count]
