// CPU: writes the log radiance of 8 x 8 pixels at those of INSTANTS instants that have a bit in `wanted`; `radiance` is as
// `shade_tile.cuh` has it.
const int first_instant = tile.instant, tile_top = tile.top, tile_left = tile.left;
for (int block = 0; block < 4 * INSTANTS; ++block) {
    const int instant = first_instant + block / 4, top = tile_top + block % 4 / 2 * 4, left = tile_left + block % 2 * 4;
    const int rows = wp::min(log_radiance_out.shape[1] - top, 4), columns = wp::min(log_radiance_out.shape[2] - left, 4);
    if (!(wanted >> block / 4 & 1)) continue;
    auto radiance_of = [&](int channel, int lane) { return radiance.data[64 * INSTANTS * channel + 16 * block + lane]; };
#include "log_luma.cuh"
}
