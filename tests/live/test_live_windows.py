"""Windows of a running simulator, over Cortex: those of its recording, to the byte."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest
import yaml
from processes import SOON_S

from neurosim_core import cli, data
from neurosim_core.data.windows import WindowConfig
from neurosim_core.record import Recording
from neurosim_core.sensors.event_labels import LabelledEvents

LENS = {"width": 32, "height": 24, "horizontal_fov_rad": 1.5}
SETTINGS = {
    "duration_s": 0.4,
    "device": "cpu",
    "renderer": "synthetic",
    "scene": {"kind": "apartment", "rooms": 1},
    "path": {"kind": "circle"},
    "sensors": {
        "events": {"kind": "event_camera", "lens": LENS, "labels": ["cause"]},
        "depth": {"kind": "depth", "rate_hz": 50.0, "lens": LENS},
        "imu": {"kind": "imu", "rate_hz": 200.0},
    },
}


@pytest.mark.usefixtures("runtime")
def test_live_windows_are_those_of_the_recording(tmp_path):
    """The simulator waits for its controller, which starts once the windows are subscribed to."""
    (tmp_path / "live.yaml").write_text(yaml.safe_dump(SETTINGS))
    env = {**os.environ, "PYTHONPATH": str(Path(cli.__file__).resolve().parents[1])}
    neurosim = [sys.executable, "-m", "neurosim_core"]
    config = str(tmp_path / "live.yaml")
    words = ["serve", config, "--lockstep", "--record", str(tmp_path / "flown"), "--duration", "0.4"]
    server = subprocess.Popen([*neurosim, *words], env=env, stdout=subprocess.DEVNULL)
    pilots: list[subprocess.Popen[bytes]] = []

    def fly() -> None:
        pilots.append(subprocess.Popen([*neurosim, "fly", config], env=env, stdout=subprocess.DEVNULL))

    source = data.LiveSource(timeout_s=3.0, start_s=SOON_S, on_join=fly)
    config_of_windows = WindowConfig(window_s=0.02)
    found: list[data.Sample] = []
    thread = threading.Thread(target=lambda: found.extend(source.samples(config_of_windows)), daemon=True)
    thread.start()
    try:
        assert server.wait(SOON_S) == 0
        thread.join(SOON_S)
        assert not thread.is_alive()
    finally:
        for process in (server, *pilots):
            process.kill()
            process.wait()
    recorded = data.Dataset(tmp_path / "flown" / "flight.h5", window_s=0.02)
    wanted = {sample.stamp_ns: sample for sample in recorded.read(0, len(recorded))}
    assert len(found) == len(wanted) == 20
    assert sum(len(sample.events.t) for sample in found) > 20
    for sample in found:
        other = wanted[sample.stamp_ns]
        assert (sample.dropped_count, sample.lost_count) == (other.dropped_count, other.lost_count) == (0, 0)
        assert np.array_equal(sample.depth, other.depth)
        assert np.array_equal(sample.imu, other.imu)
        assert all(np.array_equal(a, b) for a, b in zip(sample.events, other.events, strict=True))
    with Recording(tmp_path / "flown" / "flight.h5") as recording:
        events = [packet for packet in recording.packets() if isinstance(packet, LabelledEvents)]
    assert sum(len(packet.cause) for packet in events) > 20
