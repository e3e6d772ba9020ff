"""hover, hover-paper, throw-recover: come to rest from a throw of unknown velocity, and stay."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch

from neurosim_core.learn.episodes import StartConfig
from neurosim_core.learn.randomisation import NO_RANDOMISATION, Randomisation
from neurosim_core.learn.surfaces import LeakySurface
from neurosim_core.learn.task import MIRROR_ACTION, Observations, Task, View
from neurosim_core.learn.tasks.hall import hall_settings
from neurosim_core.registry import register

SPEED_MAX_M_S = 0.2
"""Slower than this is a hover [m/s]."""
HOLD_S = 2.0
"""For how long, to succeed [s]."""
_HALL_M = (16.0, 16.0, 9.0)
_BOXES = 24


class HoverBase(Task):
    """Come to rest, and stay: what is seen, and when it has succeeded. Start and reward are those of a task.

    The student sees event surfaces, a gyroscope, the direction of gravity and its last action: neither
    position nor velocity. The teacher and the critic see the velocity.
    """

    episode_s = 5.0
    randomisation = Randomisation(thrust_factor=(0.98, 1.02))
    camera: Mapping[str, Any] = {"width": 48, "height": 48, "horizontal_fov_rad": 1.6}
    surface = LeakySurface(tau_s=(0.02, 0.06, 0.3))
    mirror: Mapping[str, Sequence[float]] = {
        "proprioception": (1.0, -1.0, 1.0, -1.0, 1.0, -1.0, *MIRROR_ACTION),
        "velocity": (1.0, -1.0, 1.0),
    }

    def scenes(self, *, unseen: bool) -> list[dict[str, Any]]:
        """Return settings of sixteen apartments of all sorts to train in, or of four others of one room."""
        if unseen:
            return [{"kind": "apartment", "rooms": 1, "seed": seed} for seed in range(100, 104)]
        sorts = [(1, 1.0), (1, 0.5), (1, 0.0), (3, 0.5)]
        return [
            {"kind": "apartment", "rooms": rooms, "furniture": furniture, "ceiling_m": ceiling, "seed": seed}
            for seed, ((rooms, furniture), ceiling) in enumerate(
                itertools.product(sorts, (2.5, 2.7, 3.1, 3.7))
            )
        ]

    def begin(self, view: View, mask: torch.Tensor) -> None:
        """Forget how long vehicles have hovered."""
        if not hasattr(self, "_held_s"):
            self._held_s = torch.zeros_like(view.elapsed_s)
            self._best_s = torch.zeros_like(view.elapsed_s)
        self._held_s.masked_fill_(mask, 0.0)
        self._best_s.masked_fill_(mask, 0.0)

    def advance(self, view: View) -> None:
        """Count for how long each vehicle has hovered."""
        slow = view.velocity.norm(dim=1) < SPEED_MAX_M_S
        self._held_s.add_(view.step_s).masked_fill_(~slow | view.crashed, 0.0)
        self._best_s = torch.maximum(self._best_s, self._held_s)

    def observe(self, view: View) -> Observations:
        """Return state (17), proprioception (10) and velocity (3)."""
        return {
            "state": torch.cat(
                [
                    view.velocity_B,
                    view.gravity_B,
                    0.3 * view.body_rate,
                    view.action,
                    view.last_action,
                ],
                dim=1,
            ),
            "proprioception": torch.cat([view.gravity_measured, 0.3 * view.gyro, view.action], dim=1),
            "velocity": view.velocity_B,
        }

    def metrics(self, view: View) -> dict[str, torch.Tensor]:
        """Return success (hovered for 2 s, and never crashed), crash, and the final speed [m/s]."""
        return {
            "success": ((self._best_s >= HOLD_S - 1e-6) & ~view.crashed).float(),
            "crash": view.crashed.float(),
            "speed_m_s": view.velocity.norm(dim=1),
        }


@register("task", "hover")
class Hover(HoverBase):
    """Stop and hover, after a throw that drag does not stop in time."""

    rate_on_cpu_hz: float | None = 25.0
    start = StartConfig(clearance_m=0.9, speed_m_s=(0.6, 1.4), tilt_max_rad=0.15, rate_max_rad_s=0.2)
    training: Randomisation | None = Randomisation(thrust_factor=(0.98, 1.02), threshold_factor=(0.7, 3.0))
    rate_max_rad_s = (2.0, 2.0, 1.0)
    thrust_span = 0.4

    def reward(self, view: View) -> torch.Tensor:
        """Pay for slowness; tilt, rates and changes of the action cost something.

        Gently, as who imitates the policy has to see its velocity first, and to stop at once is to overreact.
        """
        speed = view.velocity.norm(dim=1)
        tilt = view.gravity_B[:, :2].square().sum(1)
        change = (view.action - view.last_action).norm(dim=1)
        cost = 0.4 * speed + 5.0 * tilt + 0.2 * view.body_rate.norm(dim=1) + 0.3 * change
        return 0.5 + torch.exp(-((speed / 0.15) ** 2)) - cost - 20.0 * view.crashed


@register("task", "hover-paper")
class HoverPaper(HoverBase):
    """The task of the Neurosim paper (arXiv 2602.15018, supplement).

    Stop and hover, given event surfaces and the whole state: position, velocity, attitude and rates.

    Thrust spans 0 to twice the hover thrust; rates are 7, 7 and 5 rad/s; an episode lasts 15 s of 100 steps.
    """

    rate_hz = 100.0
    episode_s = 15.0
    start = StartConfig(clearance_m=0.7, speed_m_s=(0.0, 2.0), tilt_max_rad=0.2, rate_max_rad_s=0.5)
    randomisation = NO_RANDOMISATION
    camera: Mapping[str, Any] = {"width": 32, "height": 32, "horizontal_fov_rad": 1.6}
    surface = LeakySurface(tau_s=(0.01,))
    rate_max_rad_s = (7.0, 7.0, 5.0)
    thrust_span = 1.0
    groups: Mapping[str, Sequence[str]] = {
        "actor": ("state", "events"),
        "critic": ("state", "events"),
        "teacher": ("state",),
        "student": ("state", "events"),
    }

    def observe(self, view: View) -> Observations:
        """Return state (13: position, velocity, orientation, body rate)."""
        parts = [view.position, view.velocity, view.orientation, view.body_rate]
        return {"state": torch.cat(parts, dim=1)}

    def reward(self, view: View) -> torch.Tensor:
        """Return -2 |v| - 0.05 |w| - 0.01 |change of the action| + 0.5, and -500 at a crash."""
        speed, rate = view.velocity.norm(dim=1), view.body_rate.norm(dim=1)
        change = (view.action - view.last_action).norm(dim=1)
        return 0.5 - 2.0 * speed - 0.05 * rate - 0.01 * change - 500.0 * view.crashed


@register("task", "throw-recover")
class ThrowRecover(HoverBase):
    """Right itself, stop and hover, after it was thrown any way up.

    What is seen, and when it has succeeded, is as in `hover`. It takes height to turn over: halls are high.
    """

    start = StartConfig(clearance_m=3.0, speed_m_s=(0.0, 3.0), tilt_max_rad=math.pi, rate_max_rad_s=6.0)
    training: Randomisation | None = Randomisation(thrust_factor=(0.98, 1.02), threshold_factor=(0.7, 2.0))
    rate_max_rad_s = (8.0, 8.0, 3.0)
    thrust_span = 1.0
    teacher: Mapping[str, Any] = {"worlds": 1024, "iterations": 150, "reward_scale": 0.1}
    student: Mapping[str, Any] = {"iterations": 164, "disturbance": 0.1}

    def scenes(self, *, unseen: bool) -> list[dict[str, Any]]:
        """Return settings of eight halls to train in, or of four others."""
        return [_hall(seed) for seed in (range(100, 104) if unseen else range(8))]

    def reward(self, view: View) -> torch.Tensor:
        """Pay for slowness; to be any way but upright, to turn and to change the action cost something."""
        speed = view.velocity.norm(dim=1)
        lean = 1.0 + view.gravity_B[:, 2]  # 0: upright, 2: upside down
        change = (view.action - view.last_action).norm(dim=1)
        cost = 0.3 * speed + lean + 0.1 * view.body_rate.norm(dim=1) + 0.1 * change
        return 0.5 + torch.exp(-((speed / 0.3) ** 2)) - cost - 20.0 * view.crashed


def _hall(seed: int) -> dict[str, Any]:
    """Return settings of a high hall with boxes along its walls."""
    rng = np.random.default_rng(seed)
    boxes = []
    for _ in range(_BOXES):
        angle = rng.uniform(-math.pi, math.pi)
        width, depth, height = rng.uniform((0.5, 0.5, 0.5), (1.5, 1.5, 4.0))
        x, y = rng.uniform(5.5, 7.5) * np.array([math.cos(angle), math.sin(angle)])
        boxes.append((x, y, 0.5 * height, width, depth, height, rng.uniform(0.0, math.pi)))
    return hall_settings(_HALL_M, boxes, seed=seed, inside_m=(0.0, 0.0, 4.5))
