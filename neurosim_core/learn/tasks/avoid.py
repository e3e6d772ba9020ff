"""avoid: fly through a hall full of pillars, fast, and touch none."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch

from neurosim_core.learn.episodes import Routes, StartConfig
from neurosim_core.learn.randomisation import Randomisation
from neurosim_core.learn.surfaces import LeakySurface
from neurosim_core.learn.task import MIRROR_ACTION, Observations, Task, View
from neurosim_core.learn.tasks.hall import hall_settings
from neurosim_core.registry import register
from neurosim_core.scene.config import SceneConfig

_HALL_M = (44.0, 14.0, 4.0)
_PILLARS = 46
_APART_M = 2.0
"""Least distance between the middles of two pillars: gaps are 0.8 m or more."""
_RANGES_M = (0.8, 1.6, 2.8, 4.5)
_BEARINGS_RAD = tuple(math.radians(angle) for angle in (-70, -45, -25, -10, 0, 10, 25, 45, 70))
_FAR_M = 2.0
"""Obstacles that are farther than this from a point leave it free."""
_NEAR_M = 0.9
"""Distances to the scene below this cost something."""
_SHARE = 0.75
"""Of the speed that is asked for, in the mean and towards the goal, to succeed."""


@register("task", "avoid")
class Avoid(Task):
    """Fly towards a goal at the speed of the start, past pillars that stand anywhere.

    The student sees event surfaces, and what an autopilot knows: velocity, gravity, body rates, where the
    goal is, and how fast to fly. Where pillars are it must see. The teacher sees the distance to the scene at
    points around the vehicle.
    """

    episode_s = 6.0
    start = StartConfig(clearance_m=0.8, speed_m_s=(2.0, 6.0), aimed=True)
    randomisation = Randomisation(thrust_factor=(0.98, 1.02))
    training: Randomisation | None = Randomisation(thrust_factor=(0.98, 1.02), threshold_factor=(0.7, 2.0))
    rate_max_rad_s = (4.0, 4.0, 2.0)
    thrust_span = 0.8
    camera: Mapping[str, Any] = {"width": 48, "height": 48, "horizontal_fov_rad": 1.6}
    mount: Mapping[str, Any] = {"position_m": (0.1, 0.0, 0.03), "rpy_rad": (0.0, -0.2, 0.0)}
    surface = LeakySurface(tau_s=(0.02, 0.06, 0.3))
    probes = tuple((r * math.cos(b), r * math.sin(b), 0.0) for r in _RANGES_M for b in _BEARINGS_RAD)
    teacher: Mapping[str, Any] = {"worlds": 2048, "iterations": 500, "reward_scale": 0.1, "divergence": 0.016}
    student: Mapping[str, Any] = {"iterations": 200, "disturbance": 0.1}
    hint = "room"
    mirror: Mapping[str, Sequence[float]] = {
        "proprioception": (
            *(1.0, -1.0, 1.0),
            *(1.0, -1.0, 1.0),
            *(-1.0, 1.0, -1.0),
            *(1.0, -1.0, 1.0),
            1.0,
            *MIRROR_ACTION,
        ),
        "room": (1.0,) * 10 + (-1.0,) * 8,
    }

    def scenes(self, *, unseen: bool) -> list[dict[str, Any]]:
        """Return settings of 36 halls to train in, or of four others."""
        return [_hall(seed) for seed in (range(100, 104) if unseen else range(36))]

    def routes(self, scene: SceneConfig) -> Routes | None:
        """Return ways along the hall, from one end to the other."""
        size = getattr(scene, "size_m", _HALL_M)
        y, z = (
            grid.reshape(-1) for grid in np.meshgrid(np.linspace(-4.5, 4.5, 64), np.linspace(1.2, 2.2, 8))
        )
        end = np.full(len(y), 0.5 * size[0] - 1.5)
        return np.stack([-end, y, z], axis=1), np.stack([end, y, z], axis=1)

    def begin(self, view: View, mask: torch.Tensor) -> None:
        """Note how fast to fly, and how far the goal is."""
        speed, distance = view.velocity.norm(dim=1), view.goal_B.norm(dim=1)
        if not hasattr(self, "_speed"):
            self._speed, self._distance = speed.clone(), distance.clone()
        torch.where(mask, speed, self._speed, out=self._speed)
        torch.where(mask, distance, self._distance, out=self._distance)

    def observe(self, view: View) -> Observations:
        """Return state (57), proprioception (17) and room (18)."""
        goal = view.goal_B / view.goal_B.norm(dim=1, keepdim=True).clamp(min=1e-3)
        known = [0.3 * view.velocity_B, goal, 0.25 * self._speed[:, None], view.action]
        room = (view.probes.clamp(max=_FAR_M) / _FAR_M).unflatten(1, (len(_RANGES_M), -1))
        even, odd = (0.5 * (room + sign * room.flip(2))[:, 1:3] for sign in (1.0, -1.0))
        return {
            "state": torch.cat(
                [view.gravity_B, 0.3 * view.body_rate, *known, view.last_action, room.flatten(1)], dim=1
            ),
            "proprioception": torch.cat(
                [known[0], view.gravity_measured, 0.3 * view.gyro, *known[1:]], dim=1
            ),
            "room": torch.cat([even[:, :, :5].flatten(1), odd[:, :, :4].flatten(1)], dim=1),
        }

    def reward(self, view: View) -> torch.Tensor:
        """Pay for the speed towards the goal, up to what is asked; nearness to pillars costs something."""
        goal = view.goal_B / view.goal_B.norm(dim=1, keepdim=True).clamp(min=1e-3)
        ahead = (view.velocity_B * goal).sum(1) / self._speed
        excess = (view.velocity.norm(dim=1) / self._speed - 1.0).clamp(min=0.0)
        near = (_NEAR_M - view.clearance[:, 0]).clamp(min=0.0)
        above = (view.goal_B * view.gravity_B).sum(1)
        change = (view.action - view.last_action).norm(dim=1)
        cost = excess + 2.0 * near + goal[:, 1].square() + 0.3 * above.abs()
        cost = cost + 0.05 * view.body_rate.norm(dim=1) + 0.1 * change
        return 0.2 + ahead.clamp(-1.0, 1.0) - cost - 20.0 * view.crashed

    def metrics(self, view: View) -> dict[str, torch.Tensor]:
        """Return success (no crash, and on towards the goal), crash, and the mean speed towards it [m/s]."""
        mean = (self._distance - view.goal_B.norm(dim=1)) / view.elapsed_s.clamp(min=view.step_s)
        return {
            "success": (~view.crashed & (mean >= _SHARE * self._speed)).float(),
            "crash": view.crashed.float(),
            "speed_m_s": mean,
        }


def _hall(seed: int) -> dict[str, Any]:
    """Return settings of a hall with pillars, from floor to ceiling, as far as they find room."""
    rng, places = np.random.default_rng(seed), np.empty((0, 2))
    boxes: list[tuple[float, ...]] = []
    while len(boxes) < _PILLARS:
        place = rng.uniform((-16.0, -6.2), (19.0, 6.2))
        if len(places) and np.hypot(*(places - place).T).min() < _APART_M:
            continue
        places = np.concatenate([places, place[None]])
        width, depth = rng.uniform(0.4, 0.85, 2)
        boxes.append((*place, 0.5 * _HALL_M[2], width, depth, _HALL_M[2], rng.uniform(0.0, math.pi)))
    return hall_settings(_HALL_M, boxes, seed=seed, inside_m=(-20.0, 0.0, 1.5))
