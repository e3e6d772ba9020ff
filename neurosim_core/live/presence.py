"""Whether a simulator runs already in the domain of a node: two would fly each other's vehicles."""

from __future__ import annotations

import os
import time

from cortex import Node
from cortex.records import NodeRecord
from neurosim_core.live.topics import SIMULATION

LOOK_S = 0.3
"""How long the records of other nodes take to come [s], generously."""
GONE_S = 2.0
"""After this a node of another host that died is forgotten [s]."""


def refuse_second(node: Node) -> None:
    """Check that no other node of the domain simulates.

    Args:
        node: One that does not publish yet.

    Raises:
        RuntimeError: There is one.
    """
    node.wait_for_registry(1.0)
    began_s = time.monotonic()
    while (waited_s := time.monotonic() - began_s) < GONE_S:
        others = [record for record in node.nodes() if record.node != node.id and _simulates(record)]
        here = [record for record in others if record.host == _host(node)]
        alive = [record for record in here if _lives(record.pid)]
        if alive:
            raise RuntimeError(
                f"a simulator runs in domain {node.domain} already (process {alive[0].pid}): end it, or set "
                "CORTEX_DOMAIN to another number for all that belongs together"
            )
        if len(others) == len(here) and waited_s > LOOK_S:
            return
        time.sleep(0.02)
    raise RuntimeError(
        f"a simulator of another host runs in domain {node.domain} already: set CORTEX_DOMAIN to another one"
    )


def _simulates(record: NodeRecord) -> bool:
    return any(publisher.topic == SIMULATION for publisher in record.publishers)


def _host(node: Node) -> str:
    return next(record.host for record in node.nodes() if record.node == node.id)


def _lives(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        pass
    return True
