"""dodge: hold a place, and get out of the way of spheres that are thrown at it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch

from neurosim_core.learn.episodes import Routes, StartConfig
from neurosim_core.learn.randomisation import Randomisation
from neurosim_core.learn.surfaces import LeakySurface
from neurosim_core.learn.task import MIRROR_ACTION, Observations, Task, View, turn
from neurosim_core.learn.tasks.hall import hall_settings
from neurosim_core.registry import register
from neurosim_core.scene.config import SceneConfig
from neurosim_core.trajectory.feasibility import GRAVITY_M_S2

_HALL_M = (26.0, 26.0, 6.0)
_SPHERES = 3
_RADIUS_M = 0.15
_CONTACT_M = 0.35
"""Distance of a sphere's middle from the vehicle's at which they touch."""
_FROM_M = 5.0
"""How far away spheres come out of the floor."""
_FLIGHT_S = (0.6, 0.9)
"""For how long they fly to the vehicle: at 6 to 8 m/s and more."""
_FIRST_S, _APART_S = 1.0, 1.3
"""When the first gets there, at the earliest, and how long after it the next."""
_BEARING_RAD = 0.5
"""How far to the side of ahead spheres come from."""
_AWAY_M = 1.0
"""Who is farther from its place than this in the end has fled."""


@register("task", "dodge")
class Dodge(Task):
    """Hover where the episode began, and be hit by none of three spheres.

    The student sees event surfaces, and what an autopilot knows: velocity, gravity, body rates and its place.
    The teacher is told where the sphere is that comes next, once it has left the floor.
    """

    episode_s = 5.0
    start = StartConfig(clearance_m=1.0, speed_m_s=(0.0, 0.3), tilt_max_rad=0.05)
    randomisation = Randomisation(thrust_factor=(0.98, 1.02))
    training: Randomisation | None = Randomisation(thrust_factor=(0.98, 1.02), threshold_factor=(0.7, 2.0))
    thrust_span = 0.8
    camera: Mapping[str, Any] = {"width": 48, "height": 48, "horizontal_fov_rad": 1.6}
    surface = LeakySurface(tau_s=(0.02, 0.06, 0.3))
    bodies: Mapping[str, Any] = {
        f"sphere_{index}": {
            "shape": {"kind": "sphere", "radius_m": _RADIUS_M},
            "surface": {"kind": "checker"},
        }
        for index in range(_SPHERES)
    }
    teacher: Mapping[str, Any] = {"worlds": 1024, "iterations": 200, "reward_scale": 0.1}
    student: Mapping[str, Any] = {"iterations": 123, "disturbance": 0.1}
    hint = "threat"
    mirror: Mapping[str, Sequence[float]] = {
        "proprioception": (*(1, -1, 1, 1, -1, 1), *MIRROR_ACTION, *(1, -1, 1, -1, 1, -1)),
        "threat": (1, -1, 1),
    }

    def scenes(self, *, unseen: bool) -> list[dict[str, Any]]:
        """Return settings of an empty hall to train in, or of another."""
        return [hall_settings(_HALL_M, (), seed=100 * unseen, inside_m=(0.0, 0.0, 2.0))]

    def routes(self, scene: SceneConfig) -> Routes | None:
        """Return places in the middle of the hall: who begins there is to stay there."""
        axis, height = np.linspace(-4.0, 4.0, 22), np.linspace(2.0, 3.0, 8)
        places = np.stack([each.reshape(-1) for each in np.meshgrid(axis, axis, height)], axis=1)
        return places, places

    def throw(
        self, position: torch.Tensor, orientation: torch.Tensor, draws: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Throw spheres from the floor ahead at the place of the vehicle, one after another."""
        side, flight, later = draws[:, : 3 * _SPHERES].double().unflatten(1, (3, _SPHERES)).unbind(1)
        x, y, z, w = orientation[:, :, None].unbind(1)
        heading = torch.atan2(2.0 * (x * y + w * z), 1.0 - 2.0 * (y * y + z * z))
        bearing = heading + _BEARING_RAD * (2.0 * side - 1.0)
        flight_s = _FLIGHT_S[0] + (_FLIGHT_S[1] - _FLIGHT_S[0]) * flight
        hit_s = _FIRST_S + 0.5 * later + _APART_S * torch.arange(_SPHERES, device=draws.device)
        ahead = torch.stack([bearing.cos(), bearing.sin(), 0.0 * bearing], dim=2)
        velocity = -_FROM_M / flight_s[..., None] * ahead  # when it gets there
        velocity[..., 2] = (position[:, 2:] + _RADIUS_M) / flight_s - 0.5 * GRAVITY_M_S2 * flight_s
        fallen = torch.zeros_like(velocity)
        fallen[..., 2] = -GRAVITY_M_S2 * hit_s
        return position[:, None] - hit_s[..., None] * (velocity - 0.5 * fallen), velocity - fallen

    def begin(self, view: View, mask: torch.Tensor) -> None:
        """Note where spheres are, and that none has hit."""
        now = view.bodies[..., :3] - view.position[:, None]
        if not hasattr(self, "_before"):
            self._hit, self._before = torch.zeros_like(mask), now
        self._hit.masked_fill_(mask, False)
        torch.where(mask[:, None, None], now, self._before, out=self._before)

    def advance(self, view: View) -> None:
        """Find out who was hit in the step: the least distance of straight ways."""
        now = view.bodies[..., :3] - view.position[:, None]
        way = now - self._before
        share = -(self._before * way).sum(2) / way.square().sum(2).clamp(min=1e-9)
        nearest = (self._before + share.clamp(0.0, 1.0)[..., None] * way).norm(dim=2)
        torch.any(nearest < _CONTACT_M, dim=1, out=self._hit)
        self._before.copy_(now)

    def observe(self, view: View) -> Observations:
        """Return state (26), proprioception (16) and threat (3)."""
        position, velocity = self._threat(view)
        known = [view.velocity_B, view.goal_B, view.action]
        told = [*known, view.gravity_B, 0.3 * view.body_rate, view.last_action]
        measured = [*known, view.gravity_measured, 0.3 * view.gyro]
        return {
            "state": torch.cat([*told, 0.3 * position, 0.1 * velocity], dim=1),
            "proprioception": torch.cat(measured, dim=1),
            "threat": 0.3 * position,
        }

    def reward(self, view: View) -> torch.Tensor:
        """Pay for being in its place; to be hit costs as much as a crash."""
        away = view.goal_B.norm(dim=1)
        change = (view.action - view.last_action).norm(dim=1)
        cost = 0.1 * view.velocity.norm(dim=1) + 0.1 * view.body_rate.norm(dim=1) + 0.1 * change
        return 0.5 + torch.exp(-away) - 0.2 * away - cost - 20.0 * (view.crashed | self._hit)

    def terminated(self, view: View) -> torch.Tensor:
        """Return who was hit."""
        return self._hit

    def metrics(self, view: View) -> dict[str, torch.Tensor]:
        """Return success (not hit, and still in its place), crash (into a sphere, too), hit, distance [m]."""
        away, crashed = view.goal_B.norm(dim=1), view.crashed | self._hit
        return {
            "success": (~crashed & (away < _AWAY_M)).float(),
            "crash": crashed.float(),
            "hit": self._hit.float(),
            "distance_m": away,
        }

    def _threat(self, view: View) -> tuple[torch.Tensor, torch.Tensor]:
        """Return where the nearest sphere is that comes closer above the floor, and its velocity; 0: none.

        Both are relative to the vehicle, in B [m, m/s], [N, 3].
        """
        position, velocity = view.bodies[..., :3] - view.position[:, None], view.bodies[..., 3:]
        velocity = velocity - view.velocity[:, None]
        comes = ((position * velocity).sum(2) < 0.0) & (view.bodies[..., 2] > 0.0)
        nearest = torch.where(comes, position.norm(dim=2), torch.inf).argmin(dim=1)
        ways = (each.take_along_dim(nearest[:, None, None], 1)[:, 0] for each in (position, velocity))
        first, second = (comes.any(1)[:, None] * turn(view.orientation, way, back=True) for way in ways)
        return first, second
