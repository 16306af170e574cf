// Lambert under one GGX lobe, fitted a texel at a time: damped Gauss-Newton on a robust error.
// Face and numpy twin: __init__.py. The reflectance is that of the tracer (trace/trace.cpp).
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "../arrays.hpp"
#include "../spread.hpp"

// Clang reads the list otherwise, and some come without what chooses at run time.
#if defined(__x86_64__) && defined(__gnu_linux__) && defined(__GNUC__) && !defined(__clang__)
#if __GNUC__ >= 12
#define CLONES __attribute__((target_clones("default", "avx2,fma", "arch=x86-64-v4")))
#else
#define CLONES __attribute__((target_clones("default", "avx2,fma")))
#endif
#else
#define CLONES
#endif

namespace nb = nanobind;

namespace {

constexpr int kLanes = 8;
constexpr int kMost = 9;              // parameters: two slopes, roughness, and two a channel
constexpr float kGrazing = 1e-4f;     // lowest cosine of the view, as in the tracer
constexpr float kLeast = 0.02f;       // of the roughness
constexpr float kMostAlbedo = 4.0f;   // data in relative units go beyond 1

// One pair a column, padded to whole vectors with weight 0.
struct Pairs {
    int m = 0, padded = 0;
    std::vector<float> room;
    float *lx, *ly, *lz, *vx, *vy, *vz, *hx, *hy, *hz, *vh5, *weight, *value;

    void reserve(int most, int channels) {
        const int n = (most + kLanes - 1) / kLanes * kLanes;
        room.assign(size_t(n) * (11 + channels) + kLanes, 0.f);
        float* at = room.data();
        for (float** part : {&lx, &ly, &lz, &vx, &vy, &vz, &hx, &hy, &hz, &vh5, &weight}) {
            *part = at;
            at += n;
        }
        value = at;
        most_ = n;
    }
    int stride() const { return most_; }
    void put(int i, const float* l, const float* v) {
        lx[i] = l[0], ly[i] = l[1], lz[i] = l[2];
        vx[i] = v[0], vy[i] = v[1], vz[i] = v[2];
        const float x = l[0] + v[0], y = l[1] + v[1], z = l[2] + v[2];
        const float part = 1 / std::sqrt(std::max(x * x + y * y + z * z, 1e-30f));
        hx[i] = x * part, hy[i] = y * part, hz[i] = z * part;
        const float vh = std::max(v[0] * hx[i] + v[1] * hy[i] + v[2] * hz[i], 0.f);
        const float g = 1 - vh, g2 = g * g;
        vh5[i] = g2 * g2 * g;
    }
    void close(int count, int channels) {
        m = count;
        padded = (m + kLanes - 1) / kLanes * kLanes;
        for (int i = m; i < padded; ++i) {
            const float up[3] = {0, 0, 1};
            put(i, up, up);
            weight[i] = 0;
            for (int c = 0; c < channels; ++c) value[c * most_ + i] = 0;
        }
    }

  private:
    int most_ = 0;
};

// Shared between channels: cosine, lobe, and their derivatives by slopes and roughness.
struct Shape {
    std::vector<float> room;
    float *nl, *nv, *nlp, *nlq, *nvp, *nvq, *lobe, *lobep, *lobeq, *lobea;
    void reserve(int n) {
        room.assign(size_t(n) * 10, 0.f);
        float* at = room.data();
        for (float** part : {&nl, &nv, &nlp, &nlq, &nvp, &nvq, &lobe, &lobep, &lobeq, &lobea}) {
            *part = at;
            at += n;
        }
    }
};

CLONES void shape_of(const Pairs& o, const float* t, Shape& s) {
    const float part = 1 / std::sqrt(t[0] * t[0] + t[1] * t[1] + 1);
    const float nx = -t[0] * part, ny = -t[1] * part, nz = part;
    const float a = t[2], a2 = a * a, ia2 = 1 / a2, ia3 = ia2 / a;
#pragma GCC ivdep
    for (int i = 0; i < o.padded; ++i) {
        const float nl = nx * o.lx[i] + ny * o.ly[i] + nz * o.lz[i];
        const float raw = nx * o.vx[i] + ny * o.vy[i] + nz * o.vz[i];
        const float nh0 = nx * o.hx[i] + ny * o.hy[i] + nz * o.hz[i];
        const float nv = raw > kGrazing ? raw : kGrazing, nh = nh0 > 0.f ? nh0 : 0.f;
        const float seen = raw > kGrazing ? 1.f : 0.f, faced = nh0 > 0.f ? 1.f : 0.f;
        const float x = nl > 1e-6f ? nl : 1e-6f;
        const float nlp = (nl * nx - o.lx[i]) * part, nlq = (nl * ny - o.ly[i]) * part;
        const float nvp = seen * (raw * nx - o.vx[i]) * part;
        const float nvq = seen * (raw * ny - o.vy[i]) * part;
        const float nhp = faced * (nh0 * nx - o.hx[i]) * part;
        const float nhq = faced * (nh0 * ny - o.hy[i]) * part;
        const float aside = 1 - nh * nh > 0.f ? 1 - nh * nh : 0.f;
        const float d = aside * ia2 + nh * nh;
        const float l2 = 1 - x * x > 0.f ? 1 - x * x : 0.f, v2 = 1 - nv * nv > 0.f ? 1 - nv * nv : 0.f;
        const float sl = std::sqrt(x * x + a2 * l2), sv = std::sqrt(nv * nv + a2 * v2);
        const float ml = x + sl, mv = nv + sv;
        const float lobe = 1 / (a2 * d * d * ml * mv);
        // Derivatives of the logarithm of the lobe.
        const float by_nh = -4 * nh * (1 - ia2) / d;
        const float by_nl = -(1 + x * (1 - a2) / sl) / ml, by_nv = -(1 + nv * (1 - a2) / sv) / mv;
        const float by_a =
            -2 / a + 4 * aside * ia3 / d - a * l2 / (sl * ml) - a * v2 / (sv * mv);
        s.nl[i] = nl, s.nv[i] = nv;
        s.nlp[i] = nlp, s.nlq[i] = nlq, s.nvp[i] = nvp, s.nvq[i] = nvq;
        s.lobe[i] = lobe;
        s.lobep[i] = lobe * (by_nh * nhp + by_nl * nlp + by_nv * nvp);
        s.lobeq[i] = lobe * (by_nh * nhq + by_nl * nlq + by_nv * nvq);
        s.lobea[i] = lobe * by_a;
    }
}

// Residual of one channel, and its derivatives by p, q, roughness, albedo, specular.
CLONES void channel_of(const Pairs& o, const Shape& s, float albedo, float f0, const float* value,
                       float* r, float* jp, float* jq, float* ja, float* jb, float* jf) {
    const bool dim = 50 * f0 < 1;
    const float f90 = dim ? 50 * f0 : 1.f, rest = f90 - f0, grows = dim ? 49.f : -1.f;
#pragma GCC ivdep
    for (int i = 0; i < o.padded; ++i) {
        const float nl = s.nl[i];
        const float lit = nl > 0.f ? 1.f : 0.f;
        const float gl = 1 - nl, gv = 1 - s.nv[i];
        const float gl4 = gl * gl * gl * gl, gv4 = gv * gv * gv * gv;
        const float fl = 1 - f0 - rest * gl4 * gl, fv = 1 - f0 - rest * gv4 * gv;
        const float fh = f0 + rest * o.vh5[i];
        const float inner = albedo * fl * fv + s.lobe[i] * fh;
        const float by_nl = inner + nl * albedo * 5 * rest * gl4 * fv;
        const float by_nv = nl * albedo * fl * 5 * rest * gv4;
        r[i] = lit * nl * inner - value[i];
        jp[i] = lit * (by_nl * s.nlp[i] + by_nv * s.nvp[i] + nl * fh * s.lobep[i]);
        jq[i] = lit * (by_nl * s.nlq[i] + by_nv * s.nvq[i] + nl * fh * s.lobeq[i]);
        ja[i] = lit * nl * fh * s.lobea[i];
        jb[i] = lit * nl * fl * fv;
        jf[i] = lit * nl * (s.lobe[i] * (1 + grows * o.vh5[i]) -
                            albedo * ((1 + grows * gl4 * gl) * fv + fl * (1 + grows * gv4 * gv)));
    }
}

CLONES void add_squares(const float* r, float* square, int n, float scale) {
#pragma GCC ivdep
    for (int i = 0; i < n; ++i) square[i] += scale * r[i] * r[i];
}

// Sums over pairs of w J'J (lower triangle, 15) and w J'r (5) for one channel, in one pass.
CLONES void sums_of(const float* w, const float* r, const float* j0, const float* j1,
                    const float* j2, const float* j3, const float* j4, int n, float* out) {
    float lane[20][kLanes] = {};
    for (int i = 0; i < n; i += kLanes)
        for (int k = 0; k < kLanes; ++k) {
            const float a = j0[i + k], b = j1[i + k], c = j2[i + k], d = j3[i + k], e = j4[i + k];
            const float wk = w[i + k], rk = r[i + k];
            const float wa = wk * a, wb = wk * b, wc = wk * c, wd = wk * d, we = wk * e;
            lane[0][k] += wa * a;
            lane[1][k] += wb * a, lane[2][k] += wb * b;
            lane[3][k] += wc * a, lane[4][k] += wc * b, lane[5][k] += wc * c;
            lane[6][k] += wd * a, lane[7][k] += wd * b, lane[8][k] += wd * c, lane[9][k] += wd * d;
            lane[10][k] += we * a, lane[11][k] += we * b, lane[12][k] += we * c;
            lane[13][k] += we * d, lane[14][k] += we * e;
            lane[15][k] += wa * rk, lane[16][k] += wb * rk, lane[17][k] += wc * rk;
            lane[18][k] += wd * rk, lane[19][k] += we * rk;
        }
    for (int at = 0; at < 20; ++at) {
        out[at] = 0;
        for (float part : lane[at]) out[at] += part;
    }
}

// Geman-McClure: weights (1 + x)^-2 of the pairs, and the error, x = square / scale^2.
CLONES float soften(const float* weight, const float* square, float* w, int n, float scale2) {
    float lane[kLanes] = {};
    const float inverse = 1 / scale2;
    for (int i = 0; i < n; i += kLanes)
        for (int k = 0; k < kLanes; ++k) {
            const float down = 1 / (1 + square[i + k] * inverse);
            w[i + k] = weight[i + k] * down * down;
            lane[k] += weight[i + k] * square[i + k] * down;
        }
    float sum = 0;
    for (float part : lane) sum += part;
    return sum;
}

bool solve(double* a, double* b, int n) {  // Cholesky in place; false where not positive
    for (int j = 0; j < n; ++j) {
        double d = a[j * n + j];
        for (int k = 0; k < j; ++k) d -= a[j * n + k] * a[j * n + k];
        if (!(d > 1e-30)) return false;
        d = std::sqrt(d);
        a[j * n + j] = d;
        for (int i = j + 1; i < n; ++i) {
            double s = a[i * n + j];
            for (int k = 0; k < j; ++k) s -= a[i * n + k] * a[j * n + k];
            a[i * n + j] = s / d;
        }
    }
    for (int i = 0; i < n; ++i) {
        for (int k = 0; k < i; ++k) b[i] -= a[i * n + k] * b[k];
        b[i] /= a[i * n + i];
    }
    for (int i = n - 1; i >= 0; --i) {
        for (int k = i + 1; k < n; ++k) b[i] -= a[k * n + i] * b[k];
        b[i] /= a[i * n + i];
    }
    return true;
}

template <int C>
struct Texel {
    static constexpr int P = 3 + 2 * C;
    Pairs pairs;
    Shape shape;
    std::vector<float> room, square, w, order;
    float *r[C], *jp[C], *jq[C], *ja[C], *jb[C], *jf[C];

    explicit Texel(int most) {
        pairs.reserve(most, C);
        const int n = pairs.stride();
        shape.reserve(n);
        room.assign(size_t(n) * 6 * C, 0.f);
        float* at = room.data();
        for (int c = 0; c < C; ++c)
            for (float** part : {&r[c], &jp[c], &jq[c], &ja[c], &jb[c], &jf[c]}) *part = at, at += n;
        square.assign(n, 0.f), w.assign(n, 0.f), order.assign(n, 0.f);
    }
    void evaluate(const float* t) {
        shape_of(pairs, t, shape);
        std::fill(square.begin(), square.begin() + pairs.padded, 0.f);
        for (int c = 0; c < C; ++c) {
            channel_of(pairs, shape, t[3 + 2 * c], t[4 + 2 * c], pairs.value + c * pairs.stride(),
                       r[c], jp[c], jq[c], ja[c], jb[c], jf[c]);
            add_squares(r[c], square.data(), pairs.padded, 1.f / C);
        }
    }
    float soften_all(float scale2) {
        return soften(pairs.weight, square.data(), w.data(), pairs.padded, scale2);
    }
    // The deviation of most pairs: the median of their distances, of those with half a weight.
    float deviation() {
        int n = 0;
        for (int i = 0; i < pairs.m; ++i)
            if (pairs.weight[i] >= 0.5f) order[n++] = square[i];
        if (n == 0)
            for (int i = 0; i < pairs.m; ++i) order[n++] = square[i];
        std::nth_element(order.begin(), order.begin() + n / 2, order.begin() + n);
        return 1.4826f * std::sqrt(order[n / 2]);
    }
    void normal_equations(double* a, double* g) {
        std::fill(a, a + P * P, 0.), std::fill(g, g + P, 0.);
        for (int c = 0; c < C; ++c) {
            const int slot[5] = {0, 1, 2, 3 + 2 * c, 4 + 2 * c};
            float sums[20];
            sums_of(w.data(), r[c], jp[c], jq[c], ja[c], jb[c], jf[c], pairs.padded, sums);
            for (int i = 0, at = 0; i < 5; ++i) {
                g[slot[i]] += sums[15 + i] / C;
                for (int k = 0; k <= i; ++k, ++at) {
                    a[slot[i] * P + slot[k]] += sums[at] / C;
                    if (i != k) a[slot[k] * P + slot[i]] += sums[at] / C;
                }
            }
        }
    }
};

struct Asked {
    const float *values, *weight, *light, *view, *place, *prior, *floor;
    int64_t t;
    int m, rounds;
    bool near_light, near_view;
    bool is_free[kMost];
};

void direction(const float* from, const float* place, bool near, float* out) {
    if (!near) {
        out[0] = from[0], out[1] = from[1], out[2] = from[2];
        return;
    }
    const float x = from[0] - place[0], y = from[1] - place[1], z = from[2] - place[2];
    const float part = 1 / std::sqrt(std::max(x * x + y * y + z * z, 1e-30f));
    out[0] = x * part, out[1] = y * part, out[2] = z * part;
}

float clamped(int k, float v) {
    if (k < 2) return std::clamp(v, -20.f, 20.f);
    if (k == 2) return std::clamp(v, kLeast, 1.f);
    return k % 2 ? std::clamp(v, 0.f, kMostAlbedo) : std::clamp(v, 0.f, 1.f);
}

// One texel: theta (P,) in place; found: deviation, share of weight kept, slope variances pp pq qq.
template <int C>
void fit_one(const Asked& q, Texel<C>& x, int64_t at, float* theta, float* found) {
    constexpr int P = Texel<C>::P;
    Pairs& o = x.pairs;
    int count = 0;
    float total = 0;
    for (int i = 0; i < q.m; ++i) {
        const float weight = q.weight[at * q.m + i];
        const float* value = q.values + (at * q.m + i) * C;
        bool good = weight > 0;
        for (int c = 0; c < C; ++c) good = good && std::isfinite(value[c]);
        if (!good) continue;
        float l[3], v[3];
        direction(q.light + 3 * i, q.place + 3 * at, q.near_light, l);
        direction(q.view + 3 * i, q.place + 3 * at, q.near_view, v);
        o.put(count, l, v);
        o.weight[count] = weight;
        for (int c = 0; c < C; ++c) o.value[c * o.stride() + count] = value[c];
        total += weight;
        ++count;
    }
    std::fill(found, found + 5, NAN);
    int unknown = 0;
    for (int k = 0; k < P; ++k) unknown += q.is_free[k];
    if (count * C < unknown || count < 3 || total <= 0) return;
    o.close(count, C);
    float start[kMost], best[kMost], trial[kMost];
    for (int k = 0; k < P; ++k) best[k] = start[k] = theta[k] = clamped(k, theta[k]);
    const float least = q.floor[at];
    x.evaluate(best);
    float sigma = std::max(x.deviation(), least), scale2 = 9 * sigma * sigma;
    const auto pulled = [&](const float* t) {
        double sum = 0;
        for (int k = 0; k < P; ++k) {
            const double off = t[k] - start[k];
            sum += q.prior[k] * off * off;
        }
        return sum;
    };
    double error = x.soften_all(scale2) + sigma * sigma * pulled(best);
    double a[kMost * kMost], g[kMost], m[kMost * kMost], b[kMost];
    x.normal_equations(a, g);
    double damping = 1e-2;
    for (int round = 0; round < q.rounds; ++round) {
        const double noise = double(sigma) * sigma;
        int n = 0, slot[kMost];
        for (int k = 0; k < P; ++k)
            if (q.is_free[k]) slot[n++] = k;
        for (int i = 0; i < n; ++i) {
            const int k = slot[i];
            for (int j = 0; j < n; ++j) m[i * n + j] = a[k * P + slot[j]];
            m[i * n + i] += noise * q.prior[k];
            m[i * n + i] += damping * m[i * n + i] + 1e-12 * total;
            b[i] = -(g[k] + noise * q.prior[k] * (best[k] - start[k]));
        }
        double worse = INFINITY;
        if (solve(m, b, n)) {
            std::copy(best, best + P, trial);
            for (int i = 0; i < n; ++i) trial[slot[i]] = clamped(slot[i], float(best[slot[i]] + b[i]));
            x.evaluate(trial);
            worse = x.soften_all(scale2) + noise * pulled(trial);
        }
        if (worse < error) {
            const bool settled = error - worse < 1e-4 * error && round > 3;
            std::copy(trial, trial + P, best);
            // Shadows and highlights stand out only once the rest fits.
            sigma = std::max(std::min(x.deviation(), sigma), least), scale2 = 9 * sigma * sigma;
            error = x.soften_all(scale2) + double(sigma) * sigma * pulled(best);
            x.normal_equations(a, g);
            damping = std::max(damping / 6, 1e-6);
            if (settled) break;
        } else {
            damping *= 8;
            if (damping > 1e6) break;
        }
    }
    std::copy(best, best + P, theta);
    x.evaluate(best);
    x.soften_all(scale2);
    float kept = 0, left = 0;
    for (int i = 0; i < count; ++i) {
        kept += std::sqrt(o.weight[i] * x.w[i]);
        left += x.w[i] * x.square[i];
    }
    found[0] = std::sqrt(left / std::max(kept, 1e-12f));
    found[1] = kept / total;
    found[2] = found[3] = found[4] = 0;
    if (!q.is_free[0] || !q.is_free[1]) return;
    x.normal_equations(a, g);
    const double noise = std::max(double(found[0]) * found[0], double(least) * least);
    double column[2][kMost];
    for (int which = 0; which < 2; ++which) {
        int n = 0, slot[kMost];
        for (int k = 0; k < P; ++k)
            if (q.is_free[k]) slot[n++] = k;
        for (int i = 0; i < n; ++i) {
            for (int j = 0; j < n; ++j) m[i * n + j] = a[slot[i] * P + slot[j]];
            m[i * n + i] += noise * q.prior[slot[i]] + 1e-12 * total;
            b[i] = slot[i] == which;
        }
        if (!solve(m, b, n)) {
            found[2] = found[4] = INFINITY;
            return;
        }
        std::copy(b, b + 2, column[which]);
    }
    found[2] = float(noise * column[0][0]);
    found[3] = float(noise * column[0][1]);
    found[4] = float(noise * column[1][1]);
}

template <int C>
void fit_all(const Asked& q, float* theta, float* found, int threads) {
    constexpr int P = Texel<C>::P;
    spread(q.t, 16, threads, [&](int, int64_t from, int64_t to) {
        Texel<C> room(q.m);
        for (int64_t at = from; at < to; ++at)
            fit_one<C>(q, room, at, theta + at * P, found + at * 5);
    });
}

void fit(In<float> values, In<float> weight, In<float> light, In<float> view, In<float> place,
         In<float> prior, In<float> floor, In<unsigned char> is_free, bool near_light,
         bool near_view, int rounds, int threads, Out<float> theta, Out<float> found) {
    require(values.ndim() == 3 && weight.ndim() == 2, "values (t, m, c) and weight (t, m)");
    Asked q{};
    q.t = int64_t(values.shape(0));
    q.m = int(values.shape(1));
    const int c = int(values.shape(2)), p = 3 + 2 * c;
    require(c == 1 || c == 3, "one or three channels");
    require(int64_t(weight.size()) == q.t * q.m, "weight has another size than values");
    require(int64_t(light.size()) == 3 * q.m && int64_t(view.size()) == 3 * q.m, "directions");
    require(int64_t(place.size()) == 3 * q.t && int64_t(floor.size()) == q.t, "places");
    require(int(prior.size()) == p && int(is_free.size()) == p, "priors");
    require(int64_t(theta.size()) == p * q.t && int64_t(found.size()) == 5 * q.t, "room");
    q.values = values.data(), q.weight = weight.data(), q.light = light.data();
    q.view = view.data(), q.place = place.data(), q.prior = prior.data(), q.floor = floor.data();
    q.near_light = near_light, q.near_view = near_view, q.rounds = rounds;
    for (int k = 0; k < p; ++k) q.is_free[k] = is_free.data()[k] != 0;
    nb::gil_scoped_release release;
    if (c == 1)
        fit_all<1>(q, theta.data(), found.data(), threads);
    else
        fit_all<3>(q, theta.data(), found.data(), threads);
}

// Values (t, m, 1) of grey texels (t, 5) under m pairs: the model alone.
void shade(In<float> light, In<float> view, In<float> theta, int threads, Out<float> values) {
    const int64_t t = int64_t(theta.size()) / 5;
    const int m = int(light.size() / 3);
    require(int64_t(theta.size()) == 5 * t && int64_t(view.size()) == 3 * m, "directions");
    require(int64_t(values.size()) == t * m, "room for the values");
    nb::gil_scoped_release release;
    spread(t, 16, threads, [&](int, int64_t from, int64_t to) {
        Texel<1> room(m);
        for (int i = 0; i < m; ++i) {
            room.pairs.put(i, light.data() + 3 * i, view.data() + 3 * i);
            room.pairs.value[i] = 0;
        }
        room.pairs.close(m, 1);
        for (int64_t at = from; at < to; ++at) {
            room.evaluate(theta.data() + 5 * at);
            std::copy(room.r[0], room.r[0] + m, values.data() + at * m);
        }
    });
}

}  // namespace

NB_MODULE(_lobe, m) {
    m.def("fit", &fit);
    m.def("shade", &shade);
}
