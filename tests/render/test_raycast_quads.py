"""Pixels of the ray caster whose threads share the rays of a pixel."""

from __future__ import annotations

import pytest

from neurosim_core.render.raycast_quads import _locate_pixel, casts_quads
from neurosim_core.render.render_terms import RenderTerms


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
    assert casts_quads(("log_radiance", "rgb"), terms)
    assert not casts_quads(("rgb",), terms)
    assert not casts_quads(("log_radiance", "depth"), terms)
    assert not casts_quads(("log_radiance",), terms._replace(quads=False))
