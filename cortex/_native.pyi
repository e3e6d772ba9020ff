from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

INTERFACE: int

class Flat:
    slots: SlotView | None
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
        may_wait: bool,
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
    ledger: Ledger | None
    prepare: Callable[[int], None]
    large_acquire: Callable[[bool], bool]
    large_release: Callable[[], None]
    finish: Callable[[int, int, int, int], bool]
    sequence: int
    bytes: int
    refresh_ns: int
    records: list[Any] | None
    batch_bytes: int
    batch_start_ns: int
    batch_count_max: int
    batch_bytes_max: int
    batch_ns_max: int
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

def listen(path: str, /) -> int: ...
def accept(listener: int, /) -> int: ...
def hear(socket: int, /) -> tuple[int, int, int, int]: ...

class Broadcast:
    def __init__(self, source: int, again: type[BaseException]) -> None: ...
    def add(self, socket: int, page: int, bell: int, strict: bool, first: int, /) -> int: ...
    def remove(self, member: int, /) -> None: ...
    def send(self, frame: bytes, flags: int = 0, /) -> bool: ...
    def end(self, frame: bytes, /) -> None: ...
    def in_the_way(self, size: int, /) -> list[int]: ...
    def give_up(self, member: int, /) -> None: ...
    def close(self) -> None: ...

class RingReader:
    broken: bool
    fd: int
    def __init__(
        self,
        path: str,
        source: int,
        number: int,
        socket_fd: int,
        receive: Callable[[int], bytes],
        again: type[BaseException],
        wait_ms: int,
    ) -> None: ...
    def receive(self, flags: int, /) -> bytes: ...
    def welcomed(self) -> int | None: ...
    def close(self) -> None: ...

class Ledger:
    def __init__(
        self,
        memory: Any,
        slots: int,
        slot_bytes: int,
        leases: int,
        headers: int,
        first: int,
        ring: int,
        head: bytes,
        place: bytes,
    ) -> None: ...
    def acquire(self) -> int: ...
    def commit(self, slot: int, sequence: int, size: int, mask: int, /) -> None: ...
    def abandon(self, slot: int, /) -> None: ...
    def is_writing(self, slot: int, /) -> bool: ...
    def revoke(self, slot: int, mask: int, /) -> None: ...
    def pin(self, slot: int, /) -> None: ...
    def unpin(self, slot: int, /) -> None: ...
    def outstanding(self, column: int, /) -> int: ...
    def has_room(self, column: int, quota: int, /) -> bool: ...
    def free_column(self, column: int, /) -> None: ...
    def is_busy(self) -> bool: ...
    def plan(self, grants: list[tuple[int, int]], /) -> None: ...
    def keep(self) -> None: ...
    def close(self) -> None: ...

class SlotView:
    def __init__(
        self,
        head: Any,
        memory: Any,
        delivered: Any,
        slots: int,
        slot_bytes: int,
        leases: int,
        headers: int,
        ring: int,
        column: int,
    ) -> None: ...
    def lease(self, slot: int, sequence: int, size: int, /) -> NDArray[np.uint8] | None: ...

class Lease: ...
