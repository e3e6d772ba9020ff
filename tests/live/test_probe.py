"""The probe against a simulator that is played here: what it sends, notes and counts."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest

from cortex import Node, reliable
from cortex.messages import Image, MotorCommand, RotorSpeeds
from neurosim_core.live import probe
from neurosim_core.live.probe import ProbeError, answer_images

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


def test_the_first_complaint_of_a_check_ends_the_wait(runtime):
    def check() -> None:
        raise SimulatorGone

    class SimulatorGone(Exception):
        pass

    begin_s = time.monotonic()
    flight = {"vehicle": "drone", "camera": "camera", "speed_rad_s": np.ones(4), "seconds": 60.0}
    with pytest.raises(SimulatorGone):
        answer_images(**flight, warm_up_s=0.0, check=check)
    assert time.monotonic() - begin_s < 20.0
