// CUDA: what the threads of a warp share about a block of 4 x 4 pixels in two instants, or in one, see `cover_block.cuh`. Each
// instant has its half of the faces and of the points that show them; one alone has them all.
struct alignas(16) Quad {
    float x, y, z, w;
};
struct Block {
    union {
        struct {
            Quad function[3][32]; // edge functions of the 16 faces of each instant that are looked at
            Quad edge[128];       // values of edge functions at the centres of pixels, their slopes, and whose they are
        };
        struct {
            float light[3][32];             // of the pairs that are shaded together
            unsigned short pair[32 * SAMPLES]; // threads in 5 bits, and entries above
        };
    };
    Quad plane[MOST];            // the nearness [1/m] along a direction is its product with this; then the surface, as bits
    int seen[MOST], part[MOST];  // part: -1 - face: no ray hit one
    unsigned shown[MOST][16];    // of each face and pixel: bits of the points that show it
    unsigned char first[MOST];   // entry of the same surface
};
