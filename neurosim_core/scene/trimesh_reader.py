"""Reads the mesh files that trimesh knows: OBJ, PLY, STL, OFF and more. glTF has a reader of its own."""

from __future__ import annotations

import hashlib
import io
import logging
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from trimesh.exchange.load import mesh_formats

from neurosim_core.scene.scene import Material, Texture
from neurosim_core.scene.source import (
    Part,
    SceneError,
    Source,
    decode_picture,
    rgb,
    unique_name,
)
from neurosim_core.scene.srgb import srgb_to_linear


def formats() -> frozenset[str]:
    """Return the suffixes of the files that trimesh reads."""
    return frozenset(mesh_formats())


class _Files(trimesh.resolvers.FilePathResolver):
    """Finds files beside a mesh file, and remembers which it did not find."""

    def __init__(self, path: Path) -> None:
        super().__init__(str(path))
        self.missing: list[str] = []

    def get(self, name: str) -> bytes:
        name = name.strip().replace("\\", "/")
        for candidate in (
            name,
            name.split()[-1] if name else name,
        ):  # map_Kd may have options before the name
            file = Path(self.parent) / candidate
            if candidate and file.is_file():
                return _utf8(file) if file.suffix.lower() == ".mtl" else file.read_bytes()
        self.missing.append(name)
        raise FileNotFoundError(name)


class _TextureStore:
    """Gives out one `Texture` per distinct picture."""

    def __init__(self) -> None:
        self._by_pixels: dict[bytes, Texture] = {}

    def add(self, srgb: NDArray[np.uint8], *, name: str) -> Texture:
        """Return the texture with these texels (uint8 [H, W, 3]), a known one where there is one."""
        key = hashlib.blake2b(srgb.tobytes(), digest_size=16).digest() + repr(srgb.shape).encode()
        return self._by_pixels.setdefault(key, Texture(name=name, srgb=srgb))


def read_with_trimesh(path: Path, suffix: str, *, textures_required: bool) -> Source:
    """Read a file of one of `formats`; a picture that is not there is an error if `textures_required`.

    Raises:
        SceneError: It cannot be read.
    """
    files = _Files(path)
    options: dict[str, Any] = {"split_objects": True} if suffix == "obj" else {}
    data = _checked(path, suffix)
    log = logging.getLogger("trimesh")
    level = log.level
    log.setLevel(logging.CRITICAL)  # it shows tracebacks of files that are missing, which are told below
    try:
        loaded = trimesh.load_scene(
            io.BytesIO(data), file_type=suffix, resolver=files, process=False, **options
        )
    except SceneError:
        raise
    except ImportError as error:
        raise SceneError(
            f"{path}: reading this {suffix.upper()} file needs the Python package {error.name!r}; install "
            "it, or export the file as GLB"
        ) from error
    except Exception as error:  # trimesh's many readers raise whatever Python raises on their way
        wrong = (
            "a face in it uses a vertex that it does not have"
            if isinstance(error, LookupError)
            else "a number in it is missing or malformed"
        )
        raise SceneError(
            f"{path}: cannot be read as {suffix.upper()}: {wrong}. It may be truncated, or of another "
            "format; export it again"
        ) from error
    finally:
        log.setLevel(level)
    source = Source(up_default="y" if suffix == "obj" else "z")
    source.up_reason = f"{suffix.upper()} files do not say which way is up"
    if files.missing:
        names = ", ".join(repr(name) for name in files.missing)
        if textures_required:
            raise SceneError(
                f"{path}: file {names} is missing beside it; put it there, or set missing_texture to "
                "'ignore' to go on without"
            )
        source.notes.append(f"Missing beside the file and left out: {names}.")
    source.unit_reason = f"{suffix.upper()} files have no unit, metres are assumed"
    if loaded.units is not None and suffix not in ("obj", "ply", "stl"):
        source.unit_m = float(trimesh.units.unit_conversion(loaded.units, "meters"))
        source.unit_reason = f"the file is in {loaded.units}"
    store, materials, taken = _TextureStore(), dict[int, int](), set[str]()
    ignored = 0
    for node in loaded.graph.nodes_geometry:
        matrix, geometry = loaded.graph[node]
        mesh = loaded.geometry[geometry]
        if not isinstance(mesh, trimesh.Trimesh):
            ignored += 1
            continue
        faces = np.asarray(mesh.faces, dtype=np.int64)
        if np.shape(mesh.vertices)[1] != 3:
            raise SceneError(
                f"{path}: the vertices of {geometry!r} have {np.shape(mesh.vertices)[1]} coordinates, "
                "3 are needed"
            )
        if faces.size and not 0 <= faces.min() <= faces.max() < len(mesh.vertices):
            raise SceneError(f"{path}: {geometry!r} uses vertex {faces.max()} of {len(mesh.vertices)}")
        material, uv, color = _appearance(mesh, source, materials, store, path)
        normals = mesh._cache.cache.get(
            "vertex_normals"
        )  # only what the file had; the property would compute it
        source.parts.append(
            Part(
                name=str(node),
                positions=np.asarray(mesh.vertices, dtype=np.float64),
                faces=faces,
                matrix=np.asarray(matrix, dtype=np.float64),
                normals=None if normals is None else np.asarray(normals, dtype=np.float64),
                uv=uv,
                corner_color=color,
                material=material,
                instance=len(source.instance_names),
            )
        )
        source.instance_names.append(unique_name(str(node), taken))
    if ignored:
        source.notes.append(f"{ignored} objects of points and lines are left out.")
    return source


def _utf8(path: Path, data: bytes | None = None) -> bytes:
    """Return a text file, or `data` out of it, in UTF-8: it may also be UTF-16 or Windows-1252 (Latin 1)."""
    data = path.read_bytes() if data is None else data
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        text = data.decode("utf-16", errors="replace")
    else:
        try:
            text = data.decode("utf-8-sig")
        except UnicodeDecodeError:
            text = data.decode("cp1252", errors="replace")
    if "\0" in text:
        raise SceneError(f"{path}: cannot be read as {path.suffix[1:].upper()}: it is not text")
    return text.encode()


def _checked(path: Path, suffix: str) -> bytes:
    """Return a mesh file, its text in UTF-8; refuse those that trimesh would read in part, or as empty."""
    data = path.read_bytes()
    if suffix == "stl":
        expected = 84 + 50 * int.from_bytes(data[80:84], "little")
        if len(data) >= 84 and len(data) == expected:
            return data
        if data.lstrip()[:5].lower() != b"solid" or b"\0" in data:
            _require(len(data) >= 84, path, suffix, f"truncated, only {len(data)} bytes, or not one")
            asked = f"its header asks for {expected} bytes, {len(data)} are there"
            _require(False, path, suffix, f"truncated or not one; {asked}")
    if suffix in ("stl", "stl_ascii"):
        text = _utf8(path, data)
        _require(b"endsolid" in text.lower(), path, "stl", "truncated, there is no 'endsolid' at its end")
        return text
    if suffix == "off":
        text = _utf8(path, data)
        lines = [line for line in (line.partition(b"#")[0].split() for line in text.splitlines()) if line]
        counts = [word for line in lines[:2] for word in line if word.isdigit()][:2]
        expected = sum(map(int, counts)) + (len(lines[0]) == 1) + 1
        missing = f"truncated, {len(lines)} of {expected} lines are there"
        _require(len(lines) >= expected, path, suffix, missing)
        return text
    if suffix != "ply":
        return _utf8(path, data)
    _require(data.startswith(b"ply"), path, suffix, "it does not start with 'ply'")
    head, mark, body = data.partition(b"end_header")
    _require(bool(mark), path, suffix, "truncated, its header does not end")
    head = _utf8(path, head)
    if b"format ascii" in head:
        body = _utf8(path, body)
        words = [line.split() for line in head.splitlines()]
        expected = sum(int(w[2]) for w in words if w[:1] == [b"element"] and w[2:] and w[2].isdigit())
        there = sum(bool(line.strip()) for line in body.splitlines())
        _require(there >= expected, path, suffix, f"truncated, {there} of {expected} lines are there")
    return head + mark + body


def _require(holds: bool, path: Path, suffix: str, why: str) -> None:
    if not holds:
        raise SceneError(f"{path}: cannot be read as {suffix.upper()}: {why}")


def _appearance(
    mesh: Any, source: Source, known: dict[int, int], store: _TextureStore, path: Path
) -> tuple[int, NDArray[np.float64] | None, NDArray[np.float64] | None]:
    """Return material index, texture coordinates and corner colours of a trimesh mesh."""
    visual = mesh.visual
    if isinstance(visual, trimesh.visual.ColorVisuals):
        color: NDArray[np.float64] | None = None
        if visual.kind == "face":
            color = np.repeat(srgb_to_linear(visual.face_colors[:, None, :3]), 3, axis=1).astype(np.float64)
        elif visual.kind == "vertex":
            color = srgb_to_linear(visual.vertex_colors[:, :3])[np.asarray(mesh.faces)].astype(np.float64)
        if -1 not in known:
            known[-1] = len(source.materials)
            source.materials.append(Material(name="plain", base_color=(0.8, 0.8, 0.8)))
        if color is not None and -2 not in known:
            known[-2] = len(source.materials)
            source.materials.append(Material(name="colours of the file", base_color=(1.0, 1.0, 1.0)))
        return known[-1 if color is None else -2], None, color
    uv = None if visual.uv is None else np.asarray(visual.uv, dtype=np.float64)
    material = visual.material
    if id(material) not in known:
        known[id(material)] = len(source.materials)
        source.materials.append(_material(material, store, path, len(source.materials)))
    return known[id(material)], uv, None


def _material(material: Any, store: _TextureStore, path: Path, index: int) -> Material:
    name = getattr(material, "name", None) or f"material {index}"
    if isinstance(material, trimesh.visual.material.PBRMaterial):
        base = material.baseColorFactor
        color = (1.0, 1.0, 1.0) if base is None else rgb(np.asarray(base, dtype=np.float64) / 255.0)
        picture, glow = material.baseColorTexture, material.emissiveFactor
    else:
        kd = material.kwargs.get("kd")  # as in the file; `diffuse` is rounded to 8 bits
        base = np.asarray(material.diffuse[:3] / 255.0 if kd is None else kd, dtype=np.float64)
        picture, glow = material.image, material.kwargs.get("ke")
        # exporters write Kd 0 or any grey beside a texture; viewers then show the texture as it is
        color = (1.0, 1.0, 1.0) if picture is not None else rgb(np.clip(np.resize(base, 3), 0.0, 1.0))
    texture = None
    if picture is not None:
        pixels = decode_picture(picture, file=str(path), name=str(picture.info.get("file_path", name)))
        texture = store.add(pixels, name=name)
    emission = (0.0, 0.0, 0.0) if glow is None else rgb(np.resize(np.asarray(glow, dtype=np.float64), 3))
    return Material(name=name, base_color=color, texture=texture, emission=emission)
