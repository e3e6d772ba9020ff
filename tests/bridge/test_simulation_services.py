"""The services of simulation_interfaces, over a real simulator, and the bridge's own with answers."""

from __future__ import annotations

from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import pytest
import yaml
from live_rig import IMU, LiveRig, make_config
from processes import SOON_S, wait_for
from recording_backend import RecordingBackend
from runtime_directory import own_directory

from cortex import Node
from cortex import messages as msg
from cortex_ros2_bridge.bridge import Bridge
from cortex_ros2_bridge.config import load
from cortex_ros2_bridge.msgs import message_class

UNSUPPORTED, OK, NOT_FOUND, INCORRECT_STATE, FAILED = range(5)
STOPPED, PLAYING, PAUSED, QUITTING = range(4)
ALREADY = INVALID_POSE = 101
PERIOD_NS = 5_000_000
BODIES = {
    "box": {"shape": {"kind": "box", "size_m": [0.2, 0.2, 0.2]}, "present": False},
    "ball": {"shape": {"kind": "sphere", "radius_m": 0.2}, "motion": {"velocity_m_s": [0.1, 0.0, 0.0]}},
}


@pytest.fixture(scope="module")
def world() -> Iterator[Any]:
    """A simulator in a thread, a bridge beside it, and `call`: what a client of ROS asks."""
    with (
        pytest.MonkeyPatch.context() as monkeypatch,
        own_directory(monkeypatch),
        LiveRig(make_config(sensors={"imu": IMU}, **{"duration_s": 3600.0, "bodies": BODIES})) as rig,
        Node("bridge") as node,
    ):
        backend = RecordingBackend()
        with Bridge(load({"namespace": "/sim"}), backend, node) as bridge:

            def call(name: str, /, **fields: Any) -> Any:
                return backend.services[f"/sim/{name}"].call(**fields)

            wait_for(lambda: bridge.update() or "/sim/get_entities" in backend.services)
            wait_for(lambda: bridge.update() or "/sim/reset_to" in backend.services)
            rig.send(rig.hover())
            rig.wait_for_status(lambda status: status.phase == "running")
            yield SimpleNamespace(rig=rig, call=call)


def set_state(world: Any, state: int) -> Any:
    wanted = message_class("simulation_interfaces/msg/SimulationState")(state=state)
    return world.call("set_simulation_state", state=wanted).result


def state_of(world: Any) -> int:
    response = world.call("get_simulation_state")
    assert response.result.result == OK
    return response.state.state


def entity_state(**fields: float) -> Any:
    made = message_class("simulation_interfaces/msg/EntityState")()
    made.pose.position.x, made.pose.position.y, made.pose.position.z = 1.0, -0.5, 1.5
    made.pose.orientation.z = made.pose.orientation.w = 0.5**0.5  # to the north
    made.twist.linear.x, made.twist.angular.x = 0.5, 0.25
    for name, value in fields.items():
        setattr(made.pose.orientation, name, value)
    return made


def test_states_and_steps(world: Any) -> None:
    """Playing, paused, on for some steps, stopped, paused at the start; what makes no sense is refused."""
    assert {20, 24, 25, 26, 31, 32} <= set(world.call("get_simulator_features").features.features)
    assert state_of(world) == PLAYING
    assert world.call("step_simulation", steps=1).result.result == FAILED
    assert "not paused" in world.call("step_simulation", steps=1).result.error_message
    assert set_state(world, PAUSED).result == OK
    assert set_state(world, PAUSED).result == ALREADY
    assert state_of(world) == PAUSED
    before = world.call("get_entity_state", entity="drone").state.header.stamp
    assert world.call("step_simulation", steps=3).result.result == OK
    after = world.call("get_entity_state", entity="drone").state.header.stamp
    assert (after.sec - before.sec) * 10**9 + after.nanosec - before.nanosec == 3 * PERIOD_NS
    assert set_state(world, STOPPED).result == OK
    assert state_of(world) == STOPPED
    assert set_state(world, PAUSED).result == OK
    assert state_of(world) == PAUSED
    assert set_state(world, QUITTING).result == UNSUPPORTED
    assert set_state(world, PLAYING).result == OK
    assert state_of(world) == PLAYING


def test_a_vehicle_is_set_and_seen(world: Any) -> None:
    """What is set while the simulation is stopped is where the run begins: exactly, in the world frame."""
    world.rig.send(world.rig.hover())  # time begins with the first command
    world.rig.wait_for_status(lambda status: status.stamp_ns > 0)
    refused = world.call("set_entity_state", entity="drone", state=entity_state())
    assert refused.result.result == INCORRECT_STATE
    assert set_state(world, STOPPED).result == OK
    assert state_of(world) == STOPPED
    assert world.call("set_entity_state", entity="drone", state=entity_state()).result.result == OK
    assert world.call("set_entity_state", entity="dog", state=entity_state()).result.result == NOT_FOUND
    bent = world.call("set_entity_state", entity="drone", state=entity_state(x=3.0))
    assert bent.result.result == INVALID_POSE
    found = world.call("get_entity_state", entity="drone").state
    assert found.header.frame_id == "map"
    assert found.pose.position == entity_state().pose.position
    assert found.pose.orientation.z == pytest.approx(0.5**0.5)
    assert found.twist.linear.x == pytest.approx(0.5)
    assert [found.twist.angular.x, found.twist.angular.y] == pytest.approx([0.25, 0.0], abs=1e-12)
    assert world.call("get_entity_state", entity="dog").result.result == NOT_FOUND
    assert world.call("get_entity_info", entity="drone").info.category.category == 1
    assert world.call("reset_simulation", scope=1).result.result == UNSUPPORTED
    assert world.call("reset_simulation", scope=0).result.result == OK
    away = world.call("get_entity_state", entity="drone").state.pose.position
    assert away != entity_state().pose.position


def test_filters(world: Any) -> None:
    make = message_class("simulation_interfaces/msg/EntityFilters")
    categories = message_class("simulation_interfaces/msg/EntityCategory")
    assert world.call("get_entities").entities == ["drone", "ball"]
    assert world.call("get_entities", filters=make(filter="^dr.n")).entities == ["drone"]
    assert world.call("get_entities", filters=make(filter="x$")).entities == []
    assert world.call("get_entities", filters=make(filter="(")).result.result == FAILED
    assert world.call("get_entities", filters=make(categories=[categories(category=2)])).entities == []
    tagged = make()
    tagged.tags.tags = ["red"]
    assert world.call("get_entities", filters=tagged).result.result == UNSUPPORTED
    both = world.call("get_entities_states")
    assert (both.entities, len(both.states)) == (["drone"], 1)  # the ball moves by itself


def test_a_reset_with_a_seed_and_a_pose_is_answered(world: Any) -> None:
    begin = message_class("neurosim/msg/Reset")(use_seed=True, seed=-1)
    refused = world.call("reset_to", begin=begin)
    assert (refused.success, "seed must be >= 0" in refused.message) == (False, True)
    begin = message_class("neurosim/msg/Reset")(use_pose=True)
    begin.pose.orientation.w = 3.0
    assert "no unit quaternion" in world.call("reset_to", begin=begin).message
    begin.pose.orientation.w, begin.pose.position.z = 1.0, 1.25
    state = world.rig.node.subscriber("/drone/odometry", msg.Odometry)
    assert world.call("reset_to", begin=begin).success
    wait_for(lambda: state.recv(SOON_S).position.tolist() == [0.0, 0.0, 1.25])


def pose_stamped(x: float, *, frame: str = "map", w: float = 1.0) -> Any:
    made = message_class("geometry_msgs/msg/PoseStamped")()
    made.header.frame_id, made.pose.position.x, made.pose.position.z, made.pose.orientation.w = (
        frame,
        x,
        1.5,
        w,
    )
    return made


def test_bodies_are_spawned_moved_and_deleted(world: Any) -> None:
    """While the simulation runs, with answers; the simulator's own settings say so."""

    def settings_of(name: str) -> Any:
        with world.rig.node.subscriber("/simulation", msg.Simulation) as said:
            return yaml.safe_load(said.recv(SOON_S).config)["bodies"][name]

    assert {0, 1, 14} <= set(world.call("get_simulator_features").features.features)
    assert [each.uri for each in world.call("get_spawnables").spawnables] == ["body:box"]
    codes = {
        101: {"uri": "body:ball"},
        102: {"uri": "body:box", "name": "crate"},
        103: {"uri": "robot.urdf"},
        104: {},
        109: {"uri": "body:box", "initial_pose": pose_stamped(1.0, w=3.0)},
        FAILED: {"uri": "body:box", "initial_pose": pose_stamped(1.0, frame="moon")},
        UNSUPPORTED: {"resource_string": "<sdf/>"},
    }
    for code, fields in codes.items():
        fields = {"initial_pose": pose_stamped(0.0), **fields}
        assert world.call("spawn_entity", **fields).result.result == code, fields
    assert not settings_of("box")["present"]
    spawned = world.call("spawn_entity", uri="body:box", initial_pose=pose_stamped(1.0))
    assert (spawned.result.result, spawned.entity_name) == (OK, "box")
    assert settings_of("box")["motion"]["position_m"] == [1.0, 0.0, 1.5]
    assert world.call("get_entities").entities == ["drone", "box", "ball"]
    assert world.call("get_entity_info", entity="box").info.category.category == 5
    assert world.call("get_spawnables").spawnables == []
    state = entity_state()
    assert world.call("set_entity_state", entity="box", state=state).result.result == UNSUPPORTED
    state.twist.linear.x = state.twist.angular.x = 0.0
    assert world.call("set_entity_state", entity="box", state=state).result.result == OK
    found = world.call("get_entity_state", entity="box").state
    assert found.pose.position == state.pose.position
    assert found.pose.orientation.z == pytest.approx(0.5**0.5)
    assert found.pose.orientation.w == pytest.approx(0.5**0.5)
    assert world.call("get_entity_state", entity="ball").result.result == FAILED
    assert world.call("get_entities_states").entities == ["drone", "box"]
    assert world.call("delete_entity", entity="drone").result.result == UNSUPPORTED
    assert world.call("delete_entity", entity="box").result.result == OK
    assert world.call("delete_entity", entity="box").result.result == NOT_FOUND
    assert world.call("get_entities").entities == ["drone", "ball"]
    assert not settings_of("box")["present"]


def test_parameters_of_the_simulator_are_set(world: Any) -> None:
    """One result for each, with the simulator's reason."""
    make, value = (message_class(f"rcl_interfaces/msg/Parameter{end}") for end in ("", "Value"))
    factor = make(name="live.real_time_factor", value=value(type=3, double_value=0.5))
    wrong = make(name="live.mode", value=value(type=4, string_value="lockstep"))
    nothing = make(name="live.overrun", value=value(type=0))
    results = world.call("set_parameters", parameters=[factor, wrong, nothing]).results
    assert [each.successful for each in results] == [True, False, False]
    assert "cannot be changed during a run" in results[1].reason
    assert "is neither a bool" in results[2].reason
    assert world.rig.simulator.config.live.real_time_factor == 0.5
    world.call("set_parameters", parameters=[make(name=factor.name, value=value(type=3, double_value=1.0))])
