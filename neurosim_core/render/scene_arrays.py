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

from neurosim_core.render.body_arrays import BodyArrays, JoinedBodies, join_bodies, upload_bodies
from neurosim_core.render.config import CandidateListConfig, RenderConfig
from neurosim_core.render.embree import EmbreeError, EmbreeTree, packet_width
from neurosim_core.render.lighting import bake_light, shading_mesh
from neurosim_core.render.ray_intersection import face_normals
from neurosim_core.render.ray_tree import make_ray_tree
from neurosim_core.render.refine import RefinedMesh, refine
from neurosim_core.render.render_terms import RenderTerms
from neurosim_core.render.scene_data import SceneData
from neurosim_core.scene.bodies import Body
from neurosim_core.scene.materials import PackedTextures, mean_albedo, pack_textures
from neurosim_core.scene.scene import Material, Scene
from neurosim_core.scene.source import unique_name
from neurosim_core.scene.triangles import corner_columns, double_areas

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
    """What moves in the scene; None: nothing does."""
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
    joined = join_bodies(
        bodies, material_count=len(scene.materials), instance_count=len(scene.instance_names)
    )
    materials = (*scene.materials, *joined.materials)
    light: NDArray[np.float32] | None = None
    data = SceneData()
    wp.zeros(1, device=device)  # Warp makes a device's streams at its first use, which must be in one thread
    with ThreadPoolExecutor(max_workers=3) as aside:
        packing = aside.submit(pack_textures, materials)
        connecting = (
            aside.submit(lambda: scene.connections) if config.samples_per_pixel == "adaptive" else None
        )
        embree_width = _embree_width(config, device)
        mesh = refine(scene, config.lighting.edge_max_m if baked else None)
        building = aside.submit(
            _build_trees, mesh, device, embree=bool(embree_width), quick=connecting is not None
        )

        def cover() -> tuple[PackedTextures, RenderTerms, NDArray[np.float64]]:
            area_m2, packed = areas_m2(mesh), packing.result()
            terms = _terms_of(materials, packed, config, device, embree=embree_width, bodies=bool(bodies))
            _upload_surfaces(data, scene, mesh, area_m2, joined, packed, terms, device)
            if connecting is not None:
                _upload_wholes(data, scene, mesh, connecting.result(), device)
            return packed, terms, area_m2

        covering = aside.submit(cover)
        if baked or config.exposure == "auto":
            light = bake_light(scene, mesh, config.lighting, device=device, embree=bool(embree_width))
        packed, terms, area_m2 = covering.result()
        tree, embree = building.result()
    material = scene.face_material[mesh.origin]
    exposure = config.exposure
    if exposure == "auto":
        assert light is not None
        exposure = auto_exposure(area_m2, light, mean_albedo(materials, packed)[material])
    data.mesh = tree.id
    if embree is not None:
        data.embree_scene = wp.uint64(embree.scene)
        data.embree_quick = wp.uint64(embree.quick)
        data.embree_intersect = wp.uint64(embree.intersect)
    else:
        data.tree = make_ray_tree(tree)
        data.face_normal = face_normals(tree)
    _upload_light(data, scene, mesh, light, config, lamps=bool(bodies) or not baked, device=device)
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
            joined,
            scene_face_count=len(mesh.faces),
            shading=shading_mesh(scene, device) if baked else None,
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
    tree = wp.Mesh(
        wp.array(mesh.vertices, dtype=wp.vec3, device=device),
        wp.array(mesh.faces.reshape(-1), dtype=int, device=device),
        bvh_constructor="sah",  # on a CPU three times faster to traverse than "median" and as fast as "cubql"
        bvh_leaf_size=1 if wp.get_device(device).is_cuda else 4,
    )
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
    scene: Scene,
    mesh: RefinedMesh,
    area_m2: NDArray[np.float64],
    joined: JoinedBodies,
    packed: PackedTextures,
    terms: RenderTerms,
    device: str,
) -> None:
    """Write what faces are made of: those of the scene, then those of the bodies."""
    materials = (*scene.materials, *joined.materials)
    material = scene.face_material[mesh.origin]
    instance = scene.face_instance[mesh.origin]
    data.face_material = wp.array(np.append(material, joined.material), dtype=int, device=device)
    data.face_instance = wp.array(np.append(instance, joined.instance), dtype=int, device=device)
    data.base_color = wp.array(_rows([m.base_color for m in materials]), dtype=wp.vec3, device=device)
    data.emission = wp.array(_rows([m.emission for m in materials]), dtype=wp.vec3, device=device)
    if terms.textured:
        data.material_texture = wp.array(packed.material_texture, dtype=wp.vec2i, device=device)
    if len(packed.levels):
        surfaces = ((mesh, area_m2, material), (joined.mesh, areas_m2(joined.mesh), joined.material))
        density = np.concatenate([_texel_density(*surface, packed) for surface in surfaces])
        uv = np.concatenate([m.uv.take(m.faces, axis=0).reshape(-1, 2) for m, *_ in surfaces])
        data.face_lod = wp.array(density, dtype=float, device=device)
        data.corner_uv = wp.array(uv, dtype=wp.vec2, device=device)
        data.levels = wp.array(packed.levels, dtype=wp.vec3i, device=device)
        data.texels = wp.array(packed.texels, dtype=wp.uint32, device=device)


def _upload_light(
    data: SceneData,
    scene: Scene,
    mesh: RefinedMesh,
    light: NDArray[np.float32] | None,
    config: RenderConfig,
    *,
    lamps: bool,
    device: str,
) -> None:
    """Write how faces are lit: baked light or shading normals, lamps if they are asked for, and the sky."""
    if config.lighting.mode == "baked":
        assert light is not None
        data.corner_light = wp.array(light.reshape(2, -1, 3), dtype=wp.vec3, device=device)
    else:
        data.corner_normal = wp.array(mesh.corner_normals.reshape(-1, 3), dtype=wp.vec3, device=device)
    if lamps:
        positions, intensities = [x.position_m for x in scene.lights], [x.intensity for x in scene.lights]
        data.light_position = wp.array(_rows(positions), dtype=wp.vec3, device=device)
        data.light_intensity = wp.array(_rows(intensities), dtype=wp.vec3, device=device)
    data.light_radius_m = config.lighting.light_radius_m
    data.ambient_up = wp.vec3(*scene.ambient.up)
    data.ambient_down = wp.vec3(*scene.ambient.down)
    data.sky = wp.vec3(*scene.sky)


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


def _rows(values: list[tuple[float, float, float]]) -> NDArray[np.float32]:
    return np.array(values, dtype=np.float32).reshape(-1, 3)


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


def areas_m2(mesh: RefinedMesh) -> NDArray[np.float64]:
    """Return the area of each face [m^2], shape [F]."""
    return 0.5 * double_areas(corner_columns(mesh.vertices.astype(np.float64), mesh.faces))


def _texel_density(
    mesh: RefinedMesh, area_m2: NDArray[np.float64], material: NDArray[np.int32], packed: PackedTextures
) -> NDArray[np.float32]:
    """Return log2 of texels of level 0 per metre on each face: half the log2 of texels per square metre."""
    u, v = np.moveaxis(mesh.uv.take(mesh.faces, axis=0).astype(np.float64), -1, 0)
    uv_area = 0.5 * np.abs(
        (u[:, 1] - u[:, 0]) * (v[:, 2] - v[:, 0]) - (u[:, 2] - u[:, 0]) * (v[:, 1] - v[:, 0])
    )
    sizes = np.array([packed.size_px(k) for k in range(len(packed.material_texture))], dtype=np.float64)
    texels = uv_area * sizes.prod(axis=1)[material]
    return (0.5 * np.log2(np.maximum(texels, 1e-12) / np.maximum(area_m2, 1e-12))).astype(np.float32)


def auto_exposure(
    area_m2: NDArray[np.float64], light: NDArray[np.float32], albedo: NDArray[np.float32]
) -> float:
    """Return an exposure that shows the mean surface as middle grey and nine tenths of all below white.

    The mean is that of log luma; faces count by area and with their brighter side: the other one is
    often the inside of a wall.
    """
    one, two, three = np.moveaxis(light.max(axis=0), 1, 0)
    luma = np.maximum(((one + two + three) / np.float32(3.0) * albedo) @ _LUMA, 1e-4)
    order = np.argsort(luma)
    share = np.cumsum(area_m2[order]) / area_m2.sum()
    bright = luma[order[np.searchsorted(share, 0.9)]]
    return float(min(_MIDDLE_GREY / np.exp(np.average(np.log(luma), weights=area_m2)), _BRIGHT / bright))
