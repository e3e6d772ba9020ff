# mypy: disable-error-code="index,misc,operator,arg-type,return-value,empty-body"
# ruff: noqa: SIM102  (nested wp.static branches have a meaning in kernels)
"""The light that a pixel receives from what its ray hits, ray by ray; `raycast_packets.py` shades packets."""

# No `from __future__ import annotations`: Warp needs the annotations of functions in closures as objects.

from functools import cache

import warp as wp

from neurosim_core.native_code import read_native
from neurosim_core.render.kernel_data import BodyData, Hit, RenderTerms, SceneData
from neurosim_core.render.lighting import ambient_light, point_light, reflect_light
from neurosim_core.scene.materials import sample_finest, sample_nearest, sample_texture

APART = wp.constant(0.42)
"""How far from the middle of a long footprint the two lookups are whose mean is taken, of its length."""
_COSINE_MIN = wp.constant(0.05)
_OFFSET_M = wp.constant(1.0e-3)


@wp.func_native(read_native(__file__, "log_of", BINARY=True))
def _binary_log(x: float) -> float: ...


@cache
def pixel_shader(terms: RenderTerms) -> wp.Function:
    """Return the function that says what light a pixel receives along a ray.

    Its parameters: the scene and its bodies; the instant; the body that the ray hits, -1: none; orientation
    of the camera; the ray, in W, and its origin; its spread [rad]; what it hits.
    """
    shade = surface_shader(terms)
    shade_body = _body_shader(terms) if terms.bodies else None

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
        if wp.static(terms.bodies):
            if body >= 0:
                return shade_body(scene, bodies, instant, body, q_WC, ray, origin, spread_rad, hit)
        return shade(scene, ray, origin, spread_rad, hit, wp.vec2(0.0))

    return radiance_of


@cache
def surface_shader(terms: RenderTerms, *, beyond: bool = False) -> wp.Function:
    """Return the function that says what light comes from what stands still, or from the sky.

    With `beyond` a hit may lie beyond the edges of its face: the texture goes on there, the light does not.
    The texture is looked up twice, by the `slope` of the weights along the footprint [1/rad].
    """
    if terms.baked and not (beyond or terms.finest_level):
        return _baked_shader(textured=terms.textured, emissive=terms.emissive)
    surface_albedo, emitted = albedo_reader(terms, beyond=beyond), _emission(terms)

    @wp.func
    def shade(
        scene: SceneData, ray: wp.vec3, origin: wp.vec3, spread_rad: float, hit: Hit, slope: wp.vec2
    ) -> wp.vec3:
        if hit.face < 0:
            return scene.sky
        corner = 3 * hit.face
        u = hit.u
        v = hit.v
        if wp.static(beyond):
            u = wp.clamp(u, 0.0, 1.0)
            v = wp.clamp(v, 0.0, 1.0 - u)
        w = 1.0 - u - v
        facing = wp.dot(ray, hit.normal)
        albedo = surface_albedo(scene, spread_rad, facing, hit, slope)
        if wp.static(terms.baked):
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

    return shade


@cache
def _baked_shader(*, textured: bool, emissive: bool) -> wp.Function:
    """Return the function for baked light and filtered textures: the program of packets, for one ray."""
    terms = {"TEXTURED": textured, "EMISSIVE": emissive}
    code = read_native(__file__, "shade_hit", **terms, UNIT=True, LIGHT_WITHIN=False, APART=0)

    @wp.func_native(code)
    def shade_hit(scene: SceneData, direction: wp.vec3, hit: Hit, spread_rad: float) -> wp.vec3: ...

    @wp.func
    def shade(
        scene: SceneData, ray: wp.vec3, origin: wp.vec3, spread_rad: float, hit: Hit, slope: wp.vec2
    ) -> wp.vec3:
        if hit.face < 0:
            return scene.sky
        return shade_hit(scene, ray, hit, spread_rad)

    return shade


@cache
def _body_shader(terms: RenderTerms) -> wp.Function:
    """Return the function that finds the light of a body for each pixel.

    It is ambient light, and that of the lamps that no part of the scene hides (all lamps, where the scene
    itself is unshadowed). Bodies move under lights that stand still, so nothing is baked.
    """
    surface_albedo, emitted = albedo_reader(terms), _emission(terms)

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
            if wp.static(terms.baked):
                if wp.max(part) > 0.0:
                    start = point + _OFFSET_M * outwards
                    to_lamp = position - start
                    distance = wp.length(to_lamp)
                    if wp.mesh_query_ray_anyhit(bodies.shading, start, to_lamp / distance, distance):
                        part = wp.vec3(0.0)
            light += part
        return reflect_light(
            surface_albedo(scene, spread_rad, facing, hit, wp.vec2(0.0)), light, emitted(scene, hit)
        )

    return shade_body


@cache
def albedo_reader(terms: RenderTerms, *, beyond: bool = False) -> wp.Function:
    """Return the function that reads the base colour and the texture of what is hit.

    The texture level comes from the footprint of the ray: ray spread times distance over |cos|, its long
    side on the surface. The filter is isotropic: a surface seen at a grazing angle is blurred across as much
    as along. The short side or the geometric mean would keep more detail there, but alias along the surface,
    and aliasing makes events that no sensor sees. |cos| counts as at least 0.05. The middle of the surface in
    a pixel (`beyond`) has room for two lookups along the footprint, which blur less: as far apart as the
    surface recedes, and close together where the texture is coarser than the pixel.
    """

    @wp.func
    def surface_albedo(
        scene: SceneData, spread_rad: float, facing: float, hit: Hit, slope: wp.vec2
    ) -> wp.vec3:
        material = scene.face_material[hit.face]
        albedo = scene.base_color[material]
        if wp.static(terms.textured):
            texture = scene.material_texture[material]
            if texture[1] > 0:
                corner = 3 * hit.face
                uv = (
                    hit.u * scene.corner_uv[corner]
                    + hit.v * scene.corner_uv[corner + 1]
                    + (1.0 - hit.u - hit.v) * scene.corner_uv[corner + 2]
                )
                if wp.static(terms.nearest_texel):
                    albedo = wp.cw_mul(albedo, sample_nearest(scene.texels, scene.levels, texture, uv))
                elif wp.static(terms.finest_level):
                    albedo = wp.cw_mul(albedo, sample_finest(scene.texels, scene.levels, texture, uv))
                else:
                    footprint_m = spread_rad * hit.t / wp.max(wp.abs(facing), _COSINE_MIN)
                    lod = _binary_log(footprint_m) + scene.face_lod[hit.face] + scene.mip_bias
                    if wp.static(beyond):
                        apart = APART * spread_rad * wp.clamp(lod + 1.0, 0.0, 1.0)
                        away = apart * slope[0] * (scene.corner_uv[corner] - scene.corner_uv[corner + 2])
                        away += apart * slope[1] * (scene.corner_uv[corner + 1] - scene.corner_uv[corner + 2])
                        color = sample_texture(scene.texels, scene.levels, texture, uv + away, lod)
                        color += sample_texture(scene.texels, scene.levels, texture, uv - away, lod)
                        albedo = wp.cw_mul(albedo, 0.5 * color)
                    else:
                        color = sample_texture(scene.texels, scene.levels, texture, uv, lod)
                        albedo = wp.cw_mul(albedo, color)
        return albedo

    return surface_albedo


@cache
def _emission(terms: RenderTerms) -> wp.Function:
    @wp.func
    def emitted(scene: SceneData, hit: Hit) -> wp.vec3:
        emission = wp.vec3(0.0)
        if wp.static(terms.emissive):
            emission = scene.emission[scene.face_material[hit.face]]
        return emission

    return emitted
