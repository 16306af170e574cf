// Factors of a BTF multiplied out: whole windows of images, and scattered values. Twin: __init__.py.

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <memory>
#include <stdexcept>
#include <string>
#include <thread>
#include <vector>

#if defined(__x86_64__) && defined(__GNUC__)
#include <immintrin.h>
#endif

#include "../processor.hpp"

namespace factors {

constexpr float kEpsilon = 1e-5f;
// exp(x) = 2^n exp(r), r = x - n ln 2 within +-0.35, where eight terms of the series suffice.
constexpr float kLog2e = 1.44269504f;
constexpr float kLn2High = 0.693145752f;  // 16 bits: n times it is exact
constexpr float kLn2Low = 1.42860677e-6f;
constexpr float kTaylor[8] = {1, 1, 1 / 2.f, 1 / 6.f, 1 / 24.f, 1 / 120.f, 1 / 720.f, 1 / 5040.f};
constexpr float kLowest = -104.0f, kHighest = 89.0f;  // beyond them exp is 0 and infinite

// Whole images: out (images, texels, channels), rows of `left` packed in groups.
struct Images {
    const float* left;     // groups of rows, each (k, rows of the group)
    const uint8_t* right;  // (.., k) numbers
    const int64_t *down, *along;
    const float* scale;    // a row of left, padded
    int64_t k, rows, images, channels, texels, width;
    bool log;
    float* out;
};

// Rows of the last group where the others have `most`: what is left, rounded up to 3, 6 or 12.
inline int64_t rest(int64_t rows, int64_t most) {
    const int64_t left = rows % most;
    return left == 0 ? 0 : left <= 3 ? 3 : left <= 6 ? 6 : 12;
}

struct Values {
    const uint8_t *left, *right;
    const int64_t *i, *j;
    const float* scale;
    int64_t k;
    bool log;
    float* out;
};

inline float widened(float x) { return x; }
inline float widened(double x) { return float(x); }
inline float widened(uint16_t half) {
    const uint32_t sign = uint32_t(half & 0x8000) << 16, magnitude = half & 0x7fff;
    uint32_t bits;
    float value;
    if (magnitude >= 0x7c00) {  // infinite or NaN
        bits = sign | 0x7f800000 | (magnitude & 0x3ff) << 13;
    } else {
        // As a float32 of an exponent that is 112 too small; the product mends it, subnormals too.
        bits = magnitude << 13;
        std::memcpy(&value, &bits, 4);
        value *= 5.192296858534828e33f;  // 2^112
        std::memcpy(&bits, &value, 4);
        bits |= sign;
    }
    std::memcpy(&value, &bits, 4);
    return value;
}

}  // namespace factors

#if defined(__x86_64__) && defined(__GNUC__)
#define FACTORS_SPACE avx2
#define FACTORS_LANES 8
#define FACTORS_TARGET __attribute__((target("avx2,fma,f16c")))
#include "tile.hpp"
#undef FACTORS_SPACE
#undef FACTORS_LANES
#undef FACTORS_TARGET
#define FACTORS_SPACE avx512
#define FACTORS_LANES 16
#define FACTORS_TARGET \
    __attribute__((target("avx512f,avx512vl,avx512dq,avx512bw,avx2,fma,f16c" WIDE)))
#include "tile.hpp"
#undef FACTORS_SPACE
#undef FACTORS_LANES
#undef FACTORS_TARGET
#endif

#define FACTORS_SPACE baseline
#define FACTORS_LANES 4
#define FACTORS_TARGET
#include "tile.hpp"

namespace nb = nanobind;

namespace {

using Bytes = nb::ndarray<const uint8_t, nb::c_contig, nb::device::cpu>;
using Index = nb::ndarray<const int64_t, nb::c_contig, nb::device::cpu>;
using Floats = nb::ndarray<const float, nb::c_contig, nb::device::cpu>;
using Out = nb::ndarray<float, nb::c_contig, nb::device::cpu>;
using ImagesRun = void (*)(const factors::Images&, std::atomic<int64_t>&, float*);
using ValuesRun = void (*)(const factors::Values&, int64_t, int64_t);

struct Variant {
    const char* name;
    int tile, rows;
    ImagesRun images[3];     // by numbers of 2, 4, 8 bytes
    ValuesRun values[3][3];  // left, right
};

#define FACTORS_VARIANT(space)                                                              \
    Variant {                                                                               \
        #space, factors::space::kTile, factors::space::kRows,                               \
            {factors::space::images<uint16_t>, factors::space::images<float>,               \
             factors::space::images<double>},                                               \
        {                                                                                   \
            {factors::space::values<uint16_t, uint16_t>, factors::space::values<uint16_t, float>, \
             factors::space::values<uint16_t, double>},                                     \
                {factors::space::values<float, uint16_t>, factors::space::values<float, float>,   \
                 factors::space::values<float, double>},                                    \
                {factors::space::values<double, uint16_t>, factors::space::values<double, float>, \
                 factors::space::values<double, double>},                                   \
        }                                                                                   \
    }

std::vector<Variant> supported() {
    std::vector<Variant> found;
#if defined(__x86_64__) && defined(__GNUC__)
    __builtin_cpu_init();
    const bool avx2 = CPU_SUPPORTS("avx2") && CPU_SUPPORTS("fma") &&
                      CPU_SUPPORTS("f16c");
    if (avx2 && CPU_SUPPORTS("avx512f") && CPU_SUPPORTS("avx512vl") &&
        CPU_SUPPORTS("avx512dq") && CPU_SUPPORTS("avx512bw"))
        found.push_back(FACTORS_VARIANT(avx512));
    if (avx2) found.push_back(FACTORS_VARIANT(avx2));
#endif
    found.push_back(FACTORS_VARIANT(baseline));
    return found;
}

std::vector<std::string> variants() {
    std::vector<std::string> names;
    for (const auto& v : supported()) names.push_back(v.name);
    return names;
}

Variant variant(const std::string& name) {
    const auto known = supported();
    if (name.empty()) return known.front();
    for (const auto& v : known)
        if (name == v.name) return v;
    throw std::invalid_argument("this processor has no variant '" + name + "'");
}

void require(bool good, const char* what) {
    if (!good) throw std::invalid_argument(what);
}

// Rows of k numbers, and which of 2, 4, 8 bytes they are.
struct Factor {
    const uint8_t* data;
    int64_t rows, k;
    int type;
};

Factor checked(const Bytes& bytes, int64_t k, int size) {
    require(k >= 1, "factors need a component");
    require(size == 2 || size == 4 || size == 8, "numbers have 2, 4 or 8 bytes");
    require(bytes.size() % (size_t(k) * size) == 0, "a factor ends within a row");
    return {bytes.data(), int64_t(bytes.size() / (size_t(k) * size)), k, size == 2 ? 0 : size / 4};
}

void within(const Index& index, int64_t rows, const char* what) {
    for (size_t n = 0; n < index.size(); ++n)
        require(index.data()[n] >= 0 && index.data()[n] < rows, what);
}

float number(const Factor& factor, int64_t row, int64_t i) {
    const int64_t at = row * factor.k + i;
    uint16_t half;
    float single;
    double twice;
    switch (factor.type) {
        case 0: std::memcpy(&half, factor.data + 2 * at, 2); return factors::widened(half);
        case 1: std::memcpy(&single, factor.data + 4 * at, 4); return single;
        default: std::memcpy(&twice, factor.data + 8 * at, 8); return float(twice);
    }
}

template <class Work>
void on_threads(int64_t threads, const Work& work) {
    std::vector<std::thread> pool;
    for (int64_t n = 1; n < threads; ++n) pool.emplace_back(work, n);
    work(0);
    for (auto& thread : pool) thread.join();
}

void images(Bytes left, int64_t left_k, int left_size, Bytes right, int64_t right_k, int right_size,
            Index rows, Index down, Index along, Floats scale, bool log, int threads,
            const std::string& name, Out out) {
    const Variant run = variant(name);
    const Factor a = checked(left, left_k, left_size), b = checked(right, right_k, right_size);
    require(a.k == b.k, "factors of different numbers of components");
    require(rows.ndim() == 2 && out.ndim() == 4, "rows are (b, c), out is (b, h, w, c)");
    const int64_t count = rows.shape(0), channels = rows.shape(1);
    require(out.shape(0) == rows.shape(0) && out.shape(3) == rows.shape(1) &&
                out.shape(1) == down.size() && out.shape(2) == along.size() && scale.size() == rows.shape(0),
            "out does not fit what is asked for");
    if (out.size() == 0) return;
    within(rows, a.rows, "a row outside the left factor");
    const auto y = std::minmax_element(down.data(), down.data() + down.size());
    const auto x = std::minmax_element(along.data(), along.data() + along.size());
    require(*y.first + *x.first >= 0 && *y.second + *x.second < b.rows, "a texel outside the right factor");

    nb::gil_scoped_release release;
    const int64_t all = count * channels, whole = all / run.rows * run.rows;
    const int64_t last = factors::rest(all, run.rows);
    std::vector<float> packed(size_t((whole + last) * a.k)), scales(size_t(whole + last));
    for (int64_t r = 0; r < all; ++r) {
        scales[r] = scale.data()[r / channels];
        const int64_t wide = r < whole ? run.rows : last, start = r / run.rows * run.rows;
        float* to = packed.data() + start * a.k + r - start;
        for (int64_t i = 0; i < a.k; ++i) to[i * wide] = number(a, rows.data()[r], i);
    }
    const int64_t texels = int64_t(down.size() * along.size());
    const factors::Images job{packed.data(), b.data, down.data(), along.data(), scales.data(), a.k, all,
                              count, channels, texels, int64_t(along.size()), log, out.data()};
    std::atomic<int64_t> next{0};
    // A thread is worth starting for a millisecond's work.
    const int64_t worth = 1 + texels * all * a.k / 10'000'000;
    on_threads(std::min<int64_t>(threads, worth), [&](int64_t) {
        // Aligned to cache lines: the innermost loop reads whole ones.
        std::vector<float> tile(size_t(run.tile * a.k) + 16);
        void* start = tile.data();
        size_t space = tile.size() * sizeof(float);
        run.images[b.type](job, next, static_cast<float*>(std::align(64, sizeof(float), start, space)));
    });
}

void values(Bytes left, int64_t left_k, int left_size, Bytes right, int64_t right_k, int right_size,
            Index i, Index j, Floats scale, bool log, int threads, const std::string& name, Out out) {
    const Variant run = variant(name);
    const Factor a = checked(left, left_k, left_size), b = checked(right, right_k, right_size);
    require(a.k == b.k, "factors of different numbers of components");
    require(i.size() == out.size() && j.size() == out.size() && scale.size() == out.size(),
            "rows, factors and out differ in length");
    within(i, a.rows, "a row outside the left factor");
    within(j, b.rows, "a texel outside the right factor");
    nb::gil_scoped_release release;
    const factors::Values job{a.data, b.data, i.data(), j.data(), scale.data(), a.k, log, out.data()};
    const int64_t count = int64_t(out.size());
    const int64_t parts = std::min<int64_t>(threads, 1 + count * a.k / 1'000'000);
    on_threads(parts, [&](int64_t part) {
        run.values[a.type][b.type](job, count * part / parts, count * (part + 1) / parts);
    });
}

}  // namespace

NB_MODULE(_factors, m) {
    m.def("variants", &variants);
    m.def("images", &images, nb::arg("left"), nb::arg("left_k"), nb::arg("left_size"), nb::arg("right"),
          nb::arg("right_k"), nb::arg("right_size"), nb::arg("rows"), nb::arg("down"), nb::arg("along"),
          nb::arg("scale"), nb::arg("log"), nb::arg("threads"), nb::arg("variant"), nb::arg("out").noconvert());
    m.def("values", &values, nb::arg("left"), nb::arg("left_k"), nb::arg("left_size"), nb::arg("right"),
          nb::arg("right_k"), nb::arg("right_size"), nb::arg("i"), nb::arg("j"), nb::arg("scale"),
          nb::arg("log"), nb::arg("threads"), nb::arg("variant"), nb::arg("out").noconvert());
}
