"""Networks: an actor and a critic for states, and a student with a memory for events."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import nn


def _perceptron(sizes: Sequence[int]) -> nn.Sequential:
    layers: list[nn.Module] = []
    for index, (inputs, outputs) in enumerate(itertools.pairwise(sizes)):
        linear = nn.Linear(inputs, outputs)
        last = index == len(sizes) - 2
        nn.init.orthogonal_(linear.weight, 0.01 if last else math.sqrt(2.0))
        nn.init.zeros_(linear.bias)
        layers += [linear] if last else [linear, nn.Tanh()]
    return nn.Sequential(*layers)


class Critic(nn.Module):
    """The outputs that PPO needs besides the mean of actions: their spread, and the value of observations."""

    def __init__(
        self,
        critic_size: int,
        action_count: int = 4,
        *,
        hidden: Sequence[int] = (64, 64),
        spread: float = 0.4,
    ) -> None:
        super().__init__()
        self.critic = _perceptron([critic_size, *hidden, 1])
        self.log_spread = nn.Parameter(torch.full((action_count,), math.log(spread)))

    def value(self, seen: torch.Tensor) -> torch.Tensor:
        """Return what is expected to be rewarded from here on, [...]."""
        value: torch.Tensor = self.critic(seen).squeeze(-1)
        return value

    def log_probability(self, mean: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        """Return the logarithm of the density of actions, [...]."""
        scaled = (action - mean) * torch.exp(-self.log_spread)
        return (-0.5 * scaled.square() - self.log_spread - 0.5 * math.log(2.0 * math.pi)).sum(-1)

    def entropy(self) -> torch.Tensor:
        """Return the entropy of an action."""
        return (self.log_spread + 0.5 * (1.0 + math.log(2.0 * math.pi))).sum()


class ActorCritic(Critic):
    """A policy and its value from vectors, for PPO."""

    def __init__(
        self, actor_size: int, critic_size: int, action_count: int = 4, *, hidden: Sequence[int] = (64, 64)
    ) -> None:
        super().__init__(critic_size, action_count, hidden=hidden)
        self.actor = _perceptron([actor_size, *hidden, action_count])

    def forward(self, seen: torch.Tensor) -> torch.Tensor:
        """Return the mean action, in [-1, 1] but for what the simulator clamps."""
        mean: torch.Tensor = self.actor(seen)
        return mean


class EventPolicy(nn.Module):
    """A convolutional network on event surfaces, a GRU over time, and an estimate that is integrated.

    The estimate (such as of the velocity) is part of the memory, and the network gives its change in each
    step: a vehicle that does not see much goes on from what it saw, by dead reckoning. `height`: of the
    surfaces [px]. `width`: of the surfaces [px]. `hint_count`: Numbers that it estimates, at least 1.
    `widths`: channels of the convolutions, of which as many are used as halve the picture to 4x4.
    """

    def __init__(
        self,
        channels: int,
        height: int,
        width: int,
        vector_size: int,
        action_count: int = 4,
        hint_count: int = 3,
        hidden: int = 128,
        widths: Sequence[int] = (32, 48, 48, 48, 48),
    ) -> None:
        super().__init__()
        self.shape: dict[str, Any] = {
            "channels": channels,
            "height": height,
            "width": width,
            "vector_size": vector_size,
            "action_count": action_count,
            "hint_count": hint_count,
            "hidden": hidden,
            "widths": tuple(widths),
        }
        self.memory_size, self.hidden = hidden + hint_count, hidden
        convolutions: list[nn.Module] = []
        rows, columns, inputs, size = height, width, channels, 5
        for outputs in widths:
            convolutions += [nn.Conv2d(inputs, outputs, size, stride=2, padding=size // 2), nn.ELU()]
            rows, columns, inputs, size = -(-rows // 2), -(-columns // 2), outputs, 3
            if max(rows, columns) <= 4:
                break
        self.eyes = nn.Sequential(
            *convolutions, nn.Flatten(), nn.Linear(inputs * rows * columns, 96), nn.ELU()
        )
        self.mix = nn.Sequential(nn.Linear(96 + vector_size, 96), nn.ELU())
        self.memory = nn.GRUCell(96 + hint_count, hidden)
        self.change = nn.Linear(hidden, hint_count)
        nn.init.orthogonal_(self.change.weight, 0.02)
        nn.init.zeros_(self.change.bias)
        self.head = nn.Sequential(
            nn.Linear(self.memory_size + vector_size, 64), nn.ELU(), nn.Linear(64, action_count)
        )

    def encode(self, surfaces: torch.Tensor, vector: torch.Tensor) -> torch.Tensor:
        """Return features of a step, [n, 96]; on CUDA bfloat16 does for surfaces in half precision."""
        seen = torch.log1p(surfaces.abs()) * surfaces.sign()  # voxel grids have both signs
        halved = seen.is_cuda and seen.dtype == torch.float16
        with torch.autocast("cuda", torch.bfloat16, enabled=halved, cache_enabled=False):
            seen = self.eyes(seen if halved else seen.float()).float()
        features: torch.Tensor = self.mix(torch.cat([seen, vector], dim=-1))
        return features

    def update_memory(self, features: torch.Tensor, memory: torch.Tensor) -> torch.Tensor:
        """Return the memory after a step, [N, memory_size]."""
        hidden, estimate = memory[:, : self.hidden], memory[:, self.hidden :]
        hidden = self.memory(torch.cat([features, estimate], dim=1), hidden)
        return torch.cat([hidden, estimate + 0.1 * self.change(hidden)], dim=1)

    def forward(
        self, surfaces: torch.Tensor, vector: torch.Tensor, memory: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return actions in [-1, 1], [N, 4], and the memory for the next step, [N, memory_size]."""
        mean, memory = self.act(surfaces, vector, memory)
        return torch.clamp(mean, -1.0, 1.0), memory

    def act(
        self, surfaces: torch.Tensor, vector: torch.Tensor, memory: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return actions (not clamped), and the memory for the next step."""
        memory = self.update_memory(self.encode(surfaces, vector), memory)
        return self.head(torch.cat([memory, vector], dim=1)), memory

    def unroll(
        self, surfaces: torch.Tensor, vectors: torch.Tensor, begun: torch.Tensor, memory: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return actions (not clamped) and estimates of a stretch of steps.

        `surfaces`: [T, N, C, H, W]. `vectors`: [T, N, n]. `begun`: an episode begins with this step: the
        memory is empty, float32, [T, N]. `memory`: before the first, [N, memory_size].
        """
        seen = self.encode(surfaces.flatten(0, 1), vectors.flatten(0, 1)).unflatten(0, surfaces.shape[:2])
        memories = []
        for features, keep in zip(seen, 1.0 - begun, strict=True):
            memory = self.update_memory(features, memory * keep[:, None])
            memories.append(memory)
        remembered = torch.stack(memories)
        return self.head(torch.cat([remembered, vectors], dim=2)), remembered[..., self.hidden :]


def make_event_policy(
    surface: torch.Tensor, vector: torch.Tensor, hint: torch.Tensor, *, hidden: int, widths: Sequence[int]
) -> EventPolicy:
    """Return a policy for what is seen in an environment, on its device.

    Args:
        surface: Event surfaces, [N, C, H, W].
        vector: What is seen besides, [N, n].
        hint: What is estimated, [N, h].
        hidden: See `EventPolicy`.
        widths: See `EventPolicy`.
    """
    _, channels, height, width = surface.shape
    policy = EventPolicy(
        channels, height, width, vector.shape[1], hint_count=hint.shape[1], hidden=hidden, widths=widths
    )
    policy.eyes.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    return policy.to(surface.device)
