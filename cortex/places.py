"""The addresses of nodes: those that a node offers, and which of another's addresses to use."""

from __future__ import annotations

import os
import socket as sockets
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import zmq

from cortex.broadcast import Listener, make_listener
from cortex.context import context, new_socket
from cortex.host import NodeFiles
from cortex.pub_socket import PubSockets, open_pub_socket
from cortex.records import Endpoint, NodeRecord
from cortex.security import Authenticator, Keys, apply_client, check_address, load_keys

Secure = Callable[[zmq.Socket[bytes]], None]


NETWORK_VARIABLES = ("CORTEX_REGISTRY", "CORTEX_LISTEN", "CORTEX_KEYS")
"""What the environment may say of other hosts."""


def network(
    registry: str | None, listen: str | None, keys: Keys | None
) -> tuple[str, str | None, Keys | None]:
    """What was given, else what CORTEX_REGISTRY, CORTEX_LISTEN and CORTEX_KEYS (a key directory) say."""
    directory = os.environ.get("CORTEX_KEYS")
    return (
        registry or os.environ.get("CORTEX_REGISTRY") or "auto",
        (os.environ.get("CORTEX_LISTEN") if listen is None else listen) or None,
        load_keys(Path(directory).expanduser()) if keys is None and directory else keys,
    )


class Places:
    """The sockets by which a node is reached: two XPUB and a ROUTER here, and on tcp if it listens."""

    def __init__(
        self,
        domain: int,
        node: int,
        pub_sockets: PubSockets,
        listen: str | None,
        *,
        keys: Keys | None,
        insecure: bool,
    ) -> None:
        self.routers: list[zmq.Socket[bytes]] = []
        self.endpoints: list[Endpoint] = []
        self._authenticator: Authenticator | None = None
        self._listener: Listener | None = None
        if listen is not None:
            check_address(f"tcp://{_bracket(listen)}:0", keys=keys, insecure=insecure)
        self._files = NodeFiles(domain, node)
        try:
            self._open_local(node, pub_sockets)
            if listen is not None:
                self._open_tcp(pub_sockets, listen, keys)
        except BaseException:
            pub_sockets.close()
            self.close()
            raise

    def _open_local(self, node: int, pub_sockets: PubSockets) -> None:
        path = self._files.endpoint
        listener = self._listener = make_listener(self._files.path("ring"))
        for role, strict in (("lossy", False), ("strict", True)):
            pub_sockets.add(open_pub_socket(path(role), strict=strict, local=True, listener=listener))
        self._router(tcp=False).bind(path("control"))
        self.endpoints.append(Endpoint("ipc", path("lossy"), path("strict"), path("control"), ""))

    def _open_tcp(self, pub_sockets: PubSockets, listen: str, keys: Keys | None) -> None:
        secure: Secure | None = None
        if keys is not None:
            self._authenticator = Authenticator.acquire(context())
            secure = partial(self._authenticator.secure, keys=keys)
        any_port = f"tcp://{_bracket(listen)}:*"
        opened = []
        for strict in (False, True):
            pub_socket = open_pub_socket(any_port, strict=strict, local=False, secure=secure)
            pub_sockets.add(pub_socket)
            opened.append(pub_socket.socket)
        router = self._router(tcp=True)
        if secure is not None:
            secure(router)
        router.bind(any_port)
        seen = listen if listen not in ("0.0.0.0", "::", "*") else _outward_address()
        bound = (socket.getsockopt_string(zmq.LAST_ENDPOINT) for socket in (*opened, router))
        at = [f"tcp://{_bracket(seen)}:{address.rpartition(':')[2]}" for address in bound]
        self.endpoints.append(Endpoint("tcp", at[0], at[1], at[2], "" if keys is None else keys.public))

    def _router(self, *, tcp: bool) -> zmq.Socket[bytes]:
        router = new_socket(zmq.ROUTER, tcp=tcp)
        router.setsockopt(zmq.ROUTER_MANDATORY, 1)
        self.routers.append(router)
        return router

    def close(self) -> None:
        """Close the ROUTERs and remove the files."""
        for router in self.routers:
            router.close()
        if self._authenticator is not None:
            self._authenticator.release()
            self._authenticator = None
        if self._listener is not None:
            self._listener.close()
            self._listener = None
        self._files.close()


class Reach(NamedTuple):
    """How to reach a node from here."""

    node: int
    endpoint: Endpoint
    local: bool
    secure: Secure | None

    def open(self) -> zmq.Socket[bytes]:
        """A DEALER to its control address."""
        socket = new_socket(zmq.DEALER, tcp=not self.local)
        socket.linger = 0
        try:
            if self.secure is not None:
                self.secure(socket)
            socket.connect(self.endpoint.control)
        except BaseException:
            socket.close(0)
            raise
        return socket


def reach(node: NodeRecord, host: str, keys: Keys | None, *, insecure: bool = False) -> Reach | None:
    """Choose how to reach a node: ipc on this host, else tcp.

    Args:
        node: The record that the node has sent; its addresses are not trusted.
        host: This host, as records name it.
        keys: For CURVE on tcp. With keys nothing beyond this host is spoken to in plain.
        insecure: Without keys, allow plain tcp beyond this host.

    Returns:
        None if it offers no address that this host can use, or may use.
    """
    for endpoint in node.endpoints:
        if endpoint.transport == "ipc" and node.host == host:
            return Reach(node.node, endpoint, True, None)
    for endpoint in node.endpoints:
        if endpoint.transport == "tcp":
            if not endpoint.server_key:
                if _may_be_plain(endpoint, insecure=insecure and keys is None):
                    return Reach(node.node, endpoint, False, None)
            elif keys is not None:
                secure = partial(apply_client, keys=keys, server_key=endpoint.server_key)
                return Reach(node.node, endpoint, False, secure)
    return None


def _may_be_plain(endpoint: Endpoint, *, insecure: bool) -> bool:
    try:
        for address in (endpoint.lossy, endpoint.strict, endpoint.control):
            check_address(address, keys=None, insecure=insecure)
    except ValueError:
        return False
    return True


def _bracket(host: str) -> str:
    return f"[{host}]" if ":" in host else host


def _outward_address() -> str:
    """This host's address on the network: that of the interface packets would leave by. Sends nothing."""
    with sockets.socket(sockets.AF_INET, sockets.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))
            return str(probe.getsockname()[0])
        except OSError:
            return "127.0.0.1"
