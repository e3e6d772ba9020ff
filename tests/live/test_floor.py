"""What the machine takes to wake another process."""

import os
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from cortex import Node, reliable
from cortex.messages import Clock
from neurosim_core.bench.closed_loop import LoopResult, with_floor
from neurosim_core.live import floor
from neurosim_core.live.floor import FloorError, measure_floor


@pytest.mark.usefixtures("shared_runtime")
def test_every_message_is_timed():
    """Times lie between nothing and what the whole measurement took."""
    begin_ns = time.monotonic_ns()
    trace = measure_floor(400.0, seconds=0.2)
    elapsed_ns = time.monotonic_ns() - begin_ns
    assert len(trace.wake_ns) == len(trace.message_ns) == 40
    for times_ns in (trace.wake_ns, trace.message_ns):
        assert times_ns.min() > 0
        assert times_ns.max() < elapsed_ns


class Clockwork:
    """A clock that only sleep moves on."""

    def __init__(self):
        self.now_ns = 0
        self.monotonic_ns = self.time_ns = lambda: self.now_ns

    def sleep(self, duration_s):
        self.now_ns += round(duration_s * 1e9)


@pytest.mark.usefixtures("shared_runtime")
def test_messages_are_sent_at_the_rate_and_in_turn(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(floor, "time", Clockwork())
    count = 20
    reading, writing = os.pipe()
    with Node("listener") as node, ThreadPoolExecutor() as pool, open(reading, "rb") as pipe:
        clocks = node.subscriber(floor._TOPIC, Clock, policy=reliable(timeout_s=60.0))
        pool.submit(floor._send, 100.0, count, writing).result(60.0)
        sent_ns = np.frombuffer(pipe.read(8 * count), np.int64)
        messages = [clocks.recv(60.0) for _ in range(count)]
    os.close(writing)
    assert (np.diff(sent_ns) == 20_000_000).all()
    assert [message.sequence for message in messages] == list(range(1, 2 * count, 2))
    assert [message.wall_ns for message in messages] == list(sent_ns + 10_000_000)


@pytest.mark.usefixtures("shared_runtime")
def test_a_sender_that_ends_is_said(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(floor, "_MODULE", "this")
    with pytest.raises(FloorError, match="ended"):
        measure_floor(400.0, seconds=0.1)


def test_a_result_is_put_beside_its_floor():
    nan = float("nan")
    result = LoopResult(
        mode="streaming",
        requested_hz=500.0,
        received_hz=500.0,
        image_count=10,
        image_bytes=921_600,
        latency_median_s=nan,
        latency_p99_s=nan,
        transport_median_s=1e-4,
        transport_p99_s=2e-4,
        lost_count=0,
        overtaken_count=0,
        unfelt_count=0,
    )
    beside = with_floor(result, seconds=0.05)
    assert 0.0 < beside.wake_median_s <= beside.wake_p99_s
    assert 0.0 < beside.message_median_s <= beside.message_p99_s
    assert (beside.transport_median_s, beside.requested_hz) == (1e-4, 500.0)
