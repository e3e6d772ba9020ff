"""How loans end otherwise than well: forgotten, dropped in odd places, lost, or after their publisher."""

from __future__ import annotations

import dataclasses
import gc
import os
import signal
import warnings

import numpy as np
import pytest
from c_module import needs_native
from peer import Scan, make_block
from processes import SOON_S, Beside, wait_for
from test_large import connected, scan, slots_held

from cortex import Loan, Publisher, keep_last, reliable
from cortex.messages import Image

pytestmark = needs_native
LARGE = 50_000
FORGOTTEN = "/large: a loan was forgotten, neither published nor dropped"


def borrow_all(publisher: Publisher[Scan], size: int = LARGE) -> list[Loan]:
    """Take every slot there is on loan."""
    loans: list[Loan] = []
    while (loan := publisher.try_loan(n=size)) is not None:
        loans.append(loan)
        assert len(loans) < 200, "slots without end"
    assert loans
    return loans


def drop_all(loans: list[Loan]) -> None:
    while loans:
        loans.pop().drop()


def fill(draft, number: int) -> None:
    draft.stamp_ns, draft.ranges[:] = number, number


def forget(publisher: Publisher[Scan]) -> None:
    """Begin a loan, and let it go."""
    loan = publisher.try_loan(n=LARGE)
    assert loan is not None, "every slot is out on loan"
    fill(loan.draft, -1)


def test_a_forgotten_loan_gives_its_slot_back(node):
    """More of them than there are slots. Nobody sees a trace of it but the warning."""
    publisher, subscriber = connected(node, Scan, keep_last(64))
    for _ in range(200):
        with pytest.warns(ResourceWarning, match=FORGOTTEN):
            forget(publisher)
    with publisher.loan(n=LARGE) as draft:
        fill(draft, 1)
    publisher.publish(scan(2))
    for number in (1, 2):
        message, info = subscriber.recv_with_info(SOON_S)
        assert (message.stamp_ns, info.sequence) == (number, number - 1)
        assert (message.ranges == number).all()
    assert (publisher.counters.skipped, subscriber.counters.lost) == (0, 0)


def test_who_still_can_write_keeps_the_slot(node):
    """Only the arrays of the draft are left, and only a part of one: nobody else gets that memory."""
    publisher, _ = connected(node, Scan, keep_last(64))
    whole = publisher.try_loan(n=LARGE).draft.ranges
    part = whole[10:20]
    del whole
    gc.collect()
    loans = borrow_all(publisher)
    assert not any(np.shares_memory(part, loan.draft.ranges) for loan in loans)
    with pytest.warns(ResourceWarning, match=FORGOTTEN):
        del part
    (last,) = borrow_all(publisher)
    drop_all([*loans, last])


def test_the_garbage_collector_comes_at_the_worst_moment(node):
    """While the thread that it runs in holds the locks that publishing takes."""
    publisher, _ = connected(node, Scan, keep_last(64))
    count = len(loans := borrow_all(publisher))
    drop_all(loans)
    first, second = publisher.try_loan(n=LARGE), publisher.loan(n=LARGE)
    fill(second.__enter__(), 1)
    cycle: list[object] = [first, second]
    cycle.append(cycle)

    def collect() -> list[str]:
        with publisher._large_lock, publisher._lock, warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            gc.collect()
        return [str(each.message) for each in said if each.category is ResourceWarning]

    del first, second, cycle
    assert Beside(collect).join() == [[FORGOTTEN]]  # the block of the second was left by an exception
    loans = borrow_all(publisher)
    assert len(loans) == count
    drop_all(loans)


def test_a_forgotten_loan_does_not_hold_up_the_end(node):
    publisher, _ = connected(node, Scan, keep_last())
    with pytest.warns(ResourceWarning, match=FORGOTTEN):
        forget(publisher)
    Beside(publisher.close, linger_s=100.0 * SOON_S).join()  # it waits for nothing


@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")  # the threads of the node
def test_a_loan_is_forgotten_in_a_forked_child(node):
    """It is the parent's: nothing is given back, and nothing is said."""
    publisher, subscriber = connected(node, Scan, keep_last())
    loan = publisher.try_loan(n=LARGE)
    fill(loan.draft, 7)
    child = os.fork()
    if child == 0:
        signal.alarm(int(SOON_S))
        try:
            with warnings.catch_warnings(record=True) as said:
                warnings.simplefilter("always")
                loan = None
                gc.collect()
            os._exit(len(said))
        except BaseException:
            os._exit(100)
    assert os.waitpid(child, 0)[1] == 0
    assert loan.publish()
    message = subscriber.recv(SOON_S)
    assert (message.ranges == 7).all()


@pytest.mark.parametrize("free", [False, True])
@pytest.mark.parametrize("policy", [keep_last(64), reliable(8, SOON_S)], ids=str)
def test_a_loan_whose_ring_was_replaced_is_sent_all_the_same(node, policy, free):
    """Its ring was given up for larger slots, also where every one of those is out on loan."""
    publisher, subscriber = connected(node, Scan, policy)
    loan = publisher.try_loan(n=5_000)
    fill(loan.draft, 100)
    publisher.publish(scan(0, 500_000))
    assert subscriber.recv(SOON_S).stamp_ns == 0
    loans = [] if free else borrow_all(publisher, 500_000)
    assert loan.publish()
    drop_all(loans)
    message = subscriber.recv(SOON_S)
    assert message.stamp_ns == 100
    assert (message.ranges == 100).all()
    assert subscriber.counters.lost == publisher.counters.skipped == 0


SHAPE = (60, 480, 3)
DIMS = dict(zip(("height", "width", "channels"), SHAPE, strict=True))


@pytest.fixture(params=["as it is", "the slow path"])
def way(request, monkeypatch):
    """What the fast path said of each message; without the C module there is only the slow path."""
    send, taken = Publisher._send_loaned, []
    if request.param == "the slow path":
        monkeypatch.setattr(Publisher, "_send_loaned", lambda *_: None)
    else:
        monkeypatch.setattr(Publisher, "_send_loaned", lambda *args: taken.append(send(*args)) or taken[-1])
    return taken


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
        for data in (larger, pixels(number)):
            assert publisher.try_loan({"data": "u1"}, **DIMS).publish(image(data, number))
            assert (subscriber.recv(SOON_S).data == data).all()
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
