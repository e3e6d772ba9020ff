// Rays in W of SIDE x SIDE pixels from `first_pixel` on: `ray` [3][N] and `spread` [N]; zero where the picture ends. Of lane k
// `pixel_of`(k) is the place in the square, and `layer_of`(k) the layer; `turn`(k, x, y, z) takes a direction to W.
alignas(64) float ray[3][N], spread[N];
const bool all = columns == SIDE && rows == SIDE;
for (int lane = 0; lane < N; ++lane) {
    const int place = pixel_of(lane), x = place % SIDE, y = place / SIDE;
    const bool inside = all || (x < columns && y < rows);
    const wp::vec4& pixel = *wp::address(rays, layer_of(lane), first_pixel + (inside ? y * width + x : 0));
    for (int axis = 0; axis < 3; ++axis) ray[axis][lane] = inside ? pixel[axis] : 0.0f;
    spread[lane] = inside ? pixel[3] : 0.0f;
}
for (int lane = 0; lane < N; ++lane) {
    const wp::vec3 turned = turn(lane, ray[0][lane], ray[1][lane], ray[2][lane]);
    for (int axis = 0; axis < 3; ++axis) ray[axis][lane] = turned[axis];
}
