from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import warp as wp
from scipy import stats

from neurosim_core import random


@wp.kernel
def _philox(counter: wp.array[wp.vec4ui], key: wp.array[wp.vec2ui], out: wp.array[wp.vec4ui]):
    row = wp.tid()
    out[row] = random.philox(counter[row], key[row])


@wp.kernel
def _draws(
    seed: wp.uint64,
    stream: wp.uint32,
    step: wp.int64,
    bits: wp.array[wp.vec4ui],
    uniform: wp.array[wp.vec2d],
    normal: wp.array[wp.vec2d],
    uniform_32: wp.array[wp.vec4],
    normal_32: wp.array[wp.vec4],
):
    element = wp.tid()
    word = random.random_bits(seed, stream, step, element)
    bits[element] = word
    uniform[element] = random.uniform2(word)
    normal[element] = random.normal2(word)
    uniform_32[element] = random.uniform4(word)
    normal_32[element] = random.normal4(word)


def draws(seed: int, stream: int, step: int, count: int, device: str) -> dict[str, Any]:
    types = {
        "bits": wp.vec4ui,
        "uniform": wp.vec2d,
        "normal": wp.vec2d,
        "uniform_32": wp.vec4,
        "normal_32": wp.vec4,
    }
    arrays = {name: wp.zeros(count, dtype=dtype, device=device) for name, dtype in types.items()}
    wp.launch(_draws, dim=count, inputs=[seed, stream, step, *arrays.values()], device=device)
    return {name: array.numpy() for name, array in arrays.items()}


def philox_in_integers(counter: tuple[int, ...], key: tuple[int, ...]) -> tuple[int, ...]:
    """The published round function in Python integers, independent of Warp's integer types."""
    mask = 2**32 - 1
    c, k = list(counter), list(key)
    for _ in range(10):
        p0, p1 = 0xD2511F53 * c[0], 0xCD9E8D57 * c[2]
        c = [(p1 >> 32) ^ c[1] ^ k[0], p1 & mask, (p0 >> 32) ^ c[3] ^ k[1], p0 & mask]
        k = [(k[0] + 0x9E3779B9) & mask, (k[1] + 0xBB67AE85) & mask]
    return tuple(c)


def test_philox_gives_the_known_answers_of_random123(device):
    """Vectors `philox4x32 10` of Random123's kat_vectors."""
    ones = 0xFFFFFFFF
    counter = [(0, 0, 0, 0), (ones,) * 4, (0x243F6A88, 0x85A308D3, 0x13198A2E, 0x03707344)]
    key = [(0, 0), (ones, ones), (0xA4093822, 0x299F31D0)]
    expected = [
        (0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8),
        (0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD),
        (0xD16CFE09, 0x94FDCCEB, 0x5001E420, 0x24126EA1),
    ]
    out = wp.zeros(3, dtype=wp.vec4ui, device=device)
    counters = wp.array(np.array(counter, np.uint32), dtype=wp.vec4ui, device=device)
    keys = wp.array(np.array(key, np.uint32), dtype=wp.vec2ui, device=device)
    wp.launch(_philox, dim=3, inputs=[counters, keys, out], device=device)
    np.testing.assert_array_equal(out.numpy(), np.array(expected, np.uint32))


def test_address_fills_counter_and_key(device):
    """Every bit of the address counts: (element, step low, step high, stream) under (seed low, seed high)."""
    seed, stream, step = 0x0123456789ABCDEF, 0xFEDCBA98, 0x1122334455667788
    bits = draws(seed, stream, step, 3, device)["bits"]
    for element in range(3):
        counter = (element, 0x55667788, 0x11223344, stream)
        assert tuple(bits[element]) == philox_in_integers(counter, (0x89ABCDEF, 0x01234567))


def test_numbers_are_those_of_the_bits(device):
    """Uniforms are the top 52 (23) bits, centred in their interval; normals their Box-Muller pairs."""
    found = draws(7, 1, 2, 1000, device)
    words = found["bits"].astype(np.uint64)
    joined = (words[:, ::2] << np.uint64(32)) | words[:, 1::2]
    uniform = ((joined >> np.uint64(12)).astype(np.float64) + 0.5) * 2.0**-52
    np.testing.assert_array_equal(found["uniform"], uniform)
    uniform_32 = ((words >> np.uint64(9)).astype(np.float64) + 0.5) * 2.0**-23
    np.testing.assert_array_equal(found["uniform_32"], uniform_32)
    radius = np.sqrt(-2.0 * np.log(uniform_32[:, ::2]))
    angle = 2.0 * np.pi * uniform_32[:, 1::2]
    expected = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1).reshape(-1, 4)
    # the angle is rounded to float32: 2^-22 of 2 pi, times a radius below 5.8
    np.testing.assert_allclose(found["normal_32"], expected, atol=4e-6)
    radius, angle = np.sqrt(-2.0 * np.log(uniform[:, :1])), 2.0 * np.pi * uniform[:, 1:]
    expected = np.hstack([radius * np.cos(angle), radius * np.sin(angle)])
    # float64 roundings of log, sqrt, cos and the angle
    np.testing.assert_allclose(draws(7, 1, 2, 1000, device)["normal"], expected, rtol=1e-12, atol=1e-14)


def test_values_do_not_depend_on_the_size_of_the_batch(device):
    np.testing.assert_array_equal(
        draws(3, 4, 5, 10, device)["normal"], draws(3, 4, 5, 1000, device)["normal"][:10]
    )


@pytest.mark.parametrize("change", [(1, 0, 0), (2**32, 0, 0), (0, 1, 0), (0, 0, 1), (0, 0, 2**32)])
def test_addresses_that_differ_are_independent(change, device):
    """Correlation of 2^17 pairs of independent normals is N(0, 1 / n): 5 sigma is a false alarm of 6e-7."""
    first, second = draws(0, 0, 0, 2**16, device)["normal"], draws(*change, 2**16, device)["normal"]
    correlation = np.mean(first * second)
    assert abs(correlation) < 5.0 / np.sqrt(first.size)


@pytest.mark.parametrize("kind", ["float64", "float32"])
def test_normals_are_standard_and_uncorrelated(kind, device):
    """Kolmogorov-Smirnov, and the covariance of the numbers of one block; false alarm below 1e-6."""
    count = 2**17
    z = (
        draws(11, 12, 13, count, device)["normal"]
        if kind == "float64"
        else draws(11, 12, 13, count, device)["normal_32"]
    )
    assert stats.kstest(z.ravel(), "norm").pvalue > 1e-6
    covariance = z.T.astype(np.float64) @ z / count
    # entries have standard deviation sqrt(2 / n) on and sqrt(1 / n) off the diagonal; 16 of them
    assert np.abs(covariance - np.eye(len(covariance))).max() < 5.5 * np.sqrt(2.0 / count)


def test_streams_of_names_are_fixed():
    """The check value of CRC-32 is 0xCBF43926."""
    assert random.stream_id("123456789") == 0xCBF43926
