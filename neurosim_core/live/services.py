"""Services of a simulator: requests wait for the loop that flies, which answers between control periods."""

from __future__ import annotations

import contextlib
import difflib
import json
import re
import threading
from collections import deque
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from dataclasses import dataclass, field
from typing import Any

from cortex import Node
from cortex.messages import Parameters, SimulatorReply, Step
from neurosim_core.config import SimulationConfig, load_config
from neurosim_core.live.topics import SERVICES, STEP_DEADLINE_S
from neurosim_core.settings_file import ConfigError

ANSWER_DEADLINE_S = 30.0
"""How long a request waits for its answer [s]."""
ENDED = "the simulator has ended"

CHANGEABLE = (
    "live.real_time_factor",
    "live.overrun",
    "live.command_timeout_s",
    "live.fail_safe",
    "live.command_deadline_s",
    "links.NAME.SETTING",
    "control.gains.GAIN",
    "bodies.NAME.present",
    "bodies.NAME.motion.SETTING",
    "vehicles.NAME.links.NAME.SETTING",
    "vehicles.NAME.control.gains.GAIN",
)
"""Keys of `/set_parameters`; words in capitals stand for any name."""

_PATTERNS = tuple(re.compile(re.sub("[A-Z]{2,}", r"\\w+", key.replace(".", r"\."))) for key in CHANGEABLE)


def change_parameters(
    config: SimulationConfig, values: Mapping[str, bool | int | float | str | None]
) -> SimulationConfig:
    """Return a configuration with other values.

    `values`: new values by dotted key; see `CHANGEABLE`.
    """
    for key, value in values.items():
        if not any(pattern.fullmatch(key) for pattern in _PATTERNS):
            close = difflib.get_close_matches(key, CHANGEABLE, n=1, cutoff=0.8)
            hint = f" (did you mean {close[0]}?)" if close else ""
            allowed = ", ".join(CHANGEABLE)
            raise ValueError(f"{key} cannot be changed during a run{hint}; allowed are {allowed}")
        if value is None:
            raise ValueError(f"{key}: no value is given")
        if key.startswith("bodies.") and (name := key.split(".")[1]) not in config.bodies:
            raise ValueError(f"no body is called {name}, known: {', '.join(config.bodies) or 'none'}")
    try:
        return load_config(config.model_dump(mode="json"), overrides=_with_lists(values))
    except ConfigError as error:
        reasons = str(error).splitlines()[1:]
        raise ValueError("; ".join(line.strip() for line in reasons)) from None


def _with_lists(values: Mapping[str, bool | int | float | str | None]) -> dict[str, Any]:
    """Return values in which texts such as "[1, 2, 3]" are lists: a message has none."""
    return {
        key: json.loads(value)
        if isinstance(value, str) and re.fullmatch(r"\[[-+.\deE, ]*\]", value)
        else value
        for key, value in values.items()
    }


@dataclass(eq=False)
class Request:
    """A request whose client waits for `answer`.

    A client that gives up cancels the request if the loop has not begun with it.
    """

    service: str
    """Such as "/reset"."""
    message: Any
    """As it came."""
    config: SimulationConfig | None = None
    """The settings that `/set_parameters` leads to."""
    is_abandoned: bool = False
    """The client has given up."""
    future: Future[str] = field(default_factory=Future)

    def answer(self, reason: str = "") -> None:
        """Tell the client that it is done, or why not."""
        if not self.future.done():
            self.future.set_result(reason)

    def wait(self, timeout_s: float) -> str:
        """Wait for the answer; return why the request was not done, empty if it was.

        A request that the loop has begun with is waited for twice as long; steps are ended instead.
        """
        with contextlib.suppress(TimeoutError):
            return self.future.result(timeout_s)
        if self.future.cancel():
            return f"no answer within {timeout_s:g} s; it will not be done"
        if self.service == "/step":
            self.is_abandoned = True
            return f"not over within {timeout_s:g} s: it stops where it is"
        with contextlib.suppress(TimeoutError):
            return self.future.result(timeout_s)
        return f"no answer within {2 * timeout_s:g} s; it may still be done"


class Steps:
    """Control periods that a paused run may still fly; true while there are some."""

    def __init__(self) -> None:
        self._request: Request | None = None
        self._left = 0

    def __bool__(self) -> bool:
        return self._left > 0

    @property
    def is_last(self) -> bool:
        """Whether the next control period is the last."""
        return self._left == 1

    def start(self, request: Request) -> None:
        """Allow as many as a request asks for; the answer follows the last one."""
        self._request, self._left = request, request.message.count
        if not self._left:
            self.stop()

    def count(self) -> None:
        """Count a control period."""
        if self._left == 1:
            self.stop()
        self._left = max(self._left - 1, 0)

    def stop(self, reason: str = "") -> None:
        """Allow no more, and answer the request: done, or why not."""
        request, self._request, self._left = self._request, None, 0
        if request is not None:
            request.answer(reason)

    def check(self) -> None:
        """Allow no more if the client has given up."""
        if self._request is not None and self._request.is_abandoned:
            self.stop()


class Services:
    """Offers the services, and hands their requests to the loop.

    The handlers of one node run one after another, so a second node offers `/step`, which may take long.
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

        `node`: for all but `/step`. `step_node`: for `/step`. `state`: returns simulated time [ns] and phase.
        `on_request`: called from other threads when there is something to `take`.
        """
        self._config = config
        self._state = state
        self._on_request = on_request
        self._waiting: deque[Request] = deque()
        self._open: set[Request] = set()
        self._lock = threading.Lock()
        self._closed = False
        self._withdraw = [
            (step_node if service == "/step" else node).service(service, *types, self._handler(service))
            for service, types in SERVICES.items()
        ]

    def __bool__(self) -> bool:
        """Whether there is something to `take`."""
        return bool(self._waiting)

    def take(self) -> Request | None:
        """Return the next request, to be answered; None if there is none."""
        while self._waiting:
            request = self._waiting.popleft()
            if request.future.set_running_or_notify_cancel():
                return request
        return None

    def close(self) -> None:
        """Withdraw the services, and answer all clients that wait."""
        for withdraw in self._withdraw:
            withdraw()
        with self._lock:
            self._closed = True
            waiting = list(self._open)
        for request in waiting:
            request.answer(ENDED)

    def _handler(self, service: str) -> Callable[[Any], SimulatorReply]:
        def handle(message: Any) -> SimulatorReply:
            deadline_s = ANSWER_DEADLINE_S
            if isinstance(message, Step):  # for as long as its client waits
                deadline_s = min(max(0.0, message.timeout_s), STEP_DEADLINE_S)
            reason = self._ask(Request(service, message), deadline_s)
            stamp_ns, phase = self._state()
            return SimulatorReply(accepted=not reason, reason=reason, stamp_ns=stamp_ns, phase=phase)

        return handle

    def _ask(self, request: Request, deadline_s: float) -> str:
        """Let the loop handle a request; return why it was not done, empty if it was."""
        if isinstance(request.message, Parameters):
            try:
                request.config = change_parameters(self._config(), request.message.to_dict())
            except ValueError as error:
                return str(error)
        with self._lock:
            if self._closed:
                return ENDED
            self._open.add(request)
        self._waiting.append(request)
        self._on_request()
        reason = request.wait(deadline_s)
        with self._lock:
            self._open.discard(request)
        return reason
