"""The page of `neurosim view --web`: Rerun's viewer, and above it buttons that pause, step and reset the run.

It is for browsers of this machine only. Another site that is open in such a browser can neither read the
answers nor send requests: they must be JSON, for which a browser asks first, and are refused under a name
other than this machine's (which stops DNS rebinding).
"""

from __future__ import annotations

import html
import json
import threading
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib import resources
from typing import Any

from cortex import Node, latest
from cortex.messages import Reset, SimulatorStatus, Step, Trigger
from neurosim_core.clock import NS_PER_S
from neurosim_core.live.call import ask
from neurosim_core.live.topics import STATUS
from neurosim_core.view.rerun_viewer import HOST, naming_port

ANSWER_S = 10.0
"""How long a request may take [s]."""
_BODY_MAX = 4096
_SEED_MAX = 2**53  # JavaScript's whole numbers
_SECURITY = {"X-Frame-Options": "DENY", "Cache-Control": "no-store", "X-Content-Type-Options": "nosniff"}


class ControlPage:
    """Serves the page. A context manager that ends it."""

    def __init__(self, node: Node, viewer_url: str, *, port: int = 0) -> None:
        """Begin to serve.

        `port`: port of the page; 0: any that is free.
        """
        self._node = node
        self._viewer_url = viewer_url
        self._status: SimulatorStatus | None = None
        self._statuses = node.subscriber(STATUS, SimulatorStatus, self._on_status, policy=latest())
        with naming_port(port):
            self._server = ThreadingHTTPServer((HOST, port), self._handler())
        self._server.daemon_threads = True
        self.url = f"http://{HOST}:{self._server.server_port}/"
        """Address of the page."""
        self._thread = threading.Thread(target=self._server.serve_forever, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End it."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()
        self._statuses.close()

    def __enter__(self) -> ControlPage:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def text(self) -> str:
        """Return the page."""
        page = resources.files(__package__).joinpath("page.html").read_text(encoding="utf-8")
        return page.replace("VIEWER_URL", html.escape(self._viewer_url))

    def status(self) -> dict[str, Any]:
        """Return how the simulator is doing; `phase` is empty if there is none."""
        status = self._status
        if status is None or not self._statuses.sources():
            return {"phase": "", "reason": "no simulator: start one with `neurosim serve`"}
        return {
            "phase": status.phase,
            "reason": status.reason,
            "time_s": status.stamp_ns / NS_PER_S,
            "real_time_factor": status.real_time_factor,
        }

    def request(self, what: str, values: Any) -> dict[str, Any]:
        """Ask the simulator for something, and return its answer.

        `values`: `seed` of a reset, null or not there: as configured.
        """
        if not isinstance(values, dict):
            raise ValueError(f"values must be a JSON object, got {values!r}")
        seed = values.get("seed")
        if seed is not None and (type(seed) is not int or not 0 <= seed < _SEED_MAX):
            raise ValueError(f"a seed is a whole number from 0 to {_SEED_MAX - 1}, got {seed!r}")
        requests = {
            "pause": Trigger(),
            "resume": Trigger(),
            "step": Step(1, timeout_s=ANSWER_S),
            "reset": Reset(seed=seed),
        }
        if what not in requests:
            raise ValueError(f"a request is one of {', '.join(requests)}, got {what!r}")
        try:
            reply = ask(self._node, f"/{what}", requests[what], ANSWER_S)
        except RuntimeError as error:
            return {"accepted": False, "reason": str(error)}
        return {"accepted": reply.accepted, "reason": reply.reason}

    def _on_status(self, status: SimulatorStatus) -> None:
        self._status = status

    def _handler(self) -> type[BaseHTTPRequestHandler]:
        page = self

        class Handler(BaseHTTPRequestHandler):
            timeout = 30.0

            def do_GET(self) -> None:
                if self.path == "/":
                    self._send(HTTPStatus.OK, page.text(), "text/html")
                elif self.path == "/status":
                    self._send_json(HTTPStatus.OK, page.status())
                else:
                    self.send_error(HTTPStatus.NOT_FOUND)

            def do_POST(self) -> None:
                length = self.headers.get("Content-Length", "")
                if self.headers.get("Content-Type") != "application/json":
                    self._send_json(HTTPStatus.UNSUPPORTED_MEDIA_TYPE, {"reason": "requests are JSON"})
                elif not (length.isascii() and length.isdigit() and int(length) <= _BODY_MAX):
                    reason = f"Content-Length must be 0 to {_BODY_MAX}"
                    self._send_json(HTTPStatus.BAD_REQUEST, {"reason": reason})
                else:
                    try:
                        values = json.loads(self.rfile.read(int(length)) or b"{}")
                        answer = page.request(self.path.removeprefix("/"), values)
                    except ValueError as error:
                        self._send_json(HTTPStatus.BAD_REQUEST, {"reason": str(error)})
                    else:
                        self._send_json(HTTPStatus.OK, answer)

            def parse_request(self) -> bool:
                if not super().parse_request():
                    return False
                if self.headers.get("Host", "").rpartition(":")[0] in (HOST, "localhost"):
                    return True
                self.send_error(HTTPStatus.FORBIDDEN, "this page is for browsers of its machine")
                return False

            def _send_json(self, status: HTTPStatus, answer: dict[str, Any]) -> None:
                self._send(status, json.dumps(answer), "application/json")

            def _send(self, status: HTTPStatus, text: str, content_type: str) -> None:
                content = text.encode()
                self.send_response(status)
                self.send_header("Content-Type", f"{content_type}; charset=utf-8")
                self.send_header("Content-Length", str(len(content)))
                for name, value in _SECURITY.items():
                    self.send_header(name, value)
                self.end_headers()
                self.wfile.write(content)

            def log_message(self, format: str, *arguments: Any) -> None:
                """Print nothing."""

        return Handler
