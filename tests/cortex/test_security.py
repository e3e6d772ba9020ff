"""Keys and their files, who is let in over CURVE, and plain tcp."""

from __future__ import annotations

import contextlib
import logging
import time

import pytest
import zmq
from processes import SOON_S

from cortex.security import (
    AUTHORIZED_FILE,
    PUBLIC_FILE,
    SECRET_FILE,
    Authenticator,
    Keys,
    apply_client,
    apply_server,
    check_address,
    load_keys,
    new_keys,
)

NOTHING_MS = 400
"""How long to wait to be sure that nothing comes: a handshake on this host takes a few milliseconds."""


@pytest.fixture
def context():
    with zmq.Context() as made:
        made.linger = 0
        yield made


@pytest.fixture
def authenticator(context):
    acquired = Authenticator.acquire(context)
    yield acquired
    acquired.release()


def pair(*authorized):
    public, secret = (key.decode() for key in zmq.curve_keypair())
    return Keys(public, secret, frozenset(authorized))


def serve(context, keys):
    """A CURVE publisher on a free port."""
    server = context.socket(zmq.XPUB)
    apply_server(server, keys)
    port = server.bind_to_random_port("tcp://127.0.0.1")
    return server, f"tcp://127.0.0.1:{port}"


def subscribe(context, address, prepare):
    client = context.socket(zmq.SUB)
    prepare(client)
    client.subscribe(b"")
    client.connect(address)
    return client


def gets_something(server, client, timeout_ms):
    """Publish until the subscriber has something, or the time is over."""
    deadline = time.monotonic() + timeout_ms / 1e3
    while time.monotonic() < deadline:
        server.send(b"secret")
        if client.poll(20):
            return client.recv() == b"secret"
    return False


def test_an_authorised_client_gets_what_is_published(context, authenticator):
    client_keys = pair()
    server_keys = pair(client_keys.public)
    client_keys = Keys(client_keys.public, client_keys.secret, frozenset({server_keys.public}))
    server, address = serve(context, server_keys)
    client = subscribe(context, address, lambda s: apply_client(s, client_keys, server_keys.public))
    assert gets_something(server, client, 1e3 * SOON_S)
    server.close()
    client.close()


def test_one_key_pair_for_all_is_enough(context, authenticator):
    keys = pair()
    server, address = serve(context, keys)
    client = subscribe(context, address, lambda s: apply_client(s, keys, keys.public))
    assert gets_something(server, client, 1e3 * SOON_S)
    server.close()
    client.close()


def _unauthorised(socket, server_keys):
    stranger = pair(server_keys.public)
    apply_client(socket, stranger, server_keys.public)


def _wrong_server_key(socket, server_keys):
    other = pair()
    keys = Keys(server_keys.public, server_keys.secret, frozenset({other.public}))
    apply_client(socket, keys, other.public)


def _without_curve(socket, server_keys):
    pass


@pytest.mark.parametrize("prepare", [_unauthorised, _wrong_server_key, _without_curve])
def test_others_get_nothing(context, authenticator, prepare):
    keys = pair()
    server, address = serve(context, keys)
    client = subscribe(context, address, lambda socket: prepare(socket, keys))
    friend = subscribe(context, address, lambda socket: apply_client(socket, keys, keys.public))
    assert gets_something(server, friend, 1e3 * SOON_S)  # so that the server is known to work
    assert not gets_something(server, client, NOTHING_MS)
    for socket in (server, client, friend):
        socket.close()


def test_a_client_without_rights_cannot_send_either(context, authenticator):
    keys = pair()
    server = context.socket(zmq.ROUTER)
    apply_server(server, keys)
    port = server.bind_to_random_port("tcp://127.0.0.1")
    stranger = pair(keys.public)
    client = context.socket(zmq.DEALER)
    apply_client(client, stranger, keys.public)
    client.connect(f"tcp://127.0.0.1:{port}")
    with contextlib.suppress(zmq.Again):  # it has nowhere to send to, once it was refused
        client.send(b"let me in", zmq.DONTWAIT)
    assert not server.poll(NOTHING_MS)
    server.close()
    client.close()


def test_without_an_authenticator_a_server_socket_is_refused(context):
    socket = context.socket(zmq.XPUB)
    with pytest.raises(RuntimeError, match=r"Authenticator\.acquire"):
        apply_server(socket, pair())
    socket.close()


def test_keys_are_private_and_never_overwritten(tmp_path):
    made = new_keys(tmp_path / "keys")
    assert (tmp_path / "keys" / SECRET_FILE).stat().st_mode & 0o777 == 0o600
    assert (tmp_path / "keys").stat().st_mode & 0o777 == 0o700
    assert load_keys(tmp_path / "keys") == made
    with pytest.raises(FileExistsError, match=SECRET_FILE):
        new_keys(tmp_path / "keys")
    assert load_keys(tmp_path / "keys") == made
    assert made.secret not in repr(made)


@pytest.mark.parametrize("mode", [0o640, 0o604, 0o660])
def test_a_secret_that_others_can_read_is_refused(tmp_path, mode):
    new_keys(tmp_path)
    (tmp_path / SECRET_FILE).chmod(mode)
    with pytest.raises(PermissionError, match=f"mode {mode:04o}: chmod 0600"):
        load_keys(tmp_path)


def test_an_allow_list_that_others_can_write_is_refused(tmp_path):
    new_keys(tmp_path)
    (tmp_path / AUTHORIZED_FILE).chmod(0o666)
    with pytest.raises(PermissionError, match="chmod 0644"):
        load_keys(tmp_path)


def test_the_allow_list_has_keys_hosts_and_comments(tmp_path):
    first, second = pair().public, "#" + pair().public[1:]
    mine = new_keys(tmp_path)
    lines = [f"{first} 10.0.0.2 robot", "", "# a comment", f"#{pair().public}", second]
    (tmp_path / AUTHORIZED_FILE).write_text("\n".join(lines))
    keys = load_keys(tmp_path)
    assert keys.authorized == {mine.public, first, second}
    assert keys.key_of_host("robot") == keys.key_of_host("10.0.0.2") == first
    assert keys.key_of_host("elsewhere") == mine.public


def test_a_broken_allow_list_is_named(tmp_path):
    new_keys(tmp_path)
    (tmp_path / AUTHORIZED_FILE).write_text("# fine\nnonsense here\n")
    with pytest.raises(ValueError, match=r"authorized_keys:2 must be a key.*'nonsense'"):
        load_keys(tmp_path)


def test_keys_that_do_not_belong_together_are_refused(tmp_path):
    new_keys(tmp_path)
    (tmp_path / PUBLIC_FILE).write_text(pair().public)
    with pytest.raises(ValueError, match="does not belong"):
        load_keys(tmp_path)


def test_an_unauthorised_server_is_refused_before_connecting(context):
    socket = context.socket(zmq.SUB)
    with pytest.raises(PermissionError, match=AUTHORIZED_FILE):
        apply_client(socket, pair(), pair().public)
    socket.close()


def test_a_revoked_key_gets_nothing(context, authenticator, tmp_path, caplog):
    guest = pair()
    new_keys(tmp_path)
    (tmp_path / AUTHORIZED_FILE).write_text(guest.public + "\n")
    keys = load_keys(tmp_path)
    guest = Keys(guest.public, guest.secret, frozenset({keys.public}))
    server, address = serve(context, keys)
    client = subscribe(context, address, lambda socket: apply_client(socket, guest, keys.public))
    assert gets_something(server, client, 1e3 * SOON_S)
    client.close()
    (tmp_path / AUTHORIZED_FILE).write_text("# " + guest.public + "\n")
    with caplog.at_level(logging.WARNING, "cortex.security"):
        client = subscribe(context, address, lambda socket: apply_client(socket, guest, keys.public))
        assert not gets_something(server, client, NOTHING_MS)
    assert [r.getMessage() for r in caplog.records if guest.public in r.getMessage()]  # and it is said
    server.close()
    client.close()


def test_an_unreadable_allow_list_lets_nobody_in(tmp_path, caplog):
    guest = pair().public
    new_keys(tmp_path)
    (tmp_path / AUTHORIZED_FILE).write_text(guest)
    keys = load_keys(tmp_path)
    assert keys.allows(guest)
    (tmp_path / AUTHORIZED_FILE).chmod(0o666)
    assert not keys.allows(guest)
    assert "nobody can connect" in caplog.text


@pytest.mark.parametrize(
    "address",
    [
        "tcp://127.0.0.1:5",
        "tcp://127.8.9.1:*",
        "tcp://localhost:5",
        "tcp://[::1]:5",
        "ipc:///tmp/x",
        "inproc://x",
    ],
)
def test_what_stays_on_this_host_needs_no_keys(address):
    check_address(address, keys=None, insecure=False)


@pytest.mark.parametrize(
    "address",
    [
        "tcp://0.0.0.0:5",
        "tcp://*:5",
        "tcp://10.0.0.1:5",
        "tcp://[::]:5",
        "tcp://eth0:5",
        "tcp://localhost.example.org:5",
        "tcp://127.0.0.1.example.org:5",
        "tcp://127.0.0.1:0;10.0.0.1:5",
    ],
)
def test_plain_tcp_beyond_this_host_must_be_asked_for(address):
    with pytest.raises(ValueError, match="insecure=True"):
        check_address(address, keys=None, insecure=False)
    check_address(address, keys=None, insecure=True)
    check_address(address, keys=pair(), insecure=False)
