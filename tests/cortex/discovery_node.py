"""A process with one directory: prints a line of JSON for each change. Run by the tests of discovery.

Its argument is JSON: name, domain, registry, peers, keys (a directory), insecure, node (a number), and listen
(a tcp address, else a unix socket) for its control socket. It ends when its input closes.
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
    control.bind(options.get("listen") or files.endpoint("control"))
    print(json.dumps({"control": control.getsockopt_string(zmq.LAST_ENDPOINT)}), flush=True)
    record = NodeRecord(node, options["name"], host_id(), os.getpid(), 1, 0, [], [], [], [])
    directory = Directory(
        context,
        domain=domain,
        record=lambda: record,
        registry=options.get("registry", "auto"),
        peers=options.get("peers", ()),
        keys=load_keys(Path(options["keys"])) if options.get("keys") else None,
        insecure=options.get("insecure", False),
    )
    poller = zmq.Poller()
    for socket in directory.sockets():
        poller.register(socket, zmq.POLLIN)
    poller.register(control, zmq.POLLIN)
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
            if socket is control:
                identity, frame = control.recv_multipart()
                answer = directory.answer(frame)
                if answer is not None:
                    control.send_multipart([identity, answer])
            else:
                directory.handle(socket)
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
