"""Recordings: what goes in comes out, whatever happens to the recorder, the disk or the file."""

from __future__ import annotations

import errno
import io
import itertools
import json
import os
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from c_module import needs_native
from hypothesis import given, settings
from hypothesis import strategies as st
from peer import Block as Large
from peer import Number, OtherNumber, Scan, is_whole, make_block
from processes import SOON_S, wait_for

from cortex import MalformedMessage, Node, TypeMismatch, keep_last, reliable
from cortex.log import Log, LogError, LogWriter, Player, Recorder, TopicStats, open_log
from cortex.log.format import CHUNK_BYTES
from cortex.log.writer import Sink
from cortex.schema import Schema, schema_of

MakeNode = Callable[..., Node]


def numbers(log: Log, **options: object) -> list[int]:
    return [message.value for _, message, _ in log.messages(**options)]  # type: ignore[arg-type]


def write_numbers(path: Path, values: range, *, gap_ns: int = 10_000_000, chunk_size: int = 1 << 20) -> None:
    """A recording with one message every 10 ms, without waiting for it."""
    from mcap.writer import CompressionType, Writer

    from cortex.codec import codec_of

    with path.open("wb") as file:
        writer = Writer(file, chunk_size=chunk_size, compression=CompressionType.NONE)
        writer.start("cortex", "test")
        schema = writer.register_schema("Number", "cortex-json", schema_of(Number).to_json().encode())
        fingerprint = f"{schema_of(Number).fingerprint:016x}"
        metadata = {"source": "a1", "node": "writer", "fingerprint": fingerprint}
        channel = writer.register_channel("/number", "cortex", schema, metadata)
        for value in values:
            body = codec_of(Number).encode(Number(-value, value), 1000)
            at_ns = 10**18 + value * gap_ns
            writer.add_message(channel, at_ns, body, at_ns, value)
        writer.finish()


def test_what_is_recorded_can_be_read(node, tmp_path):
    """Typed, generic and raw, small and large, with all that is known besides."""
    path = tmp_path / "run.mcap"
    number, block = node.publisher("/number", Number), node.publisher("/block", Large)
    before_ns = time.time_ns()
    with Recorder(node, path, ["/number", "/block"]) as recorder:
        assert number.wait_for_subscribers(timeout_s=SOON_S)
        assert block.wait_for_subscribers(timeout_s=SOON_S)
        for i in range(100):
            number.publish(Number(10**18 + i, i))
        for i in range(5):
            block.publish(make_block(i, 300_000))
        wait_for(lambda: recorder.stats.written == 105)
    after_ns = time.time_ns()
    with open_log(path) as log:
        assert log.cut == ""
        assert [(t.topic, t.schema, t.message_count, t.nodes) for t in log.topics] == [
            ("/block", schema_of(Large), 5, ("node",)),
            ("/number", schema_of(Number), 100, ("node",)),
        ]
        assert log.start["node"] == "node"
        assert json.loads(log.end["/number"]) == {
            "written": 100, "bytes": 1600, "lost": 0, "overtaken": 0, "rejected": 0, "cut_off": 0,
        }  # fmt: skip
        typed = list(log.messages(types={"/number": Number}))
        assert [message for _, message, _ in typed] == [Number(10**18 + i, i) for i in range(100)]
        for i, (topic, _, info) in enumerate(typed):
            assert (topic, info.topic, info.node) == ("/number", "/number", "node")
            assert (info.sequence, info.stamp_ns, info.size) == (i, 10**18 + i, 16)
            assert info.source == number.source
            assert before_ns - 10**6 <= info.publish_ns <= info.log_ns <= after_ns + 10**6
        assert all(is_whole(message) for _, message, _ in log.messages(["/block"]))
        assert [schema for _, _, schema in log.raw(["/block"])] == [schema_of(Large)] * 5
        times = [info.log_ns for info, _, _ in log.raw()]
        assert times == sorted(times)
        assert (log.start_ns, log.end_ns) == (times[0], times[-1])


def test_other_tools_can_read_the_file(node, tmp_path):
    """The library's own reader, which checks all sums, sees the same messages."""
    from mcap.reader import make_reader

    path = tmp_path / "run.mcap"
    publisher = node.publisher("/number", Number)
    with Recorder(node, path) as recorder:
        assert publisher.wait_for_subscribers(timeout_s=SOON_S)
        for i in range(1000):
            publisher.publish(Number(i, i))
        wait_for(lambda: recorder.stats.written == 1000)
    with path.open("rb") as file:
        seen = list(make_reader(file, validate_crcs=True).iter_messages())
    assert [message.sequence for _, _, message in seen] == list(range(1000))
    schema, channel, _ = seen[0]
    assert Schema.from_json(schema.data.decode()) == schema_of(Number)
    assert (channel.message_encoding, schema.encoding) == ("cortex", "cortex-json")
    assert channel.metadata["fingerprint"] == f"{schema_of(Number).fingerprint:016x}"


@pytest.mark.parametrize("compression", ["none", "lz4"])
def test_a_busy_topic_is_recorded_without_loss(node, tmp_path, compression):
    """Under `reliable`, the default, the publisher is held up rather than a message lost."""
    path = tmp_path / "run.mcap"
    publisher, other = node.publisher("/number", Number), node.publisher("/scan", Scan)
    with Recorder(node, path, compression=compression) as recorder:
        assert publisher.wait_for_subscribers(timeout_s=SOON_S)
        assert other.wait_for_subscribers(timeout_s=SOON_S)
        for i in range(20_000):
            publisher.publish(Number(i, i))
            if i % 1000 == 0:
                other.publish(Scan(i, np.zeros(50_000, np.float32)))
        wait_for(lambda: recorder.stats.written == 20_020)
        assert recorder.stats.lost == 0
    with open_log(path) as log:
        assert numbers(log, topics=["/number"]) == list(range(20_000))
        assert [info.stamp_ns for info, _, _ in log.raw(["/scan"])] == list(range(0, 20_000, 1000))


def test_all_topics_are_recorded_also_those_that_come_later(make_node, tmp_path):
    path = tmp_path / "run.mcap"
    robot, logger = make_node("robot"), make_node("logger")

    def publish(node, topic, message):
        publisher = node.publisher(topic, type(message))
        assert publisher.wait_for_subscribers(timeout_s=SOON_S)
        publisher.publish(message)
        return publisher

    robot.publisher("/first", Number)
    with Recorder(logger, path) as recorder:
        first = publish(robot, "/first", Number(1, 1))
        publish(make_node("late"), "/second", Scan(2, np.ones(3, np.float32)))
        wait_for(lambda: recorder.stats.written == 2)
        first.close()
        publish(robot, "/first", Number(3, 3))  # has another number, and counts from 0 again
        publish(robot, "/first", OtherNumber(4, 0.5))
        wait_for(lambda: recorder.stats.written == 4)
    with open_log(path) as log:
        found = {
            (t.topic, t.schema.fingerprint): (t.schema.name, t.message_count, t.nodes) for t in log.topics
        }
        assert found == {
            ("/first", schema_of(Number).fingerprint): ("Number", 2, ("robot",)),
            ("/first", schema_of(OtherNumber).fingerprint): ("Number", 1, ("robot",)),
            ("/second", schema_of(Scan).fingerprint): ("Scan", 1, ("late",)),
        }
        infos = [info for info, _, _ in log.raw(["/first"])]
        assert [info.sequence for info in infos] == [0, 0, 0]
        assert len({info.source for info in infos}) == 3
        with pytest.raises(TypeMismatch, match="recorded with another type"):
            list(log.messages(types={"/second": Number}))


def test_a_node_that_closes_first_ends_the_recording_in_order(make_node, tmp_path):
    path = tmp_path / "run.mcap"
    node = make_node(registry="off")
    publisher = node.publisher("/number", Number)
    recorder = Recorder(node, path)
    assert publisher.wait_for_subscribers(timeout_s=SOON_S)
    publisher.publish(Number(1, 1))
    wait_for(lambda: recorder.stats.written)
    node.close()
    wait_for(lambda: not recorder.running)
    assert recorder.close().written == 1
    with open_log(path) as log:
        assert log.cut == ""
        assert numbers(log) == [1]


def test_best_effort_counts_what_it_loses(node, tmp_path):
    """Everything that was published is either in the file or counted."""
    path = tmp_path / "run.mcap"
    publisher = node.publisher("/number", Number)
    sent = itertools.count()
    with Recorder(node, path, ["/number"], policy=keep_last(4)) as recorder:
        assert publisher.wait_for_subscribers(timeout_s=SOON_S)
        for _ in range(30_000):
            publisher.publish(Number(0, next(sent)))

        def is_complete() -> bool:
            if recorder.stats.written + recorder.stats.lost == publisher.counters.published:
                return True
            publisher.publish(Number(0, next(sent)))  # shows the gap before it
            return False

        wait_for(is_complete, every_s=0.05)
    with open_log(path) as log:
        values, published = numbers(log), publisher.counters.published
        assert values == sorted(set(values))
        assert values[-1] == published - 1
        ended = json.loads(log.end["/number"])
        assert ended["written"] == len(values)
        assert ended["written"] + ended["lost"] + ended["overtaken"] == published


@needs_native
def test_a_publisher_that_was_killed_is_counted(make_node, tmp_path, start_child):
    """The file does not say that all is in it."""
    node = make_node()
    child = start_child("peer")
    with Recorder(node, tmp_path / "run.mcap", ["/numbers"]) as recorder:
        child.ask(do="publisher", topic="/numbers", type="Number")
        assert child.ask(do="await_subscribers", topic="/numbers")["ok"]
        child.say(do="leave", topic="/numbers", count=10, orderly=False)
        wait_for(lambda: recorder.stats.topics.get("/numbers", TopicStats()).cut_off)
    with open_log(tmp_path / "run.mcap") as log:
        assert json.loads(log.end["/numbers"])["cut_off"] == 1
        assert numbers(log) == list(range(10))


def test_a_killed_recorder_leaves_all_but_the_last_second(start_child, tmp_path):
    path = tmp_path / "run.mcap"

    def missing_ns() -> int:
        path.unlink(missing_ok=True)
        child = start_child("recorder", path=str(path))
        child.line()
        began = path.stat().st_size
        wait_for(lambda: path.stat().st_size > began)
        time.sleep(0.4)  # the worst moment: just before the next flush
        killed_ns = time.monotonic_ns()
        child.kill()
        assert path.stat().st_size < CHUNK_BYTES  # so it was time, not size, that brought it into the file
        with open_log(path) as log:
            assert log.cut.startswith("it was not closed")
            assert log.end == {}
            values = numbers(log)
            assert values == list(range(len(values)))
            assert log.message_count == len(values)
            return killed_ns - max(message.stamp_ns for _, message, _ in log.messages())

    wait_for(lambda: missing_ns() < 1_000_000_000)  # a machine that stands still makes it more at times


def test_a_full_disk_ends_the_recording_and_keeps_what_is_there(start_child, tmp_path):
    """RLIMIT_FSIZE stands for the full disk: a write fails in the middle."""
    path = tmp_path / "run.mcap"
    child = start_child("recorder", path=str(path), limit_file_bytes=300_000)
    while "error" not in (said := json.loads(child.line())):
        pass
    child.finish()
    assert "File too large" in said["error"]
    assert f"{said['unwritten']} messages that had arrived are not in the file" in said["error"]
    assert str(path) in said["error"]
    assert said["errno"] > 0
    assert path.stat().st_size <= 300_000
    with open_log(path) as log:
        assert log.cut == "it was not closed"  # nothing is torn
        assert numbers(log) == list(range(said["written"]))
    assert said["unwritten"] >= 0  # none, if it is the index of what was written that failed


@pytest.mark.parametrize("where", ["_flush_old", "add_message"])
def test_any_failure_ends_the_recording_with_an_error(node, tmp_path, where, caplog):
    """Not in silence. The file is finished unless a message is torn within the writer."""
    path = tmp_path / "run.mcap"
    publisher = node.publisher("/number", Number)
    recorder = Recorder(node, path, ["/number"])
    assert publisher.wait_for_subscribers(timeout_s=SOON_S)
    publisher.publish(Number(0, 0))
    wait_for(lambda: recorder.stats.written == 1)

    def fail(*_: object, **__: object) -> None:
        raise RuntimeError("unforeseen")

    setattr(recorder if where == "_flush_old" else recorder._writer, where, fail)
    publisher.publish(Number(1, 1))
    wait_for(lambda: not recorder.running)
    with pytest.raises(OSError, match="RuntimeError: unforeseen"):
        recorder.close()
    assert any(record.exc_info for record in caplog.records)
    with open_log(path) as log:
        values = numbers(log)
        assert log.cut == ("" if where == "_flush_old" else "it was not closed")
    assert values == list(range(recorder.stats.written))
    assert recorder.stats.unwritten == publisher.counters.published - len(values)


@pytest.fixture(scope="module")
def sample(tmp_path_factory):
    """A recording of ten messages in several chunks."""
    path = tmp_path_factory.mktemp("log") / "sample.mcap"
    write_numbers(path, range(10), chunk_size=200)
    return path


def test_a_file_can_be_cut_anywhere(sample, tmp_path):
    """What is read is a beginning of what was written, and never shrinks when more of the file is there."""
    path = tmp_path / "cut.mcap"
    data = sample.read_bytes()
    most = 0
    for size in range(len(data)):
        path.write_bytes(data[:size])
        if size < 8:
            with pytest.raises(LogError, match="not an MCAP file"):
                open_log(path)
            continue
        with open_log(path) as log:
            values = numbers(log)
            assert values == list(range(len(values)))
            assert len(values) == log.message_count >= most
            assert log.cut
            most = len(values)
    assert most == 10


def test_a_damaged_summary_is_passed_over(sample, tmp_path):
    """The messages are still whole; the file is walked through to find them."""
    data, path = bytearray(sample.read_bytes()), tmp_path / "damaged.mcap"
    data[-100] ^= 1
    path.write_bytes(data)
    with open_log(path) as log:
        assert log.cut == "its summary is missing or damaged"
        assert numbers(log) == list(range(10))


@settings(max_examples=300, deadline=None)
@given(
    changes=st.lists(st.tuples(st.integers(0, 10**6), st.integers(0, 255)), min_size=1, max_size=4),
    cut=st.booleans(),
)
def test_a_damaged_file_is_refused_in_words(sample, changes, cut):
    """Whatever the bytes are: a `LogError` or messages, nothing else, and nothing that takes long."""
    data = bytearray(sample.read_bytes())
    if cut:
        del data[len(data) * 2 // 3 :]
    for position, value in changes:
        data[position % len(data)] = value
    path = sample.with_name("damaged.mcap")
    path.write_bytes(data)
    try:
        with open_log(path) as log:
            assert len(numbers(log)) <= 10
    except (LogError, MalformedMessage):
        pass


def test_other_files_are_refused_and_other_encodings_passed_over(tmp_path):
    from mcap.writer import CompressionType, Writer

    text = tmp_path / "text"
    text.write_text("no recording at all")
    with pytest.raises(LogError, match="not an MCAP file"):
        open_log(text)
    stream = io.BytesIO()
    writer = Writer(stream, compression=CompressionType.NONE)
    writer.start()
    writer.add_message(writer.register_channel("/ros", "cdr", 0), 5, b"abc", 5)
    writer.finish()
    foreign = tmp_path / "foreign.mcap"
    foreign.write_bytes(stream.getvalue())
    with open_log(foreign) as log:
        assert (log.foreign, log.topics, list(log.raw())) == (("/ros",), (), [])


def test_a_range_of_time_and_topics_is_read(tmp_path):
    path = tmp_path / "run.mcap"
    write_numbers(path, range(100), chunk_size=500)
    with open_log(path) as log:
        assert log.duration_s == pytest.approx(0.99)
        assert numbers(log, start_s=0.5) == list(range(50, 100))
        assert numbers(log, end_s=0.5) == list(range(50))
        assert numbers(log, start_s=0.2, end_s=0.25) == list(range(20, 25))
        assert numbers(log, start_s=5.0) == []
        with pytest.raises(ValueError, match="has no topic /nothing; it has /number"):
            next(log.raw(["/nothing"]))


@pytest.fixture
def recording(tmp_path):
    """50 messages, one every 10 ms."""
    path = tmp_path / "run.mcap"
    write_numbers(path, range(50))
    with open_log(path) as log:
        yield log


def test_playing_keeps_the_pace_without_drift(node, recording):
    """Message k is published at k * 10 ms / rate, never earlier, and delays do not add up."""
    subscriber = node.subscriber("/number", Number, policy=reliable(100))
    with Player(node, recording) as player:
        began_ns = time.monotonic_ns()
        assert player.run(rate=2.0) == 50
        late_ns = player.late_ns
    first_ns = 0
    for k in range(50):
        message, info = subscriber.recv_with_info(SOON_S)
        assert message == Number(-k, k)  # the stamp is the recorded one
        first_ns = first_ns or info.publish_ns
        assert info.publish_ns - began_ns >= k * 5_000_000
        # Each message is due on its own; what the machine was late with is all that may be added.
        assert info.publish_ns - first_ns <= k * 5_000_000 + late_ns + 5_000_000


def test_a_reliable_subscriber_gets_all_at_full_speed(make_node, tmp_path):
    """The player waits until the subscriber, in another node, is connected, and then for its queue."""
    path = tmp_path / "run.mcap"
    write_numbers(path, range(20_000), gap_ns=1000)
    received: list[int] = []
    listener, player_node = make_node("listener"), make_node("player")
    subscriber = listener.subscriber(
        "/number", Number, lambda m: received.append(m.value), policy=reliable(32)
    )
    wait_for(lambda: any(t.topic == "/number" for t in player_node.topics()))
    with open_log(path) as log, Player(player_node, log) as player:
        assert player.run(rate=float("inf")) == 20_000
        wait_for(lambda: len(received) == 20_000)
    assert received == list(range(20_000))
    assert subscriber.counters.lost == 0


def test_what_was_latched_is_latched_again(node, tmp_path):
    path = tmp_path / "run.mcap"
    publisher = node.publisher("/map", Number, latch=True)
    publisher.publish(Number(7, 7))
    with Recorder(node, path) as recorder:
        wait_for(lambda: recorder.stats.written == 1)
    publisher.close()
    with open_log(path) as log, Player(node, log) as player:
        assert log.topics[0].latch
        player.run()
        assert node.subscriber("/map", Number).recv(SOON_S) == Number(7, 7)


def test_a_message_that_cannot_be_written_leaves_no_trace(tmp_path):
    path = tmp_path / "log.mcap"
    with LogWriter(path) as log:
        for topic in ("/numbers", "/others"):
            with pytest.raises(TypeError, match=r"Number\.value"):
                log.write(topic, Number(0, "one"), 5)
        log.write("/numbers", Number(0, 1), 10**18)
    with open_log(path) as read:
        assert [each.topic for each in read.topics] == ["/numbers"]
        ((topic, message, info),) = read.messages()
    assert (topic, message.value, info.sequence, info.log_ns) == ("/numbers", 1, 0, 10**18)


def test_a_file_whose_end_does_not_fit_is_closed(tmp_path, monkeypatch):
    """The error is that of the disk, and comes once."""
    before = len(os.listdir("/proc/self/fd"))
    log = LogWriter(tmp_path / "log.mcap")
    log.write("/numbers", Number(0, 1), 5)

    def refuse(self: Sink, data: bytes) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Sink, "write", refuse)
    with pytest.raises(OSError, match="No space"):
        log.close()
    log.close()
    assert len(os.listdir("/proc/self/fd")) == before
