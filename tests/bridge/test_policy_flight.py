"""A policy whose vehicle is in ROS flies as it does in the simulator's process."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import yaml
from processes import ROOT, SOON_S, wait_for
from runtime_directory import own_directory

import neurosim_core as ns
from cortex import Node, reliable
from cortex.messages import Odometry, Reset, SimulatorReply
from neurosim_core import sim
from neurosim_core.packets import Events
from neurosim_core.packets import Odometry as OdometryPacket

pytest.importorskip("onnxruntime", reason="needs the extra learn")

from neurosim_core.learn.pilot import Pilot, pilot_settings, shipped_policy

DURATION_S = 2.0
LIMIT_S = 5.0 * SOON_S
"""Deadline of what takes a second or two on a machine that does nothing else."""
THROW = [0.6, 0.4, 0.0]


def settings(card) -> dict:
    return {
        **pilot_settings(card),
        "device": "cpu",
        "scene": {"kind": "apartment", "rooms": 1},
        "live": {"mode": "lockstep", "command_deadline_s": 60.0, "command_timeout_s": 5.0},
    }


@pytest.fixture(scope="module")
def alone() -> np.ndarray:
    """Where the vehicle is at each step without any of it, and how fast, [step, 6]."""
    pilot = Pilot(shipped_policy("hover"))
    model = ns.make_model(ns.load_config(settings(pilot.card)))
    start = sim.StartState(position=sim.observe(sim.make_state(model)).position, velocity=THROW)
    state = sim.make_state(model, start=start)
    packets, rows = sim.start(model, state), []
    for _ in range(round(DURATION_S * pilot.card["rate_hz"]) + 1):
        now = next(packet for packet in packets if isinstance(packet, OdometryPacket))
        seen = [packet.numpy() for packet in packets if isinstance(packet, Events)]
        rows.append([*now.position, *now.velocity])
        command = pilot.act(
            *(seen[0] if seen else (np.empty(0),) * 4),
            stamp_ns=now.stamp_ns,
            orientation=now.orientation,
            body_rate=now.body_rate,
        )
        packets = sim.step(model, state, [command.thrust_n, *command.body_rate], mode="rates")
    return np.array(rows)


@pytest.fixture
def directory(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setenv("PYTHONPATH", f"{ROOT}{os.pathsep}{os.environ.get('PYTHONPATH', '')}")
    with own_directory(monkeypatch):
        yield


def test_a_policy_flies_a_vehicle_in_ros(
    alone: np.ndarray, directory: None, dds_domain: int, tmp_path: Path
) -> None:
    """Thrown, and stopped by the policy; in lockstep only the float32 of a thrust may differ."""
    pilot = Pilot(shipped_policy("hover"))
    scene = tmp_path / "scene.yaml"
    scene.write_text(yaml.safe_dump(settings(pilot.card)), encoding="utf-8")
    rows: list[list[float]] = []
    commands = [
        ("neurosim_core", "serve", str(scene)),
        ("cortex_ros2_bridge", "--backend", "dds"),
        ("neurosim_core", "deploy", "hover", "--ros", "dds", "--duration", str(DURATION_S)),
    ]
    started: list[subprocess.Popen[bytes]] = []
    with Node("watch") as node:
        try:
            started += [subprocess.Popen([sys.executable, "-m", *words]) for words in commands[:2]]
            reset = node.client("/reset", Reset, SimulatorReply)
            assert reset.call(Reset(velocity=np.array(THROW)), LIMIT_S).accepted
            states = node.subscriber("/drone/odometry", Odometry, policy=reliable(256))
            started.append(subprocess.Popen([sys.executable, "-m", *commands[2]]))
            while len(rows) <= round(DURATION_S * pilot.card["rate_hz"]):
                state = states.recv(LIMIT_S)
                if state.stamp_ns == round(1e9 * len(rows) / pilot.card["rate_hz"]):  # else it is sent again
                    rows.append([*state.position, *state.velocity])
            assert wait_for(lambda: started[-1].poll() is not None, LIMIT_S)
            assert started[-1].returncode == 0
        finally:
            for process in started:
                process.terminate()
            for process in started:
                process.wait(SOON_S)
    assert np.linalg.norm(alone[-1, 3:]) < 0.3  # it was faster than 0.7
    np.testing.assert_allclose(rows, alone, atol=0.01)
