"""Pictures that are written where their readers find them."""

import threading
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import numpy as np
import pytest
from live_rig import count_free, loans_of

from cortex import Node, keep_last, reliable
from cortex.messages import Image
from neurosim_core.live.loans import PictureLoan

SHAPES = [(60, 480, 3), (120, 160)]
DTYPES = {3: np.uint8, 2: np.float32}


@pytest.fixture
def pair(request):
    """A publisher of images, and a subscriber that gets all of them, or as the policy of a test says."""
    policy = getattr(request, "param", reliable())
    with Node("camera") as node, Node("viewer") as viewer:
        publisher = node.publisher("/picture", Image)
        subscriber = viewer.subscriber("/picture", Image, policy=policy)
        assert publisher.wait_for_subscribers(1, timeout_s=60.0)
        yield publisher, subscriber


def picture_of(shape, seed=0):
    values = np.random.default_rng(seed).integers(0, 255, size=shape)
    return values.astype(DTYPES[len(shape)])


def message_of(data, sequence=0):
    pixels = data if data.ndim == 3 else data[:, :, None]
    return Image(stamp_ns=7, data=pixels, encoding="rgb8", frame_id="camera", sequence=sequence)


@pytest.mark.parametrize("shape", SHAPES)
def test_same_bytes_as_published(pair, shape):
    """A picture that was lent room for is the same message, byte by byte, as one that is copied."""
    publisher, subscriber = pair
    picture, loan = picture_of(shape), PictureLoan(publisher)
    publisher.publish(message_of(picture))
    room = loan.lend(picture)
    room[:] = picture
    assert room.shape == picture.shape
    assert room.dtype == picture.dtype
    assert loan.holds(room)
    assert loan.publish(message_of(room))
    assert not loan.holds(room)
    (info, body, _), (lent_info, lent_body, _) = (subscriber.recv_raw(60.0) for _ in range(2))
    assert bytes(body) == bytes(lent_body)
    assert (lent_info.sequence, lent_info.stamp_ns) == (info.sequence + 1, info.stamp_ns)


def test_nothing_is_copied(pair):
    """The reader sees the memory that was lent, and what is written there later, which nobody does."""
    publisher, subscriber = pair
    picture, loan = picture_of(SHAPES[0]), PictureLoan(publisher)
    room = loan.lend(picture)
    room[:] = 0
    loan.publish(message_of(room))
    received = subscriber.recv(60.0)
    room[3, 4, 2] = 9
    assert received.data[3, 4, 2] == 9
    assert received.data.sum() == 9


def test_one_at_a_time(pair):
    """A second picture gets no room before the first is published; what was thrown away blocks nothing."""
    publisher, subscriber = pair
    picture, loan = picture_of(SHAPES[0]), PictureLoan(publisher)
    room = loan.lend(picture)
    assert loan.lend(picture) is None
    del room
    for sequence in range(50):  # more than there are slots
        assert loan.lend(picture) is not None, sequence
    room = loan.lend(picture)
    room[:] = picture
    assert loan.publish(message_of(room, sequence=3))
    received = subscriber.recv(60.0)
    assert received.sequence == 3
    assert subscriber.counters.lost == 0
    assert (received.data == picture).all()


def test_what_is_thrown_away_is_given_back(pair):
    """Unless somebody can still write there."""
    publisher, _ = pair
    shape, loan = SHAPES[0], PictureLoan(publisher)
    loan.drop()
    free = count_free(publisher, shape)
    room = loan.lend(picture_of(shape))
    loan.drop()
    assert loan.holds(room)
    del room
    assert count_free(publisher, shape) == free - 1
    loan.drop()
    assert count_free(publisher, shape) == free


@pytest.mark.parametrize("pair", [keep_last(8)], indirect=True, ids=str)
def test_room_that_was_given_up_is_a_lost_picture(pair):
    """No error, which would end the thread that flies: this one is lost and counted, the next ones arrive."""
    publisher, subscriber = pair
    rows, *rest = SHAPES[0]
    picture, loan = picture_of(SHAPES[0]), PictureLoan(publisher)
    room = loan.lend(picture)
    for size in (2, 5, 11, 23, 47):  # for each, all memory is new
        publisher.publish(message_of(picture_of((size * rows, *rest))))
        subscriber.recv(60.0)
    others = loans_of(publisher, (47 * rows, *rest))
    assert loan.publish(message_of(room, sequence=1)) is False
    assert not loan.holds(room)
    for other in others:
        other.drop()
    room = loan.lend(picture)
    assert loan.publish(message_of(room, sequence=2))
    assert subscriber.recv(60.0).sequence == 2
    assert subscriber.counters.lost == 1


def test_no_room_while_a_picture_waits_for_its_reader():
    """Who renders does not wait with it: the next picture is copied."""
    begun, read = threading.Event(), threading.Event()

    def publish(message):
        begun.set()
        return read.wait(600.0)

    draft = SimpleNamespace(data=np.zeros(SHAPES[0], np.uint8))
    publisher = SimpleNamespace(try_loan=lambda *_, **__: SimpleNamespace(draft=draft, publish=publish))
    loan = PictureLoan(publisher)
    room = loan.lend(draft.data)
    with ThreadPoolExecutor() as pool:
        published = pool.submit(loan.publish, message_of(room))
        try:
            assert begun.wait(60.0)
            assert pool.submit(loan.lend, draft.data).result(60.0) is None
            assert not published.done()
        finally:
            read.set()
        assert published.result(60.0)


def test_small_pictures_are_copied(pair):
    publisher, _ = pair
    assert PictureLoan(publisher).lend(np.zeros((8, 8, 3), np.uint8)) is None


def test_filled_by_one_thread_and_published_by_another(pair):
    """Each picture arrives as it was written, in order, while the next one is being written."""
    publisher, subscriber = pair
    loan, count = PictureLoan(publisher), 200
    filled, lent = [], threading.Event()

    def fill():
        for number in range(count):
            picture = np.full(SHAPES[0], number, np.uint8)
            room = loan.lend(picture)
            data = np.array(picture) if room is None else room
            data[:] = picture
            del room
            filled.append((number, data))
            lent.set()

    thread = threading.Thread(target=fill)
    thread.start()
    received = []
    for _ in range(count):
        while not filled:
            lent.wait(0.01)
            lent.clear()
        number, data = filled.pop(0)
        message = message_of(data, sequence=number)
        assert loan.publish(message) if loan.holds(data) else publisher.publish(message)
        del data, message
        received.append(subscriber.recv(60.0))
        assert (received[-1].data == number).all()
        received[-1] = received[-1].sequence
    thread.join()
    assert received == list(range(count))


def test_room_is_kept_until_the_device_has_written_there(pair):
    """Where that fails, the picture is lost, and its room is not forgotten: the next one is lent it."""
    publisher, subscriber = pair
    picture, loan = picture_of(SHAPES[0]), PictureLoan(publisher)
    free = count_free(publisher, SHAPES[0])

    def fail():
        raise RuntimeError("CUDA error 700")

    loan.settle = fail
    room = loan.lend(picture)
    with pytest.raises(RuntimeError, match="700"):
        loan.publish(message_of(room))
    assert loan.holds(room)
    loan.settle = None
    room[:] = picture
    assert loan.publish(message_of(room))
    assert (subscriber.recv(60.0).data == picture).all()
    loan.settle = fail
    del room
    loan.lend(picture)
    loan.drop()
    assert count_free(publisher, SHAPES[0]) == free
