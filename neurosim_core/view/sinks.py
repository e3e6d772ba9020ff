"""Sinks that draw a flight: its Rerun file and its overview."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from neurosim_core.clock import NS_PER_S
from neurosim_core.packets import Odometry, Packet
from neurosim_core.sinks import SinkContext
from neurosim_core.view.overview import FlightSummary, Track
from neurosim_core.view.overview_plot import save_overview
from neurosim_core.view.rerun_log import RerunLogger
from neurosim_core.view.rerun_sdk import RerunStream, Table
from neurosim_core.view.rerun_shapes import scene_shapes

_CHECK_S = 1.0
_CLEARANCE_NS = 100_000_000
"""How much flight is asked for its distances at once."""


class RerunSink:
    """Writes the Rerun file of a flight, with the distance to what is nearest."""

    def __init__(self, file: Path, context: SinkContext) -> None:
        """Open the file, and write what does not change."""
        model = context.model
        self._free_space = model.free_space
        self._vehicle = next(iter(model.config.vehicles))
        self._positions = Table("clearance", self._log_clearance, span_ns=_CLEARANCE_NS)
        self._checked_s = 0.0
        self._closed = False
        self._logger = RerunLogger(
            RerunStream(file),
            vehicles={self._vehicle: context.header.sensors},
            scene=scene_shapes(model.scene, model.bodies),
        )
        self._logger.log_path(context.header.path_position)

    def write(self, packet: Packet) -> None:
        """Log a packet."""
        self._logger.log(packet)
        if isinstance(packet, Odometry):
            self._positions.append(packet.stamp_ns, position=packet.position)
        if time.monotonic() - self._checked_s >= _CHECK_S:
            self._checked_s = time.monotonic()
            self._logger.check()

    def close(self, *, complete: bool = True) -> None:
        """Complete the file."""
        if not self._closed:
            self._closed = True
            if complete:
                self._positions.send()
            self._logger.close()

    def _log_clearance(self, name: str, stamp_ns: NDArray[np.int64], position: NDArray[np.float64]) -> None:
        """Plot the distance to what is nearest."""
        for stamp, clearance_m in zip(stamp_ns, self._free_space.clearance(position), strict=True):
            self._logger.log_values(f"plots/{self._vehicle}/{name}", int(stamp), {name: float(clearance_m)})


class OverviewSink:
    """Draws a flight when it has ended."""

    def __init__(self, file: Path, context: SinkContext) -> None:
        """Start empty."""
        self._file, self._model = file, context.model
        self._summary = FlightSummary(context.header.sensors)
        self._begin_s = self._end_s = context.begin_s
        self._stamp_ns = 0
        self._has_pose = self._closed = False

    def write(self, packet: Packet) -> None:
        """Take a packet."""
        self._summary.log(packet)
        self._end_s = time.perf_counter()
        self._stamp_ns = max(self._stamp_ns, packet.stamp_ns)
        self._has_pose |= isinstance(packet, Odometry)

    def close(self, *, complete: bool = True) -> None:
        """Draw what was flown, if that is complete."""
        if self._closed:
            return
        self._closed = True
        if not complete:
            return
        flight_s = self._end_s - self._begin_s
        save_overview(
            self._file,
            self._summary,
            scene=self._model.scene,
            track=None if self._has_pose else self._planned_track(),
            real_time_factor=self._stamp_ns / NS_PER_S / flight_s if flight_s > 0.0 else None,
        )

    def _planned_track(self) -> Track:
        """Return the planned path as far as was flown, for a flight without odometry."""
        samples = self._model.path.evaluate(np.linspace(0, self._stamp_ns, 501).astype(np.int64))
        return Track(
            stamp_ns=samples.stamps_ns,
            position=samples.position,
            velocity=samples.velocity,
            heading=np.stack([np.cos(samples.yaw), np.sin(samples.yaw)], axis=1),
        )
