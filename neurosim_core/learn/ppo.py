"""Proximal policy optimisation (Schulman et al. 2017) of a policy on states."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import torch

from neurosim_core.learn import ranks
from neurosim_core.learn.descent import Descent
from neurosim_core.learn.env import Env
from neurosim_core.learn.policies import ActorCritic, Critic

_RATE_STEP, _RATE_LEAST, _RATE_MOST = 1.2, 0.05, 4.0
"""What adaptation multiplies the learning rate with, and the range of the product."""


@dataclass(frozen=True, kw_only=True)
class PpoConfig:
    """Training by proximal policy optimisation (PPO)."""

    worlds: int = 256
    iterations: int = 80
    horizon: int = 24
    """Steps of each world in an iteration."""
    epochs: int = 4
    minibatches: int = 4
    learning_rate: float = 1.5e-3
    """Initial learning rate; it falls to a tenth."""
    divergence: float = 0.0
    """How much a teacher should change in an iteration (KL): where it changes more than twice or less than
    half as much, the learning rate is divided or multiplied by 1.2 from then on. 0: it only falls."""
    discount: float = 0.98
    reward_scale: float = 1.0
    """Factor on rewards: large errors of the critic would drown the gradient of the actor."""
    trace: float = 0.95
    """Lambda of the generalised advantage estimate."""
    clip: float = 0.2
    entropy_weight: float = 0.002
    gradient_max: float = 0.5


class Ppo:
    """Trains an actor and a critic in an environment, iteration by iteration.

    Args:
        env: Its observation groups `actor` and `critic` are seen; vectors only.
        config: How.
        generator: Of all random numbers, on the device of the environment.
    """

    def __init__(self, env: Env, config: PpoConfig, generator: torch.Generator) -> None:
        self.env, self.config = env, config
        self._generator = generator
        observations, _ = env.reset()
        sizes = [env.group(observations, name).shape[1] for name in ("actor", "critic")]
        self.policy = ActorCritic(*sizes).to(env.device)
        self.descent = Descent(self.policy, self._loss, gradient_max=config.gradient_max, eps=1e-5)
        self._batch: dict[str, torch.Tensor] = {}
        size = config.horizon * env.num_envs // config.minibatches
        self._rows = torch.zeros(size, dtype=torch.int64, device=env.device)
        self._now = self._seen(observations)

    def begin(self, seed: int) -> None:
        """Begin anew in all worlds, at different times of their episodes."""
        observations, _ = self.env.reset(seed=seed, spread=True)
        self._now = self._seen(observations)

    def iterate(self, done: float) -> dict[str, float]:
        """Fly some steps and learn from them.

        Args:
            done: Share of the training that lies behind.

        Returns:
            What to log.
        """
        with torch.no_grad():
            batch, log = self._fly()
        self._learn(batch, self.config.learning_rate * (1.0 - 0.9 * done))
        return log

    def _seen(self, observations: dict[str, torch.Tensor]) -> tuple[torch.Tensor, torch.Tensor]:
        return self.env.group(observations, "actor"), self.env.group(observations, "critic")

    def _fly(self) -> tuple[dict[str, torch.Tensor], dict[str, float]]:
        config, policy, env = self.config, self.policy, self.env
        spread = torch.exp(policy.log_spread)
        rows: dict[str, list[torch.Tensor]] = {
            name: [] for name in ("actor", "critic", "action", "log_p", "value", "reward", "done")
        }
        ended = torch.zeros(3, device=env.device)  # episodes, successes, crashes
        for _ in range(config.horizon):
            seen, told = self._now
            mean = policy(seen)
            noise = torch.randn(mean.shape, generator=self._generator, device=mean.device)
            action = mean + spread * noise
            observations, reward, terminated, truncated, info = env.step(action)
            cut = policy.value(self._seen(info["final_obs"])[1])  # the episode would have gone on
            done = (terminated | truncated).float()
            for name, value in (
                ("actor", seen),
                ("critic", told),
                ("action", action),
                ("log_p", policy.log_probability(mean, action)),
                ("value", policy.value(told)),
                ("reward", config.reward_scale * reward + config.discount * cut * truncated),
                ("done", done),
            ):
                rows[name].append(value)
            ended += count_ended(done, info["metrics"])
            self._now = self._seen(observations)
        batch = {name: torch.stack(values) for name, values in rows.items()}
        add_advantages(batch, policy.value(self._now[1]), config)
        log = flown_log(batch["reward"], spread, ended)
        return {name: value.flatten(0, 1) for name, value in batch.items()}, log

    def _learn(self, batch: dict[str, torch.Tensor], rate: float) -> None:
        if not self._batch:
            self._batch = {name: torch.empty_like(value) for name, value in batch.items()}
        for name, value in batch.items():
            self._batch[name].copy_(value)
        for rows in minibatches(len(batch["advantage"]), len(self._rows), self.config, self._generator):
            self._rows.copy_(rows)
            self.descent.step(rate)
        if self.config.divergence:
            self._adapt(batch)

    def _adapt(self, batch: dict[str, torch.Tensor]) -> None:
        """Change the learning rate by how much the policy has changed on a batch."""
        with torch.no_grad():
            action = self.policy(batch["actor"])
            change = self.policy.log_probability(action, batch["action"]) - batch["log_p"]
            divergence = (change.exp() - 1.0 - change).mean()[None]  # Schulman's estimate
        if ranks.count() > 1:
            ranks.average(divergence)
        ratio = float(divergence) / self.config.divergence
        factor = 1.0 / _RATE_STEP if ratio > 2.0 else _RATE_STEP if ratio < 0.5 else 1.0
        self.descent.rate_factor = min(max(self.descent.rate_factor * factor, _RATE_LEAST), _RATE_MOST)

    def _loss(self) -> torch.Tensor:
        """Return the loss of the rows of the batch that `_rows` names."""
        part = {name: value.index_select(0, self._rows) for name, value in self._batch.items()}
        return ppo_loss(self.policy, self.policy(part["actor"]), part, self.config)


def count_ended(done: torch.Tensor, metrics: Mapping[str, torch.Tensor]) -> torch.Tensor:
    """Return how many episodes a step has ended, and how many in success and in a crash, shape [3]."""
    return torch.stack([done.sum(), (metrics["success"] * done).sum(), (metrics["crash"] * done).sum()])


def flown_log(reward: torch.Tensor, spread: torch.Tensor, ended: torch.Tensor) -> dict[str, float]:
    """Return what to log of the steps of an iteration; `ended` is the sum of their `count_ended`."""
    log = {"reward": float(reward.mean()), "spread": float(spread.mean())}
    return log | shares(ended)


def shares(ended: torch.Tensor) -> dict[str, float]:
    """Return the shares of success and of crashes, of the sum of `count_ended`; nothing if none has ended."""
    episodes, successes, crashes = ended.tolist()
    return {"success": successes / episodes, "crash": crashes / episodes} if episodes else {}


def minibatches(
    count: int, size: int, config: PpoConfig, generator: torch.Generator
) -> Iterator[torch.Tensor]:
    """Yield the numbers of the rows of each minibatch of all epochs, drawn from so many, `size` at a time."""
    for _ in range(config.epochs):
        order = torch.randperm(count, generator=generator, device=generator.device)
        yield from order.split(size)[: config.minibatches]


def add_advantages(batch: dict[str, torch.Tensor], later: torch.Tensor, config: PpoConfig) -> None:
    """Add `return` and `advantage` (of mean 0 and variance 1) to a batch of steps, [T, N].

    `batch`: `reward`, `value`, `done`. `later`: value of what is seen after the last step, [N].
    """
    value, following = batch["value"], torch.zeros_like(later)
    advantages = torch.empty_like(value)
    for step in reversed(range(len(value))):
        go_on = 1.0 - batch["done"][step]
        delta = batch["reward"][step] + config.discount * go_on * later - value[step]
        following = delta + config.discount * config.trace * go_on * following
        advantages[step], later = following, value[step]
    batch["return"] = advantages + value
    batch["advantage"] = (advantages - advantages.mean()) / (advantages.std() + 1e-8)


def ppo_loss(
    critic: Critic, mean: torch.Tensor, part: dict[str, torch.Tensor], config: PpoConfig
) -> torch.Tensor:
    """Return the loss of steps: the clipped gain, the error of the value, and the entropy."""
    ratio = torch.exp(critic.log_probability(mean, part["action"]) - part["log_p"])
    gain = torch.minimum(
        ratio * part["advantage"],
        ratio.clamp(1.0 - config.clip, 1.0 + config.clip) * part["advantage"],
    ).mean()
    error = (critic.value(part["critic"]) - part["return"]).square().mean()
    return 0.5 * error - gain - config.entropy_weight * critic.entropy()
