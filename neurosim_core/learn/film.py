"""A film of an episode: what a colour camera sees beside the event camera, its events, and the path."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import torch

from neurosim_core.data.sources import packets_of
from neurosim_core.flight import saved_flight
from neurosim_core.learn.env import Env
from neurosim_core.learn.evaluate import EPISODE_SEED, Actor
from neurosim_core.learn.task import Task
from neurosim_core.packets import Packet

_HEIGHT_PX = 220
"""Of the picture; its view is that of the event camera."""


def film_sensors(task: Task) -> dict[str, Any]:
    """Return the sensors, besides the event camera, that an environment needs to be filmed."""
    width_px = round(_HEIGHT_PX * task.camera["width"] / task.camera["height"])
    lens = {**task.camera, "width": width_px, "height": _HEIGHT_PX}
    return {
        "rgb": {"kind": "rgb", "rate_hz": task.rate_hz, "lens": lens, "mount": dict(task.mount)},
        "odometry": {"kind": "odometry", "rate_hz": task.rate_hz},
    }


@torch.no_grad()
def film_episode(env: Env, actor: Actor, file: Path, *, seed: int = EPISODE_SEED) -> None:
    """Fly an episode in the first world, and leave a film or a recording of it.

    `env`: where, with the sensors of `film_sensors`. `file`: a film (.webp, .gif) or a recording (.h5).
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
