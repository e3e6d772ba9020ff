"""The page of `neurosim view --web`: what it says of a run, its buttons, and what it refuses."""

from __future__ import annotations

import http.client
import json
import shutil
from collections.abc import Iterator
from typing import Any

import pytest

from cortex import Node
from cortex.messages import Reset, SimulatorReply, SimulatorStatus
from neurosim_core.live.page import ControlPage
from neurosim_core.live.topics import SERVICES, STATUS

CHROMIUM = shutil.which("chromium")
JSON = {"Content-Type": "application/json"}

pytestmark = pytest.mark.usefixtures("runtime")


class Simulator:
    """Answers requests and tells its phase."""

    def __init__(self, node: Node) -> None:
        self.asked: list[tuple[str, Any]] = []
        self.phase = "running"
        self._status = node.publisher(STATUS, SimulatorStatus, latch=True)
        for service, types in SERVICES.items():
            node.service(service, *types, self._handler(service))

    def tell(self) -> None:
        self._status.publish(
            SimulatorStatus(
                stamp_ns=1_500_000_000, wall_ns=0, phase=self.phase, reason="", mode="streaming",
                real_time_factor_wanted=1.0, real_time_factor=0.5, step_count=300, step_median_ns=0,
                step_p99_ns=0, late_median_ns=0, late_p99_ns=0, overrun_count=0, slipped_ns=0, sensors=[],
                vehicles=[],
            )
        )  # fmt: skip

    def _handler(self, service: str) -> Any:
        def handle(message: Any) -> SimulatorReply:
            self.asked.append((service, message))
            if service == "/step":
                return SimulatorReply(accepted=False, reason="it is not paused", stamp_ns=0, phase=self.phase)
            self.phase = {"/pause": "paused", "/resume": "running"}.get(service, self.phase)
            self.tell()
            return SimulatorReply(accepted=True, reason="", stamp_ns=0, phase=self.phase)

        return handle


@pytest.fixture
def simulator() -> Iterator[Simulator]:
    with Node("simulator") as node:
        yield Simulator(node)


@pytest.fixture
def page() -> Iterator[ControlPage]:
    with Node("viewer") as node, ControlPage(node, "about:blank#<viewer>") as page:
        yield page


def ask(page: ControlPage, method: str, path: str, body: str = "", **headers: str) -> tuple[int, str]:
    connection = http.client.HTTPConnection("127.0.0.1", int(page.url.rsplit(":")[-1].strip("/")), timeout=20)
    try:
        connection.request(method, path, body, {k.replace("_", "-"): v for k, v in headers.items()})
        answer = connection.getresponse()
        return answer.status, answer.read().decode()
    finally:
        connection.close()


def test_it_frames_the_viewer(page):
    status, text = ask(page, "GET", "/")
    assert status == 200
    assert 'src="about:blank#&lt;viewer&gt;"' in text
    assert ask(page, "GET", "/etc/passwd")[0] == 404


def test_without_a_simulator_it_says_so(page):
    said = json.loads(ask(page, "GET", "/status")[1])
    assert said["phase"] == ""
    assert "neurosim serve" in said["reason"]


@pytest.mark.parametrize(
    ("path", "body", "service", "accepted"),
    [
        ("/pause", "", "/pause", True),
        ("/resume", "{}", "/resume", True),
        ("/reset", '{"seed": 7}', "/reset", True),
        ("/reset", '{"seed": null}', "/reset", True),
        ("/step", "", "/step", False),
    ],
)
def test_requests_reach_the_simulator(page, simulator, path, body, service, accepted):
    status, text = ask(page, "POST", path, body, Content_Type="application/json")
    assert status == 200
    assert json.loads(text) == {"accepted": accepted, "reason": "" if accepted else "it is not paused"}
    [(asked, message)] = simulator.asked
    assert asked == service
    if isinstance(message, Reset):
        assert message.seed == (7 if "7" in body else None)


@pytest.mark.parametrize(
    ("status", "path", "body", "headers"),
    [
        (415, "/reset", "{}", {"Content_Type": "text/plain"}),  # what a form of another site can send
        (403, "/reset", "{}", {"Content_Type": "application/json", "Host": "evil.example:80"}),
        (400, "/reset", "{", {"Content_Type": "application/json"}),
        (400, "/reset", "[7]", {"Content_Type": "application/json"}),
        (400, "/reset", '{"seed": -1}', {"Content_Type": "application/json"}),
        (400, "/reset", '{"seed": true}', {"Content_Type": "application/json"}),
        (400, "/reset", '{"seed": 9007199254740992}', {"Content_Type": "application/json"}),
        (400, "/reset", "{}", {"Content_Type": "application/json", "Content_Length": "-1"}),
        (400, "/reset", "{}", {"Content_Type": "application/json", "Content_Length": "1000000000"}),
        (400, "/format_disk", "{}", {"Content_Type": "application/json"}),
    ],
)
def test_what_is_refused_does_nothing(page, simulator, status, path, body, headers):
    assert ask(page, "POST", path, body, **headers)[0] == status
    assert simulator.asked == []


def test_a_taken_port_is_named(page):
    port = int(page.url.rsplit(":")[-1].strip("/"))
    with Node("second") as node, pytest.raises(OSError, match=f"port {port} cannot be used"):
        ControlPage(node, "about:blank", port=port)


@pytest.mark.skipif(CHROMIUM is None, reason="needs a browser: apt-get install chromium")
def test_its_buttons_in_a_browser(page, simulator):
    driver = pytest.importorskip(
        "playwright.sync_api", reason="needs something that drives a browser: pip install playwright"
    )
    simulator.tell()
    with driver.sync_playwright() as browsers:
        browser = browsers.chromium.launch(executable_path=CHROMIUM)
        shown = browser.new_page()
        shown.goto(page.url)
        expect = driver.expect
        expect(shown.get_by_role("status")).to_contain_text("1.50 s · running · 0.50 × real time")
        expect(shown.get_by_role("button", name="Step")).to_be_disabled()
        shown.get_by_role("button", name="Pause").click()
        expect(shown.get_by_role("button", name="Start")).to_be_enabled()
        shown.get_by_role("button", name="Step").click()
        expect(shown.get_by_role("alert")).to_have_text("it is not paused")
        shown.get_by_label("seed").fill("12")
        shown.get_by_role("button", name="Reset").click()
        expect(shown.get_by_role("alert")).to_have_text("")
        browser.close()
    assert [service for service, _ in simulator.asked] == ["/pause", "/step", "/reset"]
    assert simulator.asked[-1][1].seed == 12
