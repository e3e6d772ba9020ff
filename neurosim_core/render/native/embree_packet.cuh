// Casts the 16 rays `ray` [3][16] from `origin_of(axis, lane)`; rays of zero length are not cast. The results are `faces`,
// `ts`, `us`, `vs` [16] and `normal` [3][16]. Embree's u and v weigh the second and the third corner of a
// triangle, Warp's weigh the first and the second. The packet has the layout of RTCRayHit4, 8 or 16.
constexpr float NEAR_M = 1e-5f; // a surface that the rays begin in is not seen
alignas(64) float ts[16], us[16], vs[16], normal[3][16];
alignas(64) int faces[16];
const float corners = ray[0][0] * ray[0][15] + ray[1][0] * ray[1][15] + ray[2][0] * ray[2][15]; // cosine; 0: cut off
const bool coherent = corners <= 0.0f || corners > 0.98f; // rays of coarse pictures part soon: then each on its own
for (int begin = 0; begin < 16; begin += WIDTH) {
    struct alignas(4 * WIDTH) {
        float origin[3][WIDTH], near_t[WIDTH], ray[3][WIDTH], time[WIDTH], far_t[WIDTH];
        int mask[WIDTH], id[WIDTH], flags[WIDTH];
        float normal[3][WIDTH], u[WIDTH], v[WIDTH];
        int face[WIDTH], geometry[WIDTH], instance[2][WIDTH];
    } packet;
    alignas(4 * WIDTH) int valid[WIDTH];
    struct {
        int flags, features;
        void *context, *filter, *intersect;
    } arguments = {coherent << 16, -1, nullptr, nullptr, nullptr}; // all features
    for (int lane = 0; lane < WIDTH; ++lane) {
        const int from = begin + lane;
        valid[lane] = ray[0][from] != 0.0f || ray[1][from] != 0.0f || ray[2][from] != 0.0f ? -1 : 0;
        for (int axis = 0; axis < 3; ++axis) {
            packet.origin[axis][lane] = origin_of(axis, from);
            packet.ray[axis][lane] = ray[axis][from];
        }
        packet.near_t[lane] = NEAR_M;
        packet.time[lane] = 0.0f;
        packet.far_t[lane] = far_m;
        packet.mask[lane] = -1;
        packet.id[lane] = packet.flags[lane] = 0;
        packet.face[lane] = packet.geometry[lane] = -1;
        packet.instance[0][lane] = packet.instance[1][lane] = -1;
    }
    ((void (*)(const int*, void*, void*, void*))embree_intersect)(valid, (void*)embree_scene, &packet,
                                                                  &arguments);
    for (int lane = 0; lane < WIDTH; ++lane) {
        faces[begin + lane] = packet.face[lane];
        ts[begin + lane] = packet.far_t[lane];
        us[begin + lane] = 1.0f - packet.u[lane] - packet.v[lane];
        vs[begin + lane] = packet.u[lane];
        for (int axis = 0; axis < 3; ++axis) normal[axis][begin + lane] = packet.normal[axis][lane];
    }
}
