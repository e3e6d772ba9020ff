# mypy: disable-error-code="attr-defined"
"""Environments: a task in N worlds, as PyTorch tensors that share memory with the simulator."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any, Literal, TypeVar

import torch
import warp as wp

from neurosim_core.learn.cameras import CameraDraws, draw_lenses
from neurosim_core.learn.episodes import COLUMNS, PARAMETERS, Episodes, make_routes
from neurosim_core.learn.randomisation import NO_RANDOMISATION, Randomisation
from neurosim_core.learn.snapshot import put_state, state_of
from neurosim_core.learn.surfaces import EventSurface, SurfaceConfig
from neurosim_core.learn.task import COMMANDS, Observations, Task, View, hover_command
from neurosim_core.registry import find
from neurosim_core.sim.model import Model
from neurosim_core.sim.observation import Observation
from neurosim_core.sim.scene_table import SceneSource
from neurosim_core.sim.simulation import Simulation
from neurosim_core.trajectory.feasibility import GRAVITY_M_S2

_T = TypeVar("_T")

CAMERA = "front"
"""Name of the event camera."""

_EVENTS_PER_PIXEL = 8
"""Room for the events of a step, in the mean of a picture: turns of 1 rad/s give up to three."""

Scenes = Sequence[SceneSource] | Literal["seen", "unseen"]
"""Scenes, or those of a task to train in (`seen`) or to test in (`unseen`)."""

StepResult = tuple[Observations, torch.Tensor, torch.Tensor, torch.Tensor, dict[str, Any]]


def find_task(name: str) -> Task:
    """Return a task by its name in the registry."""
    task: Task = find("task", name)()
    return task


class Env:
    """A task in N worlds. A step that ends episodes also restarts them (SAME_STEP).

    Observations, rewards and flags are tensors on the device. **Observations are valid until the next step**,
    which overwrites event surfaces: clone the tensors that you keep. A step neither waits for a CUDA device
    nor copies anything to the host; on a CPU it skips work that no world needs.

    Args:
        task: Name of a task in the registry ("hover", "hover-paper", ...), or a task.
        worlds: Number of worlds N.
        device: Device of the worlds: auto, cpu, cuda:0.
        observe: Names of the observations to compute; None: all. Without "events" nothing is rendered.
        surface: Representation of events; None: that of the task.
        scenes: "seen", "unseen", or scenes as for `Simulation`.
        models: Models of the scenes from `make_model`, in place of `scenes`, so that nothing is loaded twice.
        randomise: Draw parameters in each episode: True: those of the task; False: none; or a
            `Randomisation`.
        pixels: Width and height of the event camera [px]; None: those of the task.
        sensors: Further sensors by name, as in settings; their results are in `observation`.
        seed: Seed of world 0; world i has seed + i.

    Raises:
        ValueError: There is no such task, or a setting does not support worlds.

    Attributes:
        task: The task.
        num_envs: Number of worlds N.
        device: Device of all tensors.
        sim: The simulation of the worlds.
        view: The state of the worlds that the task reads.
        observation: Last results of all sensors. Resets clear events, on CUDA in every step: read events in
            `Task.advance` or `watch`.
        watch: Function that each step calls before the task and before resets; None: none.
        episode_steps: Steps after which an episode is truncated.
        action_count: Numbers in an action, each in [-1, 1].
        episode_length: Steps since the begin of each episode, int32, shape [N].
    """

    def __init__(
        self,
        task: str | Task,
        *,
        worlds: int = 64,
        device: str = "auto",
        observe: Collection[str] | None = None,
        surface: SurfaceConfig | None = None,
        scenes: Scenes = "seen",
        models: Sequence[Model] | None = None,
        randomise: bool | Randomisation = True,
        pixels: int | None = None,
        sensors: Mapping[str, Any] | None = None,
        seed: int = 0,
    ) -> None:
        self.task = task = find_task(task) if isinstance(task, str) else task
        if pixels is not None:
            task.camera = {**task.camera, "width": pixels, "height": pixels}
        self._observe = None if observe is None else frozenset(observe)
        sees = observe is None or "events" in observe
        if isinstance(scenes, str):
            scenes = task.scenes(unseen=scenes == "unseen")
        self.randomisation = randomise if isinstance(randomise, Randomisation) else task.randomisation
        if randomise is False:
            self.randomisation = NO_RANDOMISATION
        lenses, lens_table = draw_lenses(task.camera, self.randomisation)
        self.sim = Simulation(
            _settings(task, device, sees, sensors or {}, wind=self.randomisation.wind_m_s > 0.0),
            worlds=worlds,
            seeds=seed,
            event_capacity=_EVENTS_PER_PIXEL * task.camera["width"] * task.camera["height"],
            sorted=False,
            lenses={CAMERA: lenses} if sees and lenses else None,
            per_world_light=sees and self.randomisation.light_factor != (1.0, 1.0),
            **({"scenes": scenes} if models is None else {"models": models}),
        )
        self.num_envs, self.action_count = worlds, 4
        wp_device = self.sim.device
        self.device = torch.device(wp.device_to_torch(wp_device))
        routes = make_routes(
            [model.free_space for model in self.sim.models],
            [task.routes(model.config.scene) for model in self.sim.models],
            clearance_m=task.start.clearance_m,
            device=wp_device,
        )
        self._episodes = Episodes(self.sim, task.start, routes, probes=task.probes, drawn=self.randomisation)
        self._surface: EventSurface | None = None
        self._thresholds: torch.Tensor | None = None
        if sees and self.randomisation.threshold_factor != (1.0, 1.0):
            self._thresholds = wp.to_torch(self.sim.thresholds(CAMERA))
            self._nominal_thresholds = self._thresholds.clone()
        self._cameras: CameraDraws | None = None
        if sees and self.randomisation.cameras_differ:
            self._cameras = CameraDraws(self.sim, CAMERA, self.randomisation, lens_table)
        if sees:
            self._surface = EventSurface(
                task.surface if surface is None else surface,
                world_count=worlds,
                width=task.camera["width"],
                height=task.camera["height"],
                step_s=1.0 / task.rate_hz,
                device=str(wp_device),
                keep_ended=True,
            )
        self.episode_steps = round(task.episode_s * task.rate_hz)
        self.episode_length = torch.zeros(worlds, dtype=torch.int32, device=self.device)
        self._mask = torch.zeros(worlds, dtype=torch.bool, device=self.device)
        self._mask_array = wp.from_torch(self._mask)
        self._mask_int = torch.zeros(worlds, dtype=torch.int32, device=self.device)
        latency = self.randomisation.latency_steps
        self._hover = torch.tensor(hover_command(task.mode, self.sim.model.airframe), device=self.device)
        self._queue = torch.zeros((latency + 1, worlds, len(self._hover)), device=self.device)
        self._queue_place = 0
        self._lagging = self._queue[0].clone()
        self._each = torch.arange(worlds, device=self.device)
        self.view = self._make_view()
        self._fall = torch.tensor([0.0, 0.0, -GRAVITY_M_S2], dtype=torch.float64, device=self.device)
        self._seed = seed
        self._seeds = wp.to_torch(self._episodes.seeds.view(wp.int64))
        self._thrown = torch.zeros((worlds, len(task.bodies), 6), dtype=torch.float64, device=self.device)
        self._status: torch.Tensor | None = None
        self._started = False
        self.watch: Callable[[], None] | None = None

    @property
    def obs_groups(self) -> Mapping[str, Sequence[str]]:
        """Names of the observations that each group sees: actor, critic, teacher, student."""
        return self.task.groups

    @property
    def parameters(self) -> dict[str, torch.Tensor]:
        """Parameters of the worlds in their present episodes, by name of `Randomisation`, [N, ...].

        They are tensors of the device; what `step` returned as `seed` gives them again.
        """
        rows = wp.to_torch(self._episodes.parameters)
        found = {name: rows[:, columns].clone() for name, columns in PARAMETERS.items()}
        low, high = self.randomisation.thrust_factor
        found["thrust_factor"] = low + (high - low) * self.view.draws[:, -1]
        found["latency_steps"] = self._latency()
        found["lag_s"] = self._lag_s()
        if self._thresholds is not None:
            found["threshold_factor"] = (self._thresholds / self._nominal_thresholds).float()
        if self._cameras is not None:
            found |= self._cameras.parameters()
        return found

    @property
    def surface_card(self) -> dict[str, Any]:
        """The type of event surfaces: the name of their class and its settings."""
        if self._surface is None:
            return {}
        config = self._surface.config
        return {"kind": type(config).__name__, **dataclasses.asdict(config)}

    def group(self, observations: Observations, name: str) -> torch.Tensor:
        """Return the observations of a group that are vectors, in one tensor [N, n].

        Raises:
            ValueError: The task has no such group, or an observation of it was not asked for.
        """
        names = _named(self.obs_groups, name, "group of observations")
        parts = [_named(observations, key, "observation") for key in names]
        return torch.cat([part for part in parts if part.ndim == 2], dim=1)

    def hint(self, observations: Observations) -> torch.Tensor:
        """Return what students estimate besides (`Task.hint`), [N, n].

        Raises:
            ValueError: The task does not observe it.
        """
        return _named(observations, self.task.hint, "observation")

    def reset(
        self, *, seed: int | None = None, spread: bool = False, episodes: torch.Tensor | None = None
    ) -> tuple[Observations, dict[str, Any]]:
        """Begin an episode in all worlds.

        Args:
            seed: New seed of world 0 (of world i: seed + i), from which all episodes follow; None: go on.
            spread: Let these first episodes be cut at different times, so that worlds do not end together.
            episodes: Play these again, what `step` returned as `seed`, int64, [N]; others follow from them.

        Returns:
            Observations, and a dictionary: `seed`, as of `step`.

        Raises:
            ValueError: The seed is negative, or the episodes are not of N worlds.
        """
        if seed is not None or not self._started:
            self._episodes.seed(self._seed if seed is None else seed)
        if episodes is not None:
            if episodes.dtype != torch.int64 or episodes.shape != self._seeds.shape:
                raise ValueError(
                    f"episodes must be int64 of shape {tuple(self._seeds.shape)}, "
                    f"got {episodes.dtype} of {tuple(episodes.shape)}"
                )
            self._seeds.copy_(episodes)
        self._started = True
        self._mask.fill_(True)
        self._queue_place = 0
        self._begin(everywhere=True, again=episodes is not None)
        if spread:
            self.episode_length.copy_(self.view.draws[:, 0] * self.episode_steps)
        return self._observations(), {"seed": self._seeds.clone()}

    def step(self, actions: torch.Tensor) -> StepResult:
        """Act in all worlds for one step.

        Args:
            actions: In [-1, 1], clamped here, shape [N, 4].

        Returns:
            Observations (of worlds whose episode ended: of their new one), rewards, terminated, truncated,
            and a dictionary: `final_obs` (what was seen last where an episode ended), `metrics` of all
            worlds, which count there, `seed`, from which each episode can be played again, and `dropped`,
            the events that there was no room for.

        Raises:
            ValueError: The actions have another shape.
        """
        view = self.view
        if actions.shape != view.action.shape:
            raise ValueError(
                f"actions must have shape {tuple(view.action.shape)}, got {tuple(actions.shape)}"
            )
        view.last_action.copy_(view.action)
        torch.clamp(actions.detach(), -1.0, 1.0, out=view.action)
        observation = self.sim.step(self._delayed(self.task.command(view)), mode=self.task.mode)
        if self._surface is not None:
            self._surface.update(observation.events[CAMERA], observation.clock_ns)
        self._update_view(observation)
        self.episode_length += 1
        torch.mul(self.episode_length, view.step_s, out=view.elapsed_s)
        task = self.task
        if self.watch is not None:
            self.watch()
        task.advance(view)
        reward = task.reward(view)
        terminated = task.terminated(view) | view.crashed
        truncated = (self.episode_length >= self.episode_steps) & ~terminated
        torch.logical_or(terminated, truncated, out=self._mask)
        final = self._observations()
        metrics = Task.metrics(task, view) | task.metrics(view)
        info = {"final_obs": final, "metrics": metrics, "seed": self._seeds.clone()}
        if self._surface is not None:
            info["dropped"] = wp.to_torch(observation.events[CAMERA].dropped)
        if self.device.type == "cpu" and not self._mask.any():
            return final, reward, terminated, truncated, info
        if self._surface is not None and "events" in final:
            if final["events"] is view.surface:
                final["events"] = wp.to_torch(self._surface.ended)
            else:  # a task's own, perhaps a part of them
                final["events"] = final["events"].clone()
        self._begin(everywhere=False)
        return self._observations(), reward, terminated, truncated, info

    def state_dict(self) -> dict[str, Any]:
        """Return the state of all worlds, episodes and the task, as tensors and numbers.

        Raises:
            ValueError: A sensor remembers what is not in it: noise of event cameras, automatic exposure.
        """
        found = state_of(self)
        return {path: v.clone() if isinstance(v, torch.Tensor) else v for path, _, _, v in found}

    def load_state_dict(self, state: Mapping[str, Any]) -> Observations:
        """Go on from a state, of this environment or one that was made alike: on a CPU to the same bits.

        Returns:
            What is observed there.

        Raises:
            ValueError: The environment that it is of was made otherwise; this one has begun anew then.
        """
        self.reset()
        self.step(torch.zeros_like(self.view.action))  # some arrays are made only when they are needed
        put_state(state_of(self), state)
        wp.synchronize_device(self.sim.device)
        return self._observations()

    def close(self) -> None:
        """Nothing to close: memory is freed with the object."""

    def _begin(self, *, everywhere: bool, again: bool = False) -> None:
        """Begin episodes in the worlds of the mask."""
        episodes, view = self._episodes, self.view
        episodes.begin(self._mask_array, again=again)
        if self.task.bodies:
            self._throw()
        drawn, mask = self.randomisation, self._mask[:, None]
        if self._thresholds is not None:
            low, high = drawn.threshold_factor
            chosen = self._nominal_thresholds * (low + (high - low) * view.draws[:, -5:-3].double())
            self._thresholds.copy_(torch.where(mask, chosen, self._thresholds))
        if drawn.airframes_differ:
            episodes.vary_airframes(self._mask_array)
        if self._cameras is not None:
            self._cameras.vary(self._mask_array, episodes.seeds)
        observation = self.sim.reset(
            mask=None if everywhere else self._mask_array, seed=episodes.seeds, **episodes.start
        )
        for array in (view.action, view.last_action):
            array.masked_fill_(mask, 0.0)
        self.episode_length.masked_fill_(self._mask, 0)
        view.elapsed_s.masked_fill_(self._mask, 0.0)
        if self._surface is not None:
            self._mask_int.copy_(self._mask)
            self._surface.forget(wp.from_torch(self._mask_int))
        self._update_view(observation)
        hover = COMMANDS["attitude"](self.task, view) if self.task.mode == "attitude" else self._hover
        self._queue = torch.where(mask, hover, self._queue)
        self._lagging = torch.where(mask, hover, self._lagging)
        self.task.begin(view, self._mask)

    def _throw(self) -> None:
        """Throw the bodies of all worlds, as before where no episode begins."""
        position, orientation = (
            wp.to_torch(self._episodes.start[name]) for name in ("position", "orientation")
        )
        thrown = torch.cat(self.task.throw(position, orientation, self.view.draws), dim=2)
        self._thrown = torch.where(self._mask[:, None, None], thrown, self._thrown)
        rows = (self._thrown[..., :3].contiguous(), self._thrown[..., 3:].contiguous())
        self.sim.throw_bodies(*(wp.from_torch(each, dtype=wp.vec3d) for each in rows))

    def _delayed(self, command: torch.Tensor) -> torch.Tensor:
        """Return the commands that take effect now: each episode has a latency and a factor of thrust."""
        low, high = self.randomisation.thrust_factor
        factor = low + (high - low) * self.view.draws[:, -1:]
        if self.task.mode == "motor_speeds":
            command = command * factor.sqrt()
        elif self.task.mode != "velocity":
            command = torch.cat([command[:, :1] * factor, command[:, 1:]], dim=1)
        length = self._queue.shape[0]
        if length > 1:
            self._queue[self._queue_place] = command
            command = self._queue[(self._queue_place - self._latency()) % length, self._each]
            self._queue_place = (self._queue_place + 1) % length
        return command if self.randomisation.lag_s == (0.0, 0.0) else self._lagged(command)

    def _lagged(self, command: torch.Tensor) -> torch.Tensor:
        """Return the mean over the step of what follows the commands, first-order."""
        share = (self._lag_s() / self.view.step_s)[:, None]
        keep = torch.exp(-1.0 / share)
        behind = self._lagging - command
        self._lagging = command + keep * behind
        return command + share * (1.0 - keep) * behind

    def _lag_s(self) -> torch.Tensor:
        """Return the time constant of each episode [s], [N]."""
        low, high = self.randomisation.lag_s
        return (low + (high - low) * self.view.draws[:, -3]).clamp(min=1e-6)

    def _latency(self) -> torch.Tensor:
        """Return the steps from an action to its effect in each episode, int64, [N]."""
        length = self._queue.shape[0]
        return (self.view.draws[:, -2] * length).long().clamp_(max=length - 1)

    def _update_view(self, observation: Observation) -> None:
        self.observation = observation
        self._episodes.write_rows(observation)
        if self._status is None:  # the same array in each step
            self._status = wp.to_torch(observation.status)
        torch.not_equal(self._status, 0, out=self.view.crashed)
        if self.task.bodies:
            time_s = 1e-9 * wp.to_torch(observation.clock_ns).double()[:, None, None]
            fallen = time_s * self._fall
            position, velocity = self._thrown.split(3, dim=2)
            moved = position + time_s * (velocity + 0.5 * fallen)
            self.view.bodies.copy_(torch.cat([moved, velocity + fallen], dim=2))

    def _make_view(self) -> View:
        rows, distances = wp.to_torch(self._episodes.rows), self._episodes.distances
        worlds = self.num_envs
        return View(
            **{name: rows[:, begin:end] for name, (begin, end) in COLUMNS.items()},
            probes=wp.to_torch(distances)
            if distances.size
            else torch.zeros(distances.shape, device=self.device),
            scenes=[model.config.scene for model in self.sim.models],
            scene=wp.to_torch(self.sim.scene_of_world).long(),
            surface=None if self._surface is None else wp.to_torch(self._surface.array),
            action=torch.zeros((worlds, 4), device=self.device),
            last_action=torch.zeros((worlds, 4), device=self.device),
            crashed=torch.zeros(worlds, dtype=torch.bool, device=self.device),
            elapsed_s=torch.zeros(worlds, device=self.device),
            draws=wp.to_torch(self._episodes.draws),
            bodies=torch.zeros((worlds, len(self.task.bodies), 6), device=self.device),
            step_s=1.0 / self.task.rate_hz,
            vehicle=self.sim.model.airframe,
        )

    def _observations(self) -> Observations:
        seen = self.task.observe(self.view)
        if self.view.surface is not None:
            seen.setdefault("events", self.view.surface)
        return seen if self._observe is None else {k: v for k, v in seen.items() if k in self._observe}


def _named(found: Mapping[str, _T], name: str, what: str) -> _T:
    if name not in found:
        raise ValueError(f"the task has no {what} {name!r}, which is needed here; it has {', '.join(found)}")
    return found[name]


make_env = Env
"""The function that users call."""


def _settings(
    task: Task, device: str, sees: bool, sensors: Mapping[str, Any], *, wind: bool
) -> dict[str, Any]:
    """Return the settings of the simulator for a task, in which there can be wind."""
    rate_hz = task.rate_hz * task.renders_per_step
    camera = {
        "kind": "event_camera",
        "lens": dict(task.camera),
        "mount": dict(task.mount),
        "sampling_rate_hz": rate_hz,
        "packet_rate_hz": rate_hz,
        "pixel": dict(task.pixel) or {"threshold_on": task.threshold, "threshold_off": task.threshold},
    }
    vehicle = {"on_collision": "end", "max_step_s": 0.004, **task.vehicle}
    if wind:  # that of the episodes takes its place
        vehicle["parameters"] = {**vehicle.get("parameters", {}), "wind_m_s": (1.0, 0.0, 0.0)}
    return {
        "device": device,
        "control": {"rate_hz": task.rate_hz},
        "render": {"samples_per_pixel": task.rays_per_pixel},
        "path": {"kind": "hover"},
        "vehicle": vehicle,
        "sensors": ({CAMERA: camera} if sees else {}) | dict(sensors),
        "bodies": dict(task.bodies),
    }
