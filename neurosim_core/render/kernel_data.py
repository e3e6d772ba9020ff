"""The data of render kernels: the terms that they are compiled for, and structures that they read and write.

Scenes, bodies, the camera of a launch with its worlds and candidate lists, hits, and outputs.
"""

# No `from __future__ import annotations`: Warp needs the annotations of structures as objects.

from typing import NamedTuple

import warp as wp

TILE = 8
"""Width and height of a tile [px]."""
BLOCK = TILE * TILE
"""Threads of a CUDA block that process a tile together."""
UNRESOLVED = -2
"""In place of a face index: the candidate list does not decide what the ray hits; the tree does."""
FAR_M = wp.constant(1.0e9)
"""Beyond this distance rays hit nothing [m]."""


class RenderTerms(NamedTuple):
    """The terms of a kernel."""

    textured: bool
    """Some material has a texture; always on a CPU, where to look takes less than to compile both."""
    emissive: bool
    """Some material emits light; always on a CPU, likewise."""
    baked: bool
    """Light is baked: interpolated between corners instead of evaluated for each pixel."""
    supersampled: bool
    """Radiance is the mean over several rays per pixel; `raycast_packets.py` counts them itself."""
    embree: int = 0
    """Rays per packet of Embree (`embree.packet_width`), on the CPU only; 0: Warp intersects rays."""
    finest_level: bool = False
    """Textures are read at their finest level, whatever the footprint of a ray."""
    nearest_texel: bool = False
    """With `finest_level`: texels are not interpolated."""
    bodies: bool = False
    """Bodies move through the scene."""
    worlds: bool = False
    """Instants belong to many worlds, each of which may be inactive (`WorldData`)."""
    world_scenes: bool = False
    """Worlds have different scenes."""
    world_lenses: bool = False
    """Worlds have different lenses."""
    candidate_group: int = 0
    """Rays are intersected with candidate lists (`candidate_lists`), by a block of 64 threads for this many
    instants together; 0: rays traverse the tree. Unresolved pixels go to the kernel with `fallback`."""
    fallback: bool = False
    """The kernel renders the unresolved pixels of one with `candidate_group`; each ray traverses the tree."""
    by_tile: bool = False
    """With `candidate_group`: a thread renders a tile and resolves all of its pixels, on a CPU."""
    timed: bool = False
    """Each ray has an instant of its own (`ray_times`); rays traverse the tree."""
    quads: bool = False
    """Four threads side by side cast the rays of a pixel, a multiple of four, on CUDA."""

    @property
    def instants_per_thread(self) -> int:
        """How many instants a thread of `raycast_kernel` renders; 1 where threads are tiles or packets.

        Samples of a pixel are summed for one instant at a time.
        """
        grouped = self.candidate_group and not (self.by_tile or self.supersampled)
        return self.candidate_group if grouped else 1


@wp.struct
class RayTree:
    """A tree for `intersect_tree`. A child is the index of a node or, below zero, -1 - that of a triangle."""

    root: int  # The first child
    nodes: wp.array[wp.vec4]
    """Four rows a node: low x, high x, low y, high y of its first child; the same of its second; low and high
    z of the first, then of the second; both children, as the bits of integers."""
    triangles: wp.array[wp.vec4]
    """Three rows a triangle, in the order of the leaves: its corners. Beside them, as the bits of integers:
    which face it is; 1 for the last of its leaf."""


@wp.struct
class SceneData:
    """The arrays of a scene that the kernel reads. Corner k of face f is at 3 f + k.

    Of moving bodies, material, instance, texture coordinates and density follow those of the scene.
    """

    mesh: wp.uint64
    tree: RayTree  # The hierarchy that rays traverse; not filled if Embree intersects them
    embree_scene: wp.uint64  # `EmbreeTree.scene`; 0 if Warp intersects rays
    embree_quick: wp.uint64  # `EmbreeTree.quick`, likewise; also 0 without antialiasing
    embree_intersect: wp.uint64  # `EmbreeTree.intersect`, likewise
    face_material: wp.array[int]
    face_instance: wp.array[int]
    face_normal: wp.array[wp.vec3]  # Unit normal of each face's front; not filled if Embree intersects rays
    whole_of_face: wp.array[int]
    """The face, before faces were cut for baked light, that each is a part of; as the following, filled for
    antialiasing."""
    whole_first: wp.array[int]
    """First part of each face before the cuts, and the number of parts, shape [W + 1]."""
    whole_corner: wp.array[wp.vec3]  # Positions of its corners [m], shape [3 W]
    whole_neighbor: wp.array[int]  # The one beyond the edge opposite each corner, -1: none, shape [3 W]
    whole_surface: wp.array[int]
    """The plane surface of one material and without seams that it is a part of, shape [W]."""
    face_surface: wp.array[int]  # That of each face after the cuts
    face_lod: wp.array[float]  # log2 of texels per metre on each face
    corner_uv: wp.array[wp.vec2]
    corner_normal: wp.array[wp.vec3]
    """Shading normals, on the front of the face; not filled if light is baked."""
    corner_light: wp.array2d[wp.vec3]  # Baked light, shape [2, 3F]: front, back; not filled otherwise
    base_color: wp.array[wp.vec3]
    emission: wp.array[wp.vec3]
    material_texture: wp.array[wp.vec2i]
    levels: wp.array[wp.vec3i]
    texels: wp.array[wp.uint32]
    light_position: wp.array[wp.vec3]
    light_intensity: wp.array[wp.vec3]
    light_radius_m: float
    ambient_up: wp.vec3
    ambient_down: wp.vec3
    sky: wp.vec3
    mip_bias: float
    dark_floor: float
    exposure: float


@wp.struct
class BodyData:
    """The arrays of bodies that the kernel reads; empty without bodies."""

    mesh: wp.array[wp.uint64]  # Trees, each in the frame O of its body, shape [B]
    first_face: wp.array[int]  # First face of each body in the arrays of `SceneData`, shape [B]
    corner_normal: wp.array[wp.vec3]
    """Shading normals in O, on the front of the face, of all bodies one after another, shape [3F]."""
    shading: wp.uint64  # What of the scene casts shadows on bodies; 0 if nothing does
    sphere: wp.array[wp.vec4]  # Centre in O and radius of a sphere around each body [m], shape [B]
    p_OC: wp.array2d[wp.vec3]  # Position of the camera [m], shape [K, B]
    q_OC: wp.array2d[wp.quat]  # Orientation of the camera, shape [K, B]
    sphere_C: wp.array2d[wp.vec4]  # Centre and radius of a sphere around the body [m], shape [K, B]


@wp.struct
class CandidateListData:
    """Candidate lists: for each tile and each group of instants, the triangles that its rays may hit.

    See `candidate_lists.py`. The structure is empty in kernels that do not use lists.
    """

    instants: int  # M: consecutive instants that share a list
    limit: int  # Capacity of a list
    faces: wp.array[int]
    """The lists, shape [group, tile, limit], flattened; group g holds the instants from M g on."""
    count: wp.array2d[int]
    """Length of each list, shape [group, tile]; -1: there is none, rays traverse the tree."""
    reach: wp.array2d[float]  # Distance up to which a list is complete [m], shape [group, tile]
    bounds: wp.array[wp.vec4]
    """Least and largest x / z, least and largest y / z of the rays of a tile in C, shape [tile]."""
    unresolved: wp.array[int]  # Pixels for the fallback kernel, in any order; empty on a CPU
    unresolved_count: wp.array[int]
    """Number of unresolved pixels, including those that the array has no room for, shape [1]."""
    fallback_threads: int  # Number of threads of the fallback kernel


@wp.struct
class WorldData:
    """Worlds that are rendered together; arrays of instants have the shape [world, K], flattened."""

    stride: int  # K: capacity for instants of each world
    active: wp.array[int]  # 1: the world is rendered; 0: its outputs are left unchanged, shape [world]
    scenes: wp.array[SceneData]  # With `RenderTerms.world_scenes`: all scenes
    scene: wp.array[int]  # With `RenderTerms.world_scenes`: index of the scene of each world, shape [world]
    lens: wp.array[int]
    """With `RenderTerms.world_lenses`: index of the lens of each world, shape [world]; a layer of rays holds
    the lenses one after another."""


@wp.struct
class ViewData:
    """The rays of a lens, and the poses of the instants of a launch."""

    rays: wp.array2d[wp.vec4]
    """Direction in C and spread [rad], shape [layer, H * W]: the centres of pixels; further layers are the
    samples whose mean is the radiance."""
    width: int  # Columns of a picture [px]
    height: int  # Rows of a picture [px]
    instant_count: int  # How many of the K instants are rendered, of each world
    p_WC: wp.array[wp.vec3]
    """Position of the camera [m], shape [K]; with `RenderTerms.timed` [K, J], flattened."""
    q_WC: wp.array[wp.quat]  # Orientation of the camera's optical frame, xyzw, likewise
    pose_count: int  # With `RenderTerms.timed`: J, instants of one picture
    pose: wp.array2d[int]  # With `RenderTerms.timed`: which of them each ray has, shape [layer, H * W]
    image_slot: wp.array[int]  # Where the images of an instant go, shape [K]; -1: nowhere
    worlds: WorldData
    candidates: CandidateListData


@wp.struct
class Hit:
    """The first intersection of a ray."""

    face: int  # -1: the ray hits nothing, and the other fields have no meaning
    t: float  # Distance along the ray [m]
    u: float  # Weight of the first corner
    v: float  # Weight of the second corner
    normal: wp.vec3  # Unit normal of the face's front


@wp.struct
class RenderOutputs:
    """The arrays of outputs; those not requested are empty. All but the first two have image slots."""

    log_radiance: wp.array3d[float]  # log(Rec. 709 luma + dark floor) of each instant, shape [K, H, W]
    face: wp.array3d[int]  # Index of the face that the last ray of a pixel hits, -1: none, shape [K, H, W]
    rgb: wp.array4d[wp.uint8]  # sRGB of exposure times radiance, shape [M, H, W, 3]
    radiance: wp.array3d[wp.vec3]  # Exposure times linear radiance, of which 1 is white, shape [M, H, W]
    depth: wp.array3d[float]  # Planar z [m], inf where nothing is hit, shape [M, H, W]
    range: wp.array3d[float]  # Length of the ray [m], inf where nothing is hit, shape [M, H, W]
    normal: wp.array3d[wp.vec3]
    """Of the triangle, in W, towards the camera, zero where nothing is hit, shape [M, H, W]."""
    instance: wp.array3d[int]  # -1 where nothing is hit, shape [M, H, W]
    returns: wp.array3d[wp.vec3]
    """Length of the ray [m], inf where nothing is hit; |cosine| of incidence; luma of the albedo; shape
    [M, H, W]."""
