"""Two hosts on one machine: network namespaces, and a cable between them with delay, jitter and loss.

The cable is a process that carries packets between two TUN devices, so that it needs no kernel with netem.
Like netem it delays each packet by a normal distribution and drops some; unlike it, it keeps their order.

    with two_hosts(delay_s=0.02, jitter_s=0.005, loss=0.01) as names:
        subprocess.run(["ip", "netns", "exec", names[0], "ping", "-c", "3", ADDRESSES[1]])
"""

from __future__ import annotations

import contextlib
import fcntl
import itertools
import os
import random
import select
import shutil
import struct
import subprocess
import sys
import time
from collections import deque
from collections.abc import Iterator
from pathlib import Path

import pytest

ADDRESSES = ("10.213.7.1", "10.213.7.2")
DEVICE = "cable"
_PACKET_MAX = 65536
_numbers = itertools.count()
_TUNSETIFF = 0x400454CA
_TUN_WITHOUT_HEADER = 0x1001


def ip(*arguments: str) -> None:
    """Run the command ip.

    Raises:
        OSError: It failed.
    """
    done = subprocess.run(["ip", *arguments], capture_output=True, text=True, timeout=300.0, check=False)
    if done.returncode:
        raise OSError(f"ip {' '.join(arguments)}: {done.stderr.strip()}")


@contextlib.contextmanager
def two_hosts(*, delay_s: float = 0.0, jitter_s: float = 0.0, loss: float = 0.0) -> Iterator[tuple[str, str]]:
    """Make two network namespaces with a cable between them, and return their names.

    Skips the test where that is not possible.

    Args:
        delay_s: Of each packet, one way.
        jitter_s: Standard deviation of that.
        loss: Share of the packets that are lost.
    """
    if shutil.which("ip") is None or os.getuid() != 0 or not Path("/dev/net/tun").exists():
        pytest.skip("network namespaces need root, the command ip (package iproute2) and /dev/net/tun")
    number = f"{os.getpid()}-{next(_numbers)}"
    names = (f"cortex-a-{number}", f"cortex-b-{number}")
    numbers = [str(each) for each in (delay_s, jitter_s, loss)]
    with contextlib.ExitStack() as stack:
        try:
            for name in names:
                ip("netns", "add", name)
                stack.callback(ip, "netns", "del", name)
            command = [sys.executable, __file__, *names, *numbers]
            relay = stack.enter_context(subprocess.Popen(command, stdout=subprocess.PIPE))
            stack.callback(relay.kill)
            if relay.stdout.readline() != b"ready\n":
                raise OSError("the cable did not start")
        except OSError as error:
            pytest.skip(f"cannot make network namespaces: {error}")
        yield names


def _open_device(name: str, address: str, peer: str) -> int:
    descriptor = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
    device = f"cx{os.getpid()}"
    fcntl.ioctl(descriptor, _TUNSETIFF, struct.pack("16sH22x", device.encode(), _TUN_WITHOUT_HEADER))
    ip("link", "set", device, "netns", name, "name", DEVICE, "mtu", "9000")
    ip("-n", name, "address", "add", address, "peer", peer, "dev", DEVICE)
    for each in (DEVICE, "lo"):
        ip("-n", name, "link", "set", each, "up")
    return descriptor


def _relay(names: list[str], delay_s: float, jitter_s: float, loss: float) -> None:
    ends = [_open_device(name, ADDRESSES[index], ADDRESSES[1 - index]) for index, name in enumerate(names)]
    waiting: list[deque[tuple[float, bytes]]] = [deque(), deque()]
    print("ready", flush=True)
    chance = random.Random(1)
    while True:
        due_s = min((queue[0][0] for queue in waiting if queue), default=time.monotonic() + 1.0)
        select.select(ends, [], [], max(due_s - time.monotonic(), 0.0))
        for end, queue in zip(ends, waiting, strict=True):
            with contextlib.suppress(BlockingIOError, OSError):  # empty, or pulled
                while packet := os.read(end, _PACKET_MAX):
                    if chance.random() >= loss:
                        at_s = time.monotonic() + max(chance.gauss(delay_s, jitter_s), 0.0)
                        queue.append((max(at_s, queue[-1][0] if queue else 0.0), packet))
        for end, queue in zip(reversed(ends), waiting, strict=True):
            while queue and queue[0][0] <= time.monotonic():
                with contextlib.suppress(OSError):  # full, or pulled: lost
                    os.write(end, queue.popleft()[1])


if __name__ == "__main__":
    _relay(sys.argv[1:3], *map(float, sys.argv[3:6]))
