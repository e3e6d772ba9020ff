"""A vehicle of an outside class flies in the engine: stepped, in several worlds, and when it fails."""

from __future__ import annotations

from typing import Literal

import numpy as np
import pytest

import neurosim_core as ns
from neurosim_core.vehicle import Acceleration, MultirotorState
from neurosim_core.vehicle.base import HostVehicle, VehicleConfig


@ns.register("vehicle", "stone")
class StoneConfig(VehicleConfig):
    """Falls; its rotors do what they are told and push nothing."""

    kind: Literal["stone"] = "stone"
    shatters_below_m: float = -1e9

    def airframe(self):
        return ns.preset("hummingbird")

    def make(self, context):
        return Stone(self, context)


class Stone(HostVehicle):
    def __init__(self, config, context):
        super().__init__(config.airframe(), context)
        self._shatters_below_m = config.shatters_below_m

    def move(self, state, command, duration_s):
        pull = np.array([0.0, 0.0, -9.81])
        position = state.position + duration_s * state.velocity + 0.5 * duration_s**2 * pull
        if position[2] < self._shatters_below_m:
            position = np.full(3, np.nan)
        return MultirotorState(
            position, state.velocity + duration_s * pull, state.orientation, state.body_rate, command
        )

    def acceleration(self, state, command):
        return Acceleration(linear=np.array([0.0, 0.0, -9.81]), angular=np.zeros(3))


def settings(**vehicle):
    return ns.load_config(
        {
            "duration_s": 0.2,
            "device": "cpu",
            "scene": {"kind": "hall", "size_m": [8, 6, 3]},
            "vehicle": {"kind": "stone", "on_collision": "report", **vehicle},
            "path": {"kind": "hover"},
            "sensors": {"imu": {"kind": "imu", "rate_hz": 100}, "odometry": {"kind": "odometry"}},
        }
    )


def test_a_stone_falls_by_the_closed_form_and_its_imu_feels_nothing():
    packets = list(ns.run(settings()))
    states = [packet for packet in packets if isinstance(packet, ns.Odometry)]
    begin = states[0].position
    for state in states:
        t = 1e-9 * state.stamp_ns
        assert state.position - begin == pytest.approx([0, 0, -0.5 * 9.81 * t**2], abs=1e-12)  # roundings
    readings = [packet.specific_force for packet in packets if isinstance(packet, ns.ImuSample)]
    assert len(readings) == 21
    assert np.abs(readings).max() < 1e-12  # free fall


def test_worlds_are_moved_one_by_one_from_their_own_starts():
    worlds = ns.Simulation(settings(), worlds=3)
    worlds.reset(position=[[0, 0, 5], [0, 0, 6], [0, 0, 7]])
    state = worlds.step().state
    fallen = np.array([5.0, 6.0, 7.0]) - state.position.numpy()[:, 2]
    assert fallen == pytest.approx(np.full(3, 0.5 * 9.81 * 0.005**2), abs=1e-12)


def test_a_state_that_is_not_finite_ends_the_run_with_the_last_good_one():
    config = settings()
    height_m = next(p for p in ns.run(config) if isinstance(p, ns.Odometry)).position[2]
    floor_m = height_m - 0.1
    with pytest.raises(ns.DynamicsError, match="velocity cannot be integrated") as caught:
        list(ns.run(settings(shatters_below_m=floor_m)))
    assert floor_m <= caught.value.state.position[2] < floor_m + 0.01


def test_rotorpy_flies_the_same_path_as_the_multirotor():
    pytest.importorskip("rotorpy")
    import importlib.util
    from pathlib import Path

    file = Path(__file__).parents[2] / "examples" / "rotorpy_vehicle.py"
    spec = importlib.util.spec_from_file_location("rotorpy_vehicle", file)
    example = importlib.util.module_from_spec(spec)
    import sys

    sys.modules["rotorpy_vehicle"] = example
    spec.loader.exec_module(example)
    assert 0.0 < example.main() < 1e-4  # RotorPy integrates with a tolerance of 1e-3 a step of 5 ms
