"""How cameras share the work of rendering: one ray answers all that share pose, lens, shutter and clock."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

from neurosim_core.clock import Rate
from neurosim_core.frames import Mount
from neurosim_core.render.camera import Lens
from neurosim_core.render.ray_times import RayTiming
from neurosim_core.sensors.base import RenderedConfig, RenderRequest, SensorConfig


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
    """What a ray answers."""
    timing: RayTiming | None = None
    """When rays are cast; None: all at the stamp."""
    look_back_ns: int = 0
    """How long before the end of a batch a camera needs poses besides those of its rays [ns]."""
    max_displacement_px: float | None = None
    """Rays are cast only at the instants that this asks for (`sensors.displacement`); None: at all."""

    @property
    def names(self) -> tuple[str, ...]:
        """All cameras of the group."""
        return (*self.frame_sensors, *self.image_sensors)

    @property
    def window_ns(self) -> int:
        """How long before a stamp poses are needed [ns]."""
        return max(self.look_back_ns, 0 if self.timing is None else self.timing.window_ns)


def plan_render_groups(sensors: Mapping[str, SensorConfig]) -> tuple[RenderGroup, ...]:
    """Group the cameras of a rig into as few groups as possible.

    Frame sensors with the same lens, mount and sampling rate share a group. An image sensor joins the first
    group with its lens and mount whose ticks contain all its own; so whether it exists does not change which
    instants a frame sensor sees. For the same reason adaptive frame sensors share a group only if they ask
    for the same renders, and image sensors do not join them.
    """
    plans: list[_Plan] = []
    cameras = {name: sensor for name, sensor in sensors.items() if isinstance(sensor, RenderedConfig)}
    requests = {name: camera.render_request() for name, camera in cameras.items()}

    def join(name: str) -> None:
        camera, request = cameras[name], requests[name]
        clock = _Clock(request.rate_hz, request.max_displacement_px, request.required)
        for plan in plans:
            fits = clock == plan.clock if request.every_instant else plan.clock.contains(clock)
            same = (plan.lens, plan.mount, plan.timing) == (camera.optics, camera.mount, camera.timing)
            if same and fits:
                plan.members.append(name)
                return
        plans.append(_Plan(camera.optics, camera.mount, camera.timing, clock, [name]))

    for name, request in requests.items():
        if request.every_instant:
            join(name)
    images = [name for name, request in requests.items() if not request.every_instant]
    for name in sorted(images, key=lambda name: -requests[name].rate_hz):  # fastest first: others may join
        join(name)
    return tuple(_group(plan, requests, cameras) for plan in plans)


class _Clock(NamedTuple):
    """When a camera needs rays."""

    rate_hz: float
    max_displacement_px: float | None
    required: Rate | None

    def contains(self, other: _Clock) -> bool:
        """Whether every tick of another clock is rendered by this one."""
        return self.max_displacement_px is None and Rate(self.rate_hz).contains(Rate(other.rate_hz))


class _Plan(NamedTuple):
    """A group that cameras may still join."""

    lens: Lens
    mount: Mount
    timing: RayTiming | None
    clock: _Clock
    members: list[str]


def _group(
    plan: _Plan, requests: Mapping[str, RenderRequest], cameras: Mapping[str, RenderedConfig]
) -> RenderGroup:
    frames = tuple(name for name in plan.members if requests[name].every_instant)
    return RenderGroup(
        lens=plan.lens,
        mount=plan.mount,
        timing=plan.timing,
        look_back_ns=max(cameras[name].look_back_ns for name in plan.members),
        rate=Rate(plan.clock.rate_hz),
        frame_sensors=frames,
        image_sensors=tuple(name for name in plan.members if name not in frames),
        outputs=frozenset().union(*(requests[name].outputs for name in plan.members)),
        max_displacement_px=plan.clock.max_displacement_px,
    )
