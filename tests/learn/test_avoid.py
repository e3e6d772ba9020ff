"""The task `avoid`: where it begins, what teacher and student are shown of the pillars, what succeeds."""

from __future__ import annotations

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs the extra learn")

from neurosim_core.learn.env import find_task  # noqa: E402

torch.set_num_threads(1)


ENV = {"task": "avoid", "worlds": 24, "observe": ["state"], "seed": 3}


def test_vehicles_begin_at_one_end_and_fly_towards_the_other(env):
    env.reset(seed=3)
    view = env.view
    speed = view.velocity.norm(dim=1)
    assert 2.0 <= speed.min() < 3.0
    assert 5.0 < speed.max() <= 6.0
    ahead = torch.tensor([1.0, 0.0, 0.0])
    torch.testing.assert_close(view.goal_B / view.goal_B.norm(dim=1, keepdim=True), ahead.expand(24, 3))
    torch.testing.assert_close(view.velocity_B / speed[:, None], ahead.expand(24, 3), atol=1e-6, rtol=0.0)
    assert len(np.unique(view.position[:, 1].numpy())) > 12


def test_the_teacher_sees_how_far_pillars_are_around_it(env):
    """Against the exact distance at points that are computed here, after flight in a turn."""
    env.reset(seed=3)
    for _ in range(20):
        env.step(torch.tensor([0.1, 0.0, 0.0, 0.6]).expand(24, 4))
    view, space = env.view, env.sim.model.free_space
    x, y, z, w = view.orientation.T
    yaw = torch.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))  # of the body's x axis
    assert yaw.abs().min() > 0.1
    probes = torch.tensor(env.task.probes)
    turn = torch.stack([torch.cos(yaw), -torch.sin(yaw), torch.sin(yaw), torch.cos(yaw)], 1).reshape(-1, 2, 2)
    level = torch.einsum("nij,kj->nki", turn, probes[:, :2])
    points = view.position[:, None] + torch.cat([level, torch.zeros_like(level[..., :1])], dim=2)
    expected = space.interpolated(points.reshape(-1, 3).numpy()).reshape(24, -1)
    inside = space.clearance(points.reshape(-1, 3).numpy()).reshape(24, -1) > 0.1  # not beyond the walls
    seen = view.probes.numpy()
    np.testing.assert_allclose(seen[inside], expected[inside], atol=0.02)  # both interpolate; float32 points
    assert np.ptp(seen) > 1.0


def test_what_is_seen_in_a_mirror_is_the_mirrored_room(env):
    """Probes that change sides change the signs that the task says."""
    env.reset(seed=3)
    view, task = env.view, env.task
    first = task.observe(view)["room"].clone()
    view.probes.copy_(view.probes.unflatten(1, (4, 9)).flip(2).flatten(1).clone())
    torch.testing.assert_close(task.observe(view)["room"], first * torch.tensor(task.mirror["room"]))
    assert first.std() > 0.05
    assert len(task.mirror["proprioception"]) == task.observe(view)["proprioception"].shape[1]


def test_only_who_gets_on_without_a_crash_succeeds(env):
    """A vehicle that stands still does not, nor one that crashed, nor one that is slow."""
    env.reset(seed=3)
    view, task = env.view, env.task
    speed = view.velocity.norm(dim=1)
    goal = view.goal_B.clone()
    view.elapsed_s.fill_(2.0)
    for share, crashed, succeeds in (
        (0.0, False, 0.0),
        (0.6, False, 0.0),
        (0.9, False, 1.0),
        (0.9, True, 0.0),
    ):
        view.goal_B[:] = goal
        view.goal_B[:, 0] -= 2.0 * share * speed
        view.crashed.fill_(crashed)
        metrics = task.metrics(view)
        assert (metrics["success"] == succeeds).all()
        torch.testing.assert_close(metrics["speed_m_s"], share * speed, rtol=1e-3, atol=1e-3)
    view.crashed.fill_(False)


def test_halls_leave_a_way_and_no_straight_one():
    """Gaps are wider than a vehicle, and most straight flights would end at a pillar."""
    task = find_task("avoid")
    for scene in task.scenes(unseen=True)[:2] + task.scenes(unseen=False)[:2]:
        boxes = scene["boxes"]
        places = np.array([box["position_m"][:2] for box in boxes])
        reach = np.array([0.5 * np.hypot(*box["size_m"][:2]) for box in boxes])
        apart = np.hypot(*(places[:, None] - places[None]).transpose(2, 0, 1)) - reach[:, None] - reach[None]
        np.fill_diagonal(apart, np.inf)
        assert apart.min() > 0.6
        lines = np.linspace(-4.5, 4.5, 200)
        narrow = np.array([0.5 * min(box["size_m"][:2]) for box in boxes])  # at least so wide, however turned
        blocked = (np.abs(places[:, 1] - lines[:, None]) < narrow + 0.2).any(axis=1)
        assert blocked.mean() > 0.7
