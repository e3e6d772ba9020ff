"""Event files: there and back through every format, by independent readers, damaged, and cut off."""

from __future__ import annotations

import contextlib
import re
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest

from neurosim_core import cli
from neurosim_core.flight import rerun_file
from neurosim_core.io import FORMATS, EventFileError, create_events, open_events
from neurosim_core.io.transfer import transfer
from neurosim_core.packets import EventArrays, Events, Image, ImuSample, Odometry
from neurosim_core.record import Recording, RecordingHeader, RecordingWriter

WIDTH, HEIGHT = 346, 260
HOUR_US = 3_600_000_000
WRITABLE = [name for name, known in FORMATS.items() if known.sink]


def draw(count: int, *, span_us: int, begin_us: int = 0, seed: int = 0) -> EventArrays:
    """Sorted random events, among them runs of neighbours at one time, and the last pixel of the sensor."""
    rng = np.random.default_rng(seed)
    t = begin_us + np.sort(rng.integers(0, span_us, count))
    t[count // 2 : count // 2 + 40] = t[count // 2]
    t = np.sort(t)
    x = rng.integers(0, WIDTH, count).astype(np.uint16)
    y = rng.integers(0, HEIGHT, count).astype(np.uint16)
    x[count // 2 : count // 2 + 40], y[count // 2 : count // 2 + 40] = np.arange(40) * 2, 9
    x[-1], y[-1] = WIDTH - 1, HEIGHT - 1
    return EventArrays(t, x, y, rng.integers(0, 2, count).astype(np.uint8))


def path_of(folder: Path, name: str) -> Path:
    suffix = FORMATS[name].suffixes[0]
    return folder / (f"events{suffix}" if suffix.startswith(".") else suffix)


def write(path: Path, events: EventArrays, *, parts: int = 3) -> Path:
    writer = create_events(path, width=WIDTH, height=HEIGHT)
    with contextlib.closing(writer):
        for index in np.array_split(np.arange(len(events.t)), parts):
            writer.write(events.rows(index))
    return path


def read(path: Path, **options) -> EventArrays:
    with contextlib.closing(open_events(path, **options)) as reader:
        blocks = [*reader.blocks()]
    empty = EventArrays(*(np.zeros(0, kind) for kind in (np.int64, np.uint16, np.uint16, np.uint8)))
    return EventArrays(*(np.concatenate(columns) for columns in zip(empty, *blocks, strict=True)))


def same(found: EventArrays, events: EventArrays) -> bool:
    return all(
        a.dtype == b.dtype and np.array_equal(a, b)  # values and types
        for a, b in zip(found, events, strict=True)
    )


@pytest.mark.parametrize("name", WRITABLE)
def test_there_and_back(name, tmp_path):
    pytest.importorskip("faery") if name == "aedat4" else None
    events = draw(20_000, span_us=40_000_000)
    path = write(path_of(tmp_path, name), events)
    assert same(read(path), events)
    reader = open_events(path)
    assert (reader.width, reader.height) == (WIDTH, HEIGHT)
    reader.close()


@pytest.mark.parametrize("name", WRITABLE)
def test_no_events(name, tmp_path):
    pytest.importorskip("faery") if name == "aedat4" else None
    path = write(path_of(tmp_path, name), draw(100, span_us=100).rows(slice(0, 0)), parts=1)
    assert len(read(path).t) == 0


@pytest.mark.parametrize("name", ["evt3", "evt2", "csv", "npz", "mvsec"])
def test_hours_and_long_silences(name, tmp_path):
    """EVT3 counts 16.8 s and EVT2 4.8 h until time begins again: silences longer than both."""
    parts = [
        draw(500, span_us=3_000_000, begin_us=begin, seed=i)
        for i, begin in enumerate(
            (0, 20_000_000, 5 * HOUR_US, 15 * HOUR_US, 15 * HOUR_US + 16_777_216 + 3_000_000)
        )
    ]
    events = EventArrays(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))
    assert same(read(write(path_of(tmp_path, name), events, parts=7)), events)


@pytest.mark.parametrize("name", ["evt3", "evt2"])
def test_times_since_1970(name, tmp_path):
    events = draw(1000, span_us=30_000_000, begin_us=1_700_000_000_000_000)
    assert same(read(write(path_of(tmp_path, name), events)), events)


@pytest.mark.parametrize("name", ["evt3", "evt2", "dat", "aedat4"])
def test_faery_reads_the_same(name, tmp_path):
    faery = pytest.importorskip("faery")
    span_us = 15_000_000 if name == "evt3" else 100_000_000  # its reader is wrong where evt3 wraps
    events = draw(20_000, span_us=span_us)
    stream = faery.events_stream_from_file(write(path_of(tmp_path, name), events))
    assert stream.dimensions() == (WIDTH, HEIGHT)
    found = np.concatenate([*stream])
    columns = [found[field] for field in found.dtype.names]
    assert all(np.array_equal(a, b) for a, b in zip(columns, events, strict=True))


@pytest.mark.parametrize(
    ("name", "version"), [("evt3", "evt3"), ("evt2", "evt2"), ("dat", "dat2"), ("aedat4", None)]
)
def test_what_faery_writes(name, version, tmp_path):
    faery = pytest.importorskip("faery")
    events = draw(20_000, span_us=12_000_000, begin_us=1000)
    records = np.empty(len(events.t), faery.EVENTS_DTYPE)
    for field, column in zip(records.dtype.names, events, strict=True):
        records[field] = column
    path = path_of(tmp_path, name)
    faery.events_stream_from_array(records, (WIDTH, HEIGHT)).to_file(path, version=version, zero_t0=False)
    assert same(read(path), events)


def test_event_stream_of_another_writer(tmp_path):
    """Its rows count from below; the time of its first event is kept."""
    faery = pytest.importorskip("faery")
    events, path = draw(20_000, span_us=40_000_000, begin_us=5_000), tmp_path / "events.es"
    rows = np.empty(len(events.t), faery.EVENTS_DTYPE)
    for name, column in zip(rows.dtype.names, events, strict=True):
        rows[name] = column
    rows["y"] = HEIGHT - 1 - rows["y"]
    with faery.es.Encoder(path, "dvs", False, (WIDTH, HEIGHT)) as encoder:
        encoder.write(rows)
    assert same(read(path), events)
    path.write_bytes(path.read_bytes()[:12])
    with pytest.raises(EventFileError, match=r"events\.es is damaged"):
        read(path)
    with pytest.raises(EventFileError, match="es is only read"):
        create_events(tmp_path / "new.es", width=4, height=4)


def test_dv_processing_reads_aedat4(tmp_path):
    dv = pytest.importorskip("dv_processing")
    pytest.importorskip("faery")
    events = draw(20_000, span_us=12_000_000, begin_us=1000)
    recording = dv.io.MonoCameraRecording(str(write(tmp_path / "events.aedat4", events)))
    found = []
    while (batch := recording.getNextEventBatch()) is not None:
        found.append(batch.numpy())
    found = np.concatenate(found)
    for field, column in zip(("timestamp", "x", "y", "polarity"), events, strict=True):
        assert np.array_equal(found[field], column)


def test_evt2_words():
    """By hand: 4101 us = 64 * 64 + 5; column 7, row 3, brighter."""
    from neurosim_core.io.raw import Evt2Encoder

    events = EventArrays(*(np.array([v], k) for v, k in ((4101, "i8"), (7, "u2"), (3, "u2"), (1, "u1"))))
    words = Evt2Encoder().encode(events).view("<u4").tolist()
    assert words == [0x8 << 28 | 64, 0x1 << 28 | 5 << 22 | 7 << 11 | 3]


def test_texts_of_others(tmp_path):
    """Seconds, blanks, -1 and 1; columns in another order; a geometry."""
    events = EventArrays(
        np.array([1, 2_000_003]),
        *(np.array(v, k) for v, k in (([3, 4], np.uint16), ([5, 6], np.uint16), ([0, 1], np.uint8))),
    )
    path = tmp_path / "events.txt"
    path.write_text("346 260\n0.000001 3 5 -1\n2.000003 4 6 1\n")
    assert same(read(path), events)
    path.write_text("%geometry:346,260\nx,y,polarity,timestamp\n3,5,0,1\n4,6,1,2000003\n")
    assert same(read(path), events)
    assert open_events(path).width == 346


@pytest.mark.parametrize(
    "text",
    [
        "\ufefft,x,y,p\r\n1,3,5,0\r\n2000003,4,6,1",  # of a spreadsheet, without an end of the last line
        "t [us], x [px], y [px], p\n1,3,5,-1\n2000003,4,6,1\n",
        "1.0,3.0,5.0,0\n2000003.0,4.0,6.0,1\n",
        ",t,x,y,p\n0,1,3,5,0\n1,2000003,4,6,1\n",
        "1;3;5;0;9\n\n2000003;4;6;1;9\n",
    ],
)
def test_texts_of_other_programs(text, tmp_path):
    (tmp_path / "events.csv").write_text(text, encoding="utf-8", newline="")
    found = read(tmp_path / "events.csv")
    assert [column.tolist() for column in found] == [[1, 2_000_003], [3, 4], [5, 6], [0, 1]]


@pytest.mark.parametrize(
    ("text", "t"),
    [
        ("0 3 5 0\n0.00001 4 6 1\n", [0, 10]),  # as `%g` writes them: the first number is whole
        ("t [ns],x,y,p\n1000,3,5,0\n2000,4,6,1\n", [1, 2]),
        ("time (ms); x; y; p\n1.5; 3; 5; 0\n2; 4; 6; 1\n", [1500, 2000]),
        ("t [s],x,y,p\n1,3,5,0\n2,4,6,1\n", [1_000_000, 2_000_000]),
        ("t [us],x,y,p\n1.7,3,5,0\n2.0,4,6,1\n", [2, 2]),
    ],
)
def test_units_of_times_in_texts(text, t, tmp_path):
    (tmp_path / "events.csv").write_text(text)
    assert [column.tolist() for column in read(tmp_path / "events.csv")] == [t, [3, 4], [5, 6], [0, 1]]


def test_a_text_that_was_cut_off(tmp_path):
    """A number may be cut, and still be one: what ends with it is left out, and said."""
    path, order = tmp_path / "events.csv", "x,y,p,t\n3,5,0,10\n"
    for text in (f"{order}4,6,1,2000", "1,3,5,0\n2,4,6", "1,3,5,0\n2,4,6,-", "1,3,5,0\n2"):
        path.write_text(text)
        reader = open_events(path)
        assert sum(len(block.t) for block in reader.blocks()) == 1
        assert "cut off" in reader.notes[-1]


@pytest.mark.parametrize("lines", [50, 3, 1])
def test_events_slightly_out_of_order(lines, tmp_path, monkeypatch):
    """Within blocks and across their ends, which may be shorter than 10 ms; by more it is damage."""
    monkeypatch.setattr("neurosim_core.io.csv._BLOCK_LINES", lines)
    events, rng = draw(1000, span_us=1_000_000), np.random.default_rng(1)
    order = np.argsort(events.t + rng.integers(-4000, 4000, 1000), kind="stable")
    path = tmp_path / "events.csv"
    np.savetxt(path, np.stack([column[order] for column in events], 1), "%d", ",")
    reader = open_events(path, size=(WIDTH, HEIGHT))
    blocks = [*reader.blocks()]
    t = np.concatenate([block.t for block in blocks])
    assert np.array_equal(t, events.t)
    assert sum(len(block.t) for block in blocks) == 1000
    late = np.count_nonzero(np.maximum.accumulate(events.t[order]) > events.t[order])
    assert int(reader.notes[0].split()[0]) == late
    assert sorted(
        zip(*(np.concatenate(c).tolist() for c in zip(*blocks, strict=True)), strict=True)
    ) == sorted(zip(*(column.tolist() for column in events), strict=True))
    for first in (405, 440):  # in a block, and across the end of one
        late = np.arange(1000)
        late[[first, first + 30]] = late[[first + 30, first]]
        np.savetxt(path, np.stack([column[late] for column in events], 1), "%d", ",")
        with pytest.raises(EventFileError, match="time goes back by"):
            read(path, size=(WIDTH, HEIGHT))


@pytest.mark.parametrize("line", ["1,-1,5,0", "1,3,65536,0", "1,3.5,5,0", "1,3,5,nan", "1e300,3,5,0"])
def test_numbers_that_are_no_event(line, tmp_path):
    path = tmp_path / "events.csv"
    path.write_text(f"0.0,3,5,0\n{line}\n")
    with pytest.raises(EventFileError, match="before line 2: an event has"):
        read(path)
    path.write_text(f"{line}\n")
    with pytest.raises(EventFileError, match=r"is not a text of events|an event has t"):
        read(path)


@pytest.mark.parametrize(
    "layout",
    ["events/t,x,y,p", "events/ts,xs,ys,ps", "prophesee/left/t,x,y,p", "records events", "records CD/events"],
)
def test_hdf5_of_other_programs(layout, tmp_path):
    """Columns or records, under the names that there are; seconds, if times are floating-point numbers."""
    events, path = draw(500, span_us=3_000_000), tmp_path / "events.h5"
    signs = events.polarity.astype(np.int8) * 2 - 1
    with h5py.File(path, "w") as file:
        if layout.startswith("records"):
            rows = np.empty(500, [("x", "<u2"), ("y", "<u2"), ("p", "<i2"), ("t", "<i8")])
            rows["t"], rows["x"], rows["y"], rows["p"] = events
            file[layout.split()[1]] = rows
        else:
            group, _, names = layout.rpartition("/")
            t = events.t * 1e-6 if "ts" in names else events.t
            for name, column in zip(names.split(","), (t, events.x, events.y, signs), strict=True):
                file[f"{group}/{name}"] = column
    assert same(read(path), events)


def test_hdf5_of_whole_times(tmp_path):
    """Microseconds, as in texts, though they are floating-point numbers."""
    path = tmp_path / "events.h5"
    with h5py.File(path, "w") as file:
        for name, values in (("t", [1.0, 2_000_003.0]), ("x", [3, 4]), ("y", [5, 6]), ("p", [0, 1])):
            file[f"events/{name}"] = np.array(values)
    assert read(path).t.tolist() == [1, 2_000_003]


def test_hdf5_that_tells_nothing(tmp_path):
    path = tmp_path / "events.h5"

    def write(group, name, value) -> None:
        if not isinstance(value, dict):
            group[name] = value
            return
        inner = group.create_group(name)
        for part in value.items():
            write(inner, *part)

    for name, value, words in (
        ("events", np.zeros((9, 4)), "has no events/t"),
        ("other", 1, "has no events/t"),
        ("events", dict.fromkeys("txyp", np.zeros((9, 1))), "must be arrays of one axis"),
        ("events", {name: {} for name in "txyp"}, "must be arrays of one axis"),
    ):
        with h5py.File(path, "w") as file:
            write(file, name, value)
        with pytest.raises(EventFileError, match=words):
            open_events(path)
    with h5py.File(path, "w") as file:
        for name, value in (("t", 16 * 10**17), ("x", 3), ("y", 4), ("p", 1)):
            file[f"events/{name}"] = np.array([value])
    with pytest.raises(EventFileError, match="nanoseconds"):
        read(path)


def test_dsec(tmp_path):
    """uint32 times after t_offset, as DSEC has them."""
    events = draw(5000, span_us=3_000_000)
    with h5py.File(tmp_path / "events.h5", "w") as file:
        for name, column in zip(("t", "x", "y", "p"), events, strict=True):
            file[f"events/{name}"] = column.astype(np.uint32) if name == "t" else column
        file["t_offset"] = np.int64(49_599_300_523)
    found = read(tmp_path / "events.h5")
    assert same(found._replace(t=found.t - 49_599_300_523), events)


def flight(path: Path, events: EventArrays) -> None:
    """A recording with ground truth, at stamps that seconds in float64 hold exactly."""
    with RecordingWriter(path, RecordingHeader(config_yaml="", seed=0, version="0")) as out:
        rng = np.random.default_rng(1)
        for k in range(1, 5):
            stamp_ns = k * 500_000_000
            part = events.rows((events.t > (k - 1) * 500_000) & (events.t <= k * 500_000))
            head = {"stamp_ns": stamp_ns, "sequence": k - 1}
            out.write(
                Events(
                    sensor="cam",
                    width=WIDTH,
                    height=HEIGHT,
                    start_ns=stamp_ns - 500_000_000,
                    t=part.t,
                    x=part.x,
                    y=part.y,
                    polarity=part.polarity,
                    **head,
                )
            )
            depth = rng.random((HEIGHT, WIDTH)).astype(np.float32)
            depth[0, 0] = np.inf
            out.write(Image(sensor="depth", data=depth, encoding="32FC1", **head))
            flow = rng.random((HEIGHT, WIDTH, 2)).astype(np.float32)
            out.write(Image(sensor="flow", data=flow, encoding="32FC2", **head))
            out.write(
                ImuSample(sensor="imu", specific_force=rng.random(3), angular_rate=rng.random(3), **head)
            )
            still = {"velocity": np.zeros(3), "body_rate": np.zeros(3), "rotor_speed": np.zeros(4)}
            turn = np.array([0.0, 0.0, 0.6, 0.8])
            out.write(Odometry(sensor="odometry", position=rng.random(3), orientation=turn, **still, **head))


def test_mvsec_has_the_ground_truth(tmp_path):
    events = draw(5000, span_us=1_999_000, begin_us=1)
    flight(tmp_path / "flight.h5", events)
    done = transfer(tmp_path / "flight.h5", tmp_path / "mvsec.h5")
    assert (done.event_count, done.packet_count) == (5000, 16)
    with h5py.File(tmp_path / "mvsec.h5") as file:
        left = file["davis/left"]
        assert left["pose"].shape == (4, 4, 4)
        assert np.isnan(left["depth_image_raw"][0, 0, 0])
        assert set(np.unique(left["events"][:, 3])) == {-1.0, 1.0}
    transfer(tmp_path / "mvsec.h5", tmp_path / "back.h5")
    with Recording(tmp_path / "flight.h5") as one, Recording(tmp_path / "back.h5") as two:
        for sensor, field in (("depth", "data"), ("flow", "data"), ("imu", "specific_force")):
            assert np.array_equal(one.column(sensor, field), two.column(sensor, field))
            assert np.array_equal(one.column(sensor, "stamp_ns"), two.column(sensor, "stamp_ns"))
        assert np.allclose(
            one.column("odometry", "orientation"), two.column("pose", "orientation"), atol=1e-15
        )
        assert np.array_equal(one.column("cam", "t"), two.column("events", "t"))


def test_mvsec_reads_the_ground_truth_beside_its_data(tmp_path):
    """As it is published: events and pictures in one file, depth and poses in another."""
    flight(tmp_path / "flight.h5", draw(5000, span_us=1_999_000, begin_us=1))
    transfer(tmp_path / "flight.h5", tmp_path / "mvsec.h5")
    data, truth = tmp_path / "indoor1_data.hdf5", tmp_path / "indoor1_gt.hdf5"
    with h5py.File(tmp_path / "mvsec.h5") as whole, h5py.File(data, "w") as one, h5py.File(truth, "w") as two:
        for name in whole["davis/left"]:
            part = two if name.startswith(("depth", "flow", "pose")) else one
            whole.copy(f"davis/left/{name}", part.require_group("davis/left"))
    transfer(data, tmp_path / "both.h5")
    transfer(tmp_path / "mvsec.h5", tmp_path / "back.h5")
    with Recording(tmp_path / "both.h5") as found, Recording(tmp_path / "back.h5") as expected:
        assert found.sensors == expected.sensors
        assert np.array_equal(found.column("depth", "data"), expected.column("depth", "data"))
        assert np.array_equal(found.column("pose", "position"), expected.column("pose", "position"))
    with pytest.raises(EventFileError, match=r"has no events: .* NAME_data\.hdf5"):
        open_events(truth)


@pytest.mark.parametrize("name", ["a.csv", "a.npz", "a.h5"])
def test_nanoseconds_that_no_file_tells(name, tmp_path, capsys):
    """They pass for microseconds, and a note asks; the user's word counts, also for times since 1970."""
    events = draw(20_000, span_us=4_000_000, begin_us=1_700_000_000_000_000)
    path, t_ns = tmp_path / name, events.t * 1000 + 7
    columns = {"t": t_ns, "x": events.x, "y": events.y, "p": events.polarity}
    if name == "a.csv":
        np.savetxt(path, np.stack([*columns.values()], 1).astype(np.int64), fmt="%d", delimiter=",")
    elif name == "a.npz":
        np.savez(path, **columns)
    else:
        with h5py.File(path, "w") as file:
            file["events/t"], file["t_offset"] = t_ns - t_ns[0], t_ns[0]
            for key in "xyp":
                file[f"events/{key}"] = columns[key]
    assert same(read(path, time_unit="ns"), events)
    options = ["--from-zero", "--time-unit", "ns", "--size", "346x260"]
    assert cli.main(["convert", str(path), str(tmp_path / "b.raw"), *options]) == 0
    assert "note" not in capsys.readouterr().out
    first_us = 1_700_000_000_000_000 if name == "a.h5" else events.t[0]  # HDF5 may have ground truth
    assert same(read(tmp_path / "b.raw"), events._replace(t=events.t - first_us))
    with pytest.raises(EventFileError, match="times of evt3 have a unit"):
        open_events(tmp_path / "b.raw", time_unit="ns")


def test_nanoseconds_from_zero_are_asked_for(tmp_path, capsys):
    events = draw(20_000, span_us=4_000_000)
    write(tmp_path / "a.npz", events._replace(t=events.t * 1000))
    assert cli.main(["convert", str(tmp_path / "a.npz"), str(tmp_path / "b.raw")]) == 0
    assert "--time-unit ns" in capsys.readouterr().out


def test_nanoseconds_of_32_bits_do_not_run_over(tmp_path):
    t = np.array([0, 1_499, 1_500, 2**32 - 1], dtype=np.uint32)
    np.savez(tmp_path / "a.npz", t=t, x=t % 5, y=t % 3, p=t % 2)
    np.testing.assert_array_equal(read(tmp_path / "a.npz", time_unit="ns").t, [0, 1, 2, 4_294_967])


def test_the_unit_of_a_recording_cannot_be_told(tmp_path):
    write(tmp_path / "a.h5", draw(100, span_us=2_000))
    with pytest.raises(EventFileError, match="times of a recording of Neurosim are microseconds"):
        open_events(tmp_path / "a.h5", time_unit="ns")


def test_the_command(tmp_path, capsys):
    events = draw(3000, span_us=2_000_000, begin_us=7_000_000)
    write(tmp_path / "a.raw", events)
    assert cli.main(["convert", str(tmp_path / "a.raw"), str(tmp_path / "b.h5"), "--from-zero"]) == 0
    assert "3,000 events of 346x260 pixels, 0.000000 s to" in capsys.readouterr().out
    assert same(read(tmp_path / "b.h5"), events._replace(t=events.t - events.t[0]))
    assert cli.main(["convert", str(tmp_path / "a.raw"), str(tmp_path / "b.h5")]) == 1  # it is there
    assert "--overwrite" in capsys.readouterr().err


def test_any_event_file_can_be_viewed(tmp_path):
    pytest.importorskip("rerun")
    write(tmp_path / "a.evt2.raw", draw(3000, span_us=200_000, begin_us=1_700_000_000_000_000))
    assert cli.main(["view", str(tmp_path / "a.evt2.raw"), "--save", str(tmp_path / "a.rrd")]) == 0
    assert (tmp_path / "a.rrd").stat().st_size > 10_000


def test_files_of_one_stem_are_not_viewed_as_each_other(tmp_path):
    """A Rerun file that was made before is that of one file, and of what was in it; a bag is a folder."""
    pytest.importorskip("rerun")
    made = []
    for name in ("a.raw", "a.csv", "a_bag"):
        write(tmp_path / name, draw(3000, span_us=200_000, seed=len(made)))
        made.append(rerun_file(tmp_path / name))
        assert rerun_file(tmp_path / name) == made[-1]
    assert len(set(made)) == 3
    before = made[1].stat().st_size
    write(tmp_path / "a.csv", draw(9000, span_us=600_000))
    assert rerun_file(tmp_path / "a.csv").stat().st_size > 1.5 * before


@pytest.mark.parametrize("name", WRITABLE)
def test_damaged_files(name, tmp_path):
    """Cut off: an error, or the first events. Flipped bits: an error, or sorted events on the sensor."""
    pytest.importorskip("faery") if name == "aedat4" else None
    events = draw(2000, span_us=400_000)
    path = file = write(path_of(tmp_path, name), events)
    if path.is_dir():
        (file,) = (each for each in path.iterdir() if each.name != "metadata.yaml")
    whole = file.read_bytes()
    rng = np.random.default_rng(3)
    intact = 0
    for turn in range(24):
        if cut := turn % 2 == 0:
            data = whole[: int(rng.integers(0, len(whole)))]
        else:
            changed = np.frombuffer(whole, np.uint8).copy()
            changed[rng.integers(0, len(whole), 3)] ^= rng.integers(1, 256, 3).astype(np.uint8)
            data = changed.tobytes()
        file.write_bytes(data)
        try:
            found = read(path)
        except EventFileError:
            continue
        intact += 1
        if cut:
            assert same(found, events.rows(slice(0, len(found.t))))
        assert (np.diff(found.t) >= 0).all()
    assert intact > 0 or name in ("npz", "aedat4", "recording", "mvsec")


@pytest.mark.parametrize(
    ("name", "events", "words"),
    [
        ("dat", draw(90, span_us=10, begin_us=2 * HOUR_US), "71 minutes"),
        ("evt3", draw(90, span_us=10, begin_us=-100), "no time before 0"),
        ("recording", draw(90, span_us=10, begin_us=1 << 50), "--from-zero"),
        ("npz", draw(90, span_us=1000).rows(slice(None, None, -1)), "time goes back"),
    ],
)
def test_what_a_format_cannot_hold(name, events, words, tmp_path):
    with pytest.raises(EventFileError, match=words):
        write(path_of(tmp_path, name), events, parts=1)


def test_wrong_files(tmp_path):
    with pytest.raises(FileNotFoundError):
        open_events(tmp_path / "none.raw")
    (tmp_path / "a.xyz").write_bytes(b"")
    with pytest.raises(EventFileError, match=r"known: \.raw, "):
        open_events(tmp_path / "a.xyz")
    for name in WRITABLE:
        path = path_of(tmp_path, name)
        path.write_bytes(b"neither one nor the other\n" * 10)
        with pytest.raises((EventFileError, ImportError), match=str(path) + "|faery|mcap"):
            open_events(path)


def test_memory_does_not_grow_with_the_file(tmp_path):
    """10^7 events are 130 MB: a process that streams them through stays far below."""
    code = """
import resource, sys
import numpy as np
from neurosim_core.io import create_events, open_events
from neurosim_core.packets import EventArrays
writer = create_events(sys.argv[1], width=346, height=260)
base = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
x = (np.arange(1_000_000) * 7 % 346).astype(np.uint16)
for k in range(10):
    writer.write(EventArrays(np.arange(1_000_000) + k * 1_000_000, x, x % 260, (x % 2).astype(np.uint8)))
writer.close()
count = sum(len(block.t) for block in open_events(sys.argv[1]).blocks())
print(count, (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - base) // 1024)
"""
    for name in ("a.raw", "a.dat"):
        done = subprocess.run(
            [sys.executable, "-c", code, str(tmp_path / name)], capture_output=True, text=True
        )
        count, grown_mb = map(int, done.stdout.split())
        assert count == 10_000_000
        assert grown_mb < 250  # a block of a million in hand, with the arrays of the encoder


@pytest.mark.parametrize("name", WRITABLE)
def test_a_full_disk_is_told_with_the_name_of_the_file(name, tmp_path):
    """A limit on the size of files acts like a full disk; one format after the other once crashed."""
    pytest.importorskip("faery") if name == "aedat4" else None
    pytest.importorskip("rosbags") if FORMATS[name].module == "ros2_bag" else None
    write(tmp_path / "in.npz", draw(100_000, span_us=1_000_000))
    code = """
import resource, sys
from neurosim_core.cli import main
resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))
sys.exit(main(["convert", *sys.argv[1:]]))
"""
    out = path_of(tmp_path, name)
    command = [sys.executable, "-c", code, str(tmp_path / "in.npz"), str(out), "--to", name]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 1
    assert re.fullmatch(f"neurosim: .*{re.escape(str(out.with_suffix('')))}.*\n", done.stderr)
    assert ".part" not in done.stderr
    assert re.search("File too large|disk I/O error", done.stderr)
    assert [file.name for file in tmp_path.iterdir()] == ["in.npz"]
