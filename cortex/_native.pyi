from collections.abc import Callable
from typing import Any

class Flat:
    def __init__(
        self, cls: type, fields: list[tuple[Any, ...]], block: int, stamp: int, head: bytes
    ) -> None: ...
    def frame(self, message: Any, sequence: int, publish_ns: int, limit: int, /) -> bytes | None: ...
    def record(self, message: Any, publish_ns: int, limit: int, /) -> bytes | None: ...
    def records(self, frame: bytes, count: int, /) -> list[Any] | None: ...
    def encode(self, message: Any, limit: int, /) -> bytes | None: ...
    def read(self, frame: bytes, /) -> tuple[int, int, Any] | None: ...
    def decode(self, buffer: Any, offset: int, size: int, /) -> Any: ...
    def drain(
        self,
        receive: Callable[[int], Any],
        again: type[BaseException],
        messages: Any,
        expected: int,
        limit: int,
        latency: list[int],
        clock_offset_ns: int,
        /,
    ) -> tuple[int, int, bytes | None]: ...
    def gather(
        self,
        receive: Callable[[int], Any],
        again: type[BaseException],
        expected: int,
        limit: int,
        latency: list[int],
        clock_offset_ns: int,
        /,
    ) -> tuple[int, bytes, int, bytes | None]: ...

class Gate:
    sends: tuple[Callable[..., Any], ...]
    sequence: int
    bytes: int
    refresh_ns: int
    records: list[Any] | None
    batch_bytes: int
    batch_start_ns: int
    last_ns: int
    def __init__(
        self,
        flat: Flat,
        acquire: Callable[[], Any],
        release: Callable[[], Any],
        slowly: Callable[[Any], bool],
        retry: Callable[[Any, int], bool],
        again: type[BaseException],
        limit: int,
        flush: Callable[[], bool],
    ) -> None: ...
    def __call__(self, message: Any, /) -> bool: ...

class PipeWriter:
    def __init__(self, fd: int, again: type[BaseException]) -> None: ...
    def send(self, frame: bytes, flags: int = 0, /) -> None: ...
    def offer(self, frame: bytes, flags: int = 0, /) -> None: ...
    def flush(self) -> bool: ...
    def close(self) -> None: ...

class PipeReader:
    def __init__(
        self,
        fd: int,
        socket_fd: int,
        receive: Callable[[int], bytes],
        again: type[BaseException],
        wait_ms: int,
    ) -> None: ...
    def receive(self, flags: int, /) -> bytes: ...
