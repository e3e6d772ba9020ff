"""`neurosim view`: shows what a running simulator publishes, in Rerun.

It subscribes to every sensor that it shows, and so makes the simulator compute it. Of pictures it takes the
newest, of everything else all messages, and it counts those that it misses.
"""

from __future__ import annotations

import contextlib
import itertools
import math
import threading
import time
import webbrowser
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import yaml
from rich.console import Console

from cortex import Node, Subscriber, TypeMismatch, latest
from cortex.messages import Simulation
from neurosim_core.live.page import ControlPage
from neurosim_core.live.session import LiveSession, ViewOptions
from neurosim_core.live.topics import SIMULATION
from neurosim_core.settings_file import ConfigError
from neurosim_core.signals import stop_at_signals
from neurosim_core.view.rerun_sdk import RerunFiles, check_new_file, import_rerun
from neurosim_core.view.rerun_viewer import RerunViewer, ViewerEnded, has_display

POLL_S = 0.01
SEND_S = 0.1
"""How often the viewer gets what has been logged [s]."""
OVER_S = 0.3
"""How long the last messages may take after the end of a flight [s]."""
EVENT_WINDOW_MAX_S = 10.0
_WITHOUT_WINDOW = "`neurosim view --web` serves a page, `neurosim view --save FILE.rrd` writes a file"


def view(
    *,
    web: bool = False,
    save: Path | None = None,
    only: Sequence[str] | None = None,
    event_window_s: float = 0.02,
    image_rate_hz: float = 15.0,
    port: int = 0,
    open_browser: bool = True,
) -> int:
    """Show what a simulator publishes, until interrupted; wait for it, and for the next one when it is gone.

    Returns 0 if the flight is over and saved, or the window was closed; 130 if interrupted.

    Args:
        web: Serve a page for the browsers of this machine instead of opening a window.
        save: File to write instead, which must not exist yet; after a reset NAME-2.rrd, ...
        only: Sensors to show; None: all.
        event_window_s: Time in one picture of events [s].
        image_rate_hz: Most images of a sensor a second, by the wall clock [Hz].
        port: Port of the page; 0: any.
        open_browser: Open the page.
    """
    if save is not None:
        check_new_file(save)
    if only is not None and not all(name.strip() for name in only):
        raise ValueError(f"sensors to show are names, such as events,imu, got {','.join(only)!r}")
    if not 1e-4 <= event_window_s <= EVENT_WINDOW_MAX_S:
        raise ValueError(f"the event window must be 0.0001 to {EVENT_WINDOW_MAX_S:g} s, got {event_window_s}")
    if not 0.0 < image_rate_hz <= 1000.0:
        raise ValueError(f"the image rate must be > 0 and <= 1000 Hz, got {image_rate_hz}")
    if not 0 <= port <= 65535:
        raise ValueError(f"a port is 0 to 65535, got {port}")
    if save is None and not web and not has_display():
        raise ValueError(f"there is no display to open a window on: {_WITHOUT_WINDOW}")
    import_rerun()
    console = Console(highlight=False, soft_wrap=True)

    def say(text: str) -> None:
        console.print(text, markup=False)

    options = ViewOptions(only=only, event_window_ns=round(event_window_s * 1e9), image_rate_hz=image_rate_hz)
    stop = threading.Event()
    with stop_at_signals(stop), contextlib.ExitStack() as stack:
        target: RerunViewer | RerunFiles
        if save is not None:
            target = RerunFiles(save, say)
        else:
            target = stack.enter_context(RerunViewer(web=web, waiting=lambda: not stop.is_set()))
        node = stack.enter_context(Node("viewer"))
        if web and isinstance(target, RerunViewer):
            page = stack.enter_context(ControlPage(node, target.page_url, port=port))
            say(f"open {page.url}")
            if open_browser and has_display():
                webbrowser.open(page.url)
        try:
            status = watch(node, target, options, stop=stop, say=say, to_the_end=save is not None)
        except ViewerEnded as error:
            if web:
                raise
            raise ViewerEnded(f"{error}\n{_WITHOUT_WINDOW}") from None
    return status


def watch(
    node: Node,
    target: RerunViewer | RerunFiles,
    options: ViewOptions,
    *,
    stop: threading.Event,
    say: Callable[[str], None],
    to_the_end: bool = False,
) -> int:
    """Show one simulator after another.

    `say`: called with what a user should know. `to_the_end`: return when a simulator has left after the end
    of its flight. Returns as `view`.
    """
    announcements = node.subscriber(SIMULATION, Simulation, policy=latest())
    number = itertools.count(1)
    source, send_s, over_s, present = 0, 0.0, math.inf, False
    bodies: Any = None
    session: LiveSession | None = None
    say("waiting for a simulator (neurosim serve)")
    with contextlib.ExitStack() as stack:
        while not stop.is_set():
            time.sleep(POLL_S)
            now_s = time.monotonic()
            if not target.check():
                return 0
            found = _receive(announcements, say)
            if found is not None and (found[1] != source or _bodies_of(found[0]) != bodies):
                simulation, source = found
                bodies = _bodies_of(simulation)
                stack.close()
                session, present = None, True
                try:
                    session = LiveSession(node, simulation, target, options, number=number, say=say)
                except ConfigError as error:
                    say(f"cannot read the settings of this simulator (version {simulation.version}): {error}")
                    continue
                stack.enter_context(session)
                names = "; ".join(f"{name}: {', '.join(s)}" for name, s in session.sensors.items())
                say(f"showing {names} ({simulation.mode})")
            if session is None:
                continue
            session.read()
            if now_s >= send_s:
                send_s = now_s + SEND_S
                session.send()
            if present != (present := source in announcements.sources()) and not present:
                say("the simulator is gone; waiting for the next one (neurosim serve)")
            over = to_the_end and not present and session.phase == "ended"
            over_s = min(over_s, now_s) if over else math.inf
            if now_s - over_s >= OVER_S:
                return 0
    return 130


def _bodies_of(simulation: Simulation) -> Any:
    """Return the settings of bodies, which may change during a run: then a new recording shows them."""
    settings = yaml.safe_load(simulation.config)
    return settings.get("bodies") if isinstance(settings, dict) else None


def _receive(
    announcements: Subscriber[Simulation], say: Callable[[str], None]
) -> tuple[Simulation, int] | None:
    """Return the newest announcement and its publisher; None if there is none."""
    try:
        simulation, info = announcements.recv_with_info(0.0)
    except TimeoutError:
        return None
    except TypeMismatch as error:
        say(f"a simulator of another version, which cannot be shown:\n{error}")
        return None
    return simulation, info.source
