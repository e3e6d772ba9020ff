"""The registry: who is there, kept by leases.

A node sends `Hello` with its record, and a `Heartbeat` every quarter of a second. The registry answers the
first with `Welcome` (and, for a snapshot, every record as `Changed`), the second with `Alive`, and tells all
others `Changed` and `Gone`, numbered one by one. A node that sees a number missing, another epoch, or that
the registry has not its newest record, says `Hello` again. So nothing needs an acknowledgement, and a
registry that was killed is whole again after one heartbeat of each node.

A node whose process on this host lives is given more time than a lease, so that a long call in C, which stops
its heartbeats, cuts no stream. That a process of this host has ended the kernel tells at once (a pidfd), else
its lock after one lease. Only the process, or the CURVE key, that a node came with can change its record.

A registry that vanishes takes nobody with it: nodes keep what they know, and drop what a new registry has not
confirmed within one lease.
"""

from __future__ import annotations

import argparse
import contextlib
import logging
import os
import secrets
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import zmq

from cortex import control, host, records
from cortex.codec import MalformedMessage
from cortex.security import Authenticator, Keys, check_address, keeps_keys, load_keys
from cortex.wire import control_frame, parse_control

logger = logging.getLogger(__name__)

STALLED_S = 10.0
"""How long a silent node is kept if its process on this host lives: it may be stopped or very busy [s]."""
LINGER_S = 2.0
"""How long an embedded registry outlives its last node [s]."""

_POLL_MS = 100
_FRAMES_PER_TURN = 1000
_LOGGED_MAX = 256
_LOG_BYTES_MAX = 1 << 20
_DETACH = "import os, sys\nif os.fork():\n    os._exit(0)\nos.execv(sys.argv[1], sys.argv[1:])"


class RegistryRunning(RuntimeError):
    """Another process serves this domain."""


Route = tuple["zmq.Socket[Any]", bytes]


@dataclass(eq=False, slots=True)
class _Entry:
    node: int
    revision: int
    name: str
    frame: bytes
    route: Route
    seen_ns: int
    sender: str
    """Whose node it is; see `sender_of`."""
    process: int


class Registry:
    """The registry of one domain: makes its sockets, serves until `stop`, and leaves nothing behind.

    Args:
        domain: The domain.
        listen: A tcp address besides the unix socket, e.g. "tcp://0.0.0.0:7460"; port 0 takes a free one.
        keys: For CURVE on that address.
        insecure: Allow plain tcp beyond this host.
        linger_s: End this long after the last node left [s]; None serves for ever.
        lock: The domain's lock, if the process that started us took it already.
        nodes_max: Most nodes; others are refused.
        record_bytes_max: Largest record; larger ones are refused.
        stalled_s: How long a node may be silent while its process on this host lives [s].

    Raises:
        RegistryRunning: If another registry serves the domain.
    """

    def __init__(
        self,
        domain: int,
        *,
        listen: str | None = None,
        keys: Keys | None = None,
        insecure: bool = False,
        linger_s: float | None = None,
        lock: host.FileLock | None = None,
        nodes_max: int = control.NODES_MAX,
        record_bytes_max: int = control.RECORD_BYTES_MAX,
        stalled_s: float = STALLED_S,
    ):
        if listen is not None:
            if not listen.startswith("tcp://"):
                raise ValueError(f"listen must be a tcp:// address, got {listen!r}")
            check_address(listen, keys=keys, insecure=insecure)
        self.epoch = secrets.randbits(64) or 1
        self.version = 0
        self.rejected = 0
        self.refused = 0
        """Records that were over a limit."""
        self.address: str | None = None
        """The tcp address that it listens on, with its port."""
        self._directory = host.runtime_dir(domain)
        self._limits = (nodes_max, record_bytes_max)
        self._stalled_ns = int(stalled_s * 1e9)
        self._linger_ns = None if linger_s is None else int(linger_s * 1e9)
        self._entries: dict[int, _Entry] = {}
        self._routes: dict[Route, int] = {}
        self._bytes = 0
        self._logged: set[object] = set()
        self._sequence = 0
        self._sender = ""
        self._poller = zmq.Poller()
        self._stopping = False
        path = self._directory / host.REGISTRY_LOCK
        taken = lock or host.FileLock.acquire(path)
        if taken is None:
            raise RegistryRunning(_who_serves(path, domain))
        self._lock = taken
        os.ftruncate(taken.descriptor, 0)
        os.pwrite(taken.descriptor, f"{os.getpid()}\n".encode(), 0)
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._authenticator: Authenticator | None = None
        self._sockets: list[zmq.Socket[Any]] = []
        self._handlers: dict[type, Callable[[Any, int, Route, int], None]] = {
            records.Hello: self._on_hello,
            records.Heartbeat: self._on_heartbeat,
            records.Leave: self._on_leave,
        }
        self._types = control.control_types(*self._handlers)
        try:
            self._bind(listen, keys)
        except BaseException:
            self.close()
            raise

    def _bind(self, listen: str | None, keys: Keys | None) -> None:
        local = control.make_control_socket(self._context, zmq.ROUTER, tcp=False)
        self._sockets.append(local)
        local.bind(f"ipc://{self._directory / host.REGISTRY_SOCKET}")
        if listen is not None:
            remote = control.make_control_socket(self._context, zmq.ROUTER, tcp=True)
            self._sockets.append(remote)
            remote.ipv6 = "[" in listen  # else the address would read [::ffff:127.0.0.1]
            if keys is not None:
                self._authenticator = Authenticator.acquire(self._context)
                self._authenticator.secure(remote, keys)
            remote.bind(listen)
            self.address = str(remote.getsockopt_string(zmq.LAST_ENDPOINT))

    @property
    def node_count(self) -> int:
        """How many nodes hold a lease."""
        return len(self._entries)

    def stop(self) -> None:
        """Make `run` return soon. May be called from any thread and from a signal handler."""
        self._stopping = True

    def run(self) -> None:
        """Serve until `stop`, or until the last node has been gone for `linger_s`."""
        host.sweep(self._directory)
        for socket in self._sockets:
            self._poller.register(socket, zmq.POLLIN)
        turn_ns = busy_ns = time.monotonic_ns()
        while not self._stopping:
            ready = dict(self._poller.poll(_POLL_MS))
            before_ns, turn_ns = turn_ns, time.monotonic_ns()
            if turn_ns - before_ns > control.STALL_NS:
                for entry in self._entries.values():
                    entry.seen_ns += turn_ns - before_ns
                busy_ns += turn_ns - before_ns
            if not self._lock.intact:
                logger.warning("%s was removed: another registry takes over", self._lock.path)
                break
            for socket in self._sockets:
                if socket in ready:
                    self._drain(socket, turn_ns)
            self._expire(turn_ns, ready)
            if self._entries:
                busy_ns = turn_ns
            elif self._linger_ns is not None and turn_ns - busy_ns > self._linger_ns:
                break
        logger.info("registry ends: %d frames rejected, %d records refused", self.rejected, self.refused)

    def close(self) -> None:
        """Release everything. A registry that starts afterwards finds nothing of this one."""
        for entry in list(self._entries.values()):
            self._forget(entry)
        for socket in self._sockets:
            socket.close()
        if self._authenticator is not None:
            self._authenticator.release()
        self._context.term()  # from here on nothing of ours can touch the path, which the next registry makes
        if self._lock.intact:
            with contextlib.suppress(FileNotFoundError):
                os.unlink(self._directory / host.REGISTRY_SOCKET)
        self._lock.close()

    def _drain(self, socket: zmq.Socket[Any], now_ns: int) -> None:
        for _ in range(_FRAMES_PER_TURN):
            try:
                identity, *frames = socket.recv_multipart(zmq.NOBLOCK, copy=False)
            except zmq.Again:
                return
            route = (socket, identity.bytes)
            try:
                if len(frames) != 1:
                    raise MalformedMessage(f"{len(frames)} frames where one was expected")
                message, header = parse_control(frames[0].bytes, self._types)
                self._sequence, self._sender = header.sequence, control.sender_of(frames[0])
                self._handlers[type(message)](message, len(frames[0]), route, now_ns)
            except MalformedMessage as error:
                self.rejected += 1
                self._log_once(route, "rejected a frame: %s", error)

    def _log_once(self, key: object, text: str, *arguments: object) -> None:
        if key not in self._logged and len(self._logged) < _LOGGED_MAX:
            self._logged.add(key)
            logger.warning(text, *arguments)

    def _on_hello(self, hello: records.Hello, size: int, route: Route, now_ns: int) -> None:
        record = hello.record
        records.check_record(record)
        entry = self._entries.get(record.node)
        reason = self._reason_to_refuse(record, size, route, entry)
        if reason:
            self.refused += 1
            self._log_once((route, reason), "refused node %s: %s", record.name[:200], reason)
            self._reply(route, records.Refused(record.node, reason))
            return
        # What comes on one connection is in order; what comes on another may be older than what we have.
        is_next = entry is not None and entry.route == route and record.revision != entry.revision
        if entry is None or record.revision > entry.revision or is_next:
            self._store(record, route, now_ns, entry)
        else:
            self._routes.pop(entry.route, None)  # it has connected anew
            entry.route, entry.seen_ns = route, now_ns
            self._routes[route] = record.node
        entries = self._entries.values()
        nodes, revisions = [e.node for e in entries], [e.revision for e in entries]
        self._reply(route, records.Welcome(self.epoch, self.version, nodes, revisions))
        if hello.snapshot:
            for other in entries:
                if other.node != record.node:
                    self._send(route, other.frame)

    def _reason_to_refuse(
        self, record: records.NodeRecord, size: int, route: Route, entry: _Entry | None
    ) -> str:
        nodes_max, record_bytes_max = self._limits
        if size > record_bytes_max:
            return f"its record has {size} bytes, {record_bytes_max} are allowed"
        if self._routes.get(route, record.node) != record.node:
            return "another node speaks on this connection"
        if entry is not None and entry.sender != self._sender:
            return "it is the node of another process or key"
        if not keeps_keys(record, self._sender):
            return "its addresses have another key than it came with"
        if entry is None and len(self._entries) >= nodes_max:
            return f"there are {nodes_max} nodes already"
        if self._bytes - (len(entry.frame) if entry else 0) + size > control.TOTAL_BYTES_MAX:
            return f"all records together would exceed {control.TOTAL_BYTES_MAX} bytes"
        return ""

    def _store(self, record: records.NodeRecord, route: Route, now_ns: int, old: _Entry | None) -> None:
        process = control.watch_process(self._sender)
        if process >= 0:
            self._poller.register(process, zmq.POLLIN)
        if old is not None:
            self._forget(old)
        else:
            logger.info("node %s (%016x) has come", record.name[:200], record.node)
        self.version += 1
        frame = control_frame(records.Changed(self.version, record))
        name = record.name[:200]
        self._entries[record.node] = _Entry(
            record.node, record.revision, name, frame, route, now_ns, self._sender, process
        )
        self._routes[route] = record.node
        self._bytes += len(frame)
        self._tell(frame, except_node=record.node)

    def _on_heartbeat(self, heartbeat: records.Heartbeat, size: int, route: Route, now_ns: int) -> None:
        entry = self._entries.get(heartbeat.node)
        held = 0
        if entry is not None and entry.route == route:
            entry.seen_ns, held = now_ns, entry.revision
        alive = records.Alive(self.epoch, self.version, held)
        self._send(route, control_frame(alive, self._sequence, told_ns=time.time_ns()))

    def _on_leave(self, leave: records.Leave, size: int, route: Route, now_ns: int) -> None:
        entry = self._entries.get(leave.node)
        if entry is not None and entry.route == route:
            self._remove(entry, "left")

    def _expire(self, now_ns: int, ready: Mapping[Any, int]) -> None:
        ended = [entry for entry in self._entries.values() if entry.process in ready]
        expired = [
            entry
            for entry in self._entries.values()
            if entry.process not in ready
            and (silent_ns := now_ns - entry.seen_ns) > control.LEASE_NS
            and (silent_ns > self._stalled_ns or not host.node_lives(self._directory, entry.node))
        ]
        for entry in ended:
            self._remove(entry, "its process has ended")
        for entry in expired:
            self._remove(entry, "its lease has run out")
        if ended or expired:
            host.sweep(self._directory)

    def _remove(self, entry: _Entry, reason: str) -> None:
        self._forget(entry)
        self.version += 1
        logger.info("node %s (%016x) is gone: %s", entry.name, entry.node, reason)
        self._tell(control_frame(records.Gone(self.version, entry.node, reason)), except_node=entry.node)

    def _forget(self, entry: _Entry) -> None:
        if entry.process >= 0:
            self._poller.unregister(entry.process)
            os.close(entry.process)
        del self._entries[entry.node]
        self._routes.pop(entry.route, None)
        self._bytes -= len(entry.frame)

    def _tell(self, frame: bytes, *, except_node: int) -> None:
        for entry in self._entries.values():
            if entry.node != except_node:
                self._send(entry.route, frame)

    def _reply(self, route: Route, message: Any) -> None:
        self._send(route, control_frame(message, self._sequence))

    def _send(self, route: Route, frame: bytes) -> None:
        socket, identity = route
        # A ROUTER drops what a full queue or a closed connection cannot take; the numbers tell the node.
        socket.send_multipart((identity, frame), zmq.NOBLOCK)


def _who_serves(lock: Path, domain: int) -> str:
    process = lock.read_text(encoding="ascii", errors="replace").strip()
    if not process:
        return f"a registry that is just being started serves domain {domain}: try again"
    return f"another registry (process {process}) serves domain {domain}; to replace it, `kill {process}`"


def ensure_registry(domain: int, *, linger_s: float = LINGER_S) -> bool:
    """Start a registry in a process of its own, unless one runs or is being started; True if we started it.

    However many processes call this at once, one registry starts: the lock is taken here and handed over.
    The new process has its own session, no descriptor of ours but the lock, and writes to `registry.log`. It
    is not our child, so nobody has to wait for it.

    Raises:
        OSError: If no process can be started.
    """
    directory = host.runtime_dir(domain)
    lock = host.FileLock.acquire(directory / host.REGISTRY_LOCK)
    if lock is None:
        return False
    try:
        arguments = ["-m", "cortex.discovery", "--domain", str(domain), "--embedded"]
        arguments += ["--linger", str(linger_s), "--lock", str(lock.descriptor)]
        _spawn([sys.executable, *arguments], lock.descriptor, directory / host.REGISTRY_LOG)
    finally:
        lock.close()
    return True


def _spawn(command: list[str], descriptor: int, log: Path) -> None:
    environment = dict(os.environ)
    root = str(Path(__file__).resolve().parents[1])
    environment["PYTHONPATH"] = os.pathsep.join(filter(None, (root, environment.get("PYTHONPATH"))))
    environment["OPENBLAS_NUM_THREADS"] = "1"  # numpy would start threads that a registry has no use for
    flags = os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_NOFOLLOW | os.O_CLOEXEC
    # `Popen` waits until nobody else has the end of a pipe; a process forked meanwhile would keep it.
    with host.FileLock.no_fork(), open(os.open(log, flags, 0o600), "ab") as output:
        if output.tell() > _LOG_BYTES_MAX:
            output.truncate(0)
        detacher = subprocess.Popen(
            [sys.executable, "-I", "-S", "-c", _DETACH, *command],
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=output,
            cwd="/",
            env=environment,
            pass_fds=(descriptor,),
            start_new_session=True,
        )
    try:
        detacher.wait(timeout=10.0)
    except subprocess.TimeoutExpired as error:
        detacher.kill()
        detacher.wait()
        raise OSError(f"{sys.executable} did not start within 10 s") from error


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a registry; the exit code is 1 if another one serves the domain."""
    parser = argparse.ArgumentParser(prog="cortex discovery", description="Run the registry of a domain.")
    add = parser.add_argument
    add("--domain", type=int, help="0 to 232; default: CORTEX_DOMAIN, else 0")
    add("--listen", help="also serve other hosts, e.g. tcp://0.0.0.0:7460")
    add("--keys", type=Path, help="key directory, for CURVE on tcp")
    add("--insecure", action="store_true", help="allow plain tcp beyond this host")
    add("--embedded", action="store_true", help="end after the last node has left")
    add("--linger", type=float, default=LINGER_S, help="how long after, in seconds")
    add("--lock", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    level = logging.WARNING if options.embedded else logging.INFO
    handler = logging.StreamHandler()
    dated = logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s")
    # Until it serves, somebody waits for it at a terminal; what it says later is a log.
    handler.setFormatter(dated if options.embedded else logging.Formatter("cortex discovery: %(message)s"))
    logging.basicConfig(level=level, handlers=[handler])
    try:
        domain = host.domain_id(options.domain)
        lock = None
        if options.lock is not None:
            lock = host.FileLock.adopt(host.runtime_dir(domain) / host.REGISTRY_LOCK, options.lock)
        registry = Registry(
            domain,
            listen=options.listen,
            keys=load_keys(options.keys) if options.keys else None,
            insecure=options.insecure,
            linger_s=options.linger if options.embedded else None,
            lock=lock,
        )
    except (OSError, ValueError, RegistryRunning) as error:
        logger.error("%s", str(error).replace("insecure=True", "--insecure"))
        return 1
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: registry.stop())
    reach = f"this host and {registry.address}" if registry.address else "this host only"
    logger.info("the registry of domain %d serves %s", domain, reach)
    handler.setFormatter(dated)
    try:
        registry.run()
    finally:
        registry.close()
    return 0
