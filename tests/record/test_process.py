"""A recording that another process writes: the same file, whoever fails, is stopped, is killed or forks."""

from __future__ import annotations

import contextlib
import itertools
import os
import re
import signal
import subprocess
import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import h5py
import numpy as np
import pytest
from numpy.typing import NDArray
from processes import children_of, gone, wait_for
from test_hdf5 import HEADER, MS, assert_same, image, make_events, make_flight, write

from neurosim_core.packets import Events, FieldSpec, Packet
from neurosim_core.record import Recording
from neurosim_core.record.hdf5 import deflate_count
from neurosim_core.record.process import RecordingProcess, start_process

PACKETS = make_flight(5, [700, 0, 20_000, 30, 1, 500] * 4)[:-1]
BEGIN = """
import contextlib, os, signal, sys, time
from pathlib import Path
sys.path[:0] = [sys.argv[2], os.path.join(sys.argv[2], "..", "support")]
from test_hdf5 import HEADER, image
from test_process import PACKETS
from neurosim_core.record.process import RecordingProcess, start_process
writer = RecordingProcess(Path(sys.argv[1]), HEADER)
"""


@dataclass(frozen=True, kw_only=True, eq=False)
class LabelledEvents(Events):
    """Events of a class that the process which writes cannot import."""

    label: Annotated[NDArray[np.uint8], FieldSpec("event")]


@dataclass(frozen=True, kw_only=True, eq=False)
class Note(Packet):
    """What a packet may hold besides: texts, also as objects, arrays that are empty or not contiguous."""

    text: str
    table: Annotated[NDArray[np.float32], FieldSpec("n", 2)]
    words: Annotated[NDArray[np.str_], FieldSpec("n", dtype="str")]
    picture: Annotated[NDArray[np.int16], FieldSpec("H", "W")]
    is_last: bool
    who: Annotated[str, FieldSpec(constant=True)]


class Word(str):
    """A text of a class that the process which writes cannot import."""

    __module__ = "notebook"


def run(code: str, path: Path) -> subprocess.Popen[str]:
    command = [sys.executable, "-c", BEGIN + code, str(path), str(Path(__file__).parent)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def wait_for_packets(path: Path) -> list[Packet]:
    """Return the packets of a file that nobody closes explicitly, once all are there."""
    deadline_s = time.monotonic() + 60.0
    found: list[Packet] = []
    while len(found) < len(PACKETS) and time.monotonic() < deadline_s:
        time.sleep(0.05)
        with contextlib.suppress(ValueError, OSError), Recording(path) as flight:  # being written
            assert not flight.clean
            found = list(flight.packets())
    return found


def contents(path: Path) -> dict[str, object]:
    """Return all attributes, and the data of all datasets as they are stored."""
    found: dict[str, object] = {}

    def note(name: str, item: h5py.Group | h5py.Dataset) -> None:
        found[name] = [(key, np.asarray(value).tobytes()) for key, value in item.attrs.items()]
        if not isinstance(item, h5py.Dataset):
            return
        layout = item.dtype, item.shape, item.chunks, item.compression, item.shuffle
        found[f"{name} data"] = (*layout, repr(item[()]) if item.dtype.kind == "O" else item[()].tobytes())
        if item.chunks is not None:
            chunks = [item.id.get_chunk_info(index).chunk_offset for index in range(item.id.get_num_chunks())]
            found[f"{name} stored"] = [item.id.read_direct_chunk(chunk) for chunk in chunks]

    with h5py.File(path) as file:
        file.visititems(note)
        found["/"] = sorted((key, str(value)) for key, value in file.attrs.items())
        found["root of DSEC"] = sorted(key for key in file if file[key].name != f"/{key}" or key == "events")
    return found


def test_the_file_is_that_of_the_writer(tmp_path):
    rng = np.random.default_rng(0)
    packets = [*PACKETS]
    for k in range(3):
        events = make_events(rng, start_ns=k * MS, stamp_ns=(k + 1) * MS, count=3000 * k, sensor="mine")
        packets.append(LabelledEvents(**vars(events), label=rng.integers(0, 9, 3000 * k, dtype=np.uint8)))
        picture = rng.integers(0, 99, (120, 160), dtype=np.int16)[::2, ::2]
        table = rng.random((k, 2), dtype=np.float32)
        note = {"text": f"ä{k}", "table": table, "picture": picture, "is_last": k == 2, "who": "me"}
        words = np.array(["yes", "no"][:k], object)
        packets.append(Note(stamp_ns=(k + 1) * MS, sequence=k, sensor=np.str_("note"), words=words, **note))
    write(tmp_path / "wanted.h5", packets, flush_interval_s=1e9)
    start_process()
    writer = RecordingProcess(tmp_path / "found.h5", HEADER)
    for packet in packets:
        writer.write(packet)
    writer.close()
    writer.close()
    assert contents(tmp_path / "found.h5") == contents(tmp_path / "wanted.h5")
    with Recording(tmp_path / "found.h5") as flight:
        assert flight.clean
        assert flight.packet_count("mine") == flight.packet_count("note") == 3


def test_a_file_that_cannot_be_created_is_told_at_once(tmp_path):
    with pytest.raises(OSError, match=r"cannot write .*nowhere/f.h5: No such file or directory"):
        RecordingProcess(tmp_path / "nowhere" / "f.h5", HEADER)


def test_a_class_that_cannot_be_recorded_is_refused_each_time_and_changes_nothing(tmp_path):
    @dataclass(frozen=True, kw_only=True, eq=False)
    class Bad(Packet, known=False):
        table: dict

    writer = RecordingProcess(tmp_path / "f.h5", HEADER)
    for _ in range(2):
        with pytest.raises(TypeError, match="field 'table' of packet Bad"):
            writer.write(Bad(sensor="bad", table={}))
    writer.write(image(stamp_ns=10))
    writer.close()
    with pytest.raises(ValueError, match=r"f\.h5 is closed"):
        writer.write(image(stamp_ns=11))
    with Recording(tmp_path / "f.h5") as flight:
        assert_same(list(flight.packets()), [image(stamp_ns=10)])


def test_what_cannot_be_received_is_told_by_close(tmp_path, monkeypatch):
    @dataclass(frozen=True, kw_only=True, eq=False)
    class Words(Packet, known=False):
        words: Annotated[NDArray[np.str_], FieldSpec("n", dtype="str")]

    monkeypatch.setitem(sys.modules, "notebook", sys.modules[__name__])
    writer = RecordingProcess(tmp_path / "f.h5", HEADER)
    writer.write(image(stamp_ns=10))
    writer.write(Words(sensor="words", words=np.array([Word("yes")], object)))
    with pytest.raises(ModuleNotFoundError, match="notebook"):
        writer.close()


def test_what_the_writer_refuses_is_raised_by_a_later_call_and_once(tmp_path):
    writer = RecordingProcess(tmp_path / "f.h5", HEADER)
    writer.write(image(stamp_ns=10))
    writer.write(image(stamp_ns=9))
    with pytest.raises(ValueError, match="stamp 9 ns comes after 10 ns"):
        writer.close()
    writer.close()
    with pytest.raises(ValueError, match="stamp 9 ns comes after 10 ns"):
        writer.write(image(stamp_ns=11))
    with Recording(tmp_path / "f.h5") as flight:
        assert not flight.clean
        assert_same(list(flight.packets()), [image(stamp_ns=10)])


def test_a_full_disk_is_told_with_what_is_kept(tmp_path):
    """A limit on the file's size acts like a full disk, also for the process that inherits it."""
    code = """
import resource
resource.setrlimit(resource.RLIMIT_FSIZE, (1_000_000, 1_000_000))
writer = RecordingProcess(Path(sys.argv[1] + "2"), HEADER)
import numpy as np
from dataclasses import replace
try:
    for k in range(100_000):
        noise = np.random.default_rng(k).integers(0, 256, (100, 100, 3), dtype=np.uint8)
        writer.write(replace(image(stamp_ns=k), data=noise))
except OSError as error:
    print(k, writer.kept_ns, error)
writer.close()
"""
    found, errors = run(code, tmp_path / "f.h5").communicate(timeout=300.0)
    assert errors == ""
    _, kept_ns, message = found.split(" ", 2)
    assert "cannot write" in message
    assert "File too large" in message
    with Recording(tmp_path / "f.h52") as flight:
        assert [packet.stamp_ns for packet in flight.packets()] == [*range(int(kept_ns) + 1)]


@pytest.fixture
def none_waits(tmp_path_factory):
    """No process waits for a recording: one that a test before has left takes this one."""
    RecordingProcess(tmp_path_factory.mktemp("left") / "f.h5", HEADER).close()


@pytest.mark.usefixtures("none_waits")
def test_a_process_that_is_killed_while_it_waits_is_replaced(tmp_path):
    before = children_of(os.getpid())
    start_process()
    (pid,) = children_of(os.getpid()) - before
    os.kill(pid, signal.SIGKILL)
    wait_for(lambda: gone(pid))
    writer = RecordingProcess(tmp_path / "f.h5", HEADER)
    writer.write(PACKETS[0])
    writer.close()
    with Recording(tmp_path / "f.h5") as flight:
        assert flight.clean
        assert len([*flight.packets()]) == 1


@pytest.mark.usefixtures("none_waits")
def test_a_writer_that_is_killed_is_noticed(tmp_path):
    before = children_of(os.getpid())
    writer = RecordingProcess(tmp_path / "f.h5", HEADER)
    writer.write(PACKETS[0])
    (pid,) = children_of(os.getpid()) - before
    os.kill(pid, signal.SIGKILL)
    with pytest.raises(OSError, match="the process that writes it ended by signal 9"):
        all(writer.write(packet) is None for packet in itertools.repeat(PACKETS[0]))
    assert writer.kept_ns is None
    writer.close()


@pytest.mark.skipif(sys.platform != "linux", reason="which processes there are, only Linux says in files")
@pytest.mark.usefixtures("none_waits")
def test_a_compressor_that_is_killed_is_noticed(tmp_path):
    before = children_of(os.getpid())
    writer = RecordingProcess(tmp_path / "f.h5", HEADER)
    writer.write(PACKETS[0])
    (pid,) = children_of(os.getpid()) - before
    wait_for(lambda: len(children_of(pid)) >= deflate_count())
    for child in children_of(pid):
        os.kill(child, signal.SIGKILL)
    for packet in PACKETS[1:]:
        writer.write(packet)
    with pytest.raises(OSError, match="a process that compresses has ended"):
        writer.close()
    with Recording(tmp_path / "f.h5") as flight:
        assert not flight.clean


@pytest.mark.usefixtures("none_waits")
def test_writing_waits_for_a_process_that_stands_still(tmp_path):
    """Without end neither memory grows nor anything is lost."""
    packets = [image(stamp_ns=k, shape=(1000, 1000, 4)) for k in range(30)]  # 4 MB each
    before = children_of(os.getpid())
    writer = RecordingProcess(tmp_path / "f.h5", HEADER)
    writer.write(packets[0])
    (pid,) = children_of(os.getpid()) - before
    os.kill(pid, signal.SIGSTOP)
    written: list[None] = []
    rest = threading.Thread(target=lambda: written.extend(map(writer.write, packets[1:])), daemon=True)
    rest.start()
    rest.join(1.0)
    assert rest.is_alive()
    assert 0 < len(written) < 20
    os.kill(pid, signal.SIGCONT)
    rest.join(60.0)
    writer.close()
    with Recording(tmp_path / "f.h5") as flight:
        assert flight.packet_count("rgb") == 30


def test_a_disk_that_hangs_is_said_and_ctrl_c_ends_the_waiting(tmp_path, monkeypatch):
    (tmp_path / "sitecustomize.py").write_text(
        "import os, time\n"
        "write = os.pwrite\n"
        "os.pwrite = lambda *a: time.sleep(1e6 if os.path.exists(os.environ['HANGS']) else 0) or write(*a)\n"
    )
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path), *sys.path]))
    monkeypatch.setenv("HANGS", str(tmp_path / "hangs"))
    code = """
while not os.path.getsize(sys.argv[1]):
    time.sleep(0.01)
print("begun", flush=True)
open(os.environ["HANGS"], "w").close()
for packet in PACKETS:
    writer.write(packet)
try:
    writer.close()
except KeyboardInterrupt:
    writer.close()
    print("interrupted")
"""
    with run(code, tmp_path / "f.h5") as process:
        assert process.stdout is not None
        assert process.stderr is not None
        assert process.stdout.readline() == "begun\n"
        (writer,) = children_of(process.pid)
        try:
            said = process.stderr.readline()
            assert re.search(r"f.h5: the disk took nothing for 5 s; \d+\.\d MB wait for it", said)
            process.send_signal(signal.SIGINT)
            assert process.stdout.readline() == "interrupted\n"
            assert process.wait(60.0) == 0
        finally:
            os.kill(writer, signal.SIGKILL)


@pytest.mark.parametrize("end", ["kill", "leave", "fork"])
def test_what_was_sent_is_kept_where_the_one_that_flies_ends(tmp_path, end):
    """Also where a process that it has forked lives on."""
    code = """
for packet in PACKETS:
    writer.write(packet)
while writer._sent_bytes < writer._put_bytes:
    time.sleep(0.01)
child = os.fork() if "fork" in sys.argv[1] else 1
if child:
    print(child, flush=True)
if "leave" not in sys.argv[1]:
    time.sleep(60.0 if "kill" in sys.argv[1] or not child else 0.0)
"""
    path = tmp_path / f"{end}.h5"
    with run(code, path) as process:
        assert process.stdout is not None
        child = int(process.stdout.readline())
        if end == "kill":
            process.kill()
        assert_same(wait_for_packets(path), PACKETS)
        if end == "fork":
            os.kill(child, signal.SIGKILL)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_to_all_processes_leaves_a_complete_file(tmp_path, number):
    """Ctrl-C goes to all processes of a terminal, that of a service manager to other sessions, too."""
    code = """
number = int(sys.argv[1].rpartition(".")[2])
os.setpgrp()
stopped = []
signal.signal(number, lambda *_: stopped.append(1))
while not os.path.getsize(sys.argv[1]):
    time.sleep(0.01)
for k, packet in enumerate(PACKETS):
    writer.write(packet)
    if k == 50:
        os.killpg(0, number)
        (child,) = Path(f"/proc/self/task/{os.getpid()}/children").read_text().split()
        os.killpg(int(child), number)
writer.close()
print(stopped)
"""
    path = tmp_path / f"f.h5.{int(number)}"
    assert run(code, path).communicate(timeout=300.0) == ("[1]\n", "")
    with Recording(path) as flight:
        assert flight.clean
        assert_same(list(flight.packets()), PACKETS)


def test_a_forked_process_leaves_the_recording_to_its_parent(tmp_path):
    code = """
for packet in PACKETS[:50]:
    writer.write(packet)
start_process()
child = os.fork()
if child == 0:
    try:
        writer.write(PACKETS[50])
    except RuntimeError as error:
        print(error, flush=True)
    writer.close()
    with contextlib.closing(RecordingProcess(Path(sys.argv[1] + "2"), HEADER)) as own:
        own.write(PACKETS[0])
    sys.exit()
os.waitpid(child, 0)
for packet in PACKETS[50:]:
    writer.write(packet)
writer.close()
"""
    found, errors = run(code, tmp_path / "f.h5").communicate(timeout=300.0)
    assert errors == ""
    assert "only its parent can write" in found
    with Recording(tmp_path / "f.h52") as flight:
        assert_same(list(flight.packets()), PACKETS[:1])
    with Recording(tmp_path / "f.h5") as flight:
        assert flight.clean
        assert_same(list(flight.packets()), PACKETS)
