"""Processes of the live stack for measurements: start, check and end them."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from neurosim_core.bench.engine import ProbeError, SimulationConfig, to_yaml

_RUNTIME = "CORTEX_RUNTIME_DIR"
_VARIABLES = (_RUNTIME, "CORTEX_REGISTRY", "CORTEX_LISTEN", "CORTEX_KEYS")
"""The variables that decide which nodes find each other."""
_PARENT_MAX = 40
"""Longest directory of temporary files [characters]: paths of sockets end at 107."""
_STOP_S = 5.0


class ProcessEnded(RuntimeError):
    """A process ended while it was needed; the message has the last lines that it said."""


@contextlib.contextmanager
def own_runtime() -> Iterator[Path]:
    """Isolate the nodes of a block from all other nodes; yield a folder, which is removed at the end."""
    parent = tempfile.gettempdir()
    folder = Path(tempfile.mkdtemp(prefix="nsb-", dir=parent if len(parent) <= _PARENT_MAX else "/tmp"))
    before = {name: os.environ.pop(name, None) for name in _VARIABLES}
    os.environ[_RUNTIME] = str(folder / "cortex")
    try:
        yield folder
    finally:
        del os.environ[_RUNTIME]
        os.environ.update({name: value for name, value in before.items() if value is not None})
        shutil.rmtree(folder, ignore_errors=True)


class NeurosimProcess:
    """A command of `neurosim` as a process of its own; leaving the `with` block ends it.

    Settings are given to it as a file; what it says goes to `log`.
    """

    def __init__(self, command: str, config: SimulationConfig | None, *arguments: str, log: Path) -> None:
        self._command = command
        self._log = log
        if config is not None:
            settings = log.with_suffix(".yaml")
            settings.write_text(to_yaml(config), encoding="utf-8")
            arguments = (str(settings), *arguments)
        program = [sys.executable, "-m", "neurosim_core", command, *arguments]
        with log.open("wb") as out:
            self._process = subprocess.Popen(program, stdin=subprocess.DEVNULL, stdout=out, stderr=out)

    def check(self) -> None:
        """Raise `ProcessEnded` if it has ended."""
        status = self._process.poll()
        if status is not None:
            raise ProcessEnded(f"`neurosim {self._command}` ended with status {status}; {self.last_lines()}")

    @contextlib.contextmanager
    def with_output(self) -> Iterator[None]:
        """Add the last output of this process to the errors of probes in a block."""
        try:
            yield
        except ProbeError as error:
            raise ProbeError(f"{error}; `neurosim {self._command}`: {self.last_lines()}") from None

    def last_lines(self) -> str:
        """Return the last lines of its output, for an error message."""
        lines = self._log.read_text(errors="replace").strip().splitlines()[-5:]
        return "it said:\n" + ("\n".join(f"  {line}" for line in lines) or "  (nothing)")

    def wait(self, timeout_s: float) -> None:
        """Wait until it ends by itself; raise `ProcessEnded` where its status is not 0, or `TimeoutError`."""
        try:
            status = self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            late = f"`neurosim {self._command}` did not end within {timeout_s:g} s"
            raise TimeoutError(f"{late}; {self.last_lines()}") from None
        if status != 0:
            self.check()

    def resident_bytes(self) -> int:
        """Return the memory that it holds, shared pages included; -1 where the system does not say."""
        try:
            pages = int(Path(f"/proc/{self._process.pid}/statm").read_text().split()[1])
        except (OSError, IndexError):
            return -1
        return pages * os.sysconf("SC_PAGE_SIZE")

    def __enter__(self) -> NeurosimProcess:
        return self

    def __exit__(self, *_: object) -> None:
        """End it as Ctrl-C does, and kill it if that takes long."""
        if self._process.poll() is None:
            self._process.send_signal(signal.SIGINT)
            try:
                self._process.wait(_STOP_S)
            except subprocess.TimeoutExpired:
                self._process.kill()
        self._process.wait()
