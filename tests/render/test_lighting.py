"""Light against closed forms, and the refinement that carries it."""

from __future__ import annotations

import dataclasses
from collections import Counter

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from render_scenes import DARK, box, plane, point_light, scene_of

from neurosim_core.render.config import LightingConfig
from neurosim_core.render.lighting import bake_light
from neurosim_core.render.refine import refine
from neurosim_core.scene.scene import Ambient, Material

AMBIENT = Ambient(up=(0.4, 0.5, 0.6), down=(0.1, 0.2, 0.3))


def bake(scene, device, edge_max_m=0.5, **config):
    mesh = refine(scene, edge_max_m)
    light = bake_light(scene, mesh, LightingConfig(**config), device=device)
    return mesh, light


def edges_of(vertices, faces):
    """Count how many faces use each edge, by position."""
    place = {}
    ids = np.array([place.setdefault(tuple(v), len(place)) for v in vertices.tolist()])[faces]
    sides = np.sort(np.stack([ids, np.roll(ids, -1, axis=1)], axis=-1).reshape(-1, 2), axis=1)
    return Counter(map(tuple, sides.tolist()))


def areas(vertices, faces):
    tips = vertices[faces].astype(float)
    return 0.5 * np.linalg.norm(np.cross(tips[:, 1] - tips[:, 0], tips[:, 2] - tips[:, 0]), axis=1)


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**16), edge_max_m=st.floats(0.15, 1.5))
def test_refinement_has_no_cracks_and_keeps_area(seed, edge_max_m):
    """A closed surface stays closed: every edge is shared by two faces, whose vertices are their own."""
    rng = np.random.default_rng(seed)
    hull = trimesh.convex.convex_hull(rng.normal(size=(12, 3)) * (1.0, 0.3, 0.7))
    scene = scene_of(hull)
    mesh = refine(scene, edge_max_m)
    assert set(edges_of(mesh.vertices, mesh.faces).values()) == {2}
    tips = mesh.vertices[mesh.faces]
    assert np.linalg.norm(np.roll(tips, -1, axis=1) - tips, axis=2).max() <= edge_max_m * (1.0 + 1e-6)
    part_area = np.bincount(mesh.origin, areas(mesh.vertices, mesh.faces), minlength=len(scene.faces))
    # middles are rounded to float32: 1e-7 of a metre per edge of a sliver
    np.testing.assert_allclose(part_area, areas(scene.vertices, scene.faces), atol=2e-6)


def test_refinement_interpolates_what_vertices_carry():
    scene = scene_of(plane(4.0), uv=plane(4.0).triangles.reshape(-1, 3)[:, :2] * 0.25)
    mesh = refine(scene, 0.6)
    np.testing.assert_allclose(mesh.uv, mesh.vertices[:, :2] * 0.25, atol=1e-6)
    assert (mesh.normals == (0.0, 0.0, 1.0)).all()
    assert (np.diff(mesh.origin) >= 0).all()
    assert set(mesh.origin) == {0, 1}
    front = np.cross(*np.moveaxis(np.diff(mesh.vertices[mesh.faces], axis=1), 1, 0))
    assert (front[:, 2] > 0.0).all()


def test_short_edges_and_no_limit_leave_faces_alone():
    scene = scene_of(box((1.0, 1.0, 1.0), (0.0, 0.0, 0.0)))
    for limit in (None, 2.0):
        np.testing.assert_array_equal(refine(scene, limit).faces, scene.faces)


def test_refinement_of_a_huge_scene_is_bounded_and_says_so(caplog):
    """Two triangles of 1 km at edges of 0.5 m were 17 million."""
    scene = scene_of(plane(1000.0))
    mesh = refine(scene, 0.5, added_count_max=50_000)
    assert 25_000 / 2 < len(mesh.faces) <= 50_002  # the next shorter edge would have been too many
    assert areas(mesh.vertices, mesh.faces).sum() == pytest.approx(1e6, rel=1e-6)
    assert "edges of up to" in caplog.text
    assert "instead of 0.5 m (render.lighting.edge_max_m)" in caplog.text
    caplog.clear()
    assert len(refine(scene_of(plane(4.0)), 0.5, added_count_max=50_000).faces) < 600
    assert not caplog.text


def test_embree_bakes_the_same_light():
    """A lamp in a room with a box that shades: to rounding but where a ray grazes an edge."""
    pytest.importorskip("embreex")
    room = trimesh.util.concatenate(
        [box((4.0, 3.0, 2.5), (0.0, 0.0, 0.0)), box((0.7, 0.6, 0.9), (0.4, 0.3, -0.7))]
    )
    scene = dataclasses.replace(scene_of(room), lights=(point_light((0.3, -0.2, 1.0), 3.0),), ambient=AMBIENT)
    mesh = refine(scene, 0.4)
    by_warp = bake_light(scene, mesh, LightingConfig(), device="cpu")
    by_embree = bake_light(scene, mesh, LightingConfig(), device="cpu", embree=True)
    assert by_warp.max() > 4.0 * by_warp.mean()
    agrees = np.isclose(by_embree, by_warp, rtol=1e-4, atol=1e-6)
    assert agrees.mean() > 0.995


@pytest.mark.parametrize("flipped", [False, True])
def test_open_surface_gets_the_ambient_of_its_normal(device, flipped):
    """No occluders: up * (1 + n_z) / 2 + down * (1 - n_z) / 2 on each side, whichever way faces are wound."""
    scene = scene_of(plane(2.0, flipped=flipped), ambient=AMBIENT)
    _, light = bake(scene, device)
    up, down = light[1 if flipped else 0], light[0 if flipped else 1]
    np.testing.assert_allclose(up, np.broadcast_to(AMBIENT.up, up.shape), rtol=1e-6)
    np.testing.assert_allclose(down, np.broadcast_to(AMBIENT.down, down.shape), rtol=1e-6)


def test_point_light_without_occluder(device):
    """Light is intensity * cos / d^2 with cos = h / d, and nothing on the far side."""
    scene = scene_of(plane(4.0), ambient=DARK, lights=(point_light((0.3, -0.2, 1.5), 2.0),))
    mesh, light = bake(scene, device)
    corner = mesh.vertices[mesh.faces].astype(float)
    distance = np.linalg.norm(corner - (0.3, -0.2, 1.5), axis=-1)
    np.testing.assert_allclose(light[0], np.repeat((2.0 * 1.5 / distance**3)[..., None], 3, 2), rtol=1e-5)
    assert (light[1] == 0.0).all()


def test_box_throws_a_shadow(device):
    """A 1 m box 1 m below the light and 1 m above the floor shades 2 m of it: zero inside, full outside."""
    scene = scene_of(
        plane(8.0),
        box((1.0, 1.0, 0.01), (0.0, 0.0, 1.0)),
        ambient=DARK,
        lights=(point_light((0.0, 0.0, 2.0), 1.0),),
    )
    mesh, light = bake(scene, device, edge_max_m=0.2, light_radius_m=0.1, shadow_ray_count=16)
    on_floor = mesh.origin < 2
    corner = mesh.vertices[mesh.faces][on_floor].astype(float)
    got = light[0, on_floor, :, 0]
    reach = np.abs(corner[..., :2]).max(axis=-1)
    unshaded = 2.0 / np.linalg.norm(corner - (0.0, 0.0, 2.0), axis=-1) ** 3
    # The penumbra of a ball of 0.1 m at equal distances is 0.1 m to each side; points sit up to
    # 0.7 of the way to the middle of a face, 0.1 m.
    inside, outside = reach < 1.0 - 0.2, reach > 1.0 + 0.2
    assert inside.sum() > 50
    assert (got[inside] == 0.0).all()
    np.testing.assert_allclose(got[outside], unshaded[outside], rtol=1e-5)


def test_emitting_faces_cast_no_shadow(device):
    """A lamp's shade that emits lets the light inside it out."""
    lamp = Material(name="lamp", emission=(1.0, 1.0, 1.0))
    scene = scene_of(
        plane(2.0),
        box((0.2, 0.2, 0.2), (0.0, 0.0, 1.0)),
        materials=(Material(name="floor"), lamp),
        part_material=(0, 1),
        ambient=DARK,
        lights=(point_light((0.0, 0.0, 1.0), 1.0),),
    )
    mesh, light = bake(scene, device)
    floor = mesh.vertices[mesh.faces][mesh.origin < 2].astype(float)
    expected = 1.0 / np.linalg.norm(floor - (0.0, 0.0, 1.0), axis=-1) ** 3
    np.testing.assert_allclose(light[0, mesh.origin < 2, :, 0], expected, rtol=1e-5)


def test_ambient_occlusion_of_a_parallel_ceiling(device):
    """A plane at height h over a wide floor: rays at the angle a hit at t = h / cos(a).

    With cosine weights cos^2 is uniform in [0, 1], so of 1 - (1 - t / R)^2 the mean is
    h^2 / R^2 + integral over s from h^2 / R^2 to 1 of (2 q - q^2), q = h / (R sqrt(s)).
    """
    h, radius = 0.5, 1.0
    scene = scene_of(plane(40.0), plane(40.0, h), ambient=AMBIENT)
    mesh, light = bake(
        scene, device, edge_max_m=2.0, ambient_ray_count=1024, ambient_radius_m=radius, interreflection=0.0
    )
    q0 = h / radius
    openness = q0**2 + 2.0 * q0 * 2.0 * (1.0 - q0) - q0**2 * np.log(1.0 / q0**2)
    tips = mesh.vertices[mesh.faces]
    inner = (np.abs(tips[..., :2]).max(axis=(1, 2)) < 15.0) & (mesh.origin < 2)
    got = light[0, inner] / AMBIENT.up
    # 1024 directions and an origin 1 mm off the floor (0.2 % of h)
    np.testing.assert_allclose(got, openness, rtol=5e-3)
    _, brighter = bake(
        scene, device, edge_max_m=2.0, ambient_ray_count=1024, ambient_radius_m=radius, interreflection=0.5
    )
    expected = openness / (1.0 - 0.5 * (1.0 - openness))
    np.testing.assert_allclose(brighter[0, inner] / AMBIENT.up, expected, rtol=5e-3)


def test_corner_of_a_room_is_not_black(device):
    """Where floor and wall meet, half of the directions are open: darker than the middle, far from black."""
    scene = scene_of(plane(2.0), box((0.01, 2.0, 2.0), (1.0, 0.0, 1.0)), ambient=AMBIENT)
    mesh, light = bake(scene, device, interreflection=0.0)
    corner = mesh.vertices[mesh.faces]
    on_floor = (mesh.origin < 2)[:, None] & (np.abs(corner[..., 1]) < 0.6)
    foot = light[0][on_floor & (corner[..., 0] > 0.99)] / AMBIENT.up
    assert len(foot) > 0
    assert (foot > 0.4).all()
    assert (foot < 0.75).all()


def test_floor_under_a_carpet_does_not_darken_the_floor_beside_it(device):
    half_m = 0.9
    scene = scene_of(plane(4.0), plane(2.0 * half_m, 0.005), ambient=AMBIENT)
    mesh, light = bake(scene, device)  # corners are 0.5 m apart
    floor = light[0, mesh.origin < 2]
    reach = np.abs(mesh.vertices[mesh.faces][mesh.origin < 2][..., :2]).max(axis=-1)
    across_the_rim = (reach.max(axis=1) > half_m) & (reach.min(axis=1) < half_m)
    assert across_the_rim.any()
    # Part of what lies around their open corners is under the carpet; buried ones alone have less than 0.02.
    assert (floor[across_the_rim] / AMBIENT.up > 0.3).all()


def test_coincident_corners_share_one_value(device):
    """A sphere with vertices split per face but smooth normals is lit without seams."""
    sphere = trimesh.creation.icosphere(subdivisions=2)
    flat = scene_of(sphere, ambient=AMBIENT, lights=(point_light((2.0, 1.0, 2.0), 1.0),))
    scene = dataclasses.replace(flat, normals=flat.vertices)  # of a unit sphere
    mesh, light = bake(scene, device, edge_max_m=5.0)
    values = {}
    for place, value in zip(
        mesh.vertices[mesh.faces].reshape(-1, 3).tolist(), light[0].reshape(-1, 3), strict=True
    ):
        values.setdefault(tuple(np.round(place, 4)), []).append(value)
    assert all((np.array(v) == v[0]).all() for v in values.values())


def test_baking_twice_gives_the_same_bits(device):
    scene = scene_of(
        plane(3.0), box((1.0, 1.0, 1.0), (0.0, 0.0, 0.5)), lights=(point_light((1.0, 1.0, 2.0), 1.0),)
    )
    np.testing.assert_array_equal(bake(scene, device)[1], bake(scene, device)[1])
