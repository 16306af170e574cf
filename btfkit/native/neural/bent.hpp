// View rays through heights on a curved surface: included after march.hpp, once a variant. The
// formulas and what the names mean: bent.py, whose twin this is. Lengths in units of the heights.

// asin(x) / x of x x, |x| <= 1: least squares on Chebyshev nodes to 1e-8 up to 1/2, and beyond
// asin x = pi/2 - 2 asin sqrt((1 - x) / 2).
FN F arc_of(F q) {
    F p = all(0.0425535999f);
    p = p * q + 0.0239093639f;
    p = p * q + 0.0455390103f;
    p = p * q + 0.0749453455f;
    p = p * q + 0.166666667f;
    return p * q + 1.f;
}
FN F arc_over_sine(F x) {
    const F size = smaller(x < all(0.f) ? -x : x, all(1.f));
    const F half = (1.f - size) * 0.5f, side = root(half);
    const F wide = (1.57079632679f - 2.f * side * arc_of(half)) / larger(size, all(0.5f));
    return select(size > all(0.5f), wide, arc_of(size * size));
}
// sin(x) / x and cos(x) for |x| <= pi/2, of x x: as above, to 2e-8.
FN F sinc_of(F q) {
    F p = all(-2.38893847e-8f);
    p = p * q + 2.75252819e-6f;
    p = p * q - 1.98408612e-4f;
    p = p * q + 8.33333097e-3f;
    p = p * q - 0.166666667f;
    return p * q + 1.f;
}
FN F cosine_of(F q) {
    F p = all(1.99075889e-9f);
    p = p * q - 2.75246776e-7f;
    p = p * q + 2.48010401e-5f;
    p = p * q - 1.38888846e-3f;
    p = p * q + 4.16666679e-2f;
    p = p * q - 0.5f;
    return p * q + 1.f;
}

constexpr float kLeastSine = 1e-6f, kLeastBend = 1e-9f, kLeastDepth = 1e-6f, kLeastHalf = 1e-6f;

struct Ray {
    F bend, sine, cosine, share, start, stop, part;
    I reaches;

    MEMBER F way_to(float height) const {
        const F lift = bend * height;
        const F square = cosine * cosine + lift * (2.f + lift);
        const F side = root(larger(square, all(0.f)));
        const F there = -height * (2.f + lift) * sine /
                        ((1.f + lift) * larger(cosine + side, all(1e-9f)));
        const I missed = square < all(0.f);
        const F straight = select(missed, cosine / select(missed, bend, all(1.f)), there);
        return straight * arc_over_sine(bend * straight);
    }
    MEMBER F height_at(F way) const {
        const F half = bend * way * 0.5f, q = half * half;
        const F c = cosine_of(q), sinc = sinc_of(q), s = half * sinc;
        const F middle = cosine * c - sine * s;
        const F end = sine * (c * c - s * s) + cosine * (2.f * s * c);
        return -way * sinc * middle / larger(end, all(1e-9f));
    }
    // How fast the ray falls towards the surface there: -dz/ds.
    MEMBER F falling(F way) const {
        const F half = bend * way * 0.5f, q = half * half;
        const F c = cosine_of(q), s = half * sinc_of(q);
        const F c2 = c * c - s * s, s2 = 2.f * s * c;
        const F at = cosine * c2 - sine * s2, end = sine * c2 + cosine * s2;
        return (1.f + bend * height_at(way)) * at / larger(end, all(1e-9f));
    }
};

// x, y, z: of the view; k: curvature a unit of heights.
FN Ray ray_of(const Surface& s, F x, F y, F z, F k) {
    const float top = s.top > 0.f ? s.top : 0.f, bottom = s.bottom < 0.f ? s.bottom : 0.f;
    const float least = -kMostBend / (top > kLeastDepth ? top : kLeastDepth);
    const float most = kMostBend / (-bottom > kLeastDepth ? -bottom : kLeastDepth);
    Ray r;
    const F size = k < all(0.f) ? -k : k;
    r.bend = select(size < all(kLeastBend), all(0.f), smaller(larger(k, all(least)), all(most)));
    const F flat = larger(root(x * x + y * y), all(kLeastSine));
    const F lift = r.bend * bottom;
    r.reaches = z * z + lift * (2.f + lift) >= all(0.f);
    r.cosine = select(r.reaches, larger(z, all(kSteepest)), z);
    const F part = 1.f / root(flat * flat + r.cosine * r.cosine);
    r.sine = flat * part;
    r.cosine = r.cosine * part;
    r.share = larger(z, all(kLowestCosine)) / flat;
    r.start = r.way_to(top);
    const F turn = smaller(r.cosine, all(1.f));
    const F through = 2.f * turn * arc_over_sine(turn);
    const F leaves = through / select(r.reaches, all(1.f), r.bend);
    r.stop = select(r.reaches, r.way_to(bottom), leaves - r.start);
    r.part = r.bend / larger(through, all(2.f * kLeastHalf));
    return r;
}

// How rays drift off the circle, by their share of the way through.
struct Drift {
    F side0, side1, skew0, skew1, u, v;  // (u, v): in uv for a tile width to the side

    MEMBER F over_way(F x) const { return (1.f - x) * (side0 + side1 * x); }
    MEMBER F side(F x) const { return x * over_way(x); }
    MEMBER F scale(F x) const { return 1.f + (x - 0.5f) * (skew0 + skew1 * x); }
};

// How far rays are above the surface where their way is `way` and the circle's height z.
template <bool DRIFTS>
FN F gap_of(const Surface& surface, const Ray& r, const Drift& d, F z, F way, F u, F v, F du, F dv) {
    u += way * du;
    v += way * dv;
    if (DRIFTS) {
        const F x = way * r.part, side = d.side(x);
        z *= d.scale(x);
        u += side * d.u;
        v += side * d.v;
    }
    return surface.gap(z, u, v);
}

// Share of the way from a gap above the surface to one below it at which there is none.
FN F between(F gap, F under) {
    const F share = gap / larger(gap - under, all(1e-12f));
    return smaller(larger(share, all(0.f)), all(1.f));
}

// Way over the surface where rays first meet it; `opaque` tells those that do. (du, dv) is the
// step in uv of a unit of way.
template <bool DRIFTS>
FN F meet_bent(const Surface surface, const Ray& r, const Drift& d, F u, F v, F du, F dv,
               I& opaque) {
    const F size_u = du < all(0.f) ? -du : du, size_v = dv < all(0.f) ? -dv : dv;
    const F length = r.stop - r.start;
    const I sure = surface.opacity ? I{} : r.reaches;  // what it reaches may be a hole
    const F texels = larger(size_u * surface.w, size_v * surface.h) * length *
                     select(sure, all(1.f), all(kCurvedFiner));
    const F looks = select(sure, all(float(kLooks)), all(float(surface.looks)));
    const F count = smaller(larger(-floor_of(-texels), all(1.f)), looks);
    const F step = length / count;
    // From look to look the angle turns by twice `half`.
    const F half = r.bend * step * 0.5f, q = half * half;
    const F c1 = cosine_of(q), sinc = sinc_of(q), s1 = half * sinc;
    const F c2 = c1 * c1 - s1 * s1, s2 = 2.f * s1 * c1;
    const F fall = step * sinc;
    F sine, cosine, drop;  // of the angle at the last look; its height times that sine
    {
        const F begun = r.bend * r.start * 0.5f, p = begun * begun;
        const F c = cosine_of(p), part = sinc_of(p), s = begun * part;
        drop = -r.start * part * (r.cosine * c - r.sine * s);
        const F cc = c * c - s * s, ss = 2.f * s * c;
        sine = r.sine * cc + r.cosine * ss;
        cosine = r.cosine * cc - r.sine * ss;
    }
    F high = r.start, low = high;
    F gap = gap_of<DRIFTS>(surface, r, d, drop / larger(sine, all(1e-9f)), high, u, v, du, dv);
    F under = gap;
    F near = high, least = all(INFINITY);  // where a ray passes closest by, and by how much
    I going = ~I{};
    const int most = surface.looks > kLooks ? surface.looks : kLooks;
    for (int k = 1; k <= most; ++k) {
        high = select(going, low, high);
        gap = select(going, under, gap);
        drop -= fall * (cosine * c1 - sine * s1);
        const F turned = sine * c2 + cosine * s2;
        cosine = cosine * c2 - sine * s2;
        sine = turned;
        const F to = r.start + step * float(k);
        const F z = drop / larger(sine, all(1e-9f));
        const F rest = gap_of<DRIFTS>(surface, r, d, z, to, u, v, du, dv);
        low = select(going, to, low);
        under = select(going, rest, under);
        going &= (rest > all(0.f)) & (float(k) < count);
        if (!any_of(going)) break;
        const I nearer = going & (rest < least);
        near = select(nearer, to, near);
        least = select(nearer, rest, least);
    }
    const I passes = ~sure & (under > all(0.f)) & (least < all(INFINITY));
    if (any_of(passes)) {
        const auto look = [&](F way) NEUMIP_TARGET {
            return gap_of<DRIFTS>(surface, r, d, r.height_at(way), way, u, v, du, dv);
        };
        const F half = step * 0.5f, before = look(near - half), after = look(near + half);
        const I ahead = after < before;
        const F side = near + select(ahead, half, -half) * 0.5f, beside = look(side);
        const auto take = [&](F way, F found, F from, F gap_there) NEUMIP_TARGET {
            const I hit = passes & (found <= all(0.f));
            low = select(hit, way, low);
            under = select(hit, found, under);
            high = select(hit, from, high);
            gap = select(hit, gap_there, gap);
        };
        // The last counts: what is nearest to the viewer.
        take(near + half, after, near, least);
        take(side, beside, select(ahead, near, near - half), select(ahead, least, before));
        take(near - half, before, near - step, least);
    }
    opaque = sure | (under <= all(0.f));
    const F met = high + (low - high) * between(gap, under);
    const F rest = gap_of<DRIFTS>(surface, r, d, r.height_at(met), met, u, v, du, dv);
    const I above = rest > all(0.f);
    high = select(above, met, high);
    gap = select(above, rest, gap);
    low = select(above, low, met);
    under = select(above, under, rest);
    const F way = high + (low - high) * between(gap, under);
    return select(opaque, way, r.stop);
}
