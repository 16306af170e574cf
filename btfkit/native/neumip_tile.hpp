// One tile of queries through the model and back: included after neumip_kernel.hpp, once a variant.

// ---------------------------------------------------------------- texture lookups

// Fractions and texels from u, v in tiles and per-query texture sizes (floats) and starts.
FN void corners(Lookup& k, int n, F u, F v, F w, F h, I start, bool wrap) {
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
    store(k.fx + n, x - x0);
    store(k.fy + n, y - y0);
    const I wi = __builtin_convertvector(w, I);
    const I ra = start + __builtin_convertvector(ya, I) * wi;
    const I rb = start + __builtin_convertvector(yb, I) * wi;
    const I ca = __builtin_convertvector(xa, I), cb = __builtin_convertvector(xb, I);
    *(I*)(k.at[0] + n) = ra + ca;
    *(I*)(k.at[1] + n) = ra + cb;
    *(I*)(k.at[2] + n) = rb + ca;
    *(I*)(k.at[3] + n) = rb + cb;
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

// ---------------------------------------------------------------- one tile

struct Tile {
    const Plan& plan;
    const float* texels;
    Net offset, decoder;
    Trace offset_trace, decoder_trace;
    Features offset_features, features[kMaxBanks];
    Levels levels;
    Rows in, slopes;  // u v du_view dv_view du_light dv_light depth, and channels of one bank
    alignas(64) float direction[kDirections][kTile];
    alignas(64) float position[2][kTile];
    alignas(64) float gather[kTile][kChannels];
    Lookup offset_list[2];  // of this tile and of the next
    int64_t offset_at[2] = {-1, -1};
    int ahead = 0, now = 0;
    bool fetched = false;
    Feed feed;
    enum { kU, kV, kHu, kHv, kLu, kLv, kDepth, kMoveU, kMoveV, kInRows };

    NEUMIP_TARGET Tile(const Plan& p, const float* weights, const float* t, bool train)
        : plan(p), texels(t) {
        decoder.pack(p.decoder, weights, train);
        decoder_trace.reset(p.decoder, train);
        if (p.offset) {
            offset.pack(p.offset_mlp, weights, train);
            offset_trace.reset(p.offset_mlp, train);
        }
        in.reset(kInRows);
        slopes.reset(2 * kChannels);
        std::memset(direction, 0, sizeof direction);
        std::memset(position, 0, sizeof position);
    }

    static int padded(int n) { return (n + 8 * L - 1) / (8 * L) * (8 * L); }

    // Rows of x, y, z from vectors side by side; lanes beyond `valid` repeat the last query.
    FN void vectors(float (*rows)[kTile], const float* from, int valid, int n) {
        for (int i = 0; i < valid; ++i) {
            rows[0][i] = from[3 * i];
            rows[1][i] = from[3 * i + 1];
            rows[2][i] = from[3 * i + 2];
        }
        for (int c = 0; c < 3; ++c)
            for (int i = valid; i < n; ++i) rows[c][i] = rows[c][valid - 1];
    }

    // Displacement in uv of one unit of depth along a direction: the paper's H, v down the rows.
    MEMBER void step(const float (*d)[kTile], float* u, float* v, int n) {
        for (int i = 0; i < n; i += L) {
            const F scale = plan.depth_scale / larger(load(d[2] + i), all(0.6f));
            store(u + i, load(d[0] + i) * scale);
            store(v + i, load(d[1] + i) * scale * -plan.aspect);
        }
    }

    NEUMIP_TARGET void set_position(const float* uv, const float* footprint, int valid, int n) {
        for (int i = 0; i < valid; ++i) {
            in[kU][i] = uv[2 * i];
            in[kV][i] = uv[2 * i + 1];
        }
        for (int i = valid; i < n; ++i) {
            in[kU][i] = in[kU][valid - 1];
            in[kV][i] = in[kV][valid - 1];
        }
        levels.finest = true;
        if (footprint == nullptr) {
            std::memset(levels.level, 0, sizeof levels.level);
            std::memset(direction[10], 0, sizeof direction[10]);
            return;
        }
        float widest = 0;
        for (int i = 0; i < n; ++i) {
            const float f = footprint[i < valid ? i : valid - 1] * 2.f;
            levels.level[i] = f > 1.f ? f : 1.f;
            widest = f > widest ? f : widest;
        }
        levels.finest = !(widest > 1.f);
        for (int i = 0; i < n; i += L) {
            const F l = log_of(load(levels.level + i)) * 1.4426950408889634f;
            store(levels.level + i, larger(l, all(0.f)));
            store(direction[10] + i, larger(l, all(0.f)) * 0.125f);
        }
    }

    NEUMIP_TARGET void set_view(const float* view, int valid, int n) {
        vectors(direction + 3, view, valid, n);
        if (plan.offset) step(direction + 3, in[kHu], in[kHv], n);
    }

    NEUMIP_TARGET void set_light(const float* light, int valid, int n, bool same) {
        if (same)
            for (int c = 0; c < 3; ++c) std::fill(direction[c], direction[c] + n, light[c]);
        else vectors(direction, light, valid, n);
        if (plan.offset && plan.needs_light()) step(direction, in[kLu], in[kLv], n);
        if (!plan.decoder.needs_half()) return;
        for (int i = 0; i < n; i += L) {
            F h[3];
            for (int c = 0; c < 3; ++c) h[c] = load(direction[c] + i) + load(direction[3 + c] + i);
            // Opposite directions have no half vector.
            const F square = h[0] * h[0] + h[1] * h[1] + h[2] * h[2];
            const I none = square < all(1e-12f);
            const F safe = select(none, all(1.f), square);
            const F r = 1.f / root(safe);
            store(direction[6] + i, select(none, all(0.f), h[0] * r));
            store(direction[7] + i, select(none, all(0.f), h[1] * r));
            store(direction[8] + i, select(none, all(1.f), h[2] * r));
            store(direction[9] + i, select(none, all(0.f), square * r * 0.5f));
        }
    }

    MEMBER void put_directions(const Mlp& m, Trace& t, int n) {
        for (size_t k = 0; k < m.directions.size(); ++k)
            std::memcpy(t.x[0][m.features() + int(k)], direction[m.directions[k]], sizeof(float) * n);
    }

    // The tile's queries in two runs: while one is multiplied, the other's texels are on their way.
    static int half_from(int half) { return half * kTile / 2; }
    static int half_size(int half, int n) {
        return half ? std::max(n - kTile / 2, 0) : std::min(n, kTile / 2);
    }

    // Offset lookups of the next tile, whose texels the present one's layers fetch.
    NEUMIP_TARGET void look_ahead(const Batch& b, int64_t at, int valid) {
        if (!plan.offset) return;
        ahead = 1 - ahead;
        for (int i = 0; i < valid; ++i) {
            position[0][i] = b.uv[2 * (at + i)];
            position[1][i] = b.uv[2 * (at + i) + 1];
        }
        const int n = padded(valid);
        for (int i = valid; i < n; ++i) {
            position[0][i] = position[0][valid - 1];
            position[1][i] = position[1][valid - 1];
        }
        look_up_one(offset_list[ahead], plan.textures[plan.offset_bank.first], position[0],
                    position[1], 0, n, plan.wrap);
        offset_at[ahead] = at;
    }

    template <bool TRAIN>
    DEEP void find_features(Tile& s, const Batch& b, int64_t at, int valid, int n) {
        const Plan& plan = s.plan;
        if (plan.offset) {
            if (s.offset_at[s.ahead] != at) s.look_ahead(b, at, valid);
            s.now = s.ahead;
            fetch<false, true>(s.offset_list[s.now], s.texels, s.offset_features);
            to_rows(s.offset_features.value, s.offset_trace.x[0].base, plan.offset_bank.channels, n);
            s.put_directions(plan.offset_mlp, s.offset_trace, n);
        }
        s.feed.reset();
        for (int half = 0; half < 2; ++half) {
            const int from = half_from(half), size = half_size(half, n);
            if (plan.offset) {
                run_forward(s.offset, s.offset_trace, TRAIN, from, size, &s.feed);
                std::memcpy(s.in[kDepth] + from, s.offset_trace.x.back().base + from,
                            sizeof(float) * size);
            }
            look_up_features(s, from, size, half, valid, false);
            if (half == 0) s.wish(half, s.texels);
        }
    }

    DEEP void look_up_features(Tile& s, int from, int size, int half, int valid, bool lights) {
        const Plan& plan = s.plan;
        for (size_t k = 0; k < plan.banks.size(); ++k) {
            const Bank& bank = plan.banks[k];
            Lookup(&list)[2] = s.features[k].list[half];
            if ((bank.light != 0) != lights) continue;
            list[1].count = 0;
            const float *u = s.in[kU] + from, *v = s.in[kV] + from;
            if (plan.offset && (bank.view != 0 || bank.light != 0)) {
                for (int i = from; i < from + size; i += L) {
                    const F r = load(s.in[kDepth] + i);
                    F hu = load(s.in[kHu] + i) * bank.view, hv = load(s.in[kHv] + i) * bank.view;
                    if (bank.light != 0) {
                        hu -= load(s.in[kLu] + i) * bank.light;
                        hv -= load(s.in[kLv] + i) * bank.light;
                    }
                    store(s.position[0] + i, load(s.in[kU] + i) + r * hu);
                    store(s.position[1] + i, load(s.in[kV] + i) + r * hv);
                }
                u = s.position[0] + from;
                v = s.position[1] + from;
            }
            if (s.levels.finest || bank.count == 1)
                look_up_one(list[0], plan.textures[bank.first], u, v, from, size, plan.wrap);
            else
                look_up_levels(list[0], list[1], plan, bank, s.levels, u, v, from, size, valid);
        }
    }

    // Adds the lookups of a half to what the layers fetch meanwhile.
    void wish(int half, const float* base) {
        for (size_t k = 0; k < plan.banks.size(); ++k)
            for (const Lookup& list : features[k].list[half])
                if (list.count) feed.add(list, base);
    }

    template <bool TRAIN>
    DEEP void fetch_features(Tile& s, int half, int n, bool lights) {
        int row = 0;
        const int from = half_from(half), size = half_size(half, n);
        for (size_t k = 0; k < s.plan.banks.size(); row += s.plan.banks[k++].channels) {
            const Bank& bank = s.plan.banks[k];
            if (!TRAIN && (bank.light != 0) != lights) continue;
            Features& f = s.features[k];
            fetch<TRAIN, true>(f.list[half][0], s.texels, f);
            if (f.list[half][1].count) fetch<TRAIN, false>(f.list[half][1], s.texels, f);
            to_rows(f.value + from, s.decoder_trace.x[0][row] + from, bank.channels, size);
        }
    }

    // log(1 + rgb) as the model sees it, in the decoder's last rows; a mask is multiplied in.
    MEMBER F answer(int c, int i) {
        Rows& z = decoder_trace.x.back();
        F y = load(z[c] + i);
        if (plan.output == kLogRelu) y = larger(y, all(0.f));
        if (plan.output == kLogMask)
            y = y * (0.1f + 1.f / (1.f + exp_of(-load(z[plan.channels + c] + i))));
        return y;
    }

    NEUMIP_TARGET void stage_one(const Batch& b, int64_t at, int valid) {
        const int n = padded(valid);
        set_position(b.uv + 2 * at, b.footprint ? b.footprint + at : nullptr, valid, n);
        set_view(b.view + 3 * at, valid, n);
        find_features<false>(*this, b, at, valid, n);
        fetched = false;
    }

    // Writes (valid, outputs) reflectance; stage_one has run for these queries.
    NEUMIP_TARGET void stage_two(const float* light, bool same, int valid, float* rgb, bool raw) {
        const int n = padded(valid);
        set_light(light, valid, n, same);
        put_directions(plan.decoder, decoder_trace, n);
        feed.reset();
        wish(1, texels);
        for (int half = 0; half < 2; ++half) {
            const int from = half_from(half), size = half_size(half, n);
            if (size == 0) break;
            if (plan.needs_light()) {
                look_up_features(*this, from, size, half, valid, true);
                fetch_features<false>(*this, half, n, true);
            }
            if (!fetched) fetch_features<false>(*this, half, n, false);
            run_forward(decoder, decoder_trace, false, from, size, &feed);
            if (half == 0 && plan.offset && ahead != now) feed.add(offset_list[ahead], texels);
        }
        fetched = true;
        const int outputs = raw ? plan.decoder.widths.back() : plan.channels;
        Rows& z = decoder_trace.x.back();
        if (!raw)
            for (int c = 0; c < outputs; ++c)
                for (int i = 0; i < n; i += L) {
                    const F y = smaller(larger(answer(c, i), all(0.f)), all(20.f));
                    store(z[c] + i, exp_of(y) - 1.f);
                }
        if (outputs == 3) {
            const float *r = z[0], *g = z[1], *bl = z[2];
            for (int i = 0; i < valid; ++i) {
                rgb[3 * i] = r[i];
                rgb[3 * i + 1] = g[i];
                rgb[3 * i + 2] = bl[i];
            }
            return;
        }
        for (int c = 0; c < outputs; ++c) {
            const float* row = z[c];
            for (int i = 0; i < valid; ++i) rgb[size_t(i) * outputs + c] = row[i];
        }
    }

    // Loss of the tile and the gradient of the decoder's outputs, in decoder_trace.d0.
    NEUMIP_TARGET void judge(const Batch& b, int64_t at, int valid, int n, int loss, float scale,
                             Gradient& g) {
        const int c = plan.channels;
        double sum = 0;
        float* target = slopes[0];
        float* weight = slopes[1];
        for (int i = 0; i < n; ++i) weight[i] = i < valid ? (b.weight ? b.weight[at + i] : 1.f) : 0.f;
        for (int k = 0; k < c; ++k) {
            const float* from = b.target + at * c + k;
            for (int i = 0; i < valid; ++i) target[i] = from[int64_t(i) * c];
            for (int i = valid; i < n; ++i) target[i] = NAN;
            F counted = all(0.f);
            F total = all(0.f);
            Rows& z = decoder_trace.x.back();
            float* d = decoder_trace.d0[k];
            for (int i = 0; i < n; i += L) {
                const F t = load(target + i), y = answer(k, i);
                const I good = t - t == all(0.f);
                const F w = select(good, load(weight + i), all(0.f));
                counted += select(good, all(1.f), all(0.f));
                const F safe = larger(select(good, t, all(0.f)), all(-0.1f));
                const F e = y - log_of(safe + 1.f);
                const F size = e < all(0.f) ? -e : e;
                total += w * (loss == kSquare ? e * e : size);
                const F sign = e > all(0.f) ? all(1.f) : (e < all(0.f) ? all(-1.f) : all(0.f));
                F dy = w * scale * (loss == kSquare ? 2.f * e : sign);
                if (plan.output == kLogRelu) dy = load(z[k] + i) > all(0.f) ? dy : all(0.f);
                if (plan.output == kLogMask) {
                    const F s = 1.f / (1.f + exp_of(-load(z[c + k] + i)));
                    store(decoder_trace.d0[c + k] + i, dy * load(z[k] + i) * s * (1.f - s));
                    dy = dy * (0.1f + s);
                }
                store(d + i, dy);
            }
            sum += sum_of(total);
            g.counted += int64_t(sum_of(counted));
        }
        g.loss += sum * scale;
    }

    NEUMIP_TARGET void train(const Batch& b, int64_t at, int valid, int next, int loss,
                             float scale, Gradient& g) {
        const int n = padded(valid);
        set_position(b.uv + 2 * at, b.footprint ? b.footprint + at : nullptr, valid, n);
        set_view(b.view + 3 * at, valid, n);
        set_light(b.light + 3 * at, valid, n, false);
        find_features<true>(*this, b, at, valid, n);
        if (plan.needs_light())
            for (int half = 0; half < 2; ++half)
                look_up_features(*this, half_from(half), half_size(half, n), half, valid, true);
        put_directions(plan.decoder, decoder_trace, n);
        feed.reset();
        wish(1, texels);
        for (int half = 0; half < 2; ++half) {
            fetch_features<true>(*this, half, n, false);
            run_forward(decoder, decoder_trace, true, half_from(half), half_size(half, n), &feed);
            if (half == 0) wish(0, g.texels);
        }
        judge(b, at, valid, n, loss, scale, g);
        wish(1, g.texels);
        if (plan.offset) feed.add(offset_list[now], g.texels);
        const float* d = run_backward(decoder, decoder_trace, n, &feed);
        float* depth = plan.offset ? offset_trace.d0.base : nullptr;
        if (depth) std::fill(depth, depth + n, 0.f);
        for (size_t k = 0; k < plan.banks.size(); ++k) {
            const Bank& bank = plan.banks[k];
            Features& f = features[k];
            from_rows(d, gather, bank.channels, n);
            for (int half = 0; half < 2; ++half) {
                if (half_size(half, n) == 0) continue;
                scatter(f.list[half][0], gather, valid, g);
                if (f.list[half][1].count) scatter(f.list[half][1], gather, kTile * 2, g);
            }
            if (depth && (bank.view != 0 || bank.light != 0)) slope(bank, f, d, depth, n);
            d += bank.channels * kStride;
        }
        if (!depth) return;
        feed.reset();
        if (next > 0) look_ahead(b, at + kTile, next);
        if (ahead != now) feed.add(offset_list[ahead], texels);
        d = run_backward(offset, offset_trace, n, &feed);
        from_rows(d, gather, plan.offset_bank.channels, n);
        scatter(offset_list[now], gather, valid, g);
    }

    // Adds to the gradient of the depth what moves this bank's lookup.
    NEUMIP_TARGET void slope(const Bank& bank, Features& f, const float* d, float* depth, int n) {
        to_rows(f.du, slopes[0], bank.channels, n);
        to_rows(f.dv, slopes[kChannels], bank.channels, n);
        for (int i = 0; i < n; i += L) {
            F du = all(0.f), dv = all(0.f);
            for (int c = 0; c < bank.channels; ++c) {
                const F g = load(d + c * kStride + i);
                du += g * load(slopes[c] + i);
                dv += g * load(slopes[kChannels + c] + i);
            }
            F hu = load(in[kHu] + i) * bank.view, hv = load(in[kHv] + i) * bank.view;
            if (bank.light != 0) {
                hu -= load(in[kLu] + i) * bank.light;
                hv -= load(in[kLv] + i) * bank.light;
            }
            store(depth + i, load(depth + i) + du * hu + dv * hv);
        }
    }
};

// ---------------------------------------------------------------- entries of this variant

inline int next_size(int64_t at, int64_t to) {
    return int(std::max<int64_t>(std::min<int64_t>(kTile, to - at - kTile), 0));
}

// rgb (lights or 1, size, outputs) for queries [from, to); lights: directions shared by all.
NEUMIP_TARGET void evaluate(const Plan& plan, const float* weights, const float* texels,
                            const Batch& b, const float* lights, int64_t count, int64_t from,
                            int64_t to, float* rgb, bool raw) {
    auto tile = std::make_unique<Tile>(plan, weights, texels, false);
    const int64_t outputs = raw ? plan.decoder.widths.back() : plan.channels;
    for (int64_t at = from; at < to; at += kTile) {
        const int valid = int(std::min<int64_t>(kTile, to - at));
        tile->stage_one(b, at, valid);
        if (at + kTile < to) tile->look_ahead(b, at + kTile, next_size(at, to));
        if (lights == nullptr) {
            tile->stage_two(b.light + 3 * at, false, valid, rgb + at * outputs, raw);
            continue;
        }
        for (int64_t j = 0; j < count; ++j)
            tile->stage_two(lights + 3 * j, true, valid, rgb + (j * b.size + at) * outputs, raw);
    }
}

// Ray depth (to - from) of the offset stage, in tile widths.
NEUMIP_TARGET void depths(const Plan& plan, const float* weights, const float* texels,
                          const Batch& b, int64_t from, int64_t to, float* out) {
    auto tile = std::make_unique<Tile>(plan, weights, texels, false);
    for (int64_t at = from; at < to; at += kTile) {
        const int valid = int(std::min<int64_t>(kTile, to - at));
        tile->stage_one(b, at, valid);
        for (int i = 0; i < valid; ++i)
            out[at + i] = plan.offset ? tile->in[Tile::kDepth][i] * plan.depth_scale : 0.f;
    }
}

NEUMIP_TARGET void train(const Plan& plan, const float* weights, const float* texels,
                         const Batch& b, int loss, int64_t from, int64_t to, Gradient& g) {
    auto tile = std::make_unique<Tile>(plan, weights, texels, true);
    const float scale = 1.f / (float(b.size) * float(plan.channels));
    for (int64_t at = from; at < to; at += kTile)
        tile->train(b, at, int(std::min<int64_t>(kTile, to - at)), next_size(at, to), loss, scale, g);
    tile->decoder.unpack(g.weights);
    if (plan.offset) tile->offset.unpack(g.weights);
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
        if (!any) continue;
        const int64_t end = std::min(to, at + line);
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
