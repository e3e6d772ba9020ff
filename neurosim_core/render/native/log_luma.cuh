// CPU: writes the log of the luma of 4 x 4 pixels from `radiance_of`(channel, lane) and `dark_floor`.
#include "logarithm.cuh"
alignas(64) float log_luma[16];
for (int lane = 0; lane < 16; ++lane) {
    const float luma = 0.2126f * radiance_of(0, lane) + 0.7152f * radiance_of(1, lane) + 0.0722f * radiance_of(2, lane);
    log_luma[lane] = logarithm(luma + dark_floor);
}
for (int y = 0; y < rows; ++y) {
    float* out = wp::address(log_radiance_out, instant, top + y, left);
    for (int x = 0; x < columns; ++x) out[x] = log_luma[4 * y + x];
}
