"""Two simulators in one domain would fly each other's vehicles: the second is refused."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest
from processes import wait_for

from cortex import Node
from cortex.messages import Simulation
from neurosim_core.live.presence import refuse_second
from neurosim_core.live.topics import SIMULATION

ANNOUNCE = """
import sys
from cortex import Node
from cortex.messages import Simulation
node = Node("simulator")
node.publisher("/simulation", Simulation, latch=True)
print("ready", flush=True)
sys.stdin.read()
"""


def test_a_node_alone_may_simulate(runtime):
    with Node("other") as other, Node("simulator") as node:
        other.subscriber(SIMULATION, Simulation)  # a viewer that waits is no simulator
        refuse_second(node)


def test_a_second_simulator_is_refused_until_the_first_is_gone(runtime):
    """Also one that was killed a moment ago, which the registry still knows, is gone."""
    first = subprocess.Popen(
        [sys.executable, "-c", ANNOUNCE], stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=os.environ
    )
    assert first.stdin is not None
    assert first.stdout is not None
    try:
        assert first.stdout.readline() == b"ready\n"
        with Node("simulator") as node:
            wait_for(lambda: any(record.pid == first.pid for record in node.nodes()))
            with pytest.raises(
                RuntimeError, match=rf"domain 0 already \(process {first.pid}\).*CORTEX_DOMAIN"
            ):
                refuse_second(node)
            first.kill()
            first.wait()
            refuse_second(node)
    finally:
        first.kill()
        first.wait()
        first.stdin.close()
        first.stdout.close()
