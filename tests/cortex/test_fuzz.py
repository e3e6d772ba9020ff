"""Damaged bodies of every type are decoded or rejected and nothing else; `fuzz_decode.py` runs more."""

from __future__ import annotations

import tracemalloc

import numpy as np
from fuzz_decode import outcome, run, targets, touch
from hypothesis import given
from hypothesis import strategies as st
from random_schemas import any_message, schemas

from cortex.codec import codec_of
from cortex.schema import type_from_schema


def test_mutated_bodies():
    results = run(20_000, seed=1)
    assert results["accepted"] > 2_000  # else the mutations would only show that wrong sizes are rejected
    assert results["rejected"] > 5_000


@given(schemas, st.binary(max_size=400))
def test_random_bytes_as_any_type(schema, data):
    codec = codec_of(type_from_schema(schema))
    first = outcome(codec.decode, data)
    general = outcome(codec._body.read, np.frombuffer(data, np.uint8))
    assert (first is None) == (general is None)
    if first is not None:
        touch(first)


@given(any_message(), st.data())
def test_mutated_bodies_of_any_type(value, data):
    codec = codec_of(type(value))
    body = bytearray(codec.encode(value, 2**30))
    for _ in range(data.draw(st.integers(1, 3))):
        if body:
            place = data.draw(st.integers(0, len(body) - 1))
            body[place : place + 4] = data.draw(st.binary(min_size=4, max_size=4))
    first = outcome(codec.decode, bytes(body))
    general = outcome(codec._body.read, bytes(body))
    assert (first is None) == (general is None)
    if first is not None:
        assert codec.encode(first, 2**20) == codec.encode(general, 2**20)


def test_rejecting_takes_no_memory():
    """Whatever counts and offsets a body claims, decoding allocates no more than a small multiple of it."""
    everything = [(target, body) for target in targets() for body in target.bodies]
    for target, body in everything:
        for place in range(0, min(len(body) - 4, 96), 4):
            damaged = body[:place] + b"\xff\xff\xff\x7f" + body[place + 4 :]
            tracemalloc.start()
            try:
                outcome(target.codec.decode, damaged)
                peak = tracemalloc.get_traced_memory()[1]
            finally:
                tracemalloc.stop()
            assert peak < 50_000 + 100 * len(body), (target.name, place)
