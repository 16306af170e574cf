// A tile of queries back through the model: included after tile.hpp, once a variant.

// Loss of the tile and the gradient of the decoder's outputs, in decoder_trace.d0.
NEUMIP_TARGET inline void Tile::judge(const Batch& b, int64_t at, int valid, int n, int loss, float scale,
                         Gradient& g) {
    const int c = plan.channels;
    double sum = 0;
    float* target = slopes[0];
    float* weight = slopes[1];
    for (int i = 0; i < n; ++i) weight[i] = i < valid ? (b.weight ? b.weight[at + i] : 1.f) : 0.f;
    if (plan.curved)  // what would be seen of what is not seen, or not lit, teaches nothing
        for (int i = 0; i < n; i += L) store(weight + i, load(weight + i) * seen_and_lit(i));
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

NEUMIP_TARGET inline void Tile::train(const Batch& b, int64_t at, int valid, int next, int loss,
                         float scale, Gradient& g) {
    const int n = padded(valid);
    set_position(b.uv + 2 * at, b.footprint ? b.footprint + at : nullptr, valid, n);
    set_view(b.view + 3 * at, valid, n);
    set_curvature(b.curvature ? b.curvature + at : nullptr, nullptr, valid, n);
    find_features<true>(*this, b, at, valid, n);
    set_light(b.light + 3 * at, valid, n, false);
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

NEUMIP_TARGET inline void Tile::move_heights(int n, int valid, Gradient& g) {
    if (!bent) {
        std::fill(in[kClear], in[kClear] + n, 1.f);
        std::fill(in[kLeast], in[kLeast] + n, kFlattest);
    }
    for (int i = 0; i < n; i += L) {
        const F z = load(in[kCross] + i);
        store(position[0] + i, load(in[kU] + i) + z * load(in[kRayU] + i));
        store(position[1] + i, load(in[kV] + i) + z * load(in[kRayV] + i));
        store(in[kSlope] + i, load(in[kSlope] + i) * load(in[kLift] + i));
        if (!bent) continue;
        // At the rim of a hole a height moves nothing.
        if (surface.opacity) {
            const Corners c = surface.around(load(position[0] + i), load(position[1] + i));
            const I whole = surface.read(surface.opacity, c) > all(kWhole);
            store(in[kSlope] + i, select(whole, load(in[kSlope] + i), all(0.f)));
        }
        const I curved = follows(i);
        for (int row : {kRayU, kRayV}) {
            const F step = load(in[row] + i);
            store(in[row] + i, select(curved, -step, step));
        }
    }
    scatter_heights(surface, position[0], position[1], in[kRayU], in[kRayV], in[kClear],
                    in[kLeast], in[kSlope], n, valid, g);
}

// Adds to the gradient of the depth what moves this bank's lookup.
NEUMIP_TARGET inline void Tile::slope(const Bank& bank, Features& f, const float* d, float* depth, int n) {
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

// The gradient of the features, rows of d, gets what comes through the frames' products.
NEUMIP_TARGET inline void Tile::back_through_frames(float* d, int n) {
    const float* product = d + plan.features() * kStride;
    for (int k = 0; k < plan.frames; ++k)
        for (int c = 0; c < 3; ++c) {
            float* row = d + (3 * k + c) * kStride;
            const float *half = product + 2 * k * kStride, *light = half + kStride;
            for (int i = 0; i < n; i += L)
                store(row + i, load(row + i) + load(half + i) * load(direction[kHx + c] + i) +
                                   load(light + i) * load(direction[kLx + c] + i));
        }
}
