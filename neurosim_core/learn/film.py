"""A film of an episode: what a colour camera sees beside the event camera, its events, and the path."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from neurosim_core.flight import saved_flight
from neurosim_core.learn.env import CAMERA, Env
from neurosim_core.learn.evaluate import EPISODE_SEED, Actor
from neurosim_core.learn.task import Task
from neurosim_core.packets import Events, Image, Odometry, Packet

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
    seen = env.observation
    stamp_ns = int(seen.clock_ns.numpy()[0])
    header: dict[str, Any] = {"stamp_ns": stamp_ns, "sequence": round(1e-9 * stamp_ns * env.task.rate_hz)}
    write(Image(**header, sensor="rgb", data=np.array(seen.images["rgb"].numpy()[0]), encoding="rgb8"))
    state = {name: rows.numpy()[-1, 0] for name, rows in seen.samples["odometry"].arrays.items()}
    write(Odometry(**header, sensor="odometry", **state))
    events = seen.events[CAMERA]
    columns = events.numpy(0)
    t, x, y, polarity = (column[np.argsort(columns[0], kind="stable")] for column in columns)
    size = {"width": events.width, "height": events.height}
    write(Events(**header, sensor=CAMERA, t=t, x=x, y=y, polarity=polarity, **size))
