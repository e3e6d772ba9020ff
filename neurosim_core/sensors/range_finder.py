"""The range finder: the distance to the nearest surface in a narrow cone."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from neurosim_core.packets import FieldSpec, Packet
from neurosim_core.registry import register
from neurosim_core.render.camera import PinholeConfig
from neurosim_core.sensors.base import ImageSensorConfig, RateHz


@dataclass(frozen=True, kw_only=True, eq=False)
class Range(Packet):
    """The reading of a range finder at its stamp."""

    display: ClassVar[str] = "time series"

    distance_m: Annotated[float, FieldSpec(unit="m")]
    """Distance to the nearest surface in the field of view [m]; -inf: nearer than the sensor can measure;
    inf: farther, or nothing there (ROS REP 117)."""
    field_of_view_rad: Annotated[float, FieldSpec(unit="rad", constant=True)]
    """Width of the field of view [rad]."""
    range_min_m: Annotated[float, FieldSpec(unit="m", constant=True)]
    """Shortest distance that it measures [m]."""
    range_max_m: Annotated[float, FieldSpec(unit="m", constant=True)]
    """Longest distance that it measures [m]."""


@register("sensor", "range_finder")
class RangeFinderConfig(ImageSensorConfig):
    """A time-of-flight range finder that looks along the optical axis of its mount.

    Its field of view is a square pyramid, sampled by one ray for each pixel of the lens. It reads the
    shortest of their lengths, without noise.
    """

    kind: Literal["range_finder"] = "range_finder"
    lens: PinholeConfig = PinholeConfig(width=5, height=5, horizontal_fov_rad=0.07)
    """Rays and field of view."""
    rate_hz: RateHz = 50.0
    """Reading rate [Hz]."""
    range_min_m: Annotated[float, Field(ge=0.0)] = 0.02
    """Shortest distance that it measures [m]."""
    range_max_m: Annotated[float, Field(gt=0.0)] = 40.0
    """Longest distance that it measures [m]."""

    packet_type = Range
    output = "depth"
    encoding = "32FC1"

    @model_validator(mode="after")
    def _has_a_range(self) -> RangeFinderConfig:
        if self.range_min_m >= self.range_max_m:
            raise ValueError(
                f"range_min_m must be below range_max_m = {self.range_max_m:g}, got {self.range_min_m:g}"
            )
        return self

    def packet(self, picture: NDArray[Any], **header: Any) -> Range:
        """Return the reading; the picture holds planar depth z [m], shape [H, W]."""
        distance_m = float((picture / _cosines(self.lens)).min())
        if distance_m < self.range_min_m:
            distance_m = -np.inf
        elif distance_m > self.range_max_m:
            distance_m = np.inf
        f = self.lens.intrinsics()
        return Range(
            distance_m=distance_m,
            field_of_view_rad=float(2.0 * np.arctan(0.5 * self.lens.width / f.fx)),
            range_min_m=self.range_min_m,
            range_max_m=self.range_max_m,
            **header,
        )


@functools.lru_cache(maxsize=16)
def _cosines(lens: PinholeConfig) -> NDArray[np.float32]:
    """Return z of the unit ray of each pixel, shape [H, W]: range = depth / z."""
    return lens.ray_table()[..., 2]
