"""Encoding and decoding against an independent reading of WIRE.md, and what is refused."""

from __future__ import annotations

import dataclasses
import gc
import sys
import tracemalloc
import weakref
from concurrent.futures import ThreadPoolExecutor
from enum import Enum, IntEnum
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from random_schemas import any_message

from cortex.body import Body
from cortex.codec import MalformedMessage, Plan, codec_of
from cortex.compiled import native
from cortex.message_types import Array, Float32, Int8, Int32, UInt64, message
from cortex.messages import Clock, Image, Imu, MotorCommand
from cortex.native import make_coder
from cortex.schema import schema_of


class Mode(Enum):
    LAST = 2**31 - 1
    OFF = 0
    FIRST = -(2**31)
    ALIAS = 0


class OtherMode(Enum):
    OFF = 0


class Level(IntEnum):
    LOW = 1
    HIGH = 2


@message
class Point:
    x: float
    ok: bool = False


@message
class Everything:
    stamp_ns: int
    small: Int8
    unsigned: UInt64
    flag: bool
    mode: Mode
    level: Level | None
    text: str
    data: bytes
    fixed: Array["float32", 3]
    large: Array["uint8", 40, 40] | None
    a: Array["float32", "n"]
    b: Array["float64", "n", 3]
    open_: Array["any", "h", "w"]
    mask: Array["bool", "h", "w"] | None
    point: Point | None
    maybe: Float32 | None
    points: list[Point]
    modes: list[Mode]
    flags: list[bool]
    sizes: list[Int8]
    names: list[str]
    ragged: list[Array["any", "k", "k"]]
    deep: list[list[Int32]]


def everything(**changes: Any) -> Everything:
    plain = Everything(
        stamp_ns=1, small=-2, unsigned=2**64 - 1, flag=True, mode=Mode.FIRST, level=Level.HIGH, text="hé",
        fixed=np.arange(3, dtype=np.float32), large=np.arange(1600, dtype=np.uint8).reshape(40, 40),
        a=np.arange(5, dtype=np.float32), b=np.zeros((5, 3)), open_=np.eye(3, dtype=np.complex128)[:2],
        mask=np.eye(3, dtype=bool)[:2], point=Point(1.5), maybe=0.5, points=[Point(1.0, True), Point(2.0)],
        modes=[Mode.OFF, Mode.LAST], flags=[True, False, True], sizes=[-128, 127], deep=[[], [1, 2], [3]],
        ragged=[np.ones((2, 2), np.float16), np.zeros((0, 0)), np.ones((16, 16), np.int64)],
        names=["", "hé", "z" * 100], data=b"ab",
    )  # fmt: skip
    return dataclasses.replace(plain, **changes)


def body_of(value: Any) -> bytes:
    return codec_of(type(value)).encode(value, 2**30)


def check_both_ways(value: Any) -> None:
    """All ways to write a message give the body of the reference, and all ways to read that the message."""
    codec, reference = codec_of(type(value)), Body(schema_of(type(value)), type(value))
    body = Plan(reference, value).to_bytes()
    assert codec.encode(value, len(body)) == body
    assert codec.size(value) == len(body)
    assert codec.prepare(value, len(body)) == body
    assert codec.fixed_size in (None, len(body))
    if body:
        with pytest.raises(ValueError, match="exceeds the limit"):
            codec.encode(value, len(body) - 1)
        assert isinstance(codec.prepare(value, len(body) - 1), Plan)
    memory = np.full(len(body) + 8, 0xAA, np.uint8)
    assert codec.prepare(value, -1).write(memory) == len(body)
    assert memory.tobytes() == body + b"\xaa" * 8  # and not a byte beyond

    frame = b"header" + body + b"trailer"
    read_only = np.frombuffer(frame, np.uint8)
    for decoded in (
        codec.decode(body),
        codec.decode(frame, 6, len(body)),
        codec.decode(read_only, 6, len(body)),
        reference.read(frame, 6, len(body)),
    ):
        assert type(decoded) is type(value)
        assert decoded == value
        assert codec.encode(decoded, len(body)) == body  # a zero may have a sign


@given(any_message())
def test_messages_of_any_type(value):
    check_both_ways(value)
    if native is not None:  # it is C that has written and read each of them
        coder, body = make_coder(schema_of(type(value)), type(value)), body_of(value)
        assert coder.encode(value, len(body)) == body
        assert coder.decode(body, 0, len(body)) == value


def test_a_type_with_everything():
    check_both_ways(everything())
    check_both_ways(everything(open_=np.eye(4, 3)[::2], mask=None, point=None, large=None))


def test_stamp_of_finds_integer_stamps_only():
    @message
    class Floating:
        stamp_ns: float

    assert codec_of(Everything).stamp_of(everything()) == 1
    assert codec_of(Floating).stamp_of is None
    assert codec_of(Point).stamp_of is None


OUT, KIND = ValueError, TypeError
WRONG = [
    ("stamp_ns", 1.5, KIND, "no number for int64"),
    ("stamp_ns", np.float64(1), KIND, "no number for int64"),
    ("stamp_ns", np.bool_(True), KIND, "no number for int64"),
    ("stamp_ns", 2**63, OUT, "out of the range of int64"),
    ("stamp_ns", np.uint64(2**63), OUT, "out of the range of int64"),
    ("small", 128, OUT, "out of the range of int8"),
    ("unsigned", 2**64, OUT, "out of the range of uint64"),
    ("unsigned", -1, OUT, "out of the range of uint64"),
    ("flag", "yes", KIND, "no bool"),
    ("flag", np.zeros(2), KIND, "no bool"),
    ("mode", 0, KIND, "allowed are Mode.LAST, Mode.OFF, Mode.FIRST"),
    ("mode", OtherMode.OFF, KIND, "is no Mode"),
    ("level", 1, KIND, "is no Level"),
    ("text", b"bytes", KIND, "no str"),
    ("text", "\ud800", OUT, "UTF-8"),
    ("data", "text", KIND, "no bytes"),
    ("data", bytearray(b"ab"), KIND, "no bytes"),
    ("fixed", np.zeros(4, np.float32), OUT, r"shape \[4\], expected \[3\]"),
    ("fixed", [1.0, 2.0, 3.0], KIND, "expected an array, got list"),
    ("large", np.zeros((40, 41), np.uint8), OUT, r"expected \[40, 40\]"),
    ("large", np.zeros((40, 40), np.int8), KIND, "dtype int8, expected uint8"),
    ("a", np.zeros(5), KIND, r"dtype float64, expected float32.*astype"),
    ("a", np.zeros(5, ">f4"), KIND, "dtype >f4"),
    ("a", np.zeros((5, 1), np.float32), OUT, r"shape \[5, 1\], expected \[n\]"),
    ("b", np.zeros((4, 3)), OUT, "dimension n is 4, but 5 in an earlier field"),
    ("b", np.zeros((5, 2)), OUT, r"expected \[n, 3\]"),
    ("open_", np.zeros((2, 2), "M8[s]"), KIND, "dtype datetime64"),
    ("open_", np.zeros((2, 2), object), KIND, "dtype object"),
    ("open_", np.zeros((2, 3), ">f8"), KIND, "dtype >f8"),
    ("open_", np.zeros(3), OUT, r"shape \[3\], expected \[h, w\]"),
    ("mask", np.zeros((2, 4), bool), OUT, "dimension w is 4, but 3 in an earlier field"),
    ("point", (1.0, True), KIND, "got tuple, expected Point"),
    ("point", Point("x"), KIND, r"\.x: 'x' is no number"),
    ("point", Point(None), KIND, r"\.x: None is no number"),
    ("maybe", "x", KIND, "no number for float32"),
    ("maybe", np.complex64(1), OUT, "range of float32"),
    ("maybe", 1e300, OUT, "range of float32"),
    ("maybe", np.float64(1e300), OUT, "range of float32"),
    ("points", Point(1.0), KIND, "no list"),
    ("points", [Point(1.0), 5], KIND, r"\[1\]: got int"),
    ("points", [Point(1.0), None], KIND, r"\[1\]: got NoneType"),
    ("modes", [0], KIND, r"\[0\]: the int 0 is no Mode"),
    ("flags", [np.int8(2)], KIND, r"\[0\].*no bool"),
    ("flags", [None], KIND, r"\[0\].*no bool"),
    ("sizes", [1, -129], OUT, r"\[1\]: -129 is out of the range of int8"),
    ("sizes", [np.int16(128)], OUT, r"\[0\].*out of the range of int8"),
    ("sizes", "12", KIND, "no list"),
    ("names", ["a", b"b"], KIND, r"\[1\].*no str"),
    ("names", ["\ud800"], OUT, "UTF-8"),
    ("ragged", [np.zeros((2, 3))], OUT, r"\[0\]: .*dimension k"),
    ("deep", [[1], 2], KIND, r"\[1\].*no list"),
    ("deep", [["x"]], KIND, r"\[0\]\[0\].*no number for int32"),
]


@pytest.mark.parametrize(
    ("field", "value", "kind", "text"), WRONG, ids=[f"{w[0]}-{w[3][:20]}" for w in WRONG]
)
def test_wrong_values_are_named(field, value, kind, text):
    """C, where it is there, neither writes nor raises: the words are those of Python."""
    codec = codec_of(Everything)
    wrong = everything(**{field: value})
    if (coder := make_coder(codec.schema, codec.type)) is not None:
        assert coder.encode(wrong, 2**20) is None
        assert coder.encode(everything(), 2**20) is not None
    for attempt in (
        lambda: codec.encode(wrong, 2**20),
        lambda: codec.size(wrong),
        lambda: codec.prepare(wrong, 0),
    ):
        with pytest.raises(kind, match=rf"Everything\.{field}.*{text}"):
            attempt()


def test_a_message_of_another_type_is_refused():
    @message(name="Point")
    class Other:
        x: float
        ok: bool = False

    for cls, value in ((Point, Other(1.0)), (Imu, Point(1.0)), (MotorCommand, Point(1.0))):
        with pytest.raises(TypeError, match=f"got {type(value).__name__}, expected {cls.__name__}"):
            codec_of(cls).encode(value, 1000)
    assert codec_of(Point) is codec_of(Point)
    with pytest.raises(TypeError, match="@cortex"):
        codec_of(int)
    with pytest.raises(TypeError, match="not a message type"):
        codec_of(type("Derived", (Point,), {}))


def test_arrays_of_any_memory_layout_are_accepted():
    grid = np.arange(4096, dtype=np.float64).reshape(64, 64)
    check_both_ways(MotorCommand(0, grid[0, ::2]))
    row = np.broadcast_to(grid[0], (3, 64))
    for array in (grid[::2, 1:], grid.T, np.asfortranarray(grid), grid[::-1], row):
        check_both_ways(Image(0, array[:, :, None], "64FC1"))


def test_decoded_arrays_are_read_only_views():
    body = body_of(everything())
    for data in (body, np.frombuffer(body, np.uint8)):
        decoded = codec_of(Everything).decode(data)
        for array in (decoded.fixed, decoded.large, decoded.a, decoded.open_, decoded.ragged[0]):
            assert not array.flags.owndata
            with pytest.raises(ValueError, match="read-only"):
                array[...] = 0
            with pytest.raises(ValueError, match="WRITEABLE"):
                array.flags.writeable = True


def test_views_keep_the_buffer_alive():
    class Lease:
        def __init__(self, data: bytes) -> None:
            self.memory = np.frombuffer(data, np.uint8)
            self.__array_interface__ = self.memory.__array_interface__

    lease = Lease(body_of(MotorCommand(0, np.ones(1000))))
    gone = weakref.ref(lease)
    view = np.asarray(lease)
    view.flags.writeable = False
    decoded = codec_of(MotorCommand).decode(view, 0, len(view))
    part = decoded.speed[10:20]
    del lease, view, decoded
    gc.collect()
    assert gone() is not None
    assert part.sum() == 10.0
    del part
    gc.collect()
    assert gone() is None


def test_a_plan_refuses_small_memory_and_touches_nothing():
    memory = np.full(100, 7, np.uint8)
    with pytest.raises(ValueError, match="does not fit into a buffer of 100"):
        codec_of(Everything).prepare(everything(), 0).write(memory)
    assert (memory == 7).all()


def test_bodies_beyond_4_gib_are_refused():
    huge = np.broadcast_to(np.zeros(1), 2**29)  # 4 GiB that take up 8 bytes
    for attempt in (codec_of(MotorCommand).size, lambda value: codec_of(MotorCommand).encode(value, 2**33)):
        with pytest.raises(ValueError, match=r"shorter than 2\^32"):
            attempt(MotorCommand(0, huge))


def test_bodies_have_their_size():
    for value in (Imu(0, np.zeros(3), np.zeros(3)), Clock(1, 2)):
        codec, body = codec_of(type(value)), body_of(value)
        for wrong in (body[:-1], body + bytes(1), body + bytes(8)):
            for arguments in ((wrong,), (wrong, 0, len(wrong)), (wrong + bytes(64), 0, len(wrong))):
                with pytest.raises(MalformedMessage, match=f"allowed are {len(body)} to {len(body)}"):
                    codec.decode(*arguments)
    for value in (everything(), Imu(0, np.zeros(3), np.zeros(3)), Point(1.0), MotorCommand(0, np.zeros(3))):
        body = body_of(value)
        for size in (len(body) + 1, 2**40, -1):  # beyond the buffer
            with pytest.raises(MalformedMessage):
                codec_of(type(value)).decode(body, 0, size)


def test_a_small_body_cannot_claim_much_memory():
    """Lists of lists whose offsets all point to one place would unfold without the bound on claims."""

    @message
    class Bomb:
        lists: list[list[list[bool]]]

    count = 2000
    place = (8).to_bytes(4, "little") + count.to_bytes(4, "little")
    body = place + place * count  # each of 2000 lists has 2000 elements, which are the lists themselves
    codec = codec_of(Bomb)
    tracemalloc.start()
    try:
        with pytest.raises(MalformedMessage, match="claim more than the body"):
            codec.decode(body)
        assert tracemalloc.get_traced_memory()[1] < 4 * 2**20  # 2000^2 elements would take 32 MB and more
    finally:
        tracemalloc.stop()


def test_threads_may_share_a_codec():
    codec = codec_of(Everything)
    values = [everything(stamp_ns=k, text="x" * k, a=np.full(5, k, np.float32)) for k in range(20)]
    bodies = [body_of(value) for value in values]

    def is_right(k: int) -> bool:
        return (
            codec.encode(values[k % 20], 2**20) == bodies[k % 20]
            and codec.decode(bodies[k % 20]) == values[k % 20]
        )

    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        with ThreadPoolExecutor(4) as pool:
            assert all(pool.map(is_right, range(400), timeout=60.0))
    finally:
        sys.setswitchinterval(interval)


def test_codecs_die_with_their_classes():
    """Who is sent ever new schemas keeps those of the last 256 only."""
    from cortex import schema as schema_module
    from cortex.schema import Field, Schema

    def codec_of_schema(schema):
        return codec_of(schema_module.type_from_schema(schema))

    codec = codec_of_schema(Schema("test/Passing", (Field("value", "int64"),)))
    assert codec.decode(bytes(8)).value == 0
    alive = weakref.ref(codec), weakref.ref(codec.type)
    del codec
    for number in range(256):
        codec_of_schema(Schema(f"test/Passing{number}", (Field("value", "int64"),)))
    gc.collect()
    assert [reference() for reference in alive] == [None, None]
