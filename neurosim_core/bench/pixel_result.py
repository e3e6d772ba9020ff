"""What the test bench of the event pixel finds: measurements beside what theory says of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class Curve:
    """A quantity that was measured at several settings, and its closed form."""

    name: str
    x: Floats
    """Setting, shape [n]."""
    measured: Floats
    """Shape [n]."""
    law: Callable[[Floats], Floats]
    """The closed form: what is expected at any setting."""
    deviation: Floats | None = None
    """Standard deviation of `measured` by chance, shape [n]; None: nothing is by chance."""

    @property
    def expected(self) -> Floats:
        """What the closed form says at the settings, shape [n]."""
        return np.asarray(self.law(self.x), dtype=np.float64)

    @property
    def error_max(self) -> float:
        """Largest difference between measured and expected."""
        return float(np.abs(self.measured - self.expected).max())

    @property
    def relative_error_max(self) -> float:
        """Largest difference, as a share of what is expected."""
        return float((np.abs(self.measured - self.expected) / np.abs(self.expected)).max())

    @property
    def sigma_max(self) -> float:
        """Largest difference in standard deviations; nan where nothing is by chance."""
        if self.deviation is None:
            return float("nan")
        return float((np.abs(self.measured - self.expected) / self.deviation).max())


@dataclass(frozen=True, kw_only=True)
class Jitter:
    """How precisely a pixel model times an edge that passes."""

    name: str
    delay_s: float
    """Mean time after that of an ideal pixel [s]."""
    delay_expected_s: float
    jitter_s: float
    """Standard deviation of the times of the first events along the row [s]."""
    jitter_expected_s: float
    span_s: float
    """Mean time from the first event of a pixel to its last: how sharp the edge is left [s]."""
    span_expected_s: float
    span_deviation_s: float
    """Its standard deviation from pixel to pixel by theory [s]."""
    count: int
    """Pixels that it was taken from."""


@dataclass(frozen=True, kw_only=True, eq=False)
class BarTimes:
    """When the pixels along a row first saw an edge."""

    name: str
    column: Floats
    """[px]."""
    late_s: Floats
    """After an ideal pixel [s], shape [rows, columns]."""


@dataclass(frozen=True, kw_only=True)
class PresetRow:
    """A sensor on the bench."""

    name: str
    title: str
    threshold_on: float
    """As measured on a ramp, mean of the pixels, in log radiance."""
    threshold_on_expected: float
    threshold_off: float
    threshold_off_expected: float
    mismatch_on: float
    """Standard deviation of the threshold from pixel to pixel, in log radiance."""
    mismatch_on_expected: float
    mismatch_off: float
    mismatch_off_expected: float
    dark_on_hz: float
    """ON events a second and pixel of a still scene at a tenth of white [Hz]."""
    dark_on_expected_hz: float
    dark_off_hz: float
    dark_off_expected_hz: float
    corner_hz: float
    """Nominal 3 dB frequency at white [Hz]; inf without low-pass."""
    refractory_s: float
    """Nominal [s]."""
    bandwidth_hz: float
    """Nominal rate of the readout [Hz]; inf without one."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PixelResult:
    """What `measure_pixel` found."""

    quick: bool
    device: str
    ramp: Sequence[Curve]
    """Rate of a pixel [Hz] over the slope of log radiance [1/s]."""
    threshold: Curve
    """Threshold of the ideal pixel that the ramp gives back, over the slope."""
    staircase: Sequence[Curve]
    """Events of an ideal pixel over the height of a step."""
    s_curve: Sequence[Curve]
    """Share of the pixels that fire over the height of a step."""
    s_curve_distance: float
    """Largest Kolmogorov-Smirnov distance of the S-curves, times the root of the number of pixels."""
    latency: Sequence[Curve]
    """Time from a step to the first event [s] over the radiance after it."""
    gain: Sequence[Curve]
    """Gain of the photoreceptor over frequency [Hz], one curve for each radiance."""
    corner: Sequence[Curve]
    """3 dB frequency [Hz] over radiance."""
    bar: Sequence[BarTimes]
    jitter: Sequence[Jitter]
    dark: Sequence[Curve]
    """Rate of events of one polarity of a still pixel [Hz] over radiance."""
    survival: Curve
    """Share of the intervals of shot noise that are longer, over time [s]."""
    survival_distance: float
    """Kolmogorov-Smirnov distance of the intervals from the exponential law, times the root of how many."""
    competition: Curve
    """Rate of leak events [Hz] over the rate of shot noise that resets the pixel [Hz]."""
    hot: Curve
    """Share of hot pixels that were found, over the share that was asked for."""
    throughput: Sequence[Curve]
    """Rate out of the readout over the rate in [Hz]."""
    batch: Curve
    """Events that are read together with a row, over the rate in [Hz]."""
    wait: Curve
    """Mean time an event waits for the arbiter [s] over its load."""
    presets: Sequence[PresetRow]
