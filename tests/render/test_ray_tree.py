"""Rays that walk through their tree, against every triangle tested and against Warp's own walk."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
import warp as wp
from render_scenes import UNSHADOWED, plane, scene_of

from neurosim_core.render.ray_hit import UNFUSED
from neurosim_core.render.ray_tree import RayTree, make_ray_tree, walk_tree
from neurosim_core.render.warp_renderer import upload_scene

FAR = 1.0e9


@wp.kernel(module="unique", enable_backward=False, module_options=UNFUSED)
def walk_both(
    tree: RayTree,
    mesh: wp.uint64,
    origin: wp.array[wp.vec3],
    ray: wp.array[wp.vec3],
    far_m: float,
    ours_out: wp.array[wp.vec3],
    our_face_out: wp.array[int],
    theirs_out: wp.array[wp.vec3],
    their_face_out: wp.array[int],
):
    k = wp.tid()
    met = walk_tree(tree, origin[k], ray[k], far_m)
    ours_out[k] = wp.vec3(met[0], met[1], met[2])
    our_face_out[k] = wp.cast(met[3], int)
    query = wp.mesh_query_ray(mesh, origin[k], ray[k], far_m)
    their_face_out[k] = wp.where(query.result, query.face, -1)
    theirs_out[k] = wp.vec3(query.t, query.u, query.v)


def mesh_of(triangles, device, leaf_size=1):
    corners = np.asarray(triangles, dtype=np.float32).reshape(-1, 3)
    return wp.Mesh(
        wp.array(corners, dtype=wp.vec3, device=device),
        wp.array(np.arange(len(corners)), dtype=int, device=device),
        bvh_constructor="sah",
        bvh_leaf_size=leaf_size,
    )


def cast(mesh, origins, rays, far_m=FAR):
    """Return where rays hit, (t, u, v) and the face, by our walk and by Warp's."""
    origins = np.broadcast_to(np.asarray(origins, dtype=np.float32), np.shape(rays))
    rays = (np.asarray(rays) / np.linalg.norm(rays, axis=-1, keepdims=True)).astype(np.float32)
    device, count = mesh.device, len(rays)
    found = [wp.zeros(count, dtype=dtype, device=device) for dtype in (wp.vec3, int, wp.vec3, int)]
    seen = [wp.array(x, dtype=wp.vec3, device=device) for x in (origins, rays)]
    wp.launch(
        walk_both,
        dim=count,
        inputs=[make_ray_tree(mesh), mesh.id, *seen, far_m],
        outputs=found,
        device=device,
    )
    ours, our_face, theirs, their_face = (x.numpy() for x in found)
    return ours, our_face, theirs, their_face


def soup(count, seed, size=0.1):
    rng = np.random.default_rng(seed)
    return rng.uniform(-1.0, 1.0, (count, 1, 3)) + size * rng.normal(size=(count, 3, 3))


def assert_same(found):
    ours, our_face, theirs, their_face = found
    np.testing.assert_array_equal(our_face, their_face)
    hit = our_face >= 0
    np.testing.assert_array_equal(ours[hit], theirs[hit])
    return int(hit.sum())


@pytest.mark.parametrize("leaf_size", [1, 4, 9])
@pytest.mark.parametrize("count", [1, 2, 3, 2000])
def test_the_bits_of_warp(device, count, leaf_size):
    rng = np.random.default_rng(count)
    rays = rng.normal(size=(20_000, 3))
    rays[:2000, rng.integers(3)] = 0.0
    rays[2000:3000] = np.eye(3)[rng.integers(3, size=1000)] * rng.choice([-1.0, 1.0], (1000, 1))
    rays[3000:4000, 1] = 1e-30
    origins = rng.uniform(-1.5, 1.5, rays.shape)
    origins[4000:5000] += 1e3 * rng.normal(size=(1000, 3))
    size = 0.1 if count > 3 else 0.8
    assert assert_same(cast(mesh_of(soup(count, 1, size), device, leaf_size), origins, rays)) > 30


def test_the_first_of_those_in_one_place(device):
    """Whatever the order of the leaves is: Warp's own walk tells here one, there another."""
    triangles = np.repeat(soup(40, 2, size=0.5), 5, axis=0)
    order = np.random.default_rng(3).permutation(len(triangles))
    rays = np.random.default_rng(4).normal(size=(5000, 3))
    ours, face, _, their_face = cast(mesh_of(triangles[order], device), np.zeros(3), rays)
    hit = face >= 0
    assert hit.sum() > 1000
    first = np.array([np.flatnonzero(order // 5 == k // 5).min() for k in order])
    np.testing.assert_array_equal(face[hit], first[face[hit]])
    np.testing.assert_array_equal(face // 1 >= 0, their_face >= 0)
    again = cast(mesh_of(triangles[order], device, leaf_size=4), np.zeros(3), rays)
    np.testing.assert_array_equal(again[1], face)
    np.testing.assert_array_equal(again[0], ours)


def test_no_ray_slips_through_a_closed_surface(device):
    """Rays through the corners and along the edges of a ball, from inside, and between its vertices."""
    ball = trimesh.creation.icosphere(subdivisions=3)
    corners = np.asarray(ball.triangles)
    mesh = wp.Mesh(
        wp.array(ball.vertices, dtype=wp.vec3, device=device),
        wp.array(ball.faces.reshape(-1), dtype=int, device=device),
        bvh_constructor="sah",
        bvh_leaf_size=1,
    )
    share = np.random.default_rng(5).uniform(size=(20, len(corners), 1))
    along = share * corners[None, :, 0] + (1.0 - share) * corners[None, :, 1]
    targets = np.concatenate([corners.reshape(-1, 3), along.reshape(-1, 3)])
    for origin in (np.zeros(3), np.array([0.3, -0.2, 0.7]), np.array([0.0, 0.9, 0.0])):
        found, face, _, _ = cast(mesh, origin, targets - origin)
        assert (face >= 0).all()
        distance = np.linalg.norm(targets - origin, axis=1)
        np.testing.assert_allclose(found[:, 0], distance, atol=2e-6, rtol=2e-6)


def test_the_corners_of_boxes(device):
    """Flat boxes, and rays through their edges: a box whose sides meet in rounding alone is not passed by."""
    steps = np.linspace(-1.0, 1.0, 17)
    squares = [
        [[(x, y, 0.0), (x + 0.125, y, 0.0), (x + 0.125, y + 0.125, 0.0)],
         [(x, y, 0.0), (x + 0.125, y + 0.125, 0.0), (x, y + 0.125, 0.0)]]
        for x in steps[:-1] for y in steps[:-1]
    ]  # fmt: skip
    mesh = mesh_of(np.array(squares), device)
    x, y = (grid.reshape(-1) for grid in np.meshgrid(steps, steps))
    for origin in ((0.0, 0.0, 2.0), (0.1, 0.3, 1e-3), (7.0, -3.0, 0.5), (0.0, 0.125, 1.0)):
        rays = np.stack([x, y, 0.0 * x], axis=-1) * (1.0 - 1e-5) - origin
        _, face, _, _ = cast(mesh, origin, rays)
        assert (face >= 0).all()


def test_what_is_far_or_behind_is_not_hit(device):
    mesh = mesh_of([[(-1.0, -1.0, 3.0), (1.0, -1.0, 3.0), (0.0, 1.0, 3.0)]], device)
    for far_m, ray, expected in ((3.1, 1.0, 0), (2.9, 1.0, -1), (FAR, -1.0, -1)):
        _, face, _, _ = cast(mesh, np.zeros(3), [(0.0, 0.0, ray)], far_m)
        assert face.tolist() == [expected]


def test_rays_that_are_no_numbers_hit_nothing(device):
    rays = np.array([[np.nan, 0.0, 1.0], [np.inf, 0.0, 1.0]])
    with np.errstate(invalid="ignore"):
        _, face, _, _ = cast(mesh_of(soup(100, 6), device), np.zeros(3), rays)
    assert face.tolist() == [-1, -1]


def test_a_pile_deeper_than_the_tree_is_one_leaf(device):
    """More triangles in one place than the tree has levels to tell apart."""
    pile = np.repeat(soup(1, 7, size=1.0), 3000, axis=0) + np.linspace(0.0, 1e-12, 3000)[:, None, None]
    target = pile[0].mean(axis=0)
    _, face, _, _ = cast(mesh_of(pile, device), target + np.array([0.0, 0.0, 2.0]), [(0.0, 0.0, -1.0)])
    assert face.tolist() == [0]


def test_nothing_is_laid_out_that_embree_finds():
    arrays = upload_scene(
        scene_of(plane(1.0)), UNSHADOWED.model_copy(update={"cpu_traversal": "auto"}), "cpu"
    )
    if not arrays.terms.embree:
        pytest.skip("embreex is not installed")
    assert arrays.data.tree.nodes is None
    assert arrays.data.face_normal is None
