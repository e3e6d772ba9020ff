"""Who listens: what nobody listens to is not computed."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence

from neurosim_core.live.craft import Craft
from neurosim_core.live.status import Board

LOOK_INTERVAL_S = 0.02
"""How often it is looked, at most [s]."""
SETTLE_S = 0.1
"""For so long nobody must have come or gone before time begins [s]."""
SETTLE_MAX_S = 2.0


class Audience:
    """Keeps the vehicles' sensors on and off as others come and go."""

    def __init__(self, crafts: Sequence[Craft], board: Board) -> None:
        """Begin with nobody.

        Args:
            crafts: The vehicles.
            board: What is said besides.
        """
        self._crafts = crafts
        self._board = board
        self._counts: tuple[int, ...] = ()
        self._changed_s = self._looked_s = 0.0

    def look(self) -> None:
        """Look, if the last time is long enough ago."""
        if time.monotonic() - self._looked_s >= LOOK_INTERVAL_S:
            self._look()

    def settle(self, stop: threading.Event) -> None:
        """Wait until nobody comes or goes any more: who sends the first command may have just subscribed.

        Args:
            stop: Ends the wait.
        """
        give_up_s = time.monotonic() + SETTLE_MAX_S
        while not stop.is_set() and time.monotonic() < give_up_s:
            self._look()
            left_s = self._changed_s + SETTLE_S - time.monotonic()
            if left_s <= 0.0:
                return
            stop.wait(min(left_s, SETTLE_S / 10))

    def _look(self) -> None:
        self._looked_s = time.monotonic()
        counts = (self._board.look(), *(count for craft in self._crafts for count in craft.look()))
        if counts != self._counts:
            self._counts, self._changed_s = counts, self._looked_s
