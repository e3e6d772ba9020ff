"""hover-paper: the task of the Neurosim paper (arXiv 2602.15018, supplement)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch

from neurosim_core.learn.episodes import StartConfig
from neurosim_core.learn.randomisation import NO_RANDOMISATION
from neurosim_core.learn.surfaces import LeakySurface
from neurosim_core.learn.task import Observations, View
from neurosim_core.learn.tasks.hover import HoverBase
from neurosim_core.registry import register


@register("task", "hover-paper")
class HoverPaper(HoverBase):
    """Stop and hover, given event surfaces and the whole state: position, velocity, attitude and rates.

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
