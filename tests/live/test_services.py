"""Services: requests wait for a loop, with a deadline."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from live_rig import make_config
from processes import SOON_S, wait_for

from cortex import Node, ServiceUnavailable
from cortex.messages import Parameters, Reset, SimulatorReply, Step, Trigger
from neurosim_core.config import SimulationConfig
from neurosim_core.live import services
from neurosim_core.live.services import CHANGEABLE, Request, Services, Steps, change_parameters
from neurosim_core.live.topics import SERVICES


class Counter:
    """Requests on one side, their callers on the other."""

    def __init__(self, node: Node, step_node: Node, caller: Node) -> None:
        self.rung = threading.Event()
        self.config = make_config()
        self.caller = caller
        self.services = Services(
            node,
            step_node,
            config=lambda: self.config,
            state=lambda: (42, "paused"),
            on_request=self.rung.set,
        )

    def call(self, service: str, message: Any, replies: list[SimulatorReply]) -> threading.Thread:
        """Call from a thread of its own; the reply goes to a list."""
        client = self.caller.client(service, *SERVICES[service])
        thread = threading.Thread(target=lambda: replies.append(client.call(message, SOON_S)))
        thread.start()
        return thread

    def take(self) -> Request:
        """Wait for a request."""
        return wait_for(self.services.take)


@pytest.fixture
def counter(shared_runtime: Path) -> Iterator[Counter]:
    with Node("services") as node, Node("steps") as step_node, Node("caller") as caller:
        counter = Counter(node, step_node, caller)
        yield counter
        counter.services.close()


def test_a_request_is_answered_by_the_loop(counter: Counter):
    replies: list[SimulatorReply] = []
    assert not counter.services
    thread = counter.call("/reset", Reset(seed=5), replies)
    assert counter.rung.wait(SOON_S)
    assert counter.services
    request = counter.take()
    assert (request.service, request.message.seed) == ("/reset", 5)
    request.answer()
    thread.join(SOON_S)
    assert replies == [SimulatorReply(accepted=True, reason="", stamp_ns=42, phase="paused")]


def test_a_refusal_says_why(counter: Counter):
    replies: list[SimulatorReply] = []
    thread = counter.call("/pause", Trigger(), replies)
    counter.take().answer("not today")
    thread.join(SOON_S)
    assert not replies[0].accepted
    assert replies[0].reason == "not today"


def test_no_answer_is_a_refusal_in_time(shared_runtime: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(services, "ANSWER_DEADLINE_S", 0.05)
    with Node("services") as node, Node("steps") as step_node, Node("caller") as caller:
        counter = Counter(node, step_node, caller)
        replies: list[SimulatorReply] = []
        counter.call("/resume", Trigger(), replies).join(SOON_S)
        assert not replies[0].accepted
        assert replies[0].reason == "no answer within 0.05 s; it will not be done"
        assert counter.services.take() is None  # nobody waits for it
        counter.services.close()


def test_steps_do_not_hold_up_the_others(counter: Counter):
    replies: list[SimulatorReply] = []
    stepping = counter.call("/step", Step(count=3), replies)
    step = counter.take()
    pausing = counter.call("/pause", Trigger(), replies)
    counter.take().answer("second")
    pausing.join(SOON_S)
    assert [reply.reason for reply in replies] == ["second"]
    step.answer("first")
    stepping.join(SOON_S)
    assert [reply.reason for reply in replies] == ["second", "first"]


def test_close_answers_who_waits(counter: Counter):
    replies: list[SimulatorReply] = []
    thread = counter.call("/step", Step(count=3), replies)
    counter.take()
    counter.services.close()
    thread.join(SOON_S)
    assert replies[0].reason == "the simulator has ended"
    wait_for(lambda: not counter.caller.client("/step", Step, SimulatorReply).available())
    with pytest.raises(ServiceUnavailable):
        counter.caller.client("/step", Step, SimulatorReply).call(Step(), 0.1)


def test_parameters_are_checked_before_the_loop_hears_of_them(counter: Counter):
    replies: list[SimulatorReply] = []
    values = {"live.fail_safe": "panic"}
    counter.call("/set_parameters", Parameters.of(values), replies).join(SOON_S)
    assert "live.fail_safe" in replies[0].reason
    assert "'hover', 'cut' or 'hold'" in replies[0].reason
    assert not counter.services
    thread = counter.call("/set_parameters", Parameters.of({"live.fail_safe": "cut"}), replies)
    request = counter.take()
    assert request.config is not None
    assert request.config.live.fail_safe == "cut"
    request.answer()
    thread.join(SOON_S)


def test_steps_are_counted_down():
    steps = Steps()
    request = Request("/step", Step(count=2))
    steps.start(request)
    assert steps
    steps.count()
    assert steps
    steps.count()
    assert not steps
    assert request.wait(0.0) == ""
    steps.start(none := Request("/step", Step(count=0)))
    assert not steps
    assert none.wait(0.0) == ""


def test_steps_stop_for_a_reason_or_when_nobody_waits():
    steps = Steps()
    request = Request("/step", Step(count=2))
    steps.start(request)
    steps.stop("reset")
    assert not steps
    assert request.wait(0.0) == "reset"
    left = Request("/step", Step(count=2))
    assert left.future.set_running_or_notify_cancel()
    steps.start(left)
    steps.check()
    assert steps
    assert left.wait(0.0) == "not over within 0 s: it stops where it is"
    steps.check()
    assert not steps


def test_steps_end_with_the_patience_of_who_asked_for_them(counter: Counter):
    """A client that waits for 50 ms is gone after that: the loop sees it, whatever the longest wait is."""
    steps = Steps()

    def begun() -> bool:
        """Whether the steps were begun before the time was over."""
        replies: list[SimulatorReply] = []
        thread = counter.call("/step", Step(count=1000, timeout_s=0.05), replies)
        while thread.is_alive():
            request = counter.services.take()
            if request is not None:
                steps.start(request)
                break
        thread.join(SOON_S)
        return replies[0].reason == "not over within 0.05 s: it stops where it is"

    wait_for(begun)
    steps.check()
    assert not steps


def test_what_is_being_done_when_the_time_is_over_is_waited_for():
    """Else a client would be told that a reset that happens has not happened."""
    request = Request("/reset", Reset())
    reasons: list[str] = []
    assert request.future.set_running_or_notify_cancel()
    late = threading.Timer(0.3, request.answer)
    late.start()
    reasons.append(request.wait(0.2))
    late.join(SOON_S)
    assert reasons == [""]


def test_what_nobody_waits_for_is_not_begun():
    request = Request("/reset", Reset())
    assert request.wait(0.0) == "no answer within 0 s; it will not be done"
    assert not request.future.set_running_or_notify_cancel()
    request.answer()
    hopeless = Request("/reset", Reset())
    assert hopeless.future.set_running_or_notify_cancel()
    assert hopeless.wait(0.0) == "no answer within 0 s; it may still be done"


@pytest.mark.parametrize(
    ("key", "value", "read"),
    [
        ("live.real_time_factor", 0.5, lambda c: c.live.real_time_factor),
        ("live.command_timeout_s", 1.5, lambda c: c.live.command_timeout_s),
        ("links.command.latency_s", 0.008, lambda c: c.links["command"].latency_s),
        ("links.rgb.loss", 0.1, lambda c: c.links["rgb"].loss),
        ("vehicles.drone.links.imu.jitter_s", 0.1, lambda c: c.of("drone").links["imu"].jitter_s),
        ("control.gains.attitude_gain_per_s2", 90.0, lambda c: c.control.gains.attitude_gain_per_s2),
    ],
)
def test_a_parameter_is_changed(key: str, value: float, read: Any):
    config = make_config(links={"imu": {"loss": 0.5}})
    changed = change_parameters(config, {key: value})
    assert read(changed) == value
    assert changed.sensors == config.sensors
    assert isinstance(changed, SimulationConfig)


@pytest.mark.parametrize("key", ["scene.seed", "live.mode", "live", "links.imu", "control.rate_hz", "x"])
def test_what_cannot_be_changed_is_refused_with_what_can(key: str):
    with pytest.raises(ValueError, match="cannot be changed during a run") as caught:
        change_parameters(make_config(), {key: 1})
    assert all(name in str(caught.value) for name in CHANGEABLE)


def test_a_misspelt_key_is_answered_with_the_one_that_was_meant():
    with pytest.raises(ValueError, match=r"did you mean live\.real_time_factor\?"):
        change_parameters(make_config(), {"live.realtime_factor": 1.0})


@pytest.mark.parametrize(
    ("key", "value"),
    [("links.camera.loss", 0.1), ("links.imu.loss", 1.5), ("live.real_time_factor", -1.0)],
)
def test_values_that_are_not_allowed_are_refused(key: str, value: float):
    with pytest.raises(ValueError, match=key.rsplit(".", 1)[0]):
        change_parameters(make_config(), {key: value})


def test_a_key_without_a_value_is_refused():
    with pytest.raises(ValueError, match=r"live\.overrun: no value"):
        change_parameters(make_config(), {"live.overrun": None})
