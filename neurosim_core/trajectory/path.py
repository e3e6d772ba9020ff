# mypy: disable-error-code="index,attr-defined,misc"
"""Paths: piecewise polynomials in position and yaw, evaluated by one Warp function at integer nanoseconds.

A piece is a polynomial in its own normalised time u = (stamp - knot) / (next knot - knot) in [0, 1], and the
difference of stamps is taken between integers: nothing accumulates, however long a path is. World frame,
metres, radians.
"""

from __future__ import annotations

import operator
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from neurosim_core.clock import NS_PER_S

wp.set_module_options({"enable_backward": False})


@wp.struct
class PathArrays:
    """One path, or several behind each other, on a device; see `upload_paths`."""

    first_knot: wp.array[wp.int32]
    """Index of each path's first knot, shape [path + 1]; the last element is the number of knots."""
    knots_ns: wp.array[wp.int64]
    """Stamps at which pieces meet, strictly increasing within a path, shape [knot]."""
    coefficients: wp.array2d[wp.vec4d]
    """Coefficients of (x, y, z, yaw) in rising powers of u, shape [piece, degree + 1]."""


@wp.struct
class PathPoint:
    """The setpoint of a path at one instant, in the world frame."""

    position: wp.vec3d
    """[m]."""
    velocity: wp.vec3d
    """[m/s]."""
    acceleration: wp.vec3d
    """[m/s^2]."""
    jerk: wp.vec3d
    """[m/s^3]."""
    snap: wp.vec3d
    """[m/s^4]."""
    yaw: wp.float64
    """Heading, continuous (it may pass pi) [rad]."""
    yaw_rate: wp.float64
    """[rad/s]."""
    yaw_acceleration: wp.float64
    """[rad/s^2]."""


@wp.struct
class PathPlace:
    """The position of an instant on a path."""

    knot: int
    """At which its piece begins."""
    u: wp.float64
    """Part of the piece before it, 0 to 1."""
    rate: wp.float64
    """du/dt [1/s]; 0 before the start and after the end."""


@wp.func
def find_place(path: PathArrays, index: int, stamp_ns: wp.int64) -> PathPlace:
    """Return where path `index` is at a stamp.

    At a knot it is on the piece that starts there; at the last knot on the last piece.
    """
    first = path.first_knot[index]
    last = path.first_knot[index + 1] - 1
    low = first
    high = last  # the piece starts at the last knot <= stamp
    while high - low > 1:
        middle = (low + high) // 2
        if path.knots_ns[middle] <= stamp_ns:
            low = middle
        else:
            high = middle
    length_ns = path.knots_ns[low + 1] - path.knots_ns[low]
    elapsed_ns = wp.clamp(stamp_ns - path.knots_ns[low], wp.int64(0), length_ns)
    place = PathPlace()
    place.knot = low
    place.u = wp.float64(elapsed_ns) / wp.float64(length_ns)
    place.rate = wp.float64(1.0e9) / wp.float64(length_ns)
    if stamp_ns < path.knots_ns[first] or stamp_ns > path.knots_ns[last]:
        place.rate = wp.float64(0.0)
    return place


@wp.func
def evaluate_path(path: PathArrays, index: int, stamp_ns: wp.int64) -> PathPoint:
    """Return point of path `index` at a stamp; before its start and after its end it rests at its ends.

    Position and four derivatives come out of one Horner scheme (repeated synthetic division).
    """
    place = find_place(path, index, stamp_ns)
    u = place.u
    piece = place.knot - index  # every path has one piece less than it has knots
    d0 = wp.vec4d()
    d1 = wp.vec4d()
    d2 = wp.vec4d()
    d3 = wp.vec4d()
    d4 = wp.vec4d()
    count = path.coefficients.shape[1]
    for k in range(count):
        d4 = d4 * u + d3
        d3 = d3 * u + d2
        d2 = d2 * u + d1
        d1 = d1 * u + d0
        d0 = d0 * u + path.coefficients[piece, count - 1 - k]

    rate = place.rate
    rate2 = rate * rate
    d1 = d1 * rate
    d2 = d2 * (wp.float64(2.0) * rate2)
    d3 = d3 * (wp.float64(6.0) * rate2 * rate)
    d4 = d4 * (wp.float64(24.0) * rate2 * rate2)

    point = PathPoint()
    point.position = wp.vec3d(d0[0], d0[1], d0[2])
    point.velocity = wp.vec3d(d1[0], d1[1], d1[2])
    point.acceleration = wp.vec3d(d2[0], d2[1], d2[2])
    point.jerk = wp.vec3d(d3[0], d3[1], d3[2])
    point.snap = wp.vec3d(d4[0], d4[1], d4[2])
    point.yaw = d0[3]
    point.yaw_rate = d1[3]
    point.yaw_acceleration = d2[3]
    return point


@wp.kernel
def _evaluate(
    # Model:
    path: PathArrays,
    # In:
    stamps_ns: wp.array[wp.int64],
    # Out:
    point_out: wp.array[PathPoint],
) -> None:
    sample = wp.tid()
    point_out[sample] = evaluate_path(path, 0, stamps_ns[sample])


@dataclass(frozen=True, kw_only=True, eq=False)
class PathSamples:
    """A path at n stamps, float64, world frame."""

    stamps_ns: NDArray[np.int64]
    """Shape [n]."""
    position: NDArray[np.float64]
    """[m], shape [n, 3]."""
    velocity: NDArray[np.float64]
    """[m/s], shape [n, 3]."""
    acceleration: NDArray[np.float64]
    """[m/s^2], shape [n, 3]."""
    jerk: NDArray[np.float64]
    """[m/s^3], shape [n, 3]."""
    snap: NDArray[np.float64]
    """[m/s^4], shape [n, 3]."""
    yaw: NDArray[np.float64]
    """[rad], shape [n]."""
    yaw_rate: NDArray[np.float64]
    """[rad/s], shape [n]."""
    yaw_acceleration: NDArray[np.float64]
    """[rad/s^2], shape [n]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Attitude:
    """Orientations that a path prescribes: R_WB = R(knot) exp(rotation vector) within each piece."""

    knots: NDArray[np.float64]
    """q_WB at the knots, xyzw, shape [S + 1, 4]."""
    rotation_vectors: NDArray[np.float64]
    """Coefficients of the rotation vector in rising powers of each piece's normalised time [rad], shape
    [S, 4, 3]."""


@dataclass(frozen=True, eq=False)
class Path:
    """An immutable piecewise polynomial in (x, y, z, yaw), in the world frame.

    Attributes:
        knots_ns: Stamps at which pieces meet [ns], strictly increasing int64, shape [S + 1].
        coefficients: Coefficients [m] and [rad] in rising powers of each piece's normalised time in [0, 1],
            float64, shape [S, 4, degree + 1].
        attitude: Orientations, if the path is a motion that is followed exactly; None: a vehicle flies it.

    Raises:
        ValueError: Knots are no increasing integers, or a coefficient is not finite.
    """

    knots_ns: NDArray[np.int64]
    coefficients: NDArray[np.float64]
    attitude: Attitude | None = None

    def __post_init__(self) -> None:
        knots_ns = np.array(self.knots_ns)
        coefficients = np.array(self.coefficients, dtype=np.float64, order="C")
        if not np.issubdtype(knots_ns.dtype, np.integer) or not (np.diff(knots_ns) > 0).all():
            raise ValueError(f"knots_ns must be increasing integers, got {knots_ns.tolist()}")
        knots_ns = knots_ns.astype(np.int64)
        if not np.isfinite(coefficients).all():
            raise ValueError("coefficients must be finite")
        for name, array in (("knots_ns", knots_ns), ("coefficients", coefficients)):
            array.flags.writeable = False
            object.__setattr__(self, name, array)

    @property
    def start_ns(self) -> int:
        """First knot [ns]."""
        return int(self.knots_ns[0])

    @property
    def end_ns(self) -> int:
        """Last knot [ns]."""
        return int(self.knots_ns[-1])

    @property
    def durations_s(self) -> NDArray[np.float64]:
        """Durations of the pieces [s], shape [S]."""
        return np.diff(self.knots_ns) / NS_PER_S

    @property
    def length_m(self) -> float:
        """Length of the way flown [m], to about 1e-3 (chords at 20 parts a piece)."""
        u = np.linspace(0.0, 1.0, 21)
        points = np.einsum("sak,uk->sua", self.coefficients[:, :3], u[:, None] ** np.arange(self.degree + 1))
        return float(np.linalg.norm(np.diff(points, axis=1), axis=2).sum())

    @property
    def degree(self) -> int:
        """Largest power of normalised time."""
        return int(self.coefficients.shape[2]) - 1

    def evaluate(self, stamps_ns: ArrayLike, *, device: str = "cpu") -> PathSamples:
        """Return position, yaw and their derivatives; before the start and after the end the path rests.

        Args:
            stamps_ns: Integer stamps [ns], shape [n] or a single one, in any order.
            device: Where to compute.

        Raises:
            TypeError: If the stamps are not integers of at most 64 bits.
        """
        stamps = np.atleast_1d(np.asarray(stamps_ns))
        integer = np.issubdtype(stamps.dtype, np.integer) and np.can_cast(stamps.dtype, np.int64)
        if stamps.ndim != 1 or not integer:
            raise TypeError(
                f"stamps_ns must be integers of shape [n], got {stamps.dtype} {list(stamps.shape)}"
            )
        stamps = stamps.astype(np.int64)
        points: Any = wp.empty(len(stamps), dtype=PathPoint, device=device)
        stamps_device: Any = wp.array(stamps, dtype=wp.int64, device=device)
        wp.launch(
            _evaluate,
            dim=len(stamps),
            inputs=[upload_paths([self], device), stamps_device, points],
            device=device,
        )
        rows = points.numpy()
        return PathSamples(
            stamps_ns=stamps, **{name: np.ascontiguousarray(rows[name]) for name in rows.dtype.names}
        )

    def subdivided(self, parts: ArrayLike) -> Path:
        """Return the same curve with piece i cut in `parts[i]` parts of equal length, to the nanosecond.

        Args:
            parts: How many parts each piece is cut into, integers >= 1, shape [S] or one for all.
        """
        counts = np.broadcast_to(np.asarray(parts, dtype=np.int64), (len(self.coefficients),))
        knots: list[NDArray[np.int64]] = []
        pieces: list[NDArray[np.float64]] = []
        for start_ns, end_ns, count, piece in zip(
            self.knots_ns[:-1], self.knots_ns[1:], counts, self.coefficients, strict=True
        ):
            inner = start_ns + (np.arange(count + 1) * (end_ns - start_ns)) // count
            u = (inner - start_ns) / (end_ns - start_ns)
            knots.append(inner[:-1])
            pieces.append(np.einsum("pkj,aj->pak", restriction(u[:-1], np.diff(u), self.degree), piece))
        return Path(np.concatenate([*knots, self.knots_ns[-1:]]), np.concatenate(pieces))

    def with_yaw(self, coefficients: NDArray[np.float64]) -> Path:
        """Return this path with another yaw on the same knots.

        Args:
            coefficients: Yaw in rising powers of normalised time [rad], shape [S, any degree + 1].
        """
        return Path(self.knots_ns, join_axes(self.coefficients[:, :3], coefficients[:, None, :]))


class PathCursor:
    """A path at one stamp at a time, on the host: for control loops. It allocates nothing.

    It costs a hundredth of `Path.evaluate`, and gives the same bits. Not for several threads at once.
    """

    def __init__(self, path: Path) -> None:
        arrays = upload_paths([path], "cpu")
        stamps_ns: Any = wp.zeros(1, dtype=wp.int64, device="cpu")
        points: Any = wp.zeros(1, dtype=PathPoint, device="cpu")
        self._launch = wp.launch(
            _evaluate, dim=1, inputs=[arrays, stamps_ns, points], device="cpu", record_cmd=True
        )
        self._memory = (arrays, stamps_ns, points)  # the launch knows addresses only
        self._stamp_ns, self._point = stamps_ns.numpy(), points.numpy()

    def at(self, stamp_ns: int) -> np.void:
        """Return a record with the fields of `PathPoint`, shape []; the next call overwrites it.

        Raises:
            TypeError: The stamp is no integer.
            OverflowError: It does not fit 64 bits.
        """
        self._stamp_ns[0] = operator.index(stamp_ns)
        self._launch.launch()
        point: np.void = self._point[0]
        return point


def join_axes(first: NDArray[np.float64], second: NDArray[np.float64]) -> NDArray[np.float64]:
    """Stack coefficients [S, a, j] and [S, b, k] of different degrees as [S, a + b, max(j, k)]."""
    width = max(first.shape[2], second.shape[2])
    padded = [np.pad(c, ((0, 0), (0, 0), (0, width - c.shape[2]))) for c in (first, second)]
    return np.concatenate(padded, axis=1)


def restriction(start: NDArray[np.float64], length: NDArray[np.float64], degree: int) -> NDArray[np.float64]:
    """Return matrices that take a polynomial's coefficients to those on parts of its interval.

    Parts begin in normalised time at `start` and have a length, shape [part].

    Returns:
        Shape [part, degree + 1, degree + 1]; each part has its own normalised time in [0, 1].
    """
    matrix = np.zeros((len(start), degree + 1, degree + 1))
    binomial = np.ones(1)
    for power in range(degree + 1):  # (start + length v)^power
        for k in range(power + 1):
            matrix[:, k, power] = binomial[k] * start ** (power - k) * length**k
        binomial = np.convolve(binomial, [1.0, 1.0])
    return matrix


def upload_paths(paths: Sequence[Path], device: Any) -> PathArrays:
    """Put paths, padded to one degree, on a device, for `evaluate_path` in a kernel."""
    width = max(path.degree for path in paths) + 1
    rows = np.concatenate(
        [np.pad(path.coefficients, ((0, 0), (0, 0), (0, width - path.degree - 1))) for path in paths]
    )
    arrays = PathArrays()
    arrays.first_knot = wp.array(
        np.cumsum([0] + [len(path.knots_ns) for path in paths]), dtype=wp.int32, device=device
    )
    arrays.knots_ns = wp.array(
        np.concatenate([path.knots_ns for path in paths]), dtype=wp.int64, device=device
    )
    coefficients: Any = wp.array(np.ascontiguousarray(rows.transpose(0, 2, 1)), dtype=wp.vec4d, device=device)
    arrays.coefficients = coefficients
    return arrays
