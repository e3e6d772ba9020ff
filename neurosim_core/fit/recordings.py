"""Statistics of the pixels of an event camera, from recordings in still and in stepping light.

Every function takes events and returns raw numbers, some of them biased: `sensor` simulates cameras, measures
them here as well, and so finds the settings that give the numbers of the recording.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import optimize, special

from neurosim_core.packets import EventArrays

Floats = NDArray[np.float64]
Counts = NDArray[np.int64]

_HOT_CHANCE = 1e-3
"""A pixel is hot that fires more often than any would with this probability, by the spread of all,"""
_HOT_FACTOR = 8.0
"""and so many times more often than the median."""
_EARLY = 0.2
"""Share of the mean time to an ON event in which a pixel has not leaked a threshold."""
_SHORTEST = 5
"""Which of the shortest intervals tells the refractory time: some glitches are survived."""
_BIN_US = 1000
"""Time over which the turns of light are looked for."""
_PAUSE, _BURST = 20, 0.1
"""What comes so many bins before a turn with so small a share of its events is no part of it: pixels fire
when a camera is switched on."""
_TRIM = 0.02
"""Share of the pixels at either end whose thresholds are not counted: noise has made them.

As many of the busiest pixels of still light are left out: hot ones among them would outweigh all others."""
_WINDOW_US = 200
"""Time over which a saturated readout is counted."""
_RUN_MIN = 5
"""Windows in a row that a readout must be busy."""
_PARTS = 20
"""Of a still recording, whose rates are compared."""
_UNSTEADY = 1.5
"""Factor between the busiest and the quietest part of a recording that is not still."""
_ROWS = 10
"""Rows whose readout is timed together: stamps are whole microseconds."""


@dataclass(frozen=True, eq=False)
class Still:
    """Events of a scene in which nothing moves, by pixel."""

    span_s: float
    """Length of the recording [s]."""
    on: Counts
    """ON events of each pixel, shape [pixel]."""
    off: Counts
    """OFF events of each pixel, shape [pixel]."""
    interval_s: Floats
    """Times between two events of a pixel [s], shape [n]."""
    interval_pixel: Counts
    """Of which pixel, shape [n]."""
    interval_on: NDArray[np.bool_]
    """Whether the second of the events is ON, shape [n]."""


def sort_still(events: EventArrays, width: int, height: int, span_s: float | None = None) -> Still:
    """Return a still recording by pixel; without a span it is from the first to the last event."""
    if span_s is None:
        span_s = 1e-6 * float(events.t[-1] - events.t[0]) if len(events.t) else 0.0
    if span_s <= 0.0:
        raise ValueError(f"a still recording needs two events at different times, got {len(events.t)} events")
    pixel = events.y.astype(np.int64) * width + events.x
    order = np.argsort(pixel, kind="stable")
    same = np.diff(pixel[order]) == 0
    on = events.polarity > 0
    return Still(
        span_s,
        np.bincount(pixel[on], minlength=width * height),
        np.bincount(pixel[~on], minlength=width * height),
        1e-6 * np.diff(events.t[order])[same],
        pixel[order][1:][same],
        on[order][1:][same],
    )


def find_change(events: EventArrays) -> tuple[float, float] | None:
    """Return the lowest and the highest event rate of a recording [Hz], if it is not one of still light."""
    span_us = int(events.t[-1] - events.t[0]) + 1 if len(events.t) else 0
    if span_us < _PARTS:
        return None
    count = np.bincount((events.t - events.t[0]) * _PARTS // span_us, minlength=_PARTS)
    low, high = np.sort(count)[[1, -2]]  # one part may have been disturbed
    by_chance = high - low < 8.0 * math.sqrt(count.mean())
    rate_hz = _PARTS / (1e-6 * span_us)
    return None if by_chance or high < _UNSTEADY * low else (low * rate_hz, high * rate_hz)


def find_hot(still: Still) -> NDArray[np.bool_]:
    """Return which pixels fire far more often than the others."""
    count = (still.on + still.off).astype(float)
    middle, high = np.quantile(count, [0.5, 0.84])
    sigma = max(math.log((high + 1.0) / (middle + 1.0)), 0.1)
    sigmas = -float(special.ndtri(_HOT_CHANCE / len(count)))
    limit = (middle + 1.0) * max(math.exp(sigmas * sigma), _HOT_FACTOR)
    return np.asarray(count > limit + 10.0)


def measure_still(still: Still) -> dict[str, float]:
    """Return rates and spreads of leak, shot noise and hot pixels, and the refractory time.

    Leak needs time to reach a threshold after an event, shot noise does not: soon after events the share of
    ON is that of shot noise. What is ON beyond it is leak. Spreads are from the variance of the counts of
    pixels beyond that of a Poisson process.
    """
    hot = find_hot(still)
    count = (still.on + still.off).astype(float)
    found = {"hot_pixels.fraction": float(hot.mean())}
    refractory_s = measure_refractory(still, count / still.span_s)
    found["refractory_s"] = refractory_s
    at_risk_s = np.maximum(still.span_s - count * refractory_s, 1e-9)
    if hot.any():
        found["hot_pixels.rate_hz"] = float(np.median(count[hot] / at_risk_s[hot]))
        found["hot_pixels.on_fraction"] = float(still.on[hot].sum() / count[hot].sum())
    busy = hot | (count > np.quantile(count[~hot], 1.0 - _TRIM))
    on, off, risk_s = still.on[~busy].astype(float), still.off[~busy].astype(float), at_risk_s[~busy]
    found["shot_noise.on_fraction"] = share = _early_on_share(still, busy, on.sum() / risk_s.sum())
    off_hz, off_spread = _log_normal(off, risk_s)
    found["shot_noise.rate_hz"] = off_hz / max(1.0 - share, 1e-6)
    found["shot_noise.spread_decades"] = off_spread
    found["leak.rate_hz"], found["leak.spread_decades"] = _measure_leak(still, busy)
    shot_on = share / max(1.0 - share, 1e-6) * off.sum()
    found["leak share"] = max(1.0 - shot_on / max(on.sum(), 1.0), 0.0)
    return found


def measure_refractory(still: Still, rate_hz: Floats) -> float:
    """Return the dead time after an event [s]: the shortest intervals, less what chance leaves above it.

    Leak alone is never fast: its shortest intervals are as long as the others of their pixels, or far apart.
    """
    if len(still.interval_s) < 10 * _SHORTEST:
        return 0.0
    few = np.argpartition(still.interval_s, 10 * _SHORTEST - 1)[: 10 * _SHORTEST]
    few = few[np.argsort(still.interval_s[few])]
    shortest, later = still.interval_s[few[[_SHORTEST, -1]]].tolist()
    chance = (_SHORTEST + 1) / float(rate_hz[still.interval_pixel].sum())
    share = float(np.median(still.interval_s[few] * rate_hz[still.interval_pixel[few]]))  # of the mean
    dense = share < 0.7 and later - shortest < max(30.0 * chance, 3e-6)  # 7.5, without what varies
    fast = dense or shortest < 0.1 * float(np.median(still.interval_s))
    return shortest - chance if fast and shortest > max(3.0 * chance, 3e-6) else 0.0


def _measure_leak(still: Still, busy: NDArray[np.bool_]) -> tuple[float, float]:
    """Return median [Hz] and spread [decades] of what limits the time between events: the longest of a pixel.

    A pixel that leaks is never silent for longer than it takes to leak a threshold.
    """
    longest_s = np.zeros(len(still.on))
    np.maximum.at(longest_s, still.interval_pixel, still.interval_s)
    number = np.bincount(still.interval_pixel, minlength=len(still.on))
    longest_s = longest_s[(number >= 2) & ~busy]
    if len(longest_s) < 10:
        return 0.0, 0.0
    low, middle, high = np.quantile(np.log10(longest_s), [0.16, 0.5, 0.84])
    return float(10.0**-middle), float(0.5 * (high - low))


def _early_on_share(still: Still, busy: NDArray[np.bool_], on_hz: float) -> float:
    """Return the share of ON among the events that follow soon after another."""
    early = (still.interval_s < _EARLY / max(on_hz, 1e-9)) & ~busy[still.interval_pixel]
    return float((still.interval_on[early].sum() + 0.5) / (early.sum() + 1.0))


def _log_normal(count: Floats, risk_s: Floats) -> tuple[float, float]:
    """Return median [Hz] and spread [decades] of log-normal rates, from counts of Poisson processes."""
    mean = float(count.mean())
    if mean == 0.0:
        return 0.0, 0.0
    variance = math.log1p(max(float(count.var()) - mean, 0.0) / mean**2)
    return mean / float(risk_s.mean()) * math.exp(-0.5 * variance), math.sqrt(variance) / math.log(10.0)


def find_steps(events: EventArrays) -> tuple[Counts, Counts]:
    """Return when light begins to rise and to fall [us], in turns: a rise first, and each with its fall.

    The last fall is left out with its rise: a readout that is late may not have read it.
    """
    begin_us = int(events.t[0]) if len(events.t) else 0
    bins = (events.t - begin_us) // _BIN_US
    size = int(bins[-1]) + 1 if len(bins) else 1
    signed = np.bincount(bins, np.where(events.polarity > 0, 1.0, -1.0), minlength=size)
    chance = 8.0 * math.sqrt(float(np.median(np.bincount(bins, minlength=size))) + 4.0)
    level = max(0.2 * float(np.quantile(np.abs(signed), 1.0 - 1e-2)), chance)
    sign = np.where(np.abs(signed) > level, np.sign(signed), 0.0)
    busy = np.flatnonzero(sign)
    alike = np.split(busy, np.flatnonzero(np.diff(sign[busy])) + 1)
    turns = np.array([_begin_of(bins_alike, np.abs(signed)) for bins_alike in alike if len(bins_alike)])
    if len(turns) and sign[turns[0]] < 0:
        turns = turns[1:]
    turns = turns[: len(turns) // 2 * 2]
    if len(turns) < 8:
        raise ValueError(
            f"found {len(turns) // 2} rises of light with a fall after each, need 4 or more: the "
            "recording of steps must show light that is switched between two levels, in all pixels, each for "
            "longer than the readout takes to send the events of a step"
        )
    turns = turns[:-2]
    times = begin_us + turns * _BIN_US - _BIN_US
    return times[::2], times[1::2]


def _begin_of(bins: Counts, weight: Floats) -> int:
    """Return the first of the bins of a turn, without a burst long before it."""
    parts = np.split(bins, np.flatnonzero(np.diff(bins) > _PAUSE) + 1)
    seen = np.cumsum([weight[part].sum() for part in parts])
    return int(parts[int(np.argmax(seen > _BURST * seen[-1]))][0])


def measure_steps(
    events: EventArrays, width: int, height: int, height_log: float, hot: NDArray[np.bool_] | None = None
) -> dict[str, float]:
    """Return thresholds, their spread and jitter, from how many events a step of log radiance has.

    Where the levels lie is random, so a pixel with thresholds C_on and C_off, a ON events in a rise and b OFF
    events in a fall has a C_on = b C_off = height - (C_on + C_off) / 2. Thresholds that are drawn anew for
    each event make the events of a step a renewal process: their number varies by height sigma^2 / C^3.
    """
    rises, falls = find_steps(events)
    pixel = events.y.astype(np.int64) * width + events.x
    half_us = min(int(np.diff(rises).min()), 2 * int((falls - rises).min())) // 2
    counts, changes = [], []
    for polarity, starts in ((1, rises), (0, falls)):
        mine = events.polarity == polarity
        t, where = events.t[mine], pixel[mine]
        total, squares = np.zeros(width * height), np.zeros(width * height)
        for start in starts:
            inside = slice(np.searchsorted(t, start), np.searchsorted(t, start + half_us))
            count = np.bincount(where[inside], minlength=width * height)
            total += count
            squares += count**2
        counts.append(total / len(starts))
        changes.append((squares - total**2 / len(starts)) / (len(starts) - 1))
    on, off = counts
    use = (on > 0.5) & (off > 0.5)
    if hot is not None:
        use &= ~hot
    if use.sum() < 10:
        raise ValueError(
            "fewer than 10 pixels fire in each step; take a higher --contrast, at least 4 thresholds high"
        )
    on, off = on[use], off[use]
    threshold_on = height_log / (on + 0.5 + 0.5 * on / off)
    threshold_off = threshold_on * on / off
    found: dict[str, float] = {}
    for name, values, change in (("on", threshold_on, changes[0]), ("off", threshold_off, changes[1])):
        low, high = np.quantile(values, [_TRIM, 1.0 - _TRIM])
        middle = values[(values >= low) & (values <= high)]
        found |= {f"threshold_{name}": float(middle.mean())}
        found |= {f"threshold_spread.sigma_{name}": float(middle.std())}
        change = change[use]
        usual = change[change <= np.quantile(change, 1.0 - _TRIM)].mean()
        jitter = math.sqrt(float(np.median(values) ** 3 / height_log * usual))
        found |= {f"threshold_jitter.sigma_{name}": jitter}
    return found | {
        "ON events a rise": float(on.mean()),
        "OFF events a fall": float(off.mean()),
    }


def measure_readout(events: EventArrays) -> dict[str, float | str]:
    """Return kind and speed of the readout where it is saturated, and the busiest rate [Hz].

    Read event by event, a saturated bus is as regular as events are random: windows in a row have the same
    number. By rows, each takes row_s + n / bandwidth until the next, whatever is in it.
    """
    if len(events.t) == 0:
        return {"busiest_hz": 0.0}
    t = events.t - events.t[0]
    count = np.bincount(t // _WINDOW_US)
    found: dict[str, float | str] = {"busiest_hz": float(count.max() / (1e-6 * _WINDOW_US))}
    first, length = _longest_run(count > 0.9 * count.max())
    run = count[first + 1 : first + length - 1]  # whole windows
    if len(run) >= _RUN_MIN and run.std() < 0.5 * math.sqrt(run.mean()):
        return found | {
            "readout.kind": "event",
            "readout.bandwidth_hz": float(run.mean() / (1e-6 * _WINDOW_US)),
        }
    return found | _measure_rows(t, events.y)


def _measure_rows(t: Counts, row: NDArray[np.uint16]) -> dict[str, float | str]:
    """Return what a readout by rows takes, from blocks of rows that are read one after the other."""
    begins = np.flatnonzero((np.diff(t, prepend=-1) != 0) | (np.diff(row.astype(np.int64), prepend=-1) != 0))
    edges = begins[: (len(begins) - 1) // _ROWS * _ROWS + 1 : _ROWS]
    span_us, number = np.diff(t[edges]).astype(float), np.diff(edges).astype(float)
    busy = number > 0.3 * number.max(initial=0.0)
    if busy.sum() < _RUN_MIN or number[busy].mean() < 1.3 * _ROWS:
        return {}
    load = np.stack([np.full(len(number), float(_ROWS)), number], axis=1)
    for _ in range(8):  # what takes longer has waited for events
        (row_us, event_us), _ = optimize.nnls(load[busy], span_us[busy])
        expected_us = load @ np.array([row_us, event_us])
        wrong = np.abs(span_us - expected_us) / np.maximum(expected_us, 1.0)
        busy &= wrong <= max(2.0 * float(np.median(wrong[busy])), 0.02)
    if busy.sum() < _RUN_MIN or event_us == 0.0 or np.median(wrong[busy]) > 0.05:
        return {}
    return {
        "readout.kind": "row",
        "readout.row_s": float(1e-6 * row_us),
        "readout.bandwidth_hz": float(1e6 / event_us),
    }


def _longest_run(mask: NDArray[np.bool_]) -> tuple[int, int]:
    """Return begin and length of the longest run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    if len(edges) == 0:
        return 0, 0
    lengths = edges[1::2] - edges[::2]
    longest = int(np.argmax(lengths))
    return int(edges[2 * longest]), int(lengths[longest])
