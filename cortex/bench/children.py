"""Child processes of a benchmark: forked clean, spoken to over pipes, killed at their deadline.

The parent makes no ZeroMQ context and starts no thread, so a fork copies nothing that a child can trip over.
Every wait here has a deadline, and a child never outlives the parent.
"""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import select
import signal
import time
import traceback
import warnings
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

_PR_SET_PDEATHSIG = 1
_LAST_WORDS = frozenset({"result", "closed"})
"""Reports after which a child may end."""
_ALARM_S = 5
"""So long after its deadline a child ends itself, should nobody be left to kill it."""

Report = dict[str, Any]


class ChildFailed(RuntimeError):
    """A child raised, died or said nothing until its deadline; the text says which."""


class Channel:
    """One end of a pair of pipes that carries one JSON object a line."""

    def __init__(self, read_fd: int, write_fd: int) -> None:
        self._read_fd = read_fd
        self._write_fd = write_fd
        self._pending = b""

    def tell(self, event: str, **values: Any) -> None:
        """Send one report."""
        line = json.dumps({"event": event, **values}).encode() + b"\n"
        while line:
            line = line[os.write(self._write_fd, line) :]

    def wait(self, timeout_s: float) -> Report | None:
        """Return the next report, or None if none comes in time.

        Raises:
            EOFError: The other side has closed its end.
        """
        deadline = time.monotonic() + timeout_s
        while b"\n" not in self._pending:
            left = max(0.0, deadline - time.monotonic())
            if not select.select([self._read_fd], [], [], left)[0]:
                return None
            chunk = os.read(self._read_fd, 65536)
            if not chunk:
                raise EOFError("the other side closed the pipe")
            self._pending += chunk
        line, _, self._pending = self._pending.partition(b"\n")
        report: Report = json.loads(line)
        return report

    def close(self) -> None:
        """Close both pipes."""
        for fd in (self._read_fd, self._write_fd):
            with contextlib.suppress(OSError):
                os.close(fd)


class Child:
    """A forked process that runs ``role(channel, job)``; leaving the `with` block ends it."""

    def __init__(
        self, role: Callable[[Channel, Any], None], job: Any, *, log: Path, deadline_s: float
    ) -> None:
        """Fork.

        Args:
            role: Runs in the child.
            job: Its second argument.
            log: File that the child's standard error is appended to.
            deadline_s: From now; later the child is killed by whoever waits for it.
        """
        to_child, from_child = os.pipe(), os.pipe()
        self._log = log
        self._deadline = time.monotonic() + deadline_s
        self._status: int | None = None
        self._reports: deque[Report] = deque()
        self._is_done = False
        parent = os.getpid()
        with warnings.catch_warnings():
            warnings.simplefilter(
                "ignore", DeprecationWarning
            )  # the only other threads are the BLAS library's
            self.pid = os.fork()
        if self.pid == 0:
            os.close(to_child[1])
            os.close(from_child[0])
            signal.alarm(int(deadline_s) + _ALARM_S)
            _run(role, Channel(to_child[0], from_child[1]), job, log, parent)
        os.close(to_child[0])
        os.close(from_child[1])
        self.channel = Channel(from_child[0], to_child[1])

    def expect(self, event: str, *, beside: Sequence[Child] = ()) -> Report:
        """Return the child's next report called ``event``; others before it are passed over.

        Args:
            event: Its name.
            beside: Children whose failure ends the wait as well.

        Raises:
            ChildFailed: The child, or one beside it, failed or died, or the deadline passed.
        """
        while True:
            while self._reports:
                report = self._reports.popleft()
                if report["event"] == event:
                    return report
            if time.monotonic() > self._deadline:
                raise ChildFailed(f"deadline passed before {event!r}")
            for child in beside:
                if not child._is_done:  # it may have ended well before what we wait for is said
                    child._read(0.0, event)
            self._read(0.05 if beside else 1.0, event)

    def _read(self, timeout_s: float, event: str) -> None:
        """Keep one more report, if there is one in time."""
        left_s = max(0.0, min(timeout_s, self._deadline - time.monotonic()))
        try:
            report = self.channel.wait(left_s)
        except EOFError:
            raise ChildFailed(f"died before {event!r}: {_tail(self._log)}") from None
        if report is not None and report["event"] == "failed":
            raise ChildFailed(str(report["text"]))
        if report is not None:
            self._is_done = report["event"] in _LAST_WORDS
            self._reports.append(report)

    def tell(self, event: str, **values: Any) -> None:
        """Send the child one report; a child that died meanwhile shows at the next `expect`."""
        with contextlib.suppress(BrokenPipeError):
            self.channel.tell(event, **values)

    def __enter__(self) -> Child:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        grace_s = 2.0 if kind is None else 0.0
        self.end(grace_s=grace_s)

    def end(self, *, grace_s: float) -> None:
        """Wait until the child has gone, at most ``grace_s``, then kill it and all that it started."""
        self.channel.close()
        deadline = min(time.monotonic() + grace_s, self._deadline)
        while self._status is None and time.monotonic() < deadline:
            gone, status = os.waitpid(self.pid, os.WNOHANG)
            if gone:
                self._status = status
            else:
                time.sleep(0.002)
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(self.pid, signal.SIGKILL)
        if self._status is None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.pid, signal.SIGKILL)
            self._status = os.waitpid(self.pid, 0)[1]


def _run(role: Callable[[Channel, Any], None], channel: Channel, job: Any, log: Path, parent: int) -> None:
    """Be the child: run the role, report what it raises, and leave without the parent's exit handlers."""
    status = 1
    try:
        # To be killed with all that it starts. A session would be a scheduling group of its own on Linux,
        # with as large a share as all else that runs, whatever the run's own `nice` says.
        os.setpgrp()
        _die_with_parent(parent)
        fd = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)
        os.dup2(fd, 2)
        os.dup2(fd, 1)  # the table is the parent's alone
        role(channel, job)
        status = 0
    except (
        BaseException
    ) as error:  # the parent has to hear of anything, KeyboardInterrupt and SystemExit included
        traceback.print_exc()
        with contextlib.suppress(OSError):
            channel.tell("failed", text=f"{type(error).__name__}: {error}"[:300])
    finally:
        os._exit(status)


def _die_with_parent(parent: int) -> None:
    """Ask the kernel to kill this process when its parent ends (Linux; elsewhere its alarm ends it)."""
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        os._exit(1)


def _tail(log: Path) -> str:
    lines = log.read_text(errors="replace").strip().splitlines() if log.exists() else []
    return lines[-1][:300] if lines else "it said nothing"
