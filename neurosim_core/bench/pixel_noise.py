"""Event pixels in still light, and what theory says they give: noise, a readout loaded with it, presets."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
from scipy import stats

from neurosim_core.bench.engine import PRESETS, EventArrays, EventCameraConfig
from neurosim_core.bench.pixel_bench import (
    Curve,
    Floats,
    TestBench,
    events_per_pixel,
    make_pixel,
    make_preset,
    rates_hz,
    still,
)
from neurosim_core.bench.report import Row

_PRESET_RADIANCE = 0.1
_RATE = "darkness: rate [Hz] over radiance"


def darkness(bench: TestBench) -> list[Curve]:
    """Return rates of events of still pixels over radiance: shot noise and leak."""
    radiance = np.logspace(-3.0, 0.0, bench.pick(10, 4))
    shot = make_preset("v2e_noisy").shot_noise
    assert shot is not None
    side, seconds = bench.pick(64, 24), bench.pick(40, 10)
    found = _still_rates(bench, make_pixel(shot_noise=shot), radiance, side, seconds)
    curves = []
    for polarity, name, share in ((1, "ON", shot.on_fraction), (0, "OFF", 1.0 - shot.on_fraction)):
        law = share * shot.rate_hz * (1.0 + (shot.bright_factor - 1.0) * radiance)
        deviation = np.sqrt(law / (side * side * seconds))
        curves.append(Curve(_RATE, f"shot noise, {name}", radiance, found[polarity], law, deviation))
    leak_hz, decades = 0.1, 0.1
    spread = math.log(10.0) * decades
    mean_hz = leak_hz * math.exp(spread**2 / 2.0)
    leaky = make_pixel(leak={"rate_hz": leak_hz, "spread_decades": decades})
    found = _still_rates(bench, leaky, radiance, side, seconds)
    # rates differ from pixel to pixel, and so does the phase at which they are cut off
    variance = mean_hz**2 * math.expm1(spread**2) + (1.0 / 6.0 + 1.0 / 12.0) / seconds**2
    deviation = np.full_like(radiance, math.sqrt(variance) / side)
    curves.append(Curve(_RATE, "leak, ON", radiance, found[1], np.full_like(radiance, mean_hz), deviation))
    return curves


def _still_rates(
    bench: TestBench, config: EventCameraConfig, radiance: Floats, side: int, seconds: float
) -> Floats:
    """Return rates a pixel of OFF and ON events [Hz], shape [2, n]."""
    rates = []
    for number, light in enumerate(radiance):
        events = bench.expose(config, still(math.log(light), side), [0.0, float(seconds)], seed=number)
        on = int(events.polarity.sum())
        rates.append([len(events.t) - on, on])
    return np.asarray(np.array(rates, dtype=float).T / (side * side * seconds))


def survival(bench: TestBench) -> list[Curve]:
    """Return how intervals of shot noise are distributed, against the exponential law."""
    rate_hz, side, seconds = 10.0, bench.pick(32, 12), 20.0
    config = make_pixel(shot_noise={"rate_hz": rate_hz, "bright_factor": 1.0, "spread_decades": 0.0})
    events = bench.expose(config, still(0.0, side), [0.0, seconds])
    pixel = events.y.astype(np.int64) * side + events.x
    order = np.argsort(pixel, kind="stable")
    # long intervals do not fit before the end: those that begin shortly before it are left out
    begins = events.t[order][:-1] < 0.9e6 * seconds
    interval_s = np.sort(1e-6 * np.diff(events.t[order])[(np.diff(pixel[order]) == 0) & begins])
    worst = stats.kstest(interval_s, stats.expon(scale=1.0 / rate_hz).cdf)
    time_s = np.sort(np.append(np.linspace(0.0, 1.0, 41), worst.statistic_location))
    measured = 1.0 - np.searchsorted(interval_s, time_s) / len(interval_s)
    deviation = np.full_like(time_s, 1.0 / math.sqrt(len(interval_s)))  # Kolmogorov: D sqrt(n)
    title = "darkness: share of longer intervals over time [s]"
    return [Curve(title, "shot noise", time_s, measured, np.exp(-rate_hz * time_s), deviation)]


def hot_pixels(bench: TestBench) -> list[Curve]:
    """Return the share of pixels that are found hot: those with more than a quarter of the rate."""
    side, fractions = bench.pick(256, 64), np.array([3e-4, 1e-3, 3e-3, 1e-2])
    shares = []
    for fraction in fractions:
        config = make_pixel(hot_pixels={"fraction": fraction, "rate_hz": 100.0})
        events = bench.expose(config, still(0.0, side), [0.0, 1.0])
        shares.append(float((events_per_pixel(events, side, side * side) > 25).mean()))
    deviation = np.sqrt(fractions * (1.0 - fractions)) / side
    title = "darkness: share of hot pixels over share set"
    return [Curve(title, "hot pixels", fractions, np.array(shares), fractions, deviation)]


def readout(bench: TestBench) -> list[Curve]:
    """Return the rate out of two readouts over the rate in, when events come at random.

    Both read as many as come, until that is the bandwidth; what then waits in vain is dropped.
    """
    bandwidth_hz, side, seconds = 1e5, 32, 0.5
    loads = np.array([0.1, 0.2, 0.4, 0.6, 0.8, 1.25, 1.6, 2.0, 3.0])[:: bench.pick(1, 2)]
    curves = []
    for kind, name in (("event", "event by event"), ("row", "row by row")):
        rates = []
        for number, load in enumerate(loads):
            setting = {"kind": kind, "bandwidth_hz": bandwidth_hz, "row_s": 0.0, "queue_length": 1000}
            config = make_pixel(shot_noise=_random_light(load * bandwidth_hz / side**2), readout=setting)
            events = bench.expose(config, still(0.0, side), [0.0, seconds], seed=number)
            rates.append(np.count_nonzero(events.t < 1e6 * seconds) / seconds)
        # Poisson below the bandwidth; at it, the queue fills first, and the last row may be under way
        deviation = np.where(loads < 1.0, np.sqrt(loads * bandwidth_hz / seconds), 1e-3 * bandwidth_hz)
        law = np.minimum(loads, 1.0) * bandwidth_hz
        title = "readout: rate out [Hz] over rate in [Hz]"
        curves.append(Curve(title, name, loads * bandwidth_hz, np.array(rates), law, deviation))
    return curves


def _random_light(rate_hz: float) -> dict[str, float]:
    """Return shot noise of the same rate in all pixels [Hz]: events that come at random."""
    return {"rate_hz": rate_hz, "bright_factor": 1.0, "spread_decades": 0.0}


def wait(bench: TestBench) -> list[Curve]:
    """Return how long events wait for the arbiter when they come at random.

    A queue with Poisson arrivals and constant service: rho / (2 mu (1 - rho)) by Pollaczek and Khinchine.
    """
    bandwidth_hz, loads = 1e4, np.array([0.1, 0.3, 0.5, 0.7, 0.8])[:: bench.pick(1, 2)]
    seconds, side = float(bench.pick(40, 8)), 16
    waits, deviations = [], []
    for number, load in enumerate(loads):
        shot = _random_light(load * bandwidth_hz / side**2)
        setting = {"kind": "event", "bandwidth_hz": bandwidth_hz, "queue_length": 1 << 18}
        came, read = (
            bench.expose(config, still(0.0, side), [0.0, seconds], seed=number).t
            for config in (make_pixel(shot_noise=shot), make_pixel(shot_noise=shot, readout=setting))
        )
        wait_s = 1e-6 * (read - came[: len(read)])  # first come, first served
        means = [part.mean() for part in np.array_split(wait_s, 20)]
        waits.append(wait_s.mean())
        deviations.append(np.std(means, ddof=1) / math.sqrt(len(means)))
    law = loads / (2.0 * bandwidth_hz * (1.0 - loads))
    return [Curve("readout: wait [s] over load", "wait", loads, np.array(waits), law, np.array(deviations))]


PATTERNS: Sequence[Callable[[TestBench], list[Curve]]] = (
    darkness, survival, hot_pixels, readout, wait,
)  # fmt: skip


# Presets


def measure_presets(bench: TestBench) -> list[Row]:
    """Return a row for each preset: thresholds on a ramp, noise in a still scene."""
    names = ("davis346", "v2e_noisy", "voltmeter_dvs346") if bench.quick else tuple(PRESETS)
    side, seconds = bench.pick(64, 24), bench.pick(100, 20)
    rows = []
    for name in names:
        config, nominal = make_preset(name, readout=None), make_preset(name)
        spread, stochastic = config.threshold_spread, config.stochastic
        row: Row = {"preset": name}
        for key, sign, threshold, sigma in (
            ("on", 1.0, config.threshold_on, spread.sigma_on if spread else 0.0),
            ("off", -1.0, config.threshold_off, spread.sigma_off if spread else 0.0),
        ):
            mean, mismatch = _preset_threshold(bench, config, sign)
            row |= {f"C {key}": mean, f"C {key}, set": 1.0 / stochastic.k1 if stochastic else threshold}
            row |= {f"mismatch {key}": mismatch, f"mismatch {key}, set": sigma}
        off_hz, on_hz = _still_rates(bench, config, np.array([_PRESET_RADIANCE]), side, seconds)[:, 0]
        for key, measured, expected in zip(
            ("ON", "OFF"), (on_hz, off_hz), _expected_noise(config), strict=True
        ):
            row |= {f"{key} noise [Hz]": float(measured), f"{key} noise, theory [Hz]": expected}
        row["3 dB at white [Hz]"] = config.low_pass.cutoff_hz if config.low_pass else math.inf
        row["refractory [s]"] = config.refractory_s
        row["readout [Hz]"] = nominal.readout.bandwidth_hz if nominal.readout else math.inf
        rows.append(row)
    return rows


def _preset_threshold(bench: TestBench, config: EventCameraConfig, sign: float) -> tuple[float, float]:
    """Return mean and standard deviation of the thresholds of pixels, from the intervals on a ramp.

    The ramp is above white, where the photoreceptor has one time constant, and fast against noise; the
    refractory time is taken off.
    """
    side, slope, seconds = bench.pick(64, 24), 20.0, 1.0
    plain = config.model_copy(
        update={"shot_noise": None, "measured_noise": None, "leak": None, "hot_pixels": None}
    )
    first, last = (0, 1) if sign > 0.0 else (1, 0)
    log = still(0.0, side)
    log[last] = slope * seconds
    if config.stochastic is not None:  # its law is linear in ln(light + k2), its white is 255
        seconds, k2, dim = 0.002, config.stochastic.k2, 0.02  # fast against its leak
        log[last], log[first] = 0.0, math.log(dim)
        slope = math.log((255.0 + k2) / (255.0 * dim + k2)) / seconds
    interval_s = 1.0 / rates_hz(bench.expose(plain, log, [0.0, seconds]), side, side * side)
    thresholds = slope * (interval_s - config.refractory_s)
    return float(np.nanmean(thresholds)), float(np.nanstd(thresholds))


def _expected_noise(config: EventCameraConfig) -> tuple[float, float]:
    """Return the rates of ON and OFF events of a still pixel by theory [Hz], mean over log-normal pixels.

    After each event the leak begins anew: it fires if noise of rate l does not come within its time d, which
    is with probability exp(-l d), and an event is after t_ref + (1 - exp(-l d)) / l on average.
    """
    if config.stochastic is not None:
        return _passage_rates(config, _PRESET_RADIANCE)
    node, weight = np.polynomial.hermite_e.hermegauss(21)
    weight = np.outer(weight, weight) / weight.sum() ** 2  # of noise, of leak
    on_hz, off_hz = _noise_rates(config, _PRESET_RADIANCE, node[:, None])
    leak, hot = config.leak, config.hot_pixels
    leak_hz = np.zeros((1, len(node)))
    if leak is not None:
        growth = 1.0 + (leak.bright_factor - 1.0) * _PRESET_RADIANCE
        leak_hz = leak.rate_hz * growth * 10.0 ** (leak.spread_decades * node[None])
    total = np.zeros(2)
    for share, more_hz in ((1.0 - hot.fraction, 0.0), (hot.fraction, hot.rate_hz)) if hot else ((1.0, 0.0),):
        noise_hz = np.maximum(on_hz + off_hz + more_hz, 1e-12)
        with np.errstate(divide="ignore"):
            leaks = np.exp(-noise_hz / leak_hz)
        every_s = config.refractory_s + (1.0 - leaks) / noise_hz
        on_share = (on_hz + more_hz * (hot.on_fraction if hot else 0.0)) / noise_hz
        by_noise = weight * (1.0 - leaks) / every_s
        on = by_noise * on_share + weight * leaks / every_s
        off = by_noise * (off_hz + more_hz * (1.0 - hot.on_fraction if hot else 0.0)) / noise_hz
        total += share * np.array([on.sum(), off.sum()])
    return float(total[0]), float(total[1])


def _noise_rates(config: EventCameraConfig, radiance: float, rank: Floats) -> tuple[Floats, Floats]:
    """Return rates of ON and OFF shot noise [Hz] at a radiance, of pixels by rank (standard normal)."""
    if (shot := config.shot_noise) is not None:
        median_hz = shot.rate_hz * (1.0 + (shot.bright_factor - 1.0) * radiance)
        rate_hz = median_hz * 10.0 ** (shot.spread_decades * rank)
        more = [1.0, 1.0]
        if shot.by_threshold and (mismatch := config.threshold_spread) is not None:
            normal = np.linspace(-6.0, 6.0, 6001)
            nominal = (
                (config.threshold_on, mismatch.sigma_on),
                (config.threshold_off, mismatch.sigma_off),
            )
            drawn = [np.maximum(mean + sigma * normal, mismatch.minimum) / mean for mean, sigma in nominal]
            more = [float(np.average(1.0 / one, weights=np.exp(-0.5 * normal**2))) for one in drawn]
        return rate_hz * shot.on_fraction * more[0], rate_hz * (1.0 - shot.on_fraction) * more[1]
    if (measured := config.measured_noise) is None:
        return np.zeros_like(rank), np.zeros_like(rank)
    place = math.log(radiance * measured.white_lux)
    light = [math.log(level.lux) for level in measured.levels]
    share = np.array([np.interp(place, light, one) for one in np.eye(len(light))])  # of each level
    spread = [10.0 ** (level.spread_decades * rank) for level in measured.levels]
    factor = share[:, None, None] * np.array(spread)
    medians = np.array([(level.on_hz, level.off_hz) for level in measured.levels])
    return (factor * medians[:, :1, None]).sum(axis=0), (factor * medians[:, 1:, None]).sum(axis=0)


def measure_noise_figures(bench: TestBench) -> list[Row]:
    """Return a row for each figure that the source of a preset has of noise, beside what the preset does."""
    names = ("davis346", "gen3") if bench.quick else tuple(name for name in PRESETS if PRESETS[name].noise)
    side, seconds = bench.pick(96, 48), bench.pick(60, 20)
    rows: list[Row] = []
    for name in names:
        found: dict[float, dict[str, float]] = {}
        config = make_preset(name, readout=None)
        white_lux = config.measured_noise.white_lux if config.measured_noise else 1000.0
        for figure in PRESETS[name].noise:
            if figure.lux not in found:
                log = still(math.log(config.white_radiance * figure.lux / white_lux), side)
                events = bench.expose(config, log, [0.0, float(seconds)])
                found[figure.lux] = _noise_statistics(events, side, seconds)
            value = found[figure.lux][figure.quantity]
            row: Row = {"preset": name, "light [lux]": figure.lux, "quantity": figure.quantity}
            row |= {"preset's": value, "source's": figure.value, "its spread": figure.spread}
            rows.append({**row, "within": abs(value - figure.value) <= figure.spread})
    return rows


def _noise_statistics(events: EventArrays, side: int, seconds: float) -> dict[str, float]:
    count = events_per_pixel(events, side, side * side)
    on = int(events.polarity.sum())
    fires = count[count > 0]
    rates = {"ON rate": on, "OFF rate": len(events.t) - on, "rate": len(events.t)}
    spread = math.log1p(max(float(count.var() - count.mean()), 0.0) / max(float(count.mean()), 1e-9) ** 2)
    return {
        **{name: number / (side * side * seconds) for name, number in rates.items()},
        "ON share": on / max(len(events.t), 1),
        "spread": math.sqrt(spread) / math.log(10.0) if len(fires) else 0.0,
    }


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
