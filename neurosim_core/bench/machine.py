"""What figures depend on: the machine, the versions, the command."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import shlex
import subprocess
import sys
from datetime import datetime
from pathlib import Path
from typing import Any

import warp as wp

import neurosim_core
from neurosim_core import __version__

_LIBRARIES = ("numpy", "scipy", "warp-lang", "pyzmq")


def describe_machine(device: Any) -> list[str]:
    """Return lines for people: when, by which command, on which processor and device, with which versions.

    Args:
        device: Where it is computed; anything that `wp.get_device` takes.
    """
    place = wp.get_device(device)
    lines = [
        f"{now()}, `{command_line()}`",
        hardware(),
    ]
    if place.is_cuda:
        lines.append(str(place.name))
    return [*lines, ", ".join(f"{name} {version}" for name, version in versions().items())]


def now() -> str:
    """Return the date and time, for people."""
    return f"{datetime.now().astimezone():%Y-%m-%d %H:%M %Z}"


def hardware() -> str:
    """Return cores, processor, system and its load."""
    load = " ".join(f"{value:.2f}" for value in os.getloadavg())
    return f"{os.cpu_count()} cores, {processor()}, {platform.system()} {platform.release()}, load {load}"


def accelerators() -> list[str]:
    """Return the names of the CUDA devices that Warp can use."""
    return [str(device.name) for device in wp.get_cuda_devices()]


def versions() -> dict[str, str]:
    """Return the versions of this program and of what it computes with, by name."""
    own = " ".join(filter(None, (__version__, commit())))
    return {
        "Neurosim": own,
        "Python": platform.python_version(),
        **{name: importlib.metadata.version(name) for name in _LIBRARIES},
    }


def commit() -> str:
    """Return the commit of the checkout that this program runs from, and whether it was changed since.

    Empty: it does not run from a checkout, or there is no git.
    """
    root = Path(neurosim_core.__file__).resolve().parent.parent
    if not (root / ".git").exists():
        return ""
    name = _git(root, "rev-parse", "--short=10", "HEAD")
    if not name:
        return ""
    return f"{name} with changes" if _git(root, "status", "--porcelain", "--untracked-files=no") else name


def _git(root: Path, *arguments: str) -> str:
    """Return what git prints; empty where it fails."""
    try:
        done = subprocess.run(
            ["git", "-C", str(root), *arguments], capture_output=True, text=True, check=False, timeout=10.0
        )
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return done.stdout.strip() if done.returncode == 0 else ""


class StealTime:
    """CPU time that other machines of a virtual machine's host take: what is late may be late for that.

    Args:
        statistics: Where the system says so: proc(5), `steal`.
    """

    def __init__(self, statistics: Path = Path("/proc/stat")) -> None:
        self._statistics = statistics
        self._before_s = self._total_s()

    def notes(self) -> list[str]:
        """Return a line for people on what was taken since; none where that is not known."""
        now_s = self._total_s()
        if now_s is None or self._before_s is None:
            return []
        taken_s = now_s - self._before_s
        return [f"{taken_s:.2f} s of CPU time were taken by other machines of its host meanwhile"]

    def _total_s(self) -> float | None:
        try:
            _, *ticks = self._statistics.read_text(encoding="ascii").partition("\n")[0].split()
            return int(ticks[7]) / os.sysconf("SC_CLK_TCK")
        except (OSError, ValueError, IndexError):
            return None


def command_line() -> str:
    """Return the command that this process was started with."""
    return shlex.join([Path(sys.argv[0]).name or "python", *sys.argv[1:]])


def processor() -> str:
    """Return the name of the processor."""
    info = Path("/proc/cpuinfo")
    if info.exists():
        for line in info.read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()
