"""A policy as a Cortex node: odometry and events in, thrust and body rates out."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from cortex import Closed, Node, synchronised
from cortex.messages import Events, Odometry, RateThrustCommand
from neurosim_core.install import check_cortex
from neurosim_core.learn.pilot import CAMERA, Pilot

check_cortex()


def deploy(
    policy: str | Path,
    *,
    vehicle: str = "drone",
    events: str = CAMERA,
    duration_s: float | None = None,
    say: Callable[[str], None] = print,
) -> int:
    """Fly a vehicle by a policy until its simulator ends; in lockstep it answers every odometry.

    The rates of odometry and events must be that of the policy (`neurosim deploy --print-config`).

    Args:
        policy: `policy.onnx` of a run.
        vehicle: Name of the vehicle.
        events: Name of its event camera.
        duration_s: Stop after so much simulated time [s]; None: never.
        say: Told what happens, line by line.

    Returns:
        0.

    Raises:
        TimeoutError: Events that are due have not come.
        ValueError: The file is no policy, or the rate of the events is another.
    """
    pilot = Pilot(policy)
    with Node("policy") as node:
        commands = node.publisher(f"/{vehicle}/command/rates", RateThrustCommand)
        last_ns, count = -1, 0
        try:
            say(f"waiting for {vehicle}")
            for state, new in synchronised(
                node,
                (f"/{vehicle}/odometry", Odometry),
                events=(f"/{vehicle}/{events}", Events, float(pilot.card["rate_hz"])),
            ):
                if state.stamp_ns < last_ns or count == 0:
                    pilot.reset()
                    say(f"flying {vehicle} by {policy} ({pilot.card['task']})")
                if state.stamp_ns != last_ns:  # else it is sent again
                    parts = [(e.t, e.x, e.y, e.polarity) for e in new["events"]]
                    columns = [np.concatenate(part) for part in zip(*parts, strict=True)]
                    command = pilot.act(
                        *(columns or [np.empty(0)] * 4),
                        stamp_ns=state.stamp_ns,
                        orientation=state.orientation,
                        body_rate=state.body_rate,
                    )
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
        except Closed:
            pass
    say(f"{count} commands")
    return 0
