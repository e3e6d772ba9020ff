"""The module in C against the Python that it stands for; what it decodes is fuzzed in `fuzz_decode.py`."""

from __future__ import annotations

import gc
import sys
import threading
from collections import deque
from fractions import Fraction

import numpy as np
import pytest
import zmq
from hypothesis import given
from random_schemas import any_message

from cortex import gate, native
from cortex.codec import codec_of
from cortex.message import Array, Float32, Int8, UInt64, message
from cortex.schema import schema_of
from cortex.wire import MESSAGE, REST, message_head

if native.NativeGate is None:  # frames are made while this is imported
    pytest.skip("cortex._native was not compiled", allow_module_level=True)


@message
class Sample:
    stamp_ns: int
    data: Array["float32", "n"]


@message
class Numbers:
    small: Int8
    large: UInt64
    half: Float32
    ok: bool
    name: str


@message
class Numbers3:
    stamp_ns: int
    value: float


HEAD = message_head(MESSAGE, 7, schema_of(Sample).fingerprint, stamped=True)


def sample(stamp_ns=5, count=10):
    return Sample(stamp_ns, np.arange(count, dtype=np.float32))


def coder_of(cls, head=b""):
    return native.make_coder(schema_of(cls), cls, head)


@given(any_message())
def test_bodies_are_those_of_the_general_code(value):
    codec = codec_of(type(value))
    coder = native.make_coder(codec.schema, type(value))
    body = codec.prepare(value, -1)
    expected = body.to_bytes()
    assert coder.encode(value, 1 << 30) == expected
    assert coder.encode(value, body.size - 1) is None
    assert coder.decode(expected, 0, body.size) == value


@pytest.mark.parametrize("count", [0, 1, 255, 256, 4000])
def test_frames_are_header_and_body(count):
    coder, value = coder_of(Sample, HEAD), sample(count=count)
    body = codec_of(Sample).encode(value, 1 << 20)
    assert coder.frame(value, 3, 4, 1 << 20) == HEAD + REST.pack(3, 5, 4, len(body), 0) + body
    assert coder.frame(value, 3, 4, len(body) - 1) is None
    assert coder.read(coder.frame(value, 3, 4, 1 << 20)) == (3, 4, value)


@pytest.mark.parametrize(
    "wrong",
    [
        Numbers(128, 0, 0.0, True, ""),
        Numbers(-129, 0, 0.0, True, ""),
        Numbers(0, -1, 0.0, True, ""),
        Numbers(0, 2**64, 0.0, True, ""),
        Numbers(0, 0, 1e39, True, ""),
        Numbers(0, 0, 0.0, None, ""),
        Numbers(0, 0, 0.0, True, b""),
        Numbers(0, 0, 0.0, True, "\ud800"),
        Numbers(0.0, 0, 0.0, True, ""),
        sample(),
    ],
)
def test_what_is_not_as_usual_is_left_to_python(wrong):
    assert coder_of(Numbers).encode(wrong, 1000) is None
    assert coder_of(Numbers, HEAD).frame(wrong, 0, 0, 1000) is None
    with pytest.raises((TypeError, ValueError)):
        codec_of(Numbers).encode(wrong, 1000)


def test_values_that_python_takes_and_c_does_not():
    """Numbers of neither Python nor NumPy, a str of another class, arrays that are not contiguous."""
    values = [
        Numbers(3, 4, Fraction(1, 2), True, "six"),
        Numbers(3, 4, 5.0, 1, "six"),
        Numbers(3, 4, 5.0, True, np.str_("six")),
        Sample(5, np.arange(20, dtype=np.float32)[::2]),
        Sample(5, np.arange(20, dtype=np.float32).view(np.recarray)),
    ]
    for value in values:
        codec = codec_of(type(value))
        assert coder_of(type(value)).encode(value, 1000) is None
        assert codec.decode(codec.encode(value, 1000)) == value


def test_frames_that_are_none_of_this_publisher():
    coder = coder_of(Sample, HEAD)
    frame = coder.frame(sample(), 3, 4, 1 << 20)
    for other in (b"", frame[:63], frame[:-1], frame + b"x", b"X" + frame[1:], bytearray(frame)):
        assert coder.read(other) is None
    assert coder_of(Sample).read(frame) is None  # it has no head


def test_views_are_read_only_and_keep_what_they_look_at():
    coder = coder_of(Sample, HEAD)
    _, _, value = coder.read(coder.frame(sample(), 3, 4, 1 << 20))
    data = value.data[3:]
    del value
    gc.collect()
    assert not data.flags.writeable
    assert data.tolist() == [3, 4, 5, 6, 7, 8, 9]
    buffer = np.frombuffer(bytes(8) + codec_of(Sample).encode(sample(), 1000), np.uint8)
    view = coder.decode(buffer, 8, len(buffer) - 8).data
    assert np.shares_memory(view, buffer)
    assert view.tolist() == list(range(10))


def test_nothing_is_leaked():
    coder, value = coder_of(Sample, HEAD), sample()
    numbers, many = coder_of(Numbers), Numbers(1, 2, 3.0, True, "four")
    text = numbers.encode(many, 1000)

    def use():
        for _ in range(2000):
            coder.read(coder.frame(value, 3, 4, 1 << 20))
            numbers.decode(text, 0, len(text))
            numbers.decode(text[:-1], 0, len(text) - 1)

    use()
    gc.collect()
    before, references = sys.getallocatedblocks(), sys.getrefcount(value.data)
    use()
    gc.collect()
    grown, now = sys.getallocatedblocks() - before, sys.getrefcount(value.data)
    assert grown < 200
    assert now == references


class Script:
    """A socket that hands out frames, and then has none."""

    def __init__(self, frames):
        self.frames = deque(frames)

    def __call__(self, flags):
        assert flags == zmq.DONTWAIT
        if not self.frames:
            raise zmq.Again
        return self.frames.popleft()


def frames_of(*sequences):
    coder = coder_of(Sample, HEAD)
    return [coder.frame(sample(s), s, 0, 1000) for s in sequences]


@pytest.mark.parametrize(
    ("frames", "expected", "limit", "taken", "ended_by"),
    [
        (frames_of(*range(20)), 0, 64, range(20), None),
        (frames_of(*range(20)), 0, 7, range(7), None),
        (frames_of(0, 1, 3, 4), 0, 64, range(2), 2),
        (frames_of(4, 5), -1, 64, [], 0),
        (frames_of(3, 2), 3, 64, [3], 1),
        ([*frames_of(0), b"other", *frames_of(1)], 0, 64, [0], 1),
        ([], 0, 64, [], None),
    ],
)
@pytest.mark.parametrize("may_wait", [False, True])
def test_drain_takes_what_follows_and_hands_back_what_ends_it(
    frames, expected, limit, taken, ended_by, may_wait
):
    messages, latency, script, flags = deque(), [0] * 8, Script(frames), []

    def receive(flag):
        flags.append(flag)
        return script(zmq.DONTWAIT)

    found = coder_of(Sample, HEAD).drain(
        receive, zmq.Again, messages, expected, limit, latency, 10**12, may_wait
    )
    end = None if ended_by is None else frames[ended_by]
    assert found == (expected + len(taken), len(taken), end)
    assert list(messages) == [sample(sequence) for sequence in taken]
    assert sum(latency) == (len(taken) + 7) // 8
    assert flags[0] == (0 if may_wait else zmq.DONTWAIT)
    assert flags[1:] == [zmq.DONTWAIT] * (len(flags) - 1)


def test_drain_passes_errors_on():
    def broken(flags):
        raise OSError("gone")

    with pytest.raises(OSError, match="gone"):
        coder_of(Sample, HEAD).drain(broken, zmq.Again, deque(), 0, 4, [0] * 8, 0, False)


# The gate


class Taken:
    """What a gate was told to do."""

    def __init__(self):
        self.lock = threading.Lock()
        self.sent, self.slow, self.retried = [], [], []
        self.gate = gate.make_gate(
            coder_of(Sample, HEAD),
            self.lock,
            slowly=self.slowly,
            retry=self.retry,
            limit=1000,
        )
        self.gate.sends = (self.send,)
        self.gate.refresh_ns = 2**62

    def send(self, frame, flags):
        assert self.lock.locked()
        assert flags == zmq.DONTWAIT
        self.sent.append(frame)

    def slowly(self, value):
        assert not self.lock.locked()
        self.slow.append(value)
        return True

    def retry(self, frame, send):
        assert self.lock.locked()
        self.retried.append((frame, send))
        return False


def test_a_gate_sends_frames_and_counts_them():
    taken = Taken()
    assert all(taken.gate(sample(k)) is True for k in range(3))
    found = [coder_of(Sample, HEAD).read(frame) for frame in taken.sent]
    assert [(sequence, value.stamp_ns) for sequence, _, value in found] == [(0, 0), (1, 1), (2, 2)]
    assert all(found[k][1] <= found[k + 1][1] for k in range(2))
    assert (taken.gate.sequence, taken.gate.bytes) == (3, sum(map(len, taken.sent)) - 3 * 64)
    assert not taken.slow
    assert not taken.lock.locked()


def test_what_goes_the_long_way():
    taken = Taken()
    large, wrong = sample(count=1000), "no message"
    for value in (large, wrong):
        assert taken.gate(value) is True
    taken.gate.refresh_ns = 0
    taken.gate(sample())
    taken.gate.refresh_ns = 2**62
    taken.gate.sends = ()
    taken.gate(sample())
    assert taken.slow == [large, wrong, sample(), sample()]
    assert (taken.sent, taken.gate.sequence, taken.gate.bytes) == ([], 0, 0)


def test_a_full_queue_and_an_error_leave_the_lock_free():
    taken = Taken()

    def full(frame, flags):
        raise zmq.Again

    taken.gate.sends = (full,)
    assert taken.gate(sample()) is False
    assert [send for _, send in taken.retried] == [full]
    assert not taken.lock.locked()

    def broken(frame, flags):
        raise zmq.ZMQError(zmq.ENOTSOCK)

    taken.gate.sends = (broken,)
    with pytest.raises(zmq.ZMQError):
        taken.gate(sample())
    assert not taken.lock.locked()
    with pytest.raises(TypeError, match="one message"):
        taken.gate(sample(), sample())
