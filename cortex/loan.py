"""A message that is written in place before it is published; made by `Publisher.try_loan`."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from cortex.large import LargeSender, Slot
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
        publish: Callable[[Any, Slot, Any], bool],
        drop: Callable[[Slot], object],
    ) -> None:
        self.draft = draft
        self._slot: Slot | None = slot
        self._room = room
        self._publish = publish
        self._drop = drop

    @property
    def memory(self) -> Any:
        """The mapping in which the arrays of the draft lie; None if they are private, or the loan has ended.

        For who has to tell a device about it. Whoever keeps it keeps it mapped.
        """
        slot = self._slot
        return None if slot is None or slot.ring is None else slot.ring.memory

    def publish(self, message: Any = None) -> bool:
        """Send the message.

        Args:
            message: What to send in place of the draft, in half the time: one whose arrays are those of the
                draft, where they are. Others are copied, if they fit. One that begins where that of the draft
                does and has other dimensions is sent as it is, or raises a `ValueError`: do not rely on it.

        Returns:
            As `Publisher.publish`; False, too, if its slot was given up for larger ones meanwhile, and there
            is no other: every subscriber loses it.

        Raises:
            TypeError: The message is of another type; the loan is dropped.
            ValueError: A field is not set, or does not fit; the loan is dropped.
            RuntimeError: It was published or dropped before.
            Closed: The publisher was closed; the loan is dropped.
        """
        slot = self._end()
        if slot is None:
            raise RuntimeError("this loan was published or dropped before")
        return self._publish(self.draft, slot, message)

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


def lend(
    slot: Slot,
    make_draft: Callable[[np.ndarray], Any],
    publish: Callable[[Any, Slot, Any], bool],
    large: LargeSender,
    warn: Callable[[], object],
) -> Loan:
    """Begin a message in a slot, which is given back if that fails.

    Args:
        slot: Where it is written.
        make_draft: Makes the draft in the slot's memory.
        publish: Sends the draft, which lies in the slot, or the message in its place.
        large: Takes the slot back.
        warn: Called when the loan was forgotten, by the garbage collector.
    """
    room = None if slot.ring is None else slot.ring.room(slot.number)
    try:
        draft = make_draft(slot.buffer if room is None else room.view(np.ndarray))
    except BaseException:
        large.give_back(slot)
        raise
    if room is not None:
        room.on_forgotten = partial(_recall, slot, large, warn)
    return Loan(draft, slot, room, publish=publish, drop=large.give_back)


def _recall(slot: Slot, large: LargeSender, warn: Callable[[], object]) -> None:
    """Take back the slot of a loan that nobody can publish any more; takes no lock, see `Room`."""
    large.give_back(slot)
    warn()
