"""Pictures that are copied once: from the renderer into the shared memory in which their readers find them.

The thread that renders asks for room, and fills it; the one that flies publishes the packet when it is due,
and nothing is left to copy. One picture at a time, so that a reader never has less room than without.
"""

from __future__ import annotations

import threading
import weakref
from typing import Any

from numpy.typing import NDArray

from cortex import Loan, Publisher

_BYTES_MIN = 1 << 16
"""Smaller pictures are copied: that takes less time than to write in place."""
_FIELDS = ("stamp_ns", "encoding", "frame_id", "sequence")


class PictureLoan:
    """The slot that the next picture of one topic is written into. For any thread."""

    def __init__(self, publisher: Publisher[Any]) -> None:
        """Lend the slots of a publisher of images."""
        self._publisher = publisher
        self._lock = threading.Lock()
        self._loan: Loan | None = None
        self._room: weakref.ref[NDArray[Any]] | None = None
        """What was lent; dead as soon as nobody can write there any more."""

    def lend(self, picture: NDArray[Any]) -> NDArray[Any] | None:
        """Return room for a picture, to be filled; None if there is none, or another is under way.

        Does not wait, nor for one that is being published to a reader that makes no room.

        Args:
            picture: Of the shape and dtype that is needed, shape [H, W] or [H, W, C].
        """
        if picture.nbytes < _BYTES_MIN:
            return None
        if not self._lock.acquire(blocking=False):
            return None
        try:
            if not self._give_back():
                return None
            height, width, channels = picture.shape if picture.ndim == 3 else (*picture.shape, 1)
            self._loan = self._publisher.try_loan(
                {"data": picture.dtype}, height=height, width=width, channels=channels
            )
            if self._loan is None:
                return None
            room: NDArray[Any] = self._loan.draft.data.reshape(picture.shape)
            self._room = weakref.ref(room)
            return room
        finally:
            self._lock.release()

    def drop(self) -> None:
        """Give back the room of a picture that was thrown away; not while somebody can still write there."""
        with self._lock:
            self._give_back()

    def holds(self, data: NDArray[Any]) -> bool:
        """Return whether that is the room that was lent last, and not published yet."""
        return self._loan is not None and self._room is not None and self._room() is data

    def publish(self, message: Any) -> bool:
        """Publish the picture that was lent room for.

        Args:
            message: Its image; of its data only the place is used.

        Returns:
            As `Loan.publish`.

        Raises:
            Closed: The publisher was closed.
        """
        with self._lock:
            loan, self._loan, self._room = self._loan, None, None
            assert loan is not None
            for name in _FIELDS:
                setattr(loan.draft, name, getattr(message, name))
            return loan.publish()

    def _give_back(self) -> bool:
        """Return whether nothing is lent, having dropped what nobody can publish; the lock is held."""
        if self._loan is not None:
            if self._room is not None and self._room() is not None:
                return False
            self._loan.drop()
            self._loan = self._room = None
        return True
