"""A process with one directory: prints a line of JSON for each change. Run by the tests of discovery.

Its argument is JSON: name, domain, registry, keys (a directory), insecure, and node (a
number). It ends when its input closes.
"""

from __future__ import annotations

import json
import os
import secrets
import sys
import time
from pathlib import Path

import zmq

from cortex.discovery import Directory
from cortex.host import NodeFiles, host_id
from cortex.records import NodeRecord
from cortex.security import load_keys


def main() -> None:
    options = json.loads(sys.argv[1])
    domain = options.get("domain", 0)
    node = options.get("node") or secrets.randbits(64) | 1
    files = NodeFiles(domain, node)
    context = zmq.Context()
    control = context.socket(zmq.ROUTER)
    control.bind(files.endpoint("control"))
    record = NodeRecord(node, options["name"], host_id(), os.getpid(), 1, 0, [], [], [], [])
    directory = Directory(
        context,
        domain=domain,
        record=lambda: record,
        registry=options.get("registry", "auto"),
        keys=load_keys(Path(options["keys"])) if options.get("keys") else None,
        insecure=options.get("insecure", False),
    )
    poller = zmq.Poller()
    if directory.socket is not None:
        poller.register(directory.socket, zmq.POLLIN)
    poller.register(sys.stdin.fileno(), zmq.POLLIN)
    shown = None
    while True:
        wait_ms = max((directory.deadline_ns - time.monotonic_ns()) // 1_000_000, 0) + 1
        for socket, _ in poller.poll(wait_ms):
            if socket == sys.stdin.fileno():  # closed: the test is over
                directory.close()
                control.close()
                context.term()
                files.close()
                return
            directory.handle()
        directory.tick()
        seen = {
            "connected": directory.connected,
            "names": sorted(record.name for record in directory.nodes.values()),
        }
        if seen != shown:
            shown = seen
            print(json.dumps({**seen, "at_ns": time.monotonic_ns()}), flush=True)


if __name__ == "__main__":
    main()
