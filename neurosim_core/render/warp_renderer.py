# mypy: disable-error-code="attr-defined,var-annotated,type-arg,call-overload,assignment,no-any-return"
"""The renderer of the simulator: ray casting in Warp, the same source on CPU and CUDA."""

from __future__ import annotations

import logging
import time
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp
from numpy.typing import NDArray

from neurosim_core.render.body_arrays import (
    BodyArrays,
    join_bodies,
    make_body_data,
    place_camera,
    upload_bodies,
)
from neurosim_core.render.camera import Lens
from neurosim_core.render.cast_terms import Terms, group_of, with_walks
from neurosim_core.render.config import RenderConfig, WalkConfig
from neurosim_core.render.embree import PACKET, EmbreeError, EmbreeTree, packet_width
from neurosim_core.render.film import OUTPUTS, make_film
from neurosim_core.render.launch import launch_split
from neurosim_core.render.lighting import (
    RefinedMesh,
    bake_light,
    corner_normals,
    refine,
    shading_mesh,
    spread_order,
)
from neurosim_core.render.ray_hit import face_normals
from neurosim_core.render.ray_tree import make_ray_tree
from neurosim_core.render.raycast import asking_kernel, raycast_kernel
from neurosim_core.render.scene_data import SceneData
from neurosim_core.render.tile_walk import TileWalk, shared_walk
from neurosim_core.render.view_data import WorldData, make_view
from neurosim_core.render.walk_data import TILE, WalkData
from neurosim_core.scene.bodies import Body, BodyPoses
from neurosim_core.scene.materials import PackedTextures, mean_albedo, pack_textures
from neurosim_core.scene.scene import Scene
from neurosim_core.scene.source import unique_name

_logger = logging.getLogger(__name__)
_LUMA = np.array([0.2126, 0.7152, 0.0722])
_MIDDLE_GREY = 0.2
_BRIGHT = 0.6
_THREAD_COUNT_MAX = 2**31 - 1
"""Kernels count in 32 bits."""


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
    terms: Terms
    data: SceneData
    exposure: float
    """Factor from linear radiance to the linear value 1.0 of an 8-bit picture."""
    light_s: float
    """Wall-clock time that baking took [s]."""

    @property
    def mesh_id(self) -> wp.uint64:
        """Identifier of `mesh` for queries in kernels."""
        return self.mesh.id


def upload_scene(
    scene: Scene, config: RenderConfig, device: str, *, bodies: Sequence[Body] = ()
) -> SceneArrays:
    """Bring a scene to a device: refine and light it, pack its textures, build its tree.

    Args:
        scene: What to render.
        config: How to light it, and who casts rays on a CPU.
        device: "cpu", "cuda:0", …
        bodies: What moves in the scene.

    Raises:
        EmbreeError: `config` asks for Embree on a CPU and it cannot be used here.
    """
    baked = config.lighting.mode == "baked"
    mesh = refine(scene, config.lighting.edge_max_m if baked else None)
    joined = join_bodies(
        bodies, material_count=len(scene.materials), instance_count=len(scene.instance_names)
    )
    materials = (*scene.materials, *joined.materials)
    packed = pack_textures(materials)
    material = scene.face_material[mesh.origin]
    textured = bool((packed.material_texture[:, 1] > 0).any())
    terms = Terms(
        textured=textured,
        emissive=any(max(m.emission) > 0.0 for m in materials),
        baked=baked,
        supersampled=config.samples_per_pixel > 1,
        embree=_embree_width(config, device),
        finest_level=textured and config.texture_filter != "trilinear",
        nearest_texel=textured and config.texture_filter == "nearest",
        bodies=bool(bodies),
        by_tile=wp.get_device(device).is_cpu,
    )
    start = time.perf_counter()
    light: NDArray[np.float32] | None = None
    if baked or config.exposure == "auto":
        light = bake_light(scene, mesh, config.lighting, device=device)
    light_s = time.perf_counter() - start
    exposure = config.exposure
    if exposure == "auto":
        assert light is not None
        exposure = auto_exposure(mesh, light, mean_albedo(materials, packed)[material])

    points = wp.array(mesh.vertices, dtype=wp.vec3, device=device)
    indices = wp.array(mesh.faces.reshape(-1), dtype=int, device=device)
    tree = wp.Mesh(
        points,
        indices,
        bvh_constructor="sah",  # on a CPU three times faster to traverse than "median" and as fast as "cubql"
        bvh_leaf_size=1 if wp.get_device(device).is_cuda else 4,
    )
    embree = EmbreeTree(mesh.vertices, mesh.faces) if terms.embree else None
    data = SceneData()
    data.mesh = tree.id
    if embree is not None:
        data.embree_scene = wp.uint64(embree.scene)
        data.embree_intersect = wp.uint64(embree.intersect)
    else:
        data.tree = make_ray_tree(tree)
        data.face_normal = face_normals(tree)
    instance = scene.face_instance[mesh.origin]
    data.face_material = wp.array(np.append(material, joined.material), dtype=int, device=device)
    data.face_instance = wp.array(np.append(instance, joined.instance), dtype=int, device=device)
    data.base_color = wp.array(_rows([m.base_color for m in materials]), dtype=wp.vec3, device=device)
    data.emission = wp.array(_rows([m.emission for m in materials]), dtype=wp.vec3, device=device)
    if terms.textured:
        surfaces = ((mesh, material), (joined.mesh, joined.material))
        density = np.concatenate([_texel_density(m, owner, packed) for m, owner in surfaces])
        uv = np.concatenate([m.uv[m.faces].reshape(-1, 2) for m, _ in surfaces])
        data.face_lod = wp.array(density, dtype=float, device=device)
        data.corner_uv = wp.array(uv, dtype=wp.vec2, device=device)
        data.material_texture = wp.array(packed.material_texture, dtype=wp.vec2i, device=device)
        data.levels = wp.array(packed.levels, dtype=wp.vec3i, device=device)
        data.texels = wp.array(packed.texels, dtype=wp.uint32, device=device)
    if baked:
        assert light is not None
        data.corner_light = wp.array(light.reshape(2, -1, 3), dtype=wp.vec3, device=device)
    else:
        data.corner_normal = wp.array(corner_normals(mesh).reshape(-1, 3), dtype=wp.vec3, device=device)
    if bodies or not baked:
        positions, intensities = [x.position_m for x in scene.lights], [x.intensity for x in scene.lights]
        data.light_position = wp.array(_rows(positions), dtype=wp.vec3, device=device)
        data.light_intensity = wp.array(_rows(intensities), dtype=wp.vec3, device=device)
    data.light_radius_m = config.lighting.light_radius_m
    data.ambient_up = wp.vec3(*scene.ambient.up)
    data.ambient_down = wp.vec3(*scene.ambient.down)
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
        light_s=light_s,
    )


def _embree_width(config: RenderConfig, device: str) -> int:
    """Return how many rays Embree casts at once, 0 if Warp casts them."""
    asked = isinstance(config.shared_walk, WalkConfig)
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


def _areas_m2(mesh: RefinedMesh) -> NDArray[np.float64]:
    tips = mesh.vertices[mesh.faces].astype(np.float64)
    normal = np.cross(tips[:, 1] - tips[:, 0], tips[:, 2] - tips[:, 0])
    return 0.5 * np.asarray(np.linalg.norm(normal, axis=1))


def _texel_density(
    mesh: RefinedMesh, material: NDArray[np.int32], packed: PackedTextures
) -> NDArray[np.float32]:
    """Return log2 of texels of level 0 per metre on each face: half the log2 of texels per square metre."""
    u, v = np.moveaxis(mesh.uv[mesh.faces].astype(np.float64), -1, 0)
    uv_area = 0.5 * np.abs(
        (u[:, 1] - u[:, 0]) * (v[:, 2] - v[:, 0]) - (u[:, 2] - u[:, 0]) * (v[:, 1] - v[:, 0])
    )
    sizes = np.array([packed.size_px(k) for k in range(len(packed.material_texture))], dtype=np.float64)
    texels = uv_area * sizes.prod(axis=1)[material]
    return (0.5 * np.log2(np.maximum(texels, 1e-12) / np.maximum(_areas_m2(mesh), 1e-12))).astype(np.float32)


def auto_exposure(mesh: RefinedMesh, light: NDArray[np.float32], albedo: NDArray[np.float32]) -> float:
    """Return an exposure that shows the mean surface as middle grey and nine tenths of all below white.

    The mean is that of log luma; faces count by area and with their brighter side: the other one is
    often the inside of a wall.
    """
    luma = np.maximum((light.max(axis=0).mean(axis=1) * albedo) @ _LUMA, 1e-4)
    area = _areas_m2(mesh)
    order = np.argsort(luma)
    share = np.cumsum(area[order]) / area.sum()
    bright = luma[order[np.searchsorted(share, 0.9)]]
    return float(min(_MIDDLE_GREY / np.exp(np.average(np.log(luma), weights=area)), _BRIGHT / bright))


def ray_layers(lens: Lens, sample_count: int) -> NDArray[np.float32]:
    """Return rays through the centres of pixels and, for several samples, through points spread over them.

    The points are a lattice: along rows and along columns each n-th of a pixel has one of the n.

    Returns:
        Direction in C and spread [rad], shape [1 or 1 + n, H * W, 4].
    """
    spread = lens.ray_spread()[..., None] / np.float32(np.sqrt(sample_count))
    offsets = [(0.5, 0.5)]
    if sample_count > 1:
        columns, rows = np.arange(sample_count), spread_order(sample_count)
        offsets += list(zip((columns + 0.5) / sample_count, (rows + 0.5) / sample_count, strict=True))
    layers = [np.concatenate([lens.ray_table(offset), spread], axis=-1).reshape(-1, 4) for offset in offsets]
    return np.stack(layers)


class WarpRenderer:
    """Renders K instants of one lens per launch. `render` neither allocates nor waits for a CUDA device.

    Outputs that were not asked for are None. See `film.FilmData` for what they are.

    Attributes:
        log_radiance: float32, shape [K, H, W].
        rgb: uint8, shape [M, H, W, 3].
        depth: float32, shape [M, H, W].
        normal: vec3, shape [M, H, W].
        instance: int32, shape [M, H, W].
        rays: Rays of the pixels: direction in C and spread [rad], vec4, shape [layer, H * W].
        walk: What the rays of a tile share; None: each walks by itself.
        terms: What its kernels compute because of the scene, the settings, and the lens.
    """

    def __init__(
        self,
        arrays: SceneArrays,
        lens: Lens,
        *,
        outputs: Collection[str],
        instant_count: int,
        image_count: int = 1,
        thread_count: int | None = None,
    ) -> None:
        """Allocate the outputs and choose the kernel.

        Args:
            arrays: The scene; `upload_scene`.
            lens: Rays of the pixels.
            outputs: Some of "log_radiance", "rgb", "depth", "normal", "instance".
            instant_count: K, the most instants per launch.
            image_count: M, number of image slots.
            thread_count: Threads on a CPU device; all cores if None.

        Raises:
            ValueError: If an output is unknown or none is asked for, the instants have more than 2^31 - 1
                rays of a layer together, or rays that share a walk do not look forward or are too many.
        """
        tiles = -(-lens.width // TILE) * -(-lens.height // TILE)
        most = _THREAD_COUNT_MAX // (tiles * TILE * TILE)
        if instant_count > most:
            raise ValueError(
                f"{instant_count} instants of {lens.width} x {lens.height} px are more than 2^31 - 1 rays a "
                f"launch: at most {most} instants of this size (instants_per_launch), or take fewer pixels"
            )
        rays = ray_layers(lens, arrays.config.samples_per_pixel)
        is_cuda = wp.get_device(arrays.device).is_cuda
        shared = shared_walk(
            arrays.config.shared_walk,
            rays,
            instant_count=instant_count,
            face_count=arrays.face_origin.shape[0],
            is_cuda=is_cuda,
        )
        self.terms = terms = with_walks(arrays.terms, shared)
        self._kernel = raycast_kernel(outputs, terms)
        self._asking = asking_kernel(outputs, terms)
        self._group = group_of(terms)
        self._arrays = arrays
        self._thread_count = thread_count
        rays_together = TILE * TILE if terms.by_tile else PACKET if terms.embree else 1
        self._instant_threads = tiles * TILE * TILE // rays_together
        device = arrays.device
        self.rays: wp.array2d[wp.vec4] = wp.array(rays, dtype=wp.vec4, device=device)
        self._view = make_view(self.rays, lens.width, lens.height)
        self._body_data = make_body_data(arrays.bodies, instant_count, device)
        self._world_data = WorldData()
        self.walk = None
        if shared is not None:
            self.walk = TileWalk(
                arrays.data.tree,
                rays,
                width=lens.width,
                height=lens.height,
                extent_m=float(np.abs(arrays.scene.bounds_m).max()),
                config=shared,
                instant_count=instant_count,
                leaves=self._asking is not None,
                thread_count=thread_count,
            )
        self._walk_data = WalkData() if self.walk is None else self.walk.data
        images = (image_count, lens.height, lens.width)

        def allocate(name: str, shape: tuple[int, ...], dtype: object) -> wp.array | None:
            return wp.zeros(shape, dtype=dtype, device=device) if name in outputs else None

        self.log_radiance = allocate("log_radiance", (instant_count, *images[1:]), float)
        self.rgb = allocate("rgb", (*images, 3), wp.uint8)
        self.depth = allocate("depth", images, float)
        self.normal = allocate("normal", images, wp.vec3)
        self.instance = allocate("instance", images, int)
        self._film = make_film(**{name: getattr(self, name) for name in OUTPUTS})

    def render(
        self,
        p_WC: wp.array[wp.vec3],
        q_WC: wp.array[wp.quat],
        image_slot: wp.array[int],
        *,
        instant_count: int,
        bodies: BodyPoses | None = None,
    ) -> None:
        """Render the first `instant_count` poses into the outputs.

        Args:
            p_WC: Position of the camera [m], shape [K].
            q_WC: Orientation of the camera's optical frame, xyzw, shape [K].
            image_slot: Where the images of an instant go, shape [K]; -1: nowhere.
            instant_count: How many of the K instants are rendered.
            bodies: Where bodies are at the instants; not needed without bodies.

        Raises:
            ValueError: The scene has bodies and there are no poses of them.
        """
        if self._arrays.bodies is not None:
            if bodies is None:
                names = ", ".join(body.name for body in self._arrays.bodies.bodies)
                raise ValueError(f"bodies move in this scene ({names}): render() needs their poses")
            place_camera(
                self._arrays.bodies, bodies, p_WC, q_WC, instant_count=instant_count, data=self._body_data
            )
        if self.walk is not None:
            self.walk.launch(self.rays, p_WC, q_WC, instant_count=instant_count)
        view = self._view
        view.instant_count, view.p_WC, view.q_WC, view.image_slot = instant_count, p_WC, q_WC, image_slot
        inputs = [self._arrays.data, view, self._body_data, self._world_data, self._walk_data]
        outputs = [self._film]
        device = self._arrays.device
        launch_split(
            self._kernel,
            dim=-(-instant_count // self._group) * self._instant_threads,
            inputs=inputs,
            outputs=outputs,
            device=device,
            thread_count=self._thread_count,
        )
        if self._asking is not None and self.walk is not None:
            launch_split(
                self._asking, dim=self.walk.data.left_threads, inputs=inputs, outputs=outputs, device=device
            )
