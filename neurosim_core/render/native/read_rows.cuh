// `row` reads one of the rows of a `RayTree`.
using namespace wp;
#ifdef __CUDA_ARCH__
using Row = float4;
auto row = [](const array_t<vec4>& rows, int k) { return __ldg((const float4*)rows.data + k); };
#else
struct Row {
    float x, y, z, w;
};
auto row = [](const array_t<vec4>& rows, int k) { return ((const Row*)rows.data)[k]; };
#endif
