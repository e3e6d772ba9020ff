"""A node's view of the others; run as a module, the registry's process. `registry.py` has the protocol."""

from __future__ import annotations

import dataclasses
import logging
import sys
import time
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from typing import Any

import zmq

from cortex.codec import MalformedMessage
from cortex.control import (
    HEARTBEAT_NS,
    LEASE_NS,
    NODES_MAX,
    RECORD_BYTES_MAX,
    STALL_NS,
    control_types,
    make_control_socket,
    try_send,
)
from cortex.directory_link import DirectoryLink
from cortex.host import REGISTRY_SOCKET, runtime_dir
from cortex.records import (
    Alive,
    Changed,
    Describe,
    Gone,
    Heartbeat,
    Hello,
    Leave,
    NodeRecord,
    Refused,
    Welcome,
    check_record,
)
from cortex.registry import Registry, ensure_registry, main
from cortex.security import Keys, apply_client, check_address, host_of, keeps_keys
from cortex.wire import control_frame, parse_control

__all__ = ["Directory", "Registry", "ensure_registry", "main"]

logger = logging.getLogger(__name__)

_FRAMES_PER_CALL = 256
_CONNECT_LAST_NS = 50_000_000
_ANSWER_NS = 300_000_000
"""A `Hello` that was not answered for this long is sent again, then after twice as long, up to a second."""
_ANNOUNCE_NS = 10_000_000
"""Changes of our own record within this time travel together."""
_SILENCE_NS = 3_000_000_000
_REVIVE_FIRST_NS = 1_000_000_000
_REVIVE_LAST_NS = 10_000_000_000
_INBOUND = "inbound"


class Directory:
    """Knows the other nodes of a domain, and makes this one known to them.

    It belongs to one thread, which polls `sockets`, calls `handle` for those that are readable, and `tick` at
    `deadline_ns`. `nodes` may be read from any thread: it is replaced when it changes, never altered.

    Args:
        context: For the sockets.
        domain: The domain.
        registry: "auto" (the one of this host, started if need be), "off", or its "tcp://host:port".
        peers: Control addresses of nodes to talk to without a registry.
        keys: For CURVE on tcp.
        insecure: Allow plain tcp beyond this host.
        record: Returns this node's record; `announce` sets its revision.
        on_change: Called from `handle`, `answer` and `tick` with the numbers of the nodes that came, changed
            or went; what they are now is in `nodes`.

    Raises:
        ValueError: If an address is not one, or would be plain tcp beyond this host.
        PermissionError: If the runtime directory is not safe, or a server's key is not authorised.
    """

    def __init__(
        self,
        context: zmq.Context[Any],
        *,
        domain: int,
        record: Callable[[], NodeRecord],
        registry: str = "auto",
        peers: Sequence[str] = (),
        keys: Keys | None = None,
        insecure: bool = False,
        on_change: Callable[[frozenset[int]], None] | None = None,
    ):
        self.nodes: Mapping[int, NodeRecord] = {}
        """The other nodes' records, by node."""
        self.rejected = 0
        """Control frames that were malformed."""
        self._context = context
        self._domain = domain
        self._record = record
        self._on_change = on_change
        self._keys, self._insecure = keys, insecure
        self._revives = registry == "auto"
        self._revive_ns = 0
        self._revive_wait_ns = _REVIVE_FIRST_NS
        self._revision = 0
        self._dirty = True
        self._announced_ns = 0
        self._own = self._next_record()
        self._known: dict[int, dict[Hashable, NodeRecord]] = {}
        self._inbound: dict[int, int] = {}
        self._senders: dict[int, str] = {}
        self._changed: set[int] = set()
        self._logged: set[str] = set()
        self._tick_ns = time.monotonic_ns()
        self._link_types = control_types(Alive, Changed, Gone, Refused, Welcome)
        self._answer_types = control_types(Describe, Heartbeat, Hello, Leave)
        self._links: list[DirectoryLink] = []
        try:
            if registry == "auto":
                self._connect(f"ipc://{runtime_dir(domain) / REGISTRY_SOCKET}", is_registry=True)
            elif registry != "off":
                self._connect(registry, is_registry=True)
            for address in dict.fromkeys(peers):
                self._connect(address, is_registry=False)
        except BaseException:
            self.close()
            raise

    def _connect(self, address: str, *, is_registry: bool) -> None:
        if not address.startswith(("tcp://", "ipc://")):
            what = 'registry must be "auto", "off", or a' if is_registry else "a peer must be a"
            raise ValueError(f"{what} tcp:// or ipc:// address, got {address!r}")
        check_address(address, keys=self._keys, insecure=self._insecure)
        tcp = address.startswith("tcp://")
        socket = make_control_socket(self._context, zmq.DEALER, tcp=tcp)
        try:
            # Nothing may queue for a peer that is not there: a `send` that fails tells us so at once.
            socket.setsockopt(zmq.IMMEDIATE, 1)
            if tcp and self._keys is not None:
                apply_client(socket, self._keys, self._keys.key_of_host(host_of(address)))
            socket.connect(address)
        except BaseException:
            socket.close(linger=0)
            raise
        now_ns = time.monotonic_ns()
        self._links.append(DirectoryLink(address, socket, is_registry, next_ns=now_ns, heard_ns=now_ns))

    # What the owner drives

    def sockets(self) -> list[zmq.Socket[Any]]:
        """Return the sockets to poll for input."""
        return [link.socket for link in self._links]

    @property
    def deadline_ns(self) -> int:
        """When to call `tick` next, by CLOCK_MONOTONIC [ns]; earlier and later calls do no harm."""
        times = [link.next_ns for link in self._links]
        times.append(self._tick_ns + HEARTBEAT_NS)
        if self._dirty:
            times.append(self._announced_ns + _ANNOUNCE_NS)
        return min(times)

    @property
    def connected(self) -> bool:
        """Whether the registry and all static peers have answered and not fallen silent."""
        return all(link.welcomed and not link.missing for link in self._links)

    def announce(self) -> None:
        """Say that this node's record has changed; the next `tick` sends it. Any thread may call this."""
        self._dirty = True

    def handle(self, socket: zmq.Socket[Any]) -> None:
        """Read what has arrived on one of the sockets, at most some hundred frames."""
        link = next(link for link in self._links if link.socket is socket)
        now_ns = time.monotonic_ns()
        for _ in range(_FRAMES_PER_CALL):
            try:
                frames = socket.recv_multipart(zmq.NOBLOCK)
            except zmq.Again:
                break
            try:
                if len(frames) != 1:
                    raise MalformedMessage(f"{len(frames)} frames where one was expected")
                message, _ = parse_control(frames[0], self._link_types)
                self._on_message(link, message, now_ns)
            except MalformedMessage as error:
                self.rejected += 1
                self._log_once(f"rejected a frame of {link.address}", error)
        self._flush()

    def tick(self, now_ns: int | None = None) -> None:
        """Do what is due: heartbeats, our own changes, leases, and a new registry for one that died."""
        now_ns = time.monotonic_ns() if now_ns is None else now_ns
        self._forgive_stall(now_ns - self._tick_ns)
        self._tick_ns = now_ns
        if self._dirty and now_ns - self._announced_ns >= _ANNOUNCE_NS:
            self._announced_ns = now_ns
            self._own = self._next_record()
            for link in self._links:
                if link.welcomed:
                    self._say_hello(link, now_ns, snapshot=False)
        for link in self._links:
            if now_ns >= link.next_ns:
                self._beat(link, now_ns)
            self._expire(link, now_ns)
        for node in [n for n, seen_ns in self._inbound.items() if now_ns - seen_ns > LEASE_NS]:
            self._forget_inbound(node)
        self._flush()

    def answer(self, frame: bytes, sender: str = "") -> bytes | None:
        """Answer a control frame that came to this node's own ROUTER.

        It is for `Describe`, and for the `Hello`, `Heartbeat` and `Leave` of nodes that have this one as
        static peer: they become known here too, for as long as they send heartbeats. A node belongs to who
        came with it first.

        Args:
            frame: What has come.
            sender: Whence it came; see `sender_of`.

        Returns:
            The frame to send back; None if there is nothing to say.

        Raises:
            MalformedMessage: If the frame is something else. It is not counted here.
        """
        message, header = parse_control(frame, self._answer_types)
        now_ns = time.monotonic_ns()
        reply: Any = None
        if isinstance(message, Hello):
            check_record(message.record)
            node = message.record.node
            if len(frame) > RECORD_BYTES_MAX:
                reply = Refused(node, f"a record of {len(frame)} bytes, allowed are {RECORD_BYTES_MAX}")
            elif not self._may_change(message.record, sender):
                reply = Refused(node, "it is the node of another process or key")
            elif node in self._inbound or len(self._inbound) < NODES_MAX:
                self._inbound[node] = now_ns
                self._senders[node] = sender
                self._put(_INBOUND, message.record)
                reply = Changed(0, self._own)
            else:
                reply = Refused(node, f"this node has {NODES_MAX} peers already")
        elif isinstance(message, Heartbeat):
            known = self._known.get(message.node, {}).get(_INBOUND)
            if known is not None:
                self._inbound[message.node] = now_ns
            if message.held != self._own.revision:
                reply = Changed(0, self._own)
            else:
                reply = Alive(self._own.node, 0, known.revision if known else 0)
        elif isinstance(message, Leave):
            known_record = self.nodes.get(message.node) if message.node in self._inbound else None
            if known_record is not None and self._may_change(known_record, sender):
                self._forget_inbound(message.node)
                for link in self._links:
                    if not link.is_registry and message.node in link.nodes:
                        self._drop(link, message.node)
        else:
            reply = Changed(0, self._own)
        self._flush()
        return None if reply is None else control_frame(reply, header.sequence)

    def _may_change(self, record: NodeRecord, sender: str) -> bool:
        """Whether a sender may speak for a node: it did so first, and its keys are those that are known."""
        known = self.nodes.get(record.node, record)
        is_first = self._senders.get(record.node, sender) == sender
        return is_first and keeps_keys(record, sender) and keeps_keys(known, sender)

    def close(self) -> None:
        """Take leave, and close the sockets."""
        leave = control_frame(Leave(self._own.node))
        for link in self._links:
            if not link.socket.closed:
                if link.welcomed:
                    try_send(link.socket, leave)
                link.socket.close()

    # Sending

    def _next_record(self) -> NodeRecord:
        self._dirty = False  # before the record is read: a change that comes now is announced once more
        self._revision += 1
        return dataclasses.replace(self._record(), revision=self._revision)

    def _beat(self, link: DirectoryLink, now_ns: int) -> None:
        if not link.welcomed:
            self._say_hello(link, now_ns, snapshot=True)
            return
        held = 0
        if not link.is_registry:
            held = max((self._known[node][link].revision for node in link.nodes), default=0)
        if try_send(link.socket, control_frame(Heartbeat(self._own.node, self._own.revision, held))):
            link.next_ns = now_ns + HEARTBEAT_NS
            self._warn_of_silence(link, now_ns)
        else:
            link.lose()
            self._retry(link, now_ns)

    def _say_hello(self, link: DirectoryLink, now_ns: int, *, snapshot: bool) -> None:
        try:
            frame = control_frame(Hello(snapshot, self._own))
        except ValueError as error:  # larger than any control frame may be
            self._log_once("this node cannot be announced", error)
            link.next_ns = now_ns + LEASE_NS
            return
        if not try_send(link.socket, frame):
            link.lose()
            self._retry(link, now_ns)
            return
        link.wait_ns = min(2 * link.wait_ns, LEASE_NS) if link.asked else _ANSWER_NS
        link.asked, link.quiet_ns = True, now_ns + _ANSWER_NS
        link.next_ns = now_ns + (HEARTBEAT_NS if link.welcomed else link.wait_ns)

    def _retry(self, link: DirectoryLink, now_ns: int) -> None:
        link.next_ns = now_ns + link.wait_ns
        link.wait_ns = min(2 * link.wait_ns, _CONNECT_LAST_NS)
        self._warn_of_silence(link, now_ns)
        if link.is_registry and self._revives and now_ns >= self._revive_ns:
            self._revive(now_ns)

    def _revive(self, now_ns: int) -> None:
        """Start a registry if there is none; a registry that never answers is not started over and over."""
        try:
            if not ensure_registry(self._domain):
                return
        except OSError as error:
            self._log_once("cannot start a registry", error)
        self._revive_ns = now_ns + self._revive_wait_ns
        self._revive_wait_ns = min(2 * self._revive_wait_ns, _REVIVE_LAST_NS)

    def _warn_of_silence(self, link: DirectoryLink, now_ns: int) -> None:
        if now_ns - link.heard_ns > _SILENCE_NS and not link.warned:
            link.warned = True
            what = "registry" if link.is_registry else "peer"
            keys = " and are its key and ours authorised?" if self._keys and "tcp:" in link.address else ""
            logger.warning("no answer of the %s at %s; is it running?%s", what, link.address, keys)

    # Receiving

    def _on_message(self, link: DirectoryLink, message: Any, now_ns: int) -> None:
        link.heard_ns, link.warned = now_ns, False
        if isinstance(message, Refused):
            self._log_once(f"{link.address} refuses this node", message.reason)
            link.wait_ns, link.quiet_ns = LEASE_NS, now_ns + LEASE_NS
            if not link.welcomed:
                link.next_ns = link.quiet_ns
        elif isinstance(message, Welcome):
            self._on_welcome(link, message, now_ns)
        elif isinstance(message, Alive):
            self._on_alive(link, message, now_ns)
        elif isinstance(message, Gone):
            link.count(message.version)
            link.missing.pop(message.node, None)
            link.doubted.pop(message.node, None)
            self._drop(link, message.node)
        else:
            self._on_changed(link, message, now_ns)

    def _on_welcome(self, link: DirectoryLink, welcome: Welcome, now_ns: int) -> None:
        if not link.is_registry or len(welcome.nodes) != len(welcome.revisions):
            raise MalformedMessage("a welcome with lists of different lengths, or of a peer")
        link.greet(now_ns)
        self._revive_ns, self._revive_wait_ns = 0, _REVIVE_FIRST_NS
        link.epoch, link.version = welcome.epoch, welcome.version
        named = dict(zip(welcome.nodes, welcome.revisions, strict=True))
        named.pop(self._own.node, None)
        link.missing = {
            node: revision
            for node, revision in named.items()
            if node not in link.nodes or self._known[node][link].revision != revision
        }
        # A registry that was just started does not know everybody yet: one lease of grace.
        since = {node: link.doubted.get(node, now_ns + LEASE_NS) for node in link.nodes if node not in named}
        link.doubted = since

    def _on_alive(self, link: DirectoryLink, alive: Alive, now_ns: int) -> None:
        if not link.welcomed or now_ns < link.quiet_ns:
            return  # the answer to our last `Hello` is on its way and says more
        if link.is_registry:
            if alive.epoch != link.epoch or alive.version != link.version or link.missing:
                self._say_hello(link, now_ns, snapshot=True)
                return
        elif alive.epoch not in link.nodes and alive.epoch != self._own.node:
            link.welcomed, link.next_ns = False, now_ns
            return
        if alive.held != self._own.revision:
            self._say_hello(link, now_ns, snapshot=False)

    def _on_changed(self, link: DirectoryLink, changed: Changed, now_ns: int) -> None:
        record = changed.record
        check_record(record)
        if link.is_registry:
            link.count(changed.version)
            link.missing.pop(record.node, None)
            link.doubted.pop(record.node, None)
        else:
            link.greet(now_ns)
            for node in link.nodes - {record.node}:  # another node has taken over this address
                self._drop(link, node)
        self._put(link, record)

    # What is known

    def _forgive_stall(self, stall_ns: int) -> None:
        """If this process was stopped, the others' silence is ours: their leases start where they stood."""
        if stall_ns <= STALL_NS:
            return
        for link in self._links:
            link.heard_ns += stall_ns
            link.doubted = {node: at_ns + stall_ns for node, at_ns in link.doubted.items()}
        self._inbound = {node: seen_ns + stall_ns for node, seen_ns in self._inbound.items()}

    def _expire(self, link: DirectoryLink, now_ns: int) -> None:
        if link.is_registry:
            if not link.welcomed:
                return  # without a registry nobody is removed
            gone: Iterable[int] = [node for node, at_ns in link.doubted.items() if now_ns > at_ns]
        else:
            gone = link.nodes if now_ns - link.heard_ns > LEASE_NS else ()
        for node in list(gone):
            link.doubted.pop(node, None)
            self._drop(link, node)

    def _put(self, holder: Hashable, record: NodeRecord) -> None:
        # One holder's records come in order, so its last one counts; of several holders' the newest.
        if record.node != self._own.node:
            self._known.setdefault(record.node, {})[holder] = record
            if isinstance(holder, DirectoryLink):
                holder.nodes.add(record.node)
            self._choose(record.node)

    def _forget_inbound(self, node: int) -> None:
        self._inbound.pop(node, None)
        self._senders.pop(node, None)
        self._drop(_INBOUND, node)

    def _drop(self, holder: Hashable, node: int) -> None:
        if isinstance(holder, DirectoryLink):
            holder.nodes.discard(node)
        known = self._known.get(node)
        if known is not None and known.pop(holder, None) is not None:
            self._choose(node)

    def _choose(self, node: int) -> None:
        known = self._known[node]
        if not known:
            del self._known[node]
            self.nodes = {other: record for other, record in self.nodes.items() if other != node}
            self._changed.add(node)
            return
        newest = max(known.values(), key=lambda record: record.revision)
        before = self.nodes.get(node)
        if before is None or before.revision != newest.revision:
            self.nodes = {**self.nodes, node: newest}
            self._changed.add(node)

    def _flush(self) -> None:
        if self._changed and self._on_change is not None:
            self._on_change(frozenset(self._changed))
        self._changed.clear()

    def _log_once(self, what: str, why: object) -> None:
        if what not in self._logged:
            self._logged.add(what)
            logger.warning("%s: %s", what, why)


if __name__ == "__main__":
    sys.exit(main())
