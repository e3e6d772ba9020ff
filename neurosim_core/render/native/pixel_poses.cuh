// Where the 4 x 4 pixels at `top`, `left` are seen from: `position` and `orientation`, of a pixel at its lane with TIMED, else of
// all of them at 0.
constexpr int POSES = TIMED ? 16 : 1;
alignas(64) float position[3][POSES], orientation[4][POSES];
for (int lane = 0; lane < POSES; ++lane) {
    const int y = lane / 4 < rows ? lane / 4 : 0, x = lane % 4 < columns ? lane % 4 : 0;
    const int pose = TIMED ? instant * view.pose_count + *wp::address(view.pose, 0, (top + y) * view.width + left + x) : instant;
    for (int axis = 0; axis < 3; ++axis) position[axis][lane] = view.p_WC.data[pose][axis];
    for (int axis = 0; axis < 4; ++axis) orientation[axis][lane] = view.q_WC.data[pose][axis];
}
auto turn = [&](int lane, float x, float y, float z) {
    const int pose = TIMED ? lane : 0;
    return wp::quat_rotate(
        wp::quat(orientation[0][pose], orientation[1][pose], orientation[2][pose], orientation[3][pose]), wp::vec3(x, y, z));
};
