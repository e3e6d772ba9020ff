"""The C++ subscriber of the benchmark: built once per run, where a compiler and the headers are."""

from __future__ import annotations

import functools
import os
import shutil
import subprocess
import tempfile
from pathlib import Path

from cortex.bench.samples import Sample
from cortex.cppgen import generate, write_headers

_SOURCE = Path(__file__).with_name("subscriber.cpp")
_INCLUDE = Path(__file__).parents[1] / "cpp" / "include"
_BUILD_S = 120.0


def cpp_missing() -> str:
    """Return why the C++ subscriber cannot be built here; empty if it can."""
    if shutil.which("g++") is None:
        return "no g++"
    if not Path("/usr/include/zmq.h").exists():
        return "no zmq.h"
    return build_error()


def binary() -> Path:
    """Return where the program is, or will be, in this run's directory."""
    return Path(os.environ.get("CORTEX_BENCH_DIR", tempfile.gettempdir())) / "subscriber"


@functools.cache
def build_error() -> str:
    """Generate the header and build the program; return the first complaint of either, or nothing."""
    folder = binary().parent
    write_headers(folder)
    (folder / "sample.hpp").write_text(generate([Sample]))
    command = ["g++", "-std=c++17", "-O2", f"-I{_INCLUDE}", f"-I{folder}", str(_SOURCE)]
    command += ["-o", str(binary()), "-lzmq", "-pthread"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=_BUILD_S, check=False)
    except subprocess.TimeoutExpired:
        return f"g++ took longer than {_BUILD_S:.0f} s"
    errors = [line for line in done.stderr.splitlines() if "error" in line] or done.stderr.splitlines()
    return "" if done.returncode == 0 else f"does not build: {(errors or ['?'])[0][-120:]}"
