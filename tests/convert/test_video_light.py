"""From stored numbers to light: standards, matrices, areas."""

from __future__ import annotations

import numpy as np
import pytest

from neurosim_core.convert.geometry import Crop, Resizer, largest_crop, read_crop, read_size
from neurosim_core.convert.light import TRANSFERS, luminance_weights, transfer_of
from neurosim_core.convert.luminance import LightTables, LumaDecoder, matrix_of

LIGHT = np.concatenate([[0.0], np.logspace(-4.0, 0.0, 50)])


def encode_srgb(light):
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)


def encode_bt709(light):
    return np.where(light < 0.018, 4.5 * light, 1.099 * light**0.45 - 0.099)


def encode_smpte240m(light):
    return np.where(light < 0.0228, 4.0 * light, 1.1115 * light**0.45 - 0.1115)


def encode_pq(light):
    """ST 2084, light 1 for 203 cd/m^2."""
    y = (203.0 / 10_000.0 * light) ** 0.1593017578125
    return ((0.8359375 + 18.8515625 * y) / (1.0 + 18.6875 * y)) ** 78.84375


def encode_hlg(light):
    """BT.2100, light 1 where the code is 0.75."""
    a, b, c = 0.17883277, 0.28466892, 0.55991073
    scene = light * (np.exp((0.75 - c) / a) + b) / 12.0
    return np.where(scene <= 1 / 12, np.sqrt(3.0 * scene), a * np.log(np.maximum(12.0 * scene - b, 1e-9)) + c)


# bt709: the constants of BT.709 have three digits, ours those of BT.2020, which make the pieces meet
@pytest.mark.parametrize(
    ("name", "encode", "tolerance"),
    [
        ("srgb", encode_srgb, 2e-7),
        ("bt709", encode_bt709, 5e-4),
        ("smpte240m", encode_smpte240m, 1e-4),
        ("pq", encode_pq, 1e-9),
        ("hlg", encode_hlg, 1e-6),
        ("gamma22", lambda light: light ** (1 / 2.2), 1e-12),
        ("gamma28", lambda light: light ** (1 / 2.8), 1e-12),
        ("linear", lambda light: light, 1e-12),
    ],
)
def test_transfer_functions_undo_those_of_the_standards(name, encode, tolerance):
    np.testing.assert_allclose(TRANSFERS[name](encode(LIGHT)), LIGHT, atol=tolerance)


def test_log_functions_span_their_decades():
    np.testing.assert_allclose(TRANSFERS["log100"](np.array([0.0, 0.5, 1.0])), [0.0, 0.1, 1.0])
    np.testing.assert_allclose(TRANSFERS["log316"](np.array([0.2, 1.0])), [0.01, 1.0])


def test_a_file_names_its_transfer_function_by_number():
    assert [transfer_of(number) for number in (1, 13, 16, 18, 2)] == ["bt709", "srgb", "pq", "hlg", None]
    with pytest.raises(ValueError, match=r"transfer function 17 .* is not known, known: \[1, 4"):
        transfer_of(17)


@pytest.mark.parametrize("bits", [8, 16])
def test_grey_is_the_same_as_one_number_or_as_three(bits):
    """To the bit, so that events are the same."""
    grey = np.arange(1 << bits, dtype=np.uint8 if bits == 8 else np.uint16).reshape(16, -1)
    tables = LightTables("srgb", bits=bits)
    np.testing.assert_array_equal(
        tables.luminance(np.repeat(grey[..., None], 3, axis=2)), tables.luminance(grey)
    )


def test_luminance_of_rgb_is_the_weighted_sum_of_light():
    picture = np.random.default_rng(0).integers(0, 256, (7, 9, 3), dtype=np.uint8)
    for primaries, weights in ((1, (0.2126, 0.7152, 0.0722)), (9, (0.2627, 0.6780, 0.0593))):
        expected = TRANSFERS["srgb"](picture / 255.0) @ np.array(weights)
        found = LightTables("srgb", bits=8, primaries=primaries).luminance(picture)
        np.testing.assert_allclose(found, expected, rtol=2e-7)  # rounded to float32 once
        assert luminance_weights(primaries) == weights


@pytest.mark.parametrize("limited", [True, False])
@pytest.mark.parametrize(("bits", "matrix"), [(8, 1), (8, 6), (10, 9)])
def test_luma_and_colour_differences_become_light(bits, matrix, limited):
    """H.273: solved here for R', G', B' as a linear system."""
    rng = np.random.default_rng(1)
    stored = rng.integers(0, 1 << bits, (11, 13, 3)).astype(np.float64)
    k_r, k_b = matrix_of(matrix, 480)
    step, full = 1 << (bits - 8), (1 << bits) - 1
    luma = (stored[..., 0] - 16 * step) / (219 * step) if limited else stored[..., 0] / full
    chroma = (stored[..., 1:] - 128 * step) / (224 * step if limited else full)
    forward = np.array(
        [
            [k_r, 1 - k_r - k_b, k_b],
            np.array([-k_r, -(1 - k_r - k_b), 1 - k_b]) / (2 * (1 - k_b)),
            np.array([1 - k_r, -(1 - k_r - k_b), -k_b]) / (2 * (1 - k_r)),
        ]
    )
    rgb = np.linalg.solve(forward, np.concatenate([luma[..., None], chroma], axis=2)[..., None])[..., 0]
    expected = TRANSFERS["bt709"](np.clip(rgb, 0.0, 1.0)) @ np.array([0.2126, 0.7152, 0.0722])
    decoder = LumaDecoder("bt709", bits=bits, matrix=(k_r, k_b), primaries=1, limited=limited)
    shifted = stored.astype(np.uint16) << (16 - bits)
    # codes are float32 (6e-8), the slope at white is 2.2
    np.testing.assert_allclose(decoder.luminance(shifted), expected, atol=1e-6)
    assert len(decoder.codes) == (219 * step + 1 if limited else 1 << bits)


def test_a_file_that_names_no_matrix_is_taken_by_its_height():
    assert matrix_of(2, 480) == (0.299, 0.114)
    assert matrix_of(2, 720) == (0.2126, 0.0722)
    with pytest.raises(ValueError, match=r"colour matrix 8 .* is not known"):
        matrix_of(8, 720)


def test_areas_are_averaged_exactly():
    """Against a picture of which every pixel was cut into as many as it takes for whole numbers."""
    light = np.random.default_rng(2).random((6, 10)).astype(np.float32)
    resizer = Resizer((10, 6), Crop(10, 6), (4, 4))
    fine = np.repeat(np.repeat(light.astype(np.float64), 2, axis=0), 2, axis=1)  # 12 x 20
    expected = fine.reshape(4, 3, 4, 5).mean(axis=(1, 3))
    np.testing.assert_allclose(resizer.resize(light), expected, rtol=1e-6)  # float32 sums


def test_a_picture_of_the_wanted_size_is_left_as_it_is():
    light = np.random.default_rng(3).random((6, 10)).astype(np.float32)
    np.testing.assert_array_equal(Resizer((10, 6), Crop(10, 6), (10, 6)).resize(light), light)
    np.testing.assert_array_equal(
        Resizer((10, 6), read_crop("4x3+5+2"), (4, 3)).resize(light), light[2:5, 5:9]
    )


def test_the_largest_part_of_a_shape_is_in_the_middle():
    assert largest_crop(Crop(1920, 1080), (100, 100)) == Crop(1080, 1080, 420, 0)
    assert largest_crop(Crop(640, 480), (320, 120)) == Crop(640, 240, 0, 120)
    assert largest_crop(Crop(346, 260), (346, 260)) == Crop(346, 260)


def test_sizes_that_make_no_sense_are_refused():
    with pytest.raises(ValueError, match=r"size must be WIDTHxHEIGHT.*got '346'"):
        read_size("346")
    with pytest.raises(ValueError, match=r"crop must be WIDTHxHEIGHT\+X\+Y.*got '10x0\+1\+1'"):
        read_crop("10x0+1+1")
    with pytest.raises(ValueError, match=r"inside the 10x6 pixels there are, got 10x6\+1\+0"):
        Resizer((10, 6), Crop(10, 6, 1, 0), (10, 6))


def test_a_picture_is_enlarged_between_its_centres():
    """A ramp stays a ramp, but for the half pixel at the borders; a square keeps its shape."""
    ramp = np.arange(8, dtype=np.float32)[None, :].repeat(3, axis=0)
    larger = Resizer((8, 3), Crop(8, 3), (24, 9)).resize(ramp)
    expected = ((np.arange(24) + 0.5) / 3 - 0.5).clip(0.0, 7.0)
    np.testing.assert_allclose(larger, expected[None, :].repeat(9, axis=0), atol=1e-6)  # float32 weights


def test_one_axis_may_grow_while_the_other_shrinks():
    light = np.random.default_rng(4).random((6, 10)).astype(np.float32)
    found = Resizer((10, 6), Crop(10, 6), (20, 3)).resize(light)
    assert found.shape == (3, 20)
    shrunk = Resizer((10, 6), Crop(10, 6), (10, 3)).resize(light)
    np.testing.assert_allclose(found, Resizer((10, 3), Crop(10, 3), (20, 3)).resize(shrunk), rtol=1e-6)
