"""The probes against a simulator that is played here: what they send, note and count."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest
from processes import SOON_S

from cortex import Node, reliable
from cortex.messages import Events, Image, Imu, MotorCommand, RotorSpeeds, SimulatorStatus
from neurosim_core.live import probe
from neurosim_core.live.probe import ProbeError, StreamProbe, answer_images

HOVER_RAD_S = 500.0
PERIOD_NS = 5_000_000


class Lockstep:
    """A simulator in lockstep whose rotors obey at once; the image of tick 40 is lost."""

    def __init__(self) -> None:
        self.lost_tick = 0
        self.node = Node("played simulator")
        self.rotors = self.node.publisher("/drone/rotor_speeds", RotorSpeeds, latch=True)
        self.images = self.node.publisher("/drone/camera", Image)
        self.commands = self.node.subscriber("/drone/command/motor_speeds", MotorCommand, policy=reliable())
        self.obeyed: list[MotorCommand] = []
        self.stop = threading.Event()
        self.thread = threading.Thread(target=self.fly)

    def fly(self) -> None:
        tick = 0
        self.report(0, HOVER_RAD_S)
        while not self.stop.is_set():
            try:
                command = self.commands.recv(0.05)
            except TimeoutError:
                continue
            assert command.stamp_ns == tick * PERIOD_NS
            self.obeyed.append(command)
            if tick == 0:
                self.show(0)
            tick += 1
            if tick < 40 or self.lost_tick:
                self.show(tick)
            else:
                self.lost_tick = tick
            self.report(tick, command.speed[0])

    def report(self, tick: int, speed: float) -> None:
        self.rotors.publish(RotorSpeeds(stamp_ns=tick * PERIOD_NS, speed=np.full(4, speed), sequence=tick))

    def show(self, tick: int) -> None:
        data = np.full((48, 64, 3), tick % 256, dtype=np.uint8)
        self.images.publish(Image(stamp_ns=tick * PERIOD_NS, data=data, encoding="rgb8", sequence=tick))

    def __enter__(self) -> Lockstep:
        self.thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop.set()
        self.thread.join()
        self.node.close()


def test_a_controller_answers_every_image_and_notes_it(runtime):
    """An image that is lost is made up for by what the rotors say: the flight goes on."""
    with Lockstep() as simulator:
        trace = answer_images(
            vehicle="drone",
            camera="camera",
            speed_rad_s=np.full(4, HOVER_RAD_S),
            seconds=0.6,
            warm_up_s=0.1,
            check=lambda: None,
        )
    sent = simulator.obeyed
    assert [command.sequence for command in sent] == list(range(len(sent)))
    assert trace.answered_ns[: len(sent)].tolist() == [command.stamp_ns for command in sent]
    stamps = trace.image_stamp_ns // PERIOD_NS
    assert stamps[-1] > simulator.lost_tick >= 40
    assert simulator.lost_tick not in stamps
    assert trace.image_bytes == 64 * 48 * 3
    assert trace.lost_count == 0  # it was never published
    assert stamps[0] > 0  # the warm-up is left out
    assert np.ptp(trace.received_ns) >= 0.5e9
    assert (trace.published_ns < trace.received_ns).all()
    assert (np.diff(trace.sent_ns) > 0).all()
    felt = np.searchsorted(trace.answered_ns, trace.image_stamp_ns) - 1
    assert (trace.answered_ns[felt] == trace.image_stamp_ns - PERIOD_NS).all()
    assert (trace.sent_ns[felt] < trace.received_ns).all()


def test_silence_is_an_error_that_names_the_topic(runtime, monkeypatch):
    monkeypatch.setattr(probe, "_START_S", 0.3)
    flight = {"vehicle": "drone", "camera": "camera", "speed_rad_s": np.ones(4), "seconds": 1.0}
    checked = []
    with pytest.raises(ProbeError, match=r"/drone/command/motor_speeds had no subscriber within 0\.3 s"):
        answer_images(**flight, warm_up_s=0.0, check=lambda: checked.append(1))
    assert checked
    with Node("deaf") as node, StreamProbe(vehicle="drone", imu="imu", camera="events") as listener:
        node.publisher("/drone/imu", Imu)
        with pytest.raises(ProbeError, match=r"/drone/imu was silent for 0\.3 s"):
            listener.listen(1.0, resident=list, check=lambda: None)


def test_the_first_complaint_of_a_check_ends_the_wait(runtime):
    def check() -> None:
        raise SimulatorGone

    class SimulatorGone(Exception):
        pass

    begin_s = time.monotonic()
    with StreamProbe(vehicle="drone", imu="imu", camera="events") as listener, pytest.raises(SimulatorGone):
        listener.listen(60.0, resident=list, check=check)
    assert time.monotonic() - begin_s < 20.0


def test_a_stream_is_noted_with_all_its_gaps(runtime):
    """Samples 5 and 6, and packet 1, are never sent."""
    status = SimulatorStatus(
        stamp_ns=0, wall_ns=0, phase="running", reason="", mode="streaming", real_time_factor_wanted=1.0,
        real_time_factor=1.0, step_count=0, step_median_ns=0, step_p99_ns=0, late_median_ns=0, late_p99_ns=0,
        overrun_count=7, slipped_ns=0, sensors=[], vehicles=[],
    )  # fmt: skip
    stop = threading.Event()

    def send() -> None:
        for publisher in (imu, events, statuses):
            assert publisher.wait_for_subscribers(1, SOON_S)
        statuses.publish(status)
        for sequence in (0, 2):
            none = np.zeros(3, np.uint16)
            packet = Events(
                stamp_ns=0, x=none, y=none, t=none.astype(np.int64), polarity=none.astype(np.uint8), width=1,
                height=1, dropped_count=2, sequence=sequence,
            )  # fmt: skip
            events.publish(packet)
        sequence = 0
        while not stop.wait(1e-3):
            if sequence not in (5, 6):
                stamp_ns = sequence * 1_000_000
                zero = np.zeros(3)
                imu.publish(Imu(stamp_ns=stamp_ns, specific_force=zero, angular_rate=zero, sequence=sequence))
            sequence += 1

    with (
        Node("played simulator") as node,
        StreamProbe(vehicle="drone", imu="imu", camera="events") as listener,
    ):
        imu = node.publisher("/drone/imu", Imu)
        events = node.publisher("/drone/events", Events)
        statuses = node.publisher("/status", SimulatorStatus)
        thread = threading.Thread(target=send)
        thread.start()
        try:
            sizes = iter(range(1000, 2000))
            trace = listener.listen(0.3, resident=lambda: [next(sizes), -1], check=lambda: None)
        finally:
            stop.set()
            thread.join()
    assert trace.imu_lost_count == 2
    assert trace.imu_stamp_ns[:7].tolist() == [n * 1_000_000 for n in (0, 1, 2, 3, 4, 7, 8)]
    assert trace.imu_received_ns[-1] - trace.imu_received_ns[0] >= 0.3e9
    assert (trace.packet_count, trace.event_count) == (2, 6)
    assert (trace.packet_lost_count, trace.event_dropped_count) == (1, 4)
    assert trace.status.overrun_count == 7
    assert trace.resident_bytes.tolist() == [[1000, -1], [1001, -1]]
    assert trace.resident_s.tolist() == pytest.approx([0.0, 0.3], abs=0.2)
