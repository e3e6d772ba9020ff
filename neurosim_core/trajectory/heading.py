"""Looking where one flies: a smooth heading whose rate is bounded by construction.

The direction of travel, seen a little ahead, is unwrapped and replaced by the nearest function whose slope
stays within the limit. A Gaussian rounds it. The result gives the control points of a clamped quintic
B-spline at its Greville abscissae; the spline's slope is a convex combination of slopes between neighbouring
control points, so the limit holds everywhere.
"""

from __future__ import annotations

import numpy as np
import scipy  # which imports its parts when they are used
from numpy.typing import NDArray

from neurosim_core.clock import NS_PER_S
from neurosim_core.trajectory.path import Path

Array = NDArray[np.float64]

_DEGREE = 5
_KNOT_SPACING_S = 0.15
_SAMPLE_NS = 50_000_000
_SMOOTHING_S = 0.15
"""Standard deviation of the Gaussian: at a yaw rate of 1 rad/s it cuts a corner by 0.1 rad."""
_PENALTY = 100.0
_ITERATIONS = 150
"""Of ADMM."""
_HORIZONTAL_MIN_M = 0.02
"""Below this displacement over the lookahead there is no direction of travel, and it is interpolated."""


def follow_travel(path: Path, *, lookahead_s: float, rate_max_rad_s: float) -> Path:
    """Return a path with the same positions that looks where it will be after a time, > 0 and at most 1e6 s.

    The heading is four times continuously differentiable inside, and at rest at both ends; its rate holds
    everywhere. Pieces are cut so that none is longer than 0.15 s. A path without horizontal motion keeps yaw
    0.
    """
    fine = path.subdivided(np.maximum(np.ceil(path.durations_s / _KNOT_SPACING_S), 1.0).astype(np.int64))
    knots_s = (fine.knots_ns - fine.start_ns) / NS_PER_S
    clamped = np.concatenate([np.full(_DEGREE, knots_s[0]), knots_s, np.full(_DEGREE, knots_s[-1])])
    greville = np.lib.stride_tricks.sliding_window_view(clamped[1:-1], _DEGREE).mean(axis=1)
    # three equal control points at each end: yaw rate and acceleration start and end at zero
    asked_s = (
        np.clip(greville, greville[2], greville[-3])
        if len(greville) > 5
        else np.full(len(greville), knots_s[0])
    )

    stamps_ns = np.arange(path.start_ns, path.end_ns + _SAMPLE_NS, _SAMPLE_NS, dtype=np.int64)
    stamps_s = (stamps_ns - path.start_ns) / NS_PER_S
    ahead_ns = stamps_ns + round(lookahead_s * NS_PER_S)
    here_and_ahead = path.evaluate(np.concatenate([stamps_ns, ahead_ns])).position
    way = here_and_ahead[len(stamps_ns) :, :2] - here_and_ahead[: len(stamps_ns), :2]
    moving = np.linalg.norm(way, axis=1) >= _HORIZONTAL_MIN_M
    if not moving.any():
        return fine.with_yaw(np.zeros((len(fine.coefficients), 1)))
    heading = np.unwrap(np.arctan2(way[moving, 1], way[moving, 0]))
    target = np.interp(stamps_s, stamps_s[moving], heading)
    limited = _nearest_with_slope(target, rate_max_rad_s * _SAMPLE_NS / NS_PER_S)
    smooth = scipy.ndimage.gaussian_filter1d(limited, _SMOOTHING_S * NS_PER_S / _SAMPLE_NS, mode="nearest")

    spline = scipy.interpolate.BSpline(clamped, np.interp(asked_s, stamps_s, smooth), _DEGREE)
    powers = np.asarray(scipy.interpolate.PPoly.from_spline(spline.tck).c)[::-1]  # of seconds since the knot
    pieces = powers[:, _DEGREE : _DEGREE + len(fine.coefficients)].T
    return fine.with_yaw(pieces * np.diff(knots_s)[:, None] ** np.arange(_DEGREE + 1))


def _nearest_with_slope(values: Array, step_max: float) -> Array:
    """The sequence nearest to `values`, in the mean square, whose steps are at most `step_max`.

    By ADMM on the steps (a tridiagonal solve and a clip per iteration), which has converged to about a
    hundredth of a radian when it stops. The mean of its two Lipschitz envelopes then keeps the limit exactly.
    """
    if np.abs(np.diff(values)).max(initial=0.0) <= step_max:
        return values
    count = len(values)
    band = np.full((2, count), -_PENALTY)  # I + penalty D^T D, D the differences of neighbours
    band[0] = 1.0 + 2.0 * _PENALTY
    band[0, [0, -1]] -= _PENALTY
    factor = scipy.linalg.cholesky_banded(band, lower=True)
    nearest = values
    steps, dual = np.clip(np.diff(values), -step_max, step_max), np.zeros(count - 1)
    for _ in range(_ITERATIONS):
        pull = np.diff(_PENALTY * (dual - steps), prepend=0.0, append=0.0)
        nearest = np.asarray(scipy.linalg.cho_solve_banded((factor, True), values + pull, check_finite=False))
        slope = np.diff(nearest) + dual
        steps = np.clip(slope, -step_max, step_max)
        dual = slope - steps
    return 0.5 * (_lower_envelope(nearest, step_max) - _lower_envelope(-nearest, step_max))


def _lower_envelope(values: Array, step_max: float) -> Array:
    """The largest sequence with such steps that is nowhere above `values`."""
    ramp = step_max * np.arange(len(values))
    ahead = np.minimum.accumulate(values - ramp) + ramp
    behind = np.minimum.accumulate((values + ramp)[::-1])[::-1] - ramp
    return np.asarray(np.minimum(ahead, behind))
