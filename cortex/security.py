"""CURVE keys, who may connect over tcp, and the refusal of plain tcp beyond this host.

A key directory holds `key.secret` (only its owner can read it), `key.public`, and `authorized_keys`: the
public keys of all that we talk to, one a line, each optionally followed by the host names where it answers.
Lines that start with `#` are comments. Our own key is always authorised, so hosts may simply share one pair.
"""

from __future__ import annotations

import atexit
import contextlib
import ipaddress
import logging
import os
import stat
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import zmq
from zmq.auth.thread import ThreadAuthenticator

if TYPE_CHECKING:
    from cortex.records import NodeRecord

logger = logging.getLogger(__name__)

SECRET_FILE, PUBLIC_FILE, AUTHORIZED_FILE = "key.secret", "key.public", "authorized_keys"

_KEY_LENGTH = 40
_Z85 = frozenset("0123456789abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ.-:+=^!/*?&<>()[]{}@%$#")
_LOGGED_MAX = 256


@dataclass(frozen=True)
class Keys:
    """A CURVE key pair, and the public keys of those we talk to (ours among them), all in Z85."""

    public: str
    secret: str = field(repr=False)
    authorized: frozenset[str]
    directory: Path | None = None
    """Where they were read from. `authorized_keys` is read anew at each handshake: a key can be revoked."""

    def __post_init__(self) -> None:
        for key in (self.public, self.secret, *self.authorized):
            if not is_key(key):
                raise ValueError("a key must be 40 characters of Z85")  # never name it: it may be the secret
        if zmq.curve_public(self.secret.encode()).decode() != self.public:
            raise ValueError("the secret key does not belong to the public key")
        object.__setattr__(self, "authorized", self.authorized | {self.public})

    def allows(self, key: str) -> bool:
        """Tell whether a public key is authorised now."""
        if self.directory is None or key == self.public:
            return key in self.authorized
        try:
            return key in _read_authorized(self.directory)
        except (OSError, ValueError) as error:
            logger.error("nobody can connect: %s", error)
            return False

    def key_of_host(self, host: str) -> str:
        """Return the public key of a host named in `authorized_keys`, else our own."""
        known = _read_authorized(self.directory) if self.directory is not None else {}
        return next((key for key, hosts in known.items() if host in hosts), self.public)


def is_key(text: str) -> bool:
    """Tell whether a text is a key in Z85."""
    return len(text) == _KEY_LENGTH and _Z85.issuperset(text)


def default_directory() -> Path:
    """Return where keys lie unless told otherwise: `cortex` in `XDG_CONFIG_HOME` or `~/.config`."""
    return Path(os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config") / "cortex"


def new_keys(directory: Path) -> Keys:
    """Make a key pair: `key.secret` (mode 0600), `key.public` and an `authorized_keys` with a comment.

    Raises:
        FileExistsError: If there is a key already; it is left as it is.
    """
    directory.mkdir(mode=0o700, parents=True, exist_ok=True)
    for name in (SECRET_FILE, PUBLIC_FILE):
        if (directory / name).exists():
            raise FileExistsError(f"{directory / name} exists; choose another directory or remove it")
    public, secret = (key.decode() for key in zmq.curve_keypair())
    _write_new(directory / SECRET_FILE, secret + "\n", 0o600)
    _write_new(directory / PUBLIC_FILE, public + "\n", 0o644)
    with contextlib.suppress(FileExistsError):
        text = "# public keys that may connect, one a line: KEY [host name ...]\n"
        _write_new(directory / AUTHORIZED_FILE, text, 0o644)
    return load_keys(directory)


def load_keys(directory: Path) -> Keys:
    """Read a key directory.

    Raises:
        FileNotFoundError: If a key is missing.
        PermissionError: If others may read the secret key or change who is authorised.
        ValueError: If a file does not hold what it should.
    """
    directory = Path(directory)
    secret = _read_private(directory / SECRET_FILE, forbidden=0o077).strip()
    public = (directory / PUBLIC_FILE).read_text(encoding="ascii").strip()
    authorized = frozenset(_read_authorized(directory))
    try:
        return Keys(public, secret, authorized, directory)
    except ValueError as error:
        raise ValueError(f"{directory}: {error}") from error


def _write_new(path: Path, text: str, mode: int) -> None:
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, mode)
    with os.fdopen(descriptor, "w", encoding="ascii") as file:
        file.write(text)


def _read_private(path: Path, *, forbidden: int) -> str:
    with open(path, encoding="utf-8") as file:
        status = os.fstat(file.fileno())
        if status.st_uid not in (os.getuid(), 0):
            raise PermissionError(f"{path} belongs to user {status.st_uid}, not to us ({os.getuid()})")
        if status.st_mode & forbidden:
            mode, allowed = stat.S_IMODE(status.st_mode), 0o666 & ~forbidden
            raise PermissionError(f"{path} has mode {mode:04o}: chmod {allowed:04o} {path}")
        return file.read()


def _read_authorized(directory: Path) -> dict[str, tuple[str, ...]]:
    path = directory / AUTHORIZED_FILE
    if not path.exists():
        return {}
    known: dict[str, tuple[str, ...]] = {}
    for number, line in enumerate(_read_private(path, forbidden=0o022).splitlines(), start=1):
        words = line.split()
        # A key may begin with "#", but it has 40 characters; a key that is commented out has 41.
        if words and is_key(words[0]):
            known[words[0]] = tuple(words[1:])
        elif words and not line.lstrip().startswith("#"):
            raise ValueError(f"{path}:{number} must be a key of 40 characters or a comment, got {words[0]!r}")
    return known


def keeps_keys(record: NodeRecord, sender: str) -> bool:
    """Tell whether who has a CURVE key announces addresses with that key only."""
    return not is_key(sender) or all(e.server_key in ("", sender) for e in record.endpoints)


def check_address(address: str, *, keys: Keys | None, insecure: bool) -> None:
    """Refuse plain tcp beyond this host.

    Raises:
        ValueError: If the address is tcp, not of the loopback, there are no keys, and `insecure` is not set.
    """
    if not address.startswith("tcp://") or keys is not None or insecure or _is_loopback(host_of(address)):
        return
    raise ValueError(
        f"plain tcp on {address} would be open to everybody on the network: give keys (`cortex keys new`), "
        "use 127.0.0.1, or say insecure=True"
    )


def host_of(address: str) -> str:
    """Return the host of a ZeroMQ tcp address, without the brackets of IPv6."""
    rest = address.removeprefix("tcp://").rpartition(";")[2]  # a source address may stand before the ";"
    return rest.rpartition(":")[0].strip("[]")


def _is_loopback(host: str) -> bool:
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.partition("%")[0]).is_loopback
    except ValueError:
        return False  # a name or an interface: it may lead anywhere


def apply_client(socket: zmq.Socket[Any], keys: Keys, server_key: str) -> None:
    """Make a socket, before it connects, speak CURVE to the server that has `server_key`.

    Raises:
        PermissionError: If that key is not authorised.
    """
    if not keys.allows(server_key):
        raise PermissionError(f"the server key {server_key!r} is not in {AUTHORIZED_FILE}")
    socket.curve_publickey = keys.public.encode()
    socket.curve_secretkey = keys.secret.encode()
    socket.curve_serverkey = server_key.encode()


class Authenticator(ThreadAuthenticator):
    """The one place of a context where CURVE clients are let in or refused, on a thread of its own.

    `acquire` and `release` count users; after the last one sockets that are bound refuse new clients.
    """

    _running: ClassVar[dict[int, Authenticator]] = {}
    _lock: ClassVar[threading.Lock] = threading.Lock()

    def __init__(self, context: zmq.Context[Any]):
        super().__init__(context, log=logger)
        self._keys: dict[str, Keys] = {}
        self._logged: set[bytes] = set()
        self._users = 0
        self._pid = os.getpid()

    @classmethod
    def acquire(cls, context: zmq.Context[Any]) -> Authenticator:
        """Return the context's authenticator, started if need be."""
        with cls._lock:
            found = cls._running.get(context.underlying)
            if found is None or not found.is_alive():
                found = cls._running[context.underlying] = cls(context)
                found.start()
                atexit.register(found.stop)
            found._users += 1
            return found

    def release(self) -> None:
        """Give it back, before its context is terminated."""
        with self._lock:
            self._users -= 1
            if self._users == 0:
                self._running.pop(self.context.underlying, None)
                atexit.unregister(self.stop)
                self.stop()

    def start(self) -> None:
        """Start, once the reaper of libzmq has let go of the address of ZAP after a release."""
        deadline_s = time.monotonic() + 2.0
        while True:
            try:
                return super().start()
            except zmq.ZMQError as error:
                if error.errno != zmq.EADDRINUSE or time.monotonic() > deadline_s:
                    raise
                super().stop()
                time.sleep(0.001)

    def stop(self) -> None:
        """Stop; a forked child leaves alone what is its parent's."""
        if self._pid == os.getpid():
            super().stop()

    def secure(self, socket: zmq.Socket[Any], keys: Keys) -> None:
        """Make a socket of the context, before it binds, accept authorised CURVE clients only."""
        with self._lock:
            known = next((domain for domain, each in self._keys.items() if each == keys), "")
            domain = known or f"cortex.{len(self._keys)}"
            self._keys[domain] = keys
            self.configure_curve_callback(domain, self)
        socket.curve_secretkey = keys.secret.encode()
        socket.curve_publickey = keys.public.encode()
        socket.curve_server = True
        socket.zap_domain = domain.encode()
        # Without this, libzmq lets everybody in when no authenticator answers.
        socket.setsockopt(zmq.ZAP_ENFORCE_DOMAIN, 1)

    def callback(self, domain: str, key: bytes) -> bool:
        """Decide about a client's key; called by the thread."""
        allowed = self._keys[domain].allows(key.decode())
        if not allowed and key not in self._logged and len(self._logged) < _LOGGED_MAX:
            self._logged.add(key)
            logger.warning("refused key %s: it is not authorised", key.decode())
        return allowed
