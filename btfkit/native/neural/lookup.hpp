// Lookups in textures, and gradients back into them: included after networks.hpp, once a variant.

// ---------------------------------------------------------------- texture lookups

// Four texels around a place, and the fractions between them.
struct Corners {
    F fx, fy;
    I at[4];  // row 0 col 0, row 0 col 1, row 1 col 0, row 1 col 1
};

// From u, v in tiles and per-query texture sizes (floats) and starts.
FN Corners corners_of(F u, F v, F w, F h, I start, bool wrap) {
    F x, y;
    if (wrap) {
        x = (u - floor_of(u)) * w - 0.5f;
        y = (v - floor_of(v)) * h - 0.5f;
    } else {
        x = u * w - 0.5f;
        y = v * h - 0.5f;
    }
    // Whatever is no number becomes a border here: no index leaves the texture.
    x = smaller(larger(x, all(-1.f)), w);
    y = smaller(larger(y, all(-1.f)), h);
    const F x0 = floor_of(x), y0 = floor_of(y);
    F xa = x0, xb = x0 + 1.f, ya = y0, yb = y0 + 1.f;
    if (wrap) {
        xa = xa < all(0.f) ? xa + w : xa;
        ya = ya < all(0.f) ? ya + h : ya;
        xa = xa >= w ? xa - w : xa;
        ya = ya >= h ? ya - h : ya;
        xb = xb >= w ? xb - w : xb;
        yb = yb >= h ? yb - h : yb;
        xb = xb >= w ? all(0.f) : xb;
        yb = yb >= h ? all(0.f) : yb;
    } else {
        xa = smaller(larger(xa, all(0.f)), w - 1.f);
        ya = smaller(larger(ya, all(0.f)), h - 1.f);
        xb = smaller(larger(xb, all(0.f)), w - 1.f);
        yb = smaller(larger(yb, all(0.f)), h - 1.f);
    }
    const I wi = __builtin_convertvector(w, I);
    const I ra = start + __builtin_convertvector(ya, I) * wi;
    const I rb = start + __builtin_convertvector(yb, I) * wi;
    const I ca = __builtin_convertvector(xa, I), cb = __builtin_convertvector(xb, I);
    return {x - x0, y - y0, {ra + ca, ra + cb, rb + ca, rb + cb}};
}

FN void corners(Lookup& k, int n, F u, F v, F w, F h, I start, bool wrap) {
    const Corners c = corners_of(u, v, w, h, start, wrap);
    store(k.fx + n, c.fx);
    store(k.fy + n, c.fy);
    for (int j = 0; j < 4; ++j) *(I*)(k.at[j] + n) = c.at[j];
}

DEEP void look_up_one(Lookup& k, const Texture& t, const float* u, const float* v, int first, int n,
                      bool wrap) {
    const F w = all(float(t.w)), h = all(float(t.h)), one = all(1.f);
    for (int i = 0; i < n; i += L) {
        corners(k, i, load(u + i), load(v + i), w, h, I{} + int32_t(t.start), wrap);
        store(k.weight + i, one);
        store(k.w + i, w);
        store(k.h + i, h);
    }
    for (int i = 0; i < n; ++i) k.query[i] = first + i;
    k.first = first;
    k.count = n;
}

struct Levels {
    alignas(64) float level[kTile];
    bool finest = true;  // every query of the tile is at level 0
};

// The two levels of a bank for every query; the second list holds only those between levels.
DEEP void look_up_levels(Lookup& a, Lookup& b, const Plan& plan, const Bank& bank,
                         const Levels& levels, const float* u, const float* v, int first, int n,
                         int valid) {
    alignas(64) float w0[kTile], h0[kTile], w1[kTile], h1[kTile], f1[kTile], u1[kTile], v1[kTile];
    alignas(64) int32_t s0[kTile], s1[kTile];
    int second = 0;
    const float top = float(bank.count - 1);
    const Texture* texture = plan.textures.data() + bank.first;
    for (int i = 0; i < n; ++i) {
        float l = levels.level[first + i] - bank.shift;
        l = l > 0.f ? l : 0.f;
        l = l < top ? l : top;
        const int at = int(l);
        const float f = l - float(at);
        const Texture& t0 = texture[at];
        w0[i] = float(t0.w);
        h0[i] = float(t0.h);
        s0[i] = int32_t(t0.start);
        a.weight[i] = 1.f - f;
        a.query[i] = first + i;
        const Texture& t1 = texture[at + (f > 0.f)];
        w1[second] = float(t1.w);
        h1[second] = float(t1.h);
        s1[second] = int32_t(t1.start);
        f1[second] = f;
        u1[second] = u[i];
        v1[second] = v[i];
        b.query[second] = first + i;
        second += f > 0.f && first + i < valid;
    }
    for (int i = second; i < (second + L - 1) / L * L; ++i) {
        w1[i] = h1[i] = 1.f;
        s1[i] = 0;
        u1[i] = v1[i] = f1[i] = 0.f;
    }
    auto finish = [&](Lookup& k, int count, const float* us, const float* vs, const float* ws,
                      const float* hs, const int32_t* starts) NEUMIP_TARGET {
        for (int i = 0; i < count; i += L) {
            const F w = load(ws + i), h = load(hs + i);
            corners(k, i, load(us + i), load(vs + i), w, h, *(const I*)(starts + i), plan.wrap);
            store(k.w + i, w);
            store(k.h + i, h);
        }
    };
    finish(a, n, u, v, w0, h0, s0);
    a.first = first;
    a.count = n;
    finish(b, second, u1, v1, w1, h1, s1);
    std::memcpy(b.weight, f1, sizeof(float) * second);
    b.count = second;
}

// Features of one bank for a tile: values, and in training their slopes along u and v.
struct Features {
    alignas(64) float value[kTile][kChannels], du[kTile][kChannels], dv[kTile][kChannels];
    Lookup list[2][2];  // first and second half of the tile; finer and coarser level
};

template <bool TRAIN, bool FIRST>
DEEP void fetch(const Lookup& k, const float* texels, Features& out) {
    for (int i = 0; i < k.count; ++i) {
        const int ahead = i + kAhead < k.count ? i + kAhead : i;
        for (int c = 0; c < 4; ++c) __builtin_prefetch(texels + size_t(k.at[c][ahead]) * kChannels);
        const int q = FIRST ? k.first + i : k.query[i];
        const float fx = k.fx[i], fy = k.fy[i], w = k.weight[i];
        const V8 t00 = get8(texels + size_t(k.at[0][i]) * kChannels);
        const V8 t01 = get8(texels + size_t(k.at[1][i]) * kChannels);
        const V8 t10 = get8(texels + size_t(k.at[2][i]) * kChannels);
        const V8 t11 = get8(texels + size_t(k.at[3][i]) * kChannels);
        const V8 d0 = t01 - t00, d1 = t11 - t10;
        const V8 a = t00 + d0 * fx, b = t10 + d1 * fx;
        const V8 slope = b - a;
        V8 value = (a + slope * fy) * w;
        if (!FIRST) value += get8(out.value[q]);
        put8(out.value[q], value);
        if (TRAIN) {
            V8 du = (d0 + (d1 - d0) * fy) * (w * k.w[i]), dv = slope * (w * k.h[i]);
            if (!FIRST) {
                du += get8(out.du[q]);
                dv += get8(out.dv[q]);
            }
            put8(out.du[q], du);
            put8(out.dv[q], dv);
        }
    }
}

// (kTile, 8) to rows of one channel each.
DEEP void to_rows(const float (*from)[kChannels], float* rows, int channels, int n) {
    for (int i = 0; i < n; i += 8) {
        V8 r[8];
        for (int j = 0; j < 8; ++j) r[j] = get8(from[i + j]);
        transpose8(r);
        for (int c = 0; c < channels; ++c) put8(rows + c * kStride + i, r[c]);
    }
}

DEEP void from_rows(const float* rows, float (*to)[kChannels], int channels, int n) {
    for (int i = 0; i < n; i += 8) {
        V8 r[8];
        for (int c = 0; c < 8; ++c) r[c] = c < channels ? get8(rows + c * kStride + i) : V8{};
        transpose8(r);
        for (int j = 0; j < 8; ++j) put8(to[i + j], r[j]);
    }
}

DEEP void scatter(const Lookup& k, const float (*d)[kChannels], int valid, Gradient& g) {
    float* out = g.texels;
    const int count = std::min(k.count, valid - k.first);
    for (int i = 0; i < count; ++i) {
        const int ahead = i + kAhead < count ? i + kAhead : i;
        for (int c = 0; c < 4; ++c) __builtin_prefetch(out + size_t(k.at[c][ahead]) * kChannels, 1);
        const float fx = k.fx[i], fy = k.fy[i], w = k.weight[i];
        const V8 v = get8(d[k.query[i]]);
        const float share[4] = {w * (1 - fx) * (1 - fy), w * fx * (1 - fy), w * (1 - fx) * fy,
                                w * fx * fy};
        for (int c = 0; c < 4; ++c) {
            float* p = out + size_t(k.at[c][i]) * kChannels;
            put8(p, get8(p) + v * share[c]);
            g.touched[k.at[c][i] >> 1] = 1;
        }
    }
}
