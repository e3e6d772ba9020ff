"""What a recording is made of: the names that writer and reader share.

A recording is an MCAP file. Each publisher of a topic has a channel of its own, so that its sequence numbers
mean something: message encoding `cortex` (the body of WIRE.md, section 5), schema encoding `cortex-json` (the
canonical schema of section 4), and as metadata the fingerprint, the publisher's number, its node's name and
whether it latches. `log_time` is when a message was received and `publish_time` when it was published, both
as CLOCK_REALTIME was when the recording began, advanced by CLOCK_MONOTONIC: somebody who sets the clock
meanwhile does not tear the recording apart. `sequence` holds the low 32 bits of the publisher's. The metadata
record `cortex.start` says where and when, `cortex.end` what was counted, as JSON for each topic.
"""

from __future__ import annotations

from typing import Any, NamedTuple, cast

from cortex.log.sink import Sink
from cortex.schema import Schema

PROFILE = "cortex"
MESSAGE_ENCODING = "cortex"
SCHEMA_ENCODING = "cortex-json"
FORMAT_VERSION = "1"
START, END = "cortex.start", "cortex.end"
CHUNK_BYTES = 1 << 20


class LogError(ValueError):
    """A file is no recording, or is damaged where it should not be."""


def require_mcap() -> None:
    """Refuse in words if the library is missing.

    Raises:
        ImportError: It is not installed.
    """
    try:
        import mcap  # noqa: F401
    except ImportError as error:
        raise ImportError(
            "recordings need the library mcap, which is not installed: pip install mcap"
        ) from error


def open_writer(sink: Sink, compression: str) -> Any:
    """Open the writer of the library `mcap`; the compression is "none", "lz4" or "zstd"."""
    from mcap.exceptions import UnsupportedCompressionError
    from mcap.writer import CompressionType, Writer

    try:
        return Writer(
            cast(Any, sink), chunk_size=CHUNK_BYTES, compression=CompressionType[compression.upper()]
        )
    except UnsupportedCompressionError as error:
        library = {"lz4": "lz4", "zstd": "zstandard"}[compression]
        raise ImportError(f"the compression {compression} needs: pip install {library}") from error


def add_channel(
    writer: Any,
    schemas: dict[int, int],
    topic: str,
    schema: Schema,
    *,
    source: int,
    node: str = "",
    latch: bool = False,
) -> int:
    """Add the channel of a publisher, and its schema where that is new; return MCAP's number of the channel.

    Args:
        writer: From `open_writer`.
        schemas: MCAP's numbers of those that the file has, by fingerprint; gets the new one.
        topic: Of the messages.
        schema: Of the messages.
        source: The publisher's number.
        node: Name of its node.
        latch: Whether it latches.
    """
    number = schemas.get(schema.fingerprint)
    if number is None:
        number = writer.register_schema(schema.name, SCHEMA_ENCODING, schema.to_json().encode())
        schemas[schema.fingerprint] = number
    metadata = {
        "fingerprint": f"{schema.fingerprint:016x}",
        "source": f"{source:016x}",
        "node": node,
        "latch": "1" if latch else "0",
    }
    return int(writer.register_channel(topic, MESSAGE_ENCODING, number, metadata))


class LogInfo(NamedTuple):
    """What is known of a recorded message besides its content."""

    topic: str
    node: str
    """Name of the node that published it."""
    source: int
    """The publisher's number."""
    sequence: int
    """The low 32 bits of the publisher's sequence number."""
    stamp_ns: int | None
    """The message's own time, if its type has one [ns]."""
    publish_ns: int
    """When it was published [ns since 1970]."""
    log_ns: int
    """When it was received [ns since 1970]."""
    size: int
    """Bytes of the body."""


class LogTopic(NamedTuple):
    """One topic of a recording; one of two entries if it was published with two types."""

    topic: str
    schema: Schema
    message_count: int
    """Messages."""
    nodes: tuple[str, ...]
    """Names of the nodes that published it."""
    latch: bool
    """Whether one of them gave its last message to late joiners."""
