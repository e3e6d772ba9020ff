"""Trainings that need nothing of each other, such as several seeds, on a cluster of Ray."""

from __future__ import annotations

import dataclasses
import importlib
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from neurosim_core.data.ray_source import cluster
from neurosim_core.learn.train import Say, TrainConfig, is_for_cuda, train
from neurosim_core.render.launch import limit_cores


def train_population(
    folder: Path, configs: Mapping[str, TrainConfig], *, address: str = "auto", say: Say = print
) -> None:
    """Train with each of several settings, as many side by side as the cluster has GPUs, or cores, for.

    Runs come back from the machines where they were trained, with checkpoints, policies and logs. One that
    fails does not end the others.

    Args:
        folder: Of the runs: each in a folder there, of its name.
        configs: By name. With a CUDA device a training takes a GPU, `cuda:0` to it; else a core.
        address: See `data.ray_source.cluster`.
        say: Told what comes of each.

    Raises:
        ValueError: The folder holds one of the runs.
        RuntimeError: A training failed.
    """
    held = [name for name in configs if (folder / name / "checkpoint.pt").exists()]
    if held:
        raise ValueError(f"{folder} holds the runs {', '.join(held)}: choose another folder")
    failures = []
    with cluster(address) as ray:
        left = {}
        for name, config in configs.items():
            gpus = int(is_for_cuda(config.device))
            config = dataclasses.replace(config, device="cuda:0" if gpus else "cpu")
            training = ray.remote(_train).options(num_cpus=1, num_gpus=gpus).remote(name, config)
            left[training] = name
        while left:
            (done,), _ = ray.wait([*left], num_returns=1)
            name = left.pop(done)
            try:
                files, found = ray.get(done)
            except ray.exceptions.RayError as error:
                failures.append(name)
                say(f"{name} failed: {error}")
                continue
            (folder / name).mkdir(parents=True, exist_ok=True)
            for file, content in files.items():
                (folder / name / file).write_bytes(content)
            for tested, evaluation in found.items():
                say(f"{name}: unseen scenes, {tested}: {evaluation}")
    if failures:
        raise RuntimeError(f"these trainings failed: {', '.join(failures)}; what was printed says why")


def _train(name: str, config: TrainConfig) -> tuple[dict[str, bytes], dict[str, Any]]:
    """Train on a machine of the cluster; return the files of the run, and how its student does."""
    if config.device == "cpu":
        limit_cores(1)
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary, name)
        found = train(folder, config)
        if config.wandb:
            importlib.import_module("wandb").finish()  # the process may train the next one
        return {file.name: file.read_bytes() for file in folder.iterdir() if file.is_file()}, found
