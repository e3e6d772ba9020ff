# mypy: disable-error-code="index,attr-defined,misc,no-any-return,operator,arg-type,assignment"
# mypy: disable-error-code="call-overload,no-untyped-def"
# mypy: allow-untyped-calls, allow-untyped-decorators
# ruff: noqa: SIM102, UP018, RUF046  (nested wp.static branches and typed literals have a meaning in kernels)
"""The ray caster: one kernel factory, specialised on the outputs asked for and the terms of the scene.

One traversal per ray answers everything. A thread is a pixel of an instant; blocks of 64 threads are tiles of
8 x 8 pixels, so that their rays walk the same nodes of the tree. With Embree a thread is a packet of 4 x 4
pixels, four of them a tile. With shared walks (`tile_walk.py`) a block finds together what its rays hit, and
on a CPU a thread is a whole tile. What a specialisation does not need is not in its code.
"""

# No `from __future__ import annotations`: Warp needs the annotations of kernels in closures as objects.

from collections.abc import Collection
from functools import cache
from typing import NamedTuple

import warp as wp

from neurosim_core.render.body_arrays import BodyData
from neurosim_core.render.config import WalkConfig
from neurosim_core.render.embree import packet_caster
from neurosim_core.render.lighting import ambient_light, point_light, reflect_light
from neurosim_core.render.packet_shading import packet_eye, packet_shader
from neurosim_core.render.scene_data import SceneData
from neurosim_core.render.tile_walk import (
    ASK,
    TILE,
    UNFUSED,
    WalkData,
    find_faces,
    group_size,
    leave,
    meet_face,
    together_finder,
)
from neurosim_core.scene.materials import sample_finest, sample_nearest, sample_texture

OUTPUTS = ("log_radiance", "rgb", "depth", "normal", "instance")
"""Everything that a cast can answer."""

_BOUNDS = (64, 14)
"""Threads and, on CUDA, blocks of a multiprocessor that registers must do for: as measured on an H200."""
_COSINE_MIN = wp.constant(0.05)
_FAR_M = wp.constant(1.0e9)
_OFFSET_M = wp.constant(1.0e-3)


class Terms(NamedTuple):
    """What a scene and its settings need in the kernel."""

    textured: bool
    """Some material has a texture."""
    emissive: bool
    """Some material emits light."""
    baked: bool
    """Light is interpolated between corners instead of evaluated for each pixel."""
    supersampled: bool
    """Radiance is the mean over several rays per pixel."""
    embree: int = 0
    """Embree finds what rays hit, so many at once (`embree.packet_width`), on the CPU only; 0: Warp does."""
    finest_level: bool = False
    """Textures are read at their finest level, however large the footprint of a ray is."""
    nearest_texel: bool = False
    """With `finest_level`: as they are stored, not interpolated."""
    bodies: bool = False
    """Bodies move through the scene."""
    worlds: bool = False
    """Instants are those of many worlds, which may look or not (`WorldData`)."""
    world_scenes: bool = False
    """Worlds are in different scenes."""
    world_lenses: bool = False
    """Worlds look through different lenses."""
    walked: int = 0
    """Rays of a tile share a walk through the tree (`tile_walk`): a block of 64 threads looks at so many
    instants together. Pixels of which the lists do not tell are left to the kernel with `asking`."""
    asking: bool = False
    """Of the pixels that `walked` left, and no others: each ray walks by itself."""
    by_tile: bool = False
    """`walked` means a thread for each tile, which leaves nothing: on a CPU."""


@wp.struct
class WorldData:
    """Who looks, where worlds are rendered together; instants are [world, K], in this order in all arrays."""

    stride: int
    """K: room for instants of each world."""
    active: wp.array[int]
    """1: this world is rendered, 0: its pictures stay as they are, shape [world]."""
    scenes: wp.array[SceneData]
    """`Terms.world_scenes`: all scenes there are."""
    scene: wp.array[int]
    """`Terms.world_scenes`: which of them a world is in, shape [world]."""
    lens: wp.array[int]
    """`Terms.world_lenses`: rays of which lens, of those that follow each other in a layer, shape [world]."""


@wp.struct
class Hit:
    """What a ray hits first."""

    face: int
    """-1: nothing, and the rest has no meaning."""
    t: float
    """Distance along the ray [m]."""
    u: float
    """Weight of the first corner."""
    v: float
    """Weight of the second corner."""
    normal: wp.vec3
    """Unit normal of the face's front."""


@wp.func
def _to_srgb(linear: float) -> wp.uint8:
    # IEC 61966-2-1
    x = wp.clamp(linear, 0.0, 1.0)
    code = wp.where(x <= 0.0031308, 12.92 * x, 1.055 * wp.pow(x, 1.0 / 2.4) - 0.055)
    return wp.uint8(int(255.0 * code + 0.5))


@cache
def _kernel(outputs: tuple[str, ...], terms: Terms) -> wp.Kernel:
    with_log = "log_radiance" in outputs
    with_rgb = "rgb" in outputs
    with_depth = "depth" in outputs
    with_normal = "normal" in outputs
    with_instance = "instance" in outputs
    with_radiance = with_log or with_rgb
    textured = terms.textured
    finest_level = terms.finest_level
    nearest_texel = terms.nearest_texel
    emissive = terms.emissive
    with_images = len(outputs) > int(with_log)
    baked = terms.baked
    supersampled = terms.supersampled
    with_geometry = with_depth or with_normal or with_instance
    with_bodies = terms.bodies
    worlds = terms.worlds
    world_scenes = terms.world_scenes
    world_lenses = terms.world_lenses
    walked = terms.walked > 0
    leaving = walked and not terms.by_tile
    group = group_of(terms)
    asking = terms.asking

    @wp.func
    def meet_scene(scene: SceneData, origin: wp.vec3, ray: wp.vec3) -> Hit:
        query = wp.mesh_query_ray(scene.mesh, origin, ray, _FAR_M)
        hit = Hit()
        hit.face = wp.where(query.result, query.face, -1)
        hit.t = query.t
        hit.u = query.u
        hit.v = query.v
        hit.normal = query.normal
        return hit

    @wp.func
    def meet_listed(scene: SceneData, origin: wp.vec3, ray: wp.vec3, face: int) -> Hit:
        # `face`: what a walk found that the ray hits, -1: nothing, ASK: it does not tell.
        hit = Hit()
        hit.face = face
        if face >= 0:
            met = meet_face(scene.mesh, face, origin, ray)
            if met[0] >= 0.0:
                hit.t = met[0]
                hit.u = met[1]
                hit.v = met[2]
                hit.normal = scene.face_normal[face]
            else:
                hit.face = ASK
        if wp.static(not leaving):
            if hit.face == ASK:
                hit = meet_scene(scene, origin, ray)
        return hit

    @wp.func
    def surface_albedo(scene: SceneData, spread_rad: float, facing: float, hit: Hit) -> wp.vec3:
        material = scene.face_material[hit.face]
        albedo = scene.base_color[material]
        if wp.static(textured):
            texture = scene.material_texture[material]
            if texture[1] > 0:
                corner = 3 * hit.face
                uv = (
                    hit.u * scene.corner_uv[corner]
                    + hit.v * scene.corner_uv[corner + 1]
                    + (1.0 - hit.u - hit.v) * scene.corner_uv[corner + 2]
                )
                if wp.static(nearest_texel):
                    albedo = wp.cw_mul(albedo, sample_nearest(scene.texels, scene.levels, texture, uv))
                elif wp.static(finest_level):
                    albedo = wp.cw_mul(albedo, sample_finest(scene.texels, scene.levels, texture, uv))
                else:
                    footprint_m = spread_rad * hit.t / wp.max(wp.abs(facing), _COSINE_MIN)
                    lod = wp.log2(footprint_m) + scene.face_lod[hit.face] + scene.mip_bias
                    albedo = wp.cw_mul(albedo, sample_texture(scene.texels, scene.levels, texture, uv, lod))
        return albedo

    @wp.func
    def emitted(scene: SceneData, hit: Hit) -> wp.vec3:
        emission = wp.vec3(0.0)
        if wp.static(emissive):
            emission = scene.emission[scene.face_material[hit.face]]
        return emission

    @wp.func
    def shade(scene: SceneData, ray: wp.vec3, origin: wp.vec3, spread_rad: float, hit: Hit) -> wp.vec3:
        if hit.face < 0:
            return scene.sky
        corner = 3 * hit.face
        u = hit.u
        v = hit.v
        w = 1.0 - u - v
        facing = wp.dot(ray, hit.normal)
        albedo = surface_albedo(scene, spread_rad, facing, hit)
        if wp.static(baked):
            side = wp.where(facing > 0.0, 1, 0)
            light = (
                u * scene.corner_light[side, corner]
                + v * scene.corner_light[side, corner + 1]
                + w * scene.corner_light[side, corner + 2]
            )
        else:
            normal = wp.normalize(
                u * scene.corner_normal[corner]
                + v * scene.corner_normal[corner + 1]
                + w * scene.corner_normal[corner + 2]
            )
            if facing > 0.0:
                normal = -normal
            point = origin + hit.t * ray
            light = ambient_light(normal, scene.ambient_up, scene.ambient_down)
            for lamp in range(scene.light_position.shape[0]):
                light += point_light(
                    point,
                    normal,
                    scene.light_position[lamp],
                    scene.light_intensity[lamp],
                    scene.light_radius_m,
                )
        return reflect_light(albedo, light, emitted(scene, hit))

    @wp.func
    def meet_bodies(bodies: BodyData, instant: int, ray_C: wp.vec3, q_WC: wp.quat, hit: Hit):
        # What the ray hits first, `hit` or a point of a body, and which body, -1: none.
        nearest = Hit()
        nearest.face = hit.face
        nearest.t = wp.where(hit.face >= 0, hit.t, _FAR_M)
        nearest.u = hit.u
        nearest.v = hit.v
        nearest.normal = hit.normal
        met = int(-1)
        for body in range(bodies.mesh.shape[0]):
            sphere = bodies.sphere_C[instant, body]
            center = wp.vec3(sphere[0], sphere[1], sphere[2])
            radius = sphere[3]
            along = wp.dot(center, ray_C)
            beside = center - along * ray_C
            if along > -radius and along - radius < nearest.t and wp.dot(beside, beside) < radius * radius:
                q_OC = bodies.q_OC[instant, body]
                ray_O = wp.quat_rotate(q_OC, ray_C)
                query = wp.mesh_query_ray(bodies.mesh[body], bodies.p_OC[instant, body], ray_O, nearest.t)
                if query.result:
                    nearest.face = bodies.first_face[body] + query.face
                    nearest.t = query.t
                    nearest.u = query.u
                    nearest.v = query.v
                    nearest.normal = wp.quat_rotate(q_WC, wp.quat_rotate_inv(q_OC, query.normal))
                    met = body
        return nearest, met

    @wp.func
    def shade_body(
        scene: SceneData,
        bodies: BodyData,
        instant: int,
        body: int,
        q_WC: wp.quat,
        ray: wp.vec3,
        origin: wp.vec3,
        spread_rad: float,
        hit: Hit,
    ) -> wp.vec3:
        # Bodies move under lights that stand still, so nothing is baked: light is found here, and shadows.
        facing = wp.dot(ray, hit.normal)
        corner = 3 * (hit.face - bodies.first_face[0])
        normal_O = (
            hit.u * bodies.corner_normal[corner]
            + hit.v * bodies.corner_normal[corner + 1]
            + (1.0 - hit.u - hit.v) * bodies.corner_normal[corner + 2]
        )
        normal_C = wp.quat_rotate_inv(bodies.q_OC[instant, body], normal_O)
        normal = wp.normalize(wp.quat_rotate(q_WC, normal_C))
        outwards = hit.normal
        if facing > 0.0:
            normal = -normal
            outwards = -outwards
        point = origin + hit.t * ray
        light = ambient_light(normal, scene.ambient_up, scene.ambient_down)
        for lamp in range(scene.light_position.shape[0]):
            position = scene.light_position[lamp]
            part = point_light(point, normal, position, scene.light_intensity[lamp], scene.light_radius_m)
            if wp.static(baked):
                if wp.max(part) > 0.0:
                    start = point + _OFFSET_M * outwards
                    to_lamp = position - start
                    distance = wp.length(to_lamp)
                    if wp.mesh_query_ray_anyhit(bodies.shading, start, to_lamp / distance, distance):
                        part = wp.vec3(0.0)
            light += part
        return reflect_light(surface_albedo(scene, spread_rad, facing, hit), light, emitted(scene, hit))

    @wp.func
    def radiance_of(
        scene: SceneData,
        bodies: BodyData,
        instant: int,
        body: int,
        q_WC: wp.quat,
        ray: wp.vec3,
        origin: wp.vec3,
        spread_rad: float,
        hit: Hit,
    ) -> wp.vec3:
        if wp.static(with_bodies):
            if body >= 0:
                return shade_body(scene, bodies, instant, body, q_WC, ray, origin, spread_rad, hit)
        return shade(scene, ray, origin, spread_rad, hit)

    @wp.func
    def write_geometry(
        scene: SceneData,
        ray: wp.vec3,
        cosine: float,
        hit: Hit,
        slot: int,
        row: int,
        col: int,
        depth_out: wp.array3d[float],
        normal_out: wp.array3d[wp.vec3],
        instance_out: wp.array3d[int],
    ) -> None:
        if wp.static(with_depth):
            depth_out[slot, row, col] = wp.where(hit.face >= 0, hit.t * cosine, wp.inf)
        if wp.static(with_normal):
            normal = wp.vec3(0.0)
            if hit.face >= 0:
                normal = wp.where(wp.dot(hit.normal, ray) > 0.0, -hit.normal, hit.normal)
            normal_out[slot, row, col] = normal
        if wp.static(with_instance):
            name = int(-1)
            if hit.face >= 0:
                name = scene.face_instance[hit.face]
            instance_out[slot, row, col] = name

    @wp.func
    def write_radiance(
        scene: SceneData,
        total: wp.vec3,
        layer_count: int,
        instant: int,
        slot: int,
        row: int,
        col: int,
        log_radiance_out: wp.array3d[float],
        rgb_out: wp.array4d[wp.uint8],
    ) -> None:
        radiance = total
        if wp.static(supersampled):
            radiance = (1.0 / float(layer_count - 1)) * radiance
        if wp.static(with_log):
            luma = 0.2126 * radiance[0] + 0.7152 * radiance[1] + 0.0722 * radiance[2]
            log_radiance_out[instant, row, col] = wp.log(luma + scene.dark_floor)
        if wp.static(with_rgb):
            if slot >= 0:
                rgb_out[slot, row, col, 0] = _to_srgb(scene.exposure * radiance[0])
                rgb_out[slot, row, col, 1] = _to_srgb(scene.exposure * radiance[1])
                rgb_out[slot, row, col, 2] = _to_srgb(scene.exposure * radiance[2])

    @wp.func
    def see(
        index: int,
        scene: SceneData,
        rays: wp.array2d[wp.vec4],
        width: int,
        height: int,
        instant_count: int,
        p_WC: wp.array[wp.vec3],
        q_WC: wp.array[wp.quat],
        image_slot: wp.array[int],
        bodies: BodyData,
        world_data: WorldData,
        walk_data: WalkData,
        log_radiance_out: wp.array3d[float],
        rgb_out: wp.array4d[wp.uint8],
        depth_out: wp.array3d[float],
        normal_out: wp.array3d[wp.vec3],
        instance_out: wp.array3d[int],
    ):
        # A pixel of an instant, of which `index` tells: of a tile all instants, then the next tile. Threads
        # side by side should walk the same nodes: a block is a quarter of a tile at four instants, and
        # what is left over the whole tile at one.
        in_tile = index % 64
        block = index // 64
        instant = block % instant_count
        tile = block // instant_count
        if wp.static(not asking):
            if instant < instant_count // 4 * 4:
                quarter = instant % 4
                instant += in_tile // 16 - quarter
                in_tile = 32 * (quarter // 2) + 4 * (quarter % 2) + 8 * ((in_tile % 16) // 4) + in_tile % 4
        tile_columns = (width + 7) // 8
        world = int(0)
        first_ray = int(0)
        if wp.static(worlds):  # all tiles of a world, then the next world
            tile_count = tile_columns * ((height + 7) // 8)
            world = tile // tile_count
            tile -= world * tile_count
            instant += world * world_data.stride
            if world_data.active[world] == 0:
                return
        if wp.static(world_scenes):
            scene = world_data.scenes[world_data.scene[world]]
        if wp.static(world_lenses):
            first_ray = world_data.lens[world] * width * height
        col = (tile % tile_columns) * 8 + in_tile % 8
        row = (tile // tile_columns) * 8 + in_tile // 8
        if col >= width or row >= height:
            return
        slot = int(-1)
        if wp.static(with_images):
            slot = image_slot[instant]
            if wp.static(not with_log):
                if slot < 0:
                    return
        origin = p_WC[instant]
        q = q_WC[instant]
        pixel = first_ray + row * width + col
        radiance = wp.vec3(0.0)
        for layer in range(rays.shape[0]):
            if wp.static(supersampled):
                # Layer 0 goes through the centre and is for geometry, the others are for radiance.
                if layer == 0 and (slot < 0 or wp.static(not with_geometry)):
                    continue
            ray_C = rays[layer, pixel]
            ray = wp.quat_rotate(q, wp.vec3(ray_C[0], ray_C[1], ray_C[2]))
            hit = meet_scene(scene, origin, ray)
            body = int(-1)
            if wp.static(with_bodies):
                hit, body = meet_bodies(bodies, instant, wp.vec3(ray_C[0], ray_C[1], ray_C[2]), q, hit)
            if wp.static(with_radiance):
                if wp.static(not supersampled) or layer > 0:
                    radiance += radiance_of(scene, bodies, instant, body, q, ray, origin, ray_C[3], hit)
            if wp.static(with_geometry):
                if slot >= 0 and layer == 0:
                    write_geometry(
                        scene, ray, ray_C[2], hit, slot, row, col, depth_out, normal_out, instance_out
                    )
        if wp.static(with_radiance):
            write_radiance(scene, radiance, rays.shape[0], instant, slot, row, col, log_radiance_out, rgb_out)

    find_together = together_finder(group) if leaving else None

    @wp.func
    def see_together(
        index: int,
        scene: SceneData,
        rays: wp.array2d[wp.vec4],
        width: int,
        height: int,
        instant_count: int,
        p_WC: wp.array[wp.vec3],
        q_WC: wp.array[wp.quat],
        image_slot: wp.array[int],
        bodies: BodyData,
        world_data: WorldData,
        walk_data: WalkData,
        log_radiance_out: wp.array3d[float],
        rgb_out: wp.array4d[wp.uint8],
        depth_out: wp.array3d[float],
        normal_out: wp.array3d[wp.vec3],
        instance_out: wp.array3d[int],
    ):
        # A pixel of a group of instants, of which `index` tells; what blocks do together, all threads do.
        in_tile = index % 64
        block = index // 64
        group_count = (instant_count + group - 1) // group
        first = (block % group_count) * group
        tile = block // group_count
        instants = wp.min(instant_count - first, group)
        tile_columns = (width + 7) // 8
        world = int(0)
        block = tile * instant_count + first  # of the first instant, as `see` counts
        if wp.static(worlds):
            tile_count = tile_columns * ((height + 7) // 8)
            world = tile // tile_count
            tile -= world * tile_count
            first += world * world_data.stride
            if world_data.active[world] == 0:
                return
        col = (tile % tile_columns) * 8 + in_tile % 8
        row = (tile // tile_columns) * 8 + in_tile // 8
        outside = col >= width or row >= height
        pixel = wp.min(row, height - 1) * width + wp.min(col, width - 1)
        walk = first // walk_data.instants
        layer_count = rays.shape[0]
        radiance = wp.vec3(0.0)
        left = bool(False)
        for layer in range(layer_count):
            ray_C = rays[layer, pixel]
            faces = find_together(
                scene.mesh,
                walk_data.faces,
                (walk * walk_data.bounds.shape[0] + tile) * walk_data.limit,
                walk_data.count[walk, tile],
                walk_data.reach[walk, tile],
                _FAR_M,
                walk_data.bounds[tile],
                p_WC,
                q_WC,
                first,
                instants,
                wp.vec3(ray_C[0], ray_C[1], ray_C[2]),
            )
            for member in range(instants):
                instant = first + member
                slot = int(-1)
                if wp.static(with_images):
                    slot = image_slot[instant]
                seen = not outside and not left
                if wp.static(with_images and not with_log):
                    seen = seen and slot >= 0
                if wp.static(supersampled):
                    seen = seen and (layer > 0 or (slot >= 0 and wp.static(with_geometry)))
                if seen:
                    origin = p_WC[instant]
                    q = q_WC[instant]
                    ray = wp.quat_rotate(q, wp.vec3(ray_C[0], ray_C[1], ray_C[2]))
                    hit = meet_listed(scene, origin, ray, faces[member])
                    left = hit.face == ASK
                    if not left:
                        body = int(-1)
                        if wp.static(with_bodies):
                            hit, body = meet_bodies(
                                bodies, instant, wp.vec3(ray_C[0], ray_C[1], ray_C[2]), q, hit
                            )
                        if wp.static(with_radiance):
                            if wp.static(not supersampled) or layer > 0:
                                radiance += radiance_of(
                                    scene, bodies, instant, body, q, ray, origin, ray_C[3], hit
                                )
                        if wp.static(with_geometry):
                            if slot >= 0 and layer == 0:
                                write_geometry(
                                    scene,
                                    ray,
                                    ray_C[2],
                                    hit,
                                    slot,
                                    row,
                                    col,
                                    depth_out,
                                    normal_out,
                                    instance_out,
                                )
                if layer == layer_count - 1:
                    leave(left, (block + member) * 64 + in_tile, walk_data.left, walk_data.left_count)
                    if wp.static(with_radiance):
                        if seen and not left:
                            write_radiance(
                                scene,
                                radiance,
                                layer_count,
                                instant,
                                slot,
                                row,
                                col,
                                log_radiance_out,
                                rgb_out,
                            )
                    radiance = wp.vec3(0.0)
                    left = bool(False)

    look = see_together if leaving else see

    @wp.kernel(
        module="unique",
        enable_backward=False,
        module_options=UNFUSED,
        launch_bounds=None if leaving else _BOUNDS,
    )
    def raycast(
        first: int,
        # Model:
        scene: SceneData,
        rays: wp.array2d[wp.vec4],
        width: int,
        height: int,
        # In:
        instant_count: int,
        p_WC: wp.array[wp.vec3],
        q_WC: wp.array[wp.quat],
        image_slot: wp.array[int],
        bodies: BodyData,
        world_data: WorldData,
        walk_data: WalkData,
        # Out:
        log_radiance_out: wp.array3d[float],
        rgb_out: wp.array4d[wp.uint8],
        depth_out: wp.array3d[float],
        normal_out: wp.array3d[wp.vec3],
        instance_out: wp.array3d[int],
    ) -> None:
        begin = first + wp.tid()
        end = begin + 1
        step = int(1)
        listed = bool(False)
        if wp.static(asking):
            end = walk_data.left_count[0]
            step = walk_data.left_threads
            listed = end <= walk_data.left.shape[0]
            if not listed:  # all pixels
                end = instant_count * walk_data.bounds.shape[0] * 64
                if wp.static(worlds):
                    end *= world_data.active.shape[0]
        for place in range(begin, end, step):
            index = place
            if listed:
                index = walk_data.left[place]
            look(
                index,
                scene,
                rays,
                width,
                height,
                instant_count,
                p_WC,
                q_WC,
                image_slot,
                bodies,
                world_data,
                walk_data,
                log_radiance_out,
                rgb_out,
                depth_out,
                normal_out,
                instance_out,
            )

    if not (terms.embree or terms.by_tile):
        return raycast

    side = TILE if terms.by_tile else 4
    lanes = side * side
    packets = (TILE // side) ** 2  # of a tile
    cast_packet = packet_caster(terms.embree) if terms.embree else None

    together = with_radiance and baked and not with_bodies and not finest_level
    each_lane = with_geometry or walked or not together
    shade_packet = packet_shader(lanes, textured=textured, emissive=emissive, unit_normals=walked)
    at_once = with_log and together and not walked  # where no picture is asked for
    see_packet = packet_eye(terms.embree, textured=textured, emissive=emissive) if at_once else None

    @wp.kernel(module="unique", enable_backward=False, module_options={} if terms.embree else UNFUSED)
    def raycast_packets(
        first: int,
        # Model:
        scene: SceneData,
        rays: wp.array2d[wp.vec4],
        width: int,
        height: int,
        # In:
        instant_count: int,
        p_WC: wp.array[wp.vec3],
        q_WC: wp.array[wp.quat],
        image_slot: wp.array[int],
        bodies: BodyData,
        world_data: WorldData,
        walk_data: WalkData,
        # Out:
        log_radiance_out: wp.array3d[float],
        rgb_out: wp.array4d[wp.uint8],
        depth_out: wp.array3d[float],
        normal_out: wp.array3d[wp.vec3],
        instance_out: wp.array3d[int],
    ) -> None:
        # A packet is the same pixels in every launch: the last bit of a hit may depend on the other rays.
        index = first + wp.tid()
        in_tile = index % packets
        block = index // packets
        instant = block % instant_count
        tile = block // instant_count
        tile_columns = (width + 7) // 8
        world = int(0)
        first_ray = int(0)
        if wp.static(worlds):
            tile_count = tile_columns * ((height + 7) // 8)
            world = tile // tile_count
            tile -= world * tile_count
            instant += world * world_data.stride
            if world_data.active[world] == 0:
                return
        if wp.static(world_scenes):
            scene = world_data.scenes[world_data.scene[world]]
        if wp.static(world_lenses):
            first_ray = world_data.lens[world] * width * height
        left = (tile % tile_columns) * 8 + (in_tile % 2) * side
        top = (tile // tile_columns) * 8 + (in_tile // 2) * side
        if left >= width or top >= height:
            return
        slot = int(-1)
        if wp.static(with_images):
            slot = image_slot[instant]
            if wp.static(not with_log):
                if slot < 0:
                    return
        origin = p_WC[instant]
        q = q_WC[instant]
        columns = wp.min(width - left, side)
        rows = wp.min(height - top, side)
        if wp.static(at_once):
            if slot < 0:
                see_packet(
                    scene,
                    rays,
                    first_ray + top * width + left,
                    width,
                    origin,
                    q,
                    _FAR_M,
                    instant,
                    top,
                    left,
                    rows,
                    columns,
                    log_radiance_out,
                )
                return
        ray = wp.zeros(shape=(lanes,), dtype=wp.vec3)
        face = wp.zeros(shape=(lanes,), dtype=int)
        t = wp.zeros(shape=(lanes,), dtype=float)
        u = wp.zeros(shape=(lanes,), dtype=float)
        v = wp.zeros(shape=(lanes,), dtype=float)
        normal = wp.zeros(shape=(lanes,), dtype=wp.vec3)
        radiance = wp.zeros(shape=(lanes,), dtype=wp.vec3)
        spread_rad = wp.zeros(shape=(lanes if together else 1,), dtype=float)
        for layer in range(rays.shape[0]):
            if wp.static(supersampled):
                if layer == 0 and (slot < 0 or wp.static(not with_geometry)):
                    continue
            for y in range(rows):
                for x in range(columns):
                    ray_C = rays[layer, first_ray + (top + y) * width + left + x]
                    ray[side * y + x] = wp.quat_rotate(q, wp.vec3(ray_C[0], ray_C[1], ray_C[2]))
                    if wp.static(together):
                        spread_rad[side * y + x] = ray_C[3]
            if wp.static(walked):
                walk = instant // walk_data.instants
                find_faces(
                    scene.mesh,
                    walk_data.faces,
                    (walk * walk_data.bounds.shape[0] + tile) * walk_data.limit,
                    walk_data.count[walk, tile],
                    walk_data.reach[walk, tile],
                    _FAR_M,
                    walk_data.bounds[tile],
                    q,
                    origin,
                    ray,
                    face,
                )
            else:
                cast_packet(
                    scene.embree_intersect, scene.embree_scene, origin, ray, _FAR_M, face, t, u, v, normal
                )
            if wp.static(each_lane):
                for y in range(rows):
                    for x in range(columns):
                        lane = side * y + x
                        ray_C = rays[layer, first_ray + (top + y) * width + left + x]
                        if wp.static(walked):
                            hit = meet_listed(scene, origin, ray[lane], face[lane])
                        else:
                            hit = Hit()
                            hit.face = face[lane]
                            hit.t = t[lane]
                            hit.u = u[lane]
                            hit.v = v[lane]
                            hit.normal = wp.normalize(normal[lane])
                        body = int(-1)
                        if wp.static(with_bodies):
                            hit, body = meet_bodies(
                                bodies, instant, wp.vec3(ray_C[0], ray_C[1], ray_C[2]), q, hit
                            )
                        if wp.static(walked and together):
                            face[lane] = hit.face
                            t[lane] = hit.t
                            u[lane] = hit.u
                            v[lane] = hit.v
                            normal[lane] = hit.normal
                        if wp.static(with_radiance and not together):
                            if wp.static(not supersampled) or layer > 0:
                                radiance[lane] += radiance_of(
                                    scene, bodies, instant, body, q, ray[lane], origin, ray_C[3], hit
                                )
                        if wp.static(with_geometry):
                            if slot >= 0 and layer == 0:
                                write_geometry(
                                    scene,
                                    ray[lane],
                                    ray_C[2],
                                    hit,
                                    slot,
                                    top + y,
                                    left + x,
                                    depth_out,
                                    normal_out,
                                    instance_out,
                                )
            if wp.static(together):
                if wp.static(not supersampled) or layer > 0:
                    shade_packet(
                        scene,
                        ray,
                        spread_rad,
                        face,
                        t,
                        u,
                        v,
                        normal,
                        radiance,
                    )
        if wp.static(with_radiance):
            for y in range(rows):
                for x in range(columns):
                    write_radiance(
                        scene,
                        radiance[side * y + x],
                        rays.shape[0],
                        instant,
                        slot,
                        top + y,
                        left + x,
                        log_radiance_out,
                        rgb_out,
                    )

    return raycast_packets


def raycast_kernel(outputs: Collection[str], terms: Terms) -> wp.Kernel:
    """Return the kernel that casts rays for `outputs` in a scene with `terms`; made once per combination.

    Its outputs, all [.., H, W]: log_radiance, log(Rec. 709 luma + dark floor), of each instant; and of
    instants
    with image_slot >= 0, in that slot: rgb, sRGB of exposure times radiance; depth, planar z [m], inf where
    nothing is hit; normal, of the triangle, in W, towards the camera, zero where nothing is hit; instance, -1
    where nothing is hit.

    Rays are [layer, H * W]: direction in C and spread [rad]. One layer, or the layer of the centres and then
    the samples whose mean is the radiance.

    The texture level comes from the footprint of the ray: ray spread times distance over |cos|, its long
    side on the surface. The filter is isotropic: a surface seen at a grazing angle is blurred across as much
    as along. The short side or the geometric mean would keep more detail there, but alias along the surface,
    and aliasing makes events that no sensor sees. |cos| counts as at least 0.05.

    Bodies are met after the scene: of each whose sphere the ray passes, the tree is asked in the frame of the
    body, no further than the nearest hit so far. Their light is found for each pixel: ambient, and the lamps
    that no part of the scene hides from it (all lamps, where the scene itself is unshadowed).

    Raises:
        ValueError: If an output is unknown or none is asked for, or unlike worlds are to share walks.
    """
    if terms.walked and (terms.world_scenes or terms.world_lenses):
        raise ValueError("rays share walks where worlds have one scene and one lens")
    if not terms.walked:
        terms = terms._replace(by_tile=False)
    unknown = sorted(set(outputs) - set(OUTPUTS))
    if unknown or not outputs:
        raise ValueError(f"outputs must be some of {list(OUTPUTS)}, got {sorted(outputs)}")
    return _kernel(tuple(name for name in OUTPUTS if name in outputs), terms)


def with_walks(terms: Terms, walk: WalkConfig | None, *, group: int | None = None) -> Terms:
    """Return terms for rays that share walks, or do not; a group of instants divides those of a walk."""
    if walk is None:
        return terms._replace(walked=0, by_tile=False)
    return terms._replace(walked=group or group_size(walk.instants))


def group_of(terms: Terms) -> int:
    """Return how many instants a thread of `raycast_kernel` looks at; 1 where threads are tiles or packets.

    Samples of a pixel are added up one instant at a time.
    """
    return terms.walked if terms.walked and not (terms.by_tile or terms.supersampled) else 1


def asking_kernel(outputs: Collection[str], terms: Terms) -> wp.Kernel | None:
    """Return the kernel that renders the pixels that `raycast_kernel` leaves; None: it leaves none.

    It is launched after the other, with the same arguments and `WalkData.left_threads` threads.
    """
    if not terms.walked or terms.by_tile:
        return None
    return raycast_kernel(outputs, terms._replace(walked=0, asking=True))
