from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

INTERFACE: int

class Flat:
    slots: RingReader | None
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
    ring: Broadcast | None
    prepare: Callable[[int], None]
    large_acquire: Callable[[bool], bool]
    large_release: Callable[[], None]
    finish: Callable[[Any, int, int, int], bool]
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
    def dissolve(self) -> None: ...
    def in_the_way(self, size: int, /) -> list[int]: ...
    def give_up(self, member: int, /) -> None: ...
    slots: int
    slot_bytes: int
    def provide(self, slots: int, slot_bytes: int, /) -> None: ...
    def acquire(self, size: int, /) -> Slot | None: ...
    def commit(self, slot: Slot, header: bytes, /) -> bool: ...
    def behind(self) -> list[int]: ...
    def leased(self) -> int: ...
    def close(self) -> None: ...

class Slot:
    number: int
    memory: Any
    is_current: bool
    on_forgotten: Callable[[], object] | None
    def release(self) -> None: ...

class RingReader:
    broken: bool
    ended: bool
    is_crowded: bool
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
    def take_body(self) -> NDArray[np.uint8] | None: ...
    def pass_over(self) -> None: ...
    def close(self) -> None: ...
