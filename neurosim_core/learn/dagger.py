"""Imitation of a teacher on the student's own flights (DAgger, Ross et al. 2011), with a memory."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch

from neurosim_core.learn.env import Env
from neurosim_core.learn.policies import EventPolicy
from neurosim_core.learn.task import MIRROR_ACTION

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
    hint_weight: float = 1.0
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
        self._make_mirrors()

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

    def _make_mirrors(self) -> None:
        """Let half of the worlds be seen in a mirror, if the task says how."""
        env, signs = self.env, self.env.task.mirror
        vectors = [name for name in env.obs_groups["student"] if name != "events"]
        known = all(name in signs for name in (*vectors, *(["velocity"] if "velocity" in self._now else [])))
        self._mirrored = torch.zeros(env.num_envs, dtype=torch.bool, device=env.device)
        self._mirrored[: env.num_envs // 2] = known

        def rows(values: Sequence[float]) -> torch.Tensor:
            sign = torch.tensor(values, device=env.device)
            return torch.where(self._mirrored[:, None], sign, torch.ones_like(sign))

        self._vector_sign = rows([sign for name in vectors for sign in signs[name]] if known else [1.0])
        self._action_sign = rows(MIRROR_ACTION)
        self._hint_sign = rows(signs["velocity"] if known and "velocity" in signs else [1.0])

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
            surface = now["events"]
            surface = torch.where(self._mirrored[:, None, None, None], surface.flip(-1), surface)
            batch["surface"][step] = surface
            batch["begun"][step] = self._begun
            vector = env.group(now, "student") * self._vector_sign
            label = self.teacher(env.group(now, "teacher")).clamp(-1.0, 1.0) * self._action_sign
            rows["vector"].append(vector)
            rows["label"].append(label)
            if "velocity" in now:
                rows["hint"].append(now["velocity"] * self._hint_sign)
            memory = self._memory * (1.0 - self._begun)[:, None]
            action, self._memory = self.policy(surface, vector, memory)
            action = torch.where(led, label, action) * self._action_sign
            self._now, _, terminated, truncated, info = env.step(action)
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
