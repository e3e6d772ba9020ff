"""evt3, mono, libcaer: exact there and back, against decoders that read word by word, where time wraps."""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np
import pytest

from cortex.evt3 import EventCodecError, EventColumns, Evt3Decoder, Evt3Encoder
from cortex_ros2_bridge import cdr
from cortex_ros2_bridge.event_codec import (
    decode_libcaer,
    decode_libcaer_cmp,
    decode_mono,
    encode_mono,
    read_dvs,
)

WIDTH, HEIGHT = 640, 480
SIZE = {"width": WIDTH, "height": HEIGHT}
WRAP_US = 1 << 24


class Reference:
    """A decoder of evt3 as its description reads: one word after the other, in plain Python.

    Like the decoder of event_camera_codecs, it ignores all before the first low half of a time that follows a
    high one, and takes a high half that is smaller by more than 10 for a wrap.
    """

    def __init__(self) -> None:
        self.wraps = self.high = self.low = self.y = self.base = self.sign = 0
        self.timed = False

    def decode(self, data: bytes) -> list[tuple[int, int, int, int]]:
        events = []
        high_seen = False
        for i in range(0, len(data), 2):
            word = data[i] | data[i + 1] << 8
            kind, value = word >> 12, word & 0xFFF
            if kind == 0x8:
                if value < self.high and self.high - value > 10:
                    self.wraps += 1
                self.high, high_seen = value, True
            elif kind == 0x6:
                self.low = value
                self.timed = self.timed or high_seen
            elif kind == 0x0:
                self.y = value & 0x7FF
            elif kind == 0x2 and self.timed:
                events.append(self.event(value & 0x7FF, value >> 11))
            elif kind == 0x3:
                self.base, self.sign = value & 0x7FF, value >> 11
            elif kind in (0x4, 0x5):
                length = 12 if kind == 0x4 else 8
                for bit in range(length):
                    if value >> bit & 1 and self.timed:
                        events.append(self.event(self.base + bit, self.sign))
                self.base += length
        return [event for event in events if event[1] < WIDTH and event[2] < HEIGHT]

    def event(self, x: int, polarity: int) -> tuple[int, int, int, int]:
        return (self.wraps << 24 | self.high << 12 | self.low, x, self.y, polarity)


class Packet(NamedTuple):
    t: np.ndarray
    x: np.ndarray
    y: np.ndarray
    polarity: np.ndarray


def packet(begin_us: int, end_us: int, count: int, seed: int = 0) -> Packet:
    """Random events, sorted as the simulator sorts them."""
    rng = np.random.default_rng(seed)
    t = np.sort(rng.integers(begin_us, end_us, count)).astype(np.int64)
    x = rng.integers(0, WIDTH, count).astype(np.uint16)
    y = rng.integers(0, HEIGHT, count).astype(np.uint16)
    polarity = rng.integers(0, 2, count).astype(np.uint8)
    order = np.lexsort((polarity, x, y, t))
    return Packet(t[order], x[order], y[order], polarity[order])


def encode(encoder: Evt3Encoder, events: Packet, end_us: int = 0) -> bytes:
    return bytes(encoder.encode(EventColumns(*events), **SIZE, end_us=end_us))


def rows(columns: EventColumns | Packet) -> list[tuple[int, int, int, int]]:
    return list(zip(*(column.tolist() for column in columns), strict=True))


def word(kind: int, value: int) -> bytes:
    return (kind << 12 | value).to_bytes(2, "little")


def test_evt3_words_of_three_events():
    """By hand, from 4101 us on: high 1, low 5, row 3, column 7 (brighter); row 3, column 9 (darker); ..."""
    t = np.array([4101, 4101, 4102])
    x, y = np.array([7, 9, 639], np.uint16), np.array([3, 3, 479], np.uint16)
    data = encode(Evt3Encoder(), Packet(t, x, y, np.array([1, 0, 1], np.uint8)))
    words = np.frombuffer(data, "<u2").tolist()
    assert words == [
        *(0x8001, 0x6005, 0x0003, 0x2000 | 0x800 | 7, 0x2000 | 9),
        *(0x6006, 479, 0x2000 | 0x800 | 639),
    ]


def test_evt3_words_of_a_vector():
    """By hand: columns 10, 12, 21 | 22, 30 of one row become a base and two vectors, 600 stays alone."""
    x = np.array([10, 12, 21, 22, 30, 600], np.uint16)
    y, p = np.full(6, 3, np.uint16), np.array([1, 1, 1, 1, 1, 0], np.uint8)
    data = encode(Evt3Encoder(), Packet(np.full(6, 4101), x, y, p))
    first, second = 0x4000 | 1 << 0 | 1 << 2 | 1 << 11, 0x4000 | 1 << 0 | 1 << 8
    assert np.frombuffer(data, "<u2").tolist() == [
        *(0x8001, 0x6005, 0x0003, 0x3000 | 0x800 | 10, first, second, 0x2000 | 600)
    ]


def test_evt3_of_edges_is_exact_and_short():
    """Runs of neighbours, doubled events, both polarities: nothing is lost; vectors take under 2 bytes."""
    rng = np.random.default_rng(4)
    encoder, decoder, reference = Evt3Encoder(), Evt3Decoder(), Reference()
    for index in range(20):
        t = np.sort(rng.integers(20_000 * index, 20_000 * (index + 1), 200)).repeat(30)
        y = rng.integers(0, HEIGHT, 200).repeat(30)
        x = rng.integers(0, WIDTH - 120, 200).repeat(30) + rng.integers(0, 1 + 3 * (index % 3), 6000)
        x = np.minimum(x + np.tile(np.arange(30), 200) * (1 + index % 4), WIDTH - 1)
        p = rng.integers(0, 2, 200).repeat(30) ^ (rng.random(6000) < 0.02 * (index % 5))
        order = np.lexsort((p, x, y, t))
        events = Packet(
            t[order], x[order].astype(np.uint16), y[order].astype(np.uint16), p[order].astype(np.uint8)
        )
        data = encode(encoder, events)
        assert rows(decoder.decode(data, **SIZE)) == rows(events)
        assert reference.decode(data) == rows(events)
        if index == 0:
            assert len(data) < 2 * 6000  # runs without gaps
    scattered = packet(0, 2_000_000, 5000, seed=1)
    assert len(encode(Evt3Encoder(), scattered)) <= 6.3 * 5000  # a low half, a row, a column


@pytest.mark.parametrize("span_us", [1, 50, 1000, 100_000, 40_000_000])
def test_evt3_there_and_back(span_us):
    """With few and with many new times; the second packet begins with state."""
    encoder, decoder, reference = Evt3Encoder(), Evt3Decoder(), Reference()
    for begin_us in (123, 123 + span_us):
        events = packet(begin_us, begin_us + span_us, 5000, seed=span_us)
        data = encode(encoder, events)
        decoded = decoder.decode(data, **SIZE)
        for ours, theirs in zip(decoded, events, strict=True):
            assert ours.dtype == theirs.dtype
            assert np.array_equal(ours, theirs)
        assert reference.decode(data) == rows(events)
        assert len(data) <= 8 * 5000 + 16


def test_evt3_of_many_packets_over_several_wraps():
    """40 packets over 60 s, with silences and empty packets: time goes on for who sees them all."""
    encoder, decoder, reference = Evt3Encoder(), Evt3Decoder(), Reference()
    rng = np.random.default_rng(2)
    now_us = 0
    for index in range(40):
        end_us = now_us + int(rng.integers(1, 3_000_000))
        events = packet(now_us, end_us, 0 if index % 5 == 3 else int(rng.integers(1, 200)), seed=index)
        data = encode(encoder, events, end_us)
        assert rows(decoder.decode(data, **SIZE)) == rows(events)
        assert reference.decode(data) == rows(events)
        now_us = end_us
    assert now_us > 3 * WRAP_US


@pytest.mark.parametrize(
    "times",
    [
        (WRAP_US - 1, WRAP_US),
        (WRAP_US - 1, WRAP_US, WRAP_US + 1),
        (0, WRAP_US - 4096, 2 * WRAP_US - 4096 * 5),  # high halves that nearly agree, a wrap apart
        (4096 * 20, WRAP_US + 4096 * 19),
        (4096 * 20, WRAP_US + 4096 * 20),
        (4096 * 20, WRAP_US + 4096 * 21),
        (5, 7 * WRAP_US + 5),
        (WRAP_US - 1, 3 * WRAP_US),
    ],
)
@pytest.mark.parametrize("together", [True, False])
def test_evt3_where_time_wraps(times, together):
    """In one packet, or in one for each event; also by nearly a whole wrap, or several."""
    encoder, decoder, reference = Evt3Encoder(), Evt3Decoder(), Reference()
    t = np.array(times, np.int64)
    one = np.ones(len(t), np.uint16)
    events = Packet(t, one, one, one.astype(np.uint8))
    packets = [events] if together else [Packet(*(c[i : i + 1] for c in events)) for i in range(len(t))]
    begin = t[0] // WRAP_US * WRAP_US  # decoders begin to count at their first packet
    for each in packets:
        data = encode(encoder, each)
        expected = [(time - begin, 1, 1, 1) for time in each.t.tolist()]
        assert rows(decoder.decode(data, **SIZE)) == expected
        assert reference.decode(data) == expected


def test_evt3_says_where_time_wraps_with_the_last_and_the_first_high_half():
    """Decoders that ask for 0xFFF before 0 (OpenEB: within 10 of each) see it."""
    encoder = Evt3Encoder()
    encode(encoder, packet(100, 200, 5))
    data = encode(encoder, packet(WRAP_US + 9_000_000, WRAP_US + 9_000_001, 1))
    assert data[:4] == word(0x8, 0xFFF) + word(0x8, 0)
    assert data[4:6] == word(0x8, 9_000_000 >> 12)


def test_evt3_after_time_was_set_back_or_far_ahead_begins_anew():
    encoder = Evt3Encoder()
    encode(encoder, packet(10 * WRAP_US, 10 * WRAP_US + 5, 5))
    assert len(encode(encoder, packet(0, 1, 1))) == 8
    assert len(encode(encoder, packet(10**12, 10**12 + 1, 1))) == 8
    ones = np.ones(2, np.uint16)
    both = Packet(np.array([0, 10**15]), ones, ones, ones.astype(np.uint8))
    assert len(encode(Evt3Encoder(), both)) == 14  # no word for each wrap of 32 years


def test_evt3_decoder_finds_the_wraps_that_it_did_not_see():
    late = packet(5 * WRAP_US + 77, 5 * WRAP_US + 5000, 100)
    data = encode(Evt3Encoder(), late)
    assert np.array_equal(Evt3Decoder().decode(data, **SIZE).t, late.t - 5 * WRAP_US)
    for error_us in (-8_000_000, 0, 8_000_000):
        decoder = Evt3Decoder(start_us=int(late.t[0]) + error_us)
        assert np.array_equal(decoder.decode(data, **SIZE).t, late.t)


def test_evt3_of_a_sensor_with_vectors_and_other_words():
    """All words that there are, at random, in three packets that are cut anywhere."""
    rng = np.random.default_rng(4)
    words = [word(0x8, 7), word(0x6, 0)]
    low = 0
    for _ in range(4000):
        kind = int(rng.choice([0x0, 0x2, 0x3, 0x4, 0x5, 0x6, 0x7, 0x8, 0xA, 0xE, 0xF]))
        value = int(rng.integers(0, 1 << 12))
        if kind == 0x6:
            low = value = min(low + int(rng.integers(0, 50)), 4095)
        if kind == 0x8:
            low, value = 0, 7
        if kind == 0x0:
            value = int(rng.integers(0, HEIGHT + 20))
        if kind == 0x3:
            value = int(rng.integers(0, 2)) << 11 | int(rng.integers(0, WIDTH))
        words.append(word(kind, value))
    data = b"".join(words)
    cuts = [0, *(2 * np.sort(rng.integers(1, len(words), 2))).tolist(), len(data)]
    decoder, reference = Evt3Decoder(), Reference()
    seen = 0
    for begin, end in itertools.pairwise(cuts):
        events = rows(decoder.decode(data[begin:end], **SIZE))
        assert events == reference.decode(data[begin:end])
        seen += len(events)
    assert seen > 2000


def test_evt3_vectors_go_on_in_the_next_packet():
    """By hand: columns from 100 on, 12 of which the packet before had, then 8, then 12."""
    decoder = Evt3Decoder()
    begin = word(8, 0) + word(6, 9) + word(0, 3) + word(3, 0x800 | 100) + word(4, 1)
    assert rows(decoder.decode(begin, **SIZE)) == [(9, 100, 3, 1)]
    assert rows(decoder.decode(word(5, 0xF81), **SIZE)) == [(9, 112, 3, 1), (9, 119, 3, 1)]
    assert rows(decoder.decode(word(4, 0x801), **SIZE)) == [(9, 120, 3, 1), (9, 131, 3, 1)]


def test_evt3_without_a_time_is_ignored():
    data = (
        word(0, 3) + word(2, 5) + word(6, 1) + word(2, 6) + word(8, 1) + word(2, 7) + word(6, 2) + word(2, 8)
    )
    decoder = Evt3Decoder()
    assert rows(decoder.decode(data, **SIZE)) == [(4098, 8, 3, 0)]
    assert rows(decoder.decode(word(2, 9), **SIZE)) == [(4098, 9, 3, 0)]  # the next packet continues
    assert rows(Evt3Decoder().decode(b"", **SIZE)) == []


def test_evt3_a_high_half_that_comes_late_is_no_wrap():
    data = b"".join([word(8, 20), word(6, 0), word(2, 1), word(8, 10), word(2, 2), word(8, 9), word(2, 3)])
    times = Evt3Decoder().decode(data, **SIZE).t.tolist()
    assert times == [20 << 12, 10 << 12, 9 << 12]
    assert [t for t, *_ in Reference().decode(data)] == times
    wrapped = b"".join([word(8, 20), word(6, 0), word(2, 1), word(8, 9), word(2, 2)])
    assert Evt3Decoder().decode(wrapped, **SIZE).t.tolist() == [20 << 12, WRAP_US | 9 << 12]


def test_evt3_that_is_none_is_refused():
    with pytest.raises(EventCodecError, match="words of 2 bytes"):
        Evt3Decoder().decode(b"abc", **SIZE)
    with pytest.raises(EventCodecError, match="0x9, 0xB"):
        Evt3Decoder().decode(word(0x9, 0) + word(0x8, 0) + word(0xB, 0), **SIZE)


@pytest.mark.parametrize("encoding", ["evt3", "mono"])
@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"x": np.array([1, WIDTH], np.uint16)}, "column 640"),
        ({"y": np.array([HEIGHT, 1], np.uint16)}, "row 480"),
        ({"polarity": np.array([0, 2], np.uint8)}, "polarity is 0 or 1, got 2"),
        ({"t": np.array([5, 4])}, "not sorted"),
        ({"t": np.array([5])}, "1 times for 2"),
        ({"y": np.array([5], np.uint16)}, "2 columns, 1 rows"),
    ],
)
def test_events_that_do_not_fit_are_refused(encoding, change, reason):
    good = Packet(np.array([5, 6]), *(np.array([1, 1], np.uint16) for _ in "xy"), np.array([0, 1], np.uint8))
    wrong = good._replace(**change)
    encode_it = {
        "evt3": lambda: Evt3Encoder().encode(EventColumns(*wrong), **SIZE, end_us=0),
        "mono": lambda: encode_mono(EventColumns(*wrong), **SIZE, base_us=0),
    }[encoding]
    with pytest.raises(EventCodecError, match=reason):
        encode_it()


def test_sensors_that_are_too_large_are_refused():
    nothing = packet(0, 1, 0)
    Evt3Encoder().encode(EventColumns(*nothing), width=2048, height=2048, end_us=0)
    with pytest.raises(EventCodecError, match="use mono"):
        Evt3Encoder().encode(EventColumns(*nothing), width=2049, height=10, end_us=0)
    encode_mono(EventColumns(*nothing), width=65536, height=32768, base_us=0)
    with pytest.raises(EventCodecError, match="65536 x 32768"):
        encode_mono(EventColumns(*nothing), width=10, height=32769, base_us=0)


def test_the_last_pixel_of_the_largest_sensors():
    last = Packet(
        np.array([1]), np.array([2047], np.uint16), np.array([2047], np.uint16), np.array([1], np.uint8)
    )
    size = {"width": 2048, "height": 2048}
    data = Evt3Encoder().encode(EventColumns(*last), **size, end_us=0)
    assert rows(Evt3Decoder().decode(data, **size)) == rows(last)
    last = last._replace(x=np.array([65535], np.uint16), y=np.array([32767], np.uint16))
    data = encode_mono(EventColumns(*last), width=65536, height=32768, base_us=1)
    assert rows(decode_mono(data, base_ns=1000)) == [(1000, 65535, 32767, 1)]


def test_mono_word_of_one_event():
    """By hand: brighter, row 3, column 5, 7 us after the base."""
    one = Packet(np.array([107]), np.array([5], np.uint16), np.array([3], np.uint16), np.array([1], np.uint8))
    data = bytes(encode_mono(EventColumns(*one), **SIZE, base_us=100))
    assert int.from_bytes(data, "little") == 1 << 63 | 3 << 48 | 5 << 32 | 7000


@pytest.mark.parametrize("base_us", [0, 50, 10**12])
def test_mono_there_and_back(base_us):
    events = packet(base_us, base_us + 4_294_967, 5000)
    data = encode_mono(EventColumns(*events), **SIZE, base_us=base_us)
    decoded = decode_mono(data, base_ns=base_us * 1000)
    assert np.array_equal(decoded.t, events.t * 1000)
    for ours, theirs in zip(decoded[1:], events[1:], strict=True):
        assert ours.dtype == theirs.dtype
        assert np.array_equal(ours, theirs)


def test_mono_times_that_are_too_far_apart_are_refused():
    one = np.ones(2, np.uint16)
    events = Packet(np.array([10, 4_294_977]), one, one, one.astype(np.uint8))
    encode_mono(EventColumns(*events), **SIZE, base_us=10)
    for base_us in (9, 11):
        with pytest.raises(EventCodecError, match=r"4\.29 s"):
            encode_mono(EventColumns(*events), **SIZE, base_us=base_us)
    with pytest.raises(EventCodecError, match="words of 8 bytes"):
        decode_mono(b"1234567", base_ns=0)


@pytest.mark.parametrize("count", [0, 1, 2, 1000])
def test_arrays_of_dvs_msgs_are_read(count):
    """Against messages that were encoded one by one."""
    events = packet(1_500_000, 3_500_000, count)
    record, time = cdr.record_class("dvs_msgs/msg/Event"), cdr.record_class("builtin_interfaces/msg/Time")
    header = cdr.record_class("std_msgs/msg/Header")(time(0, 0), "dvs")
    messages = [record(x, y, time(t // 10**6, t % 10**6 * 1000), bool(p)) for t, x, y, p in rows(events)]
    array = cdr.encode(cdr.record_class("dvs_msgs/msg/EventArray")(header, HEIGHT, WIDTH, messages))
    size, found = read_dvs(array)
    assert size == (WIDTH, HEIGHT)
    assert rows(found) == rows(events)
    if count:
        with pytest.raises(EventCodecError, match="are no dvs_msgs/EventArray"):
            read_dvs(array[:-8])


def test_words_of_libcaer():
    """Column in the upper 15 bits, then row, polarity and the flag; time wraps after 2^31 us."""
    words = [(5 << 17 | 7 << 2 | 1 << 1 | 1, 2**31 - 2), (32767 << 17 | 32767 << 2 | 1, 1)]
    data = np.array(words, "<u4").tobytes()
    late_ns = (2**31 + 1) * 1000
    assert rows(decode_libcaer(data, base_ns=9)) == [
        (9 + (2**31 - 2) * 1000, 5, 7, 1),
        (9 + late_ns, 32767, 32767, 0),
    ]
    assert rows(decode_libcaer(b"", base_ns=0)) == []
    with pytest.raises(EventCodecError, match="words of 8 bytes"):
        decode_libcaer(b"1234", base_ns=0)


def libcaer_cmp_reference(words: list[int], base_ns: int) -> list[tuple[int, int, int, int]]:
    """Decode word by word, as the definition reads: times since the base, vectors along a column."""
    events: list[tuple[int, int, int, int]] = []
    high = low = x = base = sign = 0
    for word in words:
        kind, value = word >> 12, word & 0xFFF
        t = base_ns + 1000 * (high << 12 | low)
        if kind == 0:
            high = value
        elif kind == 1:
            low = value
        elif kind == 2:
            x = value & 0x7FF
        elif kind == 3:
            events.append((t, x, value & 0x7FF, value >> 11))
        elif kind == 4:
            base, sign = value & 0x7FF, value >> 11
        else:
            events += [(t, x, base + bit, sign) for bit in range(8) if value >> bit & 1]
            base += 8
    return [event for event in events if event[1] < WIDTH and event[2] < HEIGHT]


def test_words_of_libcaer_cmp():
    words = [
        0x0001, 0x1002, 0x2003, 0x3804,  # 1 x 4096 + 2 us, column 3, row 4 brighter
        0x4810, 0x5081, 0x5F02,  # rows 16 and 23, and row 25 of the next eight; 0xF00 is unused
        0x1005, 0x4064, 0x5001,  # 3 us later, row 100, darker
    ]  # fmt: skip
    data = np.array(words, "<u2").tobytes()
    expected = [(3, 4, 1), (3, 16, 1), (3, 23, 1), (3, 25, 1)]
    assert rows(decode_libcaer_cmp(data, base_ns=7, **SIZE)) == [
        *((4_098_007, *pixel) for pixel in expected),
        (4_101_007, 3, 100, 0),
    ]


def test_libcaer_cmp_agrees_with_a_decoder_that_reads_word_by_word():
    rng = np.random.default_rng(0)
    for _ in range(200):
        words = rng.integers(0, 6 << 12, rng.integers(0, 300)).astype("<u2")
        words = np.concatenate([[2 << 12], words]).astype("<u2")  # a column comes first
        found = decode_libcaer_cmp(words.tobytes(), base_ns=123, **SIZE)
        assert rows(found) == libcaer_cmp_reference(words.tolist(), 123)


@pytest.mark.parametrize(
    ("words", "message"), [([0x2001, 0x6000], "begin with 0x6"), ([0x3001], "before its first column")]
)
def test_what_is_no_libcaer_cmp_is_refused(words, message):
    with pytest.raises(EventCodecError, match=message):
        decode_libcaer_cmp(np.array(words, "<u2").tobytes(), base_ns=0, **SIZE)
