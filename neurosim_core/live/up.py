"""`neurosim up`: simulator, controller and viewer as one command. They start, print and end together."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from rich.console import Console
from rich.text import Text

from neurosim_core.config import SimulationConfig, to_yaml
from neurosim_core.scene.mesh import MeshSceneConfig
from neurosim_core.signals import INTERRUPTED_LINE, end_with_parent, handle_signals
from neurosim_core.view.rerun_sdk import check_new_file
from neurosim_core.view.rerun_viewer import has_display

GRACE_S = 1.5
"""How long a process may take to end after SIGINT before it is killed [s]."""
INTERRUPTED = 130
_LOOK_S = 0.05
_LAST_LINES_S = 0.5
"""How long the last lines of a process that has ended are waited for: what it left may write forever [s]."""


@dataclass(frozen=True, kw_only=True)
class Part:
    """One of the processes."""

    name: str
    """Its name in messages."""
    command: Sequence[str]
    """Program, by its path, and arguments."""
    at_its_end: Literal["end", "end if it failed", "go on"] = "end"
    """The response of the other processes when it ends by itself."""
    advice: str = ""
    """The message to the user when it has ended and the others go on."""
    is_prefixed: bool = True
    """Whether its lines are printed behind its name."""
    writes_file: bool = False
    """Whether it writes a file: it has all the time it needs to complete it, until a second signal."""


def up(config: SimulationConfig, *, viewer: str, record: Path | None, overwrite: bool) -> int:
    """Run a simulator, the controller that follows the path, and a viewer, until one ends or a signal comes.

    All end with the simulator. In lockstep the failure of the controller ends all; in streaming it is
    reported, and the fail-safe flies until another controller comes. The flight goes on without a viewer. The
    processes use the Cortex domain of the environment, so that other tools can join. `viewer`: native, web,
    none, a file that ends in .rrd, or auto: native where there is a display. `record`: folder to record to,
    as with `serve`. Returns the exit status of the simulator, or of the controller whose failure ended all;
    130 after a signal.
    """
    viewer_arguments = viewer_options(viewer)
    if viewer.endswith(".rrd"):
        check_new_file(Path(viewer))
    with tempfile.TemporaryDirectory(prefix="neurosim-") as folder:
        settings = Path(folder) / "config.yaml"
        settings.write_text(to_yaml(_with_absolute_scene(config)), encoding="utf-8")
        recording = [] if record is None else ["--record", str(record), *["--overwrite"] * overwrite]
        streaming = config.live.mode == "streaming"
        parts = [
            Part(
                name="simulator",
                command=_neurosim("serve", str(settings), *recording),
                is_prefixed=False,
                writes_file=record is not None,
            ),
            Part(
                name="controller",
                command=_neurosim("fly", str(settings)),
                at_its_end="go on" if streaming else "end if it failed",
                advice="the fail-safe flies until another controller comes (neurosim fly)",
            ),
        ]
        if viewer_arguments is not None:
            parts.append(
                Part(
                    name="viewer",
                    command=_neurosim("view", *viewer_arguments),
                    at_its_end="go on",
                    advice="the flight goes on (neurosim view opens another)",
                    writes_file="--save" in viewer_arguments,
                )
            )
        return run_together(parts, console=Console(highlight=False))


def viewer_options(viewer: str) -> list[str] | None:
    """Return the arguments of `neurosim view` for a choice of viewer; None for none."""
    if viewer == "auto":
        viewer = "native" if has_display() else "web"
    if viewer == "none":
        return None
    if viewer == "native":
        return []
    if viewer == "web":
        return ["--web"] if has_display() else ["--web", "--no-browser"]
    if viewer.endswith(".rrd"):
        return ["--save", viewer]
    raise ValueError(f"--viewer must be auto, native, web, none or a file that ends in .rrd, got {viewer!r}")


def _neurosim(*arguments: str) -> list[str]:
    return [sys.executable, "-m", "neurosim_core", *arguments]


def _with_absolute_scene(config: SimulationConfig) -> SimulationConfig:
    """Make a relative scene file absolute: the others read the settings from another folder."""
    scene = config.scene
    if not isinstance(scene, MeshSceneConfig):
        return config
    file = Path.cwd() / scene.file.expanduser()
    return config.model_copy(update={"scene": scene.model_copy(update={"file": file})})


def run_together(parts: Sequence[Part], *, console: Console, grace_s: float = GRACE_S) -> int:
    """Run processes until one ends that all others end with, or a signal comes; leave none behind.

    Each process leads a session of its own, so that Ctrl-C reaches only this one. SIGINT, SIGTERM and SIGHUP
    end all: each process gets SIGINT, and is killed after a grace, unless it writes a file, or at a second
    signal. When a process has ended, what it left in its session is killed. If this process is killed, the
    others get SIGINT (on Linux).
    For the main thread. `console`: where to print what they print, standard error included. `grace_s`: how
    long a process may take to end [s]. Returns the exit status of the process that ended all, 1 if a signal
    killed it; 130 after a signal; else 0.
    """
    children: list[_Child] = []
    caught: list[int] = []
    numbers = [signal.SIGINT, signal.SIGTERM]
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:  # as `nohup` has it
        numbers.append(signal.SIGHUP)
    with handle_signals(lambda number, _: caught.append(number), numbers):
        try:
            for part in parts:
                children.append(_Child(part, console))
            return _attend(children, console, caught)
        finally:
            _end(children, console, caught, grace_s)


class _Child:
    """A running part, and a thread that prints its lines.

    Attributes:
        lost_console: Its lines cannot be printed any more.
    """

    def __init__(self, part: Part, console: Console) -> None:
        self.part = part
        self.lost_console = False
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
        self._is_interrupted = False
        self._printer = threading.Thread(target=self._print_lines, name=part.name, daemon=True)
        self._printer.start()

    def poll(self) -> int | None:
        """Return its exit status, None while it runs; kill what an ended one has left in its session."""
        if self._process.returncode is None and self._process.poll() is not None:
            self._kill_session()
            self._printer.join(_LAST_LINES_S)
        return self._process.returncode

    def interrupt(self) -> None:
        self._is_interrupted = True
        self._process.send_signal(signal.SIGINT)

    def kill(self) -> None:
        """Kill it and its session, and wait until it is dead."""
        self._kill_session()
        self._process.wait()
        self._printer.join(_LAST_LINES_S)

    def _print_lines(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            text = line.decode(errors="replace").removesuffix("\n")
            if self._is_interrupted and text.strip() == INTERRUPTED_LINE:
                continue  # the user knows
            prefix = Text(f"{self.part.name}: ", "dim") if self.part.is_prefixed else Text()
            try:
                self._console.print(prefix + Text.from_ansi(text), soft_wrap=True)
            except (
                OSError,
                SystemExit,
            ):  # which `rich` raises: read on, or the part would wait
                self.lost_console = True

    def _kill_session(self) -> None:
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(self._process.pid, signal.SIGKILL)


def _attend(children: Sequence[_Child], console: Console, caught: Sequence[int]) -> int:
    """Wait until all are to end; return the exit status."""
    running = list(children)
    while running and not caught:
        time.sleep(_LOOK_S)
        if any(child.lost_console for child in children):
            return 1
        for child in [child for child in running if child.poll() is not None]:
            running.remove(child)
            part, status = child.part, child.poll() or 0
            if part.at_its_end == "end" or (part.at_its_end == "end if it failed" and status):
                if status:
                    _say(console, f"{part.name} {_describe(status)}; ending the others")
                return status if status > 0 else int(status != 0)
            _say(console, f"{part.name} {_describe(status)}" + (f"; {part.advice}" if part.advice else ""))
    return INTERRUPTED if caught else 0


def _end(children: Sequence[_Child], console: Console, caught: Sequence[int], grace_s: float) -> None:
    """End those that run."""
    running = [child for child in children if child.poll() is None]
    for child in running:
        child.interrupt()
    begin_s, caught_before = time.monotonic(), len(caught)
    while running := [child for child in running if child.poll() is None]:
        waited_s = time.monotonic() - begin_s
        is_late, at_once = waited_s >= grace_s, len(caught) > caught_before
        late = [child for child in running if at_once or (is_late and not child.part.writes_file)]
        for child in late:
            child.kill()
            with contextlib.suppress(OSError):  # the console is gone
                _say(console, f"{child.part.name} had not ended after {waited_s:.1f} s and was killed")
        running = [child for child in running if child not in late]
        time.sleep(_LOOK_S)


def _describe(status: int) -> str:
    if status < 0:
        return f"was killed by {signal.Signals(-status).name}"
    return f"failed with status {status}" if status else "has ended"


def _say(console: Console, text: str) -> None:
    console.print(Text(text, "bold"), soft_wrap=True)
