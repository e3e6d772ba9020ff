"""What figures depend on: the machine, the versions, the command."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import shlex
import sys
from datetime import datetime
from pathlib import Path
from typing import Any

import warp as wp

from neurosim_core import __version__

_LIBRARIES = ("numpy", "warp-lang", "pyzmq")


def describe_machine(device: Any) -> list[str]:
    """Return lines for people: when, by which command, on which processor and device, with which versions.

    Args:
        device: Where it is computed; anything that `wp.get_device` takes.
    """
    load = " ".join(f"{value:.2f}" for value in os.getloadavg())
    place = wp.get_device(device)
    lines = [
        f"{datetime.now().astimezone():%Y-%m-%d %H:%M %Z}, `{command_line()}`",
        f"{os.cpu_count()} cores, {processor()}, {platform.system()} {platform.release()}, load {load}",
    ]
    if place.is_cuda:
        lines.append(str(place.name))
    versions = [f"Neurosim {__version__}", f"Python {platform.python_version()}"]
    versions += [f"{name} {importlib.metadata.version(name)}" for name in _LIBRARIES]
    return [*lines, ", ".join(versions)]


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
