"""One cast at work: the poses of a batch in, pictures and events out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from neurosim_core.clock import Rate
from neurosim_core.packets import Events, Image, ImageEncoding, Packet
from neurosim_core.render.renderer import Renderer, SceneOnDevice, make_renderer
from neurosim_core.sensors.events import EventCamera
from neurosim_core.sensors.rig import Cast, EventSensorConfig, ImageSensorConfig, SensorConfig
from neurosim_core.trace import Trace

_ENCODING: dict[str, ImageEncoding] = {"rgb": "rgb8", "depth": "32FC1"}
"""Encoding of each output of a renderer."""


@dataclass(kw_only=True, eq=False)
class EventChannel:
    """An event camera of a cast and the clock of its packets."""

    camera: EventCamera
    packets: Rate


@dataclass(kw_only=True, eq=False)
class ImageChannel:
    """An image camera of a cast."""

    output: str
    """What the renderer calls its picture."""
    rate: Rate
    sequence: int = 0


@dataclass(kw_only=True, eq=False)
class CastState:
    """The device buffers of one cast, for batches of at most `capacity` instants."""

    capacity: int
    rate: Rate
    renderer: Renderer
    events: dict[str, EventChannel]
    images: dict[str, ImageChannel]
    p_BC: wp.vec3d
    q_BC: wp.quatd
    p_WC: wp.array[wp.vec3]
    q_WC: wp.array[wp.quat]
    trace_slots: wp.array[int]
    image_slots: wp.array[int]
    pictures: list[tuple[int, int, str]] = field(default_factory=list)
    """Stamp, image slot and camera of the pictures of the present batch."""
    stamps_ns: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    """Stamps of the instants of the present batch."""


def make_cast_state(
    cast: Cast, sensors: dict[str, SensorConfig], scene: SceneOnDevice, *, capacity: int, device: str
) -> CastState:
    """Allocate the buffers of a cast.

    Args:
        cast: Which cameras it serves.
        sensors: All sensors of the rig.
        scene: What to look at.
        capacity: The most instants of one batch.
        device: Where to compute.
    """
    events = {}
    for name in cast.event_cameras:
        sensor = sensors[name]
        assert isinstance(sensor, EventSensorConfig)
        events[name] = EventChannel(
            camera=EventCamera(
                sensor.pixel, width=cast.lens.width, height=cast.lens.height, device=device, sensor=name
            ),
            packets=Rate(sensor.packet_rate_hz),
        )
    images = {}
    for name in cast.image_cameras:
        sensor = sensors[name]
        assert isinstance(sensor, ImageSensorConfig)
        images[name] = ImageChannel(output=sensor.kind, rate=Rate(sensor.rate_hz))
    # of n consecutive ticks of the cast, every m-th is at most floor((n - 1) / m) + 1; cameras may alternate
    picture_count = sum(int(capacity * i.rate.rate_hz / cast.rate.rate_hz) + 1 for i in images.values())
    return CastState(
        capacity=capacity,
        rate=cast.rate,
        renderer=make_renderer(
            scene,
            cast.lens,
            outputs=cast.outputs,
            instant_count=capacity,
            image_count=max(1, min(capacity, picture_count)),
        ),
        events=events,
        images=images,
        p_BC=wp.vec3d(*cast.mount.position_m),
        q_BC=wp.quatd(*cast.mount.optical_quaternion()),
        p_WC=wp.zeros(capacity, dtype=wp.vec3, device=device),
        q_WC=wp.zeros(capacity, dtype=wp.quat, device=device),
        trace_slots=wp.zeros(capacity, dtype=int, device=device),
        image_slots=wp.zeros(capacity, dtype=int, device=device),
    )


def render_instants(cast: CastState, trace: Trace, slots: Sequence[int], stamps_ns: Sequence[int]) -> None:
    """Render the instants of a batch in one launch.

    Args:
        cast: Its buffers are overwritten.
        trace: Where the states of the batch are.
        slots: Slots of the instants in the trace, at least one.
        stamps_ns: Their stamps.
    """
    cast.stamps_ns = np.array(stamps_ns, dtype=np.int64)
    cast.pictures = []
    image_slots = []
    used = 0
    for stamp_ns in stamps_ns:
        due = [name for name, image in cast.images.items() if image.rate.has_tick(stamp_ns)]
        cast.pictures += [(stamp_ns, used, name) for name in due]
        image_slots.append(used if due else -1)
        used += bool(due)
    count = len(slots)
    _upload(cast.trace_slots, slots)
    _upload(cast.image_slots, image_slots)
    trace.camera_poses(
        cast.trace_slots, count=count, p_BC=cast.p_BC, q_BC=cast.q_BC, p_WC=cast.p_WC, q_WC=cast.q_WC
    )
    cast.renderer.render(cast.p_WC, cast.q_WC, cast.image_slots, instant_count=count)


def scan_events(cast: CastState) -> None:
    """Let every event camera see the instants just rendered; at stamp 0 they take them as their reference."""
    log_radiance = cast.renderer.log_radiance
    for channel in cast.events.values():
        if cast.stamps_ns[0] == 0:
            channel.camera.reset(log_radiance[0], stamp_ns=0)
        else:
            channel.camera.feed_device(log_radiance, cast.stamps_ns)


def read_events(cast: CastState, *, until_ns: int) -> list[Events]:
    """Return the packets of events whose windows ended in the batch, at most at a stamp."""
    packets: list[Events] = []
    for channel in cast.events.values():
        stamps = (int(stamp) for stamp in cast.stamps_ns if 0 < stamp <= until_ns)
        packets += channel.camera.collect_windows([s for s in stamps if channel.packets.has_tick(s)])
    return packets


def flush_events(cast: CastState, *, until_ns: int) -> list[Events]:
    """Return the packets whose windows have begun and not ended, cut at the last instant until a stamp."""
    end_ns = cast.rate.stamp_ns(cast.rate.first_tick(until_ns + 1) - 1)
    packets: list[Events] = []
    for channel in cast.events.values():
        begun_ns = channel.packets.stamp_ns(channel.packets.first_tick(end_ns) - 1)
        if 0 <= begun_ns < end_ns and not channel.packets.has_tick(end_ns):
            packets += channel.camera.collect_windows([end_ns])
    return packets


def read_images(cast: CastState) -> list[Packet]:
    """Return the pictures of the batch, copied to the host."""
    read: dict[str, NDArray[Any]] = {}
    count = max((slot for _, slot, _ in cast.pictures), default=-1) + 1
    packets: list[Packet] = []
    for stamp_ns, slot, name in cast.pictures:
        image = cast.images[name]
        if image.output not in read:
            read[image.output] = np.array(getattr(cast.renderer, image.output)[:count].numpy())
        packets.append(
            Image(
                stamp_ns=stamp_ns,
                sequence=image.sequence,
                sensor=name,
                data=read[image.output][slot],
                encoding=_ENCODING[image.output],
            )
        )
        image.sequence += 1
    return packets


def _upload(array: wp.array[int], values: Sequence[int]) -> None:
    wp.copy(array, wp.array(np.array(values, dtype=np.int32), dtype=int, device="cpu"), count=len(values))
