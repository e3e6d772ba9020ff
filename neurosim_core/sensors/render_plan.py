"""Cameras that share the work of rendering: one ray answers all that share pose, lens, shutter and clock."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from neurosim_core.clock import Rate
from neurosim_core.frames import Mount
from neurosim_core.render.camera import Lens
from neurosim_core.render.ray_times import RayTiming
from neurosim_core.sensors.base import RenderedConfig, SensorConfig


@dataclass(frozen=True, kw_only=True)
class RenderGroup:
    """Cameras that share a pose, a lens and a clock, so that one ray answers all of them."""

    lens: Lens
    mount: Mount
    rate: Rate
    """The instants at which rays are cast."""
    frame_sensors: tuple[str, ...]
    """Names of the cameras that see every instant."""
    image_sensors: tuple[str, ...]
    """Names of the cameras that take a picture at every n-th instant."""
    outputs: frozenset[str]
    """The quantities that a ray finds."""
    timing: RayTiming | None = None
    """When rays are cast; None: all at the stamp."""
    look_back_ns: int = 0
    """Time before the end of a batch for which a camera needs poses besides those of its rays [ns]."""
    max_displacement_px: float | None = None
    """Rays are cast only at the instants that this asks for (`sensors.displacement`); None: at all."""

    @property
    def names(self) -> tuple[str, ...]:
        """All cameras of the group."""
        return (*self.frame_sensors, *self.image_sensors)

    @property
    def window_ns(self) -> int:
        """Time before a stamp for which poses are needed [ns]."""
        return max(self.look_back_ns, 0 if self.timing is None else self.timing.window_ns)


def plan_render_groups(sensors: Mapping[str, SensorConfig]) -> tuple[RenderGroup, ...]:
    """Group the cameras of a rig into as few groups as possible.

    Frame sensors with the same lens, mount and sampling rate share a group. An image sensor joins the first
    group with its lens and mount whose ticks contain all its own; so whether it exists does not change which
    instants a frame sensor sees. For the same reason adaptive frame sensors share a group only if they ask
    for the same renders, and image sensors do not join them.
    """
    cameras = {name: sensor for name, sensor in sensors.items() if isinstance(sensor, RenderedConfig)}
    requests = {name: camera.render_request() for name, camera in cameras.items()}
    frames = [name for name, request in requests.items() if request.every_instant]
    images = [name for name in requests if name not in frames]
    images.sort(key=lambda name: -requests[name].rate_hz)  # fastest first: others may join

    def fits(name: str, first: str) -> bool:
        """Return whether a camera may join the group that another has begun."""
        camera, other = cameras[name], cameras[first]
        if (camera.optics, camera.mount, camera.timing) != (other.optics, other.mount, other.timing):
            return False
        request, clock = requests[name], requests[first]
        if request.every_instant:
            when = (request.rate_hz, request.max_displacement_px, request.required)
            return when == (clock.rate_hz, clock.max_displacement_px, clock.required)
        return clock.max_displacement_px is None and Rate(clock.rate_hz).contains(Rate(request.rate_hz))

    groups: list[list[str]] = []
    for name in (*frames, *images):
        group = next((group for group in groups if fits(name, group[0])), None)
        if group is None:
            groups.append([name])
        else:
            group.append(name)
    return tuple(
        RenderGroup(
            lens=cameras[names[0]].optics,
            mount=cameras[names[0]].mount,
            timing=cameras[names[0]].timing,
            look_back_ns=max(cameras[name].look_back_ns for name in names),
            rate=Rate(requests[names[0]].rate_hz),
            frame_sensors=tuple(name for name in names if requests[name].every_instant),
            image_sensors=tuple(name for name in names if not requests[name].every_instant),
            outputs=frozenset().union(*(requests[name].outputs for name in names)),
            max_displacement_px=requests[names[0]].max_displacement_px,
        )
        for names in groups
    )
