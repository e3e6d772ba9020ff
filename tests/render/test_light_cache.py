"""Light that is kept on disk: the same bytes, for the same scene alone, within bounds."""

from __future__ import annotations

import dataclasses
import os

import numpy as np
import pytest
from render_scenes import plane, point_light, scene_of

from neurosim_core.render import light_cache
from neurosim_core.render.config import LightingConfig
from neurosim_core.render.lighting import bake_light
from neurosim_core.render.refine import refine


@pytest.fixture
def entries(kernel_cache):
    """The files that are kept, in a folder of their own."""
    return lambda: sorted((kernel_cache / "light").glob("*"))


SCENE = scene_of(plane(4.0), lights=(point_light((0.0, 0.0, 2.0), 3.0),))


def bake(scene=SCENE, *, edge_m=0.05, **config):
    """Bake the light of more than 10,000 triangles, unless edges are longer."""
    return bake_light(scene, refine(scene, edge_m), LightingConfig(**config), device="cpu")


def test_light_is_read_for_the_same_scene_and_settings_alone(entries):
    first = bake()
    assert len(entries()) == 1
    np.testing.assert_array_equal(bake(), first)
    assert len(entries()) == 1
    with np.load(entries()[0]) as kept:
        dark = {**kept, "light": 0.0 * kept["light"]}
    np.savez(entries()[0], **dark)
    assert (bake() == 0.0).all()  # it was read indeed
    brighter = dataclasses.replace(SCENE, lights=(point_light((0.0, 0.0, 2.0), 4.0),))
    for other in (bake(brighter), bake(shadow_ray_count=8)):
        assert other.max() > 0.1
    assert len(entries()) == 3
    assert bake(edge_m=0.5).max() > 0.1
    assert len(entries()) == 3  # a small scene is lit as fast as its light is read


def test_what_is_damaged_or_cannot_be_written_is_computed(entries):
    first = bake()
    (entry,) = entries()
    for damaged in (b"", entry.read_bytes()[:-8], b"PK nonsense"):
        entry.write_bytes(damaged)
        np.testing.assert_array_equal(bake(), first)
    entry.unlink()
    entry.parent.rmdir()
    entry.parent.write_text("not a folder")
    np.testing.assert_array_equal(bake(), first)


def test_what_was_used_least_recently_goes(entries, monkeypatch):
    for number, count in enumerate((4, 5, 6)):
        bake(shadow_ray_count=count)
        for index, entry in enumerate(entries()):
            os.utime(entry, (number + index, number + index))
    oldest, *kept = sorted(entries(), key=lambda entry: entry.stat().st_mtime)
    size = oldest.stat().st_size
    monkeypatch.setattr(light_cache, "SIZE_MAX", 3 * size)
    bake(shadow_ray_count=7)
    left = entries()
    assert len(left) == 3
    assert oldest not in left
    assert set(kept) <= set(left)
