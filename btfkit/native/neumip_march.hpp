// View rays through a texture of heights: included after neumip_lookup.hpp, once a variant.

constexpr int kMarch = 16;         // looks at most along a ray
constexpr float kSteepest = 0.1f;  // lowest cosine of a ray
constexpr float kFlattest = 0.3f;  // a ray that grazes the surface moves its crossing no faster

#if NEUMIP_LANES == 16
FN F gathered(const float* p, I at) { return (F)_mm512_i32gather_ps((__m512i)at, p, 4); }
FN bool any_of(I mask) { return _mm512_movepi32_mask((__m512i)mask) != 0; }
#elif NEUMIP_LANES == 8
FN F gathered(const float* p, I at) { return (F)_mm256_i32gather_ps(p, (__m256i)at, 4); }
FN bool any_of(I mask) { return _mm256_movemask_ps((__m256)mask) != 0; }
#else
FN F gathered(const float* p, I at) {
    F x;
    for (int i = 0; i < L; ++i) x[i] = p[at[i]];
    return x;
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

    MEMBER Corners around(F u, F v) const {
        return corners_of(u, v, all(w), all(h), I{}, wrap);
    }
    MEMBER F at(F u, F v) const {
        const Corners c = around(u, v);
        const F a = gathered(heights, c.at[0]), b = gathered(heights, c.at[2]);
        const F upper = a + (gathered(heights, c.at[1]) - a) * c.fx;
        const F lower = b + (gathered(heights, c.at[3]) - b) * c.fx;
        return upper + (lower - upper) * c.fy;
    }
    // Height at which rays first meet the surface; (du, dv) is their way in uv a unit of height.
    MEMBER F crossing(F u, F v, F du, F dv) const {
        const F size_u = du < all(0.f) ? -du : du, size_v = dv < all(0.f) ? -dv : dv;
        const float rise = top - bottom;
        const F texels = larger(size_u * w, size_v * h) * rise;
        // ceil, 1 to kMarch
        const F count = smaller(larger(-floor_of(-texels), all(1.f)), all(float(kMarch)));
        const F part = 1.f / count;
        F t = all(top), met = all(bottom);
        F gap = t - at(u + t * du, v + t * dv);
        I going = ~I{};
        for (int k = 1; k <= kMarch; ++k) {
            const F to = top - rise * smaller(float(k) * part, all(1.f));
            const F below = to - at(u + to * du, v + to * dv);
            const I here = going & (below <= all(0.f));
            const F share = gap / larger(gap - below, all(1e-12f));
            met = select(here, t + (to - t) * share, met);
            going &= ~here;
            if (!any_of(going)) break;
            t = to;
            gap = below;
        }
        return met;
    }
};

// Adds to the gradient of the heights what the heights of the crossings are to move.
// place: where rays meet the surface; along: (du, dv) of each; slope: gradient of the height.
DEEP void scatter_heights(const Surface& s, const float* u, const float* v, const float* du,
                          const float* dv, const float* slope, int n, int valid, Gradient& g) {
    for (int i = 0; i < n; i += L) {
        const Corners c = s.around(load(u + i), load(v + i));
        F h[4];
        for (int j = 0; j < 4; ++j) h[j] = gathered(s.heights, c.at[j]);
        const F gu = ((h[1] - h[0]) * (1.f - c.fy) + (h[3] - h[2]) * c.fy) * s.w;
        const F gv = ((h[2] - h[0]) * (1.f - c.fx) + (h[3] - h[1]) * c.fx) * s.h;
        const F clear = 1.f - gu * load(du + i) - gv * load(dv + i);
        const F d = load(slope + i) / larger(clear, all(kFlattest));
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
