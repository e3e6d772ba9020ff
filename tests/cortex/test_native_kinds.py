"""Every kind of field in C against the Python packer: the same bytes, the same objects, the same refusals."""

from __future__ import annotations

import gc
import os
import random
import struct
import sys
import tracemalloc
import weakref
from enum import Enum
from typing import Any

import numpy as np
import pytest
from c_module import needs_native
from damage import mutate, outcome
from hypothesis import given
from hypothesis import strategies as st
from peer import slots_held
from processes import SOON_S, wait_for
from random_schemas import any_message, schemas
from test_codec import Everything, Level, Mode, Point, everything
from test_large import connected
from wire_vectors import load_vectors

from cortex import reliable
from cortex.body import Body
from cortex.codec import Plan, codec_of
from cortex.compiled import native
from cortex.message_types import Array, message
from cortex.messages import Image
from cortex.native import make_coder
from cortex.schema import Schema, schema_of, type_from_schema

pytestmark = needs_native


def python_body(value: Any) -> bytes:
    """The body as the Python packer writes it."""
    return Plan(Body(schema_of(type(value)), type(value)), value).to_bytes()


def coder_of(cls: type) -> Any:
    return make_coder(schema_of(cls), cls)


class Count(int):
    """A number of a class of its own."""


@pytest.mark.parametrize(
    "changes",
    [
        {"stamp_ns": True},
        {"stamp_ns": Level.HIGH},
        {"stamp_ns": Count(7)},
        {"maybe": 3},
        {"maybe": np.float64(0.1)},
        {"point": Point(2**60)},
        {"mode": Mode.ALIAS},
        {"points": (Point(1.0),)},
        {"sizes": [True, Count(5)]},
        {"deep": ([1], (2, 3))},
        {
            "stamp_ns": np.int64(-5),
            "sizes": [np.uint8(7), np.int16(-8)],
            "flags": [np.bool_(True), np.bool_(False)],
        },
        {"maybe": np.float32(0.1), "point": Point(np.float16(0.1), np.bool_(True))},
        {"maybe": np.int8(3), "point": Point(np.uint64(2**64 - 1))},
        {"point": Point(np.longdouble("0.1"))},
    ],
    ids=str,
)
def test_values_that_stand_for_the_usual_ones(changes):
    """An int for a float, a subclass of int, numbers of NumPy, a tuple: C writes what Python does."""
    value = everything(**changes)
    assert coder_of(Everything).encode(value, 1 << 20) == python_body(value)


def test_dimensions_that_no_array_can_have():
    """NumPy raises for some shapes of no items; to a subscriber they are malformed like others."""

    @message
    class Cube:
        data: Array["float64", "a", "b", "c"]

    codec, good, most = codec_of(Cube), python_body(Cube(np.zeros((0, 5, 5)))), 2**32 - 1
    for shape, fits in (
        ((0, 5, 5), True),
        ((0, 2**31, 2**28), True),
        *[((0, most, most), False), ((most, 0, most), False), ((most, most, 0), False)],
    ):
        assert is_accepted(codec, good[:8] + struct.pack("<3I", *shape) + good[20:], False) == fits


def many_names(count: int) -> type:
    annotations = {f"{array}{k}": Array["uint8", f"n{k}"] for k in range(count) for array in "ab"}
    return message(type("Names", (), {"__annotations__": annotations}))


def test_more_names_than_there_is_room_for():
    """Dimensions that must agree: 64 in one message, else Python does the work."""
    assert coder_of(many_names(64)) is not None
    cls = many_names(65)
    assert coder_of(cls) is None
    value = cls(*[np.full(k // 2, k, np.uint8) for k in range(130)])
    assert codec_of(cls).decode(codec_of(cls).encode(value, 1 << 20)) == value


@pytest.mark.parametrize("rows", [b"", bytes(111), bytes(113)])
def test_a_table_of_another_form_is_refused(rows):
    with pytest.raises(ValueError, match="a row has 112 bytes"):
        native.Coder(rows, (), -1, b"")


def test_types_come_and_go():
    """A coder keeps its classes and enums, and no longer than somebody keeps it."""

    def make() -> list[weakref.ref[Any]]:
        class Kind(Enum):
            ONE = 1

        @message
        class Inner:
            kind: Kind

        @message
        class Outer:
            inners: list[Inner] | None

        codec = codec_of(Outer)
        value = Outer([Inner(Kind.ONE)])
        assert codec.decode(codec.encode(value, 100)) == value
        return [weakref.ref(cls) for cls in (Kind, Inner, Outer)]

    gone = make()
    gc.collect()
    assert [ref() for ref in gone] == [None] * 3


def test_nothing_of_any_kind_is_leaked():
    coder, value = coder_of(Everything), everything()
    body = coder.encode(value, 1 << 20)
    wrong = everything(deep=[[1], ["x"]])
    damaged = [body[:place] + b"\xff" * 4 + body[place + 4 :] for place in range(0, 160, 4)]

    def use() -> None:
        for _ in range(50):
            coder.encode(value, 1 << 20)
            coder.encode(wrong, 1 << 20)
            coder.decode(body, 0, len(body))
            for other in damaged:
                coder.decode(other, 0, len(other))

    def counts() -> list[int]:
        gc.collect()
        shared = (None, Mode.OFF, Mode.FIRST, Level.HIGH, Point, Everything, np.dtype("complex128"), body)
        return [sys.getrefcount(item) for item in shared]

    use()
    before, blocks = counts(), sys.getallocatedblocks()
    use()
    after, grown = counts(), sys.getallocatedblocks() - blocks
    assert grown < 200
    assert all(abs(now - then) < 40 for then, now in zip(before, after, strict=True))  # 50 rounds would be 50


@message
class Frames:
    """Nothing in it is of a size known in advance."""

    stamp_ns: int
    frames: list[Array["any", "h", "w"]]
    numbers: list[float]
    thumbnail: Array["uint8", "h", "w"] | None = None


def opened(node, kind, value):
    """A publisher and a subscriber that are past the ring's first messages."""
    publisher, subscriber = connected(node, kind, reliable(64, SOON_S))
    for _ in range(3):
        publisher.publish(value)
        subscriber.recv(SOON_S)
    return publisher, subscriber


def picture(stamp_ns, height=480, width=640, channels=3, dtype="uint8"):
    data = np.arange(height * width * channels, dtype=np.int64) + stamp_ns
    return Image(stamp_ns, data.astype(dtype).reshape(height, width, channels), "any", "camera", stamp_ns)


def test_pictures_are_the_same_in_a_slot(node):
    """Copied at once, deferred, without the lock: the slot has the bytes that Python writes."""
    publisher, subscriber = opened(node, Image, picture(0))
    for number, (height, dtype) in enumerate(
        [(12, "uint8"), (40, "float32"), (480, "uint8"), (480, "float32")]
    ):
        value = picture(number, height, dtype=dtype)
        assert publisher.publish(value)
        info, body, _ = subscriber.recv_raw(SOON_S)
        assert bytes(body) == python_body(value)
        assert info.stamp_ns == number
        del body
        assert publisher.publish(value)
        assert_same(subscriber.recv(SOON_S).copy(), value.copy())
    wait_for(lambda: slots_held(publisher) == 0)


def test_more_large_arrays_than_are_deferred(node):
    """A list of arrays, some of which are copied with the lock held; slots that had other numbers before."""

    def frames(first: int) -> Frames:
        arrays = [np.full((90, 100 + k), first + k, "<u4" if k % 2 else "<f8") for k in range(20)]
        return Frames(5, arrays, [1.0, 2.0], np.full((200, 200), first, np.uint8))

    publisher, subscriber = opened(node, Frames, frames(100))
    assert publisher.publish(frames(1))
    _, body, _ = subscriber.recv_raw(SOON_S)
    assert bytes(body) == python_body(frames(1))


@pytest.mark.parametrize("change", ["longer", "shorter", "wrong"])
def test_a_list_that_changes_between_measuring_and_writing(node, change):
    """Another thread may have the GIL there: what arrives is whole, and the slot is not overrun."""
    numbers = [float(k) for k in range(20_000)]
    value = Frames(5, [], numbers)
    publisher, subscriber = opened(node, Frames, value)
    acquire, changed = publisher._fast_send.large_acquire, []

    def change_and_acquire(may_wait: bool) -> bool:
        if not changed:
            changed.append(True)
            if change == "longer":
                numbers.extend(numbers)
            elif change == "shorter":
                del numbers[100:]
            else:
                numbers[7] = "seven"
        return acquire(may_wait)

    publisher._fast_send.large_acquire = change_and_acquire
    if change == "wrong":
        with pytest.raises(TypeError, match=r"numbers\[7\]"):
            publisher.publish(value)
    else:
        assert publisher.publish(value)
        _, body, _ = subscriber.recv_raw(SOON_S)
        assert bytes(body) == python_body(value)
        del body
    assert changed
    wait_for(lambda: slots_held(publisher) == 0)


TARGETS = [
    (
        codec_of(type_from_schema(Schema.from_json(vector["schema"]))),
        [bytes.fromhex(case["body"]) for case in vector["cases"] + vector["malformed"]],
    )
    for vector in load_vectors().values()
]
"""The types of the test vectors, with good and malformed bodies."""


def touch(value: Any) -> int:
    """Read everything that a decoded value refers to, and return how much that is."""
    if isinstance(value, np.ndarray):
        assert not value.flags.writeable
        return len(value.tobytes())
    if isinstance(value, (str, bytes)):
        return len(value)
    if isinstance(value, list):
        return sum(map(touch, value)) + len(value)
    names = getattr(value, "__cortex_names__", ())
    return sum(touch(getattr(value, name)) for name in names)


def assert_same(left: Any, right: Any) -> None:
    """Both are of the same classes throughout and hold the same bits; nan is nan."""
    assert type(left) is type(right)
    if isinstance(left, np.ndarray):
        one, other = ((a.dtype, a.shape, a.flags.writeable, a.tobytes()) for a in (left, right))
        assert one == other
    elif isinstance(left, list):
        for pair in zip(left, right, strict=True):
            assert_same(*pair)
    elif isinstance(left, float):
        assert struct.pack("<d", left) == struct.pack("<d", right)
    elif hasattr(left, "__cortex_names__"):
        for name in left.__cortex_names__:
            assert_same(getattr(left, name), getattr(right, name))
    else:
        assert left == right


def is_accepted(codec: Any, body: bytes, bounded: bool = True) -> bool:
    """Decode a body in every way, in C and in Python, and return whether it was accepted."""
    framed = b"\xff" * 64 + body + b"\xff" * 64
    first = outcome(codec.decode, body)
    within = outcome(codec.decode, framed, 64, len(body))
    general = outcome(Body(codec.schema, codec.type).read, np.frombuffer(framed, np.uint8), 64, len(body))
    said = (codec.schema.name, body.hex())
    assert (first is None) == (within is None) == (general is None), said
    if first is None:
        return False
    assert_same(first, general)
    # Items never share bytes, and a list element takes a byte at least.
    assert not bounded or touch(first) <= 2 * len(body), said
    # Through the bytes, which are equal for nan as well.
    again = codec.encode(first, 2**32)
    assert again is not None
    assert again == codec.encode(general, 2**32) == codec.encode(within, 2**32), said
    assert codec.encode(codec.decode(again), 2**32) == again
    return True


@given(any_message(), st.data())
def test_damaged_bodies_of_any_type(value, data):
    body = python_body(value)
    is_accepted(codec_of(type(value)), mutate(data.draw(st.randoms()), body), bounded=False)


@given(schemas, st.binary(max_size=300))
def test_random_bytes(schema, data):
    is_accepted(codec_of(type_from_schema(schema)), data, bounded=False)


def test_mutated_bodies():
    rng, accepted, count = random.Random(1), 0, int(os.environ.get("CORTEX_FUZZ_BODIES", "20000"))
    for index in range(count):
        codec, bodies = TARGETS[index % len(TARGETS)]
        accepted += is_accepted(codec, mutate(rng, rng.choice(bodies), reach=120))
    assert accepted > 2_000  # else the mutations would only show that wrong sizes are rejected
    assert count - accepted > 5_000


def test_rejecting_takes_no_memory():
    """Whatever counts and offsets a body claims, decoding allocates no more than a small multiple of it."""
    for codec, body in ((codec, body) for codec, bodies in TARGETS for body in bodies):
        for place in range(0, min(len(body) - 4, 96), 4):
            damaged = body[:place] + b"\xff\xff\xff\x7f" + body[place + 4 :]
            tracemalloc.start()
            try:
                outcome(codec.decode, damaged)
                peak = tracemalloc.get_traced_memory()[1]
            finally:
                tracemalloc.stop()
            assert peak < 50_000 + 100 * len(body), (codec.schema.name, place)
