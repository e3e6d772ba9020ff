"""Stable-Baselines3: a task as the `VecEnv` that its algorithms take (PPO, SAC, TD3, ...)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from neurosim_core.learn.gym import Arrays, NumpyEnv


class Sb3Env(VecEnv):  # type: ignore[misc]
    """A task for `stable_baselines3`, with dict observations: take `MultiInputPolicy`.

    Args:
        env: The environment, such as `make_numpy_env(task="hover", num_envs=64, group="actor")`.
    """

    def __init__(self, env: NumpyEnv) -> None:
        self._env = env
        self._actions: NDArray[Any] | None = None
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)

    def reset(self) -> Arrays:
        """Begin an episode in all worlds, with the seed that `seed` was told."""
        observations, _ = self._env.reset(seed=self._seeds[0])
        self._reset_seeds()
        return observations

    def step_async(self, actions: NDArray[Any]) -> None:
        """Take actions for `step_wait`."""
        self._actions = actions

    def step_wait(self) -> tuple[Arrays, NDArray[Any], NDArray[Any], list[dict[str, Any]]]:
        """Act in all worlds; what was seen last of episodes that ended is in their `info`."""
        assert self._actions is not None
        observations, reward, terminated, truncated, found = self._env.step(self._actions)
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for world in np.flatnonzero(terminated | truncated):
            infos[world] = {
                "terminal_observation": found["final_obs"][world],
                "TimeLimit.truncated": bool(truncated[world]),
                **{name: float(value[world]) for name, value in found["final_info"].items()},
            }
        return observations, reward, terminated | truncated, infos

    def close(self) -> None:
        """Nothing to close: memory is freed with the object."""

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return an attribute of the environment, once for each world that is asked for."""
        return [getattr(self._env, attr_name, None)] * len(self._worlds(indices))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Refuse: worlds have no attributes of their own."""
        raise NotImplementedError(f"{attr_name}: worlds have no attributes of their own")

    def env_method(self, method_name: str, *_: Any, indices: Any = None, **__: Any) -> list[Any]:
        """Refuse: worlds have no methods of their own."""
        raise NotImplementedError(f"{method_name}: worlds have no methods of their own")

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        """Return that no world is wrapped, as no wrapper sees one alone."""
        return [False] * len(self._worlds(indices))

    def _worlds(self, indices: Any) -> Sequence[int]:
        return list(self._get_indices(indices))
