"""The bridge as a managed node: what its states let pass, and what it answers to those who manage it."""

from __future__ import annotations

from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import pytest
from bridge_rig import imu, rig_of
from processes import SOON_S
from runtime_directory import own_directory

from cortex import messages as msg
from cortex_ros2_bridge.config import ConfigError, load
from cortex_ros2_bridge.lifecycle import Lifecycle
from cortex_ros2_bridge.msgs import message_class

UNCONFIGURED, INACTIVE, ACTIVE, FINALIZED = 1, 2, 3, 4
CONFIGURE, CLEANUP, ACTIVATE, DEACTIVATE, SHUTDOWN_OF_ACTIVE = 1, 2, 3, 4, 7
IMU = "/drone/imu -> /drone/imu"


@pytest.fixture
def managed(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """A bridge that waits for whoever manages it, and a simulator."""
    with own_directory(monkeypatch), rig_of({"autostart": False}) as rig:
        lifecycle = Lifecycle(rig.bridge, rig.backend, "/sim/cortex_bridge")

        def call(name: str, **fields: Any) -> Any:
            return rig.backend.services[f"/sim/cortex_bridge/{name}"].call(**fields)

        def change(number: int = 0, label: str = "") -> bool:
            transition = message_class("lifecycle_msgs/msg/Transition")(id=number, label=label)
            return bool(call("change_state", transition=transition).success)

        def state() -> tuple[int, str]:
            found = call("get_state").current_state
            return found.id, found.label

        events = rig.backend.publishers["/sim/cortex_bridge/transition_event"]
        yield SimpleNamespace(rig=rig, call=call, change=change, state=state, events=events)
        lifecycle.close()
        assert not [name for name in rig.backend.services if "cortex_bridge" in name]
        assert events.closed


def actuators_of(rig: Any) -> Any:
    return rig.tally("/drone/command/motor_speeds <- /drone/actuators")


def test_messages_pass_only_while_it_is_active(managed: Any) -> None:
    """Unconfigured: nothing is open; inactive: topics are there, nothing is subscribed to."""
    rig = managed.rig
    measured = rig.simulator.publisher("/drone/imu", msg.Imu)
    commands = rig.simulator.subscriber("/drone/command/motor_speeds", msg.MotorCommand)
    rotors = message_class("actuator_msgs/msg/Actuators")(velocity=[100.0] * 4)
    rig.updates_during()
    assert (managed.state(), rig.bridge.routes()) == ((UNCONFIGURED, "unconfigured"), [])
    assert managed.change(CONFIGURE)
    assert managed.state() == (INACTIVE, "inactive")
    (sent,) = rig.opens("/drone/imu")
    (actuators,) = rig.subscribes("/drone/actuators")
    sent.subscriber_count = actuators.publisher_count = 1
    rig.updates_during()
    assert measured.subscriber_count == 0
    actuators.put(rotors)
    refused = actuators_of(rig)
    assert (refused.received, refused.sent, refused.refused) == (1, 0, 1)
    assert managed.change(ACTIVATE)
    rig.update_until(lambda: measured.subscriber_count == 1 and commands.publisher_count == 1)
    measured.publish(imu(5))
    rig.update_until(lambda: len(sent.sent) == 1)
    actuators.put(rotors)
    rig.update_until(lambda: actuators_of(rig).sent == 1)
    assert commands.recv(SOON_S).speed.tolist() == [100.0] * 4
    assert managed.change(DEACTIVATE)
    rig.update_until(lambda: measured.subscriber_count == 0)
    assert (len(sent.sent), sent.closed) == (1, False)
    assert managed.change(CLEANUP)
    assert (sent.closed, rig.backend.subscriptions) == (True, {})
    assert managed.change(CONFIGURE)
    assert managed.change(ACTIVATE)
    (again,) = rig.opens("/drone/imu")
    assert again is not sent
    assert managed.change(SHUTDOWN_OF_ACTIVE)
    rig.updates_during()
    assert (managed.state(), again.closed, rig.bridge.routes()) == ((FINALIZED, "finalized"), True, [])
    assert not managed.change(CONFIGURE)


def test_services_of_a_simulator_are_refused_while_it_is_inactive(managed: Any) -> None:
    asked = []

    def pause(request: msg.Trigger) -> msg.SimulatorReply:
        asked.append(request)
        return msg.SimulatorReply(True, "", 0, "paused")

    managed.rig.simulator.service("/pause", msg.Trigger, msg.SimulatorReply, pause)
    managed.change(CONFIGURE)
    managed.rig.update_until(lambda: "/pause" in managed.rig.backend.services)
    answer = managed.rig.backend.services["/pause"].call()
    assert (answer.success, answer.message, asked) == (False, "the bridge is not active", [])
    managed.change(ACTIVATE)
    assert managed.rig.backend.services["/pause"].call().success
    assert len(asked) == 1


def test_transitions_are_named_told_and_refused_where_they_do_not_begin(managed: Any) -> None:
    """As rcl_lifecycle does it: a label wins over a number; each step is told on the topic."""
    assert not managed.change(ACTIVATE)
    assert not managed.change(99)
    assert managed.state() == (UNCONFIGURED, "unconfigured")
    assert managed.events.messages() == []
    assert managed.change(ACTIVATE, "configure")
    steps = [
        (e.start_state.label, e.transition.label, e.transition.id, e.goal_state.label)
        for e in managed.events.messages()
    ]
    assert steps == [
        ("unconfigured", "configure", 1, "configuring"),
        ("configuring", "transition_success", 10, "inactive"),
    ]
    here = managed.call("get_available_transitions").available_transitions
    assert [(each.transition.id, each.goal_state.id) for each in here] == [(2, 11), (3, 13), (6, 12)]
    assert len(managed.call("get_available_states").available_states) == 11
    assert managed.change(0, "shutdown")
    assert managed.state() == (FINALIZED, "finalized")


def test_a_transition_that_fails_leaves_the_state_before(managed: Any, monkeypatch: Any) -> None:
    monkeypatch.setattr(managed.rig.bridge, "update", lambda: 1 / 0)
    assert not managed.change(CONFIGURE)
    assert managed.state() == (UNCONFIGURED, "unconfigured")
    last = managed.events.messages()[-1]
    assert (last.transition.label, last.goal_state.label) == ("transition_failure", "unconfigured")


def test_a_bridge_that_starts_by_itself_is_active(monkeypatch: pytest.MonkeyPatch) -> None:
    with own_directory(monkeypatch), rig_of() as rig:
        lifecycle = Lifecycle(rig.bridge, rig.backend, "/cortex_bridge")
        found = rig.backend.services["/cortex_bridge/get_state"].call().current_state
        assert (found.id, found.label) == (ACTIVE, "active")
        lifecycle.close()


def test_a_bag_cannot_be_managed() -> None:
    assert not load(None, {"autostart": False}).autostart
    with pytest.raises(ConfigError, match=r"nobody can activate a bag \(run\.mcap\)"):
        load({"backend": "run.mcap"}, {"autostart": False})
