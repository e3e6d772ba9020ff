"""What many worlds yield in a step: arrays on the device."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import warp as wp


@dataclass(frozen=True, kw_only=True, eq=False)
class VehicleStates:
    """The states of all vehicles, on the device, valid until the next step or reset."""

    position: wp.array[wp.vec3d]
    """p_WB [m], shape [N, 3]."""
    velocity: wp.array[wp.vec3d]
    """v_WB in W [m/s], shape [N, 3]."""
    orientation: wp.array[wp.quatd]
    """q_WB, xyzw, shape [N, 4]."""
    body_rate: wp.array[wp.vec3d]
    """w_WB in B [rad/s], shape [N, 3]."""
    air_velocity: wp.array[wp.vec3d]
    """Velocity of the air there, wind, gusts and turbulence together, in W [m/s], shape [N, 3]."""
    rotor_speed: wp.array2d[wp.float64]
    """[rad/s], shape [N, R]."""
    stamp_ns: wp.array[wp.int64]
    """Time of each state since the reset of its world [ns], shape [N]; stops where a vehicle is held."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Samples:
    """What a state sensor measured in a step, in the order of time, valid until the next step or reset."""

    arrays: Mapping[str, Any]
    """By name, as the fields of its packets: device arrays of shape [sample, N, ...]."""
    offsets_ns: tuple[int, ...]
    """When each sample was taken, after the begin of the step [ns]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Observation:
    """What all worlds yield in a step: arrays on the device that the next step or reset overwrites."""

    state: VehicleStates
    """At the end of the step."""
    clock_ns: wp.array[wp.int64]
    """Time since the reset of each world [ns], shape [N]."""
    frames: Mapping[str, Any]
    """What each frame sensor found: of an event camera, `sensors.event_worlds.WorldEvents`."""
    images: Mapping[str, Any]
    """The last picture of each image sensor: rgb, uint8 [N, H, W, 3]; depth [m], float32 [N, H, W]; ..."""
    fresh: frozenset[str]
    """Image sensors that took their picture in this step."""
    samples: Mapping[str, Samples]
    """Of each state sensor."""
    collided: wp.array[wp.int32]
    """1: the vehicle touched the scene in this step, or is held because it did; shape [N]."""
    status: wp.array[wp.int32]
    """0, or why a vehicle is held: index into `vehicle.status.STATUS_TERMS`, shape [N]."""

    @property
    def events(self) -> Mapping[str, Any]:
        """The events of each event camera."""
        return self.frames
