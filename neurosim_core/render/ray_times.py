"""When rays are cast: rolling shutters, exposures and scanners are rays with times of their own.

A picture has a few instants, offsets from its stamp, and each of its rays belongs to one of them. The poses
of the camera and of bodies at these instants come from the history of the flight (`sim.trace`); a kernel
looks up which one a ray has. Offsets are never positive: a stamp is when the last ray is cast, so that a
controller that has the picture sees nothing of the future.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from neurosim_core.clock import NS_PER_S
from neurosim_core.render.camera import Lens
from neurosim_core.settings import BaseConfig

INSTANT_COUNT_MAX = 65536
"""Most instants of one picture."""


class RayTimes(NamedTuple):
    """The instants of a picture, and which one each ray belongs to."""

    offsets_ns: NDArray[np.int64]
    """From the stamp [ns], <= 0, shape [J]."""
    instant: NDArray[np.int32]
    """Index into `offsets_ns`, shape [layer, H * W]; the layers are those of `ray_layers`."""
    sample_count: int
    """Rays per pixel whose mean is the radiance; with more than one, layer 0 is for geometry alone."""


class RayTiming(Protocol):
    """Settings of when rays are cast; hashable."""

    @property
    def window_ns(self) -> int:
        """Time from the first ray to the stamp [ns]."""

    def times(self, lens: Lens, sample_count: int) -> RayTimes | None:
        """Return the times of the rays of a lens, of so many samples; None: all are cast at the stamp."""


@dataclass(frozen=True)
class SweepTiming:
    """When the rays of a scan are cast, the last at the stamp; those of a camera all at the first time."""

    window_ns: int
    """From the first ray to the stamp [ns]."""

    def times(self, lens: Lens, sample_count: int) -> RayTimes:
        """Return the times of the rays: one ray each, whatever the settings ask for."""
        fractions = lens.fractions() if hasattr(lens, "fractions") else np.zeros((lens.height, lens.width))
        steps = np.rint((fractions - 1.0) * self.window_ns).astype(np.int64).ravel()
        offsets_ns, instant = np.unique(steps, return_inverse=True)
        if len(offsets_ns) > INSTANT_COUNT_MAX:
            raise ValueError(f"a sweep has at most {INSTANT_COUNT_MAX} times, got {len(offsets_ns)}")
        return RayTimes(offsets_ns, np.ascontiguousarray(instant.reshape(1, -1), dtype=np.int32), 1)


class ShutterConfig(BaseConfig):
    """Exposure times of the lines of a picture; by default, all lines are exposed at the stamp.

    Lines are rows, or columns, and are read one after the other; the last one is read at the stamp. A line is
    exposed for `exposure_s` until it is read: its light is the mean of as many instants in linear light.
    """

    readout_s: Annotated[float, Field(ge=0.0, le=1.0)] = 0.0
    """Time to read a picture, line by line [s]; 0: a global shutter."""
    direction: Literal["down", "up", "right", "left"] = "down"
    """Order in which lines are read: rows downwards or upwards, or columns."""
    exposure_s: Annotated[float, Field(ge=0.0, le=1.0)] = 0.0
    """Exposure time of a line [s]; 0: pictures without motion blur. Geometry (depth, normal, instance) is
    that of the middle of the exposure."""
    exposure_samples: Annotated[int, Field(ge=1, le=256)] = 16
    """Sampling times in an exposure, each with a ray per pixel; at least `render.samples_per_pixel`, 16 if it
    is adaptive and there are several."""

    @model_validator(mode="after")
    def _keys_have_effect(self) -> ShutterConfig:
        for name, time in (("direction", "readout_s"), ("exposure_samples", "exposure_s")):
            value, default = getattr(self, name), type(self).model_fields[name].default
            if value != default and getattr(self, time) == 0.0:
                raise ValueError(f"{name} does nothing where {time} is 0, got {value!r}")
        return self

    @property
    def window_ns(self) -> int:
        """Time from the first ray to the stamp [ns]."""
        return math.ceil((self.readout_s + self.exposure_s) * NS_PER_S)

    def times(self, lens: Lens, sample_count: int) -> RayTimes | None:
        """Return the times of the rays of a lens; None: all are cast at the stamp."""
        if self.readout_s == 0.0 and self.exposure_s == 0.0:
            return None
        lines = lens.height if self.direction in ("down", "up") else lens.width
        line_count = lines if self.readout_s > 0.0 else 1
        order = np.arange(line_count) if self.direction in ("down", "right") else np.arange(line_count)[::-1]
        read_s = (order + 1 - line_count) * (self.readout_s / line_count)
        samples = max(sample_count, self.exposure_samples) if self.exposure_s > 0.0 else sample_count
        # the middle for geometry, then samples, in an order unrelated to where in the pixel they are
        parts = np.array([0.5])
        if samples > 1:
            parts = np.concatenate([parts, (_scattered(samples) + 0.5) / samples])
        back_s = self.exposure_s * (1.0 - parts)
        offsets_ns = np.rint((read_s[None, :] - back_s[:, None]) * NS_PER_S).astype(np.int64)
        unique, index = np.unique(offsets_ns, return_inverse=True)
        index = np.broadcast_to(index.reshape(offsets_ns.shape), (len(parts), line_count))
        rows, columns = np.indices((lens.height, lens.width)).reshape(2, -1)
        line = rows if self.direction in ("down", "up") else columns
        instant = index[:, line] if line_count > 1 else np.repeat(index, len(line), axis=1)
        return RayTimes(unique, np.ascontiguousarray(instant, dtype=np.int32), samples)


def _scattered(count: int) -> NDArray[np.int64]:
    """Return 0 to count - 1 in steps of about 0.38 of them, each once: neighbours are far apart."""
    step = max(1, round(0.382 * count))
    while math.gcd(step, count) > 1:
        step += 1
    return (np.arange(count) * step) % count


def refuse_several(kind: str, shape: Mapping[str, Any]) -> None:
    """Raise if a renderer of one world and one time is asked for more.

    Raises:
        ValueError: There are several worlds, or rays have times of their own.
    """
    worlds = shape.get("worlds")
    if worlds is not None and worlds.count > 1:
        raise ValueError(f"{worlds.count} worlds need the renderer 'warp', got {kind!r}")
    if shape.get("times") is not None:
        raise ValueError(f"rays with times of their own need renderer: warp, not {kind!r}")
