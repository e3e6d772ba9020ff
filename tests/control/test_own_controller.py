"""A controller of an outside package: named in settings, with a memory, in worlds, and in another process."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
import pytest

import neurosim_core as ns
from neurosim_core.control import ControllerConfig, ControllerContext, HostController, PathFollower


class CountingController(HostController):
    """Goes to the path, the slower the longer it has flown: what it remembers changes what it does."""

    def __init__(self, config: CountingConfig, context: ControllerContext) -> None:
        super().__init__(context, config.gains)
        self._config = config
        self._calls = [0] * len(context.paths)

    def forget(self, world: int) -> None:
        """Count from 0."""
        self._calls[world] = 0

    def command(self, state: Any, target: Any, *, stamp_ns: int, world: int) -> Any:
        """Return a velocity, or what was asked for instead."""
        self._calls[world] += 1
        if self._config.wrong == "none":
            return None
        if self._config.wrong == "mode" and self._calls[world] > 3:
            return ns.Position(position_m=target["position"])
        factor = np.nan if self._config.wrong == "nan" else 1.0 / self._calls[world]
        return ns.Velocity(velocity_m_s=target["velocity"] + factor * (target["position"] - state.position))


@ns.register("controller", "test_counting")
class CountingConfig(ControllerConfig):
    """`wrong` says what it does wrong."""

    kind: Literal["test_counting"] = "test_counting"
    wrong: str = ""

    def make(self, context: ControllerContext) -> CountingController:
        """Return the controller of all worlds."""
        return CountingController(self, context)


def settings(**control: Any) -> dict[str, Any]:
    return {
        "device": "cpu",
        "duration_s": 0.2,
        "scene": {"rooms": 1},
        "path": {"kind": "circle"},
        "control": {"kind": "test_counting", "rate_hz": 100, **control},
        "sensors": {"odometry": {"kind": "odometry", "rate_hz": 100}},
    }


@pytest.fixture(scope="module")
def flown() -> tuple[ns.Model, list[ns.Odometry]]:
    model = ns.make_model(ns.load_config(settings()))
    return model, [p for p in ns.run_model(model, ns.make_state(model)) if isinstance(p, ns.Odometry)]


def test_it_is_found_by_its_kind_in_settings_of_all_vehicles_and_of_one():
    config = ns.load_config({"vehicles": {"a": {}, "b": {"control": {"kind": "test_counting"}}}})
    assert (config.of("a").control.kind, config.of("b").control.kind) == ("se3", "test_counting")
    with pytest.raises(ns.ConfigError, match=r"control.kind: must be one of .*'test_counting'"):
        ns.load_config({"control": {"kind": "test_countin"}})


def test_worlds_fly_as_a_single_run_does_also_after_a_reset(flown):
    """What it remembered of an episode is gone with it, in the worlds that begin anew and only there."""
    single = flown[1][-1].position
    worlds = ns.Simulation(settings(), worlds=3)
    worlds.reset()
    worlds.rollout(7)
    worlds.reset()
    observation = worlds.rollout(20)
    position = observation.samples["odometry"].arrays["position"].numpy()[-1]
    assert (position == single).all()


def test_another_process_commands_the_same_bits(flown):
    model, states = flown
    control = model.config.control
    follower = PathFollower(model.path, model.airframe, control.gains, controller=control)
    arrays = ns.make_state(model).vehicle.arrays
    for _ in range(2):  # the second time stamps begin again at 0
        inside = control.make(ControllerContext(airframe=model.airframe, paths=[model.path], device="cpu"))
        for state in states[:5]:
            row = {
                name: getattr(state, name) for name in ("position", "velocity", "orientation", "body_rate")
            }
            told = follower.command(stamp_ns=state.stamp_ns, rotor_speed=state.rotor_speed, **row)
            for name, value in {**row, "rotor_speed": state.rotor_speed}.items():
                getattr(arrays, name).numpy()[0] = value
            arrays.stamp_ns.numpy()[0] = state.stamp_ns
            inside.update(arrays)
            assert (told == arrays.rotor_speed_command.numpy()[0]).all()


@pytest.mark.parametrize(
    ("wrong", "error", "said"),
    [
        ("nan", ValueError, "finite"),
        ("mode", ValueError, "commands velocity: it cannot change to position"),
        ("none", TypeError, "CountingController.command must return a setpoint, got None"),
    ],
)
def test_what_it_does_wrong_is_said(wrong, error, said):
    with pytest.raises(error, match=said):
        list(ns.run(settings(wrong=wrong)))


def test_on_a_device_it_is_refused(flown, monkeypatch):
    context = ControllerContext(airframe=flown[0].airframe, paths=[flown[0].path], device="cpu")
    monkeypatch.setattr("warp.get_device", lambda _: type("Device", (), {"is_cuda": True}))
    with pytest.raises(ValueError, match="CountingController runs in Python: it needs device: cpu"):
        CountingConfig().make(context)
