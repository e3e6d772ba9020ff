"""The Rerun viewer as a child process: a window, or a server of its page and data for this machine only.

`rerun.serve_grpc` would do the second in this process, but listens on every network.
"""

from __future__ import annotations

import contextlib
import importlib.util
import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
import urllib.parse
import webbrowser
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from neurosim_core.install import install_hint
from neurosim_core.signals import end_with_parent, stop_at_signals
from neurosim_core.view.rerun_sdk import RerunStream, import_rerun

HOST = "127.0.0.1"
_START_S = 20.0
_END_S = 0.5
_CLOSE_S = 0.3
_POLL_S = 0.1
_WINDOW_MEMORY = "2GB"
_SERVER_MEMORY = "1GB"


class ViewerEnded(RuntimeError):
    """The viewer's process is gone; the message has its last words."""


class RerunViewer:
    """A viewer that recordings can be opened in. A context manager that ends it."""

    compress = False
    """Its pictures need not be small, but there at once."""

    def __init__(
        self,
        *,
        web: bool,
        port: int = 0,
        file: Path | None = None,
        waiting: Callable[[], bool] = lambda: True,
    ) -> None:
        """Start the viewer and wait until it listens.

        `web`: serve a page instead of opening a window. `port`: port of the page; 0: any that is free.
        `file`: a Rerun file to show from the beginning. `waiting`: asked now and then whether to go on
        waiting.
        """
        import_rerun()
        page_port, data_port = _free_ports(port if web else 0, 0)
        options = [] if file is None else [str(file)]
        options += ["--bind", HOST, "--port", str(data_port), "--server-memory-limit", _SERVER_MEMORY]
        if web:
            options += ["--serve-web", "--web-viewer-port", str(page_port)]
        else:
            options += ["--memory-limit", _WINDOW_MEMORY, "--hide-welcome-screen", "--expect-data-soon"]
        self.data_url = f"rerun+http://{HOST}:{data_port}/proxy"
        """Address of the viewer for recordings."""
        self.page_url = ""
        """Address of the page; empty for a window."""
        if web:
            query = urllib.parse.urlencode({"url": self.data_url}, safe=":/")
            self.page_url = f"http://{HOST}:{page_port}/?{query}"
        self._output = tempfile.TemporaryFile()  # noqa: SIM115 (closed with the process)
        self._process = subprocess.Popen(
            [_executable(), *options],
            stdin=subprocess.DEVNULL,
            stdout=self._output,
            stderr=self._output,
            env={**os.environ, "RERUN_APP_ONLY": "true"},
            start_new_session=True,  # Ctrl-C is for us, and we end it
            preexec_fn=end_with_parent(signal.SIGTERM),
        )
        try:
            self._wait_for(data_port, waiting)
            if web:
                self._wait_for(page_port, waiting)
        except BaseException:
            self.close()
            raise

    def open(self, name: str) -> RerunStream:
        """Open a recording in the viewer, which shows it at once."""
        stream = RerunStream(name=name)
        stream.recording.connect_grpc(self.data_url)
        return stream

    @property
    def ended(self) -> bool:
        """Whether the process is gone, because its window was closed or it failed."""
        return self._process.poll() is not None

    def check(self) -> bool:
        """Return whether the viewer is still there; False: its window was closed."""
        if self._process.poll():
            raise ViewerEnded(f"the viewer ended with status {self._process.poll()}:\n{self._last_lines()}")
        return not self.ended

    def close_recording(self, logger: Any) -> None:
        """Close the logger of a recording. A viewer that does not take it is not waited for."""

        def close() -> None:
            with contextlib.suppress(OSError):
                logger.close()

        closing = threading.Thread(target=close, name="close recording", daemon=True)
        closing.start()
        closing.join(_CLOSE_S)

    def close(self) -> None:
        """End the process."""
        for number in (signal.SIGTERM, signal.SIGKILL):
            if self._process.poll() is None:
                self._process.send_signal(number)
                with contextlib.suppress(subprocess.TimeoutExpired):
                    self._process.wait(_END_S)
        self._process.wait()
        self._output.close()

    def __enter__(self) -> RerunViewer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _wait_for(self, port: int, waiting: Callable[[], bool]) -> None:
        deadline_s = time.monotonic() + _START_S
        while waiting():
            if self.ended:
                raise ViewerEnded(
                    f"the viewer ended at once, with status {self._process.poll()}:\n{self._last_lines()}"
                )
            with contextlib.suppress(OSError), socket.create_connection((HOST, port), timeout=0.1):
                return
            if time.monotonic() > deadline_s:
                raise ViewerEnded(f"the viewer does not listen on port {port} after {_START_S:g} s")
            time.sleep(0.02)

    def _last_lines(self) -> str:
        self._output.seek(0)
        lines = self._output.read().decode(errors="replace").strip().splitlines()
        return "\n".join(lines[-5:])


def has_display() -> bool:
    """Return whether a window can be opened. Only Linux can be without a display; an empty name is none."""
    return sys.platform != "linux" or any(os.environ.get(k) for k in ("DISPLAY", "WAYLAND_DISPLAY"))


@contextlib.contextmanager
def naming_port(port: int) -> Iterator[None]:
    """Name the port in the error of a block that cannot listen on it."""
    try:
        yield
    except OSError as error:
        raise OSError(f"port {port} cannot be used: {error.strerror}") from None


def show_file(file: Path, *, web: bool, port: int = 0, open_browser: bool = True) -> int:
    """Show a Rerun file until the window is closed or this process is interrupted.

    `web`: serve a page instead of opening a window. `port`: port of the page; 0: any that is free. Returns 0
    if the window was closed, 130 if interrupted.
    """
    if not web and not has_display():
        raise ValueError("there is no display to open a window on: `neurosim view FILE --web` serves a page")
    stop = threading.Event()
    with (
        stop_at_signals(stop),
        RerunViewer(
            web=web, port=port, file=None if web else file, waiting=lambda: not stop.is_set()
        ) as viewer,
    ):
        if web:
            print(f"open {viewer.page_url}", flush=True)
            # a thread: Rerun waits for a server that takes nothing, and Ctrl-C does not end that
            threading.Thread(
                target=_send, args=(file, viewer.data_url), name="send flight", daemon=True
            ).start()
            if open_browser and has_display():
                webbrowser.open(viewer.page_url)
        while not stop.is_set() and viewer.check():
            time.sleep(_POLL_S)
    return 130 if stop.is_set() else 0


def _send(file: Path, url: str) -> None:
    """Send a file to a server: one that reads it itself keeps a core busy until it ends (Rerun 0.41)."""
    sender = import_rerun().RecordingStream("neurosim", send_properties=False)
    sender.connect_grpc(url)
    sender.log_file_from_path(file)
    sender.disconnect()  # returns when all has been sent


def _executable() -> str:
    """The viewer itself; the script `rerun` would start it as a process of its own."""
    given = os.environ.get("RERUN_CLI_PATH")
    if given:
        return given
    found = importlib.util.find_spec("rerun_cli")
    if found is None or found.origin is None:
        raise ImportError(f"this Rerun has no viewer: {install_hint('view')}")
    folder = Path(found.origin).parent
    bundled = folder / "Rerun.app" / "Contents" / "MacOS" / "Rerun"
    return str(bundled if bundled.exists() else folder / "rerun")


def _free_ports(*wanted: int) -> list[int]:
    """Return ports that are free and differ, in place of 0 any."""
    ports = []
    with contextlib.ExitStack() as held:
        for port in wanted:
            probe = held.enter_context(socket.socket())
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            with naming_port(port):
                probe.bind((HOST, port))
            ports.append(int(probe.getsockname()[1]))
    return ports
