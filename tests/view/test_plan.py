"""The plan of a scene against exact geometry."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from neurosim_core.scene.scene import Material, Scene, Texture
from neurosim_core.view.plan import cut_plan


def make_scene(mesh: trimesh.Trimesh, **fields) -> Scene:
    count = len(mesh.vertices)
    defaults = {
        "name": "box",
        "vertices": mesh.vertices.astype(np.float32),
        "faces": mesh.faces.astype(np.int32),
        "normals": np.tile(np.float32([0, 0, 1]), (count, 1)),
        "uv": np.zeros((count, 2), dtype=np.float32),
        "face_material": np.zeros(len(mesh.faces), dtype=np.int32),
        "face_instance": np.zeros(len(mesh.faces), dtype=np.int32),
        "instance_names": ("box",),
        "materials": (Material(name="grey"),),
    }
    return Scene(**{**defaults, **fields})


def slice_of(mesh: trimesh.Trimesh, height_m: float) -> np.ndarray:
    return cut_plan(make_scene(mesh), height_m=height_m).outlines


def test_slice_of_a_box_is_its_outline():
    segments = slice_of(trimesh.creation.box(extents=(3.0, 2.0, 1.0)), 0.2)
    assert len(segments) == 8  # two triangles a side
    lengths = np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1)
    assert lengths.sum() == pytest.approx(10.0, rel=1e-12)  # rounding
    on_side = np.isclose(np.abs(segments[..., 0]), 1.5, atol=1e-12).all(axis=1)
    on_side |= np.isclose(np.abs(segments[..., 1]), 1.0, atol=1e-12).all(axis=1)
    assert on_side.all()


@pytest.mark.parametrize("height_m", [-0.7, 0.01, 0.31])
def test_slice_of_a_sphere_is_a_circle(height_m):
    segments = slice_of(trimesh.creation.icosphere(subdivisions=4, radius=1.0), height_m)
    radius_m = np.sqrt(1.0 - height_m**2)
    # Edges are 0.07 m long, so a chord is 0.07^2 / 8 = 6e-4 m inside, and more where the sphere is slanted.
    assert np.linalg.norm(segments.reshape(-1, 2), axis=1) == pytest.approx(radius_m, abs=2e-3)
    length_m = np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1).sum()
    assert length_m == pytest.approx(2.0 * np.pi * radius_m, rel=2e-3)


def test_slice_outside_is_empty():
    assert slice_of(trimesh.creation.box(), 0.6).shape == (0, 2, 2)


def test_plan_shows_what_is_on_top_below_the_cut():
    """A floor with a table: the table is drawn after the floor; the ceiling is left out."""
    floor = trimesh.creation.box(extents=(4, 4, 0.1))
    table = trimesh.creation.box(extents=(1, 1, 0.1)).apply_translation((0, 0, 0.7))
    ceiling = trimesh.creation.box(extents=(4, 4, 0.1)).apply_translation((0, 0, 2.5))
    mesh = trimesh.util.concatenate([ceiling, table, floor])
    colors = ((1.0, 1.0, 1.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    scene = make_scene(
        mesh,
        materials=tuple(Material(name=str(k), base_color=c) for k, c in enumerate(colors)),
        face_material=np.repeat(np.arange(3), 12).astype(np.int32),
    )
    plan = cut_plan(scene, height_m=1.5)
    assert len(plan.triangles) == 8  # top and bottom of floor and table; sides are seen from the edge
    assert plan.colors[:4].tolist() == [[0.0, 1.0, 0.0]] * 4
    assert plan.colors[4:].tolist() == [[1.0, 0.0, 0.0]] * 4
    assert len(plan.outlines) == 0
    assert plan.bounds.tolist() == [[-2.0, -2.0], [2.0, 2.0]]


def test_colors_are_averaged_in_linear_light():
    """Half black, half white texels: linear 0.5 is sRGB 188 (IEC 61966-2-1), not 128."""
    srgb = np.zeros((2, 2, 3), dtype=np.uint8)
    srgb[:, 1] = 255
    plane = trimesh.Trimesh(
        [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]], process=False
    )
    scene = make_scene(
        plane,
        uv=np.float32([[0, 0], [1, 0], [1, 1], [0, 1]]),
        materials=(Material(name="half", base_color=(1.0, 1.0, 1.0), texture=Texture(name="t", srgb=srgb)),),
    )
    colors = cut_plan(scene, height_m=1.0).colors
    # The two triangles mirror each other, and so do their samples; 8 bits of sRGB leave 0.005 of light.
    linear = ((colors[:, 0] + 0.055) / 1.055) ** 2.4
    assert linear.mean() == pytest.approx(0.5, abs=0.005)


def test_large_faces_take_the_mean_of_their_texture():
    """A fine chequerboard, repeated: samples would alias, the mip level does not."""
    board = 128 * np.kron(np.indices((32, 32)).sum(axis=0) % 2, np.ones((2, 2), dtype=int)).astype(np.uint8)
    plane = trimesh.Trimesh(
        [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]], process=False
    )
    scene = make_scene(
        plane,
        uv=np.float32([[0, 0], [7.3, 0], [7.3, 5.1], [0, 5.1]]),
        materials=(
            Material(
                name="m",
                base_color=(1.0, 1.0, 1.0),
                texture=Texture(name="t", srgb=board[..., None].repeat(3, 2)),
            ),
        ),
    )
    colors = cut_plan(scene, height_m=1.0).colors
    # sRGB 128 is linear 0.2159 (IEC 61966-2-1); its half is sRGB 92.4; 8 bits round by 0.5.
    assert colors == pytest.approx(92.4 / 255, abs=0.6 / 255)
