"""Pictures that are copied once: from the renderer into the shared memory in which their readers find them.

The thread that renders asks for room, and fills it; the one that flies publishes the packet when it is due,
and nothing is left to copy. One picture at a time, so that a reader never has less room than without.

A CUDA device fills it by itself: the shared memory is pinned as long as pictures are written there.
"""

from __future__ import annotations

import logging
import threading
import weakref
from collections.abc import Callable
from typing import Any

import warp as wp
from numpy.typing import NDArray

from cortex import Loan, Publisher
from neurosim_core.runtime.pinned import PinError, PinnedMapping

_logger = logging.getLogger(__name__)
_BYTES_MIN = 1 << 16
"""Smaller pictures are copied: that takes less time than to write in place."""


class PictureLoan:
    """The slot that the next picture of one topic is written into. For any thread.

    Attributes:
        settle: Waits until pictures are there that the device may still be writing; None: they always are.
    """

    def __init__(self, publisher: Publisher[Any], *, device: str = "cpu") -> None:
        """Lend the slots of a publisher of images.

        Args:
            publisher: Whose slots.
            device: Who writes into them; for a CUDA device they are pinned.
        """
        self._publisher = publisher
        self._device = device
        self._is_cuda = bool(wp.get_device(device).is_cuda)
        self._refuses = False
        """The device cannot write into shared memory."""
        self._pinned: PinnedMapping | None = None
        """The ring that was lent from last."""
        self.settle: Callable[[], object] | None = None
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
        if picture.nbytes < _BYTES_MIN or self._refuses:
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
            if self._is_cuda and not self._pin(self._loan.memory):
                self._loan.drop()
                self._loan = None
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

    def close(self) -> None:
        """Give back the room, and let go of the memory: the topic is about to be closed."""
        with self._lock:
            self._give_back()
            self._unpin()

    def holds(self, data: NDArray[Any]) -> bool:
        """Return whether that is the room that was lent last, and not published yet."""
        return self._loan is not None and self._room is not None and self._room() is data

    def wait_for(self, data: NDArray[Any]) -> None:
        """Let the device write the picture, if that is in the room that was lent last."""
        if self.settle is not None and self.holds(data):
            self.settle()

    def publish(self, message: Any) -> bool:
        """Publish the picture that was lent room for.

        Args:
            message: Its image, with the room as data.

        Returns:
            As `Loan.publish`.

        Raises:
            Closed: The publisher was closed.
        """
        with self._lock:
            assert self._loan is not None
            if self.settle is not None:
                self.settle()
            loan, self._loan, self._room = self._loan, None, None
            return loan.publish(message)

    def _pin(self, memory: Any) -> bool:
        """Have the device know the ring that is lent from; return whether it does. The lock is held."""
        if self._pinned is not None and self._pinned.memory is memory:
            return True
        self._unpin()
        if memory is None:
            return False
        try:
            self._pinned = PinnedMapping(memory, self._device)
        except PinError as error:
            _logger.warning(
                "%s: pictures are copied once more: shared memory cannot be pinned: %s",
                self._publisher.topic,
                str(error),  # the error itself holds the memory
            )
            self._refuses = True
            return False
        return True

    def _unpin(self) -> None:
        pinned, self._pinned = self._pinned, None
        if pinned is not None:
            pinned.close()

    def _give_back(self) -> bool:
        """Return whether nothing is lent, having dropped what nobody can publish; the lock is held."""
        if self._loan is not None:
            if self._room is not None and self._room() is not None:
                return False
            self._loan.drop()
            self._loan = self._room = None
        return True
