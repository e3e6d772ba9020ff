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

import neurosim_core


def describe_machine() -> dict[str, str]:
    """Return date, command, processor, devices and versions: term -> text."""
    import warp as wp

    load = " ".join(f"{value:.2f}" for value in os.getloadavg())
    libraries = ("numpy", "scipy", "warp-lang")
    versions = {
        "Neurosim": " ".join(filter(None, (neurosim_core.__version__, commit()))),
        "Python": platform.python_version(),
        **{name: importlib.metadata.version(name) for name in libraries},
    }
    facts = {
        "date": f"{datetime.now().astimezone():%Y-%m-%d %H:%M %Z}",
        "command": shlex.join([Path(sys.argv[0]).name or "python", *sys.argv[1:]]),
        "machine": f"{os.cpu_count()} cores, {processor()}, {platform.system()}, load {load}",
        "versions": ", ".join(f"{name} {version}" for name, version in versions.items()),
    }
    if devices := [str(device.name) for device in wp.get_cuda_devices()]:
        facts["CUDA devices"] = ", ".join(devices)
    return facts


def commit() -> str:
    """Return the commit of the checkout that this program runs from; empty where there is none."""
    root = Path(neurosim_core.__file__).resolve().parent.parent
    try:
        done = subprocess.run(
            ["git", "-C", str(root), "describe", "--always", "--dirty", "--exclude=*"],
            capture_output=True, text=True, check=False, timeout=10.0,
        )  # fmt: skip
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return done.stdout.strip() if done.returncode == 0 else ""


def processor() -> str:
    """Return the name of the processor."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()
