"""A policy as a Cortex node: odometry and events in, thrust and body rates out, also from and to ROS 2."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from cortex import Closed, Node, synchronised
from cortex.messages import Events, Odometry, RateThrustCommand
from neurosim_core.install import check_cortex
from neurosim_core.learn.pilot import CAMERA, Pilot, card_airframe
from neurosim_core.signals import raise_at_signals

check_cortex()


def deploy(
    policy: str | Path,
    *,
    vehicle: str = "drone",
    events: str = CAMERA,
    duration_s: float | None = None,
    ros: str | None = None,
    max_thrust_n: float | None = None,
    say: Callable[[str], None] = print,
) -> int:
    """Fly a vehicle by a policy until it is interrupted; in lockstep it answers every odometry.

    The rates of odometry and events must be that of the policy (`neurosim deploy --print-config`). `policy`:
    `policy.onnx` of a run. `duration_s`: stop after so much simulated time [s]; None: never. `ros`: the
    vehicle is in ROS 2: nav_msgs/Odometry and event_camera_msgs/EventPacket come in from topics of these
    names, mavros_msgs/AttitudeTarget goes out, through a bridge that is started, with the backend auto, rclpy
    or dds. `max_thrust_n`: what a thrust of 1 in AttitudeTarget is [N]; None: all that the vehicle has which
    the policy was trained with.
    """
    pilot = Pilot(policy)
    with contextlib.ExitStack() as stack:
        raise_again = stack.enter_context(raise_at_signals())
        domain = None if ros is None else _BRIDGED_DOMAIN
        node = stack.enter_context(Node("policy", domain=domain))
        if ros is not None:
            thrust_n = max_thrust_n or card_airframe(pilot.card).thrust_max_n
            rate_hz = float(pilot.card["rate_hz"])
            bridge = _bridge(node, ros, rate_hz=rate_hz, events=f"/{vehicle}/{events}", max_thrust_n=thrust_n)
            stack.enter_context(bridge)
        commands = node.publisher(f"/{vehicle}/command/rates", RateThrustCommand)
        last_ns, count = -1, 0
        times_s: deque[float] = deque(maxlen=10_000)  # the newest
        try:
            say(f"waiting for {vehicle}")
            for state, new in synchronised(
                node,
                (f"/{vehicle}/odometry", Odometry),
                events=(f"/{vehicle}/{events}", Events, float(pilot.card["rate_hz"])),
            ):
                raise_again()
                if state.stamp_ns < last_ns or count == 0:
                    pilot.reset()
                    say(f"flying {vehicle} by {policy} ({pilot.card['task']})")
                if state.stamp_ns != last_ns:  # else it is sent again
                    begin_s = time.perf_counter()
                    parts = [(e.t, e.x, e.y, e.polarity) for e in new["events"]]
                    columns = [np.concatenate(part) for part in zip(*parts, strict=True)]
                    command = pilot.act(
                        *(columns or [np.empty(0)] * 4),
                        stamp_ns=state.stamp_ns,
                        orientation=state.orientation,
                        body_rate=state.body_rate,
                    )
                    times_s.append(time.perf_counter() - begin_s)
                    last_ns = state.stamp_ns
                commands.publish(
                    RateThrustCommand(
                        stamp_ns=state.stamp_ns,
                        thrust_n=command.thrust_n,
                        body_rate=command.body_rate,
                        sequence=count,
                    )
                )
                count += 1
                if duration_s is not None and state.stamp_ns >= 1e9 * duration_s:
                    break
        except (Closed, KeyboardInterrupt):
            pass
    latency = f"; each took {1e3 * np.median(times_s):.2f} ms (median) of computing" if times_s else ""
    say(f"{count} commands{latency}")
    return 0


_BRIDGED_DOMAIN = 1 + os.getpid() % 200
"""Domain of Cortex of a policy and its own bridge: a simulator in another one reaches them by ROS only."""


@contextlib.contextmanager
def _bridge(node: Node, backend: str, *, rate_hz: float, events: str, max_thrust_n: float) -> Iterator[None]:
    """Run a bridge to a vehicle in ROS; the node is closed if it ends by itself."""
    parameters = {
        "backend": backend,
        "cortex_domain": node.domain,
        "node": "policy",
        "robot": True,
        "routes.events.cortex": events,
        "routes.events.options.packet_rate_hz": rate_hz,
        "routes.thrust.cortex": "*/command/rates",
        "routes.thrust.options.max_thrust_n": max_thrust_n,
    }
    words = [word for name, value in parameters.items() for word in ("-p", f"{name}:={json.dumps(value)}")]
    command = [sys.executable, "-m", "cortex_ros2_bridge", "--ros-args", *words]
    bridge = subprocess.Popen(command, stdout=subprocess.DEVNULL)

    def close_at_end() -> None:
        bridge.wait()
        node.close()

    threading.Thread(target=close_at_end, daemon=True).start()
    try:
        yield
        if bridge.poll() is not None:
            raise RuntimeError(f"the bridge to ROS 2 ended with status {bridge.returncode}")
    finally:
        with contextlib.suppress(ProcessLookupError):
            bridge.send_signal(signal.SIGINT)
        bridge.wait()
