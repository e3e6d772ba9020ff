"""Small recordings with random events and ground truth, made without a simulator."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from neurosim_core.packets import EventArrays, Events, Image, ImuSample, Odometry
from neurosim_core.record import RecordingHeader, RecordingWriter

WIDTH, HEIGHT = 24, 16
PERIOD_NS = 10_000_000


def draw_events(duration_s: float, *, seed: int, rate_hz: float = 20_000.0) -> EventArrays:
    """Sorted random events, some of them at multiples of 10 ms exactly."""
    rng = np.random.default_rng(seed)
    count = round(rate_hz * duration_s)
    t = np.sort(rng.integers(0, round(duration_s * 1e6), count))
    t[::7] = np.maximum(np.round(t[::7], -4), 1)
    t = np.sort(np.minimum(t, round(duration_s * 1e6)))
    return EventArrays(
        t,
        rng.integers(0, WIDTH, count).astype(np.uint16),
        rng.integers(0, HEIGHT, count).astype(np.uint16),
        rng.integers(0, 2, count).astype(np.uint8),
    )


def write_flight(
    path: Path, *, duration_s: float = 1.0, seed: int = 0, depth_hz: float = 20.0
) -> EventArrays:
    """Write packets of 10 ms, IMU at 100 Hz, depth and colour; return the events."""
    rng = np.random.default_rng(seed)
    events = draw_events(duration_s, seed=seed)
    path.parent.mkdir(parents=True, exist_ok=True)
    with RecordingWriter(path, RecordingHeader(config_yaml="", seed=seed, version="0")) as out:
        for k in range(1, round(duration_s * 100) + 1):
            head = {"stamp_ns": k * PERIOD_NS, "sequence": k - 1}
            start_us, end_us = (k - 1) * 10_000, k * 10_000
            part = events.rows((events.t > start_us - (k == 1)) & (events.t <= end_us))
            out.write(
                Events(sensor="events", width=WIDTH, height=HEIGHT, start_ns=(k - 1) * PERIOD_NS, t=part.t,
                       x=part.x, y=part.y, polarity=part.polarity, dropped_count=k % 3, **head)
            )  # fmt: skip
            out.write(
                ImuSample(sensor="imu", specific_force=rng.random(3), angular_rate=rng.random(3), **head)
            )
            turn = np.array([0.0, 0.0, 0.6, 0.8])
            still = {"velocity": np.zeros(3), "body_rate": np.zeros(3), "rotor_speed": np.zeros(4)}
            out.write(Odometry(sensor="odometry", position=rng.random(3), orientation=turn, **still, **head))
            if k * depth_hz % 100 == 0:
                depth = rng.random((HEIGHT, WIDTH)).astype(np.float32)
                out.write(Image(sensor="depth", data=depth, encoding="32FC1", **head))
                rgb = rng.integers(0, 256, (HEIGHT, WIDTH, 3)).astype(np.uint8)
                out.write(Image(sensor="rgb", data=rgb, encoding="rgb8", **head))
    return events
