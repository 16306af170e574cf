// Networks whose products are of bfloat16, summed in float32: included after layers.hpp,
// once a variant. The first layer stays float32: its inputs are places on a sharp picture.
//
// Where the processor multiplies pairs of bfloat16, two channels lie side by side in one row of
// 32-bit lanes. Elsewhere weights and activations are rounded alike and multiplied as floats.

// To the nearest bfloat16, ties to even.
FN F rounded(F x) {
    const I bits = (I)x;
    return (F)((bits + 0x7fff + ((bits >> 16) & 1)) & int32_t(0xffff0000u));
}

DEEP void round_rows(float* x, int rows, int n) {
    for (int r = 0; r < rows; ++r)
        for (int i = 0; i < n; i += L) store(x + r * kStride + i, rounded(load(x + r * kStride + i)));
}

inline float rounded_one(float x) {
    uint32_t bits;
    std::memcpy(&bits, &x, 4);
    bits = (bits + 0x7fff + ((bits >> 16) & 1)) & 0xffff0000u;
    std::memcpy(&x, &bits, 4);
    return x;
}

typedef uint32_t PairRow __attribute__((may_alias));

#if NEUMIP_LANES == 16 && (defined(__clang__) || __GNUC__ >= 10)
#define HALF \
    __attribute__((target("avx512f,avx512vl,avx512dq,avx512bw,avx512bf16,avx2,fma" WIDE)))

// A matrix for `pair_gemm`: groups of six outputs, each group by pairs of inputs.
struct Pairs {
    static constexpr int kGroup = 6;
    int pairs = 0, out = 0;
    std::vector<uint32_t> weights;
    std::vector<float> bias;

    template <class At>
    void fill(int in, int outputs, At at) {
        pairs = (in + 1) / 2;
        out = outputs;
        weights.clear();
        bias.assign(out, 0.f);
        for (int o = 0; o < out; o += kGroup)
            for (int k = 0; k < in; k += 2)
                for (int i = o; i < std::min(o + kGroup, out); ++i)
                    weights.push_back(bits_of(at(i, k)) >> 16 |
                                      (k + 1 < in ? bits_of(at(i, k + 1)) : 0u));
    }
    static uint32_t bits_of(float x) {
        uint32_t bits;
        x = rounded_one(x);
        std::memcpy(&bits, &x, 4);
        return bits;
    }
};

HALF static inline __attribute__((always_inline)) void put_pair(PairRow* to, F low, F high) {
    const __m512i both = (__m512i)_mm512_cvtne2ps_pbh((__m512)high, (__m512)low);
    alignas(64) static constexpr uint16_t kMix[32] = {
        0, 16, 1, 17, 2, 18, 3, 19, 4, 20, 5, 21, 6, 22, 7, 23,
        8, 24, 9, 25, 10, 26, 11, 27, 12, 28, 13, 29, 14, 30, 15, 31};
    _mm512_store_si512(to, _mm512_permutexvar_epi16(_mm512_load_si512(kMix), both));
}

// Rows of floats to rows of pairs.
HALF static __attribute__((noinline)) void to_pairs(const float* x, int rows, PairRow* to, int n) {
    for (int r = 0; r < rows; r += 2, x += 2 * kStride, to += kStride)
        for (int i = 0; i < n; i += L)
            put_pair(to + i, load(x + i), r + 1 < rows ? load(x + kStride + i) : all(0.f));
}

template <int MR, int NR, int MODE>
HALF static inline __attribute__((always_inline)) void pair_block(
    const uint32_t* w, const float* bias, const PairRow* x, int pairs, float* rows, PairRow* to) {
    __m512 acc[MR][NR];
#pragma GCC unroll 8
    for (int m = 0; m < MR; ++m)
#pragma GCC unroll 8
        for (int n = 0; n < NR; ++n) acc[m][n] = _mm512_set1_ps(bias[m]);
    for (int k = 0; k < pairs; ++k, x += kStride, w += MR) {
        __m512bh xs[NR];
#pragma GCC unroll 8
        for (int n = 0; n < NR; ++n) xs[n] = (__m512bh)_mm512_load_si512(x + n * L);
#pragma GCC unroll 8
        for (int m = 0; m < MR; ++m) {
            const __m512bh s = (__m512bh)_mm512_set1_epi32(int(w[m]));
#pragma GCC unroll 8
            for (int n = 0; n < NR; ++n) acc[m][n] = _mm512_dpbf16_ps(acc[m][n], s, xs[n]);
        }
    }
#pragma GCC unroll 8
    for (int m = 0; m < MR; m += 2)
#pragma GCC unroll 8
        for (int n = 0; n < NR; ++n) {
            F v[2] = {(F)acc[m][n], m + 1 < MR ? (F)acc[m + 1 < MR ? m + 1 : m][n] : all(0.f)};
#pragma GCC unroll 2
            for (F& y : v) {
                if constexpr (MODE == kForwardRelu) y = larger(y, all(0.f));
                if constexpr (MODE == kForwardLeaky) y = y > all(0.f) ? y : y * kLeak;
                if constexpr (MODE == kForwardSine) {
                    y = y * 0.15915494309189535f;  // turns
                    y = sine_of_turn(y - nearest(y));
                }
            }
            if (to) {
                put_pair(to + m / 2 * kStride + n * L, v[0], v[1]);
            } else {
                store(rows + m * kStride + n * L, v[0]);
                if (m + 1 < MR) store(rows + (m + 1) * kStride + n * L, v[1]);
            }
        }
}

template <int MR, int MODE>
HALF static inline __attribute__((always_inline)) void pair_strip(
    const Pairs& p, int first, int groups, const PairRow* x, float* rows, PairRow* to, int n,
    Feed* feed) {
    constexpr int NR = MR <= 2 ? 8 : 4;
    for (int at = 0; at < n; at += NR * L) {
        if (feed) feed->some(NR * L / 2);
        for (int g = 0; g < groups; ++g) {
            const int o = first + g * MR;
            pair_block<MR, NR, MODE>(p.weights.data() + o * p.pairs, p.bias.data() + o, x + at,
                                     p.pairs, rows ? rows + o * kStride + at : nullptr,
                                     to ? to + o / 2 * kStride + at : nullptr);
        }
    }
}

// mode(matrix x + bias) for n queries, to rows of floats or of pairs.
template <int MODE>
HALF static __attribute__((noinline)) void pair_gemm(const Pairs& p, const PairRow* x, float* rows,
                                                     PairRow* to, int n, Feed* feed) {
    const int groups = p.out / Pairs::kGroup, first = groups * Pairs::kGroup;
    if (groups) pair_strip<Pairs::kGroup, MODE>(p, 0, groups, x, rows, to, n, feed);
    switch (p.out - first) {
        case 5: return pair_strip<5, MODE>(p, first, 1, x, rows, to, n, nullptr);
        case 4: return pair_strip<4, MODE>(p, first, 1, x, rows, to, n, nullptr);
        case 3: return pair_strip<3, MODE>(p, first, 1, x, rows, to, n, nullptr);
        case 2: return pair_strip<2, MODE>(p, first, 1, x, rows, to, n, nullptr);
        case 1: return pair_strip<1, MODE>(p, first, 1, x, rows, to, n, nullptr);
        default: return;
    }
}
#undef HALF
#else
// No layer is ever packed by pairs here.
struct Pairs {
    std::vector<float> bias;
    template <class At>
    void fill(int, int, At) {}
};
inline void to_pairs(const float*, int, PairRow*, int) {}
template <int MODE>
inline void pair_gemm(const Pairs&, const PairRow*, float*, PairRow*, int, Feed*) {}
#endif
