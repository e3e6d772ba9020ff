// CUDA: what the threads of a warp share about 4 x 4 pixels, see `cover_block.cuh`.
struct Block {
    union {
        float function[9][MOST];
        float light[3][32]; // of the pairs that are shaded together
    };
    float plane[3][MOST], ray[9][16];
    int seen[MOST], part[MOST], surface[MOST]; // part: -1 - face: no ray hit one
    unsigned shown[MOST][16]; // of each face and pixel: bits of the points that show it
    unsigned short listed[16 * MOST]; // pixels in 4 bits and entries above: of edges to look at, then of pairs
    unsigned char first[MOST], reach[MOST]; // first: of the same surface
};
