"""A message that is written in place before it is published; made by `Publisher.try_loan`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from cortex.large import Slot
from cortex.shm import Room


class Loan:
    """A slot that is being filled. Not for two threads at once. It ends with `publish` or `drop`.

    One that is forgotten gives its slot back when the last array of its draft is gone, too, with a
    `ResourceWarning`.

    Attributes:
        draft: A message with the type's fields: arrays are writable views to fill, the others are to be set.
            Its arrays must not be written after `publish` or `drop`.
    """

    def __init__(
        self,
        draft: Any,
        slot: Slot,
        room: Room | None,
        *,
        inline: bool,
        publish: Callable[[Any, Slot, bool], bool],
        drop: Callable[[Slot], object],
    ) -> None:
        self.draft = draft
        self._slot: Slot | None = slot
        self._room = room
        self._inline = inline
        self._publish = publish
        self._drop = drop

    def publish(self) -> bool:
        """Send the message.

        Returns:
            As `Publisher.publish`; False, too, if its slot was given up for larger ones meanwhile, and there
            is no other: every subscriber loses it.

        Raises:
            ValueError: A field is not set, or does not fit; the loan is dropped.
            RuntimeError: It was published or dropped before.
            Closed: The publisher was closed; the loan is dropped.
        """
        slot = self._end()
        if slot is None:
            raise RuntimeError("this loan was published or dropped before")
        return self._publish(self.draft, slot, self._inline)

    def drop(self) -> None:
        """Give the slot back unpublished; does nothing after `publish`."""
        slot = self._end()
        if slot is not None:
            self._drop(slot)

    def _end(self) -> Slot | None:
        slot, self._slot = self._slot, None
        if self._room is not None:
            self._room.on_forgotten = None
        return slot
