// One tile of queries through the model and back: included after march.hpp, once a variant.

// ---------------------------------------------------------------- one tile

struct Tile {
    const Plan& plan;
    const float* texels;
    Net offset, decoder;
    Trace offset_trace, decoder_trace;
    Features offset_features, features[kMaxBanks];
    Levels levels;
    // u v du_view dv_view du_light dv_light depth, of heights the ray, the crossing and its share
    // of the depth, the gradient of the depth, what curvature makes of a ray (the curvature a unit
    // of heights, the opacity, what scatter_heights takes, the way's direction, the turn, how it
    // drifts off a circle); and channels of one bank
    Rows in, slopes;
    Surface surface{};
    bool bent = false, drifts = false, train_ = false;  // whether the batch has curvatures, drifts; whether it is learnt from
    alignas(64) float direction[kInputs][kTile];
    alignas(64) float position[2][kTile];
    alignas(64) float gather[kTile][kChannels];
    Lookup offset_list[2];  // of this tile and of the next
    int64_t offset_at[2] = {-1, -1};
    int ahead = 0, now = 0;
    bool fetched = false;
    Feed feed;
    enum { kU, kV, kHu, kHv, kLu, kLv, kDepth, kRayU, kRayV, kLift, kCross, kSlope,
           kBend, kOpaque, kClear, kLeast, kBackX, kBackY, kTurnSine, kTurnCosine,
           kSide0, kSide1, kSkew0, kSkew1, kInRows };

    NEUMIP_TARGET Tile(const Plan& p, const float* weights, const float* t, const Batch& b,
                       bool train)
        : plan(p), texels(t), train_(train) {
        surface = {t, float(p.heights.w), float(p.heights.h), b.top, b.bottom, p.wrap,
                   p.holes ? t + p.plane() * kChannels : nullptr, p.looks, b.quads, b.cover_quads};
        decoder.pack(p.decoder, weights, train, p.half, p.pairs && L == 16);
        decoder_trace.reset(p.decoder, train);
        if (p.offset) {
            offset.pack(p.offset_mlp, weights, train, p.half, p.pairs && L == 16);
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
            const F scale = plan.depth_scale / larger(load(d[2] + i), all(kLowestCosine));
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
            std::memset(direction[kLevel], 0, sizeof direction[kLevel]);
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
            store(direction[kLevel] + i, larger(l, all(0.f)) * (1.f / kLevelsUnit));
        }
    }

    NEUMIP_TARGET void set_view(const float* view, int valid, int n) {
        vectors(direction + kVx, view, valid, n);
        if (plan.depth()) step(direction + kVx, in[kHu], in[kHv], n);
        if (!plan.heights.h) return;
        for (int i = 0; i < n; i += L) {
            const F z = load(direction[kVz] + i);
            const F part = 1.f / larger(z, all(kSteepest)), scale = part * plan.depth_scale;
            store(in[kRayU] + i, load(direction[kVx] + i) * scale);
            store(in[kRayV] + i, load(direction[kVy] + i) * scale * -plan.aspect);
            store(in[kLift] + i, larger(z, all(kLowestCosine)) * part);
        }
    }

    NEUMIP_TARGET void set_curvature(const float* curvature, const float* drift, int valid, int n) {
        if (!plan.curved) return;
        drifts = curvature != nullptr && drift != nullptr;
        for (int c = 0; drifts && c < 4; ++c)
            for (int i = 0; i < n; ++i) in[kSide0 + c][i] = drift[4 * (i < valid ? i : valid - 1) + c];
        // Rays that may pass a hole are followed as those that may pass an outline.
        bent = curvature != nullptr || plan.holes;
        std::fill(in[kOpaque], in[kOpaque] + n, 1.f);
        if (curvature == nullptr) {
            std::memset(direction[kCurvature], 0, sizeof direction[kCurvature]);
            std::fill(in[kBend], in[kBend] + n, 0.f);
            return;
        }
        for (int i = 0; i < n; ++i) in[kBend][i] = curvature[i < valid ? i : valid - 1];
        for (int i = 0; i < n; i += L) {
            const F k = load(in[kBend] + i), size = k < all(0.f) ? -k : k;
            store(direction[kCurvature] + i, k / (size + kCurvatureUnit));
            store(in[kBend] + i, k * plan.depth_scale);
        }
    }

    // Which of L queries have rays that may pass.
    MEMBER I follows(int i) {
        if (plan.holes) return ~I{};
        return bent ? load(in[kBend] + i) != all(0.f) : I{};
    }

    // Ray depths where the view rays of queries from..from+n meet the heights.
    MEMBER void meet(int from, int n) {
        for (int i = from; i < from + n; i += L) {
            const I curved = follows(i);
            if (any_of(~curved)) {
                const F z = surface.crossing(load(in[kU] + i), load(in[kV] + i),
                                             load(in[kRayU] + i), load(in[kRayV] + i));
                store(in[kCross] + i, z);
                store(in[kDepth] + i, z * load(in[kLift] + i));
                if (bent) {
                    store(in[kTurnSine] + i, all(0.f));
                    store(in[kTurnCosine] + i, all(1.f));
                    store(in[kClear] + i, all(1.f));
                    store(in[kLeast] + i, all(kFlattest));
                }
            }
            if (any_of(curved)) meet_curved(i, curved);
        }
    }

    // Rows x, y, z of a direction into the frame where the rays end.
    MEMBER void turn(float (*d)[kTile], int from, int n) {
        for (int i = from; i < from + n; i += L) {
            const F bx = load(in[kBackX] + i), by = load(in[kBackY] + i);
            const F s = load(in[kTurnSine] + i), c = load(in[kTurnCosine] + i);
            const F up = load(d[2] + i), along = load(d[0] + i) * bx + load(d[1] + i) * by;
            const F shift = along * (c - 1.f) - up * s;
            store(d[0] + i, load(d[0] + i) + shift * bx);
            store(d[1] + i, load(d[1] + i) + shift * by);
            store(d[2] + i, along * s + up * c);
        }
    }

    // The view as the layers take it, once the rays are followed.
    MEMBER void turn_view(int n) {
        turn(direction + kVx, 0, n);
        for (int i = 0; i < n; i += L) {
            const F z = load(direction[kVz] + i);
            const I turned = load(in[kTurnSine] + i) != all(0.f);
            store(direction[kVz] + i, select(turned, larger(z, all(kLowestSeen)), z));
        }
    }

    // The same of L queries on a curved surface; lanes outside `curved` stay as they are.
    MEMBER void meet_curved(int i, I curved) {
        auto put = [&](int row, F x) NEUMIP_TARGET {
            store(in[row] + i, select(curved, x, load(in[row] + i)));
        };
        const F x = load(direction[kVx] + i), y = load(direction[kVy] + i);
        const Ray r = ray_of(surface, x, y, load(direction[kVz] + i), load(in[kBend] + i));
        const F part = -plan.depth_scale / larger(root(x * x + y * y), all(kLeastSine));
        put(kRayU, x * part);
        put(kRayV, y * part * -plan.aspect);
        const F flat = -1.f / larger(root(x * x + y * y), all(kLeastSine));
        I opaque;
        F way;
        if (drifts) {
            const I convex = r.bend > all(0.f);
            const auto part_of = [&](int row) NEUMIP_TARGET {
                return select(convex, load(in[row] + i), all(0.f));
            };
            const Drift d{part_of(kSide0), part_of(kSide1), part_of(kSkew0), part_of(kSkew1),
                          y * flat, x * flat * plan.aspect};
            way = meet_bent<true>(surface, r, d, load(in[kU] + i), load(in[kV] + i),
                                  load(in[kRayU] + i), load(in[kRayV] + i), opaque);
            // Lookups are moved by the depth: aside, a part of it.
            const F beside = d.over_way(way * r.part) * r.part / -r.share;
            put(kHu, load(in[kHu] + i) + beside * d.u);
            put(kHv, load(in[kHv] + i) + beside * d.v);
        } else {
            way = meet_bent<false>(surface, r, Drift{}, load(in[kU] + i), load(in[kV] + i),
                                   load(in[kRayU] + i), load(in[kRayV] + i), opaque);
        }
        put(kCross, way);
        put(kDepth, -way * r.share);
        store(in[kBackX] + i, x * flat);
        store(in[kBackY] + i, y * flat);
        const F half = r.bend * way * 0.5f, q = half * half, s = half * sinc_of(q);
        put(kTurnSine, 2.f * s * cosine_of(q));
        put(kTurnCosine, 1.f - 2.f * s * s);
        put(kOpaque, select(opaque, all(1.f), all(0.f)));
        if (!train_) return;
        // Their way runs against that of the plane's rays, which rise.
        const F fall = r.falling(way);
        put(kClear, fall);
        put(kLeast, kFlattest * larger(fall, all(kSteepest)));
        put(kLift, r.share);
    }

    NEUMIP_TARGET void set_light(const float* light, int valid, int n, bool same) {
        if (same)
            for (int c = 0; c < 3; ++c) std::fill(direction[kLx + c], direction[kLx + c] + n, light[c]);
        else vectors(direction, light, valid, n);
        if (plan.depth() && plan.needs_light()) step(direction, in[kLu], in[kLv], n);
        if (bent) turn(direction, 0, n);
        if (!plan.needs_half()) return;
        for (int i = 0; i < n; i += L) {
            F h[3];
            for (int c = 0; c < 3; ++c) h[c] = load(direction[kLx + c] + i) + load(direction[kVx + c] + i);
            // Opposite directions have no half vector.
            const F square = h[0] * h[0] + h[1] * h[1] + h[2] * h[2];
            const I none = square < all(1e-12f);
            const F safe = select(none, all(1.f), square);
            const F r = 1.f / root(safe);
            store(direction[kHx] + i, select(none, all(0.f), h[0] * r));
            store(direction[kHy] + i, select(none, all(0.f), h[1] * r));
            store(direction[kHz] + i, select(none, all(1.f), h[2] * r));
            store(direction[kCosDiff] + i, select(none, all(0.f), square * r * 0.5f));
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
        const bool first = s.bent && !TRAIN;
        if (first) {  // what passes throughout is looked up nowhere
            for (int half = 0; half < 2; ++half) s.meet(half_from(half), half_size(half, n));
            if (!s.seen(valid)) return;
        }
        for (int half = 0; half < 2; ++half) {
            const int from = half_from(half), size = half_size(half, n);
            if (plan.offset) {
                run_forward(s.offset, s.offset_trace, TRAIN, from, size, &s.feed);
                std::memcpy(s.in[kDepth] + from, s.offset_trace.x.back().base + from,
                            sizeof(float) * size);
            }
            if (plan.heights.h && !first) s.meet(from, size);
            look_up_features(s, from, size, half, valid, false);
            if (half == 0) s.wish(half, s.texels);
        }
        if (s.bent) s.turn_view(n);
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
                    half += part * load(direction[kHx + c] + i);
                    light += part * load(direction[kLx + c] + i);
                }
                store(x[first + 2 * k] + i, half);
                store(x[first + 2 * k + 1] + i, light);
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
        set_curvature(b.curvature ? b.curvature + at : nullptr, b.drift ? b.drift + 4 * at : nullptr,
                      valid, n);
        find_features<false>(*this, b, at, valid, n);
        fetched = false;
    }

    // 1 where rays meet curved heights, and light comes from above there; else 0.
    MEMBER F seen_and_lit(int i) {
        const F lit = load(direction[kLz] + i);
        return select(lit > all(0.f), load(in[kOpaque] + i), all(0.f));
    }

    // Whether any ray of the tile meets the heights.
    bool seen(int valid) const {
        if (!bent) return true;
        const float* opaque = in.base + size_t(kOpaque) * kStride;
        return std::any_of(opaque, opaque + valid, [](float x) { return x > 0; });
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
                    const F y = smaller(larger(answer(c, i), all(0.f)), all(kMostLog));
                    const F value = exp_of(y) - 1.f;
                    store(z[c] + i, plan.curved ? value * seen_and_lit(i) : value);
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

    // Training: backward.hpp.
    NEUMIP_TARGET void train(const Batch& b, int64_t at, int valid, int next, int loss,
                             float scale, Gradient& g);
    NEUMIP_TARGET void judge(const Batch& b, int64_t at, int valid, int n, int loss, float scale,
                             Gradient& g);
    NEUMIP_TARGET void back_through_frames(float* d, int n);
    NEUMIP_TARGET void move_heights(int n, int valid, Gradient& g);
    NEUMIP_TARGET void slope(const Bank& bank, Features& f, const float* d, float* depth, int n);
};
