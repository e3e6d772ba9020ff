"""Networks: an actor and a critic for states, and a student with a memory for events."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

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


class ActorCritic(nn.Module):
    """A policy and its value from vectors, for PPO.

    Args:
        actor_size: Numbers that the actor sees.
        critic_size: Numbers that the critic sees.
        action_count: Numbers in an action.
        hidden: Widths of the hidden layers.
        spread: Standard deviation of actions at first.
    """

    def __init__(
        self,
        actor_size: int,
        critic_size: int,
        action_count: int = 4,
        *,
        hidden: Sequence[int] = (64, 64),
        spread: float = 0.4,
    ) -> None:
        super().__init__()
        self.actor = _perceptron([actor_size, *hidden, action_count])
        self.critic = _perceptron([critic_size, *hidden, 1])
        self.log_spread = nn.Parameter(torch.full((action_count,), math.log(spread)))

    def forward(self, seen: torch.Tensor) -> torch.Tensor:
        """Return the mean action, in [-1, 1] but for what the simulator clamps."""
        mean: torch.Tensor = self.actor(seen)
        return mean

    def value(self, seen: torch.Tensor) -> torch.Tensor:
        """Return what is expected to be rewarded from here on, [N]."""
        value: torch.Tensor = self.critic(seen).squeeze(-1)
        return value

    def log_probability(self, mean: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        """Return the logarithm of the density of actions, [N]."""
        scaled = (action - mean) * torch.exp(-self.log_spread)
        return (-0.5 * scaled.square() - self.log_spread - 0.5 * math.log(2.0 * math.pi)).sum(-1)

    def entropy(self) -> torch.Tensor:
        """Return the entropy of an action."""
        return (self.log_spread + 0.5 * (1.0 + math.log(2.0 * math.pi))).sum()


class EventPolicy(nn.Module):
    """A convolutional network on event surfaces, and a GRU over time.

    Args:
        channels: Of the surfaces.
        height: Of the surfaces [px].
        width: Of the surfaces [px].
        vector_size: Numbers seen besides.
        action_count: Numbers in an action.
        hint_count: Numbers that it learns to estimate besides, such as the velocity.
        memory_size: Numbers remembered from step to step.
    """

    def __init__(
        self,
        channels: int,
        height: int,
        width: int,
        vector_size: int,
        action_count: int = 4,
        hint_count: int = 3,
        memory_size: int = 128,
    ) -> None:
        super().__init__()
        self.shape = {
            "channels": channels,
            "height": height,
            "width": width,
            "vector_size": vector_size,
            "action_count": action_count,
            "hint_count": hint_count,
            "memory_size": memory_size,
        }
        self.memory_size, self.action_count = memory_size, action_count
        convolutions: list[nn.Module] = []
        rows, columns, inputs = height, width, channels
        for outputs in (16, 32, 48):
            convolutions += [nn.Conv2d(inputs, outputs, 3, stride=2, padding=1), nn.ELU()]
            rows, columns, inputs = -(-rows // 2), -(-columns // 2), outputs
        self.eyes = nn.Sequential(
            *convolutions, nn.Flatten(), nn.Linear(inputs * rows * columns, 64), nn.ELU()
        )
        self.memory = nn.GRUCell(64 + vector_size, memory_size)
        self.head = nn.Linear(memory_size, action_count + hint_count)

    def see(self, surfaces: torch.Tensor) -> torch.Tensor:
        """Return features of surfaces, [n, 64]."""
        features: torch.Tensor = self.eyes(torch.log1p(surfaces))
        return features

    def forward(
        self, surfaces: torch.Tensor, vector: torch.Tensor, memory: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return actions in [-1, 1], [N, 4], and the memory for the next step, [N, memory_size]."""
        memory = self.memory(torch.cat([self.see(surfaces), vector], dim=1), memory)
        return torch.clamp(self.head(memory)[:, : self.action_count], -1.0, 1.0), memory

    def unroll(
        self, surfaces: torch.Tensor, vectors: torch.Tensor, begun: torch.Tensor, memory: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return actions (not clamped) and hints of a stretch of steps.

        Args:
            surfaces: [T, N, C, H, W].
            vectors: [T, N, n].
            begun: An episode begins with this step: the memory is empty, float32, [T, N].
            memory: Before the first, [N, memory_size].
        """
        features = self.see(surfaces.flatten(0, 1)).unflatten(0, surfaces.shape[:2])
        inputs = torch.cat([features, vectors], dim=2)
        remembered = []
        for step, keep in enumerate(1.0 - begun):
            memory = self.memory(inputs[step], memory * keep[:, None])
            remembered.append(memory)
        out = self.head(torch.stack(remembered))
        return out[..., : self.action_count], out[..., self.action_count :]
