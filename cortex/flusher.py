"""The thread that sends the tail of a burst, when a coalescing publisher falls silent."""

from __future__ import annotations

import threading
import time
from typing import Any

from cortex.context import Closed
from cortex.gate import BATCH_NS
from cortex.publisher import Publisher


class Flusher:
    """Started with the first batch; sleeps while no publisher holds anything back."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._lock = threading.Lock()
        self._pending = threading.Event()
        self._publishers: tuple[Publisher[Any], ...] = ()
        self._thread: threading.Thread | None = None
        self._closed = False

    def add(self, publisher: Publisher[Any]) -> None:
        """Look after a coalescing publisher."""
        with self._lock:
            self._publishers = (*self._publishers, publisher)
            if self._thread is None and not self._closed:
                self._thread = threading.Thread(target=self._run, name=f"{self._name} flusher", daemon=True)
                self._thread.start()

    def remove(self, publisher: Publisher[Any]) -> None:
        """Look after it no more."""
        with self._lock:
            self._publishers = tuple(p for p in self._publishers if p is not publisher)

    def wake(self) -> None:
        """A batch has been begun; called under the outlets' lock."""
        if not self._pending.is_set():
            self._pending.set()

    def _run(self) -> None:
        while not self._closed:
            self._pending.wait()
            self._pending.clear()  # before looking: a batch that begins now sets it again
            waiting, pause_s = True, BATCH_NS * 1e-9
            while waiting and not self._closed:
                time.sleep(pause_s)
                # While a stream lasts its publisher sends the batches itself. This thread takes the
                # interpreter away from it each time: it then looks less often.
                pause_s = min(2.0 * pause_s, 1e-3)
                waiting = False
                for publisher in self._publishers:
                    try:
                        waiting |= publisher.flush_old(time.monotonic_ns())
                    except Closed:
                        continue

    def close(self) -> None:
        """Stop; publishers send what they hold back when they close."""
        with self._lock:
            self._closed = True
            thread = self._thread
        self._pending.set()
        if thread is not None:
            thread.join(2.0)
