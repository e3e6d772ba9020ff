"""Processes that help one process, and end with it."""

from __future__ import annotations

import gc
import os
import signal
import subprocess
import sys
from collections.abc import Mapping
from typing import IO

from neurosim_core.signals import end_with_parent


def start_child(module: str, *, stdin: IO[bytes] | int, env: Mapping[str, str]) -> subprocess.Popen[bytes]:
    """Start a process that calls `main` of a module, which uses `begin_child`.

    `env` is added to the environment. The process answers on its standard output.
    """
    # `-m` would look for modules in the working directory first, where a yaml.py may lie
    program = f"import sys; sys.path[:] = {sys.path!r}; from {module} import main; main()"
    return subprocess.Popen(
        [sys.executable, "-c", program],
        stdin=stdin,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        env={"OPENBLAS_NUM_THREADS": "1", **os.environ, **env},  # matrices are small: threads cost time
        preexec_fn=end_with_parent(signal.SIGKILL),
    )


def begin_child() -> IO[bytes]:
    """Be such a process; return where its answers go."""
    gc.disable()  # it ends soon
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # who asked says that it was interrupted
    answers = os.fdopen(os.dup(1), "wb")
    with open(os.devnull, "w") as nowhere:
        os.dup2(nowhere.fileno(), 1)  # what libraries print is no answer
    return answers


def end_child(process: subprocess.Popen[bytes]) -> None:
    """End such a process, whatever it does."""
    process.kill()
    process.communicate()  # closes the pipes
