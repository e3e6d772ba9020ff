"""Services of a simulator: requests wait for the loop that flies, which answers between control periods."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from cortex import Node
from cortex.messages import Parameters, SimulatorReply, Step
from neurosim_core.config import SimulationConfig
from neurosim_core.live.parameters import change
from neurosim_core.live.topics import SERVICES

ANSWER_DEADLINE_S = 30.0
"""How long a request waits for its answer."""
STEP_DEADLINE_S = 60.0
"""How long a request for steps does, at most: it may have to wait for the commands of a controller."""


@dataclass(eq=False)
class Request:
    """A request that waits; `answer` ends that."""

    service: str
    """Such as "/reset"."""
    message: Any
    """As it came."""
    config: SimulationConfig | None = None
    """What `/set_parameters` leads to."""
    _state: str = "waits"
    """"waits", "taken", "abandoned" (nobody waits for the answer any more) or "answered"."""
    _reason: str = ""
    _changed: threading.Condition = field(default_factory=threading.Condition)

    @property
    def abandoned(self) -> bool:
        """Nobody waits for the answer any more."""
        return self._state == "abandoned"

    def take(self) -> bool:
        """Begin with it; False if nobody waits for it any more, so that it is not to be done."""
        with self._changed:
            if self._state != "waits":
                return False
            self._state = "taken"
            return True

    def answer(self, reason: str = "") -> bool:
        """Say that it is done, or why not; False if nobody waits for that any more."""
        with self._changed:
            if self.abandoned:
                return False
            self._state, self._reason = "answered", reason
            self._changed.notify_all()
            return True

    def wait(self, timeout_s: float) -> str:
        """Wait for the answer; return why it was not done, empty if it was.

        One that was taken just now is being done: its answer is waited for as long again. Steps that have
        not come to their end are given up.
        """
        with self._changed:
            done = self._changed.wait_for(lambda: self._state == "answered", timeout_s)
            if not done and self._state == "taken" and self.service != "/step":
                done = self._changed.wait_for(lambda: self._state == "answered", timeout_s)
            if done:
                return self._reason
            begun, self._state = self._state == "taken", "abandoned"
        if not begun:
            return f"no answer within {timeout_s:g} s; it will not be done"
        if self.service == "/step":
            return f"not over within {timeout_s:g} s: it stops where it is"
        return f"no answer within {2 * timeout_s:g} s; it may still be done"


class Steps:
    """Leave of a paused run to go on for some control periods; true as long as some are left."""

    def __init__(self) -> None:
        self._request: Request | None = None
        self._left = 0

    def __bool__(self) -> bool:
        return self._left > 0

    def start(self, request: Request) -> None:
        """Give leave for as many as a request asks for; the answer comes when they are over."""
        self._request, self._left = request, request.message.count
        if not self._left:
            self.stop()

    @property
    def end_next(self) -> bool:
        """Whether the next control period is the last."""
        return self._left == 1

    def count(self) -> None:
        """Note that a control period is over."""
        if self._left:
            self._left -= 1
            if not self._left:
                self.stop()

    def stop(self, reason: str = "") -> None:
        """Answer the request, if there is one: they are over, or there is a reason why not."""
        request, self._request, self._left = self._request, None, 0
        if request is not None:
            request.answer(reason)

    def check(self) -> None:
        """Stop if nobody waits for the answer any more."""
        if self._request is not None and self._request.abandoned:
            self.stop()


class Requests:
    """Offers the services, and hands what is asked to one loop.

    Handlers of one node run one after another, so `/step`, which may take long, is offered by another node
    than the requests that can end it.
    """

    def __init__(
        self,
        node: Node,
        step_node: Node,
        *,
        config: Callable[[], SimulationConfig],
        state: Callable[[], tuple[int, str]],
        on_request: Callable[[], object],
    ) -> None:
        """Offer the services.

        Args:
            node: For all but `/step`.
            step_node: For `/step`.
            config: Gives the settings that hold.
            state: Gives simulated time [ns] and phase.
            on_request: Called, from other threads, when there is something to `take`.
        """
        self._config = config
        self._state = state
        self._on_request = on_request
        self._waiting: deque[Request] = deque()
        self._open: set[Request] = set()
        self._lock = threading.Lock()
        self._closed = False
        self._withdraw = [
            (step_node if service == "/step" else node).service(
                service, request_type, reply_type, self._handler(service)
            )
            for service, (request_type, reply_type) in SERVICES.items()
        ]

    def __bool__(self) -> bool:
        """Whether there is something to `take`."""
        return bool(self._waiting)

    def take(self) -> Request | None:
        """Return the next request, which is then waited for until it is done; None if there is none."""
        while self._waiting:
            request = self._waiting.popleft()
            if request.take():
                return request
        return None

    def close(self) -> None:
        """Offer the services no more, and answer whoever waits."""
        for withdraw in self._withdraw:
            withdraw()
        with self._lock:
            self._closed = True
            waiting = list(self._open)
        for request in waiting:
            request.answer("the simulator has ended")

    def _handler(self, service: str) -> Callable[[Any], SimulatorReply]:
        answer_deadline_s = ANSWER_DEADLINE_S

        def handle(message: Any) -> SimulatorReply:
            deadline_s = answer_deadline_s
            if isinstance(message, Step):  # for as long as its client waits: that tells whether there is one
                deadline_s = min(max(0.0, message.timeout_s), STEP_DEADLINE_S)
            reason = self._ask(Request(service, message), deadline_s)
            stamp_ns, phase = self._state()
            return SimulatorReply(accepted=not reason, reason=reason, stamp_ns=stamp_ns, phase=phase)

        return handle

    def _ask(self, request: Request, deadline_s: float) -> str:
        """Let the loop do it; return why not, empty if it was done."""
        if isinstance(request.message, Parameters):
            try:
                request.config = change(self._config(), request.message.to_dict())
            except ValueError as error:
                return str(error)
        with self._lock:
            if self._closed:
                return "the simulator has ended"
            self._open.add(request)
        self._waiting.append(request)
        self._on_request()
        reason = request.wait(deadline_s)
        with self._lock:
            self._open.discard(request)
        return reason
