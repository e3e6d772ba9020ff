"""A message whose large arrays lie in a slot that was lent: sent as it is, or written anew, never wrong."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from peer import make_block
from processes import SOON_S, wait_for
from test_large import connected, slots_held

from cortex import Publisher, keep_last, reliable
from cortex.compiled import native
from cortex.messages import Image

SHAPE = (60, 480, 3)
DIMS = dict(zip(("height", "width", "channels"), SHAPE, strict=True))


@pytest.fixture(params=["as it is", "the long way"])
def way(request, monkeypatch):
    """Without the C module there is only the long way."""
    if request.param == "the long way":
        monkeypatch.setattr(Publisher, "_send_loaned", lambda *_: None)
    elif native is None:
        pytest.skip("without the C module there is no short cut")
    else:
        send, taken = Publisher._send_loaned, []
        monkeypatch.setattr(Publisher, "_send_loaned", lambda *args: taken.append(send(*args)) or taken[-1])
        yield taken
        return
    yield []


def image(data: np.ndarray, number: int = 0, frame_id: str = "camera") -> Image:
    return Image(stamp_ns=7 + number, data=data, encoding="rgb8", frame_id=frame_id, sequence=number)


def pixels(number: int) -> np.ndarray:
    return np.random.default_rng(number).integers(0, 256, SHAPE).astype(np.uint8)


def test_the_same_bytes_as_a_message_that_is_copied(node, way):
    """Whatever else is in it; and who has it sees the memory that was lent."""
    publisher, subscriber = connected(node, Image, reliable(64, SOON_S))
    for number, frame_id in enumerate(["camera", "", "ä" * 700, "camera"]):
        expected = image(pixels(number), number, frame_id)
        publisher.publish(expected)
        info, body, _ = subscriber.recv_raw(SOON_S)
        loan = publisher.try_loan({"data": "u1"}, **DIMS)
        room = loan.draft.data
        room[:] = expected.data
        assert loan.publish(dataclasses.replace(expected, data=room))
        lent_info, lent_body, _ = subscriber.recv_raw(SOON_S)
        assert bytes(lent_body) == bytes(body)
        assert (lent_info.sequence, lent_info.stamp_ns) == (info.sequence + 1, info.stamp_ns)
        with pytest.raises(ValueError, match="read-only"):
            room[:] = 0
        with pytest.raises(RuntimeError, match="before"):
            loan.publish(expected)
        del room, body, lent_body, loan
    assert not way or True in way  # not each: now and then the fast path looks who has come
    wait_for(lambda: slots_held(publisher) == 0)


def test_arrays_that_lie_elsewhere_are_copied(node, way):
    """Of other memory, at another place in the slot, in another order: readers get what the message says."""
    publisher, subscriber = connected(node, Image, reliable(64, SOON_S))
    picture = pixels(1)
    flipped = np.ascontiguousarray(picture[::-1])

    def of_the_slot(room: np.ndarray) -> np.ndarray:
        """The same bytes, 64 further on than they belong."""
        memory = room.base if isinstance(room.base, np.ndarray) else room
        while isinstance(memory.base, np.ndarray):
            memory = memory.base
        begin = room.ctypes.data - memory.ctypes.data + 64
        moved = memory.view(np.ndarray)[begin : begin + room.size].reshape(SHAPE)
        moved[:] = picture
        return moved

    for data_of, expected in [
        (lambda room: picture, picture),
        (lambda room: room[::-1], flipped),
        (of_the_slot, picture),
        (lambda room: room, picture),
    ]:
        loan = publisher.try_loan({"data": "u1"}, **DIMS)
        loan.draft.data[:] = picture
        loan.publish(image(data_of(loan.draft.data), 3))
        received = subscriber.recv(SOON_S)
        assert (received.data == expected).all()
        assert (received.stamp_ns, received.sequence, received.frame_id) == (10, 3, "camera")
        del received, loan
    wait_for(lambda: slots_held(publisher) == 0)


def test_what_lies_elsewhere_goes_the_long_way(node, way):
    """There it is copied without the lock, whatever its size."""
    publisher, subscriber = connected(node, Image, reliable(64, SOON_S))
    larger = np.full((SHAPE[0] + 1, *SHAPE[1:]), 7, np.uint8)
    for number in range(10):
        loan = publisher.try_loan({"data": "u1"}, **DIMS)
        assert loan.publish(image(larger, number))
        assert (subscriber.recv(SOON_S).data == larger).all()
        loan = publisher.try_loan({"data": "u1"}, **DIMS)
        loan.publish(image(pixels(number), number))
        assert (subscriber.recv(SOON_S).data == pixels(number)).all()
    assert True not in way


def test_what_does_not_fit_leaves_no_slot_behind(node, way):
    publisher, subscriber = connected(node, Image, reliable(64, SOON_S))
    wrong = [
        (make_block(0, 100), TypeError),
        (image(np.zeros(6, np.uint8)), ValueError),
        (dataclasses.replace(image(pixels(0)), stamp_ns="soon"), (TypeError, ValueError)),
    ]
    for number in range(30):
        for bad, error in wrong:
            loan = publisher.try_loan({"data": "u1"}, **DIMS)
            assert loan is not None, number
            with pytest.raises(error):
                loan.publish(bad)
    publisher.publish(image(pixels(5)))
    assert (subscriber.recv(SOON_S).data == pixels(5)).all()


def test_a_reader_without_room(node, way):
    """Who keeps two gets the newest, and whoever is slow is counted: nothing is overwritten that is held."""
    publisher, subscriber = connected(node, Image, keep_last(2))
    held = []
    for number in range(40):
        loan = publisher.try_loan({"data": "u1"}, **DIMS)
        if loan is None:
            publisher.publish(image(pixels(number), number))
            continue
        loan.draft.data[:] = pixels(number)
        loan.publish(image(loan.draft.data, number))
        del loan
        if number % 13 == 5:
            held.append(subscriber.recv(SOON_S))
    for received in held:
        assert (received.data == pixels(received.sequence)).all()
