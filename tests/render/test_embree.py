"""Embree's rays against Warp's, against closed surfaces that must hold, and what happens without Embree."""

from __future__ import annotations

import ctypes
import functools
import importlib.metadata
import logging
import resource
from pathlib import Path

import numpy as np
import pytest
import trimesh
import warp as wp
from render_scenes import LOOK_DOWN, UNSHADOWED, box, plane, render, scene_of
from scipy.spatial.transform import Rotation

from neurosim_core.render import embree
from neurosim_core.render.camera import PinholeConfig
from neurosim_core.render.config import LightingConfig, RenderConfig
from neurosim_core.render.embree import EmbreeError, EmbreeTree, packet_caster, packet_width
from neurosim_core.render.kernel_data import Hit
from neurosim_core.render.outputs import OUTPUTS
from neurosim_core.render.refine import refine
from neurosim_core.render.scene_arrays import upload_scene
from neurosim_core.scene.apartment import ApartmentConfig, make_apartment
from neurosim_core.scene.mesh import MeshSceneConfig, load_mesh_scene

LENS = PinholeConfig(width=45, height=34, fx=40.0, fy=38.0, cx=21.0, cy=18.5)  # no multiples of a packet


@pytest.fixture(scope="module")
def width():
    pytest.importorskip("embreex", exc_type=ImportError)
    return packet_width()


def make_embree_kernel(width):
    cast_packet = packet_caster(width)

    @wp.kernel(module="unique", enable_backward=False)
    def embree_rays(
        intersect: wp.uint64,
        scene: wp.uint64,
        origins: wp.array[wp.vec3],
        rays: wp.array2d[wp.vec3],
        hit_out: wp.array2d[Hit],
    ):
        packet = wp.tid()
        origin = wp.zeros(shape=(16,), dtype=wp.vec3)
        for lane in range(16):
            origin[lane] = origins[packet]
        cast_packet(intersect, scene, origin, rays[packet], 1.0e9, hit_out[packet])

    return embree_rays


@wp.kernel(enable_backward=False)
def warp_rays(
    mesh: wp.uint64,
    origins: wp.array[wp.vec3],
    rays: wp.array2d[wp.vec3],
    hit_out: wp.array2d[Hit],
):
    packet, lane = wp.tid()
    query = wp.mesh_query_ray(mesh, origins[packet], rays[packet, lane], 1.0e9)
    hit = Hit()
    hit.face = wp.where(query.result, query.face, -1)
    hit.t = query.t
    hit.u = query.u
    hit.v = query.v
    hit.normal = query.normal
    hit_out[packet, lane] = hit


def columns(hits):
    """Return face, t, u, v, normal."""
    return [hits.numpy()[name] for name in ("face", "t", "u", "v", "normal")]


def cast(tree, origins, rays, width, scene=None):
    """Cast 16 rays from each origin; return face, t, u, v, normal."""
    got = wp.empty((len(origins), 16), dtype=Hit, device="cpu")
    wp.launch(
        make_embree_kernel(width),
        dim=len(origins),
        inputs=[
            tree.intersect,
            scene or tree.scene,
            wp.array(origins, dtype=wp.vec3, device="cpu"),
            wp.array(rays, dtype=wp.vec3, device="cpu"),
        ],
        outputs=[got],
        device="cpu",
    )
    return columns(got)


def cast_by_warp(vertices, faces, origins, rays):
    mesh = wp.Mesh(
        wp.array(vertices, dtype=wp.vec3, device="cpu"), wp.array(faces.reshape(-1), dtype=int, device="cpu")
    )
    got = wp.empty((len(origins), 16), dtype=Hit, device="cpu")
    wp.launch(
        warp_rays,
        dim=(len(origins), 16),
        inputs=[
            mesh.id,
            wp.array(origins, dtype=wp.vec3, device="cpu"),
            wp.array(rays, dtype=wp.vec3, device="cpu"),
        ],
        outputs=[got],
        device="cpu",
    )
    return columns(got)


def unit(x):
    return (x / np.linalg.norm(x, axis=-1, keepdims=True)).astype(np.float32)


def assert_agree(vertices, faces, origins, rays, width):
    """Same face, or the same distance: then the ray meets an edge, or faces that lie in each other."""
    face, t, u, v, normal = cast(EmbreeTree(vertices, faces), origins, rays, width)
    face_w, t_w, _, _, normal_w = cast_by_warp(vertices, faces, origins, rays)
    hit = (face >= 0) & (face_w >= 0)
    assert hit.sum() > 1000
    # Rays by the outer edge of a triangle that one of them takes and the other not: a few in a million.
    other = (face != face_w) & ~(hit & np.isclose(t, t_w, rtol=1e-5))
    assert other.sum() <= 3e-5 * face.size + 1
    same = hit & (face == face_w)
    np.testing.assert_allclose(t[same], t_w[same], rtol=1e-5, atol=1e-5)
    corners = vertices[faces[face[same]]].astype(np.float64)
    weights = np.stack([u[same], v[same], 1.0 - u[same] - v[same]], axis=-1)
    along = np.repeat(origins[:, None], 16, axis=1)[same] + t[same][:, None] * rays[same].astype(np.float64)
    front = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    exact = unit(front)
    cosine = np.abs(np.einsum("nc,nc->n", rays[same], exact))
    miss = np.linalg.norm((weights[..., None] * corners).sum(axis=1) - along, axis=-1)
    # Weights are rounded at the distance over the height of the triangle, t / h; that moves the point along
    # its longest side, l: eps t l / h, with l / h = l^2 / (2 area).
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1).max(axis=1)
    slender = longest**2 / np.linalg.norm(front, axis=-1)
    assert (miss * cosine < 2e-7 * (t[same] * slender + np.abs(vertices).max())).all()
    # Both front; edges of the smallest triangles have some 12 bits left after the origin is taken away.
    assert np.einsum("nc,nc->n", unit(normal[same]), exact).min() > 0.999
    assert np.einsum("nc,nc->n", normal_w[same], exact).min() > 0.999


def test_agrees_with_warp_on_loose_triangles(width):
    rng = np.random.default_rng(0)
    centre = rng.uniform(-5.0, 5.0, (3000, 1, 3))
    vertices = (centre + rng.normal(0.0, 0.3, (3000, 3, 3))).reshape(-1, 3).astype(np.float32)
    faces = np.arange(9000, dtype=np.int32).reshape(-1, 3)
    origins = rng.uniform(-6.0, 6.0, (3000, 3)).astype(np.float32)
    rays = unit(rng.normal(size=(3000, 16, 3)))
    assert_agree(vertices, faces, origins, rays, width)


def views(mesh, count):
    """Return eye points in a scene and packets of neighbouring rays."""
    rng = np.random.default_rng(1)
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    origins = (low + (high - low) * rng.uniform(0.2, 0.8, (count, 3))).astype(np.float32)
    middle = rng.normal(size=(count, 1, 3))
    return origins, unit(unit(middle) + rng.normal(0.0, 0.01, (count, 16, 3)))


def test_agrees_with_warp_in_the_apartment(width):
    mesh = refine(make_apartment(ApartmentConfig()), 0.5)
    assert_agree(mesh.vertices, mesh.faces, *views(mesh, 5000), width)


def test_the_quick_tree_sees_what_the_other_sees(width):
    """All but the rays by an edge, which one of them takes and the other not."""
    mesh = refine(make_apartment(ApartmentConfig()), 0.5)
    tree = EmbreeTree(mesh.vertices, mesh.faces, quick=True)
    origins, rays = views(mesh, 5000)
    face, t, *_ = cast(tree, origins, rays, width)
    quick_face, quick_t, *_ = cast(tree, origins, rays, width, tree.quick)
    assert (face >= 0).mean() > 0.9
    other = (face != quick_face) & ~np.isclose(t, quick_t, rtol=1e-5)
    assert other.sum() <= 1e-4 * face.size
    assert EmbreeTree(mesh.vertices, mesh.faces).quick == 0


def test_agrees_with_warp_in_the_house(width, house):
    mesh = refine(load_mesh_scene(MeshSceneConfig(file=house)), 0.5)
    assert_agree(mesh.vertices, mesh.faces, *views(mesh, 5000), width)


@pytest.mark.parametrize("shape", ["sphere", "box"])
@pytest.mark.parametrize("aim", ["edges", "vertices"])
def test_closed_surfaces_hold(width, shape, aim):
    """A million rays from inside at points of edges and at vertices, as exactly as float32 aims.

    None goes through an edge. Where six triangles meet, rounding leaves a hole of the last bit in Embree as
    in Warp; Embree's is the smaller one.
    """
    rng = np.random.default_rng(2)
    if shape == "sphere":
        ball = trimesh.creation.icosphere(subdivisions=4)
    else:
        ball = trimesh.creation.box((2.0, 2.0, 2.0))
        for _ in range(4):
            ball = ball.subdivide()
    centre = np.array([0.3, -0.7, 0.2])
    vertices = (ball.vertices @ Rotation.random(random_state=0).as_matrix().T + centre).astype(np.float32)
    faces = ball.faces.astype(np.int32)
    count = 62_500
    origins = (rng.uniform(-0.5, 0.5, (count, 3)) + centre).astype(np.float32)
    first, second = np.moveaxis(
        ball.edges_unique[rng.integers(0, len(ball.edges_unique), (count, 16))], -1, 0
    )
    share = rng.uniform(0.01, 0.99, (count, 16, 1)) if aim == "edges" else np.zeros((count, 16, 1))
    to_target = (1.0 - share) * vertices[first] + share * vertices[second] - origins[:, None]
    face, t, _, _, _ = cast(EmbreeTree(vertices, faces), origins, unit(to_target), width)
    if aim == "edges":
        assert (face >= 0).all()
    else:
        by_warp = cast_by_warp(vertices, faces, origins, unit(to_target))[0]
        assert (face < 0).sum() < (by_warp < 0).sum() < 0.01 * face.size
    held = face >= 0
    np.testing.assert_allclose(t[held], np.linalg.norm(to_target, axis=-1)[held], rtol=2e-6)


def room():
    tilt = tuple((Rotation.from_euler("xyz", (0.5, 0.1, 0.3)) * Rotation.from_quat(LOOK_DOWN)).as_quat())
    scene = scene_of(
        plane(6.0), box((1.0, 1.0, 1.0), (0.5, 0.3, 0.5)), box((0.3, 0.3, 0.3), (-1.0, 0.0, 1.5))
    )
    return scene, [((0.1 * k, 1.2, 3.0 - 0.1 * k), tilt) for k in range(3)]


@pytest.mark.parametrize("samples", [1, 4])
def test_pictures_are_those_of_warp(width, samples):
    scene, poses = room()
    by = {}
    for traversal in ("embree", "warp"):
        config = RenderConfig(
            lighting=UNSHADOWED.lighting, exposure=1.0, samples_per_pixel=samples, cpu_traversal=traversal
        )
        arrays = upload_scene(scene, config, "cpu")
        assert arrays.terms.embree == (width if traversal == "embree" else 0)
        by[traversal] = render(arrays, LENS, poses, outputs=OUTPUTS)
    sky = by["warp"]["instance"] < 0
    assert sky.any()
    assert not sky.all()
    np.testing.assert_array_equal(by["embree"]["instance"], by["warp"]["instance"])
    np.testing.assert_allclose(by["embree"]["depth"], by["warp"]["depth"], rtol=1e-5)
    np.testing.assert_allclose(by["embree"]["normal"], by["warp"]["normal"], atol=1e-6)
    np.testing.assert_allclose(by["embree"]["log_radiance"], by["warp"]["log_radiance"], atol=2e-5)
    assert np.abs(by["embree"]["rgb"].astype(int) - by["warp"]["rgb"]).max() <= 1


def test_a_tree_built_again_gives_the_same_bits(width):
    scene = make_apartment(ApartmentConfig())
    origins, rays = views(scene, 2000)
    first = cast(EmbreeTree(scene.vertices, scene.faces), origins, rays, width)
    again = cast(EmbreeTree(scene.vertices, scene.faces), origins, rays, width)
    for a, b in zip(first, again, strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("narrow", [8, 4])
def test_narrower_packets_give_the_same_hits(width, narrow):
    """So that other processors are right, and no ray is led by its neighbours."""
    if narrow >= width:
        pytest.skip("as wide as this processor's")
    scene = make_apartment(ApartmentConfig())
    origins, rays = views(scene, 2000)
    tree = EmbreeTree(scene.vertices, scene.faces)
    wide = cast(tree, origins, rays, width)
    files = importlib.metadata.files("embreex") or ()
    (library,) = (str(f.locate()) for f in files if f.name.startswith(("libembree4", "embree4")))
    function = getattr(ctypes.CDLL(library), f"rtcIntersect{narrow}")
    tree.intersect = ctypes.cast(function, ctypes.c_void_p).value
    again = cast(tree, origins, rays, narrow)
    np.testing.assert_array_equal(again[0] >= 0, wide[0] >= 0)
    np.testing.assert_allclose(again[1], wide[1], rtol=1e-6)


def test_the_tree_is_freed(width):
    """Its memory serves the next ones."""

    def resident_bytes():
        return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()

    count = 50_000
    vertices = np.random.default_rng(0).normal(size=(3 * count, 3)).astype(np.float32)
    faces = np.arange(3 * count, dtype=np.int32).reshape(-1, 3)
    used = []
    for _ in range(12):
        before = resident_bytes()
        tree = EmbreeTree(vertices, faces)
        assert tree.scene
        del tree
        used.append(resident_bytes() - before)
    assert sum(used[2:]) < 2 * vertices.nbytes


def forget(monkeypatch):
    """Let the library be looked for again, for the time of a test.

    A second device in a process would have Embree start threads, one of which may never rest.
    """
    monkeypatch.setattr(embree, "_library", functools.cache(embree._Library))


def test_without_embree_warp_casts_the_rays(monkeypatch, caplog):
    def missing(name):
        raise importlib.metadata.PackageNotFoundError(name)

    forget(monkeypatch)
    monkeypatch.setattr(importlib.metadata, "files", missing)
    scene, poses = room()
    lighting = LightingConfig(mode="unshadowed")
    with pytest.raises(
        EmbreeError, match="cpu_traversal is 'embree', but the package embreex is not installed"
    ):
        upload_scene(scene, RenderConfig(lighting=lighting, exposure=1.0, cpu_traversal="embree"), "cpu")
    with caplog.at_level(logging.INFO, logger="neurosim_core"):
        arrays = upload_scene(scene, RenderConfig(lighting=lighting, exposure=1.0), "cpu")
    assert "embreex is not installed" in caplog.text
    assert arrays.terms.embree == 0
    assert np.isfinite(render(arrays, LENS, poses, outputs=("depth",))["depth"]).any()


def test_an_old_embreex_is_refused(monkeypatch):
    forget(monkeypatch)
    monkeypatch.setattr(importlib.metadata, "files", lambda name: [])
    with pytest.raises(EmbreeError, match="carries no Embree 4"):
        packet_width()


def test_a_camera_in_the_plane_of_a_surface_sees_past_it(width):
    """As it would from either side of the plane, but for what is nearer than rounding."""
    scene = scene_of(plane(8.0), plane(8.0, 2.0), plane(8.0, 2.0, flipped=True))
    seen = render(scene, LENS, [((0.3, 0.1, 2.0), LOOK_DOWN)], outputs=("depth",))
    np.testing.assert_allclose(seen["depth"], 2.0, rtol=1e-6)
