// One tile of queries through the model and back: included after neumip_march.hpp, once a variant.

// ---------------------------------------------------------------- one tile

struct Tile {
    const Plan& plan;
    const float* texels;
    Net offset, decoder;
    Trace offset_trace, decoder_trace;
    Features offset_features, features[kMaxBanks];
    Levels levels;
    // u v du_view dv_view du_light dv_light depth, of heights the ray, the crossing and its share
    // of the depth, the gradient of the depth; and channels of one bank
    Rows in, slopes;
    Surface surface{};
    alignas(64) float direction[kDirections][kTile];
    alignas(64) float position[2][kTile];
    alignas(64) float gather[kTile][kChannels];
    Lookup offset_list[2];  // of this tile and of the next
    int64_t offset_at[2] = {-1, -1};
    int ahead = 0, now = 0;
    bool fetched = false;
    Feed feed;
    enum { kU, kV, kHu, kHv, kLu, kLv, kDepth, kRayU, kRayV, kLift, kCross, kSlope, kInRows };

    NEUMIP_TARGET Tile(const Plan& p, const float* weights, const float* t, const Batch& b,
                       bool train)
        : plan(p), texels(t) {
        surface = {t, float(p.heights.w), float(p.heights.h), b.top, b.bottom, p.wrap};
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
        if (plan.depth()) step(direction + 3, in[kHu], in[kHv], n);
        if (!plan.heights.h) return;
        for (int i = 0; i < n; i += L) {
            const F z = load(direction[5] + i);
            const F part = 1.f / larger(z, all(kSteepest)), scale = part * plan.depth_scale;
            store(in[kRayU] + i, load(direction[3] + i) * scale);
            store(in[kRayV] + i, load(direction[4] + i) * scale * -plan.aspect);
            store(in[kLift] + i, larger(z, all(0.6f)) * part);
        }
    }

    // Ray depths where the view rays of queries from..from+n meet the heights.
    MEMBER void meet(int from, int n) {
        for (int i = from; i < from + n; i += L) {
            const F z = surface.crossing(load(in[kU] + i), load(in[kV] + i), load(in[kRayU] + i),
                                         load(in[kRayV] + i));
            store(in[kCross] + i, z);
            store(in[kDepth] + i, z * load(in[kLift] + i));
        }
    }

    NEUMIP_TARGET void set_light(const float* light, int valid, int n, bool same) {
        if (same)
            for (int c = 0; c < 3; ++c) std::fill(direction[c], direction[c] + n, light[c]);
        else vectors(direction, light, valid, n);
        if (plan.depth() && plan.needs_light()) step(direction, in[kLu], in[kLv], n);
        if (!plan.needs_half()) return;
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
            if (plan.heights.h) s.meet(from, size);
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
            if (plan.depth() && (bank.view != 0 || bank.light != 0)) {
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

    // Products of the frames with the half vector and the light, after the features.
    MEMBER void put_frames(int from, int n) {
        Rows& x = decoder_trace.x[0];
        const int first = plan.features();
        for (int k = 0; k < plan.frames; ++k)
            for (int i = from; i < from + n; i += L) {
                F half = all(0.f), light = all(0.f);
                for (int c = 0; c < 3; ++c) {
                    const F part = load(x[3 * k + c] + i);
                    half += part * load(direction[6 + c] + i);
                    light += part * load(direction[c] + i);
                }
                store(x[first + 2 * k] + i, half);
                store(x[first + 2 * k + 1] + i, light);
            }
    }

    // The gradient of the features, rows of d, gets what comes through the frames' products.
    MEMBER void back_through_frames(float* d, int n) {
        const float* product = d + plan.features() * kStride;
        for (int k = 0; k < plan.frames; ++k)
            for (int c = 0; c < 3; ++c) {
                float* row = d + (3 * k + c) * kStride;
                const float *half = product + 2 * k * kStride, *light = half + kStride;
                for (int i = 0; i < n; i += L)
                    store(row + i, load(row + i) + load(half + i) * load(direction[6 + c] + i) +
                                       load(light + i) * load(direction[c] + i));
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
            put_frames(from, size);
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
            put_frames(half_from(half), half_size(half, n));
            run_forward(decoder, decoder_trace, true, half_from(half), half_size(half, n), &feed);
            if (half == 0) wish(0, g.texels);
        }
        judge(b, at, valid, n, loss, scale, g);
        wish(1, g.texels);
        if (plan.offset) feed.add(offset_list[now], g.texels);
        float* d = run_backward(decoder, decoder_trace, n, &feed);
        back_through_frames(d, n);
        float* depth = plan.offset ? offset_trace.d0.base : plan.heights.h ? in[kSlope] : nullptr;
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
        if (plan.heights.h) return move_heights(n, valid, g);
        if (!depth) return;
        feed.reset();
        if (next > 0) look_ahead(b, at + kTile, next);
        if (ahead != now) feed.add(offset_list[ahead], texels);
        d = run_backward(offset, offset_trace, n, &feed);
        from_rows(d, gather, plan.offset_bank.channels, n);
        scatter(offset_list[now], gather, valid, g);
    }

    NEUMIP_TARGET void move_heights(int n, int valid, Gradient& g) {
        for (int i = 0; i < n; i += L) {
            const F z = load(in[kCross] + i);
            store(position[0] + i, load(in[kU] + i) + z * load(in[kRayU] + i));
            store(position[1] + i, load(in[kV] + i) + z * load(in[kRayV] + i));
            store(in[kSlope] + i, load(in[kSlope] + i) * load(in[kLift] + i));
        }
        scatter_heights(surface, position[0], position[1], in[kRayU], in[kRayV], in[kSlope], n,
                        valid, g);
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
    auto tile = std::make_unique<Tile>(plan, weights, texels, b, false);
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
