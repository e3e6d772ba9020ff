// `points` [2][SAMPLES]: a Hammersley set around the centre of a pixel of width 1, one in each of 16 rows, of 16 columns
// and of 4 x 4 cells.
float points[2][SAMPLES];
for (int sample = 0; sample < SAMPLES; ++sample) {
    const int reversed = (sample & 1) << 3 | (sample & 2) << 1 | (sample & 4) >> 1 | (sample & 8) >> 3;
    points[0][sample] = ((float)sample + 0.5f) / SAMPLES - 0.5f;
    points[1][sample] = ((float)reversed + 0.5f) / SAMPLES - 0.5f;
}
