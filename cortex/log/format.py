"""The format of recordings: the names that writer and reader share.

A recording is an MCAP file. Each publisher of a topic has a channel of its own, so that its sequence numbers
mean something: message encoding `cortex` (the body of WIRE.md, section 5), schema encoding `cortex-json` (the
canonical schema of section 4), and as metadata the fingerprint, the publisher's number, its node's name and
whether it latches. `log_time` is when a message was received and `publish_time` when it was published, both
as CLOCK_REALTIME was when the recording began, advanced by CLOCK_MONOTONIC: somebody who sets the clock
meanwhile does not tear the recording apart. `sequence` holds the low 32 bits of the publisher's. The metadata
record `cortex.start` says where and when, `cortex.end` what was counted, as JSON for each topic.
"""

from __future__ import annotations

from typing import NamedTuple

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


class LogInfo(NamedTuple):
    """What is known of a recorded message besides its content."""

    topic: str
    node: str
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


class LogTopic(NamedTuple):
    """One topic of a recording; one of two entries if it was published with two types."""

    topic: str
    schema: Schema
    message_count: int
    nodes: tuple[str, ...]
    latch: bool
    """Whether one of them gave its last message to late joiners."""
