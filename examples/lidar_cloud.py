"""Turn a LiDAR with 16 beams once around in a room, and measure the height above the floor in its cloud.

Each ray has its own time, and `deskew` removes the motion.
"""

from __future__ import annotations

import neurosim_core as ns


def main() -> float:
    """Return how high the lowest points are above the sensor [m]."""
    config = ns.load_config(
        {
            "duration_s": 0.2,
            "device": "cpu",
            "scene": {"kind": "apartment", "rooms": 1},
            "path": {"kind": "hover", "position_m": [0.0, 0.0, 0.6]},
            "sensors": {"lidar": {"kind": "lidar", "preset": "velodyne_vlp16", "deskew": True}},
        }
    )
    clouds = [packet for packet in ns.run(config) if packet.sensor == "lidar"]
    points = clouds[-1].points
    height_m = float(points[:, 2].min())
    print(f"{len(points)} points; the lowest are {-height_m:.2f} m below")
    return height_m


if __name__ == "__main__":
    main()
