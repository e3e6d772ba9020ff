"""Sealed memory that two processes share: how it is made, opened, trusted, laid out, and let go of.

The layout is section 6 of WIRE.md; `cortex.shm` has the rules by which it is used.
"""

from __future__ import annotations

import errno
import fcntl
import logging
import mmap
import os
import stat
import struct
import sys
import threading
import weakref
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

_log = logging.getLogger(__name__)

COLUMNS = 64
"""Readers that can hold leases in one ring."""
SLOTS_MAX = 4096
SLOT_BYTES_MAX = 1 << 32
PAGE = 4096
HEADER_WORDS = 8
"""A slot's header is 8 numbers of 8 bytes: state, sequence, size and zeros."""

_HEADER = struct.Struct("<8sIIQIIQQQQQ")
_MAGIC = b"CTXRING1"
_VERSION = 1
STORES_IN_ORDER = os.uname().machine in {"x86_64", "i386", "i686"}
_FENCE = threading.Lock()


class ShmUnavailable(OSError):
    """This memory cannot be made or cannot be trusted; messages can still be sent through a socket."""


class RingGone(ShmUnavailable):
    """The publisher's descriptors can be seen, but this one is closed, or something else by now."""


class Layout(NamedTuple):
    """Where the parts of a ring are, in bytes from its start."""

    leases: int
    headers: int
    slots: int
    total: int


def layout_of(slots: int, slot_bytes: int) -> Layout:
    """Lay out a ring of `slots` slots of `slot_bytes` bytes, a multiple of 4096."""
    headers = PAGE + slots * COLUMNS
    first = -(-(headers + slots * HEADER_WORDS * 8) // PAGE) * PAGE
    return Layout(PAGE, headers, first, first + slots * slot_bytes)


def fence() -> None:
    """Keep loads and stores before this on their side of those after it, on processors that reorder them.

    An acquiring operation stays before what follows it, a releasing one after what precedes it, and an
    acquire does not pass an earlier release (ARMv8: both are RCsc). So a release and then an acquire bar
    everything; taking a lock twice contains that pair.
    """
    with _FENCE:
        pass
    with _FENCE:
        pass


def create_ring_memory(source: int, ring_id: int, slots: int, slot_bytes: int) -> tuple[int, mmap.mmap]:
    """Make the memory of a ring: sealed, every page of it there, header written, all else zero.

    Returns:
        Its descriptor, which the caller owns, and the whole of it, mapped to read and write.

    Raises:
        ShmUnavailable: No such memory on this system, or not enough of it.
    """
    _check_platform()
    layout = layout_of(slots, slot_bytes)
    available = _available_bytes()
    if available is not None and layout.total > available:
        # Memory that is missing would not be an error below, but make the kernel kill some process.
        raise ShmUnavailable(f"ring {ring_id}: {layout.total} bytes, but only {available} are available")
    fd = -1
    try:
        fd = os.memfd_create(f"cortex-{source:016x}-{ring_id}", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
        os.fchmod(fd, 0o600)
        os.ftruncate(fd, layout.total)
        os.posix_fallocate(fd, 0, layout.total)  # a missing page is an error here, instead of SIGBUS later
        fcntl.fcntl(fd, fcntl.F_ADD_SEALS, fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | fcntl.F_SEAL_SEAL)
        memory = mmap.mmap(fd, layout.total, mmap.MAP_SHARED | mmap.MAP_POPULATE)
    except OSError as error:
        if fd >= 0:
            os.close(fd)
        text = f"ring {ring_id} of {layout.total} bytes: {error.strerror}"
        raise ShmUnavailable(error.errno, text) from error
    _HEADER.pack_into(memory, 0, _MAGIC, _VERSION, ring_id, source, slots, COLUMNS, slot_bytes, *layout)
    return fd, memory


def open_ring_memory(
    source: int, ring_id: int, slots: int, slot_bytes: int, *, pid: int, fd: int
) -> tuple[Head, mmap.mmap]:
    """Map another process's ring, if it is what these arguments say.

    Returns:
        Its head up to the slots, to read and write, and the whole of it, to read.

    Raises:
        RingGone: The publisher, which can be reached, has no such memory any more.
        ShmUnavailable: It cannot be reached from here, or is something else, or could change its size.
    """
    _check_platform()
    layout = layout_of(slots, slot_bytes)
    expected = (_MAGIC, _VERSION, ring_id, source, slots, COLUMNS, slot_bytes, *layout)
    path = f"/proc/{pid}/fd/{fd}"
    own = -1
    try:
        _check_file(os.stat(path), path, layout.total)  # before opening: to open a device may do something
        own = os.open(path, os.O_RDWR | os.O_CLOEXEC | os.O_NOCTTY | os.O_NONBLOCK)
        _check_file(os.fstat(own), path, layout.total)
        seals = fcntl.fcntl(own, fcntl.F_GET_SEALS)
        if ~seals & (fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | fcntl.F_SEAL_SEAL):
            raise ShmUnavailable(f"{path} is not sealed (seals {seals:#x}): its size could change")
        found = _HEADER.unpack(os.pread(own, _HEADER.size, 0))
        if found != expected:
            raise ShmUnavailable(f"{path} has the header {found} instead of {expected}")
        head = Head(own, layout.slots, mmap.MAP_SHARED)
        flags = mmap.MAP_SHARED | mmap.MAP_POPULATE
        return head, mmap.mmap(own, layout.total, flags, mmap.PROT_READ)
    except OSError as error:
        other = isinstance(error, ShmUnavailable)  # what is there is not what it was
        gone = (other or error.errno == errno.ENOENT) and os.access(f"/proc/{pid}/fd", os.R_OK | os.X_OK)
        kind = RingGone if gone else ShmUnavailable
        raise (kind(str(error)) if other else kind(error.errno, f"{path}: {error.strerror}")) from error
    finally:
        if own >= 0:
            os.close(own)


def _check_platform() -> None:
    if sys.platform != "linux" or sys.byteorder != "little":
        raise ShmUnavailable("shared memory needs Linux (memfd) and a little-endian processor")


def _check_file(status: os.stat_result, path: str, size_bytes: int) -> None:
    if not stat.S_ISREG(status.st_mode):
        raise ShmUnavailable(f"{path} is not memory")
    if status.st_uid != os.geteuid():
        raise ShmUnavailable(f"{path} belongs to user {status.st_uid}, not to {os.geteuid()}")
    if status.st_size != size_bytes:
        raise ShmUnavailable(f"{path} has {status.st_size} bytes instead of {size_bytes}")


def _available_bytes() -> int | None:
    """Memory that can be had without swapping; None if the kernel does not say."""
    try:
        with open("/proc/meminfo", encoding="ascii") as file:
            for line in file:
                if line.startswith("MemAvailable:"):
                    return int(line.split()[1]) * 1024
    except (OSError, ValueError, IndexError):
        return None
    return None


class Head(mmap.mmap):
    """The lease table and slot headers; mapped as long as an array may have to give its slot back.

    In a forked child it is a private copy from the start: a lease belongs to the parent.
    """

    def __init__(self, *_args: object) -> None:  # mmap does its work in __new__
        in_forked_child(self, Head.detach)

    def detach(self) -> None:
        """Turn this process's view into a private copy: what is written from now on reaches nobody.

        Raises:
            OSError: The kernel has no memory for it.
        """
        make_private(address_of(memoryview(self)), len(self), mmap.PROT_READ | mmap.PROT_WRITE)


def address_of(memory: memoryview) -> int:
    """Return where memory begins."""
    return int(np.frombuffer(memory, np.uint8).__array_interface__["data"][0])


def make_private(address: int, size_bytes: int, protection: int) -> None:
    """Replace mapped pages by private ones of the same content, at once for all threads that look at them.

    Raises:
        OSError: The kernel has no memory for it.
    """
    import ctypes  # only needed when a message outlives its ring

    libc = ctypes.CDLL(None, use_errno=True)
    libc.mmap.restype = libc.mremap.restype = ctypes.c_void_p
    failed = ctypes.c_void_p(-1).value
    length = ctypes.c_size_t(size_bytes)
    flags = mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS
    fresh = libc.mmap(None, length, mmap.PROT_READ | mmap.PROT_WRITE, flags, -1, ctypes.c_long(0))
    if fresh == failed:
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
    ctypes.memmove(fresh, address, size_bytes)
    source = ctypes.c_void_p(fresh)
    may_move, fixed = 1, 2
    moved = failed
    if libc.mprotect(source, length, protection) == 0:
        moved = libc.mremap(source, length, length, may_move | fixed, ctypes.c_void_p(address))
    if moved == failed:
        error = ctypes.get_errno()
        libc.munmap(source, length)
        raise OSError(error, os.strerror(error))


_forkable: weakref.WeakKeyDictionary[object, Callable[..., None]] = weakref.WeakKeyDictionary()


def in_forked_child(thing: object, action: Callable[..., None]) -> None:
    """Call `action(thing)` in every child that forks while `thing` is alive."""
    _forkable[thing] = action


def _after_fork_in_child() -> None:
    for thing, action in list(_forkable.items()):
        try:
            action(thing)
        except OSError as error:
            _log.warning("memory shared with the parent process could not be let go of: %s", error)


os.register_at_fork(after_in_child=_after_fork_in_child)
