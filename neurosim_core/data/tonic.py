"""Windows as data sets of tonic have them: events as a structured array, and a target."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from neurosim_core.data.stream import Dataset


class TonicDataset:
    """Pairs of events and ground truth, for the transforms, slicers and caches of tonic.

    Tonic itself is not needed to read them.

    Args:
        source: As for `Dataset`.
        target: Field that is the target, or several: then a tuple.
        transform: Called with the events, such as `tonic.transforms.ToVoxelGrid(ds.sensor_size, 5)`.
        target_transform: Called with the target.
        transforms: Called with both, returns both; instead of the other two.
        window_s: Length of a window [s].
        options: As for `Dataset`.

    Attributes:
        sensor_size: Width, height, and 2 for the polarities.
        ordering: Names of an event's fields.

    Raises:
        ValueError: As for `Dataset`; there is no window, or sensors differ in size.
    """

    dtype: ClassVar[Any] = np.dtype([("x", np.int16), ("y", np.int16), ("t", np.int64), ("p", np.int8)])
    ordering: ClassVar[tuple[str, ...]] = ("x", "y", "t", "p")

    def __init__(
        self,
        source: str | Path | Sequence[str | Path],
        *,
        target: str | Sequence[str] = "depth",
        transform: Callable[[Any], Any] | None = None,
        target_transform: Callable[[Any], Any] | None = None,
        transforms: Callable[[Any, Any], tuple[Any, Any]] | None = None,
        window_s: float = 0.05,
        **options: Any,
    ) -> None:
        if transforms is not None and (transform is not None or target_transform is not None):
            raise ValueError("transforms goes instead of transform and target_transform, not beside them")
        self._targets = (target,) if isinstance(target, str) else tuple(target)
        self._alone = isinstance(target, str)
        self._windows = Dataset(source, window_s=window_s, fields=["events", *self._targets], **options)
        if not len(self._windows):
            raise ValueError(f"{source} has no window of {window_s:g} s")
        first = self._windows[0]
        self.sensor_size = (first.width, first.height, 2)
        self._transform, self._target_transform, self._both = transform, target_transform, transforms

    def __len__(self) -> int:
        return len(self._windows)

    def __getitem__(self, index: int) -> tuple[Any, Any]:
        sample = self._windows[index]
        if (sample.width, sample.height, 2) != self.sensor_size:
            raise ValueError(f"{sample.source} has another sensor than {self.sensor_size[:2]}")
        assert sample.events is not None
        events: Any = np.empty(len(sample.events.t), self.dtype)
        for name, values in zip("txyp", sample.events, strict=True):
            events[name] = values
        found = tuple(getattr(sample, name) for name in self._targets)
        target: Any = found[0] if self._alone else found
        if self._both is not None:
            return self._both(events, target)
        events = events if self._transform is None else self._transform(events)
        return events, target if self._target_transform is None else self._target_transform(target)
