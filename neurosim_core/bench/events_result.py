"""What `neurosim bench events` found, and the factors by which one scheme is better than another."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import warp as wp

Scheme = Literal["fixed", "adaptive", "naive"]

COST_PER_S = 200.0
"""q of the distance [1/s]: to shift an event by 5 ms costs as much as to lose it, and events that are further
apart than 10 ms are not the same."""
TIMED_MAX = 1000
"""Renders of a candidate that are timed, evenly spread over the flight."""
BINS_US = np.geomspace(10.0, 1e4, 25)
"""Edges of the histogram of timing errors [us]; what is less than the first is in the first bin."""


@dataclass(frozen=True, kw_only=True)
class Score:
    """How the events of one candidate differ from those of the reference."""

    scheme: Scheme
    setting: float
    """Renders a second [Hz], or the displacement between two renders [px]."""
    render_count: int
    slow_render_count: int
    """Those before the manoeuvre."""
    choice_s: float
    """Time that it took to choose the renders among the ticks of the reference [s]: CPU time of all threads
    on a CPU, wall clock on CUDA; 0 for a fixed rate."""
    render_s: float
    """Time of all its renders [s], measured likewise, on some of them."""
    event_count: int
    missing_count: int
    spurious_count: int
    distance: float
    """Of Victor and Purpura, the sum over all pixels and polarities."""
    median_us: float
    """Median timing error of the events matched, without sign [us]; nan if there is none."""
    high_us: float
    """Nine tenths are below it [us]."""
    worst_us: float
    """The largest [us]; at most the window."""
    histogram: tuple[int, ...]
    """Events matched by timing error."""

    @property
    def run_s(self) -> float:
        """Time of choosing and rendering [s]."""
        return self.choice_s + self.render_s


@dataclass(frozen=True, kw_only=True)
class EventStudy:
    """What `measure_events` found."""

    quick: bool
    scene: str
    scene_file: Path | None
    """None: generated."""
    device: str
    width: int
    height: int
    samples_per_pixel: int
    duration_s: float
    reference_hz: float
    reference_count: int
    """Events of the reference."""
    scores: tuple[Score, ...]

    def of(self, scheme: Scheme) -> list[Score]:
        """Return the scores of a scheme, the one with the fewest renders first."""
        return sorted((s for s in self.scores if s.scheme == scheme), key=lambda s: s.render_count)

    @property
    def clock(self) -> str:
        """What run times are, in words."""
        return "wall-clock time" if wp.get_device(self.device).is_cuda else "CPU time"

    def error(self, score: Score) -> float:
        """Return the distance to the reference for each of its events."""
        return score.distance / self.reference_count


def saving(
    study: EventStudy, error: Callable[[Score], float], cost: Callable[[Score], float]
) -> dict[float, float]:
    """Return how many times as much the best fixed rate costs for the error of adaptive sampling.

    Between two rates the curve is interpolated in logarithms. Candidates that are better than the fastest
    rate or worse than the slowest are left out.

    Args:
        study: What was measured.
        error: What counts as the error of a score.
        cost: What counts as its cost.

    Returns:
        Factor by displacement [px].
    """
    fixed = sorted(study.of("fixed"), key=error)
    errors, costs = np.log([error(s) for s in fixed]), np.log([cost(s) for s in fixed])
    return {
        s.setting: float(np.exp(np.interp(np.log(error(s)), errors, costs)) / cost(s))
        for s in study.of("adaptive")
        if errors[0] <= np.log(error(s)) <= errors[-1]
    }


def timing_gain(study: EventStudy, ours: Scheme, error_us: Callable[[Score], float]) -> dict[float, float]:
    """Return how many times larger the timing error of the naive scheme is for as many renders.

    Our curve is interpolated in logarithms; rates beyond it are left out.

    Args:
        study: What was measured.
        ours: Fixed: at the same rate, thus of the same renders. Adaptive: of as many renders.
        error_us: Which timing error of a score [us]; less than 1 counts as 1, the resolution of stamps.

    Returns:
        Factor by rate of the naive scheme [Hz].
    """
    curve = study.of(ours)
    renders = np.log([s.render_count for s in curve])
    errors = np.log([max(error_us(s), 1.0) for s in curve])
    return {
        s.setting: float(error_us(s) / np.exp(np.interp(np.log(s.render_count), renders, errors)))
        for s in study.of("naive")
        if len(renders) and renders[0] <= np.log(s.render_count) <= renders[-1]
    }


def falls(study: EventStudy, scheme: Scheme) -> bool:
    """Return whether more renders always give a smaller error."""
    return all(a.distance > b.distance for a, b in itertools.pairwise(study.of(scheme)))
