"""Textures: decoding, mip levels, packing, and the sampler on each device."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st

from neurosim_core.scene.materials import (
    mean_albedo,
    pack_textures,
    sample_finest,
    sample_nearest,
    sample_texture,
)
from neurosim_core.scene.scene import Material, Texture
from neurosim_core.scene.srgb import srgb_to_linear
from neurosim_core.scene.texels import encode_texels, mip_chain


@wp.kernel
def _sample(
    texels: wp.array[wp.uint32],
    levels: wp.array[wp.vec3i],
    texture: wp.vec2i,
    uv: wp.array[wp.vec2],
    lod: wp.array[float],
    color_out: wp.array[wp.vec3],
):
    k = wp.tid()
    color_out[k] = sample_texture(texels, levels, texture, uv[k], lod[k])


@wp.kernel
def _sample_finest_level(
    texels: wp.array[wp.uint32],
    levels: wp.array[wp.vec3i],
    texture: wp.vec2i,
    uv: wp.array[wp.vec2],
    nearest: bool,
    color_out: wp.array[wp.vec3],
):
    k = wp.tid()
    if nearest:
        color_out[k] = sample_nearest(texels, levels, texture, uv[k])
    else:
        color_out[k] = sample_finest(texels, levels, texture, uv[k])


def sample(srgb, uv, lod, device):
    """Sample a texture trilinearly, or at its finest level if `lod` is "finest" or "nearest"."""
    packed = pack_textures([Material(name="m", texture=Texture(name="t", srgb=srgb))])
    uv = np.asarray(uv, np.float32).reshape(-1, 2)
    color = wp.zeros(len(uv), dtype=wp.vec3, device=device)
    inputs = [
        wp.array(packed.texels, dtype=wp.uint32, device=device),
        wp.array(packed.levels, dtype=wp.vec3i, device=device),
        wp.vec2i(*packed.material_texture[0].tolist()),
        wp.array(uv, dtype=wp.vec2, device=device),
    ]
    if isinstance(lod, str):
        kernel, inputs = _sample_finest_level, [*inputs, lod == "nearest"]
    else:
        lods = np.broadcast_to(np.float32(lod), len(uv))
        kernel, inputs = _sample, [*inputs, wp.array(lods, dtype=float, device=device)]
    wp.launch(kernel, dim=len(uv), inputs=inputs, outputs=[color], device=device)
    return color.numpy()


def noise(height, width, seed=0):
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)


def test_srgb_decodes_by_the_standard():
    """IEC 61966-2-1: 12.92 below 0.04045, a power of 2.4 above."""
    linear = srgb_to_linear(np.array([0, 10, 128, 255], np.uint8))
    expected = [0.0, 10 / 255 / 12.92, ((128 / 255 + 0.055) / 1.055) ** 2.4, 1.0]
    np.testing.assert_allclose(linear, expected, rtol=1e-6)


@settings(max_examples=30, deadline=None)
@given(height=st.integers(1, 67), width=st.integers(1, 67))
def test_every_mip_level_has_the_mean_of_the_picture(height, width):
    picture = srgb_to_linear(noise(height, width))
    chain = mip_chain(picture)
    assert chain[-1].shape == (1, 1, 3)
    for level in chain:
        # float32 averages of averages: a rounding of 6e-8 per level and axis
        means = [p.mean(axis=(0, 1), dtype=np.float64) for p in (level, picture)]
        np.testing.assert_allclose(*means, rtol=2e-6)


def test_mip_texels_are_box_averages():
    picture = srgb_to_linear(noise(8, 6))
    half = mip_chain(picture)[1]
    np.testing.assert_allclose(half, picture.reshape(4, 2, 3, 2, 3).mean(axis=(1, 3)), rtol=1e-6)


def test_odd_sizes_are_averaged_by_area():
    """A row of 3 texels halves to one, 5 to two that share the middle one half and half."""
    row = np.array([1.0, 2.0, 4.0, 8.0, 16.0], np.float32).reshape(1, 5, 1)
    expected = [(1.0 + 2.0 + 0.5 * 4.0) / 2.5, (0.5 * 4.0 + 8.0 + 16.0) / 2.5]
    np.testing.assert_allclose(mip_chain(row)[1].ravel(), expected, rtol=1e-6)


def test_packed_texels_are_finer_than_the_file(device):
    """The error of every 8-bit code is below a tenth (blue: a fifth) of the step to the next code."""
    codes = np.repeat(np.arange(256, dtype=np.uint8)[None, :, None], 3, axis=2)
    uv = np.stack([(np.arange(256) + 0.5) / 256, np.full(256, 0.5)], axis=1)
    exact = srgb_to_linear(codes)[0].astype(float)
    error = np.abs(sample(codes, uv, 0.0, device) - exact)
    step = np.diff(exact[:, 0], append=exact[-1, 0] + 0.009)
    assert (error[:, :2] < 0.1 * step[:, None]).all()
    assert (error[:, 2] < 0.2 * step).all()


def test_texel_centres_and_orientation(device):
    """Texture coordinate v = 1 is the top row, u = 0 the left column."""
    srgb = noise(4, 8)
    rows, cols = np.indices((4, 8))
    uv = np.stack([(cols + 0.5) / 8, 1.0 - (rows + 0.5) / 4], axis=-1)
    got = sample(srgb, uv, 0.0, device).reshape(4, 8, 3)
    np.testing.assert_allclose(got, srgb_to_linear(srgb), atol=1.1e-3)  # 10 bits of the root of blue


def test_between_texels_light_is_linear_and_wraps(device):
    srgb = np.zeros((1, 4, 3), np.uint8)
    srgb[0, 0] = 255
    u = np.array(
        [0.125, 0.25, 0.0, 1.0, -0.0625, 5.1875]
    )  # centre, halfway right, halfway over the border, …
    got = sample(srgb, np.stack([u, np.full(6, 0.3)], axis=1), 0.0, device)[:, 0]
    np.testing.assert_allclose(got, [1.0, 0.5, 0.5, 0.5, 0.25, 0.75], atol=1e-6)


def test_between_levels_light_is_linear(device):
    srgb = noise(16, 16, seed=3)
    uv = [(0.37, 0.61)]
    fine, coarse, between = (sample(srgb, uv, lod, device)[0] for lod in (1.0, 2.0, 1.25))
    np.testing.assert_allclose(between, 0.75 * fine + 0.25 * coarse, rtol=1e-6)
    np.testing.assert_array_equal(sample(srgb, uv, -3.0, device), sample(srgb, uv, 0.0, device))
    mean = srgb_to_linear(srgb).mean(axis=(0, 1))
    np.testing.assert_allclose(sample(srgb, uv, 99.0, device)[0], mean, rtol=2e-3)  # half a step of 10 bits


def test_nearest_texel_is_the_one_that_contains_the_point(device):
    srgb = noise(5, 7, seed=4)
    uv = np.random.default_rng(5).uniform(-3.0, 3.0, (500, 2)).astype(np.float32)
    uv = np.concatenate([uv, [[0.0, 0.0], [1.0, 1.0], [-1e-9, 1e-9]]]).astype(np.float32)
    texel = np.mod(uv, np.float32(1.0)) * [7, 5]  # np.mod of -1e-9 is 1.0: the last column
    column = np.minimum(texel[:, 0].astype(int), 6)
    row = np.minimum((5.0 - texel[:, 1]).astype(int), 4)  # v = 1 is the top
    expected = srgb_to_linear(srgb)[row, column]
    np.testing.assert_allclose(
        sample(srgb, uv, "nearest", device), expected, atol=1.1e-3
    )  # 10 bits of the root of blue


def test_finest_level_is_level_0(device):
    srgb = noise(9, 4, seed=6)
    uv = np.random.default_rng(7).uniform(-3.0, 3.0, (500, 2))
    np.testing.assert_array_equal(sample(srgb, uv, "finest", device), sample(srgb, uv, 0.0, device))


def test_shared_textures_are_packed_once():
    texture = Texture(name="t", srgb=noise(4, 4))
    other = Texture(name="o", srgb=noise(2, 8))
    materials = [
        Material(name="a", texture=texture),
        Material(name="b"),
        Material(name="c", texture=other),
        Material(name="d", texture=texture),
    ]
    packed = pack_textures(materials)
    assert packed.material_texture.tolist() == [[0, 3], [0, 0], [3, 4], [0, 3]]
    assert packed.texels.size == (16 + 4 + 1) + (16 + 4 + 2 + 1)
    assert packed.levels[3:].tolist() == [[21, 8, 2], [37, 4, 1], [41, 2, 1], [43, 1, 1]]
    assert [packed.size_px(k) for k in range(4)] == [(4, 4), (0, 0), (8, 2), (4, 4)]


def test_mean_albedo_is_base_colour_times_mean_texture():
    materials = [
        Material(name="a", base_color=(0.5, 1.0, 1.0), texture=Texture(name="t", srgb=noise(8, 8))),
        Material(name="b", base_color=(0.1, 0.2, 0.3)),
    ]
    mean = srgb_to_linear(noise(8, 8)).mean(axis=(0, 1)) * (0.5, 1.0, 1.0)
    albedo = mean_albedo(materials, pack_textures(materials))
    np.testing.assert_allclose(albedo, [mean, (0.1, 0.2, 0.3)], rtol=2e-3)  # half a step of 10 bits


def test_a_scene_without_textures_packs_nothing():
    packed = pack_textures([Material(name="a")])
    assert packed.texels.size == 0
    assert packed.levels.shape == (0, 3)


def test_encoding_clips():
    assert encode_texels(np.array([[2.0, -1.0, 1.0]], np.float32))[0] == 2047 | (1023 << 22)


def test_threads_decode_textures_at_once():
    """Each picture waits for the other; before Python 3.12 a `cached_property` would let in one at a time."""
    both = threading.Barrier(2)

    def paint():
        both.wait(60.0)
        return np.zeros((2, 2, 3), np.uint8)

    with ThreadPoolExecutor(2) as threads:
        list(threads.map(Texture.decode, [Texture(name=name, srgb=paint) for name in "ab"]))
