"""Frames: round trips, and what the parsers do with frames that are not what they must be."""

from __future__ import annotations

import contextlib

import pytest
from damage import mutate
from hypothesis import given, settings
from hypothesis import strategies as st

from cortex.codec import MalformedMessage
from cortex.control import control_types
from cortex.message_types import message
from cortex.records import Heartbeat, Leave
from cortex.wire import (
    ATTACH,
    CONTROL,
    HEADER_SIZE,
    MESSAGE,
    AttachAnswer,
    AttachKey,
    Header,
    answer_frame,
    attach_key,
    check_body,
    control_frame,
    pack_header,
    parse_answer,
    parse_attach_key,
    parse_control,
    prefix,
    unpack_header,
)

u8, u32, u64 = (st.integers(0, 2**bits - 1) for bits in (8, 32, 64))
i64 = st.integers(-(2**63), 2**63 - 1)
headers = st.builds(
    Header,
    kind=st.sampled_from([b"M", b"L", b"S", b"N", b"A", b"C", b"Q", b"P", b"E"]),
    source=u64,
    fingerprint=u64,
    sequence=u64,
    stamp_ns=st.none() | i64,
    publish_ns=i64,
    body_size=u64,
    aux=u64,
)


@given(headers)
def test_a_header_survives(header):
    packed = pack_header(header)
    assert unpack_header(packed) == unpack_header(memoryview(packed + b"body")) == header
    for size in (0, HEADER_SIZE - 1):
        with pytest.raises(MalformedMessage, match=f"a frame of {size} bytes is shorter"):
            unpack_header(packed[:size])


@given(headers, st.integers(0, 7), u8)
def test_a_header_with_another_beginning_is_refused(header, place, byte):
    packed = bytearray(pack_header(header))
    packed[place] = byte
    allowed = packed[:3] == b"CTX" and packed[4] == 1 and packed[5] < 2 and packed[6:8] == b"\x40\0"
    if allowed:
        unpack_header(bytes(packed))
    else:
        with pytest.raises(MalformedMessage, match="not a frame of Cortex 1"):
            unpack_header(bytes(packed))


keys = st.builds(
    AttachKey,
    source=u64,
    reader=u64,
    shared_memory=st.booleans(),
    strict=st.booleans(),
    quota=u8,
    timeout_ms=u32,
)


@given(keys, st.booleans())
def test_an_attach_key_survives(key, stamped):
    packed = attach_key(key, stamped=stamped)
    assert packed[:16] == prefix(ATTACH, key.source, stamped=stamped)
    assert parse_attach_key(packed) == key


@given(st.binary(max_size=80))
def test_other_subscriptions_are_no_attach_keys(data):
    assert parse_attach_key(data) is None
    assert parse_attach_key(prefix(MESSAGE, 1, stamped=False) + bytes(16)) is None


answers = st.builds(AttachAnswer, sequence=u64, latched=st.binary(max_size=200))


@given(keys, answers, st.data())
def test_an_attach_answer_survives_is_refused_or_fits_its_frame(key, answer, data):
    """Whatever is changed, what comes out is all of the frame and no more."""
    frame = answer_frame(attach_key(key, stamped=True), answer)
    assert parse_answer(frame) == answer
    frame = mutate(data.draw(st.randoms()), frame)
    with contextlib.suppress(MalformedMessage):
        assert len(frame) == 64 + len(parse_answer(frame).latched)


@given(u64, u64, st.integers(0, 2**32))
def test_a_control_message_survives(node, revision, sequence):
    sent = Heartbeat(node, revision, 3)
    received, header = parse_control(control_frame(sent, sequence, source=7), control_types(Heartbeat, Leave))
    assert received == sent
    assert (header.kind, header.sequence, header.source) == (CONTROL, sequence, 7)


def test_a_control_message_of_another_type_is_refused():
    with pytest.raises(MalformedMessage, match="unexpected control message of type"):
        parse_control(control_frame(Leave(1)), control_types(Heartbeat))


@settings(max_examples=300)
@given(st.data())
def test_a_mutated_control_frame_is_refused_or_a_message(data):
    frame = mutate(data.draw(st.randoms()), control_frame(Heartbeat(1, 2, 3)))
    with contextlib.suppress(MalformedMessage):
        received, _ = parse_control(frame, control_types(Heartbeat))
        assert isinstance(received, Heartbeat)
        assert len(frame) == HEADER_SIZE + 24


Bulk = message(type("Bulk", (), {"__annotations__": {"data": bytes}}))


def test_a_control_message_has_a_limit():
    with pytest.raises(ValueError, match="exceeds"):
        control_frame(Bulk(bytes(16 << 20)))
    with pytest.raises(MalformedMessage, match="limit"):
        check_body(Header(CONTROL, 0, 0, 0, None, 0, (16 << 20) + 1, 0), HEADER_SIZE + (16 << 20) + 1)
