"""A process whose lines a test reads, each with a deadline."""

from __future__ import annotations

import os
import select
import signal
import subprocess
import time
from collections.abc import Sequence

from processes import SOON_S


class LineProcess:
    """A process; what it writes to its standard output and error is one stream of lines.

    A context manager: at its end the process is killed, if it has not ended.
    """

    def __init__(self, command: Sequence[str], *, own_session: bool = False) -> None:
        self.process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            start_new_session=own_session,
        )
        assert self.process.stdout is not None
        self.output = self.process.stdout
        self._begun = b""

    def __enter__(self) -> LineProcess:
        return self

    def __exit__(self, *_: object) -> None:
        self.kill()
        self.output.close()

    def kill(self) -> None:
        """SIGKILL, and wait until it is dead."""
        self.process.kill()
        self.process.wait(SOON_S)

    def interrupt(self) -> None:
        """What Ctrl-C does."""
        self.process.send_signal(signal.SIGINT)

    def read_until(self, *words: str, within_s: float = SOON_S) -> list[str]:
        """Lines up to that by which each of some texts has come, in any order."""
        lines, missing = [], list(words)
        deadline_s = time.monotonic() + within_s
        while missing:
            line = self._line(deadline_s)
            assert line is not None, f"it has ended, without {missing}: {lines}"
            lines.append(line)
            missing = [word for word in missing if word not in line]
        return lines

    def rest(self, within_s: float = SOON_S) -> list[str]:
        """What it writes until its end, for which this waits."""
        deadline_s = time.monotonic() + within_s
        lines = []
        while (line := self._line(deadline_s)) is not None:
            lines.append(line)
        self.process.wait(max(deadline_s - time.monotonic(), 0.0))
        return lines

    def _line(self, deadline_s: float) -> str | None:
        """The next line; None at the end."""
        while b"\n" not in self._begun:
            left_s = max(deadline_s - time.monotonic(), 0.0)
            ready = select.select([self.output], [], [], left_s)[0]
            assert ready, f"it is silent, after {self._begun!r}"
            chunk = os.read(self.output.fileno(), 1 << 16)
            if not chunk:
                return None
            self._begun += chunk
        line, self._begun = self._begun.split(b"\n", 1)
        return line.decode()
