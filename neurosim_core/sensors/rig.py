"""The sensors of a vehicle as the user names them, and how their cameras share the work of rendering."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from fractions import Fraction
from typing import Annotated, Literal, NamedTuple

from pydantic import Field, model_validator

from neurosim_core.clock import Rate
from neurosim_core.frames import Mount
from neurosim_core.render.camera import PinholeConfig
from neurosim_core.sensors.event_config import EventCameraConfig
from neurosim_core.sensors.imu import ImuConfig
from neurosim_core.settings import Settings

RateHz = Annotated[float, Field(gt=0.0, le=1e6)]


class CameraConfig(Settings):
    """What every camera has: a lens and a place on the body."""

    lens: PinholeConfig = PinholeConfig(width=346, height=260, horizontal_fov_rad=1.5)
    """Resolution and field of view."""
    mount: Mount = Mount(position_m=(0.1, 0.0, 0.03))
    """Pose of the camera on the body."""


class EventSensorConfig(CameraConfig):
    """An event camera."""

    kind: Literal["event_camera"] = "event_camera"
    pixel: EventCameraConfig = EventCameraConfig()
    """The law of its pixels."""
    sampling_rate_hz: RateHz = 500.0
    """How often log radiance is rendered [Hz]; between two renders it is taken as linear in time."""
    max_displacement_px: Annotated[float, Field(gt=0.0, le=100.0)] | None = None
    """Adaptive sampling: a tick of the sampling rate is rendered only if without it some point would have
    moved further than this between two renders [px]; ends of packets are always rendered. `sampling_rate_hz`
    is then the finest step, and may be high, such as 10000. null: every tick is rendered."""
    packet_rate_hz: RateHz | None = None
    """How many packets of events are sent a second [Hz]; each holds the events of its whole window. null: the
    highest rate up to 100 Hz that divides the sampling rate."""

    @property
    def packets(self) -> Rate:
        """The clock at which packets end."""
        if self.packet_rate_hz is not None:
            return Rate(self.packet_rate_hz)
        sampling = Fraction(str(self.sampling_rate_hz))
        shares = (sampling / count for count in itertools.count(max(1, math.ceil(sampling / 100))))
        return Rate(float(next(share for share in shares if Fraction(str(float(share))) == share)))

    @model_validator(mode="after")
    def _packets_end_on_renders(self) -> EventSensorConfig:
        if self.packet_rate_hz is not None and not _divides(self.packet_rate_hz, self.sampling_rate_hz):
            raise ValueError(
                f"packet_rate_hz must divide sampling_rate_hz = {self.sampling_rate_hz:g} without remainder, "
                f"got {self.packet_rate_hz:g}"
            )
        return self


class RgbSensorConfig(CameraConfig):
    """A colour camera with an ideal global shutter; pictures are 8-bit sRGB."""

    kind: Literal["rgb"] = "rgb"
    rate_hz: RateHz = 20.0
    """Pictures a second [Hz]."""


class DepthSensorConfig(CameraConfig):
    """A camera that measures planar depth z [m], without noise; inf where nothing is hit."""

    kind: Literal["depth"] = "depth"
    rate_hz: RateHz = 20.0
    """Pictures a second [Hz]."""


class ImuSensorConfig(ImuConfig):
    """An inertial measurement unit."""

    kind: Literal["imu"] = "imu"


class OdometrySensorConfig(Settings):
    """The true state of the vehicle, as a sensor."""

    kind: Literal["odometry"] = "odometry"
    rate_hz: RateHz = 200.0
    """Samples a second [Hz]."""


ImageSensorConfig = RgbSensorConfig | DepthSensorConfig
SensorConfig = Annotated[
    EventSensorConfig | RgbSensorConfig | DepthSensorConfig | ImuSensorConfig | OdometrySensorConfig,
    Field(discriminator="kind"),
]


@dataclass(frozen=True, kw_only=True)
class Cast:
    """Cameras that share a pose, a lens and a clock, so that one ray answers all of them."""

    lens: PinholeConfig
    mount: Mount
    rate: Rate
    """The instants at which rays are cast."""
    event_cameras: tuple[str, ...]
    """Names of the event cameras that see every instant."""
    image_cameras: tuple[str, ...]
    """Names of the cameras that take a picture at every n-th instant."""
    outputs: frozenset[str]
    """What a ray answers."""
    max_displacement_px: float | None = None
    """Rays are cast only at the instants that this asks for (`sensors.displacement`); None: at all."""

    @property
    def names(self) -> tuple[str, ...]:
        """All cameras of the cast."""
        return (*self.event_cameras, *self.image_cameras)


def plan_casts(sensors: dict[str, SensorConfig]) -> tuple[Cast, ...]:
    """Group the cameras of a rig into as few casts as possible.

    Event cameras with the same lens, mount and sampling rate share a cast. An image camera joins the first
    cast with its lens and mount whose ticks contain all its own; so whether it exists does not change which
    instants an event camera sees. For the same reason adaptive event cameras share a cast only if they ask
    for the same renders, and image cameras do not join them.
    """
    plans: list[_Plan] = []

    def join(camera: CameraConfig, clock: _Clock, name: str, *, event: bool) -> None:
        for plan in plans:
            fits = clock == plan.clock if event else plan.clock.contains(clock)
            if plan.lens == camera.lens and plan.mount == camera.mount and fits:
                (plan.events if event else plan.images).append(name)
                return
        names: tuple[list[str], list[str]] = ([name], []) if event else ([], [name])
        plans.append(_Plan(camera.lens, camera.mount, clock, *names))

    images = {n: s for n, s in sensors.items() if isinstance(s, ImageSensorConfig)}
    for name, sensor in sensors.items():
        if isinstance(sensor, EventSensorConfig):
            join(sensor, _event_clock(sensor), name, event=True)
    for name, image in sorted(
        images.items(), key=lambda item: -item[1].rate_hz
    ):  # fastest first: others may join
        join(image, _Clock(image.rate_hz), name, event=False)
    return tuple(
        Cast(
            lens=plan.lens,
            mount=plan.mount,
            rate=Rate(plan.clock.rate_hz),
            event_cameras=tuple(plan.events),
            image_cameras=tuple(plan.images),
            outputs=frozenset(
                (["log_radiance"] if plan.events else []) + [images[n].kind for n in plan.images]
            ),
            max_displacement_px=plan.clock.max_displacement_px,
        )
        for plan in plans
    )


class _Clock(NamedTuple):
    """When a camera needs rays."""

    rate_hz: float
    max_displacement_px: float | None = None
    packets: Rate | None = None
    """Ticks that an adaptive camera always needs."""

    def contains(self, other: _Clock) -> bool:
        """Whether every tick of another clock is rendered by this one."""
        return self.max_displacement_px is None and _divides(other.rate_hz, self.rate_hz)


class _Plan(NamedTuple):
    """A cast that cameras may still join."""

    lens: PinholeConfig
    mount: Mount
    clock: _Clock
    events: list[str]
    images: list[str]


def _event_clock(sensor: EventSensorConfig) -> _Clock:
    if sensor.max_displacement_px is None:
        return _Clock(sensor.sampling_rate_hz)
    return _Clock(sensor.sampling_rate_hz, sensor.max_displacement_px, sensor.packets)


def _divides(rate_hz: float, faster_hz: float) -> bool:
    """Whether every tick of one rate is a tick of the other."""
    return (Fraction(str(faster_hz)) / Fraction(str(rate_hz))).denominator == 1
