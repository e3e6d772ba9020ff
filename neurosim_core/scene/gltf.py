"""glTF 2.0 (.gltf, .glb): geometry, node tree, materials, textures and lights of the default scene.

Read here rather than with trimesh, whose reader rounds base colours to 8 bits and leaves out sparse and
normalised accessors, second texture coordinate sets, texture transforms, skins and KHR_lights_punctual.
Reference: Khronos glTF 2.0 specification; KHR_lights_punctual, KHR_texture_transform,
KHR_materials_emissive_strength, KHR_materials_pbrSpecularGlossiness, KHR_mesh_quantization, EXT_texture_webp.
"""

from __future__ import annotations

import json
import math
import struct
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurosim_core.scene.gltf_file import UNREADABLE, GltfFile
from neurosim_core.scene.scene import Material, Texture
from neurosim_core.scene.source import (
    Lamp,
    Part,
    SceneError,
    Source,
    decode_picture,
    rgb,
    unique_name,
)
from neurosim_core.scene.srgb import srgb_to_linear

_MAX_DEPTH = 256
_REPEAT = 10497  # the code of a texture that wraps around
_LABELS = ("semantic", "class", "category", "label")
"""Keys of extras that say what an object is."""


def read_gltf(path: Path, *, textures_required: bool, pictures: bool = True) -> Source:
    """Read the default scene of a glTF file, .gltf or .glb.

    A texture file that is not there is an error if `textures_required`, else noted and left out. Textures are
    decoded at the first look at them, which raises what is wrong; with `pictures` emissive ones are here.

    Raises:
        SceneError: If the file is truncated, malformed, or needs an extension that is not read.
    """
    try:
        return _Reader(path, textures_required=textures_required, pictures=pictures).read()
    except (KeyError, IndexError, TypeError, AttributeError, struct.error, ValueError) as error:
        if isinstance(error, SceneError):
            raise
        if isinstance(error, KeyError):
            wrong = f"{error.args[0]!r} is missing in it, or not known"
        elif isinstance(error, IndexError):
            wrong = "a number in it points past the end of a list"
        elif isinstance(error, (TypeError, AttributeError)):
            wrong = "an entry of it is of the wrong kind"
        else:
            wrong = f"an entry of it has the wrong form ({error})"
        raise SceneError(f"{path}: malformed glTF, {wrong}; a glTF 2.0 validator says where") from error


class _Reader:
    def __init__(self, path: Path, *, textures_required: bool, pictures: bool) -> None:
        self.path = path
        self.file = GltfFile(path)
        self.textures_required = textures_required
        self.pictures = pictures
        self.textures: dict[int, Texture | None] = {}
        self.pictures_read: dict[bytes, Texture] = {}
        self.source = Source(unit_reason="glTF is in metres by specification", up_default="y")

    def _texture(self, reference: dict[str, Any] | None) -> Texture | None:
        """Return what a texture reference stands for, the same for pictures of the same bytes; None: nothing.

        See `read_gltf` for a picture whose file is not there.
        """
        if not reference:
            return None
        entry = self.file.entry("textures", reference["index"])
        webp = entry.get("extensions", {}).get("EXT_texture_webp", {})
        index = int(entry.get("source", webp.get("source", -1)))
        if index >= 0 and index not in self.textures:
            self.textures[index] = self._picture(index)
        return self.textures.get(index)

    def _picture(self, index: int) -> Texture | None:
        image = self.file.entry("images", index)
        uri = image.get("uri")
        name = image.get("name") or (uri if uri and not uri.startswith("data:") else f"image {index}")
        if "bufferView" in image:
            data: bytes | None = bytes(self.file.view(image["bufferView"])[0])
        else:
            data = self.file.uri_bytes(image["uri"])
        if data is None:
            if self.textures_required:
                raise SceneError(
                    f"{self.path}: texture file {uri!r} is missing beside it; put it there, or "
                    "set missing_texture to 'ignore' to use the base colour alone"
                )
            return None
        if data not in self.pictures_read:
            decode = partial(decode_picture, data, file=str(self.path), name=name)
            self.pictures_read[data] = Texture(name=name, srgb=decode)
        return self.pictures_read[data]

    def _materials(self) -> list[dict[str, Any]]:
        """Fill the materials; return for each how its texture coordinates are found."""
        # the last one: the specification's default material
        entries = [*self.file.tree.get("materials", []), {}]
        taken: set[str] = set()
        coordinates = []
        see_through = metallic = glowing = transformed = clamped = 0
        for index, entry in enumerate(entries):
            extensions = entry.get("extensions", {})
            glossy = extensions.get("KHR_materials_pbrSpecularGlossiness")
            if glossy is not None:
                factor, info = glossy.get("diffuseFactor", [1, 1, 1, 1]), glossy.get("diffuseTexture")
            else:
                pbr = entry.get("pbrMetallicRoughness", {})
                factor, info = pbr.get("baseColorFactor", [1, 1, 1, 1]), pbr.get("baseColorTexture")
            strength = extensions.get("KHR_materials_emissive_strength", {}).get("emissiveStrength", 1.0)
            glow = np.asarray(entry.get("emissiveFactor", [0, 0, 0]), dtype=np.float64) * strength
            texture, emissive = self._texture(info), self._texture(entry.get("emissiveTexture"))
            if emissive is not None and self.pictures and glow.any():
                glow = glow * srgb_to_linear(emissive.srgb).mean(axis=(0, 1), dtype=np.float64)
                glowing += 1
            self.source.materials.append(
                Material(
                    name=unique_name(entry.get("name") or f"material {index}", taken),
                    base_color=rgb(np.clip(np.asarray(factor, dtype=np.float64), 0.0, 1.0)),
                    texture=texture,
                    emission=rgb(np.maximum(glow, 0.0)),
                )
            )
            see_through += entry.get("alphaMode", "OPAQUE") != "OPAQUE"
            metallic += bool(entry) and self._is_metal(entry)
            info = info or {}
            transform = info.get("extensions", {}).get("KHR_texture_transform", {})
            transformed += bool(transform)
            clamped += bool(info) and self._is_clamped(self.file.entry("textures", info["index"]))
            where = transform.get("texCoord", info.get("texCoord", 0))
            coordinates.append({"set": where, "transform": transform})
        if missing := sum(texture is None for texture in self.textures.values()):
            self.source.notes.append(f"{missing} texture files are missing; base colours are used alone.")
        for count, text in (
            (see_through, "materials with transparency are drawn opaque"),
            (metallic, "metallic materials are drawn as Lambertian surfaces of their base colour"),
            (glowing, "emissive textures are replaced by their mean"),
            (transformed, "texture transforms are applied to the texture coordinates"),
            (clamped, "textures that ask for clamping or mirroring wrap around instead"),
        ):
            if count:
                self.source.notes.append(f"{count} {text}.")
        return coordinates

    def _is_clamped(self, texture: dict[str, Any]) -> bool:
        if "samplers" not in self.file.tree or "sampler" not in texture:
            return False
        sampler = self.file.entry("samplers", texture["sampler"])
        return any(sampler.get(key, _REPEAT) != _REPEAT for key in ("wrapS", "wrapT"))

    @staticmethod
    def _is_metal(entry: dict[str, Any]) -> bool:
        pbr = entry.get("pbrMetallicRoughness")
        return (
            pbr is not None and "metallicRoughnessTexture" not in pbr and pbr.get("metallicFactor", 1.0) > 0.5
        )

    @staticmethod
    def _local(node: dict[str, Any]) -> NDArray[np.float64]:
        if "matrix" in node:
            return np.asarray(np.asarray(node["matrix"], dtype=np.float64).reshape(4, 4).T)
        matrix = np.eye(4)
        rotation = np.asarray(node.get("rotation", [0, 0, 0, 1]), dtype=np.float64)
        if np.linalg.norm(rotation) > 0.0:
            matrix[:3, :3] = _rotation(rotation)
        matrix[:3, :3] *= np.asarray(node.get("scale", [1, 1, 1]), dtype=np.float64)
        matrix[:3, 3] = node.get("translation", [0, 0, 0])
        return matrix

    def _world(self) -> dict[int, NDArray[np.float64]]:
        """Return the matrix of each node of the default scene, parents before children."""
        nodes = self.file.tree.get("nodes", [])
        if "scenes" in self.file.tree:
            roots = self.file.entry("scenes", self.file.tree.get("scene", 0)).get("nodes", [])
        else:
            children = {child for node in nodes for child in node.get("children", [])}
            roots = [index for index in range(len(nodes)) if index not in children]
        world: dict[int, NDArray[np.float64]] = {}
        stack = [(root, np.eye(4), 0) for root in reversed(roots)]
        while stack:
            index, parent, depth = stack.pop()
            if depth > _MAX_DEPTH or index in world:
                raise SceneError(f"{self.path}: node {index} has two parents or is its own ancestor")
            node = self.file.entry("nodes", index)
            world[index] = parent @ self._local(node)
            stack.extend((child, world[index], depth + 1) for child in reversed(node.get("children", [])))
        return world

    def read(self) -> Source:
        source = self.source
        coordinates = self._materials()
        world = self._world()
        primitives: dict[int, list[tuple[Part, Any]]] = {}
        taken: set[str] = set()
        for index, matrix in world.items():
            node = self.file.tree["nodes"][index]
            if "light" in node.get("extensions", {}).get("KHR_lights_punctual", {}):
                self._lamp(node["extensions"]["KHR_lights_punctual"]["light"], matrix)
            if "mesh" not in node:
                continue
            mesh = self.file.entry("meshes", node["mesh"])
            if node["mesh"] not in primitives:
                primitives[node["mesh"]] = self._primitives(mesh, coordinates)
            name = unique_name(node.get("name") or mesh.get("name") or f"node {index}", taken)
            for primitive, skin in primitives[node["mesh"]]:
                part = replace(primitive, name=name, matrix=matrix, instance=len(source.instance_names))
                if "skin" in node and skin is not None:
                    part.positions = self._posed(part, skin, self.file.entry("skins", node["skin"]), world)
                    part.matrix, part.normals = np.eye(4), None
                source.parts.append(part)
            source.instance_names.append(name)
            extras = {**_extras(mesh), **_extras(node)}
            if label := next((extras[key] for key in _LABELS if isinstance(extras.get(key), str)), ""):
                source.instance_labels[name] = label
        self._orientation()
        return source

    def _primitives(self, mesh: dict[str, Any], coordinates: list[dict[str, Any]]) -> list[tuple[Part, Any]]:
        """Return the parts of a mesh, without a name and a place, and how each is skinned."""
        parts = []
        for primitive in mesh["primitives"]:
            mode = primitive.get("mode", 4)
            attributes = primitive["attributes"]
            if mode not in (4, 5, 6) or "POSITION" not in attributes:
                self.source.notes.append(f"Points and lines of {mesh.get('name', 'a mesh')!r} are left out.")
                continue
            for name in primitive.get("extensions", {}):
                if name in UNREADABLE:
                    raise SceneError(
                        f"{self.path}: uses {name}, which is not read; export it again without it"
                    )
            positions = self.file.accessor(attributes["POSITION"]).astype(np.float64)
            if "indices" in primitive:
                order = self.file.accessor(primitive["indices"])[:, 0].astype(np.int64)
            else:
                order = np.arange(len(positions), dtype=np.int64)
            faces = _triangles(order, mode)
            if faces.size and faces.max() >= len(positions):
                raise SceneError(
                    f"{self.path}: mesh {mesh.get('name', '')!r} uses vertex {faces.max()} of "
                    f"{len(positions)}"
                )
            material = primitive.get("material", len(coordinates) - 1)
            if "material" in primitive:
                self.file.entry("materials", material)
            where = coordinates[material]
            uv = None
            if f"TEXCOORD_{where['set']}" in attributes:
                uv = self.file.accessor(attributes[f"TEXCOORD_{where['set']}"]).astype(np.float64)
                uv = _transformed(uv, where["transform"])
                uv[:, 1] = 1.0 - uv[:, 1]  # glTF counts v from the top row down
            colors = None
            if "COLOR_0" in attributes:
                colors = self.file.accessor(attributes["COLOR_0"])[:, :3].astype(np.float64)[faces]
            skin = None
            if "JOINTS_0" in attributes and "WEIGHTS_0" in attributes:
                skin = (
                    self.file.accessor(attributes["JOINTS_0"]).astype(np.int64),
                    self.file.accessor(attributes["WEIGHTS_0"]).astype(np.float64),
                )
            normals = None
            if "NORMAL" in attributes:
                normals = self.file.accessor(attributes["NORMAL"]).astype(np.float64)
            if "targets" in primitive and any(mesh.get("weights", [])):
                for weight, target in zip(mesh["weights"], primitive["targets"], strict=False):
                    if "POSITION" in target:
                        positions = positions + weight * self.file.accessor(target["POSITION"])
                normals = None
            part = Part(
                name="",
                positions=positions,
                faces=faces,
                matrix=np.eye(4),
                normals=normals,
                uv=uv,
                corner_color=colors,
                material=material,
            )
            parts.append((part, skin))
        return parts

    def _posed(
        self, part: Part, skin: Any, entry: dict[str, Any], world: dict[int, NDArray[np.float64]]
    ) -> NDArray[np.float64]:
        """Return skinned vertices, with the joints where the node tree has them."""
        joints, weights = skin
        bind = np.tile(np.eye(4), (len(entry["joints"]), 1, 1))
        if "inverseBindMatrices" in entry:
            bind = self.file.accessor(entry["inverseBindMatrices"]).reshape(-1, 4, 4).transpose(0, 2, 1)
        pose = np.stack([world.get(joint, np.eye(4)) for joint in entry["joints"]]) @ bind
        total = weights.sum(axis=1, keepdims=True)
        blend = np.einsum("vk,vkij->vij", weights / np.where(total > 0.0, total, 1.0), pose[joints])
        note = "Skinned meshes stand in the pose of the file's node tree; animation is not played."
        if note not in self.source.notes:
            self.source.notes.append(note)
        return np.einsum("vij,vj->vi", blend[:, :3, :3], part.positions) + blend[:, :3, 3]

    def _lamp(self, index: int, matrix: NDArray[np.float64]) -> None:
        light = self.file.tree["extensions"]["KHR_lights_punctual"]["lights"][index]
        intensity = np.asarray(light.get("color", [1, 1, 1]), dtype=np.float64) * light.get("intensity", 1.0)
        if not intensity.any():
            return
        directional = light["type"] == "directional"
        if light["type"] == "spot":
            self.source.notes.append(f"Spot light {light.get('name', index)!r} shines in all directions.")
        self.source.lamps.append(
            Lamp(
                kind="directional" if directional else "point",
                vector=-matrix[:3, 2] if directional else matrix[:3, 3],
                intensity=rgb(intensity),
            )
        )

    def _orientation(self) -> None:
        """Find what the file says about up: extras, then a Habitat settings file, then its generator."""
        source = self.source
        scenes = self.file.tree.get("scenes") or [{}]
        for holder in (self.file.tree.get("asset", {}), scenes[self.file.tree.get("scene", 0)]):
            extras = holder.get("extras")
            for key in ("up_axis", "upAxis", "up"):
                value = extras.get(key) if isinstance(extras, dict) else None
                if isinstance(value, str) and value.lower()[:1] in ("x", "y", "z"):
                    source.up_axis = value.lower()[0]  # type: ignore[assignment]
                    source.up_reason = f"the file's extras say {key} = {value!r}"
                    return
        for kind in ("stage", "object"):
            beside = self.path.with_name(f"{self.path.stem}.{kind}_config.json")
            if not beside.is_file():
                continue
            try:
                up = json.loads(beside.read_text()).get("up")
            except (OSError, ValueError, AttributeError) as error:
                raise SceneError(
                    f"{beside}: cannot be read ({error}); repair it or declare up_axis"
                ) from error
            axis = {(1, 0, 0): "x", (0, 1, 0): "y", (0, 0, 1): "z"}.get(tuple(up)) if up else None
            if axis is not None:
                source.up_axis = axis  # type: ignore[assignment]
                source.up_reason = f"{beside.name} beside it says up = {up}"
                return
        generator = str(self.file.tree.get("asset", {}).get("generator", ""))
        if "trimesh" in generator.lower():
            source.up_reason = (
                "glTF is y up by specification, though its writer, trimesh, stores any axes as they are"
            )
        else:
            source.up_axis = "y"
            source.up_reason = "glTF is y up by specification"


def _rotation(quaternion: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the matrix of a quaternion (xyzw) of any length; SciPy's takes 0.2 ms for each."""
    x, y, z, w = quaternion.tolist()
    length = math.sqrt(x * x + y * y + z * z + w * w)
    x, y, z, w = x / length, y / length, z / length, w / length
    xx, yy, zz, ww = x * x, y * y, z * z, w * w
    return np.array(
        [
            [xx - yy - zz + ww, 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), -xx + yy - zz + ww, 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), -xx - yy + zz + ww],
        ]
    )


def _triangles(order: NDArray[np.int64], mode: int) -> NDArray[np.int64]:
    """Return faces [F, 3] of a triangle list (4), strip (5) or fan (6)."""
    if mode == 4:
        return order[: len(order) // 3 * 3].reshape(-1, 3)
    count = max(len(order) - 2, 0)
    k = np.arange(count)
    if mode == 6:
        return np.stack([np.repeat(order[:1], count), order[k + 1], order[k + 2]], axis=1)
    odd = k % 2
    return np.stack([order[k], order[k + 1 + odd], order[k + 2 - odd]], axis=1)


def _transformed(uv: NDArray[np.float64], transform: dict[str, Any]) -> NDArray[np.float64]:
    """Apply a KHR_texture_transform: scale, rotate counter-clockwise as seen on the picture, offset."""
    if not transform:
        return uv
    angle = transform.get("rotation", 0.0)
    scaled = uv * np.asarray(transform.get("scale", [1.0, 1.0]), dtype=np.float64)
    turn = np.array(
        [[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]]
    )  # v points down
    return np.asarray(scaled @ turn.T + np.asarray(transform.get("offset", [0.0, 0.0]), dtype=np.float64))


def _extras(holder: dict[str, Any]) -> dict[str, Any]:
    extras = holder.get("extras")
    return extras if isinstance(extras, dict) else {}
