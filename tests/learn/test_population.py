"""Several seeds on a cluster of Ray: each is what it is in this process, to the byte."""

from __future__ import annotations

import logging

import pytest

torch = pytest.importorskip("torch", reason="needs the extra learn")
pytest.importorskip("ray", reason="needs the extra distributed")
pytest.importorskip("onnx", reason="needs the extra learn")
pytest.importorskip("tensorboard", reason="needs the extra learn")

from neurosim_core.learn.dagger import DaggerConfig  # noqa: E402
from neurosim_core.learn.population import train_population  # noqa: E402
from neurosim_core.learn.ppo import PpoConfig  # noqa: E402
from neurosim_core.learn.train import TrainConfig, train  # noqa: E402


def test_seeds_on_a_cluster_are_those_of_this_process(tmp_path, monkeypatch):
    logging.getLogger("ray").setLevel(logging.ERROR)
    monkeypatch.setenv("RAY_worker_niceness", "0")
    configs = {
        f"seed-{seed}": TrainConfig(
            task="dodge",
            device="cpu",
            seed=seed,
            teacher=PpoConfig(worlds=4, iterations=1, horizon=4, minibatches=1),
            student=DaggerConfig(worlds=4, iterations=1, horizon=4, updates=1, batch=4, widths=(4, 4, 4)),
            pixels=8,
            evaluation_worlds=2,
        )
        for seed in (3, 4)
    }
    said: list[str] = []
    train_population(tmp_path, configs, address="local", say=said.append)
    assert sorted(line.split(":")[0] for line in said) == ["seed-3", "seed-3", "seed-4", "seed-4"]
    here = tmp_path / "here"
    train(here, configs["seed-4"], say=said.append)
    policies = [folder / "policy.onnx" for folder in (here, tmp_path / "seed-4", tmp_path / "seed-3")]
    alike, other = (policies[0].read_bytes() == policy.read_bytes() for policy in policies[1:])
    assert alike
    assert not other
    assert list((tmp_path / "seed-3").glob("events.out.tfevents.*"))
