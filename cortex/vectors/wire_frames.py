"""Test vectors of frames: what is in them, and the same in bytes; and bytes that are no frames."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from cortex.messages import Events
from cortex.records import Describe
from cortex.schema import schema_of
from cortex.wire import (
    LARGE,
    MESSAGE,
    NEXT,
    SLOT,
    AttachAnswer,
    AttachKey,
    Header,
    answer_frame,
    attach_key,
    control_frame,
    pack_header,
    resume_key,
)

SOURCE, READER = 0x0123456789ABCDEF, 0xFEDCBA9876543210
SCHEMA = schema_of(Events)
FINGERPRINT = SCHEMA.fingerprint
BODY = bytes(range(1, 13))


@dataclass(frozen=True)
class Frame:
    """A frame in bytes; of a message of several ZeroMQ frames, all of them joined."""

    name: str
    frame: str
    """Hexadecimal."""
    fields: dict[str, Any]
    """As the tables of WIRE.md name them; `kind` is a letter, bytes are in hexadecimal."""


def frames() -> list[Frame]:
    """Return one frame of each kind that carries messages, and those by which readers attach and resume."""
    stamped = Header(MESSAGE, SOURCE, FINGERPRINT, 7, -5, 2**62, len(BODY), 0)
    plain = stamped._replace(stamp_ns=None)
    following = stamped._replace(kind=NEXT, stamp_ns=0, body_size=0)
    slot = stamped._replace(kind=SLOT, body_size=50_000, aux=5)
    asked = AttachKey(SOURCE, READER, True, True, 66, 1500, True)
    key = attach_key(asked, stamped=True)
    latched = pack_header(stamped) + BODY
    answer = AttachAnswer(8, latched)
    shown_key = {"kind": "A", "source": SOURCE, "stamped": True, "reader": READER}
    shown_key |= {"options": int.from_bytes(key[24:], "little")}
    return [
        Frame("message", (pack_header(stamped) + BODY).hex(), _shown(stamped) | {"body": BODY.hex()}),
        Frame("without stamp", (pack_header(plain) + BODY).hex(), _shown(plain) | {"body": BODY.hex()}),
        Frame(
            "large",
            (pack_header(plain._replace(kind=LARGE)) + BODY).hex(),
            _shown(plain._replace(kind=LARGE)) | {"body": BODY.hex()},
        ),
        Frame("next", pack_header(following).hex(), _shown(following) | {"body": ""}),
        Frame("slot", pack_header(slot).hex(), _shown(slot)),
        Frame("attach key", key.hex(), shown_key),
        Frame(
            "answer",
            answer_frame(key, answer).hex(),
            shown_key | {"next": 8, "latched": latched.hex()},
        ),
        Frame(
            "answer without latched message",
            answer_frame(key, AttachAnswer(0, b"")).hex(),
            shown_key | {"next": 0, "latched": ""},
        ),
        Frame(
            "resume key",
            resume_key(SOURCE, READER, 9, stamped=False).hex(),
            {"kind": "R", "source": SOURCE, "stamped": False, "reader": READER, "sequence": 9},
        ),
        Frame(
            "control",
            control_frame(Describe(5), 6).hex(),
            {"kind": "C", "name": "cortex/Describe", "sequence": 6, "message": {"node": 5}},
        ),
    ]


def malformed() -> list[dict[str, str]]:
    """Return frames that a subscriber of the source and type of `frames` must reject."""
    good = {frame.name: frame.frame for frame in frames()}
    message, following, answer = good["message"], good["next"], good["answer"]

    def put(frame: str, offset: int, data: str) -> str:
        return frame[: 2 * offset] + data + frame[2 * offset + len(data) :]

    bad = {
        "shorter than a header": message[:126],
        "magic": put(message, 2, "59"),
        "version": put(message, 4, "02"),
        "flags": put(message, 5, "03"),
        "header length": put(message, 6, "4800"),
        "kind": put(message, 3, "78"),
        "body shorter than it says": message[:-2],
        "body longer than it says": message + "00",
        "other fingerprint": put(message, 16, "00"),
        "a body where there is none": put(following, 48, "08") + "00" * 8,
        "an answer with more than its latched message": answer + "00",
        "an answer whose latched message is cut off": answer[:-2],
    }
    return [{"name": name, "frame": frame} for name, frame in bad.items()]


def contents() -> dict[str, Any]:
    """Return the contents of the file: `publisher` is whose frames these are. Their bodies stand for any."""
    publisher = {"source": SOURCE, "fingerprint": FINGERPRINT, "schema": SCHEMA.to_json()}
    return {"publisher": publisher, "frames": [asdict(frame) for frame in frames()], "malformed": malformed()}


def _shown(header: Header) -> dict[str, Any]:
    shown = header._asdict() | {"kind": header.kind.decode(), "stamp_ns": header.stamp_ns or 0}
    return shown | {"stamped": header.stamp_ns is not None}
