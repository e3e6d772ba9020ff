"""The data of a flight's overview, collected from its packets in bounded memory."""

from __future__ import annotations

import dataclasses
from collections import deque
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from neurosim_core.packets import Events, FieldSchema, Packet, as_numpy, join_events, schema_of
from neurosim_core.record.header import SensorDescription
from neurosim_core.view.pictures import picture_of
from neurosim_core.view.rerun_layout import PICTURES

_ROWS_MAX = 20_000
_LINES_MAX = 12
_CONSIDER_NS = 200_000_000
"""A moment is compared with the best so far if the one compared before is that long ago, or at the end."""
_STEP_PX = 4
"""Every so many rows and columns tell how much there is to see in a picture."""


class Snapshot(NamedTuple):
    """The pictures of a vehicle's sensors at one moment."""

    stamp_ns: int
    """The moment [ns]."""
    packets: dict[str, Packet]
    """By sensor, of those that send pictures, points or bars: the last packet, and of an event camera the
    events of a window that ends at the moment."""


class Track(NamedTuple):
    """Positions of the vehicle, by time."""

    stamp_ns: NDArray[np.int64]
    """Times [ns], shape [n]."""
    position: NDArray[np.float64]
    """p_WB [m], shape [n, 3]."""
    velocity: NDArray[np.float64]
    """v_WB in W [m/s], shape [n, 3]."""
    heading: NDArray[np.float64]
    """Horizontal part of the direction in which the first camera looks, in W, shape [n, 2]."""


class Series(NamedTuple):
    """A field of the packets of a sensor, by time."""

    sensor: str
    field: FieldSchema
    stamp_ns: NDArray[np.int64]
    """Times [ns], shape [n]."""
    values: NDArray[np.float64]
    """Values in the unit of the field, shape [n, items]."""


class FlightSummary:
    """Collects from the packets of a flight what its overview shows, in bounded memory.

    Which sensors there are is learnt from the packets. The moment shown is a picture of great contrast and
    depth (up to 3 m) at which about a third of the pixels saw events: a view into a room, not the wall in
    front.
    """

    def __init__(
        self, sensors: tuple[SensorDescription, ...] = (), *, event_window_ns: int = 20_000_000
    ) -> None:
        """Start empty.

        `sensors`: sensors of the flight; the orientation of the first camera is used. `event_window_ns`:
        length of the window of events that is shown [ns].
        """
        self._window_ns = event_window_ns
        cameras = [s for s in sensors if s.intrinsics is not None]
        self._q_BC = cameras[0].orientation if cameras else np.array([-0.5, 0.5, -0.5, 0.5])
        self._latest: dict[str, Packet] = {}
        self._recent: dict[str, deque[Events]] = {}
        self._waiting_ns: int | None = None
        self._next_ns = 0
        self._best_interest = -np.inf
        self._best: tuple[Snapshot, dict[str, list[Events]]] | None = None
        self._series: dict[str, list[tuple[FieldSchema, _Rows]]] = {}
        self._pose = _Rows()
        self._pose_sensor = ""
        self._stamp_ns = 0
        self.texts: deque[str] = deque(maxlen=_LINES_MAX)
        """The last texts of all sensors."""
        self.event_count = 0
        """Events of all event cameras so far."""

    def log(self, packet: Packet) -> None:
        """Take one packet; packets come in the order of their stamps."""
        if self._waiting_ns is not None and packet.stamp_ns > self._waiting_ns:
            self._consider(self._waiting_ns)
        self._stamp_ns = packet.stamp_ns
        schema = schema_of(type(packet))
        if isinstance(packet, Events):
            self.event_count += len(packet)
            recent = self._recent.setdefault(packet.sensor, deque())
            recent.append(packet)
            while recent[0].stamp_ns <= packet.stamp_ns - self._window_ns:
                recent.popleft()
        elif schema.display in (*PICTURES, "points", "bars"):
            self._latest[packet.sensor] = packet
            if schema.display in PICTURES:
                self._waiting_ns = packet.stamp_ns
        elif schema.display == "pose":
            self._log_pose(packet)
        elif schema.display == "text":
            texts = (str(getattr(packet, f.name)) for f in schema.fields if f.dtype == "str")
            self.texts.append(f"{packet.stamp_ns * 1e-9:.2f} s  {packet.sensor}: {' '.join(texts)}")
        elif schema.display == "time series":
            if packet.sensor not in self._series:
                self._series[packet.sensor] = [(f, _Rows()) for f in schema.fields if f.is_number]
            for number, rows in self._series[packet.sensor]:
                rows.add(packet.stamp_ns, as_numpy(getattr(packet, number.name)).ravel())

    def snapshot(self) -> Snapshot:
        """Return the moment to show; the last one if there is no picture."""
        if self._waiting_ns is not None:
            self._next_ns = 0
            self._consider(self._waiting_ns)
        snapshot, recent = self._best or self._moment(self._stamp_ns)
        begin_ns = snapshot.stamp_ns - self._window_ns
        windows = {name: _window(packets, begin_ns, snapshot.stamp_ns) for name, packets in recent.items()}
        return Snapshot(snapshot.stamp_ns, snapshot.packets | windows)

    def track(self) -> Track:
        """Return where the vehicle was so far, at no more than 20 000 times."""
        stamp_ns, table = self._pose.arrays()
        position, velocity, orientation = np.split(table.reshape(-1, 10), [3, 6], axis=1)
        heading = np.zeros((0, 2))
        if len(stamp_ns):
            R_WC = Rotation.from_quat(orientation) * Rotation.from_quat(self._q_BC)
            heading = R_WC.apply([0.0, 0.0, 1.0])[:, :2]
        return Track(stamp_ns, position, velocity, heading)

    def series(self) -> list[Series]:
        """Return the numbers that sensors measured so far, at no more than 20 000 times each."""
        return [
            Series(sensor, number, *rows.arrays())
            for sensor, plotted in self._series.items()
            for number, rows in plotted
        ]

    def _log_pose(self, packet: Any) -> None:
        self._pose_sensor = self._pose_sensor or packet.sensor
        if packet.sensor == self._pose_sensor:
            row = np.concatenate([packet.position, packet.velocity, packet.orientation])
            self._pose.add(packet.stamp_ns, row)

    def _moment(self, stamp_ns: int) -> tuple[Snapshot, dict[str, list[Events]]]:
        """Return the present packets, and those of events: few moments are shown, so they are cut later."""
        recent = {name: list(packets) for name, packets in self._recent.items()}
        return Snapshot(stamp_ns, dict(self._latest)), recent

    def _consider(self, stamp_ns: int) -> None:
        """Keep the moment if there is more to see than at the best one so far."""
        self._waiting_ns = None
        if stamp_ns < self._next_ns:
            return
        self._next_ns = stamp_ns + _CONSIDER_NS
        contrast, depth_m, covered = 0.0, 3.0, 0.0
        for packet in self._latest.values():
            if schema_of(type(packet)).display in PICTURES:
                kind, data = picture_of(packet)
                if kind == "colour":
                    contrast = max(contrast, float(data[::_STEP_PX, ::_STEP_PX].std()))
                elif kind == "depth":
                    depth_m = min(depth_m, float(np.median(data[::_STEP_PX, ::_STEP_PX])))
        for recent in self._recent.values():
            width, height = recent[-1].width, recent[-1].height
            seen = np.zeros(height * width, dtype=np.bool_)
            for _, x, y, _ in (packet.numpy() for packet in recent):
                seen[np.multiply(y, width, dtype=np.intp) + x] = True
            covered = max(covered, float(seen.mean()))
        # most at a third: more is a thicket
        interest = (1.0 + contrast) * (0.01 + covered * (1.0 - covered) ** 2) * (0.1 + depth_m)
        if interest >= self._best_interest:
            self._best_interest, self._best = interest, self._moment(stamp_ns)


def _window(packets: Sequence[Events], begin_ns: int, end_ns: int) -> Events:
    """Return the events of a window of time as one packet."""
    joined = join_events([packet.numpy() for packet in packets])
    begin, end = np.searchsorted(joined.t, [begin_ns // 1000 + 1, end_ns // 1000 + 1])
    events = joined.rows(slice(begin, end))._asdict()
    return dataclasses.replace(packets[-1], start_ns=begin_ns, stamp_ns=end_ns, **events)


class _Rows:
    """Rows of numbers by time; when they become many, every second one is kept."""

    def __init__(self) -> None:
        self._stamp_ns: list[int] = []
        self._rows: list[NDArray[np.float64]] = []
        self._stride = 1
        self._count = 0

    def add(self, stamp_ns: int, values: NDArray[Any]) -> None:
        self._count += 1
        if (self._count - 1) % self._stride:
            return
        self._stamp_ns.append(stamp_ns)
        self._rows.append(values.astype(np.float64))
        if len(self._rows) > _ROWS_MAX:
            self._stamp_ns, self._rows, self._stride = self._stamp_ns[::2], self._rows[::2], 2 * self._stride

    def arrays(self) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        table = np.stack(self._rows) if self._rows else np.zeros((0, 1))
        return np.array(self._stamp_ns, dtype=np.int64), table
