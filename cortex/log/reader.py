"""Reading recordings, whole ones and those that were cut off."""

from __future__ import annotations

import contextlib
import os
import struct
import zlib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, NamedTuple

from cortex.codec import codec_of
from cortex.context import Closing
from cortex.layout import measure_fields
from cortex.log.format import (
    END,
    MESSAGE_ENCODING,
    SCHEMA_ENCODING,
    START,
    LogError,
    LogInfo,
    LogTopic,
    require_mcap,
)
from cortex.schema import SCALAR_CODES, Schema, SchemaError, TypeMismatch, schema_of, type_from_schema

if TYPE_CHECKING:
    from mcap import records
    from mcap.summary import Summary

MAGIC = b"\x89MCAP0\r\n"
_FRAME = struct.Struct("<BQ")
_FOOTER = struct.Struct("<BQQQI")
_MESSAGE = struct.Struct("<HIQQ")
_CHUNK_HEAD = struct.Struct("<QQQII")
_INDEX_HEAD = struct.Struct("<HI")
_INDEX_ENTRY_BYTES = 16
_CHUNK_MAX = 4 << 30


class _Channel(NamedTuple):
    topic: str
    schema: Schema
    node: str
    source: int
    latch: bool
    stamp: tuple[struct.Struct, int] | None
    """How and where in a body the stamp lies."""


@dataclass(slots=True)
class _Chunk:
    position: int
    start_ns: int
    end_ns: int
    counts: dict[int, int] = field(default_factory=dict)
    """Messages by channel; empty if the file does not say."""


@dataclass(slots=True)
class _Contents:
    """What is where in a file."""

    chunks: list[_Chunk] = field(default_factory=list)
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    counts: dict[int, int] = field(default_factory=dict)
    schemas: dict[int, records.Schema] = field(default_factory=dict)
    channels: dict[int, records.Channel] = field(default_factory=dict)
    cut: str = ""


class Log(Closing):
    """A recording that is open for reading; made by `open_log`. One thread at a time may use it."""

    def __init__(self, path: Path, file: BinaryIO) -> None:
        self.path = path
        self._file = file
        self._size = os.fstat(file.fileno()).st_size
        contents = _read_contents(file, self._size)
        self.cut = contents.cut
        """What is missing at the end, in words; empty for a recording that was closed in an orderly way."""
        self.start = contents.metadata.get(START, {})
        """Where and when it was recorded."""
        self.end = contents.metadata.get(END, {})
        """What the recorder counted, JSON by topic; empty if it was cut off."""
        self._chunks = contents.chunks
        self._channels, foreign = _known_channels(contents)
        self.foreign = tuple(sorted(foreign))
        """Topics in another encoding than that of Cortex, which are passed over."""
        self.topics = _summarise(self._channels, contents.counts)
        self.message_count = sum(topic.message_count for topic in self.topics)
        known = [chunk for chunk in self._chunks if chunk.end_ns]
        self.start_ns = min((chunk.start_ns for chunk in known), default=0)
        """When the first message was received [ns since 1970]; 0 if there is none."""
        self.end_ns = max((chunk.end_ns for chunk in known), default=0)

    @property
    def duration_s(self) -> float:
        """Time from the first to the last message [s]."""
        return (self.end_ns - self.start_ns) * 1e-9

    def raw(
        self, topics: Iterable[str] | None = None, *, start_s: float = 0.0, end_s: float | None = None
    ) -> Iterator[tuple[LogInfo, bytes, Schema]]:
        """Messages as the bytes of their bodies, in the order in which they were received.

        Args:
            topics: Which; None takes all.
            start_s: From this time after the first message on [s].
            end_s: Before this time after the first message [s]; None: to the end.

        Raises:
            ValueError: A topic is not in the recording.
            LogError: The file is damaged in the middle.
        """
        wanted = self._select(topics)
        first_ns = self.start_ns + round(start_s * 1e9)
        last_ns = None if end_s is None else self.start_ns + round(end_s * 1e9)
        for chunk in self._chunks:
            if chunk.end_ns < first_ns or (last_ns is not None and chunk.start_ns >= last_ns):
                continue
            if chunk.counts and not wanted.keys() & chunk.counts.keys():
                continue
            for number, sequence, log_ns, publish_ns, body in self._messages_of(chunk):
                channel = wanted.get(number)
                if channel is None or log_ns < first_ns or (last_ns is not None and log_ns >= last_ns):
                    continue
                who, stamp_ns = (channel.topic, channel.node, channel.source), _stamp_in(channel, body)
                yield LogInfo(*who, sequence, stamp_ns, publish_ns, log_ns, len(body)), body, channel.schema

    def messages(
        self,
        topics: Iterable[str] | None = None,
        *,
        types: Mapping[str, type] | None = None,
        start_s: float = 0.0,
        end_s: float | None = None,
    ) -> Iterator[tuple[str, Any, LogInfo]]:
        """Messages decoded, each with its topic and what is known of it; see `raw`.

        Args:
            topics: Which; None takes all, or those in `types`.
            types: The class to decode a topic's messages with; others get one made from the recorded schema.
            start_s: As in `raw`.
            end_s: As in `raw`.

        Raises:
            TypeMismatch: A topic was recorded with another type than the one in `types`.
            MalformedMessage: A publisher had sent a body that is none of its type.
        """
        types = types or {}
        chosen = list(topics) if topics is not None else list(types) or None
        for topic in types:
            for entry in self.topics:
                if entry.topic == topic and entry.schema != schema_of(types[topic]):
                    what = f"{self.path}: {topic} was recorded with another type"
                    raise TypeMismatch(what, schema_of(types[topic]), entry.schema)
        for info, body, schema in self.raw(chosen, start_s=start_s, end_s=end_s):
            kind = types.get(info.topic) or type_from_schema(schema)
            yield info.topic, codec_of(kind).decode(body), info

    def _select(self, topics: Iterable[str] | None) -> dict[int, _Channel]:
        if topics is None:
            return self._channels
        wanted = set(topics)
        present = {channel.topic for channel in self._channels.values()}
        if wanted - present:
            raise ValueError(
                f"{self.path} has no topic {', '.join(sorted(wanted - present))}; "
                f"it has {', '.join(sorted(present)) or 'none'}"
            )
        return {number: channel for number, channel in self._channels.items() if channel.topic in wanted}

    def _messages_of(self, chunk: _Chunk) -> Iterator[tuple[int, int, int, int, bytes]]:
        """Channel, sequence, log time, publish time and body, one by one: a player must not wait for all."""
        data = _read_chunk(self._file, chunk.position, self._size)
        yield from (
            (*_MESSAGE.unpack_from(payload), bytes(payload[_MESSAGE.size :]))
            for payload in _payloads(data, _opcodes().MESSAGE, chunk.position)
        )

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def open_log(path: str | os.PathLike[str]) -> Log:
    """Open a recording.

    One that was cut off (the recorder was killed, the disk was full) is read up to its last whole record;
    `cut` then says what is missing.

    Raises:
        ImportError: The library `mcap` is missing.
        OSError: The file cannot be read.
        LogError: It is no recording.
    """
    require_mcap()
    path = Path(path)
    file = open(path, "rb")  # noqa: SIM115 - the log closes it
    try:
        return Log(path, file)
    except BaseException as error:
        file.close()
        if isinstance(error, LogError):
            raise LogError(f"{path}: {error}") from error
        raise


# What is where


def _read_contents(file: BinaryIO, size: int) -> _Contents:
    if file.read(len(MAGIC)) != MAGIC:
        raise LogError("not an MCAP file")
    file.seek(max(len(MAGIC), size - len(MAGIC)))
    if file.read() == MAGIC and _is_summary_whole(file, size):
        contents = _from_summary(file)
        if contents is not None:
            return contents
    return _scan(file, size)


def _is_summary_whole(file: BinaryIO, size: int) -> bool:
    """Whether the check sum of summary and footer is right; the library does not look at it."""
    footer_at = size - len(MAGIC) - _FOOTER.size
    if footer_at < len(MAGIC):
        return False
    file.seek(footer_at)
    code, length, summary_at, _, expected = _FOOTER.unpack(file.read(_FOOTER.size))
    if code != _opcodes().FOOTER or length != _FOOTER.size - _FRAME.size:
        return False
    if not len(MAGIC) <= summary_at <= footer_at:
        return False  # 0: there is none
    file.seek(summary_at)
    checksum, left = 0, footer_at + _FOOTER.size - 4 - summary_at
    while left > 0 and (block := file.read(min(left, 1 << 20))):  # a wrong number may claim the whole file
        checksum = zlib.crc32(block, checksum)
        left -= len(block)
    return expected in (0, checksum)


def _from_summary(file: BinaryIO) -> _Contents | None:
    from mcap.reader import SeekingReader

    file.seek(0)
    reader = SeekingReader(file, validate_crcs=True)
    with _damage("its summary cannot be read"):
        summary: Summary | None = reader.get_summary()
        if summary is None or summary.statistics is None:
            return None
        if summary.statistics.chunk_count != len(summary.chunk_indexes):
            return None
        metadata = {record.name: record.metadata for record in reader.iter_metadata()}
    chunks = [
        # Which channels a chunk holds is known, how often each is not: 1 stands for "some".
        _Chunk(
            index.chunk_start_offset,
            index.message_start_time,
            index.message_end_time,
            dict.fromkeys(index.message_index_offsets, 1),
        )
        for index in sorted(summary.chunk_indexes, key=lambda index: index.chunk_start_offset)
    ]
    counts = dict(summary.statistics.channel_message_counts)
    return _Contents(chunks, metadata, counts, summary.schemas, summary.channels)


def _scan(file: BinaryIO, size: int) -> _Contents:
    """Walk through a file without summary, up to its last whole record; bodies are passed over."""
    opcode = _opcodes()
    contents = _Contents()
    position = len(MAGIC)
    while True:
        file.seek(position)
        frame = file.read(_FRAME.size)
        if len(frame) < _FRAME.size or frame[0] == 0:
            break
        code, length = _FRAME.unpack(frame)
        end = position + _FRAME.size + length
        if code == opcode.DATA_END:
            contents.cut = "its summary is missing or damaged"
            break
        if end > size:
            break
        with _damage(f"the record at byte {position} is damaged"):
            if code == opcode.CHUNK:
                start_ns, end_ns = _CHUNK_HEAD.unpack(file.read(_CHUNK_HEAD.size))[:2]
                contents.chunks.append(_Chunk(position, start_ns, end_ns))
            elif code == opcode.MESSAGE_INDEX and contents.chunks:
                channel, size_of_entries = _INDEX_HEAD.unpack(file.read(_INDEX_HEAD.size))
                contents.chunks[-1].counts[channel] = size_of_entries // _INDEX_ENTRY_BYTES
            elif code == opcode.METADATA:
                record = _record_types()["Metadata"](_stream(file.read(length)))
                contents.metadata[record.name] = record.metadata
        position = end
    missing = size - position
    if not contents.cut:
        contents.cut = "it was not closed" + (f", its last {missing} bytes are incomplete" if missing else "")
    _learn_channels(file, size, contents)
    return contents


def _learn_channels(file: BinaryIO, size: int, contents: _Contents) -> None:
    """Read the chunks in which a channel appears first, and those without index."""
    opcode, read = _opcodes(), _record_types()
    for chunk in contents.chunks:
        indexed = bool(chunk.counts)
        if not indexed or chunk.counts.keys() - contents.channels.keys():
            data = _read_chunk(file, chunk.position, size)
            with _damage(f"the chunk at byte {chunk.position} is damaged"):
                for payload in _payloads(data, opcode.SCHEMA, chunk.position):
                    schema = read["Schema"](_stream(payload))
                    contents.schemas[schema.id] = schema
                for payload in _payloads(data, opcode.CHANNEL, chunk.position):
                    channel = read["Channel"](_stream(payload))
                    contents.channels[channel.id] = channel
            for payload in () if indexed else _payloads(data, opcode.MESSAGE, chunk.position):
                number = _MESSAGE.unpack_from(payload)[0]
                chunk.counts[number] = chunk.counts.get(number, 0) + 1
        for number, count in chunk.counts.items():
            contents.counts[number] = contents.counts.get(number, 0) + count


def _known_channels(contents: _Contents) -> tuple[dict[int, _Channel], set[str]]:
    known, foreign = {}, set()
    for number, record in contents.channels.items():
        schema_record = contents.schemas.get(record.schema_id)
        encodings = (record.message_encoding, schema_record.encoding if schema_record else "")
        if schema_record is None or encodings != (MESSAGE_ENCODING, SCHEMA_ENCODING):
            foreign.add(record.topic)
            continue
        try:
            schema = Schema.from_json(schema_record.data.decode())
            source = int(record.metadata.get("source", "0"), 16)
            fingerprint = record.metadata.get("fingerprint", f"{schema.fingerprint:016x}")
            if fingerprint != f"{schema.fingerprint:016x}":
                raise SchemaError(f"its schema has not the fingerprint {fingerprint!r:.40}")
        except (SchemaError, ValueError) as error:
            raise LogError(f"channel {record.topic}: {error}") from error
        node, latch = record.metadata.get("node", ""), record.metadata.get("latch") == "1"
        known[number] = _Channel(record.topic, schema, node, source, latch, _stamp_place(schema))
    return known, foreign


def _summarise(channels: Mapping[int, _Channel], counts: Mapping[int, int]) -> tuple[LogTopic, ...]:
    topics: dict[tuple[str, int], LogTopic] = {}
    for number, channel in channels.items():
        key = (channel.topic, channel.schema.fingerprint)
        topic = topics.get(key) or LogTopic(channel.topic, channel.schema, 0, (), latch=False)
        topics[key] = topic._replace(
            message_count=topic.message_count + counts.get(number, 0),
            nodes=tuple(dict.fromkeys((*topic.nodes, channel.node))),
            latch=topic.latch or channel.latch,
        )
    return tuple(topics[key] for key in sorted(topics))


def _stamp_place(schema: Schema) -> tuple[struct.Struct, int] | None:
    k = schema.stamp_index
    if k < 0:
        return None
    return struct.Struct(f"<{SCALAR_CODES[str(schema.fields[k].type)]}"), measure_fields(schema)[0][k]


def _stamp_in(channel: _Channel, body: bytes) -> int | None:
    if channel.stamp is None:
        return None
    layout, offset = channel.stamp
    if len(body) < offset + layout.size:
        raise LogError(f"a message of {channel.topic} has {len(body)} bytes, too few for its stamp")
    return int(layout.unpack_from(body, offset)[0])


# Records


def _read_chunk(file: BinaryIO, position: int, size: int) -> bytes:
    file.seek(position)
    with _damage(f"the chunk at byte {position} is damaged"):
        code, length = _FRAME.unpack(file.read(_FRAME.size))
        if code != _opcodes().CHUNK or position + _FRAME.size + length > size:
            raise LogError("it is not there")
        chunk = _record_types()["Chunk"](_stream(file.read(length)))
        if chunk.uncompressed_size > _CHUNK_MAX:
            raise LogError(f"it claims {chunk.uncompressed_size} bytes")
        data = _decompress(chunk.compression, chunk.data, chunk.uncompressed_size)
        if chunk.uncompressed_crc not in (0, zlib.crc32(data)):
            raise LogError("its check sum is wrong")
        return data


def _decompress(compression: str, data: bytes, size: int) -> bytes:
    """Return a chunk's data; no more than the size that it claims is ever unpacked."""
    if compression == "lz4":
        from lz4.frame import LZ4FrameDecompressor

        unpacked = LZ4FrameDecompressor().decompress(data, max_length=size + 1)
    elif compression == "zstd":
        from zstandard import ZstdDecompressor

        with ZstdDecompressor().stream_reader(data) as reader:
            unpacked = reader.read(size + 1)
    else:
        unpacked = data
    if len(unpacked) != size:
        more = "more" if len(unpacked) > size else str(len(unpacked))
        raise LogError(f"it has {more} bytes uncompressed and claims {size}")
    return bytes(unpacked)


def _payloads(data: bytes, wanted: int, position: int) -> Iterator[memoryview]:
    view, at = memoryview(data), 0
    shortest = _MESSAGE.size if wanted == _opcodes().MESSAGE else 0
    while at < len(data):
        if at + _FRAME.size > len(data):
            raise LogError(f"the chunk at byte {position} ends within a record")
        code, length = _FRAME.unpack_from(data, at)
        at += _FRAME.size
        if at + length > len(data) or (code == wanted and length < shortest):
            raise LogError(f"the chunk at byte {position} has a record of {length} bytes that does not fit")
        if code == wanted:
            yield view[at : at + length]
        at += length


def _opcodes() -> Any:
    from mcap.opcode import Opcode

    return Opcode


def _record_types() -> Mapping[str, Any]:
    from mcap import records

    return {name: getattr(records, name).read for name in ("Channel", "Chunk", "Metadata", "Schema")}


def _stream(data: bytes | memoryview) -> Any:
    from mcap.data_stream import ReadDataStream

    return ReadDataStream(BytesIO(data))


@contextlib.contextmanager
def _damage(what: str) -> Iterator[None]:
    """Turn whatever the library raises on damaged bytes into a `LogError` that says where."""
    from mcap.exceptions import McapError

    # ValueError is a wrong check sum or text, RuntimeError comes from lz4, the others from wrong numbers.
    wrong_numbers = (struct.error, OverflowError, EOFError, MemoryError, OSError)
    try:
        yield
    except Exception as error:
        kinds = (McapError, ValueError, RuntimeError, *wrong_numbers)
        if isinstance(error, kinds) or type(error).__name__ == "ZstdError":
            raise LogError(f"{what}: {error}") from error
        raise
