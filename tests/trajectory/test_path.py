"""Paths against NumPy's polynomials, at integer stamps."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st

from neurosim_core.trajectory.path import Path, PathArrays, PathCursor, evaluate_path, upload_paths

FIELDS = ("position", "velocity", "acceleration", "jerk", "snap")
KNOTS_NS = np.array([7, 400_000_000, 1_000_000_003, 3_500_000_000])


@pytest.fixture
def path() -> Path:
    return Path(KNOTS_NS, np.random.default_rng(1).normal(size=(3, 4, 8)))


def oracle(path: Path, stamp_ns: int) -> list[np.ndarray]:
    """(x, y, z, yaw) and four derivatives by numpy.polyval, in exact integer time since the knot."""
    piece = min(int(np.searchsorted(path.knots_ns, stamp_ns, side="right")) - 1, len(path.coefficients) - 1)
    length_ns = int(path.knots_ns[piece + 1] - path.knots_ns[piece])
    u = (stamp_ns - int(path.knots_ns[piece])) / length_ns
    rows = []
    for order in range(5):
        values = [np.polyval(np.polyder(np.poly1d(c[::-1]), order), u) for c in path.coefficients[piece]]
        rows.append(np.array(values) / (length_ns * 1e-9) ** order)
    return rows


def test_agrees_with_numpy(path, device):
    stamps = np.random.default_rng(2).integers(7, 3_500_000_001, size=200)
    stamps[:4] = KNOTS_NS
    samples = path.evaluate(stamps, device=device)
    for row, stamp in enumerate(stamps.tolist()):
        rows = oracle(path, stamp)
        for name, expected in zip(FIELDS, rows, strict=True):
            # the sum of 8 terms of size up to 5e4 (snap of a 0.4 s piece) in float64
            assert getattr(samples, name)[row] == pytest.approx(expected[:3], rel=1e-11, abs=1e-9)
        assert samples.yaw[row] == pytest.approx(rows[0][3], abs=1e-12)
        assert samples.yaw_rate[row] == pytest.approx(rows[1][3], abs=1e-11)
        assert samples.yaw_acceleration[row] == pytest.approx(rows[2][3], abs=1e-10)


def test_a_cursor_gives_the_same_bits(path):
    stamps = np.random.default_rng(3).integers(-10, 3_600_000_000, size=50)
    samples, cursor = path.evaluate(stamps), PathCursor(path)
    for row, stamp in enumerate(stamps.tolist()):
        point = cursor.at(stamp)
        assert point.dtype.names is not None
        for name in point.dtype.names:
            assert point[name].tobytes() == getattr(samples, name)[row].tobytes()


def test_rests_before_its_start_and_after_its_end(path, device):
    samples = path.evaluate([-(10**12), 6, 7, 3_500_000_000, 3_500_000_001, 10**15], device=device)
    for before in (0, 1):
        assert (samples.position[before] == path.coefficients[0, :3, 0]).all()
    for after in (4, 5):
        assert (samples.position[after] == samples.position[3]).all()
        assert samples.yaw[after] == samples.yaw[3]
    for name in (*FIELDS[1:], "yaw_rate", "yaw_acceleration"):
        assert not getattr(samples, name)[[0, 1, 4, 5]].any(), name
        assert getattr(samples, name)[[2, 3]].all(), name  # at the ends themselves it still moves


def test_time_does_not_accumulate(path):
    """A path that starts after a year gives the same bits as one that starts now."""
    year_ns = 365 * 24 * 3600 * 10**9
    later = Path(path.knots_ns + year_ns, path.coefficients)
    stamps = np.arange(7, 3_500_000_000, 12_345_678)
    assert (later.evaluate(stamps + year_ns).snap == path.evaluate(stamps).snap).all()


def test_several_paths_in_one_array(path, device):
    second = Path(np.array([0, 10**9]), np.random.default_rng(3).normal(size=(1, 4, 4)))

    @wp.kernel(enable_backward=False, module="unique")
    def positions(paths: PathArrays, stamp_ns: wp.int64, position_out: wp.array[wp.vec3d]) -> None:
        vehicle = wp.tid()
        point = evaluate_path(paths, vehicle, stamp_ns)
        position_out[vehicle] = point.position

    out = wp.empty(3, dtype=wp.vec3d, device=device)
    paths = upload_paths([path, second, path], device)
    wp.launch(positions, dim=3, inputs=[paths, 700_000_000, out], device=device)
    alone = [p.evaluate(700_000_000, device=device).position[0] for p in (path, second, path)]
    assert (out.numpy() == np.array(alone)).all()


def test_subdivided_is_the_same_curve(path):
    fine = path.subdivided([1, 5, 3])
    assert len(fine.coefficients) == 9
    assert set(KNOTS_NS) <= set(fine.knots_ns.tolist())
    stamps = np.arange(7, 3_500_000_000, 7_654_321)
    for name in FIELDS:
        whole = getattr(path.evaluate(stamps), name)
        # float64 rounding of coefficients, times the largest value
        assert getattr(fine.evaluate(stamps), name) == pytest.approx(whole, abs=1e-13 * np.abs(whole).max())


def test_length_of_a_straight_path():
    line = Path(np.array([0, 10**9]), np.array([[[0.0, 3.0], [1.0, 4.0], [2.0, 0.0], [0.0, 0.0]]]))
    assert line.length_m == pytest.approx(5.0, rel=1e-12)


def test_is_immutable(path):
    with pytest.raises(ValueError, match="read-only"):
        path.coefficients[0, 0, 0] = 1.0


@pytest.mark.parametrize(
    ("knots", "coefficients", "message"),
    [
        ([0.0, 1.0], np.zeros((1, 4, 2)), "integers"),
        ([0, 0], np.zeros((1, 4, 2)), "increasing"),
        ([0, 1], np.full((1, 4, 2), np.nan), "finite"),
    ],
)
def test_refuses_nonsense(knots, coefficients, message):
    with pytest.raises(ValueError, match=message):
        Path(np.array(knots), coefficients)


def test_refuses_stamps_in_seconds(path):
    with pytest.raises(TypeError, match="integers"):
        path.evaluate([0.5])


@settings(max_examples=50, deadline=None)
@given(
    lengths=st.lists(st.integers(1, 10**10), min_size=1, max_size=5),
    fraction=st.floats(0.0, 1.0),
    seed=st.integers(0, 2**32 - 1),
)
def test_any_path_agrees_with_numpy(lengths, fraction, seed):
    knots = np.cumsum([0, *lengths])
    path = Path(knots, np.random.default_rng(seed).normal(size=(len(lengths), 4, 6)))
    stamp = int(fraction * int(knots[-1]))
    samples = path.evaluate(stamp)
    rows = oracle(path, stamp)
    assert samples.position[0] == pytest.approx(rows[0][:3], abs=1e-12)
    assert samples.velocity[0] == pytest.approx(rows[1][:3], rel=1e-12, abs=1e-11 * np.abs(rows[1]).max())
