"""Cut a flight into windows of events with depth, as input of a network.

The same lines read recordings, folders of recordings, event files, and running simulators.
"""

from __future__ import annotations

import neurosim_core as ns


def main() -> tuple[int, int]:
    """Return the number of windows, and of events in them."""
    lens = {"width": 64, "height": 48, "horizontal_fov_rad": 1.5}
    config = {
        "duration_s": 0.5,
        "device": "cpu",
        "scene": {"kind": "apartment", "rooms": 1},
        "sensors": {
            "events": {"kind": "event_camera", "lens": lens},
            "depth": {"kind": "depth", "rate_hz": 20.0, "lens": lens},
        },
    }
    windows = events = 0
    for batch in ns.data.Stream(config, window_s=0.05, batch=4):
        voxels = batch.events.voxel(5)  # float32 [B, 5, H, W]
        assert voxels.shape[1:] == (5, 48, 64)
        assert batch.depth.shape[1:] == (48, 64)  # at the end of each window
        windows += len(voxels)
        events += len(batch.events.raw.t)
    print(f"{windows} windows with {events} events")
    return windows, events


if __name__ == "__main__":
    main()
