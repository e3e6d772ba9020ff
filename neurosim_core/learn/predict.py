"""A network for depth or flow as a Cortex node: events of a running simulator in, pictures out."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from cortex import Node
from cortex.messages import Image
from neurosim_core.data import LiveSource, Stream
from neurosim_core.install import check_cortex
from neurosim_core.learn.dense_train import load_dense
from neurosim_core.live.topics import stream_topic

check_cortex()

_SILENT_S = 10.0
"""The simulator has ended if nothing comes for so long [s]."""
_ENCODINGS = {"depth": "32FC1", "flow": "32FC2"}


def predict(
    file: Path,
    *,
    vehicle: str = "drone",
    events: str = "events",
    device: str = "cpu",
    duration_s: float | None = None,
    say: Callable[[str], None] = print,
) -> int:
    """Publish what a network predicts at the end of each window, until its simulator is silent for 10 s.

    The network forgets when the simulator begins anew. The simulator waits for it rather than lose events.
    `file`: what `neurosim learn depth` or `flow` left. `duration_s`: stop after so much simulated time [s];
    None: never. Returns how many pictures were published.
    """
    net, config = load_dense(file)
    if config.task not in _ENCODINGS:
        raise ValueError(f"{file} is of `neurosim learn {config.task}`: only depth and flow are pictures")
    net.to(device)
    topic, encoding = stream_topic(vehicle, f"predicted/{config.task}"), _ENCODINGS[config.task]
    source = LiveSource(vehicles=[vehicle], timeout_s=_SILENT_S)
    options: dict[str, Any] = {
        "fields": ["events"],
        "sensors": {"events": events},
        "window_s": config.window_s,
    }
    memory, last_ns, count = None, -1, 0
    say(f"waiting for {vehicle}")
    with Node("predict") as node, torch.no_grad():
        publisher = node.publisher(topic, Image)
        for batch in Stream(source, batch=1, **options):
            if int(batch.start_ns[0]) != last_ns:  # another flight, or a window is missing
                memory = None
                say(f"{topic}: {config.task} from {events}, every {1e3 * config.window_s:g} ms")
            last_ns = int(batch.stamp_ns[0])
            predicted, memory = net(torch.from_numpy(batch.events.voxel(config.bins)).to(device), memory)
            picture = predicted[0].exp() if config.task == "depth" else predicted[0]
            data = np.ascontiguousarray(picture.movedim(0, -1).cpu().numpy())
            publisher.publish(Image(stamp_ns=last_ns, data=data, encoding=encoding, sequence=count))
            count += 1
            if duration_s is not None and last_ns >= 1e9 * duration_s:
                break
    say(f"{count} pictures")
    return count
