"""Free space against closed forms: rooms, spheres, solids, gaps."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import trimesh
import warp as wp
from hypothesis import example, given, settings
from hypothesis import strategies as st

from neurosim_core.scene import freespace
from neurosim_core.scene.freespace import FreeSpaceConfig, make_free_space
from neurosim_core.scene.scene import Scene


def as_scene(*meshes: trimesh.Trimesh, inside_m: tuple[float, float, float] | None = None) -> Scene:
    mesh = trimesh.util.concatenate(list(meshes))
    count = len(mesh.faces)
    return Scene(
        name="test",
        vertices=mesh.vertices.astype(np.float32),
        faces=mesh.faces.astype(np.int32),
        normals=np.zeros((len(mesh.vertices), 3), dtype=np.float32),
        uv=np.zeros((len(mesh.vertices), 2), dtype=np.float32),
        face_material=np.zeros(count, dtype=np.int32),
        face_instance=np.zeros(count, dtype=np.int32),
        instance_names=("all",),
        materials=(),
        inside_m=inside_m,
    )


def box(low: tuple[float, ...], high: tuple[float, ...]) -> trimesh.Trimesh:
    return trimesh.creation.box(bounds=[low, high])


ROOM = box((0.0, 0.0, 0.0), (4.0, 3.0, 2.5))


def grid(space: freespace.FreeSpace) -> np.ndarray:
    voxels = np.stack(np.unravel_index(np.arange(space.distance.size), space.distance.shape), axis=1)
    return space.centers(voxels)


def test_distance_in_a_room_is_that_to_the_nearest_wall(device):
    space = make_free_space(as_scene(ROOM), FreeSpaceConfig(), device)
    points = grid(space)
    expected = np.minimum(points, np.array([4.0, 3.0, 2.5]) - points).min(axis=1)
    assert space.distance.shape == (40, 30, 25)
    assert space.distance.reshape(-1) == pytest.approx(expected, abs=2e-6)  # float32 at 4 m
    assert space.clearance(points) == pytest.approx(expected, abs=2e-6)


def test_distance_around_a_sphere(device):
    """Outside an icosphere, between those of its inscribed and its circumscribed sphere."""
    ball = trimesh.creation.icosphere(subdivisions=4, radius=1.0)
    inner = float(np.einsum("fi,fi->f", ball.face_normals, ball.triangles[:, 0]).min())
    space = make_free_space(
        as_scene(box((-3, -3, -3), (3, 3, 3)), ball), FreeSpaceConfig(voxel_m=0.2), device
    )
    points = grid(space)
    to_wall = (3.0 - np.abs(points)).min(axis=1)
    radius = np.linalg.norm(points, axis=1)
    outside = radius > 1.0
    near = np.minimum(to_wall, radius - 1.0)[outside]
    far = np.minimum(to_wall, radius - inner)[outside]
    distance = space.distance.reshape(-1)[outside]
    assert (distance >= near - 2e-6).all()
    assert (distance <= far + 2e-6).all()
    assert inner > 0.998  # so the two differ by 2 mm at most


@pytest.fixture(scope="module")
def furnished() -> freespace.FreeSpace:
    sofa = box((1.0, 1.0, 0.0), (2.5, 2.0, 1.2))
    tilted = box((0.0, 0.0, 0.0), (0.5, 0.5, 0.5))
    tilted.apply_transform(trimesh.transformations.rotation_matrix(0.7, [1.0, 2.0, 3.0], [3.2, 2.2, 1.2]))
    tilted.apply_translation([2.9, 2.0, 1.0])
    return make_free_space(as_scene(ROOM, sofa, tilted), FreeSpaceConfig())


def brute_force(space: freespace.FreeSpace, points: np.ndarray) -> np.ndarray:
    """Distance to every triangle in NumPy: to its plane where the foot is inside, else to its edges."""
    triangles = space.mesh.points.numpy()[space.mesh.indices.numpy().reshape(-1, 3)].astype(np.float64)
    best = np.full(len(points), np.inf)
    for a, b, c in triangles:
        normal = np.cross(b - a, c - a)
        normal /= np.linalg.norm(normal)
        height = (points - a) @ normal
        foot = points - height[:, None] * normal
        inside = np.ones(len(points), dtype=bool)
        for p, q in ((a, b), (b, c), (c, a)):
            inside &= np.cross(q - p, foot - p) @ normal >= 0.0
            s = np.clip((points - p) @ (q - p) / ((q - p) @ (q - p)), 0.0, 1.0)
            best = np.minimum(best, np.linalg.norm(points - p - s[:, None] * (q - p), axis=1))
        best = np.where(inside, np.minimum(best, np.abs(height)), best)
    return best


def test_clearance_agrees_with_brute_force(furnished):
    points = np.random.default_rng(0).uniform([0.0, 0.0, 0.0], [4.0, 3.0, 2.5], size=(500, 3))
    assert furnished.clearance(points) == pytest.approx(brute_force(furnished, points), abs=2e-6)


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_the_grid_is_within_its_bound(furnished, seed):
    """Trilinear values differ from exact ones by at most voxel sqrt(sum u (1 - u)); also on the device."""
    rng = np.random.default_rng(seed)
    points = rng.uniform([0.06, 0.06, 0.06], [3.94, 2.94, 2.44], size=(200, 3))
    u = np.mod((points - furnished.origin_m) / furnished.voxel_m, 1.0)
    bound = furnished.voxel_m * np.sqrt((u * (1.0 - u)).sum(axis=1)) + 1e-5
    error = furnished.interpolated(points) - furnished.clearance(points)
    assert (np.abs(error) <= bound).all()
    sample = device_samples(furnished, points)
    assert sample[:, 0] == pytest.approx(furnished.interpolated(points), abs=5e-6)
    assert (np.abs(sample[:, 0] - furnished.clearance(points)) <= sample[:, 1]).all()


def device_samples(space: freespace.FreeSpace, points: np.ndarray) -> np.ndarray:
    out = wp.empty(len(points), dtype=wp.vec2, device=space.device)
    rows = wp.array(points.astype(np.float32), dtype=wp.vec3, device=space.device)
    wp.launch(_sample, dim=len(points), inputs=[space.arrays, rows, out], device=space.device)
    return out.numpy()


@wp.kernel(enable_backward=False, module="unique")
def _sample(field: freespace.DistanceField, points: wp.array[wp.vec3], sample_out: wp.array[wp.vec2]) -> None:
    sample = wp.tid()
    sample_out[sample] = freespace.sample_distance(field, points[sample])


@wp.kernel(enable_backward=False, module="unique")
def _room(
    field: freespace.DistanceField,
    radius_m: float,
    exact_below: float,
    position: wp.array[wp.vec3d],
    clearance_out: wp.array[float],
) -> None:
    sample = wp.tid()
    clearance_out[sample] = freespace.clearance_around(
        field, radius_m, exact_below, -wp.float64(wp.inf), position[sample]
    )


def test_room_around_is_exact_when_near(furnished):
    rng = np.random.default_rng(3)
    points = rng.uniform([-0.5, -0.5, -0.5], [4.5, 3.5, 3.0], size=(2000, 3))
    position = wp.array(points, dtype=wp.vec3d, device="cpu")
    clearance = wp.empty(2000, dtype=wp.float32, device="cpu")
    wp.launch(_room, 2000, inputs=[furnished.arrays, 0.2, 0.2 + furnished.voxel_m, position, clearance])
    exact = brute_force(furnished, points) - 0.2
    found = clearance.numpy()
    near = exact < furnished.voxel_m - 1e-5
    assert near.sum() > 200
    assert (~near).sum() > 200
    assert found[near] == pytest.approx(exact[near], abs=2e-6)
    assert (found[~near] <= exact[~near] + 2e-6).all()
    assert (found[~near] > furnished.voxel_m - 2e-5).all()


def test_a_closed_solid_is_never_entered(furnished):
    """The room around the sofa can be reached; its inside cannot, though it has as much room as asked."""
    inside, outside = furnished.voxel_of((1.75, 1.5, 0.6)), furnished.voxel_of((0.5, 0.5, 1.2))
    assert furnished.distance[inside] > 0.4
    for clearance_m in (0.0, 0.1, 0.3):
        reachable = furnished.reachable(clearance_m)
        assert reachable[outside]
        assert not reachable[inside]
        centers = furnished.centers(np.argwhere(reachable))
        assert (furnished.clearance(centers) >= clearance_m).all()
        in_sofa = ((centers > [1.0, 1.0, 0.0]) & (centers < [2.5, 2.0, 1.2])).all(axis=1)
        assert not in_sofa.any()


def test_neighbours_are_connected_by_clear_lines(furnished):
    """Of a thousand steps between neighbours, also diagonal ones, no point has less than asked."""
    reachable = furnished.reachable(0.25)
    here = np.argwhere(reachable)
    rng = np.random.default_rng(4)
    step = rng.integers(-1, 2, size=here.shape)
    there = here + step
    ok = reachable[tuple(there.T)]
    pick = rng.choice(np.flatnonzero(ok), size=1000)
    a, b = furnished.centers(here[pick]), furnished.centers(there[pick])
    for s in np.linspace(0.0, 1.0, 11):
        assert (furnished.clearance(a + s * (b - a)) >= 0.25).all()


def two_rooms(gap_m: float) -> Scene:
    """A wall at x = 4 with an opening of a given width from floor to ceiling."""
    low, high = 1.5 - 0.5 * gap_m, 1.5 + 0.5 * gap_m
    walls = (box((3.95, 0.0, 0.0), (4.05, low, 2.5)), box((3.95, high, 0.0), (4.05, 3.0, 2.5)))
    return as_scene(box((0.0, 0.0, 0.0), (8.0, 3.0, 2.5)), *walls, inside_m=(1.0, 1.0, 1.0))


def test_a_narrow_gap_is_open_to_small_and_closed_to_large():
    space = make_free_space(two_rooms(0.8), FreeSpaceConfig())
    behind = space.voxel_of((6.0, 1.5, 1.2))
    assert space.reachable(0.3)[behind]
    assert not space.reachable(0.45)[behind]  # 0.4 m is all there is in the middle of the gap
    assert space.reachable(0.45)[space.voxel_of((1.0, 1.5, 1.2))]


def test_the_seed_is_found_in_the_room_and_not_in_solids_or_outside():
    """A house on a larger ground: outside is larger, but open on some side; the cupboard is smaller."""
    ground = box((-6.0, -6.0, -0.2), (6.0, 6.0, -0.1))
    cupboard = box((1.0, 1.0, 0.0), (2.4, 2.4, 2.4))
    pillar = box((5.8, 5.8, 0.0), (6.0, 6.0, 2.9))
    space = make_free_space(as_scene(ROOM, ground, cupboard, pillar), FreeSpaceConfig())
    assert (space.seed_m > [0.0, 0.0, 0.0]).all()
    assert (space.seed_m < [4.0, 3.0, 2.5]).all()
    assert not ((space.seed_m > 1.0) & (space.seed_m < 2.4)).all()
    assert "floor below and walls on four sides" in space.notes[-1]
    reached = space.centers(np.argwhere(space.reachable(0.1)))
    assert (reached > 0.0).all()
    assert (reached < [4.0, 3.0, 2.5]).all()


def test_open_ground_has_free_space_above_it():
    rocks = [box((x, x, 0.0), (x + 1.0, x + 1.0, 2.0)) for x in (-4.0, 3.0)]
    space = make_free_space(as_scene(box((-5.0, -5.0, -0.1), (5.0, 5.0, 0.0)), *rocks), FreeSpaceConfig())
    assert "no room has walls" in space.notes[-1]
    assert space.reachable(0.3).any()


@pytest.mark.parametrize("axis", [0, 2], ids=["poster", "ground"])
def test_there_is_room_beside_a_flat_scene(axis):
    low, high = [-5.0] * 3, [5.0] * 3
    low[axis] = high[axis] = 0.0
    space = make_free_space(as_scene(box(tuple(low), tuple(high))), FreeSpaceConfig())
    beside = np.zeros(3)
    beside[axis] = 1.5
    assert space.clearance(beside[None])[0] == pytest.approx(1.5, abs=0.1)
    assert any("flat" in note for note in space.notes)
    with pytest.raises(ValueError, match="the scene has no free space"):
        make_free_space(as_scene(box((0.0, 0.0, 0.0), (0.15, 0.15, 0.15))), FreeSpaceConfig())


def test_the_seed_of_the_scene_and_of_the_configuration_win():
    scene = two_rooms(0.0)
    assert make_free_space(scene, FreeSpaceConfig()).seed_m == pytest.approx([1.0, 1.0, 1.0])
    space = make_free_space(scene, FreeSpaceConfig(seed_m=(7.0, 1.0, 1.0)))
    assert space.seed_m == pytest.approx([7.0, 1.0, 1.0])
    assert not space.reachable(0.2)[space.voxel_of((1.0, 1.0, 1.0))]
    with pytest.raises(ValueError, match=r"seed_m must be in free space, got \(4.0, 0.5, 1.0\)"):
        make_free_space(scene, FreeSpaceConfig(seed_m=(4.0, 0.5, 1.0)))
    with pytest.raises(ValueError, match="seed_m must be in free space"):
        make_free_space(scene, FreeSpaceConfig(seed_m=(40.0, 0.5, 1.0)))


def test_a_scene_that_is_wrong_about_its_inside_is_corrected():
    scene = as_scene(ROOM, inside_m=(0.0, 1.0, 1.0))
    space = make_free_space(scene, FreeSpaceConfig())
    assert space.clearance(space.seed_m)[0] > 1.0
    assert "names (0.0, 1.0, 1.0) as inside" in space.notes[0]


GRID_M = st.integers(-8000, 8000).map(lambda n: n * 0.05)  # sizes and places that people choose
ANYWHERE_M = GRID_M | st.floats(-2000.0, 2000.0)
LENGTH_M = st.integers(12, 40).map(lambda n: n * 0.2) | st.floats(2.4, 8.0)


@settings(max_examples=60, deadline=None)
@given(
    size=st.tuples(LENGTH_M, LENGTH_M, st.sampled_from([2.4, 2.5, 2.7, 3.0])),
    low=st.tuples(ANYWHERE_M, ANYWHERE_M, ANYWHERE_M),
    voxel_m=st.sampled_from([0.1, 0.13, 0.15, 0.2]),
    wall=st.floats(0.3, 0.7) | st.sampled_from([0.25, 0.5, 0.75]),
)
@example(size=(6.0, 5.0, 2.7), low=(0.0, 0.0, 0.0), voxel_m=0.1, wall=0.5)
def test_a_room_of_any_size_at_any_place_is_free_up_to_its_walls(size, low, voxel_m, wall):
    """A plain box: exactly the centres that keep the clearance are free; a sheet across it ends the room."""
    low, high = np.array(low), np.array(low) + size
    space = make_free_space(as_scene(box(low, high)), FreeSpaceConfig(voxel_m=voxel_m))
    centers = grid(space)
    spare = np.minimum(centers - low, high - centers).min(axis=1) - np.sqrt(0.2**2 + 0.75 * voxel_m**2)
    sure = np.abs(spare) > 2e-3  # float32 at 2 km: 0.12 mm a rounding
    assert (space.reachable(0.2).reshape(-1) == (spare > 0.0))[sure].all()

    sheet_m = low[0] + wall * size[0]
    corners = np.array([[sheet_m, y, z] for y in (low[1], high[1]) for z in (low[2], high[2])])
    sheet = trimesh.Trimesh(corners, [[0, 1, 2], [1, 3, 2]], process=False)
    seed = (float(low[0] + 0.5 * wall * size[0]), float(low[1]) + 1.2, float(low[2]) + 1.2)
    half = make_free_space(as_scene(box(low, high), sheet), FreeSpaceConfig(voxel_m=voxel_m, seed_m=seed))
    reached = half.centers(np.argwhere(half.reachable(0.0)))
    assert len(reached) > 0
    assert (reached[:, 0] < sheet_m).all()


def test_a_huge_scene_gets_coarser_voxels_and_says_so():
    scene = as_scene(box((0.0, 0.0, 0.0), (400.0, 300.0, 25.0)))
    space = make_free_space(scene, FreeSpaceConfig(voxel_count_max=10_000))
    assert space.distance.size <= 10_000
    assert "instead of 0.1 m" in space.notes[0]


def test_a_start_inside_a_solid_is_refused(furnished):
    furnished.check_start((0.5, 0.5, 1.2))
    furnished.check_start((-3.0, 0.0, 1.0))  # not in the scene at all: flights there are allowed
    with pytest.raises(ValueError, match=r"begins at \[1.75, 1.5, 0.6\] m, inside a solid of"):
        furnished.check_start((1.75, 1.5, 0.6))
    with pytest.raises(ValueError, match=r"m away from the scene.*subtract it here as well"):
        furnished.check_start((9000.0, -100.0, 1.0))  # in the coordinates of a map, say
    cut_off = make_free_space(two_rooms(0.0), FreeSpaceConfig())
    cut_off.check_start((6.0, 1.5, 1.2))  # another room of 30 m^3, behind a closed wall


def test_a_start_outside_of_a_closed_scene_is_refused():
    scene = as_scene(ROOM)
    closed = dataclasses.replace(scene, closed=True)
    outside = (-3.0, 0.0, 1.0)
    space = make_free_space(closed, FreeSpaceConfig())
    space.check_start((0.5, 0.5, 1.0))
    with pytest.raises(ValueError, match="outside of the rooms"):
        space.check_start(outside)
    make_free_space(scene, FreeSpaceConfig()).check_start(outside)
    make_free_space(closed, FreeSpaceConfig(seed_m=(1.0, 1.0, 1.0))).check_start(outside)


def test_outside_the_bounds_nothing_is_free(furnished):
    assert furnished.clearance([[-1.0, 1.0, 1.0], [2.0, 1.0, 9.0]]) == pytest.approx([-1.0, -6.5])


def test_height_above_what_is_below(furnished):
    over_sofa = furnished.height[furnished.voxel_of((1.75, 1.5, 1.9))]
    over_floor = furnished.height[furnished.voxel_of((0.5, 0.5, 1.9))]
    assert over_sofa == pytest.approx(0.7, abs=furnished.voxel_m)
    assert over_floor == pytest.approx(1.9, abs=furnished.voxel_m)
