"""Files that the processes of one host share: the runtime directory, its locks, and the files of each node.

Everything Cortex leaves in the file system lies in one directory that only its user can enter. A file of a
node is stale when nobody holds the node's lock, which the kernel lets go of however the node died.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import os
import platform
import re
import stat
import sys
import threading
import time
from pathlib import Path
from typing import ClassVar

SOCKET_PATH_MAX = 107 if sys.platform == "linux" else 103
"""Longest path of a unix socket in bytes: `sun_path` less its terminating zero."""
DOMAIN_MAX = 232
"""Largest domain; the range is that of ROS 2, so that one number can serve both."""
REGISTRY_SOCKET = "registry"
REGISTRY_LOCK = "registry.lock"
REGISTRY_LOG = "registry.log"

_NODE_FILE = re.compile(r"([0-9a-f]{16})\.[a-z]{1,12}")
_ROLE = re.compile(r"[a-z]{1,12}")
_LONGEST_NAME = 16 + 1 + 12


def domain_id(domain: int | None = None) -> int:
    """Return the domain to use: the one given, else that of `CORTEX_DOMAIN`, else 0.

    Raises:
        ValueError: If it is not an integer from 0 to 232.
    """
    source, given = "domain", str(domain)
    if domain is None:
        source, given = "CORTEX_DOMAIN", os.environ.get("CORTEX_DOMAIN", "0")
        domain = int(given) if given.isascii() and given.isdigit() else -1
    if not isinstance(domain, int) or isinstance(domain, bool) or not 0 <= domain <= DOMAIN_MAX:
        raise ValueError(f"{source} must be an integer from 0 to {DOMAIN_MAX}, got {given}")
    return domain


def runtime_base() -> Path:
    """Return the directory above the domains, whether it exists or not.

    It is `CORTEX_RUNTIME_DIR`, else `cortex` in `XDG_RUNTIME_DIR` (if that is a directory of ours), else
    `/tmp/cortex-UID`. Processes that are to meet on one host must agree on it.
    """
    chosen = os.environ.get("CORTEX_RUNTIME_DIR")
    if chosen:
        return Path(chosen).absolute()
    session = os.environ.get("XDG_RUNTIME_DIR")
    if session:
        # Under sudo or su the variable may name the directory of another user, which is of no use.
        with contextlib.suppress(OSError):
            if os.stat(session).st_uid == os.getuid():
                return Path(session) / "cortex"
    return Path(f"/tmp/cortex-{os.getuid()}")


def runtime_dir(domain: int) -> Path:
    """Return the directory of a domain, made (mode 0700) if it does not exist.

    Raises:
        PermissionError: If it is not ours, is a symbolic link, or others may enter it.
        ValueError: If a socket in it would have a path of more than 107 bytes.
    """
    directory = runtime_base() / str(domain_id(domain))
    longest = len(os.fsencode(directory)) + 1 + _LONGEST_NAME
    if longest > SOCKET_PATH_MAX:
        raise ValueError(
            f"the runtime directory {str(directory)!r} is too long: a socket in it would have a path of "
            f"{longest} bytes, {SOCKET_PATH_MAX} are allowed; set CORTEX_RUNTIME_DIR to a shorter one"
        )
    _make_private(directory.parent)
    _make_private(directory)
    return directory


def _make_private(directory: Path) -> None:
    if not directory.parent.is_dir():
        directory.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    with contextlib.suppress(FileExistsError):
        directory.mkdir(mode=0o700)
    status = os.lstat(directory)
    if not stat.S_ISDIR(status.st_mode):
        raise PermissionError(f"{directory} must be a directory, not a link or a file")
    if status.st_uid != os.getuid():
        raise PermissionError(
            f"{directory} belongs to user {status.st_uid}, not to us ({os.getuid()}): "
            "choose a directory of your own"
        )
    if status.st_mode & stat.S_ISVTX and status.st_mode & 0o077:
        raise PermissionError(f"{directory} is one that others use, too: choose a directory of your own")
    if status.st_mode & 0o077:
        raise PermissionError(
            f"{directory} has mode {stat.S_IMODE(status.st_mode):04o}, it must be 0700: chmod 700 {directory}"
        )


def host_id() -> str:
    """Return a text that is equal for two processes if they can share memory and unix sockets.

    That takes one kernel, one user, one process namespace (shared memory is opened through `/proc`) and one
    runtime directory (the same inode, so containers with private file systems differ).
    """
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
        processes = os.readlink("/proc/self/ns/pid")
    except OSError:  # not Linux: no shared memory, and one space of processes
        boot, processes = platform.node(), ""
    base = runtime_base()
    try:
        status = os.stat(base)
        place = f"{status.st_dev}:{status.st_ino}"
    except FileNotFoundError:
        place = str(base)
    parts = (boot, processes, str(os.getuid()), place)
    return hashlib.blake2b("\n".join(parts).encode(), digest_size=8).hexdigest()


class FileLock:
    """An exclusive lock on a file, held until `close` or until the last process that has it is dead.

    A forked child does not keep the lock: its copy of the descriptor is closed at the fork.
    """

    _held: ClassVar[set[FileLock]] = set()
    _guard: ClassVar[threading.Lock] = threading.Lock()

    def __init__(self, path: Path, descriptor: int):
        self.path = path
        self.descriptor = descriptor
        """To hand over to a process that is being started; -1 when closed."""

    @classmethod
    def acquire(cls, path: Path) -> FileLock | None:
        """Lock a file, made if need be, without waiting; None if another holder has it."""
        while True:
            with cls._guard:  # a fork waits for this, so that no child gets a descriptor it does not know of
                descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
                lock = cls(path, descriptor)
                cls._held.add(lock)
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                lock._close_descriptor()
                return None
            if lock.intact:
                return lock
            lock._close_descriptor()  # the file was removed between our two steps: it is the lock no more

    @classmethod
    def adopt(cls, path: Path, descriptor: int) -> FileLock:
        """Take over a lock that the process which started us holds, by the descriptor it left us."""
        os.set_inheritable(descriptor, False)
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)  # raises if it is not the lock after all
        lock = cls(path, descriptor)
        with cls._guard:
            cls._held.add(lock)
        return lock

    @property
    def intact(self) -> bool:
        """Whether the file is still there; if somebody has removed it, others can take the lock anew."""
        try:
            current = os.stat(self.path)
        except FileNotFoundError:
            return False
        held = os.fstat(self.descriptor)
        return (held.st_dev, held.st_ino) == (current.st_dev, current.st_ino)

    def close(self, *, remove: bool = False) -> None:
        """Let go of the lock (unless a process it was handed to has it), and remove the file if asked to."""
        if self.descriptor < 0:
            return
        if remove:  # while we hold it: who opens the file later makes a new one
            with contextlib.suppress(FileNotFoundError):
                os.unlink(self.path)
        self._close_descriptor()

    def _close_descriptor(self) -> None:
        with self._guard:
            if self in self._held:
                self._held.discard(self)
                os.close(self.descriptor)
                self.descriptor = -1

    @classmethod
    def no_fork(cls) -> threading.Lock:
        """A lock that keeps other threads from `os.fork` while it is held."""
        return cls._guard

    @classmethod
    def _after_fork_in_child(cls) -> None:
        for lock in cls._held:
            os.close(lock.descriptor)
            lock.descriptor = -1
        cls._held.clear()
        cls._guard.release()


os.register_at_fork(
    before=FileLock._guard.acquire,
    after_in_parent=FileLock._guard.release,
    after_in_child=FileLock._after_fork_in_child,
)


class NodeFiles:
    """The files of one node in the runtime directory: a lock that says it lives, and its unix sockets.

    Args:
        domain: The domain.
        node: The node's number; all its files start with it in hexadecimal.

    Raises:
        FileExistsError: If a living node has this number.
    """

    def __init__(self, domain: int, node: int):
        self.directory = runtime_dir(domain)
        self._stem = f"{node:016x}"
        if len(self._stem) != 16:
            raise ValueError(f"node must be a number of 64 bits, got {node}")
        sweep(self.directory)
        self._lock = self._acquire()

    def _acquire(self) -> FileLock:
        path = self.directory / f"{self._stem}.lock"
        # A sweep may hold the new file for a moment, before it sees that there is nothing to remove. Attempts
        # are counted, and not time: a machine that stands still for a second stops the sweep, too.
        for _ in range(500):
            if (lock := FileLock.acquire(path)) is not None:
                return lock
            time.sleep(1e-3)
        raise FileExistsError(f"node {self._stem} is already running in {self.directory}")

    def path(self, role: str) -> Path:
        """Return the path of the socket with a role (a lower-case word of at most 12 letters)."""
        if not _ROLE.fullmatch(role) or role == "lock":
            raise ValueError(f"role must be 1 to 12 letters a-z, and not 'lock', got {role!r}")
        return self.directory / f"{self._stem}.{role}"

    def endpoint(self, role: str) -> str:
        """Return the ZeroMQ address of the socket with a role."""
        return f"ipc://{self.path(role)}"

    def close(self) -> None:
        """Remove the files. Close the sockets and terminate their context first."""
        if self._lock.descriptor >= 0:  # not in a forked child, and once
            _remove_files(self.directory, self._stem)
            self._lock.close(remove=True)


def node_lives(directory: Path, node: int) -> bool:
    """Tell whether a process holds the files of a node; a node of another host has none here."""
    path = directory / f"{node:016x}.lock"
    if not path.exists():
        return False
    lock = FileLock.acquire(path)
    if lock is not None:
        lock.close(remove=True)
    return lock is None


def sweep(directory: Path) -> list[int]:
    """Remove the files of nodes that are dead, and return the nodes' numbers.

    A file whose node's lock is held, or whose name is not one of ours, is left alone. Any process may sweep
    at any time: a living node holds its lock from before it makes its first socket.
    """
    swept = []
    stems = {match[1] for name in os.listdir(directory) if (match := _NODE_FILE.fullmatch(name))}
    for stem in sorted(stems):
        path = directory / f"{stem}.lock"
        lock = FileLock.acquire(path)
        if lock is None:
            continue
        _remove_files(directory, stem)
        lock.close(remove=True)
        swept.append(int(stem, 16))
    return swept


def _remove_files(directory: Path, stem: str) -> None:
    for name in os.listdir(directory):
        match = _NODE_FILE.fullmatch(name)
        if match and match[1] == stem and name != f"{stem}.lock":
            with contextlib.suppress(FileNotFoundError):
                os.unlink(directory / name)
