// Radiance of N lanes: from `ray`, `spread`, `faces`, `ts`, `us`, `vs` and `normal` to `radiance`. Textures are
// looked up twice, as `shading.py` says: `slope` [2][N] is the change of us and vs along the footprint [1/rad], 0: once.
#include "logarithm.cuh"
constexpr float COSINE_MIN = 0.05f;
constexpr float TEXEL_UNIT[3] = {1.0f / (2047 * 2047), 1.0f / (2047 * 2047), 1.0f / (1023 * 1023)}; // as in `materials.py`
alignas(64) float facing[N], red[N], green[N], blue[N], w[N];
alignas(64) float lit[4][N], emitted[3][N];
alignas(64) int face[N], material[N];
for (int lane = 0; lane < N; ++lane) {
    const float x = normal[0][lane], y = normal[1][lane], z = normal[2][lane];
    const float square = x * x + y * y + z * z;
#ifdef __CUDA_ARCH__
    const float root = sqrtf(square);
#else
    const float root = __builtin_elementwise_sqrt(square); // a vector instruction without a branch
#endif
    const float length = UNIT ? 1.0f : root;
    const float cosine =
        ray[0][lane] * (x / length) + ray[1][lane] * (y / length) + ray[2][lane] * (z / length);
    facing[lane] = length > 0.0f ? cosine : 0.0f;
    face[lane] = faces[lane] < 0 ? 0 : faces[lane]; // of a miss, any: the sky takes its place
    w[lane] = 1.0f - us[lane] - vs[lane];
}
int others = 0;
for (int lane = 0; lane < N; ++lane)
    others |= (face[lane] ^ face[0]) | ((facing[lane] > 0.0f) ^ (facing[0] > 0.0f));
const int different = others ? N : 1; // lanes that are loaded for
auto repeat = [](auto& values) {
    for (int lane = 1; lane < N; ++lane) values[lane] = values[0];
};
for (int lane = 0; lane < different; ++lane) {
    material[lane] = scene.face_material.data[face[lane]];
    const wp::vec3& base = scene.base_color.data[material[lane]];
    red[lane] = base[0];
    green[lane] = base[1];
    blue[lane] = base[2];
    for (int channel = 0; channel < 3; ++channel)
        emitted[channel][lane] = EMISSIVE ? scene.emission.data[material[lane]][channel] : 0.0f;
}
auto light_of = [&](int lane) { // of the corners of the face, by channel
    return (const float*)(scene.corner_light.data + (size_t)(facing[lane] > 0.0f ? scene.corner_light.shape[1] : 0)
                          + 3 * (size_t)face[lane]);
};
if (different == 1) {
    repeat(material);
    repeat(red);
    repeat(green);
    repeat(blue);
    for (int channel = 0; channel < 3; ++channel) repeat(emitted[channel]);
}
alignas(64) int first[N], level_count[N];
int sampled = 0; // whether any lane has a texture
if constexpr (TEXTURED) {
    for (int lane = 0; lane < different; ++lane) {
        const wp::vec2i& texture = scene.material_texture.data[material[lane]];
        first[lane] = texture[0];
        level_count[lane] = texture[1];
        sampled |= texture[1];
    }
}
if (sampled) {
    alignas(64) float x[N], y[N], blend[N], lod[N];
    alignas(64) int finer[N];
    alignas(64) float uv[2][3][N], away[2][N];
    alignas(64) float face_lods[N];
    for (int lane = 0; lane < different; ++lane) {
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
    for (int lane = 0; lane < N; ++lane) lod[lane] = binary_logarithm(lod[lane]);
    for (int lane = 0; lane < N; ++lane) {
        const float wanted = lod[lane] + face_lods[lane] + scene.mip_bias;
        x[lane] = us[lane] * uv[0][0][lane] + vs[lane] * uv[0][1][lane] + w[lane] * uv[0][2][lane];
        y[lane] = us[lane] * uv[1][0][lane] + vs[lane] * uv[1][1][lane] + w[lane] * uv[1][2][lane];
        const float clamped = wp::clamp(wanted, 0.0f, (float)(level_count[lane] - 1));
        finer[lane] = (int)(clamped);
        blend[lane] = clamped - (float)(finer[lane]);
        const float apart = 0.01f * APART * spread[lane] * wp::clamp(wanted + 1.0f, 0.0f, 1.0f);
        const float du = apart * slope[0][lane], dv = apart * slope[1][lane];
        for (int axis = 0; axis < 2; ++axis)
            away[axis][lane] = du * (uv[axis][0][lane] - uv[axis][2][lane]) + dv * (uv[axis][1][lane] - uv[axis][2][lane]);
    }
    int mixed = 0, twice = 0;
    for (int lane = 0; lane < N; ++lane) {
        const bool textured = level_count[lane] > 0 && faces[lane] >= 0;
        if (!textured) first[lane] = finer[lane] = 0; // read something, and use nothing of it
        if (!textured) blend[lane] = x[lane] = y[lane] = away[0][lane] = away[1][lane] = 0.0f;
        twice |= away[0][lane] != 0.0f || away[1][lane] != 0.0f;
        level_count[lane] = textured;
        mixed |= blend[lane] > 0.0f;
    }
    alignas(64) float color[2][3][N], mean[3][N] = {};
    constexpr int KEPT = N > 1 ? 2 : 1; // levels of packets are read once for both lookups
    alignas(64) int origins[KEPT][N], widths[KEPT][N], heights[KEPT][N];
    for (int tap = 0; tap <= twice; ++tap) {
        for (int coarser = 0; coarser <= mixed; ++coarser) {
            alignas(64) float blend_x[N], blend_y[N];
            auto &origin = origins[coarser % KEPT], &width = widths[coarser % KEPT], &height = heights[coarser % KEPT];
            alignas(64) int place[4][N];
            alignas(64) uint32_t code[4][N];
            int wraps = 0;
            if (KEPT == 1 || tap == 0)
                for (int lane = 0; lane < N; ++lane) {
                    const int index = first[lane] + finer[lane] + (blend[lane] > 0.0f ? coarser : 0);
                    const wp::vec3i& level = scene.levels.data[index];
                    origin[lane] = level[0];
                    width[lane] = level[1];
                    height[lane] = level[2];
                }
            for (int lane = 0; lane < N; ++lane) {
                const float along = tap ? x[lane] - away[0][lane] : x[lane] + away[0][lane];
                const float up = tap ? y[lane] - away[1][lane] : y[lane] + away[1][lane];
                const float u = along - wp::floor(along), v = 1.0f - (up - wp::floor(up));
                const float column = u * (float)(width[lane]) - 0.5f;
                const float row = v * (float)(height[lane]) - 0.5f;
                const float column_floor = wp::floor(column);
                const float row_floor = wp::floor(row);
                blend_x[lane] = column - column_floor;
                blend_y[lane] = row - row_floor;
                int left = (int)(column_floor);
                int top = (int)(row_floor);
                wraps |= left < 0 || left + 1 >= width[lane];
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
#ifndef __CUDA_ARCH__
            if (!wraps) // both texels of a row by one load
                for (int corner = 0; corner < 4; corner += 2) {
                    alignas(64) uint64_t both[N];
                    for (int lane = 0; lane < N; ++lane)
                        __builtin_memcpy(&both[lane], scene.texels.data + place[corner][lane], sizeof(uint64_t));
                    for (int lane = 0; lane < N; ++lane) {
                        code[corner][lane] = (uint32_t)both[lane];
                        code[corner + 1][lane] = (uint32_t)(both[lane] >> 32);
                    }
                }
            else
#endif
                for (int corner = 0; corner < 4; ++corner)
                    for (int lane = 0; lane < N; ++lane) code[corner][lane] = scene.texels.data[place[corner][lane]];
            for (int lane = 0; lane < N; ++lane) {
                for (int channel = 0; channel < 3; ++channel) {
                    float texel[4];
                    for (int corner = 0; corner < 4; ++corner) {
                        const uint32_t bits = channel == 2 ? code[corner][lane] >> 22
                                                           : (code[corner][lane] >> (11 * channel)) & 2047u;
                        const float root = (float)((int)(bits));
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
                    color[0][channel][lane] = blend[lane] > 0.0f ? color[0][channel][lane] * (1.0f - blend[lane])
                                                                       + color[1][channel][lane] * blend[lane]
                                                                 : color[0][channel][lane];
        for (int channel = 0; channel < 3; ++channel)
            for (int lane = 0; lane < N; ++lane) mean[channel][lane] += color[0][channel][lane];
    }
    const float each = twice ? 0.5f : 1.0f;
    for (int lane = 0; lane < N; ++lane) {
        red[lane] = level_count[lane] ? red[lane] * (each * (TEXEL_UNIT[0] * mean[0][lane])) : red[lane];
        green[lane] = level_count[lane] ? green[lane] * (each * (TEXEL_UNIT[1] * mean[1][lane])) : green[lane];
        blue[lane] = level_count[lane] ? blue[lane] * (each * (TEXEL_UNIT[2] * mean[2][lane])) : blue[lane];
    }
}
alignas(64) float radiance[3][N];
if constexpr (LIGHT_WITHIN) // no light is extrapolated beyond the face
    for (int lane = 0; lane < N; ++lane) {
        us[lane] = wp::clamp(us[lane], 0.0f, 1.0f);
        vs[lane] = wp::clamp(vs[lane], 0.0f, 1.0f - us[lane]);
        w[lane] = 1.0f - us[lane] - vs[lane];
    }
if (different == 1) {
    const float* const corner = light_of(0);
    for (int channel = 0; channel < 3; ++channel)
        for (int lane = 0; lane < N; ++lane)
            lit[channel][lane] = us[lane] * corner[channel] + vs[lane] * corner[3 + channel] + w[lane] * corner[6 + channel];
}
#ifndef __CUDA_ARCH__
else {
#include "transpose_quads.cuh"
    for (int begin = 0; begin < N; begin += 16) {
        auto quad_of = [&](int place) {
            const int lane = begin + place;
            const float* const corner = light_of(lane);
            Quad tip[3];
            for (int k = 0; k < 3; ++k) __builtin_memcpy(&tip[k], corner + (k < 2 ? 3 * k : 5), sizeof(Quad)); // within the corners
            return us[lane] * tip[0] + vs[lane] * tip[1] + w[lane] * tip[2].yzww;
        };
        float* const rows[4] = {lit[0] + begin, lit[1] + begin, lit[2] + begin, lit[3] + begin};
        transpose_quads(quad_of, rows);
    }
}
#endif
for (int channel = 0; channel < 3; ++channel) {
    const float* albedo = channel == 0 ? red : channel == 1 ? green : blue;
    for (int lane = 0; lane < N; ++lane) {
        const float lit_and_own = albedo[lane] * lit[channel][lane] + emitted[channel][lane];
        radiance[channel][lane] = faces[lane] < 0 ? scene.sky[channel] : lit_and_own;
    }
}
