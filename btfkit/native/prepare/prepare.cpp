// What every query goes through before a model answers it. Face and numpy twin: __init__.py.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <stdexcept>
#include <vector>

#include "../arrays.hpp"
#include "../spread.hpp"

namespace nb = nanobind;

namespace {

constexpr int kChunk = 64;
constexpr int64_t kGrain = 1 << 12;  // queries below which another thread costs more than it saves

// Unit vectors of a chunk, by component; good: 1 where there was a direction to normalise.
struct Units {
    alignas(64) float x[kChunk], y[kChunk], z[kChunk];
    alignas(64) int32_t good[kChunk];

    void set(const float* from, int n) {
        for (int i = 0; i < n; ++i) {
            x[i] = from[3 * i];
            y[i] = from[3 * i + 1];
            z[i] = from[3 * i + 2];
        }
        int32_t all = 1;
        for (int i = 0; i < n; ++i) {
            const float square = x[i] * x[i] + y[i] * y[i] + z[i] * z[i];
            const float part = 1.f / std::sqrt(square);
            // Squares beyond float's range, and what is no number, are looked at again below.
            good[i] = (square > 1e-30f) & (square < 1e30f);
            all &= good[i];
            x[i] = good[i] ? x[i] * part : x[i];
            y[i] = good[i] ? y[i] * part : y[i];
            z[i] = good[i] ? z[i] * part : z[i];
        }
        if (all) return;
        for (int i = 0; i < n; ++i) {
            if (good[i]) continue;
            const double length =
                std::sqrt(double(x[i]) * x[i] + double(y[i]) * y[i] + double(z[i]) * z[i]);
            good[i] = std::isfinite(length) && length > 1e-30;
            if (!good[i]) continue;
            x[i] = float(x[i] / length);
            y[i] = float(y[i] / length);
            z[i] = float(z[i] / length);
        }
    }
    // One direction for all queries.
    void fill(const float* from) {
        set(from, 1);
        std::fill(x + 1, x + kChunk, x[0]);
        std::fill(y + 1, y + kChunk, y[0]);
        std::fill(z + 1, z + kChunk, z[0]);
        std::fill(good + 1, good + kChunk, good[0]);
    }
};

// The largest whole number not above v; v itself where it is too large to have a fraction.
inline float floor_of(float v) {
    const float whole = float(int32_t(std::fabs(v) < 8388608.f ? v : 0.f));
    const float below = whole - (whole > v ? 1.f : 0.f);
    return std::fabs(v) < 8388608.f ? below : v;
}
inline double floor_of(double v) {
    if (!(std::fabs(v) < 2147483647.0)) return std::floor(v);
    const double whole = double(int32_t(v));
    return whole - (whole > v ? 1.0 : 0.0);
}

template <class T>
inline float reduced(T v, bool wrap) {
    if (wrap) return float(v - floor_of(v));
    return float(std::min(std::max(v, T(0)), T(1)));
}

struct Parts {
    const void* uv;
    const float *light, *view, *footprint, *curvature;
    bool one_uv, one_light, one_view, one_footprint, one_curvature;
    float *to_uv, *to_light, *to_view, *to_footprint, *to_curvature, *opacity;
    int32_t* rows;
};

struct Found {
    int64_t first = 0, answered = 0, good = 0;
    bool blurred = false, curved = false;
};

// Queries [from, to); those to be answered lie one after the other from row `from` on.
template <class T>
Found prepare_some(const Parts& p, int64_t from, int64_t to, bool wrap, bool below) {
    Units light, view;
    alignas(64) float u[kChunk], v[kChunk], wide[kChunk], bent[kChunk];
    alignas(64) int32_t good[kChunk], answer[kChunk];
    const T* uv = static_cast<const T*>(p.uv);
    if (p.one_light) light.fill(p.light);
    if (p.one_view) view.fill(p.view);
    std::fill(wide, wide + kChunk, p.footprint[0]);
    std::fill(bent, bent + kChunk, p.curvature[0]);
    Found found;
    int64_t out = found.first = from;
    for (int64_t at = from; at < to; at += kChunk) {
        const int n = int(std::min<int64_t>(kChunk, to - at));
        if (!p.one_light) light.set(p.light + 3 * at, n);
        if (!p.one_view) view.set(p.view + 3 * at, n);
        if (!p.one_footprint) std::copy(p.footprint + at, p.footprint + at + n, wide);
        if (!p.one_curvature) std::copy(p.curvature + at, p.curvature + at + n, bent);
        const T* place = uv + (p.one_uv ? 0 : 2 * at);
        const int step = p.one_uv ? 0 : 2;
        int32_t all = 1, some_wide = 0, some_bent = 0;
        for (int i = 0; i < n; ++i) {
            const T a = place[step * i], b = place[step * i + 1];
            u[i] = reduced(a, wrap);
            v[i] = reduced(b, wrap);
            // x - x is 0 for every finite x, and no number for others.
            const int32_t finite = (a - a == 0) & (b - b == 0) &
                                   (wide[i] - wide[i] == 0) & (bent[i] - bent[i] == 0);
            good[i] = finite & light.good[i] & view.good[i] & (view.z[i] >= 0);
            answer[i] = good[i] & (below | (light.z[i] > 0));
            all &= answer[i];
            some_wide |= good[i] & (wide[i] > 0.5f);
            some_bent |= good[i] & (bent[i] != 0);
        }
        found.blurred |= some_wide != 0;
        found.curved |= some_bent != 0;
        for (int i = 0; i < n; ++i) p.opacity[at + i] = float(good[i]);
        for (int i = 0; i < n; ++i) found.good += good[i];
        const auto put = [&](int64_t o, int i) {
            p.to_uv[2 * o] = u[i];
            p.to_uv[2 * o + 1] = v[i];
            p.to_light[3 * o] = light.x[i];
            p.to_light[3 * o + 1] = light.y[i];
            p.to_light[3 * o + 2] = light.z[i];
            p.to_view[3 * o] = view.x[i];
            p.to_view[3 * o + 1] = view.y[i];
            p.to_view[3 * o + 2] = view.z[i];
            p.rows[o] = int32_t(at + i);
            if (!p.one_footprint) p.to_footprint[o] = std::max(wide[i], 0.f);
            if (!p.one_curvature) p.to_curvature[o] = bent[i];
        };
        if (all) {
            for (int i = 0; i < n; ++i) put(out + i, i);
            out += n;
            continue;
        }
        for (int i = 0; i < n; ++i) {
            if (!answer[i]) continue;
            put(out, i);
            ++out;
        }
    }
    found.answered = out - from;
    return found;
}

void close_up(const Parts& p, int64_t from, int64_t count, int64_t to) {
    const auto move = [&](auto* a, int width) {
        std::memmove(a + to * width, a + from * width, sizeof(*a) * size_t(count) * width);
    };
    move(p.to_uv, 2);
    move(p.to_light, 3);
    move(p.to_view, 3);
    move(p.rows, 1);
    if (!p.one_footprint) move(p.to_footprint, 1);
    if (!p.one_curvature) move(p.to_curvature, 1);
}

int64_t rows_of(const char* name, int64_t size, int64_t width, int64_t b) {
    const int64_t rows = size / width;
    if (rows * width != size || (rows != b && rows != 1)) throw std::invalid_argument(name);
    return rows;
}

// Returns (answered, good, blurred, curved).
template <class T>
nb::tuple prepare(In<T> uv, In<float> light, In<float> view, In<float> footprint,
                  In<float> curvature, bool wrap, bool below, Out<float> to_uv,
                  Out<float> to_light, Out<float> to_view, Out<float> to_footprint,
                  Out<float> to_curvature, Out<float> opacity, Out<int32_t> rows, int threads) {
    const int64_t b = int64_t(opacity.size());
    const auto one = [&](const char* name, int64_t size, int64_t width) {
        return rows_of(name, size, width, b) == 1;
    };
    const Parts p{uv.data(), light.data(), view.data(), footprint.data(), curvature.data(),
                  one("uv", int64_t(uv.size()), 2), one("light", int64_t(light.size()), 3),
                  one("view", int64_t(view.size()), 3),
                  one("footprint", int64_t(footprint.size()), 1),
                  one("curvature", int64_t(curvature.size()), 1),
                  to_uv.data(), to_light.data(), to_view.data(), to_footprint.data(),
                  to_curvature.data(), opacity.data(), rows.data()};
    if (int64_t(to_uv.size()) != 2 * b || int64_t(to_light.size()) != 3 * b ||
        int64_t(to_view.size()) != 3 * b || int64_t(rows.size()) != b ||
        (!p.one_footprint && int64_t(to_footprint.size()) != b) ||
        (!p.one_curvature && int64_t(to_curvature.size()) != b))
        throw std::invalid_argument("room for the prepared queries");
    const int parts = int(std::clamp<int64_t>(b / kGrain, 1, std::max(threads, 1)));
    std::vector<Found> found(parts);
    Found sum;
    {
        nb::gil_scoped_release release;
        spread(b, kChunk, parts, [&](int part, int64_t from, int64_t to) {
            found[part] = prepare_some<T>(p, from, to, wrap, below);
        });
        for (const Found& f : found) {
            if (f.answered && f.first != sum.answered) close_up(p, f.first, f.answered, sum.answered);
            sum.answered += f.answered;
            sum.good += f.good;
            sum.blurred |= f.blurred;
            sum.curved |= f.curved;
        }
    }
    return nb::make_tuple(sum.answered, sum.good, sum.blurred, sum.curved);
}

}  // namespace

NB_MODULE(_prepare, m) {
    m.def("prepare32", &prepare<float>);
    m.def("prepare64", &prepare<double>);
}
