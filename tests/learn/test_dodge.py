"""The task `dodge`: spheres come where they are aimed, are seen there, and hit who stays."""

from __future__ import annotations

import numpy as np
import pytest

import neurosim_core as ns

torch = pytest.importorskip("torch", reason="needs the extra learn")

from neurosim_core.learn.env import find_task  # noqa: E402
from neurosim_core.learn.episodes import StartConfig  # noqa: E402
from neurosim_core.learn.evaluate import evaluate_policy  # noqa: E402

torch.set_num_threads(1)


def make(**options):
    task = find_task("dodge")
    task.start = StartConfig(clearance_m=1.0)  # at rest and level: a hover stays where it is
    return ns.learn.make_env(task, device="cpu", seed=3, randomise=False, **options)


@pytest.fixture(scope="module")
def env():
    return make(worlds=64, observe=["state", "threat"])


def test_each_sphere_comes_to_the_place_of_the_vehicle(env):
    """By the law of free fall: once in the time that the task says, from ahead and out of the floor."""
    env.reset(seed=3)
    view = env.view
    p, v = (part.numpy()[:, None] for part in view.bodies.double().split(3, dim=2))
    t = np.arange(0.0, 5.0, 1e-3)[None, :, None, None]
    way = p + v * t - 0.5 * np.array([0.0, 0.0, 9.81]) * t**2 - view.position.numpy()[:, None, None]
    distance = np.linalg.norm(way, axis=3)
    assert distance.min(axis=1).max() < 0.01  # 1 ms at 9 m/s
    hit_s = 1e-3 * distance.argmin(axis=1)
    first_s = np.array([1.0, 2.3, 3.6])
    assert (hit_s > first_s - 0.002).all()  # two steps of t
    assert (hit_s < first_s + 0.502).all()
    assert np.ptp(hit_s, axis=0).min() > 0.3
    launched = np.argmax(way[..., 2] + view.position.numpy()[:, None, None, 2] > 0.0, axis=1)
    first = np.take_along_axis(way, launched[:, None, :, None], axis=1)[:, 0]
    level = np.linalg.norm(first[..., :2], axis=2)
    assert 4.5 < level.min() < level.max() < 5.01
    x, y, z, w = view.orientation.numpy().T
    heading = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))[:, None]
    bearing = np.angle(np.exp(1j * (np.arctan2(first[..., 1], first[..., 0]) - heading)))
    assert 0.4 < np.abs(bearing).max() < 0.501


def test_who_hovers_is_hit_and_who_is_aside_is_not(env):
    observations, _ = env.reset(seed=3)
    assert (observations["threat"] == 0.0).all()  # all are below the floor
    ended = torch.zeros(64, dtype=torch.bool)
    told = torch.zeros(64, dtype=torch.bool)
    for _ in range(76):
        observations, _, terminated, _, info = env.step(torch.zeros(64, 4))
        told |= (observations["threat"] != 0.0).any(1)
        assert (info["metrics"]["hit"][terminated] == 1.0).all()
        assert (info["metrics"]["success"][terminated] == 0.0).all()
        assert (told | ~terminated).all()
        ended |= terminated
    assert ended.all()
    env.reset(seed=3)
    task, view = env.task, env.view
    for miss_m, hit in ((0.3, True), (0.4, False)):
        aside = torch.tensor([0.0, miss_m, 0.0])
        for along in (-0.1, 0.1):  # past the vehicle within a step
            view.bodies[:, :, :3] = view.position[:, None] + aside + torch.tensor([along, 0.0, 0.0])
            task.advance(view)
        assert (task.terminated(view) == hit).all()


def test_worlds_see_their_own_spheres_where_they_are():
    """Events of a camera at rest are where the sphere is, by the camera's mount and lens."""
    env = make(worlds=4, pixels=48)
    env.reset(seed=3)
    looked = 0
    for _ in range(60):
        observations, _, terminated, _, _ = env.step(torch.zeros(4, 4))
        threat = observations["threat"] / 0.3 - torch.tensor([0.1, 0.0, 0.03])
        counts = observations["events"][:, :2].sum(1)  # of the last 20 ms or so
        focal = 24.0 / np.tan(0.8)
        for world in range(4):
            x, y, z = threat[world].tolist()
            if terminated[world] or not 1.0 < x < 3.5 or counts[world].sum() < 5.0:
                continue
            column, row = 24.0 - focal * y / x, 24.0 - focal * z / x
            rows, columns = np.mgrid[0:48, 0:48] + 0.5
            near = (
                np.hypot(rows - row, columns - column) < focal * 0.15 / x + 4.0
            )  # and what it was just before
            assert counts[world].numpy()[near].sum() > 0.9 * counts[world].sum()
            looked += 1
    assert looked > 20


def test_who_climbs_as_long_as_a_sphere_comes_succeeds(env):
    """What a teacher is told is enough: thrust up while there is a threat, then back down."""

    def climb(observations, _):
        up = 0.6 * env.view.goal_B[:, 2] - 0.5 * env.view.velocity_B[:, 2]
        action = torch.zeros(64, 4)
        action[:, 0] = torch.where((observations["threat"] != 0.0).any(1), 0.8, up.clamp(-0.5, 0.5))
        return action

    found = evaluate_policy(env, climb)
    assert found.metrics["hit"] < 0.1
    assert evaluate_policy(env, lambda *_: torch.zeros(64, 4)).metrics["hit"] == 1.0


def test_throwing_makes_no_tensor_of_host_numbers(env, host_tensors):
    env.reset(seed=3)
    actions = torch.zeros((64, 4))
    env.episode_length.fill_(env.episode_steps - 1)
    assert host_tensors(lambda: env.step(actions)) == 0
