"""The simulator on one host, the controller on another: a flight in lockstep over a slow, lossy link."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import tempfile
from pathlib import Path

from cable import ADDRESSES, two_hosts
from processes import ROOT

from cortex.security import AUTHORIZED_FILE, new_keys

PROGRAM = "import sys; from neurosim_core.cli import main; sys.exit(main())"
STARTED_S = 120.0


def test_a_flight_in_lockstep_whose_controller_is_on_another_host():
    """40 control periods at 5 ms each way, 1 ms of jitter and 1 % loss, with CURVE: none is missing."""
    with contextlib.ExitStack() as stack:
        place = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="cx-")))
        keys = new_keys(place / "keys")
        (place / "keys" / AUTHORIZED_FILE).write_text(f"{keys.public} {ADDRESSES[0]}\n")
        hosts = stack.enter_context(two_hosts(delay_s=0.005, jitter_s=0.001, loss=0.01))
        registry = f"tcp://{ADDRESSES[0]}:7460"
        started: list[subprocess.Popen[bytes]] = []

        def run(index: int, *arguments: str) -> subprocess.Popen[bytes]:
            environment = {
                **os.environ,
                "PYTHONPATH": str(ROOT),
                "CORTEX_RUNTIME_DIR": str(place / str(index)),
                "CORTEX_REGISTRY": registry,
                "CORTEX_LISTEN": ADDRESSES[index],
                "CORTEX_KEYS": str(place / "keys"),
            }
            command = ["ip", "netns", "exec", hosts[index], sys.executable, *arguments]
            output = stack.enter_context(open(place / f"output-{len(started)}", "w"))
            process = subprocess.Popen(command, env=environment, stdout=output, stderr=subprocess.STDOUT)
            started.append(process)
            stack.callback(process.wait)
            stack.callback(process.kill)
            return process

        run(0, "-m", "cortex.discovery", "--listen", registry, "--keys", str(place / "keys"))
        simulator = run(0, "-c", PROGRAM, "serve", "--lockstep", "--device", "cpu", "--duration", "0.2")
        controller = run(1, "-c", PROGRAM, "fly")
        statuses = []
        for process in (simulator, controller):
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(STARTED_S)
            statuses.append(process.poll())
        said = [(place / f"output-{index}").read_text() for index in range(3)]
        assert statuses == [0, 0], said
        assert "lockstep, 0.200 s, 40 control periods" in said[1]
