"""How loans end otherwise than well: forgotten, dropped in odd places, lost, or after their publisher."""

from __future__ import annotations

import gc
import os
import signal
import threading
import warnings

import numpy as np
import pytest
from peer import Scan
from processes import SOON_S
from test_large import connected, scan

from cortex import Loan, Publisher, keep_last, reliable

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
    draft.stamp_ns = number
    draft.ranges[:] = number


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
    done = threading.Event()

    def collect() -> None:
        with publisher._large_lock, publisher._lock, warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            gc.collect()
        heard.extend(str(each.message) for each in said if each.category is ResourceWarning)
        done.set()

    heard: list[str] = []
    del first, second, cycle
    threading.Thread(target=collect, daemon=True).start()
    assert done.wait(SOON_S)
    assert heard == [FORGOTTEN]  # of the first: the block of the other was left by an exception
    loans = borrow_all(publisher)
    assert len(loans) == count
    drop_all(loans)


def test_a_forgotten_loan_does_not_hold_up_the_end(node):
    publisher, _ = connected(node, Scan, keep_last())
    with pytest.warns(ResourceWarning, match=FORGOTTEN):
        forget(publisher)
    end_in_time(publisher)


def end_in_time(publisher: Publisher[Scan]) -> None:
    """Close a publisher that has all the time in the world for what is on its way."""
    thread = threading.Thread(target=publisher.close, kwargs={"linger_s": 100.0 * SOON_S}, daemon=True)
    thread.start()
    thread.join(SOON_S)
    assert not thread.is_alive()


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
