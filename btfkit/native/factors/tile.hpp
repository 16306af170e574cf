// One variant of the kernel, included once for each width of vectors. Twin: __init__.py.
//
// Lanes are texels: a tile of 2 x LANES rows of `right` is turned to (k, texels), and 12 rows of
// `left`, or 6, or 3, are multiplied with it at a time. Every value is the same chain of multiply-adds over k,
// wherever in a tile it lies, so that windows and scattered values are those of whole images.

namespace factors::FACTORS_SPACE {

constexpr int kLanes = FACTORS_LANES;
constexpr int kTile = 2 * kLanes;
#define FACTORS_INLINE FACTORS_TARGET static inline __attribute__((always_inline))

#if FACTORS_LANES == 16
constexpr int kRows = 12;
using V = __m512;
FACTORS_INLINE V load(const float* p) { return _mm512_loadu_ps(p); }
FACTORS_INLINE void store(float* p, V v) { _mm512_storeu_ps(p, v); }
FACTORS_INLINE V all(float x) { return _mm512_set1_ps(x); }
FACTORS_INLINE V fma(V a, V b, V c) { return _mm512_fmadd_ps(a, b, c); }
FACTORS_INLINE V scaled(V a, V b) { return _mm512_mul_ps(a, b); }
FACTORS_INLINE V expand(const uint16_t* p) {
    return _mm512_cvtph_ps(_mm256_loadu_si256(reinterpret_cast<const __m256i*>(p)));
}
FACTORS_INLINE V expand(const float* p) { return load(p); }
FACTORS_INLINE V expand(const double* p) {
    const __m256 low = _mm512_cvtpd_ps(_mm512_loadu_pd(p));
    return _mm512_insertf32x8(_mm512_castps256_ps512(low), _mm512_cvtpd_ps(_mm512_loadu_pd(p + 8)), 1);
}
FACTORS_INLINE V exponential(V x) {
    const V n = _mm512_roundscale_ps(scaled(x, all(kLog2e)), _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC);
    const V r = fma(n, all(-kLn2Low), fma(n, all(-kLn2High), x));
    V p = all(kTaylor[7]);
#pragma GCC unroll 8
    for (int i = 6; i >= 0; --i) p = fma(p, r, all(kTaylor[i]));
    return _mm512_scalef_ps(p, n);
}
FACTORS_INLINE void turn(V* r) {
    V u[16];
#pragma GCC unroll 4
    for (int g = 0; g < 16; g += 4) {
        const __m512d a = _mm512_castps_pd(_mm512_unpacklo_ps(r[g], r[g + 1]));
        const __m512d b = _mm512_castps_pd(_mm512_unpackhi_ps(r[g], r[g + 1]));
        const __m512d c = _mm512_castps_pd(_mm512_unpacklo_ps(r[g + 2], r[g + 3]));
        const __m512d d = _mm512_castps_pd(_mm512_unpackhi_ps(r[g + 2], r[g + 3]));
        u[g] = _mm512_castpd_ps(_mm512_unpacklo_pd(a, c));
        u[g + 1] = _mm512_castpd_ps(_mm512_unpackhi_pd(a, c));
        u[g + 2] = _mm512_castpd_ps(_mm512_unpacklo_pd(b, d));
        u[g + 3] = _mm512_castpd_ps(_mm512_unpackhi_pd(b, d));
    }
#pragma GCC unroll 4
    for (int j = 0; j < 4; ++j) {
        const V a = _mm512_shuffle_f32x4(u[j], u[4 + j], 0x88);
        const V b = _mm512_shuffle_f32x4(u[8 + j], u[12 + j], 0x88);
        const V c = _mm512_shuffle_f32x4(u[j], u[4 + j], 0xdd);
        const V d = _mm512_shuffle_f32x4(u[8 + j], u[12 + j], 0xdd);
        r[j] = _mm512_shuffle_f32x4(a, b, 0x88);
        r[4 + j] = _mm512_shuffle_f32x4(c, d, 0x88);
        r[8 + j] = _mm512_shuffle_f32x4(a, b, 0xdd);
        r[12 + j] = _mm512_shuffle_f32x4(c, d, 0xdd);
    }
}
// Element m of the three vectors of 16 that hold r0 g0 b0 r1 ...: the channel is m % 3.
alignas(64) constexpr int kFirst[48] = {0, 16, 0, 1, 17, 0, 2, 18, 0, 3, 19, 0, 4, 20, 0, 5,
                                        21, 0, 6, 22, 0, 7, 23, 0, 8, 24, 0, 9, 25, 0, 10, 26,
                                        0, 11, 27, 0, 12, 28, 0, 13, 29, 0, 14, 30, 0, 15, 31, 0};
alignas(64) constexpr int kThen[48] = {0, 1, 16, 3, 4, 17, 6, 7, 18, 9, 10, 19, 12, 13, 20, 15,
                                       0, 21, 2, 3, 22, 5, 6, 23, 8, 9, 24, 11, 12, 25, 14, 15,
                                       26, 1, 2, 27, 4, 5, 28, 7, 8, 29, 10, 11, 30, 13, 14, 31};
FACTORS_INLINE void interleave(V r, V g, V b, float* out) {
#pragma GCC unroll 3
    for (int o = 0; o < 3; ++o) {
        const V two = _mm512_permutex2var_ps(r, _mm512_load_si512(kFirst + 16 * o), g);
        store(out + 16 * o, _mm512_permutex2var_ps(two, _mm512_load_si512(kThen + 16 * o), b));
    }
}
#elif FACTORS_LANES == 8
constexpr int kRows = 6;
using V = __m256;
FACTORS_INLINE V load(const float* p) { return _mm256_loadu_ps(p); }
FACTORS_INLINE void store(float* p, V v) { _mm256_storeu_ps(p, v); }
FACTORS_INLINE V all(float x) { return _mm256_set1_ps(x); }
FACTORS_INLINE V fma(V a, V b, V c) { return _mm256_fmadd_ps(a, b, c); }
FACTORS_INLINE V scaled(V a, V b) { return _mm256_mul_ps(a, b); }
FACTORS_INLINE V expand(const uint16_t* p) {
    return _mm256_cvtph_ps(_mm_loadu_si128(reinterpret_cast<const __m128i*>(p)));
}
FACTORS_INLINE V expand(const float* p) { return load(p); }
FACTORS_INLINE V expand(const double* p) {
    return _mm256_set_m128(_mm256_cvtpd_ps(_mm256_loadu_pd(p + 4)), _mm256_cvtpd_ps(_mm256_loadu_pd(p)));
}
FACTORS_INLINE V exponential(V x) {
    // The second operand is taken where the first is NaN.
    x = _mm256_max_ps(all(kLowest), _mm256_min_ps(all(kHighest), x));
    const V n = _mm256_round_ps(scaled(x, all(kLog2e)), _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC);
    const V r = fma(n, all(-kLn2Low), fma(n, all(-kLn2High), x));
    V p = all(kTaylor[7]);
#pragma GCC unroll 8
    for (int i = 6; i >= 0; --i) p = fma(p, r, all(kTaylor[i]));
    // In two steps: 2^n alone may leave the range where the result does not.
    const __m256i whole = _mm256_cvtps_epi32(n), half = _mm256_srai_epi32(whole, 1);
    const __m256i bias = _mm256_set1_epi32(127);
    const __m256i first = _mm256_slli_epi32(_mm256_add_epi32(half, bias), 23);
    const __m256i rest = _mm256_slli_epi32(_mm256_add_epi32(_mm256_sub_epi32(whole, half), bias), 23);
    return scaled(scaled(p, _mm256_castsi256_ps(first)), _mm256_castsi256_ps(rest));
}
FACTORS_INLINE void turn(V* r) {
    V u[8];
#pragma GCC unroll 2
    for (int g = 0; g < 8; g += 4) {
        const __m256d a = _mm256_castps_pd(_mm256_unpacklo_ps(r[g], r[g + 1]));
        const __m256d b = _mm256_castps_pd(_mm256_unpackhi_ps(r[g], r[g + 1]));
        const __m256d c = _mm256_castps_pd(_mm256_unpacklo_ps(r[g + 2], r[g + 3]));
        const __m256d d = _mm256_castps_pd(_mm256_unpackhi_ps(r[g + 2], r[g + 3]));
        u[g] = _mm256_castpd_ps(_mm256_unpacklo_pd(a, c));
        u[g + 1] = _mm256_castpd_ps(_mm256_unpackhi_pd(a, c));
        u[g + 2] = _mm256_castpd_ps(_mm256_unpacklo_pd(b, d));
        u[g + 3] = _mm256_castpd_ps(_mm256_unpackhi_pd(b, d));
    }
#pragma GCC unroll 4
    for (int j = 0; j < 4; ++j) {
        r[j] = _mm256_permute2f128_ps(u[j], u[4 + j], 0x20);
        r[4 + j] = _mm256_permute2f128_ps(u[j], u[4 + j], 0x31);
    }
}
FACTORS_INLINE void interleave(V r, V g, V b, float* out) {
    // Element m of the three vectors that hold r0 g0 b0 r1 ... is texel m / 3.
    const V r0 = _mm256_permutevar8x32_ps(r, _mm256_setr_epi32(0, 0, 0, 1, 1, 1, 2, 2));
    const V g0 = _mm256_permutevar8x32_ps(g, _mm256_setr_epi32(0, 0, 0, 1, 1, 1, 2, 2));
    const V b0 = _mm256_permutevar8x32_ps(b, _mm256_setr_epi32(0, 0, 0, 1, 1, 1, 2, 2));
    store(out, _mm256_blend_ps(_mm256_blend_ps(r0, g0, 0x92), b0, 0x24));
    const V r1 = _mm256_permutevar8x32_ps(r, _mm256_setr_epi32(2, 3, 3, 3, 4, 4, 4, 5));
    const V g1 = _mm256_permutevar8x32_ps(g, _mm256_setr_epi32(2, 3, 3, 3, 4, 4, 4, 5));
    const V b1 = _mm256_permutevar8x32_ps(b, _mm256_setr_epi32(2, 3, 3, 3, 4, 4, 4, 5));
    store(out + 8, _mm256_blend_ps(_mm256_blend_ps(r1, g1, 0x24), b1, 0x49));
    const V r2 = _mm256_permutevar8x32_ps(r, _mm256_setr_epi32(5, 5, 6, 6, 6, 7, 7, 7));
    const V g2 = _mm256_permutevar8x32_ps(g, _mm256_setr_epi32(5, 5, 6, 6, 6, 7, 7, 7));
    const V b2 = _mm256_permutevar8x32_ps(b, _mm256_setr_epi32(5, 5, 6, 6, 6, 7, 7, 7));
    store(out + 16, _mm256_blend_ps(_mm256_blend_ps(r2, g2, 0x49), b2, 0x92));
}
#else
constexpr int kRows = 6;
struct V {
    float lane[kLanes];
};
#define FACTORS_LANEWISE(result, expression) \
    V result;                                \
    for (int i = 0; i < kLanes; ++i) result.lane[i] = (expression);
FACTORS_INLINE V load(const float* p) {
    V v;
    std::memcpy(v.lane, p, sizeof v.lane);
    return v;
}
FACTORS_INLINE void store(float* p, V v) { std::memcpy(p, v.lane, sizeof v.lane); }
FACTORS_INLINE V all(float x) { FACTORS_LANEWISE(v, x) return v; }
FACTORS_INLINE V fma(V a, V b, V c) {
    FACTORS_LANEWISE(v, a.lane[i] * b.lane[i] + c.lane[i])
    return v;
}
FACTORS_INLINE V scaled(V a, V b) { FACTORS_LANEWISE(v, a.lane[i] * b.lane[i]) return v; }
template <class T>
FACTORS_INLINE V expand(const T* p) {
    T raw[kLanes];
    std::memcpy(raw, p, sizeof raw);
    FACTORS_LANEWISE(v, widened(raw[i]))
    return v;
}
FACTORS_INLINE V exponential(V x) { FACTORS_LANEWISE(v, std::exp(x.lane[i])) return v; }
FACTORS_INLINE void turn(V* r) {
    for (int i = 0; i < kLanes; ++i)
        for (int j = i + 1; j < kLanes; ++j) std::swap(r[i].lane[j], r[j].lane[i]);
}
FACTORS_INLINE void interleave(V r, V g, V b, float* out) {
    for (int i = 0; i < kLanes; ++i, out += 3) {
        out[0] = r.lane[i];
        out[1] = g.lane[i];
        out[2] = b.lane[i];
    }
}
#undef FACTORS_LANEWISE
#endif

// scale * (exp(v) - 1e-5) or scale * v; 0 times what is not finite makes it NaN.
FACTORS_INLINE V finished(V v, V scale, bool log) {
    v = fma(v, all(0.0f), v);
    if (log) v = fma(exponential(v), all(1.0f), all(-kEpsilon));
    v = scaled(v, scale);
    return fma(v, all(0.0f), v);
}

// Numbers first .. first + kLanes of a row, zero past its end.
template <class T>
FACTORS_INLINE V part(const uint8_t* row, int64_t first, int64_t k) {
    const uint8_t* p = row + first * sizeof(T);
    if (first + kLanes <= k) return expand(reinterpret_cast<const T*>(p));
    T rest[kLanes] = {};
    std::memcpy(rest, p, (k - first) * sizeof(T));
    return expand(static_cast<const T*>(rest));
}

// Rows of texels (kTile of them) to (k, kTile) numbers.
template <class T>
FACTORS_TARGET static void pack(const uint8_t* const* rows, int64_t k, float* out) {
    V block[kLanes];
    for (int64_t first = 0; first < k; first += kLanes)
        for (int half = 0; half < kTile; half += kLanes) {
            for (int i = 0; i < kLanes; ++i) block[i] = part<T>(rows[half + i], first, k);
            turn(block);
            const int count = int(std::min<int64_t>(kLanes, k - first));
            for (int j = 0; j < count; ++j) store(out + (first + j) * kTile + half, block[j]);
        }
}

// ROWS rows of images (k, ROWS) times texels (k, kTile): (ROWS, kTile).
template <int ROWS>
FACTORS_INLINE void multiply(const float* a, const float* b, int64_t k, V (&sum)[ROWS][2]) {
#pragma GCC unroll 16
    for (int r = 0; r < ROWS; ++r) sum[r][0] = sum[r][1] = all(0.0f);
    for (int64_t i = 0; i < k; ++i, a += ROWS, b += kTile) {
        const V left = load(b), right = load(b + kLanes);
#pragma GCC unroll 16
        for (int r = 0; r < ROWS; ++r) {
            const V x = all(a[r]);
            sum[r][0] = fma(x, left, sum[r][0]);
            sum[r][1] = fma(x, right, sum[r][1]);
        }
    }
}

// Finish rows start .. start + ROWS and put texels first .. first + count of them into images.
template <int ROWS>
FACTORS_INLINE void deliver(const Images& job, int64_t start, int64_t first, int64_t count, V (&sum)[ROWS][2]) {
    const int64_t c = job.channels;
    const float* scale = job.scale + start;
#pragma GCC unroll 16
    for (int r = 0; r < ROWS; ++r)
#pragma GCC unroll 2
        for (int half = 0; half < 2; ++half) sum[r][half] = finished(sum[r][half], all(scale[r]), job.log);
    float spare[3 * kTile];
    if (c == 3) {
#pragma GCC unroll 8
        for (int r = 0; r < ROWS; r += 3) {
            const int64_t image = (start + r) / 3;
            if (image >= job.images) return;
            float* out = job.out + (image * job.texels + first) * 3;
            float* to = count == kTile ? out : spare;
            interleave(sum[r][0], sum[r + 1][0], sum[r + 2][0], to);
            interleave(sum[r][1], sum[r + 1][1], sum[r + 2][1], to + 3 * kLanes);
            if (to == spare) std::memcpy(out, spare, sizeof(float) * 3 * count);
        }
        return;
    }
#pragma GCC unroll 16
    for (int r = 0; r < ROWS; ++r) {
        const int64_t image = (start + r) / c, channel = (start + r) % c;
        if (image >= job.images) return;
        float* out = job.out + (image * job.texels + first) * c + channel;
        float* to = c == 1 && count == kTile ? out : spare;
        store(to, sum[r][0]);
        store(to + kLanes, sum[r][1]);
        if (to == spare)
            for (int64_t i = 0; i < count; ++i) out[i * c] = spare[i];
    }
}

template <int ROWS>
FACTORS_INLINE void group(const Images& job, int64_t start, int64_t first, int64_t count, const float* packed) {
    V sum[ROWS][2];
    multiply<ROWS>(job.left + start * job.k, packed, job.k, sum);
    deliver<ROWS>(job, start, first, count, sum);
}

template <class T>
FACTORS_TARGET static void images(const Images& job, std::atomic<int64_t>& next, float* packed) {
    const uint8_t* rows[kTile];
    const int64_t tiles = (job.texels + kTile - 1) / kTile, k = job.k;
    for (int64_t tile; (tile = next.fetch_add(1)) < tiles;) {
        const int64_t first = tile * kTile, count = std::min<int64_t>(kTile, job.texels - first);
        for (int64_t i = 0; i < kTile; ++i) {
            const int64_t texel = first + std::min(i, count - 1);
            rows[i] = job.right + (job.down[texel / job.width] + job.along[texel % job.width]) * k * int64_t(sizeof(T));
        }
        pack<T>(rows, k, packed);
        const int64_t whole = job.rows / kRows * kRows;
        for (int64_t start = 0; start < whole; start += kRows) group<kRows>(job, start, first, count, packed);
        switch (rest(job.rows, kRows)) {
            case 3: group<3>(job, whole, first, count, packed); break;
            case 6: group<6>(job, whole, first, count, packed); break;
            case 12: group<12>(job, whole, first, count, packed); break;
            default: break;
        }
    }
}

template <class L, class R>
FACTORS_TARGET static void values(const Values& job, int64_t from, int64_t to) {
    const int64_t k = job.k, wide = k * sizeof(L), high = k * sizeof(R);
    V x[kLanes], y[kLanes];
    float scale[kLanes] = {}, found[kLanes];
    for (int64_t first = from; first < to; first += kLanes) {
        const int64_t count = std::min<int64_t>(kLanes, to - first);
        const uint8_t *left[kLanes], *right[kLanes];
        for (int64_t q = 0; q < kLanes; ++q) {
            const int64_t at = first + std::min(q, count - 1);
            left[q] = job.left + job.i[at] * wide;
            right[q] = job.right + job.j[at] * high;
            scale[q] = job.scale[at];
        }
        for (int64_t at = first + kLanes; at < std::min(to, first + 2 * kLanes); ++at) {
            for (int64_t n = 0; n < high; n += 64) __builtin_prefetch(job.right + job.j[at] * high + n);
            for (int64_t n = 0; n < wide; n += 64) __builtin_prefetch(job.left + job.i[at] * wide + n);
        }
        V sum = all(0.0f);
        for (int64_t start = 0; start < k; start += kLanes) {
            for (int q = 0; q < kLanes; ++q) x[q] = part<L>(left[q], start, k);
            turn(x);
            for (int q = 0; q < kLanes; ++q) y[q] = part<R>(right[q], start, k);
            turn(y);
            const int terms = int(std::min<int64_t>(kLanes, k - start));
            for (int n = 0; n < terms; ++n) sum = fma(x[n], y[n], sum);
        }
        store(found, finished(sum, load(scale), job.log));
        std::memcpy(job.out + first, found, sizeof(float) * count);
    }
}

#undef FACTORS_INLINE

}  // namespace factors::FACTORS_SPACE
