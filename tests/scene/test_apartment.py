"""The generated apartment: geometry that is sound, rooms that can be flown through, textures that repeat."""

from __future__ import annotations

import functools
import itertools
import re

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from neurosim_core.scene.apartment import ApartmentConfig, make_apartment
from neurosim_core.scene.apartment.floorplan import make_floor_plan
from neurosim_core.scene.scene import Scene
from neurosim_core.scene.solids import Part, box, cushion, cylinder, lathe, tube
from neurosim_core.settings_file import ConfigError

FLATS = [(0, 1), (7, 4), (5, 8)]
SHELL = re.compile(
    r"(floor|ceiling|wall|baseboard|door_casing|doorway|window|view|outer_wall|roof|wall_top)_\d+"
)


@functools.cache
def flat(seed: int, rooms: int) -> Scene:
    return make_apartment(ApartmentConfig(seed=seed, rooms=rooms))


@pytest.fixture(params=FLATS, ids=lambda pair: f"seed{pair[0]}-rooms{pair[1]}")
def scene(request: pytest.FixtureRequest) -> Scene:
    return flat(*request.param)


def plan_of(scene: Scene):
    rooms, seed = (int(number) for number in re.findall(r"\d+", scene.name))
    return make_floor_plan(ApartmentConfig(seed=seed, rooms=rooms))


def corners(scene: Scene) -> NDArray[np.float64]:
    return scene.vertices.astype(np.float64)[scene.faces]


def instance_bounds(scene: Scene) -> dict[str, NDArray[np.float64]]:
    points = corners(scene).reshape(-1, 3)
    owner = np.repeat(scene.face_instance, 3)
    low, high = (
        np.full((len(scene.instance_names), 3), np.inf),
        np.full((len(scene.instance_names), 3), -np.inf),
    )
    np.minimum.at(low, owner, points)
    np.maximum.at(high, owner, points)
    return {name: np.stack([low[k], high[k]]) for k, name in enumerate(scene.instance_names)}


def samples(triangles: NDArray[np.float64], *, spacing_m: float) -> NDArray[np.float64]:
    """Points on all triangles, none further than `spacing_m` from every point of the surface."""
    a, u, v = triangles[:, 0], triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    longest = np.maximum.reduce([np.linalg.norm(edge, axis=1) for edge in (u, v, u - v)])
    steps = np.maximum(1, np.ceil(longest / spacing_m)).astype(int)
    points = []
    for count in np.unique(steps):
        s, t = (grid.reshape(-1) / count for grid in np.meshgrid(np.arange(count + 1), np.arange(count + 1)))
        inside = s + t <= 1.0 + 1e-9
        chosen = steps == count
        points.append(a[chosen, None] + s[inside, None] * u[chosen, None] + t[inside, None] * v[chosen, None])
    return np.concatenate([block.reshape(-1, 3) for block in points])


# ---------------------------------------------------------------------------------------------- solids


def volume(part: Part) -> float:
    """Divergence theorem: positive when faces wind outwards, exact for closed bodies."""
    a, b, c = (part.vertices[part.faces[:, k]] for k in range(3))
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6.0)


def rounded_volume(size: tuple[float, float, float], r: float) -> float:
    """Steiner formula: the Minkowski sum of a box and a ball."""
    a, b, c = (edge - 2.0 * r for edge in size)
    return (
        a * b * c + 2.0 * r * (a * b + b * c + c * a) + np.pi * r**2 * (a + b + c) + 4.0 / 3.0 * np.pi * r**3
    )


def polygon(sides: int) -> float:
    """Area of a regular polygon inscribed in the unit circle."""
    return 0.5 * sides * np.sin(2.0 * np.pi / sides)


@pytest.mark.parametrize(
    ("part", "expected", "tolerance"),
    [
        (box((0.3, 0.5, 0.7)), 0.105, 1e-12),
        (cylinder((0.2, 0.1, 0.6), sides=24), polygon(24) * 0.04 * 0.5, 1e-12),
        (lathe([(0.0, 0.0), (0.3, 0.0), (0.0, 0.4)], sides=36), polygon(36) * 0.09 * 0.4 / 3.0, 1e-12),
        (tube([(0, 0, 0), (0, 3, 4)], radius=0.1, sides=12), polygon(12) * 0.01 * 5.0, 1e-12),
        # Chords cut arcs: at 8 facets per half edge by less than (pi / 32)^2 / 6 = 0.2 %.
        (box((0.3, 0.5, 0.7), edge=0.05, segments=8), rounded_volume((0.3, 0.5, 0.7), 0.05), 2e-3),
        # An ellipsoid; the error of 12 * 24^2 chords is of the same order.
        (cushion((0.4, 0.6, 0.2), power=(2, 2, 2), segments=24), np.pi / 6.0 * 0.048, 5e-3),
    ],
    ids=["box", "cylinder", "cone", "tube", "rounded box", "ellipsoid"],
)
def test_solids_are_closed_and_wind_outwards(part: Part, expected: float, tolerance: float):
    assert volume(part) == pytest.approx(expected, rel=tolerance)
    shifted = part.moved((5.0, -3.0, 2.0))  # the volume of an open surface would depend on where it is
    assert volume(shifted) == pytest.approx(volume(part), rel=1e-9)


def test_turned_walls_stay_exactly_on_axis():
    part = box((1.0, 2.0, 3.0)).moved((0.1, 0.2, 0.3), yaw_rad=0.5 * np.pi)
    assert np.array_equal(np.unique(part.vertices[:, 0]), [0.1 - 1.0, 0.1 + 1.0])


# ---------------------------------------------------------------------------------------------- the scene


def test_same_seed_same_bytes_other_seed_other_flat():
    again = make_apartment(ApartmentConfig(seed=7, rooms=4))
    first, other = flat(7, 4), make_apartment(ApartmentConfig(seed=8, rooms=4))
    for name in ("vertices", "faces", "normals", "uv", "face_material", "face_instance"):
        assert getattr(first, name).tobytes() == getattr(again, name).tobytes(), name
    assert first.instance_names == again.instance_names
    assert first.lights == again.lights
    for left, right in zip(first.materials, again.materials, strict=True):
        assert (left.name, left.base_color, left.emission) == (right.name, right.base_color, right.emission)
        assert (left.texture is None) == (right.texture is None)
        if left.texture is not None and right.texture is not None:
            assert left.texture.srgb.tobytes() == right.texture.srgb.tobytes(), left.name
    assert not np.allclose(first.bounds_m, other.bounds_m)


def test_furniture_of_a_room_does_not_depend_on_density_of_nothing():
    """Less furniture asked for is less furniture, and never more than the whole."""
    empty = make_apartment(ApartmentConfig(seed=7, rooms=4, furniture=0.0))
    assert 10 < len(empty.instance_names) < len(flat(7, 4).instance_names)


def test_arrays_are_sound(scene: Scene):
    triangles = corners(scene)
    normal = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    area = 0.5 * np.linalg.norm(normal, axis=1)
    assert area.min() > 1e-9  # a triangle of 0.05 mm: float32 positions resolve 0.001 mm here
    assert np.isfinite(scene.uv).all()
    assert np.abs(scene.uv).max() < 1e3  # so that float32 still resolves a texel of 512
    assert np.linalg.norm(scene.normals, axis=1) == pytest.approx(1.0, abs=1e-5)  # float32 rounding
    side = np.einsum("ij,ikj->ik", normal / (2.0 * area[:, None]), scene.normals[scene.faces].astype(float))
    assert side.min() > -0.2  # shading normals lean over the edge of a coarse facet, but never to the back
    assert np.mean(side > 0.5) > 0.98
    assert scene.face_material.min() == 0
    assert scene.face_material.max() == len(scene.materials) - 1
    assert np.array_equal(np.unique(scene.face_instance), np.arange(len(scene.instance_names)))
    assert len(set(scene.instance_names)) == len(scene.instance_names)


def test_triangle_count(scene: Scene):
    assert 20_000 <= len(scene.faces) <= 50_000 + 15_000 * len(plan_of(scene).rooms)


@pytest.mark.parametrize("rooms", [2, 6])
def test_triangle_count_of_further_flats(rooms: int):
    count = len(make_apartment(ApartmentConfig(seed=10, rooms=rooms)).faces)
    assert 20_000 <= count <= 50_000 + 15_000 * rooms


def test_materials_are_physical(scene: Scene):
    for material in scene.materials:
        assert all(0.0 <= value <= 1.0 for value in material.base_color), material.name
        assert all(0.0 <= value < 4.0 for value in material.emission), material.name
        if material.texture is not None:
            srgb = material.texture.srgb
            assert srgb.dtype == np.uint8
            assert srgb.ndim == 3
            assert srgb.shape[2] == 3
            assert srgb.std() > 2.0, f"{material.name} has no structure that an event camera could see"


def test_texel_density_is_consistent(scene: Scene):
    """Walls and floors show 150 to 700 texels per metre."""
    triangles, uv = corners(scene), scene.uv.astype(float)[scene.faces]
    for index, material in enumerate(scene.materials):
        if (
            material.texture is None
            or re.match(r"(wall paint|floor|parquet|.* floor|wall tiles)", material.name) is None
        ):
            continue
        chosen = scene.face_material == index
        edge = triangles[chosen, 1] - triangles[chosen, 0]
        across = triangles[chosen, 2] - triangles[chosen, 0]
        area = 0.5 * np.linalg.norm(np.cross(edge, across), axis=1).sum()
        du, dv = uv[chosen, 1] - uv[chosen, 0], uv[chosen, 2] - uv[chosen, 0]
        share = 0.5 * np.abs(du[:, 0] * dv[:, 1] - du[:, 1] * dv[:, 0]).sum()
        texels = np.sqrt(share * material.texture.srgb.shape[0] * material.texture.srgb.shape[1] / area)
        assert 150.0 < texels < 700.0, material.name


def test_lights_are_clear_of_their_lamps(scene: Scene):
    """A renderer may give lights a radius of 0.1 m; nothing may be inside of it."""
    triangles = corners(scene)
    low, high = triangles.min(axis=1) - 0.3, triangles.max(axis=1) + 0.3
    rooms = plan_of(scene).rooms
    for light in scene.lights:
        at = np.array(light.position_m)
        near = triangles[((low < at) & (at < high)).all(axis=1)]
        distance = np.linalg.norm(samples(near, spacing_m=0.05) - at, axis=1).min()
        assert distance > 0.125, light  # 0.1 m, and half the spacing of the samples
    for room in rooms:
        rect = room.rect
        lit = [
            p
            for p in (light.position_m for light in scene.lights)
            if rect.x0 < p[0] < rect.x1 and rect.y0 < p[1] < rect.y1
        ]
        assert lit, f"{room.name} has no lamp"


def test_furniture_does_not_overlap(scene: Scene):
    bounds = {name: box for name, box in instance_bounds(scene).items() if SHELL.fullmatch(name) is None}
    names = list(bounds)
    stacked = np.stack([bounds[name] for name in names])
    low, high = stacked[:, 0], stacked[:, 1]
    clash = ((low[:, None] < high[None]) & (low[None] < high[:, None])).all(axis=2)
    np.fill_diagonal(clash, False)
    assert not [(names[a], names[b]) for a, b in np.argwhere(clash) if a < b]


def test_furniture_is_inside_its_room_and_leaves_doors_free(scene: Scene):
    plan = plan_of(scene)
    for name, (low, high) in instance_bounds(scene).items():
        if SHELL.fullmatch(name):
            continue
        inside = [
            room
            for room in plan.rooms
            if room.rect.x0 <= low[0]
            and room.rect.y0 <= low[1]
            and room.rect.x1 >= high[0]
            and room.rect.y1 >= high[1]
        ]
        assert len(inside) == 1, name
        assert low[2] > 1e-4, f"{name} touches the floor's plane"
        for door in plan.doors:
            a, b = (door.at_m - 0.9, door.at_m + 0.9), (door.low_m, door.high_m)
            x, y = (a, b) if door.axis == "x" else (b, a)
            blocks = low[0] < x[1] and high[0] > x[0] and low[1] < y[1] and high[1] > y[0]
            assert not blocks or high[2] < 0.02, f"{name} stands in front of {door}"  # a rug may lie there


def test_all_rooms_can_be_flown_to(scene: Scene):
    """Flood fill of the space that a ball of 0.3 m radius can be in, from `inside_m`."""
    voxel = 0.06
    points = samples(corners(scene), spacing_m=0.05)
    low, high = scene.bounds_m
    shape = np.ceil((high - low) / voxel).astype(int) + 1
    empty = np.ones(shape, bool)
    empty[tuple(np.floor((points - low) / voxel).astype(int).T)] = False
    # Centres of voxels lie within 0.052 m of what they contain: 0.36 m between centres leaves 0.3 m.
    free = ndimage.distance_transform_edt(empty, sampling=voxel) > 0.36
    label, _ = ndimage.label(free)
    assert scene.inside_m is not None
    start = label[tuple(np.floor((np.array(scene.inside_m) - low) / voxel).astype(int))]
    assert start != 0
    plan = plan_of(scene)
    for room in plan.rooms:
        x, y = (
            slice(*(np.floor((np.array(span) - low[axis]) / voxel).astype(int)))
            for axis, span in enumerate([(room.rect.x0, room.rect.x1), (room.rect.y0, room.rect.y1)])
        )
        z = slice(*(np.floor((np.array([1.2, 1.6]) - low[2]) / voxel).astype(int)))
        reached = (label[x, y, z] == start).any(axis=2).mean()
        assert reached > 0.25, f"only {reached:.0%} of {room.name} can be reached"
    for door in plan.doors:
        assert door.high_m - door.low_m >= 0.95
    outside = label == start
    assert not outside[[0, -1]].any()
    assert not outside[:, [0, -1]].any()
    assert not outside[:, :, [0, -1]].any()


def neighbours_in_order(group: NDArray[np.int64]) -> NDArray[np.int64]:
    """All pairs of indices with equal values, shape [P, 2]."""
    order = np.argsort(group, kind="stable")
    sorted_group = group[order]
    pairs, start, lag = [], np.arange(len(group)), 1
    while len(start := start[start + lag < len(group)]):
        start = start[sorted_group[start] == sorted_group[start + lag]]
        pairs.append(np.stack([order[start], order[start + lag]], axis=1))
        lag += 1
    return np.concatenate(pairs) if pairs else np.empty((0, 2), np.int64)


def overlapping_coplanar(triangles: NDArray[np.float64], *, apart_m: float) -> set[tuple[int, int]]:
    """Pairs of triangles that face the same way, lie within `apart_m` of one plane and share an area."""
    normal = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    offset = np.einsum("ij,ij->i", normal, triangles.mean(axis=1))
    low, high = triangles.min(axis=1), triangles.max(axis=1)
    found: set[tuple[int, int]] = set()
    for shift in (0.0, 0.5):  # two overlapping sets of bins, so that no pair is split by both
        cells = [*np.floor(normal.T / 2e-3 + 0.5 + 0.25 * shift), np.floor(offset / (2.0 * apart_m) + shift)]
        key = np.zeros(len(triangles), np.int64)
        for cell in cells:
            key = key * 1_000_003 + cell.astype(np.int64)
        pairs = neighbours_in_order(key)
        near = np.abs(offset[pairs[:, 0]] - offset[pairs[:, 1]]) < apart_m
        near &= (low[pairs[:, 0]] < high[pairs[:, 1]] + apart_m).all(axis=1)
        near &= (low[pairs[:, 1]] < high[pairs[:, 0]] + apart_m).all(axis=1)
        pairs = pairs[near]
        first, second = triangles[pairs[:, 0]], triangles[pairs[:, 1]]
        share = np.full(len(pairs), np.inf)
        for one in (first, second):
            for k in range(3):  # separating axes: the normals of all six edges, in the plane
                edge = one[:, (k + 1) % 3] - one[:, k]
                across = np.cross(normal[pairs[:, 0]], edge / np.linalg.norm(edge, axis=1, keepdims=True))
                a, b = (np.einsum("pkj,pj->pk", which, across) for which in (first, second))
                share = np.minimum(share, np.minimum(a.max(1), b.max(1)) - np.maximum(a.min(1), b.min(1)))
        found.update((int(min(pair)), int(max(pair))) for pair in pairs[share > 1e-3])
    return found


def test_coplanar_check_finds_what_it_shall():
    one = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    assert overlapping_coplanar(np.stack([one, one + np.array([0.2, 0.2, 1e-4])]), apart_m=3e-4) == {(0, 1)}
    assert not overlapping_coplanar(np.stack([one, one + np.array([0.2, 0.2, 2e-3])]), apart_m=3e-4)
    assert not overlapping_coplanar(np.stack([one, one + np.array([1.0, 0.0, 0.0])]), apart_m=3e-4)
    neighbour = np.array([[1.0, 0, 0], [1, 1, 0], [0, 1, 0]])
    assert not overlapping_coplanar(np.stack([one, neighbour]), apart_m=3e-4)


def test_no_two_faces_share_a_plane(scene: Scene):
    """Coplanar overlapping faces would flicker: false events."""
    pairs = overlapping_coplanar(corners(scene), apart_m=3e-4)
    names = {
        (scene.instance_names[scene.face_instance[a]], scene.instance_names[scene.face_instance[b]])
        for a, b in pairs
    }
    assert not names


def test_nonsense_is_refused():
    for wrong in ({"rooms": 0}, {"rooms": 9}, {"seed": -1}, {"door_width_m": 0.5}, {"colour": "red"}):
        with pytest.raises(ConfigError):
            ApartmentConfig(**wrong)


@pytest.mark.parametrize("seed", range(40))
def test_plans_connect_all_rooms(seed: int):
    rooms = 1 + seed % 8
    plan = make_floor_plan(ApartmentConfig(seed=seed, rooms=rooms))
    reached = {0}
    for _ in plan.rooms:
        reached |= {k for door in plan.doors if reached & set(door.rooms) for k in door.rooms}
    assert reached == set(range(rooms))
    for index, a in enumerate(plan.rooms):
        assert min(a.rect.width, a.rect.depth) > 1.8, a
        for b in plan.rooms[index + 1 :]:
            apart_x = max(a.rect.x0, b.rect.x0) >= min(a.rect.x1, b.rect.x1)
            assert apart_x or max(a.rect.y0, b.rect.y0) >= min(a.rect.y1, b.rect.y1)
        for wall in a.walls:
            for opening in wall.openings:
                assert 0.2 < opening.x0 < opening.x1 < wall.length_m - 0.2


# ---------------------------------------------------------------------------------------------- textures

SEAMLESS = re.compile(
    r"wood|dark_wood|planks|chevron|.* floor \d|wall tiles \d|wallpaper .*|"
    r"marble|weave|knit|pile|plaster|metal|concrete"
)


@functools.cache
def seamless() -> dict[str, NDArray[np.float64]]:
    """One picture of each kind of texture that repeats, from as few flats as show all of them."""
    found: dict[str, NDArray[np.float64]] = {}
    for seed in (5, 0, 1):
        for material in flat(seed, 8).materials:
            key = "" if material.texture is None else material.texture.name
            kind = re.sub(r" \d+$", "", key)
            if material.texture is not None and SEAMLESS.fullmatch(key) and kind not in found:
                found[kind] = material.texture.srgb / 255.0
    return found


def test_there_are_all_kinds_of_textures():
    kinds = set(seamless())
    assert {f"wallpaper {kind}" for kind in ("stripes", "scales", "lattice", "leaves")} <= kinds
    assert {f"{kind} floor" for kind in ("checker", "terrazzo", "slate", "two tone")} <= kinds
    assert {"planks", "chevron", "wall tiles", "pile"} <= kinds


@pytest.mark.parametrize("axis", [0, 1])
def test_textures_repeat_without_a_seam(axis: int):
    """The step from the last row to the first is like the largest of the steps inside the picture."""
    for name, picture in seamless().items():
        step = np.abs(np.roll(picture, -1, axis=axis) - picture).mean(axis=(1 - axis, 2))
        assert step[-1] <= 1.25 * step[:-1].max(), name


def octave_contrast(picture: NDArray[np.float64]) -> list[float]:
    """Standard deviation of luminance in bands of 2, 4, 8, … texels."""
    grey, bands = picture.mean(axis=2), []
    while grey.shape[0] > 4:
        half = grey.reshape(grey.shape[0] // 2, 2, grey.shape[1] // 2, 2).mean(axis=(1, 3))
        bands.append(float((grey - half.repeat(2, 0).repeat(2, 1)).std()))
        grey = half
    return bands


def test_textures_have_contrast_at_every_scale():
    """Event cameras need something to see at every distance: 0.2 % of full scale in each of seven octaves."""
    for name, picture in seamless().items():
        assert min(octave_contrast(picture)) > 0.002, name


def test_posters_and_rugs_differ():
    textures = {material.texture for material in flat(5, 8).materials if material.texture is not None}
    pictures = [texture.srgb.astype(float) for texture in textures if re.match("poster|rug", texture.name)]
    assert len(pictures) > 6
    for one, two in itertools.combinations(pictures, 2):
        assert one.shape != two.shape or np.abs(one - two).mean() > 2.5
