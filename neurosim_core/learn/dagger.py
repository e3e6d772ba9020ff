"""Imitation of a teacher on the student's own flights (DAgger, Ross et al. 2011), with a memory."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import torch

from neurosim_core.learn.descent import Descent, GraphedFunction
from neurosim_core.learn.env import Env
from neurosim_core.learn.policies import make_event_policy
from neurosim_core.learn.ppo import count_ended, shares
from neurosim_core.learn.task import MIRROR_ACTION

Teacher = Callable[[torch.Tensor], torch.Tensor]
"""Returns actions for the observations of the group `teacher`."""


@dataclass(frozen=True, kw_only=True)
class DaggerConfig:
    """Training of a student that imitates a teacher (DAgger)."""

    worlds: int = 96
    iterations: int = 130
    horizon: int = 40
    """Steps of each world in an iteration, and of backpropagation through time."""
    replay: int = 3
    """Number of iterations to learn from: the present one and those before."""
    updates: int = 6
    """Gradient steps in an iteration."""
    batch: int = 48
    """Sequences (`horizon` steps of a world) in a gradient step."""
    learning_rate: float = 1.5e-3
    """Initial learning rate; it falls to zero along a cosine."""
    lead: float = 0.3
    """Share of the training in which the teacher flies less and less often."""
    lead_last: float = 0.2
    """Share of the worlds that the teacher flies after that."""
    disturbance: float = 0.2
    """Noise on the teacher's actions where it flies, so that it shows how to recover: mean over the worlds of
    the standard deviation, which is between 0 and twice as much."""
    disturbance_s: float = 0.25
    """Correlation time of this noise [s]."""
    hint_weight: float = 2.0
    """Weight of the error of the estimated velocity, relative to that of the action."""
    gradient_max: float = 1.0
    hidden: int = 128
    """Width of the student's GRU."""
    widths: tuple[int, ...] = (32, 48, 48, 48, 48)
    """Channels of its convolutions."""


class Dagger:
    """Trains a student in an environment, iteration by iteration.

    `env`: the student sees its group `student`, of which `events` are pictures; the teacher `teacher`.
    `Task.hint` is estimated besides. `generator`: of all random numbers, on the device of the environment.
    """

    def __init__(self, env: Env, teacher: Teacher, config: DaggerConfig, generator: torch.Generator) -> None:
        self.env, self.teacher, self.config = env, teacher, config
        self._generator = generator
        self._now, _ = env.reset()
        vector = env.group(self._now, "student")
        hint = env.hint(self._now)
        self.policy = make_event_policy(
            self._now["events"], vector, hint, hidden=config.hidden, widths=config.widths
        )
        self._actor = self.policy
        self._learner: ThreadPoolExecutor | None = None
        if env.device.type == "cpu":  # it learns on one core while worlds are rendered on the others
            if config.replay < 2:
                raise ValueError("replay must be 2 at least on a CPU: one iteration is flown meanwhile")
            self._actor = copy.deepcopy(self.policy)
            self._learner = ThreadPoolExecutor(1, thread_name_prefix="learner")
        self.descent = Descent(self.policy, self._loss, gradient_max=config.gradient_max)
        self._memory = torch.zeros((env.num_envs, self.policy.memory_size), device=env.device)
        self._begun = torch.ones(env.num_envs, device=env.device)
        self._pushed = torch.zeros((env.num_envs, 4), device=env.device)
        self._make_mirrors()
        self._make_replay(vector.shape[1], hint.shape[1])

    def begin(self, seed: int) -> None:
        """Begin anew in all worlds, at different times of their episodes, with nothing to learn from."""
        self._now, _ = self.env.reset(seed=seed, spread=True)
        self._memory.zero_()
        self._pushed.zero_()
        self._begun.fill_(1.0)
        self._flown = 0

    def iterate(self, done: float) -> dict[str, float]:
        """Fly some steps and learn from them; on a CPU learn meanwhile, from those before if there are any.

        `done`: share of the training that lies behind. Returns what to log.
        """
        config = self.config
        rate = config.learning_rate * 0.5 * (1.0 + math.cos(math.pi * min(done, 1.0)))
        lead = 1.0 - (1.0 - config.lead_last) * min(done / max(config.lead, 1e-9), 1.0)
        lead = max(lead, 1e-9)
        if self._actor is not self.policy:
            self._actor.load_state_dict(self.policy.state_dict())
        if self._learner is None or self._flown == 0:
            with torch.no_grad():
                log = self._fly(lead=lead)
            return log | self._learn(rate, self._draw_stretches(config.replay))
        learning = self._learner.submit(self._learn, rate, self._draw_stretches(config.replay - 1))
        with torch.no_grad():
            log = self._fly(lead=lead)
        return log | learning.result()

    def _make_mirrors(self) -> None:
        """Let half of the worlds be seen in a mirror, if the task says how."""
        env, signs = self.env, self.env.task.mirror
        vectors = [name for name in env.obs_groups["student"] if name != "events"]
        known = all(name in signs for name in (*vectors, env.task.hint))
        self._mirrored = torch.zeros(env.num_envs, dtype=torch.bool, device=env.device)
        self._mirrored[: env.num_envs // 2] = known

        def rows(values: Sequence[float]) -> torch.Tensor:
            sign = torch.tensor(values, device=env.device)
            return torch.where(self._mirrored[:, None], sign, torch.ones_like(sign))

        self._vector_sign = rows([sign for name in vectors for sign in signs[name]] if known else [1.0])
        self._action_sign = rows(MIRROR_ACTION)
        self._hint_sign = rows(signs[env.task.hint] if known else [1.0])

    def _make_replay(self, vector_size: int, hint_count: int) -> None:
        """Make room for stretches of flight: [iteration, world, step, ...]; surfaces in half precision."""
        config, env = self.config, self.env
        stretches, steps = (config.replay, env.num_envs), (config.horizon,)
        sizes = {"vector": vector_size, "label": 4, "hint": hint_count}
        self._kept = {
            name: torch.zeros((*stretches, *steps, n), device=env.device) for name, n in sizes.items()
        }
        self._kept["begun"] = torch.zeros((*stretches, *steps), device=env.device)
        self._kept["memory"] = torch.zeros((*stretches, self.policy.memory_size), device=env.device)
        self._kept["surface"] = torch.zeros(
            (*stretches, *steps, *self._now["events"].shape[1:]), dtype=torch.float16, device=env.device
        )
        self._seen = {n: torch.zeros_like(v[0, :, 0]) for n, v in self._kept.items() if n != "memory"}
        self._told = torch.zeros_like(env.group(self._now, "teacher"))
        self._action = torch.zeros((env.num_envs, 4), device=env.device)
        self._act = GraphedFunction(self._decide, on_cuda=env.device.type == "cuda")
        self._rows = torch.zeros(config.batch, dtype=torch.int64, device=env.device)
        self._losses = torch.zeros(2, device=env.device)
        self._flown = 0

    def _fly(self, *, lead: float) -> dict[str, float]:
        """Fly the horizon, and keep it; in a share `lead` of the worlds a disturbed teacher acts."""
        env, config = self.env, self.config
        kept = {name: value[self._flown % config.replay] for name, value in self._kept.items()}
        kept["memory"].copy_(self._memory)
        ended = torch.zeros(3, device=env.device)
        draw = torch.rand(env.num_envs, generator=self._generator, device=env.device)
        led = (draw < lead)[:, None]
        push = 2.0 * config.disturbance * (draw / lead)[:, None]
        decay = math.exp(-1.0 / (env.task.rate_hz * config.disturbance_s))
        for step in range(config.horizon):
            seen = self._seen
            seen["begun"].copy_(self._begun)
            seen["vector"].copy_(env.group(self._now, "student"))
            seen["hint"].copy_(env.hint(self._now))
            self._told.copy_(env.group(self._now, "teacher"))
            self._act()
            for name, value in seen.items():
                kept[name][:, step] = value
            noise = torch.randn(self._action.shape, generator=self._generator, device=env.device)
            self._pushed.mul_(decay).add_(noise, alpha=math.sqrt(1.0 - decay**2))
            action = torch.where(led, seen["label"] + push * self._pushed, self._action) * self._action_sign
            self._now, _, terminated, truncated, info = env.step(action)
            self._begun = (terminated | truncated).float()
            ended += count_ended(self._begun * ~led[:, 0], info["metrics"])
        self._flown += 1
        return shares(ended)

    def _decide(self) -> None:
        """Let teacher and student act on what is in `_seen` and `_told`, half of them in a mirror."""
        seen, surface = self._seen, self._now["events"]
        seen["surface"].copy_(torch.where(self._mirrored[:, None, None, None], surface.flip(-1), surface))
        seen["vector"].mul_(self._vector_sign)
        seen["hint"].mul_(self._hint_sign)
        seen["label"].copy_(self.teacher(self._told).clamp(-1.0, 1.0) * self._action_sign)
        memory = self._memory * (1.0 - seen["begun"])[:, None]
        action, memory = self._actor(seen["surface"], seen["vector"], memory)
        self._action.copy_(action)
        self._memory.copy_(memory)

    def _draw_stretches(self, iterations: int) -> torch.Tensor:
        """Return numbers of stretches from so many of the last iterations, [updates, batch]."""
        config, worlds, device = self.config, self.env.num_envs, self.env.device
        count, shape = min(self._flown, iterations) * worlds, (config.updates, config.batch)
        back = torch.randint(count, shape, generator=self._generator, device=device)
        return (self._flown * worlds - 1 - back) % (config.replay * worlds)

    def _learn(self, rate: float, stretches: torch.Tensor) -> dict[str, float]:
        """Learn from stretches of flight."""
        config = self.config
        self._losses.zero_()
        for rows in stretches:
            self._rows.copy_(rows)
            self.descent.step(rate)
        imitation, hint = (self._losses / config.updates).tolist()
        return {"imitation error": imitation, f"{self.env.task.hint} error": hint}

    def _loss(self) -> torch.Tensor:
        """Return the loss of the stretches that `_rows` names; adds to `_losses`."""
        part = {name: value.flatten(0, 1).index_select(0, self._rows) for name, value in self._kept.items()}
        memory = part.pop("memory")
        part = {name: value.transpose(0, 1) for name, value in part.items()}
        action, hint = self.policy.unroll(part["surface"], part["vector"], part["begun"], memory)
        errors = (action - part["label"]).square().mean(), (hint - part["hint"]).square().mean()
        self._losses += torch.stack(errors).detach()
        return errors[0] + self.config.hint_weight * errors[1]
