"""The services of `simulation_interfaces`, which other simulators have too, over those of Cortex.

What does not apply (worlds, named poses, tags) is not offered; GetSimulatorFeatures says what is.
"""

from __future__ import annotations

import contextlib
import functools
import logging
from collections.abc import Callable
from typing import Any

from cortex import Node, latest
from cortex import messages as msg
from cortex.service import Client
from cortex_ros2_bridge.backend.base import Backend
from cortex_ros2_bridge.backend.names import service_path
from cortex_ros2_bridge.config import BridgeConfig
from cortex_ros2_bridge.entities import (
    FAILED,
    INCORRECT_STATE,
    OK,
    PACKAGE,
    UNSUPPORTED,
    Entities,
    Refused,
    refuse,
)
from cortex_ros2_bridge.incoming import NOT_ACTIVE, ask
from cortex_ros2_bridge.msgs import message_class
from cortex_ros2_bridge.parameter_values import value_of

logger = logging.getLogger(__name__)

SERVED = {"/reset": msg.Reset, "/pause": msg.Trigger, "/resume": msg.Trigger, "/step": msg.Step}
"""What a simulator of Cortex offers, and the requests."""
NEWS_S = 2.0
"""Longest wait for the state of a simulator, which says it five times a second [s]."""

_ALREADY, _INCORRECT_TRANSITION = 101, 103
_STOPPED, _PLAYING, _PAUSED = range(3)
_TIME_AND_STATE = 3
_FEATURES = (0, 1, 8, 10, 11, 12, 14, 20, 24, 25, 26, 31, 32)
"""Of SimulatorFeatures: spawning, categories, state and info of entities, reset, simulation states, steps."""


class SimulationServices:
    """Answers for the simulator, until it is closed. One of several hosts answers for itself.

    Without the ROS package, rclpy has no such services, which is said.
    """

    def __init__(
        self, node: Node, backend: Backend, config: BridgeConfig, is_active: Callable[[], bool]
    ) -> None:
        self._node = node
        self._is_active = is_active
        self._starts_paused = False
        self._resources = contextlib.ExitStack()
        self._clients: dict[str, Client[Any, msg.SimulatorReply]] = {
            name: node.client(name, kind, msg.SimulatorReply) for name, kind in SERVED.items()
        }
        self._clients["/set_parameters"] = node.client("/set_parameters", msg.Parameters, msg.SimulatorReply)
        for client in self._clients.values():
            self._resources.callback(client.close)
        answers: dict[str, Callable[[Any, Any], None]] = {
            "GetSimulatorFeatures": self._features,
            "GetSimulationState": self._state,
            "SetSimulationState": self._set_state,
            "ResetSimulation": self._reset,
            "StepSimulation": self._step,
            **Entities(self._call, self._news, config.frame_names).answers,
        }
        try:
            for name, answer in answers.items():
                path = config.ros_topic(f"/{service_path(name)}")
                serve = functools.partial(self._answer, answer)
                service = backend.service(path, f"{PACKAGE}/srv/{name}", serve)
                self._resources.callback(service.close)
        except ValueError as error:
            logger.info("no services of %s: %s", PACKAGE, error)
        service = backend.service(
            config.ros_topic("/set_parameters"), "rcl_interfaces/srv/SetParameters", self._set_parameters
        )
        self._resources.callback(service.close)

        self.close = self._resources.close  # withdraws the services; a call that is under way is given up

    def _answer(self, answer: Callable[[Any, Any], None], request: Any, response: Any) -> Any:
        found = OK, ""
        try:
            if not self._is_active():
                refuse(INCORRECT_STATE, NOT_ACTIVE)
            answer(request, response)
        except Refused as refused:
            found = refused.args
        if hasattr(response, "result"):
            response.result.result, response.result.error_message = found
        return response

    # The simulation

    def _features(self, request: Any, response: Any) -> None:
        response.features.features = list(_FEATURES)
        response.features.custom_info = (
            "Neurosim; SetEntityState of vehicles while the simulation is stopped; bodies of the settings "
            "are spawned and deleted (GetSpawnables), vehicles are not"
        )

    def _state(self, request: Any, response: Any) -> None:
        response.state.state = self._state_of(self._news("/status", msg.SimulatorStatus))

    def _state_of(self, status: msg.SimulatorStatus) -> int:
        if status.phase == "paused":
            return _STOPPED if status.stamp_ns == 0 and not self._starts_paused else _PAUSED
        return _STOPPED if status.phase == "ended" else _PLAYING

    def _set_state(self, request: Any, response: Any) -> None:
        before, wanted = self._state_of(self._news("/status", msg.SimulatorStatus)), request.state.state
        if wanted not in (_STOPPED, _PLAYING, _PAUSED):
            refuse(UNSUPPORTED, "stopped, playing and paused are the states that can be asked for")
        if wanted == before:
            refuse(_ALREADY, "it is in that state")
        self._call("/resume" if wanted == _PLAYING else "/pause")
        if wanted == _STOPPED:
            self._call("/reset")
        self._starts_paused = wanted == _PAUSED

    def _reset(self, request: Any, response: Any) -> None:
        if request.scope and request.scope & _TIME_AND_STATE != _TIME_AND_STATE:
            refuse(UNSUPPORTED, "time and state are reset together: SCOPE_DEFAULT, SCOPE_ALL, or both")
        self._call("/reset")

    def _step(self, request: Any, response: Any) -> None:
        self._call("/step", msg.Step(min(request.steps, 2**32 - 1)))

    def _set_parameters(self, request: Any, response: Any) -> Any:
        """Change settings of the simulator, one after another."""
        make = message_class("rcl_interfaces/msg/SetParametersResult")
        response.results = []
        for parameter in request.parameters:
            reason = NOT_ACTIVE
            if self._is_active():
                value = value_of(parameter.value)
                text = str(value) if isinstance(value, list) else value
                try:
                    asked = msg.Parameters.of({parameter.name: text})
                    reason = ask(self._clients["/set_parameters"], asked)[0]
                except TypeError as error:
                    reason = str(error)
            response.results = [*response.results, make(successful=not reason, reason=reason)]
        return response

    # Cortex

    def _call(self, name: str, request: Any = None) -> None:
        reason = ask(self._clients[name], SERVED[name]() if request is None else request)[0]
        if reason:
            refuse(FAILED, reason)

    def _news(self, topic: str, kind: type[Any]) -> Any:
        """Return the newest message of a topic: the latched one, or the next."""
        with self._node.subscriber(topic, kind, policy=latest()) as subscriber:
            try:
                return subscriber.recv(NEWS_S)
            except TimeoutError:
                refuse(FAILED, f"the simulator says nothing on {topic}")
