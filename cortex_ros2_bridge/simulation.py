"""The services of `simulation_interfaces`, which other simulators have too, over those of Cortex.

What does not apply to a simulator whose vehicles are those of its settings (spawning, deleting, worlds) is
not offered; GetSimulatorFeatures says what is.
"""

from __future__ import annotations

import contextlib
import functools
import logging
import math
import re
from collections.abc import Callable
from typing import Any, NoReturn

import numpy as np

from cortex import Node, latest
from cortex import messages as msg
from cortex.service import Client
from cortex_ros2_bridge import frames
from cortex_ros2_bridge.backend.base import Backend
from cortex_ros2_bridge.backend.names import service_path
from cortex_ros2_bridge.config import BridgeConfig
from cortex_ros2_bridge.incoming import NOT_ACTIVE, ask
from cortex_ros2_bridge.msgs import message_class

logger = logging.getLogger(__name__)

PACKAGE = "simulation_interfaces"
SERVED = {"/reset": msg.Reset, "/pause": msg.Trigger, "/resume": msg.Trigger, "/step": msg.Step}
"""What a simulator of Cortex offers, and the requests."""
NEWS_S = 2.0
"""Longest wait for the state of a simulator, which says it five times a second [s]."""

_UNSUPPORTED, _OK, _NOT_FOUND, _INCORRECT_STATE, _FAILED = range(5)
_ALREADY, _INCORRECT_TRANSITION, _INVALID_POSE = 101, 103, 101
_STOPPED, _PLAYING, _PAUSED = range(3)
_ROBOT = 1
_TIME_AND_STATE = 3
_FEATURES = (8, 10, 11, 12, 20, 24, 25, 26, 31, 32)
"""Of SimulatorFeatures: categories, state and info of entities, reset, simulation states, steps."""


class _Refused(Exception):
    """What was asked is not done: the code of the answer, and why."""


class SimulationServices:
    """Answers for the simulator, until it is closed. One of several hosts answers for itself."""

    def __init__(
        self, node: Node, backend: Backend, config: BridgeConfig, is_active: Callable[[], bool]
    ) -> None:
        """Open the services; without the ROS package, rclpy has none, which is said.

        Args:
            node: Who calls the simulator.
            backend: Where the services are.
            config: Names topics and frames.
            is_active: Says whether requests may pass.
        """
        self._node = node
        self._is_active = is_active
        self._frames = config.frame_names
        self._starts_paused = False
        self._resources = contextlib.ExitStack()
        self._clients: dict[str, Client[Any, msg.SimulatorReply]] = {
            name: node.client(name, kind, msg.SimulatorReply) for name, kind in SERVED.items()
        }
        for client in self._clients.values():
            self._resources.callback(client.close)
        answers: dict[str, Callable[[Any, Any], None]] = {
            "GetSimulatorFeatures": self._features,
            "GetSimulationState": self._state,
            "SetSimulationState": self._set_state,
            "ResetSimulation": self._reset,
            "StepSimulation": self._step,
            "GetEntities": self._entities,
            "GetEntitiesStates": self._entities_states,
            "GetEntityInfo": self._info,
            "GetEntityState": self._entity_state,
            "SetEntityState": self._set_entity_state,
        }
        try:
            for name, answer in answers.items():
                path = config.ros_topic(f"/{service_path(name)}")
                serve = functools.partial(self._answer, answer)
                service = backend.service(path, f"{PACKAGE}/srv/{name}", serve)
                if service is not None:
                    self._resources.callback(service.close)
        except ValueError as error:
            logger.info("no services of %s: %s", PACKAGE, error)

        self.close = self._resources.close  # withdraws the services; a call that is under way is given up

    def _answer(self, answer: Callable[[Any, Any], None], request: Any, response: Any) -> Any:
        found = _OK, ""
        try:
            if not self._is_active():
                _refuse(_INCORRECT_STATE, NOT_ACTIVE)
            answer(request, response)
        except _Refused as refused:
            found = refused.args
        if hasattr(response, "result"):
            response.result.result, response.result.error_message = found
        return response

    # The simulation

    def _features(self, request: Any, response: Any) -> None:
        response.features.features = list(_FEATURES)
        response.features.custom_info = "Neurosim; SetEntityState while the simulation is stopped"

    def _state(self, request: Any, response: Any) -> None:
        response.state.state = self._state_of(self._news("/status", msg.SimulatorStatus))

    def _state_of(self, status: msg.SimulatorStatus) -> int:
        if status.phase == "paused":
            return _STOPPED if status.stamp_ns == 0 and not self._starts_paused else _PAUSED
        return _STOPPED if status.phase == "ended" else _PLAYING

    def _set_state(self, request: Any, response: Any) -> None:
        before, wanted = self._state_of(self._news("/status", msg.SimulatorStatus)), request.state.state
        if wanted not in (_STOPPED, _PLAYING, _PAUSED):
            _refuse(_UNSUPPORTED, "stopped, playing and paused are the states that can be asked for")
        if wanted == before:
            _refuse(_ALREADY, "it is in that state")
        self._call("/resume" if wanted == _PLAYING else "/pause")
        if wanted == _STOPPED:
            self._call("/reset")
        self._starts_paused = wanted == _PAUSED

    def _reset(self, request: Any, response: Any) -> None:
        if request.scope and request.scope & _TIME_AND_STATE != _TIME_AND_STATE:
            _refuse(_UNSUPPORTED, "time and state are reset together: SCOPE_DEFAULT, SCOPE_ALL, or both")
        self._call("/reset")

    def _step(self, request: Any, response: Any) -> None:
        self._call("/step", msg.Step(min(request.steps, 2**32 - 1)))

    # Entities: the vehicles

    def _entities(self, request: Any, response: Any) -> None:
        response.entities = self._fitting(request.filters)

    def _entities_states(self, request: Any, response: Any) -> None:
        response.entities = self._fitting(request.filters)
        response.states = [self._look_at(name) for name in response.entities]

    def _info(self, request: Any, response: Any) -> None:
        self._check_entity(request.entity)
        response.info.category.category = _ROBOT
        response.info.description = "a multirotor"

    def _entity_state(self, request: Any, response: Any) -> None:
        self._check_entity(request.entity)
        response.state = self._look_at(request.entity)

    def _set_entity_state(self, request: Any, response: Any) -> None:
        """Begin the run with the vehicle elsewhere; its time is 0 before and after."""
        self._check_entity(request.entity)
        if self._news("/status", msg.SimulatorStatus).stamp_ns:
            _refuse(_INCORRECT_STATE, "the simulation runs: stop it first (SetSimulationState)")
        state = request.state
        if state.header.frame_id not in ("", self._frames.ros(frames.WORLD), frames.WORLD):
            _refuse(_FAILED, f"a state in frame {state.header.frame_id!r}, known: the world")
        q = np.array([getattr(state.pose.orientation, axis) for axis in "xyzw"])
        rate = frames.rotate_back(q, _xyz(state.twist.angular))
        if not abs(math.hypot(*q.tolist()) - 1.0) < 1e-3:  # also refuses nan
            _refuse(_INVALID_POSE, f"the quaternion has not length 1: {q.tolist()}")
        position, velocity = _xyz(state.pose.position), _xyz(state.twist.linear)
        self._call("/reset", msg.Reset(None, request.entity, position, q, velocity, rate))

    def _fitting(self, filters: Any) -> list[str]:
        """Return the names of the vehicles that filters leave."""
        if filters.tags.tags or filters.bounds.type:
            _refuse(_UNSUPPORTED, "entities have neither tags nor bounds")
        try:
            pattern = re.compile(filters.filter)
        except re.error as error:
            _refuse(_FAILED, f"the filter {filters.filter!r} is no regular expression: {error}")
        robots = not filters.categories or any(each.category == _ROBOT for each in filters.categories)
        return [name for name in self._names() if robots and pattern.search(name)]

    def _check_entity(self, name: str) -> None:
        if name not in self._names():
            _refuse(_NOT_FOUND, f"no entity {name!r}, known: {', '.join(self._names())}")

    def _names(self) -> list[str]:
        return [each.name for each in self._news("/status", msg.SimulatorStatus).vehicles]

    def _look_at(self, name: str) -> Any:
        """Return the EntityState of a vehicle, in the map frame."""
        seen = self._news(f"/{name}/odometry", msg.Odometry)
        state = message_class(f"{PACKAGE}/msg/EntityState")()
        state.header.stamp.sec, state.header.stamp.nanosec = divmod(seen.stamp_ns, 1_000_000_000)
        state.header.frame_id = self._frames.ros(frames.WORLD)
        parts = (
            (state.pose.position, "xyz", seen.position),
            (state.pose.orientation, "xyzw", seen.orientation),
            (state.twist.linear, "xyz", seen.velocity),
            (state.twist.angular, "xyz", frames.rotate(seen.orientation, seen.body_rate)),
        )
        for part, axes, values in parts:
            for axis, value in zip(axes, values.tolist(), strict=True):
                setattr(part, axis, value)
        return state

    # Cortex

    def _call(self, name: str, request: Any = None) -> None:
        reason = ask(self._clients[name], SERVED[name]() if request is None else request)[0]
        if reason:
            _refuse(_FAILED, reason)

    def _news(self, topic: str, kind: type[Any]) -> Any:
        """Return the newest message of a topic: the latched one, or the next."""
        with self._node.subscriber(topic, kind, policy=latest()) as subscriber:
            try:
                return subscriber.recv(NEWS_S)
            except TimeoutError:
                _refuse(_FAILED, f"the simulator says nothing on {topic}")


def _refuse(code: int, reason: str) -> NoReturn:
    raise _Refused(code, reason)


def _xyz(vector: Any) -> Any:
    return np.array([vector.x, vector.y, vector.z])
