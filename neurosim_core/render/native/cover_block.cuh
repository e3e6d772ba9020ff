// CUDA: the threads of a warp find together what the points of 4 x 4 pixels show in two instants, as `list_seen_faces.cuh` and
// `cover_lanes.cuh` do on a CPU. A thread is a pixel in an instant; with one instant, `alone`, two threads are a pixel while
// faces are looked at, half of them each, and after that the second one is idle. Leaves pairs of a thread and a surface that it
// shows in shared memory. Returns their number, -1: the instants show so many faces that they have to be taken one by one; the
// first of the thread and how many; how many of its points show none, -1: it has to be rendered by rays; whether the sky is
// behind; where the pairs are. `position` is where the camera sees the pixel from: with TIMED each pixel has its own, else they
// share one.
const int instant = at.instant, top = at.top, left = at.left, height = view.height, width = view.width;
const wp::vec3 position = rays.position, center = rays.center, across = rays.across, down = rays.down;
wp::vec_t<6, int> result;
#ifdef __CUDA_ARCH__
#include "pixel_block.cuh"
#include "sample_points.cuh"
__shared__ Block blocks[2];
Block& block = blocks[threadIdx.x / 32 % 2];
constexpr unsigned ALL = 0xffffffffu;
const int lane = threadIdx.x % 32, pixel = lane % 16, half = alone ? 0 : lane / 16;
const int members = alone ? 32 : 16, member = lane % members; // threads of an instant, which look at a face or an edge each
wp::vec3 origin = position, shift; // where faces are prepared for, and from there to the position
if constexpr (TIMED)
    for (int axis = 0; axis < 3; ++axis) {
        origin[axis] = __shfl_sync(0xffffffffu, position[axis], 16 * half);
        shift[axis] = position[axis] - origin[axis];
    }
const unsigned below = (1u << lane) - 1u, ours = alone ? ALL : 0xffffu << (16 * half); // threads before; those of the instant
const int room = alone ? MOST : MOST / 2, width_of_row = alone ? 16 : 32, base_of_faces = half * room;
int *const seen = block.seen + base_of_faces, *const part_of = block.part + base_of_faces;
unsigned char* const first_of = block.first + base_of_faces;
Quad* const plane_of = block.plane + base_of_faces;
unsigned* const own_shown = block.shown[0] + 16 * half + pixel; // of entry: at entry * width_of_row
struct Entries { // a bit for each; those of one of two instants have room in the low word
    unsigned low = 0, high = 0;
    int begin = 0; // of the low word
    void add(int entry) {
        const unsigned bit = 1u << (entry & 31);
        low |= entry < 32 ? bit : 0u;
        high |= entry < 32 ? 0u : bit;
    }
    bool has(int entry) const { return ((entry < 32 ? low : high) >> (entry & 31)) & 1u; }
    bool any() { // whether there is one to `take`
        if (low == 0u && high != 0u) {
            low = high;
            high = 0u;
            begin = 32;
        }
        return low != 0u;
    }
    int take() { // the first one
        const int entry = begin + __ffs(low) - 1;
        low &= low - 1u;
        return entry;
    }
};
#include "edge_functions.cuh"
auto along = [](const Quad& function, const wp::vec3& toward) {
    return fmaf(function.x, toward[0], fmaf(function.y, toward[1], function.z * toward[2]));
};
auto distance = [&](const Quad& plane) { return TIMED ? 1.0f - along(plane, shift) : 1.0f; }; // by that from the origin
// Bits of the points where a function, of which the value at the centre and the slopes are given, is negative.
auto negative_at = [](float value, float slope_x, float slope_y) {
    float at[SAMPLES], step[SAMPLES]; // of the samples 1, 2, 4, ... from sample 0
#pragma unroll
    for (int bit = 0; 1 << bit < SAMPLES; ++bit) step[1 << bit] = fmaf((float)(1 << bit) / SAMPLES, slope_x, 0.5f / (1 << bit) * slope_y);
    at[0] = fmaf(0.5f / SAMPLES - 0.5f, slope_x + slope_y, value);
#pragma unroll
    for (int sample = 1; sample < SAMPLES; ++sample) at[sample] = at[sample & (sample - 1)] + step[sample & -sample];
    unsigned negative = 0;
#pragma unroll
    for (int sample = SAMPLES - 1; sample >= 0; --sample) negative = __funnelshift_l(__float_as_uint(at[sample]), negative, 1);
    return negative;
};
const int upper = wp::max(wp::min(top - 1, height - 6), 0), leftmost = wp::max(wp::min(left - 1, width - 6), 0);
const int* const first_row = faces.data + (size_t)instant * height * width;
for (int entry = pixel; entry < room; entry += 16) seen[entry] = -1;
__syncwarp();
int count = 0, parts[3], wholes[3];
auto is_seen = [&](int face) {
    bool found = false;
#pragma unroll 1
    for (int entry = 0; entry < wp::min(count, room); entry += 4) { // behind the last one there is none
        const int4 four = *(const int4*)(seen + entry);
        found |= four.x == face | four.y == face | four.z == face | four.w == face;
    }
    return found;
};
auto add = [&](int face, int part) { // those of the threads that are not -1, in their order, and each once
    const unsigned same = __match_any_sync(ALL, face) & ours;
    const bool added = face >= 0 && __ffs(same) - 1 == lane;
    const unsigned additions = __ballot_sync(ALL, added) & ours;
    const int entry = count + __popc(additions & below);
    if (added && entry < room) {
        seen[entry] = face;
        part_of[entry] = part;
    }
    count += __popc(additions);
    __syncwarp();
};
bool sky = false;
#pragma unroll
for (int turn = 0; turn < 3; ++turn) {
    const int place = 16 * turn + pixel, y = upper + place / 6, x = leftmost + place % 6;
    const bool inside = place < 36 && y < height && x < width;
    parts[turn] = inside ? first_row[y * width + x] : -1;
    sky |= inside && parts[turn] < 0;
}
#pragma unroll
for (int turn = 0; turn < 3; ++turn) wholes[turn] = parts[turn] >= 0 ? scene.whole_of_face.data[parts[turn]] : -1;
#pragma unroll 1
for (int turn = 0; turn < 3; ++turn) {
    const int face = wholes[0] >= 0 && is_seen(wholes[0]) ? -1 : wholes[0], part = parts[0];
    wholes[0] = wholes[1];
    wholes[1] = wholes[2];
    parts[0] = parts[1];
    parts[1] = parts[2];
    add(face, part);
}
bool full = count > (alone ? room : room / 2); // there are more than have room, or so many that more are going to be found
sky = (__ballot_sync(ALL, sky) & ours) != 0;
Entries reaching; // those that reach the pixel
int looked = 0, edges = 0; // edges that cross pixels: how many are looked at, and how many there are
bool more = true;
for (int begin = 0; more;) {
    if (alone ? full : __any_sync(ALL, full)) { // the instants are taken one by one, or the pixels rendered by rays
        result[0] = alone ? 0 : -1;
        result[3] = -1;
        return result;
    }
    more = __any_sync(ALL, begin < count); // if not, the last edges are looked at
    const int number = wp::max(wp::min(count - begin, members), 0), most = wp::max(number, __shfl_xor_sync(ALL, number, 16));
    const int entry = begin + member;
    // Each half of the warp looks at faces of its own: at those of its instant, or at half of those of the one that is alone.
    const int split = alone ? (number + 1) / 2 : 16, turns = alone ? split : most;
    const bool later = lane >= split; // which half looks at the face of this thread, and in which turn
    const unsigned lookers = later ? 0xffff0000u : 0xffffu;
    const int own_turn = later ? lane - split : lane;
    bool solid = false;
    if (member < number) { // each thread prepares a face
        const int face = seen[entry];
        const wp::vec3* corner = scene.whole_corner.data + 3 * (size_t)face;
        float function[3][3];
        solid = functions_of(corner[0] - origin, corner[1] - origin, corner[2] - origin, function) != 0.0f;
        for (int side = 0; side < 3; ++side)
            block.function[side][lane] = {function[side][0], function[side][1], function[side][2], 0.0f};
        plane_of[entry] = {function[0][0] + function[1][0] + function[2][0], function[0][1] + function[1][1] + function[2][1],
                           function[0][2] + function[1][2] + function[2][2], __int_as_float(scene.whole_surface.data[face])};
    }
    const unsigned solids = __ballot_sync(ALL, solid);
    __syncwarp();
    unsigned crossed = 0; // of the face of this thread: edges that cross pixels; 8: it reaches one
    for (int turn = 0; turn < wp::max(turns, 1); ++turn) {
        if (more) {
            const int at = (lane < 16 ? 0 : split) + turn, looked_at = begin + at % members;
            bool reached = (solids >> at) & 1u;
            float value[3][3], cut_at[3], along_shift[3];
#pragma unroll
            for (int side = 0; side < 3; ++side) {
                const Quad function = block.function[side][at];
                value[side][0] = along(function, center);
                value[side][1] = along(function, across);
                value[side][2] = along(function, down);
                if constexpr (TIMED) along_shift[side] = along(function, shift);
            }
            if constexpr (TIMED) shift_values([&](int side, int term) -> float& { return value[side][term]; }, along_shift);
#pragma unroll
            for (int side = 0; side < 3; ++side) {
                const float extent = 0.5f * (wp::abs(value[side][1]) + wp::abs(value[side][2]));
                reached &= value[side][0] + extent >= 0.0f;
                cut_at[side] = value[side][0] - extent;
            }
            if (reached) {
                reaching.add(looked_at);
                own_shown[looked_at * width_of_row] = ALL_POINTS;
            }
            const unsigned reaches = __ballot_sync(ALL, reached);
            if (own_turn == turn && reaches & lookers) crossed |= 8u;
            float near[3];
#pragma unroll
            for (int term = 0; term < 3; ++term) near[term] = OVERLAP * (value[0][term] + value[1][term] + value[2][term]);
#pragma unroll
            for (int side = 0; side < 3; ++side) {
                const bool cut = reached && cut_at[side] < 0.0f;
                const unsigned cuts = __ballot_sync(ALL, cut);
                if (own_turn == turn && cuts & lookers) crossed |= 1u << side;
                if (cut)
                    block.edge[(edges + __popc(cuts & below)) % 128] = {value[side][0] + near[0], value[side][1] + near[1],
                                                                       value[side][2] + near[2],
                                                                       __int_as_float(looked_at * width_of_row + 16 * half + pixel)};
                edges += __popc(cuts);
            }
        }
        while (edges - looked >= (more ? 32 : 1)) { // each thread finds which points of a pixel are outside an edge
            __syncwarp();
            if (looked + lane < edges) {
                const Quad edge = block.edge[(looked + lane) % 128];
                atomicAnd(&block.shown[0][__float_as_int(edge.w)], ~negative_at(edge.x, edge.y, edge.z));
            }
            looked = wp::min(looked + 32, edges);
            __syncwarp();
        }
    }
    if (member < number && crossed == 0) plane_of[entry].w = __int_as_float(-1); // no pixel shows it
    __syncwarp();
    const int surface = member < number ? __float_as_int(plane_of[entry].w) : -1;
    int first = begin + __ffs(__match_any_sync(ALL, surface) & ours) - 1 - 16 * half;
    if (member < number) {
#pragma unroll 1
        for (int other = begin - 1; other >= 0; --other)
            if (__float_as_int(plane_of[other].w) == surface) first = other;
        first_of[entry] = (unsigned char)first;
    }
    for (int base = 0; base < 3 * most; base += members) { // each thread looks beyond an edge
        const int at = wp::min((base + member) / 3, members - 1), side = (base + member) % 3;
        const unsigned crossings = __shfl_sync(ALL, crossed, 16 * half + at);
        int beyond = -1;
        if (!full && base + member < 3 * number && (crossings >> side) & 1u)
            beyond = scene.whole_neighbor.data[3 * (size_t)seen[begin + at] + side];
        if (beyond >= 0 && !is_seen(beyond)) {
            const Quad edge = block.function[side][16 * half + at];
            const float function[3] = {edge.x, edge.y, edge.z};
            if (!is_beyond(beyond, function)) beyond = -1;
        } else {
            beyond = -1;
        }
        add(beyond, -1 - beyond);
        full |= count > room;
    }
    begin += number;
}
if (alone) { // the first threads go on with what the others have found
    const unsigned low = __shfl_xor_sync(ALL, reaching.low, 16), high = __shfl_xor_sync(ALL, reaching.high, 16);
    reaching.low = lane < 16 ? reaching.low | low : 0u;
    reaching.high = lane < 16 ? reaching.high | high : 0u;
}
unsigned taken = 0; // points that show a face
Entries surfaces, holding; // first entries of the surfaces that the pixel shows; entries that hold points
for (Entries rest = reaching; rest.any();) { // which of several shows where they are
    const int entry = rest.take();
    unsigned inside = own_shown[entry * width_of_row], overlap = inside & taken;
    const Quad own = plane_of[entry];
    for (Entries others = holding; overlap && others.any();) {
        const int other = others.take();
        const unsigned contested = own_shown[other * width_of_row] & overlap;
        if (!contested) continue;
        overlap &= ~contested; // no two hold a point
        const Quad against = plane_of[other];
        unsigned won = 0;
        if (__float_as_int(against.w) != __float_as_int(own.w)) {
            // distances to planes that the camera crosses are negative
            const float own_distance = distance(own), other_distance = distance(against);
            const float other_share = NEARER * copysignf(own_distance, other_distance);
            const float share = copysignf(other_distance, own_distance);
            const Quad behind = {fmaf(other_share, against.x, -share * own.x), fmaf(other_share, against.y, -share * own.y),
                                 fmaf(other_share, against.z, -share * own.z), 0.0f};
            const float middle = along(behind, center), slope_x = along(behind, across), slope_y = along(behind, down);
            const float extent = 0.5f * (wp::abs(slope_x) + wp::abs(slope_y));
            won = middle < -extent ? contested : 0u;
            if (wp::abs(middle) <= extent) won = contested & negative_at(middle, slope_x, slope_y);
        }
        own_shown[other * width_of_row] &= ~won;
        inside &= ~(contested & ~won);
    }
    own_shown[entry * width_of_row] = inside;
    if (inside) holding.add(entry);
    taken |= inside;
}
for (Entries rest = holding; rest.any();) { // faces of one surface are taken together
    const int entry = rest.take(), first = first_of[entry];
    const unsigned shown = own_shown[entry * width_of_row];
    if (!shown) continue;
    if (first < entry) own_shown[first * width_of_row] = shown | (surfaces.has(first) ? own_shown[first * width_of_row] : 0u);
    surfaces.add(first);
}
const int bare = SAMPLES - __popc(taken);
const bool resolved = sky || 2 * bare <= SAMPLES;
if (outside || !resolved) surfaces = Entries();
const int pairs = __popc(surfaces.low) + __popc(surfaces.high);
int before = pairs;
#pragma unroll
for (int step = 1; step < 32; step *= 2) {
    const int other = __shfl_up_sync(ALL, before, step, 32);
    if (lane >= step) before += other;
}
result[0] = __shfl_sync(ALL, before, 31);
before -= pairs;
for (int pair = before; surfaces.any();) block.pair[pair++] = (unsigned short)(lane | surfaces.take() << 5);
__syncwarp();
result[1] = before;
result[2] = pairs;
result[3] = resolved ? bare : -1;
result[4] = sky;
result[5] = (int)__cvta_generic_to_shared(&block);
#endif
return result;
