# mypy: disable-error-code="no-untyped-call,no-untyped-def,empty-body,untyped-decorator,valid-type"
"""Shading of a packet of rays on a CPU, in loops over its lanes that become vector instructions.

The same arithmetic in the same order as `raycast.shade` for baked light and mip-mapped textures, so the same
bytes. Ray by ray, shading took three times as long as Embree takes to find what the rays hit. Here lanes are
gathered into arrays, one for each quantity, and each loop does one thing for all lanes without a branch, but
for those that load from tables, and for the logarithm of the footprint, which is the library's.
"""

# No `from __future__ import annotations`: Warp needs the annotations of kernels in closures as objects.

from functools import cache
from typing import Any

import warp as wp

_HITS = """
    constexpr int N = LANES;
    constexpr float COSINE_MIN = 0.05f;
    alignas(64) float facing[N], red[N], green[N], blue[N], u[N], v[N], w[N];
    alignas(64) float light[3][3][N];
    alignas(64) int face[N];
    for (int lane = 0; lane < N; ++lane) {
        const wp::vec3 front = FRONT;
        facing[lane] = wp::dot(rays.data[lane], front);
        face[lane] = faces.data[lane] < 0 ? 0 : faces.data[lane];  // of a miss, any: the sky takes its place
        u[lane] = us.data[lane];
        v[lane] = vs.data[lane];
        w[lane] = 1.0f - u[lane] - v[lane];
    }
    alignas(64) int material[N];
    for (int lane = 0; lane < N; ++lane) {
        material[lane] = face_material.data[face[lane]];
        const wp::vec3& base = base_color.data[material[lane]];
        red[lane] = base[0];
        green[lane] = base[1];
        blue[lane] = base[2];
        const wp::vec3* corner = corner_light.data + (size_t)(facing[lane] > 0.0f ? corner_light.shape[1] : 0)
            + 3 * (size_t)face[lane];
        for (int tip = 0; tip < 3; ++tip)
            for (int channel = 0; channel < 3; ++channel) light[channel][tip][lane] = corner[tip][channel];
    }
"""

_TEXTURE = """
    alignas(64) float x[N], y[N], blend[N], lod[N];
    alignas(64) int first[N], finer[N];
    alignas(64) float uv[2][3][N];
    alignas(64) float face_lods[N];
    alignas(64) int level_count[N];
    for (int lane = 0; lane < N; ++lane) {
        const wp::vec2i& texture = material_texture.data[material[lane]];
        first[lane] = texture[0];
        level_count[lane] = texture[1];
        face_lods[lane] = face_lod.data[face[lane]];
        const wp::vec2* corner = corner_uv.data + 3 * (size_t)face[lane];
        for (int tip = 0; tip < 3; ++tip)
            for (int axis = 0; axis < 2; ++axis) uv[axis][tip][lane] = corner[tip][axis];
    }
    for (int lane = 0; lane < N; ++lane)
        lod[lane] = spreads.data[lane] * ts.data[lane] / wp::max(wp::abs(facing[lane]), COSINE_MIN);
    for (int lane = 0; lane < N; ++lane) lod[lane] = wp::log2(lod[lane]);
    for (int lane = 0; lane < N; ++lane) {
        const float wanted = lod[lane] + face_lods[lane] + mip_bias;
        x[lane] = u[lane] * uv[0][0][lane] + v[lane] * uv[0][1][lane] + w[lane] * uv[0][2][lane];
        y[lane] = u[lane] * uv[1][0][lane] + v[lane] * uv[1][1][lane] + w[lane] * uv[1][2][lane];
        x[lane] = x[lane] - wp::floor(x[lane]);
        y[lane] = 1.0f - (y[lane] - wp::floor(y[lane]));
        const float clamped = wp::clamp(wanted, 0.0f, (float)(level_count[lane] - 1));
        finer[lane] = (int)(clamped);
        blend[lane] = clamped - (float)(finer[lane]);
    }
    int mixed = 0;
    for (int lane = 0; lane < N; ++lane) {
        const bool textured = level_count[lane] > 0 && faces.data[lane] >= 0;
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
            const wp::vec3i& level = levels.data[index];
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
            for (int lane = 0; lane < N; ++lane) code[corner][lane] = texels.data[place[corner][lane]];
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
            emitted[channel][lane] = EMISSIVE ? emission.data[EMISSIVE ? material[lane] : 0][channel] : 0.0f;
    for (int channel = 0; channel < 3; ++channel) {
        const float* albedo = channel == 0 ? red : channel == 1 ? green : blue;
        for (int lane = 0; lane < N; ++lane) {
            const float lit = u[lane] * light[channel][0][lane] + v[lane] * light[channel][1][lane]
                + w[lane] * light[channel][2][lane];
            radiance[channel][lane] = albedo[lane] * lit + emitted[channel][lane];
        }
    }
    for (int lane = 0; lane < N; ++lane)
        for (int channel = 0; channel < 3; ++channel)
            total.data[lane][channel] += faces.data[lane] < 0 ? sky[channel] : radiance[channel][lane];
"""


@cache
def packet_shader(lanes: int, *, textured: bool, emissive: bool, unit_normals: bool) -> Any:
    """Return the Warp function, for CPU kernels only, that adds the radiance of a packet's hits to a total.

    Its parameters are the arrays of `raycast.SceneData` and its sky and mip bias; then of each lane: ray, of
    unit length; spread [rad]; face, -1: nothing was hit; distance [m]; u and v, the weights of the first and
    the second corner; the normal of the front. The last is the radiance of each lane so far, to add to.

    Args:
        lanes: Rays of a packet.
        textured: Some material has a texture; it is filtered trilinearly.
        emissive: Some material emits light.
        unit_normals: Normals are of unit length already.
    """
    snippet = "\n".join([_HITS, _TEXTURE if textured else "", _LIGHT])
    names = {
        "LANES": str(lanes),
        "FRONT": "normals.data[lane]" if unit_normals else "wp::normalize(normals.data[lane])",
        "EMISSIVE": "true" if emissive else "false",
        "SCALE_RG": "(float)(1.0 / 2047)",
        "SCALE_B": "(float)(1.0 / 1023)",
    }
    for name, value in names.items():
        snippet = snippet.replace(name, value)

    def shade_packet(
        face_material: wp.array[int],
        face_lod: wp.array[float],
        corner_uv: wp.array[wp.vec2],
        corner_light: wp.array2d[wp.vec3],
        base_color: wp.array[wp.vec3],
        emission: wp.array[wp.vec3],
        material_texture: wp.array[wp.vec2i],
        levels: wp.array[wp.vec3i],
        texels: wp.array[wp.uint32],
        sky: wp.vec3,
        mip_bias: float,
        rays: wp.array[wp.vec3],
        spreads: wp.array[float],
        faces: wp.array[int],
        ts: wp.array[float],
        us: wp.array[float],
        vs: wp.array[float],
        normals: wp.array[wp.vec3],
        total: wp.array[wp.vec3],
    ): ...

    if textured:  # by its name the code of a kernel tells whether it samples textures
        shade_packet.__name__ = shade_packet.__qualname__ = "shade_textured_packet"
    return wp.func_native(snippet)(shade_packet)
