"""Messages written in place give the body that encoding gives."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from cortex.codec import codec_of
from cortex.message import Array, Int8, message
from cortex.messages import Events, Image


@message
class Mixed:
    stamp_ns: int
    small: Int8
    text: str
    fixed: Array["float32", 3]
    large: Array["uint8", 40, 40]
    a: Array["float32", "n"]
    b: Array["float64", "n", 3]
    numbers: list[int]
    maybe: Array["float32", "n"] | None
    flag: bool = True
    tags: list[str] = dataclasses.field(default_factory=lambda: ["tag"])


def mixed() -> Mixed:
    return Mixed(
        1,
        -2,
        "text",
        np.arange(3, dtype=np.float32),
        np.arange(1600, dtype=np.uint8).reshape(40, 40),
        np.arange(5, dtype=np.float32),
        np.arange(15.0).reshape(5, 3),
        [1, 2],
        np.ones(5, np.float32),
    )


def test_a_draft_gives_the_same_body():
    codec = codec_of(Events)
    rng = np.random.default_rng(0)
    x, y = rng.integers(0, 640, (2, 500)).astype(np.uint16)
    t, polarity = np.sort(rng.integers(0, 1000, 500)), rng.integers(0, 2, 500).astype(np.uint8)
    memory = np.full(codec.drafter.size({"n": 500}), 0xAA, np.uint8)
    draft = codec.drafter.draft(memory, {"n": 500})
    draft.x[:], draft.y[:], draft.t[:] = x, y, t
    draft.polarity = polarity
    draft.stamp_ns, draft.width, draft.height, draft.frame_id = 7, 640, 480, "camera"
    size = codec.drafter.finish(draft)
    decoded = codec.decode(memory[:size].tobytes())
    assert decoded == Events(7, x, y, t, polarity, 640, 480, frame_id="camera")
    assert memory[:size].tobytes() == codec.encode(decoded, 2**20)
    assert draft.stamp_ns == 7
    assert draft.sequence == 0
    # What lies between the arrays is zero, not what the memory held before.
    arrays = sum(array.nbytes for array in (x, y, t, polarity))
    assert np.count_nonzero(memory[:size] == 0xAA) <= np.count_nonzero(x == 0xAA) + arrays // 100


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
    with pytest.raises(ValueError, match="no dimension m, its arrays have"):
        codec.drafter.size({"m": 3})
    with pytest.raises(ValueError, match="dimension n is -1"):
        codec.drafter.size({"n": -1})
    with pytest.raises(ValueError, match="no array x of open dtype"):
        codec.drafter.size({"n": 1}, {"x": "uint8"})
    with pytest.raises(ValueError, match="dtype object is none of"):
        codec_of(Image).drafter.size({}, {"data": "object"})
    with pytest.raises(ValueError, match=r"draft of \d+ bytes, the buffer has"):
        codec.drafter.draft(memory, {"n": 3000})
    draft = codec.drafter.draft(memory, {"n": 3})
    with pytest.raises(ValueError, match=r"stamp_ns was not set"):
        codec.drafter.finish(draft)
    with pytest.raises(AttributeError, match="field stamp_ns is not set yet"):
        _ = draft.stamp_ns
    with pytest.raises(AttributeError, match="field stamp is none of"):
        draft.stamp = 5
    with pytest.raises(ValueError, match=r"x: shape \[2\], expected \[3\]"):
        draft.x = np.zeros(2, np.uint16)
    with pytest.raises(TypeError, match="cast"):
        draft.x = np.zeros(3)
    draft.stamp_ns, draft.width, draft.height = 1, 2, "wide"
    with pytest.raises(TypeError, match=r"Events\.height: 'wide' is no number"):
        codec.drafter.finish(draft)
    draft.height, draft.frame_id = 3, "f" * 5000
    with pytest.raises(ValueError, match="bytes more than the 4096 in reserve"):
        codec.drafter.finish(draft)
    draft.frame_id = "f" * 4000
    assert codec.decode(memory[: codec.drafter.finish(draft)].tobytes()).frame_id == "f" * 4000


def test_arrays_of_unknown_size_go_into_the_reserve_of_a_draft():
    codec = codec_of(Mixed)
    memory = np.zeros(codec.drafter.size(), np.uint8)
    draft = codec.drafter.draft(memory)
    for field in dataclasses.fields(Mixed):
        setattr(draft, field.name, getattr(mixed(), field.name))
    assert codec.decode(memory[: codec.drafter.finish(draft)].tobytes()) == mixed()
    draft = codec.drafter.draft(memory, {"n": 5})
    for field in dataclasses.fields(Mixed):
        setattr(draft, field.name, getattr(mixed(), field.name))
    assert codec.decode(memory[: codec.drafter.finish(draft)].tobytes()) == mixed()
