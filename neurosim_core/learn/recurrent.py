"""PPO of a policy with a memory on events, from scratch: its critic sees the state, nobody teaches it."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import nn

from neurosim_core.learn.descent import Descent, GraphedFunction
from neurosim_core.learn.env import Env
from neurosim_core.learn.policies import Critic, EventPolicy, make_event_policy
from neurosim_core.learn.ppo import (
    PpoConfig,
    add_advantages,
    count_ended,
    flown_log,
    minibatches,
    ppo_loss,
)
from neurosim_core.learn.task import Observations


@dataclass(frozen=True, kw_only=True)
class RecurrentPpoConfig(PpoConfig):
    """Training of a recurrent policy by PPO."""

    horizon: int = 32
    """Steps of each world in an iteration, and of backpropagation through time."""
    learning_rate: float = 6e-4
    reward_scale: float = 0.1
    gradient_max: float = 1.0
    hint_weight: float = 1.0
    """Weight of the error of the estimate (`Task.hint`), which the policy learns in addition."""
    hidden: int = 128
    """Width of the GRU."""
    widths: tuple[int, ...] = (32, 48, 48, 48, 48)
    """Channels of the convolutions."""


class _EventActorCritic(Critic):
    """A policy on events, and a critic on states."""

    def __init__(self, policy: EventPolicy, critic_size: int) -> None:
        super().__init__(critic_size)
        self.policy = policy


class RecurrentPpo:
    """Trains a policy on events in an environment, iteration by iteration.

    `env`: the policy sees its group `student`, of which `events` are pictures; the critic `critic`.
    `Task.hint` is estimated besides. `generator`: of all random numbers, on the device of the environment.
    """

    def __init__(self, env: Env, config: RecurrentPpoConfig, generator: torch.Generator) -> None:
        self.env, self.config, self._generator = env, config, generator
        self._now, _ = env.reset()
        on_cuda = env.device.type == "cuda"
        vector, told = (env.group(self._now, name) for name in ("student", "critic"))
        surface, hint = self._now["events"], env.hint(self._now)
        self.policy = make_event_policy(surface, vector, hint, hidden=config.hidden, widths=config.widths)
        last = self.policy.head[-1]
        assert isinstance(last, nn.Linear)
        nn.init.orthogonal_(last.weight, 0.05)  # at first it does next to nothing
        self._module = _EventActorCritic(self.policy, told.shape[1]).to(env.device)
        self.descent = Descent(self._module, self._loss, gradient_max=config.gradient_max, eps=1e-5)
        self._memory = torch.zeros((env.num_envs, self.policy.memory_size), device=env.device)
        sizes = {"vector": vector.shape[1], "hint": hint.shape[1], "critic": told.shape[1], "action": 4}
        steps = (config.horizon, env.num_envs)
        self._kept = {name: torch.zeros((*steps, size), device=env.device) for name, size in sizes.items()}
        for name in ("begun", "log_p", "value", "reward", "done", "advantage", "return"):
            self._kept[name] = torch.zeros(steps, device=env.device)
        self._kept["surface"] = torch.zeros(
            (*steps, *surface.shape[1:]), dtype=torch.float16, device=env.device
        )
        self._first_memory = torch.zeros_like(self._memory)
        self._seen = {
            name: torch.zeros_like(self._kept[name][0])
            for name in ("surface", "vector", "hint", "critic", "begun", "action", "log_p", "value")
        }
        self._noise = torch.zeros_like(self._seen["action"])
        self._act = GraphedFunction(self._decide, on_cuda=on_cuda)
        self._rows = torch.zeros(env.num_envs // config.minibatches, dtype=torch.int64, device=env.device)
        self._hint_error = torch.zeros((), device=env.device)
        self._begun = torch.ones(env.num_envs, device=env.device)

    def begin(self, seed: int) -> None:
        """Begin anew in all worlds, at different times of their episodes."""
        self._now, _ = self.env.reset(seed=seed, spread=True)
        self._memory.zero_()
        self._begun.fill_(1.0)

    def iterate(self, done: float) -> dict[str, float]:
        """Fly some steps and learn from them.

        `done`: share of the training that lies behind. Returns what to log.
        """
        with torch.no_grad():
            log = self._fly()
        self._hint_error.zero_()
        config = self.config
        for rows in minibatches(self.env.num_envs, len(self._rows), config, self._generator):
            self._rows.copy_(rows)
            self.descent.step(config.learning_rate * (1.0 - 0.9 * done))
        error = float(self._hint_error) / (config.epochs * config.minibatches)
        return log | {f"{self.env.task.hint} error": error}

    def _fly(self) -> dict[str, float]:
        config, env, kept = self.config, self.env, self._kept
        self._first_memory.copy_(self._memory)
        ended = torch.zeros(3, device=env.device)  # episodes, successes, crashes
        for step in range(config.horizon):
            self._copy_observations(self._now)
            self._noise.normal_(generator=self._generator)
            self._act()
            for name, value in self._seen.items():
                kept[name][step] = value
            self._now, reward, terminated, truncated, info = env.step(self._seen["action"])
            cut = self._module.value(env.group(info["final_obs"], "critic"))  # it would have gone on
            kept["reward"][step] = config.reward_scale * reward + config.discount * cut * truncated
            self._begun = kept["done"][step] = (terminated | truncated).float()
            ended += count_ended(self._begun, info["metrics"])
        later = self._module.value(env.group(self._now, "critic"))
        batch = {name: kept[name] for name in ("reward", "value", "done")}
        add_advantages(batch, later, config)
        for name in ("advantage", "return"):
            kept[name].copy_(batch[name])
        return flown_log(kept["reward"], torch.exp(self._module.log_spread), ended)

    def _copy_observations(self, now: Observations) -> None:
        """Copy what is seen to where `_decide` reads it."""
        seen, env = self._seen, self.env
        seen["begun"].copy_(self._begun)
        seen["surface"].copy_(now["events"])
        seen["vector"].copy_(env.group(now, "student"))
        seen["critic"].copy_(env.group(now, "critic"))
        seen["hint"].copy_(env.hint(now))

    def _decide(self) -> None:
        """Act on what is in `_seen`, with `_noise`."""
        seen, module = self._seen, self._module
        memory = self._memory * (1.0 - seen["begun"])[:, None]
        mean, memory = self.policy.act(seen["surface"], seen["vector"], memory)
        self._memory.copy_(memory)
        seen["action"].copy_(mean + torch.exp(module.log_spread) * self._noise)
        seen["log_p"].copy_(module.log_probability(mean, seen["action"]))
        seen["value"].copy_(module.value(seen["critic"]))

    def _loss(self) -> torch.Tensor:
        """Return the loss of the worlds that `_rows` names; adds to `_hint_error`."""
        config = self.config
        part = {name: value.index_select(1, self._rows) for name, value in self._kept.items()}
        memory = self._first_memory.index_select(0, self._rows)
        mean, hint = self.policy.unroll(part["surface"], part["vector"], part["begun"], memory)
        error = (hint - part["hint"]).square().mean()
        self._hint_error += error.detach()
        return ppo_loss(self._module, mean, part, config) + config.hint_weight * error
