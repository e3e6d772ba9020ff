# mypy: disable-error-code="attr-defined,union-attr"
"""The observation of many worlds after a step: arrays on the device."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import warp as wp

from neurosim_core.packets import Packet
from neurosim_core.sim.schedule import Stretch
from neurosim_core.sim.state import State
from neurosim_core.vehicle.arrays import MultirotorArrays


@dataclass(frozen=True, kw_only=True, eq=False)
class Samples:
    """The samples of a state sensor in a step, in the order of time, valid until the next step or reset."""

    arrays: Mapping[str, Any]
    """Device arrays of shape [sample, N, ...], by the names of its packet fields; lost samples have 0 in the
    array `received`."""
    offsets_ns: tuple[int, ...]
    """Time of each sample since the begin of the step [ns]."""
    packet: Callable[..., Packet | None]
    """Returns a sample of one world as a packet: `Sampler.packet`."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Observation:
    """The results of all worlds after a step: arrays on the device that the next step or reset overwrites."""

    state: MultirotorArrays
    """The states of all vehicles at the end of the step."""
    clock_ns: wp.array[wp.int64]
    """Time since the reset of each world [ns], shape [N]."""
    frames: Mapping[str, Any]
    """Results of each frame sensor; those of an event camera are `sensors.event_worlds.WorldEvents`."""
    images: Mapping[str, Any]
    """The last picture of each image sensor: rgb, uint8 [N, H, W, 3]; depth [m], float32 [N, H, W]; ..."""
    fresh: frozenset[str]
    """Names of image sensors that took a picture in this step."""
    samples: Mapping[str, Samples]
    """Samples of each state sensor."""
    collided: wp.array[wp.int32]
    """1: the vehicle touched the scene in this step, or is held after a contact; shape [N]."""
    status: wp.array[wp.int32]
    """0, or the reason why a vehicle is held, an index into `vehicle.arrays.STATUS_TERMS`; shape [N]."""

    @property
    def events(self) -> Mapping[str, Any]:
        """The events of each event camera."""
        return self.frames


def make_observation(state: State, stretch: Stretch) -> Observation:
    """Return views of the results of a stretch in many worlds."""
    arrays = state.vehicle.arrays
    samples = {}
    for index, (name, sampler) in enumerate(state.samplers.items()):
        places = stretch.sampler_places.get(index, ())
        offsets_ns = tuple(stretch.boundaries[place].stamp_ns for place in places)
        samples[name] = Samples(
            arrays={field: _first(rows, len(offsets_ns)) for field, rows in sampler.arrays.items()},
            offsets_ns=offsets_ns,
            packet=sampler.packet,
        )
    return Observation(
        state=arrays,
        clock_ns=state.worlds.clock_ns,
        frames={name: s.results for group in state.groups for name, s in group.frames.items()},
        images={name: picture for group in state.groups for name, picture in group.pictures.items()},
        fresh=stretch.pictures,
        samples=samples,
        collided=state.worlds.collided,
        status=arrays.status,
    )


def _first(rows: Any, count: int) -> Any:
    """Return the first rows; Warp refuses an empty slice."""
    if count == 0:
        return wp.empty((0, *rows.shape[1:]), dtype=rows.dtype, device=rows.device)
    return rows[:count]
