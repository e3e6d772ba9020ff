"""Which image has felt which command, read from rotors that are simulated here by their closed form."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from neurosim_core.bench.loop_trace import (
    CODES,
    LoopTrace,
    answered_commands,
    command_speed,
    felt_at_once,
    felt_commands,
    loop_latency_ns,
    received_hz,
    transport_ns,
)

HOVER_RAD_S = 623.0
MS = 1_000_000


def flown(held, *, period_ns=MS, time_constant_s=0.02, begin=0, sent_count=None):
    """Return what is seen of rotors that obey the numbered commands `held`, one in each period.

    Command n is sent at n ms and 0.1 ms; the image of tick k is published at k ms and 0.5 ms, and received
    0.2 ms later.
    """
    speeds = [HOVER_RAD_S]
    decay = math.exp(-period_ns * 1e-9 / time_constant_s) if time_constant_s else 0.0
    for number in held:
        asked = HOVER_RAD_S if number is None else command_speed(number, HOVER_RAD_S)
        speeds.append(asked + (speeds[-1] - asked) * decay)
    ticks = np.arange(len(speeds))
    count = sent_count or 1 + max(n for n in held if n is not None)
    return LoopTrace(
        sent_ns=np.arange(count) * MS + MS // 10,
        answered_ns=np.arange(count) * period_ns,
        image_stamp_ns=ticks * period_ns,
        published_ns=ticks * MS + MS // 2,
        received_ns=ticks * MS + MS // 2 + MS // 5,
        rotor_stamp_ns=ticks * period_ns,
        rotor_sequence=ticks,
        rotor_speed=np.array(speeds),
        image_bytes=1,
        begin=begin,
        lost_count=0,
        overtaken_count=0,
    )


def felt(trace, time_constant_s=0.02):
    return felt_commands(trace, hover_rad_s=HOVER_RAD_S, motor_time_constant_s=time_constant_s).tolist()


def latency_ms(trace):
    commands = np.array(felt(trace))
    return (loop_latency_ns(trace, commands, trace.rotor_stamp_ns[1:]) / MS).tolist()


@pytest.mark.parametrize("period_ns", [100_000, 200_000, 10 * MS])
@pytest.mark.parametrize("time_constant_s", [0.0, 0.005, 0.05])
def test_the_rotors_tell_the_command(period_ns, time_constant_s):
    """From 10 kHz, where a rotor hardly moves in a period, to a rotor that obeys at once."""
    held = [0, 0, 1, 3, 3, 3, 4, 17, 18]
    trace = flown(held, period_ns=period_ns, time_constant_s=time_constant_s)
    assert felt(trace, time_constant_s) == held


def test_numbers_go_on_when_codes_come_again():
    held = list(range(0, 3 * CODES, 1000))
    assert felt(flown(held)) == held


def test_what_is_not_a_command_of_ours_is_not_taken_for_one():
    """Rotors that hover, as before the first command, and one of somebody else."""
    trace = flown([None, None, 0, 1])
    speed = trace.rotor_speed.copy()
    speed[-1] += 1.0
    assert felt(dataclasses.replace(trace, rotor_speed=speed)) == [-1, -1, 0, -1]
    assert felt(flown([None], sent_count=CODES)) == [-1]  # hover is the middle of all codes
    assert felt(flown([0, 1, 2], sent_count=2)) == [0, 1, -1]  # a number that was never sent


def test_a_report_that_is_missing_or_comes_twice_tells_nothing():
    trace = flown([0, 1, 2, 3, 4])
    without = [0, 1, 3, 4, 5]  # between reports 1 and 3 two commands held
    cut = {
        name: getattr(trace, name)[without] for name in ("rotor_stamp_ns", "rotor_sequence", "rotor_speed")
    }
    assert felt(dataclasses.replace(trace, **cut)) == [0, -1, 3, 4]
    twice = [0, 0, 1, 2, 3, 4, 5]
    doubled = {name: getattr(trace, name)[twice] for name in cut}
    assert felt(dataclasses.replace(trace, **doubled)) == [-1, 0, 1, 2, 3, 4]


def test_the_loop_ends_at_the_first_image_that_felt_the_command():
    """Command 1, sent at 1.1 ms, holds from tick 2 on: the first image is that of tick 3, at 3.7 ms."""
    trace = flown([0, 0, 1, 1, 2])
    assert latency_ms(trace) == [1.6, 2.6, 3.6]


def test_where_that_image_was_lost_it_is_the_next_one():
    trace = flown([0, 0, 1, 1, 2])
    kept = [0, 1, 2, 4, 5]
    images = {name: getattr(trace, name)[kept] for name in ("image_stamp_ns", "published_ns", "received_ns")}
    trace = dataclasses.replace(trace, **images)
    assert latency_ms(trace) == [1.6, 3.6, 3.6]


def test_the_warm_up_does_not_count():
    trace = flown([0, 0, 1, 1, 2], begin=3)
    assert latency_ms(trace) == [2.6, 3.6]
    assert transport_ns(trace).tolist() == [0.2 * MS] * 3
    assert received_hz(trace) == pytest.approx(1000.0)
    assert math.isnan(received_hz(dataclasses.replace(trace, begin=5)))


def test_in_lockstep_the_stamps_tell_the_same():
    """Command n answers tick n, and is felt by image n + 1, 1.6 ms after it was sent."""
    trace = flown([0, 1, 2, 3, 4])
    assert felt_at_once(trace, np.array(felt(trace)))
    by_stamp = answered_commands(trace)
    assert by_stamp.tolist() == felt(trace)
    latency = loop_latency_ns(trace, by_stamp, trace.image_stamp_ns[1:]) / MS
    assert latency.tolist() == latency_ms(trace) == [1.6] * 5
    kept = [0, 1, 3, 4, 5]  # image 2 was lost: image 3 shows commands 1 and 2
    images = {name: getattr(trace, name)[kept] for name in ("image_stamp_ns", "published_ns", "received_ns")}
    assert answered_commands(dataclasses.replace(trace, **images)).tolist() == [0, 2, 3, 4]


@pytest.mark.parametrize("held", [[0, 0, 1, 2], [0, 1, 1, 2], [None, 0, 1], [None]])
def test_a_command_that_comes_late_is_noticed(held):
    for sent_count in (1, 5):
        trace = flown(held, sent_count=sent_count)
        assert not felt_at_once(trace, np.array(felt(trace)))


def test_without_reports_nothing_is_known():
    trace = flown([0, 1])
    none = {name: getattr(trace, name)[:1] for name in ("rotor_stamp_ns", "rotor_sequence", "rotor_speed")}
    trace = dataclasses.replace(trace, **none)
    assert felt(trace) == []
    assert not felt_at_once(trace, np.array(felt(trace)))


def test_commands_average_to_hover():
    """Else a vehicle that is flown for long would drift away."""
    speeds = [command_speed(number, HOVER_RAD_S) for number in range(CODES)]
    assert np.mean(speeds) == pytest.approx(HOVER_RAD_S, rel=1e-14)  # rounding
    assert np.ptp(speeds) < 1e-6 * HOVER_RAD_S
