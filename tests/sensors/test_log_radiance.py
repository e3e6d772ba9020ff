"""Pictures of log radiance are what the pixels of an event camera see."""

from __future__ import annotations

import numpy as np
import pytest

import neurosim_core as ns

LENS = {"width": 24, "height": 18, "horizontal_fov_rad": 1.4}


def test_events_are_the_steps_of_log_radiance():
    """An ideal pixel's events times its threshold are the change of log radiance, to a threshold."""
    sensors = {
        "events": {
            "kind": "event_camera",
            "lens": LENS,
            "sampling_rate_hz": 500,
            "packet_rate_hz": 50,
            "pixel": {"threshold_on": 0.1, "threshold_off": 0.1},
        },
        "radiance": {"kind": "log_radiance", "lens": LENS, "rate_hz": 50},
        "depth": {"kind": "depth", "lens": LENS, "rate_hz": 10},
    }
    scene = {"kind": "apartment", "rooms": 1}
    config = {"duration_s": 0.2, "device": "cpu", "scene": scene, "sensors": sensors}
    total, first, seen = np.zeros((18, 24)), None, 0
    for packet in ns.run(config):
        if packet.sensor == "events":
            events = packet.numpy()
            np.add.at(total, (events.y, events.x), 0.1 * (2.0 * events.polarity - 1.0))
        elif packet.sensor == "radiance":
            first = packet.data if first is None else first
            assert np.abs(packet.data - first - total).max() < 0.1 + 1e-4
            seen += 1
    assert seen == 11
    assert np.abs(total).max() > 0.25


def test_worlds_refuse_it_by_name():
    scene = {"kind": "hall", "size_m": [8, 6, 3]}
    sensors = {"radiance": {"kind": "log_radiance", "lens": LENS, "rate_hz": 50}}
    with pytest.raises(ValueError, match="radiance: pictures of log radiance are for single runs"):
        ns.Simulation({"device": "cpu", "scene": scene, "sensors": sensors}, worlds=2)
