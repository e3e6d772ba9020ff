"""Mesh files as scenes: hand-made files against values worked out by hand."""

from __future__ import annotations

import base64
import io
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from PIL import Image

from neurosim_core.scene import gltf
from neurosim_core.scene.mesh import MeshSceneConfig, SceneError, load_mesh_scene
from neurosim_core.scene.scene import Scene
from neurosim_core.scene.topology import smooth_normals
from neurosim_core.settings_file import ConfigError

TRIANGLE = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], dtype=np.float32)
RED, GREEN, BLUE, WHITE = (255, 0, 0), (0, 255, 0), (0, 0, 255), (255, 255, 255)
PICTURE = np.array([[RED, GREEN], [BLUE, WHITE]], dtype=np.uint8)
"""Top row red, green; bottom row blue, white."""
COMPONENT = {"f4": 5126, "u4": 5125, "u2": 5123, "u1": 5121}


class Gltf:
    """Writes glTF files number by number."""

    def __init__(self, **tree: Any) -> None:
        self.data = b""
        self.tree: dict[str, Any] = {"asset": {"version": "2.0", "generator": "hand"}, "scene": 0}
        self.tree |= {
            "scenes": [{"nodes": []}],
            "nodes": [],
            "meshes": [],
            "accessors": [],
            "bufferViews": [],
        }
        self.tree |= tree

    def view(self, data: bytes) -> int:
        self.data += b"\0" * (-len(self.data) % 4)
        self.tree["bufferViews"].append({"buffer": 0, "byteOffset": len(self.data), "byteLength": len(data)})
        self.data += data
        return len(self.tree["bufferViews"]) - 1

    def accessor(self, array: Any, kind: str = "f4", **more: Any) -> int:
        array = np.asarray(array, dtype="<" + kind)
        shape = "SCALAR" if array.ndim == 1 else f"VEC{array.shape[1]}"
        if array.ndim == 3:
            shape, array = "MAT4", array.transpose(0, 2, 1)
        entry = {"bufferView": self.view(array.tobytes()), "componentType": COMPONENT[kind]}
        self.tree["accessors"].append({**entry, "count": len(array), "type": shape, **more})
        return len(self.tree["accessors"]) - 1

    def mesh(self, positions: Any = TRIANGLE, faces: Any = ((0, 1, 2),), material: int | None = None,
             mode: int = 4, **attributes: int) -> int:  # fmt: skip
        primitive: dict[str, Any] = {"attributes": {"POSITION": self.accessor(positions), **attributes}}
        if faces is not None:
            primitive["indices"] = self.accessor(np.asarray(faces).reshape(-1), "u4")
        if material is not None:
            primitive["material"] = material
        self.tree["meshes"].append({"primitives": [{**primitive, "mode": mode}]})
        return len(self.tree["meshes"]) - 1

    def node(self, *, root: bool = True, **node: Any) -> int:
        self.tree["nodes"].append(node)
        if root:
            self.tree["scenes"][0]["nodes"].append(len(self.tree["nodes"]) - 1)
        return len(self.tree["nodes"]) - 1

    def textured(self, uv: Any, **texture: Any) -> Gltf:
        """Add one triangle with `PICTURE` on it."""
        image = self.view(png(PICTURE))
        self.tree["images"] = [{"bufferView": image, "mimeType": "image/png"}]
        self.tree["textures"] = [{"source": 0}]
        self.tree["materials"] = [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0, **texture}}}]
        self.node(mesh=self.mesh(material=0, TEXCOORD_0=self.accessor(uv)))
        return self

    def glb(self) -> bytes:
        self.tree["buffers"] = [{"byteLength": len(self.data)}]
        text = json.dumps(self.tree).encode()
        text += b" " * (-len(text) % 4)
        data = self.data + b"\0" * (-len(self.data) % 4)
        chunks = struct.pack("<II", len(text), 0x4E4F534A) + text
        chunks += struct.pack("<II", len(data), 0x004E4942) + data
        return b"glTF" + struct.pack("<II", 2, 12 + len(chunks)) + chunks

    def gltf(self) -> bytes:
        uri = "data:application/octet-stream;base64," + base64.b64encode(self.data).decode()
        self.tree["buffers"] = [{"byteLength": len(self.data), "uri": uri}]
        return json.dumps(self.tree).encode()


def png(pixels: NDArray[np.uint8]) -> bytes:
    stream = io.BytesIO()
    Image.fromarray(pixels).save(stream, "PNG")
    return stream.getvalue()


def load(path: Path, data: bytes | str, **settings: Any) -> Scene:
    path.write_bytes(data.encode() if isinstance(data, str) else data)
    return load_mesh_scene(MeshSceneConfig(file=path, **settings))


def texel(scene: Scene, uv: Any, material: int = 0) -> tuple[int, ...]:
    """Look up the nearest texel as `Texture` says: v = 1 is the top row, coordinates wrap around."""
    texture = scene.materials[material].texture
    assert texture is not None
    height, width = texture.srgb.shape[:2]
    column, row = int(np.floor(uv[0] * width)) % width, int(np.floor((1.0 - uv[1]) * height)) % height
    return tuple(int(c) for c in texture.srgb[row, column])


def area(scene: Scene) -> float:
    t = scene.vertices[scene.faces].astype(np.float64)
    return float(np.linalg.norm(np.cross(t[:, 1] - t[:, 0], t[:, 2] - t[:, 0]), axis=1).sum() / 2.0)


def face_normals(scene: Scene) -> NDArray[np.float64]:
    t = scene.vertices[scene.faces].astype(np.float64)
    n = np.cross(t[:, 1] - t[:, 0], t[:, 2] - t[:, 0])
    return n / np.linalg.norm(n, axis=1, keepdims=True)


def check(scene: Scene) -> None:
    """Assert what every scene promises."""
    assert scene.vertices.dtype == scene.normals.dtype == scene.uv.dtype == np.float32
    assert scene.faces.dtype == scene.face_material.dtype == scene.face_instance.dtype == np.int32
    assert scene.normals.shape == scene.vertices.shape
    assert scene.uv.shape == (len(scene.vertices), 2)
    assert len(scene.faces) == len(scene.face_material) == len(scene.face_instance) > 0
    assert np.array_equal(np.unique(scene.faces), np.arange(len(scene.vertices)))  # all used
    assert scene.face_material.max() < len(scene.materials)
    assert scene.face_instance.max() < len(scene.instance_names)
    assert len(set(scene.instance_names)) == len(scene.instance_names)
    assert np.abs(np.linalg.norm(scene.normals, axis=1) - 1.0).max() < 1e-5  # float32 roundings
    assert np.isfinite(scene.uv).all()
    assert scene.lights


# axes, units, transforms


@pytest.mark.parametrize(
    ("axis", "expected"),
    [("z", (1, 2, 3)), ("y", (1, -3, 2)), ("x", (-3, 2, 1))],
)
def test_up_axis_turns_without_mirroring(tmp_path, axis, expected):
    """The declared axis ends up along z, and a triangle keeps its sense of rotation."""
    corners = np.array([[1, 2, 3], [2, 2, 3], [1, 3, 3]], dtype=np.float32)
    model = Gltf()
    model.node(mesh=model.mesh(corners))
    scene = load(tmp_path / "a.glb", model.glb(), up_axis=axis)
    assert scene.vertices[0] == pytest.approx(expected)
    up = {"x": (-1, 0, 0), "y": (0, -1, 0), "z": (0, 0, 1)}[axis]  # where the file's z went
    assert face_normals(scene)[0] == pytest.approx(up, abs=1e-6)
    assert scene.normals[0] == pytest.approx(up, abs=1e-6)
    assert "as declared" in scene.notes[1]


def test_gltf_is_y_up_by_specification(tmp_path):
    model = Gltf()
    model.node(mesh=model.mesh())
    scene = load(tmp_path / "a.glb", model.glb())
    assert scene.vertices[2] == pytest.approx((0, 0, 1))  # file's y
    assert scene.notes[1].startswith("Up axis: y; glTF is y up by specification")


@pytest.mark.parametrize(
    ("where", "value"), [("asset", {"up_axis": "Z"}), ("scene", {"upAxis": "Z_UP"}), ("beside", [0, 0, 1])]
)
def test_file_that_says_up(tmp_path, where, value):
    model = Gltf()
    model.node(mesh=model.mesh())
    if where == "asset":
        model.tree["asset"]["extras"] = value
    elif where == "scene":
        model.tree["scenes"][0]["extras"] = value
    else:
        (tmp_path / "a.stage_config.json").write_text(json.dumps({"up": value}))
    scene = load(tmp_path / "a.glb", model.glb())
    assert scene.vertices[2] == pytest.approx((0, 1, 0))
    assert scene.notes[1].startswith("Up axis: z; ")


CUPBOARD = (0.2, 2.2, 2.8, 4.8, 0.1, 2.9)


def room(*, ceiling: bool) -> trimesh.Trimesh:
    """Two rooms of 5 x 5 x 3 m with a door between them, and a closed cupboard as large as a lift."""

    def slab(x0, x1, y0, y1, z0, z1):
        return trimesh.creation.box(bounds=[[x0, y0, z0], [x1, y1, z1]])

    walls = [slab(0, 10, 0, 5, -0.1, 0), slab(0, 10, -0.1, 0, 0, 3), slab(0, 10, 5, 5.1, 0, 3)]
    walls += [slab(-0.1, 0, 0, 5, 0, 3), slab(10, 10.1, 0, 5, 0, 3)]
    walls += [slab(4.95, 5.05, 0, 2, 0, 3), slab(4.95, 5.05, 3, 5, 0, 3), slab(4.95, 5.05, 2, 3, 2.1, 3)]
    walls.append(slab(*CUPBOARD))
    if ceiling:
        walls.append(slab(0, 10, 0, 5, 3, 3.1))
    return trimesh.util.concatenate(walls)


def turned(mesh: trimesh.Trimesh, axis: str) -> trimesh.Trimesh:
    """Return a z-up mesh with `axis` up."""
    order = {"z": [0, 1, 2], "y": [1, 2, 0], "x": [2, 0, 1]}[axis]
    return trimesh.Trimesh(mesh.vertices[:, order], mesh.faces, process=False)


def flat() -> trimesh.Trimesh:
    """Two rooms, 5 m wide and 7.5 m long."""
    return room(ceiling=True).apply_scale([1.0, 1.5, 1.0])


def quad(*corners: tuple[float, float, float]) -> trimesh.Trimesh:
    return trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False)


@pytest.mark.parametrize(
    ("suffix", "axis", "loaded"),
    [(s, a, a) for s in ("glb", "obj", "stl") for a in "yz"] + [("glb", "x", "y"), ("stl", "x", "z")],
)
def test_a_building_shows_which_way_is_up(tmp_path, suffix, axis, loaded):
    """Two rooms, with a floor, walls and a cupboard: y or z is seen; x, which nobody means, never is."""
    turned(flat(), axis).export(tmp_path / f"flat.{suffix}")
    scene = load_mesh_scene(MeshSceneConfig(file=tmp_path / f"flat.{suffix}"))
    how = "from the geometry" if axis == loaded else "by default"
    assert scene.notes[1].startswith(f"Up axis: {loaded}, {how}")
    if axis == loaded:
        assert np.ptp(scene.bounds_m, axis=0)[2] == pytest.approx(3.2, abs=1e-5)


def test_a_building_in_millimetres_shows_which_way_is_up(tmp_path):
    mesh = flat()
    mesh.apply_scale(1000.0)
    mesh.export(tmp_path / "flat.glb")
    scene = load_mesh_scene(MeshSceneConfig(file=tmp_path / "flat.glb", unit_m=0.001))
    assert scene.notes[1].startswith("Up axis: z, from the geometry")
    # the same numbers in metres, 3.2 km high, are no building
    far = load_mesh_scene(MeshSceneConfig(file=tmp_path / "flat.glb"))
    assert far.notes[2].startswith("Up axis: y, by default")


def things() -> dict[str, trimesh.Trimesh]:
    """Things that have a flattest axis, z, but are no building that lies on its side."""
    box, ball = trimesh.creation.box, trimesh.creation.icosphere(subdivisions=3)
    wall = quad((-5, 0, 0), (5, 0, 0), (5, 8, 0), (-5, 8, 0))
    stage = [wall, quad((-5, 0, 0), (5, 0, 0), (5, 0, 3), (-5, 0, 3)), box(bounds=[[0, 0, 1], [1, 1, 2]])]
    shelf = [box(bounds=[[0, 0.4 * k, 0], [1, 0.4 * k + 0.02, 0.3]]) for k in range(6)]
    shelf += [box(bounds=[[x, 0, 0], [x + 0.02, 2, 0.3]]) for x in (-0.02, 1.0)]
    rack = [box(bounds=[[0, k, 0], [8, k + 0.1, 3]]) for k in range(9)]
    rack += [box(bounds=[[x, 0, 0], [x + 0.1, 8, 3]]) for x in (-0.1, 8.0)]
    rack.append(box(bounds=[[0, 0, -0.1], [8, 8, 0]]))
    tin = trimesh.creation.cylinder(radius=1.0, height=2.0)
    return {
        "wall": wall,
        "box": box([6.0, 5.0, 2.5]),
        "tall box": box([6.0, 5.0, 4.0]),
        "ball on a plane": trimesh.util.concatenate([ball, box([10, 10, 0.1])]),
        "tin over a plane": trimesh.util.concatenate([tin, box(bounds=[[-8, -8, -1.3], [8, 8, -1.2]])]),
        "stage": trimesh.util.concatenate(stage),
        "shelf": trimesh.util.concatenate(shelf),
        "rack": trimesh.util.concatenate(rack),
        "doll's house": flat().apply_scale(0.55),
    }


@pytest.mark.parametrize("suffix", ["glb", "obj"])
@pytest.mark.parametrize("name", things())
def test_things_stand_as_their_format_says(tmp_path, name, suffix):
    """Each of them with each axis flattest: none changes what glTF and OBJ mean, and the note says so."""
    for axis in "xyz":
        turned(things()[name], axis).export(tmp_path / f"thing.{suffix}")
        scene = load_mesh_scene(MeshSceneConfig(file=tmp_path / f"thing.{suffix}"))
        assert scene.notes[1].startswith("Up axis: y, by default")
        assert scene.notes[1].endswith("the geometry shows no building. Declare up_axis to be sure.")


def test_a_wall_stands(tmp_path):
    """A y-up wall, 2 m wide and 1 m high, in the plane x = 0, as trimesh writes it."""
    quad((0, 0, -1), (0, 0, 1), (0, 1, 1), (0, 1, -1)).export(tmp_path / "wall.glb")
    scene = load_mesh_scene(MeshSceneConfig(file=tmp_path / "wall.glb"))
    assert np.ptp(scene.bounds_m, axis=0) == pytest.approx([0, 2, 1])


@pytest.mark.parametrize(("suffix", "axis"), [("glb", "y"), ("obj", "y"), ("ply", "z"), ("stl", "z")])
def test_a_cube_stands_as_its_format_says(tmp_path, suffix, axis):
    trimesh.creation.box([1, 1, 1]).export(tmp_path / f"cube.{suffix}")
    scene = load_mesh_scene(MeshSceneConfig(file=tmp_path / f"cube.{suffix}"))
    assert scene.notes[1].startswith(f"Up axis: {axis}, by default")
    directions = np.unique(scene.normals, axis=0)
    assert len(directions) == 6  # sharp at the edges
    assert scene.normals[scene.faces] == pytest.approx(np.repeat(face_normals(scene)[:, None], 3, axis=1))


@pytest.mark.parametrize("suffix", ["glb", "obj", "ply", "stl"])
def test_unit(tmp_path, suffix):
    """Declared millimetres shrink the box; lights and area follow."""
    trimesh.creation.box([3000, 2000, 1000]).export(tmp_path / f"box.{suffix}")
    scene = load_mesh_scene(MeshSceneConfig(file=tmp_path / f"box.{suffix}", unit_m=0.001, up_axis="z"))
    assert np.ptp(scene.bounds_m, axis=0) == pytest.approx((3, 2, 1))
    assert scene.notes[0] == "Unit: 0.001 m, as declared."
    metres = load_mesh_scene(MeshSceneConfig(file=tmp_path / f"box.{suffix}"))
    assert any("declare unit_m" in note for note in metres.notes)


def test_node_tree(tmp_path):
    """Child under parent: p -> parent (T R S) child (T) p; one mesh, two instances."""
    model = Gltf()
    mesh = model.mesh()
    child = model.node(root=False, mesh=mesh, translation=[1, 0, 0], name="thing")
    half = np.sqrt(0.5)
    model.node(children=[child], translation=[0, 0, 5], rotation=[0, 0, half, half], scale=[2, 3, 4])
    model.node(mesh=mesh, name="thing", matrix=np.eye(4).T.reshape(-1).tolist())
    scene = load(tmp_path / "a.gltf", model.gltf(), up_axis="z")
    assert scene.instance_names == ("thing", "thing.2")
    # corner (1, 0, 0) + (1, 0, 0), scaled by (2, 3, 4): (4, 0, 0), a quarter turn about z: (0, 4, 0), up 5
    placed = scene.vertices[scene.faces[scene.face_instance == 0]]
    assert placed.reshape(3, 3)[1] == pytest.approx((0, 4, 5), abs=1e-6)
    assert placed.reshape(3, 3)[2] == pytest.approx((-3, 2, 5), abs=1e-6)
    assert scene.vertices[scene.faces[1]] == pytest.approx(TRIANGLE)


def test_mirror_flips_winding_and_keeps_normals_outside(tmp_path):
    box = trimesh.creation.box([1, 2, 3])
    model = Gltf()
    normals = model.accessor(np.repeat(face := box.face_normals, 3, axis=0))
    mesh = model.mesh(box.triangles.reshape(-1, 3), None, NORMAL=normals)
    model.node(mesh=mesh, scale=[-2, 1, 1], translation=[10, 0, 0])
    scene = load(tmp_path / "a.glb", model.glb(), up_axis="z")
    outward = scene.vertices[scene.faces].mean(axis=1) - (10, 0, 0)
    assert (np.einsum("fx,fx->f", face_normals(scene), outward) > 0.0).all()
    corner_normal = scene.normals[scene.faces]
    assert corner_normal == pytest.approx(np.repeat(face_normals(scene)[:, None], 3, axis=1), abs=1e-6)
    assert len(face) == len(scene.faces)


def test_normals_under_shear_stay_perpendicular(tmp_path):
    """They are turned by the cofactor matrix: uneven scale must not tilt them off the surface."""
    tilted = np.array([[0, 0, 0], [1, 0, 1], [0, 1, 0]], dtype=np.float32)
    normal = np.cross(tilted[1], tilted[2]) / np.sqrt(2.0)
    model = Gltf()
    model.node(mesh=model.mesh(tilted, NORMAL=model.accessor([normal] * 3)), scale=[1, 1, 5])
    scene = load(tmp_path / "a.glb", model.glb(), up_axis="z")
    assert scene.normals == pytest.approx(np.repeat(face_normals(scene), 3, axis=0), abs=1e-6)


def test_position_is_added_before_rounding(tmp_path):
    """Survey coordinates far from the origin keep their millimetres."""
    text = "v 4500000.001 0 0\nv 4500001.001 0 0\nv 4500000.001 1 0\nf 1 2 3\n"
    scene = load(tmp_path / "a.obj", text, up_axis="z", position_m=(-4500000.0, 0.0, 0.0))
    assert scene.vertices[0, 0] == pytest.approx(0.001, abs=2e-9)  # float64 spacing at 4.5e6 is 1e-9


@pytest.mark.parametrize("away_m", [(0.0, 0.0, 0.0), (12_000.0, -3_000.0, 0.0), (4_500_000.0, 0.0, 800.0)])
def test_a_scene_far_from_the_origin_is_moved_there(tmp_path, away_m):
    """To float32 the mesh is that of the same scene near the origin, and a note says what was subtracted."""
    here = np.array([[-1.4, -2.0, 0.0], [1.6, 0.1, 0.3], [0.25, 2.3, 2.7]])
    lines = [f"v {x:.4f} {y:.4f} {z:.4f}" for x, y, z in here + away_m]
    scene = load(tmp_path / "a.obj", "\n".join([*lines, "f 1 2 3", ""]), up_axis="z")
    moved = np.where(
        np.abs(away_m) > 100.0, away_m + np.rint(0.5 * (here.min(axis=0) + here.max(axis=0))), 0.0
    )
    assert scene.origin_m == pytest.approx(moved)
    assert scene.vertices == pytest.approx(here + away_m - moved, abs=3e-7)  # a spacing of float32 at 2 m
    assert any("was subtracted from its coordinates" in note for note in scene.notes) == moved.any()


# materials and textures


@pytest.mark.parametrize(
    ("uv", "expected"),
    [((0.25, 0.25), RED), ((0.75, 0.25), GREEN), ((0.25, 0.75), BLUE), ((1.75, -0.25), WHITE)],
)
def test_gltf_texture_orientation(tmp_path, uv, expected):
    """GlTF counts v from the top row down."""
    scene = load(tmp_path / "a.glb", Gltf().textured([uv] * 3).glb())
    assert texel(scene, scene.uv[0]) == expected


def test_texture_transform(tmp_path):
    """Scale 0.5, turn a quarter counter-clockwise on the picture, offset; by hand in top-down (u, v).

    (0.5, 0.5) scaled is (0.25, 0.25); turned counter-clockwise as seen, right goes up: (u, v) -> (v, -u) =
    (0.25, -0.25); with offset (0.5, 0.5) it is (0.75, 0.25), the green texel.
    """
    transform = {"scale": [0.5, 0.5], "rotation": np.pi / 2, "offset": [0.5, 0.5]}
    model = Gltf().textured([(0.5, 0.5)] * 3, extensions={"KHR_texture_transform": transform})
    scene = load(tmp_path / "a.glb", model.glb())
    assert scene.uv[0] == pytest.approx((0.75, 0.75))  # bottom-up v
    assert texel(scene, scene.uv[0]) == GREEN
    assert any("texture transforms" in note for note in scene.notes)


def test_second_coordinates_and_normalised_integers(tmp_path):
    model = Gltf().textured([(0.0, 0.0)] * 3, texCoord=1)
    uv = np.array([[49151, 16384]] * 3)  # 0.75, 0.25
    attributes = model.tree["meshes"][0]["primitives"][0]["attributes"]
    attributes["TEXCOORD_1"] = model.accessor(uv, "u2", normalized=True)
    scene = load(tmp_path / "a.glb", model.glb())
    assert scene.uv[0] == pytest.approx((0.75, 0.75), abs=1e-4)  # 1 / 65535
    assert texel(scene, scene.uv[0]) == GREEN


def test_obj_with_texture(tmp_path):
    """OBJ counts v from the bottom row up; Kd beside a texture is not multiplied in."""
    Image.fromarray(PICTURE).save(tmp_path / "t.png")
    (tmp_path / "a.mtl").write_text(
        "newmtl m\nKd 0 0 0\nmap_Kd -s 1 1 1 t.png\nnewmtl k\nKd 0.25 0.5 0.003\n"
    )
    text = "mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nvt 0.25 0.75\n"
    text += "usemtl m\nf 1/1 2/1 3/1\nusemtl k\nf 1 2 4\n"
    scene = load(tmp_path / "a.obj", text)
    check(scene)
    painted = [m.texture is not None for m in scene.materials].index(True)
    face = int(np.flatnonzero(scene.face_material == painted)[0])
    assert texel(scene, scene.uv[scene.faces[face, 0]], painted) == RED
    assert scene.materials[painted].base_color == (1.0, 1.0, 1.0)
    assert scene.materials[1 - painted].base_color == pytest.approx((0.25, 0.5, 0.003))


def test_base_colour_emission_and_default_material(tmp_path):
    model = Gltf()
    model.tree["materials"] = [
        {
            "name": "lamp",
            "pbrMetallicRoughness": {"baseColorFactor": [0.5, 0.0007, 1, 1]},
            "emissiveFactor": [1, 0.5, 0],
            "extensions": {"KHR_materials_emissive_strength": {"emissiveStrength": 4}},
        }
    ]
    model.node(mesh=model.mesh(material=0))
    model.node(mesh=model.mesh())
    scene = load(tmp_path / "a.glb", model.glb())
    lamp, plain = scene.materials
    assert lamp.name == "lamp"
    assert lamp.base_color == pytest.approx((0.5, 0.0007, 1.0))  # not rounded to 8 bits
    assert lamp.emission == pytest.approx((4.0, 2.0, 0.0))
    assert plain.base_color == (1.0, 1.0, 1.0)  # the specification's default
    assert scene.face_material.tolist() == [0, 1]


def test_emissive_texture_becomes_its_mean(tmp_path):
    """Mean of linear light: two of the four texels are lit in each channel."""
    model = Gltf().textured([(0, 0)] * 3)
    model.tree["materials"][0] |= {"emissiveTexture": {"index": 0}, "emissiveFactor": [1, 1, 0.5]}
    scene = load(tmp_path / "a.glb", model.glb())
    assert scene.materials[0].emission == pytest.approx((0.5, 0.5, 0.25))
    assert any("emissive textures" in note for note in scene.notes)


def test_equal_pictures_are_one_texture(tmp_path):
    model = Gltf().textured([(0, 0)] * 3)
    model.tree["images"].append({"bufferView": model.view(png(PICTURE))})
    model.tree["textures"].append({"source": 1})
    model.tree["materials"].append({"pbrMetallicRoughness": {"baseColorTexture": {"index": 1}}})
    model.node(mesh=model.mesh(material=1))
    scene = load(tmp_path / "a.glb", model.glb())
    assert len(scene.materials) == 2
    assert scene.materials[0].texture is scene.materials[1].texture


def test_pictures_may_wait_until_somebody_looks(tmp_path, monkeypatch):
    """The same triangles and texels; one picture that two materials wear is decoded once."""
    model = Gltf().textured([(0, 0), (1, 0), (0, 1)])
    model.tree["materials"].append({"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}})
    model.node(mesh=model.mesh(material=1))
    now = load(tmp_path / "a.glb", model.glb())
    decode, decoded = gltf.decode_picture, []
    monkeypatch.setattr(gltf, "decode_picture", lambda *args, **kw: decoded.append(1) or decode(*args, **kw))
    later = load_mesh_scene(MeshSceneConfig(file=tmp_path / "a.glb"), pictures=False)
    for name in ("vertices", "faces", "normals", "uv", "face_material", "face_instance"):
        np.testing.assert_array_equal(getattr(later, name), getattr(now, name))
    textures = [material.texture for material in later.materials]
    assert textures[0] is textures[1]
    assert not decoded
    np.testing.assert_array_equal(textures[0].srgb, now.materials[0].texture.srgb)
    assert textures[0].srgb is textures[1].srgb
    assert len(decoded) == 1


@pytest.mark.parametrize("mode", ["L", "P", "RGBA", "I;16"])
def test_pictures_of_every_kind(tmp_path, mode):
    """Grey 200 whatever the picture's kind; 16 bits are scaled, not clipped."""
    if mode == "I;16":
        picture = Image.fromarray(np.full((2, 2), 200 * 257, dtype=np.uint16))
    else:
        picture = Image.new("RGB", (2, 2), (200, 200, 200))
        picture = picture.quantize(4) if mode == "P" else picture.convert(mode)
    stream = io.BytesIO()
    picture.save(stream, "PNG")
    model = Gltf().textured([(0, 0)] * 3)
    model.tree["images"] = [{"bufferView": model.view(stream.getvalue())}]
    scene = load(tmp_path / "a.glb", model.glb())
    assert texel(scene, (0.1, 0.1)) == (200, 200, 200)


def test_transparency_and_metal_are_noted(tmp_path):
    model = Gltf()
    pbr = {"baseColorFactor": [1, 1, 1, 0.2], "metallicFactor": 1.0}
    model.tree["materials"] = [{"alphaMode": "BLEND", "pbrMetallicRoughness": pbr}]
    model.node(mesh=model.mesh(material=0))
    notes = load(tmp_path / "a.glb", model.glb()).notes
    assert "1 materials with transparency are drawn opaque." in notes
    assert any("metallic" in note for note in notes)


def bilinear(scene: Scene, uv: NDArray[np.float64], material: int) -> NDArray[np.float64]:
    """Look up in linear light between texel centres, written independently of the renderer."""
    texture = scene.materials[material].texture
    assert texture is not None
    code = texture.srgb / 255.0
    linear = np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4)
    height, width = linear.shape[:2]
    x, y = uv[0] * width - 0.5, (1.0 - uv[1]) * height - 0.5
    i, j = int(np.floor(x)), int(np.floor(y))
    fx, fy = x - i, y - j
    rows = [linear[(j + b) % height, (i + a) % width] for b in (0, 1) for a in (0, 1)]
    return np.array([(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy]) @ np.array(rows)


def test_ply_vertex_colours_blend_linearly(tmp_path):
    """A point at weights (0.2, 0.3, 0.5) of a face has that blend of its corners' linear colours."""
    body = "0 0 0 255 0 0\n1 0 0 0 128 0\n0 1 0 0 0 255\n1 1 0 40 50 60\n3 0 1 2\n3 1 3 2\n"
    names = "".join(f"property float {a}\n" for a in "xyz")
    names += "".join(f"property uchar {c}\n" for c in ("red", "green", "blue"))
    text = f"ply\nformat ascii 1.0\nelement vertex 4\n{names}element face 2\n"
    scene = load(tmp_path / "a.ply", text + "property list uchar int vertex_indices\nend_header\n" + body)
    check(scene)
    weights = np.array([0.2, 0.3, 0.5])
    red, green, blue, grey = [255, 0, 0], [0, 128, 0], [0, 0, 255], [40, 50, 60]
    code = np.array([[red, green, blue], [green, grey, blue]]) / 255.0
    linear = np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4)
    for face in range(2):
        uv = weights @ scene.uv[scene.faces[face]]
        seen = bilinear(scene, uv, int(scene.face_material[face])) * scene.materials[0].base_color
        # the fourth texel, at weight 0.3 * 0.5, is clipped to [0, 1]; 8 bits are up to 0.0044 of linear light
        fourth = linear[face, 1] + linear[face, 2] - linear[face, 0]
        wanted = weights @ linear[face] + 0.15 * (np.clip(fourth, 0.0, 1.0) - fourth)
        assert seen == pytest.approx(wanted, abs=0.0045)


def test_face_colours(tmp_path):
    """Each face of a cube in its own colour, at every point of it."""
    box = trimesh.creation.box([1, 1, 1])
    colors = np.arange(12 * 3, dtype=np.uint8).reshape(12, 3) * 7
    box.visual = trimesh.visual.ColorVisuals(box, face_colors=np.c_[colors, np.full(12, 255, np.uint8)])
    box.export(tmp_path / "a.ply")
    scene = load_mesh_scene(MeshSceneConfig(file=tmp_path / "a.ply"))
    check(scene)
    for face in range(12):
        middle = scene.uv[scene.faces[face]].mean(axis=0)
        assert texel(scene, middle, int(scene.face_material[face])) == tuple(colors[face])


def test_one_colour_needs_no_texture(tmp_path):
    model = Gltf()
    colors = model.accessor(np.full((3, 4), 0.25))
    model.node(mesh=model.mesh(COLOR_0=colors))
    scene = load(tmp_path / "a.glb", model.glb())
    assert scene.materials[0].texture is None
    assert scene.materials[0].base_color == pytest.approx((0.25, 0.25, 0.25))


# geometry


def test_strip_fan_and_plain_order(tmp_path):
    """Each way of writing a unit square gives two triangles that face up."""
    square = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], dtype=np.float32)
    for mode, order in ((5, (0, 1, 2, 3)), (6, (0, 1, 3, 2)), (4, (0, 1, 2, 1, 3, 2))):
        for indexed in (True, False):
            model = Gltf()
            corners = square if indexed else square[list(order)]
            model.node(mesh=model.mesh(corners, order if indexed else None, mode=mode))
            scene = load(tmp_path / "a.glb", model.glb(), up_axis="z")
            assert face_normals(scene) == pytest.approx(np.array([[0, 0, 1], [0, 0, 1]]))
            assert area(scene) == pytest.approx(1.0)


def test_sparse_accessor(tmp_path):
    model = Gltf()
    model.node(mesh=model.mesh())
    where, what = model.view(np.array([1], "<u2").tobytes()), model.view(np.array([5, 0, 0], "<f4").tobytes())
    model.tree["accessors"][0]["sparse"] = {
        "count": 1,
        "indices": {"bufferView": where, "componentType": 5123},
        "values": {"bufferView": what},
    }
    scene = load(tmp_path / "a.glb", model.glb())
    assert scene.vertices[1] == pytest.approx((5, 0, 0))


def test_interleaved_vertices(tmp_path):
    model = Gltf()
    model.node(mesh=model.mesh())
    rows = np.c_[TRIANGLE * 3, np.ones((3, 3), np.float32)].astype("<f4")
    view = model.view(rows.tobytes())
    model.tree["bufferViews"][view]["byteStride"] = 24
    model.tree["accessors"][0] |= {"bufferView": view, "byteOffset": 0}
    assert load(tmp_path / "a.glb", model.glb(), up_axis="z").vertices == pytest.approx(TRIANGLE * 3)


def test_skin_stands_where_its_joints_stand(tmp_path):
    """A joint that moved by (0, 2, 0) since binding takes its vertex along; the mesh node does not count."""
    model = Gltf()
    joints = model.accessor([[0, 1, 0, 0]] * 3, "u1")
    weights = model.accessor([[1, 0, 0, 0], [0, 1, 0, 0], [0.5, 0.5, 0, 0]])
    first, second = model.node(), model.node(translation=[0, 5, 0])
    bind = np.tile(np.eye(4), (2, 1, 1))
    bind[1, 1, 3] = -3.0  # was at y = 3 when bound
    model.tree["skins"] = [{"joints": [first, second], "inverseBindMatrices": model.accessor(bind)}]
    model.node(mesh=model.mesh(JOINTS_0=joints, WEIGHTS_0=weights), skin=0, translation=[100, 0, 0])
    scene = load(tmp_path / "a.glb", model.glb(), up_axis="z")
    assert scene.vertices == pytest.approx(TRIANGLE + np.array([[0, 0, 0], [0, 2, 0], [0, 1, 0]]))


def test_degenerate_faces_are_dropped_and_counted(tmp_path):
    corners = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.1, 0.1, 0.3], [0.2, 0.2, 0.6], [0.7, 0.7, 2.1], [0, 0, 0]]
    faces = [(0, 1, 2), (0, 0, 1), (3, 4, 5), (0, 6, 1), (2, 1, 0)]
    model = Gltf()
    model.node(mesh=model.mesh(corners, faces), rotation=[0.2, 0.3, 0.4, 0.8])
    scene = load(tmp_path / "a.glb", model.glb())
    assert len(scene.faces) == 2
    assert "3 of 5 faces have no area and are dropped." in scene.notes
    check(scene)


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**31),
    count=st.integers(1, 30),
    repeated=st.integers(0, 5),
    scale=st.floats(1e-3, 1.5),  # larger ones would be rooms, where placing lamps takes a while
)
def test_area_is_kept(tmp_path_factory, seed, count, repeated, scale):
    """Random triangles, randomly turned: area times unit^2, and exactly the degenerate ones are gone."""
    random = np.random.default_rng(seed)
    corners = (random.uniform(-1, 1, (count, 3, 3)) * scale).astype(np.float32)
    wrong = corners[random.integers(0, count, repeated)]
    wrong[:, 2] = wrong[:, 0]
    model = Gltf()
    rotation = random.normal(size=4)
    everything = np.concatenate([corners, wrong]).reshape(-1, 3)
    model.node(mesh=model.mesh(everything, None), rotation=(rotation / np.linalg.norm(rotation)).tolist())
    scene = load(tmp_path_factory.mktemp("area") / "a.glb", model.glb(), unit_m=0.5)
    t = corners.astype(np.float64)
    expected = np.linalg.norm(np.cross(t[:, 1] - t[:, 0], t[:, 2] - t[:, 0]), axis=1).sum() / 2.0
    assert len(scene.faces) == count
    assert area(scene) == pytest.approx(0.25 * expected, rel=1e-4)  # slivers feel the rounding to float32
    check(scene)


# normals


def test_cube_is_sharp_and_sphere_is_smooth():
    box = trimesh.creation.box()
    normals, index = smooth_normals(box.vertices, box.faces, np.zeros(8, dtype=np.int64))
    assert len(normals) == 24
    assert normals[index] == pytest.approx(np.repeat(box.face_normals[:, None], 3, axis=1))
    ball = trimesh.creation.icosphere(subdivisions=3)
    normals, index = smooth_normals(ball.vertices, ball.faces, np.zeros(len(ball.vertices), dtype=np.int64))
    assert len(normals) == len(ball.vertices)
    assert np.einsum("fcx,fcx->fc", normals[index], ball.vertices[ball.faces]).min() > 0.9995


def test_normals_do_not_depend_on_how_a_flat_side_is_cut():
    """Angle weights: the edge of a bent sheet has the bisector, although one side is cut more often."""
    bend = 0.5
    side = [0.0, -np.cos(bend), -np.sin(bend)]
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], side, [1, *side[1:]], [0.2, *side[1:]]])
    faces = np.array([[0, 1, 3], [0, 3, 2], [4, 6, 0], [6, 5, 0], [5, 1, 0]])
    normals, index = smooth_normals(points, faces, np.zeros(7, dtype=np.int64))
    assert normals[index[0, 0]] == pytest.approx([0, -np.sin(bend / 2), np.cos(bend / 2)], abs=1e-9)
    assert index[0, 0] == index[1, 0] == index[2, 2] == index[3, 2] == index[4, 2]


def test_seams_are_smoothed_and_objects_are_not():
    """Vertices at one position are one, in one object."""
    bent = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 0], [1, 0, 0], [0, -1, 0.3]])
    faces = np.array([[0, 1, 2], [3, 5, 4]])
    one, _ = smooth_normals(bent, faces, np.zeros(6, dtype=np.int64))
    two, _ = smooth_normals(bent, faces, np.array([0, 0, 0, 1, 1, 1]))
    assert len(one) == 4
    assert len(two) == 6


# lights


def lit(kind: str, **light: Any) -> Gltf:
    model = Gltf()
    model.tree["extensions"] = {"KHR_lights_punctual": {"lights": [{"type": kind, **light}]}}
    model.node(mesh=model.mesh())
    model.node(extensions={"KHR_lights_punctual": {"light": 0}}, translation=[1, 2, 3])
    return model


def test_light_of_the_file(tmp_path):
    model = lit("point", intensity=100.0, color=[1, 0.5, 0.25])
    scene = load(tmp_path / "a.glb", model.glb(), light_scale=0.01)
    (light,) = scene.lights
    assert light.position_m == pytest.approx((1, -3, 2))
    assert light.intensity == pytest.approx((1.0, 0.5, 0.25))
    # by itself: the median surface at 0.3, whatever the candela
    for intensity in (1.0, 54351.0):
        scene = load(tmp_path / "a.glb", lit("point", intensity=intensity).glb())
        middle = scene.vertices.mean(axis=0)
        distance2 = float(((scene.lights[0].position_m - middle) ** 2).sum())
        assert scene.lights[0].intensity[0] / distance2 == pytest.approx(0.3, rel=0.1)


def test_a_scale_for_lights_that_are_not_there_is_refused(tmp_path):
    model = Gltf()
    model.node(mesh=model.mesh())
    with pytest.raises(
        SceneError, match=r"light_scale = 2 scales the lights of the file, and .*a\.glb has none"
    ):
        load(tmp_path / "a.glb", model.glb(), light_scale=2.0)


def test_sun_is_a_far_light(tmp_path):
    """It shines along the node's -z (here the file's -z, so the world's +y), 5 lx times 0.1 strong."""
    scene = load(tmp_path / "a.glb", lit("directional", intensity=5.0).glb(), light_scale=0.1)
    offset = np.array(scene.lights[0].position_m) - scene.vertices.mean(axis=0)
    distance = np.linalg.norm(offset)
    assert offset / distance == pytest.approx((0, -1, 0), abs=0.02)  # 20 diagonals away, from the middle
    assert scene.lights[0].intensity == pytest.approx(np.full(3, 0.5 * distance**2), rel=0.02)


@pytest.mark.parametrize("ceiling", [True, False])
def test_lamps_hang_in_every_room(tmp_path, ceiling):
    room(ceiling=ceiling).export(tmp_path / "flat.stl")
    scene = load_mesh_scene(MeshSceneConfig(file=tmp_path / "flat.stl"))
    assert any("no lights; " in note and "hung" in note for note in scene.notes)
    places = np.array([light.position_m for light in scene.lights])
    assert 2 <= len(places) <= 6
    assert (places[:, 0] < 4.9).any()
    assert (places[:, 0] > 5.1).any()
    assert ((places[:, 2] > 1.9) & (places[:, 2] < 2.8)).all()
    assert ((places > (0, 0, 0)) & (places < (10, 5, 3))).all()
    assert not ((places[:, 0] < CUPBOARD[1]) & (places[:, 1] > CUPBOARD[2])).any()


def test_things_are_lit_from_outside(tmp_path):
    trimesh.creation.box([0.1, 0.1, 0.1]).export(tmp_path / "dice.stl")
    scene = load_mesh_scene(MeshSceneConfig(file=tmp_path / "dice.stl"))
    assert all(np.linalg.norm(light.position_m) > 0.1 for light in scene.lights)


# what is refused


def broken(name: str) -> tuple[str, bytes | str]:
    """Return a suffix and the bytes of a file that cannot be used."""
    model = Gltf()
    if name == "nan":
        model.node(mesh=model.mesh([[0, 0, 0], [1, 0, 0], [0, np.nan, 0]]), name="bad")
    elif name == "nan in matrix":
        model.node(mesh=model.mesh(), translation=[float("nan"), 0, 0], name="bad")
    elif name == "all flat":
        model.node(mesh=model.mesh(TRIANGLE * 0))
    elif name == "huge":
        model.node(mesh=model.mesh(TRIANGLE * 1e6))
    elif name == "no mesh":
        model.node(name="nothing")
    elif name == "cycle":
        model.node(children=[0])
    elif name == "wrong vertex":
        model.node(mesh=model.mesh(faces=((0, 1, 7),)))
    elif name == "draco":
        model.tree["extensionsRequired"] = ["KHR_draco_mesh_compression"]
    elif name == "old":
        model.tree["asset"]["version"] = "1.0"
    elif name == "picture":
        model.textured([(0, 0)] * 3)
        model.tree["images"] = [{"bufferView": model.view(png(PICTURE)[:40])}]
    elif name == "texture file":
        model.textured([(0, 0)] * 3)
        model.tree["images"] = [{"uri": "wood%20floor.png"}]
    elif name == "malformed":
        model.node(mesh=3)
    else:
        return {
            "obj mtl": ("obj", "mtllib lost.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"),
            "stl": ("stl", trimesh.creation.box().export(file_type="stl")[:-20]),
            "ply": ("ply", trimesh.creation.box().export(file_type="ply")[:-20]),
            "json": ("gltf", Gltf().gltf()[:-9]),
            "no json": ("gltf", "hello"),
            "not glb": ("glb", "hello, this is no model"),
            "points": ("ply", trimesh.PointCloud(TRIANGLE).export(file_type="ply")),
            "no bytes": ("glb", b""),
            "empty obj": ("obj", "v 0 0 0\n"),
        }[name]
    return "glb", model.glb()


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("nan", "'bad' has NaN or infinite numbers in 1 corners"),
        ("nan in matrix", "'bad' has NaN or infinite numbers in its transform"),
        ("all flat", "empty, none of its 1 faces has an area"),
        ("huge", r"reaches 1,000,000 m from the origin, allowed are 20,000 m; declare unit_m"),
        ("no mesh", "empty, there are no triangles"),
        ("cycle", "node 0 has two parents or is its own ancestor"),
        ("wrong vertex", "uses vertex 7 of 3"),
        ("draco", "needs KHR_draco_mesh_compression"),
        ("old", "glTF version 1.0, only 2.x"),
        ("picture", "cannot be decoded"),
        ("texture file", r"texture file 'wood%20floor.png' is missing .* set missing_texture to 'ignore'"),
        ("malformed", "malformed glTF, it refers to number 3 of its meshes, of which there are 0"),
        ("obj mtl", "file 'lost.mtl' is missing .* set missing_texture to 'ignore'"),
        ("stl", "cannot be read as STL: truncated .* asks for 684 bytes, 664 are there"),
        ("ply", "cannot be read as PLY: .* may be truncated"),
        ("json", "not glTF, or truncated"),
        ("no json", "not glTF, or truncated"),
        ("not glb", "does not start with 'glTF'"),
        ("points", "empty, there are no triangles"),
        ("no bytes", "the file has no bytes"),
        ("empty obj", "empty, there are no triangles"),
    ],
)
def test_refused(tmp_path, name, message):
    suffix, data = broken(name)
    with pytest.raises(SceneError, match=message) as error:
        load(tmp_path / f"thing.{suffix}", data)
    assert "thing." in str(error.value)  # names the file


TEXT = b"v 0 0 0\nv 1 0 0\nv 0 1 0\n"


def ascii_of(suffix: str) -> bytes:
    """Return a cube of 12 triangles as text."""
    written = trimesh.creation.box().export(
        file_type={"stl": "stl_ascii"}.get(suffix, suffix),
        **({"encoding": "ascii"} if suffix == "ply" else {}),
    )
    return written if isinstance(written, bytes) else bytes(written.encode())


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "cp1252"])
def test_text_in_other_encodings(tmp_path, encoding):
    """Names and comments with an accent, in an OBJ file and in its materials; files so named are found."""
    material = "# café\nnewmtl café\nKd 0.25 0.5 0.75\nmap_Kd café.png\n"
    (tmp_path / "café.mtl").write_bytes(material.encode(encoding))
    Image.fromarray(PICTURE).save(tmp_path / "café.png")
    text = f"# café\nmtllib café.mtl\no café\n{TEXT.decode()}vt 0 0\nusemtl café\nf 1/1 2/1 3/1\n"
    scene = load(tmp_path / "a.obj", text.encode(encoding))
    assert scene.materials[0].texture is not None
    assert scene.materials[0].name == "café"


@pytest.mark.parametrize("suffix", ["ply", "binary ply", "stl", "stl_ascii", "off"])
def test_a_byte_that_is_not_utf8(tmp_path, suffix):
    if suffix == "binary ply":
        data = trimesh.creation.box().export(file_type="ply").replace(b"1.0\n", b"1.0\ncomment \xe9\n", 1)
    else:
        old, new = {
            "ply": (b"1.0\n", b"1.0\ncomment caf\xe9\n"),
            "off": (b"OFF\n", b"OFF\n# caf\xe9\n"),
        }.get(suffix, (b"solid", b"solid caf\xe9"))
        data = ascii_of(suffix).replace(old, new, 1)
    assert b"\xe9" in data
    assert len(load(tmp_path / f"a.{suffix.split()[-1]}", data).faces) == 12


@pytest.mark.parametrize(
    ("suffix", "data", "message"),
    [
        ("obj", TEXT + b"f 1 2 9\n", "a face in it uses a vertex that it does not have"),
        ("obj", b"v 0 zz 0\n" + TEXT + b"f 1 2 3\n", "a number in it is missing or malformed"),
        ("obj", b"v 0 0\nv 1 0\nv 0 1\nf 1 2 3\n", "have 2 coordinates, 3 are needed"),
        ("obj", bytes(range(256)), "it is not text"),
        ("stl", b"hello", "truncated, only 5 bytes"),
        ("stl", bytes(range(200, 256)) * 9, "truncated or not one; its header asks for"),
        ("stl", ascii_of("stl")[:-30], "truncated, there is no 'endsolid'"),
        ("ply", b"hello", "does not start with 'ply'"),
        ("ply", ascii_of("ply")[:60], "truncated, its header does not end"),
        ("ply", ascii_of("ply")[:-20], "truncated, 18 of 20 lines are there"),
        ("off", ascii_of("off")[:-20], "truncated, 20 of 22 lines are there"),
        ("off", b"hello", "cannot be read as OFF"),
    ],
)  # fmt: skip
def test_refused_in_words(tmp_path, suffix, data, message):
    with pytest.raises(SceneError, match=message) as error:
        load(tmp_path / f"thing.{suffix}", data)
    assert "thing." in str(error.value)
    assert "Error" not in str(error.value)  # no name of a Python exception


def test_a_package_that_is_missing_is_no_truncated_file(tmp_path, monkeypatch):
    def load_scene(*_: Any, **__: Any) -> None:
        raise ModuleNotFoundError("No module named 'lost'", name="lost")

    monkeypatch.setattr(trimesh, "load_scene", load_scene)
    with pytest.raises(SceneError, match="needs the Python package 'lost'; install it") as error:
        load(tmp_path / "a.obj", TEXT + b"f 1 2 3\n")
    assert "truncated" not in str(error.value)


@pytest.mark.parametrize(
    ("tree", "message"),
    [
        ({"nodes": [{"mesh": 0}]}, "number 0 of its meshes, of which there are 0"),
        ({"nodes": [{"mesh": -1}], "meshes": [{"primitives": []}]}, "number -1 of its meshes"),
        ({"nodes": [{"mesh": "x"}], "meshes": []}, "number 'x' of its meshes"),
        ({"nodes": [{"mesh": 0}], "meshes": {}}, "number 0 of its meshes"),
        ({"nodes": [{"mesh": 0}], "meshes": [{}]}, "'primitives' is missing in it, or not known"),
        ({"nodes": [7]}, "number 0 of its nodes is no JSON object"),
        ({"nodes": [{"scale": {}}]}, "an entry of it is of the wrong kind"),
        ({"nodes": [{"matrix": [1, 2]}]}, "an entry of it has the wrong form"),
        ({"nodes": []}, "number 0 of its nodes, of which there are 0"),
    ],
)
def test_malformed_gltf_in_words(tmp_path, tree, message):
    everything = {"asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], **tree}
    with pytest.raises(SceneError, match=rf"a\.gltf: malformed glTF, .*{message}") as error:
        load(tmp_path / "a.gltf", json.dumps(everything))
    assert "Error" not in str(error.value)


@pytest.mark.parametrize("share", [0.0, 0.01, 0.3, 0.7, 0.999])
def test_truncated_glb(tmp_path, share):
    data = Gltf().textured([(0, 0)] * 3).glb()
    with pytest.raises(SceneError, match=r"t\.glb: (truncated|empty|not a GLB)"):
        load(tmp_path / "t.glb", data[: int(share * len(data))])


def test_truncated_buffer_file(tmp_path):
    model = Gltf()
    model.node(mesh=model.mesh())
    model.tree["buffers"] = [{"uri": "a b.bin", "byteLength": len(model.data)}]
    with pytest.raises(SceneError, match=r"buffer file 'a b.bin' is missing"):
        load(tmp_path / "t.gltf", json.dumps(model.tree))
    (tmp_path / "a b.bin").write_bytes(model.data[:-1])
    with pytest.raises(SceneError, match="truncated, buffer 0"):
        load(tmp_path / "t.gltf", json.dumps(model.tree))
    (tmp_path / "a b.bin").write_bytes(model.data)
    assert len(load(tmp_path / "t.gltf", json.dumps(model.tree)).faces) == 1


def test_missing_files_can_be_ignored(tmp_path):
    for name in ("texture file", "obj mtl"):
        suffix, data = broken(name)
        scene = load(tmp_path / f"a.{suffix}", data, missing_texture="ignore")
        assert any("issing" in note for note in scene.notes)
        assert all(material.texture is None for material in scene.materials)


def test_a_picture_of_a_ply_that_is_missing_is_told_once(tmp_path, caplog):
    data = ascii_of("ply").replace(b"1.0\n", b"1.0\ncomment TextureFile lost.jpg\n", 1)
    with pytest.raises(SceneError, match=r"file 'lost.jpg' is missing .* set missing_texture to 'ignore'"):
        load(tmp_path / "a.ply", data)
    assert not caplog.records


def test_no_file_directory_and_format(tmp_path):
    with pytest.raises(SceneError, match=r"gone\.glb: no such file"):
        load_mesh_scene(MeshSceneConfig(file=tmp_path / "gone.glb"))
    with pytest.raises(SceneError, match="a directory; name a mesh file in it"):
        load_mesh_scene(MeshSceneConfig(file=tmp_path))
    (tmp_path / "a.docx").write_text("x")
    with pytest.raises(SceneError, match=r"unknown format '\.docx', known: .*glb.*obj.*ply.*stl"):
        load_mesh_scene(MeshSceneConfig(file=tmp_path / "a.docx"))


@pytest.mark.parametrize("bad", [{"unit_m": 0.0}, {"unit_m": -1.0}, {"up_axis": "w"}, {"scale": 2.0}])
def test_config_is_checked(bad):
    with pytest.raises(ConfigError, match=next(iter(bad))):
        MeshSceneConfig(file=Path("a.glb"), **bad)


# real files


def test_house(house):
    scene = load_mesh_scene(MeshSceneConfig(file=house))
    check(scene)
    assert len(scene.faces) == 145_844 - 4
    assert "4 of 145844 faces have no area and are dropped." in scene.notes
    assert np.ptp(scene.bounds_m, axis=0) == pytest.approx((19.0, 11.4, 3.0), abs=0.01)
    assert len(scene.instance_names) == 108
    assert len({id(m.texture) for m in scene.materials if m.texture}) == 64
    assert scene.notes[1].startswith("Up axis: z, from the geometry")
    floor = face_normals(scene)[:, 2] > 0.99
    assert np.median(scene.vertices[scene.faces[floor]][..., 2]) < 1.5
    # all pieces of furniture stand on the same side of the floor, the lamps hang inside
    assert all(1.9 < light.position_m[2] < 3.0 and abs(light.position_m[0]) < 9.5 for light in scene.lights)


ASSETS = {
    "objects/5boxes.glb": (60, (10.414, 6.414, 6.0)),
    "objects/chair.glb": (1008, (0.521, 0.433, 0.900)),
    "objects/donut.glb": (8736, (0.227, 0.218, 0.077)),
    "objects/nested_box.glb": (24, (1.034, 0.878, 0.639)),
    "objects/skinned_prism.glb": (768, (2.0, 2.0, 6.0)),
    "objects/sphere.glb": (1280, (0.5, 0.5, 0.5)),
    "objects/transform_box.glb": (12, (2.0, 2.0, 2.0)),
    "scenes/plane.glb": (2048, (200.0, 0.0, 200.0)),
    "scenes/simple_room.glb": (84, (10.527, 10.847, 2.215)),
    "scenes/stage_floor1.glb": (2048, (19.998, 19.998, 1.871)),
}
"""Number of faces; size in x, y, z after loading [m]."""


@pytest.mark.parametrize("name", ASSETS)
def test_small_assets(small_assets, name):
    scene = load_mesh_scene(MeshSceneConfig(file=small_assets / name))
    check(scene)
    count, size = ASSETS[name]
    assert len(scene.faces) == count
    assert np.ptp(scene.bounds_m, axis=0) == pytest.approx(size, abs=0.002)
    independent = trimesh.load_scene(small_assets / name, process=False).to_mesh()
    assert area(scene) == pytest.approx(independent.area, rel=1e-4)  # slivers feel the rounding to float32
