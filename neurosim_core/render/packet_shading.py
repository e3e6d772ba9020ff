# mypy: disable-error-code="no-untyped-call,no-untyped-def,empty-body,untyped-decorator,valid-type"
"""Shading of a packet of rays on a CPU, in loops over its lanes that become vector instructions.

The same arithmetic in the same order as `shading.py` for baked light and mip-mapped textures, so the same
bytes. Ray by ray, shading took three times as long as Embree takes to find what the rays hit. Here lanes are
gathered into arrays, one for each quantity, and each loop does one thing for all lanes without a branch, but
for those that load from tables, and for the logarithm of the footprint, which is the library's. Where all
lanes see one triangle, its tables are read once.
"""

# No `from __future__ import annotations`: Warp needs the annotations of kernels in closures as objects.

from functools import cache
from typing import Any

import warp as wp

from neurosim_core.render.embree import INTERSECT
from neurosim_core.render.scene_data import SceneData

_GATHER = """
    alignas(64) float ray[3][N], normal[3][N], spread[N], ts[N], us[N], vs[N];
    alignas(64) int faces[N];
    for (int lane = 0; lane < N; ++lane) {
        faces[lane] = hit_face.data[lane];
        ts[lane] = hit_t.data[lane];
        us[lane] = hit_u.data[lane];
        vs[lane] = hit_v.data[lane];
        spread[lane] = spreads.data[lane];
        for (int axis = 0; axis < 3; ++axis) {
            ray[axis][lane] = rays.data[lane][axis];
            normal[axis][lane] = normals.data[lane][axis];
        }
    }
"""

_AIM = """
    alignas(64) float ray[3][N], spread[N];
    const wp::vec4* aimed = wp::address(rays, layer, first_pixel);
    if (columns == SIDE && rows == SIDE)
        for (int lane = 0; lane < N; ++lane) {
            const wp::vec4& pixel = aimed[(lane / SIDE) * width + lane % SIDE];
            for (int axis = 0; axis < 3; ++axis) ray[axis][lane] = pixel[axis];
            spread[lane] = pixel[3];
        }
    else
        for (int lane = 0; lane < N; ++lane) {
            const bool inside = lane % SIDE < columns && lane / SIDE < rows;
            const wp::vec4& pixel = aimed[inside ? (lane / SIDE) * width + lane % SIDE : 0];
            for (int axis = 0; axis < 3; ++axis) ray[axis][lane] = inside ? pixel[axis] : 0.0f;
            spread[lane] = inside ? pixel[3] : 0.0f;
        }
    for (int lane = 0; lane < N; ++lane) {
        const wp::vec3 turned = wp::quat_rotate(q_WC, wp::vec3(ray[0][lane], ray[1][lane], ray[2][lane]));
        for (int axis = 0; axis < 3; ++axis) ray[axis][lane] = turned[axis];
    }
"""

_HITS = """
    constexpr float COSINE_MIN = 0.05f;
    alignas(64) float facing[N], red[N], green[N], blue[N], w[N];
    alignas(64) float light[3][3][N];
    alignas(64) int face[N], material[N];
    for (int lane = 0; lane < N; ++lane) {
        const float x = normal[0][lane], y = normal[1][lane], z = normal[2][lane];
        const float square = x * x + y * y + z * z;
#ifdef __CUDA_ARCH__
        const float root = sqrtf(square);
#else
        const float root = __builtin_elementwise_sqrt(square);  // a vector instruction without a branch
#endif
        const float length = UNIT ? 1.0f : root;
        const float cosine
            = ray[0][lane] * (x / length) + ray[1][lane] * (y / length) + ray[2][lane] * (z / length);
        facing[lane] = length > 0.0f ? cosine : 0.0f;
        face[lane] = faces[lane] < 0 ? 0 : faces[lane];  // of a miss, any: the sky takes its place
        w[lane] = 1.0f - us[lane] - vs[lane];
    }
    int others = 0;
    for (int lane = 0; lane < N; ++lane)
        others |= (face[lane] ^ face[0]) | ((facing[lane] > 0.0f) ^ (facing[0] > 0.0f));
    const int different = others ? N : 1;  // lanes that are loaded for
    auto repeat = [](auto& values) {
        for (int lane = 1; lane < N; ++lane) values[lane] = values[0];
    };
    for (int lane = 0; lane < different; ++lane) {
        material[lane] = scene.face_material.data[face[lane]];
        const wp::vec3& base = scene.base_color.data[material[lane]];
        red[lane] = base[0];
        green[lane] = base[1];
        blue[lane] = base[2];
        const wp::vec3* corner = scene.corner_light.data
            + (size_t)(facing[lane] > 0.0f ? scene.corner_light.shape[1] : 0) + 3 * (size_t)face[lane];
        for (int tip = 0; tip < 3; ++tip)
            for (int channel = 0; channel < 3; ++channel) light[channel][tip][lane] = corner[tip][channel];
    }
    if (different == 1) {
        repeat(material);
        repeat(red);
        repeat(green);
        repeat(blue);
        for (int tip = 0; tip < 3; ++tip)
            for (int channel = 0; channel < 3; ++channel) repeat(light[channel][tip]);
    }
"""

_TEXTURE = """
    alignas(64) float x[N], y[N], blend[N], lod[N];
    alignas(64) int first[N], finer[N];
    alignas(64) float uv[2][3][N];
    alignas(64) float face_lods[N];
    alignas(64) int level_count[N];
    for (int lane = 0; lane < different; ++lane) {
        const wp::vec2i& texture = scene.material_texture.data[material[lane]];
        first[lane] = texture[0];
        level_count[lane] = texture[1];
        face_lods[lane] = scene.face_lod.data[face[lane]];
        const wp::vec2* corner = scene.corner_uv.data + 3 * (size_t)face[lane];
        for (int tip = 0; tip < 3; ++tip)
            for (int axis = 0; axis < 2; ++axis) uv[axis][tip][lane] = corner[tip][axis];
    }
    if (different == 1) {
        repeat(first);
        repeat(level_count);
        repeat(face_lods);
        for (int tip = 0; tip < 3; ++tip)
            for (int axis = 0; axis < 2; ++axis) repeat(uv[axis][tip]);
    }
    for (int lane = 0; lane < N; ++lane)
        lod[lane] = spread[lane] * ts[lane] / wp::max(wp::abs(facing[lane]), COSINE_MIN);
    for (int lane = 0; lane < N; ++lane) lod[lane] = wp::log2(lod[lane]);
    for (int lane = 0; lane < N; ++lane) {
        const float wanted = lod[lane] + face_lods[lane] + scene.mip_bias;
        x[lane] = us[lane] * uv[0][0][lane] + vs[lane] * uv[0][1][lane] + w[lane] * uv[0][2][lane];
        y[lane] = us[lane] * uv[1][0][lane] + vs[lane] * uv[1][1][lane] + w[lane] * uv[1][2][lane];
        x[lane] = x[lane] - wp::floor(x[lane]);
        y[lane] = 1.0f - (y[lane] - wp::floor(y[lane]));
        const float clamped = wp::clamp(wanted, 0.0f, (float)(level_count[lane] - 1));
        finer[lane] = (int)(clamped);
        blend[lane] = clamped - (float)(finer[lane]);
    }
    int mixed = 0;
    for (int lane = 0; lane < N; ++lane) {
        const bool textured = level_count[lane] > 0 && faces[lane] >= 0;
        if (!textured) first[lane] = finer[lane] = 0;  // read something, and use nothing of it
        if (!textured) blend[lane] = x[lane] = y[lane] = 0.0f;
        level_count[lane] = textured;
        mixed |= blend[lane] > 0.0f;
    }
    alignas(64) float color[2][3][N];
    for (int coarser = 0; coarser <= mixed; ++coarser) {
        alignas(64) float blend_x[N], blend_y[N];
        alignas(64) int origin[N], width[N], height[N], place[4][N];
        alignas(64) uint32_t code[4][N];
        for (int lane = 0; lane < N; ++lane) {
            const int index = first[lane] + finer[lane] + (blend[lane] > 0.0f ? coarser : 0);
            const wp::vec3i& level = scene.levels.data[index];
            origin[lane] = level[0];
            width[lane] = level[1];
            height[lane] = level[2];
        }
        for (int lane = 0; lane < N; ++lane) {
            const float column = x[lane] * (float)(width[lane]) - 0.5f;
            const float row = y[lane] * (float)(height[lane]) - 0.5f;
            const float column_floor = wp::floor(column);
            const float row_floor = wp::floor(row);
            blend_x[lane] = column - column_floor;
            blend_y[lane] = row - row_floor;
            int left = (int)(column_floor);
            int top = (int)(row_floor);
            const int right = left + 1 < width[lane] ? left + 1 : 0;
            const int bottom = top + 1 < height[lane] ? top + 1 : 0;
            left = left < 0 ? width[lane] - 1 : left;
            top = top < 0 ? height[lane] - 1 : top;
            const int upper = origin[lane] + top * width[lane];
            const int lower = origin[lane] + bottom * width[lane];
            place[0][lane] = upper + left;
            place[1][lane] = upper + right;
            place[2][lane] = lower + left;
            place[3][lane] = lower + right;
        }
        for (int corner = 0; corner < 4; ++corner)
            for (int lane = 0; lane < N; ++lane) code[corner][lane] = scene.texels.data[place[corner][lane]];
        for (int lane = 0; lane < N; ++lane) {
            for (int channel = 0; channel < 3; ++channel) {
                float texel[4];
                for (int corner = 0; corner < 4; ++corner) {
                    const uint32_t bits = channel == 2 ? code[corner][lane] >> 22
                                                       : (code[corner][lane] >> (11 * channel)) & 2047u;
                    const float root = (float)((int)(bits)) * (channel == 2 ? SCALE_B : SCALE_RG);
                    texel[corner] = root * root;
                }
                const float above = texel[0] * (1.0f - blend_x[lane]) + texel[1] * blend_x[lane];
                const float below = texel[2] * (1.0f - blend_x[lane]) + texel[3] * blend_x[lane];
                color[coarser][channel][lane] = above * (1.0f - blend_y[lane]) + below * blend_y[lane];
            }
        }
    }
    if (mixed)
        for (int channel = 0; channel < 3; ++channel)
            for (int lane = 0; lane < N; ++lane)
                color[0][channel][lane] = blend[lane] > 0.0f
                    ? color[0][channel][lane] * (1.0f - blend[lane]) + color[1][channel][lane] * blend[lane]
                    : color[0][channel][lane];
    for (int lane = 0; lane < N; ++lane) {
        red[lane] = level_count[lane] ? red[lane] * color[0][0][lane] : red[lane];
        green[lane] = level_count[lane] ? green[lane] * color[0][1][lane] : green[lane];
        blue[lane] = level_count[lane] ? blue[lane] * color[0][2][lane] : blue[lane];
    }
"""

_LIGHT = """
    alignas(64) float radiance[3][N], emitted[3][N];
    for (int channel = 0; channel < 3; ++channel)
        for (int lane = 0; lane < N; ++lane)
            emitted[channel][lane]
                = EMISSIVE ? scene.emission.data[EMISSIVE ? material[lane] : 0][channel] : 0.0f;
    for (int channel = 0; channel < 3; ++channel) {
        const float* albedo = channel == 0 ? red : channel == 1 ? green : blue;
        for (int lane = 0; lane < N; ++lane) {
            const float lit = us[lane] * light[channel][0][lane] + vs[lane] * light[channel][1][lane]
                + w[lane] * light[channel][2][lane];
            const float lit_and_own = albedo[lane] * lit + emitted[channel][lane];
            radiance[channel][lane] = faces[lane] < 0 ? scene.sky[channel] : lit_and_own;
        }
    }
"""

_ADD = """
    for (int lane = 0; lane < N; ++lane)
        for (int channel = 0; channel < 3; ++channel) total.data[lane][channel] += radiance[channel][lane];
"""

_SEE = """
    alignas(64) float total[3][N] = {};
    const int layers = rays.shape[0];
    for (int layer = layers > 1; layer < layers; ++layer) {
        BODY
        for (int channel = 0; channel < 3; ++channel)
            for (int lane = 0; lane < N; ++lane) total[channel][lane] += radiance[channel][lane];
    }
    alignas(64) float luma[N];
    const float share = layers > 1 ? 1.0f / (float)(layers - 1) : 1.0f;
    for (int lane = 0; lane < N; ++lane) {
        luma[lane] = 0.2126f * (share * total[0][lane]) + 0.7152f * (share * total[1][lane])
            + 0.0722f * (share * total[2][lane]);
        luma[lane] = luma[lane] + scene.dark_floor;
    }
    for (int y = 0; y < rows; ++y) {
        float* out = wp::address(log_radiance_out, instant, top + y, left);
        for (int x = 0; x < columns; ++x) out[x] = wp::log(luma[SIDE * y + x]);
    }
"""


def _shading(*, textured: bool, emissive: bool, unit_normals: bool) -> str:
    """Return C++ that shades what `_GATHER`, or `_AIM` and a cast, have left of each lane."""
    snippet = "".join([_HITS, _TEXTURE if textured else "", _LIGHT])
    names = {
        "UNIT": "true" if unit_normals else "false",
        "EMISSIVE": "true" if emissive else "false",
        "SCALE_RG": "(float)(1.0 / 2047)",
        "SCALE_B": "(float)(1.0 / 1023)",
    }
    for name, value in names.items():
        snippet = snippet.replace(name, value)
    return snippet


@cache
def packet_shader(lanes: int, *, textured: bool, emissive: bool, unit_normals: bool) -> Any:
    """Return the Warp function, for CPU kernels only, that adds the radiance of a packet's hits to a total.

    Its parameters are the scene; then of each lane: ray, of unit length; spread [rad]; face, -1: nothing was
    hit; distance [m]; u and v, the weights of the first and the second corner; the normal of the front. The
    last is the radiance of each lane so far, to add to.

    Args:
        lanes: Rays of a packet.
        textured: Some material has a texture; it is filtered trilinearly.
        emissive: Some material emits light.
        unit_normals: Normals are of unit length already.
    """
    shading = _shading(textured=textured, emissive=emissive, unit_normals=unit_normals)

    def shade_packet(
        scene: SceneData,
        rays: wp.array[wp.vec3],
        spreads: wp.array[float],
        hit_face: wp.array[int],
        hit_t: wp.array[float],
        hit_u: wp.array[float],
        hit_v: wp.array[float],
        normals: wp.array[wp.vec3],
        total: wp.array[wp.vec3],
    ): ...

    if textured:  # by its name the code of a kernel tells whether it samples textures
        shade_packet.__name__ = shade_packet.__qualname__ = "shade_textured_packet"
    return wp.func_native(f"constexpr int N = {lanes};" + _GATHER + shading + _ADD)(shade_packet)


@cache
def packet_eye(width: int, *, textured: bool, emissive: bool) -> Any:
    """Return the Warp function, for CPU kernels only, that casts and shades 4 x 4 pixels, and takes the log.

    The same bits as casting by `packet_caster`, shading by `packet_shader` and writing each pixel; but what
    the rays hit is passed on in arrays by quantity, which are neither cleared nor transposed on the way. Of
    several layers of rays the first is left out, and the mean of the others taken.

    Its parameters: the scene; rays of pixels, as `ViewData` has them, contiguous; the first of the
    packet, and the columns of the picture; position and orientation of the camera; the distance beyond which
    hits do not count [m]; instant, top row and left column of the packet; its rows and columns, at most 4.
    The last is the log radiance, of which these pixels are written.

    Args:
        width: `embree.packet_width()`.
        textured: Some material has a texture; it is filtered trilinearly.
        emissive: Some material emits light.
    """
    intersect = (
        INTERSECT.replace("WIDTH", str(width))
        .replace("EMBREE_INTERSECT", "scene.embree_intersect")
        .replace("EMBREE_SCENE", "scene.embree_scene")
    )
    shading = _shading(textured=textured, emissive=emissive, unit_normals=False)

    def see_packet(
        scene: SceneData,
        rays: wp.array2d[wp.vec4],
        first_pixel: int,
        width: int,
        origin: wp.vec3,
        q_WC: wp.quat,
        far_m: float,
        instant: int,
        top: int,
        left: int,
        rows: int,
        columns: int,
        log_radiance_out: wp.array3d[float],
    ): ...

    if textured:
        see_packet.__name__ = see_packet.__qualname__ = "see_textured_packet"
    code = "constexpr int N = 16, SIDE = 4;" + _SEE.replace("BODY", _AIM + intersect + shading)
    return wp.func_native(code)(see_packet)
