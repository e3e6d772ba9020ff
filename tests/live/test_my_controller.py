"""The controller of the README, beside a real `neurosim serve`."""

from __future__ import annotations

import contextlib
import re
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from processes import ROOT, SOON_S

from cortex import Node, reliable
from cortex.messages import Odometry
from neurosim_core.config import load_config, to_yaml

README = (ROOT / "README.md").read_text(encoding="utf-8")
SETTINGS: dict[str, Any] = {
    "duration_s": 1.5,
    "device": "cpu",
    "scene": {"kind": "apartment", "rooms": 1},
    "render": {"lighting": {"mode": "unshadowed"}, "samples_per_pixel": 1},
    "vehicle": {"on_collision": "report"},
    "path": {"kind": "hover"},
    "sensors": {
        "events": {
            "kind": "event_camera",
            "lens": {"width": 32, "height": 24, "horizontal_fov_rad": 1.5},
            "sampling_rate_hz": 100,
            "packet_rate_hz": 100,
        }
    },
    "live": {"run_on": False},
}


@pytest.fixture
def program(tmp_path) -> Path:
    found = re.search(r"<!-- live: controller -->\s*```python\n(.*?)```", README, flags=re.DOTALL)
    if found is None:
        pytest.skip("the README has no controller")
    path = tmp_path / "my_controller.py"
    path.write_text(found[1], encoding="utf-8")
    return path


def fly(program: Path, folder: Path, mode: str, pixel: dict[str, Any]) -> dict[int, Odometry]:
    """Let the program fly a simulator of its own process; return all states by stamp."""
    settings = folder / "scene.yaml"
    overrides = {"live.mode": mode, "sensors.events.pixel": pixel}
    settings.write_text(to_yaml(load_config(SETTINGS, overrides=overrides)))
    with contextlib.ExitStack() as stack:
        node = stack.enter_context(Node("listener"))
        odometry = node.subscriber("/drone/odometry", Odometry, policy=reliable(4096))

        def start(name: str, *command: str) -> subprocess.Popen[bytes]:
            log = stack.enter_context((folder / f"{name}.txt").open("wb"))
            process = subprocess.Popen(
                [sys.executable, "-W", "error", *command], stdout=log, stderr=subprocess.STDOUT
            )
            stack.callback(process.wait, SOON_S)
            stack.callback(process.kill)
            return process

        controller = start("controller", str(program))  # the first one there waits for the other
        simulator = start("serve", "-m", "neurosim_core", "serve", str(settings))
        assert simulator.wait(120.0) == 0, (folder / "serve.txt").read_text()
        assert controller.poll() is None, (folder / "controller.txt").read_text()
        controller.send_signal(signal.SIGINT)
        controller.wait(SOON_S)

        states = {}
        with contextlib.suppress(TimeoutError):
            while True:
                state = odometry.recv(0.1)
                states[state.stamp_ns] = state
    assert sorted(states) == [tick * 5_000_000 for tick in range(301)]
    return states


@pytest.mark.parametrize(
    ("mode", "threshold", "east_m", "speed_m_s"),
    [
        ("lockstep", 2.0, 1.28, 1.0),
        pytest.param("streaming", 0.01, 0.39, 0.3, marks=pytest.mark.alone),
    ],
)
def test_it_flies_east(shared_runtime, program, tmp_path, mode, threshold, east_m, speed_m_s):
    """At 1 m/s before a camera that sees nothing, at 0.3 m/s before one that sees everything move.

    It takes 0.2 s to be that fast: 1 / `velocity_gain_per_s`. The last metre to the goal is flown slower.
    """
    states = fly(program, tmp_path, mode, {"threshold_on": threshold, "threshold_off": threshold})
    first, last = states[0], states[1_500_000_000]
    moved_m = last.position - first.position
    # Events that a busy machine delivers late let it fly at up to 1 m/s for as long.
    np.testing.assert_allclose(moved_m, [east_m, 0.0, 0.0], atol=0.12)
    second_half = [state for stamp_ns, state in states.items() if stamp_ns >= 750_000_000]
    speed = np.median([np.linalg.norm(state.velocity) for state in second_half])
    assert speed == pytest.approx(speed_m_s, rel=0.2)


def test_two_flights_in_lockstep_are_equal_to_the_last_bit(shared_runtime, program, tmp_path):
    """Events slow it down and let it go again; each command sees the same ones, whoever is faster."""
    flights = []
    for name in ("first", "second"):
        (tmp_path / name).mkdir()
        flights.append(
            fly(program, tmp_path / name, "lockstep", {"threshold_on": 0.05, "threshold_off": 0.05})
        )
    speeds = [float(np.linalg.norm(state.velocity)) for state in flights[0].values()]
    assert 0.3 < max(speeds) < 0.98  # events mattered
    for one, other in zip(*(flight.values() for flight in flights), strict=True):
        assert (one.position == other.position).all()
        assert (one.orientation == other.orientation).all()
