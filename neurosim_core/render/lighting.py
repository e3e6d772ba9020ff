# mypy: disable-error-code="index,attr-defined,misc,operator,no-untyped-def,return-value"
# ruff: noqa: UP018, RUF046  (typed literals are variables in kernels)
"""Light: the one equation of how a surface looks, and its shadows, computed once per scene.

Linear radiance of a Lambertian surface, seen from the side of its normal n (surfaces are two-sided: n points
to the viewer):

    radiance = albedo * (ambient(n) + sum_lights intensity * max(cos, 0) / d^2) + emission
    ambient(n) = up * (1 + n_z) / 2 + down * (1 - n_z) / 2

Scene and lights do not move, so the bracket, the light that a white surface reflects, does not depend on the
view: `bake_light` computes it once, with shadows and ambient occlusion, and a renderer only interpolates.
"""

from __future__ import annotations

import functools
import inspect
import math
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from neurosim_core.render.config import LightingConfig
from neurosim_core.render.embree import EmbreeTree, embree_distance, packet_width
from neurosim_core.render.kernel_data import SceneData
from neurosim_core.render.launch import launch_split
from neurosim_core.render.light_cache import cached_arrays
from neurosim_core.render.ray_tree import make_mesh
from neurosim_core.scene.scene import RefinedMesh, Scene

wp.set_module_options({"enable_backward": False})

_GOLDEN_ANGLE = math.pi * (3.0 - math.sqrt(5.0))
_BURIED = 0.1  # occluders at 5 % of the ambient radius all around
_OFFSET_M = wp.constant(1.0e-3)
_KEPT_FACES_MIN = 10_000
"""Scenes of fewer triangles are lit as fast as their light is read, and so are all on CUDA (0.1 s)."""


@wp.func
def ambient_light(normal: wp.vec3, up: wp.vec3, down: wp.vec3) -> wp.vec3:
    """Return what a white surface reflects of the hemispheric ambient light."""
    blend = 0.5 + 0.5 * normal[2]
    return blend * up + (1.0 - blend) * down


@wp.func
def point_light(
    point: wp.vec3, normal: wp.vec3, position: wp.vec3, intensity: wp.vec3, light_radius_m: float
) -> wp.vec3:
    """Return what a white surface reflects of an unshaded point light: intensity * max(cos, 0) / d^2."""
    to_light = position - point
    distance2 = wp.dot(to_light, to_light)
    cosine = wp.dot(to_light, normal) / wp.sqrt(wp.max(distance2, 1.0e-12))
    return (wp.max(cosine, 0.0) / wp.max(distance2, light_radius_m * light_radius_m)) * intensity


@wp.func
def reflect_light(albedo: wp.vec3, light: wp.vec3, emission: wp.vec3) -> wp.vec3:
    """Return the radiance of a surface, given what a white one would reflect."""
    return wp.cw_mul(albedo, light) + emission


@wp.kernel
def _bake(
    first: int,
    # Model:
    scene: SceneData,
    ambient_radius_m: float,
    interreflection: float,
    hemisphere: wp.array[wp.vec3],
    sphere: wp.array[wp.vec3],
    # In:
    vertices: wp.array[wp.vec3],
    faces: wp.array[wp.vec3i],
    group_normal: wp.array[wp.vec3],
    group_first: wp.array[int],
    group_corner: wp.array[int],
    # Out:
    light_out: wp.array[wp.vec3],
    openness_out: wp.array[float],
) -> None:
    index = first + wp.tid()
    group = index // 2
    side = 1.0 - 2.0 * float(index % 2)
    normal = side * group_normal[group]
    begin = group_first[group]
    count = group_first[group + 1] - begin

    handed = wp.where(normal[2] < 0.0, -1.0, 1.0)
    a = -1.0 / (handed + normal[2])
    b = normal[0] * normal[1] * a
    tangent = wp.vec3(1.0 + handed * normal[0] * normal[0] * a, handed * b, -handed * normal[0])
    bitangent = wp.vec3(b, handed + normal[1] * normal[1] * a, -normal[1])

    point = wp.vec3(0.0)
    openness = float(0.0)
    ray_count = hemisphere.shape[0]
    ray = int(0)
    while ray < ray_count:
        corner = group_corner[begin + ray % count]
        origin, face_normal, point = _sample_point(vertices, faces, corner, ray, normal)
        local = hemisphere[ray]
        direction = local[0] * tangent + local[1] * bitangent + local[2] * normal
        below = wp.dot(direction, face_normal)
        if below < 0.0:
            direction = direction - 2.0 * below * face_normal
        near = _free_distance(scene, origin, direction, ambient_radius_m) / ambient_radius_m
        openness += near * (2.0 - near)
        ray += 1
        if 4 * ray >= ray_count and (openness == float(ray) or openness < 0.25 * float(ray)):
            ray_count = ray  # a quarter of the directions, which are well spread: all open, or a dark corner
    openness = openness / float(ray_count)
    openness_out[index] = openness
    openness = openness / (1.0 - interreflection * (1.0 - openness))
    light = openness * ambient_light(normal, scene.ambient_up, scene.ambient_down)

    for lamp in range(scene.light_position.shape[0]):
        position = scene.light_position[lamp]
        unshaded = point_light(point, normal, position, scene.light_intensity[lamp], scene.light_radius_m)
        if wp.max(unshaded) > 0.0:
            clear = int(0)
            shadow_ray_count = sphere.shape[0]
            shadow_ray = int(0)
            while shadow_ray < shadow_ray_count:
                corner = group_corner[begin + shadow_ray % count]
                origin, _face_normal, _corner_point = _sample_point(
                    vertices, faces, corner, shadow_ray, normal
                )
                to_light = position + scene.light_radius_m * sphere[shadow_ray] - origin
                distance = wp.length(to_light)
                if not _is_blocked(scene, origin, to_light / distance, distance):
                    clear += 1
                shadow_ray += 1
                if 2 * shadow_ray >= shadow_ray_count and (clear == 0 or clear == shadow_ray):
                    shadow_ray_count = shadow_ray  # half of them agree: full light or full shadow
            light = light + (float(clear) / float(shadow_ray_count)) * unshaded
    light_out[index] = light


@wp.func
def _free_distance(scene: SceneData, origin: wp.vec3, ray: wp.vec3, far_m: float) -> float:
    # Embree's tree where there is a function for it, else Warp's
    distance = far_m
    if scene.embree_intersect != wp.uint64(0):
        distance = embree_distance(scene.embree_intersect, scene.embree_scene, origin, ray, far_m)
    else:
        query = wp.mesh_query_ray(scene.mesh, origin, ray, far_m)
        if query.result:
            distance = query.t
    return distance


@wp.func
def _is_blocked(scene: SceneData, origin: wp.vec3, ray: wp.vec3, far_m: float) -> bool:
    if scene.embree_intersect != wp.uint64(0):
        return embree_distance(scene.embree_intersect, scene.embree_scene, origin, ray, far_m) < far_m
    return wp.mesh_query_ray_anyhit(scene.mesh, origin, ray, far_m)


@wp.func
def _sample_point(
    vertices: wp.array[wp.vec3], faces: wp.array[wp.vec3i], corner: int, ray: int, normal: wp.vec3
):
    # Off the surface and inside the corner: never on the edge where surfaces meet, and spread over the inner
    # part of the face, so that occluders smaller than faces are averaged and not aliased.
    face = faces[corner // 3]
    p0 = vertices[face[0]]
    p1 = vertices[face[1]]
    p2 = vertices[face[2]]
    point = vertices[face[corner % 3]]
    face_normal = wp.normalize(wp.cross(p1 - p0, p2 - p0))
    if wp.dot(face_normal, normal) < 0.0:
        face_normal = -face_normal
    inwards = (p0 + p1 + p2) / 3.0 - point
    golden = 0.618034 * float(ray)
    inset = 0.1 + 0.6 * (golden - wp.floor(golden))
    return point + inset * inwards + _OFFSET_M * face_normal, face_normal, point


def spread_order(count: int) -> NDArray[np.int64]:
    """Return an order of `count` items in which every part of the order is spread evenly over them."""
    stride = round(count * (math.sqrt(5.0) - 1.0) / 2.0)
    while math.gcd(stride, count) != 1:
        stride += 1
    return np.arange(count) * stride % count


def _hemisphere(count: int) -> NDArray[np.float32]:
    """Return cosine-weighted directions about z, a Fibonacci spiral, shape [count, 3]."""
    k = spread_order(count)
    radius2 = (k + 0.5) / count
    angle = k * _GOLDEN_ANGLE
    radius = np.sqrt(radius2)
    columns = radius * np.cos(angle), radius * np.sin(angle), np.sqrt(1.0 - radius2)
    return np.stack(columns, axis=1, dtype=np.float32)


def _sphere(count: int) -> NDArray[np.float32]:
    """Return evenly spread directions, a Fibonacci spiral, shape [count, 3]."""
    k = spread_order(count)
    z = 1.0 - (2.0 * k + 1.0) / count
    radius = np.sqrt(1.0 - z * z)
    columns = radius * np.cos(k * _GOLDEN_ANGLE), radius * np.sin(k * _GOLDEN_ANGLE), z
    return np.stack(columns, axis=1, dtype=np.float32)


def _unbury(light: NDArray[np.float32], openness: NDArray[np.float32], faces: NDArray[np.int64]) -> None:
    """Give buried points (a floor under a carpet) the mean light of the neighbours that are not, in place.

    They are not seen, but faces reach from them into the open, and would be dark there. Shapes: light of each
    group on each side [G, 2, 3], openness [G, 2], groups of the corners of each face [F, 3].
    """
    corners = np.ascontiguousarray(faces.T)
    for side in range(2):
        buried = openness[:, side] < _BURIED
        first, second, third = (buried.take(corner) for corner in corners)
        some = (first | second | third) & ~(first & second & third)  # few faces
        a, b, c = (corner[some] for corner in corners)
        one, other = np.concatenate([a, b, c, b, c, a]), np.concatenate([b, c, a, a, b, c])
        rim = buried.take(one) & ~buried.take(other)
        inside, outside = one[rim], other[rim]
        count = np.bincount(inside, minlength=len(light))
        touched = count > 0
        for channel in range(3):
            total = np.bincount(inside, light[outside, side, channel], minlength=len(light))
            light[touched, side, channel] = total[touched] / count[touched]


def shading_faces(scene: Scene) -> NDArray[np.int32]:
    """Return the triangles of a scene that cast shadows: all that do not emit light, shape [F, 3]."""
    dark = np.array([max(m.emission) <= 0.0 for m in scene.materials])[scene.face_material]
    return scene.faces[dark] if dark.any() else np.zeros((1, 3), dtype=np.int32)  # a point hides nothing


def bake_light(
    scene: Scene, mesh: RefinedMesh, config: LightingConfig, *, device: str, embree: bool = False
) -> NDArray[np.float32]:
    """Return the light that a white surface reflects at each corner of each face, on both sides.

    Corners in the same place with the same shading normal share one value: the rays are spread over them.
    Point lights are dimmed by the share of shadow rays that reach them. Ambient light is dimmed by the mean
    over cosine-weighted rays of (1 - t / R)^2 where something is hit at t < R; of what is taken, occluders
    give back `interreflection`, and so on: open / (1 - interreflection (1 - open)). Emitting faces cast no
    shadow, so a light may sit inside its lamp. Buried points take the light of their neighbours. Directions
    are fixed: the same scene gives the same light. Rays stop early where a well spread part of them agrees.
    On a CPU the light of a large scene is kept on disk (`light_cache`).

    Returns:
        Linear light, shape [2, F, 3, 3]: front and back, face, corner, RGB.
    """

    def compute() -> dict[str, NDArray[Any]]:
        with ThreadPoolExecutor(max_workers=1) as aside:
            building = aside.submit(_build_occluders, scene, device, embree=embree)
            group, _ = mesh.corner_groups
            occluders = building.result()
        light, openness = _light_groups(scene, mesh, config, occluders, device)
        _unbury(light, openness, group.reshape(-1, 3))
        return {"light": light, "group": group.astype(np.int32)}

    caster = wp.get_device(device).name, embree and packet_width()
    inputs = scene.vertices, shading_faces(scene), mesh.vertices, mesh.faces, mesh.normals
    rest = scene.lights, scene.ambient, config, caster, wp.__version__, _source()
    large = wp.get_device(device).is_cpu and len(mesh.faces) >= _KEPT_FACES_MIN
    found = cached_arrays((*inputs, *rest), compute) if large else compute()
    per_corner = found["light"].take(found["group"], axis=0)
    return np.ascontiguousarray(np.moveaxis(per_corner, 1, 0)).reshape(2, -1, 3, 3)


def _build_occluders(scene: Scene, device: str, *, embree: bool) -> wp.Mesh | EmbreeTree:
    """Return the tree of the triangles that cast shadows."""
    if embree:
        return EmbreeTree(scene.vertices, shading_faces(scene))
    # on CUDA: built there in 0.01 s, not here in 0.12 s
    return make_mesh(scene.vertices, shading_faces(scene), device, constructor=None)


@functools.cache
def _source() -> bytes:
    return Path(__file__).read_bytes() + Path(inspect.getfile(RefinedMesh)).read_bytes()


def upload_lights(data: SceneData, scene: Scene, config: LightingConfig, device: str) -> None:
    """Write the lamps of a scene and its ambient light."""
    positions = np.array([light.position_m for light in scene.lights], np.float32).reshape(-1, 3)
    intensities = np.array([light.intensity for light in scene.lights], np.float32).reshape(-1, 3)
    data.light_position = wp.array(positions, dtype=wp.vec3, device=device)
    data.light_intensity = wp.array(intensities, dtype=wp.vec3, device=device)
    data.light_radius_m = config.light_radius_m
    data.ambient_up = wp.vec3(*scene.ambient.up)
    data.ambient_down = wp.vec3(*scene.ambient.down)


def _light_groups(
    scene: Scene, mesh: RefinedMesh, config: LightingConfig, occluders: wp.Mesh | EmbreeTree, device: str
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return light, shape [G, 2, 3], and openness, [G, 2], of each group of corners on both sides."""
    group, example = mesh.corner_groups
    order = np.argsort(group, kind="stable").astype(np.int32)
    starts = np.concatenate([[0], np.cumsum(np.bincount(group))]).astype(np.int32)
    light = wp.empty(2 * len(example), dtype=wp.vec3, device=device)
    openness = wp.empty(2 * len(example), dtype=float, device=device)
    data = SceneData()
    if isinstance(occluders, EmbreeTree):
        data.embree_scene = wp.uint64(occluders.scene)
        data.embree_intersect = wp.uint64(occluders.intersect_one)
    else:
        data.mesh = occluders.id
    upload_lights(data, scene, config, device)
    launch_split(
        _bake,
        dim=2 * len(example),
        inputs=[
            data,
            config.ambient_radius_m,
            config.interreflection,
            wp.array(_hemisphere(config.ambient_ray_count), dtype=wp.vec3, device=device),
            wp.array(_sphere(config.shadow_ray_count), dtype=wp.vec3, device=device),
            wp.array(mesh.vertices, dtype=wp.vec3, device=device),
            wp.array(mesh.faces, dtype=wp.vec3i, device=device),
            wp.array(mesh.corner_normals.reshape(-1, 3)[example], dtype=wp.vec3, device=device),
            wp.array(starts, dtype=int, device=device),
            wp.array(order, dtype=int, device=device),
        ],
        outputs=[light, openness],
        device=device,
    )
    return light.numpy().reshape(-1, 2, 3), openness.numpy().reshape(-1, 2)
