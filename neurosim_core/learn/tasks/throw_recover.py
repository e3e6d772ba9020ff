"""throw-recover: come to rest from a throw with any attitude, spinning."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from neurosim_core.learn.episodes import StartConfig
from neurosim_core.learn.randomisation import Randomisation
from neurosim_core.learn.task import View
from neurosim_core.learn.tasks.hall import hall_settings
from neurosim_core.learn.tasks.hover import HoverBase
from neurosim_core.registry import register

_HALL_M = (16.0, 16.0, 9.0)
_BOXES = 24


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
