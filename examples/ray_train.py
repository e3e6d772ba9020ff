"""Train depth from events with Ray: Ray Data prepares windows, Ray Train distributes them to workers."""

from __future__ import annotations

import io
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

import neurosim_core as ns

try:
    import ray.train.torch
    import torch
except ImportError as error:
    raise SystemExit(
        f"this example needs Ray and PyTorch ({error}): pip install -e '.[distributed]'"
    ) from None

LENS = {"width": 32, "height": 24, "horizontal_fov_rad": 1.5}
CONFIG = {
    "duration_s": 1.0,
    "scene": {"kind": "apartment", "rooms": 1},
    "sensors": {
        "events": {"kind": "event_camera", "lens": LENS},
        "depth": {"kind": "depth", "rate_hz": 20.0, "lens": LENS},
    },
}


def voxel_and_depth(row: dict[str, Any]) -> dict[str, Any]:
    """Return what the network takes of a window."""
    events = ns.packets.EventArrays(**np.load(io.BytesIO(row["events.npz"])))
    batch = ns.data.collate([ns.data.Sample(**row["json"], events=events)])
    return {"voxel": batch.events.voxel(5)[0], "depth": row["depth.npy"]}


def train() -> None:
    """Train in one of the workers; PyTorch averages their gradients."""
    net = ray.train.torch.prepare_model(ns.learn.DenseNet((0.7,), channels=4))
    optimizer = torch.optim.Adam(net.parameters(), lr=3e-3)
    shard = ray.train.get_dataset_shard("train")
    for _ in range(4):
        for batch in shard.iter_torch_batches(batch_size=5, dtypes=torch.float32):
            predicted, _ = net(batch["voxel"])
            loss = ns.learn.depth_loss(predicted, batch["depth"][:, None])
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
    told = {"loss": loss.item(), "workers": ray.train.get_context().get_world_size()}
    with tempfile.TemporaryDirectory() as folder:
        torch.save(net.state_dict(), Path(folder, "depth.pt"))
        ray.train.report(told, checkpoint=ray.train.Checkpoint.from_directory(folder))


def main() -> dict[str, Any]:
    """Return the last loss of worker 0, and how many workers there were."""
    with tempfile.TemporaryDirectory() as name, ns.data.cluster("local"):
        shards = Path(name, "shards")
        ns.data.write_shards(
            ns.data.RunSource(CONFIG).samples(ns.data.WindowConfig(window_s=0.05)), shards, windows=5
        )
        trainer = ray.train.torch.TorchTrainer(
            train,
            datasets={"train": ray.data.read_webdataset(str(shards)).map(voxel_and_depth)},
            scaling_config=ray.train.ScalingConfig(num_workers=2, resources_per_worker={"CPU": 0.4}),
            run_config=ray.train.RunConfig(storage_path=name),
        )
        told = trainer.fit().metrics
    print(f"{told['workers']} workers, loss {told['loss']:.3f}")
    return dict(told)


if __name__ == "__main__":
    main()
