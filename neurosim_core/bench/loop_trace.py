"""What a controller sees that answers every image with a numbered command, and what follows from it.

Which image has felt which command is read from the physics: the number of a command is in the rotor speed
that it asks for, as a change of 2e-7 at most, and two reports of the rotors give the speed that was asked for
in between. So it makes no difference how a simulator handles commands, or what it says of it. In lockstep the
reports of the warm-up are enough: where they show that every command is obeyed at once, no further ones are
asked for, which would slow down what is measured.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Times = NDArray[np.int64]

CODES = 4096
"""Commands whose numbers can be told apart: far more than are under way at a time."""
_CODE_STEP = 1e-10
_MIDDLE = 0.5 * (CODES - 1)


@dataclass(frozen=True, kw_only=True, eq=False)
class LoopTrace:
    """What was seen; times are of CLOCK_MONOTONIC, stamps of the simulation."""

    sent_ns: Times
    """When each command was handed to Cortex [ns], shape [commands]."""
    answered_ns: Times
    """Stamp of the state that each command answers [ns], shape [commands]."""
    image_stamp_ns: Times
    """Stamp of each image that was received [ns], shape [images]."""
    published_ns: Times
    """When the simulator published each image [ns], shape [images]."""
    received_ns: Times
    """When each image was in the controller's hands [ns], shape [images]."""
    rotor_stamp_ns: Times
    """Stamp of each report of the rotors [ns], shape [reports]."""
    rotor_sequence: Times
    """Number of each report, shape [reports]."""
    rotor_speed: NDArray[np.float64]
    """Speed of the first rotor in each report [rad/s], shape [reports]."""
    image_bytes: int
    """Size of an image."""
    begin: int
    """Images before this one are warm-up."""
    lost_count: int
    """Images that were published after the warm-up and never arrived."""
    overtaken_count: int
    """Images after the warm-up that gave way to newer ones before the controller looked."""


def command_speed(number: int, hover_rad_s: float) -> float:
    """Return the rotor speed that carries the number of a command [rad/s]; on average, and never, hover."""
    return hover_rad_s * (1.0 + _CODE_STEP * (number % CODES - _MIDDLE))


def felt_commands(trace: LoopTrace, *, hover_rad_s: float, motor_time_constant_s: float) -> Times:
    """Find which command the rotors obeyed before each report but the first.

    The speed of a rotor approaches the one asked for exponentially, so that two reports give the latter, to
    about 1e-13 of it.

    Args:
        trace: What was seen.
        hover_rad_s: As given to `command_speed`.
        motor_time_constant_s: Time to close 63 % of a step in commanded rotor speed; 0: at once.

    Returns:
        Index into `sent_ns`, -1 where no single command of ours held, shape [reports - 1].
    """
    felt = np.full(max(len(trace.rotor_stamp_ns) - 1, 0), -1, dtype=np.int64)
    pair = np.flatnonzero(np.diff(trace.rotor_sequence) == 1)  # else two commands may have held in between
    span_s = 1e-9 * (trace.rotor_stamp_ns[pair + 1] - trace.rotor_stamp_ns[pair])
    lagging = motor_time_constant_s > 0.0
    decay = np.exp(-span_s / motor_time_constant_s) if lagging else np.zeros_like(span_s)
    asked = (trace.rotor_speed[pair + 1] - decay * trace.rotor_speed[pair]) / (1.0 - decay)
    place = (asked / hover_rad_s - 1.0) / _CODE_STEP + _MIDDLE
    code = np.rint(place)
    certain = (np.abs(place - code) < 0.25) & (code >= 0) & (code < CODES)
    number = 0
    for index, value in zip(pair[certain], code[certain], strict=True):
        ahead = (int(value) - number) % CODES  # commands are obeyed in the order of their numbers
        if number + ahead < len(trace.sent_ns):
            number += ahead
            felt[index] = number
    return felt


def loop_latency_ns(trace: LoopTrace, felt: Times, stamp_ns: Times) -> Times:
    """Return the time from sending each command to having the first image that felt it [ns].

    Args:
        trace: What was seen.
        felt: Commands that were felt, in the order of time, -1: none; shape [n].
        stamp_ns: When, shape [n].

    Returns:
        One time for each command that was felt, and whose image came after the warm-up, in their order.
    """
    known = np.flatnonzero(felt >= 0)
    numbers, first = np.unique(felt[known], return_index=True)
    image = np.searchsorted(trace.image_stamp_ns, stamp_ns[known[first]])
    seen = (image >= trace.begin) & (image < len(trace.image_stamp_ns))
    return trace.received_ns[image[seen]] - trace.sent_ns[numbers[seen]]


def felt_at_once(trace: LoopTrace, felt: Times) -> bool:
    """Return whether, as far as reports go, rotors obey the answer to the state that a period begins with.

    Args:
        trace: What was seen.
        felt: What `felt_commands` found.
    """
    followed = np.diff(trace.rotor_sequence) == 1
    return bool(
        followed.any()
        and (felt[followed] >= 0).all()
        and (trace.answered_ns[felt[followed]] == trace.rotor_stamp_ns[:-1][followed]).all()
    )


def answered_commands(trace: LoopTrace) -> Times:
    """Return which command each image but the first felt, where commands are obeyed at once.

    Returns:
        Index into `sent_ns`, shape [images - 1]: the last command that answers an earlier stamp.
    """
    return np.asarray(np.searchsorted(trace.answered_ns, trace.image_stamp_ns[1:]) - 1)


def transport_ns(trace: LoopTrace) -> Times:
    """Return the time from publishing each image after the warm-up to having it [ns]."""
    return (trace.received_ns - trace.published_ns)[trace.begin :]


def received_hz(trace: LoopTrace) -> float:
    """Return how many images a second were received after the warm-up [Hz]; nan of fewer than two."""
    times = trace.received_ns[trace.begin :]
    if len(times) < 2:
        return float("nan")
    return float((len(times) - 1) / ((times[-1] - times[0]) * 1e-9))
