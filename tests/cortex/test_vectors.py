"""The test vectors are what Python reads and writes; `examples/rust` reads WIRE.md independently of it."""

from __future__ import annotations

import json
from typing import Any

import pytest
from wire_vectors import DIRECTORY, load_vectors, message_from_plain, message_to_plain

from cortex import messages, records
from cortex.body import Body
from cortex.codec import MalformedMessage, Plan, codec_of
from cortex.intake import Intake
from cortex.link import Link
from cortex.message_types import is_message
from cortex.policy import keep_last
from cortex.receive_lock import ReceiveLock
from cortex.records import PublisherRecord
from cortex.schema import Schema, fingerprint_of, schema_of, type_from_schema
from cortex.stats import SubscriberCounters
from cortex.wire import (
    AttachAnswer,
    AttachKey,
    Header,
    answer_frame,
    attach_key,
    control_frame,
    pack_header,
    parse_answer,
    resume_key,
)

VECTORS = load_vectors()
CONTROL = {"cortex/Leave": records.Leave}
CASES = [(name, case) for name, vector in VECTORS.items() for case in vector["cases"]]
MALFORMED = [(name, case) for name, vector in VECTORS.items() for case in vector["malformed"]]


def label(value: Any) -> str:
    return value["name"] if isinstance(value, dict) else value


@pytest.mark.parametrize("name", VECTORS)
def test_schema_and_fingerprint(name):
    vector = VECTORS[name]
    schema = Schema.from_json(vector["schema"])
    assert f"{schema.fingerprint:016x}" == vector["fingerprint"]
    assert codec_of(type_from_schema(schema)).fixed_size == vector["fixed_size"]


@pytest.mark.parametrize(("name", "case"), CASES, ids=label)
def test_bodies(name, case):
    schema = Schema.from_json(VECTORS[name]["schema"])
    codec = codec_of(type_from_schema(schema))
    body = bytes.fromhex(case["body"])
    value = message_from_plain(schema, case["value"])
    in_python = Plan(Body(schema, codec.type), value).to_bytes()
    assert codec.encode(value, len(body)) == in_python == body
    assert message_to_plain(schema, codec.decode(body)) == case["value"]


@pytest.mark.parametrize(("name", "case"), MALFORMED, ids=label)
def test_malformed_bodies(name, case):
    schema = Schema.from_json(VECTORS[name]["schema"])
    body = bytes.fromhex(case["body"])
    assert all(body.hex() != good["body"] for good in VECTORS[name]["cases"])
    codec, said = codec_of(type_from_schema(schema)), []
    for decode in (
        codec.decode,
        Body(schema, codec.type).read,
    ):  # the words are those of Python, whoever finds it
        with pytest.raises(MalformedMessage, match=schema.name) as caught:
            decode(body)
        said.append(str(caught.value))
    assert said[0] == said[1]


FRAMES = json.loads((DIRECTORY / "frames.json").read_text(encoding="utf-8"))


def make_link(counters: SubscriberCounters) -> Link:
    """A link to the publisher of the frames, which is not there."""
    published = FRAMES["publisher"]
    codec = codec_of(type_from_schema(Schema.from_json(published["schema"])))
    record = PublisherRecord(
        "/frames", published["source"], "", codec.fingerprint, published["schema"], False
    )
    return Link(
        record,
        codec,
        "tcp://127.0.0.1:9",
        policy=keep_last(),
        local=False,
        shared_memory=False,
        counters=counters,
        clock_offset_ns=0,
    )


def written(fields: dict[str, Any]) -> bytes:
    """The frame of these fields, as Python writes it."""
    kind, source, stamped = fields["kind"].encode(), fields.get("source", 0), fields.get("stamped", False)
    if kind == b"C":
        return control_frame(CONTROL[fields["name"]](**fields["message"]), fields["sequence"])
    if kind == b"R":
        return resume_key(source, fields["reader"], fields["sequence"], stamped=stamped)
    if kind == b"A":
        options = fields["options"]
        asked = (bool(options & 1), bool(options & 2), options >> 8 & 255, options >> 32)
        key = attach_key(AttachKey(source, fields["reader"], *asked), stamped=stamped)
        if "next" not in fields:
            return key
        return answer_frame(key, AttachAnswer(fields["next"], bytes.fromhex(fields["latched"])))
    names = ("fingerprint", "sequence", "stamp_ns", "publish_ns", "body_size", "aux")
    header = Header(kind, source, *(fields[name] for name in names))
    header = header if stamped else header._replace(stamp_ns=None)
    return pack_header(header) + bytes.fromhex(fields.get("body", ""))


@pytest.mark.parametrize("case", FRAMES["frames"], ids=label)
def test_frames(case):
    """What is written into a frame is what the tables of WIRE.md find there."""
    fields, frame = case["fields"], bytes.fromhex(case["frame"])
    assert written(fields) == frame
    assert frame[:3] == b"CTX"
    assert frame[3:4].decode() == fields["kind"]
    places = {"source": 8, "fingerprint": 16, "sequence": 24, "body_size": 48, "aux": 56}
    if fields["kind"] in "AR":
        places = {"source": 8, "reader": 16, "options": 24, "next": 32} | (
            {"sequence": 24} if fields["kind"] == "R" else {}
        )
    for name, offset in places.items():
        if name in fields:
            assert int.from_bytes(frame[offset : offset + 8], "little") == fields[name], name
    assert frame[5] == fields.get("stamped", False)


@pytest.mark.parametrize("case", FRAMES["malformed"], ids=label)
def test_malformed_frames(case):
    frame = bytes.fromhex(case["frame"])
    if frame[3:4] == b"A":
        with pytest.raises(MalformedMessage):
            parse_answer(frame)
        return
    counters = SubscriberCounters()
    link = make_link(counters)
    try:
        Intake(keep_last(), counters, ReceiveLock()).accept(link, frame, timed=False)
    finally:
        link.close()
    assert counters.rejected == 1


def test_there_are_vectors_for_everything():
    text = "".join(vector["schema"] for vector in VECTORS.values())
    for part in ("optional:", "list:", "enum:", "message:", "array:any", "str", "bytes", "bool"):
        assert ":".join(f'"{word}"' if word else "" for word in part.split(":")) in text
    assert len(VECTORS) >= 15
    assert len(MALFORMED) >= 40


def test_types():
    """The standard and the control messages have the structures that are written down."""
    found = [item for module in (messages, records) for item in vars(module).values()]
    ours = {schema.name: schema for item in found if is_message(item) for schema in [schema_of(item)]}
    written_down = json.loads((DIRECTORY / "types.json").read_text(encoding="utf-8"))
    assert {entry["name"]: entry["schema"] for entry in written_down} == {
        name: schema.to_json() for name, schema in ours.items()
    }
    for entry in written_down:
        assert f"{fingerprint_of(entry['schema'].encode()):016x}" == entry["fingerprint"]
