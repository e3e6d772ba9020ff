"""The bench that shows light to event pixels, and what is found there, beside its closed form."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurosim_core.bench.engine import EventArrays, EventCamera, EventCameraConfig
from neurosim_core.bench.report import Row

Floats = NDArray[np.float64]

THRESHOLD = 0.2
STAMP_S = 1e-6
"""Resolution of stamps."""


@dataclass(frozen=True, eq=False)
class Curve:
    """A quantity that was measured at several settings, and its closed form."""

    pattern: str
    """Pattern: quantity over setting, with units."""
    name: str
    x: Floats
    """Settings, shape [n]."""
    measured: Floats
    """Shape [n]."""
    expected: Floats
    """The closed form at the settings, shape [n]."""
    deviation: Floats | None = None
    """Standard deviation of `measured` by chance, or what is allowed, shape [n]; None: no chance."""

    @property
    def error(self) -> float:
        """Largest difference between measured and expected."""
        return float(np.abs(self.measured - self.expected).max())

    @property
    def relative(self) -> float:
        """Largest difference, as a share of what is expected."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return float((np.abs(self.measured - self.expected) / np.abs(self.expected)).max())

    @property
    def sigma(self) -> float:
        """Largest difference in deviations; nan where there are none."""
        if self.deviation is None:
            return float("nan")
        return float((np.abs(self.measured - self.expected) / self.deviation).max())

    def row(self) -> Row:
        """Return the curve as a row of a table."""
        row: Row = {"pattern": self.pattern, "curve": self.name, "points": len(self.x)}
        row |= {"from": float(self.x.min()), "to": float(self.x.max()), "largest error": self.error}
        return {**row, "relative": self.relative, "in deviations": self.sigma}


class TestBench:
    """Shows patterns to pixels.

    Args:
        device: Warp device.
        quick: Few settings and pixels.
    """

    __test__ = False  # pytest would collect it

    def __init__(self, *, device: str, quick: bool) -> None:
        self.device = device
        self.quick = quick

    def pick(self, full: int, quick: int) -> int:
        """Return a size that depends on how much is measured."""
        return quick if self.quick else full

    def expose(
        self, config: EventCameraConfig, log: Floats, time_s: Sequence[float] | Floats, *, seed: int = 0
    ) -> EventArrays:
        """Return the events of pixels that begin at the first frame.

        Args:
            config: What the pixels are like.
            log: Log radiance, shape [K, H, W].
            time_s: When, shape [K].
            seed: Of the noise.
        """
        _, height, width = log.shape
        camera = EventCamera(
            config, width=width, height=height, device=self.device, sensor="bench", seed=seed
        )
        stamps = np.rint(1e9 * np.asarray(time_s)).astype(np.int64)
        frames = log.astype(np.float32)
        camera.reset(frames[0], int(stamps[0]))
        return camera.feed(frames[1:], stamps[1:]).numpy()


def make_pixel(**settings: Any) -> EventCameraConfig:
    """Return pixels with both thresholds 0.2 and whatever else is asked for."""
    thresholds = {"threshold_on": THRESHOLD, "threshold_off": THRESHOLD}
    return EventCameraConfig.model_validate({**thresholds, **settings})


def make_preset(name: str, **settings: Any) -> EventCameraConfig:
    """Return the pixels of a preset, with some settings in place of its own."""
    return EventCameraConfig.model_validate({"preset": name, **settings})


def still(level: float, side: int) -> Floats:
    """Return two frames of one log radiance everywhere, shape [2, side, side]."""
    return np.full((2, side, side), level)


def events_per_pixel(events: EventArrays, width: int, count: int) -> NDArray[np.int64]:
    """Return the number of events of each pixel, shape [count]."""
    return np.bincount(events.y.astype(np.int64) * width + events.x, minlength=count)


def rates_hz(events: EventArrays, width: int, count: int) -> Floats:
    """Return the rate of each pixel from its first to its last event, shape [count]; nan if it has one."""
    pixel = events.y.astype(np.int64) * width + events.x
    order = np.argsort(pixel, kind="stable")
    pixel, t = pixel[order], events.t[order]
    found, first, number = np.unique(pixel, return_index=True, return_counts=True)
    rates = np.full(count, np.nan)
    several = number > 1
    rates[found[several]] = (number[several] - 1) / (1e-6 * (t[first + number - 1] - t[first])[several])
    return rates
