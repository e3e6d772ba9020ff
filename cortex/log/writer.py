"""Writing recordings: for the recorder, and of messages that come from elsewhere, such as bags of ROS 2."""

from __future__ import annotations

import contextlib
import os
import secrets
from pathlib import Path
from typing import Any, cast

from cortex.codec import codec_of
from cortex.context import Closing
from cortex.log import format as names
from cortex.schema import Schema
from cortex.topic import check_topic
from cortex.wire import BODY_LIMIT


class Sink:
    """What the MCAP writer writes to. Each of its `write` calls holds whole records.

    Raises:
        FileExistsError: It exists.
        OSError: It cannot be made.
    """

    def __init__(self, path: Path, *, overwrite: bool = False) -> None:
        flags = os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC | (os.O_TRUNC if overwrite else os.O_EXCL)
        self._descriptor = os.open(path, flags, 0o666)
        self._position = 0

    def tell(self) -> int:
        """Bytes written so far."""
        return self._position

    def write(self, data: bytes) -> int:
        """Write all of it; if that fails, what was written of it is taken back.

        Raises:
            OSError: The disk is full, or whatever else the kernel says.
        """
        rest = memoryview(data)
        try:
            while rest:
                rest = rest[os.write(self._descriptor, rest) :]
        except OSError:
            os.ftruncate(self._descriptor, self._position)
            os.lseek(self._descriptor, self._position, os.SEEK_SET)
            raise
        self._position += len(data)
        return len(data)

    def flush(self) -> None:
        """Nothing waits here: what was written is the kernel's, and survives the death of this process."""

    def close(self) -> None:
        """Close the file."""
        if self._descriptor >= 0:
            descriptor, self._descriptor = self._descriptor, -1
            os.close(descriptor)


def open_writer(sink: Sink, compression: str) -> Any:
    """Open the writer of the library `mcap`; the compression is "none", "lz4" or "zstd"."""
    from mcap.exceptions import UnsupportedCompressionError
    from mcap.writer import CompressionType, Writer

    try:
        return Writer(
            cast(Any, sink), chunk_size=names.CHUNK_BYTES, compression=CompressionType[compression.upper()]
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

    `schemas` are MCAP's numbers of those that the file has, by fingerprint; it gets the new one.
    """
    number = schemas.get(schema.fingerprint)
    if number is None:
        number = writer.register_schema(schema.name, names.SCHEMA_ENCODING, schema.to_json().encode())
        schemas[schema.fingerprint] = number
    metadata = {
        "fingerprint": f"{schema.fingerprint:016x}",
        "source": f"{source:016x}",
        "node": node,
        "latch": "1" if latch else "0",
    }
    return int(writer.register_channel(topic, names.MESSAGE_ENCODING, number, metadata))


class LogWriter(Closing):
    """Writes a recording, which `open_log`, `cortex play` and `Player` take like one of a `Recorder`.

    Args:
        path: The file to make.
        overwrite: Replace a file that exists.

    Raises:
        ImportError: The library `mcap` is missing.
        FileExistsError: The file exists and may not be overwritten.
        OSError: It cannot be written.
    """

    def __init__(self, path: Path, *, overwrite: bool = False) -> None:
        names.require_mcap()
        self._channels: dict[tuple[str, int], tuple[int, int]] = {}
        """MCAP's number, and how many messages there are, of each topic and type."""
        self._schemas: dict[int, int] = {}
        self._last_ns = 0
        self._sink = Sink(path, overwrite=overwrite)
        self._writer: Any = open_writer(self._sink, "none")
        self._writer.start(profile=names.PROFILE, library="cortex")
        self._writer.add_metadata(names.START, {"format": names.FORMAT_VERSION})

    def write(self, topic: str, message: Any, at_ns: int) -> None:
        """Write a message.

        Args:
            topic: Like "/front/image".
            message: Of a class made by `@message`.
            at_ns: When it was published [ns since 1970]. What is earlier than the message before is played
                together with it.

        Raises:
            TypeError, ValueError: It is no message, or its values do not fit its type.
            OSError: The disk is full.
        """
        codec = codec_of(type(message))
        body = codec.encode(message, BODY_LIMIT)
        key = check_topic(topic), codec.fingerprint
        if key not in self._channels:
            source = secrets.randbits(64) | 1
            channel = add_channel(self._writer, self._schemas, topic, codec.schema, source=source)
            self._channels[key] = channel, 0
        channel, count = self._channels[key]
        self._channels[key] = channel, count + 1
        self._last_ns = max(self._last_ns, at_ns)
        self._writer.add_message(
            channel, log_time=self._last_ns, data=body, publish_time=max(at_ns, 0), sequence=count
        )

    def close(self) -> None:
        """Write the file's summary. Closing twice is allowed.

        Raises:
            OSError: The disk is full; the file is closed all the same.
        """
        writer, self._writer = self._writer, None
        if writer is not None:
            with contextlib.closing(self._sink):
                writer.finish()
