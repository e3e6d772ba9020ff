"""Asking a simulator from the command line; the test plays the simulator."""

from __future__ import annotations

import dataclasses
import threading
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from processes import SOON_S

from cortex import Node
from cortex.messages import (
    Parameters,
    Reset,
    SensorStatus,
    SimulatorReply,
    SimulatorStatus,
    Step,
    Trigger,
    VehicleStatus,
)
from neurosim_core.cli import _parser
from neurosim_core.live.call import call, describe_status, parameters_of
from neurosim_core.live.topics import SERVICES, STATUS

STATUS_NOW = SimulatorStatus(
    stamp_ns=1_234_000_000,
    wall_ns=0,
    phase="running",
    reason="",
    mode="streaming",
    real_time_factor_wanted=0.5,
    real_time_factor=0.49,
    step_count=2468,
    step_median_ns=1_250_000,
    step_p99_ns=3_750_000,
    late_median_ns=60_000,
    late_p99_ns=210_000,
    overrun_count=17,
    slipped_ns=345_000_000,
    sensors=[
        SensorStatus("red", "events", True, 2, 1357, 3, 1, 12, 98_500_000),
        SensorStatus("red", "rgb", False, 0, 0, 0, 0),
    ],
    vehicles=[VehicleStatus("red", "velocity", 4321, 5, 6, 7, 8_000_000, True, 9, 1, 13, "", 4, "", "fly")],
)


def ask(*words: str) -> int:
    return call(_parser().parse_args(["call", *words, "--timeout", "60"]))


@pytest.fixture
def asked(shared_runtime) -> Iterator[Callable[..., list[Any]]]:
    """A simulator that notes what it is asked, and does it, or refuses for a reason."""
    requests: list[Any] = []
    with Node("simulator") as node:

        def offer(reason: str = "") -> list[Any]:
            def handle(request: Any) -> SimulatorReply:
                requests.append(request)
                return SimulatorReply(not reason, reason, 1_500_000_000, "paused")

            for service, (request_type, reply_type) in SERVICES.items():
                node.service(service, request_type, reply_type, handle)
            return requests

        yield offer


def test_requests_arrive_as_they_are_meant(asked, capsys):
    requests = asked()
    assert ask("reset", "--seed", "7", "--vehicle", "red", "--position", "1", "-2", "0.5") == 0
    assert capsys.readouterr().out == "paused at 1.5 s\n"
    for words in (("reset",), ("step", "12"), ("step",), ("pause",), ("resume",)):
        assert ask(*words) == 0
    capsys.readouterr()
    assert ask("set", "live.real_time_factor=2", "live.fail_safe=cut", "links.imu.latency_s=0.008") == 0
    changed = "live.real_time_factor = 2; live.fail_safe = cut; links.imu.latency_s = 0.008"
    assert capsys.readouterr().out == f"{changed}; paused at 1.5 s\n"
    first, *others = requests
    assert (first.seed, first.vehicle, first.position.tolist()) == (7, "red", [1.0, -2.0, 0.5])
    steps = [Step(12, timeout_s=60.0), Step(1, timeout_s=60.0)]  # no longer than we wait
    assert others[:5] == [Reset(), *steps, Trigger(), Trigger()]
    assert isinstance(others[5], Parameters)
    assert others[5].to_dict() == {
        "live.real_time_factor": 2,
        "live.fail_safe": "cut",
        "links.imu.latency_s": 0.008,
    }


def test_a_refusal_is_said_and_fails(asked, capsys):
    asked("it is not paused, and [this] is no markup")
    assert ask("step", "3") == 1
    said = capsys.readouterr().out
    assert said == "refused (paused at 1.5 s): it is not paused, and [this] is no markup\n"


@pytest.mark.parametrize("words", [["pause"], ["status"]])
def test_nobody_is_there(shared_runtime, words):
    with pytest.raises(RuntimeError, match=r"no simulator answers \(waited 0.3 s\): start one with"):
        call(_parser().parse_args(["call", *words, "--timeout", "0.3"]))


def test_an_answer_that_does_not_come(shared_runtime):
    done = threading.Event()
    with Node("simulator") as node:

        def handle(_: Trigger) -> SimulatorReply:
            done.wait(SOON_S)
            return SimulatorReply(True, "", 0, "paused")

        node.service("/pause", Trigger, SimulatorReply, handle)
        try:
            with pytest.raises(RuntimeError, match="has not answered within 3 s, and may still do it"):
                call(_parser().parse_args(["call", "pause", "--timeout", "3"]))
        finally:
            done.set()


def test_status(shared_runtime, capsys):
    """Every figure of the message is there, in words and units for people."""
    stop = threading.Event()
    with Node("simulator") as node:
        statuses = node.publisher(STATUS, SimulatorStatus)

        def say() -> None:
            while not stop.wait(0.02):
                statuses.publish(STATUS_NOW)

        thread = threading.Thread(target=say)
        thread.start()
        try:
            assert ask("status") == 0
        finally:
            stop.set()
            thread.join()
    rows = [" ".join(line.split()) for line in capsys.readouterr().out.splitlines()]
    assert rows[:3] == [
        "running",
        "streaming, 1.234 s, 2,468 control periods, 0.49 of 0.5 x real time",
        "step 1.25 ms (p99 3.75 ms), late 0.06 ms (p99 0.21 ms), 17 overruns, delayed by 0.345 s",
    ]
    for row in (
        "red fail-safe fly 4,321 8.00 ms 5 4 6 7 9 13",
        "red/events on 2 1,357 3 1 12 98.50 ms",
        "red/rgb off 0 0 0 0 0 0.00 ms",
    ):
        assert row in rows


def test_settings_are_read_as_yaml():
    given = parameters_of(["a.b=true", "c=3", "d=-0.5", "e=text", "f=x=y"]).to_dict()
    assert given == {"a.b": True, "c": 3, "d": -0.5, "e": "text", "f": "x=y"}


@pytest.mark.parametrize(
    ("setting", "text"),
    [
        ("nothing", "set takes KEY=VALUE, got 'nothing'"),
        ("=3", "set takes KEY=VALUE, got '=3'"),
        ("a=", "a takes a number, true, false, text or a list, got None"),
        ("a=[1", r"set a: the value '\[1' is not YAML"),
    ],
)
def test_settings_that_are_none_are_refused(setting, text):
    with pytest.raises(ValueError, match=text):
        parameters_of([setting])


def test_wrong_numbers_are_refused(shared_runtime):
    for words, text in (
        (["step", "0"], "control periods must be >= 1, got 0"),
        (["pause", "--timeout", "nan"], "--timeout must be > 0, got nan"),
    ):
        with pytest.raises(ValueError, match=text):
            call(_parser().parse_args(["call", *words]))


def test_what_was_not_measured_is_left_out():
    stopped = dataclasses.replace(STATUS_NOW, phase="ended", reason="done", step_median_ns=0)
    first = describe_status(stopped).partition("\n\n")[0]
    assert first == (
        "**ended**: done  \nstreaming, 1.234 s, 2,468 control periods  \n17 overruns, delayed by 0.345 s"
    )
