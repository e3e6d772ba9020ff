"""Services: one request, one reply, by a deadline; a server that is dead is an error in time, not a hang."""

from __future__ import annotations

import asyncio
import logging
import secrets
import threading
import time
from collections.abc import Callable
from typing import Any, Generic, NamedTuple, TypeVar

import zmq

from cortex import wire
from cortex.codec import MalformedMessage, codec_of
from cortex.context import Closed, Closing
from cortex.places import Reach
from cortex.records import ServiceError, ServiceRecord
from cortex.schema import fingerprint_of, schema_of

logger = logging.getLogger(__name__)

Request = TypeVar("Request")
Reply = TypeVar("Reply")

PENDING_MAX = 256
_UNAVAILABLE = {"unknown", "busy", "closed"}


class ServiceTimeout(TimeoutError):
    """No reply came in time."""


class ServiceUnavailable(ConnectionError):
    """Nobody offers the service, its server died during the call, or it has too much to do."""


class ServiceFailed(RuntimeError):
    """The server's handler raised, or did not understand the request; the text is the server's."""


def service_number(name: str, request_type: type, reply_type: type) -> int:
    """The number by which a service is called: name and both structures (WIRE.md, section 8)."""
    parts = (name, schema_of(request_type).to_json(), schema_of(reply_type).to_json())
    return fingerprint_of("\0".join(parts).encode())


class Service(NamedTuple):
    """A service that this process offers."""

    name: str
    number: int
    request_type: type
    reply_type: type
    handler: Callable[[Any], Any]

    def record(self) -> ServiceRecord:
        """What others must know to call it."""
        request, reply = schema_of(self.request_type), schema_of(self.reply_type)
        return ServiceRecord(self.name, self.number, request.to_json(), reply.to_json())


class Server:
    """Answers the requests that come to a node. Handlers run one after another on the callback thread."""

    def __init__(self, submit: Callable[[Callable[[], object]], None]) -> None:
        self._submit = submit
        self._lock = threading.Lock()
        self._services: dict[int, Service] = {}
        self._pending = 0
        self.rejected = 0

    def add(self, service: Service) -> None:
        """Offer a service.

        Raises:
            ValueError: This node offers one of that name already.
        """
        with self._lock:
            if any(other.name == service.name for other in self._services.values()):
                raise ValueError(f"this node offers {service.name} already")
            self._services[service.number] = service

    def remove(self, service: Service) -> None:
        """Offer it no more."""
        with self._lock:
            self._services.pop(service.number, None)

    def services(self) -> list[Service]:
        """What is offered now."""
        with self._lock:
            return list(self._services.values())

    def handle(self, frame: bytes, reply: Callable[[bytes], None]) -> None:
        """Take in a request; `reply` is called once, from any thread, with the frame that answers it.

        Raises:
            MalformedMessage: It is not a request.
        """
        header = wire.unpack_header(frame)
        if header.kind != wire.REQUEST:
            raise MalformedMessage(f"kind {header.kind!r} where {wire.REQUEST!r} was expected")
        wire.check_body(header, len(frame))
        deadline_ns = time.monotonic_ns() + max(header.publish_ns, 0)
        if header.stamp_ns is not None:  # of this host's clock: it also counts the time before we ran
            deadline_ns = min(deadline_ns, header.stamp_ns)
            header = header._replace(stamp_ns=None)  # it is no part of the reply
        with self._lock:
            service = self._services.get(header.aux)
            busy = self._pending >= PENDING_MAX
            if service is not None and not busy:
                self._pending += 1
        if service is None:
            reply(_error(header, "unknown", "this node does not offer the service"))
        elif busy:
            reply(_error(header, "busy", f"{PENDING_MAX} requests wait already"))
        else:
            self._submit(lambda: self._serve(service, header, frame, deadline_ns, reply))

    def _serve(
        self,
        service: Service,
        header: wire.Header,
        frame: bytes,
        deadline_ns: int,
        reply: Callable[[bytes], None],
    ) -> None:
        with self._lock:
            self._pending -= 1
        reply(_serve(service, header, frame, deadline_ns))


def _serve(service: Service, header: wire.Header, frame: bytes, deadline_ns: int) -> bytes:
    """Answer a request; nothing that a handler raises gets out."""
    if time.monotonic_ns() > deadline_ns:
        return _error(header, "late", "the request waited until its deadline")
    try:
        request = codec_of(service.request_type).decode(frame, wire.HEADER_SIZE, header.body_size)
    except MalformedMessage as error:
        return _error(header, "malformed", str(error))
    try:
        answer = service.handler(request)
        if type(answer) is not service.reply_type:
            wanted, got = service.reply_type.__name__, type(answer).__name__
            raise TypeError(f"the handler of {service.name} must return {wanted}, it returned {got}")
        return _answer(header, wire.REPLY, answer)
    except Exception as error:
        logger.exception("the handler of %s raised", service.name)
        return _error(header, "failed", f"{type(error).__name__}: {error}"[:2000])


def _answer(header: wire.Header, kind: bytes, message: Any) -> bytes:
    codec = codec_of(type(message))
    body = codec.encode(message, wire.CONTROL_LIMIT)
    header = header._replace(kind=kind, fingerprint=codec.fingerprint, body_size=len(body))
    return wire.pack_header(header) + body


def _error(header: wire.Header, kind: str, text: str) -> bytes:
    return _answer(header, wire.ERROR, ServiceError(kind, text))


class Client(Closing, Generic[Request, Reply]):
    """Calls a service; made by `Node.client`. Calls from several threads follow one another."""

    def __init__(
        self,
        name: str,
        request_type: type[Request],
        reply_type: type[Reply],
        find: Callable[[], Reach | None],
    ) -> None:
        self.name = name
        self._request_type, self._reply_type = request_type, reply_type
        self._number = service_number(name, request_type, reply_type)
        self._find = find
        self._lock = threading.Lock()
        self._socket: zmq.Socket[bytes] | None = None
        self._place: Reach | None = None
        self._source = secrets.randbits(64) or 1
        self._calls = 0
        self._closed = False

    def call(self, request: Request, timeout_s: float = 1.0) -> Reply:
        """Send a request and wait for its reply.

        Args:
            request: What to ask.
            timeout_s: Time for everything: finding the server, other threads' calls, the call [s].

        Raises:
            ServiceTimeout: The server did not reply in time; whether it has acted is not known.
            ServiceUnavailable: Nobody offers the service, or its server died.
            ServiceFailed: The handler raised.
            TypeMismatch: The service of this name has other types.
            TypeError: The request is of another type.
            Closed: The client or its node was closed, before or meanwhile.
        """
        self._check_open()
        if type(request) is not self._request_type:
            raise TypeError(f"{self.name} takes {self._request_type.__name__}, got {type(request).__name__}")
        body = codec_of(self._request_type).encode(request, wire.CONTROL_LIMIT)
        deadline_s = time.monotonic() + timeout_s
        if not self._lock.acquire(timeout=max(timeout_s, 0.0)):
            self._check_open()
            raise ServiceTimeout(f"{self.name}: other calls took the {timeout_s} s")
        try:
            self._check_open()
            place = self._connect(deadline_s, timeout_s)
            self._calls += 1
            header = wire.Header(
                wire.REQUEST,
                self._source,
                schema_of(self._request_type).fingerprint,
                self._calls,
                int(deadline_s * 1e9) if place.local else None,
                int((deadline_s - time.monotonic()) * 1e9),
                len(body),
                self._number,
            )
            return self._exchange(place, wire.pack_header(header) + body, deadline_s, timeout_s)
        finally:
            self._lock.release()

    async def call_async(self, request: Request, timeout_s: float = 1.0) -> Reply:
        """Do `call` without blocking the running loop, in a thread.

        A task that is cancelled meanwhile does not end the call, which goes on until its time is over.
        """
        return await asyncio.to_thread(self.call, request, timeout_s)

    def available(self) -> bool:
        """Whether somebody offers the service now."""
        return self._find() is not None

    def _check_open(self) -> None:
        if self._closed:
            raise Closed(f"the client of {self.name} was closed")

    def _connect(self, deadline_s: float, timeout_s: float) -> Reach:
        while (place := self._find()) is None:
            if time.monotonic() >= deadline_s:
                raise ServiceUnavailable(f"nobody offers {self.name} (waited {timeout_s} s)")
            time.sleep(2e-3)
            self._check_open()
        if (
            self._socket is None or self._place is None or place[:3] != self._place[:3]
        ):  # not how it is secured
            self._disconnect()
            self._socket, self._place = place.open(), place
        return place

    def _exchange(self, place: Reach, frame: bytes, deadline_s: float, timeout_s: float) -> Reply:
        socket = self._socket
        assert socket is not None
        socket.send(frame, zmq.DONTWAIT)
        while True:
            left_s = deadline_s - time.monotonic()
            if left_s <= 0.0:
                self._disconnect()  # a reply that comes late finds nobody
                raise ServiceTimeout(f"{self.name}: no reply within {timeout_s} s")
            if not socket.poll(max(1, int(min(left_s, 0.05) * 1000.0))):
                self._check_open()
                now = self._find()
                if now is None or now.node != place.node:
                    self._disconnect()
                    raise ServiceUnavailable(f"the server of {self.name} has gone")
                continue
            parts = socket.recv_multipart(zmq.DONTWAIT)
            try:
                reply = self._parse(parts)
            except MalformedMessage as error:
                raise ServiceFailed(f"{self.name}: a reply that makes no sense: {error}") from None
            if reply is not None:
                return reply

    def _parse(self, parts: list[bytes]) -> Reply | None:
        if len(parts) != 1:
            raise MalformedMessage(f"a reply of {len(parts)} frames")
        frame = parts[0]
        header = wire.unpack_header(frame)
        wire.check_body(header, len(frame))
        if header.source != self._source or header.sequence != self._calls:
            return None  # the answer to a call that was given up
        if header.kind == wire.REPLY:
            codec = codec_of(self._reply_type)
            if header.fingerprint != codec.fingerprint:
                raise MalformedMessage(f"type {header.fingerprint:016x}")
            reply: Reply = codec.decode(frame, wire.HEADER_SIZE, header.body_size)
            return reply
        if header.kind != wire.ERROR:
            raise MalformedMessage(f"kind {header.kind!r}")
        error = codec_of(ServiceError).decode(frame, wire.HEADER_SIZE, header.body_size)
        if error.kind == "late":
            raise ServiceTimeout(f"{self.name}: {error.text}")
        if error.kind in _UNAVAILABLE:
            raise ServiceUnavailable(f"{self.name}: {error.text}")
        raise ServiceFailed(f"{self.name}: {error.text}")

    def _disconnect(self) -> None:
        if self._socket is not None:
            self._socket.close(0)
            self._socket = None

    def __del__(self) -> None:
        if hasattr(self, "_socket"):
            self._disconnect()

    def close(self) -> None:
        """Disconnect. A call that waits in another thread ends soon, with `Closed`."""
        self._closed = True
        with self._lock:
            self._disconnect()
