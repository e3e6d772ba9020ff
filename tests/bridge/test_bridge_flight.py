"""A foreign controller on DDS flies a figure eight through the bridge as well as one without any of it."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import foreign_controller
import pytest
import yaml
from foreign_controller import DURATION_S, MAX_THRUST_N, SETTINGS, Errors, make_law
from processes import ROOT
from runtime_directory import own_directory

import neurosim_core as ns
from cortex import Node
from neurosim_core.sim import observe

MODES = ("attitude", "motor_speeds")
LIMIT_S = 120.0
"""Longest time of the flights; they take ten seconds on a machine that does nothing else."""
BRIDGE = {
    "namespace": "/sim",
    "routes": [
        {"cortex": "*", "type": "mavros_msgs/msg/AttitudeTarget", "options": {"max_thrust_n": MAX_THRUST_N}}
    ],
}


@pytest.fixture
def registry(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A runtime directory, with a registry that is not in the test's DDS domain."""
    monkeypatch.setenv("PYTHONPATH", f"{ROOT}{os.pathsep}{os.environ.get('PYTHONPATH', '')}")
    with own_directory(monkeypatch), Node("first") as node:
        assert node.wait_for_registry()
        yield


def fly_in_process(mode: str) -> float:
    """Fly the same figure eight with the same law; return the RMS distance from the path [m]."""
    model = ns.make_model(ns.load_config(SETTINGS))
    state = ns.make_state(model)
    law, errors = make_law(mode, model.config, model.path), Errors(model.path)
    while True:
        now = observe(state)
        errors.add(now.stamp_ns, now.position)
        if now.stamp_ns >= round(DURATION_S * 1e9):
            return errors.rms_m
        row = law(
            stamp_ns=now.stamp_ns,
            position=now.position,
            velocity=now.velocity,
            orientation=now.orientation,
            body_rate=now.body_rate,
            rotor_speed=now.rotor_speed,
        )
        ns.step(model, state, row, mode=mode)


@contextlib.contextmanager
def process(*arguments: str) -> Iterator[subprocess.Popen[str]]:
    started = subprocess.Popen(
        [sys.executable, *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    try:
        yield started
    finally:
        if started.poll() is None:
            started.send_signal(signal.SIGINT)
        try:
            started.communicate(timeout=10.0)
        except subprocess.TimeoutExpired:
            started.kill()
            started.communicate()


def test_a_figure_eight_through_dds(registry: None, dds_domain: int, tmp_path: Path) -> None:
    """AttitudeTarget, a reset by topic, then Actuators: each is as close to the path as in one process.

    Lockstep makes delays harmless, so only the float32 of a thrust may differ.
    """
    scene, bridge = tmp_path / "scene.yaml", tmp_path / "bridge.yaml"
    scene.write_text(yaml.safe_dump(SETTINGS), encoding="utf-8")
    bridge.write_text(yaml.safe_dump(BRIDGE), encoding="utf-8")
    with (
        process("-m", "neurosim_core", "serve", str(scene)),
        process("-m", "cortex_ros2_bridge", "--backend", "dds", "--config", str(bridge)),
        process(foreign_controller.__file__, str(dds_domain), *MODES) as controller,
    ):
        out, complaints = controller.communicate(timeout=LIMIT_S)
    assert controller.returncode == 0, complaints
    flights = [json.loads(line) for line in out.splitlines()]
    assert [flight["mode"] for flight in flights] == list(MODES)
    for flight in flights:
        alone_m = fly_in_process(flight["mode"])
        assert flight["count"] == 201
        assert alone_m < 0.15
        assert flight["rms_m"] == pytest.approx(alone_m, rel=0.1)
