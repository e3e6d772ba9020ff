"""One of several processes that train a policy: arguments are a scene and a folder; prints a line of JSON."""

from __future__ import annotations

import hashlib
import json
import sys
from pathlib import Path
from typing import Any

import torch
from torch import distributed

import neurosim_core as ns
from neurosim_core.learn import ranks
from neurosim_core.learn.dagger import DaggerConfig
from neurosim_core.learn.ppo import PpoConfig
from neurosim_core.learn.train import TrainConfig, Training


def train(folder: Path, model: ns.Model, *, stops: tuple[tuple[int, int], ...] = ()) -> dict[str, Any]:
    """Train a little, and return what tells weights and flights apart; it is resumed after each stop."""
    torch.set_num_threads(1)
    config = TrainConfig(
        task="hover",
        device=ranks.join("cpu"),
        teacher=PpoConfig(worlds=4, iterations=2, horizon=6, epochs=2, minibatches=2, divergence=1e-9),
        student=DaggerConfig(worlds=4, iterations=2, horizon=6),
        pixels=8,
        block=1,
    )
    for part, until in enumerate((*stops, None)):
        training = Training(folder, config, say=lambda line: None, models=[model])
        if part > 0:
            distributed.barrier()  # the first process has left its checkpoint
            training.resume()
        training.run(until=until)
    digests = [
        hashlib.sha256(
            torch.cat([each.detach().flatten() for each in policy.parameters()]).numpy()
        ).hexdigest()
        for policy in (training.teacher, training.student)
        if policy is not None
    ]
    position = training.env.view.position.sum().item()
    return {"rank": ranks.rank(), "digests": digests, "position": position}


def main(scene: str, folder: str) -> None:
    mesh = {"kind": "mesh", "file": scene, "up_axis": "z", "unit_m": 1.0, "inside_m": [0.0, 0.0, 2.0]}
    settings = {
        "device": "cpu",
        "render": {"samples_per_pixel": 4},
        "scene": mesh,
        "path": {"kind": "hover"},
    }
    model = ns.make_model(ns.load_config(settings))
    found = train(Path(folder), model)
    resumed = train(Path(folder, "resumed"), model, stops=((1, 0), (2, 1)))
    print(json.dumps({**found, "resumed": resumed["digests"]}), flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
