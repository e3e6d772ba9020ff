"""The speed of an environment, and of a training in it."""

from __future__ import annotations

import time
from collections.abc import Callable

import torch

from neurosim_core.learn.env import Env
from neurosim_core.learn.recurrent import RecurrentPpo, RecurrentPpoConfig

_REPEATS = 5


def measure_steps(env: Env, *, ending: int = 0, seconds: float = 1.0) -> tuple[float, float, float]:
    """Return steps of worlds a second: the median, the slowest and the fastest of five stretches.

    `env`: the environment; actions are zero. `ending`: episodes that are cut in each step; no other ends by
    time. `seconds`: how long to step in all, about [s].
    """
    actions = torch.zeros((env.num_envs, env.action_count), device=env.device)
    env.reset()

    def fly(steps: int) -> None:
        for step in range(steps):
            env.episode_length.zero_()
            if ending:
                first = step * ending % (env.num_envs - ending + 1)
                env.episode_length[first : first + ending] = env.episode_steps
            env.step(actions)

    _rate(env, fly, 5)  # kernels, graphs
    steps = max(int(seconds / _REPEATS * _rate(env, fly, 3) / env.num_envs), 1)
    return _spread([_rate(env, fly, steps) for _ in range(_REPEATS)])


def measure_updates(env: Env) -> tuple[float, float, float]:
    """Return the same of recurrent PPO on events, which learns from these steps: of five iterations."""
    config = RecurrentPpoConfig(worlds=env.num_envs)
    trainer = RecurrentPpo(env, config, torch.Generator(device=env.device))
    trainer.begin(0)

    def train(steps: int) -> None:
        for _ in range(steps // config.horizon):
            trainer.iterate(0.0)

    _rate(env, train, config.horizon)  # kernels, graphs
    return _spread([_rate(env, train, config.horizon) for _ in range(_REPEATS)])


def _rate(env: Env, fly: Callable[[int], None], steps: int) -> float:
    """Return steps of worlds a second of so many steps of all worlds."""
    _wait(env.device)
    begin_s = time.perf_counter()
    fly(steps)
    _wait(env.device)
    return env.num_envs * steps / (time.perf_counter() - begin_s)


def _spread(rates: list[float]) -> tuple[float, float, float]:
    rates = sorted(rates)
    return rates[len(rates) // 2], rates[0], rates[-1]


def _wait(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)
