"""Launches that come again are replayed as graphs: they give what the launches give, in all ways to fly."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from cpu_graphs import CpuGraphs, cpu_graphs  # noqa: F401  (a fixture)
from world_rig import LENS, RIG, commands_of, fly_alone, room, settings, snapshot

import neurosim_core as ns
from neurosim_core import sim

STEP_COUNT = 30
CAMERAS: dict[str, Any] = {  # of one group: some take a picture alone, and some process it
    "rgb": {"kind": "rgb", "lens": LENS, "rate_hz": 20},
    "depth": {"kind": "depth", "lens": LENS, "rate_hz": 50},
    "flow": {"kind": "optical_flow", "lens": LENS, "rate_hz": 100 / 3},
    "corners": {"kind": "corners", "lens": LENS, "rate_hz": 25},
}


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return room(tmp_path_factory.mktemp("room") / "room.glb", textured=True)


def content(value: Any) -> Any:
    """Return all that a value holds, to compare."""
    if isinstance(value, dict):
        return {name: content(part) for name, part in value.items()}
    if isinstance(value, list | tuple):
        return [content(part) for part in value]
    return value.tobytes() if isinstance(value, np.ndarray) else value


def fly_in_steps(config: dict[str, Any]) -> list[ns.Packet]:
    commands = commands_of("rates", STEP_COUNT, 1)[:, 0]
    return [packet for step in fly_alone(config, commands) for packet in step]


def fly_ahead(config: dict[str, Any]) -> list[ns.Packet]:
    model = sim.make_model(ns.load_config(config))
    return list(sim.run_model(model, sim.make_state(model, in_flight=2)))


@pytest.mark.parametrize("fly", [fly_in_steps, fly_ahead])
@pytest.mark.parametrize("pixel", [{}, {"preset": "davis346"}], ids=["ideal", "davis346"])
def test_packets_of_replays(scene, request, fly, pixel):
    """Also where two cameras of a group take pictures at other times."""
    front = {**RIG["front"], "pixel": pixel}
    path = {"kind": "circle", "center_m": [0.0, 0.0, 1.5], "radius_m": 0.8}
    rig = {**RIG, **CAMERAS, "front": front}
    config = {**settings(scene, sensors=rig, duration_s=0.6, instants_per_launch=8), "path": path}
    expected = fly(config)
    graphs: CpuGraphs = request.getfixturevalue("cpu_graphs")
    packets = fly(config)
    assert graphs.replayed_count > STEP_COUNT // 2
    assert {packet.sensor for packet in packets} == rig.keys()
    assert content([vars(packet) for packet in packets]) == content([vars(packet) for packet in expected])


@pytest.mark.parametrize("pictures", [("rgb", "corners", "depth"), ()], ids=["pictures", "events"])
def test_worlds_of_replays(scene, request, pictures):
    """A step is one graph, and so is a reset; events are in the order in which threads found them."""
    rig = {"front": RIG["front"], "imu": RIG["imu"], **{name: CAMERAS[name] for name in pictures}}
    config = settings(scene, sensors=rig)
    commands = commands_of("rates", STEP_COUNT, 3)

    def fly() -> list[Any]:
        worlds, seen, now_ns = ns.Simulation(config, worlds=3, sorted=False), [], 0

        def note(observation: Any) -> None:
            for world in range(3):
                found = snapshot(observation, world)
                found["front"] = sorted(zip(*(column.tolist() for column in found["front"]), strict=True))
                seen.append(content(found))

        for command in commands:
            if now_ns % worlds.common_ns == 0:
                note(worlds.reset(mask=np.array([True, False, True]) if now_ns else None, seed=now_ns))
            note(worlds.step(command))
            now_ns += worlds.duration_ns
        return seen

    expected = fly()
    graphs: CpuGraphs = request.getfixturevalue("cpu_graphs")
    assert fly() == expected
    assert graphs.replayed_count > STEP_COUNT // 2
