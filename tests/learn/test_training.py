"""Training that can be interrupted, what it leaves, and who flies it."""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image
from processes import ROOT

import neurosim_core as ns
from neurosim_core.cli import main
from neurosim_core.registry import register

torch = pytest.importorskip("torch", reason="needs the extra learn")

import rank_process  # noqa: E402

from neurosim_core.learn.dagger import DaggerConfig  # noqa: E402
from neurosim_core.learn.evaluate import (  # noqa: E402
    EPISODE_SEED,
    evaluate_policy,
    record_episode,
    recording_sensors,
    student_actor,
    teacher_actor,
)
from neurosim_core.learn.policies import EventPolicy  # noqa: E402
from neurosim_core.learn.ppo import Ppo, PpoConfig  # noqa: E402
from neurosim_core.learn.randomisation import NO_RANDOMISATION  # noqa: E402
from neurosim_core.learn.recurrent import RecurrentPpo, RecurrentPpoConfig  # noqa: E402
from neurosim_core.learn.tasks.hover import Hover  # noqa: E402
from neurosim_core.learn.train import (  # noqa: E402
    TrainConfig,
    Training,
    default_config,
    evaluate_run,
    load_student,
    make_card,
    read_config,
    train,
)

torch.set_num_threads(1)


@register("task", "brief-hover")
class BriefHover(Hover):
    """Hover with small pictures and short episodes."""

    camera = {"width": 8, "height": 8, "horizontal_fov_rad": 1.5}  # noqa: RUF012
    episode_s = 0.4


CONDITIONS = (
    "as in the tests",
    "noise of a DAVIS346",
    "thresholds 3 to 4 times",
    "lens of 0.8 times the angle",
    "mass 0.9 to 1.1 times, wind up to 1 m/s",
    "clock 36 % slower",
    "actions one step later",
    "three tenths of the actions lost",
    "three tenths of the event packets lost",
    "lenses 0.9 to 1.1 times as long, k1 up to 0.05",
)


def small(**changes) -> TrainConfig:
    return TrainConfig(
        task="brief-hover",
        device="cpu",
        seed=2,
        teacher=PpoConfig(worlds=4, iterations=4, horizon=6, epochs=2, minibatches=2, divergence=1e-9),
        **{"student": DaggerConfig(worlds=4, iterations=4, horizon=6), "block": 2, **changes},
    )


IMITATES = small().student
FROM_SCRATCH = RecurrentPpoConfig(worlds=4, iterations=4, horizon=6, epochs=2, minibatches=2)


def run(folder, hall, *, stops=(), student=IMITATES) -> Training:
    """Train, in a process of its own from each stop on, as it were."""
    pytest.importorskip("tensorboard")
    for until in (*stops, None):
        going_on = (folder / "checkpoint.pt").exists()
        training = Training(
            folder, None if going_on else small(student=student), say=lambda line: None, models=[hall]
        )
        if going_on:
            training.resume()
        training.run(until=until)
    return training


@pytest.mark.parametrize("student", [IMITATES, FROM_SCRATCH])
def test_a_run_that_is_resumed_ends_where_it_would_have(tmp_path, hall, student):
    whole = run(tmp_path / "whole", hall, student=student)
    parts = run(tmp_path / "parts", hall, stops=[(2, 0), (4, 2)], student=student)
    assert (whole.teacher is None) == (student is FROM_SCRATCH)
    for policy in ("teacher", "student") if whole.teacher else ("student",):
        states = [getattr(training, policy).state_dict() for training in (whole, parts)]
        for name, value in states[0].items():
            assert torch.equal(value, states[1][name]), (policy, name)
    fresh = Training(tmp_path / "fresh", small(student=student), models=[hall])
    moved = [
        (a - b).abs().max()
        for a, b in zip(whole.student.parameters(), fresh.student.parameters(), strict=True)
    ]
    assert min(moved) > 0.0
    assert list((tmp_path / "whole").glob("events.out.tfevents.*"))


def test_an_exported_policy_acts_as_the_trained_one(tmp_path, hall):
    pytest.importorskip("onnxruntime")
    from neurosim_core.learn.export import export_onnx
    from neurosim_core.learn.pilot import Pilot, pilot_settings

    training = Training(tmp_path, small(), models=[hall])
    policy = training.student
    export_onnx(policy, make_card(training.env, "brief-hover"), tmp_path / "policy.onnx")
    pilot = Pilot(tmp_path / "policy.onnx")
    rng = np.random.default_rng(0)
    memory, action = torch.zeros(1, policy.memory_size), torch.zeros(1, 4)
    surface = np.zeros((6, 8, 8))
    for step in range(1, 6):
        count = 40
        t = np.sort(rng.integers(20_000 * (step - 1) + 1, 20_000 * step + 1, count))
        x, y, polarity = (rng.integers(0, top, count, dtype=np.uint16) for top in (8, 8, 2))
        rate = rng.normal(size=3)
        command = pilot.act(
            t, x, y, polarity, stamp_ns=20_000_000 * step, orientation=[0.0, 0.0, 0.0, 1.0], body_rate=rate
        )
        for scale, tau_s in enumerate((0.02, 0.06, 0.3)):
            surface[2 * scale : 2 * scale + 2] *= np.exp(-0.02 / tau_s)
            np.add.at(surface, (2 * scale + polarity, y, x), np.exp(-(20_000 * step - t) / (1e6 * tau_s)))
        vector = torch.tensor(np.concatenate([[0.0, 0.0, -1.0], 0.3 * rate]), dtype=torch.float32)[None]
        seen = torch.tensor(surface[None], dtype=torch.float32)
        with torch.no_grad():
            action, memory = policy(seen, torch.cat([vector, action], dim=1), memory)
        np.testing.assert_allclose(pilot.action, action[0], atol=1e-5)  # the pilot sums in 1/65536
        card = pilot.card
        thrust_n = card["hover_thrust_n"] * (1.0 + card["thrust_span"] * pilot.action[0])
        assert command.thrust_n == pytest.approx(thrust_n)
    ns.load_config(pilot_settings(pilot.card))
    for x, y in ((8, 0), (0, 8)):
        with pytest.raises(ValueError, match="trained with 8x8 pixels, and got events of others"):
            pilot.act([1], [x], [y], [1], stamp_ns=1000, orientation=[0.0, 0.0, 0.0, 1.0], body_rate=rate)
    with pytest.raises(ValueError, match="there is no policy"):
        Pilot(tmp_path / "nothing.onnx")
    export_onnx(policy, {**card, "mode": "velocity"}, tmp_path / "other.onnx")
    with pytest.raises(ValueError, match="commands velocity, and only thrust and body rates are flown"):
        Pilot(tmp_path / "other.onnx")
    shape = {**policy.shape, "vector_size": 17}
    export_onnx(EventPolicy(**shape), {**card, "task": "avoid"}, tmp_path / "other.onnx")
    with pytest.raises(ValueError, match="trained for 'avoid', and needs more than events"):
        Pilot(tmp_path / "other.onnx")


def test_onnx_runtime_computes_what_torch_does(tmp_path, hall):
    """Both act alike to 1e-5 for 50 steps, each with a memory of its own, with weights that matter."""
    onnxruntime = pytest.importorskip("onnxruntime")
    from neurosim_core.learn.export import export_onnx

    training = Training(tmp_path, small(), models=[hall])
    policy = training.student
    export_onnx(policy, make_card(training.env, "brief-hover"), tmp_path / "policy.onnx")
    session = onnxruntime.InferenceSession(str(tmp_path / "policy.onnx"))
    rng = np.random.default_rng(3)
    memories = [np.zeros((1, policy.memory_size), np.float32) for _ in range(2)]
    actions = []
    for _ in range(50):
        seen = rng.laplace(scale=2.0, size=(1, 6, 8, 8)).astype(np.float32)  # voxel grids have both signs
        vector = rng.normal(size=(1, 10)).astype(np.float32)
        inputs = {"events": seen, "vector": vector, "memory": memories[0]}
        action, memories[0] = session.run(None, inputs)
        with torch.no_grad():
            expected, memory = policy(*map(torch.from_numpy, (seen, vector, memories[1])))
        memories[1] = memory.numpy()
        np.testing.assert_allclose(action, expected, atol=1e-5)
        actions.append(action)
    assert np.std(actions, axis=0).min() > 0.01  # a constant would agree, too


def test_ppo_learns_to_stop(hall):
    """In a tenth of the usual time rewards rise well above those of the first iterations."""
    torch.manual_seed(0)
    config = dataclasses.replace(PpoConfig(), worlds=192, iterations=24)
    env = ns.learn.make_env("hover", worlds=config.worlds, device="cpu", observe=["state"], models=[hall])
    ppo = Ppo(env, config, torch.Generator().manual_seed(0))
    before = evaluate_policy(env, teacher_actor(ppo.policy, env))
    ppo.begin(1)
    rewards = [ppo.iterate(i / config.iterations)["reward"] for i in range(config.iterations)]
    after = evaluate_policy(env, teacher_actor(ppo.policy, env))
    assert np.mean(rewards[-3:]) > np.mean(rewards[2:6]) + 0.2
    assert after.metrics["speed_m_s"] < before.metrics["speed_m_s"]


@pytest.mark.parametrize(("divergence", "factor"), [(0.0, 1.0), (1e-9, 1.2**-3), (1e3, 1.2**3)])
def test_the_learning_rate_follows_how_much_a_policy_changes(hall, divergence, factor):
    config = PpoConfig(worlds=8, horizon=6, epochs=2, minibatches=2, divergence=divergence)
    env = ns.learn.make_env("hover", worlds=config.worlds, device="cpu", observe=["state"], models=[hall])
    ppo = Ppo(env, config, torch.Generator().manual_seed(0))
    for _ in range(3):
        ppo.iterate(0.0)
    assert ppo.descent.rate_factor == pytest.approx(factor)
    assert ppo.descent.optimizer.param_groups[0]["lr"] == pytest.approx(1.5e-3 * factor ** (2 / 3))


class Recall:
    """Episodes of five steps: which way to act is shown in the first of them only."""

    num_envs, device, task = 32, torch.device("cpu"), Hover()

    def reset(self, *, seed=0, spread=False):
        self._generator, self._step = torch.Generator().manual_seed(seed), 0
        return self._seen(), {}

    def group(self, observations, name):
        return observations["vector"] if name == "student" else observations["velocity"]

    def hint(self, observations):
        return observations["velocity"]

    def step(self, action):
        reward, end = (
            (self._way * action.clamp(-1.0, 1.0)[:, :1]).squeeze(1),
            torch.zeros(self.num_envs) > 0.0,
        )
        self._step = (self._step + 1) % 5
        last = self._seen()
        metrics = {"success": reward, "crash": torch.zeros(self.num_envs)}
        return last, reward, end | (self._step == 0), end, {"final_obs": last, "metrics": metrics}

    def _seen(self):
        if self._step == 0:
            self._way = torch.sign(torch.randn(self.num_envs, 1, generator=self._generator))
        shown = self._way * (self._step == 0)
        return {"events": torch.zeros(self.num_envs, 2, 8, 8), "vector": shown, "velocity": self._way}


def test_ppo_learns_what_only_a_memory_can():
    """Without one, half of the actions would go the wrong way but for the first of five: a reward of 0.2."""
    torch.manual_seed(0)
    config = RecurrentPpoConfig(
        worlds=32, horizon=20, learning_rate=5e-3, reward_scale=1.0, widths=(4,), hidden=16
    )
    ppo = RecurrentPpo(Recall(), config, torch.Generator().manual_seed(0))
    ppo.begin(1)
    logs = [ppo.iterate(0.0) for _ in range(10)]
    rewards = [log["reward"] for log in logs]
    assert logs[-1]["velocity error"] < logs[0]["velocity error"]
    assert rewards[0] < 0.2
    assert np.mean(rewards[-3:]) > 0.5


def test_evaluation_counts_one_episode_of_each_world(tmp_path, hall):
    training = run(tmp_path, hall)
    env = ns.learn.make_env("brief-hover", worlds=6, device="cpu", models=[hall])
    policy = load_student(tmp_path, env.device)
    first = evaluate_policy(env, student_actor(policy, env))
    assert first == evaluate_policy(env, student_actor(policy, env))
    assert first.episodes == 6
    assert set(first.metrics) == {"success", "crash", "speed_m_s"}
    assert first.metrics["success"] == 0.0  # an episode is shorter than the time to hold
    assert first.metrics != evaluate_policy(env, student_actor(policy, env, blind=True)).metrics
    assert "0 % success (0 to 39)" in str(first)  # 1 - 1.96^2 / (6 + 1.96^2) of all might have failed
    del training


def test_a_task_that_measures_nothing_is_trained_and_evaluated(hall):
    """What it tells is who crashed."""

    class Fall(ns.learn.Task):
        episode_s = 2.0
        groups = dict.fromkeys(("actor", "critic", "teacher"), ("state",))

        def observe(self, view):
            return {"state": view.velocity}

        def reward(self, view):
            return -view.velocity[:, 2]

    env = ns.learn.make_env(Fall(), worlds=16, device="cpu", observe=["state"], models=[hall])
    ppo = Ppo(env, PpoConfig(worlds=16, iterations=1), torch.Generator().manual_seed(0))
    ppo.begin(seed=1)
    ppo.iterate(0.0)
    down = torch.tensor([-1.0, 0.0, 0.0, 0.0]).repeat(16, 1)
    found = evaluate_policy(env, lambda observations, begun: down)
    assert found.metrics == {"success": 0.0, "crash": 1.0}
    assert str(found).startswith("0 % success (0 to 19), 100 % crash (81 to 100) in 16")


def test_a_run_is_evaluated_in_the_file_of_a_scene(tmp_path, hall):
    run(tmp_path, hall)
    file = hall.config.scene.file
    found = dict(evaluate_run(tmp_path, scenes=str(file), worlds=3))
    assert set(found) == {"events", "blind"}
    assert found["events"].episodes == 3
    slow = next(evaluate_run(tmp_path, scenes=str(file), worlds=3, speed_m_s=0.1))[1]
    assert slow.metrics["speed_m_s"] < 0.7 * found["events"].metrics["speed_m_s"]
    with pytest.raises(ValueError, match="nowhere"):
        next(evaluate_run(tmp_path, scenes="nowhere", worlds=3))


def test_a_run_says_how_far_a_block_has_come(tmp_path, hall, monkeypatch):
    pytest.importorskip("tensorboard")
    monkeypatch.setattr("neurosim_core.learn.train._TELL_S", 0.0)
    said: list[str] = []
    Training(tmp_path, small(block=4), say=said.append, models=[hall]).run()
    assert [line.split()[1] for line in said] == ["1/4:", "2/4:", "3/4:", "4/4"] * 2
    assert all(line.startswith("teacher ") and "reward" in line for line in said[:4])
    errors = ("imitation error ", "velocity error ")  # of actions, and of what students estimate besides
    assert all(line.startswith("student ") and all(e in line for e in errors) for line in said[4:])


def test_a_run_sees_events_as_it_is_told(tmp_path, hall):
    pytest.importorskip("tensorboard")
    training = Training(tmp_path, small(surface="time", rate_hz=25.0), models=[hall])
    card = make_card(training.env, "brief-hover")["surface"]
    assert card["kind"] == "TimeSurface"
    np.testing.assert_allclose(card["tau_s"], (0.04, 0.12, 0.6))  # of the task, for steps twice as long
    training.run(until=(2, 2))
    assert next(evaluate_run(tmp_path, scenes=str(hall.config.scene.file), worlds=1))[0] == "events"
    with pytest.raises(ValueError, match="unknown surface 'voxel', known: leaky, time, counts, voxels"):
        small(surface="voxel")


def test_a_policy_sees_voxels_of_both_signs():
    torch.manual_seed(0)
    policy = EventPolicy(channels=5, height=8, width=8, vector_size=3)
    voxels, vector = torch.full((2, 5, 8, 8), 3.0), torch.zeros(2, 3)
    voxels[1] = -3.0  # as many events, but darker
    seen = policy.encode(voxels, vector)
    assert seen.isfinite().all()
    assert not torch.allclose(seen[0], seen[1])


def test_an_evaluation_animates_the_first_of_its_episodes(tmp_path, hall, capsys):
    """The recording that an animation is made of begins where the first world does, and goes the same way."""
    run(tmp_path, hall)
    scene, file = str(hall.config.scene.file), tmp_path / "flight.h5"
    (_, evaluation), *_ = evaluate_run(tmp_path, scenes=scene, worlds=1, animation=file)
    with ns.Recording(file) as flight:
        poses, pictures = (list(flight.packets(name)) for name in ("odometry", "rgb"))
        assert [packet.stamp_ns for packet in poses] == [20_000_000 * step for step in range(21)]
        assert len(pictures) == 21
        assert pictures[0].data.shape == (220, 220, 3)
        assert np.ptp(pictures[0].data) > 50
        events = flight.events("front", 0.0, 0.5)
        assert len(events.t) > 20
    env = ns.learn.make_env("brief-hover", worlds=3, device="cpu", scenes=[scene])
    env.reset(seed=EPISODE_SEED)
    np.testing.assert_allclose(poses[0].position, env.view.position[0], atol=1e-6)  # float32
    speed_m_s = np.linalg.norm(poses[-1].velocity)
    assert evaluation.metrics["speed_m_s"] == pytest.approx(speed_m_s, rel=1e-5)  # float32
    for speed, name in (([], "hall.webp"), (["--speed", "4.5"], "hall-4.5m_s.webp")):
        assert main(["learn", "eval", str(tmp_path), "--scenes", scene, "--worlds", "1", *speed]) == 0
        assert f"wrote {tmp_path}/{name}" in capsys.readouterr().out
        with Image.open(tmp_path / name) as frames:
            assert frames.n_frames == 5
    env = ns.learn.make_env(
        "brief-hover", worlds=2, device="cpu", scenes=[scene], sensors=recording_sensors(env.task)
    )
    act = student_actor(load_student(tmp_path, env.device), env)

    def acting(observations, begun):  # beside a world that begins anew in each step, as on CUDA all might
        env.episode_length[1] = env.episode_steps
        return act(observations, begun)

    record_episode(env, acting, tmp_path / "again.h5")
    with ns.Recording(tmp_path / "again.h5") as flight:
        # a network rounds otherwise for two worlds than for one
        np.testing.assert_allclose(flight.events("front", 0.0, 0.5).t, events.t, atol=20)


def test_a_policy_is_evaluated_where_it_was_not_trained(tmp_path, hall, monkeypatch):
    """Each condition changes what is flown; with none of them the evaluation is that of the tests."""
    from neurosim_core.learn import transfer

    run(tmp_path, hall)
    file = hall.config.scene.file
    changes = {name: transfer.CONDITIONS[name] for name in CONDITIONS}
    monkeypatch.setattr(transfer, "CONDITIONS", changes)
    found = dict(transfer.evaluate_transfer(tmp_path, scenes=[str(file)], worlds=3))
    assert found["as in the tests"] == next(evaluate_run(tmp_path, scenes=str(file), worlds=3))[1]
    assert len({evaluation.metrics["speed_m_s"] for evaluation in found.values()}) == len(CONDITIONS)


def test_weights_and_biases_gets_what_tensorboard_does_if_asked_for(tmp_path, hall, monkeypatch):
    begun = []
    monkeypatch.setitem(sys.modules, "wandb", SimpleNamespace(init=lambda **given: begun.append(given)))
    Training(tmp_path / "without", small(), models=[hall]).run(until=(2, 0))
    assert not begun
    Training(tmp_path / "with", small(wandb=True), models=[hall]).run(until=(2, 0))
    (given,) = begun
    assert given["sync_tensorboard"] is True
    assert given["name"] == "with"
    assert given["config"]["teacher"]["worlds"] == 4


def test_weights_and_biases_must_be_there_before_anything_is_set_up(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "wandb", None)
    with pytest.raises(ImportError, match="--wandb needs the package wandb: pip install wandb"):
        train(tmp_path / "run", small(wandb=True))
    assert not (tmp_path / "run").exists()
    (tmp_path / "run.json").write_text(json.dumps(dataclasses.asdict(small())))
    with pytest.raises(ImportError, match="--wandb needs the package wandb"):  # asked for by who goes on
        train(tmp_path, small(wandb=True), resume=True)


def test_a_training_may_have_longer_steps(tmp_path, hall):
    """Its surfaces remember as many steps, and whoever flies the policy is told."""
    config = small(rate_hz=25.0)
    env = Training(tmp_path, config, models=[hall]).env
    assert env.episode_steps == round(25.0 * env.task.episode_s)
    assert env.task.surface.tau_s == pytest.approx([2.0 * tau_s for tau_s in Hover.surface.tau_s])
    card = make_card(env, config.task)
    assert (card["rate_hz"], card["surface"]["tau_s"]) == (25.0, env.task.surface.tau_s)
    assert read_config(tmp_path).make_task().rate_hz == 25.0
    assert small().make_task().rate_hz == Hover.rate_hz
    assert default_config("hover", device="cpu").make_task().rate_hz == 25.0
    assert default_config("throw-recover", device="cpu").make_task().rate_hz == 50.0


def test_a_block_of_one_iteration_learns(tmp_path, hall):
    """A CPU learns from iterations before: where there is none, from the first after it has flown."""
    training = Training(tmp_path, small(block=1), models=[hall])
    before = [parameter.clone() for parameter in training.student.parameters()]
    training.run(until=(0, 1))
    after = training.student.parameters()
    assert not any(torch.equal(a, b) for a, b in zip(before, after, strict=True))


def test_runs_of_another_version_are_refused(tmp_path, hall):
    training = run(tmp_path, hall)
    state = torch.load(tmp_path / "checkpoint.pt", weights_only=True)
    state["weights"]["motion.weight"] = torch.zeros(3, 44)
    torch.save(state, tmp_path / "checkpoint.pt")
    for read in (training.resume, lambda: load_student(tmp_path, torch.device("cpu"))):
        with pytest.raises(ValueError, match="of another version"):
            read()


def test_a_run_from_before_rates_adapted_goes_on(tmp_path, hall):
    """With the rates that it had: a factor of 1."""
    pytest.importorskip("tensorboard")
    training = Training(tmp_path, small(), models=[hall])
    training.run(until=(2, 0))
    before = torch.load(tmp_path / "checkpoint.pt", weights_only=True)
    assert before["teacher"].pop("rate_factor") != 1.0
    found = []
    for factor in ({}, {"rate_factor": 1.0}):
        torch.save({**before, "teacher": {**before["teacher"], **factor}}, tmp_path / "checkpoint.pt")
        training.resume()
        training.run(until=(4, 0))
        found.append(torch.load(tmp_path / "checkpoint.pt", weights_only=True)["teacher"]["rate_factor"])
    assert found[0] == found[1]


def test_a_task_that_lacks_what_training_needs_says_so(tmp_path, hall):
    with pytest.raises(ValueError, match="the task has no observation 'velocity', which is needed here; it"):
        Training(tmp_path, dataclasses.replace(small(), task="hover-paper"), models=[hall])
    env = ns.learn.make_env("hover", worlds=2, device="cpu", observe=["state"], models=[hall])
    seen, _ = env.reset()
    with pytest.raises(ValueError, match=r"no group of observations 'pilot', .* actor, critic, teacher, st"):
        env.group(seen, "pilot")


def test_nothing_is_drawn_if_that_is_asked_for(tmp_path, hall):
    training = Training(tmp_path, small(randomise="none"), models=[hall])
    assert training.env.randomisation == NO_RANDOMISATION
    assert Training(tmp_path, small(), models=[hall]).env.randomisation == Hover.training
    with pytest.raises(ValueError, match="unknown randomise 'some', known: training, tests, none"):
        small(randomise="some")


def test_a_task_of_ones_own_is_learnt(monkeypatch):
    """The example ends nearer to its height after a third of its training than without any."""
    monkeypatch.syspath_prepend(str(ROOT / "examples"))
    import custom_task

    errors = [custom_task.main(iterations) for iterations in (0, 30)]
    assert errors[1] < 0.8 * errors[0]


def test_the_policy_that_comes_with_the_package_stops():
    """Thrown at 1 m/s in the default apartment, it ends slower than 0.2 m/s: the bar of the task."""
    pytest.importorskip("onnxruntime")
    from neurosim_core.learn.pilot import fly_policy, shipped_policy

    assert shipped_policy("hover").stat().st_size < 1_000_000
    assert fly_policy("hover", overrides={"device": "cpu"}, say=lambda line: None) < 0.2


def test_a_flight_in_a_mirror_is_a_flight(hall):
    """Two vehicles that begin and act as mirror images stay so: the signs are those of physics."""
    from neurosim_core.learn.task import MIRROR_ACTION

    sim = ns.Simulation(hall.config, worlds=2, models=[hall])
    sign = np.array([1.0, -1.0, 1.0])
    signs = np.array(Hover.mirror["proprioception"])
    np.testing.assert_array_equal(signs[:3], sign)  # gravity is a vector,
    np.testing.assert_array_equal(signs[3:6], -sign)  # the gyroscope's is an axial one
    np.testing.assert_array_equal(Hover.mirror["velocity"], sign)
    velocity, rate, turn = np.array([0.4, 0.3, -0.2]), np.array([0.5, -0.4, 0.3]), np.array([0.1, 0.2, -0.3])
    q = np.array([*turn, np.sqrt(1.0 - turn @ turn)])
    sim.reset(
        position=[0.0, 0.0, 2.0],
        velocity=np.stack([velocity, sign * velocity]),
        orientation=np.stack([q, q * [-1.0, 1.0, -1.0, 1.0]]),
        body_rate=np.stack([rate, -sign * rate]),
    )
    action = np.array([6.0, 0.8, -0.5, 0.4])
    for _ in range(20):
        seen = sim.step(np.stack([action, action * MIRROR_ACTION]).astype(np.float32), mode="rates")
    state = seen.state
    rates, speeds = state.body_rate.numpy(), state.velocity.numpy()
    np.testing.assert_allclose(rates[1], -sign * rates[0], atol=1e-6)
    np.testing.assert_allclose(speeds[1], sign * speeds[0], atol=1e-6)
    assert np.abs(speeds[0] - velocity).min() > 0.01


def test_a_stretch_of_flight_is_learnt_from_as_it_was_flown():
    """`unroll` gives the actions of single steps, also where an episode begins within."""
    torch.manual_seed(1)
    policy = EventPolicy(4, 9, 9, 10)
    surfaces, vectors = torch.rand(6, 3, 4, 9, 9), torch.randn(6, 3, 10)
    begun = torch.zeros(6, 3)
    begun[2, 1] = 1.0
    memory = 0.1 * torch.randn(3, policy.memory_size)
    with torch.no_grad():
        actions, estimates = policy.unroll(surfaces, vectors, begun, memory)
        for step in range(6):
            memory = memory * (1.0 - begun[step])[:, None]
            action, memory = policy(surfaces[step], vectors[step], memory)
            torch.testing.assert_close(action, actions[step].clamp(-1.0, 1.0))
            torch.testing.assert_close(memory[:, policy.hidden :], estimates[step])
    assert estimates.std() > 0.0


def test_two_processes_train_one_policy(tmp_path, hall):
    """They fly in different worlds and end with the same weights, to the bit, also if they are resumed.

    One alone ends with others.
    """
    pytest.importorskip("tensorboard")
    script, scene = str(ROOT / "tests" / "learn" / "rank_process.py"), str(hall.config.scene.file)
    torchrun = (sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2")
    done = subprocess.run(
        [*torchrun, script, scene, str(tmp_path / "both")],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=900,
    )
    assert done.returncode == 0, done.stderr
    found = [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]
    first, second = sorted(found, key=lambda each: each["rank"])
    alone = rank_process.train(tmp_path / "alone", hall)
    assert first["digests"] == second["digests"] == first["resumed"] == second["resumed"]
    assert first["position"] != second["position"]
    assert not set(first["digests"]) & set(alone["digests"])
    assert (tmp_path / "both" / "checkpoint.pt").exists()


def test_a_cluster_may_have_the_gpus_that_this_machine_has_not():
    """Settings for CUDA devices are made anywhere; only a training looks for the device."""
    config = default_config("hover", device="cuda:7")
    assert (config.device, config.student.worlds, config.pixels) == ("cuda:7", 1024, None)
