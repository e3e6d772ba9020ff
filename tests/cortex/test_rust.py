"""The Rust subscriber and publisher, written from WIRE.md: vectors, and what passes between it and Python."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from peer import Block, Number, Scan, is_whole, make_block, take_all
from processes import ROOT, SOON_S, Beside, Lines
from test_end_of_stream import expected, leavers
from wire_vectors import message_to_plain

from cortex import keep_last, reliable
from cortex.registry import ensure_registry
from cortex.schema import schema_of

__all__ = ["leavers"]

CRATE = ROOT / "cortex" / "examples" / "rust"
TARGET = ROOT / "build" / "rust"
CARGO = shutil.which(
    "cargo", path=os.pathsep.join([os.environ.get("PATH", ""), str(Path.home() / ".cargo/bin")])
)
OLDEST = (1, 89)
DEBIAN = Path("/usr/share/cargo/registry")
"""Where `apt install librust-zmq-dev` and the like put crates: they are taken from there, if they are."""
CRATES = "libzmq3-dev librust-{anyhow,blake2b-simd,hex,nix,rand,serde-json,zmq}-dev"
PATIENCE_S = 900.0
"""After this a build or program that takes seconds hangs, also on a machine that does a lot besides."""


def _cargo(*arguments: str, timeout_s: float = PATIENCE_S) -> subprocess.CompletedProcess[str]:
    """Run cargo in the crate; builds are kept in `build/rust`, which cargo itself locks."""
    assert CARGO is not None
    command = [CARGO, *arguments]
    if any(DEBIAN.glob("zmq-*")):
        command += ["--offline", "--config", 'source.crates-io.replace-with="debian"']
        command += ["--config", f'source.debian.directory="{DEBIAN}"']
    # Built once and run for seconds: what makes later builds or the programs fast costs more than it saves.
    quick = {"CARGO_PROFILE_DEV_DEBUG": "0", "CARGO_PROFILE_DEV_OPT_LEVEL": "0", "CARGO_INCREMENTAL": "0"}
    environment = os.environ | {"CARGO_TARGET_DIR": str(TARGET), **quick}
    return subprocess.run(
        command, cwd=CRATE, env=environment, capture_output=True, text=True, timeout=timeout_s, check=False
    )


def _missing() -> str:
    if CARGO is None:
        return "no cargo: install Rust from https://rustup.rs"
    shown = subprocess.run([CARGO, "--version"], capture_output=True, text=True, check=False).stdout
    found = re.match(r"cargo (\d+)\.(\d+)", shown)
    if found is None or (int(found[1]), int(found[2])) < OLDEST:
        return f"cargo {OLDEST[0]}.{OLDEST[1]} or newer is needed, this is {shown.strip()!r}"
    found_crates = _cargo("fetch", timeout_s=60.0)
    return f"no crates: apt install {CRATES}" if found_crates.returncode else ""


def cargo(*arguments: str) -> str:
    done = _cargo(*arguments)
    assert done.returncode == 0, done.stdout[-4000:] + done.stderr[-4000:]
    return done.stdout


@pytest.fixture(scope="module", autouse=True)
def build():
    """Everything is built once."""
    if missing := _missing():
        pytest.skip(f"the Rust example cannot be built here: {missing}")
    cargo("build")


@pytest.fixture
def start(runtime):
    """Starts one of the programs, with a registry for it to find, and ends it."""
    ensure_registry(0)
    started: list[subprocess.Popen[bytes]] = []

    def run(*arguments: str) -> subprocess.Popen[bytes]:
        pipe = subprocess.PIPE
        command = [str(TARGET / "debug" / "cortex-peer"), *arguments]
        started.append(subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=pipe, bufsize=0))
        return started[-1]

    yield run
    for process in started:
        process.kill()
        process.communicate()


def finish(process: subprocess.Popen[bytes]) -> tuple[list[Any], list[str]]:
    """Wait for a program that ends by itself: the lines of JSON that it printed, and those of its errors."""
    output, errors = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, errors.decode()
    return [json.loads(line) for line in output.splitlines()], errors.decode().splitlines()


class Publishing(Lines):
    """A running `cortex-peer pub` that publishes messages of a type."""

    def __init__(self, process: subprocess.Popen[bytes], kind: type) -> None:
        super().__init__(process, "cortex-peer pub")
        self._schema = schema_of(kind)
        self._say(self._schema.to_json())

    def _say(self, line: str) -> None:
        self.process.stdin.write(line.encode() + b"\n")

    def await_subscribers(self, count: int) -> None:
        while json.loads(self.line())["subscribers"] != count:
            pass

    def publish(self, message: Any) -> None:
        self._say(json.dumps(message_to_plain(self._schema, message)))

    def close(self) -> dict[str, int]:
        """End its input; what it has counted."""
        lines, errors = finish(self.process)
        assert not errors
        return lines[-1]


def test_vectors():
    output = cargo("test")
    assert {"test bodies ... ok", "test frames ... ok", "test types ... ok"} <= set(output.splitlines())


def blocks_of(count: int) -> list[Block]:
    """Small messages, and every hundredth a large one."""
    return [make_block(number, 20_000 if number % 100 == 9 else number % 7) for number in range(count)]


def test_reliable_from_python(start, make_node):
    """More than all queues hold: the subscriber gets each message, and the publisher's end."""
    publisher = make_node().publisher("/blocks", Block, max_wait_s=SOON_S)
    reading = Beside(finish, start("sub", "/blocks", "--reliable", "--once"))  # it must never wait for us
    assert publisher.wait_for_subscribers(1, SOON_S)
    blocks = blocks_of(6_000)
    delivered = sum(map(publisher.publish, blocks))
    publisher.close()
    ((messages, errors),) = reading.join(PATIENCE_S)
    counted = json.loads(errors[-1])
    assert len(messages) == counted["received"] >= delivered
    assert counted["received"] + counted["lost"] == len(blocks)
    assert (counted["rejected"], counted["cut_off"]) == (0, 0)
    if delivered == len(blocks):  # nobody had to wait for longer than the reader asks for
        assert messages == [message_to_plain(schema_of(Block), block) for block in blocks]


def test_reliable_from_rust(start, make_node):
    """As the other way round; every tenth message is a large one."""
    node = make_node()
    publishing = Publishing(start("pub", "/blocks"), Block)
    subscriber = node.subscriber("/blocks", Block, policy=reliable(16, timeout_s=SOON_S))
    publishing.await_subscribers(1)
    count, blocks = 3_000, blocks_of(3_000)
    feeding = Beside(lambda: [*map(publishing.publish, blocks), publishing.close()][-1])
    received = []
    while subscriber.counters.received + subscriber.counters.lost < count:
        received.append(subscriber.recv(SOON_S))
    (closed,) = feeding.join()
    assert closed["published"] == count
    assert len(received) + subscriber.counters.lost == count
    assert subscriber.counters.lost <= closed["timeouts"]
    assert all(is_whole(block) for block in received)
    numbers = [block.number for block in received]
    assert numbers == sorted(set(numbers))
    assert subscriber.counters.rejected == subscriber.counters.cut_off == 0


@pytest.mark.parametrize("pause_s", [0.0, 0.5], ids=["at once", "after it was told first"])
def test_a_reader_that_rust_does_not_wait_for(start, make_node, pause_s):
    """It counts what it has lost, learns of the last loss whenever it reads, and gets messages again."""
    publishing = Publishing(start("pub", "/blocks"), Block)
    subscriber = make_node().subscriber("/blocks", Block, policy=reliable(2, timeout_s=0.0))
    publishing.await_subscribers(1)
    count = 2_000  # of a kilobyte: more than lies between the two
    for number in range(count):
        publishing.publish(make_block(number, 1_000))
    time.sleep(pause_s)
    numbers: list[int] = []
    while len(numbers) + subscriber.counters.lost < count:
        blocks = take_all(subscriber)
        assert all(map(is_whole, blocks))
        numbers += [block.number for block in blocks]
    lost = subscriber.counters.lost
    assert lost > 0
    for number in range(count, count + 20):
        publishing.publish(make_block(number, 5))
        assert subscriber.recv(SOON_S).number == number
    counted = publishing.close()
    assert counted["published"] == count + 20
    # Once it has lost a message, all may be lost until the publisher hears that it reads again.
    first = next(index for index, number in enumerate([*numbers, count]) if index != number)
    assert lost <= counted["timeouts"] < count + 20 - first
    assert (subscriber.counters.lost, subscriber.counters.rejected) == (lost, 0)


def test_several_subscribers_of_rust(start, make_node):
    """Each reader gets its own copy, whatever its policy; who leaves is no subscriber any more."""
    publishing = Publishing(start("pub", "/scans"), Scan)
    first, second = make_node("first"), make_node("second")
    lossy = first.subscriber("/scans", Scan, policy=keep_last(8))
    strict = second.subscriber("/scans", Scan, policy=reliable(8))
    publishing.await_subscribers(2)
    scan = Scan(5, np.array([0.5, -np.inf, np.nan], np.float32))
    publishing.publish(scan)
    for subscriber in (lossy, strict):
        message, info = subscriber.recv_with_info(SOON_S)
        np.testing.assert_array_equal(message.ranges, scan.ranges)
        assert (message.stamp_ns, info.stamp_ns, info.sequence) == (5, 5, 0)
    lossy.close()
    publishing.await_subscribers(1)
    assert publishing.close() == {"published": 1, "timeouts": 0}


def test_a_registry_that_is_killed_is_found_again(start, make_node, runtime):
    """Connected peers go on; who comes later is found through the registry that takes over."""
    publishing = Publishing(start("pub", "/numbers"), Number)
    node = make_node("first")
    first = node.subscriber("/numbers", Number, policy=reliable(8))
    publishing.await_subscribers(1)
    os.kill(int((runtime / "0" / "registry.lock").read_text()), 9)
    second = make_node("second").subscriber("/numbers", Number, policy=reliable(8))
    publishing.await_subscribers(2)
    publishing.publish(Number(1, 2))
    assert first.recv(SOON_S) == second.recv(SOON_S) == Number(1, 2)
    assert publishing.close() == {"published": 1, "timeouts": 0}


def test_rust_reports_what_it_has_not_heard_the_end_of(runtime, leavers):
    (runtime / "0").mkdir(mode=0o700)
    leavers.router.bind(f"ipc://{runtime}/0/registry")
    program, pipe = TARGET / "debug" / "cortex-peer", subprocess.PIPE
    readers = [
        subprocess.Popen([program, "sub", f"/cut{number}", "--reliable", "--once"], stdout=pipe, stderr=pipe)
        for number in (0, 1)
    ]
    try:
        leavers.speak()
        leavers.leave()
        for number, reader in enumerate(readers):
            _, errors = reader.communicate(timeout=SOON_S)
            counted = expected(number)
            counted["cut_off"] -= counted["rejected"]  # to it a message that is none has no number
            assert json.loads(errors.splitlines()[-1]) == counted
    finally:
        for reader in readers:
            reader.kill()
            reader.communicate()
