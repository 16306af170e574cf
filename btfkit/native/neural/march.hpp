// View rays through a texture of heights: included after lookup.hpp, once a variant.

#if NEUMIP_LANES == 16
FN F gathered(const float* p, I at) { return (F)_mm512_i32gather_ps((__m512i)at, p, 4); }
// Floats at `at` and beside it: half as many loads as two gathers take.
FN void gathered_pair(const float* p, I at, F& left, F& right) {
    const __m512i i = (__m512i)at;
    const __m512 low = _mm512_castpd_ps(_mm512_i32gather_pd(_mm512_castsi512_si256(i), p, 4));
    const __m512 high = _mm512_castpd_ps(_mm512_i32gather_pd(_mm512_extracti64x4_epi64(i, 1), p, 4));
    const __m512i even = _mm512_setr_epi32(0, 2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 22, 24, 26, 28, 30);
    left = (F)_mm512_permutex2var_ps(low, even, high);
    right = (F)_mm512_permutex2var_ps(low, _mm512_or_si512(even, _mm512_set1_epi32(1)), high);
}
// Upper and lower halves of the 64 bits at `at`.
FN void gathered_halves(const uint64_t* p, I at, I& upper, I& lower) {
    const __m512i i = (__m512i)at;
    const __m512i low = _mm512_i32gather_epi64(_mm512_castsi512_si256(i), p, 8);
    const __m512i high = _mm512_i32gather_epi64(_mm512_extracti64x4_epi64(i, 1), p, 8);
    const __m512i even = _mm512_setr_epi32(0, 2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 22, 24, 26, 28, 30);
    lower = (I)_mm512_permutex2var_epi32(low, even, high);
    upper = (I)_mm512_permutex2var_epi32(low, _mm512_or_si512(even, _mm512_set1_epi32(1)), high);
}
FN bool any_of(I mask) { return _mm512_movepi32_mask((__m512i)mask) != 0; }
#elif NEUMIP_LANES == 8
FN F gathered(const float* p, I at) { return (F)_mm256_i32gather_ps(p, (__m256i)at, 4); }
FN void gathered_pair(const float* p, I at, F& left, F& right) {
    left = gathered(p, at);
    right = gathered(p, at + 1);
}
FN void gathered_halves(const uint64_t* p, I at, I& upper, I& lower) {
    const int* q = reinterpret_cast<const int*>(p);
    lower = (I)_mm256_i32gather_epi32(q, (__m256i)at, 8);
    upper = (I)_mm256_i32gather_epi32(q + 1, (__m256i)at, 8);
}
FN bool any_of(I mask) { return _mm256_movemask_ps((__m256)mask) != 0; }
#else
FN F gathered(const float* p, I at) {
    F x;
    for (int i = 0; i < L; ++i) x[i] = p[at[i]];
    return x;
}
FN void gathered_pair(const float* p, I at, F& left, F& right) {
    left = gathered(p, at);
    right = gathered(p, at + 1);
}
FN void gathered_halves(const uint64_t* p, I at, I& upper, I& lower) {
    for (int i = 0; i < L; ++i) {
        lower[i] = int32_t(p[at[i]]);
        upper[i] = int32_t(p[at[i]] >> 32);
    }
}
FN bool any_of(I mask) {
    int32_t some = 0;
    for (int i = 0; i < L; ++i) some |= mask[i];
    return some != 0;
}
#endif

struct Surface {
    const float* heights;
    float w, h, top, bottom;
    bool wrap;
    const float* opacity;  // of the heights, or null
    int looks;             // at most along a ray that may pass
    QuadView quads, cover_quads;  // the same, where `at` is not null

    MEMBER Corners around(F u, F v) const {
        return corners_of(u, v, all(w), all(h), I{}, wrap);
    }
    MEMBER F at(F u, F v) const { return read(heights, around(u, v)); }
    // How far a height z lies above what there is; in holes there is nothing.
    MEMBER F gap(F z, F u, F v) const {
        F height, cover;
        if (quads.at) {
            F fx, fy;
            const I at = quad_at(u, v, fx, fy);
            height = read_quad(quads, at, fx, fy);
            if (opacity) cover = read_quad(cover_quads, at, fx, fy);
        } else {
            const Corners c = around(u, v);
            height = read(heights, c);
            if (opacity) cover = read(opacity, c);
        }
        const F above = z - height;
        if (!opacity) return above;
        const float range = (top > 0.f ? top : 0.f) - (bottom < 0.f ? bottom : 0.f);
        const float rise = range > kLeastRange ? range : kLeastRange;
        return larger(above - kSlack * rise, (0.5f - cover) * rise);
    }
    // Which quad a place is in, and where: the first row and column lie before the texture.
    MEMBER I quad_at(F u, F v, F& fx, F& fy) const {
        F x = u, y = v;
        if (wrap) {
            x -= floor_of(x);
            y -= floor_of(y);
        }
        // Quads begin a texel before the texture.
        x = x * w + 0.5f;
        y = y * h + 0.5f;
        if (!wrap) {
            x = smaller(larger(x, all(0.f)), all(w));
            y = smaller(larger(y, all(0.f)), all(h));
        }
        const F x0 = floor_of(x), y0 = floor_of(y);
        fx = x - x0;
        fy = y - y0;
        const I at = __builtin_convertvector(y0, I) * (int32_t(w) + 1) + __builtin_convertvector(x0, I);
        // No index leaves the quads, whatever is no number.
        typedef uint32_t U __attribute__((vector_size(sizeof(I)), may_alias));
        const U last = U{} + uint32_t((int32_t(w) + 1) * (int32_t(h) + 1) - 1);
        return (I)((U)at < last ? (U)at : last);
    }
    MEMBER F read_quad(QuadView from, I at, F fx, F fy) const {
        I upper, lower;
        gathered_halves(from.at, at, upper, lower);
        typedef uint32_t U __attribute__((vector_size(sizeof(I)), may_alias));
        const F a = __builtin_convertvector(lower & 0xffff, F);
        const F b = __builtin_convertvector((I)((U)lower >> 16), F);
        const F c = __builtin_convertvector(upper & 0xffff, F);
        const F d = __builtin_convertvector((I)((U)upper >> 16), F);
        const F first = a + (b - a) * fx, second = c + (d - c) * fx;
        return from.low + from.step * (first + (second - first) * fy);
    }
    MEMBER F read(const float* from, const Corners& c) const {
        F h[4];
        if (!any_of(c.at[1] != c.at[0] + 1)) {
            gathered_pair(from, c.at[0], h[0], h[1]);
            gathered_pair(from, c.at[2], h[2], h[3]);
        } else {  // a lane at the border of the tile
            for (int j = 0; j < 4; ++j) h[j] = gathered(from, c.at[j]);
        }
        const F upper = h[0] + (h[1] - h[0]) * c.fx;
        const F lower = h[2] + (h[3] - h[2]) * c.fx;
        return upper + (lower - upper) * c.fy;
    }
    // Height at which rays first meet the surface; (du, dv) is their way in uv a unit of height.
    MEMBER F crossing(F u, F v, F du, F dv) const {
        const F size_u = du < all(0.f) ? -du : du, size_v = dv < all(0.f) ? -dv : dv;
        const float rise = top - bottom;
        const F texels = larger(size_u * w, size_v * h) * rise;
        // ceil, 1 to kLooks
        const F count = smaller(larger(-floor_of(-texels), all(1.f)), all(float(kLooks)));
        const F part = 1.f / count;
        // Between `high`, above the surface by `gap`, and `low`, below it by -`under`.
        F high = all(top), low = high;
        F gap = high - at(u + high * du, v + high * dv), under = gap;
        I going = ~I{};
        for (int k = 1; k <= kLooks; ++k) {
            high = select(going, low, high);
            gap = select(going, under, gap);
            const F to = top - rise * smaller(float(k) * part, all(1.f));
            const F found = to - at(u + to * du, v + to * dv);
            low = select(going, to, low);
            under = select(going, found, under);
            going &= found > all(0.f);
            if (!any_of(going)) break;
        }
        // Twice where a straight surface would be met.
        const F met = high + (low - high) * (gap / larger(gap - under, all(1e-12f)));
        const F rest = met - at(u + met * du, v + met * dv);
        const I above = rest > all(0.f);
        high = select(above, met, high);
        gap = select(above, rest, gap);
        low = select(above, low, met);
        under = select(above, under, rest);
        return high + (low - high) * (gap / larger(gap - under, all(1e-12f)));
    }
};

// Adds to the gradient of the heights what the heights of the crossings are to move.
// u, v: where rays meet the surface; du, dv: their way, of which the slopes of the surface are
// taken from `clear`, held at `least`; slope: gradient of the height.
DEEP void scatter_heights(const Surface& s, const float* u, const float* v, const float* du,
                          const float* dv, const float* clear, const float* least,
                          const float* slope, int n, int valid, Gradient& g) {
    for (int i = 0; i < n; i += L) {
        const Corners c = s.around(load(u + i), load(v + i));
        F h[4];
        for (int j = 0; j < 4; ++j) h[j] = gathered(s.heights, c.at[j]);
        const F gu = ((h[1] - h[0]) * (1.f - c.fy) + (h[3] - h[2]) * c.fy) * s.w;
        const F gv = ((h[2] - h[0]) * (1.f - c.fx) + (h[3] - h[1]) * c.fx) * s.h;
        const F clearance = load(clear + i) - gu * load(du + i) - gv * load(dv + i);
        const F d = load(slope + i) / larger(clearance, load(least + i));
        const F share[4] = {d * (1.f - c.fx) * (1.f - c.fy), d * c.fx * (1.f - c.fy),
                            d * (1.f - c.fx) * c.fy, d * c.fx * c.fy};
        for (int j = 0; j < 4; ++j)
            for (int q = 0; q < L && i + q < valid; ++q) {
                const int32_t at = c.at[j][q];
                g.texels[at] += share[j][q];
                g.touched[at / (2 * kChannels)] = 1;
            }
    }
}
