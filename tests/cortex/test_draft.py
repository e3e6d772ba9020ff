"""Messages written in place give the body that encoding gives."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from cortex.codec import codec_of
from cortex.message_types import Array, Int8, message
from cortex.messages import Events, Image


@message
class Mixed:
    stamp_ns: int
    small: Int8
    text: str
    large: Array["uint8", 40, 40]
    a: Array["float32", "n"]
    b: Array["float64", "n", 3]
    numbers: list[int]
    maybe: Array["float32", "n"] | None
    tags: list[str] = dataclasses.field(default_factory=lambda: ["tag"])


def test_a_draft_gives_the_same_body():
    codec, rng = codec_of(Events), np.random.default_rng(0)
    x, y = rng.integers(0, 640, (2, 500)).astype(np.uint16)
    t, polarity = np.sort(rng.integers(0, 1000, 500)), rng.integers(0, 2, 500).astype(np.uint8)
    memory = np.full(codec.drafter.size({"n": 500}), 0xAA, np.uint8)
    draft = codec.drafter.draft(memory, {"n": 500})
    draft.x[:], draft.y[:], draft.t[:] = x, y, t
    draft.polarity = polarity
    draft.stamp_ns, draft.width, draft.height, draft.frame_id = 7, 640, 480, "camera"
    body = memory[: codec.drafter.finish(draft)].tobytes()
    expected = Events(7, x, y, t, polarity, 640, 480, frame_id="camera")
    assert codec.decode(body) == expected
    assert body == codec.encode(expected, 2**20)  # between the arrays, too, where the memory held something
    assert (draft.stamp_ns, draft.sequence) == (7, 0)


def test_a_draft_of_an_image_of_open_dtype():
    codec = codec_of(Image)
    dims, dtypes = {"height": 48, "width": 64, "channels": 3}, {"data": "uint8"}
    memory = np.zeros(codec.drafter.size(dims, dtypes), np.uint8)
    draft = codec.drafter.draft(memory, dims, dtypes)
    assert np.shares_memory(draft.data, memory)
    draft.data[:] = 200
    draft.stamp_ns, draft.encoding = 5, "rgb8"
    size = codec.drafter.finish(draft)
    assert codec.decode(memory[:size].tobytes()) == Image(5, np.full((48, 64, 3), 200, np.uint8), "rgb8")
    assert not draft.data.flags.writeable


def test_drafts_refuse_what_does_not_fit():
    codec = codec_of(Events)
    memory = np.zeros(codec.drafter.size({"n": 3}), np.uint8)
    for ask, said in (
        (lambda: codec.drafter.size({"m": 3}), "no dimension m, its arrays have"),
        (lambda: codec.drafter.size({"n": -1}), "dimension n is -1"),
        (lambda: codec.drafter.size({"n": 1}, {"x": "uint8"}), "no array x of open dtype"),
        (lambda: codec_of(Image).drafter.size({}, {"data": "object"}), "dtype object is none of"),
        (lambda: codec.drafter.draft(memory, {"n": 3000}), r"draft of \d+ bytes, the buffer has"),
    ):
        with pytest.raises(ValueError, match=said):
            ask()
    draft = codec.drafter.draft(memory, {"n": 3})
    with pytest.raises(ValueError, match=r"stamp_ns was not set"):
        codec.drafter.finish(draft)
    with pytest.raises(AttributeError, match="field stamp_ns is not set yet"):
        _ = draft.stamp_ns
    for name, value, error, said in (
        ("stamp", 5, AttributeError, "field stamp is none of"),
        ("x", np.zeros(2, np.uint16), ValueError, r"x: shape \[2\], expected \[3\]"),
        ("x", np.zeros(3), TypeError, "cast"),
    ):
        with pytest.raises(error, match=said):
            setattr(draft, name, value)
    draft.stamp_ns, draft.width, draft.height = 1, 2, "wide"
    with pytest.raises(TypeError, match=r"Events\.height: 'wide' is no number"):
        codec.drafter.finish(draft)
    draft.height, draft.frame_id = 3, "f" * 5000
    with pytest.raises(ValueError, match="bytes more than the 4096 in reserve"):
        codec.drafter.finish(draft)
    draft.frame_id = "f" * 4000
    assert codec.decode(memory[: codec.drafter.finish(draft)].tobytes()).frame_id == "f" * 4000


@pytest.mark.parametrize("dims", [{}, {"n": 5}])
def test_arrays_of_unknown_size_go_into_the_reserve_of_a_draft(dims):
    large, ones = np.arange(1600, dtype=np.uint8).reshape(40, 40), np.ones(5, np.float32)
    mixed = Mixed(1, -2, "text", large, ones, np.arange(15.0).reshape(5, 3), [1, 2], ones)
    drafter = codec_of(Mixed).drafter
    memory = np.full(drafter.size(), 0xAA, np.uint8)
    draft = drafter.draft(memory, dims)
    for field in dataclasses.fields(Mixed):
        setattr(draft, field.name, getattr(mixed, field.name))
    body = memory[: drafter.finish(draft)].tobytes()
    assert codec_of(Mixed).decode(body) == mixed
    assert body[9:12] == bytes(3)  # behind the small number
