"""Trainings on a cluster of Ray: each is what it is without, to the byte."""

from __future__ import annotations

import dataclasses
import json
import logging
import os
import subprocess
import sys
from types import SimpleNamespace

import pytest
from processes import ROOT

torch = pytest.importorskip("torch", reason="needs the extra learn")
pytest.importorskip("ray", reason="needs the extra distributed")
pytest.importorskip("onnx", reason="needs the extra learn")
pytest.importorskip("tensorboard", reason="needs the extra learn")

from neurosim_core.cli import main  # noqa: E402
from neurosim_core.learn.dagger import DaggerConfig  # noqa: E402
from neurosim_core.learn.population import train_population  # noqa: E402
from neurosim_core.learn.ppo import PpoConfig  # noqa: E402
from neurosim_core.learn.train import TrainConfig, train  # noqa: E402

CONFIG = TrainConfig(
    task="dodge",
    device="cpu",
    seed=3,
    teacher=PpoConfig(worlds=4, iterations=1, horizon=4, minibatches=1),
    student=DaggerConfig(worlds=4, iterations=2, horizon=4, updates=1, batch=4, widths=(4, 4, 4)),
    pixels=8,
    evaluation_worlds=2,
    rate_hz=10.0,  # few steps in an episode
)
TRAIN_AS_CONFIGURED = """
import sys
from pathlib import Path
from neurosim_core.learn.train import read_config, train
folder = Path(sys.argv[1])
train(folder, read_config(folder))
"""


@pytest.fixture(autouse=True)
def quiet(monkeypatch):
    logging.getLogger("ray").setLevel(logging.ERROR)
    monkeypatch.setenv("RAY_worker_niceness", "0")


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    """The folder of a training in this process."""
    folder = tmp_path_factory.mktemp("alone")
    train(folder, CONFIG, say=lambda line: None)
    return folder


def test_seeds_on_a_cluster_are_those_of_this_process(tmp_path, alone):
    configs = {f"seed-{seed}": dataclasses.replace(CONFIG, seed=seed) for seed in (3, 4)}
    said: list[str] = []
    train_population(tmp_path, configs, address="local", say=said.append)
    assert sorted(line.split(":")[0] for line in said) == ["seed-3", "seed-3", "seed-4", "seed-4"]
    policies = [folder / "policy.onnx" for folder in (alone, tmp_path / "seed-3", tmp_path / "seed-4")]
    alike, other = (policies[0].read_bytes() == policy.read_bytes() for policy in policies[1:])
    assert alike
    assert not other
    assert list((tmp_path / "seed-3").glob("events.out.tfevents.*"))


def test_two_workers_of_a_cluster_train_one_policy_as_torchrun_does(tmp_path, alone):
    said: list[str] = []
    train_population(tmp_path, {"both": CONFIG}, address="local", workers=2, say=said.append)
    assert len(said) == 2
    script, folder = tmp_path / "train.py", tmp_path / "torchrun"
    script.write_text(TRAIN_AS_CONFIGURED)
    folder.mkdir()
    (folder / "run.json").write_text(json.dumps(dataclasses.asdict(CONFIG)))
    subprocess.run(
        [
            *(sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"),
            *(str(script), str(folder)),
        ],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        check=True,
        capture_output=True,
        timeout=900,
    )
    both, other, one = (
        (run / "policy.onnx").read_bytes() for run in (tmp_path / "both", tmp_path / "torchrun", alone)
    )
    assert both == other
    assert both != one


class Placed(ValueError):
    """A cluster was asked to begin a training."""


@pytest.fixture
def addresses(monkeypatch):
    """Return the addresses that are connected to: of a cluster of two CPUs, where nothing begins."""

    def place(*_):
        raise Placed("it would begin here")

    asked = []
    ray = SimpleNamespace(
        is_initialized=lambda: False,
        init=lambda address, **_: asked.append(address),
        shutdown=lambda: None,
        cluster_resources=lambda: {"CPU": 2.0},
        util=SimpleNamespace(placement_group=place),
    )
    monkeypatch.setitem(sys.modules, "ray", ray)
    return asked


def test_a_cluster_that_is_too_small_is_told(tmp_path, addresses):
    """It may grow: Ray waits until it has."""
    on_gpu = dataclasses.replace(CONFIG, device="cuda:0")
    for config, workers, lacking in ((CONFIG, 2, ""), (CONFIG, 3, "2 of 3 CPUs"), (on_gpu, 1, "0 of 1 GPUs")):
        said: list[str] = []
        with pytest.raises(Placed):
            train_population(tmp_path, {"a": config}, address="there:1", workers=workers, say=said.append)
        assert said == [f"a waits: the cluster has {lacking}"] * bool(lacking)
    assert addresses == ["there:1"] * 3
    for configs, workers in (({"a": CONFIG}, 0), ({}, 1)):
        with pytest.raises(ValueError, match="1 training and 1 worker at least"):
            train_population(tmp_path, configs, workers=workers)


def test_without_an_address_the_cluster_is_that_of_this_machine(tmp_path, addresses, capsys):
    assert main(["learn", "hover", "--device", "cpu", "--out", str(tmp_path), "--ray", "--workers", "3"]) == 1
    assert addresses == ["auto"]
    told = capsys.readouterr()
    assert "seed-0 waits: the cluster has 2 of 3 CPUs" in told.out
    assert "it would begin here" in told.err


def test_where_no_cluster_runs_that_is_said(tmp_path, monkeypatch, capsys):
    def init(address, **_):
        raise ConnectionError("Could not find any running Ray instance")

    monkeypatch.setattr("ray.init", init)
    assert main(["learn", "hover", "--device", "cpu", "--out", str(tmp_path), "--ray"]) == 1
    assert "no Ray cluster on this machine (`ray start --head` starts one)" in capsys.readouterr().err
