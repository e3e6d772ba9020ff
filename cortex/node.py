"""A node: what a process opens to publish, subscribe and serve."""

from __future__ import annotations

import atexit
import logging
import os
import secrets
import threading
import time
import weakref
from collections.abc import Callable
from functools import partial
from typing import Any, TypeVar, cast

from cortex.callbacks import CallbackThread, check_callable
from cortex.clock import Clock, wall_offset_ns
from cortex.codec import Codec, RawCodec, RawMessage, codec_of
from cortex.context import LINGER_MS, Closed, Closing, context
from cortex.control_thread import ControlThread, ask_stats
from cortex.discovery import Directory
from cortex.host import domain_id, host_id
from cortex.matching import Matcher
from cortex.overview import Liveliness, TopicInfo, Watch, topics_of
from cortex.places import Places, Reach, network
from cortex.policy import Policy, keep_last
from cortex.pub_socket import Backoff, PubSockets
from cortex.publisher import INLINE_MAX, Publisher, close_publishers, usual_max_wait_s
from cortex.records import NodeRecord, StatsReply
from cortex.schema import Schema, schema_of
from cortex.security import Keys
from cortex.service import Client, Server, Service, service_number
from cortex.subscriber import Subscriber
from cortex.topic import check_pattern, check_topic, matches

logger = logging.getLogger(__name__)

T = TypeVar("T")
Request = TypeVar("Request")
Reply = TypeVar("Reply")

_nodes: weakref.WeakSet[Node] = weakref.WeakSet()


class Node(Closing):
    """A participant: its publishers, subscribers and services, and the thread that keeps them connected.

    Args:
        name: For people; need not be unique.
        domain: Nodes of one domain see each other; None takes `CORTEX_DOMAIN`, else 0.
        registry: "auto" (the one of this host, started if there is none), "off", or "tcp://host:port"; None
            takes `CORTEX_REGISTRY`, else "auto".
        listen: Address to be reached at over tcp, such as "192.168.1.5" or "0.0.0.0"; None takes
            `CORTEX_LISTEN`, else this host only, as "" does. Without `keys` also "127.0.0.1" lets every user
            of this host read and call this node.
        keys: CURVE keys for tcp, from `cortex.security.load_keys`; None takes those in `CORTEX_KEYS`, a
            directory, if that is set.
        insecure: Allow plain tcp beyond this host.

    Raises:
        ValueError: An argument is not what it must be, or plain tcp would be open to the network.
        PermissionError: The runtime directory is not safe, or a server's key is not authorised.
    """

    def __init__(
        self,
        name: str,
        *,
        domain: int | None = None,
        registry: str | None = None,
        listen: str | None = None,
        keys: Keys | None = None,
        insecure: bool = False,
    ) -> None:
        if not name or len(name) > 100:
            raise ValueError(f"a node's name has 1 to 100 characters, got {name!r}")
        self.name = name
        self.domain = domain_id(domain)
        self.id = secrets.randbits(64) or 1
        registry, listen, keys = network(registry, listen, keys)
        self._pid = os.getpid()
        self._lock = threading.RLock()
        self._pub_sockets = PubSockets()
        self._publishers: list[Publisher[Any]] = []
        self._subscribers: list[Subscriber[Any]] = []
        self._watches: list[Watch] = []
        self._clients: weakref.WeakSet[Client[Any, Any]] = weakref.WeakSet()
        self._callbacks = CallbackThread(name)
        self._server = Server(self._callbacks.submit)
        self._clock_offset_ns = wall_offset_ns()
        self._closed = False
        self._places = Places(self.domain, self.id, self._pub_sockets, listen, keys=keys, insecure=insecure)
        self._host = host_id()  # once the runtime directory exists: it counts
        self._matcher = Matcher(self._host, keys, insecure=insecure)
        try:
            self._directory = Directory(
                context(),
                domain=self.domain,
                record=self._record,
                registry=registry,
                keys=keys,
                insecure=insecure,
                on_change=self._on_change,
            )
        except BaseException:
            self._pub_sockets.close()
            self._places.close()
            raise
        self._control = ControlThread(
            name,
            self._places,
            self._directory,
            self._server,
            self._pub_sockets,
            stats=self._stats,
            publishers=self._publishers,
            subscribers=self._subscribers,
            on_clock=self._set_clock,
        )
        self._control.start()
        _nodes.add(self)

    def publisher(
        self,
        topic: str,
        message_type: type[T],
        *,
        latch: bool = False,
        inline_max: int = INLINE_MAX,
        expected_bytes: int = 0,
        max_wait_s: float | None = None,
    ) -> Publisher[T]:
        """Publish messages of a type on a topic.

        Args:
            topic: Like "/front/image".
            message_type: A class made by `@message`.
            latch: Give the last message to subscribers that come later.
            inline_max: Bodies over this size go through shared memory where that is possible [bytes].
            expected_bytes: Bodies will hardly be larger than this: shared memory for them is made when the
                first local subscriber comes, and not while messages grow, which takes milliseconds then
                [bytes]. 0: not known.
            max_wait_s: Longest time that reliable subscribers may hold up one `publish`, whatever they
                ask for [s]. None: 1 s, for the types of `cortex.messages.commands` 0.1 s.

        Raises:
            ValueError: The topic is not one, `inline_max` is negative, or `max_wait_s` is not 0 to 86400.
        """
        self._check_open()
        if inline_max < 0:
            raise ValueError(f"inline_max must not be negative, got {inline_max}")
        if max_wait_s is None:
            max_wait_s = usual_max_wait_s(message_type)
        if not 0.0 <= max_wait_s <= 86_400.0:
            raise ValueError(f"max_wait_s must be 0 to 86400, got {max_wait_s}")
        return self._add_publisher(
            topic,
            codec_of(message_type),
            latch=latch,
            inline_max=inline_max,
            expected_bytes=expected_bytes,
            max_wait_s=max_wait_s,
        )

    def raw_publisher(self, topic: str, schema: Schema, *, latch: bool = False) -> Publisher[RawMessage]:
        """Publish bodies that are encoded already; their type is known by its schema only."""
        self._check_open()
        return self._add_publisher(topic, cast(Any, RawCodec(schema)), latch=latch)

    def subscriber(
        self,
        topic: str,
        message_type: type[T] | None = None,
        callback: Callable[[T], object] | None = None,
        *,
        policy: Policy | None = None,
    ) -> Subscriber[T]:
        """Subscribe to a topic.

        Args:
            topic: Like "/front/image". In a pattern `*` stands for one part of a name, `**` for any number:
                "/*/imu", "/drone/**". `recv_with_info` says which topic a message is of. A pattern passes
                over topics of other types.
            message_type: A class made by `@message`; None takes whatever type each publisher has. A publisher
                may have further optional fields at the end, or lack ours, which are None then.
            callback: Called with every message on the node's callback thread; None: use `recv` or iterate.
            policy: What to do when messages come faster than they are taken; None: `keep_last(64)`.
        """
        self._check_open()
        if policy is not None and not isinstance(policy, Policy):
            raise TypeError(f"policy must be a Policy such as latest() or reliable(), got {policy!r:.80}")
        if callback is not None:
            check_callable(callback, "callback must be a function of one message")
        subscriber: Subscriber[T] = Subscriber(
            check_pattern(topic),
            None if message_type is None else codec_of(message_type),
            keep_last() if policy is None else policy,
            callback=callback,
            on_close=self._drop_subscriber,
        )
        with self._lock:
            self._subscribers.append(subscriber)
            self._matcher.match(subscriber, self._record(), self._directory.nodes.values())
        if callback is not None:
            self._callbacks.add(subscriber)
        self._announce()
        return subscriber

    def service(
        self,
        name: str,
        request_type: type[Request],
        reply_type: type[Reply],
        handler: Callable[[Request], Reply],
    ) -> Callable[[], None]:
        """Offer a service. The handler runs on the callback thread.

        Returns:
            A function that withdraws it.
        """
        self._check_open()
        check_callable(handler, "handler must be a function of one request")
        number = service_number(check_topic(name), request_type, reply_type)
        service = Service(name, number, request_type, reply_type, handler)
        self._server.add(service)
        self._callbacks.serve()
        self._announce()

        def withdraw() -> None:
            self._server.remove(service)
            self._announce()

        return withdraw

    def client(
        self, name: str, request_type: type[Request], reply_type: type[Reply]
    ) -> Client[Request, Reply]:
        """Call a service."""
        self._check_open()
        number = service_number(check_topic(name), request_type, reply_type)
        find = partial(self._find_service, name, number, schema_of(request_type))
        client = Client(name, request_type, reply_type, find)
        self._clients.add(client)
        return client

    def watch(self, pattern: str, callback: Callable[[Liveliness], object]) -> Callable[[], None]:
        """Be told, on the callback thread, of each publisher that comes, leaves or dies.

        Those that are there already come first. A process that dies on this host is known within
        milliseconds, one on another host after a second.

        Args:
            pattern: A topic, or a pattern of topics as for `subscriber`.
            callback: Called with each change.

        Returns:
            A function that ends it.
        """
        self._check_open()
        check_callable(callback, "callback must be a function of one change")
        watch = Watch(pattern, callback)
        with self._lock:
            self._watches.append(watch)
        self._callbacks.serve()
        self._tell_watches()

        def stop() -> None:
            watch.stopped = True
            with self._lock:
                if watch in self._watches:
                    self._watches.remove(watch)

        return stop

    @property
    def rejected(self) -> int:
        """Control frames that made no sense."""
        return self._control.rejected

    def nodes(self) -> list[NodeRecord]:
        """All nodes that are known now, this one included."""
        return list(self._known().values())

    def topics(self) -> list[TopicInfo]:
        """All topics that are published or subscribed now, one entry for each type on a topic."""
        return topics_of(self.nodes())

    def ask_stats(self, node: int, timeout_s: float = 1.0) -> StatsReply:
        """Ask a node for its counters.

        Raises:
            KeyError: There is no such node.
            ConnectionError: It cannot be reached from here, or answers nobody.
            TimeoutError: It did not answer in time.
        """
        if node == self.id:
            return self._stats()
        return ask_stats(self._matcher.reach_control(self._known()[node]), self.id, timeout_s)

    def now_ns(self) -> int:
        """CLOCK_REALTIME of the registry's host, for stamps that hosts compare [ns]; may go back a little."""
        return time.monotonic_ns() + self._directory.clock.offset_ns()

    def clock(self) -> Clock | None:
        """Return this host's clock beside that of the registry's host; None: it has not answered yet."""
        return self._directory.clock.clock(time.monotonic_ns())

    def wait_for_registry(self, timeout_s: float = 5.0) -> bool:
        """Wait until the registry has told of all nodes; False if it has not in time."""
        backoff = Backoff(timeout_s)
        while not self._directory.connected:
            if not backoff.wait():
                return False
        return True

    def stop_waiting(self) -> None:
        """Hold up no publisher any more, as `Publisher.stop_waiting`; may be called by a signal handler."""
        for publisher in list(self._publishers):
            publisher.stop_waiting()

    def close(self) -> None:
        """Leave: send what is queued, close publishers, subscribers and services, stop the threads.

        Nobody holds this up for longer than a second, reliable subscribers neither: to give each of them its
        time, close the publishers first.
        """
        if self._pid != os.getpid():
            return  # a forked child has copies of us, but not our threads
        with self._lock:
            if self._closed:
                return
            self._closed = True
            publishers, subscribers = list(self._publishers), list(self._subscribers)
        close_publishers(publishers, longest_s=LINGER_MS * 1e-3)  # as long as the sockets
        for subscriber in subscribers:
            subscriber.close()
        for client in list(self._clients):
            client.close()
        self._callbacks.close()
        self._control.stop()
        self._pub_sockets.emit_notes()
        self._pub_sockets.close()

    def disown(self) -> None:
        """Give up in a forked child: threads and sockets are the parent's."""
        for publisher in self._publishers:
            publisher.disown()
        for subscriber in self._subscribers:
            subscriber.disown()

    def _check_open(self) -> None:
        if self._pid != os.getpid():
            raise RuntimeError(f"node {self.name!r} belongs to the process that this one was forked from")
        if self._closed:
            raise Closed(f"node {self.name!r} is closed")

    def _add_publisher(self, topic: str, codec: Codec, **options: Any) -> Publisher[Any]:
        check_topic(topic)
        publisher: Publisher[Any] = Publisher(
            topic, codec, self._pub_sockets, on_close=self._drop_publisher, **options
        )
        with self._lock:
            self._publishers.append(publisher)
            self._match_all(publisher.topic)
        self._announce()
        return publisher

    def _drop_publisher(self, publisher: Publisher[Any]) -> None:
        with self._lock:
            if publisher in self._publishers:
                self._publishers.remove(publisher)
            self._match_all(publisher.topic)
        self._announce()

    def _drop_subscriber(self, subscriber: Subscriber[Any]) -> None:
        self._callbacks.remove(subscriber)
        with self._lock:
            if subscriber in self._subscribers:
                self._subscribers.remove(subscriber)
        self._announce()

    def _announce(self) -> None:
        if not self._closed:
            self._directory.announce()
            self._control.hurry()
            self._tell_watches()

    def _tell_watches(self) -> None:
        with self._lock:
            if self._watches and not self._closed:
                records = list(self._known().values())
                for watch in self._watches:
                    for change in watch.changes(records):
                        self._callbacks.submit(partial(watch.tell, change))

    def _record(self) -> NodeRecord:
        with self._lock:
            return NodeRecord(
                self.id,
                self.name,
                self._host,
                self._pid,
                0,
                self._clock_offset_ns,
                self._places.endpoints,
                [publisher.record() for publisher in self._publishers],
                [subscriber.record() for subscriber in self._subscribers],
                [service.record() for service in self._server.services()],
            )

    def _known(self) -> dict[int, NodeRecord]:
        return {**self._directory.nodes, self.id: self._record()}

    def _set_clock(self, offset_ns: int) -> None:
        self._clock_offset_ns = offset_ns
        self._directory.announce()
        self._match_all()

    def _on_change(self, _: frozenset[int]) -> None:
        self._match_all()
        self._tell_watches()
        self._control.hurry()

    def _match_all(self, topic: str | None = None) -> None:
        with self._lock:
            own, peers = self._record(), self._directory.nodes.values()
            for subscriber in self._subscribers:
                if topic is None or matches(subscriber.topic, topic):
                    try:
                        self._matcher.match(subscriber, own, peers)
                    except Exception:  # one that cannot be connected must not take the others along
                        what = "%s: cannot connect the subscriber of %s"
                        logger.exception(what, self.name, subscriber.topic)

    def _find_service(self, name: str, number: int, expected: Schema) -> Reach | None:
        place = self._matcher.find_service(name, number, expected, self._known().values())
        if place is not None and place.node == self.id and self._callbacks.is_current:
            raise RuntimeError(
                f"{name} is served by the thread that calls it: a callback or handler cannot call a service "
                "of its own node"
            )
        return place

    def _stats(self) -> StatsReply:
        with self._lock:
            publishers, subscribers = list(self._publishers), list(self._subscribers)
        return StatsReply(
            self.id,
            [publisher.stats() for publisher in publishers],
            [subscriber.stats() for subscriber in subscribers],
            self.rejected + self._directory.rejected + self._server.rejected,
        )


def _after_fork_in_child() -> None:
    for node in list(_nodes):
        node.disown()


os.register_at_fork(after_in_child=_after_fork_in_child)


@atexit.register
def _close_nodes() -> None:
    """Take leave of the others when the process ends in an orderly way."""
    for node in list(_nodes):
        node.close()
