"""Ends the processes of a supervisor that is gone without having done so; needs the standard library only.

It is run by its file name, which takes a few milliseconds:

    guard.py watch GRACE_S FOLDER     who runs is told to it by lines "+PID" and "-PID" on standard input. At
                                      the end of the input it interrupts those left, kills them and all of
                                      their process groups after a grace, and removes the folder
    guard.py begin FD COMMAND...      tells "+PID" through a descriptor, and becomes the command

The input ends when the supervisor does, however that comes about, since nobody else keeps its other end: a
command tells of itself before it can be left alone. A process that leads no group of its own is not for it.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import sys
import time


def watch(grace_s: float, folder: str) -> None:
    """Wait for the end of standard input, and end who was told to run."""
    left: set[int] = set()
    for line in sys.stdin:
        process = int(line[1:])
        if line[0] == "+":
            left.add(process)
        else:
            left.discard(process)
    for process in left:
        with contextlib.suppress(OSError):
            os.kill(process, signal.SIGINT)
    deadline_s = time.monotonic() + grace_s
    while left:
        for process in sorted(left):
            if time.monotonic() >= deadline_s or not _lives(process):
                with contextlib.suppress(OSError):
                    os.killpg(process, signal.SIGKILL)
                left.remove(process)
        time.sleep(0.01)
    shutil.rmtree(folder, ignore_errors=True)


def begin(descriptor: int, command: list[str]) -> None:
    """Tell of this process, and become a command."""
    os.write(descriptor, b"+%d\n" % os.getpid())
    os.close(descriptor)
    os.execv(command[0], command)


def _lives(process: int) -> bool:
    try:
        os.kill(process, 0)
    except OSError:
        return False
    return True


if __name__ == "__main__":
    role, value, *rest = sys.argv[1:]
    if role == "watch":
        watch(float(value), *rest)
    else:
        begin(int(value), rest)
