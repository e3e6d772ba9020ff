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


@pytest.fixture
def serve(context, authenticator):
    """Makes a CURVE publisher on a free port, and its readers."""
    with contextlib.ExitStack() as sockets:

        def make(keys):
            server = sockets.enter_context(context.socket(zmq.XPUB))
            authenticator.secure(server, keys)
            port = server.bind_to_random_port("tcp://127.0.0.1")

            def subscribe(prepare):
                client = sockets.enter_context(context.socket(zmq.SUB))
                prepare(client)
                client.subscribe(b"")
                client.connect(f"tcp://127.0.0.1:{port}")
                return client

            return server, subscribe

        yield make


def gets_something(server, client, timeout_ms):
    """Publish until the subscriber has something, or the time is over."""
    deadline = time.monotonic() + timeout_ms / 1e3
    while time.monotonic() < deadline:
        server.send(b"secret")
        if client.poll(20):
            return client.recv() == b"secret"
    return False


def _unauthorised(socket, server_keys):
    apply_client(socket, pair(server_keys.public), server_keys.public)


def _wrong_server_key(socket, server_keys):
    other = pair()
    keys = Keys(server_keys.public, server_keys.secret, frozenset({other.public}))
    apply_client(socket, keys, other.public)


def _without_curve(socket, server_keys):
    pass


@pytest.mark.parametrize("prepare", [_unauthorised, _wrong_server_key, _without_curve])
def test_others_get_nothing(serve, prepare):
    """A friend, with the one key pair for all, does: so that the server is known to work."""
    keys = pair()
    server, subscribe = serve(keys)
    client = subscribe(lambda socket: prepare(socket, keys))
    friend = subscribe(lambda socket: apply_client(socket, keys, keys.public))
    assert gets_something(server, friend, 1e3 * SOON_S)
    assert not gets_something(server, client, NOTHING_MS)


def test_what_cannot_be_right_is_refused_before_connecting(context):
    with context.socket(zmq.SUB) as socket, pytest.raises(PermissionError, match=AUTHORIZED_FILE):
        apply_client(socket, pair(), pair().public)


def test_keys_are_private_and_never_overwritten(tmp_path):
    made = new_keys(tmp_path / "keys")
    assert (tmp_path / "keys" / SECRET_FILE).stat().st_mode & 0o777 == 0o600
    assert (tmp_path / "keys").stat().st_mode & 0o777 == 0o700
    assert load_keys(tmp_path / "keys") == made
    with pytest.raises(FileExistsError, match=SECRET_FILE):
        new_keys(tmp_path / "keys")
    assert load_keys(tmp_path / "keys") == made
    assert made.secret not in repr(made)


@pytest.mark.parametrize(
    ("file", "text", "mode", "error", "said"),
    [
        *(
            (SECRET_FILE, None, mode, PermissionError, f"mode {mode:04o}: chmod 0600")
            for mode in (0o640, 0o604)
        ),
        (AUTHORIZED_FILE, None, 0o666, PermissionError, "chmod 0644"),
        (AUTHORIZED_FILE, "# fine\nnonsense here\n", 0o644, ValueError, r"_keys:2 must be a key.*'nonsense'"),
        (PUBLIC_FILE, "a" * 40, 0o644, ValueError, "does not belong"),
    ],
)
def test_keys_that_are_open_to_others_or_broken_are_refused(tmp_path, file, text, mode, error, said):
    new_keys(tmp_path)
    if text is not None:
        (tmp_path / file).write_text(text)
    (tmp_path / file).chmod(mode)
    with pytest.raises(error, match=said):
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


def test_a_revoked_key_gets_nothing(serve, tmp_path, caplog):
    guest = pair()
    new_keys(tmp_path)
    (tmp_path / AUTHORIZED_FILE).write_text(guest.public + "\n")
    keys = load_keys(tmp_path)
    guest = Keys(guest.public, guest.secret, frozenset({keys.public}))
    server, subscribe = serve(keys)
    client = subscribe(lambda socket: apply_client(socket, guest, keys.public))
    assert gets_something(server, client, 1e3 * SOON_S)
    client.close()
    (tmp_path / AUTHORIZED_FILE).write_text("# " + guest.public + "\n")
    with caplog.at_level(logging.WARNING, "cortex.security"):
        client = subscribe(lambda socket: apply_client(socket, guest, keys.public))
        assert not gets_something(server, client, NOTHING_MS)
    assert [r.getMessage() for r in caplog.records if guest.public in r.getMessage()]  # and it is said


def test_an_unreadable_allow_list_lets_nobody_in(tmp_path, caplog):
    guest = pair().public
    new_keys(tmp_path)
    (tmp_path / AUTHORIZED_FILE).write_text(guest)
    keys = load_keys(tmp_path)
    assert keys.allows(guest)
    (tmp_path / AUTHORIZED_FILE).chmod(0o666)
    assert not keys.allows(guest)
    assert "nobody can connect" in caplog.text


NEAR = "tcp://127.0.0.1:5 tcp://127.8.9.1:* tcp://localhost:5 tcp://[::1]:5 ipc:///tmp/x inproc://x"
FAR = (
    "tcp://0.0.0.0:5 tcp://*:5 tcp://10.0.0.1:5 tcp://[::]:5 tcp://eth0:5 tcp://localhost.example.org:5 "
    "tcp://127.0.0.1.example.org:5 tcp://127.0.0.1:0;10.0.0.1:5"
)


@pytest.mark.parametrize("address", [*NEAR.split(), *FAR.split()])
def test_plain_tcp_beyond_this_host_must_be_asked_for(address):
    expected = (
        pytest.raises(ValueError, match="insecure=True") if address in FAR else contextlib.nullcontext()
    )
    with expected:
        check_address(address, keys=None, insecure=False)
    check_address(address, keys=None, insecure=True)
    check_address(address, keys=pair(), insecure=False)
