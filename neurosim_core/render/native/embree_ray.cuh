// Returns the distance to the nearest triangle along a unit ray [m], or `far_m` if none is nearer. The ray is laid
// out as RTCRayHit.
#ifdef __CUDA_ARCH__
return far_m;
#else
struct alignas(16) {
    float origin[3], near_t, ray[3], time, far_t;
    int mask, id, flags;
    float normal[3], u, v;
    int face, geometry, instance[2];
} hit;
for (int axis = 0; axis < 3; ++axis) {
    hit.origin[axis] = origin[axis];
    hit.ray[axis] = ray[axis];
}
hit.near_t = hit.time = 0.0f;
hit.far_t = far_m;
hit.mask = hit.face = hit.geometry = hit.instance[0] = hit.instance[1] = -1;
hit.id = hit.flags = 0;
((void (*)(void*, void*, void*))intersect)((void*)scene, &hit, nullptr);
return hit.far_t;
#endif
