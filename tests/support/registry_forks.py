"""Registries that are forked from a process which has imported what they need: most tests start one."""

from __future__ import annotations

import atexit
import functools
import json
import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path

from cortex.host import FileLock

ROOT = Path(__file__).resolve().parents[2]
DIRECTORY = "CORTEX_RUNTIME_DIR"
_BLANK = "/tmp/ctx-????????"
"""As long as the name of the directory of a test, which takes its place in the environment of a registry."""


class RegistryForks:
    """Takes the place of `cortex.registry._spawn`; `real` is what it takes it from."""

    def __init__(self, real: Callable[[list[str], int, Path], None]) -> None:
        self.real = real
        self._lock = threading.Lock()
        self._owner = os.getpid()
        self._socket, theirs = socket.socketpair()
        environment = {**os.environ, "PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "1", DIRECTORY: _BLANK}
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, __file__, str(theirs.fileno()), "--embedded"],  # as those that nodes start
                env=environment,
                pass_fds=(theirs.fileno(),),
                start_new_session=True,
            )
        atexit.register(self.close)

    def __call__(self, command: list[str], descriptor: int, log: Path) -> None:
        directory = os.environ[DIRECTORY]
        if os.getpid() != self._owner or len(directory) != len(_BLANK):
            self.real(command, descriptor, log)
            return
        arguments = command[command.index("-m") + 2 : -1]  # all but the number of the descriptor
        flags = os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC
        with FileLock.no_fork(), self._lock, open(os.open(log, flags, 0o600), "ab") as output:
            said = json.dumps([directory, arguments]).encode()
            socket.send_fds(self._socket, [said], [descriptor, output.fileno()])
            assert self._socket.recv(1) == b"."

    def close(self) -> None:
        """End it, whoever else has a copy of our end; registries have sessions of their own."""
        self._socket.close()
        self._process.kill()
        self._process.wait()


@functools.cache
def forks(real: Callable[[list[str], int, Path], None]) -> RegistryForks:
    """The one of this process."""
    return RegistryForks(real)


def _show_directory(directory: str) -> None:
    """Write the directory where others read the environment of this process."""
    os.environ[DIRECTORY] = directory
    stat = Path("/proc/self/stat").read_text().rpartition(")")[2].split()
    place = Path("/proc/self/environ").read_bytes().index(_BLANK.encode())
    with open("/proc/self/mem", "r+b", buffering=0) as memory:
        memory.seek(int(stat[47]) + place)  # env_start, the 50th field of the line
        memory.write(directory.encode())


def _serve(link: socket.socket) -> None:
    from cortex.discovery import main

    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # nobody waits for them
    while True:
        said, descriptors, _, _ = socket.recv_fds(link, 1 << 16, 2)
        if not said:
            return
        if os.fork() == 0:
            signal.signal(signal.SIGCHLD, signal.SIG_DFL)
            os.setsid()
            link.close()
            lock, output = descriptors
            os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
            for stream in (1, 2):
                os.dup2(output, stream)
            os.close(output)
            directory, arguments = json.loads(said)
            _show_directory(directory)
            os._exit(main([*arguments, str(lock)]))
        for descriptor in descriptors:
            os.close(descriptor)
        link.send(b".")


if __name__ == "__main__":
    _serve(socket.socket(fileno=int(sys.argv[1])))
