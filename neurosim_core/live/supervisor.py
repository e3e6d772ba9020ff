"""Several processes as one command: they start together, print to one console, and end together.

Every process leads a session of its own, so that Ctrl-C reaches it once, from here, and not from the terminal
too. A process `guard.py` ends them where this one cannot, because it was killed.
"""

from __future__ import annotations

import contextlib
import os
import selectors
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from rich.console import Console
from rich.text import Text

from neurosim_core.signals import INTERRUPTED_LINE

GRACE_S = 1.5
"""How long a process may take to end after it was interrupted, before it is killed [s]."""
INTERRUPTED = 130

_LOOK_S = 0.05
_LAST_READS = 64
_GUARD = str(Path(__file__).with_name("guard.py"))


@dataclass(frozen=True, kw_only=True)
class Part:
    """One of the processes."""

    name: str
    """What it is called in messages."""
    command: Sequence[str]
    """Program, by its path, and arguments."""
    at_its_end: Literal["end", "end if it failed", "go on"] = "end"
    """What the others do when it ends by itself."""
    advice: str = ""
    """What to tell a user when it has ended and the others go on."""
    advice_if_failed: str = ""
    """What to tell besides, if it failed."""
    prefixed: bool = True
    """Whether its lines are printed behind its name."""


def run_together(
    parts: Sequence[Part], *, console: Console, folder: str | Path, grace_s: float = GRACE_S
) -> int:
    """Run processes until one ends that all others end with, or a signal comes; leave none behind.

    SIGINT, SIGTERM and SIGHUP end all: each process gets SIGINT, and is killed if it has not ended after a
    grace (such as when it is in native code, which compiles kernels and does not see signals), or at a second
    signal. What a process leaves running in its session is killed after it. If this process itself is killed,
    the same happens to all of them.

    To be called from the main thread.

    Args:
        parts: What to run.
        console: Where to print what they print, their standard errors included.
        folder: A folder to remove if this process is killed.
        grace_s: How long a process may take to end [s].

    Returns:
        The exit status of the process whose end was that of all, 1 if a signal killed it; 130 after a signal;
        else 0.

    Raises:
        OSError: A process cannot be started, or the console is gone. Those that run are ended.
    """
    with (
        _caught_signals() as caught,
        _guarded(folder, grace_s) as guard,
        selectors.DefaultSelector() as inputs,
    ):
        children: list[_Child] = []
        try:
            for part in parts:
                children.append(_Child(part, console, guard))
                inputs.register(children[-1].output, selectors.EVENT_READ, children[-1])
            return _attend(children, inputs, console, caught)
        finally:
            _end(children, inputs, console, caught, grace_s)


class _Child:
    """A running part."""

    def __init__(self, part: Part, console: Console, guard: int) -> None:
        self.part = part
        self._console = console
        self._guard = guard
        environment = {**os.environ, "PYTHONUNBUFFERED": "1"}
        if console.is_terminal:
            environment["COLUMNS"] = str(console.width)
        self._process = subprocess.Popen(
            [sys.executable, "-I", "-S", _GUARD, "begin", str(guard), *part.command],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            env=environment,
            pass_fds=(guard,),
            start_new_session=True,
        )
        assert self._process.stdout is not None
        self.output = self._process.stdout
        os.set_blocking(self.output.fileno(), False)
        self._begun = b""
        self._interrupted = False

    def poll(self) -> int | None:
        """Return its exit status, None while it runs; kill what an ended one has left in its session."""
        if self._process.returncode is None and self._process.poll() is not None:
            self._signal_group(signal.SIGKILL)
            self._forget()
        return self._process.returncode

    def interrupt(self) -> None:
        self._interrupted = True
        self._process.send_signal(signal.SIGINT)

    def kill(self) -> None:
        """Kill it, unless it has ended, and what it has started; wait until it is dead."""
        if self._process.returncode is None:
            self._signal_group(signal.SIGKILL)
            self._process.wait()
            self._forget()

    def pass_on(self) -> bool:
        """Print the lines that it has written meanwhile; return whether there can be more."""
        try:
            chunk = os.read(self.output.fileno(), 1 << 16)
        except BlockingIOError:
            return True
        *lines, self._begun = (self._begun + chunk).split(b"\n")
        if not chunk and self._begun:  # a last line without an end
            lines, self._begun = [self._begun], b""
        for line in lines:
            if self._interrupted and line.decode(errors="replace").strip() == INTERRUPTED_LINE:
                continue  # the user knows: all of them are
            text = Text.from_ansi(line.decode(errors="replace"))
            if self.part.prefixed:
                text = Text.assemble((f"{self.part.name}: ", "dim"), text)
            self._console.print(text, soft_wrap=True)
        return bool(chunk)

    def close(self) -> None:
        self.output.close()

    def _forget(self) -> None:
        with contextlib.suppress(BrokenPipeError):  # of a guard that somebody killed
            os.write(self._guard, b"-%d\n" % self._process.pid)

    def _signal_group(self, number: int) -> None:
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(self._process.pid, number)


def _attend(
    children: Sequence[_Child], inputs: selectors.BaseSelector, console: Console, caught: Sequence[int]
) -> int:
    """Print what they print until the end is near; return the exit status of all."""
    running = list(children)
    while running and not caught:
        _pass_on(inputs, _LOOK_S)
        for child in [child for child in running if child.poll() is not None]:
            running.remove(child)
            _pass_on(inputs, 0.0)
            part, status = child.part, child.poll() or 0
            if part.at_its_end == "end" or (part.at_its_end == "end if it failed" and status):
                if status:
                    _say(console, f"{part.name} {_how(status)}; ending the others")
                return status if status > 0 else int(status != 0)
            advice = [part.advice, part.advice_if_failed if status else ""]
            _say(console, "; ".join([f"{part.name} {_how(status)}", *filter(None, advice)]))
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
        with contextlib.suppress(OSError):  # the console is gone: they may still end as they should
            _pass_on(inputs, _LOOK_S)
    for child in running:
        child.kill()
    with contextlib.suppress(OSError):
        for _ in range(_LAST_READS):  # a process that got away may write for ever
            _pass_on(inputs, 0.0)
        for child in running:
            _say(console, f"{child.part.name} had not ended after {waited_s:.1f} s and was killed")
    for child in children:
        child.close()


def _pass_on(inputs: selectors.BaseSelector, timeout_s: float) -> None:
    """Print what has been written; wait for something if there is nothing."""
    for key, _ in inputs.select(timeout_s):
        if not key.data.pass_on():
            inputs.unregister(key.fileobj)


def _how(status: int) -> str:
    if status < 0:
        return f"was killed by {signal.Signals(-status).name}"
    return f"failed with status {status}" if status else "has ended"


def _say(console: Console, text: str) -> None:
    console.print(Text(text, "bold"), soft_wrap=True)


@contextlib.contextmanager
def _caught_signals() -> Iterator[list[int]]:
    """Collect the signals that end us, instead of acting on them; SIGHUP stays ignored if it is (nohup)."""
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


@contextlib.contextmanager
def _guarded(folder: str | Path, grace_s: float) -> Iterator[int]:
    """Start the guard, and give the descriptor through which it is told who runs."""
    guard = subprocess.Popen(
        [sys.executable, "-I", "-S", _GUARD, "watch", str(grace_s), str(folder)],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    assert guard.stdin is not None
    try:
        yield guard.stdin.fileno()
    finally:
        guard.stdin.close()
        guard.wait()
