"""CURVE between the C++ client and Python, over tcp as from another host."""

from __future__ import annotations

import json
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cpp_client import Peer
from cpp_messages import Rich, Scan
from cpp_programs import needs_compiler, programs
from directories import serving
from processes import SOON_S, wait_for
from test_transports import keys_of

from cortex.policy import reliable
from cortex.security import AUTHORIZED_FILE, load_keys, new_keys

__all__ = ["programs"]

pytestmark = needs_compiler

Start = Callable[..., Any]


@pytest.fixture
def places(tmp_path):
    """Key directories: `python` and `cpp` trust each other, `stranger` trusts both and is trusted by none."""
    made = keys_of(tmp_path, ("python", "cpp"))
    new_keys(tmp_path / "stranger")
    (tmp_path / "stranger" / AUTHORIZED_FILE).write_text((made["cpp"] / AUTHORIZED_FILE).read_text())
    return made | {"stranger": tmp_path / "stranger"}


def authorize(place: Path, key: str) -> None:
    """Add the key that answers at 127.0.0.1."""
    file = place / AUTHORIZED_FILE
    file.write_text(f"{file.read_text()}{key} 127.0.0.1\n")


@pytest.fixture
def elsewhere():
    """A runtime directory of another host, whose path leaves room for sockets."""
    with tempfile.TemporaryDirectory(prefix="ctx-", dir="/tmp") as folder:
        yield Path(folder)


@pytest.fixture
def registry(places, runtime):
    with serving(listen="tcp://127.0.0.1:*", keys=load_keys(places["python"])) as serves:
        yield serves


@pytest.fixture
def python_node(registry, places, make_node):
    return make_node(listen="127.0.0.1", keys=load_keys(places["python"]))


@pytest.fixture
def start_cpp(programs, registry, places, elsewhere, monkeypatch):
    """Start a program on another host, with the keys of a directory; a stranger is not waited for."""

    def start(name: str, *arguments: object) -> Any:
        authorize(places[name], load_keys(places["python"]).public)
        command = [programs / "peer", *map(str, arguments)]
        with monkeypatch.context() as environment:
            for variable, value in {
                "CORTEX_TEST_REGISTRY": registry.address,
                "HOME": places[name].parent,
                "CORTEX_TEST_KEYS": f"~/{places[name].name}",
                "CORTEX_TEST_LISTEN": "127.0.0.1",
                "CORTEX_RUNTIME_DIR": elsewhere,
            }.items():
                environment.setenv(variable, str(value))
            if name == "stranger":
                return subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.DEVNULL)
            return Peer(command)

    return start


def test_cpp_reads_what_python_writes(start_cpp, python_node):
    scans = python_node.publisher("/scan", Scan)
    peer = start_cpp("cpp", "count", "/scan", "reliable", 0, 0)
    assert scans.wait_for_subscribers(1, SOON_S)
    for number in [*range(100), -1]:
        scans.publish(Scan(number, np.full(8, number, np.float32)))
    result = json.loads(peer.line())
    assert (result["received"], result["wrong"], result["lost"]) == (100, 0, 0)
    peer.end()


def tcp_key_of(node: Node) -> str:
    """The server key of the program in C++ that a node knows."""
    (found,) = wait_for(lambda: [each for each in node.nodes() if each.name == "cpp"])
    return next(each.server_key for each in found.endpoints if each.transport == "tcp")


def test_python_reads_what_cpp_writes(start_cpp, python_node):
    scans = python_node.subscriber("/scan", Scan, policy=reliable(64, SOON_S))
    peer = start_cpp("cpp", "publish", "/scan", 100, 8)
    assert [scans.recv(SOON_S).stamp_ns for _ in range(100)] == list(range(100))
    assert tcp_key_of(python_node) != ""
    peer.end()


def test_a_stranger_is_told_nothing(start_cpp, python_node, caplog, places):
    key = load_keys(places["stranger"]).public
    process = start_cpp("stranger", "count", "/scan", "reliable", 0, 0)
    try:
        assert wait_for(lambda: f"refused key {key}" in caplog.text)
    finally:
        process.kill()
        process.communicate()
    assert [node.name for node in python_node.nodes()] == [python_node.name]


def test_a_stranger_cannot_read_cpp(start_cpp, python_node, places, make_node):
    """A key that the list no longer has: the publisher's process says whom it has refused."""
    peer = start_cpp("cpp", "echo")
    authorize(places["stranger"], tcp_key_of(python_node))
    stranger = make_node(listen="127.0.0.1", keys=load_keys(places["stranger"]))
    scans = stranger.subscriber("/from_cpp", Rich)
    with pytest.raises(TimeoutError):
        scans.recv(1.0)
    assert f"refused key {load_keys(places['stranger']).public}" in peer.end()


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (lambda place: (place / "key.secret").chmod(0o644), "key.secret is open to others"),
        (lambda place: (place / "key.secret").unlink(), "cannot read"),
        (lambda place: (place / "key.public").write_text("no key"), "40 characters of Z85"),
        (lambda place: (place / "key.public").write_text("0" * 40), "does not belong"),
        (lambda place: (place / AUTHORIZED_FILE).write_text("rubbish"), "must hold keys and comments"),
    ],
)
def test_bad_keys_are_refused(start_cpp, places, damage, said):
    damage(places["cpp"])
    with pytest.raises(AssertionError, match=said):
        start_cpp("cpp", "count", "/scan", "reliable", 0, 0)
