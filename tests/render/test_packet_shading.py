"""Shading of packets against shading ray by ray: the same bytes.

Candidate lists give the hits of Warp's rays to the last bit, and shades them in packets, so that pictures
of both differ only if the shading does.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import warp as wp
from hall import hall

from neurosim_core.render.camera import PinholeConfig
from neurosim_core.render.config import RenderConfig
from neurosim_core.render.scene_arrays import upload_scene
from neurosim_core.render.warp_renderer import WarpRenderer
from neurosim_core.scene.scene import Material, Texture

LENS = PinholeConfig(width=53, height=38, horizontal_fov_rad=1.5)  # no multiples of a packet
VIEWS = 4


def scene_of(kind):
    """Return a hall without its ceiling, so that some rays hit nothing; textures of many sizes."""
    whole = hall(2_000)
    kept = whole.face_instance != 1
    rng = np.random.default_rng(1)

    def texture(width, height):
        return Texture(name="noise", srgb=rng.integers(0, 256, (height, width, 3), dtype=np.uint8))

    sizes = [(256, 128), (64, 64), (1, 1), (33, 7), (1, 16)]
    textures = [texture(*size) for size in sizes] if kind != "plain" else [None] * len(sizes)
    emission = (0.0, 0.3, 0.2) if kind == "emissive" else (0.0, 0.0, 0.0)
    materials = [
        Material(name=str(k), base_color=(0.9, 0.5, 0.2), texture=t, emission=emission)
        for k, t in enumerate(textures)
    ]
    return replace(
        whole,
        faces=whole.faces[kept],
        face_material=whole.face_material[kept],
        face_instance=whole.face_instance[kept],
        materials=(*materials, Material(name="bare", base_color=(0.3, 0.6, 0.9))),
    )


def pictures(scene, *, with_depth=False, **settings):
    """Return log radiance of views all around, of which one is far outside; with depth: of each."""
    rng = np.random.default_rng(2)
    q_WC = rng.normal(size=(VIEWS, 4)).astype(np.float32)
    q_WC /= np.linalg.norm(q_WC, axis=1, keepdims=True)
    p_WC = np.tile(np.float32([0.3, 2.1, 1.7]), (VIEWS, 1))
    p_WC[-1] += 400.0
    arrays = upload_scene(scene, RenderConfig(**settings), "cpu")
    outputs = ("log_radiance", "depth") if with_depth else ("log_radiance",)
    renderer = WarpRenderer(arrays, LENS, outputs=outputs, instant_count=VIEWS, image_count=VIEWS)
    slots = wp.array([k if with_depth else -1 for k in range(VIEWS)], dtype=int, device="cpu")
    poses = wp.array(p_WC, dtype=wp.vec3, device="cpu"), wp.array(q_WC, dtype=wp.quat, device="cpu")
    renderer.render(*poses, slots, instant_count=VIEWS)
    return renderer.log_radiance.numpy()


KINDS = pytest.mark.parametrize(
    ("kind", "settings"),
    [
        ("plain", {}),
        ("textured", {"mip_bias": -2.0}),
        ("emissive", {"mip_bias": 1.0, "samples_per_pixel": 2}),
    ],
)


@KINDS
def test_packets_are_shaded_like_single_rays(kind, settings):
    scene = scene_of(kind)
    alone = pictures(scene, cpu_traversal="warp", candidate_lists=None, **settings)
    packets = pictures(scene, candidate_lists={}, **settings)
    assert packets.tobytes() == alone.tobytes()
    sky = np.log(np.float32(0.2126 * 0.55 + 0.7152 * 0.7 + 0.0722 * 0.95 + 1e-3))
    seen = np.abs(alone - sky) > 1e-3
    assert 1.0 - seen.mean() > 0.02  # the sky is seen, and other things
    assert len(np.unique(alone[seen])) > 1000


@KINDS
def test_packets_are_seen_at_once_as_step_by_step(kind, settings):
    """Where a picture of depth is taken, casting, shading and writing are steps of their own; else one."""
    pytest.importorskip("embreex", exc_type=ImportError)
    scene = scene_of(kind)
    at_once = pictures(scene, cpu_traversal="embree", **settings)
    by_step = pictures(scene, with_depth=True, cpu_traversal="embree", **settings)
    assert by_step.tobytes() == at_once.tobytes()
    assert len(np.unique(at_once)) > 1000
