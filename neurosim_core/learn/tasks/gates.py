"""gates: race through the gates of a track that was never seen."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from neurosim_core.learn.episodes import Routes, StartConfig
from neurosim_core.learn.randomisation import Randomisation
from neurosim_core.learn.surfaces import TimeSurface
from neurosim_core.learn.task import MIRROR_ACTION, Observations, Task, View, turn
from neurosim_core.learn.tasks.hall import hall_settings
from neurosim_core.registry import register
from neurosim_core.scene.config import SceneConfig

_HALL_M = (46.0, 46.0, 6.0)
_GATES = 10
_OPENING_M = 2.0
_BAR_M = 0.3
_SPEED_M_S = 8.0
_SHARE = 0.85
"""Of that speed, in the mean, to succeed."""
_AHEAD_M = 5.0
"""How far before a gate episodes begin."""


@register("task", "gates")
class Gates(Task):
    """Fly a round track, either way, at 8 m/s; an episode ends at a gate that is missed.

    The student sees time surfaces of events, and what an autopilot knows: velocity, gravity and body rates.
    Where the gates are it must see. The teacher is told where the next two are.
    """

    episode_s = 5.0
    start = StartConfig(clearance_m=0.6, speed_m_s=(6.0, 8.0), aimed=True)
    randomisation = Randomisation(thrust_factor=(0.98, 1.02))
    training: Randomisation | None = Randomisation(thrust_factor=(0.98, 1.02), threshold_factor=(0.7, 2.0))
    rate_max_rad_s = (4.0, 4.0, 3.0)
    thrust_span = 0.9
    camera: Mapping[str, Any] = {"width": 48, "height": 48, "horizontal_fov_rad": 1.6}
    mount: Mapping[str, Any] = {"position_m": (0.1, 0.0, 0.03), "rpy_rad": (0.0, -0.3, 0.0)}
    surface = TimeSurface(tau_s=(0.01, 0.03, 0.1))
    teacher: Mapping[str, Any] = {"worlds": 512, "iterations": 250, "reward_scale": 0.1, "divergence": 0.016}
    student: Mapping[str, Any] = {"iterations": 120, "disturbance": 0.1, "hint_weight": 0.2}
    hint = "next_gate"
    mirror: Mapping[str, Sequence[float]] = {
        "proprioception": (1.0, -1.0, 1.0, 1.0, -1.0, 1.0, -1.0, 1.0, -1.0, *MIRROR_ACTION),
        "next_gate": (1.0, -1.0, 1.0),
    }

    def scenes(self, *, unseen: bool) -> list[dict[str, Any]]:
        """Return settings of forty tracks to train on, or of eight others."""
        return [_hall(seed) for seed in (range(100, 108) if unseen else range(40))]

    def routes(self, scene: SceneConfig) -> Routes | None:
        """Return ways to each gate from before it, along the track and against it."""
        gates, yaw = track(getattr(scene, "seed", 0))
        before = _AHEAD_M * np.stack([np.cos(yaw), np.sin(yaw), np.zeros(_GATES)], axis=1)
        return np.concatenate([gates - before, gates + before]), np.concatenate([gates, gates])

    def begin(self, view: View, mask: torch.Tensor) -> None:
        """Note which gate comes first, and in which direction the track is flown."""
        if not hasattr(self, "_index"):
            tracks = [track(getattr(scene, "seed", 0)) for scene in view.scenes]
            rows = [np.concatenate([gates, yaw[:, None]], axis=1) for gates, yaw in tracks]
            self._tracks = torch.tensor(np.array(rows), dtype=torch.float32, device=view.position.device)
            self._index, self._missed = torch.zeros_like(view.scene), torch.zeros_like(mask)
            self._way, self._passed, self._before, self._path_m = torch.zeros(
                (4, len(mask)), device=mask.device
            )
        goal = view.position + turn(view.orientation, view.goal_B)
        gates = self._tracks[view.scene]
        nearest = (gates[:, :, :3] - goal[:, None]).norm(dim=2).argmin(dim=1)
        torch.where(mask, nearest, self._index, out=self._index)
        yaw = self._tracks[view.scene, self._index, 3]
        along = view.velocity[:, 0] * torch.cos(yaw) + view.velocity[:, 1] * torch.sin(yaw)
        torch.where(mask, torch.sign(along), self._way, out=self._way)
        self._passed.masked_fill_(mask, 0.0)
        self._path_m.masked_fill_(mask, 0.0)
        self._missed.masked_fill_(mask, False)
        self._look(view)

    def advance(self, view: View) -> None:
        """Count the gates that were passed, and note who missed one."""
        before = self._before.clone()
        self._look(view)
        crossed = (self._before <= 0.0) & (before > 0.0)
        aside = self._offset - self._before[:, None] * self._normal
        inside = torch.maximum(aside[:, :2].norm(dim=1), aside[:, 2].abs()) < 0.5 * _OPENING_M
        self._now = crossed & inside & ~view.crashed
        self._missed.copy_((crossed & ~inside) | view.crashed)
        self._passed += self._now
        self._path_m += view.velocity.norm(dim=1) * view.step_s
        self._index.copy_((self._index + (self._now * self._way).long()) % _GATES)
        self._look(view)

    def observe(self, view: View) -> Observations:
        """Return state (30), proprioception (13) and next_gate (3)."""
        ways = (self._offset, self._normal, *self._gate(view, 1))
        gate, normal, after, later = (turn(view.orientation, way, back=True) for way in ways)
        speed = view.velocity_B / _SPEED_M_S
        vectors = [speed, view.gravity_B, 0.3 * view.body_rate, view.action, view.last_action]
        thrust = 2.0 * view.draws[:, -1:] - 1.0  # that factor of the episode which a student has to find out
        return {
            "state": torch.cat([*vectors, thrust, 0.2 * gate, normal, 0.1 * after, later], dim=1),
            "proprioception": torch.cat([speed, view.gravity_measured, 0.3 * view.gyro, view.action], dim=1),
            "next_gate": 0.2 * gate,
        }

    def reward(self, view: View) -> torch.Tensor:
        """Pay for the speed towards the next gate, up to 8 m/s, and for gates that are passed."""
        towards = self._offset / self._offset.norm(dim=1, keepdim=True).clamp(min=0.1)
        ahead = (view.velocity * towards).sum(1) / _SPEED_M_S
        excess = (view.velocity.norm(dim=1) / _SPEED_M_S - 1.0).clamp(min=0.0)
        aim = turn(view.orientation, towards, back=True)
        aside = self._offset - self._before[:, None] * self._normal
        change = (view.action - view.last_action).norm(dim=1)
        cost = 2.0 * excess + 0.5 * aim[:, 1].square() + 0.05 * view.body_rate.norm(dim=1) + 0.1 * change
        near = (0.6 - view.clearance[:, 0]).clamp(min=0.0)
        cost = cost + 0.2 * aside.norm(dim=1).clamp(max=2.0) + 4.0 * near
        return 0.2 + ahead.clamp(-1.0, 1.0) - cost + 2.0 * self._now - 20.0 * self._missed

    def terminated(self, view: View) -> torch.Tensor:
        """Return who missed a gate."""
        return self._missed

    def metrics(self, view: View) -> dict[str, torch.Tensor]:
        """Return success (no gate missed at speed), crash, gates passed and missed, and the mean speed [m/s].

        The share of gates is that of the means: passed / (passed + missed).
        """
        speed = self._path_m / view.elapsed_s.clamp(min=view.step_s)
        return {
            "success": (~self._missed & (speed >= _SHARE * _SPEED_M_S)).float(),
            "crash": view.crashed.float(),
            "passed": self._passed.clone(),
            "missed": self._missed.float(),
            "speed_m_s": speed,
        }

    def _gate(self, view: View, later: int) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the way to the next gate, or one later, and the direction through it, in W."""
        index = (self._index + (later * self._way).long()) % _GATES
        gate = self._tracks[view.scene, index]
        level = torch.stack([torch.cos(gate[:, 3]), torch.sin(gate[:, 3]), 0.0 * gate[:, 3]], dim=1)
        return gate[:, :3] - view.position, self._way[:, None] * level

    def _look(self, view: View) -> None:
        self._offset, self._normal = self._gate(view, 0)
        self._before.copy_((self._offset * self._normal).sum(1))


def track(seed: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the middles of the gates of a round track [m], [n, 3], and the yaw of the way through [rad]."""
    rng = np.random.default_rng(seed)
    angle = 2.0 * math.pi * (np.arange(_GATES) + rng.uniform(-0.2, 0.2, _GATES)) / _GATES
    radius = rng.uniform(14.0, 17.0, _GATES)
    gates = np.stack([radius * np.cos(angle), radius * np.sin(angle), rng.uniform(1.7, 3.3, _GATES)], axis=1)
    way = np.roll(gates, -1, axis=0) - np.roll(gates, 1, axis=0)
    return gates, np.arctan2(way[:, 1], way[:, 0])


def _hall(seed: int) -> dict[str, Any]:
    """Return settings of a hall with the gates of a track: four bars each."""
    boxes = []
    middle, long = 0.5 * (_OPENING_M + _BAR_M), _OPENING_M + 2.0 * _BAR_M
    for gate, yaw in zip(*track(seed), strict=True):
        left = np.array([-math.sin(yaw), math.cos(yaw), 0.0])
        for offset, size in (
            (middle * left, (0.15, _BAR_M, long)),
            (-middle * left, (0.15, _BAR_M, long)),
            ((0.0, 0.0, middle), (0.15, _OPENING_M, _BAR_M)),
            ((0.0, 0.0, -middle), (0.15, _OPENING_M, _BAR_M)),
        ):
            boxes.append((*(gate + offset), *size, yaw))
    return hall_settings(_HALL_M, boxes, seed=seed, inside_m=(0.0, 0.0, 2.0))
