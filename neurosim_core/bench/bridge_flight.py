"""Closed loop through DDS: how well a foreign controller flies through the ROS 2 bridge, against one without.

`python -m neurosim_core.bench.bridge_flight` prints a line of JSON for each flight.
A simulator, the bridge and a controller that only speaks DDS are three processes. The controller in the
simulator's process has the same law and the same rate.
"""

from __future__ import annotations

import contextlib
import json
import os
import secrets
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

import yaml

from neurosim_core.bench.bridge_laws import (
    DURATION_S,
    MAX_THRUST_N,
    Errors,
    flight_config,
    make_law,
    settings_of,
)
from neurosim_core.sim.model import Model, make_fleet
from neurosim_core.sim.rollout import observe, step
from neurosim_core.sim.state import make_state

MODES: tuple[Literal["attitude", "motor_speeds"], ...] = ("attitude", "motor_speeds")
LIVE_MODES = ("lockstep", "streaming")
LIMIT_S = 120.0
"""Longest time of the flights of one process; they take ten seconds on a machine that does nothing else."""
LOOPBACK = (
    "<CycloneDDS><Domain id='any'><General><Interfaces><NetworkInterface name='lo' multicast='false'/>"
    "</Interfaces><AllowMulticast>false</AllowMulticast></General><Discovery>"
    "<ParticipantIndex>auto</ParticipantIndex><Peers><Peer address='127.0.0.1'/></Peers></Discovery></Domain>"
    "</CycloneDDS>"
)
_BRIDGE = {
    "namespace": "/sim",
    "routes": [
        {"cortex": "*", "type": "mavros_msgs/msg/AttitudeTarget", "options": {"max_thrust_n": MAX_THRUST_N}}
    ],
}


@dataclass(frozen=True, kw_only=True)
class Flight:
    """One figure eight."""

    live_mode: str
    """lockstep or streaming."""
    mode: str
    """Of the commands."""
    rms_m: float
    """Distance from the path, through the bridge [m]."""
    in_process_rms_m: float
    """The same without any of it [m]."""
    count: int
    """States that the controller answered."""

    @property
    def ratio(self) -> float:
        """Error through the bridge over that without."""
        return self.rms_m / self.in_process_rms_m


def measure_flights(live_mode: str, *, domain: int) -> list[Flight]:
    """Fly with each mode of commands through simulator, bridge and DDS.

    Args:
        live_mode: lockstep or streaming.
        domain: DDS domain. The environment says how it is found, and where Cortex is.

    Raises:
        RuntimeError: A process ended early or not at all.
    """
    (model,) = make_fleet(flight_config(live_mode)).values()
    expected = [fly_in_process(model, mode) for mode in MODES]
    with tempfile.TemporaryDirectory(prefix="ctx-") as folder:
        scene, bridge = Path(folder, "scene.yaml"), Path(folder, "bridge.yaml")
        scene.write_text(yaml.safe_dump(settings_of(live_mode)), encoding="utf-8")
        bridge.write_text(yaml.safe_dump(_BRIDGE), encoding="utf-8")
        with (
            _process("neurosim_core", "serve", str(scene)) as simulator,
            _process("cortex_ros2_bridge", "--backend", "dds", "--config", str(bridge)) as bridging,
            _process("neurosim_core.bench.bridge_controller", str(domain), live_mode, *MODES) as controller,
        ):
            try:
                out, complaints = controller.communicate(timeout=LIMIT_S)
            except subprocess.TimeoutExpired:
                said = [_end(process) for process in (controller, simulator, bridging)]
                raise RuntimeError(f"the flight did not end: {said}") from None
    if controller.returncode:
        raise RuntimeError(f"the controller has failed: {complaints}")
    flown = [json.loads(line) for line in out.splitlines()]
    return [
        Flight(
            live_mode=live_mode,
            mode=each["mode"],
            rms_m=each["rms_m"],
            in_process_rms_m=rms_m,
            count=each["count"],
        )
        for each, rms_m in zip(flown, expected, strict=True)
    ]


def fly_in_process(model: Model, mode: Literal["attitude", "motor_speeds"]) -> float:
    """Fly the same figure eight with the same law, and without anybody else; return the error [m]."""
    state = make_state(model)
    law, errors = make_law(mode, model.config, model.path), Errors(model.path)
    end_ns = round(DURATION_S * 1e9)
    while True:
        now = observe(state)
        errors.add(now.stamp_ns, now.position)
        if now.stamp_ns >= end_ns:
            return errors.rms_m
        row = law(
            stamp_ns=now.stamp_ns,
            position=now.position,
            velocity=now.velocity,
            orientation=now.orientation,
            body_rate=now.body_rate,
            rotor_speed=now.rotor_speed,
        )
        step(model, state, row, mode=mode)


@contextlib.contextmanager
def _process(module: str, *arguments: str) -> Iterator[subprocess.Popen[str]]:
    process = subprocess.Popen(
        [sys.executable, "-m", module, *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        yield process
    finally:
        _end(process)


def _end(process: subprocess.Popen[str]) -> str:
    """Interrupt a process, if it still runs; return what it said on standard error."""
    if process.returncode is not None:
        return ""
    if process.poll() is None:
        process.send_signal(signal.SIGINT)
    try:
        return process.communicate(timeout=10.0)[1]
    except subprocess.TimeoutExpired:
        process.kill()
        return process.communicate()[1]


def main(arguments: Sequence[str] | None = None) -> int:
    """Fly in a domain and a runtime directory of its own; print a line of JSON for each flight."""
    live_modes = list(sys.argv[1:] if arguments is None else arguments) or list(LIVE_MODES)
    domain = 1 + secrets.randbelow(100)
    with tempfile.TemporaryDirectory(prefix="ctx-") as folder:
        os.environ.setdefault("CYCLONEDDS_URI", LOOPBACK)
        os.environ |= {"CORTEX_RUNTIME_DIR": folder, "ROS_DOMAIN_ID": str(domain)}
        for live_mode in live_modes:
            for flight in measure_flights(live_mode, domain=domain):
                print(json.dumps(asdict(flight)), flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
