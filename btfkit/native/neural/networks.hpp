// Networks of layers and what a tile leaves in them: included after half.hpp, once a variant.

struct Net {
    const Mlp* mlp = nullptr;
    std::vector<Packed> forward, backward;
    std::vector<float> gradient;  // a layer: (out, in + 1), the bias last
    bool half = false;            // products of bfloat16 after the first layer
    std::vector<Pairs> paired;    // of those layers, where the processor multiplies pairs

    void pack(const Mlp& m, const float* flat, bool train, bool rounding, bool pairs) {
        mlp = &m;
        half = rounding && !train;
        const int layers = m.layers();
        forward.resize(layers);
        backward.resize(train ? layers : 0);
        if (train) gradient.assign(m.size(), 0.f);
        const float* w = flat + m.start;
        for (int l = 0; l < layers; ++l) {
            const int in = m.widths[l], out = m.widths[l + 1];
            // Sines count their phase in turns; the weights are in radians.
            const bool turns = m.activation == kSine && l + 1 < layers;
            const float scale = turns ? 0.15915494309189535f : 1.f;
            forward[l].reset(in, out);
            const bool round = half && l > 0;
            forward[l].fill([&](int o, int k) {
                return (round ? rounded_one(w[o * in + k]) : w[o * in + k]) * scale;
            });
            if (round && pairs) {
                paired.emplace_back();
                paired.back().fill(in, out, [&](int o, int k) { return w[o * in + k]; });
                std::copy(w + size_t(in) * out, w + size_t(in + 1) * out, paired.back().bias.begin());
            }
            for (int o = 0; o < out; ++o) forward[l].bias[o] = w[size_t(in) * out + o] * scale;
            if (train) {
                const int rows = l == 0 ? m.features() : in;
                backward[l].reset(out, rows);
                backward[l].fill([&](int o, int k) { return w[k * in + o]; });
            }
            w += size_t(in + 1) * out;
        }
    }
    // Gradients in the order of the flat weights, added to `flat`.
    void unpack(float* flat) const {
        float* w = flat + mlp->start;
        const float* g = gradient.data();
        for (int l = 0; l < mlp->layers(); ++l) {
            const int in = mlp->widths[l], out = mlp->widths[l + 1];
            for (int o = 0; o < out; ++o)
                for (int k = 0; k <= in; ++k)
                    w[k < in ? o * in + k : size_t(in) * out + o] += *g++;
            w += size_t(in + 1) * out;
        }
    }
};

struct Rows {
    std::vector<float> memory;
    float* base = nullptr;
    void reset(int rows) {
        memory.assign(size_t(rows) * kStride + 16, 0.f);
        base = memory.data();
        while (reinterpret_cast<uintptr_t>(base) % 64 != 0) ++base;
    }
    float* operator[](int row) { return base + size_t(row) * kStride; }
    void ones(int row) { std::fill(base + size_t(row) * kStride, base + size_t(row + 1) * kStride, 1.f); }
};

// Inputs and outputs of every layer of one network for one tile.
struct Trace {
    std::vector<Rows> x, cosine;
    Rows d0, d1;
    Rows pairs[2];  // inputs and outputs of a layer as rows of two channels
    void reset(const Mlp& m, bool train) {
        x.resize(m.layers() + 1);
        cosine.resize(train && m.activation == kSine ? m.layers() : 0);
        int widest = 0;
        for (int l = 0; l <= m.layers(); ++l) {
            x[l].reset(m.widths[l] + 1);
            x[l].ones(m.widths[l]);
            widest = std::max(widest, m.widths[l]);
        }
        for (auto& c : cosine) c.reset(widest);
        for (auto& p : pairs) p.reset((widest + 1) / 2);
        if (train) {
            d0.reset(widest);
            d1.reset(widest);
        }
    }
};

// Queries from..from+n from the first layer's outputs on, in pairs of bfloat16.
DEEP void run_pairs(const Net& net, Trace& t, int from, int n, Feed* feed) {
    const int layers = net.mlp->layers(), act = net.mlp->activation;
    PairRow *x = (PairRow*)(t.pairs[0].base + from), *y = (PairRow*)(t.pairs[1].base + from);
    to_pairs(t.x[1].base + from, net.mlp->widths[1], x, n);
    for (int l = 1; l < layers; ++l) {
        const Pairs& p = net.paired[l - 1];
        if (l + 1 == layers) {
            pair_gemm<kPlain>(p, x, t.x[layers].base + from, nullptr, n, feed);
            return;
        }
        if (act == kLinear) pair_gemm<kPlain>(p, x, nullptr, y, n, feed);
        else if (act == kRelu) pair_gemm<kForwardRelu>(p, x, nullptr, y, n, feed);
        else if (act == kLeaky) pair_gemm<kForwardLeaky>(p, x, nullptr, y, n, feed);
        else pair_gemm<kForwardSine>(p, x, nullptr, y, n, feed);
        std::swap(x, y);
    }
}

// Queries from..from+n through a network.
DEEP void run_forward(const Net& net, Trace& t, bool train, int from, int n, Feed* feed) {
    const int layers = net.mlp->layers(), act = net.mlp->activation;
    for (int l = 0; l < layers && n > 0; ++l) {
        const Packed& p = net.forward[l];
        const float* x = t.x[l].base + from;
        float* y = t.x[l + 1].base + from;
        if (l == 1 && !net.paired.empty()) return run_pairs(net, t, from, n, feed);
        if (l + 1 == layers || act == kLinear) gemm<kPlain>(p, x, y, nullptr, n, feed);
        else if (act == kRelu) gemm<kForwardRelu>(p, x, y, nullptr, n, feed);
        else if (act == kLeaky) gemm<kForwardLeaky>(p, x, y, nullptr, n, feed);
        else if (train) gemm<kTrainSine>(p, x, y, t.cosine[l].base + from, n, feed);
        else gemm<kForwardSine>(p, x, y, nullptr, n, feed);
        if (net.half && l + 1 < layers) round_rows(y, p.out, n);
    }
}

// Takes the gradient of the outputs in t.d0; returns that of the features.
DEEP float* run_backward(Net& net, Trace& t, int n, Feed* feed) {
    const int layers = net.mlp->layers(), act = net.mlp->activation;
    size_t at = net.mlp->size();
    float *dy = t.d0.base, *dx = t.d1.base;
    for (int l = layers - 1; l >= 0; --l) {
        const int in = net.mlp->widths[l], out = net.mlp->widths[l + 1];
        at -= size_t(in + 1) * out;
        outer(dy, t.x[l].base, out, in + 1, n, net.gradient.data() + at);
        const Packed& p = net.backward[l];
        if (l == 0 || act == kLinear) gemm<kPlain>(p, dy, dx, nullptr, n, feed);
        else if (act == kRelu) gemm<kBackRelu>(p, dy, dx, t.x[l].base, n, feed);
        else if (act == kLeaky) gemm<kBackLeaky>(p, dy, dx, t.x[l].base, n, feed);
        else gemm<kBackSine>(p, dy, dx, t.cosine[l - 1].base, n, feed);
        std::swap(dy, dx);
    }
    return dy;
}
