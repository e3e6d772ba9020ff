"""The memory of a ring: its bytes as WIRE.md section 6 has them, what is refused, what is left behind."""

from __future__ import annotations

import errno
import fcntl
import gc
import logging
import mmap
import os
import stat
import struct
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cortex import memory
from cortex.memory import ShmUnavailable, address_of, make_private
from cortex.shm import Ring, RingView

ROOT = Path(__file__).resolve().parents[2]
SOURCE, RING, SLOTS, SLOT_BYTES = 0x1122334455667788, 9, 3, 8192
# By hand from section 6: 3 slots of 64 columns after the first page, 3 headers of 64 bytes, the next page.
LEASES, HEADERS, BODIES, TOTAL = 4096, 4096 + 192, 8192, 8192 + 3 * 8192
FIELDS = (b"CTXRING1", 1, RING, SOURCE, SLOTS, 64, SLOT_BYTES, LEASES, HEADERS, BODIES, TOTAL)
HEADER = struct.pack("<8sIIQIIQQQQQ", *FIELDS)
SEALS = fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | fcntl.F_SEAL_SEAL


def our_memory() -> tuple[int, int, list[str]]:
    """How many rings this process has mapped and how many it has open, and files that should not be."""
    maps = Path("/proc/self/maps").read_text()
    links = []
    for fd in os.listdir("/proc/self/fd"):
        try:
            links.append(os.readlink(f"/proc/self/fd/{fd}"))
        except FileNotFoundError:  # that of the listing itself
            continue
    files = [name for name in os.listdir("/dev/shm") if "cortex" in name]  # others may use it meanwhile
    return maps.count("/memfd:cortex-"), sum(link.startswith("/memfd:cortex-") for link in links), files


@pytest.fixture(autouse=True)
def nothing_left() -> Iterator[None]:
    """No test leaves memory or a file behind."""
    gc.collect()  # what other tests left in cycles
    before = our_memory()
    yield
    assert our_memory() == before


@pytest.fixture
def forged() -> Iterator[int]:
    """A descriptor of memory that is what a publisher written by somebody else would make."""
    fd = forge(HEADER)
    yield fd
    os.close(fd)


def forge(header: bytes, *, size: int = TOTAL, seals: int = SEALS) -> int:
    fd = os.memfd_create("cortex-forged", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
    os.ftruncate(fd, size)
    os.pwrite(fd, header, 0)
    fcntl.fcntl(fd, fcntl.F_ADD_SEALS, seals)
    return fd


def view_of(at: int, **changes: int) -> RingView:
    place = {
        "source": SOURCE, "ring_id": RING, "slots": SLOTS, "slot_bytes": SLOT_BYTES,
        "pid": os.getpid(), "fd": at, "column": 5,
    }  # fmt: skip
    return RingView(**(place | changes))


def test_ring_has_the_bytes_of_the_specification():
    ring = Ring(SOURCE, RING, slots=SLOTS, slot_bytes=5000)  # rounded up to 8192
    status = os.fstat(ring.fd)
    assert status.st_size == TOTAL
    assert stat.S_IMODE(status.st_mode) == 0o600
    assert status.st_blocks * 512 >= TOTAL  # all there, so no SIGBUS later
    assert fcntl.fcntl(ring.fd, fcntl.F_GET_SEALS) == SEALS
    assert os.get_inheritable(ring.fd) is False
    assert os.pread(ring.fd, TOTAL, 0) == HEADER + bytes(TOTAL - len(HEADER))

    slot = ring.acquire()
    assert slot == 0
    assert os.pread(ring.fd, 64, HEADERS) == struct.pack("<Q56x", 1)
    ring.buffer(slot)[:5] = np.frombuffer(b"hello", np.uint8)
    ring.commit(slot, 2**40 + 3, 5, 1 << 63 | 1 << 5)
    slot = ring.acquire()
    assert slot == 1
    ring.buffer(slot)[-1] = 7
    ring.commit(slot, 2**40 + 4, SLOT_BYTES, 1 << 5)

    expected = bytearray(HEADER + bytes(TOTAL - len(HEADER)))
    expected[LEASES + 5] = expected[LEASES + 63] = expected[LEASES + 64 + 5] = 1
    struct.pack_into("<QQQ", expected, HEADERS, 2, 2**40 + 3, 5)
    struct.pack_into("<QQQ", expected, HEADERS + 64, 2, 2**40 + 4, SLOT_BYTES)
    expected[BODIES : BODIES + 5] = b"hello"
    expected[BODIES + 2 * SLOT_BYTES - 1] = 7
    assert os.pread(ring.fd, TOTAL, 0) == expected
    ring.close()


@given(slots=st.integers(1, 300), pages=st.integers(1, 3))
@settings(max_examples=30, deadline=None)
def test_parts_follow_each_other_aligned(slots: int, pages: int):
    ring = Ring(1, 0, slots=slots, slot_bytes=4096 * pages)
    leases, headers, bodies, total = struct.unpack("<4Q", os.pread(ring.fd, 32, 40))
    assert leases == 4096
    assert headers % 64 == bodies % 4096 == 0
    assert 0 <= headers - (leases + 64 * slots) < 64
    assert 0 <= bodies - (headers + 64 * slots) < 4096
    assert total == bodies + slots * pages * 4096 == os.fstat(ring.fd).st_size
    ring.close()


def test_a_foreign_publisher_is_understood(forged: int):
    """Memory and lease written by hand; nothing of `Ring` is involved."""
    os.pwrite(forged, b"\x01", LEASES + 2 * 64 + 5)
    os.pwrite(forged, struct.pack("<QQQ", 8, 70, 3), HEADERS + 2 * 64)
    os.pwrite(forged, b"abc", BODIES + 2 * SLOT_BYTES)
    view = view_of(forged)
    message = view.lease(2, 70, 3)
    assert message.tobytes() == b"abc"
    assert message.ctypes.data % 64 == 0
    del message
    assert os.pread(forged, 1, LEASES + 2 * 64 + 5) == b"\0"
    view.close()


@given(offset=st.integers(0, len(HEADER) - 1), change=st.integers(1, 255))
@settings(max_examples=200, deadline=None)
def test_any_other_header_is_refused(offset: int, change: int):
    header = bytearray(HEADER)
    header[offset] ^= change
    fd = forge(bytes(header))
    try:
        with pytest.raises(ShmUnavailable, match="header"):
            view_of(fd)
    finally:
        os.close(fd)


@given(
    slots=st.integers(-1, 2**32 - 1),
    slot_bytes=st.integers(-1, 2**64 - 1) | st.integers(0, 2**20).map(lambda n: n * 4096),
)
@settings(deadline=None)
def test_any_other_shape_is_refused(slots: int, slot_bytes: int):
    """Whatever an answer frame claims, the reader maps nothing that is not there."""
    if (slots, slot_bytes) == (SLOTS, SLOT_BYTES):
        return
    fd = forge(HEADER)
    try:
        with pytest.raises(ShmUnavailable):
            view_of(fd, slots=slots, slot_bytes=slot_bytes)
    finally:
        os.close(fd)


@pytest.mark.parametrize(
    "changes",
    [{"source": SOURCE + 1}, {"ring_id": RING + 1}, {"column": 64}, {"column": 2**32 - 1}, {"column": -1},
     {"pid": 0}, {"pid": -1}, {"pid": 2**31 - 1}, {"pid": 2**32}, {"fd": -1}, {"fd": 2**31 - 1}],
)  # fmt: skip
def test_a_wrong_place_is_refused(forged: int, changes: dict[str, int]):
    with pytest.raises(ShmUnavailable):
        view_of(forged, **changes)


@pytest.mark.parametrize("missing", [fcntl.F_SEAL_SHRINK, fcntl.F_SEAL_GROW, fcntl.F_SEAL_SEAL])
def test_memory_that_could_change_is_refused(missing: int):
    fd = forge(HEADER, seals=SEALS & ~missing)
    with pytest.raises(ShmUnavailable, match="not sealed"):
        view_of(fd)
    os.close(fd)


@pytest.mark.parametrize("size", [0, 71, TOTAL - 1, TOTAL + 1])
def test_memory_of_another_size_is_refused(size: int):
    fd = forge(HEADER[:size], size=size)
    with pytest.raises(ShmUnavailable, match=f"has {size} bytes"):
        view_of(fd)
    os.close(fd)


def test_what_is_no_sealed_memory_is_refused(tmp_path: Path):
    path = tmp_path / "ring"
    path.write_bytes(HEADER + bytes(TOTAL - len(HEADER)))
    file = os.open(path, os.O_RDWR)
    pipe = os.pipe()
    try:
        with pytest.raises(ShmUnavailable):
            view_of(file)  # a file cannot be sealed
        for fd in pipe:
            with pytest.raises(ShmUnavailable, match="is not memory"):
                view_of(fd)
    finally:
        for fd in (file, *pipe):
            os.close(fd)


def test_another_users_memory_is_refused(forged: int, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(os, "geteuid", lambda: os.getuid() + 1)
    with pytest.raises(ShmUnavailable, match="belongs to user"):
        view_of(forged)


def test_other_systems_say_so(forged: int, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(memory, "sys", type("sys", (), {"platform": "darwin", "byteorder": "little"}))
    with pytest.raises(ShmUnavailable, match="needs Linux"):
        Ring(1, 0, slots=4, slot_bytes=4096)
    with pytest.raises(ShmUnavailable, match="needs Linux"):
        view_of(forged)


def test_a_reader_cannot_resize():
    """Neither through its own descriptor nor through another's: the size is for good."""
    ring = Ring(SOURCE, RING, slots=SLOTS, slot_bytes=SLOT_BYTES)
    other = os.open(f"/proc/{os.getpid()}/fd/{ring.fd}", os.O_RDWR)
    for size in (0, TOTAL - 4096, TOTAL + 4096):
        with pytest.raises(PermissionError):
            os.ftruncate(other, size)
    with pytest.raises(PermissionError):
        fcntl.fcntl(other, fcntl.F_ADD_SEALS, fcntl.F_SEAL_WRITE)
    os.close(other)
    ring.close()


def test_slots_are_mapped_read_only(forged: int):
    def ours() -> list[str]:
        maps = Path("/proc/self/maps").read_text().splitlines()
        return sorted(line.split()[1] for line in maps if "/memfd:cortex-" in line)

    view = view_of(forged)
    assert ours() == ["r--s", "rw-s"]
    view.close()


@pytest.mark.parametrize(
    ("slots", "slot_bytes"), [(0, 4096), (-1, 4096), (4097, 4096), (4, 0), (4, -1), (4, 2**32 + 1)]
)
def test_impossible_rings_are_refused(slots: int, slot_bytes: int):
    with pytest.raises(ValueError, match="must be 1 to"):
        Ring(1, 0, slots=slots, slot_bytes=slot_bytes)


def test_more_than_there_is():
    """16 TiB: refused before the kernel would have to find them."""
    with pytest.raises(ShmUnavailable, match="are available"):
        Ring(1, 0, slots=4096, slot_bytes=2**32)


def test_pages_that_are_missing_are_noticed_at_once(monkeypatch: pytest.MonkeyPatch):
    def full(fd: int, offset: int, size: int) -> None:
        assert (offset, size) == (0, os.fstat(fd).st_size)
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "posix_fallocate", full)
    with pytest.raises(ShmUnavailable, match="No space left") as caught:
        Ring(1, 0, slots=4, slot_bytes=4096)
    assert caught.value.errno == errno.ENOSPC


@pytest.mark.parametrize(
    ("limit", "code"), [("RLIMIT_FSIZE", "EFBIG"), ("RLIMIT_AS", "ENOMEM"), ("RLIMIT_NOFILE", "EMFILE")]
)
def test_no_memory_is_an_error_not_a_signal(limit: str, code: str):
    """The limits are set after the imports, to what is in use then and a little more."""
    script = f"""
import errno, os, resource
from cortex.shm import Ring, ShmUnavailable
before = set(os.listdir("/proc/self/fd"))
used = int(open("/proc/self/statm").read().split()[0]) * 4096
value = {{"RLIMIT_FSIZE": 1 << 20, "RLIMIT_AS": used + (4 << 20), "RLIMIT_NOFILE": 3}}["{limit}"]
soft, hard = resource.getrlimit(resource.{limit})
resource.setrlimit(resource.{limit}, (value, hard))
try:
    Ring(1, 0, slots=8, slot_bytes=1 << 20)
except ShmUnavailable as error:
    resource.setrlimit(resource.{limit}, (soft, hard))
    assert set(os.listdir("/proc/self/fd")) == before
    print(errno.errorcode[error.errno], end="")
"""
    command = [sys.executable, "-c", script]
    run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300.0)
    assert (run.returncode, run.stdout, run.stderr) == (0, code, "")


def test_a_private_copy_takes_the_place_of_shared_pages():
    shared = mmap.mmap(-1, 3 * 4096)
    shared[:] = bytes(range(256)) * 48
    fd = os.memfd_create("cortex-shared", os.MFD_CLOEXEC)
    os.write(fd, shared[:])
    mapped = mmap.mmap(fd, 3 * 4096, mmap.MAP_SHARED, mmap.PROT_READ)
    make_private(address_of(memoryview(mapped)) + 4096, 4096, mmap.PROT_READ)
    os.pwrite(fd, bytes(3 * 4096), 0)
    assert mapped[:] == bytes(4096) + bytes(range(256)) * 16 + bytes(4096)
    mapped.close()
    os.close(fd)


def test_a_copy_that_cannot_be_made_is_an_error():
    whole = mmap.mmap(-1, 4096)
    with pytest.raises(OSError, match="Invalid argument"):
        make_private(address_of(memoryview(whole)) + 1, 4096, mmap.PROT_READ)  # no multiple of a page


def test_failing_to_let_go_after_a_fork_is_logged(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
):
    def fail(thing: object) -> None:
        raise OSError("no memory")

    monkeypatch.setattr(memory, "_forkable", {"ring": fail})
    with caplog.at_level(logging.WARNING, "cortex.memory"):
        memory._after_fork_in_child()
    assert "could not be let go of: no memory" in caplog.text
