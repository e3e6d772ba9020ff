"""Sinks for the packets of a flight, by kind: files, viewers, other processes; `sinks` of the settings."""

from __future__ import annotations

import contextlib
import importlib.util
import math
import shutil
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Protocol

from pydantic import Field, field_validator

from neurosim_core.clock import NS_PER_S
from neurosim_core.install import install_hint
from neurosim_core.packets import Events, Packet
from neurosim_core.registry import register
from neurosim_core.settings import BaseConfig

if TYPE_CHECKING:
    from neurosim_core.io.event_file import EventWriter
    from neurosim_core.record.header import RecordingHeader
    from neurosim_core.sensors.base import SensorConfig
    from neurosim_core.sim.model import Model

_ROOM_BYTES = 32_000_000
"""When less is left on the disk, sinks that can give way do [bytes]."""
_CHECK_S = 1.0


class Sink(Protocol):
    """Takes the packets of one flight."""

    def write(self, packet: Packet) -> None:
        """Take a packet; they come in the order of time.

        Raises:
            OSError: It cannot be written: the flight ends.
        """

    def close(self, *, complete: bool = True) -> None:
        """Complete what was written. Closing twice is allowed.

        Args:
            complete: All that was to be written was.

        Raises:
            OSError: It cannot be written.
        """


@dataclass(frozen=True, kw_only=True, eq=False)
class SinkContext:
    """The context that a sink is opened in."""

    name: str
    """The sink's name in the settings."""
    folder: Path
    """Folder of the flight; it exists."""
    stem: str
    """Prefix of the file names: flight; after a reset of a live run flight-2, ..."""
    model: Model
    """The model of the flight."""
    header: RecordingHeader
    """Header of a recording: settings, sensors and path."""
    begin_s: float = field(default_factory=time.perf_counter)
    """When the flight began, as `time.perf_counter` says [s]: its real-time factor counts from there."""
    on_stop: list[Callable[[], object]] = field(default_factory=list)
    """Functions that a signal handler calls to end the flight. A sink that waits for other processes adds a
    function that ends the wait."""


class SinkConfig(BaseConfig):
    """Base class of the settings of sinks. Subclasses add `kind`, their fields, and `open`."""

    kind: str
    """Name under which the class is registered."""

    library: ClassVar[tuple[str, str] | None] = None
    """A required library and the extra that installs it; without the library, the sink is skipped."""
    is_live: ClassVar[bool] = True
    """Whether `neurosim serve --record` uses it."""
    is_optional: ClassVar[bool] = False
    """Whether the flight continues without it after a write error, such as a full disk."""
    again: ClassVar[str] = ""
    """Hint how to make its file from flight.h5 after an error; {folder} is the folder of the flight."""

    def is_installed(self) -> bool:
        """Whether the required library is installed."""
        return self.library is None or importlib.util.find_spec(self.library[0]) is not None

    def file(self, stem: str) -> str:
        """Return the name of its file; empty: no file."""
        return ""

    def prepare(self) -> None:
        """Start processes early, before other set-up work."""

    def load(self) -> None:
        """Import libraries, in a thread beside other set-up work."""

    def check(self, name: str, sensors: Mapping[str, SensorConfig]) -> None:
        """Check early that `open` can handle a flight with these sensors.

        Args:
            name: The sink's name in the settings.
            sensors: Sensors of the flight, by name.

        Raises:
            ValueError: A sensor that it needs is missing.
            ImportError: A library that it needs is not installed.
        """

    def open(self, context: SinkContext) -> Sink:
        """Return the sink of one flight.

        Raises:
            OSError: Its output cannot be written.
        """
        raise NotImplementedError


@register("sink", "hdf5")
class Hdf5SinkConfig(SinkConfig):
    """The recording, flight.h5: all packets of all sensors, written by a separate process."""

    kind: Literal["hdf5"] = "hdf5"
    library = ("h5py", "record")

    def file(self, stem: str) -> str:
        """Return the name of the recording."""
        return f"{stem}.h5"

    def prepare(self) -> None:
        """Start the writing process."""
        from neurosim_core.record.process import start_process

        if self.is_installed():
            start_process()

    def open(self, context: SinkContext) -> Sink:
        """Return the sink that sends packets to the writing process."""
        from neurosim_core.record.process import RecordingProcess

        return RecordingProcess(context.folder / self.file(context.stem), context.header)


@register("sink", "rerun")
class RerunSinkConfig(SinkConfig):
    """A file of the Rerun viewer, flight.rrd; `neurosim view` can also make it from the recording."""

    kind: Literal["rerun"] = "rerun"
    library = ("rerun", "view")
    is_live = False
    is_optional = True
    again = "`neurosim view {folder} --save FILE.rrd` makes it from flight.h5"

    def file(self, stem: str) -> str:
        """Return the name of the file."""
        return f"{stem}.rrd"

    def load(self) -> None:
        """Import Rerun."""
        from neurosim_core.view.rerun_sdk import import_rerun

        import_rerun()

    def open(self, context: SinkContext) -> Sink:
        """Return the writer."""
        from neurosim_core.view.sinks import RerunSink

        return RerunSink(context.folder / self.file(context.stem), context)


@register("sink", "overview")
class OverviewSinkConfig(SinkConfig):
    """A picture of the flight on one page, overview.png."""

    kind: Literal["overview"] = "overview"
    library = ("matplotlib", "view")
    is_live = False
    is_optional = True

    def file(self, stem: str) -> str:
        """Return the name of the picture."""
        return "overview.png"

    def open(self, context: SinkContext) -> Sink:
        """Return the sink that draws it."""
        from neurosim_core.view.sinks import OverviewSink

        return OverviewSink(context.folder / self.file(context.stem), context)


def default_sinks() -> dict[str, SinkConfig]:
    """Return the default sinks."""
    return {"recording": Hdf5SinkConfig(), "rerun": RerunSinkConfig(), "overview": OverviewSinkConfig()}


def check_files(sinks: Mapping[str, SinkConfig]) -> Mapping[str, SinkConfig]:
    """Return the sinks if no two of them write the same file.

    Raises:
        ValueError: Two sinks write the same file.
    """
    writers: dict[str, str] = {}
    for name, sink in sinks.items():
        file = sink.file("flight")
        if file and writers.setdefault(file, name) is not name:
            raise ValueError(f"{name} would write {file}, and so does {writers[file]}: give one another name")
    return sinks


@register("sink", "event_file")
class EventFileSinkConfig(SinkConfig):
    """The events of one camera in a format of other tools, such as events.raw; a bag has all sensors."""

    kind: Literal["event_file"] = "event_file"
    name: Annotated[str, Field(pattern=r"^[^/]+$")]
    """File name; the suffix sets the format, as in `neurosim convert`: events.raw, events.aedat4, a.mcap."""
    sensor: str = ""
    """Name of the event camera; empty: the first."""

    @field_validator("name")
    @classmethod
    def _can_be_written(cls, name: str) -> str:
        from neurosim_core.io.formats import FORMATS, format_of

        if not FORMATS[format_of(Path(name))].sink:
            raise ValueError(f"{name}: this format is only read")
        return name

    def file(self, stem: str) -> str:
        """Return the name of the file."""
        return self.name if stem == "flight" else f"{stem}-{self.name}"

    def check(self, name: str, sensors: Mapping[str, SensorConfig]) -> None:
        """Write a file without events elsewhere.

        Raises:
            ValueError: There is no such camera, or the format cannot hold its pixels.
            ImportError: A library of the format is not installed.
        """
        with tempfile.TemporaryDirectory() as folder:
            self.create(name, sensors, Path(folder) / self.name)[1].close()

    def create(self, name: str, sensors: Mapping[str, SensorConfig], file: Path) -> tuple[str, EventWriter]:
        """Return the name of the camera and the writer of its events; arguments and errors as for `check`."""
        from neurosim_core.io import create_events
        from neurosim_core.record.header import describe_sensors

        cameras = {s.name: s.intrinsics for s in describe_sensors(sensors) if s.has_events and s.intrinsics}
        camera = self.sensor or next(iter(cameras), "")
        if camera not in cameras:
            if not cameras:
                raise ValueError(f"sinks.{name}: needs an event camera, and there is none")
            known = ", ".join(cameras)
            raise ValueError(f"sinks.{name}: no event camera {camera!r}, known: {known}")
        return camera, create_events(file, width=cameras[camera].width, height=cameras[camera].height)

    def open(self, context: SinkContext) -> Sink:
        """Return the writer; errors as for `check`."""
        file = context.folder / self.file(context.stem)
        return _EventFileSink(*self.create(context.name, context.model.config.sensors, file))


class _EventFileSink:
    """Writes the events of a camera, and other packets where the format has a place for them."""

    def __init__(self, sensor: str, writer: EventWriter) -> None:
        self._sensor, self._writer = sensor, writer

    def write(self, packet: Packet) -> None:
        """Append a packet."""
        if not isinstance(packet, Events):
            if self._writer.write_packet is not None:
                self._writer.write_packet(packet)
        elif packet.sensor == self._sensor:
            self._writer.write(packet.numpy())

    def close(self, *, complete: bool = True) -> None:
        """Complete the file."""
        self._writer.close()


class Sinks:
    """The sinks of one flight, as one. A context manager."""

    def __init__(
        self, settings: Mapping[str, SinkConfig], *, say: Callable[[str], None], **context: Any
    ) -> None:
        """Open them.

        Args:
            settings: By name.
            say: Told what is left out or given up.
            context: `folder`, `stem`, `model`, `header` and, where there are any, `begin_s` and `on_stop` of
                `SinkContext`.

        Raises:
            OSError, ValueError: One cannot be opened.
        """
        self._settings, self._say = dict(settings), say
        self._context = context
        self._open: dict[str, Sink] = {}
        self._checked_s = -math.inf  # so before the first packet is written
        with contextlib.ExitStack() as opened:
            opened.callback(self.abandon)
            for name, each in settings.items():
                if each.library is not None and not each.is_installed():
                    say(f"{self._title(name)} is left out: {install_hint(each.library[1])}")
                    continue
                self._open[name] = each.open(SinkContext(name=name, **context))
            opened.pop_all()

    def write(self, packet: Packet) -> None:
        """Hand a packet to all.

        Raises:
            OSError: One that does not give way cannot be written; the message says up to when it is kept.
        """
        if time.monotonic() - self._checked_s >= _CHECK_S:
            self._make_room()
        for name in [*self._open]:
            self._try(name, lambda sink: sink.write(packet))

    def close(self, *, complete: bool = True) -> None:
        """Close all. Closing twice is allowed.

        Raises:
            OSError: One that does not give way cannot be written.
        """
        with contextlib.ExitStack() as stack:  # each of them, whatever another one raises
            stack.callback(self._open.clear)
            for name in reversed([*self._open]):
                stack.callback(self._try, name, lambda sink: sink.close(complete=complete))

    def __enter__(self) -> Sinks:
        return self

    def __exit__(self, *_: object) -> None:
        self.abandon()

    def abandon(self) -> None:
        """Close what is open as incomplete, after an error that will be told."""
        for sink in self._open.values():
            with contextlib.suppress(Exception):  # each of them, whatever another one raises
                sink.close(complete=False)
        self._open.clear()

    def _try(self, name: str, act: Callable[[Sink], None]) -> None:
        sink = self._open[name]
        try:
            act(sink)
        except OSError as error:
            if self._settings[name].is_optional:
                self._give_up(name, str(error))
                return
            kept_ns: int | None = getattr(sink, "kept_ns", None)
            if kept_ns is None:
                raise OSError(f"sinks.{name}: {error}") from error
            kept = f"{self._title(name)} is kept up to {kept_ns / NS_PER_S:.3f} s"
            raise OSError(f"{error}; {kept}") from error

    def _make_room(self) -> None:
        """Give up optional files before they take the last space of the disk from others."""
        self._checked_s = time.monotonic()
        optional = [name for name in self._open if self._settings[name].is_optional and self._has_file(name)]
        if not optional or len(optional) == len(self._open):
            return
        if shutil.disk_usage(self._context["folder"]).free < _ROOM_BYTES:
            for name in optional:
                self._give_up(name, f"less than {_ROOM_BYTES / 1e6:g} MB are left on the disk")

    def _give_up(self, name: str, why: str) -> None:
        with contextlib.suppress(OSError):
            self._open.pop(name).close(complete=False)
        if self._has_file(name):
            self._path(name).unlink()
        again = self._settings[name].again.format(folder=self._context["folder"])
        self._say(f"{self._title(name)} is given up: {why}" + (f"; {again}" if again else ""))

    def _has_file(self, name: str) -> bool:
        return self._settings[name].file(self._context["stem"]) != "" and self._path(name).is_file()

    def _path(self, name: str) -> Path:
        folder: Path = self._context["folder"]
        return folder / self._title(name)

    def _title(self, name: str) -> str:
        return self._settings[name].file(self._context["stem"]) or name
