"""The C++ client: bodies, rings, and everything that passes between it and Python."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import shutil
import subprocess
import time

import numpy as np
import pytest
from cpp_client import (
    Impostor,
    Peer,
    bad_frames,
    make_frame,
    make_rich,
    publishers_in_cpp,
    subscribers_in_cpp,
)
from cpp_messages import OtherScan, Picture, Rich, Scan
from cpp_programs import CPP, PATIENCE_S, needs_compiler, programs, short, start
from directories import serving
from processes import SOON_S, shared_mappings, wait_for
from wire_vectors import load_vectors, message_from_plain

from cortex import wire
from cortex.codec import MalformedMessage, codec_of
from cortex.layout import VALUES_MAX, measure_fields
from cortex.policy import reliable
from cortex.registry import ensure_registry
from cortex.schema import Schema, TypeMismatch, schema_of

MUTATIONS = 3000
HOSTILE_WRITES = int(os.environ.get("CORTEX_HOSTILE_WRITES", "40000"))
"""Writes of a peer that writes at random; ten millions take a few minutes."""
CLEAN = {"wrong": 0, "lost": 0, "rejected": 0, "overtaken": 0, "cut_off": 0}
END = Scan(-1, np.zeros(0, np.float32))
"""Who counts scans ends with this one."""

__all__ = ["programs", "start"]

pytestmark = needs_compiler


def too_many_values() -> bytes:
    """A whole body of the vectors' `Lists`, but for one value more in a list than a body may hold (B10)."""
    vector = load_vectors()["lists"]
    schema = Schema.from_json(vector["schema"])
    some = message_from_plain(schema, vector["cases"][0]["value"])
    names = [field.name for field in schema.fields]
    empty = {name: [] for name in names if isinstance(getattr(some, name), list)}
    message = dataclasses.replace(some, **empty | {"flags": [True] * VALUES_MAX})
    codec = codec_of(type(message))
    body = codec.encode(message, 1 << 24)
    assert codec.decode(body) == message
    at = measure_fields(schema)[0][names.index("flags")] + 4
    more = body[:at] + (VALUES_MAX + 1).to_bytes(4, "little") + body[at + 4 :] + b"\1"
    with pytest.raises(MalformedMessage):
        codec.decode(more)
    return more


def test_vectors_and_damaged_bodies(programs):
    """Good bodies return as the same bytes, bad ones are rejected, damaged ones do no harm (ASan, UBSan)."""
    lines = [f"Lists bad {too_many_values().hex()} flags"]
    for vector in load_vectors().values():
        name = short(Schema.from_json(vector["schema"]))
        lines += [f"{name} good {case['body']}" for case in vector["cases"]]
        lines += [f"{name} bad {case['body']}" for case in vector["malformed"]]
    said = run_program([programs / "codec_test", str(MUTATIONS)], input="\n".join(lines) + "\n")
    assert said.startswith(f"{len(lines)} bodies, ")


def test_a_peer_that_writes_at_random(programs, tmp_path):
    """Into a ring and its slots, a page, a wakeup, a connection: it hurts itself only (ASan, UBSan)."""
    run_program([programs / "hostile_test", tmp_path, str(HOSTILE_WRITES), "1"])


def run_program(command, **options):
    """Run a test program, which says nothing if all is well."""
    done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S, check=False, **options)
    assert done.returncode == 0, done.stdout[-4000:] + done.stderr[-4000:]
    return done.stdout


def test_between_threads(programs):
    """Under the thread sanitizer: nothing is torn, lost or written while somebody looks at it."""
    run_program([programs / "broadcast_test"])


def test_nodes_between_threads(programs, runtime):
    """Under the thread sanitizer: shared publishers, leases that end elsewhere, nodes that end early."""
    ensure_registry(0)
    suppressed = {"TSAN_OPTIONS": f"suppressions={CPP}/tests/tsan.supp"}
    run_program([programs / "node_test"], env=os.environ | suppressed)


def test_installed_package_has_all_headers(programs):
    installed = {path.name for path in (programs / "installed/include/cortex").iterdir()}
    shipped = {path.name for path in (CPP / "include/cortex").iterdir()}
    assert installed == shipped | {"messages.hpp", "records.hpp"}
    assert list((programs / "installed").glob("lib*/**/cortexConfig.cmake"))


def test_messages_return_unchanged(start, make_node):
    """Python -> C++ -> Python, small in frames and large in slots of shared memory, both ways."""
    start("echo")
    node = make_node()
    out = node.publisher("/to_cpp", Rich)
    back = node.subscriber("/from_cpp", Rich, policy=reliable(8, SOON_S))
    assert out.wait_for_subscribers(1, SOON_S)
    assert back.wait_for_publisher(SOON_S)
    for number, (height, width) in enumerate([(0, 5), (2, 3), (4, 4), (120, 160), (7, 1), (480, 640)]):
        message = make_rich(number, height, width)
        assert out.publish(message)
        assert back.recv(SOON_S) == message
    assert (back.counters.lost, back.counters.rejected) == (0, 0)


def test_loans_arrive_as_views_of_shared_memory(start, make_node):
    """C++ writes into its ring, Python looks at it there; small loans travel in frames."""
    node = make_node()
    for height in (2, 600):
        pictures = node.subscriber("/picture", Picture, policy=reliable(8, SOON_S))
        peer = start("loan", 50, height)
        for number in range(50):
            picture = pictures.recv(SOON_S)
            assert picture.stamp_ns == number
            assert picture.name == f"picture {number}"
            expected = np.arange(number, number + 64 * height, dtype=np.uint64).astype(np.uint8)
            assert np.array_equal(picture.pixels.ravel(), expected)
            assert np.array_equal(picture.depth, np.full((height, 64), number, np.float32))
            assert shared_mappings()
            del picture
        assert (pictures.counters.lost, pictures.counters.rejected) == (0, 0)
        peer.end()
        pictures.close()


@pytest.mark.parametrize(("policy", "size"), [("4", 10), ("latest", 20_000), ("brief", 3000)])
def test_slow_reader_knows_what_it_missed(start, make_node, policy, size):
    """Received, overtaken and lost messages add up to those that were sent; who is brief is taken back."""
    scans = make_node().publisher("/scan", Scan)
    peer = start("count", "/scan", policy, 500, 0)
    assert scans.wait_for_subscribers(1, SOON_S)
    refused = sum(not scans.publish(Scan(k, np.full(size, k, np.float32))) for k in range(2000))
    while not peer.has_line():  # on a busy machine the end is lost as well as any other message
        scans.publish(END)
        time.sleep(0.01)
    result = json.loads(peer.line())
    accounted = result["received"] + result["lost"] + result["overtaken"]
    assert (result["wrong"], result["rejected"]) == (0, 0)
    assert result["received"] < 2000  # 0 if it was asleep until the end overtook them all
    if policy == "brief":  # it may have been told of messages after the last that it received
        assert result["sequence"] <= accounted <= scans.counters.published
        assert min(refused, result["lost"]) > 0
    else:
        assert (accounted, refused) == (result["sequence"], 0)


def test_late_reliable_reader_of_cpp_is_told(start, make_node):
    """A reader in Python that holds up C++ for too long loses messages, knows how many, and is taken back."""
    scans = make_node().subscriber("/scan", Scan, policy=reliable(4, 0.001))
    peer = start("publish", "/scan", 1500, 3000)
    result: dict[str, int] = {}
    while not result or scans.counters.received + scans.counters.lost < result["published"]:
        with contextlib.suppress(TimeoutError):
            scans.recv(0.05)
        time.sleep(0.001)  # work
        if not result and peer.has_line():
            result = json.loads(peer.line())
            deadline_s = time.monotonic() + SOON_S
        assert not result or time.monotonic() < deadline_s
    assert scans.counters.received + scans.counters.lost == result["published"]
    assert scans.counters.lost > 0
    assert result["refused"] == result["timeouts"] > 0


@pytest.mark.parametrize("size", [10, 20_000])
def test_latched_messages(start, make_node, size):
    """Python hears the last message of C++, and C++ that of Python."""
    peer, node = start("publish", "/map", 3, size, "latch"), make_node()
    wait_for(lambda: [found.published for found in publishers_in_cpp(node)] == [3])
    assert node.subscriber("/map", Scan).recv(SOON_S).stamp_ns == 2
    assert peer.process.poll() is None
    scans = node.publisher("/scan", Scan, latch=True)
    scans.publish(Scan(5, np.full(size, 5, np.float32)))
    reader = start("count", "/scan", "4", 0, 0)
    assert scans.wait_for_subscribers(1, SOON_S)
    scans.publish(END)
    assert json.loads(reader.line()) == {**CLEAN, "received": 1, "sequence": 1, "sources": 1, "last": 5}


def test_mismatching_types_are_told(start, make_node):
    """Each side sees both structures, and goes on."""
    node = make_node()
    others = node.publisher("/scan", OtherScan)
    peer = start("count", "/scan", "latest", 0, 0)
    assert peer.line() == "mismatch a publisher of /scan sends another type than is subscribed"
    assert peer.line() == f"expected: {schema_of(Scan).to_json()}"
    assert peer.line() == f"actual: {schema_of(OtherScan).to_json()}"
    others.close()
    scans = node.publisher("/scan", Scan)
    assert scans.wait_for_subscribers(1, SOON_S)
    scans.publish(END)
    assert json.loads(peer.line())["received"] == 0
    start("publish", "/other", 10, 10, "latch")
    wrong = node.subscriber("/other", OtherScan)
    with pytest.raises(TypeMismatch, match="expected: Scan"):
        wrong.recv(SOON_S)


def test_counters_can_be_asked(start, make_node):
    node = make_node()
    scans = node.subscriber("/scan", Scan, policy=reliable(64, SOON_S))
    start("publish", "/scan", 10, 10)
    start("count", "/other", "reliable", 0, 0)
    for _ in range(10):
        scans.recv(SOON_S)
    (published,) = wait_for(lambda: publishers_in_cpp(node))
    (subscribed,) = wait_for(lambda: subscribers_in_cpp(node))
    assert (published.topic, published.published, published.timeouts) == ("/scan", 10, 0)
    assert published.bytes == 10 * (24 + 40)  # the fixed block and ten floats
    assert (subscribed.topic, subscribed.policy) == ("/other", "reliable(depth=64, timeout_s=60)")


def test_the_clock_is_that_of_the_registry(start, make_node, runtime, monkeypatch):
    """A registry whose host is a minute ahead: what a C++ node tells of its own clock says so."""
    real = time.time_ns
    monkeypatch.setattr(time, "time_ns", lambda: real() + 60 * 10**9)
    with serving(1, listen="tcp://127.0.0.1:0") as registry:
        monkeypatch.setenv("CORTEX_REGISTRY", str(registry.address))
        node = make_node()
        start("count", "/other", "reliable", 0, 0)

        def offset_ns() -> int:
            offsets = [record.clock_offset_ns for record in node.nodes() if record.node != node.id]
            return offsets[0] if offsets else 0

        wait_for(lambda: abs(offset_ns() - (time.time_ns() - time.monotonic_ns())) < 10**9)


def test_lies_are_rejected(programs, runtime, monkeypatch, tmp_path):
    """A subscriber counts every frame that is wrong and reads those between; a false ring does no harm."""
    impostor = Impostor(runtime)
    try:
        monkeypatch.setenv("CORTEX_TEST_REGISTRY", impostor.registry)
        peer = Peer([programs / "peer", "count", "/scan", "8", 0, 0])
        key = impostor.await_key()
        body = codec_of(Scan).encode(Scan(0, np.zeros(4, np.float32)), 1000)
        good = make_frame(b"M", 0, body)
        bad = list(bad_frames(good, key))
        for frames in bad:
            impostor.xpub.send_multipart(frames)
        malformed = make_frame(b"M", 0, body[:8] + b"\xff" * 8 + body[16:])
        impostor.xpub.send(malformed)
        impostor.xpub.send(make_frame(b"M", 1, body))
        impostor.xpub.send(wire.answer_frame(key, wire.AttachAnswer(2, b"")))
        impostor.xpub.send_multipart([make_frame(b"L", 2, b"", size=len(body)), body])
        impostor.xpub.send(make_frame(b"M", 5, codec_of(Scan).encode(END, 1000)))
        result = json.loads(peer.line())
        assert result["received"] + result["wrong"] >= 1
        assert result["rejected"] == len(bad) + 1
        assert result["lost"] == 2  # numbers 3 and 4
        peer.end()
    finally:
        impostor.close()
    shutil.rmtree(runtime, ignore_errors=True)
    runtime.mkdir(mode=0o700)


def test_example_reads_the_other(programs, runtime):
    """The two example programs meet through a registry."""
    ensure_registry(0)
    listener = subprocess.Popen([programs / "listener", "5"], stdout=subprocess.PIPE, text=True)
    lidar = subprocess.Popen([programs / "lidar", "100000"])  # goes on for longer than it takes to meet
    try:
        assert listener.communicate(timeout=PATIENCE_S)[0] == "steered by 5 scans\n"
        few = subprocess.run([programs / "lidar", "3"], stdout=subprocess.PIPE, text=True, timeout=PATIENCE_S)
        assert few.stdout == "published 3 scans\n"
    finally:
        for process in (listener, lidar):
            process.kill()
            process.communicate()
