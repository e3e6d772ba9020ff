"""Services of a simulator: requests wait for the loop that flies, which answers between control periods."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from cortex import Node
from cortex.messages import Parameters, SimulatorReply
from neurosim_core.config import SimulationConfig
from neurosim_core.nodes.parameters import change
from neurosim_core.nodes.topics import SERVICES

ANSWER_DEADLINE_S = 30.0
"""How long a request waits for its answer."""
STEP_DEADLINE_S = 60.0
"""How long a request for steps does: it may have to wait for the commands of a controller."""


@dataclass(eq=False)
class Request:
    """A request that waits; `answer` ends that."""

    service: str
    """Such as "/reset"."""
    message: Any
    """As it came."""
    config: SimulationConfig | None = None
    """What `/set_parameters` leads to."""
    abandoned: bool = False
    """Nobody waits for the answer any more."""
    _answered: threading.Event = field(default_factory=threading.Event)
    _reason: str = ""

    def answer(self, reason: str = "") -> None:
        """Say that it is done, or why not."""
        self._reason = reason
        self._answered.set()

    def wait(self, timeout_s: float) -> str:
        """Wait for the answer; return why it was not done, empty if it was."""
        if not self._answered.wait(timeout_s):
            self.abandoned = True
            return f"no answer within {timeout_s:g} s"
        return self._reason


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
        """Return the next request; None if there is none."""
        while self._waiting:
            request = self._waiting.popleft()
            if not request.abandoned:
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
        deadline_s = STEP_DEADLINE_S if service == "/step" else ANSWER_DEADLINE_S

        def handle(message: Any) -> SimulatorReply:
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
