"""Launches that have the same key are the same, or a CUDA graph of some would be replayed for others."""

from __future__ import annotations

from collections import defaultdict
from typing import Any

import numpy as np
import pytest
import warp as wp
from world_rig import LENS, RIG, UNSHADOWED, room

import neurosim_core as ns
from neurosim_core import sim
from neurosim_core.runtime import cuda
from neurosim_core.sensors.base import FrameContext, FrameSensor, FrameSensorConfig, RenderRequest


@pytest.fixture
def launched(monkeypatch) -> dict[Any, list[list[Any]]]:
    """What was launched each time that a key came, by cache and key: kernels, and copies by their places."""
    found: dict[Any, list[list[Any]]] = defaultdict(list)
    now: list[Any] = []
    launch, relaunch, copy = wp.launch, wp.Launch.launch, wp.copy

    def note_launch(kernel: Any, *given: Any, record_cmd: bool = False, **options: Any) -> Any:
        if not record_cmd:
            now.append(kernel.key)
        return launch(kernel, *given, record_cmd=record_cmd, **options)

    def note_relaunch(recorded: Any, *given: Any) -> None:
        now.append(recorded.kernel.key)
        relaunch(recorded, *given)

    def note_copy(dest: Any, src: Any, *given: Any, **options: Any) -> None:
        now.append((dest.ptr, src.ptr))
        copy(dest, src, *given, **options)

    def run(graphs: cuda.GraphCache, key: Any, call: Any) -> None:
        now.clear()
        call()
        if key is not None:
            found[id(graphs), key].append([*now])

    for owner, name, function in (
        (wp, "launch", note_launch),
        (wp.Launch, "launch", note_relaunch),
        (wp, "copy", note_copy),
        (cuda.GraphCache, "run", run),
    ):
        monkeypatch.setattr(owner, name, function)
    return found


@pytest.fixture
def settings(tmp_path) -> dict[str, Any]:
    return {
        "device": "cpu",
        "scene": {"kind": "mesh", "file": str(room(tmp_path / "room.glb")), "up_axis": "z", "unit_m": 1.0},
        "render": UNSHADOWED,
        "path": {"kind": "line", "start_m": [-1.0, 0.0, 1.5], "end_m": [1.0, 0.3, 1.4]},
        "control": {"rate_hz": 100},
        "vehicle": {"on_collision": "report"},
    }


def camera(kind: str, rate_hz: float) -> dict[str, Any]:
    return {"kind": kind, "lens": LENS, "rate_hz": rate_hz}


def check(launched: dict[Any, list[list[Any]]]) -> None:
    assert any(len(times) > 1 for times in launched.values())
    for key, times in launched.items():
        assert all(each == times[0] for each in times), key


@pytest.mark.parametrize("in_flight", [1, 3])
def test_steps_with_cameras_that_take_turns(settings, launched, in_flight):
    """The flow is computed where it is due only, though pictures of both have the same places."""
    settings["sensors"] = {"rgb": camera("rgb", 100), "flow": camera("optical_flow", 25), "imu": RIG["imu"]}
    model = sim.make_model(ns.load_config(settings))
    state = sim.make_state(model, in_flight=in_flight)
    for count in range(20):
        if count == 10:
            sim.select_cameras(model, state, ["flow"])
        sim.step(model, state, None)
    check(launched)


def test_worlds_with_cameras_that_take_turns(settings, launched):
    """The last picture of the slower one is kept while the faster one goes on; worlds begin anew."""
    settings["sensors"] = {"rgb": camera("rgb", 100), "slow": camera("rgb", 50), "imu": RIG["imu"]}
    worlds = ns.Simulation(settings, worlds=2)
    for count in range(18):
        if count in (0, 4, 8, 12):
            worlds.reset(mask=np.array([True, False]) if count > 4 else None)
        worlds.step()
    check(launched)


class StillConfig(FrameSensorConfig):
    """A camera that clears an array of its own at each batch."""

    kind: str = "test_still"

    def render_request(self) -> RenderRequest:
        """Return what it asks of the renderer."""
        return RenderRequest(frozenset(["log_radiance"]), rate_hz=100.0, every_instant=True)

    def make(self, context: FrameContext) -> FrameSensor:
        """Return the camera at work."""
        return Still()


class Still(FrameSensor):
    """Launches the same each time."""

    def __init__(self) -> None:
        self.results: Any = wp.zeros(1, dtype=float, device="cpu")
        self._zeros: Any = wp.zeros(1, dtype=float, device="cpu")

    def begin(self, frames: Any, stamp_ns: int, mask: Any) -> None:
        """It needs no reference."""

    def plan(self, frames: Any, stamps_ns: Any, end_ns: int) -> cuda.Launches:
        """Return the same launches each time."""
        return cuda.Launches("clear", lambda: wp.copy(self.results, self._zeros))

    def begin_read(self, stamps_ns: Any, *, until_ns: int) -> Any:
        """There are no packets."""
        return list


def test_sensors_of_one_kind(settings, launched):
    """Each knows its own keys only."""
    sensors = {name: StillConfig(lens=LENS) for name in ("left", "right")}
    config = ns.load_config({**settings, "sensors": {}}).model_copy(update={"sensors": sensors})
    model = sim.make_model(config)
    state = sim.make_state(model)
    for _ in range(4):
        sim.step(model, state, None)
    check(launched)


def test_other_gains_leave_the_buffer_of_rotor_speeds(settings):
    """Graphs copy from there, and no controller that is made anew says that they are others."""
    model = sim.make_model(ns.load_config({**settings, "sensors": {"imu": RIG["imu"]}}))
    state = sim.make_state(model)
    for mode in ("motor_speeds", "rates"):
        sim.step(model, state, np.zeros(4), mode=mode)
    before = dict(state.commands)
    sim.forget_controllers(state)
    for mode in ("motor_speeds", "rates"):
        sim.step(model, state, np.zeros(4), mode=mode)
    assert state.commands["motor_speeds"] is before["motor_speeds"]
    assert state.commands["rates"] is not before["rates"]
