"""The fixture `runtime`: a directory of its own for the nodes of a test, and a check that nothing is left."""

from __future__ import annotations

import contextlib
import gc
import os
import shutil
import signal
import sys
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from processes import processes_with, shared_mappings, wait_for
from registry_forks import forks
from zmq.utils.garbage import GarbageCollectorThread

from cortex import registry
from cortex.host import REGISTRY_LOCK, REGISTRY_LOG, REGISTRY_SOCKET, sweep
from cortex.places import NETWORK_VARIABLES

_SPAWN = registry._spawn


def _shared_files() -> set[str]:
    return {name for name in os.listdir("/dev/shm") if "cortex" in name.lower() or "ctx" in name.lower()}


def _threads() -> set[threading.Thread]:
    """Threads, without those that stay: pyzmq's for messages without a copy, and the pool that renders."""
    return {
        thread
        for thread in threading.enumerate()
        if not isinstance(thread, GarbageCollectorThread) and not thread.name.startswith("neurosim-render")
    }


@pytest.fixture
def runtime(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A runtime directory for the test; afterwards no process, thread, memory or file of it is left."""
    with own_directory(monkeypatch) as base:
        yield base


@pytest.fixture(scope="module")
def shared_runtime() -> Iterator[Path]:
    """As `runtime`, for all tests of a module: they start one registry, not one each."""
    with pytest.MonkeyPatch.context() as monkeypatch, own_directory(monkeypatch) as base:
        yield base


@contextlib.contextmanager
def own_directory(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Let nodes meet in a directory of their own; check at the end that nothing is left of them."""
    base = Path(tempfile.mkdtemp(prefix="ctx-", dir="/tmp"))
    monkeypatch.setenv("CORTEX_RUNTIME_DIR", str(base))
    for name in ("CORTEX_DOMAIN", *NETWORK_VARIABLES):
        monkeypatch.delenv(name, raising=False)
    if sys.platform == "linux":
        monkeypatch.setattr(registry, "_spawn", forks(_SPAWN))
    threads, files, mappings = _threads(), _shared_files(), set(shared_mappings())
    try:
        yield base
        _end_registries(base)
        wait_for(lambda: not _threads() - threads)
        if set(shared_mappings()) - mappings:
            gc.collect()  # of all that the process has imported: a tenth of a second and more
        wait_for(lambda: not set(shared_mappings()) - mappings)
        wait_for(lambda: not _shared_files() - files)
        for domain in base.iterdir():
            wait_for(lambda domain=domain: not _left(domain))
    finally:
        for pid in processes_with(str(base)):
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        shutil.rmtree(base, ignore_errors=True)


def _left(domain: Path) -> set[str]:
    """Names that belong to a node that was not closed: what the killed ones left is swept.

    A process that dies has no environment any more some time before its files are closed.
    """
    sweep(domain)
    return {path.name for path in domain.iterdir()} - {REGISTRY_LOCK, REGISTRY_LOG, REGISTRY_SOCKET}


def _end_registries(base: Path) -> None:
    """End the registries, which would wait for two seconds; anything else that still runs is a failure."""
    for lock in base.glob(f"*/{REGISTRY_LOCK}"):
        text = lock.read_text()
        if text and int(text) in processes_with(str(base)):
            with contextlib.suppress(ProcessLookupError):  # its two seconds are over
                os.kill(int(text), signal.SIGTERM)
    wait_for(lambda: not processes_with(str(base)))
