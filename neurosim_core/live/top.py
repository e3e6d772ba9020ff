"""`neurosim top`: a running simulator in the terminal: real-time factor, rates, losses, latency."""

from __future__ import annotations

import contextlib
from collections import deque

from rich.console import Console, Group
from rich.live import Live
from rich.markdown import Markdown
from rich.text import Text

from cortex import Node, latest
from cortex.messages import SimulatorStatus
from neurosim_core.live.call import SensorRates, describe_status, no_simulator
from neurosim_core.live.topics import STATUS
from neurosim_core.signals import raise_at_signals

_BARS = " ▁▂▃▄▅▆▇█"
_HISTORY = 60
_NEXT_S = 1.0
_LOST_AFTER_S = 5.0


class Dashboard:
    """What `top` shows, from one status to the next."""

    def __init__(self) -> None:
        self._factors: deque[float] = deque(maxlen=_HISTORY)
        self._rates = SensorRates()

    def update(self, status: SimulatorStatus) -> Group:
        """Return the screen after a status."""
        self._factors.append(status.real_time_factor)
        most = max(1.0, status.real_time_factor_wanted, *self._factors)
        bars = "".join(_BARS[round(factor / most * (len(_BARS) - 1))] for factor in self._factors)
        return Group(
            Text.assemble(("real-time factor ", "dim"), (bars, "green"), f" {status.real_time_factor:.2f}"),
            Markdown(describe_status(status, rates_hz=self._rates.update(status))),
        )


def top(*, once: bool = False, timeout_s: float = 10.0) -> int:
    """Show the status until Ctrl-C, or until the run has ended.

    `once`: print the screen after two statuses, and stop. `timeout_s`: how long to wait for a simulator [s].
    """
    console, dashboard = Console(highlight=False), Dashboard()
    with (
        raise_at_signals() as raise_again,
        Node("top") as node,
        node.subscriber(STATUS, SimulatorStatus, policy=latest()) as statuses,
    ):
        try:
            screen = dashboard.update(statuses.recv(timeout_s))
        except TimeoutError:
            raise RuntimeError(no_simulator(timeout_s)) from None
        if once:
            with contextlib.suppress(TimeoutError):  # of a run that has ended there is no other
                screen = dashboard.update(statuses.recv(_NEXT_S))
            console.print(screen)
            return 0
        with Live(screen, console=console, screen=console.is_terminal, auto_refresh=False) as live:
            while True:
                raise_again()
                try:
                    status = statuses.recv(_LOST_AFTER_S)
                except TimeoutError:
                    break
                live.update(dashboard.update(status), refresh=True)
                if status.phase == "ended":
                    break
    console.print("the simulator has ended")
    return 0
