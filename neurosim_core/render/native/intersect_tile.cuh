#include "list_of_tile.cuh"
#include "candidate_test.cuh"
float best[64] = {}, next[64] = {}, ray_x[64], ray_y[64], ray_z[64];
int which[64];
const vec3 origin = p_WC.data[first];
const Axes axes = axes_of(q_WC.data[first]);
for (int pixel = 0; pixel < 64; ++pixel) {
    which[pixel] = UNRESOLVED;
    const vec3 ray = in_camera(axes, rays.data[pixel]);
    ray_x[pixel] = ray[0] / ray[2];
    ray_y[pixel] = ray[1] / ray[2];
    ray_z[pixel] = ray[2];
}
const float part_y[PARTS][2] = {{bounds[2], bounds[3]}};
for (int k = 0; k < count; ++k)
    if (Face face; prepare(faces.data[begin + k], origin, axes, part_y, face)) {
        if (face.slack < 0.0f)
            for (int pixel = 0; pixel < 64; ++pixel) test_from_side(face, ray_x[pixel], ray_y[pixel], next[pixel]);
        else
            for (int pixel = 0; pixel < 64; ++pixel)
                test(face, ray_x[pixel], ray_y[pixel], best[pixel], next[pixel], which[pixel]);
    }
for (int pixel = 0; pixel < 64; ++pixel)
    face_out.data[pixel] = count < 0 ? UNRESOLVED : decide(best[pixel], next[pixel], which[pixel], ray_z[pixel]);
