"""The formats of event files by name: how to open one, and how to make one."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

from neurosim_core.io.event_file import UNITS_US, EventFileError, EventReader, EventSource, EventWriter
from neurosim_core.io.hdf5_events import damage_of, open_hdf5
from neurosim_core.record.disk import naming_file
from neurosim_core.record.hdf5 import FORMAT


class Format(NamedTuple):
    """One format."""

    module: str
    """Module of `neurosim_core.io` with its classes, imported on first use."""
    source: str
    sink: str
    """Empty: it is only read."""
    suffixes: tuple[str, ...]
    options: dict[str, Any]
    """More arguments of its sink."""


FORMATS = {
    "evt3": Format("raw", "RawSource", "RawSink", (".raw",), {}),
    "evt2": Format("raw", "RawSource", "RawSink", (".evt2.raw",), {"encoding": "evt2"}),
    "dat": Format("dat", "DatSource", "DatSink", (".dat",), {}),
    "csv": Format("csv", "CsvSource", "CsvSink", (".csv", ".txt"), {}),
    "npz": Format("npz", "NpzSource", "NpzSink", (".npz",), {}),
    "aedat4": Format("aedat4", "Aedat4Source", "Aedat4Sink", (".aedat4",), {}),
    "es": Format("aedat4", "EsSource", "", (".es",), {}),
    "mvsec": Format("mvsec", "MvsecSource", "MvsecSink", ("mvsec.h5", "mvsec.hdf5"), {}),
    "dsec": Format("dsec", "DsecSource", "", (), {}),
    "recording": Format("hdf5_events", "Hdf5Source", "RecordingSink", (".h5", ".hdf5"), {}),
    "mcap": Format("ros2_bag", "open_mcap", "BagSink", (".mcap",), {}),
    "rosbag": Format("ros2_bag", "BagSource", "BagSink", ("bag",), {}),
    "rosbag_sqlite3": Format("ros2_bag", "BagSource", "BagSink", (".sqlite3",), {"storage": "sqlite3"}),
}
"""By name. Where two suffixes fit, the longer one counts."""
_UNITLESS = ("csv", "npz", "recording")
"""Formats that others use too, for anything, with times of any unit."""
_FOLDERS = {"metadata.yaml": "rosbag", "events/left/events.h5": "dsec"}
"""Formats that are folders, by a file that is in each."""


def format_of(path: Path, name: str | None = None) -> str:
    """Return the name of the format of a file, from its own name.

    `path`: the file; what is in it does not count. A directory with metadata of rosbag2 is a bag, one with
    events/left/events.h5 a sequence of DSEC. `name`: the format, if the user says it.
    """
    if name is not None:
        if name not in FORMATS:
            raise EventFileError(f"unknown format {name!r}, known: {', '.join(FORMATS)}")
        return name
    for mark, folder in _FOLDERS.items():
        if (path / mark).is_file():
            return folder
    fits = {
        suffix: key
        for key, known in FORMATS.items()
        for suffix in known.suffixes
        if path.name.lower().endswith(suffix)
    }
    if not fits:
        suffixes = [suffix for known in FORMATS.values() for suffix in known.suffixes]
        raise EventFileError(f"{path}: no format of events has this suffix, known: {', '.join(suffixes)}")
    return fits[max(fits, key=len)]


def is_event_file(path: Path) -> bool:
    """Whether a name is that of a file of events; of a directory: whether it is of a format that is one."""
    try:
        return any((path / f).is_file() for f in _FOLDERS) if path.is_dir() else bool(format_of(path))
    except EventFileError:
        return False


def check_events(path: Path) -> None:
    """Look whether there are events in a file of a format that is used for other things as well.

    Args:
        path: A file or folder of which `is_event_file` is true; formats of events alone, and recordings,
            are not opened.

    Raises:
        NoEventsError: There are none.
        EventFileError: The file cannot be read.
    """
    if path.is_dir() or (path.suffix.lower() in FORMATS["recording"].suffixes and is_recording(path)):
        return
    if (name := _format_in(path)) in (*_UNITLESS, "mvsec"):
        EventReader(path, _open(name, path), (1, 1)).close()


def open_events(
    path: str | Path,
    *,
    format: str | None = None,
    size: tuple[int, int] | None = None,
    sensor: str = "",
    time_unit: str | None = None,
) -> EventReader:
    """Open a file of events, of any format.

    Args:
        path: The file.
        format: Key of `FORMATS`; None: by its suffix, and for HDF5 by what is in it.
        size: Width and height of the sensor [px], where the file does not say it.
        sensor: Event camera, of files that hold several; empty: the first.
        time_unit: s, ms, us or ns: that of a text, NPZ or HDF5 file that does not say it.

    Raises:
        FileNotFoundError: There is no such file.
        EventFileError: It is not of the format, or damaged; or times of the format have a unit.
        ImportError: A library for the format is not installed.
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"no file {path}")
    name = _format_in(path) if format is None else format_of(path, format)
    more: dict[str, Any] = {}
    if name == "recording" or FORMATS[name].module == "ros2_bag":
        more["sensor"] = sensor
    if time_unit is not None:
        if name not in _UNITLESS:
            raise EventFileError(f"{path}: times of {name} have a unit, it cannot be {time_unit}")
        more["unit_us"] = UNITS_US[time_unit]
    return EventReader(path, _open(name, path, **more), size)


def is_recording(path: Path) -> bool:
    """Whether an HDF5 file is a recording of Neurosim."""
    with open_hdf5(path) as file, damage_of(path):
        return bool(file.attrs.get("format") == FORMAT)


def _format_in(path: Path) -> str:
    """Return the format of a file; that of HDF5 depends on what is in it."""
    name = format_of(path)
    if name in ("mvsec", "recording"):
        with open_hdf5(path) as file, damage_of(path):
            name = "mvsec" if "davis" in file else "recording"
    return name


def _open(name: str, path: Path, **options: Any) -> EventSource:
    source: EventSource = _load(FORMATS[name], FORMATS[name].source)(path, **options)
    return source


def create_events(path: str | Path, *, width: int, height: int, format: str | None = None) -> EventWriter:
    """Make a file of events, replacing one that exists.

    Args:
        path: The file.
        width: Of the sensor [px].
        height: Of the sensor [px].
        format: Key of `FORMATS`; None: by the suffix.

    Raises:
        EventFileError: The format cannot be written, or not for such a sensor.
        ImportError: A library for the format is not installed.
        OSError: The file cannot be written.
    """
    path = Path(path)
    name = format_of(path, format)
    known = FORMATS[name]
    if not known.sink:
        raise EventFileError(f"{path}: {name} is only read; write .h5")
    with naming_file(path):
        sink = _load(known, known.sink)(path, width=width, height=height, **known.options)
    return EventWriter(path, sink, width=width, height=height)


def _load(known: Format, name: str) -> Any:
    return getattr(import_module(f"neurosim_core.io.{known.module}"), name)
