"""The task `throw-recover`: any way up, and a teacher that learns to right itself."""

from __future__ import annotations

import pytest

torch = pytest.importorskip("torch", reason="needs the extra learn")

from neurosim_core.learn.evaluate import evaluate_policy, teacher_actor  # noqa: E402
from neurosim_core.learn.ppo import Ppo, PpoConfig  # noqa: E402

torch.set_num_threads(1)


ENV = {"task": "throw-recover", "worlds": 128, "observe": ["state"], "seed": 3}


def test_episodes_begin_any_way_up_and_spinning(env):
    env.reset(seed=3)
    view = env.view
    down = -view.gravity_B[:, 2]
    assert down.min() < -0.95
    assert down.max() > 0.95
    assert 0.35 < (down < 0.0).float().mean() < 0.65  # tilt is uniform in [0, pi]: a half, 3 sigma are 0.13
    assert 5.0 < view.body_rate.abs().max() <= 6.0
    assert view.clearance.min() > 2.5  # at least 3 m, to a voxel


def test_upside_down_costs_more_than_upright(env):
    env.reset(seed=3)
    view = env.view
    for array in (view.velocity, view.body_rate, view.action, view.last_action):
        array.zero_()
    rewards = []
    for z in (-1.0, 0.0, 1.0):
        view.gravity_B[:] = torch.tensor([0.0, (1.0 - z * z) ** 0.5, z])
        rewards.append(float(env.task.reward(view)[0]))
    assert rewards == pytest.approx([1.5, 0.5, -0.5])


def test_a_teacher_learns_to_right_itself(env):
    torch.manual_seed(0)
    config = PpoConfig(**{**env.task.teacher, "worlds": 128, "iterations": 50})
    teacher = Ppo(env, config, torch.Generator().manual_seed(0))
    before = evaluate_policy(env, teacher_actor(teacher.policy, env))
    teacher.begin(1)
    for iteration in range(config.iterations):
        teacher.iterate(iteration / config.iterations)
    after = evaluate_policy(env, teacher_actor(teacher.policy, env))
    assert before.metrics["crash"] > 0.9
    assert after.metrics["crash"] < 0.5
