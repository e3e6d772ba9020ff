#include "candidate_test.cuh"
float best[64] = {}, next[64] = {}, unsure[64] = {}, ray_x[64], ray_y[64], ray_z[64];
int which[64];
for (int pixel = 0; pixel < 64; ++pixel) {
    which[pixel] = UNRESOLVED;
    ray_x[pixel] = rays.data[pixel][0];
    ray_y[pixel] = rays.data[pixel][1];
    ray_z[pixel] = rays.data[pixel][2];
}
Tile tile;
for (int side = 0; side < 4; ++side) bound(side, q, tile);
for (int k = 0; k < count; ++k)
    if (Face face; prepare(faces.data[begin + k], origin, tile, face))
        for (int pixel = 0; pixel < 64; ++pixel)
            test(face, ray_x[pixel], ray_y[pixel], ray_z[pixel], best[pixel], next[pixel], unsure[pixel],
                 which[pixel]);
for (int pixel = 0; pixel < 64; ++pixel)
    face_out.data[pixel] =
        count < 0 ? UNRESOLVED : decide(best[pixel], next[pixel], unsure[pixel], which[pixel]);
