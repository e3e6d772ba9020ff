"""How fast an environment is."""

from __future__ import annotations

import time

import torch

from neurosim_core.learn.env import Env

_REPEATS = 5


def measure_steps(env: Env, *, ending: int = 0, seconds: float = 1.0) -> tuple[float, float, float]:
    """Return steps of worlds a second: the median, the slowest and the fastest of five stretches.

    Args:
        env: The environment; actions are zero.
        ending: Episodes that are cut in each step; no other ends by time.
        seconds: How long to step in all, about [s].
    """
    actions = torch.zeros((env.num_envs, env.action_count), device=env.device)
    env.reset()

    def stretch(steps: int) -> float:
        _wait(env.device)
        begin_s = time.perf_counter()
        for step in range(steps):
            env.episode_length.zero_()
            if ending:
                first = step * ending % (env.num_envs - ending + 1)
                env.episode_length[first : first + ending] = env.episode_steps
            env.step(actions)
        _wait(env.device)
        return env.num_envs * steps / (time.perf_counter() - begin_s)

    stretch(5)  # kernels, graphs
    steps = max(int(seconds / _REPEATS * stretch(3) / env.num_envs), 1)
    rates = sorted(stretch(steps) for _ in range(_REPEATS))
    return rates[_REPEATS // 2], rates[0], rates[-1]


def _wait(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)
