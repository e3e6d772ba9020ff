// Rays in W of the SIDE x SIDE pixels from `first_pixel` on, of a layer: `ray` [3][N] and `spread` [N]; zero where the
// picture ends.
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
