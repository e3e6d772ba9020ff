"""A node's view of the others; run as a module, the registry's process. `registry.py` has the protocol."""

from __future__ import annotations

import logging
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import zmq

from cortex import control, records
from cortex.clock import ClockEstimate
from cortex.codec import MalformedMessage
from cortex.host import REGISTRY_SOCKET, runtime_dir
from cortex.registry import Registry, ensure_registry, main
from cortex.security import Keys, apply_client, check_address, host_of
from cortex.wire import Header, control_frame, parse_control

__all__ = ["Directory", "Registry", "ensure_registry", "main"]

logger = logging.getLogger(__name__)

_FRAMES_PER_CALL = 256
_CONNECT_FIRST_NS = 2_000_000
_CONNECT_LAST_NS = 50_000_000
_ANSWER_NS = 300_000_000
"""A `Hello` that was not answered for this long is sent again, then after twice as long, up to a second."""
_ANNOUNCE_NS = 10_000_000
"""Changes of our own record within this time travel together."""
_SILENCE_NS = 3_000_000_000
_REVIVE_FIRST_NS = 1_000_000_000
_REVIVE_LAST_NS = 10_000_000_000


class Directory:
    """Knows the other nodes of a domain, and makes this one known to them.

    It belongs to one thread, which polls `socket`, calls `handle` when that is readable, and `tick` often.
    `nodes` may be read from any thread: it is replaced when it changes, never altered.

    Args:
        context: For the sockets.
        domain: The domain.
        registry: "auto" (the one of this host, started if need be), "off", or its "tcp://host:port".
        keys: For CURVE on tcp.
        insecure: Allow plain tcp beyond this host.
        record: Returns this node's record; `announce` sets its revision.
        on_change: Called from `handle` and `tick` with the numbers of the nodes that came, changed
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
        record: Callable[[], records.NodeRecord],
        registry: str = "auto",
        keys: Keys | None = None,
        insecure: bool = False,
        on_change: Callable[[frozenset[int]], None] | None = None,
    ):
        self.nodes: Mapping[int, records.NodeRecord] = {}
        self.rejected = 0
        self.clock = ClockEstimate(local=not registry.startswith("tcp://"))
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
        self._changed: set[int] = set()
        self._logged: set[str] = set()
        self._tick_ns = time.monotonic_ns()
        self._link_types = control.control_types(
            records.Alive, records.Changed, records.Gone, records.Refused, records.Welcome
        )
        self.socket: zmq.Socket[Any] | None = None
        """To be polled for input; None without a registry."""
        self._next_ns = self._heard_ns = self._tick_ns
        """When to send the next heartbeat or `Hello`; when the registry was heard, or our wait began."""
        self._wait_ns = _CONNECT_FIRST_NS
        self._asked = self._welcomed = self._warned = False
        """Whether a `Hello` has been sent and not answered yet; answered; our impatience said."""
        self._quiet_ns = 0
        """Until when an `Alive` is no reason for a further `Hello`."""
        self._epoch = self._version = 0
        self._named: dict[int, int] = {}
        """Revisions of the other nodes that the registry has told of."""
        self._doubt_until_ns = 0
        """When to drop the nodes that it has not told of."""
        self._address = f"ipc://{runtime_dir(domain) / REGISTRY_SOCKET}" if registry == "auto" else registry
        if registry != "off":
            self._connect(self._address)

    def _connect(self, address: str) -> None:
        if not address.startswith(("tcp://", "ipc://")):
            raise ValueError(
                f'registry must be "auto", "off", or a tcp:// or ipc:// address, got {address!r}'
            )
        check_address(address, keys=self._keys, insecure=self._insecure)
        tcp = address.startswith("tcp://")
        socket = control.make_control_socket(self._context, zmq.DEALER, tcp=tcp)
        try:
            # Nothing may queue for a registry that is not there: a `send` that fails tells us so at once.
            socket.setsockopt(zmq.IMMEDIATE, 1)
            if tcp and self._keys is not None:
                apply_client(socket, self._keys, self._keys.key_of_host(host_of(address)))
            socket.connect(address)
        except BaseException:
            socket.close(linger=0)
            raise
        self.socket = socket

    # What the owner drives

    @property
    def connected(self) -> bool:
        """Whether the registry has told of all nodes; without one there is nothing to wait for."""
        return self.socket is None or (self._welcomed and self._is_complete())

    def _is_complete(self) -> bool:
        known = self.nodes
        return all(
            node in known and known[node].revision == named for node, named in list(self._named.items())
        )

    def announce(self) -> None:
        """Say that this node's record has changed; the next `tick` sends it. Any thread may call this."""
        self._dirty = True

    def handle(self) -> None:
        """Read what has arrived, at most some hundred frames."""
        now_ns = time.monotonic_ns()
        for _ in range(_FRAMES_PER_CALL if self.socket is not None else 0):
            assert self.socket is not None
            try:
                frames = self.socket.recv_multipart(zmq.NOBLOCK)
            except zmq.Again:
                break
            try:
                if len(frames) != 1:
                    raise MalformedMessage(f"{len(frames)} frames where one was expected")
                message, header = parse_control(frames[0], self._link_types)
                if isinstance(message, records.Alive):
                    self._read_clock(header, time.monotonic_ns())
                self._on_message(message, now_ns)
            except MalformedMessage as error:
                self.rejected += 1
                self._log_once(f"rejected a frame of {self._address}", error)
        self._flush()

    def tick(self, now_ns: int | None = None) -> None:
        """Do what is due: heartbeats, our own changes, leases, and a new registry for one that died."""
        now_ns = time.monotonic_ns() if now_ns is None else now_ns
        self._forgive_stall(now_ns - self._tick_ns)
        self._tick_ns = now_ns
        if self._dirty and now_ns - self._announced_ns >= _ANNOUNCE_NS:
            self._announced_ns = now_ns
            self._own = self._next_record()
            if self._welcomed:
                self._say_hello(now_ns, snapshot=False)
        if self.socket is not None and now_ns >= self._next_ns:
            self._beat(now_ns)
        self._expire(now_ns)
        self._flush()

    def close(self) -> None:
        """Take leave, and close the sockets."""
        if self.socket is not None and not self.socket.closed:
            if self._welcomed:
                self._send(records.Leave(self._own.node))
            self.socket.close()

    # Sending

    def _next_record(self) -> records.NodeRecord:
        self._dirty = False  # before the record is read: a change that comes now is announced once more
        self._revision += 1
        return replace(self._record(), revision=self._revision)

    def _send(self, message: Any, sequence: int = 0) -> bool:
        frame = control_frame(message, sequence)
        return self.socket is not None and control.try_send(self.socket, frame)

    def _lose(self) -> None:
        """The connection is gone. What was known through it stays, until its lease says otherwise."""
        if self._welcomed or self._asked:
            self._wait_ns = _CONNECT_FIRST_NS
        self._welcomed = self._asked = False

    def _beat(self, now_ns: int) -> None:
        if not self._welcomed:
            self._say_hello(now_ns, snapshot=True)
            return
        heartbeat = records.Heartbeat(self._own.node, self._own.revision, 0)
        if self._send(heartbeat, time.monotonic_ns()):  # the answer returns the time
            self._next_ns = now_ns + control.HEARTBEAT_NS
            self._warn_of_silence(now_ns)
        else:
            self._lose()
            self._retry(now_ns)

    def _say_hello(self, now_ns: int, *, snapshot: bool) -> None:
        try:
            is_sent = self._send(records.Hello(snapshot, self._own))
        except ValueError as error:  # larger than any control frame may be
            self._log_once("this node cannot be announced", error)
            self._next_ns = now_ns + control.LEASE_NS
            return
        if not is_sent:
            self._lose()
            self._retry(now_ns)
            return
        self._wait_ns = min(2 * self._wait_ns, control.LEASE_NS) if self._asked else _ANSWER_NS
        self._asked, self._quiet_ns = True, now_ns + _ANSWER_NS
        self._next_ns = now_ns + (control.HEARTBEAT_NS if self._welcomed else self._wait_ns)

    def _retry(self, now_ns: int) -> None:
        self._next_ns = now_ns + self._wait_ns
        self._wait_ns = min(2 * self._wait_ns, _CONNECT_LAST_NS)
        self._warn_of_silence(now_ns)
        if self._revives and now_ns >= self._revive_ns:
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

    def _warn_of_silence(self, now_ns: int) -> None:
        if now_ns - self._heard_ns > _SILENCE_NS and not self._warned:
            self._warned = True
            keys = " and are its key and ours authorised?" if self._keys and "tcp:" in self._address else ""
            logger.warning("no answer of the registry at %s; is it running?%s", self._address, keys)

    # Receiving

    def _on_message(self, message: Any, now_ns: int) -> None:
        self._heard_ns, self._warned = now_ns, False
        if isinstance(message, records.Refused):
            self._log_once(f"{self._address} refuses this node", message.reason)
            self._wait_ns, self._quiet_ns = control.LEASE_NS, now_ns + control.LEASE_NS
            if not self._welcomed:
                self._next_ns = self._quiet_ns
        elif isinstance(message, records.Welcome):
            self._on_welcome(message, now_ns)
        elif isinstance(message, records.Alive):
            self._on_alive(message, now_ns)
        elif isinstance(message, records.Gone):
            self._count(message.version)
            self._named.pop(message.node, None)
            self._drop(message.node)
        else:
            self._on_changed(message)

    def _count(self, version: int) -> None:
        """Take note of a change that the registry has numbered."""
        # Records of a snapshot are older than the `Welcome` before them; a gap shows at the next `Alive`.
        if self._welcomed and version == self._version + 1:
            self._version = version

    def _read_clock(self, header: Header, now_ns: int) -> None:
        is_told = 0 < header.sequence < now_ns and 0 < header.publish_ns < records.CLOCK_OFFSET_MAX_NS
        if is_told and not self.clock.local:
            self.clock.add(header.sequence, header.publish_ns, now_ns)

    def _on_welcome(self, welcome: records.Welcome, now_ns: int) -> None:
        if len(welcome.nodes) != len(welcome.revisions):
            raise MalformedMessage("a welcome with lists of different lengths")
        if not self._welcomed:
            self._next_ns = now_ns + control.HEARTBEAT_NS
        self._welcomed, self._asked, self._quiet_ns = True, False, 0
        if welcome.epoch != self._epoch and not self.clock.local:
            self.clock.forget()
        self._revive_ns, self._revive_wait_ns = 0, _REVIVE_FIRST_NS
        self._epoch, self._version = welcome.epoch, welcome.version
        named = dict(zip(welcome.nodes, welcome.revisions, strict=True))
        named.pop(self._own.node, None)
        self._named = named
        # A registry that was just started does not know everybody yet: one lease of grace.
        self._doubt_until_ns = now_ns + control.LEASE_NS

    def _on_alive(self, alive: records.Alive, now_ns: int) -> None:
        if not self._welcomed or now_ns < self._quiet_ns:
            return  # the answer to our last `Hello` is in flight and says more
        if alive.epoch != self._epoch or alive.version != self._version or not self._is_complete():
            self._say_hello(now_ns, snapshot=True)
        elif alive.held != self._own.revision:
            self._say_hello(now_ns, snapshot=False)

    def _on_changed(self, changed: records.Changed) -> None:
        record = changed.record
        records.check_record(record)
        self._count(changed.version)
        if record.node == self._own.node:
            return
        self._named[record.node] = record.revision
        known = self.nodes.get(record.node)
        if known is None or known.revision != record.revision:
            self.nodes = {**self.nodes, record.node: record}
            self._changed.add(record.node)

    # What is known

    def _forgive_stall(self, stall_ns: int) -> None:
        """If this process was stopped, the others' silence is ours: their leases start where they stood."""
        if stall_ns > control.STALL_NS:
            self._heard_ns += stall_ns
            self._doubt_until_ns += stall_ns

    def _expire(self, now_ns: int) -> None:
        if self._welcomed and now_ns > self._doubt_until_ns:  # without a registry nobody is removed
            for node in self.nodes.keys() - self._named.keys():
                self._drop(node)

    def _drop(self, node: int) -> None:
        if node in self.nodes:
            self.nodes = {other: record for other, record in self.nodes.items() if other != node}
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
