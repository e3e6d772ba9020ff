"""Windows of a stream of packets: events in (t0, t1], ground truth at t1.

Windows lie on a grid: t1 is a multiple of the stride. Events are compared in whole microseconds, as they are
stamped, so that a recording, a file of events and a live stream give the same windows. A window is complete
when every sensor has come as far as its end; one whose ground truth has no packet at exactly t1 is left out
and counted.
"""

from __future__ import annotations

import functools
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from neurosim_core.data.batch import FIELDS, Sample
from neurosim_core.packets import (
    EventArrays,
    Events,
    ImuSample,
    Odometry,
    Packet,
    PacketSchema,
    join_events,
    schema_of,
)

_ENCODINGS = {"32FC1": "depth", "32FC2": "flow", "rgb8": "rgb", "mono8": "rgb"}
_US_NS = 1000
AT_STAMP = ("depth", "flow", "rgb", "pose")
"""Fields that need a packet at exactly the end of a window."""
_SKIPPED_MAX = 20
"""An error is raised after so many windows without ground truth, if none had it."""


@dataclass(frozen=True, kw_only=True)
class WindowConfig:
    """Windows to cut from a stream of events, and their fields."""

    window_s: float = 0.05
    """Length of a window, in whole microseconds [s]."""
    stride_s: float | None = None
    """Time from one window to the next [s]; None: `window_s`."""
    ends: str | None = None
    """Field whose packets end the windows; None: windows end at multiples of the stride."""
    fields: Sequence[str] | None = None
    """Fields to return, of `FIELDS`; None: all that a source has."""
    sensors: Mapping[str, str] = field(default_factory=dict)
    """Name of the sensor for each field; by default the first that fits."""

    def __post_init__(self) -> None:
        for name, value in (("window_s", self.window_s), ("stride_s", self.stride_s)):
            if value is not None and not (value >= 1e-6 and abs(value * 1e6 - round(value * 1e6)) < 1e-6):
                raise ValueError(f"{name} must be whole microseconds, at least 1, got {value}")
        if self.ends is not None and self.ends not in AT_STAMP:
            raise ValueError(f"ends must be one of {', '.join(AT_STAMP)}, got {self.ends!r}")
        if self.ends is not None and not self.takes(self.ends):
            raise ValueError(f"ends is {self.ends!r}, which is not in fields")
        unknown = {*(self.fields or ()), *self.sensors} - {*FIELDS}
        if unknown:
            raise ValueError(f"unknown field {sorted(unknown)[0]!r}, known: {', '.join(FIELDS)}")

    @property
    def window_ns(self) -> int:
        """Length of a window [ns]."""
        return round(self.window_s * 1e6) * _US_NS

    @property
    def stride_ns(self) -> int:
        """From one window to the next [ns]."""
        return self.window_ns if self.stride_s is None else round(self.stride_s * 1e6) * _US_NS

    def first_end_ns(self, begin_ns: int) -> int:
        """Return the end of the first window that begins at a time or later [ns]."""
        return -(-(begin_ns + self.window_ns) // self.stride_ns) * self.stride_ns

    def takes(self, name: str) -> bool:
        """Whether a field is wanted."""
        return self.fields is None or name in self.fields


def field_of(schema: PacketSchema, encoding: str) -> str | None:
    """Return the field that packets of a class give, whose pictures have an encoding."""
    named = "events" if schema.has_events else {"ImuSample": "imu", "Odometry": "pose"}.get(schema.name)
    return named or _ENCODINGS.get(encoding)


@functools.cache
def _field_of_packets(kind: Any, encoding: str) -> str | None:
    """Return `field_of` of a class, which is asked for each packet."""
    return field_of(schema_of(kind), encoding)


def value_of(packet: Packet) -> Any:
    """Return what a packet that is no event gives to its field."""
    if isinstance(packet, ImuSample):
        return np.concatenate([[packet.stamp_ns * 1e-9], packet.specific_force, packet.angular_rate])
    if isinstance(packet, Odometry):
        return np.concatenate([packet.position, packet.orientation])
    return np.asarray(getattr(packet, "data"))  # noqa: B009 (any class that has an encoding)


class PacketWindows:
    """Cuts the packets of one flight into windows. Sensors must be known before the first window ends.

    `sensors`: name of the sensor of each field that there is. `source`: name of the flight, for its samples.

    Attributes:
        skipped_count: Windows that were left out, as their ground truth is missing.
    """

    def __init__(self, config: WindowConfig, sensors: Mapping[str, str], *, source: str) -> None:
        self._config = config
        self._fields = {name: sensor for name, sensor in sensors.items() if config.takes(name)}
        self._watched = {"events": sensors["events"], **self._fields}
        self._source = source
        self._events: deque[EventArrays] = deque()
        self._counts: deque[tuple[int, int, int]] = deque()
        self._values: dict[str, deque[tuple[int, Any]]] = {name: deque() for name in self._fields}
        self._reached_ns = dict.fromkeys(self._watched, -1)
        self._end_ns: int | None = None
        self._sequence: int | None = None
        self._size = (0, 0)
        self._found = False
        self.skipped_count = 0

    def add(self, packet: Packet) -> Iterator[Sample]:
        """Take a packet, and yield the windows that are complete with it."""
        kind: Any = type(packet)  # mypy does not take classes for hashable
        name = _field_of_packets(kind, getattr(packet, "encoding", ""))
        if name is None or self._watched.get(name) != packet.sensor:
            return
        if isinstance(packet, Events):
            self._add_events(packet)
        else:
            self._values[name].append((packet.stamp_ns, value_of(packet)))
        self._reached_ns[name] = packet.stamp_ns
        yield from self._complete(ended=False)

    def end(self) -> Iterator[Sample]:
        """Yield the windows that are left at the end of the flight.

        Raises:
            ValueError: Windows were cut, but none has its ground truth.
        """
        yield from self._complete(ended=True)
        if not self._found and self.skipped_count >= _SKIPPED_MAX:
            names = [name for name in AT_STAMP if self._config.takes(name)]
            raise ValueError(no_ground_truth(self._source, " or ".join(names), self._config))

    def _add_events(self, packet: Events) -> None:
        if self._end_ns is None:
            self._end_ns = self._config.first_end_ns(packet.start_ns)
            self._size = (packet.width, packet.height)
        lost = 0 if self._sequence is None else max(packet.sequence - self._sequence - 1, 0)
        self._sequence = packet.sequence
        self._counts.append((packet.stamp_ns, packet.dropped_count, lost))
        if len(packet):
            self._events.append(packet.numpy())

    def _complete(self, *, ended: bool) -> Iterator[Sample]:
        while self._end_ns is not None:
            end_ns = self._end_ns
            reached_ns = self._reached_ns["events"]
            if ended:
                if reached_ns < end_ns:
                    return
            elif reached_ns < end_ns + _US_NS - 1 or any(ns < end_ns for ns in self._reached_ns.values()):
                return
            sample = self._cut(end_ns)
            self._end_ns += self._config.stride_ns
            self._forget(self._end_ns - self._config.window_ns)
            if sample is None:
                self.skipped_count += 1
            else:
                self._found = True
                yield sample

    def _cut(self, end_ns: int) -> Sample | None:
        start_ns = end_ns - self._config.window_ns
        values: dict[str, Any] = dict.fromkeys(FIELDS)
        for name, queue in self._values.items():
            if name == "imu":
                rows = [value for stamp_ns, value in queue if start_ns < stamp_ns <= end_ns]
                values[name] = np.array(rows).reshape(-1, 7)
            elif name in AT_STAMP:
                values[name] = next((value for stamp_ns, value in queue if stamp_ns == end_ns), None)
                if values[name] is None:
                    return None
        if "events" in self._fields:
            values["events"] = cut_events(self._events, start_ns // _US_NS, end_ns // _US_NS)
        counts = [
            (dropped, lost) for stamp_ns, dropped, lost in self._counts if start_ns < stamp_ns <= end_ns
        ]
        return Sample(
            stamp_ns=end_ns,
            start_ns=start_ns,
            source=self._source,
            width=self._size[0],
            height=self._size[1],
            dropped_count=sum(dropped for dropped, _ in counts),
            lost_count=sum(lost for _, lost in counts),
            **values,
        )

    def _forget(self, start_ns: int) -> None:
        """Drop what is before the next window."""
        while self._events and int(self._events[0].t[-1]) <= start_ns // _US_NS:
            self._events.popleft()
        for queue in self._values.values():
            while queue and queue[0][0] <= start_ns:
                queue.popleft()
        while self._counts and self._counts[0][0] <= start_ns:
            self._counts.popleft()


def cut_events(parts: Iterable[EventArrays], start_us: int, end_us: int) -> EventArrays:
    """Return the events with start < t <= end, of parts in the order of time."""
    cut = []
    for part in parts:
        begin, end = np.searchsorted(part.t, [start_us, end_us], side="right")
        if begin < end:
            cut.append(part.rows(slice(int(begin), int(end))))
    return join_events(cut)


def choose_sensors(found: Mapping[str, str | None], config: WindowConfig, *, source: str) -> dict[str, str]:
    """Return the name of the sensor of each field.

    `found`: the field of each sensor, in the order in which the first is to be taken.
    """
    chosen: dict[str, str] = {}
    for sensor, name in found.items():
        if name is not None and config.sensors.get(name, sensor) == sensor:
            chosen.setdefault(name, sensor)
    wanted_fields = {"events", *(config.fields or ()), *config.sensors, *filter(None, [config.ends])}
    for name in wanted_fields - {*chosen}:
        wanted = config.sensors.get(name)
        what = f"sensor {wanted!r} for {name}" if wanted else f"sensor for {name}"
        raise ValueError(f"{source} has no {what}; its sensors are {', '.join(found) or 'none'}")
    return chosen


def no_ground_truth(source: str, field: str, config: WindowConfig) -> str:
    """Return what to say where windows never end at a packet of a field."""
    stride_s = 1e-9 * config.stride_ns
    return (
        f"{source}: no packet of {field} is stamped at the end of a window, a multiple of {stride_s:g} s: "
        f"choose window_s or stride_s as multiples of its period, or leave {field} out of fields"
    )
