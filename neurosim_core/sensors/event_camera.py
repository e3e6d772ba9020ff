"""The event camera as a sensor: its settings, its request to the renderer, and its packets."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from fractions import Fraction
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from pydantic import Field, model_validator

from neurosim_core.clock import Rate
from neurosim_core.packets import Events, Packet
from neurosim_core.registry import register
from neurosim_core.runtime.cuda import Launches
from neurosim_core.sensors.base import (
    FrameContext,
    FrameSensor,
    FrameSensorConfig,
    RateHz,
    RenderRequest,
)
from neurosim_core.sensors.event_config import EventCameraConfig, describe_pixel
from neurosim_core.sensors.event_noise_model import CAUSE, CAUSE_BITS
from neurosim_core.sensors.event_worlds import WorldEventCamera
from neurosim_core.sensors.events import EventCamera

if TYPE_CHECKING:
    from neurosim_core.sensors.event_labels import EventLabels

EventLabel = Literal["depth", "flow", "instance", "semantic", "cause"]

_ROOM_MIN = 1024
"""Smallest default capacity for the events of one world in one step."""
_INDEX_MAX = 2**31 - 1
"""Largest number of events of all worlds; indices have 32 bits."""


@register("sensor", "event_camera")
class EventSensorConfig(FrameSensorConfig):
    """An event camera."""

    kind: Literal["event_camera"] = "event_camera"
    pixel: EventCameraConfig = EventCameraConfig()
    """Model of its pixels."""
    sampling_rate_hz: RateHz = 500.0
    """Rate at which log radiance is rendered [Hz]; it is linear in time between two renders."""
    max_displacement_px: Annotated[float, Field(gt=0.0, le=100.0)] | None = None
    """Adaptive sampling: a tick of the sampling rate is rendered only if some point would otherwise move
    further than this between two renders [px]; ends of packets are always rendered. `sampling_rate_hz` is
    then the highest render rate, and may be high, such as 10000. null: every tick is rendered."""
    packet_rate_hz: RateHz | None = None
    """Rate of packets [Hz]; each packet holds the events of its whole window. null: the highest rate up to
    100 Hz that divides the sampling rate."""

    labels: tuple[EventLabel, ...] = ()
    """Ground truth of each event, beside t, x, y and polarity: any of [depth, flow, instance, semantic,
    cause]; see `sensors/event_labels.py`. Empty: none."""
    classes: dict[str, tuple[str, ...]] | None = None
    """For the label `semantic`: name patterns by class, as for a `semantic` camera."""

    packet_type = Events
    reported: ClassVar[Any] = {"pixels": lambda sensor: describe_pixel(sensor.pixel)}

    @model_validator(mode="after")
    def _classes_are_labels(self) -> EventSensorConfig:
        if self.classes is not None and "semantic" not in self.labels:
            raise ValueError(f"classes need the label semantic, got labels {list(self.labels)}")
        return self

    @property
    def packet_class(self) -> type[Events]:
        """`LabelledEvents` with labels, else `Events`."""
        if not self.labels:
            return Events
        from neurosim_core.sensors.event_labels import LabelledEvents

        return LabelledEvents

    @property
    def look_back_ns(self) -> int:
        """Length of the motion history for labels [ns]: one packet and one sampling period."""
        if not set(self.labels) - {"cause"}:
            return 0
        return math.ceil(1e9 * (1.0 / self.packets.rate_hz + 1.0 / self.sampling_rate_hz))

    @property
    def clock(self) -> Rate:
        """Clock at which log radiance is rendered."""
        return Rate(self.sampling_rate_hz)

    @property
    def packets(self) -> Rate:
        """Clock at which packets end."""
        if self.packet_rate_hz is not None:
            return Rate(self.packet_rate_hz)
        sampling = Fraction(str(self.sampling_rate_hz))
        shares = (sampling / count for count in itertools.count(max(1, math.ceil(sampling / 100))))
        return Rate(float(next(share for share in shares if Fraction(str(float(share))) == share)))

    def render_request(self) -> RenderRequest:
        """Return its request to the renderer."""
        adaptive = self.max_displacement_px is not None
        return RenderRequest(
            outputs=frozenset(["log_radiance"]),
            rate_hz=self.sampling_rate_hz,
            every_instant=True,
            max_displacement_px=self.max_displacement_px,
            required=self.packets if adaptive else None,
        )

    def world_capacity(self, world_count: int, event_capacity: int | None) -> int:
        """Return the capacity for events of each world in a step."""
        capacity = event_capacity or max(_ROOM_MIN, 2 * self.lens.width * self.lens.height)
        if world_count * capacity > _INDEX_MAX:
            raise ValueError(
                f"{world_count} worlds with a capacity of {capacity} events each exceed 2^31 events: give an "
                f"event_capacity of at most {_INDEX_MAX // world_count}, or fewer worlds"
            )
        return capacity

    def make(self, context: FrameContext) -> FrameSensor:
        """Return the camera of one world with packets, or the cameras of all worlds."""
        if context.on_host:
            return EventChannel(self, context)
        if self.labels:
            raise ValueError(
                f"labels of {context.name!r} are for single runs only: they are part of packets on the host"
            )
        pixels = [config.pixel for config in context.configs]
        if any(pixel.readout is not None for pixel in pixels):
            raise ValueError(
                f"readout of {context.name!r} is for single runs only: the arbiter runs on the host"
            )
        return WorldEventCamera(
            pixels,
            width=self.lens.width,
            height=self.lens.height,
            instant_count=context.instant_count,
            device=context.device,
            capacity=context.capacity,
            sensor=context.name,
            seeds=context.seeds,
            clock_ns=context.clock_ns,
            ordered=context.ordered,
        )

    @model_validator(mode="after")
    def _labels_can_be_had(self) -> EventSensorConfig:
        if "cause" in self.labels and self.lens.width > 1 << (16 - CAUSE_BITS):
            raise ValueError(f"the cause of events needs a width of at most {1 << (16 - CAUSE_BITS)} px")
        return self

    @model_validator(mode="after")
    def _packets_end_on_renders(self) -> EventSensorConfig:
        rate_hz, sampling_hz = self.packet_rate_hz, self.sampling_rate_hz
        if rate_hz is not None and not Rate(sampling_hz).contains(Rate(rate_hz)):
            raise ValueError(
                f"packet_rate_hz must divide sampling_rate_hz = {sampling_hz:g} without remainder, "
                f"got {rate_hz:g}"
            )
        return self


class EventChannel(FrameSensor):
    """An event camera of one world, whose packets go to the host."""

    def __init__(self, config: EventSensorConfig, context: FrameContext) -> None:
        terms = config.pixel.terms()
        has_cause = "cause" in config.labels and bool(terms)  # of ideal pixels it is the signal
        self._labels: EventLabels | None = None
        if config.labels:
            from neurosim_core.sensors.event_labels import EventLabels

            self._labels = EventLabels(config.labels, config.classes, context, has_cause=has_cause)
        self._camera = EventCamera(
            config.pixel,
            width=context.lens.width,
            height=context.lens.height,
            device=context.device,
            sensor=context.name,
            seed=context.seeds[0],
            scan_count_max=context.in_flight,
            on_host=True,
            terms=(*terms, CAUSE) if has_cause else None,
            labels=self._labels,
        )
        self.terms = (
            *self._camera.terms,
            *(f"{label} of events" for label in config.labels if label != CAUSE),
        )
        self._packets = config.packets
        self._sequence = 0
        self._seen_ns = 0

    def begin(self, frames: Any, stamp_ns: int, mask: Any) -> None:
        """Take the first frame as the reference; waits for the device."""
        self._camera.reset(frames[0], stamp_ns, sequence=self._sequence)

    def plan(self, frames: Any, stamps_ns: Sequence[int], end_ns: int) -> Launches | None:
        """Return the scan of the instants of a batch, without a key: the camera records its own graphs."""
        if not stamps_ns:
            return None

        def scan() -> None:
            if self._labels is not None:
                self._labels.record_flight()
            self._camera.feed_device(frames, stamps_ns)

        return Launches(None, scan)

    def begin_read(self, stamps_ns: Sequence[int], *, until_ns: int) -> Callable[[], list[Packet]]:
        """Wait for the oldest batch; return a function that returns the packets whose windows end in it."""
        start_ns = self._camera.window_start_ns
        ticks = self._packets.stamps(stamps_ns[0], stamps_ns[-1] + 1)
        ends = [tick for tick in ticks if tick in stamps_ns and start_ns < tick <= until_ns]
        is_fed = stamps_ns[-1] > self._camera.stamp_ns
        self._seen_ns = max((stamp for stamp in stamps_ns if stamp <= until_ns), default=self._seen_ns)
        collect = self._camera.begin_windows(ends, scan_count=int(is_fed))
        self._sequence += len(ends)
        return lambda: self._labelled(collect())

    def flush(self, *, until_ns: int) -> list[Packet]:
        """Return the packet of the open window, cut at the last instant up to a stamp."""
        cut_ns = min(until_ns, self._seen_ns)
        if self._camera.window_start_ns >= cut_ns:
            return []
        packets = self._camera.collect_windows([cut_ns], scan_count=0)
        self._sequence += 1
        return self._labelled(packets)

    def _labelled(self, packets: list[Events]) -> list[Packet]:
        if self._labels is None:
            return [*packets]
        return [self._labels.add(packet) for packet in packets]
