"""skrl: a task as the wrapped environment that its trainers take."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from types import SimpleNamespace
from typing import Any

import torch
from skrl.envs.wrappers.torch import Wrapper
from skrl.utils.spaces.torch import flatten_tensorized_space

from neurosim_core.learn.env import Env
from neurosim_core.learn.gym import action_space, observation_space
from neurosim_core.learn.task import Observations


class SkrlEnv(Wrapper):  # type: ignore[misc]
    """A task for trainers of skrl.

    skrl wants observations flat; a model gets pictures back by `unflatten_tensorized_space` of
    `env.observation_space`. An episode that is cut counts as one that ends (see `value_time_outs`), as skrl
    would take what is seen first of the new episode for what follows.

    Args:
        env: The environment.
        actor: Group of observations that policies see,
        critic: and of those that are skrl's states, which critics may see.
    """

    def __init__(self, env: Env, *, actor: str = "actor", critic: str = "critic") -> None:
        self._worlds = env
        self._value: Callable[[Mapping[str, torch.Tensor]], torch.Tensor] | None = None
        self._actor, self._critic = env.obs_groups[actor], env.obs_groups[critic]
        self._now, _ = env.reset(spread=True)
        super().__init__(
            SimpleNamespace(  # of which the base has its properties
                num_envs=env.num_envs,
                device=env.device,
                observation_space=observation_space(self._now, self._actor),
                state_space=observation_space(self._now, self._critic),
                action_space=action_space(env),
            )
        )

    def value_time_outs(
        self, value: Callable[[Mapping[str, torch.Tensor]], torch.Tensor], *, discount_factor: float
    ) -> None:
        """Reward an episode that is cut with what would have followed, for PPO and its like.

        Args:
            value: Returns that [N, 1], given `observations` and `states`, such as
                `lambda inputs: critic.act(inputs, role="value")[0]`.
            discount_factor: Of the agent.
        """
        self._value = lambda inputs: discount_factor * value(inputs)

    def reset(self) -> tuple[torch.Tensor, dict[str, Any]]:
        """Return what is seen: episodes begin anew by themselves."""
        return _flat(self._now, self._actor), {}

    def step(
        self, actions: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor, dict[str, Any]]:
        """Act in all worlds; all but observations and information is of shape [N, 1]."""
        self._now, reward, terminated, truncated, info = self._worlds.step(actions)
        if self._value is not None:
            last = info["final_obs"]
            seen = {"observations": _flat(last, self._actor), "states": _flat(last, self._critic)}
            with torch.no_grad():
                reward = reward + self._value(seen)[:, 0] * truncated
        ended = (terminated | truncated)[:, None]
        metrics = {name: value.mean() for name, value in info["metrics"].items()}
        seen_now = _flat(self._now, self._actor)
        return seen_now, reward[:, None], ended, torch.zeros_like(ended), {"episode": metrics}

    def state(self) -> torch.Tensor:
        """Return the present states."""
        return _flat(self._now, self._critic)

    def render(self, *_: Any, **__: Any) -> None:
        """Show nothing; `learn.evaluate.record_episode` makes an animation."""

    def close(self) -> None:
        """Nothing to close: memory is freed with the object."""


def _flat(observations: Observations, names: Sequence[str]) -> torch.Tensor:
    """Return copies: surfaces are overwritten by the next step."""
    flat: torch.Tensor = flatten_tensorized_space({name: observations[name] for name in names})
    return flat
