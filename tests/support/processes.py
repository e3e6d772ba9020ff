"""Waiting with a deadline, and the processes that tests of nodes start.

`peer.py` has what such a process can do; both sides speak lines of JSON over its standard streams.
"""

from __future__ import annotations

import contextlib
import functools
import json
import multiprocessing
import os
import select
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from multiprocessing import forkserver
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[2]
PEER = ROOT / "tests" / "cortex" / "peer.py"
SOON_S = 60.0
"""Deadline of what takes milliseconds, on a machine that does a lot besides, or stands still for a while."""


def wait_for(condition: Callable[[], object], timeout_s: float = SOON_S, *, every_s: float = 2e-3) -> Any:
    """Wait until a condition holds, and return what it returned."""
    deadline = time.monotonic() + timeout_s
    while not (value := condition()):
        assert time.monotonic() < deadline, "the condition did not come true in time"
        time.sleep(every_s)
    return value


def in_time(action: Callable[[], object], limit_s: float) -> None:
    """Do something until it was quick once: a busy machine makes some attempts late, not each."""

    def took_s() -> float:
        begin_s = time.monotonic()
        action()
        return time.monotonic() - begin_s

    wait_for(lambda: took_s() < limit_s)


class Beside:
    """Does something in a thread, which has to end in time; as a context, once the block is over.

    Args:
        action: What to do; `results` will have what it returns.
        *arguments: Of it.
        **options: Of it.
    """

    def __init__(self, action: Callable[..., object], *arguments: Any, **options: Any) -> None:
        self.results: list[Any] = []
        self.thread = threading.Thread(
            target=lambda: self.results.append(action(*arguments, **options)), daemon=True
        )
        self.thread.start()

    def __enter__(self) -> Beside:
        return self

    def __exit__(self, *_: object) -> None:
        self.join()

    def join(self, timeout_s: float = SOON_S) -> list[Any]:
        """Wait for its end."""
        self.thread.join(timeout_s)
        assert not self.thread.is_alive(), "the thread does not end"
        return self.results


@functools.cache
def fork_server() -> Any:
    """Starts processes that have imported what `peer.py` needs, in milliseconds: tests kill thousands.

    To be called before `runtime`: it is not to know that directory.
    """
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["peer"])
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", f"{ROOT}:{PEER.parent}:{Path(__file__).parent}")
        patch.setenv("OPENBLAS_NUM_THREADS", "1")
        forkserver.ensure_running()
    return context


class _Forked:
    """What a `Child` uses of a `Popen`, of a process of the fork server."""

    def __init__(self, role: str, arguments: dict[str, Any]) -> None:
        import peer

        (stdin, mine), (my_out, stdout), (my_err, stderr) = os.pipe(), os.pipe(), os.pipe()
        self.stdin = os.fdopen(mine, "wb", buffering=0)
        self.stdout, self.stderr = (os.fdopen(end, "rb", buffering=0) for end in (my_out, my_err))
        streams = Connection(stdin, writable=False), Connection(stdout), Connection(stderr)
        directory = os.environ["CORTEX_RUNTIME_DIR"]
        self._process = fork_server().Process(target=peer.forked, args=(role, arguments, directory, *streams))
        self._process.start()
        self.pid, self.code = self._process.pid, None
        for stream in streams:
            stream.close()

    def poll(self) -> int | None:
        if self.code is None:
            self.code = self._process.exitcode
        return self.code

    def wait(self, timeout_s: float) -> int | None:
        if self.code is None:
            self._process.join(timeout_s)
        return self.poll()

    def kill(self) -> None:
        self._process.kill()

    def close(self) -> None:
        """Forget it, once it has ended."""
        self.code = self.poll()
        self._process.close()

    def send_signal(self, number: int) -> None:
        os.kill(self.pid, number)


class Lines:
    """A process that prints lines.

    Args:
        process: Its standard output and error are unbuffered pipes.
        name: For errors.
    """

    def __init__(self, process: Any, name: str) -> None:
        self.process = process
        self.name = name
        self._rest = b""

    def has_line(self, timeout_s: float = 0.0) -> bool:
        """Whether it has printed a line that was not taken yet."""
        deadline_s = time.monotonic() + timeout_s
        while b"\n" not in self._rest:
            left_s = max(deadline_s - time.monotonic(), 0.0)
            if not select.select([self.process.stdout], [], [], left_s)[0]:
                return False
            chunk = os.read(self.process.stdout.fileno(), 65536)
            assert chunk, f"the process {self.name!r} has ended: {self.errors(SOON_S)}"
            self._rest += chunk
        return True

    def line(self, within_s: float = SOON_S) -> str:
        """The next line that it prints."""
        assert self.has_line(within_s), f"the process {self.name!r} is silent"
        line, self._rest = self._rest.split(b"\n", 1)
        return line.decode()

    def errors(self, timeout_s: float = 0.0) -> str:
        """What it has written to its standard error since the last call; the rest once it has ended.

        Args:
            timeout_s: How long to wait for something.
        """
        text = b""
        while select.select([self.process.stderr], [], [], 0.0 if text else timeout_s)[0]:
            chunk = os.read(self.process.stderr.fileno(), 65536)
            if not chunk:
                break
            text += chunk
        return text.decode()


class Child(Lines):
    """A process of `peer.py`.

    Args:
        role: What it does.
        prefix: A command that runs it.
        env: Changes of its environment.
        forked: From a process that has imported everything.
        **arguments: Of the role.
    """

    def __init__(
        self,
        role: str,
        *,
        prefix: Sequence[str] = (),
        env: dict[str, str] | None = None,
        forked: bool = False,
        **arguments: Any,
    ):
        process: Any = (
            _Forked(role, arguments)
            if forked
            else subprocess.Popen(
                [*prefix, sys.executable, str(PEER), role, json.dumps(arguments)],
                env={**os.environ, "PYTHONPATH": str(ROOT), **(env or {})},
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                bufsize=0,
            )
        )
        super().__init__(process, role)

    @property
    def pid(self) -> int:
        return self.process.pid

    def say(self, **words: Any) -> None:
        """Send it a line."""
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps(words).encode() + b"\n")

    @functools.cached_property
    def hello(self) -> dict[str, Any]:
        """The first line that it prints, once it is ready."""
        said: dict[str, Any] = json.loads(self.line())
        return said

    def hear(self, within_s: float = SOON_S) -> dict[str, Any]:
        """The next line that it prints after that."""
        assert self.hello
        said: dict[str, Any] = json.loads(self.line(within_s))
        return said

    def ask(self, within_s: float = SOON_S, **words: Any) -> dict[str, Any]:
        """Send it a line and wait for its answer."""
        self.say(**words)
        return self.hear(within_s)

    def kill(self) -> None:
        """SIGKILL, and wait until it is dead."""
        self.process.kill()
        assert self.process.wait(SOON_S) == -signal.SIGKILL

    @contextlib.contextmanager
    def stopped(self) -> Any:
        """SIGSTOP for the time of the block."""
        self.process.send_signal(signal.SIGSTOP)
        wait_for(lambda: self._state() in "T")
        try:
            yield
        finally:
            self.process.send_signal(signal.SIGCONT)

    def _state(self) -> str:
        text = Path(f"/proc/{self.pid}/stat").read_text()
        return text.rpartition(")")[2].split()[0]

    def finish(self, timeout_s: float = SOON_S) -> None:
        """Close its input, and expect that it ends well."""
        assert self.process.stdin is not None
        self.process.stdin.close()
        code = self.process.wait(timeout_s)
        assert code == 0, f"the process {self.name!r} ended with {code}: {self.errors()}"

    def end(self) -> None:
        """Get rid of it, whatever state it is in."""
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGCONT)
            self.process.kill()
        self.process.wait(SOON_S)
        for stream in (self.process.stdin, self.process.stdout, self.process.stderr):
            if stream is not None:
                with contextlib.suppress(OSError):
                    stream.close()
        if isinstance(self.process, _Forked):
            self.process.close()


def processes_with(text: str) -> list[int]:
    """Processes, other than this one, whose environment contains a text."""
    found = []
    for entry in os.scandir("/proc"):
        if entry.name.isdigit() and int(entry.name) != os.getpid():
            try:
                environment = Path(entry.path, "environ").read_bytes()
            except OSError:
                continue
            if text.encode() in environment:
                found.append(int(entry.name))
    return found


def stat_of(pid: int) -> list[str]:
    """State and parent of a process, among others; those of a zombie if there is none."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except (FileNotFoundError, ProcessLookupError):
        return ["Z", "0"]


def gone(pid: int) -> bool:
    """Return whether a process has ended (a zombie has)."""
    return stat_of(pid)[0] == "Z"


def children_of(parent: int) -> set[int]:
    """Processes that a process has started."""
    pids = map(int, filter(str.isdigit, os.listdir("/proc")))
    return {pid for pid in pids if stat_of(pid)[1] == str(parent)}


def shared_mappings() -> list[str]:
    """Rings that this process has mapped or open."""
    maps = [line for line in Path("/proc/self/maps").read_text().splitlines() if "memfd:cortex" in line]
    for entry in os.scandir("/proc/self/fd"):
        with contextlib.suppress(OSError):
            target = os.readlink(entry.path)
            if "memfd:cortex" in target:
                maps.append(target)
    return maps
