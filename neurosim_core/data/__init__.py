"""Data for learning: windows of events with ground truth, from recordings, simulators and event files."""

from __future__ import annotations

from typing import TYPE_CHECKING

from neurosim_core.lazy import lazy_names

if TYPE_CHECKING:  # isort: off
    from neurosim_core.data.batch import (
        Batch as Batch,
        EventBatch as EventBatch,
        Sample as Sample,
        collate as collate,
    )
    from neurosim_core.data.live import LiveSource as LiveSource
    from neurosim_core.data.ray_source import (
        RaySource as RaySource,
        cluster as cluster,
    )
    from neurosim_core.data.shards import write_shards as write_shards
    from neurosim_core.data.sources import RunSource as RunSource
    from neurosim_core.data.stream import (
        Dataset as Dataset,
        Stream as Stream,
    )
    from neurosim_core.data.torch_loader import (
        Loader as Loader,
        as_tensors as as_tensors,
    )
    from neurosim_core.data.windows import WindowConfig as WindowConfig

__getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
