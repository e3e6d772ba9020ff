"""NPZ files of NumPy: arrays t (int64 [us]), x, y (uint16), p (uint8), and width and height.

`np.load` opens them. Both directions hold all events in memory, 13 bytes each, as `np.load` does.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from neurosim_core.io.event_file import (
    EventFileError,
    EventSource,
    NoEventsError,
    events_of,
    in_microseconds,
    split_blocks,
)
from neurosim_core.packets import EventArrays, join_events

_OTHER_NAMES = {"t": ("ts", "timestamps"), "x": (), "y": (), "p": ("polarity",)}
_NAMES = {"width", "height", *_OTHER_NAMES, *(other for others in _OTHER_NAMES.values() for other in others)}


class NpzSource(EventSource):
    """Reads an NPZ file; `polarity` and `ts` or `timestamps` are other names for p and t."""

    def __init__(self, path: Path, *, unit_us: float | None = None) -> None:
        super().__init__(path)
        self.knows_unit = unit_us is not None
        with open(path, "rb") as file:
            try:
                with np.load(file, allow_pickle=False) as archive:
                    found = {name: archive[name] for name in archive.files if name in _NAMES}
            except Exception as error:  # what NumPy raises for damage is not listed anywhere
                raise EventFileError(f"{path} is not a whole NPZ file: {error}") from None
        columns = []
        for name, others in _OTHER_NAMES.items():
            key = next((n for n in (name, *others) if n in found), None)
            if key is None:
                raise NoEventsError(f"{path} has no array {name!r}, only {sorted(found)}")
            columns.append(found[key])
        shapes = {column.shape for column in columns}
        if len(shapes) > 1 or columns[0].ndim != 1 or any(c.dtype.kind not in "iub" for c in columns):
            kinds = ", ".join(f"{column.dtype} {column.shape}" for column in columns)
            raise EventFileError(f"{path}: t, x, y and p must be as long, and whole numbers: got {kinds}")
        try:
            self._events = events_of(in_microseconds(columns[0], unit_us), *columns[1:])
        except ValueError as error:
            raise EventFileError(f"{path}: {error}") from None
        known = [found[name] for name in ("width", "height") if name in found]
        sized = len(known) == 2 and all(array.size == 1 for array in known)
        self.size = (int(known[0].item()), int(known[1].item())) if sized else None

    def read(self) -> Iterator[EventArrays]:
        """See `EventSource.read`."""
        yield from split_blocks(self._events)


class NpzSink:
    """Writes an NPZ file when it is closed."""

    def __init__(self, path: Path, *, width: int, height: int) -> None:
        self._path, self._size = path, (width, height)
        self._blocks: list[EventArrays] = []
        path.touch()  # says now that it cannot be written

    def write(self, events: EventArrays) -> None:
        """See `EventSink.write`."""
        self._blocks.append(events)

    def close(self) -> None:
        """Complete the file."""
        (width, height), (t, x, y, p) = self._size, join_events(self._blocks)
        with open(self._path, "wb") as file:  # a path would get the suffix .npz
            np.savez_compressed(file, width=width, height=height, t=t, x=x, y=y, p=p)
