"""Rooms to fly in, and one world on its own by the ordinary simulation: the oracle of this directory."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import trimesh

import neurosim_core as ns
from neurosim_core import sim
from neurosim_core.packets import Events, Image, ImuSample, Odometry, Packet
from neurosim_core.sim import StartState

LENS = {"width": 36, "height": 28, "horizontal_fov_rad": 1.5}
UNSHADOWED: dict[str, Any] = {"lighting": {"mode": "unshadowed"}, "samples_per_pixel": 1}
RIG: dict[str, Any] = {
    "front": {
        "kind": "event_camera",
        "lens": LENS,
        "sampling_rate_hz": 400,
        "packet_rate_hz": 100,
        "pixel": {"threshold_on": 0.12, "threshold_off": 0.1},
    },
    "rgb": {"kind": "rgb", "lens": LENS, "rate_hz": 50},
    "depth": {"kind": "depth", "lens": LENS, "rate_hz": 100},
    "imu": {
        "kind": "imu",
        "rate_hz": 200,
        "accelerometer_noise_density": 1e-2,
        "gyroscope_random_walk": 1e-3,
        "gyroscope_bias_instability_rad_s": 1e-3,
    },
    "odometry": {"kind": "odometry", "rate_hz": 100},
}


def room(path: Path, *, textured: bool = False) -> Path:
    """Write a room of 6 x 4 x 3 m with boxes on the floor, z up, its middle at (0, 0, 1.5)."""
    scene = trimesh.Scene()
    walls = trimesh.creation.box(extents=[6.0, 4.0, 3.0])
    walls.invert()
    walls.apply_translation([0.0, 0.0, 1.5])
    rng = np.random.default_rng(int(textured))
    if textured:  # face colours are read as a texture
        walls.visual.face_colors = rng.integers(40, 255, (len(walls.faces), 4))
    scene.add_geometry(walls, node_name="walls")
    for index in range(12):
        box = trimesh.creation.box(extents=rng.uniform(0.2, 0.6, size=3))
        angle = 0.5 * index
        box.apply_translation([2.6 * np.cos(angle), 1.7 * np.sin(angle), 0.5 + 0.2 * index % 2.0])
        color = [*rng.uniform(0.0, 1.0, size=3), 1.0]
        box.visual = trimesh.visual.TextureVisuals(
            material=trimesh.visual.material.PBRMaterial(baseColorFactor=color)
        )
        scene.add_geometry(box, node_name=f"box_{index}")
    scene.export(path)
    return path


def scene_of(path: Path) -> dict[str, Any]:
    """Return the settings of the scene of a room."""
    return {"kind": "mesh", "file": str(path), "up_axis": "z", "unit_m": 1.0, "inside_m": [0.0, 0.0, 1.5]}


def settings(path: Path, device: str = "cpu", **changes: Any) -> dict[str, Any]:
    """Return settings of a vehicle that begins in the middle of a room."""
    return {
        "seed": 7,
        "device": device,
        "scene": scene_of(path),
        "render": UNSHADOWED,
        "path": {"kind": "hover", "position_m": [0.0, 0.0, 1.5]},
        "control": {"rate_hz": 100},
        "vehicle": {"on_collision": "report"},
        "sensors": RIG,
        **changes,
    }


def commands_of(mode: str, steps: int, count: int) -> np.ndarray:
    """Return different commands for each step and world, shape [step, world, width]."""
    rng = np.random.default_rng(3)
    thrust = rng.uniform(4.0, 7.0, (steps, count, 1))
    if mode == "rates":
        return np.concatenate([thrust, rng.normal(0.0, 1.5, (steps, count, 3))], axis=2)
    if mode == "attitude":
        return np.concatenate([thrust, rng.normal([0, 0, 0, 1], 0.2, (steps, count, 4))], axis=2)
    if mode == "motor_speeds":
        return rng.uniform(400.0, 800.0, (steps, count, 4))
    return rng.normal([0.0, 0.0, 1.5 if mode == "position" else 0.0, 0.0], 1.0, (steps, count, 4))


def fly_alone(
    config: dict[str, Any],
    commands: np.ndarray,
    *,
    mode: str = "rates",
    start: StartState | None = None,
    overrides: dict[str, Any] | None = None,
) -> list[list[Packet]]:
    """Return what a single simulation yields with some commands: at stamp 0, then step by step."""
    model = ns.make_model(ns.load_config(config, overrides=overrides))
    state = sim.make_state(model, start=start)
    steps = [sim.start(model, state)]
    for command in commands:
        steps.append(sim.step(model, state, command, mode=mode))  # type: ignore[arg-type]
        if state.ended or state.failure is not None:
            break
    return steps


def snapshot(observation: Any, world: int) -> dict[str, Any]:
    """Return what one world yields in a step, on the host, by sensor."""
    seen: dict[str, Any] = {name: events.numpy(world) for name, events in observation.events.items()}
    for name in observation.fresh:
        seen[name] = np.array(observation.images[name].numpy()[world])
    for name, rows in observation.samples.items():
        if name != "odometry":
            seen[name] = tuple(np.array(column.numpy()[:, world]) for column in rows.arrays.values())
    state = observation.state
    seen["state"] = [
        np.array(array.numpy()[world])
        for array in (state.position, state.orientation, state.velocity, state.body_rate, state.rotor_speed)
    ]
    seen["collided"] = int(observation.collided.numpy()[world])
    seen["status"] = int(observation.status.numpy()[world])
    seen["dropped"] = {name: int(e.dropped.numpy()[world]) for name, e in observation.events.items()}
    return seen


def assert_same(seen: dict[str, Any], packets: list[Packet]) -> None:
    """Assert that a world has yielded the bytes of a single simulation's packets, no more and no less."""
    by_sensor: dict[str, list[Any]] = {}
    for packet in packets:
        by_sensor.setdefault(packet.sensor, []).append(packet)
    for name, found in by_sensor.items():
        if isinstance(found[0], Events):
            assert len(found) == 1
            for column, expected in zip(seen[name], found[0].numpy(), strict=True):
                assert column.dtype == expected.dtype
                np.testing.assert_array_equal(column, expected, err_msg=name)
            assert seen["dropped"][name] == found[0].dropped_count
        elif isinstance(found[0], Image):
            assert len(found) == 1
            assert seen[name].dtype == found[0].data.dtype
            np.testing.assert_array_equal(seen[name], found[0].data, err_msg=name)
        elif isinstance(found[0], ImuSample):
            np.testing.assert_array_equal(seen[name][0], [p.specific_force for p in found])
            np.testing.assert_array_equal(seen[name][1], [p.angular_rate for p in found])
        elif isinstance(found[0], Odometry):
            now = found[-1]
            expected_state = (now.position, now.orientation, now.velocity, now.body_rate, now.rotor_speed)
            for value, expected in zip(seen["state"], expected_state, strict=True):
                np.testing.assert_array_equal(value, expected)
    given = {name for name in seen if name not in ("state", "collided", "status", "dropped")}
    empty = {name for name in given - set(by_sensor) if all(len(part) == 0 for part in seen[name])}
    assert given - empty == set(by_sensor) - {"odometry", "collision"}
