"""Integrate an ideal IMU along a flight, and compare with the true velocity.

An IMU measures specific force in its own axes: v' = R f + g. The remaining error after a second is that of
the trapezoidal rule at 1 kHz, and of rotors that change their thrust between two samples.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

import neurosim_core as ns


def main() -> float:
    """Return the error of the integrated velocity at the end [m/s]."""
    config = {
        "duration_s": 1.0,
        "device": "cpu",
        "scene": {"kind": "apartment", "rooms": 1},
        "sensors": {
            "imu": {"kind": "imu", "rate_hz": 1000.0},
            "odometry": {"kind": "odometry", "rate_hz": 1000.0},
        },
    }
    packets = list(ns.run(config))
    force = np.array([p.specific_force for p in packets if isinstance(p, ns.ImuSample)])
    states = [p for p in packets if isinstance(p, ns.Odometry)]
    attitude = Rotation.from_quat([state.orientation for state in states])
    acceleration = attitude.apply(force) + np.array([0.0, 0.0, -9.80665])
    change = 0.5e-3 * (acceleration[1:] + acceleration[:-1]).sum(axis=0)  # trapezoids of 1 ms
    error_m_s = float(np.linalg.norm(states[0].velocity + change - states[-1].velocity))
    print(f"flew at {np.linalg.norm(states[-1].velocity):.2f} m/s; off by {1e3 * error_m_s:.2f} mm/s")
    return error_m_s


if __name__ == "__main__":
    main()
