"""Services: replies, failures, deadlines, and servers that stop or die during a call."""

from __future__ import annotations

import asyncio
import threading
import time

import pytest
import zmq
from peer import Number, OtherNumber, Scan
from processes import SOON_S, Beside, in_time, wait_for

from cortex import Closed, ServiceFailed, ServiceTimeout, ServiceUnavailable
from cortex.codec import codec_of
from cortex.context import new_socket
from cortex.message_types import message
from cortex.places import Reach
from cortex.records import Endpoint
from cortex.schema import TypeMismatch
from cortex.service import PENDING_MAX, Client
from cortex.wire import CONTROL_LIMIT, REPLY, pack_header, unpack_header


@message
class Bulk:
    data: bytes


def double(request):
    return Number(request.stamp_ns, 2 * request.value)


def reach(address, *, local=False):
    """Where the service of a node is whose control socket has an address."""
    return Reach(1, Endpoint("tcp", "", "", address, ""), local, None)


class Holding:
    """A handler that answers with the request, but not before it is told to."""

    def __init__(self):
        self.entered, self.release = threading.Event(), threading.Event()
        self.seen = []

    def __call__(self, request):
        self.seen.append(request.value)
        self.entered.set()
        self.release.wait(SOON_S)
        return request


def outcome_of(client, value):
    """The answer to a call, or the error."""
    try:
        return client.call(Number(0, value), timeout_s=SOON_S).value
    except (Closed, ServiceUnavailable) as error:
        return error


def test_a_task_calls_without_blocking_the_loop(node):
    """Other tasks go on while the handler works."""
    go_on = threading.Event()

    def slow(request):
        assert go_on.wait(SOON_S)
        return double(request)

    node.service("/double", Number, Number, slow)

    async def run(client):
        call = asyncio.create_task(client.call_async(Number(0, 21), SOON_S))
        await asyncio.sleep(0)
        go_on.set()  # only a loop that is not blocked gets here
        return await call

    with node.client("/double", Number, Number) as client:
        assert asyncio.run(run(client)).value == 42


def test_a_handler_that_raises(node, caplog):
    """The text comes back; the next call works; a failure is in the server's log."""

    def fail(request):
        raise KeyError(f"no {request.value}")

    node.service("/fail", Number, Number, fail)
    with node.client("/fail", Number, Number) as client:
        for value in range(3):
            with pytest.raises(ServiceFailed, match=f"/fail: KeyError: 'no {value}'"):
                client.call(Number(0, value), SOON_S)
    assert sum(record.exc_info is not None for record in caplog.records) == 3


def test_it_is_not_there_or_withdrawn(node):
    with node.client("/double", Number, Number) as client:
        assert not client.available()

        def call():
            begin = time.monotonic()
            with pytest.raises(ServiceUnavailable, match=r"nobody offers /double \(waited 0\.1 s\)"):
                client.call(Number(0, 0), timeout_s=0.1)
            assert time.monotonic() - begin >= 0.1

        in_time(call, 1.0)
        withdraw = node.service("/double", Number, Number, double)
        assert client.available()
        assert client.call(Number(0, 4), SOON_S).value == 8
        withdraw()
        withdraw()
        with pytest.raises(ServiceUnavailable):
            client.call(Number(0, 4), timeout_s=0.05)
        node.service("/double", Number, Number, lambda request: Number(0, 3 * request.value))
        assert client.call(Number(0, 4), SOON_S).value == 12


def test_other_types(node):
    node.service("/double", Number, Number, double)
    refused = pytest.raises(TypeMismatch, match=r"(?s)/double.*float64.*actual.*int64")
    with node.client("/double", OtherNumber, Number) as client, refused:
        client.call(OtherNumber(0, 1.0))
    with node.client("/double", Number, Scan) as client, pytest.raises(TypeMismatch):
        client.call(Number(0, 1), SOON_S)


def test_wrong_use(node):
    node.service("/double", Number, Number, double)
    with pytest.raises(ValueError, match="offers /double already"):
        node.service("/double", OtherNumber, Number, double)
    with pytest.raises(ValueError, match="is named like"):
        node.service("double", Number, Number, double)
    client = node.client("/double", Number, Number)
    with client, pytest.raises(TypeError, match="takes Number, got Scan"):
        client.call(Scan(0, None))


@pytest.mark.parametrize("excess", [-64, 0, 1, 1000])
def test_a_request_has_a_limit(node, excess):
    """At the limit it arrives; above it is refused at once, not lost."""
    node.service("/bulk", Bulk, Number, lambda request: Number(0, len(request.data)))
    size = CONTROL_LIMIT - 8 + excess  # the block of the body
    with node.client("/bulk", Bulk, Number) as client:
        if excess > 0:
            with pytest.raises(ValueError, match="exceeds the limit"):
                client.call(Bulk(bytes(size)), timeout_s=SOON_S)
        else:
            assert client.call(Bulk(bytes(size)), timeout_s=SOON_S).value == size
        assert client.call(Bulk(b"123"), SOON_S).value == 3


def test_a_handler_that_takes_too_long(node):
    """An error in time; the reply that comes later is not taken for that of the next call."""
    release = threading.Event()

    def handle(request):
        if request.stamp_ns:
            release.wait(SOON_S)
        return double(request)

    node.service("/slow", Number, Number, handle)
    with node.client("/slow", Number, Number) as client:
        with pytest.raises(ServiceTimeout, match=r"/slow: no reply within 0\.05 s"):
            client.call(Number(1, 1), timeout_s=0.05)
        release.set()
        assert client.call(Number(0, 5), timeout_s=SOON_S).value == 10


def test_a_request_whose_time_is_over_is_not_acted_upon(node):
    """It waited behind another one until its caller had given up."""
    handler = Holding()
    node.service("/slow", Number, Number, handler)
    with node.client("/slow", Number, Number) as one, node.client("/slow", Number, Number) as other:
        with Beside(outcome_of, one, 1) as first:
            assert handler.entered.wait(SOON_S)
            with pytest.raises(ServiceTimeout):
                other.call(Number(0, 2), timeout_s=0.05)
            handler.release.set()
        assert other.call(Number(0, 3), timeout_s=SOON_S).value == 3
    assert (first.results, handler.seen) == ([1], [1, 3])


@pytest.mark.parametrize("local", [True, False])
def test_the_deadline_goes_along_within_a_host(runtime, local):
    """The clocks of two hosts have nothing in common."""
    with new_socket(zmq.ROUTER) as socket:
        socket.bind("tcp://127.0.0.1:*")
        address = socket.getsockopt_string(zmq.LAST_ENDPOINT)
        client = Client("/double", Number, Number, lambda: reach(address, local=local))

        def ask():
            """When a call began and had ended, and what came: nothing, if it was stopped before it sent."""
            begin_ns = time.monotonic_ns()
            with pytest.raises(ServiceTimeout):
                client.call(Number(0, 0), timeout_s=0.3)
            end_ns = time.monotonic_ns()
            return socket.poll(200) and (begin_ns, end_ns, socket.recv_multipart()[1])

        with client:
            begin_ns, end_ns, frame = wait_for(ask)
        header = unpack_header(frame)
    if local:
        assert begin_ns + 300_000_000 <= header.stamp_ns <= end_ns
    else:
        assert header.stamp_ns is None


@pytest.mark.parametrize("who", ["client", "server"])
def test_closing_during_a_call(make_node, who):
    """The client by itself or with its node, or the server: an error at once."""
    server, caller, handler = make_node("server"), make_node("caller"), Holding()
    server.service("/hold", Number, Number, handler)
    client, other = caller.client("/hold", Number, Number), caller.client("/hold", Number, Number)
    other.close()
    with pytest.raises(Closed, match="/hold"):
        other.call(Number(0, 0), SOON_S)
    calling = Beside(outcome_of, client, 0)
    assert handler.entered.wait(SOON_S)
    with Beside(caller.close if who == "client" else server.close):
        (outcome,) = calling.join(SOON_S / 2)
        assert type(outcome) is (Closed if who == "client" else ServiceUnavailable)
        handler.release.set()
    if who == "client":
        with pytest.raises(Closed, match="/hold"):
            client.call(Number(0, 0), SOON_S)
    client.close()


def test_an_answer_to_another_call_is_not_taken(runtime):
    """Replies with another number or for another caller are passed over."""
    with new_socket(zmq.ROUTER) as socket:
        socket.bind("tcp://127.0.0.1:*")
        address = socket.getsockopt_string(zmq.LAST_ENDPOINT)

        def answer():
            assert socket.poll(1e3 * SOON_S)
            identity, frame = socket.recv_multipart()
            header = unpack_header(frame)._replace(kind=REPLY)
            others = ({"sequence": header.sequence - 1}, {"source": header.source ^ 1}, {"sequence": 2**40})
            for number, change in enumerate((*others, {})):
                body = codec_of(Number).encode(Number(0, number), 1000)
                reply = header._replace(body_size=len(body), **change)
                socket.send_multipart([identity, pack_header(reply) + body])

        with Client("/double", Number, Number, lambda: reach(address)) as client:
            for _ in range(2):
                with Beside(answer):
                    assert client.call(Number(0, 0), timeout_s=SOON_S).value == 3


def test_too_many_requests(node):
    """Those over the number that may wait are refused at once, the others are served."""
    handler = Holding()
    node.service("/busy", Number, Number, handler)
    clients = [node.client("/busy", Number, Number) for _ in range(PENDING_MAX + 6)]
    calls = [Beside(outcome_of, clients[0], 0)]
    assert handler.entered.wait(SOON_S)
    calls += [Beside(outcome_of, client, 1) for client in clients[1:]]
    refused = wait_for(lambda: (ended := [call for call in calls if call.results])[4:] and ended)
    assert [str(call.results[0]) for call in refused] == [f"/busy: {PENDING_MAX} requests wait already"] * 5
    handler.release.set()
    outcomes = [call.join()[0] for call in calls]
    for client in clients:
        client.close()
    assert sum(isinstance(outcome, int) for outcome in outcomes) == PENDING_MAX + 1


def test_a_handler_that_calls_back(make_node):
    """A server asks its caller something before it answers: both threads are free for it."""
    one, two = make_node("one"), make_node("two")
    one.service("/base", Number, Number, lambda request: Number(0, 100))
    with two.client("/base", Number, Number) as back, one.client("/add", Number, Number) as client:

        def add(request):
            return Number(0, request.value + back.call(request, timeout_s=SOON_S).value)

        two.service("/add", Number, Number, add)
        assert client.call(Number(0, 7), timeout_s=SOON_S).value == 107


def test_a_handler_that_calls_its_own_node(node, caplog):
    """The one thread for handlers is taken by itself: it is told so at once, and the node lives."""
    node.service("/inner", Number, Number, double)
    with node.client("/inner", Number, Number) as inner, node.client("/outer", Number, Number) as client:
        node.service("/outer", Number, Number, lambda request: inner.call(request, timeout_s=0.1))
        with pytest.raises(ServiceFailed, match="its own node"):
            client.call(Number(0, 1), timeout_s=SOON_S)
        assert inner.call(Number(0, 1), timeout_s=SOON_S).value == 2


def test_a_server_that_is_killed_during_a_call(make_node, start_child):
    """The caller hears of it when the server's lease is over, long before its own deadline."""
    child = start_child("peer")
    child.ask(do="serve", name="/double")

    def kill():
        wait_for(lambda: child.ask(do="served")["count"] == 2)  # the call is under way
        child.process.kill()

    with make_node().client("/double", Number, Number) as client:
        assert client.call(Number(0, 1), timeout_s=SOON_S).value == 2
        with Beside(kill), pytest.raises(ServiceUnavailable, match="the server of /double has gone"):
            client.call(Number(100_000, 1), timeout_s=SOON_S)
        other = start_child("peer")
        other.ask(do="serve", name="/double")
        assert client.call(Number(0, 3), timeout_s=SOON_S) == Number(other.pid, 6)
