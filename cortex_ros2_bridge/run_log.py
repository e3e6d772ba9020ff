"""Events of a simulator that a user of ROS wants to read on the bridge's console."""

from __future__ import annotations

import logging

from cortex.messages import SimulatorStatus
from cortex_ros2_bridge.tally import Tally

logger = logging.getLogger(__name__)


class RunLog:
    """Says that a run has ended, and which commands the simulator refuses."""

    def __init__(self, reset: str) -> None:
        """Begin with no simulator; `reset` is the service in ROS that begins another run."""
        self._reset = reset
        self._phase = ""
        self._refused: dict[str, Tally] = {}

    def take(self, status: SimulatorStatus) -> None:
        """Take in a status."""
        if status.phase == "ended" != self._phase:
            logger.warning("the run has ended: %s; the service %s begins another", status.reason, self._reset)
        self._phase = status.phase
        for vehicle in status.vehicles:
            tally = self._refused.setdefault(vehicle.name, Tally(f"{vehicle.name}: the simulator"))
            if vehicle.refused_count > tally.refused:
                tally.count("refused", vehicle.refused_reason, vehicle.refused_count - tally.refused)
            tally.refused = vehicle.refused_count
