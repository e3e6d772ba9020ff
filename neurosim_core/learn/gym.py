"""Gymnasium: a task as a `VectorEnv` of NumPy arrays.

`gymnasium.make_vec("neurosim_core.learn.gym:neurosim/hover-v0", 64)` makes one, too. For learning libraries
that want NumPy; those of PyTorch take `Env` as it is, without copies.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box, Dict
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from neurosim_core.learn.env import Env, make_env
from neurosim_core.learn.task import Observations
from neurosim_core.registry import kinds

Arrays = dict[str, NDArray[Any]]


class NumpyEnv(VectorEnv[Arrays, NDArray[Any], NDArray[Any]]):
    """A task in N worlds as a vector environment that begins anew in the step that ends an episode.

    `group`: observations of this group of the task only; None: all.
    """

    def __init__(self, env: Env, *, group: str | None = None) -> None:
        self._env = env
        self._names = None if group is None else frozenset(env.obs_groups[group])
        self.num_envs = env.num_envs
        self.metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}
        observations, _ = env.reset()
        self.single_observation_space = observation_space(observations, self._names)
        self.single_action_space = action_space(env)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)

    def reset(  # type: ignore[override]
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Arrays, dict[str, Any]]:
        """Begin an episode in all worlds.

        `seed`: of world 0; world i has seed + i. None: go on. `options`: `spread` and `episodes` of
        `Env.reset`, the latter as an array. Returns observations, and a dictionary: `seed`, from which each
        episode can be played again.
        """
        given = dict(options or {})
        episodes = given.pop("episodes", None)
        if episodes is not None:
            episodes = torch.as_tensor(episodes, device=self._env.device)
        spread = given.pop("spread", False)
        if given:
            raise ValueError(f"unknown options {sorted(given)}, known: ['episodes', 'spread']")
        observations, info = self._env.reset(seed=seed, spread=spread, episodes=episodes)
        return self._arrays(observations), _of_all("seed", info)

    def step(
        self, actions: NDArray[Any]
    ) -> tuple[Arrays, NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:
        """Act in all worlds.

        Returns observations, rewards, terminated, truncated, and a dictionary: `seed` of each episode,
        `dropped` (events that there was no room for), and where some ended `final_obs` and `final_info` (the
        task's metrics), which count in the worlds of `_final_obs`.
        """
        given = torch.as_tensor(actions, dtype=torch.float32, device=self._env.device)
        observations, reward, terminated, truncated, info = self._env.step(given)
        ended = (terminated | truncated).cpu().numpy()
        extra = _of_all("seed", info) | _of_all("dropped", info)
        if ended.any():
            final = self._arrays(info["final_obs"])
            rows = np.empty(self.num_envs, dtype=object)
            for world in np.flatnonzero(ended):
                rows[world] = {name: value[world] for name, value in final.items()}
            extra |= {
                "final_obs": rows,
                "_final_obs": ended,
                "final_info": {name: value.cpu().numpy() for name, value in info["metrics"].items()},
                "_final_info": ended,
            }
        return (
            self._arrays(observations),
            reward.cpu().numpy(),
            terminated.cpu().numpy(),
            truncated.cpu().numpy(),
            extra,
        )

    def _arrays(self, observations: Observations) -> Arrays:
        """Return copies on the host."""
        return {
            name: np.array(value.cpu().numpy())
            for name, value in observations.items()
            if self._names is None or name in self._names
        }


def _of_all(name: str, info: dict[str, Any]) -> dict[str, Any]:
    """Return what all worlds tell under a name, if they do, as vector environments of Gymnasium tell it."""
    if name not in info:
        return {}
    values = np.array(info[name].cpu().numpy())
    return {name: values, f"_{name}": np.ones(len(values), dtype=bool)}


def observation_space(observations: Observations, names: Collection[str] | None) -> Dict:
    """Return the space of a world for observations of these names; None: of all."""
    spaces: dict[str, gymnasium.Space[Any]] = {
        name: Box(*_bounds(value), shape=tuple(value.shape[1:]), dtype=value[:0].cpu().numpy().dtype.type)
        for name, value in observations.items()
        if names is None or name in names
    }
    return Dict(spaces)


def _bounds(value: torch.Tensor) -> tuple[float, float]:
    return (-np.inf, np.inf) if value.is_floating_point() else (0, torch.iinfo(value.dtype).max)


def action_space(env: Env) -> Box:
    """Return the space of the actions of a world."""
    return Box(-1.0, 1.0, shape=(env.action_count,), dtype=np.float32)


def make_numpy_env(*, task: str, num_envs: int = 1, group: str | None = None, **options: Any) -> NumpyEnv:
    """Return a task as a vector environment; `options` are those of `make_env`."""
    return NumpyEnv(make_env(task, worlds=num_envs, **options), group=group)


def register_all() -> None:
    """Register all tasks as `neurosim/NAME-v0`."""
    for name in kinds("task"):
        identifier = f"neurosim/{name}-v0"
        if identifier not in gymnasium.registry:
            gymnasium.register(
                identifier,
                vector_entry_point="neurosim_core.learn.gym:make_numpy_env",
                kwargs={"task": name},
            )


register_all()
