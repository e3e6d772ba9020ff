"""Writing recordings of messages that come from elsewhere than from nodes, such as bags of ROS 2."""

from __future__ import annotations

import contextlib
import secrets
from pathlib import Path
from types import TracebackType
from typing import Any

from cortex.codec import codec_of
from cortex.log.format import (
    FORMAT_VERSION,
    PROFILE,
    START,
    add_channel,
    open_writer,
    require_mcap,
)
from cortex.log.sink import Sink
from cortex.topic import check_topic
from cortex.wire import BODY_LIMIT


class LogWriter:
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
        require_mcap()
        self._channels: dict[tuple[str, int], tuple[int, int]] = {}
        """MCAP's number, and how many messages there are, of each topic and type."""
        self._schemas: dict[int, int] = {}
        self._last_ns = 0
        self._sink = Sink(path, overwrite=overwrite)
        self._writer: Any = open_writer(self._sink, "none")
        self._writer.start(profile=PROFILE, library="cortex")
        self._writer.add_metadata(START, {"format": FORMAT_VERSION})

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
        if body is None:
            raise ValueError(f"{topic}: the message has more than {BODY_LIMIT} bytes")
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

    def __enter__(self) -> LogWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
