// Vectors of one width and their mathematics: the first header of a variant. NEUMIP_SPACE (its
// namespace), NEUMIP_LANES (floats a vector) and NEUMIP_TARGET (what the compiler may use) are
// defined by then.
// clang-format off
#define FN NEUMIP_TARGET static inline __attribute__((always_inline))
#define MEMBER NEUMIP_TARGET inline __attribute__((always_inline))
#define DEEP NEUMIP_TARGET static __attribute__((noinline))
// clang-format on

namespace neumip {
namespace NEUMIP_SPACE {

constexpr int L = NEUMIP_LANES;
typedef float F __attribute__((vector_size(4 * NEUMIP_LANES), may_alias));
typedef int32_t I __attribute__((vector_size(4 * NEUMIP_LANES), may_alias));
typedef float V8 __attribute__((vector_size(32), may_alias, aligned(4)));

FN F load(const float* p) { return *(const F*)p; }
FN void store(float* p, F v) { *(F*)p = v; }
FN F all(float x) { return x - F{}; }  // x + 0 would not fold: it turns -0 into 0
FN F select(I mask, F a, F b) { return (F)((mask & (I)a) | (~mask & (I)b)); }
// larger and smaller give b where a is not a number.
#if NEUMIP_LANES == 16
FN F larger(F a, F b) { return (F)_mm512_max_ps((__m512)a, (__m512)b); }
FN F smaller(F a, F b) { return (F)_mm512_min_ps((__m512)a, (__m512)b); }
FN F root(F x) { return (F)_mm512_sqrt_ps((__m512)x); }
FN F nearest(F x) { return (F)_mm512_roundscale_ps((__m512)x, 0); }
FN F floor_of(F x) { return (F)_mm512_roundscale_ps((__m512)x, 1); }
#elif NEUMIP_LANES == 8
FN F larger(F a, F b) { return (F)_mm256_max_ps((__m256)a, (__m256)b); }
FN F smaller(F a, F b) { return (F)_mm256_min_ps((__m256)a, (__m256)b); }
FN F root(F x) { return (F)_mm256_sqrt_ps((__m256)x); }
FN F nearest(F x) { return (F)_mm256_round_ps((__m256)x, 8); }
FN F floor_of(F x) { return (F)_mm256_round_ps((__m256)x, 9); }
#else
FN F larger(F a, F b) { return a > b ? a : b; }
FN F smaller(F a, F b) { return a < b ? a : b; }
FN F root(F x) {
    for (int i = 0; i < L; ++i) x[i] = __builtin_sqrtf(x[i]);
    return x;
}
FN F nearest(F x) {  // |x| < 2^22; beyond, x itself, which has next to no fraction left
    const F magic = all(12582912.f), size = x < all(0.f) ? -x : x;
    return size < all(4194304.f) ? (x + magic) - magic : x;
}
FN F floor_of(F x) {
    const F r = nearest(x);
    return r - (r > x ? all(1.f) : all(0.f));
}
#endif

// exp for -87 <= x <= 88. Source: Cephes expf.
FN F exp_of(F x) {
    x = smaller(larger(x, all(-87.f)), all(88.f));
    const F n = nearest(x * 1.44269504088896341f);
    x = x - n * 0.693359375f;
    x = x + n * 2.12194440e-4f;
    F y = all(1.9875691500e-4f);
    y = y * x + 1.3981999507e-3f;
    y = y * x + 8.3334519073e-3f;
    y = y * x + 4.1665795894e-2f;
    y = y * x + 1.6666665459e-1f;
    y = y * x + 5.0000001201e-1f;
    y = y * x * x + x + 1.f;
    const I scale = (__builtin_convertvector(n, I) + 127) << 23;
    return y * (F)scale;
}

// Natural logarithm of normal x > 0. Source: Cephes logf.
FN F log_of(F x) {
    const I bits = (I)x;
    I e = ((bits >> 23) & 255) - 126;
    F m = (F)((bits & 0x007fffff) | 0x3f000000);
    const I low = m < all(0.707106781f);
    e = e + low;  // a true mask is -1
    m = m + select(low, m, all(0.f)) - 1.f;
    const F z = m * m;
    F y = all(7.0376836292e-2f);
    y = y * m - 1.1514610310e-1f;
    y = y * m + 1.1676998740e-1f;
    y = y * m - 1.2420140846e-1f;
    y = y * m + 1.4249322787e-1f;
    y = y * m - 1.6668057665e-1f;
    y = y * m + 2.0000714765e-1f;
    y = y * m - 2.4999993993e-1f;
    y = y * m + 3.3333331174e-1f;
    const F n = __builtin_convertvector(e, F);
    y = y * m * z - n * 2.12194440e-4f - z * 0.5f;
    return m + y + n * 0.693359375f;
}

// sin and cos of 2 pi u for |u| <= 1/2, to 1e-7 and 1e-8: least squares on Chebyshev nodes.
FN F sine_of_turn(F u) {
    const F q = u * u;
    F p = all(12.23593025532227f);
    p = p * q - 38.12418001627253f;
    p = p * q + 67.04401210989847f;
    p = p * q - 64.83468551736061f;
    p = p * q + 25.132730419927455f;
    return p * (u * (0.25f - q));
}
FN F cosine_of_turn(F u) {
    const F q = u * u;
    F p = all(-6.541494115107186f);
    p = p * q + 25.568783955332695f;
    p = p * q - 58.572515169836485f;
    p = p * q + 81.78974748812098f;
    p = p * q - 59.82728047212572f;
    p = p * q + 15.999999837185692f;
    return p * (0.0625f - q);
}

FN V8 get8(const float* p) { return *(const V8*)p; }
FN void put8(float* p, V8 v) { *(V8*)p = v; }

// Eight rows of eight, transposed.
FN void transpose8(V8 r[8]) {
    V8 t[8], s[8];
#pragma GCC unroll 8
    for (int i = 0; i < 8; i += 2) {
        t[i] = __builtin_shufflevector(r[i], r[i + 1], 0, 8, 1, 9, 4, 12, 5, 13);
        t[i + 1] = __builtin_shufflevector(r[i], r[i + 1], 2, 10, 3, 11, 6, 14, 7, 15);
    }
#pragma GCC unroll 8
    for (int i = 0; i < 8; i += 4) {
        s[i] = __builtin_shufflevector(t[i], t[i + 2], 0, 1, 8, 9, 4, 5, 12, 13);
        s[i + 1] = __builtin_shufflevector(t[i], t[i + 2], 2, 3, 10, 11, 6, 7, 14, 15);
        s[i + 2] = __builtin_shufflevector(t[i + 1], t[i + 3], 0, 1, 8, 9, 4, 5, 12, 13);
        s[i + 3] = __builtin_shufflevector(t[i + 1], t[i + 3], 2, 3, 10, 11, 6, 7, 14, 15);
    }
#pragma GCC unroll 8
    for (int i = 0; i < 4; ++i) {
        r[i] = __builtin_shufflevector(s[i], s[i + 4], 0, 1, 2, 3, 8, 9, 10, 11);
        r[i + 4] = __builtin_shufflevector(s[i], s[i + 4], 4, 5, 6, 7, 12, 13, 14, 15);
    }
}

FN float sum_of(F v) {
#if NEUMIP_LANES == 16
    typedef float H8 __attribute__((vector_size(32)));
    H8 a = __builtin_shufflevector(v, v, 0, 1, 2, 3, 4, 5, 6, 7) +
           __builtin_shufflevector(v, v, 8, 9, 10, 11, 12, 13, 14, 15);
#else
    const F a = v;
#endif
    typedef float H4 __attribute__((vector_size(16)));
#if NEUMIP_LANES >= 8
    H4 b = __builtin_shufflevector(a, a, 0, 1, 2, 3) + __builtin_shufflevector(a, a, 4, 5, 6, 7);
#else
    H4 b = a;
#endif
    b = b + __builtin_shufflevector(b, b, 2, 3, 2, 3);
    return b[0] + b[1];
}
