"""Fly with your own controller in the same process: climb by half a metre, and stay there.

Between two control periods, the controller has the exact state and all packets up to it.
"""

from __future__ import annotations

import numpy as np

import neurosim_core as ns


def main() -> float:
    """Return how far from the goal the flight ends [m]."""
    config = ns.load_config(
        {
            "device": "cpu",
            "scene": {"kind": "apartment", "rooms": 1},
            "control": {"rate_hz": 100.0},
            "sensors": {"imu": {"kind": "imu", "rate_hz": 200.0}},
        }
    )
    model = ns.make_model(config)
    state = ns.make_state(model)
    goal = ns.sim.observe(state).position + np.array([0.0, 0.0, 0.5])
    while state.stamp_ns < 4_000_000_000:
        away = goal - ns.sim.observe(state).position
        velocity = np.clip(2.0 * away, -0.5, 0.5)
        ns.step(model, state, ns.Velocity(velocity_m_s=velocity.tolist(), yaw_rate_rad_s=0.0))
    error_m = float(np.linalg.norm(goal - ns.sim.observe(state).position))
    print(f"{1e3 * error_m:.1f} mm from the goal after 4 s")
    return error_m


if __name__ == "__main__":
    main()
