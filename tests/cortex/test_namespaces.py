"""Two hosts: network namespaces with a cable between them, a registry in one, CURVE on tcp."""

from __future__ import annotations

import contextlib
import json
import os
import re
import selectors
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from cortex.security import AUTHORIZED_FILE, Keys, new_keys

ROOT = Path(__file__).resolve().parents[2]
NODE = Path(__file__).with_name("discovery_node.py")
ADDRESSES = ("10.213.7.1", "10.213.7.2")
SOON_S = 60.0


def ip(*arguments: str) -> None:
    done = subprocess.run(["ip", *arguments], capture_output=True, text=True, timeout=300.0, check=False)
    if done.returncode:
        raise OSError(f"ip {' '.join(arguments)}: {done.stderr.strip()}")


@pytest.fixture(scope="module")
def hosts() -> Iterator[tuple[str, str]]:
    """The names of two network namespaces with a veth pair between them."""
    if shutil.which("ip") is None:
        pytest.skip("network namespaces need the command ip (package iproute2)")
    if os.getuid() != 0:
        pytest.skip("network namespaces need root")
    names = (f"ctxa{os.getpid()}", f"ctxb{os.getpid()}")
    try:
        try:
            for name in names:
                ip("netns", "add", name)
            ip("link", "add", "cable", "netns", names[0], "type", "veth", "peer", "cable", "netns", names[1])
            for name, address in zip(names, ADDRESSES, strict=True):
                ip("-n", name, "address", "add", f"{address}/24", "dev", "cable")
                ip("-n", name, "link", "set", "cable", "up")
                ip("-n", name, "link", "set", "lo", "up")
        except OSError as error:
            pytest.skip(f"cannot make network namespaces: {error}")
        yield names
    finally:
        for name in names:
            with contextlib.suppress(OSError):
                ip("netns", "del", name)


@pytest.fixture
def place() -> Iterator[Path]:
    """A short path, for sockets lie below it."""
    path = Path(tempfile.mkdtemp(prefix="cortex-test-"))
    yield path
    shutil.rmtree(path)


class Process:
    """A program on one of the hosts; each host has a runtime directory of its own."""

    def __init__(self, host: str, place: Path, *arguments: str):
        environment = {
            **os.environ,
            "PYTHONPATH": str(ROOT),
            "CORTEX_RUNTIME_DIR": str(place / host),
            "PYTHONUNBUFFERED": "1",
        }
        self._process = subprocess.Popen(
            ["ip", "netns", "exec", host, sys.executable, *arguments],
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            bufsize=0,  # what is buffered here, `select` does not see
        )
        self.said: list[str] = []

    def read(self, pattern: str, timeout_s: float = SOON_S) -> re.Match[str] | None:
        """The next line that matches; None if there is none in time."""
        deadline = time.monotonic() + timeout_s
        with selectors.DefaultSelector() as selector:
            selector.register(self._process.stdout, selectors.EVENT_READ)
            while selector.select(max(deadline - time.monotonic(), 0)):
                line = self._process.stdout.readline().decode()
                if not line:
                    return None
                self.said.append(line)
                if match := re.search(pattern, line):
                    return match
        return None

    def sees(self, *names: str, timeout_s: float = SOON_S) -> bool:
        return self.read(re.escape(f'"names": {json.dumps(sorted(names))}'), timeout_s) is not None

    def signal(self, number: int) -> None:
        self._process.send_signal(number)

    def close(self) -> None:
        self._process.stdin.close()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(0.5)
        if self._process.poll() is None:
            self._process.terminate()
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(60.0)
        self._process.kill()
        self._process.wait()
        self._process.stdout.close()


@dataclass
class Keyring:
    """Directories with keys: of the registry, of a node that it knows, and of one that it does not."""

    registry: Path
    friend: Path
    stranger: Path


@pytest.fixture
def keyring(place) -> Keyring:
    ring = Keyring(*(place / name for name in ("registry", "friend", "stranger")))
    registry, friend, _ = (new_keys(directory) for directory in (ring.registry, ring.friend, ring.stranger))
    authorize(ring.registry, friend)
    for directory in (ring.friend, ring.stranger):
        authorize(directory, registry, ADDRESSES[0])
    return ring


def authorize(directory: Path, keys: Keys, *hosts: str) -> None:
    (directory / AUTHORIZED_FILE).write_text(" ".join([keys.public, *hosts]) + "\n")


@pytest.fixture
def start(place):
    with contextlib.ExitStack() as stack:

        def start_process(host, *arguments):
            process = Process(host, place, *arguments)
            stack.callback(process.close)
            return process

        yield start_process


def serve(start, host: str, *options: str) -> tuple[Process, str]:
    registry = start(host, "-m", "cortex.discovery", *options)
    match = registry.read(r"serves .*tcp://[0-9.]+:([0-9]+)")
    assert match, registry.said
    return registry, match[1]


def node(start, host: str, name: str, **options) -> Process:
    return start(host, str(NODE), json.dumps({"name": name, **options}))


def test_nodes_of_two_hosts_see_each_other_through_one_registry(hosts, start, keyring):
    _, port = serve(start, hosts[0], "--listen", "tcp://0.0.0.0:0", "--keys", str(keyring.registry))
    address = f"tcp://{ADDRESSES[0]}:{port}"
    near = node(start, hosts[0], "near")
    far = node(start, hosts[1], "far", registry=address, keys=str(keyring.friend))
    assert near.sees("far"), near.said
    assert far.sees("near"), far.said
    # The cable is pulled: the far node's lease runs out here, but it forgets nobody itself.
    ip("-n", hosts[1], "link", "set", "cable", "down")
    assert near.sees(), near.said
    assert not far.sees(timeout_s=1.5), far.said
    ip("-n", hosts[1], "link", "set", "cable", "up")
    assert near.sees("far"), near.said
    far.signal(signal.SIGKILL)
    assert near.sees(), near.said


def test_a_registry_on_another_host_that_is_killed_and_comes_back(hosts, start, keyring):
    options = ("--keys", str(keyring.registry))
    first, port = serve(start, hosts[0], "--listen", "tcp://0.0.0.0:0", *options)
    address = f"tcp://{ADDRESSES[0]}:{port}"
    far = [node(start, hosts[1], f"far {k}", registry=address, keys=str(keyring.friend)) for k in range(2)]
    assert far[0].sees("far 1"), far[0].said
    assert far[1].sees("far 0"), far[1].said
    before = len(far[0].said)
    first.signal(signal.SIGKILL)
    first.close()
    serve(start, hosts[0], "--listen", f"tcp://0.0.0.0:{port}", *options)
    late = node(start, hosts[1], "late", registry=address, keys=str(keyring.friend))
    assert late.sees("far 0", "far 1"), late.said
    assert far[0].sees("far 1", "late"), far[0].said
    assert not [line for line in far[0].said[before:] if "far 1" not in line]  # it was never forgotten


@pytest.mark.parametrize("keys", ["stranger", None])
def test_a_stranger_sees_nobody_and_is_seen_by_nobody(hosts, start, keyring, keys):
    registry, port = serve(start, hosts[0], "--listen", "tcp://0.0.0.0:0", "--keys", str(keyring.registry))
    address = f"tcp://{ADDRESSES[0]}:{port}"
    near = node(start, hosts[0], "near")
    directory = str(getattr(keyring, keys)) if keys else None
    stranger = node(start, hosts[1], "stranger", registry=address, keys=directory, insecure=keys is None)
    friend = node(start, hosts[1], "friend", registry=address, keys=str(keyring.friend))
    assert friend.sees("near"), friend.said
    assert near.sees("friend"), near.said
    assert not stranger.sees("friend", "near", timeout_s=1.5), stranger.said
    assert not any('"connected": true' in line for line in stranger.said)
    assert not any("stranger" in line for line in near.said + friend.said)
    if keys:
        assert registry.read("refused key"), registry.said
