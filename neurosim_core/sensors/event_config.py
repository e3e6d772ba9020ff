"""Settings of an event camera: thresholds, and how its pixels and its readout depart from the ideal.

Every group is optional. What is left out is not compiled and allocates nothing; the kernels are in
`event_scan` (ideal pixels), `event_noise_scan` and `event_readout`.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, SerializeAsAny, model_validator

from neurosim_core.registry import register
from neurosim_core.sensors.event_noise_model import TERMS, NoiseTermConfig, parse_terms
from neurosim_core.settings import BaseConfig, fill_from_preset
from neurosim_core.settings_file import read_table

Share = Annotated[float, Field(ge=0.0, le=1.0)]
Rate = Annotated[float, Field(ge=0.0, le=1e6)]
Decades = Annotated[float, Field(ge=0.0, le=2.0)]


class _ThresholdNoiseConfig(NoiseTermConfig):
    """Thresholds with normally distributed deviations from the nominal ones."""

    sigma_on: Annotated[float, Field(ge=0.0, le=10.0)] = 0.03
    """Standard deviation of the ON threshold, in log radiance."""
    sigma_off: Annotated[float, Field(ge=0.0, le=10.0)] = 0.03
    """Standard deviation of the OFF threshold, in log radiance."""
    minimum: Annotated[float, Field(ge=1e-3, le=100.0)] = 0.01
    """Smaller thresholds are raised to this one, in log radiance."""


@register("noise", "threshold_spread")
class ThresholdSpreadConfig(_ThresholdNoiseConfig):
    """Mismatch: the thresholds of each pixel have a fixed, normally distributed deviation."""

    compiled = ("spread",)


@register("noise", "threshold_jitter")
class ThresholdJitterConfig(_ThresholdNoiseConfig):
    """Thresholds that are drawn anew after each event, around those of the pixel, as in ESIM."""

    compiled = ("jitter",)


@register("noise", "lin_log")
class LinLogConfig(NoiseTermConfig):
    """A logarithm that becomes linear in the dark, where 8-bit pictures are too coarse, as in v2e.

    With DN the radiance in units of white_radiance / 255, the pixel sees ln(DN) above `linear_below`, here D,
    and DN ln(D) / D below.
    """

    compiled = ("lin_log",)

    linear_below: Annotated[float, Field(gt=1.0, le=255.0)] = 20.0
    """Radiance below which the response is linear [white_radiance / 255]."""

    def numbers(self, white_radiance: float) -> tuple[float, ...]:
        """Return radiance where the logarithm begins, its logarithm, and log radiance over that light."""
        begin = white_radiance * self.linear_below / 255.0
        return begin, math.log(begin), math.log(self.linear_below)


@register("noise", "low_pass")
class LowPassConfig(NoiseTermConfig):
    """Bandwidth of the photoreceptor: a first-order low-pass filter, slower in the dark.

    With I the radiance at the pixel, I_w that of white and I_d what the dark current stands for, the 3 dB
    frequency is cutoff_hz min((I + I_d) / (I_w + I_d), 1).
    """

    compiled = ("low_pass",)

    cutoff_hz: Annotated[float, Field(gt=0.0, le=1e12)] = 3000.0
    """3 dB frequency at `white_radiance` [Hz]; above that light it stays, limited by the bias current."""
    dark_radiance: Annotated[float, Field(ge=0.0)] = 0.08
    """Radiance equivalent of the dark current; it keeps the time constant of a black pixel finite."""


@register("noise", "leak")
class LeakConfig(NoiseTermConfig):
    """Leak of the reset switch: the reference falls, so that a still pixel fires ON events steadily."""

    compiled = ("leak",)

    rate_hz: Annotated[float, Field(ge=0.0, le=1e4)] = 0.1
    """ON events per second of a pixel in a still scene, in the dark [Hz]."""
    spread_decades: Decades = 0.1
    """Standard deviation of log10 of the rate between pixels; the rate of a pixel is fixed."""
    bright_factor: Annotated[float, Field(ge=0.0, le=1e4)] = 1.0
    """Factor on the rate at `white_radiance`, linear in light, which leaks through the switch."""

    def terms(self) -> tuple[str, ...]:
        """Return the names of what is compiled in."""
        return self.compiled if self.bright_factor == 1.0 else (*self.compiled, "light_leak")


@register("noise", "shot_noise")
class ShotNoiseConfig(NoiseTermConfig):
    """Shot noise: random events, a Poisson process in each pixel; fewer where it is bright."""

    compiled = ("spontaneous",)

    rate_hz: Rate = 1.0
    """Events per second of a pixel in the dark, of both polarities together [Hz]."""
    bright_factor: Share = 0.25
    """Factor on the rate at `white_radiance` and above; it falls linearly with radiance."""
    on_fraction: Share = 0.5
    """Share of ON events, from 0 to 1."""
    spread_decades: Decades = 0.1
    """Standard deviation of log10 of the rate between pixels; the rate of a pixel is fixed."""
    by_threshold: bool = False
    """Whether the rate of a polarity is inversely proportional to the threshold of the pixel, as in v2e."""


class NoiseLevelConfig(BaseConfig):
    """Measured rates of random events at one illuminance."""

    lux: Annotated[float, Field(ge=1e-6, le=1e7)]
    """Illuminance of the scene [lux]."""
    on_hz: Rate
    """ON events per second of the median pixel [Hz]."""
    off_hz: Rate
    """OFF events per second of the median pixel [Hz]."""
    spread_decades: Decades = 0.25
    """Standard deviation of log10 of the rates between pixels; a pixel has one rank at all illuminances."""


@register("noise", "measured_noise")
class MeasuredNoiseConfig(NoiseTermConfig):
    """Random events at rates measured at several illuminances, for each polarity.

    Each pixel is a Poisson process. Between two lights rates are linear in the logarithm of light, beyond
    them they stay. They come from `levels`, or each pixel takes those of a random pixel in `file`.
    """

    compiled = ("spontaneous", "measured")

    white_lux: Annotated[float, Field(ge=1e-3, le=1e7)] = 1000.0
    """Illuminance that corresponds to `white_radiance` [lux]."""
    levels: tuple[NoiseLevelConfig, ...] = ()
    """Rates by ascending illuminance: [{lux: 0.1, on_hz: 5, off_hz: 4}, ...]."""
    file: Path | None = None
    """Rates of P pixels of a sensor at L ascending illuminances: .npz with lux [L], on_hz [L, P], off_hz [L,
    P]. `neurosim fit-sensor --also` makes one."""

    @model_validator(mode="after")
    def _rates_are_there(self) -> MeasuredNoiseConfig:
        if (self.file is None) == (not self.levels):
            raise ValueError("give levels or file, one of them")
        lux = [level.lux for level in self.levels]
        if sorted(set(lux)) != lux:
            raise ValueError(f"levels must go from dark to bright, got lux {lux}")
        return self


@register("noise", "hot_pixels")
class HotPixelConfig(NoiseTermConfig):
    """A few pixels that fire continuously, at random times."""

    compiled = ("spontaneous",)

    fraction: Share = 1e-4
    """Share of hot pixels, which are drawn once."""
    rate_hz: Rate = 100.0
    """Events per second of a hot pixel [Hz]."""
    on_fraction: Share = 1.0
    """Share of ON events, from 0 to 1."""


@register("noise", "stochastic")
class StochasticConfig(NoiseTermConfig):
    """DVS-Voltmeter: the voltage of a pixel is a Brownian motion with drift, events are first passages.

    With L the radiance in units of white_radiance / 255, at most 1000 times white, the voltage moves with

        mean rate  k1 d/dt ln(L + k2) + k4 + k5 L,    standard deviation  k3 sqrt(L) / (L + k2) + k6,

    per microsecond and root microsecond, and fires at +1 and -1. `threshold_on` and `threshold_off` do not
    count (k1 holds them), only their spread does.

    Reference: Lin, Ma, Guo, Wen (2022), DVS-Voltmeter: stochastic process-based event simulator for dynamic
    vision sensors, ECCV, eq. (10) and (11), where d/dt ln(L + k2) is taken between frames; its published code
    has the parameters.
    """

    compiled = ("stochastic",)

    k1: Annotated[float, Field(ge=0.0, le=1e4)]
    """Events per e-fold of light; its inverse is the threshold."""
    k2: Annotated[float, Field(ge=0.0, le=1e6)]
    """Radiance equivalent of the dark current [white_radiance / 255]."""
    k3: Annotated[float, Field(ge=0.0, le=1e3)]
    """Photon noise, times sqrt(L) / (L + k2) [1/sqrt(us)]."""
    k4: Annotated[float, Field(ge=0.0, le=1.0)]
    """Leak rate in the dark [1/us]."""
    k5: Annotated[float, Field(ge=0.0, le=1e-3)]
    """Leak rate by parasitic photocurrent, per unit of L [1/us]."""
    k6: Annotated[float, Field(ge=0.0, le=1.0)]
    """Noise that does not depend on light [1/sqrt(us)]."""
    random_phase: bool = True
    """Whether voltages begin at random in [0, 1), as in a running camera; false: at 0, as published."""

    @model_validator(mode="after")
    def _noise_is_bounded(self) -> StochasticConfig:
        photons = 0.5 * self.k3 / math.sqrt(max(self.k2, 1e-300))
        if photons + self.k6 > 1.0:
            raise ValueError(
                f"k3 / (2 sqrt(k2)) + k6, the largest noise, must be at most 1 per root microsecond, "
                f"got k2 = {self.k2:g}, k3 = {self.k3:g}, k6 = {self.k6:g}"
            )
        return self


class ReadoutConfig(BaseConfig):
    """The arbiter between pixels and bus: events queue for it, and their stamps are readout times.

    `event`: one event at a time, in the order in which they came. `row`: the row with the oldest event that
    waits is read at once, all its events get the same stamp; it takes row_s + n / bandwidth_hz.
    """

    kind: Literal["event", "row"] = "event"
    """What is read at a time: one event, or all waiting events of a row."""
    bandwidth_hz: Annotated[float, Field(ge=1.0, le=1e12)] = 12e6
    """Readout bandwidth, in events per second [Hz]."""
    row_s: Annotated[float, Field(ge=0.0, le=1.0)] = 0.0
    """`row`: time to select a row before its events are read [s]."""
    handshake: bool = False
    """Whether a pixel stays in reset until its event is read: events that it would have fired meanwhile are
    lost, and counted in `Events.dropped_count`."""
    latency_s: Annotated[float, Field(ge=0.0, le=1.0)] = 0.0
    """Mean time from the readout of an event to its stamp [s]."""
    jitter_s: Annotated[float, Field(ge=0.0, le=1.0)] = 0.0
    """Standard deviation of that time, event by event; no stamp is before the readout [s]."""
    queue_length: Annotated[int, Field(ge=1, le=1 << 26)] = 65_536
    """Capacity of the queue [events]; events that find it full are lost, and counted in
    `Events.dropped_count`. Reading a full queue must take 60 s at most."""

    @model_validator(mode="after")
    def _queue_is_read_in_time(self) -> ReadoutConfig:
        if self.queue_length > 60.0 * self.bandwidth_hz:
            raise ValueError(
                f"queue_length must be at most 60 s of bandwidth_hz = {self.bandwidth_hz:g}, "
                f"got {self.queue_length}"
            )
        return self


def event_presets() -> dict[str, Any]:
    """Return what is known of each sensor that is a preset: the table `event_presets.yaml`."""
    return read_table(__file__, "event_presets")


def describe_pixel(pixel: EventCameraConfig) -> str:
    """Return preset, thresholds and everything that departs from the ideal, by the keys that set it."""
    parts = [] if pixel.preset is None else [pixel.preset]
    if pixel.stochastic is not None:
        parts.append(f"steps of about {1.0 / pixel.stochastic.k1:.3g}" if pixel.stochastic.k1 else "no steps")
    else:
        parts.append(f"thresholds {pixel.threshold_on:g} on, {pixel.threshold_off:g} off")
    groups = {name: getattr(pixel, name) for name in type(pixel).model_fields}
    present = [name for name, group in groups.items() if isinstance(group, NoiseTermConfig | ReadoutConfig)]
    present += [term for each in pixel.noise for term in each.terms()]
    if pixel.refractory_s > 0.0:
        present.append("refractory_s")
    return ", ".join([*parts, *(present or ["ideal"])])


class EventCameraConfig(BaseConfig):
    """The pixels of an event camera, ideal by default: equal thresholds, no noise, no dead time.

    What counts as reaching a threshold, when samples are rounded to float32, is in `EventCamera`.
    """

    preset: str | None = None
    """Name of a sensor whose settings apply where none are given here: dvs128, davis240c, davis346, gen3,
    gen4, imx636, v2e_clean, v2e_noisy, voltmeter_dvs240 or voltmeter_dvs346 (sources: event_presets.yaml).
    null turns a group off: {preset: davis346, leak: {rate_hz: 0.2}, shot_noise: null}. From a file that lists
    every key, remove those that the preset shall set."""
    threshold_on: float = Field(default=0.2, ge=1e-3, le=100.0)
    """Rise of log radiance (natural logarithm) that fires an ON event, polarity 1."""
    threshold_off: float = Field(default=0.2, ge=1e-3, le=100.0)
    """Fall of log radiance (natural logarithm) that fires an OFF event, polarity 0."""
    white_radiance: float = Field(default=1.0, gt=0.0, le=1e30)
    """Radiance of white, the brightest value of a picture, for all terms that depend on light."""
    threshold_spread: ThresholdSpreadConfig | None = None
    """Fixed thresholds that differ between pixels: {sigma_on: 0.03, sigma_off: 0.03, minimum: 0.01}, standard
    deviations in log radiance; null: none."""
    threshold_jitter: ThresholdJitterConfig | None = None
    """Thresholds drawn anew after each event: {sigma_on: 0.03, sigma_off: 0.03, minimum: 0.01}; null: they
    are fixed."""
    lin_log: LinLogConfig | None = None
    """Linear response in the dark, as in v2e: {linear_below: 20}; null: logarithmic everywhere."""
    low_pass: LowPassConfig | None = None
    """Finite bandwidth of the photoreceptor, lower in the dark: {cutoff_hz: 3000, dark_radiance: 0.08}; null:
    unlimited."""
    refractory_s: float = Field(default=0.0, ge=0.0, le=10.0)
    """Time after each event in which a pixel is held in reset [s]; its reference is the signal at its end."""
    leak: LeakConfig | None = None
    """ON events at a steady rate, also of still pixels: {rate_hz: 0.1, spread_decades: 0.1}; null: none."""
    shot_noise: ShotNoiseConfig | None = None
    """Random events, more of them in the dark: {rate_hz: 1, bright_factor: 0.25, on_fraction: 0.5,
    spread_decades: 0.1}; null: none."""
    measured_noise: MeasuredNoiseConfig | None = None
    """Random events at measured rates, instead of `shot_noise`: {white_lux: 1000, levels: [{lux: .., on_hz:
    .., off_hz: .., spread_decades: 0.25}, ..]}, or {file: my_camera.npz}; null: none."""
    hot_pixels: HotPixelConfig | None = None
    """Pixels that fire continuously: {fraction: 1e-4, rate_hz: 100, on_fraction: 1}; null: none."""
    stochastic: StochasticConfig | None = None
    """DVS-Voltmeter model, Brownian motion instead of thresholds: {k1: .., .. k6: .., random_phase: true};
    replaces low_pass, leak and noise. null: thresholds."""
    noise: Annotated[tuple[SerializeAsAny[NoiseTermConfig], ...], BeforeValidator(parse_terms)] = ()
    """Noise terms of other packages, by kind: [{kind: flicker, depth: 0.1}]; each kind once."""
    readout: ReadoutConfig | None = None
    """Arbiter with limited bandwidth: {kind: event or row, bandwidth_hz: 12e6, row_s: 0, queue_length:
    65536}; null: all events are read at once."""
    event_count_max: int = Field(default=1 << 24, ge=1, le=1 << 30)
    """Most events between two frames. When there are more, the rows from the top are kept as long as they
    fit; the events of the others are lost, and counted in `Events.dropped_count`. The buffer grows up to this
    size times the frames of a batch as needed, 8 bytes per event; sorting takes about 40 bytes per event."""

    def terms(self) -> tuple[str, ...]:
        """Return what departs from ideal pixels: some of `event_noise_model.TERMS`, and terms of others."""
        groups = [getattr(self, name) for name in type(self).model_fields]
        terms = [each for each in (*groups, *self.noise) if isinstance(each, NoiseTermConfig)]
        present = {name for term in terms for name in term.terms()}
        if self.refractory_s > 0.0:
            present.add("refractory")
        return (*(term for term in TERMS if term in present), *sorted(present - set(TERMS)))

    @model_validator(mode="before")
    @classmethod
    def _fill_from_preset(cls, given: Any) -> Any:
        filled = fill_from_preset(given, {name: preset["pixel"] for name, preset in event_presets().items()})
        if "preset" in given and "shot_noise" in given and "measured_noise" not in given:
            filled["measured_noise"] = None  # the user has said which noise there is
        return filled

    @model_validator(mode="after")
    def _law_is_one(self) -> EventCameraConfig:
        if self.stochastic is not None:
            for name in ("threshold_jitter", "lin_log", "low_pass", "leak", "shot_noise", "measured_noise"):
                if getattr(self, name) is not None:
                    raise ValueError(f"{name} must be null where stochastic is given, which has its own")
            for name in ("threshold_on", "threshold_off"):
                if (value := getattr(self, name)) != type(self).model_fields[name].default:
                    raise ValueError(f"{name} does nothing where stochastic is given, got {value:g}: use k1")
        kinds = [term for each in self.noise for term in each.terms()]
        if len(set(kinds)) < len(kinds):
            raise ValueError(f"noise must have each kind once, got {', '.join(kinds)}")
        if self.shot_noise is not None and self.measured_noise is not None:
            raise ValueError("give shot_noise or measured_noise, not both")
        return self
