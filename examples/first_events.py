"""Fly through a generated room and count the events of its camera, brighter and darker.

You see that a flight is an iterator of packets, in the order of their stamps, and that its events are arrays.
"""

from __future__ import annotations

import neurosim_core as ns

CONFIG = {
    "duration_s": 0.5,
    "device": "cpu",
    "scene": {"kind": "apartment", "rooms": 1, "seed": 3},
    "sensors": {
        "events": {"kind": "event_camera", "lens": {"width": 96, "height": 72, "horizontal_fov_rad": 1.5}},
        "imu": {"kind": "imu", "rate_hz": 200.0},
    },
}


def main() -> int:
    """Return how many events there were."""
    brighter = darker = samples = 0
    for packet in ns.run(CONFIG):
        if isinstance(packet, ns.Events):
            _, _, _, polarity = packet.numpy()  # t [us], x, y, polarity
            brighter += int(polarity.sum())
            darker += int((1 - polarity).sum())
        elif isinstance(packet, ns.ImuSample):
            samples += 1
    print(f"{brighter} brighter, {darker} darker, beside {samples} samples of the IMU")
    print(f"{brighter + darker} events")
    return brighter + darker


if __name__ == "__main__":
    main()
