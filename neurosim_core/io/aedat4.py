"""AEDAT4 files of iniVation, and Event Stream files (`.es`), through faery."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from neurosim_core.install import need
from neurosim_core.io.event_file import EventFileError, EventSource, events_of, split_blocks
from neurosim_core.packets import EventArrays

_PACKET_EVENTS = 8192
_SIZE_MAX = 1 << 15


class Aedat4Source(EventSource):
    """Reads the first stream of events of an AEDAT4 file."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._faery = _import_faery()
        with open(path, "rb") as file:
            if file.read(14) != b"#!AER-DAT4.0\r\n":
                raise EventFileError(f"{path} is not an AEDAT4 file")
        tracks = [track for track in self._decoder().tracks() if track.data_type == "events"]
        if not tracks:
            raise EventFileError(f"{path} holds no events")
        self._track = tracks[0].id
        self.size = tracks[0].dimensions

    def read(self) -> Iterator[EventArrays]:
        """See `EventSource.read`."""
        for track, events in _whole(self._path, self._decoder()):
            if track.id == self._track and len(events):
                yield _columns(events)

    def _decoder(self) -> Any:
        try:
            return self._faery.aedat.Decoder(self._path)
        except BaseException as error:
            raise _damage(self._path, error) from None


class EsSource(EventSource):
    """Reads a file of Event Stream (loris, expelliarmus), of a DVS or an ATIS; their y counts from below."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        faery = _import_faery()
        with open(path, "rb") as file:
            if file.read(12) != b"Event Stream":
                raise EventFileError(f"{path} is not a file of Event Stream")
        try:
            self._stream = faery.events_stream_from_file(path, file_type="es")
            self.size = self._stream.dimensions()
        except BaseException as error:
            raise _damage(path, error) from None

    def read(self) -> Iterator[EventArrays]:
        """See `EventSource.read`."""
        for events in _whole(self._path, iter(self._stream)):
            if len(events):
                yield _columns(events)


class Aedat4Sink:
    """Writes an AEDAT4 file, compressed with LZ4."""

    def __init__(self, path: Path, *, width: int, height: int) -> None:
        faery = _import_faery()
        if max(width, height) > _SIZE_MAX:
            raise EventFileError(f"AEDAT4 files hold at most 32768 x 32768 pixels, not {width} x {height}")
        self._dtype = faery.EVENTS_DTYPE
        self._path = path
        node, attribute = faery.aedat.DescriptionNode, faery.aedat.DescriptionAttribute
        size = {"sizeX": attribute("int", width), "sizeY": attribute("int", height)}
        place = "/mainloop/Recorder/outInfo/"
        info = node("info", f"{place}0/info/", {**size, "source": attribute("string", "Neurosim")}, [])
        stream = {"compression": "LZ4", "originalOutputName": "events", "typeIdentifier": "EVTS"}
        attributes = {name: attribute("string", value) for name, value in stream.items()}
        tree = [node("outInfo", place, {}, [node("0", f"{place}0/", attributes, [info])])]
        with _disk_errors():
            self._encoder: Any = faery.aedat.Encoder(path, tree, faery.aedat.LZ4_DEFAULT)
            self._encoder.__enter__()

    def write(self, events: EventArrays) -> None:
        """See `EventSink.write`."""
        for block in split_blocks(events, _PACKET_EVENTS):
            if int(block.t[0]) < 0:
                raise EventFileError(f"{self._path}: AEDAT4 files hold no time before 0, got {block.t[0]} us")
            records = np.empty(len(block.t), self._dtype)
            for name, column in zip(records.dtype.names or (), block, strict=True):
                records[name] = column
            with _disk_errors():
                self._encoder.write(0, records)

    def close(self) -> None:
        """Complete the file."""
        with _disk_errors():
            self._encoder.__exit__(None, None, None)


@contextlib.contextmanager
def _disk_errors() -> Iterator[None]:
    """Turn what faery raises on a full disk into an OSError."""
    try:
        yield
    except RuntimeError as error:
        raise OSError(str(error)) from None


def _whole(path: Path, blocks: Iterator[Any]) -> Iterator[Any]:
    """Yield what can be decoded; what faery raises for the rest, panics too, tells of damage."""
    while True:
        try:
            block = next(blocks)
        except StopIteration:
            return
        except BaseException as error:
            raise _damage(path, error) from None
        yield block


def _columns(events: Any) -> EventArrays:
    return events_of(*(events[name] for name in ("t", "x", "y", "on" if "on" in events.dtype.names else "p")))


def _import_faery() -> Any:
    return need("AEDAT4 and Event Stream files need faery", "formats", "faery")


def _damage(path: Path, error: BaseException) -> BaseException:
    """Return what to raise for an error of faery: a panic of its Rust code is no Exception."""
    if isinstance(error, KeyboardInterrupt | SystemExit | GeneratorExit | MemoryError):
        return error
    return EventFileError(f"{path} is damaged: {str(error) or type(error).__name__}")
