"""The report of a scene: figures against a room worked out by hand, the cut against exact areas."""

from __future__ import annotations

import dataclasses
import io
import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from rich.console import Console

from neurosim_core.scene.freespace import FreeSpaceConfig, make_free_space
from neurosim_core.scene.mesh import SceneError
from neurosim_core.scene.report import cut_open, figures, report_scene
from neurosim_core.scene.scene import Light, Material, Scene, Texture

BOX_FACES = np.array(
    [[0, 2, 1], [1, 2, 3], [4, 5, 6], [5, 7, 6], [0, 1, 4], [1, 5, 4],
     [2, 6, 3], [3, 6, 7], [0, 4, 2], [2, 4, 6], [1, 3, 5], [3, 7, 5]]
)  # fmt: skip


def hall() -> Scene:
    """A closed hall of 6 x 4 x 3 m around the origin of x and y: checkered floor, walls that glow, a lamp."""
    corners = np.array([[x, y, z] for z in (0, 3) for y in (-2, 2) for x in (-3, 3)], dtype=np.float32)
    checker = np.where((np.indices((8, 16)).sum(axis=0) % 2)[..., None], 220, 60).astype(np.uint8)
    texture = Texture(name="checker", srgb=np.repeat(checker, 3, axis=2))
    return Scene(
        name="hall",
        vertices=corners,
        faces=BOX_FACES.astype(np.int32),
        normals=(corners - [0, 0, 1.5]) / np.linalg.norm(corners - [0, 0, 1.5], axis=1, keepdims=True),
        uv=corners[:, :2],
        face_material=np.array([0, 0] + [1] * 10, dtype=np.int32),
        face_instance=np.zeros(12, dtype=np.int32),
        instance_names=("hall",),
        materials=(
            Material(name="floor", texture=texture),
            Material(name="wall", emission=(0.1, 0.0, 0.0)),
        ),
        lights=(Light(position_m=(0.0, 0.0, 2.5), intensity=(1.0, 1.0, 1.0)),),
        notes=("Built by hand.",),
    )


def area(scene: Scene) -> float:
    t = scene.vertices[scene.faces].astype(np.float64)
    return float(np.linalg.norm(np.cross(t[:, 1] - t[:, 0], t[:, 2] - t[:, 0]), axis=1).sum() / 2.0)


def numbers(text: str) -> list[float]:
    return [float(number.replace(",", "")) for number in re.findall(r"-?[0-9][0-9.,]*", text)]


def test_figures_of_a_hall():
    scene = hall()
    space = make_free_space(scene, FreeSpaceConfig(voxel_m=0.1), device="cpu")
    found = figures(scene, space)
    assert found["size"] == "6.00 x 4.00 x 3.00 m"
    assert found["corners"] == "(-3.00, -2.00, 0.00) to (3.00, 2.00, 3.00) m"
    assert found["triangles"].startswith("12, median edge ")
    assert [found[name] for name in ("vertices", "objects", "lights")] == ["8", "1", "1"]
    assert found["materials"] == "2, 1 glow"
    assert found["textures"] == "1, 0.0 million texels; 78 % of the area has none"  # 84 of 108
    assert found["area"] == f"{2.0 * (24.0 + 18.0 + 12.0)} m²"
    # 0.3 m clear leaves 5.4 x 3.4 x 2.4 m; the map may lose a voxel at each side
    volume_m3, floor_m2, _ = numbers(found["free space"])
    assert 5.2 * 3.2 * 2.2 - 0.05 <= volume_m3 <= 5.4 * 3.4 * 2.4 + 0.05
    assert 5.2 * 3.2 - 0.05 <= floor_m2 <= 5.4 * 3.4 + 0.05
    assert numbers(found["widest place"])[0] == pytest.approx(1.5, abs=0.1)
    assert numbers(found["fly at"])[0] == pytest.approx(1.5, abs=0.11)
    assert "free space" not in figures(scene)


@settings(max_examples=50, deadline=None)
@given(height=st.floats(0.01, 2.99))
def test_cut_keeps_what_is_below(height):
    """Floor and the walls up to the cut; uv, materials and winding go along."""
    cut = cut_open(hall(), height)
    assert area(cut) == pytest.approx(24.0 + 20.0 * height, rel=1e-5)  # float32 corners
    assert cut.vertices[:, 2].max() <= height * (1.0 + 1e-6)
    assert cut.uv == pytest.approx(cut.vertices[:, :2], abs=1e-5)  # linear, as in the hall
    assert area_of(cut, 0) == pytest.approx(24.0)
    t = cut.vertices[cut.faces].astype(np.float64)
    outward = np.cross(t[:, 1] - t[:, 0], t[:, 2] - t[:, 0])
    assert (np.einsum("fx,fx->f", outward, t.mean(axis=1) - [0, 0, 1.5]) > 0.0).all()


def area_of(scene: Scene, material: int) -> float:
    t = scene.vertices[scene.faces[scene.face_material == material]].astype(np.float64)
    return float(np.linalg.norm(np.cross(t[:, 1] - t[:, 0], t[:, 2] - t[:, 0]), axis=1).sum() / 2.0)


def test_cut_above_and_below_everything():
    assert area(cut_open(hall(), 3.0)) == pytest.approx(108.0)
    with pytest.raises(ValueError, match=r"nothing of scene 'hall' is below -1\.0 m"):
        cut_open(hall(), -1.0)


def test_report_scene_draws_what_is_there(tmp_path):
    """White around it, the plan in green where there is room, and as wide as the hall is."""
    stream = io.StringIO()
    out = tmp_path / "new" / "hall.png"
    report_scene(hall(), out, console=Console(file=stream, width=200))
    for piece in (str(out), "fly at", "- Built by hand."):
        assert piece in stream.getvalue()
    with Image.open(out) as opened:
        picture = np.asarray(opened).astype(int)
    assert picture.shape == (900, 1600, 3)
    assert (picture[0] == 255).all()
    plan = picture[70 : 70 + 366, 1030:1580]  # 6 x 4 m at 550 / 6 px per metre
    green = plan[..., 1] - plan[..., 0] > 20
    for axis, length in ((0, 6.0), (1, 4.0)):
        ends = np.flatnonzero(green.any(axis=axis))[[0, -1]] * 6.0 / 550.0
        assert ends == pytest.approx([0.3, length - 0.3], abs=0.1)  # a voxel
    view = picture[:, :1010]
    shown = (view < 250).any(axis=2)
    assert 0.2 < shown.mean() < 0.9
    assert not shown[:, :5].any()
    assert not shown[:, -5:].any()
    assert view[shown].std() > 20.0  # the checkered floor, not a flat grey


def test_report_of_a_house(house, tmp_path):
    stream = io.StringIO()
    report_scene(house, tmp_path / "house.png", console=Console(file=stream, width=200))
    lines = {line.strip().partition("  ")[0]: line for line in stream.getvalue().splitlines()}
    assert numbers(lines["textures"])[0] == 64
    assert 250.0 < numbers(lines["free space"])[0] < 350.0
    assert 0.8 < numbers(lines["fly at"])[0] < 2.2
    assert "4 of 145844 faces have no area" in stream.getvalue()
    with Image.open(tmp_path / "house.png") as picture:
        assert picture.size == (1600, 900)


@pytest.mark.parametrize(
    "corners",
    [
        [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)],
        [(0, 0, 0), (1, 0, 0), (1, 0, 1), (0, 0, 1)],
    ],
    ids=["lying", "standing"],
)
def test_a_sheet_is_described_and_drawn(tmp_path, corners):
    """No room beside something so small: that is said, and everything else too."""
    vertices = 0.5 * np.array(corners, dtype=np.float32)
    normal = np.cross(vertices[1] - vertices[0], vertices[2] - vertices[0])
    sheet = dataclasses.replace(
        hall(),
        name="sheet",
        vertices=vertices,
        normals=np.tile(normal / np.linalg.norm(normal), (4, 1)).astype(np.float32),
        uv=np.zeros((4, 2), dtype=np.float32),
        faces=np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32),
        face_material=np.zeros(2, dtype=np.int32),
        face_instance=np.zeros(2, dtype=np.int32),
        lights=(Light(position_m=(0.5, 0.5, 2.0), intensity=(1.0, 1.0, 1.0)),),
    )
    stream = io.StringIO()
    report_scene(sheet, tmp_path / "sheet.png", console=Console(file=stream, width=200))
    assert "2, median edge" in stream.getvalue()
    assert "none with 0.3 m clear" in stream.getvalue()
    assert "The scene is flat: free space is mapped up to 3 m on both sides of it" in stream.getvalue()
    with Image.open(tmp_path / "sheet.png") as opened:
        picture = np.asarray(opened).astype(int)
    assert ((picture[:, :1010] < 250).any(axis=2)).mean() > 0.02  # it is drawn
    assert not (picture[..., 1] - picture[..., 0] > 20).any()  # nothing green


def test_no_file(tmp_path):
    with pytest.raises(SceneError, match="no such file"):
        report_scene(tmp_path / "gone.glb")
