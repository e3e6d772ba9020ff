"""Evaluation of a policy: an episode in each world, in scenes that it may not have seen; animations."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
from scipy.stats import binomtest

from neurosim_core.data.sources import packets_of
from neurosim_core.flight import saved_flight
from neurosim_core.learn.env import Env
from neurosim_core.learn.policies import EventPolicy
from neurosim_core.learn.task import Observations, Task
from neurosim_core.packets import Packet

EPISODE_SEED = 1_000_000
"""Of the episodes that policies are evaluated in."""
_IMAGE_HEIGHT_PX = 220
"""Height of the colour picture of an animation; its view is that of the event camera."""

Actor = Callable[[Observations, torch.Tensor], torch.Tensor]
"""Returns actions, given observations and which worlds begin an episode (bool, [N])."""


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """The result of an episode in each world."""

    episodes: int
    metrics: dict[str, float]
    """Means over the episodes: `success`, `crash`, and what else the task measures."""
    speeds: dict[str, float]
    """Quantiles of the metric `speed_m_s` at the end of episodes without a crash [m/s]."""
    intervals: dict[str, tuple[float, float]]
    """95 % intervals of `success` and `crash`."""

    def __str__(self) -> str:
        parts = []
        for name, bounds in self.intervals.items():
            low, high = (f"{100.0 * bound:.0f}" for bound in bounds)
            parts.append(f"{100.0 * self.metrics[name]:.0f} % {name} ({low} to {high})")
        if self.speeds:
            parts.append(f"median speed {self.speeds['median']:.2f} m/s")
        parts += [f"{self.metrics[name]:.2f} {name}" for name in self.metrics if name not in _SAID]
        return ", ".join(parts) + f" in {self.episodes} episodes"


_SAID = ("success", "crash", "speed_m_s")


def student_actor(policy: EventPolicy, env: Env, *, blind: bool = False) -> Actor:
    """Return the student as an actor; blind: its event surfaces are empty."""
    memory = torch.zeros((env.num_envs, policy.memory_size), device=env.device)

    def act(observations: Observations, begun: torch.Tensor) -> torch.Tensor:
        memory.masked_fill_(begun[:, None], 0.0)
        surfaces = observations["events"]
        if blind:
            surfaces = torch.zeros_like(surfaces)
        action, new = policy(surfaces, env.group(observations, "student"), memory)
        memory.copy_(new)
        return action

    return act


def teacher_actor(policy: Callable[[torch.Tensor], torch.Tensor], env: Env) -> Actor:
    """Return a teacher, who sees the group of that name, as an actor."""
    return lambda observations, _: policy(env.group(observations, "teacher"))


@torch.no_grad()
def evaluate_policy(
    env: Env,
    actor: Actor,
    *,
    seed: int = EPISODE_SEED,
) -> Evaluation:
    """Fly the first episode of each world.

    Args:
        env: Where.
        actor: Who flies.
        seed: Of the episodes.
    """
    observations, _ = env.reset(seed=seed)
    begun = torch.ones(env.num_envs, dtype=torch.bool, device=env.device)
    going = begun.clone()
    found: dict[str, torch.Tensor] = {}
    for _ in range(env.episode_steps):
        observations, _, terminated, truncated, info = env.step(actor(observations, begun))
        begun = terminated | truncated
        for name, value in info["metrics"].items():
            found[name] = torch.where(going & begun, value, found.get(name, torch.zeros_like(value)))
        going &= ~begun
    speeds = {}
    if "speed_m_s" in found and (whole := found["speed_m_s"][found["crash"] == 0.0]).numel():
        speeds = {"median": float(whole.median()), "0.9": float(whole.quantile(0.9))}
    metrics = {name: float(value.mean()) for name, value in found.items()}
    return Evaluation(
        episodes=env.num_envs,
        metrics=metrics,
        speeds=speeds,
        intervals={name: _interval(found[name]) for name in ("success", "crash")},
    )


def _interval(happened: torch.Tensor) -> tuple[float, float]:
    """Return the 95 % interval of the probability of what is 1 where it happened."""
    low, high = binomtest(int(happened.sum()), len(happened)).proportion_ci(0.95, method="wilson")
    return float(low), float(high)


def recording_sensors(task: Task) -> dict[str, Any]:
    """Return the sensors, besides the event camera, that an environment needs for `record_episode`."""
    width_px = round(_IMAGE_HEIGHT_PX * task.camera["width"] / task.camera["height"])
    lens = {**task.camera, "width": width_px, "height": _IMAGE_HEIGHT_PX}
    return {
        "rgb": {"kind": "rgb", "rate_hz": task.rate_hz, "lens": lens, "mount": dict(task.mount)},
        "odometry": {"kind": "odometry", "rate_hz": task.rate_hz},
    }


@torch.no_grad()
def record_episode(env: Env, actor: Actor, file: Path, *, seed: int = EPISODE_SEED) -> None:
    """Fly an episode in the first world, and write an animation or a recording of it.

    `env`: with the sensors of `recording_sensors`. `file`: an animation (.webp, .gif) or a recording (.h5).
    """
    with saved_flight(file, env.sim.model) as write:
        observations, _ = env.reset(seed=seed)
        _write(env, write)
        env.watch = partial(_write, env, write)
        begun = torch.ones(env.num_envs, dtype=torch.bool, device=env.device)
        try:
            for _ in range(env.episode_steps):
                observations, _, terminated, truncated, _ = env.step(actor(observations, begun))
                begun = terminated | truncated
                if begun[0]:
                    break
        finally:
            env.watch = None


def _write(env: Env, write: Callable[[Packet], None]) -> None:
    """Write what the sensors of the first world yielded."""
    (packets,) = packets_of(env.sim, env.observation, [0], env.sim.model.config.sensors)
    for packet in packets:
        write(packet)
