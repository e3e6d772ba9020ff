"""The task `gates`: where it begins, which gate is next, what counts as passed and what as missed."""

from __future__ import annotations

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs the extra learn")

from neurosim_core.learn.tasks.gates import track  # noqa: E402

torch.set_num_threads(1)


ENV = {"task": "gates", "worlds": 24, "observe": ["state", "next_gate"]}


def begin(env):
    """Begin, and return the middle of the next gate and the direction through it, in W."""
    observations, _ = env.reset(seed=5)
    view = env.view
    gates, yaw = track(100)
    distance = np.linalg.norm(gates[None, :, :2] - view.position[:, None, :2].numpy(), axis=2)
    first = np.array([int(np.argmin(np.abs(row - 5.0))) for row in distance])
    normal = np.stack([np.cos(yaw[first]), np.sin(yaw[first]), np.zeros(24)], axis=1)
    way = np.sign((normal * view.velocity.numpy()).sum(axis=1))
    return observations, gates, first, normal * way[:, None], way


def test_episodes_begin_before_a_gate_in_either_direction(env):
    observations, gates, first, normal, way = begin(env)
    assert len(set(first)) > 5
    assert set(way) == {-1.0, 1.0}
    expected = gates[first] - 5.0 * normal
    np.testing.assert_allclose(env.view.position, expected, atol=1e-4)
    straight = torch.tensor([1.0, 0.0, 0.0]).expand(24, 3)  # 0.2 of 5 m, ahead
    torch.testing.assert_close(observations["next_gate"], straight, atol=1e-4, rtol=0.0)


def test_a_gate_that_is_passed_makes_way_for_the_next(env):
    _, gates, first, normal, way = begin(env)
    view, task = env.view, env.task
    aside = np.stack([-normal[:, 1], normal[:, 0], np.zeros(24)], axis=1)
    for at in (-0.2, 0.2):  # before and behind the gate, 0.8 m off its middle
        view.position[:] = torch.tensor(gates[first] + at * normal + 0.8 * aside)
        task.advance(view)
    assert not task.terminated(view).any()
    assert (task.metrics(view)["passed"] == 1.0).all()
    after = gates[(first + way.astype(int)) % len(gates)]
    view.orientation[:] = torch.tensor([0.0, 0.0, 0.0, 1.0])
    seen = task.observe(view)["next_gate"]
    np.testing.assert_allclose(seen, 0.2 * (after - view.position.numpy()), atol=1e-5)


@pytest.mark.parametrize("offset", [(1.1, 0.0), (0.0, 1.1)])
def test_a_gate_that_is_flown_past_ends_the_episode(env, offset):
    _, gates, first, normal, _ = begin(env)
    view, task = env.view, env.task
    aside = np.stack([-normal[:, 1], normal[:, 0], np.zeros(24)], axis=1)
    for at in (-0.2, 0.2):
        place = gates[first] + at * normal + offset[0] * aside + [0.0, 0.0, offset[1]]
        view.position[:] = torch.tensor(place)
        task.advance(view)
    assert task.terminated(view).all()
    metrics = task.metrics(view)
    assert (metrics["passed"] == 0.0).all()
    assert (metrics["missed"] == 1.0).all()
    assert (metrics["success"] == 0.0).all()


def test_who_hovers_misses_nothing_and_does_not_succeed(env):
    begin(env)
    view, task = env.view, env.task
    view.velocity[:] = 0.0
    view.elapsed_s.fill_(5.0)
    assert not task.terminated(view).any()
    assert (task.metrics(view)["success"] == 0.0).all()


def test_bars_leave_the_opening_and_nothing_beside_it(env):
    """The middle of a gate is half an opening away from its bars, and 1.15 m aside there is one."""
    gates, yaw = track(100)
    space = env.sim.model.free_space
    np.testing.assert_allclose(space.clearance(gates), 1.0, atol=1e-3)
    left = np.stack([-np.sin(yaw), np.cos(yaw), 0.0 * yaw], axis=1)
    assert space.clearance(gates + 1.15 * left).max() < 0.16  # within a bar, 0.15 by 0.3 m
    assert space.clearance(gates + 2.0 * left).min() > 0.5
