# mypy: disable-error-code="index,attr-defined,misc,operator"
# ruff: noqa: SIM102, UP018, RUF046  (nested wp.static branches, typed literals: they have a meaning)
"""The ray caster of a CPU: a thread is a packet of pixels, of which four are a tile, or a tile.

With Embree a thread is a packet of 4 x 4 pixels, with candidate lists (`candidate_lists.py`) a whole tile.
"""

# No `from __future__ import annotations`: Warp needs the annotations of kernels in closures as objects.

import warp as wp

from neurosim_core.render.body_arrays import BodyData
from neurosim_core.render.candidate_data import TILE, UNRESOLVED, CandidateListData
from neurosim_core.render.candidate_intersection import intersect_tile
from neurosim_core.render.embree import packet_caster
from neurosim_core.render.outputs import (
    RADIANCE,
    RenderOutputs,
    geometry_writer,
    radiance_writer,
    requested_outputs,
)
from neurosim_core.render.packet_shading import face_caster, packet_program, packet_shader
from neurosim_core.render.ray_intersection import (
    FAR_M,
    UNFUSED,
    Hit,
    intersect_bodies,
    intersect_candidate,
    intersect_scene,
)
from neurosim_core.render.render_terms import RenderTerms
from neurosim_core.render.scene_data import SceneData
from neurosim_core.render.shading import pixel_shader
from neurosim_core.render.view_data import ViewData, WorldData, tile_locator


def packet_kernel(outputs: tuple[str, ...], terms: RenderTerms) -> wp.Kernel:
    """Build the kernel; see `raycast.raycast_kernel`."""
    requested = requested_outputs(outputs)
    listed = terms.candidate_group > 0
    every_instant = requested.log or requested.faces
    locate_tile = tile_locator(terms, images=requested.images, instants=every_instant)
    radiance_of = pixel_shader(terms)
    write_geometry = geometry_writer(outputs, terms, allocated=True)
    write_radiance = radiance_writer(RADIANCE, supersampled=False, allocated=True)
    side = TILE if terms.by_tile else 4
    lanes = side * side
    packets = (TILE // side) ** 2  # of a tile
    cast_packet = packet_caster(terms.embree, origins=terms.timed) if terms.embree else None

    packed = requested.radiance and terms.baked and not terms.bodies and not terms.finest_level
    origin_count = lanes if terms.timed else 1
    each_lane = requested.geometry or listed or not packed
    shade_packet = packet_shader(lanes, unit_normals=listed)
    fused = requested.log and packed and not listed and not terms.timed  # for instants without an image slot
    render_packet = packet_program(terms.embree) if fused else None
    plain = requested.faces and not (requested.radiance or terms.bodies or listed)
    cast_faces = face_caster(terms.embree, timed=terms.timed) if plain else None

    @wp.kernel(module="unique", enable_backward=False, module_options={} if terms.embree else UNFUSED)
    def raycast_packets(
        first: int,
        # In:
        scene: SceneData,
        view: ViewData,
        bodies: BodyData,
        worlds: WorldData,
        candidates: CandidateListData,
        # Out:
        out: RenderOutputs,
    ) -> None:
        # A packet is the same pixels in every launch: the last bit of a hit may depend on the other rays.
        index = first + wp.tid()
        in_tile = index % packets
        block = index // packets
        instant = block % view.instant_count
        place = locate_tile(block // view.instant_count, instant, view, worlds)
        if wp.static(terms.world_scenes):
            scene = worlds.scenes[worlds.scene[place.world]]
        left = place.left + (in_tile % 2) * side
        top = place.top + (in_tile // 2) * side
        if not place.rendered or left >= view.width or top >= view.height:
            return
        instant = place.instant
        tile = place.tile
        first_ray = place.first_ray
        slot = place.slot
        origin = view.p_WC[instant]
        q = view.q_WC[instant]
        columns = wp.min(view.width - left, side)
        rows = wp.min(view.height - top, side)
        if wp.static(fused):
            if slot < 0:
                render_packet(
                    scene,
                    view.rays,
                    first_ray + top * view.width + left,
                    view.width,
                    origin,
                    q,
                    FAR_M,
                    instant,
                    top,
                    left,
                    rows,
                    columns,
                    out.log_radiance,
                )
                return
        if wp.static(plain):
            if slot < 0 or wp.static(not requested.geometry):
                cast_faces(
                    scene,
                    view,
                    first_ray + top * view.width + left,
                    FAR_M,
                    instant,
                    top,
                    left,
                    rows,
                    columns,
                    out.face,
                )
                return
        ray = wp.zeros(shape=(lanes,), dtype=wp.vec3)
        face = wp.zeros(shape=(lanes,), dtype=int)
        t = wp.zeros(shape=(lanes,), dtype=float)
        u = wp.zeros(shape=(lanes,), dtype=float)
        v = wp.zeros(shape=(lanes,), dtype=float)
        normal = wp.zeros(shape=(lanes,), dtype=wp.vec3)
        radiance = wp.zeros(shape=(lanes,), dtype=wp.vec3)
        origins = wp.zeros(shape=(origin_count,), dtype=wp.vec3)
        spread_rad = wp.zeros(shape=(lanes if packed else 1,), dtype=float)
        layers = view.rays.shape[0]
        for layer in range(layers):
            if layers > 1 and layer == 0 and (slot < 0 or wp.static(not requested.geometry)):
                continue
            for y in range(rows):
                for x in range(columns):
                    ray_C = view.rays[layer, first_ray + (top + y) * view.width + left + x]
                    if wp.static(terms.timed):
                        pose = instant * view.pose_count + view.pose[layer, (top + y) * view.width + left + x]
                        q = view.q_WC[pose]
                        origins[side * y + x] = view.p_WC[pose]
                    ray[side * y + x] = wp.quat_rotate(q, wp.vec3(ray_C[0], ray_C[1], ray_C[2]))
                    if wp.static(packed):
                        spread_rad[side * y + x] = ray_C[3]
            if wp.static(listed):
                group = instant // candidates.instants
                intersect_tile(
                    scene.mesh,
                    candidates.faces,
                    (group * candidates.bounds.shape[0] + tile) * candidates.limit,
                    candidates.count[group, tile],
                    candidates.reach[group, tile],
                    FAR_M,
                    candidates.bounds[tile],
                    q,
                    origin,
                    ray,
                    face,
                )
            else:
                embree_scene = scene.embree_scene
                if wp.static(requested.faces):
                    if layer == layers - 1:
                        embree_scene = scene.embree_quick
                if wp.static(terms.timed):
                    cast_packet(
                        scene.embree_intersect, embree_scene, origins, ray, FAR_M, face, t, u, v, normal
                    )
                else:
                    cast_packet(
                        scene.embree_intersect, embree_scene, origin, ray, FAR_M, face, t, u, v, normal
                    )
            if wp.static(each_lane):
                for y in range(rows):
                    for x in range(columns):
                        lane = side * y + x
                        ray_C = view.rays[layer, first_ray + (top + y) * view.width + left + x]
                        if wp.static(listed):
                            hit = intersect_candidate(scene, origin, ray[lane], face[lane])
                            if hit.face == UNRESOLVED:
                                hit = intersect_scene(scene, origin, ray[lane])
                        else:
                            hit = Hit()
                            hit.face = face[lane]
                            hit.t = t[lane]
                            hit.u = u[lane]
                            hit.v = v[lane]
                            hit.normal = wp.normalize(normal[lane])
                        body = int(-1)
                        pose = instant
                        if wp.static(terms.timed):
                            own = view.pose[layer, (top + y) * view.width + left + x]
                            pose = instant * view.pose_count + own
                            origin = view.p_WC[pose]
                            q = view.q_WC[pose]
                        if wp.static(terms.bodies):
                            hit, body = intersect_bodies(
                                bodies, pose, wp.vec3(ray_C[0], ray_C[1], ray_C[2]), q, hit
                            )
                        if wp.static(listed and packed):
                            face[lane] = hit.face
                            t[lane] = hit.t
                            u[lane] = hit.u
                            v[lane] = hit.v
                            normal[lane] = hit.normal
                        if wp.static(requested.faces):
                            if layer == layers - 1:
                                out.face[instant, top + y, left + x] = hit.face
                        if wp.static(requested.radiance and not packed):
                            if layers == 1 or layer > 0:
                                radiance[lane] += radiance_of(
                                    scene, bodies, pose, body, q, ray[lane], origin, ray_C[3], hit
                                )
                        if wp.static(requested.geometry):
                            if slot >= 0 and layer == 0:
                                write_geometry(
                                    scene, ray[lane], ray_C[2], ray_C[3], hit, slot, top + y, left + x, out
                                )
            if wp.static(packed):
                if layers == 1 or layer > 0:
                    shade_packet(scene, ray, spread_rad, face, t, u, v, normal, radiance)
        if wp.static(requested.radiance):
            share = 1.0 / float(wp.max(layers - 1, 1))
            for y in range(rows):
                for x in range(columns):
                    write_radiance(
                        scene, share * radiance[side * y + x], 1, instant, slot, top + y, left + x, out
                    )

    return raycast_packets
