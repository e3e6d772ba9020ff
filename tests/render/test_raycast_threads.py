"""What threads of the ray caster render: each pixel is taken once."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from neurosim_core.render.kernel_data import RenderTerms
from neurosim_core.render.raycast import _casts_quads, _locate_pixel, turn_count

LARGEST = 2**31 - 1


@wp.kernel(enable_backward=False)
def _count_turns(begins: wp.array[int], end: int, step: int, count_out: wp.array[int]) -> None:
    thread = wp.tid()
    count_out[thread] = turn_count(begins[thread], end, step)


@pytest.mark.parametrize("step", [1, 7, 84_480, LARGEST])
@pytest.mark.parametrize("end", [0, 1, 1000, 84_480, 84_481, LARGEST - 84_480, LARGEST - 1, LARGEST])
def test_turns_are_counted_up_to_the_largest_index(device, end, step):
    """As many as Python's range has, whose integers do not overflow."""
    begins = sorted({k for k in (0, 1, 999, 1000, 84_479, end - 1, end, LARGEST) if k >= 0})
    counts = wp.zeros(len(begins), dtype=int, device=device)
    wp.launch(
        _count_turns,
        dim=len(begins),
        inputs=[wp.array(np.array(begins, np.int32), dtype=int, device=device), end, step],
        outputs=[counts],
        device=device,
    )
    np.testing.assert_array_equal(counts.numpy(), [len(range(begin, end, step)) for begin in begins])


@pytest.mark.parametrize("paired", [False, True])
def test_each_pixel_of_a_tile_is_rendered_once_by_four_adjacent_threads(paired: bool) -> None:
    threads: dict[tuple[int, int, int], list[int]] = {}
    for half in range(1 + paired):
        for thread in range(64):
            for patch in range(4):
                instant = (thread // 16) % 2 if paired else 0
                pixel = (instant, *_locate_pixel(patch, thread, paired, half))
                threads.setdefault(pixel, []).append(thread)
    assert len(threads) == 64 * (1 + paired)
    assert {pixel[1] for pixel in threads} == {pixel[2] for pixel in threads} == set(range(8))
    assert all(four == list(range(four[0] // 4 * 4, four[0] // 4 * 4 + 4)) for four in threads.values())


def test_only_light_at_all_instants_is_rendered_so() -> None:
    terms = RenderTerms(textured=False, emissive=False, baked=True, supersampled=True, quads=True)
    assert _casts_quads(("log_radiance", "rgb"), terms)
    assert not _casts_quads(("rgb",), terms)
    assert not _casts_quads(("log_radiance", "depth"), terms)
    assert not _casts_quads(("log_radiance",), terms._replace(quads=False))
