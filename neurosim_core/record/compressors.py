"""Processes that compress chunks for the one that writes a recording.

Threads would do, but for the interpreter's lock: a chunk takes it dozens of times, and each time waits for
all others. A thread for each process asks for it thrice.
"""

from __future__ import annotations

import itertools
import os
import pickle
import queue
import socket
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurosim_core.record.columns import deflate
from neurosim_core.record.frames import connect, receive_frame, send_frame


class Compressors:
    """Processes that are forked from this one, which must not have threads yet; they end with it."""

    def __init__(self, count: int) -> None:
        self.count = count
        self._idle: queue.SimpleQueue[socket.socket] = queue.SimpleQueue()
        for _ in range(count):
            ours, theirs = connect()
            if os.fork() == 0:
                os.closerange(0, 3)  # the end of this process must be seen by those who have them
                ours.close()
                _serve(theirs)
            theirs.close()
            self._idle.put(ours)

    def deflate(self, columns: Sequence[tuple[Sequence[NDArray[Any]], int]]) -> list[list[Any]]:
        """Return what `columns.deflate` does; from as many threads at a time as there are processes.

        Raises:
            OSError: A process has ended.
        """
        link = self._idle.get()
        try:
            forms = [(parts[0].dtype.str, parts[0].shape[1:], length) for parts, length in columns]
            counts = [sum(map(len, parts)) for parts, _ in columns]
            arrays = [np.ascontiguousarray(part) for parts, _ in columns for part in parts]
            send_frame(link, [pickle.dumps((forms, counts))], arrays)
            (sizes,), data = receive_frame(link)
        except (EOFError, OSError):
            raise OSError("a process that compresses has ended") from None
        finally:
            self._idle.put(link)
        ends = itertools.accumulate(itertools.chain(*sizes))
        return [[data[end - size : end] for size, end in zip(column, ends, strict=False)] for column in sizes]


def _serve(link: socket.socket) -> None:
    """Compress what comes, and end the process when nobody asks any more."""
    try:
        while True:
            ((forms, counts),), data = receive_frame(link)
            columns, begin = [], 0
            for (dtype, shape, length), count in zip(forms, counts, strict=True):
                rows: NDArray[Any] = np.ndarray((count, *shape), dtype, data, begin)
                columns.append(([rows], length))
                begin += rows.nbytes
            chunks = deflate(columns)
            body = pickle.dumps([[*map(len, column)] for column in chunks])
            send_frame(link, [body], [np.frombuffer(b"".join(itertools.chain(*chunks)), np.uint8)])
    finally:
        os._exit(0)
