"""Child processes of a benchmark: forked, spoken to over pipes, killed at their deadline.

The parent makes no ZeroMQ context and starts no thread, so a fork copies nothing that a child can trip over.
Every wait here has a deadline, and a child never outlives the parent (on Linux).
"""

from __future__ import annotations

import contextlib
import ctypes
import multiprocessing
import os
import signal
import time
import warnings
from collections.abc import Callable, Sequence
from multiprocessing.connection import wait
from typing import Any

_FORK = multiprocessing.get_context("fork")
_PR_SET_PDEATHSIG = 1

Role = Callable[[Any, Any], None]


class ChildFailed(RuntimeError):
    """A child raised, died or said nothing until its deadline; the text says which."""


class Child:
    """A forked process that runs ``role(pipe, job)``; leaving the `with` block ends it and all it started."""

    def __init__(self, role: Role, job: Any, *, deadline_s: float) -> None:
        self._deadline = time.monotonic() + deadline_s
        self._pipe, theirs = _FORK.Pipe()
        self._process = _FORK.Process(target=_run, args=(role, job, theirs, os.getpid()), daemon=True)
        with warnings.catch_warnings():  # the only other threads are the BLAS library's
            warnings.simplefilter("ignore", DeprecationWarning)
            self._process.start()
        theirs.close()
        self.pid = self._process.pid or 0

    def tell(self, word: str) -> None:
        """Send the child a word; a child that died meanwhile shows at the next `expect`."""
        with contextlib.suppress(OSError):
            self._pipe.send(word)

    def expect(self, beside: Sequence[Child] = ()) -> Any:
        """Return the child's next report.

        Raises:
            ChildFailed: The child, or one beside it, failed or died, or the deadline passed.
        """
        while not self._pipe.poll():
            for child in beside:
                while child._process.exitcode:
                    child._take()  # what it said before it failed is passed over
            watched = [child._process.sentinel for child in beside if child._process.exitcode is None]
            if not wait([self._pipe, *watched], max(0.0, self._deadline - time.monotonic())):
                raise ChildFailed("its deadline passed")
        return self._take()

    def _take(self) -> Any:
        try:
            report = self._pipe.recv()
        except (EOFError, ConnectionError):
            self._process.join(1.0)
            raise ChildFailed(f"died with status {self._process.exitcode}") from None
        if isinstance(report, ChildFailed):
            raise report
        return report

    def kill(self) -> int:
        """Kill it; return when, by CLOCK_MONOTONIC [ns]."""
        now_ns = time.monotonic_ns()
        self._process.kill()
        return now_ns

    def __enter__(self) -> Child:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self._process.join(2.0 if kind is None else 0.0)
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(self.pid, signal.SIGKILL)
        self._process.kill()  # it may have no group of its own yet
        self._process.join()
        self._pipe.close()


def _run(role: Role, job: Any, pipe: Any, parent: int) -> None:
    """Be the child: run the role, report what it raises, and leave without the parent's exit handlers."""
    # To be killed with all that it starts. A session would be a scheduling group of its own on Linux,
    # with as large a share as all else that runs, whatever the run's own `nice` says.
    os.setpgrp()
    with contextlib.suppress(AttributeError):
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    status = 1
    try:
        if os.getppid() == parent:
            role(pipe, job)
            status = 0
    except BaseException as error:  # the parent has to hear of anything, SystemExit included
        with contextlib.suppress(OSError):
            pipe.send(ChildFailed(f"{type(error).__name__}: {error}"[:300]))
    finally:
        os._exit(status)
