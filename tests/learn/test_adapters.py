"""Libraries and vehicles at both ends: rsl-rl-lib and Stable-Baselines3 train, Cortex flies."""

from __future__ import annotations

import threading
from pathlib import Path

import numpy as np
import pytest
from processes import SOON_S

import neurosim_core as ns
from cortex import Node, reliable
from cortex.messages import Events, Odometry, RateThrustCommand

torch = pytest.importorskip("torch", reason="needs the extra learn")


@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning", "ignore::UserWarning")
def test_a_runner_of_rsl_rl_trains(hall):
    runners = pytest.importorskip("rsl_rl.runners", reason="rsl-rl-lib is not installed")
    from neurosim_core.learn.rsl_rl import RslRlEnv

    env = RslRlEnv(ns.learn.make_env("hover", worlds=8, device="cpu", observe=["state"], models=[hall]))
    network = {"class_name": "MLPModel", "hidden_dims": [16], "activation": "elu"}
    spread = {"distribution_cfg": {"class_name": "GaussianDistribution", "init_std": 0.5}}
    runner = runners.OnPolicyRunner(
        env,
        {
            "num_steps_per_env": 4,
            "save_interval": 100,
            "obs_groups": {"actor": ["state"], "critic": ["state"]},
            "algorithm": {"class_name": "PPO", "num_learning_epochs": 1, "num_mini_batches": 1},
            "actor": {**network, **spread},
            "critic": network,
        },
        log_dir=None,
        device="cpu",
    )
    before = [parameter.clone() for parameter in runner.alg.actor.parameters()]
    runner.learn(2, init_at_random_ep_len=True)
    after = list(runner.alg.actor.parameters())
    assert any(not torch.equal(a, b) for a, b in zip(before, after, strict=True))


@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning", "ignore::UserWarning")
@pytest.mark.parametrize("name", ["PPO", "SAC"])
def test_stable_baselines_trains(hall, name):
    """On policy and off policy; episodes of 0.2 s end by time, and say what was seen last."""
    library = pytest.importorskip("stable_baselines3", reason="stable-baselines3 is not installed")
    from neurosim_core.learn.gym import NumpyEnv
    from neurosim_core.learn.sb3 import Sb3Env
    from neurosim_core.learn.tasks.hover import Hover

    class Short(Hover):
        episode_s = 0.2

    bare = ns.learn.make_env(Short(), worlds=6, device="cpu", observe=["state"], models=[hall])
    env = Sb3Env(NumpyEnv(bare, group="actor"))
    sizes = {"PPO": {"n_steps": 8, "batch_size": 24}, "SAC": {"learning_starts": 30, "batch_size": 16}}
    learner = getattr(library, name)("MultiInputPolicy", env, device="cpu", seed=3, **sizes[name])
    before = [value.clone() for value in learner.policy.parameters()]
    learner.learn(96)
    assert any(not torch.equal(a, b) for a, b in zip(before, learner.policy.parameters(), strict=True))
    env.seed(5)
    first = env.reset()["state"]
    for step in range(10):
        seen, _, ended, infos = env.step(np.zeros((6, 4), np.float32))
        assert ended.all() == (step == 9)
    assert infos[2]["TimeLimit.truncated"]
    assert infos[2]["success"] == 0.0
    assert not np.allclose(infos[2]["terminal_observation"]["state"], seen["state"][2])
    env.seed(5)
    np.testing.assert_array_equal(env.reset()["state"], first)


@pytest.fixture(scope="module")
def policy(tmp_path_factory):
    """A policy that was not trained, in a file."""
    pytest.importorskip("onnx")
    pytest.importorskip("onnxruntime")
    from neurosim_core.learn.export import export_onnx
    from neurosim_core.learn.policies import EventPolicy

    torch.manual_seed(1)
    card = {
        "task": "hover",
        "rate_hz": 50.0,
        "camera": {"width": 8, "height": 8, "horizontal_fov_rad": 1.5},
        "mount": {"position_m": (0.1, 0.0, 0.03)},
        "threshold": 0.1,
        "renders_per_step": 1,
        "rays_per_pixel": 1,
        "surface": {"kind": "TimeSurface", "tau_s": [0.05]},
        "hover_thrust_n": 4.905,
        "thrust_span": 0.4,
        "rate_max_rad_s": [2.0, 2.0, 1.0],
        "vehicle": {"preset": "hummingbird"},
    }
    file = tmp_path_factory.mktemp("policy") / "policy.onnx"
    export_onnx(EventPolicy(2, 8, 8, 10), card, file)
    return file


def test_a_policy_as_a_cortex_node_commands_what_it_does_in_process(policy, runtime):
    from neurosim_core.learn.deploy import deploy
    from neurosim_core.learn.pilot import Pilot

    rng, pilot = np.random.default_rng(0), Pilot(policy)
    flown = threading.Thread(
        target=deploy, args=(policy,), kwargs={"duration_s": 0.06, "say": lambda line: None}, daemon=True
    )
    with Node("vehicle") as node:
        states = node.publisher("/drone/odometry", Odometry)
        seen = node.publisher("/drone/events", Events)
        commands = node.subscriber("/drone/command/rates", RateThrustCommand, policy=reliable(16))
        flown.start()
        assert states.wait_for_subscribers(timeout_s=SOON_S)
        assert seen.wait_for_subscribers(timeout_s=SOON_S)
        for step in range(4):
            stamp_ns = 20_000_000 * step
            t = np.sort(rng.integers(20_000 * (step - 1) + 1, 20_000 * step + 1, 30 * (step > 0)))
            x, y = (rng.integers(0, 8, len(t)).astype(np.uint16) for _ in range(2))
            polarity = rng.integers(0, 2, len(t)).astype(np.uint8)
            q, rate = np.array([0.1, 0.0, 0.0, 0.995]), rng.normal(size=3)
            if step:
                seen.publish(Events(stamp_ns=stamp_ns, t=t, x=x, y=y, polarity=polarity, width=8, height=8))
            still = np.zeros(3)
            states.publish(
                Odometry(stamp_ns=stamp_ns, position=still, orientation=q, velocity=still, body_rate=rate)
            )
            command = commands.recv(SOON_S)
            expected = pilot.act(t, x, y, polarity, stamp_ns=stamp_ns, orientation=q, body_rate=rate)
            assert command.stamp_ns == stamp_ns
            assert command.thrust_n == expected.thrust_n
            np.testing.assert_array_equal(command.body_rate, expected.body_rate)
        flown.join(SOON_S)
    assert not flown.is_alive()


def test_a_policy_flies_in_this_process(policy, hall, tmp_path):
    from neurosim_core.learn.pilot import fly_policy, shipped_policy

    scene = hall.config.scene.model_dump()
    overrides = {f"scene.{key}": scene[key] for key in ("kind", "file", "up_axis", "unit_m", "inside_m")}
    said: list[str] = []
    overrides |= {"device": "cpu", "render.lighting.mode": "unshadowed"}
    film = tmp_path / "flight.h5"
    speed_m_s = fly_policy(str(policy), duration_s=0.2, overrides=overrides, save=film, say=said.append)
    with ns.Recording(film) as flight:
        counts = {name: flight.packet_count(name) for name in flight.sensors}
        assert counts["rgb"] == 4
        assert counts["odometry"] == 10
        assert counts["events"] > 0
    with pytest.raises(ValueError, match=r"ends in \.h5, \.webp or \.gif, got film\.mp4"):
        fly_policy(str(policy), duration_s=0.2, overrides=overrides, save=Path("film.mp4"))
    assert 0.5 < speed_m_s < 2.0  # thrown at 0.8 m/s, and hardly slowed in that time
    assert said[-1].startswith("mean speed of the last 0.2 s")
    with pytest.raises(ValueError, match="unknown policy 'nobody', known: "):
        shipped_policy("nobody")
