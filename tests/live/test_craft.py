"""One vehicle of a live run, period by period."""

from __future__ import annotations

from typing import Any

import pytest
from live_rig import RGB, make_config, models_of

from cortex import Node
from cortex.messages import Reset
from neurosim_core.live import craft as module
from neurosim_core.live.beginning import make_beginning
from neurosim_core.live.craft import Craft
from neurosim_core.live.simulator import Simulator


@pytest.fixture(name="craft")
def _craft(runtime: Any) -> Any:
    config = make_config(sensors={"rgb": RGB}, **{"live.mode": "lockstep"})
    with Node("simulator") as node:
        craft = Craft(node, "drone", models_of(config)["drone"])
        beginning = make_beginning([craft], config, Reset())
        craft.begin(beginning.states["drone"], seed=beginning.seeds["drone"])
        yield craft
        craft.drop_loans()


def test_cameras_are_switched_between_control_periods(craft: Craft, monkeypatch: pytest.MonkeyPatch):
    """Who comes while a period is under way sees from the next one on: all launches of one see the same."""
    begun = craft.begin_step(0)
    monkeypatch.setattr(craft.outlet, "active", lambda: frozenset({"rgb", "imu"}))
    craft.look()
    assert craft.state.wanted == frozenset()
    craft.end_step(begun)
    assert craft.state.wanted == {"rgb"}
    monkeypatch.setattr(craft.outlet, "active", lambda: frozenset({"imu"}))
    craft.look()
    assert craft.state.wanted == frozenset()


def test_the_next_period_is_planned_for_those_that_came_meanwhile(
    craft: Craft, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(craft, "_is_late", True)
    begun = craft.begin_step(0)
    monkeypatch.setattr(craft.outlet, "active", lambda: frozenset({"rgb"}))
    craft.look()
    craft.end_step(begun)
    assert craft.state.ahead is not None
    assert craft.state.ahead.batch.wanted == {"rgb"}


def test_every_period_that_was_begun_is_ended(runtime: Any, monkeypatch: pytest.MonkeyPatch):
    """Whatever happens to one of them, in the order in which they began."""
    config = make_config(
        sensors={"rgb": RGB}, vehicles={"a": {}, "b": {}, "c": {}}, **{"live.mode": "lockstep"}
    )
    ended: list[str] = []
    end = module.Craft.end_step

    def failing(craft: Craft, begun: Any) -> None:
        ended.append(craft.name)
        end(craft, begun)
        if craft.name != "c":
            raise RuntimeError(craft.name)

    monkeypatch.setattr(module.Craft, "end_step", failing)
    with Simulator(config, models=models_of(config)) as simulator:
        with pytest.raises(RuntimeError, match=r"^a$"):  # the first, and not what came of it
            simulator._step()
        assert ended == ["a", "b", "c"]
        assert [craft.state.launched_ns for craft in simulator.crafts] == [5_000_000] * 3
