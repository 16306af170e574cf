// Blurs of a texture in place, by three taps along both sides. Face and twin: blur.py.
#pragma once

#include <algorithm>
#include <cstdint>
#include <cstring>
#include <vector>

#include "../arrays.hpp"
#include "plan.hpp"

namespace neumip {

// Each of `n` numbers of `now` moves by share towards those before and after it; `before` holds
// what came before, as it was, and takes what `now` was.
inline void soften(float* now, float* before, const float* after, int64_t n, float share) {
    for (int64_t i = 0; i < n; ++i) {
        const float was = now[i];
        now[i] = was + share * (before[i] + after[i] - 2.f * was);
        before[i] = was;
    }
}

// `count` cells of `n` numbers, a cell apart; the borders meet, or stand still.
inline void soften_line(float* line, int64_t count, int64_t n, float share, bool wrap,
                        std::vector<float>& first, std::vector<float>& before) {
    if (count < 2) return;
    first.assign(line, line + n);
    const float* last = line + (count - 1) * n;
    before.assign(wrap ? last : line, (wrap ? last : line) + n);
    for (int64_t i = 0; i + 1 < count; ++i)
        soften(line + i * n, before.data(), line + (i + 1) * n, n, share);
    if (!wrap) first.assign(last, last + n);
    soften(line + (count - 1) * n, before.data(), first.data(), n, share);
}

inline void blur(Out<float> texture, float share, bool wrap) {
    require(texture.ndim() == 3, "a texture is (h, w, k)");
    const int64_t h = texture.shape(0), w = texture.shape(1), k = texture.shape(2);
    float* data = texture.data();
    nanobind::gil_scoped_release release;
    std::vector<float> first, before;
    for (int64_t row = 0; row < h; ++row)
        soften_line(data + row * w * k, w, k, share, wrap, first, before);
    soften_line(data, h, w * k, share, wrap, first, before);
}

}  // namespace neumip
