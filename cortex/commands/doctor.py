"""`cortex doctor`: does everything that Cortex needs work on this host, and how to mend what does not."""

from __future__ import annotations

import argparse
import fcntl
import importlib
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import zmq

from cortex.commands.session import open_node
from cortex.commands.text import seconds
from cortex.compiled import native
from cortex.host import REGISTRY_LOCK, FileLock, domain_id, runtime_dir
from cortex.message_types import message
from cortex.places import NETWORK_VARIABLES
from cortex.security import PUBLIC_FILE, default_directory, load_keys

_FILES_MIN = 1024
_EXCHANGE_S = 20.0
_CLOCK_S = 10.0
_LISTEN_S = 2.0


class Fault(Exception):
    """What is wrong, and how to mend it."""


@message(name="cortex/doctor/Sample")
class Sample:
    """What two processes exchange to see whether they can."""

    data: bytes


def examine(options: argparse.Namespace) -> int:
    """Check one thing after the other; 1 if something is wrong."""
    checks: list[tuple[str, Callable[[], str]]] = [
        ("runtime directory", lambda: _check_directory(options.domain)),
        ("registry", lambda: _check_registry(options.domain)),
        ("C module", _check_native),
        ("shared memory", _check_memory),
        ("limits", _check_limits),
        ("CURVE", lambda: _check_curve(options)),
        ("two processes", _check_exchange),
    ]
    if options.registry not in ("auto", "off"):
        checks[1] = ("registry", lambda: options.registry)
        checks.append(("clock", lambda: _check_clock(options)))
    faults = 0
    for name, check in checks:
        try:
            print(f"ok     {name}: {check()}", flush=True)
        except (Fault, OSError, ValueError) as error:
            faults += 1
            print(f"WRONG  {name}: {error}", flush=True)
    return int(faults > 0)


def _check_directory(domain: int | None) -> str:
    try:
        directory = runtime_dir(domain_id(domain))
    except PermissionError as error:
        raise Fault(f"{error}; or set CORTEX_RUNTIME_DIR to a directory of your own") from error
    return f"{directory}, domain {domain_id(domain)}; who is to be met must use the same"


def _check_registry(domain: int | None) -> str:
    path = runtime_dir(domain_id(domain)) / REGISTRY_LOCK
    lock = FileLock.acquire(path) if path.exists() else None
    if lock is not None:
        lock.close()
    if lock is not None or not path.exists():
        return "none runs; the first node starts one"
    return f"process {path.read_text(encoding='ascii', errors='replace').strip() or 'unknown'}"


def _check_native() -> str:
    if native is not None:
        return str(native.__file__)
    if os.environ.get("CORTEX_PURE_PYTHON"):
        raise Fault("CORTEX_PURE_PYTHON leaves it out, which is slower: unset it")
    try:
        importlib.import_module("cortex._native")
    except ImportError as error:
        reason = str(error)
    else:
        reason = "it is of another version of cortex"
    install = "Install a C compiler and Python's headers, then `pip install -e .` again"
    raise Fault(f"{reason}. All works, more slowly. {install}")


def _check_memory() -> str:
    if sys.platform != "linux":
        return f"none, {sys.platform} has no memfd: large messages go through sockets, with two copies more"
    descriptor = os.memfd_create("cortex-doctor", os.MFD_ALLOW_SEALING)
    try:
        os.ftruncate(descriptor, 1 << 20)
        fcntl.fcntl(descriptor, fcntl.F_ADD_SEALS, fcntl.F_SEAL_GROW | fcntl.F_SEAL_SHRINK)
        os.close(os.open(f"/proc/self/fd/{descriptor}", os.O_RDWR | os.O_CLOEXEC))
    except OSError as error:
        raise Fault(
            f"a memfd cannot be used ({error}): is /proc mounted, does a seccomp filter forbid it?"
        ) from error
    finally:
        os.close(descriptor)
    free = os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return f"memfd with seals; {free / 1e9:.1f} GB of memory are free"


def _check_limits() -> str:
    files, size = (resource.getrlimit(kind)[0] for kind in (resource.RLIMIT_NOFILE, resource.RLIMIT_FSIZE))
    if size != resource.RLIM_INFINITY:
        raise Fault(f"files may have {size} bytes at most, rings of shared memory too: `ulimit -f unlimited`")
    if files != resource.RLIM_INFINITY and files < _FILES_MIN:
        raise Fault(f"a process may open {files} files, a link needs up to 8: `ulimit -n {_FILES_MIN}`")
    return f"{files} open files, no limit to their size"


def _check_curve(options: argparse.Namespace) -> str:
    if not zmq.has("curve"):
        raise Fault(
            "this libzmq has no CURVE, so tcp cannot be encrypted: `pip install pyzmq` brings one that has"
        )
    given = options.keys or os.environ.get("CORTEX_KEYS")
    directory = Path(given or default_directory())
    if not (directory / PUBLIC_FILE).exists():
        if given:
            raise Fault(f"no keys in {directory}, so no node can start: `cortex keys new --dir {directory}`")
        return f"there; no keys in {directory} (`cortex keys new` makes some)"
    keys = load_keys(directory)
    return f"keys in {directory}, {len(keys.authorized) - 1} others are authorised"


def _check_clock(options: argparse.Namespace) -> str:
    """This host's clock beside that of the registry's: what `time.time` of both would disagree by."""
    with open_node(options) as node:
        deadline_s = time.monotonic() + _CLOCK_S
        while node.clock() is None and time.monotonic() < deadline_s:
            time.sleep(0.1)
        time.sleep(_LISTEN_S)  # some answers are quicker than others
        clock = node.clock()
    if clock is None:
        raise Fault(f"the registry at {options.registry} does not answer: does it run, are the keys known?")
    ahead = "ahead of" if clock.ahead_ns >= 0 else "behind"
    return (
        f"{seconds(abs(clock.ahead_ns) * 1e-9)} {ahead} the registry's, to {seconds(clock.error_ns * 1e-9)}"
        "; stamps of `node.now_ns()` agree"
    )


def _check_exchange() -> str:
    """A small and a large message, from a process of its own."""
    from cortex.node import Node
    from cortex.policy import reliable

    before = {name: os.environ.pop(name, None) for name in _ENVIRONMENT}
    command = [sys.executable, "-c", "from cortex.commands.doctor import publish; publish()"]
    path = os.pathsep.join(filter(None, (str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH"))))
    try:
        with tempfile.TemporaryDirectory(prefix="cortex-doctor-") as directory, ExitStack() as stack:
            os.environ.update(CORTEX_RUNTIME_DIR=directory, CORTEX_DOMAIN="0")
            node = stack.enter_context(Node("doctor"))
            subscriber = stack.enter_context(node.subscriber("/doctor", Sample, policy=reliable()))
            environment = {**os.environ, "PYTHONPATH": path}
            child = subprocess.Popen(command, env=environment, stdin=subprocess.PIPE)
            stack.enter_context(child)
            stack.callback(child.kill)
            sizes = [len(subscriber.recv(_EXCHANGE_S).data) for _ in _SIZES]
            carriers = subscriber.carriers
    except TimeoutError:
        raise Fault(f"nothing came of another process within {_EXCHANGE_S:.0f} s") from None
    finally:
        for name, value in before.items():
            os.environ.pop(name, None) if value is None else os.environ.update({name: value})
    if sizes != _SIZES:
        raise Fault(f"messages of {_SIZES} bytes were sent, {sizes} have come")
    if sys.platform == "linux" and not any("shared memory" in carrier for carrier in carriers):
        raise Fault(f"they meet, but share no memory ({'; '.join(carriers)}): see above")
    return f"they talk by {'; '.join(carriers)}"


_ENVIRONMENT = ("CORTEX_RUNTIME_DIR", "CORTEX_DOMAIN", *NETWORK_VARIABLES)
_SIZES = [10, 1_000_000]


def publish() -> None:
    """The other process: publishes, and ends with its standard input."""
    from cortex.node import Node

    with Node("patient") as node, node.publisher("/doctor", Sample) as publisher:
        if publisher.wait_for_subscribers(timeout_s=_EXCHANGE_S):
            for size in _SIZES:
                publisher.publish(Sample(bytes(size)))
        sys.stdin.read()
