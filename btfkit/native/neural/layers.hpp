// Layers on a tile of queries: included after vector.hpp, once a variant.
//
// A tile of queries is kept as rows of one number each (channel-major), so that a layer is a
// small matrix product with the queries along the vector lanes and the weights broadcast.

constexpr int kTile = 256;
constexpr int kStride = kTile + 16;  // a power of two would put every row on the same cache sets
constexpr int kAhead = 16;

// Bilinear lookups of up to a tile of queries in textures of one flat array of texels.
struct Lookup {
    alignas(64) int32_t query[kTile];
    alignas(64) int32_t at[4][kTile];  // texels: row 0 col 0, row 0 col 1, row 1 col 0, row 1 col 1
    alignas(64) float fx[kTile], fy[kTile], weight[kTile], w[kTile], h[kTile];
    int first = 0, count = 0;  // of the tile's queries
};

// Texels that a later lookup will want, asked for a few at a time while layers are multiplied.
struct Feed {
    struct Wish {
        const Lookup* list;
        const float* base;
    };
    Wish wishes[4 * kMaxBanks + 4];
    int wanted = 0, wish = 0, at = 0;

    void reset() { wanted = wish = at = 0; }
    void add(const Lookup& list, const float* base) { wishes[wanted++] = {&list, base}; }
    MEMBER void some(int queries) {
        while (wish < wanted && queries > 0) {
            const Wish& w = wishes[wish];
            const int stop = std::min(w.list->count, at + queries);
            queries -= std::max(stop - at, 0);
            for (; at < stop; ++at)
                for (int c = 0; c < 4; ++c)
                    __builtin_prefetch(w.base + size_t(w.list->at[c][at]) * kChannels, 0, 2);
            if (at >= w.list->count) {  // a list may have been made anew, and shorter, meanwhile
                ++wish;
                at = 0;
            }
        }
    }
};

enum Mode {
    kPlain, kForwardRelu, kForwardLeaky, kForwardSine, kTrainSine,
    kBackRelu, kBackLeaky, kBackSine
};

// A matrix for `gemm`: groups of a few outputs, each group k-major; what is left over at the end.
struct Packed {
    int in = 0, out = 0;
    std::vector<float> weights, bias;

    void reset(int inputs, int outputs) {
        in = inputs;
        out = outputs;
        weights.resize(size_t(in) * out);
        bias.assign(out, 0.f);
    }
    // Five rows and two vectors fill the registers best; four waste nothing on 24 and 32.
    static int group(int out) { return out < 5 ? out : out % 5 != 0 && out % 4 == 0 ? 4 : 5; }
    template <class At>
    void fill(At at) {
        float* p = weights.data();
        const int m = group(out);
        for (int o = 0; o < out; o += m)
            for (int k = 0; k < in; ++k)
                for (int i = o; i < std::min(o + m, out); ++i) *p++ = at(i, k);
    }
};

template <int MR, int NR>
FN void multiply(F (&acc)[MR][NR], const float* w, const float* x) {
    F xs[NR];
#pragma GCC unroll 8
    for (int n = 0; n < NR; ++n) xs[n] = load(x + n * L);
#pragma GCC unroll 8
    for (int m = 0; m < MR; ++m) {
        const F s = all(w[m]);
#pragma GCC unroll 8
        for (int n = 0; n < NR; ++n) acc[m][n] += s * xs[n];
    }
}

template <int MR, int NR, int MODE>
FN void block(const float* w, const float* bias, const float* x, int in, float* y, float* side) {
    F acc[MR][NR];
#pragma GCC unroll 8
    for (int m = 0; m < MR; ++m)
#pragma GCC unroll 8
        for (int n = 0; n < NR; ++n) acc[m][n] = all(bias[m]);
    int k = in;
    // By fours: the end of a run of 25 would be mispredicted, of six it is not.
    for (; k >= 4; k -= 4, x += 4 * kStride, w += 4 * MR) {
        multiply<MR, NR>(acc, w, x);
        multiply<MR, NR>(acc, w + MR, x + kStride);
        multiply<MR, NR>(acc, w + 2 * MR, x + 2 * kStride);
        multiply<MR, NR>(acc, w + 3 * MR, x + 3 * kStride);
    }
    for (; k > 0; --k, x += kStride, w += MR) multiply<MR, NR>(acc, w, x);
#pragma GCC unroll 8
    for (int m = 0; m < MR; ++m)
#pragma GCC unroll 8
        for (int n = 0; n < NR; ++n) {
            F v = acc[m][n];
            const int at = m * kStride + n * L;
            if constexpr (MODE == kForwardRelu) v = larger(v, all(0.f));
            if constexpr (MODE == kForwardLeaky) v = v > all(0.f) ? v : v * kLeak;
            if constexpr (MODE == kForwardSine || MODE == kTrainSine) {
                const F u = v - nearest(v);
                if constexpr (MODE == kTrainSine) store(side + at, cosine_of_turn(u));
                v = sine_of_turn(u);
            }
            if constexpr (MODE == kBackRelu) v = load(side + at) > all(0.f) ? v : all(0.f);
            if constexpr (MODE == kBackLeaky) v = load(side + at) > all(0.f) ? v : v * kLeak;
            if constexpr (MODE == kBackSine) v = v * load(side + at);
            store(y + at, v);
        }
}

// Queries outermost: a column of inputs stays in the nearest cache for all groups of outputs.
template <int MR, int NR, int MODE>
FN void strip(const Packed& p, int first, int groups, const float* x, float* y, float* side, int n,
              Feed* feed) {
    const int in = p.in;
    for (int at = 0; at < n; at += NR * L) {
        if (feed) feed->some(NR * L / 2);
        for (int g = 0; g < groups; ++g) {
            const int o = first + g * MR, to = o * kStride + at;
            block<MR, NR, MODE>(p.weights.data() + o * in, p.bias.data() + o, x + at, in, y + to,
                                side + to);
        }
    }
}

template <int MODE>
FN void strips(const Packed& p, int m, int first, int groups, const float* x, float* y, float* side,
               int n, Feed* feed) {
    constexpr int wide = L == 16 ? 4 : 2;
    switch (m) {
        case 5: strip<5, wide, MODE>(p, first, groups, x, y, side, n, feed); break;
        case 4: strip<4, wide, MODE>(p, first, groups, x, y, side, n, feed); break;
        case 3: strip<3, 4, MODE>(p, first, groups, x, y, side, n, feed); break;
        case 2: strip<2, 4, MODE>(p, first, groups, x, y, side, n, feed); break;
        default: strip<1, 8, MODE>(p, first, groups, x, y, side, n, feed); break;
    }
}

// y = mode(matrix x + bias) for n queries; n is a multiple of 8 vectors.
template <int MODE>
DEEP void gemm(const Packed& p, const float* x, float* y, float* side, int n, Feed* feed) {
    const int m = Packed::group(p.out), groups = p.out / m, rest = p.out % m;
    if (side == nullptr) side = y;
    strips<MODE>(p, m, 0, groups, x, y, side, n, feed);
    if (rest) strips<MODE>(p, rest, groups * m, 1, x, y, side, n, nullptr);
}

template <int MO, int MI>
FN void outer_block(const float* dy, const float* x, int n, float* dw, int row) {
    F acc[MO][MI] = {};
#pragma GCC unroll 4
    for (int at = 0; at < n; at += L) {
        F xs[MI];
#pragma GCC unroll 8
        for (int i = 0; i < MI; ++i) xs[i] = load(x + i * kStride + at);
#pragma GCC unroll 8
        for (int o = 0; o < MO; ++o) {
            const F d = load(dy + o * kStride + at);
#pragma GCC unroll 8
            for (int i = 0; i < MI; ++i) acc[o][i] += d * xs[i];
        }
    }
#pragma GCC unroll 8
    for (int o = 0; o < MO; ++o)
#pragma GCC unroll 8
        for (int i = 0; i < MI; ++i) dw[o * row + i] += sum_of(acc[o][i]);
}

template <int MO>
FN void outer_rows(const float* dy, const float* x, int in, int n, float* dw, int row) {
    constexpr int MI = MO >= 5 ? (L == 16 ? 4 : 2) : MO >= 3 ? 3 : 4;
    int i = 0;
    for (; i + MI <= in; i += MI) outer_block<MO, MI>(dy, x + i * kStride, n, dw + i, row);
    for (; i < in; ++i) outer_block<MO, 1>(dy, x + i * kStride, n, dw + i, row);
}

// dw (out, in) += dy x^T over n queries.
DEEP void outer(const float* dy, const float* x, int out, int in, int n, float* dw) {
    for (int o = 0; o < out;) {
        const int groups = (out - o + 4) / 5, m = (out - o + groups - 1) / groups;
        const float* d = dy + o * kStride;
        float* to = dw + o * in;
        switch (m) {
            case 5: outer_rows<5>(d, x, in, n, to, in); break;
            case 4: outer_rows<4>(d, x, in, n, to, in); break;
            case 3: outer_rows<3>(d, x, in, n, to, in); break;
            case 2: outer_rows<2>(d, x, in, n, to, in); break;
            default: outer_rows<1>(d, x, in, n, to, in); break;
        }
        o += m;
    }
}
