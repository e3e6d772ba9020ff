"""Starts Warp, once for each process: quietly, and not in a process that was forked after it had started."""

from __future__ import annotations

import functools
import hashlib
import os
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import warp as wp

if sys.platform != "win32":
    import fcntl

_NO_CUDA = ("NVIDIA CUDA driver", "no CUDA-capable device")
"""What Warp writes where there is no driver, and where there is no device."""
_COMPILE_S = 120.0
"""After this a process that compiles kernels is no longer waited for."""
_owner: int | None = None
"""Process that was the first to compute."""


def start_warp() -> None:
    """Start Warp without its lines about devices and modules; set `wp.config.log_level` later to see them.

    The line about a CUDA driver or device that is missing, or hidden by CUDA_VISIBLE_DEVICES, is written by
    native code straight to the standard error stream: the stream is held back while Warp starts, and what
    else was written to it is written again.

    Raises:
        OSError: The folder for compiled kernels cannot be made.
    """
    global _owner
    started = _owner is not None
    refuse_forked_process()
    if started:
        return
    wp.config.log_level = max(wp.config.log_level, wp.LOG_WARNING)
    sys.stderr.flush()
    stderr = os.dup(2)
    with tempfile.TemporaryFile() as held:
        os.dup2(held.fileno(), 2)
        try:
            wp.init()
        except OSError as error:
            _owner = None  # it has not started
            raise type(error)(
                f"cannot make {wp.config.kernel_cache_dir}, where compiled kernels are kept: "
                f"{error.strerror}; set WARP_CACHE_PATH to a folder that can be written"
            ) from error
        finally:
            os.dup2(stderr, 2)
            os.close(stderr)
        held.seek(0)
        lines = held.read().decode(errors="replace").splitlines(keepends=True)
    sys.stderr.write("".join(line for line in lines if not any(known in line for known in _NO_CUDA)))
    context: Any = wp._src.context
    context.runtime.get_clang_pch_dir = _header_folder
    context.Module._compile = _compile_once(context.Module._compile)


def find_device(name: str) -> str:
    """Return the Warp name of a device setting: auto, cuda, cpu, cuda:0, ...

    Raises:
        ValueError: The device is not on this machine.
        RuntimeError: This process was forked from one that had used a device.
    """
    start_warp()
    known = [str(device) for device in wp.get_devices()]
    if name == "auto":
        return "cuda:0" if "cuda:0" in known else "cpu"
    if name == "cuda":
        name = "cuda:0"
    if name not in known:
        raise ValueError(
            f"device {name!r} is not on this machine, known: {known}; cuda needs an NVIDIA GPU and its "
            "driver (`nvidia-smi` lists it), and device: auto takes a GPU if there is one, else the CPU"
        )
    return name


def start_device(name: str) -> Any:
    """Allocate a number on the device of a setting, see `find_device`: the first one creates a CUDA context.

    Most of that runs in the driver, without the GIL.
    """
    return wp.zeros(1, device=find_device(name))


def has_kernels() -> bool:
    """Return whether kernels of a simulator are in the kernel cache; a first flight compiles them all."""
    start_warp()  # which says where the cache is
    return any(Path(str(wp.config.kernel_cache_dir)).glob("wp_neurosim_core.*"))


def _compile_once(compile_module: Callable[..., bool]) -> Callable[..., bool]:
    """Return a function that compiles a module; while another process does so, it waits for that instead.

    Simulators, tests or ranks of a training that start at once on a new machine need the same kernels.
    """

    @functools.wraps(compile_module)
    def compile_or_wait(module: Any, device: Any, folder: Any, *arguments: Any, **options: Any) -> bool:
        if Path(str(folder)).is_dir():  # it is there, maybe in a cache that is not ours to write
            return compile_module(module, device, folder, *arguments, **options)
        locks = Path(str(wp.config.kernel_cache_dir), "locks")
        locks.mkdir(parents=True, exist_ok=True)
        with open(locks / Path(str(folder)).name, "a") as lock:
            _await_lock(lock.fileno())  # it is free when the file is closed, or the process ends
            return compile_module(module, device, folder, *arguments, **options)

    return compile_or_wait


def _await_lock(file: int) -> None:
    """Lock a file; give up where there are no locks, or the process that has it seems to be stopped."""
    if sys.platform == "win32":
        return  # each process compiles for itself there
    deadline_s = time.monotonic() + _COMPILE_S
    while time.monotonic() < deadline_s:
        try:
            return fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            time.sleep(0.01)
        except OSError:  # of a file system without locks
            return


def _header_folder() -> str:
    """Return the folder of the kernel cache with Warp's precompiled headers for kernels of a CPU.

    Warp on its own precompiles them in each thread of each process again, which takes as long as the
    kernels do (1.7 s). Writers rename whole files into place, so processes can share the folder.
    """
    folder = Path(str(wp.config.kernel_cache_dir), "headers", _header_version())
    folder.mkdir(parents=True, exist_ok=True)  # `wp.clear_kernel_cache` may have removed it
    return str(folder)


@functools.cache
def _header_version() -> str:
    """Return a name that differs between installations of Warp: precompiled headers name their sources."""
    sources = Path(str(wp.__file__)).parent / "native"
    newest = max(header.stat().st_mtime_ns for header in sources.rglob("*.h"))
    return hashlib.sha256(f"{sources} {newest}".encode()).hexdigest()[:16]


def refuse_forked_process() -> None:
    """Refuse to compute in a process that was forked after Warp had started: it would wait forever."""
    global _owner
    if _owner is None:
        _owner = os.getpid()
    elif _owner != os.getpid():
        raise RuntimeError(
            "this process was forked from one that had started the simulator, whose threads and CUDA context "
            "do not survive a fork: start workers by multiprocessing_context='spawn' (torch's DataLoader) or "
            "multiprocessing.get_context('spawn')"
        )
