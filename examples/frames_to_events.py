"""Feed your own frames to an event camera: an edge that moves to the right.

The log radiance of each pixel that the edge passes rises by log(4) = 1.39: 6 thresholds of 0.2, and a
remainder that the pixel keeps. So the number of events is known in advance.
"""

from __future__ import annotations

import numpy as np

import neurosim_core as ns


def main() -> int:
    """Return how many events the edge left."""
    camera = ns.EventCamera(
        ns.EventCameraConfig(threshold_on=0.2, threshold_off=0.2), width=64, height=48, device="cpu"
    )
    columns = np.arange(64)
    dark, bright = np.log(0.2), np.log(0.8)
    frames = np.stack(
        [np.broadcast_to(np.where(columns < edge, bright, dark), (48, 64)) for edge in range(33)]
    ).astype(np.float32)
    camera.reset(frames[0], stamp_ns=0)
    events = camera.feed(frames[1:], np.arange(1, 33) * 1_000_000)  # one column a millisecond
    t, x, _, polarity = events.numpy()
    assert polarity.all()  # all brighter
    assert np.abs(t / 1000.0 - x).max() <= 1.0  # when the edge was there [ms]
    print(f"{len(events)} events; 32 columns x 48 rows x 6 = {32 * 48 * 6}")
    return len(events)


if __name__ == "__main__":
    main()
