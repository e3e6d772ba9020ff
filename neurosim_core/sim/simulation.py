# mypy: disable-error-code="attr-defined,call-overload,union-attr"
"""N worlds, one vehicle each, stepped together; everything stays on the device.

On a CUDA device a step is one graph: flight, poses, one render of all instants of all worlds, one scan of all
their pixels. It allocates nothing and waits for nothing; results are arrays on the device that the next step
overwrites.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from neurosim_core.config import SimulationConfig, load_config
from neurosim_core.control import CommandMode
from neurosim_core.render.camera import Lens
from neurosim_core.scene.bodies import throw_bodies
from neurosim_core.sim.inputs import (
    Start,
    checked_mask,
    checked_rows,
    checked_seeds,
    make_seeds,
    take_seeds,
)
from neurosim_core.sim.integrate import plan_batch, set_command
from neurosim_core.sim.model import Model
from neurosim_core.sim.observation import Observation, make_observation
from neurosim_core.sim.parameters import WorldSettings, check_lenses, lenses_differ, vary_sensors
from neurosim_core.sim.scene_table import SceneSource, make_scene_table
from neurosim_core.sim.schedule import STRETCH_COUNT_MAX, Schedule, Stretch
from neurosim_core.sim.state import make_state, reset_vehicles
from neurosim_core.sim.step import launch
from neurosim_core.trajectory.feasibility import GRAVITY_M_S2

_logger = logging.getLogger(__name__)

WORLD_COUNT_MAX = 4096
"""Most worlds."""


class Simulation:
    """N worlds that are stepped together; results are arrays on the device.

    All worlds share the clocks of the rig. World i gives what `step` of a single run gives with the same
    settings, its seed and its commands: the same bytes on a CPU.

    A vehicle that touches the scene, where `vehicle.on_collision` is `end`, or whose motion cannot be
    integrated, is held where it is until its world is reset; its cameras look on from there, and time passes.

    Args:
        config: What `load_config` returns or accepts: scene, vehicle, sensors, control; one vehicle.
        worlds: Number of worlds N, 1 to 4096.
        device: Where to compute; None: as configured.
        seeds: Of world 0 (of the others: the next integers) or of each, shape [N]; None: as configured.
        parameters: What differs from world to world, one number for each, shape [N]: thresholds, noise and
            dead time of event cameras ("front.threshold_on", "front.shot_noise.rate_hz") and lenses
            ("front.lens.horizontal_fov_rad").
        lenses: Lenses of cameras, by name, that worlds change between (`optics`); all begin with the first.
        own_light: Let the light of each world be changed (`light`).
        scenes: Scenes to be in: settings files, mesh files or settings; None: the configured one.
        models: What `make_model` returned for each scene, in place of `scenes`: nothing is loaded twice. They
            must be on the same device, and have the bodies and `render` of `config`.
        scene_of_world: Which of them each world is in, shape [N]; by default they take turns.
        event_capacity: Room for the events of one world and camera in one step; by default two for each
            pixel. What does not fit is counted (`WorldEvents.dropped`).
        sorted: Sort events by (t, y, x, polarity) within each world; else those of one world come in an order
            that on a CUDA device differs from run to run.

    Attributes:
        count: Number of worlds N.
        device: Where everything is.
        duration_ns: How long the last step was [ns].

    Raises:
        ValueError: A setting is not for worlds, out of range, or of the wrong shape; see the message.
    """

    def __init__(
        self,
        config: SimulationConfig | Mapping[str, Any] | str | Path | None = None,
        *,
        worlds: int = 1,
        device: str | None = None,
        seeds: int | ArrayLike | None = None,
        parameters: Mapping[str, ArrayLike] | None = None,
        lenses: Mapping[str, Sequence[Lens]] | None = None,
        own_light: bool = False,
        scenes: Sequence[SceneSource] | None = None,
        models: Sequence[Model] | None = None,
        scene_of_world: ArrayLike | None = None,
        event_capacity: int | None = None,
        sorted: bool = True,
    ) -> None:
        if not 1 <= worlds <= WORLD_COUNT_MAX:
            raise ValueError(f"worlds must be in [1, {WORLD_COUNT_MAX}], got {worlds}")
        if event_capacity is not None and event_capacity < 1:
            raise ValueError(f"event_capacity must be 1 at least, got {event_capacity}")
        chosen = _one_vehicle(config, device)
        rigs = vary_sensors(chosen.sensors, parameters or {}, worlds)
        check_lenses(chosen.sensors, lenses or {})
        self.count = worlds
        first_seeds = make_seeds(chosen.seed if seeds is None else seeds, worlds)
        self._scenes = make_scene_table(
            chosen,
            count=worlds,
            scenes=scenes,
            models=models,
            scene_of_world=scene_of_world,
            lenses_differ=lenses_differ(rigs) or bool(lenses),
            own_light=own_light,
        )
        self._model = model = self._scenes.model
        self.device = wp.get_device(model.device)
        self._schedule = model.schedule
        _check_image_rates(self._schedule)
        self._state = make_state(
            model,
            worlds=WorldSettings(
                scenes=self._scenes,
                seeds=first_seeds,
                rigs=rigs,
                lenses=lenses or {},
                instant_count=self._schedule.instants_per_period(),
                slot_count=self._schedule.boundary_count_max(1.0 / self._schedule.control.rate_hz),
                event_capacity=event_capacity,
                ordered=sorted,
            ),
        )
        self._mask = wp.ones(worlds, dtype=wp.int32, device=self.device)
        self._begin = {name: wp.clone(getattr(self._state.start, name)) for name in Start.vars}
        self._warned = False
        self._observations: dict[Stretch, Observation] = {}
        self._has_begun = False
        self.duration_ns = 0

    @property
    def model(self) -> Model:
        """The model of the first scene, which does not change."""
        return self._model

    @property
    def seeds(self) -> list[int]:
        """Seed of each world; waits for the device."""
        return [int(seed) for seed in self._state.seeds.numpy()]

    def thresholds(self, camera: str) -> Any:
        """Return the thresholds of an event camera in each world, up and down, vec2d, shape [N].

        They are on the device, and may be written where a world is about to begin anew.

        Raises:
            ValueError: There is no such event camera, or its pixels are not ideal.
        """
        for group in self._state.groups:
            if camera in group.frames:
                thresholds = getattr(group.frames[camera], "thresholds", None)
                if thresholds is not None:
                    return thresholds
        raise ValueError(f"{camera!r} is no event camera with ideal pixels: its thresholds stay as they are")

    def optics(self, camera: str) -> tuple[Any, Any, Any]:
        """Return how a camera is mounted and looks in each world: p_BC [m], q_BC, and the number of its lens.

        They are device arrays of vec3d, quatd and int32, shape [N], and may be written where a world is about
        to begin anew. Cameras that share its rays have the same.

        Raises:
            ValueError: There is no such camera.
        """
        for group, plan in zip(self._state.groups, self._model.groups, strict=True):
            if camera in plan.names:
                return group.p_BC, group.q_BC, group.worlds.lens_of_world
        raise ValueError(f"there is no camera {camera!r}")

    def light(self, name: str) -> Any:
        """Return `dark_floor` or `exposure` of the renderer in each world, device array of float32, [N].

        They may be written where a world is about to begin anew. g times the light is 1/g of the dark floor
        and g times the exposure: of log radiance all that changes else is a constant, log(g).

        Raises:
            ValueError: The worlds were made without `own_light`.
        """
        return self._scenes.light(name)

    @property
    def airframes(self) -> Any:
        """Parameters of the multirotor of each world, device array of `vehicle.aerodynamics.Airframe`, [N].

        They may be written between steps. Controllers and motors go on with the configured ones.
        """
        return self._state.vehicle.airframes

    def throw_bodies(self, position: Any, velocity: Any) -> None:
        """Let the bodies of each world fly freely, each world its own way, from the begin of its episode on.

        They may be thrown anew where an episode is about to begin; the others must be thrown as before.

        Args:
            position: p_WO of each body when the episode begins [m], device array of vec3d, shape [N, B].
            velocity: Its velocity then in W [m/s], likewise.

        Raises:
            ValueError: The shapes are others, or a sensor measures how bodies move, which it knows of bodies
                of the configuration only.
        """
        shape = (self._state.seeds.shape[0], len(self.model.config.bodies))
        for name, rows in (("position", position), ("velocity", velocity)):
            if tuple(rows.shape) != shape or rows.dtype is not wp.vec3d:
                raise ValueError(f"{name} must be vec3d of shape {shape}, got {rows.dtype} {rows.shape}")
        for group in self._state.groups:
            if group.motions is None:
                raise ValueError("there are no bodies to throw: say what they are in `bodies`")
            if any(each.processes for each in group.buffers) or group.rule is not None:
                raise ValueError("bodies can be thrown where cameras give colour, depth and events only")
        for group in self._state.groups:
            assert group.motions is not None
            throw_bodies(group.motions, position, velocity, (0.0, 0.0, -GRAVITY_M_S2))

    @property
    def fields(self) -> Any:
        """Distance to each scene, device array of `scene.freespace.DistanceField`, shape [scene]."""
        return self._scenes.fields

    @property
    def scene_of_world(self) -> Any:
        """Index of the scene of each world, device array of int32, shape [N]."""
        return self._scenes.scene

    @property
    def models(self) -> tuple[Model, ...]:
        """The model of each scene: its free space, path and light."""
        return self._scenes.models

    @property
    def common_ns(self) -> int:
        """Some worlds can be reset when all of them have flown for a multiple of this [ns]; 0: never."""
        return self._schedule.common_ns

    def reset(
        self,
        *,
        mask: Any = None,
        seed: Any = None,
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
            seed: New seeds, of world 0 (of the others: the next integers) or of each, shape [N], on the host
                or a Warp array of uint64 on the device; None: the same. Worlds that are not reset keep
                theirs. Where the pixels of an event camera are not ideal, this waits for the device.
            position: p_WB [m], shape [N, 3] or [3]; None: where the configured path begins.
            velocity: v_WB in W [m/s], likewise.
            orientation: q_WB, xyzw, shape [N, 4] or [4]; normalised here.
            body_rate: w_WB in B [rad/s], shape [N, 3] or [3]; None: 0.

        Raises:
            ValueError: A shape is wrong or a number not finite; or only some worlds are to be reset, and
                clocks of the rig, which all worlds share, do not tick together now (see `common_ns`); or the
                path is a motion that is prescribed, and a start is given.
        """
        given = {
            "position": position,
            "velocity": velocity,
            "orientation": orientation,
            "body_rate": body_rate,
        }
        if self._model.path.attitude is not None and any(value is not None for value in given.values()):
            names = ", ".join(name for name, value in given.items() if value is not None)
            raise ValueError(f"path.kind poses says where an episode starts: give no {names}")
        if mask is not None:
            self._check_partial()
        seeds = None if seed is None else checked_seeds(seed, self.count, self.device)
        chosen = None if mask is None else checked_mask(mask, self.count, self.device)
        state, first = self._state, self._schedule.first()
        begin = {
            name: self._begin[name] if value is None else checked_rows(value, self._begin[name], name)
            for name, value in given.items()
        }
        if chosen is None:  # all is checked: nothing is half done
            self._mask.fill_(1)
        else:
            wp.utils.array_cast(chosen, self._mask)
        if seeds is not None:
            self._reseed(seeds)
        for name, rows in begin.items():
            wp.copy(getattr(state.start, name), rows)
        reset_vehicles(self._model, state, self._mask)
        wp.copy(state.worlds.active, self._mask)  # sensors of the others do not see this
        if mask is None:
            state.launched_ns = 0
        launch(self._model, state, plan_batch(state, first, closed_loop=False, begins=self._mask))
        state.worlds.active.fill_(1)
        self._has_begun = True
        self.duration_ns = 0
        return self._observe(first)

    def step(self, commands: Any = None, mode: CommandMode = "rates") -> Observation:
        """Hold a command in each world until the next tick of the control clock.

        On a CUDA device this only queues work. Commands on the device must come from the stream of Warp or
        from CUDA's default stream, which PyTorch uses unless told otherwise.

        Args:
            commands: A setpoint (`control.setpoints`), or rows of the mode (`control.modes.MODES`), shape
                [N, width] or, on the host, one row for all. NumPy, PyTorch, Warp or what else has DLPack,
                float32 or float64. They are copied. None: the rotor speeds that hold now.
            mode: What they are; turned into rotor speeds once, at the begin of the step.

        Returns:
            What the sensors yield in (begin, end] of the step; overwritten by the next.

        Raises:
            RuntimeError: The worlds were not reset.
            ValueError: Commands on the host are of a wrong shape or not finite. Those on the device are not
                looked at: a vehicle whose command is not finite is held (`Observation.status`).
        """
        self._require_reset()
        set_command(self._model, self._state, commands, mode)
        return self._advance(closed_loop=False)

    def rollout(self, periods: int) -> Observation:
        """Follow the configured path for some control periods, with the controller on the device.

        Args:
            periods: How many, at least 1.

        Returns:
            What the sensors yield in the last of them.

        Raises:
            RuntimeError: The worlds were not reset.
            ValueError: `periods` is less than 1.
        """
        self._require_reset()
        if periods < 1:
            raise ValueError(f"periods must be 1 at least, got {periods}")
        if self._state.path_controller is not None:  # after a reset or a step there is no command of it
            self._state.path_controller.update(self._state.vehicle.arrays)
        for _ in range(periods):
            observation = self._advance(closed_loop=True)
        return observation

    def _require_reset(self) -> None:
        if not self._has_begun:
            raise RuntimeError("reset() must be called before step()")

    def _advance(self, *, closed_loop: bool) -> Observation:
        """Fly one control period."""
        state = self._state
        stretch = self._schedule.stretch(state.launched_ns, self._schedule.period_end_ns(state.launched_ns))
        launch(self._model, state, plan_batch(state, stretch, closed_loop=closed_loop))
        self.duration_ns = stretch.duration_ns
        if state.pipeline.graphs.dropped_count > 0 and not self._warned:
            self._warned = True
            _logger.warning(
                "steps of these worlds come in more patterns than there is room for graphs, and are launched "
                "one by one, which is slower: give sensors rates that are simple fractions of "
                "control.rate_hz = %g or multiples of it",
                self._model.config.control.rate_hz,
            )
        return self._observe(stretch)

    def _observe(self, stretch: Stretch) -> Observation:
        """Return the views of what a stretch yields: the same arrays each time."""
        if stretch not in self._observations:
            if len(self._observations) >= STRETCH_COUNT_MAX:
                self._observations.clear()
            self._observations[stretch] = make_observation(self._state, stretch)
        return self._observations[stretch]

    def _check_partial(self) -> None:
        if not self._has_begun:
            raise ValueError("mask: the first reset is of all worlds")
        common_ns, now_ns = self.common_ns, self._state.launched_ns
        if common_ns == 0 or now_ns % common_ns != 0:
            when = f"every {common_ns} ns" if common_ns else "never"
            raise ValueError(
                "mask: a world that begins now would not be in step with the clocks of the rig, which tick "
                f"together {when}, and it is {now_ns} ns: give all sensors rates that are multiples of "
                f"control.rate_hz = {self._model.config.control.rate_hz:g}, or reset some worlds only then"
            )

    def _reseed(self, seeds: Any) -> None:
        """Give the worlds of the mask other seeds."""
        inputs, outputs = [self._mask, seeds], [self._state.seeds]
        wp.launch(take_seeds, dim=self.count, inputs=inputs, outputs=outputs, device=self.device)
        sensors = [sensor for group in self._state.groups for sensor in group.frames.values()]
        if any(sensor.terms for sensor in sensors):
            worlds = set(np.flatnonzero(self._mask.numpy()).tolist())
            for sensor in sensors:
                sensor.seed(self.seeds, worlds)


def _one_vehicle(
    config: SimulationConfig | Mapping[str, Any] | str | Path | None, device: str | None
) -> SimulationConfig:
    chosen = config if isinstance(config, SimulationConfig) else load_config(config)
    if len(chosen.vehicles) > 1:
        raise ValueError(
            f"a world holds one vehicle, got {', '.join(chosen.vehicles)}: `neurosim serve` flies several"
        )
    chosen = chosen.of(next(iter(chosen.vehicles)))
    return chosen if device is None else chosen.model_copy(update={"device": device})


def _check_image_rates(schedule: Schedule) -> None:
    for name, rate in schedule.images.items():
        if not schedule.control.contains(rate):
            raise ValueError(
                f"sensors.{name}.rate_hz must divide control.rate_hz = {schedule.control.rate_hz:g} in "
                f"worlds, where pictures are taken at the end of steps, got {rate.rate_hz:g}"
            )
