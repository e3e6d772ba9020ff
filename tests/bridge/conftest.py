"""Fixtures for tests of the bridge: a runtime directory of Cortex and a DDS domain, for the test alone."""

from __future__ import annotations

import os
import random
import threading
import uuid
from collections.abc import Callable, Iterator

import pytest
from foreigners import Foreigner
from processes import processes_with, wait_for
from runtime_directory import runtime

# Classes of ROS since Jazzy check what they are given only then.
os.environ["ROS_PYTHON_CHECK_FIELDS"] = "1"

__all__ = ["dds_domain", "foreigner", "runtime", "short_lease"]

# `lo` has no multicast, so processes find each other by the ports of 127.0.0.1. The tag keeps apart what has
# the same number of domain by accident.
_CONFIG = """<CycloneDDS><Domain>
  <General>
    <Interfaces><NetworkInterface address="127.0.0.1"/></Interfaces>
    <AllowMulticast>false</AllowMulticast>
  </General>
  <Discovery>
    <ParticipantIndex>auto</ParticipantIndex>
    <MaxAutoParticipantIndex>32</MaxAutoParticipantIndex>
    <Peers><Peer address="127.0.0.1"/></Peers>
    <Tag>{tag}</Tag>
  </Discovery>
</Domain></CycloneDDS>"""


@pytest.fixture
def dds_domain(monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    """The number of a DDS domain on loopback that nobody else is in; processes of the test inherit it.

    Afterwards no process and no thread of the test may be left.
    """
    number, tag = random.randrange(1, 102), f"test-{uuid.uuid4().hex}"
    for name in ("ROS_DISTRO", "ROS_LOCALHOST_ONLY", "ROS_AUTOMATIC_DISCOVERY_RANGE", "ROS_STATIC_PEERS"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("ROS_DOMAIN_ID", str(number))
    monkeypatch.setenv("CYCLONEDDS_URI", _CONFIG.format(tag=tag))
    threads = set(threading.enumerate())
    yield number
    wait_for(lambda: not processes_with(tag))
    wait_for(lambda: not set(threading.enumerate()) - threads)


@pytest.fixture
def short_lease(dds_domain: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Processes that are killed are missed after a second instead of ten, by those that start after this."""
    lease = "<Discovery><LeaseDuration>1 s</LeaseDuration></Discovery>"
    config = os.environ["CYCLONEDDS_URI"]
    monkeypatch.setenv("CYCLONEDDS_URI", f"{config},<CycloneDDS><Domain>{lease}</Domain></CycloneDDS>")


@pytest.fixture
def foreigner(dds_domain: int) -> Iterator[Callable[..., Foreigner]]:
    """A function that starts processes which speak DDS without our code, in the domain of the test."""
    started: list[Foreigner] = []

    def start(**environment: str) -> Foreigner:
        started.append(Foreigner(dds_domain, **environment))
        return started[-1]

    yield start
    for process in started:
        process.end()


def pytest_configure(config: pytest.Config) -> None:
    """Let rclpy do what it does at import: its `lark` imports modules that Python 3.11 deprecates."""
    config.addinivalue_line("filterwarnings", "ignore:module 'sre_:DeprecationWarning")
