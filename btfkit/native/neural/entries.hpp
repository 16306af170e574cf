// What a variant offers: the last of its headers.

inline int next_size(int64_t at, int64_t to) {
    return int(std::max<int64_t>(std::min<int64_t>(kTile, to - at - kTile), 0));
}

// rgb (lights or 1, size, outputs) for queries [from, to); lights: directions (count) shared by all,
// or `each` of them (count, size), where a vector of zeros is not asked and answers 0; opacity
// (size) of curved heights, or null.
NEUMIP_TARGET void evaluate(const Plan& plan, const float* weights, const float* texels,
                            const Batch& b, const float* lights, int64_t count, bool each,
                            int64_t from, int64_t to, float* rgb, float* opacity, bool raw) {
    auto tile = std::make_unique<Tile>(plan, weights, texels, b, false);
    const int64_t outputs = raw ? plan.decoder.widths.back() : plan.channels;
    for (int64_t at = from; at < to; at += kTile) {
        const int valid = int(std::min<int64_t>(kTile, to - at));
        tile->stage_one(b, at, valid);
        if (at + kTile < to) tile->look_ahead(b, at + kTile, next_size(at, to));
        if (opacity) std::copy_n(tile->in[Tile::kOpaque], valid, opacity + at);
        if (!raw && !tile->seen(valid)) {
            for (int64_t j = 0; j < (lights ? count : 1); ++j)
                std::fill_n(rgb + (j * b.size + at) * outputs, valid * outputs, 0.f);
            continue;
        }
        if (lights == nullptr) {
            tile->stage_two(b.light + 3 * at, false, valid, rgb + at * outputs, raw);
            continue;
        }
        for (int64_t j = 0; j < count; ++j) {
            float* out = rgb + (j * b.size + at) * outputs;
            if (!each) {
                tile->stage_two(lights + 3 * j, true, valid, out, raw);
                continue;
            }
            const float* own = lights + 3 * (j * b.size + at);
            const auto asked = [&](int i) { return own[3 * i] != 0 || own[3 * i + 1] != 0 || own[3 * i + 2] != 0; };
            int some = 0;
            for (int i = 0; i < valid; ++i) some += asked(i);
            if (some) tile->stage_two(own, false, valid, out, raw);
            if (some == valid) continue;
            for (int i = 0; i < valid; ++i)
                if (!asked(i)) std::fill_n(out + i * outputs, outputs, 0.f);
        }
    }
}

// Ray depth (to - from) of the offset stage, in tile widths.
NEUMIP_TARGET void depths(const Plan& plan, const float* weights, const float* texels,
                          const Batch& b, int64_t from, int64_t to, float* out) {
    auto tile = std::make_unique<Tile>(plan, weights, texels, b, false);
    for (int64_t at = from; at < to; at += kTile) {
        const int valid = int(std::min<int64_t>(kTile, to - at));
        tile->stage_one(b, at, valid);
        for (int i = 0; i < valid; ++i)
            out[at + i] = plan.depth() ? tile->in[Tile::kDepth][i] * plan.depth_scale : 0.f;
    }
}

NEUMIP_TARGET void train(const Plan& plan, const float* weights, const float* texels,
                         const Batch& b, int loss, int64_t from, int64_t to, Gradient& g) {
    auto tile = std::make_unique<Tile>(plan, weights, texels, b, true);
    const float scale = 1.f / (float(b.size) * float(plan.channels));
    for (int64_t at = from; at < to; at += kTile)
        tile->train(b, at, int(std::min<int64_t>(kTile, to - at)), next_size(at, to), loss, scale, g);
    tile->decoder.unpack(g.weights);
    if (plan.offset) tile->offset.unpack(g.weights);
}

// Whether any gradient is not 0: a lookup of weight 0, or a dead network, touches and pulls not.
FN bool pulled(float* const* g, int buffers, int64_t from, int64_t to) {
    uint32_t bits = 0;
    for (int t = 0; t < buffers; ++t)
        for (int64_t i = from; i < to; ++i) {
            uint32_t one;
            std::memcpy(&one, g[t] + i, sizeof one);
            bits |= one << 1;  // without the sign
        }
    return bits != 0;
}

// Adam on parameters [from, to) given the gradients of `buffers` threads; these are zeroed.
// touched (buffers, ...) marks the pairs of texels that have a gradient; null: all of them.
NEUMIP_TARGET void adam(float* p, float* m, float* v, float* const* g, uint8_t* const* touched,
                        int buffers, int64_t from, int64_t to, float lr, float b1, float b2,
                        float eps, float scale1, float scale2, bool dense) {
    typedef float U __attribute__((vector_size(4 * NEUMIP_LANES), may_alias, aligned(4)));
    constexpr int64_t line = 2 * kChannels;
    const F zero = all(0.f);
    for (int64_t at = from; at < to; at += line) {
        bool any = dense;
        if (touched)
            for (int t = 0; t < buffers; ++t) {
                any |= touched[t][at / line] != 0;
                touched[t][at / line] = 0;
            }
        const int64_t end = std::min(to, at + line);
        if (!any || (!dense && !pulled(g, buffers, at, end))) continue;
        int64_t i = at;
        for (; i + L <= end; i += L) {
            F sum = zero;
            for (int t = 0; t < buffers; ++t) {
                sum += (F) * (const U*)(g[t] + i);
                *(U*)(g[t] + i) = zero;
            }
            const F mm = (F) * (const U*)(m + i) * b1 + sum * (1.f - b1);
            const F vv = (F) * (const U*)(v + i) * b2 + sum * sum * (1.f - b2);
            *(U*)(m + i) = mm;
            *(U*)(v + i) = vv;
            const F size = root(vv * scale2) + eps;
            *(U*)(p + i) = (F) * (const U*)(p + i) - lr * (mm * scale1) / size;
        }
        for (; i < end; ++i) {
            float sum = 0;
            for (int t = 0; t < buffers; ++t) {
                sum += g[t][i];
                g[t][i] = 0;
            }
            m[i] = m[i] * b1 + sum * (1.f - b1);
            v[i] = v[i] * b2 + sum * sum * (1.f - b2);
            p[i] -= lr * (m[i] * scale1) / (__builtin_sqrtf(v[i] * scale2) + eps);
        }
    }
}

// Operations a CPU second of independent fused multiply-adds on one thread.
NEUMIP_TARGET double peak(double seconds) {
    F acc[12];
#pragma GCC unroll 12
    for (int i = 0; i < 12; ++i) acc[i] = all(float(i));
    const F x = all(0.999f), y = all(1e-3f);
    double operations = 0, passed = 0;
    // CPU time: a neighbour on the same core must not look like a slower processor.
    const std::clock_t start = std::clock();
    while (passed < seconds) {
        for (int k = 0; k < 20000; ++k) {
#pragma GCC unroll 12
            for (int i = 0; i < 12; ++i) {
                acc[i] = acc[i] * x + y;
                NEUMIP_KEEP(acc[i]);  // nothing may be folded or dropped
            }
        }
        operations += 20000.0 * 12 * L * 2;
        passed = double(std::clock() - start) / CLOCKS_PER_SEC;
    }
    return operations / passed;
}

}  // namespace NEUMIP_SPACE
}  // namespace neumip

#undef FN
#undef DEEP
#undef MEMBER
