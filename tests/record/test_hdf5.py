"""Flights as HDF5 files: what is read is what was written, also from a run that was killed."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
import threading
import time
import tracemalloc
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import h5py
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from neurosim_core import packets as packet_module
from neurosim_core.live.config import LinkConfig
from neurosim_core.live.links import Link
from neurosim_core.packets import (
    Collision,
    Delivery,
    Events,
    FieldSpec,
    Image,
    ImuSample,
    Odometry,
    Packet,
    schema_of,
)
from neurosim_core.record import (
    Intrinsics,
    Recording,
    RecordingHeader,
    RecordingWriter,
    SensorDescription,
)
from neurosim_core.record.columns import deflate
from neurosim_core.record.disk import Disk

HEADER = RecordingHeader(config_yaml="duration_s: 1.0\n", seed=7, version="0.1.0", scene="flat")
MS = 1_000_000


def make_events(
    rng, *, start_ns, stamp_ns, count, sensor="dvs", sequence=0, dropped=0, width=346, height=260
):
    """Random events of the window (start_ns, stamp_ns], sorted as packets are."""
    t = rng.integers(start_ns // 1000 + 1, stamp_ns // 1000 + 1, count)
    x, y, p = rng.integers(0, width, count), rng.integers(0, height, count), rng.integers(0, 2, count)
    order = np.lexsort((p, x, y, t))
    return Events(
        stamp_ns=stamp_ns,
        start_ns=start_ns,
        sequence=sequence,
        sensor=sensor,
        t=t[order].astype(np.int64),
        x=x[order].astype(np.uint16),
        y=y[order].astype(np.uint16),
        polarity=p[order].astype(np.uint8),
        width=width,
        height=height,
        dropped_count=dropped,
    )


def make_flight(seed: int, event_counts: list[int], *, images: int = 3, rotors: int = 4) -> list[Packet]:
    """Packets of every type, several of equal stamp, with gaps in the sequence."""
    rng = np.random.default_rng(seed)
    packets: list[Packet] = []
    for k, count in enumerate(event_counts):
        stamp_ns = (k + 1) * 10 * MS + 137
        packets.append(
            make_events(
                rng, start_ns=k * 10 * MS, stamp_ns=stamp_ns - 137, count=count, sequence=2 * k, dropped=k
            )
        )
        packets.append(
            ImuSample(
                stamp_ns=stamp_ns,
                sequence=k,
                sensor="imu",
                specific_force=rng.normal(size=3),
                angular_rate=np.array([np.nan, -0.0, np.inf]),
            )
        )
        packets.append(
            Odometry(
                stamp_ns=stamp_ns,
                sequence=k,
                sensor="truth",
                position=rng.normal(size=3),
                orientation=rng.normal(size=4),
                velocity=rng.normal(size=3),
                body_rate=rng.normal(size=3),
                rotor_speed=rng.normal(size=rotors),
            )
        )
        if k < images:
            depth = rng.random((5, 7), dtype=np.float32)
            depth[0, 0] = np.inf
            rgb = rng.integers(0, 256, (5, 7, 3), dtype=np.uint8)
            packets.append(Image(stamp_ns=stamp_ns, sequence=k, sensor="rgb", data=rgb, encoding="rgb8"))
            packets.append(Image(stamp_ns=stamp_ns, sequence=k, sensor="depth", data=depth, encoding="32FC1"))
        lost = k % 3 == 1
        packets.append(
            Delivery(
                stamp_ns=stamp_ns,
                sequence=k,
                sensor="imu_link",
                delivered_ns=-1 if lost else 2**60 + k,  # a float64 would round it
                size_bytes=int(rng.integers(0, 2**40)),
            )
        )
    packets.append(
        Collision(
            stamp_ns=10**15, sequence=0, sensor="collision", position=rng.normal(size=3), clearance_m=-0.25
        )
    )
    return packets


def as_bits(value: object) -> object:
    """Make a field comparable: arrays by type, shape and bytes."""
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.shape, value.tobytes()
    return type(value), value


def assert_same(found: list[Packet], wanted: list[Packet]) -> None:
    assert [type(p) for p in found] == [type(p) for p in wanted]
    for a, b in zip(found, wanted, strict=True):
        assert {k: as_bits(v) for k, v in vars(a).items()} == {k: as_bits(v) for k, v in vars(b).items()}


def write(path: Path, packets: list[Packet], header: RecordingHeader = HEADER, **options: float) -> None:
    with RecordingWriter(path, header, **options) as writer:
        for packet in packets:
            writer.write(packet)


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    seed=st.integers(0, 2**32 - 1),
    event_counts=st.lists(st.sampled_from([0, 0, 1, 2, 50]), max_size=8),
    images=st.integers(0, 3),
    rotors=st.integers(1, 8),
    flush_interval_s=st.sampled_from([0.0, 1e9]),
)
def test_round_trip_is_bitwise(tmp_path, seed, event_counts, images, rotors, flush_interval_s):
    """Same packets, same order, same bits, however often the writer flushes."""
    packets = make_flight(seed, event_counts, images=images, rotors=rotors)
    write(tmp_path / "f.h5", packets, flush_interval_s=flush_interval_s)
    with Recording(tmp_path / "f.h5") as flight:
        assert flight.clean
        assert flight.notes == ()
        assert_same(list(flight.packets()), packets)


def test_what_a_link_did_is_read_as_whole_numbers(tmp_path):
    """As a column of int64 too, for who asks how late every command was."""
    link = Link(LinkConfig(latency_s=0.008, loss=0.5), seed=0, name="command")
    sent = [link.send(None, stamp_ns=2**60 + 10 * MS * k, size_bytes=90 + k) for k in range(50)]
    write(tmp_path / "f.h5", sent)
    with Recording(tmp_path / "f.h5") as flight:
        assert flight.sensors == ("command_link",)
        delivered_ns = flight.column("command_link", "delivered_ns")
        assert delivered_ns.dtype == np.int64
        assert flight.column("command_link", "size_bytes").tolist() == list(range(90, 140))
        arrived = delivered_ns >= 0
        assert (delivered_ns[arrived] - flight.column("command_link", "stamp_ns")[arrived] == 8 * MS).all()
        assert (~arrived).sum() == link.lost_count > 0
        assert_same(list(flight.packets("command_link")), sent)


@pytest.mark.parametrize("deflate", ["isal", "zlib"])
def test_many_packets_cross_chunks_and_blocks(tmp_path, monkeypatch, deflate):
    """More events than a chunk, more rows than a chunk and than a block of the reader; by both libraries."""
    if deflate == "zlib":
        monkeypatch.setitem(sys.modules, "isal", None)
    rng = np.random.default_rng(0)
    packets: list[Packet] = []
    for k in range(5000):
        packets.append(
            ImuSample(
                stamp_ns=k * MS,
                sequence=k,
                sensor="imu",
                specific_force=rng.random(3),
                angular_rate=rng.random(3),
            )
        )
        if k % 500 == 0:
            packets.append(
                make_events(
                    rng, start_ns=(k - 500) * MS, stamp_ns=k * MS, count=20_000 if k else 0, sequence=k
                )
            )
    write(tmp_path / "f.h5", packets, buffer_bytes=300_000)
    with Recording(tmp_path / "f.h5") as flight:
        assert_same(list(flight.packets()), packets)


def test_header_round_trip(tmp_path):
    camera = SensorDescription(
        name="dvs",
        kind="event_camera",
        rate_hz=100.0,
        position=np.array([0.1, 0.0, 0.03]),
        orientation=np.array([-0.5, 0.5, -0.5, 0.5]),
        intrinsics=Intrinsics(width=346, height=260, fx=185.1, fy=185.2, cx=173.0, cy=130.0),
        settings='{"pixel":{"threshold_on":0.2}}',
    )
    imu = SensorDescription(
        name="a_imu",
        kind="imu",
        rate_hz=400.0,
        position=np.zeros(3),
        orientation=np.array([0.0, 0.0, 0.0, 1.0]),
    )
    header = RecordingHeader(
        config_yaml="# ünits\n" + "a: 1\n" * 20_000,  # more than an HDF5 attribute can hold
        seed=2**63 - 1,
        version="9.9.9",
        scene="house",
        sensors=(camera, imu),
        path_stamp_ns=np.array([0, 5], dtype=np.int64),
        path_position=np.array([[0.0, 1.0, 2.0], [3.0, 4.0, 5.0]]),
    )
    write(tmp_path / "f.h5", [], header)
    with Recording(tmp_path / "f.h5") as flight:
        read = flight.header
    for name in ("config_yaml", "seed", "version", "scene"):
        assert getattr(read, name) == getattr(header, name)
    assert as_bits(read.path_stamp_ns) == as_bits(header.path_stamp_ns)
    assert as_bits(read.path_position) == as_bits(header.path_position)
    assert [s.name for s in read.sensors] == ["dvs", "a_imu"]
    for a, b in zip(read.sensors, header.sensors, strict=True):
        assert {k: as_bits(v) for k, v in vars(a).items()} == {k: as_bits(v) for k, v in vars(b).items()}


def dsec_window(file: h5py.Group, start_us: int, end_us: int) -> dict[str, np.ndarray]:
    """Read a window as the definition of DSEC allows: conservative milliseconds, then exact times."""
    start_us -= int(file["t_offset"][()])
    end_us -= int(file["t_offset"][()])
    index = np.asarray(file["ms_to_idx"], dtype=np.int64)
    low, high = index[start_us // 1000], index[-(-end_us // 1000)]
    t = file["events/t"][low:high]
    inside = (t >= start_us) & (t < end_us)
    return {name: file[f"events/{name}"][low:high][inside] for name in ("t", "x", "y", "p")}


@pytest.mark.parametrize("counts", [[0, 300, 0, 0, 1, 5000], [0], [1], []])
def test_index_obeys_its_definition_and_dsec_readers_find_it(tmp_path, counts):
    """t[ms_to_idx[ms]] >= 1000 ms and t[ms_to_idx[ms] - 1] < 1000 ms, up to the first ms after the flight."""
    rng = np.random.default_rng(1)
    packets = [
        make_events(rng, start_ns=k * 7 * MS + 500, stamp_ns=(k + 1) * 7 * MS + 500, count=n, sequence=k)
        for k, n in enumerate(counts)
    ]
    write(tmp_path / "f.h5", packets)
    with h5py.File(tmp_path / "f.h5") as file:
        assert ("events" in file) == bool(counts)
        if not counts:
            return
        t, index = file["events/t"][:], file["ms_to_idx"][:]
        assert len(index) == 7 * len(counts) + 2
        brute = [
            int((t < 1000 * ms).sum()) for ms in range(len(index))
        ]  # events before: both conditions at once
        assert index.tolist() == brute
        assert file["t_offset"][()] == 0
        assert file["events"] == file["sensors/dvs/events"]  # the same object, not a copy
        for start_us, end_us in ((0, 1), (2_500, 6_999), (7_000, 7 * len(counts) * 1000 + 1)):
            found = dsec_window(file, start_us, end_us)
            inside = (t >= start_us) & (t < end_us)
            assert found["t"].tolist() == t[inside].tolist()
            assert found["p"].tolist() == file["events/p"][:][inside].tolist()


def test_root_belongs_to_the_first_camera_of_the_configuration(tmp_path):
    rng = np.random.default_rng(0)
    cameras = tuple(
        SensorDescription(
            name=name,
            kind="event_camera",
            rate_hz=1.0,
            position=np.zeros(3),
            orientation=np.array([0, 0, 0, 1.0]),
            has_events=True,
        )
        for name in ("right", "left")
    )
    packets = [
        make_events(rng, start_ns=0, stamp_ns=10 * MS, count=n, sensor=s)
        for s, n in (("left", 5), ("right", 9))
    ]
    write(
        tmp_path / "f.h5",
        packets,
        RecordingHeader(config_yaml="", seed=0, version="", scene="", sensors=cameras),
    )
    with h5py.File(tmp_path / "f.h5") as file:
        assert file["events/t"].shape == (9,)
        assert dsec_window(file["sensors/left"], 0, 10_001)["t"].shape == (5,)


def test_events_of_a_class_that_is_not_known_here_are_read(tmp_path, monkeypatch):
    @dataclass(frozen=True, kw_only=True, eq=False)
    class Colored(Events):
        color: Annotated[NDArray[np.uint8], FieldSpec("event")]

    rng = np.random.default_rng(0)
    packets = [
        Colored(
            **vars(make_events(rng, start_ns=10 * MS * k, stamp_ns=10 * MS * (k + 1), count=7)),
            color=rng.integers(0, 3, 7, dtype=np.uint8),
        )
        for k in range(3)
    ]
    write(tmp_path / "f.h5", packets)
    monkeypatch.delitem(packet_module._classes, schema_of(Colored).name)
    with Recording(tmp_path / "f.h5") as flight:
        for found, wanted in zip(flight.packets("dvs"), packets, strict=True):
            assert not isinstance(found, Events)
            assert {k: as_bits(v) for k, v in vars(found).items()} == {
                k: as_bits(v) for k, v in vars(wanted).items()
            }
        t = np.concatenate([packet.t for packet in packets])
        assert flight.events("dvs", 0.005, 0.025).t.tolist() == t[(t >= 5000) & (t < 25_000)].tolist()


def test_event_windows_match_brute_force(tmp_path):
    rng = np.random.default_rng(2)
    packets = [
        make_events(rng, start_ns=k * 10 * MS, stamp_ns=(k + 1) * 10 * MS, count=400) for k in range(10)
    ]
    write(tmp_path / "f.h5", packets)
    t, x = (np.concatenate([getattr(p, name) for p in packets]) for name in ("t", "x"))
    windows = [tuple(sorted(rng.uniform(-0.01, 0.12, 2))) for _ in range(200)]
    windows += [(0.0, 0.1), (0.02, 0.02), (0.05, 0.01), (5.0, 6.0), (float(t[17]) / 1e6, float(t[40]) / 1e6)]
    with Recording(tmp_path / "f.h5") as flight:
        for start_s, end_s in windows:
            inside = (t * 1000 >= round(start_s * 1e9)) & (t * 1000 < round(end_s * 1e9))
            found = flight.events("dvs", start_s, end_s)
            assert found.t.tolist() == t[inside].tolist()
            assert found.x.tolist() == x[inside].tolist()


def test_packet_windows_and_columns_match_brute_force(tmp_path):
    packets = make_flight(3, [10, 0, 20, 5])[:-1]
    write(tmp_path / "f.h5", packets)
    with Recording(tmp_path / "f.h5") as flight:
        for start_s, end_s in ((None, 0.02), (0.02, None), (0.02, 0.030000137), (0.5, 0.6), (0.03, 0.01)):
            wanted = [
                p
                for p in packets
                if (start_s is None or p.stamp_ns >= round(start_s * 1e9))
                and (end_s is None or p.stamp_ns < round(end_s * 1e9))
            ]
            assert_same(list(flight.packets(start_s=start_s, end_s=end_s)), wanted)
        assert_same(
            list(flight.packets("imu", "dvs")), [p for p in packets if isinstance(p, ImuSample | Events)]
        )
        positions = np.stack([p.position for p in packets if isinstance(p, Odometry)])
        assert as_bits(flight.column("truth", "position")) == as_bits(positions)
        assert flight.column("dvs", "dropped_count").tolist() == [0, 1, 2, 3]
        assert flight.packet_count("rgb") == 3


CHILD = """
import sys, numpy as np
sys.path.insert(0, sys.argv[2])
from test_hdf5 import HEADER, make_flight
from neurosim_core.record import RecordingWriter
writer = RecordingWriter(sys.argv[1], HEADER, flush_interval_s=1e9)
packets = make_flight(5, [700, 0, 900, 30, 1, 500] * 4)[:-1]
for packet in packets[:50]:
    writer.write(packet)
writer.flush()
for packet in packets[50:60]:
    writer.write(packet)
print("ready", flush=True)
{then}
"""


def kill_child(path: Path, then: str) -> None:
    command = [sys.executable, "-c", CHILD.format(then=then), str(path), str(Path(__file__).parent)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as child:
        assert child.stdout is not None
        assert child.stdout.readline() == "ready\n"
        child.send_signal(signal.SIGKILL)


@pytest.mark.parametrize(
    "then",
    [
        "import time; time.sleep(60)",
        "for k in range(10**6): writer.write(packets[60]); writer.flush() if k % 7 == 0 else None",
    ],
    ids=["between flushes", "while flushing"],
)
def test_killed_run_leaves_a_readable_file(tmp_path, then, caplog):
    """All packets up to the last flush are there, bit for bit; the reader says that the end is missing."""
    path = tmp_path / "f.h5"
    kill_child(path, then)
    packets = make_flight(5, [700, 0, 900, 30, 1, 500] * 4)[:-1]
    with Recording(path) as flight:
        assert not flight.clean
        assert "was not closed" in flight.notes[0]
        assert "was not closed" in caplog.text
        found = list(flight.packets())
        if "flush" in then:
            assert len(found) >= 50
            assert_same(found[:50], packets[:50])
        else:
            assert_same(found, packets[:50])
        flushed = [p for p in packets[:50] if isinstance(p, Events)]
        end_s = flushed[-1].stamp_ns * 1e-9
        t = np.concatenate([p.t for p in flushed])
        assert flight.events("dvs", 0.0, end_s).t.tolist() == t[t < end_s * 1e6].tolist()
    with h5py.File(path) as file:  # and any other program can open it
        assert file["events/t"].shape[0] >= len(t)


def run_child(path: Path, then: str, *, first: str = "") -> tuple[int, str, str]:
    command = [sys.executable, "-c", first + CHILD.format(then=then), str(path), str(Path(__file__).parent)]
    done = subprocess.run(command, timeout=300, capture_output=True, text=True, check=False)
    return done.returncode, done.stdout.removeprefix("ready\n"), done.stderr


@pytest.mark.parametrize(
    ("then", "count"),
    [
        ("", 60),
        ("raise SystemExit(0)", 60),
        ("writer.write(packets[60]); writer._begin_flush()", 61),
        ("import atexit; atexit.register(lambda: [*map(writer.write, packets[60:90])])", 90),
    ],
)
def test_a_program_that_does_not_close_leaves_all_that_it_wrote(tmp_path, then, count):
    """Also what it writes as it ends, when threads and pools take nothing any more."""
    assert run_child(tmp_path / "f.h5", then) == (0, "", "")
    with Recording(tmp_path / "f.h5") as flight:
        assert not flight.clean
        packets = make_flight(5, [700, 0, 900, 30, 1, 500] * 4)[:-1]
        assert_same(list(flight.packets()), packets[:count])


def test_no_thread_is_left_of_a_recording_that_is_closed(tmp_path):
    """A thread that is alive when the interpreter ends may hold a lock for which the interpreter waits."""
    before = threading.active_count()
    for _ in range(20):
        RecordingWriter(tmp_path / "f.h5", HEADER).close()
        assert threading.active_count() <= before


DISK = """
import os, time
from neurosim_core.record import hdf5
hdf5._QUIET_S = 1.0
wait_s, write = 0.0, os.pwrite
def late(*arguments):
    time.sleep(wait_s)
    return write(*arguments)
os.pwrite = late
"""


def test_a_program_that_ends_waits_for_a_slow_disk(tmp_path):
    """A flush may take longer than the disk may hang."""
    assert run_child(tmp_path / "f.h5", "wait_s = 0.05", first=DISK) == (0, "", "")
    with Recording(tmp_path / "f.h5") as flight:
        assert len(list(flight.packets())) == 60


def test_a_program_that_ends_does_not_wait_for_a_disk_that_hangs(tmp_path):
    status, _, errors = run_child(tmp_path / "f.h5", "wait_s = 1e6", first=DISK)
    assert status == 1
    assert re.search(r"f.h5: the disk took nothing for 1 s; \d.\d MB wait for it; .* kept up to 0.1", errors)
    with Recording(tmp_path / "f.h5") as flight:
        assert len(list(flight.packets())) == 50


def test_a_disk_that_hangs_is_said_and_ctrl_c_ends_the_waiting(tmp_path):
    """Not the file: a thread is still in it, as long as the process lives."""
    then = """
import logging
class Interrupt(logging.Handler):
    def emit(self, record):
        said.append(record.getMessage())
        if len(said) <= 2:
            os.kill(os.getpid(), signal.SIGINT)
said = []
logging.getLogger().addHandler(Interrupt())
wait_s = 1e6
for wait in writer.flush, writer.close:
    try:
        wait()
    except KeyboardInterrupt:
        print("interrupted", flush=True)
print(said[0], flush=True)
"""
    status, found, _ = run_child(tmp_path / "f.h5", then, first=f"import signal{DISK}")
    assert status == 1  # given up at the end
    assert found.startswith("interrupted\ninterrupted\n")
    assert re.search(r"f.h5: the disk took nothing for 1 s; 0\.\d MB wait for it", found)
    with Recording(tmp_path / "f.h5") as flight:
        assert len(list(flight.packets())) == 50


@pytest.mark.parametrize("leave", ["sys.exit()", "writer.close(); sys.exit()", "writer.flush()"])
def test_a_forked_process_leaves_the_file_to_its_parent(tmp_path, leave):
    then = f"""
import os
child = os.fork()
if child == 0:
    try:
        writer.write(packets[60])
    except RuntimeError as error:
        print(error, flush=True)
    {leave}
os.waitpid(child, 0)
writer.write(packets[60])
writer.close()
"""
    status, found, _ = run_child(tmp_path / "f.h5", then)
    assert status == 0
    assert "only its parent can write to it" in found
    with Recording(tmp_path / "f.h5") as flight:
        assert flight.clean
        packets = make_flight(5, [700, 0, 900, 30, 1, 500] * 4)[:-1]
        assert_same(list(flight.packets()), packets[:61])


def test_writing_waits_for_a_slow_disk(tmp_path, monkeypatch):
    """What is not in the file is at most twice the bound and a packet, and nothing of it is lost."""
    rng = np.random.default_rng(0)
    packets = [
        make_events(rng, start_ns=k * MS, stamp_ns=(k + 1) * MS, count=2000, sequence=k) for k in range(50)
    ]  # 26 kB each
    bound, gate, seal = 100_000, threading.Event(), Disk.seal
    monkeypatch.setattr(Disk, "seal", lambda disk: gate.wait(60.0) and seal(disk))
    gate.set()
    with RecordingWriter(tmp_path / "f.h5", HEADER, flush_interval_s=1e9, buffer_bytes=bound) as writer:
        writer.write(packets[0])
        writer.flush()
        gate.clear()
        rest = threading.Thread(target=lambda: [*map(writer.write, packets[1:])], daemon=True)
        rest.start()
        deadline_s = time.monotonic() + 60.0
        while writer.pending_bytes < 150_000 and time.monotonic() < deadline_s:
            time.sleep(0.001)
        rest.join(0.2)
        assert rest.is_alive()
        assert 150_000 < writer.pending_bytes < 2 * bound + 27_000
        assert writer.kept_ns == MS
        gate.set()
        rest.join(60.0)
    with Recording(tmp_path / "f.h5") as flight:
        assert_same(list(flight.packets()), packets)


def test_memory_is_bounded(tmp_path):
    """Buffers, chunks and what compresses them are a fraction of what is written."""
    rng = np.random.default_rng(0)
    events = make_events(rng, start_ns=0, stamp_ns=MS, count=100_000)  # 1.3 MB
    with RecordingWriter(tmp_path / "f.h5", HEADER, flush_interval_s=1e9, buffer_bytes=2_000_000) as writer:
        writer.write(events)
        tracemalloc.start()
        for k in range(1, 60):
            writer.write(replace(events, stamp_ns=(k + 1) * MS, t=events.t + 1000 * k, sequence=k))
        held_bytes = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    assert held_bytes < 20_000_000


def test_caller_may_reuse_small_arrays(tmp_path):
    data = np.zeros((4, 4), dtype=np.float32)
    with RecordingWriter(tmp_path / "f.h5", HEADER, flush_interval_s=1e9) as writer:
        for k in range(3):
            data[:] = k
            writer.write(Image(stamp_ns=k, sequence=k, sensor="depth", data=data, encoding="32FC1"))
    with Recording(tmp_path / "f.h5") as flight:
        assert flight.column("depth", "data")[:, 0, 0].tolist() == [0.0, 1.0, 2.0]


def image(stamp_ns=0, shape=(4, 5, 3), encoding="rgb8", sensor="rgb"):
    return Image(stamp_ns=stamp_ns, sensor=sensor, data=np.zeros(shape, np.uint8), encoding=encoding)


@pytest.mark.parametrize(
    ("second", "message"),
    [
        (image(stamp_ns=9), "stamp 9 ns comes after 10 ns"),
        (image(stamp_ns=11, shape=(5, 4, 3)), r"was .*\(4, 5, 3, .* got .*\(5, 4, 3, "),
        (image(stamp_ns=11, shape=(4, 5), encoding="mono8"), "mono8"),
        (
            Collision(stamp_ns=11, sensor="rgb", position=np.zeros(3), clearance_m=0.0),
            "sends Image, got a Collision",
        ),
        (image(stamp_ns=11, sensor=""), "needs a sensor name"),
        (
            Collision(stamp_ns=11, sensor="bump", position=np.zeros(2), clearance_m=0.0),
            r"'bump': position must have shape \[3\], got \[2\]",
        ),
    ],
)
def test_packets_that_do_not_fit_are_refused(tmp_path, second, message):
    with RecordingWriter(tmp_path / "f.h5", HEADER) as writer:
        writer.write(image(stamp_ns=10))
        with pytest.raises(ValueError, match=message):
            writer.write(second)
    with Recording(tmp_path / "f.h5") as flight:  # what was there is unharmed
        assert_same(list(flight.packets()), [image(stamp_ns=10)])


def test_a_packet_of_a_wrong_type_leaves_nothing(tmp_path):
    samples = [packet for packet in make_flight(0, [50, 50, 50]) if isinstance(packet, Events)]
    wrong = replace(samples[1], polarity=samples[1].polarity.astype(np.float64))
    with RecordingWriter(tmp_path / "f.h5", HEADER) as writer:
        writer.write(samples[0])
        with pytest.raises(TypeError, match="float64"):
            writer.write(wrong)
        writer.write(samples[2])
    with Recording(tmp_path / "f.h5") as flight:
        assert_same(list(flight.packets()), [samples[0], samples[2]])


def test_unwritable_path_is_named(tmp_path):
    with pytest.raises(OSError, match=r"cannot write .*nowhere/f.h5.*No such file or directory"):
        RecordingWriter(tmp_path / "nowhere" / "f.h5", HEADER)


def test_full_disk_is_reported_once_and_leaves_what_was_flushed(tmp_path):
    """A limit on the file's size acts like a full disk: the write call fails."""
    code = """
import resource, signal, sys
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
sys.path.insert(0, sys.argv[2])
import numpy as np
from test_hdf5 import HEADER, image, make_events
from neurosim_core.live.links import Link
from neurosim_core.live.config import LinkConfig
from neurosim_core.packets import Image
from neurosim_core.record import RecordingWriter
rng = np.random.default_rng(0)
writer = RecordingWriter(sys.argv[1], HEADER, flush_interval_s=0.0)
resource.setrlimit(resource.RLIMIT_FSIZE, (1_000_000, 1_000_000))
try:
    with writer:
        for k in range(300):
            data = rng.integers(0, 256, (100, 100, 3), dtype=np.uint8)
            writer.write(Image(stamp_ns=k, sequence=k, sensor="rgb", data=data, encoding="rgb8"))
except OSError as error:
    print(writer.kept_ns, error)
"""
    command = [sys.executable, "-c", code, str(tmp_path / "f.h5"), str(Path(__file__).parent)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300.0, check=True)
    kept_ns, message = done.stdout.split(" ", 1)
    assert "cannot write" in message
    assert "File too large" in message
    assert "f.h5" in message
    assert 20 < int(kept_ns) < 40  # 30 kB of noise a picture
    assert done.stderr == ""
    with Recording(tmp_path / "f.h5") as flight:
        assert not flight.clean
        assert len(list(flight.packets())) == int(kept_ns) + 1


def test_a_thread_that_fails_is_reported_once_and_leaves_what_was_flushed(tmp_path):
    def fail(_: object) -> list[list[bytes]]:
        raise MemoryError("no room")

    deflates = [deflate, fail]
    writer = RecordingWriter(tmp_path / "f.h5", HEADER, deflate=lambda columns: deflates.pop(0)(columns))
    writer.write(image(stamp_ns=1, shape=(90, 90)))
    writer.flush()
    writer.write(image(stamp_ns=2, shape=(90, 90)))
    with pytest.raises(MemoryError, match="no room"):
        writer.flush()
    writer.close()
    with Recording(tmp_path / "f.h5") as flight:
        assert not flight.clean
        assert_same(list(flight.packets()), [image(stamp_ns=1, shape=(90, 90))])


def test_files_that_are_not_ours_are_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match="no file"):
        Recording(tmp_path / "none.h5")
    (tmp_path / "text.h5").write_text("not HDF5")
    with pytest.raises(ValueError, match="not a readable HDF5 file"):
        Recording(tmp_path / "text.h5")
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["events/t"] = [1, 2]
    with pytest.raises(ValueError, match="not a recording"):
        Recording(tmp_path / "other.h5")
    write(tmp_path / "later.h5", [])
    for version, age in ((1, "an older"), (99, "a newer")):
        with h5py.File(tmp_path / "later.h5", "r+") as file:
            file.attrs["format_version"] = version
        with pytest.raises(ValueError, match=rf"written by {age} version .*format version {version}\)"):
            Recording(tmp_path / "later.h5")


@pytest.mark.parametrize("lost", ["path/stamp_ns", "sensors/imu/sequence"])
def test_what_is_missing_in_a_recording_is_damage(tmp_path, lost):
    write(tmp_path / "f.h5", make_flight(0, [1]))
    with h5py.File(tmp_path / "f.h5", "r+") as file:
        del file[lost]
    with pytest.raises(ValueError, match=r"f.h5 is damaged: "), Recording(tmp_path / "f.h5") as flight:
        list(flight.packets())


def test_a_flipped_bit_in_a_schema_is_damage(tmp_path):
    write(tmp_path / "f.h5", make_flight(0, [1]))
    with h5py.File(tmp_path / "f.h5", "r+") as file:
        attributes = file["sensors/imu"].attrs
        attributes["schema"] = attributes["schema"].replace("dtype", "etype", 1)
    with pytest.raises(ValueError, match=r"f.h5 is damaged: .*etype"):
        Recording(tmp_path / "f.h5")


def test_unknown_names_list_the_known_ones(tmp_path):
    write(tmp_path / "f.h5", make_flight(0, [1]))
    with Recording(tmp_path / "f.h5") as flight:
        with pytest.raises(ValueError, match=r"unknown sensor 'nose', known: .*'imu'"):
            next(flight.packets("nose"))
        with pytest.raises(ValueError, match=r"unknown field 'smell' .* known: .*'specific_force'"):
            flight.column("imu", "smell")
        with pytest.raises(ValueError, match="sends ImuSample, not Events"):
            flight.events("imu", 0.0, 1.0)


def test_missing_h5py_names_the_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "h5py", None)
    for open_file in (
        lambda: RecordingWriter(tmp_path / "f.h5", HEADER),
        lambda: Recording(tmp_path / "f.h5"),
    ):
        with pytest.raises(ImportError, match=r"pip install -e '\.\[record\]'"):
            open_file()
