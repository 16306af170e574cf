// Batches of random texels from images in memory. Face and numpy twin: __init__.py.

#include <nanobind/nanobind.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>

#include "../arrays.hpp"
#include "../spread.hpp"

namespace {

inline float from_half(uint16_t h) {
    const uint32_t sign = uint32_t(h & 0x8000) << 16, rest = h & 0x7fff;
    // Exponents move by 112; the product puts subnormals right, the largest exponent is special.
    float f;
    const uint32_t bits = rest << 13;
    std::memcpy(&f, &bits, 4);
    f *= 5.192296858534828e33f;  // 2^112
    uint32_t out;
    std::memcpy(&out, &f, 4);
    if (rest >= 0x7c00) out = 0x7f800000 | bits;
    out |= sign;
    std::memcpy(&f, &out, 4);
    return f;
}

inline uint64_t scrambled(uint64_t x) {  // splitmix64
    x += 0x9e3779b97f4a7c15u;
    x = (x ^ (x >> 30)) * 0xbf58476d1ce4e5b9u;
    x = (x ^ (x >> 27)) * 0x94d049bb133111ebu;
    return x ^ (x >> 31);
}

// Random texels of random images: images (k, h, w, c) hold every `stride`-th row and column of
// their image, from `phase` (k, 2) on, of a grid (rows, cols). Where texel > 0, light and view are
// positions above the centre of the sample, and texel the edge of one of the grid.
template <class T>
void draw(In<T> images, In<float> light, In<float> view, In<int32_t> phase, int stride, int rows,
          int cols, float texel_light, float texel_view, uint64_t seed, Out<float> uv,
          Out<float> lights, Out<float> views, Out<float> rgb, Out<int32_t> slots, int threads) {
    require(images.ndim() == 4 && images.size() > 0, "images are (k, h, w, c)");
    const uint64_t k = images.shape(0), h = images.shape(1), w = images.shape(2);
    const size_t c = images.shape(3), b = uv.size() / 2;
    require(light.size() == 3 * k && view.size() == 3 * k && phase.size() == 2 * k, "a row an image");
    require(lights.size() == 3 * b && views.size() == 3 * b && rgb.size() == c * b &&
                slots.size() == b, "sizes of the batch");
    constexpr int64_t block = 64;
    nanobind::gil_scoped_release release;
    spread(int64_t(b), block, int(std::clamp<size_t>(b / 4096, 1, threads)),
           [&](int, int64_t from, int64_t to) {
        const T* at[block];
        int32_t slot[block], row[block], col[block];
        for (int64_t start = from; start < to; start += block) {
            const int n = int(std::min(block, to - start));
            for (int i = 0; i < n; ++i) {
                const uint64_t r = scrambled(seed + uint64_t(start + i)), q = scrambled(r);
                slot[i] = int32_t(((r >> 32) * k) >> 32);
                const uint64_t t = ((q >> 32) * (h * w)) >> 32;
                row[i] = int32_t(t / w);
                col[i] = int32_t(t % w);
                at[i] = images.data() + (uint64_t(slot[i]) * h * w + t) * c;
                __builtin_prefetch(at[i]);
            }
            for (int i = 0; i < n; ++i) {
                const int64_t o = start + i;
                const int s = slot[i];
                const float y = float(row[i] * stride + phase.data()[2 * s]) + 0.5f;
                const float x = float(col[i] * stride + phase.data()[2 * s + 1]) + 0.5f;
                slots.data()[o] = s;
                uv.data()[2 * o] = x / float(cols);
                uv.data()[2 * o + 1] = y / float(rows);
                auto direction = [&](const float* from_table, float texel, float* out) {
                    float d[3] = {from_table[0], from_table[1], from_table[2]};
                    if (texel > 0) {
                        d[0] -= (x - float(cols) / 2) * texel;
                        d[1] += (y - float(rows) / 2) * texel;
                        const float size = std::sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2]);
                        for (float& part : d) part /= size;
                    }
                    for (int j = 0; j < 3; ++j) out[j] = d[j];
                };
                direction(light.data() + 3 * s, texel_light, lights.data() + 3 * o);
                direction(view.data() + 3 * s, texel_view, views.data() + 3 * o);
                for (size_t j = 0; j < c; ++j) {
                    if constexpr (sizeof(T) == 2) rgb.data()[o * c + j] = from_half(at[i][j]);
                    else rgb.data()[o * c + j] = at[i][j];
                }
            }
        }
    });
}

}  // namespace

NB_MODULE(_draw, m) {
    m.def("draw16", &draw<uint16_t>);
    m.def("draw32", &draw<float>);
}
