"""Data for learning: windows of events with ground truth, from recordings, simulators and event files."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from neurosim_core.data.batch import Batch, EventBatch, Sample, collate
    from neurosim_core.data.live import LiveSource
    from neurosim_core.data.ray_source import RaySource
    from neurosim_core.data.shards import write_shards
    from neurosim_core.data.stream import Dataset, Stream
    from neurosim_core.data.tonic import TonicDataset
    from neurosim_core.data.torch_loader import Loader, as_tensors

_HOME = {
    "Batch": "batch",
    "Dataset": "stream",
    "EventBatch": "batch",
    "LiveSource": "live",
    "Loader": "torch_loader",
    "RaySource": "ray_source",
    "Sample": "batch",
    "Stream": "stream",
    "TonicDataset": "tonic",
    "as_tensors": "torch_loader",
    "collate": "batch",
    "write_shards": "shards",
}

__all__ = [
    "Batch",
    "Dataset",
    "EventBatch",
    "LiveSource",
    "Loader",
    "RaySource",
    "Sample",
    "Stream",
    "TonicDataset",
    "as_tensors",
    "collate",
    "write_shards",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'neurosim_core.data' has no attribute {name!r}, known: {__all__}")
    return getattr(importlib.import_module(f"neurosim_core.data.{_HOME[name]}"), name)
