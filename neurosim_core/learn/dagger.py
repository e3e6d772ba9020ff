"""Imitation of a teacher on the student's own flights (DAgger, Ross et al. 2011), with a memory."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch

from neurosim_core.learn.env import Env
from neurosim_core.learn.policies import EventPolicy

Teacher = Callable[[torch.Tensor], torch.Tensor]
"""Returns actions for the observations of the group `teacher`."""


@dataclass(frozen=True, kw_only=True)
class DaggerConfig:
    """How a student is trained."""

    worlds: int = 96
    iterations: int = 130
    horizon: int = 20
    """Steps of each world in an iteration, and how far back gradients go."""
    epochs: int = 2
    minibatches: int = 4
    learning_rate: float = 1.5e-3
    """At first; it falls to a twentieth."""
    lead: float = 0.2
    """Share of the training in which the teacher flies less and less often."""
    hint_weight: float = 0.5
    """Of the error of the estimated velocity, against that of the action."""
    gradient_max: float = 1.0


class Dagger:
    """Trains a student in an environment, iteration by iteration.

    Args:
        env: The student sees its group `student`, of which `events` are pictures; the teacher `teacher`.
            Observations named `velocity` are estimated besides.
        teacher: Who is imitated.
        config: How.
        generator: Of all random numbers, on the device of the environment.
    """

    def __init__(self, env: Env, teacher: Teacher, config: DaggerConfig, generator: torch.Generator) -> None:
        self.env, self.teacher, self.config = env, teacher, config
        self._generator = generator
        self._now, _ = env.reset()
        vector = env.group(self._now, "student")
        _, channels, height, width = self._now["events"].shape
        hints = self._now["velocity"].shape[1] if "velocity" in self._now else 0
        self.policy = EventPolicy(channels, height, width, vector.shape[1], hint_count=hints).to(env.device)
        self.optimizer = torch.optim.Adam(self.policy.parameters(), lr=config.learning_rate)
        self._memory = torch.zeros((env.num_envs, self.policy.memory_size), device=env.device)
        self._begun = torch.ones(env.num_envs, device=env.device)

    def begin(self, seed: int) -> None:
        """Begin anew in all worlds, at different times of their episodes."""
        self._now, _ = self.env.reset(seed=seed, spread=True)
        self._memory.zero_()
        self._begun.fill_(1.0)

    def iterate(self, done: float) -> dict[str, float]:
        """Fly some steps and learn from them.

        Args:
            done: Share of the training that lies behind.

        Returns:
            What to log.
        """
        for group in self.optimizer.param_groups:
            group["lr"] = self.config.learning_rate * (1.0 - 0.95 * done)
        memory = self._memory.clone()
        with torch.no_grad():
            batch, log = self._fly(lead=max(0.0, 1.0 - done / max(self.config.lead, 1e-9)))
        return log | self._learn(batch, memory)

    def state_dict(self) -> dict[str, Any]:
        """Return what training goes on from."""
        return {"policy": self.policy.state_dict(), "optimizer": self.optimizer.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from there."""
        self.policy.load_state_dict(state["policy"])
        self.optimizer.load_state_dict(state["optimizer"])

    def _fly(self, *, lead: float) -> tuple[dict[str, torch.Tensor], dict[str, float]]:
        """Fly the horizon; in a share `lead` of the worlds the teacher acts."""
        env, config = self.env, self.config
        shape = (config.horizon, env.num_envs)
        batch = {
            "surface": torch.empty((*shape, *self._now["events"].shape[1:]), device=env.device),
            "begun": torch.empty(shape, device=env.device),
        }
        rows: dict[str, list[torch.Tensor]] = {"vector": [], "label": [], "hint": []}
        ended = torch.zeros(3, device=env.device)
        draw = torch.rand(env.num_envs, generator=self._generator, device=env.device)
        led = (draw < lead)[:, None]
        for step in range(config.horizon):
            now = self._now
            batch["surface"][step] = now["events"]
            batch["begun"][step] = self._begun
            vector = env.group(now, "student")
            label = self.teacher(env.group(now, "teacher")).clamp(-1.0, 1.0)
            rows["vector"].append(vector)
            rows["label"].append(label)
            if "velocity" in now:
                rows["hint"].append(now["velocity"])
            memory = self._memory * (1.0 - self._begun)[:, None]
            action, self._memory = self.policy(now["events"], vector, memory)
            self._now, _, terminated, truncated, info = env.step(torch.where(led, label, action))
            self._begun = (terminated | truncated).float()
            counted = (info["metrics"][name] * self._begun for name in ("success", "crash"))
            ended += torch.stack([self._begun.sum(), *(each.sum() for each in counted)])
        batch |= {name: torch.stack(values) for name, values in rows.items() if values}
        episodes, successes, crashes = ended.tolist()
        log = {"success": successes / episodes, "crash": crashes / episodes} if episodes else {}
        return batch, log

    def _learn(self, batch: dict[str, torch.Tensor], memory: torch.Tensor) -> dict[str, float]:
        config, worlds = self.config, self.env.num_envs
        losses, misses = [], []
        for _ in range(config.epochs):
            order = torch.randperm(worlds, generator=self._generator, device=memory.device)
            for rows in order.chunk(config.minibatches):
                action, hint = self.policy.unroll(
                    batch["surface"][:, rows], batch["vector"][:, rows], batch["begun"][:, rows], memory[rows]
                )
                loss = (action - batch["label"][:, rows]).square().mean()
                losses.append(loss.detach())
                if "hint" in batch:
                    missed = (hint - batch["hint"][:, rows]).square().mean()
                    misses.append(missed.detach())
                    loss = loss + config.hint_weight * missed
                self.optimizer.zero_grad(set_to_none=True)
                loss.backward()
                torch.nn.utils.clip_grad_norm_(self.policy.parameters(), config.gradient_max)
                self.optimizer.step()
        log = {"imitation": float(torch.stack(losses).mean())}
        return log | ({"hint": float(torch.stack(misses).mean())} if misses else {})
