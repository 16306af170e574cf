// What a NeuMIP model looks like to its kernels: textures, networks, and where all of it lies.
#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <stdexcept>
#include <string>
#include <vector>

#include "conventions.hpp"

namespace neumip {

using namespace conventions;

constexpr int kMaxBanks = 4;
constexpr int kChannels = 8;   // floats a texel; a bank uses the first `channels` of them

enum Activation { kLinear = 0, kRelu = 1, kLeaky = 2, kSine = 3 };
enum Output { kLog = 0, kLogRelu = 1, kLogMask = 2 };
enum Loss { kSquare = 0, kAbsolute = 1 };
constexpr const char* kActivationNames[] = {"linear", "relu", "leaky", "sine"};
constexpr const char* kOutputNames[] = {"log", "relu", "mask"};

// Place of a name in a table of names.
template <size_t N>
int code_of(const char* const (&names)[N], const std::string& name, const char* what) {
    for (size_t i = 0; i < N; ++i)
        if (name == names[i]) return int(i);
    throw std::invalid_argument(std::string("the kernels do not know the ") + what + " " + name);
}

struct Texture {
    int h, w;
    int64_t start;  // texels before it
};

// A pyramid of textures that is read at u + view * H(view) - light * H(light).
struct Bank {
    int channels, first, count;
    float view, light, shift;  // shift: level of the data at which the pyramid begins
};

struct Mlp {
    std::vector<int> widths;      // inputs, hidden ..., outputs
    std::vector<int> directions;  // which inputs follow the features
    int activation = kRelu;
    size_t start = 0;             // floats before it in the flat weights
    int layers() const { return int(widths.size()) - 1; }
    int features() const { return widths[0] - int(directions.size()); }
    bool needs_half() const {
        return std::any_of(directions.begin(), directions.end(), [](int d) { return d >= kHx && d <= kCosDiff; });
    }
    size_t size() const {
        size_t n = 0;
        for (int l = 0; l < layers(); ++l) n += size_t(widths[l] + 1) * widths[l + 1];
        return n;
    }
};

struct Plan {
    bool wrap = true, offset = false;
    bool curved = false;  // whether curvature bends rays through heights, which may pass them
    int looks = 1;        // at most along a ray that may pass
    bool holes = false;   // whether curved heights have an opacity, a float a texel behind them
    float aspect = 1, depth_scale = 1;
    int output = kLog, channels = 3;
    int frames = 0;  // vectors among the first features: the decoder takes their products with
                     // the half vector and with the light
    bool half = false;   // products of bfloat16 in evaluation, after each network's first layer
    bool pairs = false;  // whether the processor multiplies them by pairs
    std::vector<Texture> textures;
    Bank offset_bank{};
    Texture heights{0, 0, 0};  // one float a texel, first of all; h = 0 where there are none
    std::vector<Bank> banks;
    Mlp offset_mlp, decoder;

    // Texels that hold one float for each height.
    int64_t plane() const { return (int64_t(heights.h) * heights.w + kChannels - 1) / kChannels; }
    size_t weights() const { return (offset ? offset_mlp.size() : 0) + decoder.size(); }
    int64_t texels() const {
        int64_t n = plane() * (1 + holes);
        for (const auto& t : textures) n = std::max(n, t.start + int64_t(t.h) * t.w);
        return n;
    }
    int features() const {
        int n = 0;
        for (const auto& b : banks) n += b.channels;
        return n;
    }
    bool needs_half() const { return frames > 0 || decoder.needs_half(); }
    bool depth() const { return offset || heights.h > 0; }
    bool needs_light() const {
        for (const auto& b : banks)
            if (b.light != 0) return true;
        return false;
    }
};

inline void check(const Mlp& mlp) {
    require(mlp.layers() >= 1 && mlp.layers() <= 8, "a network has 1 to 8 layers");
    for (int width : mlp.widths) require(width >= 1 && width <= 128, "layer widths are 1 to 128");
    for (int code : mlp.directions) {
        require(code >= 0 && code < kInputs, "unknown input");
    }
    require(mlp.activation >= kLinear && mlp.activation <= kSine, "unknown activation");
    require(mlp.features() >= 1, "a network needs at least one feature");
}

// Everything the kernels trust later is checked here, once.
inline void check(const Plan& plan) {
    require(!plan.banks.empty() && plan.banks.size() <= kMaxBanks, "1 to 4 banks of textures");
    for (const auto& t : plan.textures)
        require(t.h >= 1 && t.w >= 1 && t.start >= 0 && int64_t(t.h) * t.w < (int64_t(1) << 30),
                "texture sizes are 1 to 2^30 texels");
    require(plan.texels() < (int64_t(1) << 31), "more than 2^31 texels");
    auto bank = [&](const Bank& b) {
        require(b.channels >= 1 && b.channels <= kChannels, "a bank has 1 to 8 channels");
        require(b.count >= 1 && b.count <= 16 && b.first >= 0 &&
                    size_t(b.first + b.count) <= plan.textures.size(),
                "a bank has 1 to 16 levels");
    };
    require(!(plan.offset && plan.heights.h), "depths from a network or from heights, not both");
    require(int64_t(plan.heights.h) * plan.heights.w < (int64_t(1) << 30), "2^30 heights or more");
    require(!plan.curved || plan.heights.h > 0, "curvature bends rays through heights alone");
    require(plan.looks >= 1, "a ray is looked at once at least");
    require(!plan.holes || plan.curved, "holes are those of curved heights");
    auto takes_curvature = [](const Mlp& m) {
        return std::count(m.directions.begin(), m.directions.end(), int(kCurvature)) > 0;
    };
    require(plan.curved || !takes_curvature(plan.decoder),
            "the input curvature is that of curved heights");
    require(!plan.offset || !takes_curvature(plan.offset_mlp),
            "the offset network knows no curvature");
    for (const auto& b : plan.banks) bank(b);
    require(plan.frames >= 0 && 3 * plan.frames <= plan.banks[0].channels,
            "a frame takes three channels of the first bank");
    check(plan.decoder);
    require(plan.decoder.features() == plan.features() + 2 * plan.frames, "the decoder's inputs do not fit its banks");
    const int raw = plan.output == kLogMask ? 2 * plan.channels : plan.channels;
    require(plan.channels >= 1 && plan.decoder.widths.back() == raw,
            "the decoder's outputs do not fit the channels");
    if (plan.offset) {
        bank(plan.offset_bank);
        require(plan.offset_bank.count == 1, "the offset texture has one level");
        check(plan.offset_mlp);
        require(plan.offset_mlp.features() == plan.offset_bank.channels &&
                    plan.offset_mlp.widths.back() == 1,
                "the offset network takes its texture's channels and gives one number");
    }
}

// Where a batch lies; null where a part is absent. Vectors are rows of 2, 3 or c floats.
constexpr float kQuadMost = 65535.f;

// A plane of numbers for marches, which look at many: the four around each place, 16 bits each of
// the way from the least to the greatest, side by side. One row and one column come before it, for
// places between the last and the first, or before the first.
struct QuadView {
    const uint64_t* at = nullptr;
    float low = 0, step = 0;
};

struct Quads {
    std::vector<uint64_t> at;
    float low = 0, step = 0;

    Quads() = default;
    QuadView view() const { return {at.empty() ? nullptr : at.data(), low, step}; }
    Quads(const float* from, int h, int w, bool wrap) : at(size_t(h + 1) * (w + 1)) {
        const auto [least, most] = std::minmax_element(from, from + size_t(h) * w);
        low = *least;
        step = (*most - low) / 65535.f;
        const auto share = [&](int y, int x) {
            y = wrap ? (y + h) % h : std::clamp(y, 0, h - 1);
            x = wrap ? (x + w) % w : std::clamp(x, 0, w - 1);
            const float s = step > 0.f ? (from[size_t(y) * w + x] - low) / step + 0.5f : 0.f;
            return uint64_t(s > 0.f ? std::min(s, 65535.f) : 0.f);  // what is no number: the least
        };
        for (int y = -1; y < h; ++y)
            for (int x = -1; x < w; ++x)
                at[size_t(y + 1) * (w + 1) + x + 1] = share(y, x) | share(y, x + 1) << 16 |
                                                      share(y + 1, x) << 32 |
                                                      share(y + 1, x + 1) << 48;
    }
};

struct Batch {
    int64_t size = 0;
    const float *uv = nullptr, *light = nullptr, *view = nullptr, *footprint = nullptr;
    const float *curvature = nullptr;  // 1 / tile width; null is the plane
    const float *drift = nullptr;      // four a query, of rays that curvature bends; null is 0
    const float *target = nullptr, *weight = nullptr;
    float top = 0, bottom = 0;  // of the heights
    QuadView quads, cover_quads;  // of frozen curved heights; else without `at`
};

struct Gradient {
    float* weights = nullptr;  // summed over tiles
    float* texels = nullptr;
    uint8_t* touched = nullptr;  // one a pair of texels, that is a cache line
    double loss = 0;
    int64_t counted = 0;
};

}  // namespace neumip
