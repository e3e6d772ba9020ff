"""Trainings on a cluster of Ray: several seeds side by side, or one policy by several machines."""

from __future__ import annotations

import dataclasses
import importlib
import os
import socket
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from neurosim_core.data.ray_source import cluster
from neurosim_core.learn.train import Say, TrainConfig, is_for_cuda, train
from neurosim_core.render.launch import limit_cores


def train_population(
    folder: Path,
    configs: Mapping[str, TrainConfig],
    *,
    address: str = "auto",
    workers: int = 1,
    say: Say = print,
) -> None:
    """Train with each of several settings, as many side by side as the cluster has GPUs, or cores, for.

    Runs come back from the machines where they were trained, with checkpoints, policies and logs. One that
    fails does not end the others. Where the cluster is too small for one, that is said: it may grow.
    `folder`: of the runs: each in a folder there, of its name. `address`: see `data.ray_source.cluster`.
    `workers`: processes that train one policy, on any machines of the cluster, each with worlds of its own
    (see `ranks`). With a CUDA device each takes a GPU, `cuda:0` to it; else a core.
    """
    if not configs or workers < 1:
        raise ValueError(f"needs 1 training and 1 worker at least, got {len(configs)} and {workers}")
    held = [name for name in configs if (folder / name / "checkpoint.pt").exists()]
    if held:
        raise ValueError(f"{folder} holds the runs {', '.join(held)}: choose another folder")
    failures = []
    with cluster(address) as ray:
        left: dict[Any, str] = {}
        groups: dict[str, Any] = {}
        try:
            for name, config in configs.items():
                if lacking := _lacking(ray, config, workers):
                    say(f"{name} waits: the cluster has {lacking}")
                groups[name], trainings = _begin(ray, name, config, workers)
                left |= dict.fromkeys(trainings, name)
            while left:
                (done,), _ = ray.wait([*left], num_returns=1)
                name = left.pop(done)
                try:
                    files, found = ray.get(done)
                except ray.exceptions.RayError as error:
                    failures.append(name)
                    say(f"{name} failed: {error}")
                    left = {training: other for training, other in left.items() if other != name}
                else:
                    for file, content in files.items():
                        (folder / name).mkdir(parents=True, exist_ok=True)
                        (folder / name / file).write_bytes(content)
                    for tested, evaluation in found.items():
                        say(f"{name}: unseen scenes, {tested}: {evaluation}")
                if name not in left.values():
                    ray.util.remove_placement_group(groups.pop(name))  # ends its processes
        finally:  # after an interruption, too: those of a process stay as long as it does
            for group in groups.values():
                ray.util.remove_placement_group(group)
    if failures:
        raise RuntimeError(f"these trainings failed: {', '.join(failures)}; see their output above")


def _needs(config: TrainConfig) -> dict[str, int]:
    """Return what a worker needs, by Ray's names."""
    return {"CPU": 1, **({"GPU": 1} if is_for_cuda(config.device) else {})}


def _lacking(ray: Any, config: TrainConfig, workers: int) -> str:
    """Return what the cluster as it is has too few of for a training, and how many."""
    there = ray.cluster_resources()
    return ", ".join(
        f"{there.get(name, 0):g} of {workers * count} {name}s"
        for name, count in _needs(config).items()
        if there.get(name, 0) < workers * count
    )


def _begin(ray: Any, name: str, config: TrainConfig, workers: int) -> tuple[Any, list[Any]]:
    """Return what is reserved for a training, all of it or nothing, and what its workers will return."""
    cuda = is_for_cuda(config.device)
    config = dataclasses.replace(config, device="cuda:0" if cuda else "cpu")
    group = ray.util.placement_group([_needs(config)] * workers)
    placed = ray.util.scheduling_strategies.PlacementGroupSchedulingStrategy(group)
    worker = ray.remote(_Worker).options(num_cpus=1, num_gpus=int(cuda), scheduling_strategy=placed)
    started = [worker.remote() for _ in range(workers)]
    meeting = started[0].free_port.remote()
    return group, [
        each.train.remote(name, config, rank, workers, meeting) for rank, each in enumerate(started)
    ]


class _Worker:
    """A process on a machine of the cluster, which trains alone or with others."""

    def free_port(self) -> tuple[str, int]:
        """Return where others can meet this process."""
        ray = importlib.import_module("ray")
        with socket.socket() as found:
            found.bind(("", 0))
            return ray.util.get_node_ip_address(), found.getsockname()[1]

    def train(
        self, name: str, config: TrainConfig, rank: int, workers: int, meeting: tuple[str, int]
    ) -> tuple[dict[str, bytes], dict[str, Any]]:
        """Train; return the files of the run, and how its student does: nothing, but of rank 0."""
        if config.device == "cpu":
            limit_cores(1)
        host, port = meeting
        who = {"RANK": rank, "LOCAL_RANK": 0, "WORLD_SIZE": workers, "MASTER_ADDR": host, "MASTER_PORT": port}
        os.environ |= {key: str(value) for key, value in who.items()}
        with tempfile.TemporaryDirectory() as temporary:
            folder = Path(temporary, name)
            found = train(folder, config)
            if config.wandb and rank == 0:
                importlib.import_module("wandb").finish()
            return {file.name: file.read_bytes() for file in folder.iterdir() if file.is_file()}, found
