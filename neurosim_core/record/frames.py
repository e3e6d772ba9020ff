"""Messages between the processes of a recording: pickled contents, and behind them arrays as they are."""

from __future__ import annotations

import io
import pickle
import socket
import struct
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

_SIZES = struct.Struct("<QQ")
_PARTS_MAX = 1000
"""More than that no system takes in one call."""
_BUFFER_BYTES = 1 << 20
"""What a connection holds, where the system allows it [bytes]: about a frame."""


def connect() -> tuple[socket.socket, socket.socket]:
    """Return the ends of a connection that holds more than usual: each time it is full wakes both sides."""
    ends = socket.socketpair()
    for end in ends:
        end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER_BYTES)
    return ends


def send_frame(link: socket.socket, bodies: Sequence[bytes], arrays: Sequence[NDArray[Any]]) -> None:
    """Send contents, each pickled, and contiguous arrays, in one call of the system.

    Raises:
        OSError: The other side is gone.
    """
    sizes = sum(map(len, bodies)), sum(array.nbytes for array in arrays)
    parts: list[Any] = [b"".join([_SIZES.pack(*sizes), *bodies]), *arrays]
    if len(parts) > _PARTS_MAX:
        parts = [b"".join(parts)]
    sent = link.sendmsg(parts)
    if sent < _SIZES.size + sum(sizes):  # a signal came
        link.sendall(b"".join(parts)[sent:])


def receive_frame(link: socket.socket) -> tuple[list[Any], NDArray[np.uint8]]:
    """Return contents, and the bytes of all arrays.

    Raises:
        EOFError: The other side is gone.
    """
    sizes = bytearray(_SIZES.size)
    _receive_into(link, [memoryview(sizes)])
    bodies, arrays = (np.empty(size, np.uint8) for size in _SIZES.unpack(sizes))
    _receive_into(link, [bodies.data, arrays.data])
    stream, contents = io.BytesIO(bodies.tobytes()), []
    while stream.tell() < bodies.size:
        contents.append(pickle.load(stream))
    return contents, arrays


def _receive_into(link: socket.socket, parts: list[memoryview]) -> None:
    """Fill all parts; one call does, unless the process was stopped and goes on, or they exceed 2 GB."""
    while parts := [part for part in parts if len(part)]:
        received = link.recvmsg_into(parts, 0, socket.MSG_WAITALL)[0]
        if received == 0:
            raise EOFError
        for index, part in enumerate(parts):
            parts[index], received = part[received:], max(0, received - len(part))
