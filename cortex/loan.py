"""A message that is written in place before it is published; made by `Publisher.try_loan`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np


class Loan:
    """A slot that is being filled. Not for two threads at once. It ends with `publish` or `drop`.

    One that is forgotten gives its slot back when the last array of its draft is gone, too, with a
    `ResourceWarning`.

    Attributes:
        draft: A message with the type's fields: arrays are writable views to fill, the others are to be set.
            Its arrays must not be written after `publish` or `drop`.
    """

    def __init__(
        self, draft: Any, buffer: np.ndarray, slot: Any, publish: Callable[[Any, np.ndarray, Any, Any], bool]
    ) -> None:
        self.draft = draft
        self._buffer: np.ndarray | None = buffer
        self._slot = slot
        self._publish = publish

    @property
    def memory(self) -> Any:
        """The mapping in which the arrays of the draft lie; None if they are private, or the loan has ended.

        For who has to tell a device about it. Whoever keeps it keeps it mapped.
        """
        return None if self._slot is None else self._slot.memory

    def publish(self, message: Any = None) -> bool:
        """Send the message.

        Args:
            message: What to send in place of the draft, in half the time: one whose arrays are those of the
                draft, where they are. Any other is copied, as by `Publisher.publish`; so is each one if its
                type has arrays of fixed shape, or where a subscriber reads through a socket.

        Returns:
            As `Publisher.publish`.

        Raises:
            TypeError: The message is of another type; the loan is dropped.
            ValueError: A field is not set, or does not fit; the loan is dropped.
            RuntimeError: It was published or dropped before.
            Closed: The publisher was closed; the loan is dropped.
        """
        buffer, slot = self._end()
        if buffer is None:
            raise RuntimeError("this loan was published or dropped before")
        try:
            return self._publish(self.draft, buffer, slot, message)
        finally:
            if slot is not None:
                slot.release()  # does nothing if it was sent

    def drop(self) -> None:
        """Give the slot back unpublished; does nothing after `publish`."""
        _, slot = self._end()
        if slot is not None:
            slot.release()

    def _end(self) -> tuple[np.ndarray | None, Any]:
        buffer, slot, self._buffer, self._slot = self._buffer, self._slot, None, None
        if slot is not None:
            slot.on_forgotten = None
        return buffer, slot
