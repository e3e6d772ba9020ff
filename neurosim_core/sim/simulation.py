# mypy: disable-error-code="attr-defined,call-overload,union-attr"
"""N worlds with one vehicle each, stepped together on the device.

On a CUDA device, a step is one graph: motion, poses, one render of all instants of all worlds, one scan of
all their pixels. It neither allocates nor waits. Results are arrays on the device that the next step
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

from neurosim_core.config import SimulationConfig, as_config
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
"""Largest number of worlds."""


class Simulation:
    """N worlds that are stepped together; results are arrays on the device.

    All worlds share the clocks of the rig. World i gives the same results as a single run (`ns.step`) with
    the same settings, seed and commands: the same bytes on a CPU.

    A vehicle is held in place until its world is reset if it touches the scene and `vehicle.on_collision` is
    `end`, or if its motion cannot be integrated. Its cameras keep rendering, and time goes on.

    Args:
        config: Settings, or anything that `load_config` accepts: scene, sensors, control and one vehicle.
        worlds: Number of worlds N, 1 to 4096.
        device: Device to compute on; None: as configured.
        seeds: Seed of world 0 (world i has seed + i), or one seed per world, shape [N]; None: as configured.
        parameters: Values that differ between worlds, one number per world, shape [N]: thresholds, noise and
            dead time of event cameras ("front.threshold_on", "front.shot_noise.rate_hz") and lenses
            ("front.lens.horizontal_fov_rad").
        lenses: Lenses that a camera can switch between, by name of the camera (`optics`); all worlds begin
            with the first.
        per_world_light: Each world has its own light, which can be changed (`light`).
        scenes: Scenes of the worlds: settings files, mesh files or settings; None: the configured scene.
        models: Models of the scenes from `make_model`, in place of `scenes`, so that nothing is loaded twice.
            They must be on one device, and have the bodies and `render` settings of `config`.
        scene_of_world: Index of the scene of each world, shape [N]; by default 0, 1, 2, ..., 0, 1, ...
        event_capacity: Capacity for the events of one world and camera in one step; by default two per pixel.
            Events beyond it are counted (`WorldEvents.dropped`).
        sorted: Sort the events of each world by (t, y, x, polarity). Unsorted events of a world are in an
            order that differs from run to run on a CUDA device.

    Attributes:
        count: Number of worlds N.
        device: The Warp device of all arrays.
        duration_ns: Length of the last step [ns].

    Raises:
        ValueError: A setting does not support worlds, is out of range, or has a wrong shape; see the message.
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
        per_world_light: bool = False,
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
            per_world_light=per_world_light,
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
        """The model of the first scene."""
        return self._model

    @property
    def seeds(self) -> list[int]:
        """Seed of each world; waits for the device."""
        return [int(seed) for seed in self._state.seeds.numpy()]

    def thresholds(self, camera: str) -> Any:
        """Return the ON and OFF thresholds of an event camera in each world, device array of vec2d, [N].

        You may write the values of a world right before its reset.

        Raises:
            ValueError: There is no such event camera, or its pixels are not ideal.
        """
        for group in self._state.groups:
            if camera in group.frames:
                thresholds = getattr(group.frames[camera], "thresholds", None)
                if thresholds is not None:
                    return thresholds
        raise ValueError(f"{camera!r} is no event camera with ideal pixels: only theirs can be changed")

    def optics(self, camera: str) -> tuple[Any, Any, Any]:
        """Return the mount and the lens of a camera in each world: p_BC [m], q_BC, and the index of its lens.

        They are device arrays of vec3d, quatd and int32, shape [N]. You may write the values of a world right
        before its reset. Cameras that share rays share these arrays.

        Raises:
            ValueError: There is no such camera.
        """
        for group, plan in zip(self._state.groups, self._model.groups, strict=True):
            if camera in plan.names:
                return group.p_BC, group.q_BC, group.worlds.lens_of_world
        raise ValueError(f"there is no camera {camera!r}")

    def light(self, name: str) -> Any:
        """Return `dark_floor` or `exposure` of the renderer in each world, device array of float32, [N].

        You may write the values of a world right before its reset. To scale the light by g, multiply the
        exposure by g and divide the dark floor by g; log radiance then differs from that of the scaled light
        by the constant log(g).

        Raises:
            ValueError: The simulation was made without `per_world_light`.
        """
        return self._scenes.light(name)

    @property
    def airframes(self) -> Any:
        """Parameters of the multirotor of each world, device array of `vehicle.aerodynamics.Airframe`, [N].

        You may write them between steps. Controllers and motors keep the configured parameters.
        """
        return self._state.vehicle.airframes

    def throw_bodies(self, position: Any, velocity: Any) -> None:
        """Let the bodies of each world fall freely from the begin of its episode.

        Change the values of a world only right before its reset; repeat those of the other worlds.

        Args:
            position: p_WO of each body at the begin of the episode [m], device array of vec3d, shape [N, B].
            velocity: Velocity of each body at that time in W [m/s], same type and shape.

        Raises:
            ValueError: A shape is wrong, there are no bodies, or a sensor needs the motion of bodies, which
                it knows from the settings only.
        """
        shape = (self._state.seeds.shape[0], len(self.model.config.bodies))
        for name, rows in (("position", position), ("velocity", velocity)):
            if tuple(rows.shape) != shape or rows.dtype is not wp.vec3d:
                raise ValueError(f"{name} must be vec3d of shape {shape}, got {rows.dtype} {rows.shape}")
        for group in self._state.groups:
            if group.motions is None:
                raise ValueError("there are no bodies to throw: define them in the settings `bodies`")
            if any(each.processes for each in group.buffers) or group.rule is not None:
                raise ValueError(
                    "throw_bodies: cameras that process their pictures (optical_flow, lidar, ...), and "
                    "max_displacement_px, know the configured motions of bodies only"
                )
        for group in self._state.groups:
            assert group.motions is not None
            throw_bodies(group.motions, position, velocity, (0.0, 0.0, -GRAVITY_M_S2))

    @property
    def fields(self) -> Any:
        """Distance field of each scene, device array of `scene.freespace.DistanceField`, shape [scene]."""
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
        """Common period of all clocks [ns], at whose multiples some worlds can be reset; 0: never."""
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
        """Reset all worlds or some of them, with rotors at hover, and sample all sensors at stamp 0.

        Event cameras take the first render as their reference, so the observation has no events in any world.
        Rows of worlds that are not reset are ignored. If all arguments are arrays of a CUDA device, the call
        does not wait for it.

        Args:
            mask: Worlds to reset, shape [N], bool, uint8 or int32, on host or device; None: all.
            seed: New seed of world 0 (world i gets seed + i), or one seed per world, shape [N], on the host
                or as a Warp array of uint64 on the device; None: seeds stay. Worlds that are not reset keep
                their seeds. If an event camera has noise, new seeds wait for the device.
            position: p_WB [m], shape [N, 3] or [3]; None: the start of the configured path.
            velocity: v_WB in W [m/s], shape [N, 3] or [3]; None: the start of the configured path.
            orientation: q_WB, xyzw, shape [N, 4] or [4]; it is normalised.
            body_rate: w_WB in B [rad/s], shape [N, 3] or [3]; None: 0.

        Raises:
            ValueError: A shape is wrong or a number is not finite; the path prescribes the motion and a start
                is given; or only some worlds are reset while the clocks of the rig, which all worlds share,
                do not tick together (see `common_ns`).
        """
        given = {
            "position": position,
            "velocity": velocity,
            "orientation": orientation,
            "body_rate": body_rate,
        }
        if self._model.path.attitude is not None and any(value is not None for value in given.values()):
            names = ", ".join(name for name, value in given.items() if value is not None)
            raise ValueError(f"path.kind poses prescribes the start of an episode: give no {names}")
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
        launch(self._model, state, plan_batch(state, first, closed_loop=False, reset_mask=self._mask))
        state.worlds.active.fill_(1)
        self._has_begun = True
        self.duration_ns = 0
        return self._observe(first)

    def step(self, commands: Any = None, mode: CommandMode = "rates") -> Observation:
        """Hold a command in each world until the next tick of the control clock.

        On a CUDA device this only queues work. Commands on the device must come from Warp's stream or from
        CUDA's default stream, which is PyTorch's default.

        Args:
            commands: A setpoint (`control.setpoints`), or rows of the mode (`control.modes.MODES`), shape
                [N, width] or, on the host, one row for all worlds; float32 or float64, from NumPy, PyTorch,
                Warp or any library with DLPack. They are copied. None: hold the present rotor speeds.
            mode: Command mode of the rows, converted to rotor speeds once, at the begin of the step.

        Returns:
            The results of all sensors in (begin, end] of the step; the next step overwrites them.

        Raises:
            RuntimeError: `reset` was not called.
            ValueError: Commands on the host have a wrong shape or are not finite. The values of commands on
                the device are not checked: a vehicle with a command that is not finite is held
                (`Observation.status`).
        """
        self._require_reset()
        set_command(self._model, self._state, commands, mode)
        return self._advance(closed_loop=False)

    def rollout(self, periods: int) -> Observation:
        """Follow the configured path for some control periods, with the controller on the device.

        Args:
            periods: Number of control periods, at least 1.

        Returns:
            The results of all sensors in the last period.

        Raises:
            RuntimeError: `reset` was not called.
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
        """Return the views of the results of a stretch; equal stretches share one observation."""
        if stretch not in self._observations:
            if len(self._observations) >= STRETCH_COUNT_MAX:
                self._observations.clear()
            self._observations[stretch] = make_observation(self._state, stretch)
        return self._observations[stretch]

    def _check_partial(self) -> None:
        if not self._has_begun:
            raise ValueError("mask: the first reset must reset all worlds: give no mask")
        common_ns, now_ns = self.common_ns, self._state.launched_ns
        if common_ns == 0 or now_ns % common_ns != 0:
            when = f"every {common_ns} ns" if common_ns else "never"
            raise ValueError(
                "mask: some worlds can be reset only when all clocks of the rig tick together, which is "
                f"{when}; it is {now_ns} ns: give all sensors rates that are multiples of "
                f"control.rate_hz = {self._model.config.control.rate_hz:g}, or reset some worlds only then"
            )

    def _reseed(self, seeds: Any) -> None:
        """Set new seeds in the worlds of the mask."""
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
    chosen = as_config(config)
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
                f"worlds, which take pictures at the end of steps, got {rate.rate_hz:g}"
            )
