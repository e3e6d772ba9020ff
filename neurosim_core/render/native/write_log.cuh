// CPU: writes the log radiance of 4 x 4 pixels.
auto radiance_of = [&](int channel, int lane) { return radiance.data[lane][channel]; };
#include "log_luma.cuh"
