"""Trainings that need nothing of each other, such as several seeds, on a cluster of Ray."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from neurosim_core.data.ray_source import cluster
from neurosim_core.learn.train import Say, TrainConfig, train
from neurosim_core.render.launch import limit_cores


def train_population(
    folder: Path, configs: Mapping[str, TrainConfig], *, address: str = "auto", say: Say = print
) -> None:
    """Train with each of several settings, as many side by side as the cluster has GPUs, or cores, for.

    Runs come back from the machines where they were trained, with checkpoints, policies and logs.

    Args:
        folder: Of the runs: each in a folder there, of its name.
        configs: By name. With a CUDA device a training takes a GPU, `cuda:0` to it; else a core.
        address: See `data.ray_source.cluster`.
        say: Told what comes of each.
    """
    with cluster(address) as ray:
        left = {}
        for name, config in configs.items():
            gpus = int(config.device.startswith("cuda"))
            training = ray.remote(_train).options(num_cpus=1, num_gpus=gpus).remote(config)
            left[training] = name
        while left:
            (done,), _ = ray.wait([*left], num_returns=1)
            name = left.pop(done)
            files, found = ray.get(done)
            (folder / name).mkdir(parents=True, exist_ok=True)
            for file, content in files.items():
                (folder / name / file).write_bytes(content)
            for tested, evaluation in found.items():
                say(f"{name}: unseen scenes, {tested}: {evaluation}")


def _train(config: TrainConfig) -> tuple[dict[str, bytes], dict[str, Any]]:
    """Train on a machine of the cluster; return the files of the run, and how its student does."""
    if not config.device.startswith("cuda"):
        limit_cores(1)
    with tempfile.TemporaryDirectory() as folder:
        found = train(Path(folder), config)
        return {file.name: file.read_bytes() for file in Path(folder).iterdir()}, found
