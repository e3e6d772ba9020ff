"""Fly the path with your own controller, named in the settings: it commands a velocity towards the path.

It prints its average distance from the path, and that of the geometric controller. To install such a
controller as a package, name its module in an entry point of the group `neurosim.plugins`; `neurosim run`,
`serve` and `fly` then find it.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

import neurosim_core as ns


@ns.register("controller", "pursuit")
class PursuitConfig(ns.control.ControllerConfig):
    """A velocity that closes in on the path; the geometric controller below turns it into rotor speeds."""

    kind: Literal["pursuit"] = "pursuit"
    closing_per_s: Annotated[float, Field(gt=0.0, le=20.0)] = 2.0
    """Speed towards the path, for each metre away from it [1/s]."""

    def make(self, context: ns.control.ControllerContext) -> PursuitController:
        """Return the controller of all worlds."""
        return PursuitController(self, context)


class PursuitController(ns.control.HostController):
    """Computed in Python, one world after the other."""

    def __init__(self, config: PursuitConfig, context: ns.control.ControllerContext) -> None:
        super().__init__(context, config.gains)
        self._closing_per_s = config.closing_per_s

    def command(self, state: Any, target: Any, *, stamp_ns: int, world: int) -> ns.Velocity:
        """Return the velocity of the path, and what brings the vehicle back to it."""
        back = self._closing_per_s * (target["position"] - state.position)
        return ns.Velocity(velocity_m_s=target["velocity"] + back, yaw_rate_rad_s=float(target["yaw_rate"]))


def error_m(control: dict[str, Any]) -> float:
    """Fly a circle; return how far from it the vehicle is on average [m]."""
    config = ns.load_config(
        {
            "device": "cpu",
            "duration_s": 3.0,
            "scene": {"rooms": 1},
            "path": {"kind": "circle"},
            "control": control,
            "sensors": {"odometry": {"kind": "odometry", "rate_hz": 100.0}},
        }
    )
    model = ns.make_model(config)
    states = [
        packet for packet in ns.run_model(model, ns.make_state(model)) if isinstance(packet, ns.Odometry)
    ]
    planned = model.path.evaluate([state.stamp_ns for state in states]).position
    return float(np.linalg.norm(planned - [state.position for state in states], axis=1).mean())


def main() -> tuple[float, float]:
    """Return the mean errors of the pursuit and of the geometric controller [m]."""
    pursuit_m, geometric_m = error_m({"kind": "pursuit"}), error_m({"kind": "se3"})
    print(f"pursuit: {100.0 * pursuit_m:.1f} cm from the path, geometric: {100.0 * geometric_m:.1f} cm")
    return pursuit_m, geometric_m


if __name__ == "__main__":
    main()
