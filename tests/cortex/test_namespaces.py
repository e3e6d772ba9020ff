"""Two hosts: network namespaces with a cable between them, a registry in one, CURVE on tcp."""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from cable import ADDRESSES, DEVICE, ip, two_hosts
from processes import ROOT, SOON_S, Child, Lines

from cortex.security import AUTHORIZED_FILE, new_keys


@pytest.fixture(scope="module")
def hosts():
    """The names of two network namespaces with a cable between them."""
    with two_hosts() as names:
        yield names


@pytest.fixture
def place():
    """A short path, for sockets lie below it."""
    path = Path(tempfile.mkdtemp(prefix="cortex-test-"))
    yield path
    shutil.rmtree(path)


class Process(Lines):
    """A program on one of the hosts; each host has a runtime directory of its own."""

    def __init__(self, host: str, place: Path, *arguments: str, prefix: Sequence[str] = (), **more: str):
        own = {"PYTHONPATH": str(ROOT), "CORTEX_RUNTIME_DIR": str(place / host), "PYTHONUNBUFFERED": "1"}
        pipes = {
            "stdin": subprocess.PIPE,
            "stdout": subprocess.PIPE,
            "stderr": subprocess.STDOUT,
            "bufsize": 0,
        }
        command = ["ip", "netns", "exec", host, *prefix, sys.executable, *arguments]
        super().__init__(subprocess.Popen(command, env=os.environ | own | more, **pipes), host)

    def read(self, pattern: str, timeout_s: float = SOON_S) -> re.Match[str]:
        """The next line that matches."""
        deadline_s, said = time.monotonic() + timeout_s, []
        while (match := re.search(pattern, (said or [""])[-1])) is None:
            assert self.has_line(deadline_s - time.monotonic()), said
            said.append(self.line())
        return match

    def close(self) -> None:
        self.process.stdin.close()
        for end, within_s in (
            (lambda: None, 0.5),
            (self.process.terminate, SOON_S),
            (self.process.kill, SOON_S),
        ):
            end()
            with contextlib.suppress(subprocess.TimeoutExpired):
                self.process.wait(within_s)
                break
        self.process.stdout.close()


@pytest.fixture
def keyring(place) -> dict[str, str]:
    """Directories with keys: of the registry, of a node that it knows, and of one that it does not."""
    made = {name: new_keys(place / name) for name in ("registry", "friend", "stranger")}
    for name, line in (
        ("registry", made["friend"].public),
        *((name, f"{made['registry'].public} {ADDRESSES[0]}") for name in ("friend", "stranger")),
    ):
        (place / name / AUTHORIZED_FILE).write_text(line + "\n")
    return {name: str(place / name) for name in made}


@pytest.fixture
def start(place):
    with contextlib.ExitStack() as stack:

        def start_process(host, *arguments, **options):
            process = Process(host, place, *arguments, **options)
            stack.callback(process.close)
            return process

        yield start_process


def serve(start, keyring, host: str, port: str = "0") -> tuple[Process, str]:
    """A registry, and the port at which it is found."""
    options = ("--listen", f"tcp://0.0.0.0:{port}", "--keys", keyring["registry"])
    registry = start(host, "-m", "cortex.discovery", *options)
    return registry, registry.read(r"serves .*tcp://[0-9.]+:([0-9]+)")[1]


@pytest.fixture
def node(start_child, place):
    def start_node(host: str, name: str, **options: object) -> Child:
        there = {"prefix": ["ip", "netns", "exec", host], "env": {"CORTEX_RUNTIME_DIR": str(place / host)}}
        return start_child("peer", name=name, **there, **options)

    return start_node


def sees(child: Child, *names: str, timeout_s: float = SOON_S, always: Sequence[str] = ()) -> bool:
    """Whether a node comes to know these, itself among them, and no others, some of them always."""
    deadline_s = time.monotonic() + timeout_s
    while (found := child.ask(do="nodes")["names"]) != sorted(names):
        assert set(always) <= set(found)
        if time.monotonic() > deadline_s:
            return False
        time.sleep(2e-3)
    return True


def test_nodes_of_two_hosts_see_each_other_through_one_registry(hosts, start, node, keyring):
    _, port = serve(start, keyring, hosts[0])
    near = node(hosts[0], "near")
    far = node(hosts[1], "far", registry=f"tcp://{ADDRESSES[0]}:{port}", keys=keyring["friend"])
    assert sees(near, "near", "far")
    assert sees(far, "near", "far")
    # The cable is pulled: the far node's lease runs out here, but it forgets nobody itself.
    ip("-n", hosts[1], "link", "set", DEVICE, "down")
    assert sees(near, "near", always=["near"])
    assert not sees(far, "far", timeout_s=1.5)
    ip("-n", hosts[1], "link", "set", DEVICE, "up")
    assert sees(near, "near", "far")
    far.kill()
    assert sees(near, "near")


def test_a_registry_on_another_host_that_is_killed_and_comes_back(hosts, start, node, keyring):
    first, port = serve(start, keyring, hosts[0])
    place = {"registry": f"tcp://{ADDRESSES[0]}:{port}", "keys": keyring["friend"]}
    far = [node(hosts[1], f"far {k}", **place) for k in range(2)]
    assert all(sees(each, "far 0", "far 1") for each in far)
    first.process.kill()
    first.process.wait()
    serve(start, keyring, hosts[0], port)
    late = node(hosts[1], "late", **place)
    assert sees(far[0], "far 0", "far 1", "late", always=["far 1"])  # it was never forgotten
    assert sees(late, "far 0", "far 1", "late")


@pytest.mark.parametrize("keys", ["stranger", None])
def test_a_stranger_sees_nobody_and_is_seen_by_nobody(hosts, start, node, keyring, keys):
    registry, port = serve(start, keyring, hosts[0])
    address = f"tcp://{ADDRESSES[0]}:{port}"
    near = node(hosts[0], "near")
    options = {"keys": keyring[keys]} if keys else {"insecure": True}
    stranger = node(hosts[1], "stranger", registry=address, **options)
    friend = node(hosts[1], "friend", registry=address, keys=keyring["friend"])
    assert sees(friend, "friend", "near")
    assert not sees(stranger, "friend", "near", "stranger", timeout_s=1.5)
    assert stranger.ask(do="nodes") == {"names": ["stranger"], "connected": False}
    assert sees(near, "friend", "near")
    assert sees(friend, "friend", "near")
    if keys:
        registry.read("refused key")


DELAY_S, JITTER_S = 0.02, 0.003
HOUR_S = 3600
ROBOT = """
import json, time
import numpy as np
from cortex import Node, reliable
from cortex.messages import Image, VelocityCommand

node = Node("robot")
images = node.publisher("/front/image", Image, max_wait_s=2.0)
commands = node.subscriber("/command", VelocityCommand, policy=reliable(8, 2.0))
assert images.wait_for_subscribers(timeout_s=60.0) and commands.wait_for_publisher(60.0)
pixels = np.zeros((100, 100, 1), np.uint8)
loops, ways = [], []
for index in range(150):
    images.publish(Image(stamp_ns=node.now_ns(), data=pixels, encoding="mono8", frame_id="front"))
    begin_ns = time.monotonic_ns()
    command, info = commands.recv_with_info(30.0)
    loops.append(time.monotonic_ns() - begin_ns)
    ways.append(info.latency_ns)
images.close()
print("robot", json.dumps([loops, ways, commands.counters.lost, images.counters.timeouts]))
"""
CONTROLLER = """
import json, sys, time
import numpy as np
real = time.time_ns
time.time_ns = lambda: real() - 3 * 10**9
from cortex import Node, reliable
from cortex.messages import Image, VelocityCommand

node = Node("controller")
images = node.subscriber("/front/image", Image, policy=reliable(8, 2.0))
commands = node.publisher("/command", VelocityCommand, max_wait_s=2.0)
assert node.wait_for_registry(60.0)
while node.clock() is None:
    time.sleep(0.1)
ages, ways = [], []
while len(ages) < 150:
    image, info = images.recv_with_info(60.0)
    ages.append(node.now_ns() - image.stamp_ns)
    ways.append(info.latency_ns)
    commands.publish(VelocityCommand(stamp_ns=image.stamp_ns, velocity=np.zeros(3)))
time.sleep(1.0)
print("controller", json.dumps([ages, ways, images.counters.lost, list(node.clock())]))
sys.stdin.read()
"""


def test_a_closed_loop_over_a_bad_link_between_hosts_whose_clocks_differ(start, keyring):
    """150 pictures and commands at 20 ms, 3 ms of jitter and 1 % loss each way, CURVE; one host lags by 3 s.

    Nothing is lost, and what either side says of one way is half of the loop, which needs no clock but one.
    """
    with two_hosts(delay_s=DELAY_S, jitter_s=JITTER_S, loss=0.01) as hosts:
        _, port = serve(start, keyring, hosts[0])
        address = {"CORTEX_REGISTRY": f"tcp://{ADDRESSES[0]}:{port}", "CORTEX_KEYS": keyring["friend"]}
        shifted = ("unshare", "--time", "--monotonic", str(HOUR_S))
        near, far = (
            start(host, "-c", code, prefix=prefix, CORTEX_LISTEN=listen, **address)
            for host, code, prefix, listen in zip(
                hosts, (ROBOT, CONTROLLER), ((), shifted), ADDRESSES, strict=True
            )
        )
        doctor = start(hosts[1], "-m", "cortex", "doctor", **address)
        told = [json.loads(each.read(r"(?:robot|controller) (\[.*)", 120.0)[1]) for each in (near, far)]
        doctor.read(r"ok     clock: [0-9.]+ [mun]s (ahead of|behind) the registry's")
    (loops, commands, *counted), (ages, images, lost, (ahead_ns, error_ns)) = told
    assert [*counted, lost] == [0, 0, 0]
    loop_ns, command_ns, age_ns, image_ns = (
        float(np.median(each)) for each in (loops, commands, ages, images)
    )
    assert image_ns == pytest.approx(DELAY_S * 1e9, abs=8e6)
    assert command_ns == pytest.approx(DELAY_S * 1e9, abs=8e6)
    assert age_ns == pytest.approx(image_ns, abs=3e6)
    assert image_ns + command_ns == pytest.approx(loop_ns, abs=3e6)
    assert ahead_ns == pytest.approx(-3e9, abs=8e6)
    assert error_ns == pytest.approx(DELAY_S * 1e9, abs=10e6)
