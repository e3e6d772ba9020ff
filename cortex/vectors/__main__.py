"""Write the test vectors anew: `python -m cortex.vectors`."""

from __future__ import annotations

import json
import sys
from typing import Any

from cortex import messages, records
from cortex.codec import codec_of
from cortex.message import is_message
from cortex.schema import schema_of
from cortex.vectors import DIRECTORY, message_to_plain, wire_frames
from cortex.vectors.catalogue import CATALOGUE, Entry, Malformed


def vector_of(entry: Entry) -> dict[str, Any]:
    """Return the contents of the file for one type."""
    codec = codec_of(entry.type)
    bodies = {name: _encode(entry, value) for name, value in entry.cases.items()}
    return {
        "schema": codec.schema.to_json(),
        "fingerprint": f"{codec.fingerprint:016x}",
        "fixed_size": codec.fixed_size,
        "cases": [
            {
                "name": name,
                "value": message_to_plain(codec.schema, value),
                "body": bodies[name].hex(),
            }
            for name, value in entry.cases.items()
        ],
        "malformed": [
            {"name": bad.name, "body": damage(bodies[bad.case], bad).hex()} for bad in entry.malformed
        ],
    }


def damage(body: bytes, bad: Malformed) -> bytes:
    """Return a good body with the bytes of a malformed case."""
    data = bytes.fromhex(bad.data)
    if bad.offset + len(data) > len(body):
        raise ValueError(f"{bad.name}: offset {bad.offset} lies beyond the body of {len(body)} bytes")
    changed = body[: bad.offset] + data + body[bad.offset + len(data) :]
    return changed[: len(changed) - bad.drop] + bytes(max(0, -bad.drop))


def types() -> list[dict[str, str]]:
    """Return name, schema and fingerprint of the standard and the control messages."""
    found = [item for module in (messages, records) for item in vars(module).values()]
    schemas = [schema_of(item) for item in found if isinstance(item, type) and is_message(item)]
    return [
        {"name": schema.name, "fingerprint": f"{schema.fingerprint:016x}", "schema": schema.to_json()}
        for schema in sorted(schemas, key=lambda schema: schema.name)
    ]


def files() -> dict[str, str]:
    """Return the text of all files by name."""
    contents: dict[str, Any] = {f"{name}.json": vector_of(entry) for name, entry in CATALOGUE.items()}
    contents["types.json"] = types()
    contents["frames.json"] = wire_frames.contents()
    return {
        name: json.dumps(content, ensure_ascii=False, indent=1) + "\n" for name, content in contents.items()
    }


def _encode(entry: Entry, value: Any) -> bytes:
    body = codec_of(entry.type).encode(value, 2**20)
    if body is None:
        raise ValueError(f"a body of {entry.type.__name__} is too large for a vector")
    return body


def main() -> int:
    """Write all files and remove those that are no longer made."""
    texts = files()
    for path in DIRECTORY.glob("*.json"):
        if path.name not in texts:
            path.unlink()
    for name, text in texts.items():
        (DIRECTORY / name).write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
