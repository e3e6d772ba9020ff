"""A packet class that no other file knows: recorded, read back, logged to Rerun, drawn in the overview."""

from __future__ import annotations

import io
import subprocess
import sys
from dataclasses import dataclass, make_dataclass, replace
from pathlib import Path
from typing import Annotated, Any, ClassVar, TypeVar

import h5py
import numpy as np
import PIL.Image
import pytest
import rerun.chunk
import trimesh
from numpy.typing import NDArray
from rerun_file import read, scalars
from test_plan import make_scene
from typing_extensions import TypeAliasType

from neurosim_core import packets as packets_module
from neurosim_core.packets import PACKET_CLASSES, FieldSpec, GenericPacket, Image, Packet, schema_of
from neurosim_core.record import Recording, RecordingHeader, RecordingWriter
from neurosim_core.view.overview import FlightSummary
from neurosim_core.view.overview_plot import save_overview
from neurosim_core.view.rerun_log import RerunLogger
from neurosim_core.view.rerun_sdk import RerunStream

HEADER = RecordingHeader(config_yaml="", seed=0, version="")
MS = 1_000_000


@dataclass(frozen=True, kw_only=True, eq=False)
class Ranging(Packet):
    """What a range finder measures; shown as its schema suggests: numbers against time."""

    range_m: float
    """Distance along the axis [m]."""
    noise: Annotated[NDArray[np.float32], FieldSpec(2, unit="m")]
    count: int
    valid: bool
    mode: Annotated[str, FieldSpec(constant=True)] = "near"


@dataclass(frozen=True, kw_only=True, eq=False)
class Cloud(Packet):
    """Points of a LiDAR; two arrays share the varying length."""

    points: Annotated[NDArray[np.float32], FieldSpec("n", 3, unit="m")]
    ring: Annotated[NDArray[np.uint16], FieldSpec("n")]
    corners: Annotated[NDArray[np.float64], FieldSpec("k", 2)]


@dataclass(frozen=True, kw_only=True, eq=False)
class Spectrum(Packet):
    """Power of a varying number of bands."""

    power: Annotated[NDArray[np.float64], FieldSpec("band", unit="W")]


@dataclass(frozen=True, kw_only=True, eq=False)
class Note(Packet):
    """What somebody says."""

    text: str


@dataclass(frozen=True, kw_only=True, eq=False)
class Heat(Packet):
    """A thermal picture."""

    kelvin: Annotated[NDArray[np.float32], FieldSpec("H", "W", unit="K")]


@dataclass(frozen=True, kw_only=True, eq=False)
class Secret(Packet):
    """Not shown at all."""

    display: ClassVar[str] = "none"
    key: int


def make_packets() -> list[Packet]:
    rng = np.random.default_rng(0)
    packets: list[Packet] = []
    for k in range(12):
        header = {"stamp_ns": k * 10 * MS, "sequence": k}
        ranging = Ranging(
            range_m=2.0 + 0.1 * k,
            noise=rng.random(2, np.float32),
            count=k - 5,
            valid=k % 2 == 0,
            sensor="sonar",
            **header,
        )
        cloud = Cloud(
            points=rng.normal(size=(50 * (k % 4), 3)).astype(np.float32),
            ring=np.arange(50 * (k % 4), dtype=np.uint16),
            corners=rng.random((k, 2)),
            sensor="lidar",
            **header,
        )
        labels = rng.integers(-1, 9, (20, 30)).astype(np.int32)
        normals = np.zeros((20, 30, 3), np.float32)
        normals[:10, :, 2] = 1.0
        packets += [
            ranging,
            cloud,
            Spectrum(power=rng.random(k), sensor="ear", **header),
            Note(text=f"zwölf{k}" * k, sensor="log", **header),
            Heat(kelvin=280.0 + rng.random((20, 30), np.float32), sensor="thermal", **header),
            Secret(key=k, sensor="vault", **header),
            Image(data=labels, encoding="32SC1", sensor="labels", **header),
            Image(data=normals, encoding="32FC3", sensor="normals", **header),
            Image(
                data=rng.normal(size=(20, 30, 2)).astype(np.float32),
                encoding="32FC2",
                sensor="flow",
                **header,
            ),
        ]
    return packets


def write(path: Path, packets: list[Packet]) -> None:
    with RecordingWriter(path, HEADER, flush_interval_s=0.0) as writer:
        for packet in packets:
            writer.write(packet)


def values(packet: Packet) -> list[object]:
    """The fields of a packet, arrays by type, shape and bytes."""
    found = vars(packet).items()
    return [
        (k, v.dtype.str, v.shape, v.tobytes()) if isinstance(v, np.ndarray) else (k, type(v), v)
        for k, v in found
    ]


def test_the_schema_is_that_of_the_class():
    schema = schema_of(Ranging)
    assert schema.name == "test_new_packet.Ranging"
    assert PACKET_CLASSES[schema.name] is Ranging
    assert [(f.name, f.dtype, f.shape, f.unit, f.constant) for f in schema.fields] == [
        ("range_m", "float64", (), "m", False),
        ("noise", "float32", (2,), "m", False),
        ("count", "int64", (), "", False),
        ("valid", "bool", (), "", False),
        ("mode", "str", (), "", True),
    ]
    assert schema.fields[0].doc == "Distance along the axis [m]."
    shown = [schema_of(cls).display for cls in (Ranging, Cloud, Spectrum, Note, Heat, Secret)]
    assert shown == ["time series", "points", "bars", "text", "image", "none"]


def test_what_is_read_is_what_was_written(tmp_path):
    packets = make_packets()
    write(tmp_path / "f.h5", packets)
    with Recording(tmp_path / "f.h5") as recording:
        assert recording.notes == ()
        found = list(recording.packets())
        assert recording.column("lidar", "points").shape == (sum(50 * (k % 4) for k in range(12)), 3)
        assert recording.column("sonar", "range_m").tolist() == [2.0 + 0.1 * k for k in range(12)]
        assert recording.column("log", "text")[2] == "zwölf2zwölf2"
        some = list(recording.packets("lidar", start_s=0.045))
    assert [type(p) for p in found] == [type(p) for p in packets]
    assert [values(p) for p in found] == [values(p) for p in packets]
    assert [values(p) for p in some] == [values(p) for p in packets if isinstance(p, Cloud)][5:]
    with h5py.File(tmp_path / "f.h5") as file:  # for other programs
        group = file["sensors/lidar"]
        assert group["n_end"][:4].tolist() == [0, 50, 150, 300]
        assert group.attrs["packet"] == "test_new_packet.Cloud"


def test_a_class_that_is_not_imported_is_read_by_its_schema(tmp_path):
    """In another process: the fields are there, the note names the class; and it can be recorded again."""
    write(tmp_path / "f.h5", make_packets())
    code = """
import sys
from neurosim_core.record import Recording, RecordingWriter
with Recording(sys.argv[1]) as recording, RecordingWriter(sys.argv[2], recording.header) as writer:
    print(*recording.notes, sep="\\n")
    for packet in recording.packets():
        writer.write(packet)
"""
    command = [sys.executable, "-c", code, str(tmp_path / "f.h5"), str(tmp_path / "g.h5")]
    said = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert "sensor 'sonar' sends packets of class test_new_packet.Ranging, which is not known here" in said
    with Recording(tmp_path / "g.h5") as recording:
        found = list(recording.packets())
    assert [values(p) for p in found] == [values(p) for p in make_packets()]
    assert not any(isinstance(p, GenericPacket) for p in found)


@dataclass(frozen=True, kw_only=True, eq=False)
class Changed(Packet):
    """`Note`, as another version of its plug-in has it."""

    words: str


def test_a_class_that_has_changed_is_read_by_its_schema(tmp_path, monkeypatch):
    write(tmp_path / "f.h5", make_packets())
    monkeypatch.setitem(packets_module._classes, schema_of(Note).name, Changed)
    with Recording(tmp_path / "f.h5") as recording:
        note = next(recording.packets("log", start_s=0.01))
    assert isinstance(note, GenericPacket)
    assert note.text == "zwölf1"  # type: ignore[attr-defined]


def test_an_array_whose_annotation_is_an_alias_of_the_language():
    """NumPy 2.5, of Python 3.12 on, has such an NDArray."""
    item = TypeVar("item")
    alias = TypeAliasType("NDArray", np.ndarray[Any, np.dtype[item]], type_params=(item,))
    annotations = [("plain", alias[np.float32]), ("any", Annotated[alias[Any], FieldSpec("H", "W")])]
    kind = make_dataclass("Aliased", annotations, bases=(Packet,), frozen=True, kw_only=True, eq=False)
    plain, anything = schema_of(kind).fields
    assert (plain.dtype, plain.shape) == ("float32", ("...",))
    assert (anything.dtype, anything.shape) == ("any", ("H", "W"))


def test_what_cannot_be_recorded_is_refused(tmp_path):
    @dataclass(frozen=True, kw_only=True, eq=False)
    class Strange(Packet):
        parts: list[int]

    @dataclass(frozen=True, kw_only=True, eq=False)
    class Taken(Packet):
        order: int

    with RecordingWriter(tmp_path / "f.h5", HEADER) as writer:
        with pytest.raises(
            TypeError, match=r"field 'parts' of packet Strange is annotated .*; allowed are int"
        ):
            writer.write(Strange(parts=[], sensor="a"))
        with pytest.raises(ValueError, match="cannot be called 'order'"):
            writer.write(Taken(order=1, sensor="a"))
        uneven = Cloud(
            points=np.zeros((3, 3), np.float32), ring=np.zeros(2, np.uint16), corners=np.zeros((0, 2))
        )
        with pytest.raises(ValueError, match=r"ring must have shape \[3\], got \[2\]"):
            writer.write(replace(uneven, sensor="a"))
    with Recording(tmp_path / "f.h5") as recording:
        assert recording.sensors == ()


def view_names(path: Path) -> set[str]:
    """Names of the views in the layouts of a Rerun file."""
    reader = rerun.chunk.RrdReader(path)
    batches = [
        chunk.to_record_batch() for store in reader.blueprints() for chunk in reader.stream(store=store)
    ]
    columns = [b.column(n) for b in batches for n in b.schema.names if n.endswith(":display_name")]
    return {name for column in columns for names in column.to_pylist() for name in names or ()}


def test_it_is_shown_in_rerun(tmp_path):
    packets = make_packets()
    with RerunLogger(RerunStream(tmp_path / "f.rrd"), vehicles={"drone": ()}) as logger:
        for packet in packets:
            logger.log(packet)
    rows = read(tmp_path / "f.rrd")
    ranges = [(p.stamp_ns, [p.range_m]) for p in packets if isinstance(p, Ranging)]
    assert scalars(rows, "/plots/drone/sonar/range_m") == ranges
    noise = [list(map(float, p.noise)) for p in packets if isinstance(p, Ranging)]
    assert [v for _, v in scalars(rows, "/plots/drone/sonar/noise")] == noise
    points = [len(v["positions"] or []) for _, v in rows["/world/vehicles/drone/lidar"]]
    assert points == [50 * (k % 4) for k in range(12)]
    assert [v["text"] for _, v in rows["/plots/drone/log"]][2] == ["zwölf2zwölf2"]
    assert len(rows["/plots/drone/ear/power"]) == 12
    for name in ("thermal", "labels", "normals", "flow"):
        assert len(rows[f"/world/vehicles/drone/{name}/image"]) == 12, name
    assert not [entity for entity in rows if "vault" in entity]
    blob = rows["/world/vehicles/drone/normals/image"][0][1]["blob"][0]
    with PIL.Image.open(io.BytesIO(bytes(blob))) as found:
        assert found.getpixel((0, 0)) == (128, 128, 255)  # a normal along z
        assert found.getpixel((0, 19)) == (233, 236, 239)  # nothing
    views = view_names(tmp_path / "f.rrd")
    assert {"sonar: range [m]", "log", "ear: power [W]", "thermal", "normals"} <= views


def test_it_is_drawn_in_the_overview(tmp_path):
    """Every sensor has a panel that shows more than paper; four panels more make the picture higher."""
    summary = FlightSummary()
    for packet in make_packets():
        summary.log(packet)
    room = make_scene(trimesh.creation.box(extents=(6, 4, 2.5)))
    save_overview(tmp_path / "o.png", summary, scene=room)
    with PIL.Image.open(tmp_path / "o.png") as image:
        found = np.asarray(image.convert("RGB"))
    assert found.shape == (900 + 2 * 400, 1600, 3)
    for row in range(4):
        for x in (40, 520):
            panel = found[124 + 396 * row : 436 + 396 * row, x : x + 416]
            assert (panel != 255).any(axis=-1).mean() > 0.004, (row, x)


def test_an_unknown_display_lists_the_known_ones(tmp_path):
    @dataclass(frozen=True, kw_only=True, eq=False)
    class Smell(Packet):
        display: ClassVar[str] = "odour"
        strength: float

    with (
        RerunLogger(RerunStream(tmp_path / "f.rrd"), vehicles={"drone": ()}) as logger,
        pytest.raises(ValueError, match="unknown display 'odour', known: image, depth"),
    ):
        logger.log(Smell(strength=1.0, sensor="nose"))
