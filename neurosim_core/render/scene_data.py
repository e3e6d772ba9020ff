"""What kernels read of a scene."""

# No `from __future__ import annotations`: Warp needs the annotations of structures as objects.

import warp as wp

from neurosim_core.render.ray_tree import RayTree


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
