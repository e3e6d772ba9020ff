"""What bytes from others may cost: objects, bytes and time have bounds, and what is over them says so."""

from __future__ import annotations

import json
import time
import tracemalloc

import numpy as np
import pytest
from peer import connect

from cortex import Array, MalformedMessage, message, reliable
from cortex.body import Body
from cortex.codec import codec_of
from cortex.layout import VALUES_MAX
from cortex.messages import VelocityCommand
from cortex.schema import Schema, SchemaError, schema_of, type_from_schema


@message
class Cell:
    occupied: bool


@message
class Cells:
    cells: list[Cell]


@message
class Numbers:
    numbers: list[int]


@message
class Grid:
    cells: Array["uint8", "n"]


def _body(count: int) -> bytes:
    """A body of `Cells` with so many elements, as any encoder could write it."""
    return np.array([8, count], np.uint32).tobytes() + bytes(count + (-count % 8))


@pytest.mark.parametrize("in_python", [False, True])
def test_lists_of_a_body_become_a_bounded_number_of_objects(in_python):
    """Each element is a message with one field: 16 MB would become 32 million objects."""
    schema = schema_of(Cells)
    decode = Body(schema, Cells).read if in_python else codec_of(Cells).decode
    assert len(decode(_body(VALUES_MAX // 2)).cells) == VALUES_MAX // 2
    tracemalloc.start()
    try:
        with pytest.raises(MalformedMessage, match="more than 1048576 values"):
            decode(_body(16 << 20))
        assert tracemalloc.get_traced_memory()[1] < 64 << 20
    finally:
        tracemalloc.stop()


def test_what_no_reader_would_take_is_not_written():
    with pytest.raises(ValueError, match="more than 1048576 values; send large ones as arrays"):
        codec_of(Numbers).encode(Numbers([0] * (VALUES_MAX + 1)), 1 << 30)
    largest = Numbers([0] * VALUES_MAX)
    assert len(codec_of(Numbers).encode(largest, 1 << 30)) == 8 + 8 * VALUES_MAX


def _text(types: list[object]) -> str:
    fields = [{"name": f"f{i}", "type": kind, "unit": "", "frame": ""} for i, kind in enumerate(types)]
    return json.dumps({"name": "hostile", "fields": fields}, separators=(",", ":"))


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (_text([{"enum": "e", "values": {f"v{i}": i for i in range(55_000)}}]), "allowed are 65536 bytes"),
        (_text([{"enum": "e", "values": {f"v{i}": i for i in range(3_000)}}]), "allowed are 2048"),
        (_text([{"array": "any", "shape": [f"n{i}" for i in range(32)]}] * 200), "allowed are 2048"),
    ],
)
def test_a_schema_that_takes_long_to_build_is_refused(text, reason):
    begin = time.process_time()
    with pytest.raises(SchemaError, match=reason):
        codec_of(type_from_schema(Schema.from_json(text)))
    assert time.process_time() - begin < 1.0  # these took 2 to 13 s


def test_a_chunk_unpacks_to_no_more_than_it_claims(tmp_path):
    pytest.importorskip("mcap")
    lz4 = pytest.importorskip("lz4.frame")
    from cortex.log.format import LogError
    from cortex.log.reader import _decompress

    bomb = lz4.compress(bytes(256 << 20))
    tracemalloc.start()
    try:
        with pytest.raises(LogError, match="it has more bytes uncompressed and claims 100"):
            _decompress("lz4", bomb, 100)
        assert tracemalloc.get_traced_memory()[1] < 16 << 20
    finally:
        tracemalloc.stop()
    assert _decompress("lz4", lz4.compress(b"whole"), 5) == b"whole"


def test_back_pressure_ends_when_the_publisher_says(node):
    publisher, _ = connect(node, "/grid", Grid, reliable(1, 3_000_000.0), max_wait_s=0.2)
    grid = Grid(np.zeros(1000, np.uint8))
    begin = time.monotonic()
    while publisher.publish(grid):
        assert time.monotonic() - begin < 30.0
    assert publisher.counters.timeouts == 1
    with pytest.raises(ValueError, match="max_wait_s must be 0 to 86400, got -1"):
        node.publisher("/other", Grid, max_wait_s=-1.0)


@pytest.mark.parametrize(("type_", "longest_s"), [(Grid, 1.0), (VelocityCommand, 0.1)])
def test_a_command_holds_up_its_publisher_for_a_moment_only(node, type_, longest_s):
    """By default; whatever a reader asks for."""
    publisher, _ = connect(node, "/topic", type_, reliable(timeout_s=3_000_000.0))
    assert [reader.timeout_s for reader in publisher._fanout.readers.values()] == [longest_s]
