"""rsl-rl-lib: a task as the `VecEnv` that its runners take."""

from __future__ import annotations

from typing import Any

import torch
from rsl_rl.env import VecEnv
from tensordict import TensorDict

from neurosim_core.learn.env import Env
from neurosim_core.learn.task import Observations


class RslRlEnv(VecEnv):  # type: ignore[misc]
    """A task for `rsl_rl.runners.OnPolicyRunner`; `obs_groups` of the runner are `env.obs_groups`.

    Args:
        env: The environment.
    """

    def __init__(self, env: Env) -> None:
        self._env = env
        self.num_envs, self.num_actions = env.num_envs, env.action_count
        self.max_episode_length = env.episode_steps
        self.device = env.device
        self.cfg: dict[str, Any] = {}
        self._observations, _ = env.reset(spread=True)

    @property
    def episode_length_buf(self) -> torch.Tensor:
        """Steps since each episode began; may be written, to let episodes end at different times."""
        return self._env.episode_length

    @episode_length_buf.setter
    def episode_length_buf(self, steps: torch.Tensor) -> None:
        self._env.episode_length.copy_(steps)

    def get_observations(self) -> TensorDict:
        """Return the present observations."""
        return self._dict(self._observations)

    def step(self, actions: torch.Tensor) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict[str, Any]]:
        """Act in all worlds; `time_outs` tells PPO to add the value of what would have followed."""
        self._observations, reward, terminated, truncated, info = self._env.step(actions)
        done = terminated | truncated
        extras = {"time_outs": truncated, "log": {n: v.mean() for n, v in info["metrics"].items()}}
        return self._dict(self._observations), reward, done.long(), extras

    def _dict(self, observations: Observations) -> TensorDict:
        """Return copies: surfaces are overwritten by the next step."""
        copied = {name: value.clone() for name, value in observations.items()}
        return TensorDict(copied, batch_size=[self.num_envs], device=self.device)
