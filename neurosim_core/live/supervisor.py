"""Processes that run as one: they start, print and end together."""

from __future__ import annotations

import contextlib
import os
import selectors
import signal
import subprocess
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

from rich.console import Console
from rich.text import Text

from neurosim_core.signals import INTERRUPTED_LINE, end_with_parent

GRACE_S = 1.5
"""How long a process may take to end after SIGINT before it is killed [s]."""
INTERRUPTED = 130
_LOOK_S = 0.05
_LAST_READS = 64


@dataclass(frozen=True, kw_only=True)
class Part:
    """One of the processes."""

    name: str
    """Its name in messages."""
    command: Sequence[str]
    """Program, by its path, and arguments."""
    at_its_end: Literal["end", "end if it failed", "go on"] = "end"
    """What the others do when it ends by itself."""
    advice: str = ""
    """What to tell a user when it has ended and the others go on."""
    is_prefixed: bool = True
    """Whether its lines are printed behind its name."""


def run_together(parts: Sequence[Part], *, console: Console, grace_s: float = GRACE_S) -> int:
    """Run processes until one ends that all others end with, or a signal comes; leave none behind.

    Each process leads a session of its own, so that Ctrl-C reaches only this one. SIGINT, SIGTERM and SIGHUP
    end all: each process gets SIGINT, and is killed after a grace, or at a second signal. When a process has
    ended, what it left in its session is killed. If this process is killed, the others get SIGINT (on Linux).
    For the main thread. `console`: where to print what they print, standard error included. `grace_s`: how
    long a process may take to end [s]. Returns the exit status of the process that ended all, 1 if a signal
    killed it; 130 after a signal; else 0.
    """
    children: list[_Child] = []
    with _caught_signals() as caught, selectors.DefaultSelector() as inputs:
        try:
            for part in parts:
                children.append(_Child(part, console))
                inputs.register(children[-1].output, selectors.EVENT_READ, children[-1])
            return _attend(children, inputs, console, caught)
        finally:
            _end(children, inputs, console, caught, grace_s)


class _Child:
    """A running part."""

    def __init__(self, part: Part, console: Console) -> None:
        self.part = part
        self._console = console
        environment = {**os.environ, "PYTHONUNBUFFERED": "1"}
        if console.is_terminal:
            environment["COLUMNS"] = str(console.width)
        self._process = subprocess.Popen(
            part.command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            env=environment,
            start_new_session=True,
            preexec_fn=end_with_parent(signal.SIGINT),
        )
        assert self._process.stdout is not None
        self.output = self._process.stdout
        os.set_blocking(self.output.fileno(), False)
        self._unfinished = b""
        self._is_interrupted = False

    def poll(self) -> int | None:
        """Return its exit status, None while it runs; kill what an ended one has left in its session."""
        if self._process.returncode is None and self._process.poll() is not None:
            self._kill_session()
        return self._process.returncode

    def interrupt(self) -> None:
        self._is_interrupted = True
        self._process.send_signal(signal.SIGINT)

    def kill(self) -> None:
        """Kill it and its session, and wait until it is dead."""
        if self._process.returncode is None:
            self._kill_session()
            self._process.wait()

    def print_output(self) -> bool:
        """Print the lines that it has written; return whether there can be more."""
        try:
            chunk = os.read(self.output.fileno(), 1 << 16)
        except BlockingIOError:
            return True
        *lines, self._unfinished = (self._unfinished + chunk).split(b"\n")
        if not chunk and self._unfinished:
            lines, self._unfinished = [self._unfinished], b""
        for line in lines:
            text = line.decode(errors="replace")
            if self._is_interrupted and text.strip() == INTERRUPTED_LINE:
                continue  # the user knows
            prefix = Text(f"{self.part.name}: ", "dim") if self.part.is_prefixed else Text()
            self._console.print(prefix + Text.from_ansi(text), soft_wrap=True)
        return bool(chunk)

    def _kill_session(self) -> None:
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(self._process.pid, signal.SIGKILL)


def _attend(
    children: Sequence[_Child], inputs: selectors.BaseSelector, console: Console, caught: Sequence[int]
) -> int:
    """Print what they print until all are to end; return the exit status."""
    running = list(children)
    while running and not caught:
        _print_output(inputs, _LOOK_S)
        for child in [child for child in running if child.poll() is not None]:
            running.remove(child)
            _print_output(inputs, 0.0)
            part, status = child.part, child.poll() or 0
            if part.at_its_end == "end" or (part.at_its_end == "end if it failed" and status):
                if status:
                    _say(console, f"{part.name} {_describe(status)}; ending the others")
                return status if status > 0 else int(status != 0)
            _say(console, f"{part.name} {_describe(status)}" + (f"; {part.advice}" if part.advice else ""))
    return INTERRUPTED if caught else 0


def _end(
    children: Sequence[_Child],
    inputs: selectors.BaseSelector,
    console: Console,
    caught: Sequence[int],
    grace_s: float,
) -> None:
    """End those that run, and print the last of what they print."""
    running = [child for child in children if child.poll() is None]
    for child in running:
        child.interrupt()
    begin_s, caught_before = time.monotonic(), len(caught)
    while running := [child for child in running if child.poll() is None]:
        waited_s = time.monotonic() - begin_s
        if waited_s >= grace_s or len(caught) > caught_before:
            break
        with contextlib.suppress(OSError):  # the console is gone
            _print_output(inputs, _LOOK_S)
    for child in running:
        child.kill()
    with contextlib.suppress(OSError):
        for _ in range(_LAST_READS):  # a process that left its session may write forever
            _print_output(inputs, 0.0)
        for child in running:
            _say(console, f"{child.part.name} had not ended after {waited_s:.1f} s and was killed")
    for child in children:
        child.output.close()


def _print_output(inputs: selectors.BaseSelector, timeout_s: float) -> None:
    """Print what has been written; wait for something if there is nothing."""
    for key, _ in inputs.select(timeout_s):
        if not key.data.print_output():
            inputs.unregister(key.fileobj)


def _describe(status: int) -> str:
    if status < 0:
        return f"was killed by {signal.Signals(-status).name}"
    return f"failed with status {status}" if status else "has ended"


def _say(console: Console, text: str) -> None:
    console.print(Text(text, "bold"), soft_wrap=True)


@contextlib.contextmanager
def _caught_signals() -> Iterator[list[int]]:
    """Collect the signals that end this process; SIGHUP stays ignored if it is (nohup)."""
    caught: list[int] = []
    numbers = [signal.SIGINT, signal.SIGTERM]
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
        numbers.append(signal.SIGHUP)
    before = {number: signal.signal(number, lambda got, _: caught.append(got)) for number in numbers}
    try:
        yield caught
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
