"""A foreign controller on DDS flies a figure eight through the bridge as well as one without any of it."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import flight_laws
import pytest
import yaml
from flight_laws import Errors, make_law
from processes import ROOT
from runtime_directory import own_directory

from cortex import Node
from neurosim_core.simulation import Model, make_fleet, make_state, observe, step

MODES = ("attitude", "motor_speeds")
BRIDGE = {
    "namespace": "/sim",
    "routes": [
        {
            "cortex": "*",
            "type": "mavros_msgs/msg/AttitudeTarget",
            "options": {"max_thrust_n": flight_laws.MAX_THRUST_N},
        }
    ],
}
LIMIT_S = 120.0
"""It takes ten seconds on a machine that does nothing else."""


class Process:
    """A process that ends with the test."""

    def __init__(self, *command: object, **environment: str) -> None:
        self.process = subprocess.Popen(
            [sys.executable, *map(str, command)],
            env={**os.environ, "PYTHONPATH": f"{ROOT}{os.pathsep}{Path(__file__).parent}", **environment},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    def end(self) -> str:
        """Interrupt it, if it still runs; what it said on standard error."""
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGINT)
        try:
            return self.process.communicate(timeout=10.0)[1]
        except subprocess.TimeoutExpired:
            self.process.kill()
            return self.process.communicate()[1]


@pytest.fixture
def registry() -> Iterator[None]:
    """A runtime directory, with a registry that is not in the test's DDS domain."""
    with pytest.MonkeyPatch.context() as monkeypatch, own_directory(monkeypatch), Node("first") as node:
        assert node.wait_for_registry()
        yield


@pytest.fixture
def flights(registry: None, dds_domain: int, tmp_path: Path) -> Iterator[tuple[Process, list[Process]]]:
    """The controller, and the other processes."""
    scene, bridge = tmp_path / "scene.yaml", tmp_path / "bridge.yaml"
    scene.write_text(yaml.safe_dump(flight_laws.SETTINGS))
    bridge.write_text(yaml.safe_dump(BRIDGE))
    others = [
        Process("-m", "neurosim_core", "serve", scene),
        Process("-m", "cortex_ros2_bridge", "--backend", "dds", "--config", bridge),
    ]
    controller = Process(Path(__file__).with_name("dds_controller.py"), dds_domain, *MODES)
    yield controller, others
    for process in (controller, *others):
        process.end()


def in_process(model: Model, mode: str) -> dict[str, Any]:
    """The same flight, with the same law, without anybody else."""
    state = make_state(model)
    law, errors = make_law(mode, model.config, model.path), Errors(model.path)
    end_ns = round(flight_laws.DURATION_S * 1e9)
    while True:
        now = observe(state)
        errors.add(now.stamp_ns, now.position)
        if now.stamp_ns >= end_ns:
            return {"mode": mode, "rms_m": errors.rms_m, "count": len(errors.squares)}
        row = law(
            stamp_ns=now.stamp_ns,
            position=now.position,
            velocity=now.velocity,
            orientation=now.orientation,
            body_rate=now.body_rate,
            rotor_speed=now.rotor_speed,
        )
        step(model, state, row, mode=mode)


def test_a_figure_eight_through_dds(flights: tuple[Process, list[Process]]) -> None:
    """AttitudeTarget, a reset by topic, then Actuators: each is as close to the path as in one process.

    Lockstep makes delays harmless, so only the float32 of a thrust may differ.
    """
    controller, others = flights
    (model,) = make_fleet(flight_laws.config()).values()
    expected = [in_process(model, mode) for mode in MODES]
    try:
        out, complaints = controller.process.communicate(timeout=LIMIT_S)
    except subprocess.TimeoutExpired:
        controller.process.kill()
        said = [process.end() for process in (controller, *others)]
        raise AssertionError(f"the flight did not end: {said}") from None
    assert controller.process.returncode == 0, complaints
    flown = [json.loads(line) for line in out.splitlines()]
    assert [f["mode"] for f in flown] == list(MODES)
    for there, here in zip(flown, expected, strict=True):
        assert there["count"] == here["count"] == 401
        assert here["rms_m"] < 0.15
        assert there["rms_m"] == pytest.approx(here["rms_m"], rel=0.1)
