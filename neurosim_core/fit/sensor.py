"""The settings of event pixels that give what a recording shows, and how sure they are.

Statistics of the recording are measured (`recordings`); a camera with these settings is simulated in the same
light for as long, and measured alike; the settings are moved by what differs, until the simulation shows what
the recording does. So no bias of a statistic remains that the simulation shares. The spread of further
simulations with other seeds is the standard error (a parametric bootstrap).

Reference: Gourieroux, Monfort, Renault (1993), Indirect inference. Recordings of still light as a source of
parameters: Xu et al. (2026), Noise2Params, arXiv 2605.16317, which has another law of noise; S-curves and
steps: McReynolds, Graca, Delbruck (2022), Experimental methods to predict dynamic vision sensor event camera
performance.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from neurosim_core.fit.recordings import (
    Floats,
    Still,
    find_change,
    find_hot,
    find_steps,
    measure_readout,
    measure_steps,
    measure_still,
    sort_still,
)
from neurosim_core.packets import EventArrays
from neurosim_core.sensors.event_config import EventCameraConfig
from neurosim_core.sensors.events import EventCamera
from neurosim_core.settings_file import nested

_ROUNDS, _REFIT_ROUNDS = 5, 3
_GAIN = 1.3
"""A statistic moves by 0.5 to 1 of its setting: a step that is so much longer than the gap closes it soon."""
_SIMULATED_EVENTS = 2_000_000
"""Events of a simulation at most, about: it has fewer pixels than the recording where there are more."""
_PERIODS_MAX = 12
_ALIKE = 0.25
"""Pixels are alike whose thresholds spread by less than this share of what one event more or less makes."""
_JITTER = 1.15
"""Thresholds change from event to event where counts of a step vary by so much more than without."""
_DEFAULT_THRESHOLD = 0.2

Numbers = dict[str, float]


@dataclass(frozen=True, kw_only=True, eq=False)
class Stimulus:
    """Recordings of one camera and what it saw."""

    width: int
    """Of the sensor [px]."""
    height: int
    """Of the sensor [px]."""
    still: EventArrays
    """Events of constant light."""
    span_s: float | None = None
    """Length of the still recording [s]; None: from its first to its last event."""
    steps: EventArrays | None = None
    """Events of light that is switched between two levels, everywhere at once."""
    contrast: float = 2.0
    """Of the steps: the bright level over the dark one."""
    rise_s: float = 0.0
    """Time that light takes from one level to the other, linear in its logarithm [s]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Observation:
    """Measurements of one camera, real or simulated, and their curves for plots."""

    numbers: dict[str, Any]
    """Raw statistics, by the setting that they tell."""
    still: Still
    hot: Any
    """Which pixels are hot, shape [pixel]."""
    period_hz: Floats
    """Events a second and pixel over the time after a rise, ON and OFF, shape [2, 400]; empty: no steps."""
    period_s: float


@dataclass(frozen=True, kw_only=True, eq=False)
class SensorFit:
    """Settings of a camera, with their standard errors, and what a camera with them shows."""

    settings: dict[str, Any]
    """By dotted key of `EventCameraConfig`."""
    errors: Numbers
    """Standard errors, by the same keys."""
    real: Observation
    simulated: Observation
    notes: list[str] = field(default_factory=list)
    """The parameters that could not be estimated, and why."""


def make_pixel(settings: Mapping[str, Any]) -> EventCameraConfig:
    """Return pixels of dotted settings."""
    return EventCameraConfig.model_validate(nested(settings))


def fit_sensor(
    stimulus: Stimulus,
    *,
    repeats: int = 8,
    seed: int = 0,
    progress: Callable[[str], None] = lambda _: None,
) -> SensorFit:
    """Return the settings of an event camera whose recordings are like those given.

    `repeats`: simulations for the standard errors, at least 2.
    """
    if repeats < 2:
        raise ValueError(f"repeats must be >= 2, got {repeats}")
    progress("measure the recordings")
    real = observe(stimulus)
    notes: list[str] = []
    settings = _first_guess(real, stimulus, notes)
    if (change := find_change(stimulus.still)) is not None:
        notes.append(
            f"the still recording is not still: its rate goes from {change[0]:,.0f} to {change[1]:,.0f} "
            "events/s. What moves or flickers there is taken for noise"
        )

    def approach(begin: dict[str, Any], target: Mapping[str, Any], rounds: int) -> dict[str, Any]:
        for _ in range(rounds):
            twin = simulate(stimulus, begin, real, seed)
            begin = _corrected(begin, target, observe(twin).numbers)
        return begin

    progress(f"simulate, {_ROUNDS} rounds")
    settings = approach(settings, real.numbers, _ROUNDS)
    if jitter := _find_jitter(real, observe(simulate(stimulus, settings, real, seed))):
        progress(f"simulate with thresholds that change, {_ROUNDS} rounds")
        settings = approach(settings | jitter, real.numbers, _ROUNDS)
    twins, refits = [], []
    for number in range(repeats):
        progress(f"simulate for the errors, {number + 1} of {repeats}")
        twin = simulate(stimulus, settings, real, seed + 1 + number)
        twins.append(observe(twin))
        refits.append(approach(settings, twins[-1].numbers, _REFIT_ROUNDS))
    fewer = twin.width * twin.height / (stimulus.width * stimulus.height)
    errors, centred = {}, dict(settings)
    for key in settings:
        again = [refit[key] for refit in refits]
        if isinstance(again[0], float) and np.ptp(again) > 0.0:
            errors[key] = float(np.std(again, ddof=1)) * math.sqrt(fewer + 1.0 / repeats)
            centred[key] = max(2.0 * settings[key] - float(np.mean(again)), 0.0)  # what all share is chance
    if "refractory_s" in errors:
        errors["refractory_s"] = max(errors["refractory_s"], 1e-6)  # stamps are whole microseconds
    share = settings.get("hot_pixels.fraction", 0.0)
    if share:
        errors["hot_pixels.fraction"] = math.sqrt(share * (1.0 - share) / (stimulus.width * stimulus.height))
    _tell_alike(centred, errors, real.numbers, notes)
    for key in ("readout.bandwidth_hz", "readout.row_s"):
        if key in settings and all(key in twin.numbers for twin in twins):
            errors[key] = float(np.std([twin.numbers[key] for twin in twins], ddof=1))
    return SensorFit(settings=centred, errors=errors, real=real, simulated=twins[0], notes=notes)


def _find_jitter(real: Observation, simulated: Observation) -> Numbers:
    """Return the jitter of thresholds that a recording shows beyond a simulation without it, if any."""
    keys = ("threshold_jitter.sigma_on", "threshold_jitter.sigma_off")
    if not all(key in one.numbers for key in keys for one in (real, simulated)):
        return {}
    squares = [(real.numbers[key] ** 2, simulated.numbers[key] ** 2) for key in keys]
    if not any(shown > _JITTER * expected for shown, expected in squares):
        return {}
    return {
        key: math.sqrt(max(shown - expected, 0.0))
        for key, (shown, expected) in zip(keys, squares, strict=True)
    }


def _tell_alike(
    settings: Mapping[str, Any], errors: Numbers, numbers: Mapping[str, Any], notes: list[str]
) -> None:
    """Widen the errors of thresholds where all pixels have the same whole number of events in a step.

    Thresholds within C / (n + 1) have n events then. Where pixels differ by more, their mean tells it better.
    """
    widened = False
    for name, counted in (("on", "ON events a rise"), ("off", "OFF events a fall")):
        key = f"threshold_{name}"
        if counted not in numbers:
            continue
        alike = settings[key] / (numbers[counted] + 1.0)
        if settings.get(f"threshold_spread.sigma_{name}", 0.0) < _ALIKE * alike:
            for unsure in (key, f"threshold_spread.sigma_{name}"):
                errors[unsure] = math.hypot(errors.get(unsure, 0.0), alike / math.sqrt(12.0))
            widened = True
    if widened:
        notes.append(
            "all pixels have the same whole number of events in a step, which tells thresholds less exactly "
            "than steps of a higher contrast would"
        )


def observe(stimulus: Stimulus) -> Observation:
    """Measure recordings, of a real camera or of a simulated one."""
    width, height = stimulus.width, stimulus.height
    still = sort_still(stimulus.still, width, height, stimulus.span_s)
    hot = find_hot(still)
    numbers: dict[str, Any] = dict(measure_still(still))
    period, period_s = np.zeros((2, 0)), 0.0
    if stimulus.steps is not None:
        numbers |= measure_steps(stimulus.steps, width, height, math.log(stimulus.contrast), hot)
        numbers |= measure_readout(stimulus.steps)
        period, period_s = _fold(stimulus.steps, width * height)
    else:
        numbers |= measure_readout(stimulus.still)
    return Observation(numbers=numbers, still=still, hot=hot, period_hz=period, period_s=period_s)


def _fold(steps: EventArrays, pixel_count: int) -> tuple[Floats, float]:
    """Return the rate of a pixel over the time after a rise, and the length of a period [s]."""
    rises, _ = find_steps(steps)
    period_us = float(np.median(np.diff(rises)))
    number = np.searchsorted(rises, steps.t, side="right") - 1
    after = steps.t - rises[np.maximum(number, 0)]
    inside = (number >= 0) & (after < period_us)
    bins = (after[inside] / period_us * 400).astype(np.int64)
    on = steps.polarity[inside] > 0
    counts = [np.bincount(bins[which], minlength=400)[:400] for which in (on, ~on)]
    return np.array(counts) / (pixel_count * len(rises) * 1e-6 * period_us / 400), 1e-6 * period_us


def simulate(stimulus: Stimulus, settings: Mapping[str, Any], real: Observation, seed: int) -> Stimulus:
    """Return what a camera with some settings records in the same light, perhaps with fewer pixels."""
    still_count = max(len(stimulus.still.t), 1)
    rise_count = 0 if stimulus.steps is None else min(len(find_steps(stimulus.steps)[0]), _PERIODS_MAX)
    per_rise = real.numbers.get("ON events a rise", 0.0) + real.numbers.get("OFF events a fall", 0.0)
    step_count = per_rise * rise_count * stimulus.width * stimulus.height
    share = min(1.0, math.sqrt(_SIMULATED_EVENTS / max(still_count, step_count)))
    width, height = (
        max(math.ceil(side * share), min(side, 32)) for side in (stimulus.width, stimulus.height)
    )
    quiet = {key: value for key, value in settings.items() if not key.startswith("readout.")}
    still = _expose(quiet, width, height, np.zeros(2), np.array([0.0, real.still.span_s]), seed)
    steps = None
    if stimulus.steps is not None:
        steps = _expose(settings, width, height, *_square_wave(stimulus, rise_count, real.period_s), seed)
    return Stimulus(
        width=width,
        height=height,
        still=still,
        span_s=real.still.span_s,
        steps=steps,
        contrast=stimulus.contrast,
        rise_s=stimulus.rise_s,
    )


def _square_wave(stimulus: Stimulus, rise_count: int, period_s: float) -> tuple[Floats, Floats]:
    """Return log radiance, shape [n], and its times [s], of as many steps as are simulated."""
    assert stimulus.steps is not None
    starts, falls = find_steps(stimulus.steps)
    bright_s = 1e-6 * float(np.median(falls - starts))
    rise_s = max(stimulus.rise_s, 1e-6)
    if rise_s >= (level_s := min(bright_s, period_s - bright_s)):
        raise ValueError(f"--rise must be shorter than a level of the steps, {level_s:.3g} s, got {rise_s:g}")
    top = math.log(stimulus.contrast)
    log, time_s = [0.0], [0.0]
    for number in range(rise_count + 1):
        begin = 0.5 * period_s + number * period_s
        log += [0.0, top, top, 0.0]
        time_s += [begin, begin + rise_s, begin + bright_s, begin + bright_s + rise_s]
    return np.array([*log, 0.0]), np.array([*time_s, time_s[-1] + 0.5 * (period_s - bright_s)])


def _expose(
    settings: Mapping[str, Any], width: int, height: int, log: Floats, time_s: Floats, seed: int
) -> EventArrays:
    """Return the events of a camera that sees the same light in all pixels."""
    camera = EventCamera(make_pixel(settings), width=width, height=height, sensor="fit", seed=seed)
    stamps = np.rint(1e9 * time_s).astype(np.int64)
    frames = np.broadcast_to(log[:, None, None], (len(log), height, width)).astype(np.float32)
    camera.reset(frames[0], int(stamps[0]))
    return camera.feed(frames[1:], stamps[1:]).numpy()


def _first_guess(real: Observation, stimulus: Stimulus, notes: list[str]) -> dict[str, Any]:
    """Return settings of the terms that the recordings show."""
    numbers, still, hot = real.numbers, real.still, real.hot
    on, off = int(still.on[~hot].sum()), int(still.off[~hot].sum())
    settings: dict[str, Any] = {"threshold_on": _DEFAULT_THRESHOLD, "threshold_off": _DEFAULT_THRESHOLD}
    if "threshold_on" in numbers:
        steps = ("threshold_on", "threshold_off", "threshold_spread.sigma_on", "threshold_spread.sigma_off")
        settings |= {key: numbers[key] for key in steps}
        settings["threshold_spread.minimum"] = max(1e-3, 0.1 * min(numbers[key] for key in steps[:2]))
    else:
        notes.append(
            f"thresholds are not told by still light; {_DEFAULT_THRESHOLD} is a guess. Record steps."
        )
    pixel_count = max(int((~hot).sum()), 1)
    leak = (numbers["leak share"] if off >= 10 else 1.0) * on / (still.span_s * pixel_count)
    if numbers["leak.rate_hz"] > 0.0 and leak * still.span_s * pixel_count > 5.0 * math.sqrt(on + 1.0):
        settings |= {key: numbers[key] for key in ("leak.rate_hz", "leak.spread_decades")}
    else:
        notes.append("no leak is seen beside the shot noise")
    if off >= 10:
        names = ("rate_hz", "on_fraction", "spread_decades")
        settings |= {f"shot_noise.{name}": numbers[f"shot_noise.{name}"] for name in names}
        settings["shot_noise.bright_factor"] = 1.0
    else:
        notes.append(f"no shot noise is seen: {off} OFF events")
    if hot.any():
        names = ("fraction", "rate_hz", "on_fraction")
        settings |= {f"hot_pixels.{name}": numbers[f"hot_pixels.{name}"] for name in names}
    if numbers["refractory_s"] > 0.0:
        settings["refractory_s"] = min(numbers["refractory_s"], 10.0)
    else:
        notes.append("no dead time is seen above what chance hides")
    if "readout.kind" in numbers:
        settings |= {key: value for key, value in numbers.items() if key.startswith("readout.")}
    else:
        notes.append(
            f"the readout is never saturated: it reads more than {numbers['busiest_hz']:.3g} events/s"
        )
    if stimulus.steps is not None and numbers["ON events a rise"] < 1.5:
        notes.append("a step has hardly more than one event a pixel: give light a --rise, or more contrast")
    return settings


def _is_rate(key: str) -> bool:
    return key.endswith("_hz") or key in ("threshold_on", "threshold_off", "refractory_s")


def _corrected(
    settings: Mapping[str, Any], target: Mapping[str, Any], simulated: Mapping[str, Any]
) -> dict[str, Any]:
    """Return settings moved by what differs between a recording and its simulation."""
    moved = dict(settings)
    for key, value in settings.items():
        if key not in target or key not in simulated or key.startswith(("readout", "hot_pixels.fraction")):
            continue
        goal, now = target[key], simulated[key]
        if _is_rate(key):
            if goal > 0.0 and now > 0.0:
                moved[key] = value * min(max((goal / now) ** _GAIN, 0.2), 5.0)
        elif key.startswith(("threshold_spread", "threshold_jitter")):
            moved[key] = math.sqrt(max(value**2 + _GAIN * (goal**2 - now**2), 0.0))
        else:
            moved[key] = min(max(value + _GAIN * (goal - now), 0.0), 1.0)
    return moved


def statistics(one: Observation) -> Numbers:
    """Return what a user compares of a real and a simulated camera."""
    still, calm = one.still, ~one.hot
    rate = (still.on + still.off)[calm] / still.span_s
    fires = rate[rate > 0.0]
    shown = {
        "ON rate of a pixel [Hz]": float(still.on[calm].mean() / still.span_s),
        "OFF rate of a pixel [Hz]": float(still.off[calm].mean() / still.span_s),
        "silent pixels": float((rate == 0.0).mean()),
        "spread of rates [decades]": float(np.log10(fires).std()) if len(fires) else 0.0,
        "hot pixels": float(one.hot.mean()),
    }
    interval_s = still.interval_s[calm[still.interval_pixel]]
    if len(interval_s):
        for share in (0.1, 0.5, 0.9):
            shown[f"{100 * share:.0f} % of intervals below [s]"] = float(np.quantile(interval_s, share))
    names = {"ON events a rise": "", "OFF events a fall": "", "busiest_hz": "busiest 0.2 ms [events/s]"}
    return shown | {names[key] or key: one.numbers[key] for key in names if key in one.numbers}
