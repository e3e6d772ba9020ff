"""The benchmark of rendering, small: its bar, and what its numbers must obey."""

from __future__ import annotations

import numpy as np
import pytest

from neurosim_core.bench.render import checkerboard_floor, looking, measure_render
from neurosim_core.bench.render_chapter import render_chapter
from neurosim_core.bench.render_result import DEFAULT, POINT, Sampling
from neurosim_core.bench.report import write_report


@pytest.fixture(scope="module")
def result():
    return measure_render(quick=True, device="cpu")


def pan_of(result, sampling):
    return next(row for row in result.pan if row.sampling == sampling)


def test_defaults_make_ten_times_fewer_false_events_than_point_sampling(result):
    """Issue 6, rendering."""
    (bar,) = render_chapter(result).bars
    assert bar.met
    point, default = pan_of(result, POINT), pan_of(result, DEFAULT)
    assert point.false_count >= 10 * default.false_count
    assert default.event_count > 10_000  # not because there are none


def test_events_add_up(result):
    for row in result.pan:
        assert row.event_count == row.true_count - row.missing_count + row.false_count
        assert row.wrong_polarity_count >= 0
    point, default = pan_of(result, POINT), pan_of(result, DEFAULT)
    assert result.false_per_pixel.sum(axis=(1, 2)).tolist() == [point.false_count, default.false_count]


@pytest.mark.parametrize("scene", ["apartment", "checkerboard"])
def test_errors_shrink_with_samples_and_filtering(result, scene):
    rms = {row.sampling: row.rms for row in result.pictures if row.scene == scene}
    assert rms[DEFAULT] < rms[Sampling(texture_filter="bilinear")] < rms[POINT]
    for name in ("bilinear", "nearest"):  # point samples of a function: about as 1 / sqrt(n) or better
        assert (
            rms[Sampling(texture_filter=name, samples_per_pixel=4)] < 0.6 * rms[Sampling(texture_filter=name)]
        )
    assert rms[DEFAULT] < rms[Sampling(mip_bias=-2.0)]
    for row in result.pictures:
        assert 0.0 < row.rms < row.p99 < 10.0
        assert row.picture_s > 0.0


def test_the_reference_is_far_better_than_what_is_judged(result):
    assert 0.0 < result.reference_rms < 0.2 * min(r.rms for r in result.pictures if r.scene == "checkerboard")


def test_the_reference_sees_the_squares_as_they_are(result):
    """The nearest ones are three pixels wide: linear light of their sRGB, evenly lit, with the dark floor."""
    low, high = result.views[2].min(), result.views[2].max()
    albedo = np.array([(code / 255 + 0.055) / 1.055 for code in (40, 230)]) ** 2.4
    np.testing.assert_allclose([low, high], np.log(albedo + 1e-3), atol=0.02)  # 11-bit roots of texels


def test_views_are_upright():
    """Looking along x, and down: right is -y, the picture's down is down and back."""
    from scipy.spatial.transform import Rotation

    R_WC = Rotation.from_quat(looking(0.0, np.pi / 6)).as_matrix()
    np.testing.assert_allclose(R_WC[:, 2], [np.cos(np.pi / 6), 0.0, -0.5], atol=1e-12)
    np.testing.assert_allclose(R_WC[:, 0], [0.0, -1.0, 0.0], atol=1e-12)
    assert R_WC[2, 1] < 0.0
    assert np.linalg.det(R_WC) == pytest.approx(1.0)


def test_squares_have_their_size():
    """Two squares to a period of the texture."""
    scene = checkerboard_floor(0.05)
    span_m = np.ptp(scene.vertices[:, 0])
    assert np.ptp(scene.uv[:, 0]) == pytest.approx(span_m / 0.1)


def test_the_chapter(result, tmp_path):
    chapter = render_chapter(result)
    write_report([chapter], tmp_path)
    assert {p.name for p in tmp_path.iterdir()} == {
        "render-pictures.csv", "render-aliasing.csv", "render-error.png", "render-aliasing.png",
        "report.md", "report.html",
    }  # fmt: skip
    point, default = pan_of(result, POINT), pan_of(result, DEFAULT)
    assert f"adds {default.false_count:,} false ones" in chapter.summary
    assert f"{default.false_count:,} against {point.false_count:,}" in chapter.bars[0].measured
    assert chapter.command == "neurosim bench render --quick"
