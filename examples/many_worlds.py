"""Step eight worlds together, with different thresholds of their event cameras, and count events.

Everything stays on the device: on a GPU, the same lines step thousands of worlds. High thresholds yield few
events.
"""

from __future__ import annotations

import numpy as np

import neurosim_core as ns


def main() -> list[int]:
    """Return the events of each world, by rising threshold."""
    lens = {"width": 48, "height": 36, "horizontal_fov_rad": 1.5}
    worlds = ns.Simulation(
        {
            "device": "cpu",
            "scene": {"kind": "apartment", "rooms": 1},
            "control": {"rate_hz": 100},
            "sensors": {"front": {"kind": "event_camera", "lens": lens, "sampling_rate_hz": 400}},
        },
        worlds=8,
        parameters={
            "front.threshold_on": np.linspace(0.1, 0.4, 8),
            "front.threshold_off": np.linspace(0.1, 0.4, 8),
        },
    )
    worlds.reset(seed=1)
    commands = np.zeros((8, 4), np.float32)
    commands[:, 3] = 1.5  # hover and turn [rad/s]
    counts = np.zeros(8, np.int64)
    for _ in range(30):
        observation = worlds.step(commands, mode="velocity")
        counts += observation.events["front"].counts.numpy()
    print("events by world:", ", ".join(str(count) for count in counts))
    return [int(count) for count in counts]


if __name__ == "__main__":
    main()
