"""Batches of windows, from recordings in any order, or from simulators in the order of time."""

from __future__ import annotations

import logging
import os
import weakref
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurosim_core.data.arguments import names_arguments
from neurosim_core.data.batch import Batch, Sample, collate
from neurosim_core.data.flights import RecordedFlight
from neurosim_core.data.shards import ShardFlight
from neurosim_core.data.windows import WindowConfig

_log = logging.getLogger(__name__)
_OPEN_MAX = 64
"""Largest number of open files."""


class Dataset:
    """The windows of recordings by index: a map-style data set for `torch.utils.data.DataLoader`.

    Use the loader with `collate_fn=ns.data.collate`. Reading does not start a device, so workers can be
    forked.

    Args:
        source: A recording, a file of events of any format (which is copied to a temporary recording), a
            shard (`write_shards`), a folder with such files or with a data set of `neurosim dataset`, or a
            list of these.
        window_s: Length of a window [s].
        stride_s: Time from one window to the next [s]; None: `window_s`.
        ends: Field whose packets end the windows, such as depth of MVSEC, which has irregular times; None:
            windows end at multiples of the stride.
        fields: Fields to read, of events, depth, flow, rgb, imu, pose; None: all that the source has.
        sensors: Name of the sensor for a field, such as {"depth": "depth_left"}; by default the first.

    Attributes:
        flights: The recordings, in the order of their paths.

    Raises:
        ValueError: A file is no recording or lacks a field, or all flights are shorter than a window.
        FileNotFoundError: There is no such file.
    """

    @names_arguments
    def __init__(
        self,
        source: str | Path | Sequence[str | Path],
        *,
        window_s: float = 0.05,
        stride_s: float | None = None,
        ends: str | None = None,
        fields: Sequence[str] | None = None,
        sensors: Mapping[str, str] | None = None,
    ) -> None:
        from neurosim_core.io.transfer import as_recording

        config = WindowConfig(
            window_s=window_s, stride_s=stride_s, ends=ends, fields=fields, sensors=sensors or {}
        )
        self.flights: list[RecordedFlight | ShardFlight] = []
        for path in find_recordings(source):
            if path.suffix == ".tar":
                self.flights.append(ShardFlight(path, config))
                continue
            files = ExitStack()
            flight = RecordedFlight(files.enter_context(as_recording(path)), config, name=str(path))
            weakref.finalize(flight, _close, files, os.getpid())
            self.flights.append(flight)
        self._tell_missing(config)
        self._begins = np.concatenate([[0], np.cumsum([len(flight) for flight in self.flights])])
        self._open: list[RecordedFlight | ShardFlight] = []

    @property
    def skipped_count(self) -> int:
        """Number of windows that were skipped because their ground truth is missing."""
        return sum(flight.skipped_count for flight in self.flights)

    def _tell_missing(self, config: WindowConfig) -> None:
        """Raise if no flight is as long as a window; warn if most windows have no ground truth."""
        count, skipped = sum(map(len, self.flights)), self.skipped_count
        spans_s = [1e-9 * flight.span_ns for flight in self.flights]
        if not count and max(spans_s) < config.window_s:
            hint = f"; if these are milliseconds, write {1e-3 * config.window_s:g}"
            raise ValueError(
                f"window_s = {config.window_s:g} fits into no flight, the longest has {max(spans_s):g} s of "
                f"events{hint if config.window_s >= 1.0 else ''}"
            )
        if skipped > count:
            _log.warning(
                "%d of %d windows are skipped: their ground truth is not stamped at their end; choose "
                "window_s or stride_s as multiples of its period, or fewer fields",
                skipped, skipped + count,
            )  # fmt: skip

    def __len__(self) -> int:
        return int(self._begins[-1])

    def __getitem__(self, index: int) -> Sample:
        if not -len(self) <= index < len(self):
            raise IndexError(f"there are {len(self)} windows, got index {index}")
        return self.read(index % len(self), 1)[0]

    def read(self, first: int, count: int) -> list[Sample]:
        """Return `count` consecutive windows from index `first`."""
        samples: list[Sample] = []
        while count > 0:
            number = int(np.searchsorted(self._begins, first, side="right")) - 1
            flight, offset = self.flights[number], first - int(self._begins[number])
            part = min(count, len(flight) - offset)
            samples += flight.read(offset, part)
            self._note_open(flight)
            first, count = first + part, count - part
        return samples

    def _note_open(self, flight: RecordedFlight | ShardFlight) -> None:
        if flight in self._open:
            return
        self._open.append(flight)
        if len(self._open) > _OPEN_MAX:
            self._open.pop(0).close()


class Position(NamedTuple):
    """The position in a stream."""

    epoch: int
    """Number of completed epochs."""
    batch: int
    """The next batch of this epoch."""


class Stream:
    """Batches of windows: events in (t0, t1], ground truth at t1.

    A loop over it reads one epoch. The order of recordings depends on `seed` and the number of the epoch
    alone, not on workers; `state_dict` and `load_state_dict` continue in the middle of an epoch.

    Args:
        source: A source of `Dataset`; settings or a settings file, flown in this process; a `Simulation`; or
            a source such as `LiveSource(...)` or `RaySource(...)`.
        window_s: Length of a window [s].
        stride_s: Time from one window to the next [s]; None: `window_s`.
        ends: Field whose packets end the windows, for recordings only; see `Dataset`.
        batch: Number of windows in a batch, a multiple of `sequence`; the last batch of an epoch may be
            smaller.
        fields: Fields to read, of events, depth, flow, rgb, imu, pose; None: all that the source has.
        sensors: Name of the sensor for a field; by default the first.
        shuffle: Read the sequences of recordings in random order.
        sequence: Number of consecutive windows that stay together, for networks with memory; also faster to
            read. An incomplete sequence at the end of a flight is skipped.
        seed: Seed of the order.
        rank: Index of this process among `ranks` processes, which divide the windows equally.
        ranks: Number of processes.
        transform: Function of a batch; the stream yields its result.

    Raises:
        ValueError: An argument is out of range, or is for recordings only.
    """

    @names_arguments
    def __init__(
        self,
        source: Any,
        *,
        window_s: float = 0.05,
        stride_s: float | None = None,
        ends: str | None = None,
        batch: int = 32,
        fields: Sequence[str] | None = None,
        sensors: Mapping[str, str] | None = None,
        shuffle: bool = False,
        sequence: int = 1,
        seed: int = 0,
        rank: int = 0,
        ranks: int = 1,
        transform: Callable[[Batch], Any] | None = None,
    ) -> None:
        if sequence < 1 or batch < 1 or batch % sequence:
            raise ValueError(
                f"batch must be a multiple of sequence, both at least 1: got {batch}, {sequence}"
            )
        if not 0 <= rank < ranks:
            raise ValueError(f"rank must be in [0, ranks), got {rank} of {ranks}")
        self._batch, self._sequence, self._shuffle, self._seed = batch, sequence, shuffle, seed
        self._rank, self._ranks, self._transform = rank, ranks, transform
        options: dict[str, Any] = {
            "window_s": window_s,
            "stride_s": stride_s,
            "ends": ends,
            "fields": fields,
            "sensors": sensors or {},
        }
        self._source = _sequential(source)
        self._data: Dataset | None = None
        if self._source is None:
            self._data = Dataset(source, **options)
        else:
            self._config = WindowConfig(**options)
            if shuffle or ranks > 1 or sequence > 1 or ends is not None:
                raise ValueError("shuffle, ranks, sequence and ends go with recordings, not with simulators")
        self._position = Position(0, 0)
        self._resume = False
        self._order: tuple[int, NDArray[np.int64]] | None = None
        """The epoch that was read last, and its plan."""

    @property
    def is_recorded(self) -> bool:
        """Whether it reads recordings."""
        return self._data is not None

    @property
    def skipped_count(self) -> int:
        """Number of windows that were skipped because their ground truth is missing."""
        source: Any = self._source if self._data is None else self._data
        return int(source.skipped_count)

    def __len__(self) -> int:
        """Return the number of batches of an epoch; TypeError for simulators, where nobody knows it."""
        if self._data is None:
            raise TypeError("how many windows a simulator gives is not known")
        return -(-len(self._plan(0)) // (self._batch // self._sequence))

    def __iter__(self) -> Iterator[Any]:
        epoch, begin = self._position.epoch, self._position.batch if self._resume else 0
        self._resume = False
        if self._data is None:
            batches = self._simulated()
        else:
            batches = (self.read(epoch, number) for number in range(begin, len(self)))
        for number, batch in enumerate(batches, begin):
            self._position = Position(epoch, number + 1)
            yield batch
        self._position = Position(epoch + 1, 0)

    def __getitem__(self, index: Any) -> Any:
        """Raise TypeError: PyTorch's DataLoader, for one, asks for windows by number."""
        raise TypeError(
            "a Stream is iterated; for PyTorch take ns.data.Loader, or a DataLoader of ns.data.Dataset"
        )

    def read(self, epoch: int, number: int) -> Any:
        """Return a batch of an epoch; recordings only."""
        assert self._data is not None
        if self._order is None or self._order[0] != epoch:
            self._order = epoch, self._plan(epoch)
        count, samples = self._batch // self._sequence, []
        firsts = self._order[1][number * count : (number + 1) * count]
        breaks = np.flatnonzero(np.diff(firsts) != self._sequence) + 1
        for run in np.split(firsts, breaks):  # those that follow on each other are read at once
            samples += self._data.read(int(run[0]), len(run) * self._sequence)
        return self._make_batch(samples)

    def state_dict(self) -> dict[str, int]:
        """Return where the stream is, for `load_state_dict`."""
        return self._position._asdict()

    def load_state_dict(self, state: Mapping[str, int]) -> None:
        """Let the next loop begin where a stream with the same arguments was; recordings only."""
        if self._data is None:
            raise ValueError("only recordings can be read from the middle on")
        self._position = Position(int(state["epoch"]), int(state["batch"]))
        self._resume = True

    def _simulated(self) -> Iterator[Any]:
        assert self._source is not None
        samples = self._source.samples(self._config)
        while taken := list(islice(samples, self._batch)):
            yield self._make_batch(taken)

    def _make_batch(self, samples: list[Sample]) -> Any:
        batch = collate(samples)
        return batch if self._transform is None else self._transform(batch)

    def _plan(self, epoch: int) -> NDArray[np.int64]:
        """Return the first window of each sequence of this rank, in the order of an epoch."""
        assert self._data is not None
        begin, parts = 0, []
        for flight in self._data.flights:
            parts.append(begin + np.arange(len(flight) // self._sequence) * self._sequence)
            begin += len(flight)
        firsts = np.concatenate(parts) if parts else np.zeros(0, np.int64)
        if self._shuffle:
            firsts = np.random.default_rng([self._seed, epoch]).permutation(firsts)
        share = len(firsts) // self._ranks
        return firsts[: share * self._ranks][self._rank :: self._ranks].astype(np.int64)


def find_recordings(source: str | Path | Sequence[str | Path]) -> list[Path]:
    """Return the files of a source: of folders all recordings and event files below, in alphabetical order.

    Texts, HDF5 and NPZ files in folders that hold no events, but poses say, are left out.
    """
    from neurosim_core.io import is_event_file

    if not isinstance(source, str | Path):
        return [path for one in source for path in find_recordings(one)]
    path = Path(source)
    if path.is_file() or (path.is_dir() and is_event_file(path)):
        return [path]
    files = (p for p in path.rglob("*") if p.name[0] != "." and p.exists())
    hits = {p for p in files if p.suffix == ".tar" or (is_event_file(p) and not _is_other(p))}
    found = sorted(p for p in hits if p.parent not in hits)  # what is in a bag is the bag's
    if not found:
        raise FileNotFoundError(
            f"{path} holds no recording" if path.is_dir() else f"no file or folder {path}"
        )
    return found


def _is_other(path: Path) -> bool:
    from neurosim_core.io import EventFileError, NoEventsError, check_events

    try:
        check_events(path)
    except NoEventsError as error:
        _log.warning("%s; it is left out", error)
        return True
    except (EventFileError, OSError):
        pass  # whoever reads it says so
    return False


def _close(files: ExitStack, pid: int) -> None:
    if os.getpid() == pid:  # not in a worker that was forked
        files.close()


def _sequential(source: Any) -> Any:
    """Return a source whose flights come once; None for recordings."""
    if hasattr(source, "samples"):
        return source
    if isinstance(source, str | Path) and Path(source).suffix in (".yaml", ".yml"):
        from neurosim_core.config import load_config

        source = load_config(source)
    if isinstance(source, str | Path) or (isinstance(source, Sequence) and not isinstance(source, Mapping)):
        return None
    from neurosim_core.data.sources import RunSource, WorldsSource

    if hasattr(source, "rollout"):
        return WorldsSource(source)
    return RunSource(source)
