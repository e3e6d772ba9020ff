"""Libraries and vehicles at both ends: rsl-rl-lib, Stable-Baselines3 and skrl train, Cortex flies."""

from __future__ import annotations

import re
import threading
from pathlib import Path

import numpy as np
import pytest
from processes import SOON_S

import neurosim_core as ns
from cortex import Node, reliable
from cortex.messages import Events, Odometry, RateThrustCommand

torch = pytest.importorskip("torch", reason="needs the extra learn")

torch.set_num_threads(1)


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
def test_a_runner_of_rsl_rl_distils_a_student_on_events(hall):
    """It comes nearer to its teacher, who acts on states."""
    runners = pytest.importorskip("rsl_rl.runners", reason="rsl-rl-lib is not installed")
    from neurosim_core.learn.rsl_rl import RslRlEnv

    torch.manual_seed(0)
    bare = ns.learn.make_env("hover", worlds=16, device="cpu", pixels=12, models=[hall])
    layers = {"output_channels": [4, 4], "kernel_size": [5, 3], "stride": [2, 2], "activation": "elu"}
    network = {"hidden_dims": [16], "activation": "elu"}
    spread = {"distribution_cfg": {"class_name": "GaussianDistribution", "init_std": 0.1}}
    runner = runners.DistillationRunner(
        RslRlEnv(bare),
        {
            "num_steps_per_env": 8,
            "save_interval": 100,
            "obs_groups": {name: bare.obs_groups[name] for name in ("student", "teacher")},
            "algorithm": {
                "class_name": "Distillation",
                "num_learning_epochs": 4,
                "gradient_length": 4,
                "learning_rate": 5e-3,
            },
            "student": {"class_name": "CNNModel", "cnn_cfg": layers, **network, **spread},
            "teacher": {"class_name": "MLPModel", **network, **spread},
        },
        log_dir=None,
        device="cpu",
    )
    runner.alg.teacher_loaded = True  # one that was not trained, and pushes one way, will do
    torch.nn.init.constant_(runner.alg.teacher.mlp[-1].bias, 0.5)
    losses = []
    update = runner.alg.update

    def note():
        losses.append(update())
        return losses[-1]

    runner.alg.update = note
    runner.learn(12)
    errors = [loss["behavior"] for loss in losses]
    assert np.mean(errors[-3:]) < 0.5 * errors[0], errors


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


@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning", "ignore::UserWarning")
def test_skrl_trains(hall):
    """PPO learns to stop: in a fifth of the usual time the reward of a step rises well above the first."""
    pytest.importorskip("skrl", reason="skrl is not installed")
    from skrl.agents.torch.ppo import PPO
    from skrl.memories.torch import RandomMemory
    from skrl.models.torch import DeterministicMixin, GaussianMixin, Model
    from skrl.trainers.torch import SequentialTrainer

    from neurosim_core.learn.skrl import SkrlEnv

    torch.manual_seed(0)
    worlds, steps = 128, 24
    env = SkrlEnv(ns.learn.make_env("hover", worlds=worlds, device="cpu", observe=["state"], models=[hall]))
    spaces = {name: getattr(env, name) for name in ("observation_space", "state_space", "action_space")}

    def network(outputs):
        return torch.nn.Sequential(torch.nn.Linear(17, 32), torch.nn.Tanh(), torch.nn.Linear(32, outputs))

    class Policy(GaussianMixin, Model):
        def __init__(self):
            Model.__init__(self, **spaces, device="cpu")
            GaussianMixin.__init__(self)
            self.net, self.spread = network(4), torch.nn.Parameter(torch.full((4,), -0.9))

        def compute(self, inputs, role):
            return self.net(inputs["observations"]), {"log_std": self.spread}

    class Value(DeterministicMixin, Model):
        def __init__(self):
            Model.__init__(self, **spaces, device="cpu")
            DeterministicMixin.__init__(self)
            self.net = network(1)

        def compute(self, inputs, role):
            return self.net(inputs["states"]), {}

    models = {"policy": Policy(), "value": Value()}
    env.value_time_outs(lambda inputs: models["value"].act(inputs, role="value")[0], discount_factor=0.98)
    rewards = []

    def note(reward, timestep, timesteps):
        rewards.append(float(reward.mean()))
        return reward

    settings = {"rollouts": steps, "learning_epochs": 4, "mini_batches": 4, "discount_factor": 0.98}
    quiet = {"write_interval": 0, "checkpoint_interval": 0}
    agent = PPO(
        models=models,
        memory=RandomMemory(memory_size=steps, num_envs=worlds, device="cpu"),
        **spaces,
        device="cpu",
        cfg={**settings, "learning_rate": 3e-3, "rewards_shaper": note, "experiment": quiet},
    )
    length = {"timesteps": 16 * steps, "disable_progressbar": True, "close_environment_at_exit": False}
    SequentialTrainer(env=env, agents=agent, cfg=length).train()
    assert np.mean(rewards[-2 * steps :]) > np.mean(rewards[steps : 3 * steps]) + 0.2


@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning")
def test_skrl_is_told_what_an_episode_that_is_cut_would_have_brought(hall):
    pytest.importorskip("skrl", reason="skrl is not installed")
    from skrl.utils.spaces.torch import unflatten_tensorized_space

    from neurosim_core.learn.skrl import SkrlEnv
    from neurosim_core.learn.tasks.hover import Hover

    class Short(Hover):
        episode_s = 0.2
        camera = {"width": 8, "height": 6, "horizontal_fov_rad": 1.5}  # noqa: RUF012

    bare, wrapped = (ns.learn.make_env(Short(), worlds=5, device="cpu", models=[hall]) for _ in range(2))
    bare.reset(spread=True)
    env = SkrlEnv(wrapped, actor="student")
    env.value_time_outs(lambda inputs: inputs["states"][:, :1] + 3.0, discount_factor=0.5)
    cut_count = 0
    for _ in range(12):
        action = torch.full((5, 4), 0.3)
        expected, reward, _, truncated, info = bare.step(action)
        flat, rewarded, terminated, cut, _ = env.step(action)
        worth = 0.5 * (info["final_obs"]["state"][:, :1] + 3.0) * truncated[:, None]
        torch.testing.assert_close(rewarded, reward[:, None] + worth)
        assert torch.equal(terminated[:, 0], truncated)
        assert not cut.any()
        seen = unflatten_tensorized_space(env.observation_space, flat)
        assert torch.equal(seen["events"], expected["events"])
        assert torch.equal(seen["proprioception"], expected["proprioception"])
        assert torch.equal(env.state(), expected["state"])
        assert torch.equal(env.reset()[0], flat)
        cut_count += int(truncated.sum())
    assert cut_count >= 5


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
    said: list[str] = []
    flown = threading.Thread(
        target=deploy, args=(policy,), kwargs={"duration_s": 0.06, "say": said.append}, daemon=True
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
    assert re.fullmatch(r"4 commands; each took \d+\.\d\d ms \(median\) of computing", said[-1])


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


def test_gymnasium_knows_that_surfaces_are_bytes(hall):
    from neurosim_core.learn.gym import NumpyEnv

    surface = ns.learn.Counts(dtype="uint8")
    bare = ns.learn.make_env("hover", worlds=2, device="cpu", pixels=8, models=[hall], surface=surface)
    env = NumpyEnv(bare)
    observations, _ = env.reset(seed=1)
    space = env.single_observation_space["events"]
    assert (space.dtype, space.low.max(), space.high.min()) == (np.uint8, 0, 255)
    assert env.observation_space.contains(observations)
