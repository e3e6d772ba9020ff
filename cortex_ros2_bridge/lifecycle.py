"""The bridge as a managed node: its states, and the services and the topic by which ROS changes them.

    unconfigured --configure--> inactive --activate--> active        messages pass only in the last
                 <--cleanup---           <-deactivate-               shutdown: from each of them, for good

`ros2 lifecycle`, the LifecycleNode of launch_ros and lifecycle managers ask for transitions; each is done
when its answer comes. Routes are open while the bridge is inactive, so that others see its topics.

Reference: design.ros2.org, "Managed nodes"; numbers and names are those of lifecycle_msgs and rcl_lifecycle.
"""

from __future__ import annotations

import contextlib
import functools
import logging
import threading
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

from cortex_ros2_bridge import cdr
from cortex_ros2_bridge.backend.base import Backend, BackendError, Qos
from cortex_ros2_bridge.msgs import message_class

if TYPE_CHECKING:
    from cortex_ros2_bridge.bridge import Bridge

logger = logging.getLogger(__name__)

UNCONFIGURED, INACTIVE, ACTIVE, FINALIZED = 1, 2, 3, 4
_ERROR = 15
STATES = {
    0: "unknown",
    UNCONFIGURED: "unconfigured",
    INACTIVE: "inactive",
    ACTIVE: "active",
    FINALIZED: "finalized",
    10: "configuring",
    11: "cleaningup",
    12: "shuttingdown",
    13: "activating",
    14: "deactivating",
    _ERROR: "errorprocessing",
}
"""Names of states by their numbers."""


class Transition(NamedTuple):
    """From a state to another one."""

    number: int
    label: str
    start: int
    goal: int


_CALLS = (
    Transition(1, "configure", UNCONFIGURED, 10),
    Transition(2, "cleanup", INACTIVE, 11),
    Transition(3, "activate", INACTIVE, 13),
    Transition(4, "deactivate", ACTIVE, 14),
    Transition(5, "shutdown", UNCONFIGURED, 12),
    Transition(6, "shutdown", INACTIVE, 12),
    Transition(7, "shutdown", ACTIVE, 12),
)
"""What can be asked for."""
_OUTCOMES = {
    10: (10, INACTIVE, UNCONFIGURED, _ERROR),
    11: (20, UNCONFIGURED, INACTIVE, _ERROR),
    13: (30, ACTIVE, INACTIVE, _ERROR),
    14: (40, INACTIVE, ACTIVE, _ERROR),
    12: (50, FINALIZED, FINALIZED, _ERROR),
    _ERROR: (60, UNCONFIGURED, FINALIZED, FINALIZED),
}
"""By the state on the way: number of the transition of success, and where success, failure and error lead."""
TRANSITIONS = _CALLS + tuple(
    Transition(first + number, f"transition_{how}", state, goal)
    for state, (first, *goals) in _OUTCOMES.items()
    for number, (how, goal) in enumerate(zip(("success", "failure", "error"), goals, strict=True))
)
"""All of them, also those that follow by themselves."""
_TRANSITIONS = "GetAvailableTransitions"


class Lifecycle:
    """Answers the services of a managed node of a full name, until it is closed."""

    def __init__(self, managed: Bridge, backend: Backend, node: str) -> None:
        self._managed = managed
        self._lock = threading.Lock()
        self._resources = contextlib.ExitStack()
        states = [_state(number) for number in STATES]
        graph = [_described(each) for each in TRANSITIONS]
        answers: tuple[tuple[str, str, str, Callable[[Any], Any]], ...] = (
            ("change_state", "ChangeState", "success", self._change),
            ("get_state", "GetState", "current_state", lambda _: _state(managed.state)),
            ("get_available_states", "GetAvailableStates", "available_states", lambda _: states),
            ("get_available_transitions", _TRANSITIONS, "available_transitions", self._available),
            ("get_transition_graph", _TRANSITIONS, "available_transitions", lambda _: graph),
        )
        for name, kind, field, value in answers:
            answer = functools.partial(_answer, field, value)
            service = backend.service(f"{node}/{name}", f"lifecycle_msgs/srv/{kind}", answer)
            self._resources.callback(service.close)
        self._events = backend.publisher(
            f"{node}/transition_event", "lifecycle_msgs/msg/TransitionEvent", Qos()
        )
        self._resources.callback(self._events.close)
        self.close = self._resources.close  # withdraws services and topic

    def change(self, number: int, label: str = "") -> bool:
        """Do a transition, by its label if there is one, else by its number; returns whether it was done."""
        with self._lock:
            wanted = [
                call
                for call in _CALLS
                if call.start == self._managed.state
                and (call.label == label if label else call.number == number)
            ]
            if not wanted:
                what, state = label or str(number), STATES[self._managed.state]
                logger.warning("the transition %s does not begin in the state %s", what, state)
                return False
            (call,) = wanted
            first, goal, failed, _ = _OUTCOMES[call.goal]
            self._tell(call)
            try:
                self._managed.change_state(goal)
            except Exception:  # whatever went wrong: who manages gets an answer, and may try again
                logger.exception("the transition %s failed", call.label)
                self._managed.state = failed
                self._tell(TRANSITIONS_BY_NUMBER[first + 1])
                return False
            self._tell(TRANSITIONS_BY_NUMBER[first])
            logger.info("%s", STATES[goal])
            return True

    def _change(self, request: Any) -> bool:
        return self.change(request.transition.id, request.transition.label)

    def _available(self, _request: Any) -> list[Any]:
        return [_described(each) for each in TRANSITIONS if each.start == self._managed.state]

    def _tell(self, transition: Transition) -> None:
        event = message_class("lifecycle_msgs/msg/TransitionEvent")(timestamp=time.time_ns())
        _fill(event, transition)
        with contextlib.suppress(BackendError):  # the backend ends
            self._events.publish(cdr.encode(event))


TRANSITIONS_BY_NUMBER = {each.number: each for each in TRANSITIONS}


def _answer(field: str, value: Callable[[Any], Any], request: Any, response: Any) -> Any:
    setattr(response, field, value(request))
    return response


def _state(number: int) -> Any:
    return message_class("lifecycle_msgs/msg/State")(id=number, label=STATES[number])


def _described(transition: Transition) -> Any:
    return _fill(message_class("lifecycle_msgs/msg/TransitionDescription")(), transition)


def _fill(message: Any, transition: Transition) -> Any:
    """Write a transition into a message that has a place for it and for its two states."""
    message.transition.id, message.transition.label = transition.number, transition.label
    message.start_state, message.goal_state = _state(transition.start), _state(transition.goal)
    return message
