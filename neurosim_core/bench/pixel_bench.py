"""The bench that shows light to event pixels, and how their events are counted.

Light is given as log radiance that is linear between frames, so ramps and steps are exact. Pixels of one row
or picture see the same unless a pattern moves: what differs between them is mismatch and noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurosim_core.bench.pixel_result import Floats
from neurosim_core.packets import EventArrays
from neurosim_core.sensors.event_config import EventCameraConfig
from neurosim_core.sensors.events import EventCamera

THRESHOLD = 0.2


class TestBench:
    """Shows patterns to pixels.

    Attributes:
        device: Warp device.
        quick: Few settings and pixels.
    """

    def __init__(self, *, device: str, quick: bool) -> None:
        self.device = device
        self.quick = quick

    def pick(self, full: int, quick: int) -> int:
        """Return a size that depends on how much is measured."""
        return quick if self.quick else full

    def expose(
        self,
        config: EventCameraConfig,
        log_radiance: Floats,
        time_s: Sequence[float] | Floats,
        *,
        seed: int = 0,
    ) -> EventArrays:
        """Return the events of pixels that begin at the first frame.

        Args:
            config: What the pixels are like.
            log_radiance: Shape [K, H, W].
            time_s: When, shape [K].
            seed: Of the noise.
        """
        _, height, width = log_radiance.shape
        camera = EventCamera(
            config, width=width, height=height, device=self.device, sensor="bench", seed=seed, on_host=True
        )
        stamps = np.rint(1e9 * np.asarray(time_s)).astype(np.int64)
        frames = log_radiance.astype(np.float32)
        camera.reset(frames[0], int(stamps[0]))
        return camera.feed(frames[1:], stamps[1:]).numpy()


def make_pixel(**settings: Any) -> EventCameraConfig:
    """Return pixels with both thresholds 0.2 and whatever else is asked for."""
    return EventCameraConfig.model_validate(
        {"threshold_on": THRESHOLD, "threshold_off": THRESHOLD, **settings}
    )


def make_preset(name: str, **settings: Any) -> EventCameraConfig:
    """Return the pixels of a preset, with some settings in place of its own."""
    return EventCameraConfig.model_validate({"preset": name, **settings})


def still(level: float, *, height: int, width: int, count: int = 2) -> Floats:
    """Return frames of one log radiance everywhere, shape [count, height, width]."""
    return np.full((count, height, width), level)


def per_pixel(events: EventArrays, width: int, count: int) -> NDArray[np.int64]:
    """Return the number of events of each pixel, shape [count]."""
    pixel = events.y.astype(np.int64) * width + events.x
    return np.bincount(pixel, minlength=count)


def rates_hz(events: EventArrays, width: int, count: int) -> Floats:
    """Return the rate of each pixel from its first to its last event, shape [count]; nan if it has one."""
    pixel = events.y.astype(np.int64) * width + events.x
    order = np.argsort(pixel, kind="stable")
    pixel, t = pixel[order], events.t[order]
    found, first, number = np.unique(pixel, return_index=True, return_counts=True)
    rates = np.full(count, np.nan)
    several = number > 1
    span_s = 1e-6 * (t[first + number - 1] - t[first])[several]
    rates[found[several]] = (number[several] - 1) / span_s
    return rates
