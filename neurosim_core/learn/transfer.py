"""Evaluation of a policy under conditions that it was not trained for."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import torch

from neurosim_core.learn.env import Env
from neurosim_core.learn.evaluate import Actor, Evaluation, evaluate_policy, student_actor
from neurosim_core.learn.surfaces import LeakySurface
from neurosim_core.learn.task import Observations, Task
from neurosim_core.learn.train import load_student, read_config

_NOISY_WORLDS = 128
"""At most so many worlds with a noisy camera, whose noise is drawn on the host at each reset."""
_DAVIS346 = {"preset": "davis346", "readout": None}
_SAME_THRESHOLDS = {"threshold_factor": (1.0, 1.0)}

CONDITIONS: Mapping[str, Mapping[str, Any]] = {
    "as in the tests": {},
    "noise of a DAVIS346": {"pixel": _DAVIS346, "drawn": _SAME_THRESHOLDS},
    "thresholds 0.4 to 0.6 times": {"drawn": {"threshold_factor": (0.4, 0.6)}},
    "thresholds 3 to 4 times": {"drawn": {"threshold_factor": (3.0, 4.0)}},
    "lens of 0.8 times the angle": {"fov_factor": 0.8},
    "lens of 1.2 times the angle": {"fov_factor": 1.2},
    "thrust 0.9 to 1.1 times": {"drawn": {"thrust_factor": (0.9, 1.1)}},
    "bias of the gyroscope up to 0.05 rad/s": {"drawn": {"gyro_bias_rad_s": 0.05}},
    "latency up to 2 steps, lag up to 0.05 s": {"drawn": {"latency_steps": 2, "lag_s": (0.0, 0.05)}},
    "mass 0.9 to 1.1 times, wind up to 1 m/s": {"drawn": {"mass_factor": (0.9, 1.1), "wind_m_s": 1.0}},
    "clock 36 % slower": {"rate_factor": 0.64},
    "clock 28 % faster": {"rate_factor": 1.28},
    "actions one step later": {"late": 1.0},
    "a tenth of the actions lost": {"late": 0.1},
    "three tenths of the actions lost": {"late": 0.3},
    "a tenth of the event packets lost": {"lost": 0.1},
    "three tenths of the event packets lost": {"lost": 0.3},
    "camera turned by up to 0.05 rad about each axis": {"drawn": {"mount_rad": 0.05}},
    "light 0.01 to 0.1 times": {"drawn": {"light_factor": (0.01, 0.1)}},
    "lenses 0.9 to 1.1 times as long, k1 up to 0.05": {
        "drawn": {"focal_factor": (0.9, 1.1), "distortion": (-0.05, 0.05)}
    },
}
"""What differs from the tests of a task, by name; periods of 50 Hz stay whole nanoseconds."""


def evaluate_transfer(
    folder: Path,
    *,
    scenes: Any = "unseen",
    device: str | None = None,
    worlds: int | None = None,
) -> Iterator[tuple[str, Evaluation]]:
    """Yield how the student of a run does under each of `CONDITIONS`.

    `scenes`: where to fly, as for `make_env`. `device`: None: as in the training. `worlds`: episodes; None:
    as configured.
    """
    config = read_config(folder)
    where: dict[str, Any] = {"scenes": scenes}
    for name, changes in CONDITIONS.items():
        count = worlds or config.evaluation_worlds
        task = _changed(config.make_task(), changes)
        if "lost" in changes and not isinstance(task.surface, LeakySurface):
            continue  # what other surfaces show without a packet is not known
        noisy = min(count, _NOISY_WORLDS) if task.pixel else count
        env = config.make_env(task, worlds=noisy, device=device, **where)
        where = {"models": env.sim.models}  # nothing is loaded twice
        if "lost" in changes:
            _lose_events(env, changes["lost"])
        policy = load_student(folder, env.device)
        yield name, evaluate_policy(env, _late(student_actor(policy, env), env, changes.get("late", 0.0)))


def _late(actor: Actor, env: Env, share: float) -> Actor:
    """Return an actor of whose actions a share is replaced by the one before; 1: all come a step later."""
    generator = torch.Generator(device=env.device).manual_seed(0)
    last = torch.zeros((env.num_envs, env.action_count), device=env.device)

    def act(observations: Observations, begun: torch.Tensor) -> torch.Tensor:
        last.masked_fill_(begun[:, None], 0.0)
        action = actor(observations, begun)
        lost = torch.rand((env.num_envs, 1), generator=generator, device=env.device) < share
        taken = torch.where(lost, last, action)
        last.copy_(action if share == 1.0 else taken)
        return taken

    return act


def _lose_events(env: Env, share: float) -> None:
    """Let the events of a share of the steps get lost, in each world at times of its own."""
    task, surface = env.task, env.task.surface
    assert isinstance(surface, LeakySurface)  # asked before
    tau_s = torch.tensor(surface.tau_s, device=env.device).repeat_interleave(2)
    decay = torch.exp(-1.0 / (task.rate_hz * tau_s))[:, None, None]
    generator = torch.Generator(device=env.device).manual_seed(0)
    before: list[torch.Tensor] = []
    view = env.view

    def lose() -> None:
        assert view.surface is not None
        if before:
            lost = torch.rand((env.num_envs, 1, 1, 1), generator=generator, device=env.device) < share
            lost &= (env.episode_length > 1)[:, None, None, None]
            view.surface.copy_(torch.where(lost, before.pop() * decay, view.surface))
        before[:] = [view.surface.clone()]

    env.watch = lose


def _changed(task: Task, changes: Mapping[str, Any]) -> Task:
    """Return a task with the changes of a condition."""
    task.pixel = changes.get("pixel", {})
    task.rate_hz *= changes.get("rate_factor", 1.0)
    task.randomisation = dataclasses.replace(task.randomisation, **changes.get("drawn", {}))
    angle_rad = task.camera["horizontal_fov_rad"] * changes.get("fov_factor", 1.0)
    task.camera = {**task.camera, "horizontal_fov_rad": angle_rad}
    return task
