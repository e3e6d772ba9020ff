"""The command `cortex-ros2-bridge` in a process of its own."""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys
import time
from pathlib import Path

from processes import ROOT, SOON_S


class BridgeProcess:
    """The command in a process, with its standard error; `path` is where its Python looks for packages."""

    backend = ""

    def __init__(self, *arguments: str, python: str = sys.executable, path: str = str(ROOT)) -> None:
        self.process = subprocess.Popen(
            [python, "-m", "cortex_ros2_bridge", *arguments],
            env={**os.environ, "PYTHONPATH": path, "PYTHONUNBUFFERED": "1"},
            stderr=subprocess.PIPE,
        )
        self.said = ""

    def wait_for(self, text: str) -> None:
        """Read until it has said something."""
        deadline_s = time.monotonic() + SOON_S
        assert self.process.stderr is not None
        while text not in self.said:
            left_s = deadline_s - time.monotonic()
            assert select.select([self.process.stderr], [], [], max(left_s, 0.0))[0], self.said
            chunk = os.read(self.process.stderr.fileno(), 65536)
            assert chunk, self.said
            self.said += chunk.decode()

    def hear(self) -> None:
        """Take in what it has said by now."""
        assert self.process.stderr is not None
        if select.select([self.process.stderr], [], [], 0.0)[0]:
            self.said += os.read(self.process.stderr.fileno(), 65536).decode()

    def end(self, number: int) -> float:
        """Send a signal; how long it then took to end [s]."""
        begin_s = time.monotonic()
        self.process.send_signal(number)
        assert self.process.wait(SOON_S) == 0, self.said
        return time.monotonic() - begin_s

    def __enter__(self) -> BridgeProcess:
        return self

    def __exit__(self, *_: object) -> None:
        if self.process.poll() is None:
            self.process.kill()
        self.process.communicate()

    def kill(self) -> None:
        """SIGKILL, and wait until it is dead."""
        self.process.kill()
        assert self.process.wait(SOON_S) == -signal.SIGKILL

    @property
    def resident_bytes(self) -> int:
        """Memory that it has now."""
        pages = int(Path(f"/proc/{self.process.pid}/statm").read_text().split()[1])
        return pages * os.sysconf("SC_PAGE_SIZE")
