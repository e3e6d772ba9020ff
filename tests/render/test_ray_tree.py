"""Rays that walk through their tree, against every triangle tested by itself and against Warp's own walk."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
import warp as wp
from render_scenes import UNSHADOWED, plane, scene_of

from neurosim_core.render.kernel_data import RayTree
from neurosim_core.render.ray_intersection import UNFUSED, intersect_face
from neurosim_core.render.ray_tree import intersect_tree, make_ray_tree
from neurosim_core.render.scene_arrays import upload_scene

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
    met = intersect_tree(tree, origin[k], ray[k], far_m)
    ours_out[k] = wp.vec3(met[0], met[1], met[2])
    our_face_out[k] = wp.cast(met[3], int)
    query = wp.mesh_query_ray(mesh, origin[k], ray[k], far_m)
    their_face_out[k] = wp.where(query.result, query.face, -1)
    theirs_out[k] = wp.vec3(query.t, query.u, query.v)


@wp.kernel(module="unique", enable_backward=False, module_options=UNFUSED)
def every_triangle(
    mesh: wp.uint64,
    face_count: int,
    origin: wp.array[wp.vec3],
    ray: wp.array[wp.vec3],
    met_out: wp.array[wp.vec3],
    face_out: wp.array[int],
):
    k = wp.tid()
    nearest = wp.vec3(1.0e9, 0.0, 0.0)
    nearest_face = int(-1)  # noqa: UP018, RUF046
    for face in range(face_count):
        met = intersect_face(mesh, face, origin[k], ray[k])
        if met[0] >= 0.0 and met[0] < nearest[0]:
            nearest = met
            nearest_face = face
    met_out[k] = nearest
    face_out[k] = nearest_face


def mesh_of(triangles, device, leaf_size=1):
    corners = np.asarray(triangles, dtype=np.float32).reshape(-1, 3)
    return wp.Mesh(
        wp.array(corners, dtype=wp.vec3, device=device),
        wp.array(np.arange(len(corners)), dtype=int, device=device),
        bvh_constructor="sah",
        bvh_leaf_size=leaf_size,
    )


def upload(mesh, origins, rays):
    """Return origins and directions of rays, of unit length, on the device of a mesh."""
    origins = np.broadcast_to(np.asarray(origins, dtype=np.float32), np.shape(rays))
    rays = (np.asarray(rays) / np.linalg.norm(rays, axis=-1, keepdims=True)).astype(np.float32)
    return [wp.array(x, dtype=wp.vec3, device=mesh.device) for x in (origins, rays)]


def nearest_of_all(mesh, origins, rays):
    """Return where rays hit, (t, u, v) and the face: of all triangles the nearest, the first of equals."""
    met = wp.zeros(len(rays), dtype=wp.vec3, device=mesh.device)
    face = wp.zeros(len(rays), dtype=int, device=mesh.device)
    inputs = [mesh.id, mesh.indices.shape[0] // 3, *upload(mesh, origins, rays)]
    wp.launch(every_triangle, dim=len(rays), inputs=inputs, outputs=[met, face], device=mesh.device)
    return met.numpy(), face.numpy()


def cast(mesh, origins, rays, far_m=FAR):
    """Return where rays hit, (t, u, v) and the face, by our walk and by Warp's."""
    device, count = mesh.device, len(rays)
    found = [wp.zeros(count, dtype=dtype, device=device) for dtype in (wp.vec3, int, wp.vec3, int)]
    seen = upload(mesh, origins, rays)
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


@pytest.mark.parametrize("leaf_size", [1, 4])
def test_the_nearest_of_all_triangles(device, leaf_size):
    rng = np.random.default_rng(10)
    mesh = mesh_of(np.concatenate([soup(1500, 11), soup(100, 12, size=1.0)]), device, leaf_size)
    rays, origins = rng.normal(size=(4000, 3)), rng.uniform(-1.5, 1.5, (4000, 3))
    expected, expected_face = nearest_of_all(mesh, origins, rays)
    ours, face, _, _ = cast(mesh, origins, rays)
    np.testing.assert_array_equal(face, expected_face)
    np.testing.assert_array_equal(ours, expected)
    assert (face >= 0).sum() > 3000


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
    np.testing.assert_array_equal(hit, their_face >= 0)
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
    for far_m, ray, expected in ((3.1, 1.0, 0), (3.0, 1.0, -1), (2.9, 1.0, -1), (FAR, -1.0, -1)):
        _, face, _, _ = cast(mesh, np.zeros(3), [(0.0, 0.0, ray)], far_m)
        assert face.tolist() == [expected]


def test_rays_that_are_no_numbers_hit_nothing(device):
    rays = np.array([[np.nan, 0.0, 1.0], [np.inf, 0.0, 1.0]])
    with np.errstate(invalid="ignore"):
        _, face, _, _ = cast(mesh_of(soup(100, 6), device), np.zeros(3), rays)
    assert face.tolist() == [-1, -1]


def test_rays_along_the_sides_of_boxes(device):
    """A ray in the plane of a side of a box, exactly or nearly, meets what is in it."""
    square = [[(-1.0, -1.0, 0.0), (1.0, -1.0, 0.0), (1.0, 1.0, 0.0)],
              [(-1.0, -1.0, 0.0), (1.0, 1.0, 0.0), (-1.0, 1.0, 0.0)]]  # fmt: skip
    for offset in (np.zeros(3), np.array([1000.0, 5.0, 0.0]), np.array([-1.0, -1.0, 0.0])):
        mesh = mesh_of(np.array(square) + offset, device)
        starts = [(1.0, 0.3, 2.0), (-1.0, 0.3, 2.0), (0.3, 1.0, 2.0), (0.3, -1.0, 2.0), (1.0, 1.0, 2.0)]
        for tilt in (0.0, 1e-39, -1e-39, 1e-21):
            rays = np.tile([0.0, 0.0, -1.0], (len(starts), 1))
            rays[:, 0] = tilt
            found, face, _, _ = cast(mesh, np.array(starts) + offset, rays)
            expected, expected_face = nearest_of_all(mesh, np.array(starts) + offset, rays)
            np.testing.assert_array_equal(face, expected_face)  # a tilt may take it past the edge
            np.testing.assert_array_equal(found, expected)
            assert tilt != 0.0 or (face >= 0).all()


def test_a_step_seen_from_above_its_edge(device):
    """The upper plate ends where the lower one begins: the ray between them hits the upper one."""

    def plate(left, right, height):
        a, b, c, d = ((x, y, height) for x, y in ((left, 0.0), (right, 0.0), (right, 1.0), (left, 1.0)))
        return [[a, b, c], [a, c, d]]

    mesh = mesh_of(np.array([*plate(-0.5, 0.5, 0.0), *plate(0.5, 1.5, -1.0)]), device)
    found, face, _, _ = cast(mesh, (0.5, 0.3, 2.0), [(0.0, 0.0, -1.0)])
    assert face[0] in (0, 1)
    assert found[0, 0] == 2.0


def test_more_triangles_than_the_tree_has_levels_to_tell_apart(device):
    """Each half as large as the last: the tree is as deep as it gets, and its last leaf has the rest."""
    corners = np.array([(0.0, 0.0, 1.0), (1.0, 0.0, 1.0), (0.0, 1.0, 1.0)])
    sizes = 1e30 * 0.5 ** np.arange(200)
    mesh = mesh_of(sizes[:, None, None] * corners, device)
    last = make_ray_tree(mesh).triangles.numpy()[1::3, 3].view(np.int32)
    assert np.diff(np.flatnonzero(last), prepend=-1).max() > 10  # triangles of a leaf
    rng = np.random.default_rng(8)
    targets = sizes[rng.integers(200, size=2000), None] * corners.mean(axis=0)
    rays = targets / np.linalg.norm(targets, axis=1, keepdims=True) + 0.1 * rng.normal(size=(2000, 3))
    expected, expected_face = nearest_of_all(mesh, np.zeros(3), rays)
    ours, face, _, _ = cast(mesh, np.zeros(3), rays)
    np.testing.assert_array_equal(face, expected_face)
    np.testing.assert_array_equal(ours, expected)
    assert (face >= 0).sum() > 1000


def test_nothing_is_laid_out_that_embree_finds():
    arrays = upload_scene(
        scene_of(plane(1.0)), UNSHADOWED.model_copy(update={"cpu_traversal": "auto"}), "cpu"
    )
    if not arrays.terms.embree:
        pytest.skip("embreex is not installed")
    assert arrays.data.tree.nodes is None
    assert arrays.data.face_normal is None
