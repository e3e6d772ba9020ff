"""Event pixels in still light, and what theory says they give: noise, a readout loaded with it, presets.

Presets are shown a ramp besides, which tells their thresholds.

Reference: McReynolds, Graca, Delbruck (2022), Experimental methods to predict dynamic vision sensor event
camera performance (noise over light).
"""

from __future__ import annotations

import math
from functools import partial

import numpy as np
from scipy import stats

from neurosim_core.bench.pixel_bench import TestBench, make_pixel, make_preset, per_pixel, rates_hz, still
from neurosim_core.bench.pixel_result import Curve, Floats, PresetRow
from neurosim_core.packets import EventArrays
from neurosim_core.sensors.event_config import EventCameraConfig
from neurosim_core.sensors.event_presets import PRESETS

# ---- darkness --------------------------------------------------------------------------------------------


def measure_dark(bench: TestBench) -> list[Curve]:
    """Return rates of events of still pixels over radiance: shot noise, leak, and first passages."""
    radiance = np.logspace(-3.0, 0.0, bench.pick(10, 4))
    shot = make_preset("v2e_noisy").shot_noise
    assert shot is not None
    leak_hz, decades = 0.1, 0.1
    leak = make_pixel(leak={"rate_hz": leak_hz, "spread_decades": decades})
    spread = math.log(10.0) * decades
    mean_leak_hz = leak_hz * math.exp(spread**2 / 2.0)
    side = bench.pick(64, 24)
    seconds = bench.pick(40, 10)
    pixel_s = side * side * seconds
    curves = []
    found = _dark_rates(bench, make_pixel(shot_noise=shot), radiance, side, seconds)
    for polarity, name, share in ((1, "ON", shot.on_fraction), (0, "OFF", 1.0 - shot.on_fraction)):
        law = partial(_shot_hz, share * shot.rate_hz, shot.bright_factor)
        curves.append(
            Curve(
                name=f"shot noise, {name}",
                x=radiance,
                measured=found[polarity],
                law=law,
                deviation=np.sqrt(law(radiance) / pixel_s),
            )
        )
    found = _dark_rates(bench, leak, radiance, side, seconds)
    # rates differ from pixel to pixel, and so does the phase at which they are cut off
    variance = (leak_hz * math.exp(spread**2 / 2.0)) ** 2 * math.expm1(spread**2)
    variance += (1.0 / 6.0 + 1.0 / 12.0) / seconds**2
    curves.append(
        Curve(
            name="leak, ON",
            x=radiance,
            measured=found[1],
            law=lambda light: np.full_like(light, mean_leak_hz),
            deviation=np.full_like(radiance, math.sqrt(variance) / side),
        )
    )
    return [*curves, _dark_passages(bench, radiance, side, seconds)]


def _shot_hz(dark_hz: float, bright_factor: float, radiance: Floats) -> Floats:
    return dark_hz * (1.0 + (bright_factor - 1.0) * radiance)


def _dark_passages(bench: TestBench, radiance: Floats, side: int, seconds: float) -> Curve:
    """Return the rate of ON events of DVS-Voltmeter's DAVIS346, which leaks more in the light."""
    config = make_preset("voltmeter_dvs346")
    found = _dark_rates(bench, config, radiance, side, seconds)
    return Curve(
        name="DVS-Voltmeter, ON",
        x=radiance,
        measured=found[1],
        law=lambda radiance: np.array([_passage_rates(config, light)[0] for light in radiance]),
        # drift outweighs diffusion: the counts of a pixel differ by one, by the phase at which it begins
        deviation=np.full_like(radiance, 0.5 / (side * seconds)),
    )


def _dark_rates(
    bench: TestBench, config: EventCameraConfig, radiance: Floats, side: int, seconds: float
) -> Floats:
    """Return rates a pixel of OFF and ON events [Hz], shape [2, n]."""
    rates = []
    for number, light in enumerate(radiance):
        log = still(math.log(light), height=side, width=side)
        events = bench.expose(config, log, [0.0, float(seconds)], seed=number)
        on = int(events.polarity.sum())
        rates.append([len(events.t) - on, on])
    return np.asarray(np.array(rates, dtype=float).T / (side * side * seconds))


def measure_survival(bench: TestBench) -> tuple[Curve, float]:
    """Return how intervals of shot noise are distributed, and the distance from the exponential law."""
    rate_hz, side, seconds = 10.0, bench.pick(32, 12), 20.0
    config = make_pixel(shot_noise={"rate_hz": rate_hz, "bright_factor": 1.0, "spread_decades": 0.0})
    events = bench.expose(config, still(0.0, height=side, width=side), [0.0, seconds])
    pixel = events.y.astype(np.int64) * side + events.x
    order = np.argsort(pixel, kind="stable")
    # long intervals do not fit before the end: those that begin shortly before it are left out
    begins = events.t[order][:-1] < 0.9e6 * seconds
    interval_s = 1e-6 * np.diff(events.t[order])[(np.diff(pixel[order]) == 0) & begins]
    interval_s = np.sort(interval_s)
    distance = stats.kstest(interval_s, stats.expon(scale=1.0 / rate_hz).cdf).statistic
    time_s = np.linspace(0.0, 1.0, 41)
    measured = 1.0 - np.searchsorted(interval_s, time_s) / len(interval_s)
    expected = np.exp(-rate_hz * time_s)
    curve = Curve(
        name="shot noise",
        x=time_s,
        measured=measured,
        law=lambda time_s: np.exp(-rate_hz * time_s),
        deviation=np.sqrt(np.maximum(expected * (1.0 - expected), 1e-12) / len(interval_s)),
    )
    return curve, float(distance * math.sqrt(len(interval_s)))


def measure_competition(bench: TestBench) -> Curve:
    """Return the rate of leak events of pixels that shot noise resets.

    Resets come at rate l, the leak needs T = 1 / r from one to its event: an event comes first with
    probability e^(-lT), and it does so at the rate l e^(-lT) / (1 - e^(-lT)).
    """
    leak_hz = 1.0
    noise_hz = np.logspace(-1.0, 1.0, bench.pick(9, 4))
    side, seconds, begin_s = bench.pick(48, 16), 50.0, 10.0  # a pixel begins at a random phase of its leak
    rates = []
    for number, rate_hz in enumerate(noise_hz):
        config = make_pixel(
            leak={"rate_hz": leak_hz, "spread_decades": 0.0},
            shot_noise={"rate_hz": rate_hz, "bright_factor": 1.0, "on_fraction": 0.0, "spread_decades": 0.0},
        )
        events = bench.expose(config, still(0.0, height=side, width=side), [0.0, seconds], seed=number)
        leaked = (events.polarity == 1) & (events.t > 1e6 * begin_s)
        late = EventArrays(*(column[leaked] for column in events))
        rates.append(per_pixel(late, side, side * side) / (seconds - begin_s))
    return Curve(
        name="leak among shot noise",
        x=noise_hz,
        measured=np.array([rate.mean() for rate in rates]),
        law=lambda noise_hz: noise_hz / np.expm1(noise_hz / leak_hz),
        deviation=np.array([max(float(rate.std()), 0.1 / seconds) / side for rate in rates]),
    )


def measure_hot(bench: TestBench) -> Curve:
    """Return the share of pixels that are found hot: those with more than a quarter of the rate."""
    side = bench.pick(256, 64)
    fractions = np.array([3e-4, 1e-3, 3e-3, 1e-2])
    shares = []
    for fraction in fractions:
        config = make_pixel(hot_pixels={"fraction": fraction, "rate_hz": 100.0})
        events = bench.expose(config, still(0.0, height=side, width=side), [0.0, 1.0])
        shares.append(float((per_pixel(events, side, side * side) > 25).mean()))
    deviation = np.sqrt(fractions * (1.0 - fractions)) / side
    return Curve(
        name="hot pixels", x=fractions, measured=np.array(shares), law=lambda f: f, deviation=deviation
    )


# ---- readout ---------------------------------------------------------------------------------------------


def measure_throughput(bench: TestBench) -> list[Curve]:
    """Return the rate out of two readouts over the rate in, when events come at random.

    Both read as many as come, until that is the bandwidth; what then waits in vain is dropped.
    """
    bandwidth_hz, side, seconds = 1e5, 32, 0.5
    loads = np.array([0.1, 0.2, 0.4, 0.6, 0.8, 1.25, 1.6, 2.0, 3.0])[:: bench.pick(1, 2)]
    curves = []
    for kind, name in (("event", "event by event"), ("row", "row by row")):
        rates = []
        for number, load in enumerate(loads):
            shot = _random_light(load * bandwidth_hz / side**2)
            readout = {"kind": kind, "bandwidth_hz": bandwidth_hz, "row_s": 0.0, "queue_length": 1000}
            config = make_pixel(shot_noise=shot, readout=readout)
            log = still(0.0, height=side, width=side)
            events = bench.expose(config, log, [0.0, seconds], seed=number)
            rates.append(np.count_nonzero(events.t < 1e6 * seconds) / seconds)
        # Poisson below the bandwidth; at it, the queue fills first, and the last row may be under way
        deviation = np.where(loads < 1.0, np.sqrt(loads * bandwidth_hz / seconds), 1e-3 * bandwidth_hz)
        curves.append(
            Curve(
                name=name,
                x=loads * bandwidth_hz,
                measured=np.array(rates),
                law=lambda rate_hz: np.minimum(rate_hz, bandwidth_hz),
                deviation=deviation,
            )
        )
    return curves


def _random_light(rate_hz: float) -> dict[str, float]:
    """Return shot noise of the same rate in all pixels [Hz]: events that come at random."""
    return {"rate_hz": rate_hz, "bright_factor": 1.0, "spread_decades": 0.0}


def measure_batch(bench: TestBench) -> Curve:
    """Return how many events are read together with a row, over the rate in.

    Rows are visited in turn and never empty here: with rows that take row_s and bandwidth B, those that come
    at the rate x while all others are visited are n = x row_s / (1 - x / B) on average (gated polling).
    """
    bandwidth_hz, row_s, height, width = 1e6, 1e-4, 16, 64
    loads = np.array([0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7])[:: bench.pick(1, 3)]
    seconds = bench.pick(2, 1)
    sizes, deviations = [], []
    for number, load in enumerate(loads):
        rate_hz = load * bandwidth_hz
        readout = {"kind": "row", "bandwidth_hz": bandwidth_hz, "row_s": row_s, "queue_length": 1 << 20}
        config = make_pixel(shot_noise=_random_light(rate_hz / (height * width)), readout=readout)
        log = still(0.0, height=height, width=width)
        events = bench.expose(config, log, [0.0, float(seconds)], seed=number)
        late = events.t > 0.2e6 * seconds  # it began empty
        latch = events.t[late] * height + events.y[late]
        _, size = np.unique(latch, return_counts=True)
        size = size[:-1]  # the last may be incomplete
        parts = [part.mean() for part in np.array_split(size, 10)]
        sizes.append(size.mean())
        deviations.append(np.std(parts, ddof=1) / math.sqrt(len(parts)))
    return Curve(
        name="events per row",
        x=loads * bandwidth_hz,
        measured=np.array(sizes),
        law=lambda rate_hz: rate_hz * row_s / (1.0 - rate_hz / bandwidth_hz),
        deviation=np.array(deviations),
    )


def measure_wait(bench: TestBench) -> Curve:
    """Return how long events wait for the arbiter when they come at random.

    A queue with Poisson arrivals and constant service: rho / (2 mu (1 - rho)) by Pollaczek and Khinchine.
    The deviation is that of the means of 20 parts of the time.
    """
    bandwidth_hz = 1e4
    loads = np.array([0.1, 0.3, 0.5, 0.7, 0.8])[:: bench.pick(1, 2)]
    seconds, side = float(bench.pick(40, 8)), 16
    waits, deviations = [], []
    for number, load in enumerate(loads):
        shot = _random_light(load * bandwidth_hz / side**2)
        readout = {"kind": "event", "bandwidth_hz": bandwidth_hz, "queue_length": 1 << 18}
        log = still(0.0, height=side, width=side)
        came, read = (
            bench.expose(config, log, [0.0, seconds], seed=number).t
            for config in (make_pixel(shot_noise=shot), make_pixel(shot_noise=shot, readout=readout))
        )
        wait_s = 1e-6 * (read - came[: len(read)])  # first come, first served
        parts = [part.mean() for part in np.array_split(wait_s, 20)]
        waits.append(wait_s.mean())
        deviations.append(np.std(parts, ddof=1) / math.sqrt(len(parts)))
    return Curve(
        name="wait",
        x=loads,
        measured=np.array(waits),
        law=lambda load: load / (2.0 * bandwidth_hz * (1.0 - load)),
        deviation=np.array(deviations),
    )


# ---- presets ---------------------------------------------------------------------------------------------


def measure_presets(bench: TestBench) -> list[PresetRow]:
    """Put the pixels of all presets on the bench: thresholds on a slow ramp, noise in a still scene."""
    names = ("davis346", "v2e_noisy", "voltmeter_dvs346") if bench.quick else tuple(PRESETS)
    return [_measure_preset(bench, name) for name in names]


def _measure_preset(bench: TestBench, name: str) -> PresetRow:
    config = make_preset(name, readout=None)
    nominal = make_preset(name)
    spread = config.threshold_spread
    on, off = (_preset_threshold(bench, config, sign) for sign in (1.0, -1.0))
    on_hz, off_hz = _preset_noise(bench, config)
    expected_on, expected_off = _expected_noise(config)
    stochastic = config.stochastic
    return PresetRow(
        name=name,
        title=PRESETS[name].title,
        threshold_on=on[0],
        threshold_on_expected=1.0 / stochastic.k1 if stochastic else config.threshold_on,
        threshold_off=off[0],
        threshold_off_expected=1.0 / stochastic.k1 if stochastic else config.threshold_off,
        mismatch_on=on[1],
        mismatch_on_expected=spread.sigma_on if spread else 0.0,
        mismatch_off=off[1],
        mismatch_off_expected=spread.sigma_off if spread else 0.0,
        dark_on_hz=on_hz,
        dark_on_expected_hz=expected_on,
        dark_off_hz=off_hz,
        dark_off_expected_hz=expected_off,
        corner_hz=config.low_pass.cutoff_hz if config.low_pass else math.inf,
        refractory_s=config.refractory_s,
        bandwidth_hz=nominal.readout.bandwidth_hz if nominal.readout else math.inf,
    )


def _preset_threshold(bench: TestBench, config: EventCameraConfig, sign: float) -> tuple[float, float]:
    """Return mean and standard deviation of the thresholds of pixels, from the intervals on a ramp.

    The ramp is above white, where the photoreceptor has one time constant, and fast against noise; the
    refractory time is taken off.
    """
    side, slope, seconds = bench.pick(64, 24), 20.0, 1.0
    plain = config.model_copy(update={"shot_noise": None, "leak": None, "hot_pixels": None})
    log = np.zeros((2, side, side))
    log[1 if sign > 0.0 else 0] = slope * seconds
    if config.stochastic is not None:  # its law is linear in ln(light + k2), its white is 255
        seconds, k2 = 0.002, config.stochastic.k2  # fast against its leak
        dim = 0.02
        log[1 if sign > 0.0 else 0] = 0.0
        log[0 if sign > 0.0 else 1] = math.log(dim)
        slope = math.log((255.0 + k2) / (255.0 * dim + k2)) / seconds
    events = bench.expose(plain, log, [0.0, seconds])
    interval_s = 1.0 / rates_hz(events, side, side * side)
    thresholds = slope * (interval_s - config.refractory_s)
    return float(np.nanmean(thresholds)), float(np.nanstd(thresholds))


_PRESET_RADIANCE = 0.1


def _preset_noise(bench: TestBench, config: EventCameraConfig) -> tuple[float, float]:
    """Return the rates of ON and OFF events of a still pixel [Hz]."""
    side, seconds = bench.pick(64, 24), bench.pick(100, 20)
    off_hz, on_hz = _dark_rates(bench, config, np.array([_PRESET_RADIANCE]), side, seconds)
    return float(on_hz[0]), float(off_hz[0])


def _expected_noise(config: EventCameraConfig) -> tuple[float, float]:
    """Return the rates of ON and OFF events of a still pixel by theory [Hz].

    Leak alone has the mean of log-normal rates. Shot noise comes at l / (1 + l t_ref), and leaves the leak no
    time if it comes far more often.
    """
    if config.stochastic is not None:
        return _passage_rates(config, _PRESET_RADIANCE)
    leak_hz = 0.0
    if config.leak is not None:
        spread = math.log(10.0) * config.leak.spread_decades
        leak_hz = config.leak.rate_hz * math.exp(spread**2 / 2.0)
    if (shot := config.shot_noise) is None:
        return leak_hz, 0.0
    rate_hz = shot.rate_hz * (1.0 + (shot.bright_factor - 1.0) * _PRESET_RADIANCE)
    leak_hz = rate_hz / math.expm1(rate_hz / leak_hz) if leak_hz else 0.0
    rate_hz /= 1.0 + rate_hz * config.refractory_s
    return leak_hz + rate_hz * shot.on_fraction, rate_hz * (1.0 - shot.on_fraction)


def _passage_rates(config: EventCameraConfig, radiance: float) -> tuple[float, float]:
    """Return the rates of ON and OFF events of a Brownian motion with drift [Hz].

    Between -1 and 1, with drift m and variance v, it leaves after tanh(m / v) / m on average, and upwards
    with probability 1 / (1 + exp(-2 m / v)) (Karatzas and Shreve, 1991, section 3.5).
    """
    law = config.stochastic
    assert law is not None
    light = 255.0 * radiance / config.white_radiance
    drift_hz = 1e6 * (law.k4 + law.k5 * light)
    variance_hz = 1e6 * (law.k3 * math.sqrt(light) / (light + law.k2) + law.k6) ** 2
    rate_hz = drift_hz / math.tanh(drift_hz / variance_hz)
    off_hz = rate_hz / (1.0 + math.exp(min(2.0 * drift_hz / variance_hz, 700.0)))
    return rate_hz - off_hz, off_hz
