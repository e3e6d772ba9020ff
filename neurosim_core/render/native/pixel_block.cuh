// CUDA: what the threads of a warp share about 4 x 4 pixels, see `cover_block.cuh`.
struct Block {
    union {
        float function[9][MOST];
        float pair[3][16 * SAMPLES]; // pixel, first entry of its surface and number of points, in 8 bits each; their mean; or light
    };
    int seen[MOST], part[MOST], surface[MOST], first[MOST], reach[MOST]; // part: -1 - face: no ray hit one

    float ray[9][16];
};
