"""The messages of a burst, which a coalescing publisher collects and sends as one frame."""

from __future__ import annotations

from collections.abc import Callable

from cortex.gate import BATCH_BYTES, BATCH_COUNT, BATCH_NS, Gate
from cortex.wire import RECORD, REST


class Batch:
    """The batch of one publisher, to which its gate adds, too. The caller holds the outlets' lock.

    Args:
        head: What the frame begins with.
        gate: Counts its bytes.
        on_begin: Called with the first message of each.
    """

    def __init__(self, head: bytes, gate: Gate, on_begin: Callable[[], None] | None) -> None:
        self._head = head
        self._gate = gate
        self._on_begin = on_begin
        self.records: list[bytes] = []
        self.sequence = 0
        """Of the first message."""

    def add(self, record: bytes, now_ns: int) -> bool:
        """Add the next message; whether the batch is full, or old, and is to be sent."""
        gate = self._gate
        if not self.records:
            self.sequence = gate.sequence
            gate.batch_start_ns = now_ns
            if self._on_begin is not None:
                self._on_begin()
        gate.last_ns = now_ns
        gate.sequence += 1
        self.records.append(record)
        gate.batch_bytes += len(record)
        return len(self.records) >= BATCH_COUNT or gate.batch_bytes >= BATCH_BYTES or self.is_old(now_ns)

    def is_old(self, now_ns: int) -> bool:
        """Whether its first message has waited long enough."""
        return now_ns - self._gate.batch_start_ns >= BATCH_NS

    def take(self) -> bytes:
        """Return the frame of what was collected; the next batch begins."""
        gate, records = self._gate, b"".join(self.records)
        gate.bytes += len(records) - RECORD.size * len(self.records)
        rest = REST.pack(self.sequence, 0, gate.batch_start_ns, len(records), gate.sequence - self.sequence)
        self.records.clear()
        gate.batch_bytes = 0
        return self._head + rest + records
