# mypy: disable-error-code="attr-defined,var-annotated,type-arg,call-overload,assignment"
"""A scene on a device, ready to be cast at: triangles, light, textures and trees, shared by all cameras."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import warp as wp
from numpy.typing import NDArray

from neurosim_core.render.body_arrays import BodyArrays, upload_bodies
from neurosim_core.render.config import CandidateListConfig, RenderConfig
from neurosim_core.render.embree import EmbreeError, EmbreeTree, packet_width
from neurosim_core.render.kernel_data import RenderTerms, SceneData
from neurosim_core.render.lighting import bake_light, shading_faces, upload_lights
from neurosim_core.render.ray_intersection import face_normals
from neurosim_core.render.ray_tree import make_mesh, make_ray_tree
from neurosim_core.render.refine import refine
from neurosim_core.scene.bodies import Body
from neurosim_core.scene.materials import PackedTextures, mean_albedo, pack_textures
from neurosim_core.scene.scene import Material, RefinedMesh, Scene
from neurosim_core.scene.source import unique_name

_logger = logging.getLogger(__name__)
_LUMA = np.array([0.2126, 0.7152, 0.0722])
_MIDDLE_GREY = 0.2
_BRIGHT = 0.6


@dataclass(frozen=True, kw_only=True, eq=False)
class SceneArrays:
    """A scene on a device, ready to be cast at; shared by all cameras."""

    scene: Scene
    config: RenderConfig
    device: str
    mesh: wp.Mesh
    """All triangles, refined if light is baked; for rays and for nearest-point queries."""
    face_origin: wp.array[int]
    """Face of the scene that each face of `mesh` is a part of, shape [F]."""
    embree: EmbreeTree | None
    """The triangles of `mesh`, if Embree finds what the rays of cameras hit."""
    bodies: BodyArrays | None
    """Moving bodies; None: there are none."""
    instance_names: tuple[str, ...]
    """Names of the instances: those of the scene, then of the bodies."""
    terms: RenderTerms
    data: SceneData
    exposure: float
    """Factor from linear radiance to the linear value 1.0 of an 8-bit picture."""

    @property
    def mesh_id(self) -> wp.uint64:
        """Identifier of `mesh` for queries in kernels."""
        return self.mesh.id


def upload_scene(
    scene: Scene, config: RenderConfig, device: str, *, bodies: Sequence[Body] = ()
) -> SceneArrays:
    """Bring a scene to a device: refine and light it, pack its textures, build its tree.

    Raises:
        EmbreeError: `config` asks for Embree on a CPU and it cannot be used here.
    """
    baked = config.lighting.mode == "baked"
    edge_max_m = config.lighting.edge_max_m if baked else None
    solids = [body.solid for body in bodies]
    materials = [material for each in (scene, *solids) for material in each.materials]
    light: NDArray[np.float32] | None = None
    data = SceneData()
    wp.zeros(1, device=device)  # Warp makes a device's streams at its first use, which must be in one thread
    with ThreadPoolExecutor(max_workers=3) as aside:
        packing = aside.submit(pack_textures, materials)
        connecting = (
            aside.submit(lambda: scene.connections) if config.samples_per_pixel == "adaptive" else None
        )
        embree_width = _embree_width(config, device)
        mesh, whole = refine(scene, edge_max_m), [refine(solid, None) for solid in solids]
        building = aside.submit(
            _build_trees, mesh, device, embree=bool(embree_width), quick=connecting is not None
        )

        def cover() -> tuple[PackedTextures, RenderTerms]:
            packed = packing.result()
            terms = _terms_of(materials, packed, config, device, embree=embree_width, bodies=bool(bodies))
            _upload_surfaces(data, (scene, *solids), (mesh, *whole), packed, terms, device)
            if connecting is not None:
                _upload_wholes(data, scene, mesh, connecting.result(), device)
            return packed, terms

        covering = aside.submit(cover)
        if baked or config.exposure == "auto":
            light = bake_light(scene, mesh, config.lighting, device=device, embree=bool(embree_width))
        packed, terms = covering.result()
        tree, embree = building.result()
    material = scene.face_material[mesh.origin]
    exposure = config.exposure
    if exposure == "auto":
        assert light is not None
        exposure = auto_exposure(mesh, light, mean_albedo(materials, packed)[material])
    data.mesh = tree.id
    if embree is not None:
        data.embree_scene = wp.uint64(embree.scene)
        data.embree_quick = wp.uint64(embree.quick)
        data.embree_intersect = wp.uint64(embree.intersect)
    else:
        data.tree = make_ray_tree(tree)
        data.face_normal = face_normals(tree)
    if baked:
        assert light is not None
        data.corner_light = wp.array(light.reshape(2, -1, 3), dtype=wp.vec3, device=device)
    else:
        data.corner_normal = wp.array(mesh.corner_normals.reshape(-1, 3), dtype=wp.vec3, device=device)
    upload_lights(data, scene, config.lighting, device)
    data.sky = wp.vec3(*scene.sky)
    data.mip_bias = config.mip_bias
    data.dark_floor = config.dark_floor
    data.exposure = exposure
    taken: set[str] = set()
    return SceneArrays(
        scene=scene,
        config=config,
        device=device,
        mesh=tree,
        face_origin=wp.array(mesh.origin, dtype=int, device=device),
        embree=embree,
        bodies=upload_bodies(
            bodies,
            whole,
            scene_face_count=len(mesh.faces),
            shading=make_mesh(scene.vertices, shading_faces(scene), device) if baked else None,
            device=device,
        )
        if bodies
        else None,
        instance_names=tuple(
            unique_name(name, taken) for name in (*scene.instance_names, *(body.name for body in bodies))
        ),
        terms=terms,
        data=data,
        exposure=exposure,
    )


def _build_trees(
    mesh: RefinedMesh, device: str, *, embree: bool, quick: bool
) -> tuple[wp.Mesh, EmbreeTree | None]:
    """Return the tree of a mesh as Warp has it, and as Embree has it if that casts rays."""
    tree = make_mesh(mesh.vertices, mesh.faces, device)
    return tree, EmbreeTree(mesh.vertices, mesh.faces, quick=quick) if embree else None


def _terms_of(
    materials: Sequence[Material],
    packed: PackedTextures,
    config: RenderConfig,
    device: str,
    *,
    embree: int,
    bodies: bool,
) -> RenderTerms:
    """Return what a scene of these materials and its settings need of the ray caster."""
    textured, on_cpu = len(packed.levels) > 0, wp.get_device(device).is_cpu
    return RenderTerms(
        textured=on_cpu or textured,
        emissive=on_cpu or any(max(m.emission) > 0.0 for m in materials),
        baked=config.lighting.mode == "baked",
        supersampled=config.samples_per_pixel not in (1, "adaptive"),
        embree=embree,
        finest_level=textured and config.texture_filter != "trilinear",
        nearest_texel=textured and config.texture_filter == "nearest",
        bodies=bodies,
        by_tile=on_cpu,
    )


def _upload_surfaces(
    data: SceneData,
    scenes: Sequence[Scene],
    meshes: Sequence[RefinedMesh],
    packed: PackedTextures,
    terms: RenderTerms,
    device: str,
) -> None:
    """Write what faces are made of: those of the scene, then those of the bodies."""
    materials = [material for scene in scenes for material in scene.materials]
    material, instance = [], []
    material_count = instance_count = 0
    for scene, mesh in zip(scenes, meshes, strict=True):
        material.append(material_count + scene.face_material[mesh.origin])
        instance.append(instance_count + scene.face_instance[mesh.origin])
        material_count += len(scene.materials)
        instance_count += len(scene.instance_names)
    data.face_material = wp.array(np.concatenate(material), dtype=int, device=device)
    data.face_instance = wp.array(np.concatenate(instance), dtype=int, device=device)
    data.base_color = wp.array(
        np.array([m.base_color for m in materials], np.float32), dtype=wp.vec3, device=device
    )
    data.emission = wp.array(
        np.array([m.emission for m in materials], np.float32), dtype=wp.vec3, device=device
    )
    if terms.textured:
        data.material_texture = wp.array(packed.material_texture, dtype=wp.vec2i, device=device)
    if len(packed.levels):
        density = [_texel_density(*surface, packed) for surface in zip(meshes, material, strict=True)]
        uv = np.concatenate([mesh.uv.take(mesh.faces, axis=0).reshape(-1, 2) for mesh in meshes])
        data.face_lod = wp.array(np.concatenate(density), dtype=float, device=device)
        data.corner_uv = wp.array(uv, dtype=wp.vec2, device=device)
        data.levels = wp.array(packed.levels, dtype=wp.vec3i, device=device)
        data.texels = wp.array(packed.texels, dtype=wp.uint32, device=device)


def _embree_width(config: RenderConfig, device: str) -> int:
    """Return how many rays Embree casts at once, 0 if Warp casts them."""
    asked = isinstance(config.candidate_lists, CandidateListConfig)
    if config.cpu_traversal == "warp" or asked or not wp.get_device(device).is_cpu:
        return 0
    try:
        return packet_width()
    except EmbreeError as error:
        if config.cpu_traversal == "embree":
            raise EmbreeError(f"cpu_traversal is 'embree', but {error}") from None
        _logger.info("rays are cast by Warp, several times slower than by Embree: %s", error)
        return 0


def _upload_wholes(
    data: SceneData,
    scene: Scene,
    mesh: RefinedMesh,
    connected: tuple[NDArray[np.int32], NDArray[np.int32]],
    device: str,
) -> None:
    """Write what antialiasing reads: faces as they were before they were cut."""
    neighbor, surface = connected
    first = np.searchsorted(mesh.origin, np.arange(len(scene.faces) + 1)).astype(np.int32)
    data.whole_of_face = wp.array(mesh.origin, dtype=int, device=device)
    data.whole_first = wp.array(first, dtype=int, device=device)
    corners = scene.vertices.take(scene.faces, axis=0).reshape(-1, 3).astype(np.float32)
    data.whole_corner = wp.array(corners, dtype=wp.vec3, device=device)
    data.whole_neighbor = wp.array(neighbor, dtype=int, device=device)
    data.whole_surface = wp.array(surface, dtype=int, device=device)
    data.face_surface = wp.array(surface[mesh.origin], dtype=int, device=device)


def _texel_density(
    mesh: RefinedMesh, material: NDArray[np.int32], packed: PackedTextures
) -> NDArray[np.float32]:
    """Return log2 of texels of level 0 per metre on each face: half the log2 of texels per square metre."""
    u, v = np.moveaxis(mesh.uv.take(mesh.faces, axis=0).astype(np.float64), -1, 0)
    uv_area = 0.5 * np.abs(
        (u[:, 1] - u[:, 0]) * (v[:, 2] - v[:, 0]) - (u[:, 2] - u[:, 0]) * (v[:, 1] - v[:, 0])
    )
    sizes = np.array([packed.size_px(k) for k in range(len(packed.material_texture))], dtype=np.float64)
    texels = uv_area * sizes.prod(axis=1)[material]
    return (0.5 * np.log2(np.maximum(texels, 1e-12) / np.maximum(mesh.areas_m2, 1e-12))).astype(np.float32)


def auto_exposure(mesh: RefinedMesh, light: NDArray[np.float32], albedo: NDArray[np.float32]) -> float:
    """Return an exposure that shows the mean surface as middle grey and nine tenths of all below white.

    The mean is that of log luma; faces count by area and with their brighter side: the other one is
    often the inside of a wall. Light is that of `bake_light`; albedo is that of each face, shape [F, 3].
    """
    one, two, three = np.moveaxis(light.max(axis=0), 1, 0)
    luma = np.maximum(((one + two + three) / np.float32(3.0) * albedo) @ _LUMA, 1e-4)
    order = np.argsort(luma)
    share = np.cumsum(mesh.areas_m2[order]) / mesh.areas_m2.sum()
    bright = luma[order[np.searchsorted(share, 0.9)]]
    mean = np.exp(np.average(np.log(luma), weights=mesh.areas_m2))
    return float(min(_MIDDLE_GREY / mean, _BRIGHT / bright))
