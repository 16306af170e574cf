// NeuMIP: evaluation, gradients and optimisation in fused kernels. Face and numpy twin: __init__.py, plain.py.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <ctime>
#include <memory>
#include <string>
#include <vector>

#if defined(__x86_64__)
#include <immintrin.h>
#endif
#if defined(__linux__)
#include <sys/mman.h>
#endif

#include "../arrays.hpp"
#include "../spread.hpp"
#include "../processor.hpp"
#include "blur.hpp"
#include "plan.hpp"

#define NEUMIP_KEEP(x) asm volatile("" : "+r,m"(x) : : )
#if defined(__x86_64__) && defined(__GNUC__)
#undef NEUMIP_KEEP
#define NEUMIP_KEEP(x) asm volatile("" : "+x"(x))
#define NEUMIP_SPACE avx2
#define NEUMIP_LANES 8
#define NEUMIP_TARGET __attribute__((target("avx2,fma")))
#include "variant.hpp"
#undef NEUMIP_SPACE
#undef NEUMIP_LANES
#undef NEUMIP_TARGET
#define NEUMIP_SPACE avx512
#define NEUMIP_LANES 16
#define NEUMIP_TARGET \
    __attribute__((target("avx512f,avx512vl,avx512dq,avx512bw,avx2,fma" WIDE)))
#include "variant.hpp"
#undef NEUMIP_SPACE
#undef NEUMIP_LANES
#undef NEUMIP_TARGET
#elif defined(__aarch64__)
#undef NEUMIP_KEEP
#define NEUMIP_KEEP(x) asm volatile("" : "+w"(x))
#endif

#define NEUMIP_SPACE baseline
#define NEUMIP_LANES 4
#define NEUMIP_TARGET
#include "variant.hpp"

namespace nb = nanobind;
using namespace neumip;

namespace {

// Which lights queries have: one each, all of them the same, or several each.
enum Lit { kOwn, kShared, kEach };

struct Variant {
    const char* name;
    decltype(&baseline::evaluate) evaluate;
    decltype(&baseline::depths) depths;
    decltype(&baseline::train) train;
    decltype(&baseline::adam) adam;
    decltype(&baseline::peak) peak;
};

#define NEUMIP_VARIANT(space) \
    Variant { #space, space::evaluate, space::depths, space::train, space::adam, space::peak }

std::vector<Variant> supported() {
    std::vector<Variant> found;
#if defined(__x86_64__) && defined(__GNUC__)
    __builtin_cpu_init();
    if (CPU_SUPPORTS("avx512f") && CPU_SUPPORTS("avx512vl") &&
        CPU_SUPPORTS("avx512dq") && CPU_SUPPORTS("avx512bw"))
        found.push_back(NEUMIP_VARIANT(avx512));
    if (CPU_SUPPORTS("avx2") && CPU_SUPPORTS("fma"))
        found.push_back(NEUMIP_VARIANT(avx2));
#endif
    found.push_back(NEUMIP_VARIANT(baseline));
    return found;
}

bool multiplies_pairs() {
#if defined(__x86_64__) && (defined(__clang__) || __GNUC__ >= 10)
    __builtin_cpu_init();
    return CPU_SUPPORTS("avx512bf16");
#else
    return false;
#endif
}

Variant variant(const std::string& name) {
    const auto known = supported();
    if (name.empty()) return known.front();
    for (const auto& v : known)
        if (name == v.name) return v;
    throw std::invalid_argument("this processor has no variant '" + name + "'");
}

// Zeros that begin on a huge page: a texel never lies across two cache lines, and random texels
// of a large texture do not each need a page walk.
class Zeros {
  public:
    explicit Zeros(size_t count) {
        constexpr size_t page = size_t(1) << 21;
        const size_t bytes = count * sizeof(float), align = bytes < page ? 64 : page;
        const size_t whole = (bytes + align - 1) / align * align + (bytes == 0) * align;
        data_.reset(static_cast<float*>(std::aligned_alloc(align, whole)));
        if (!data_) throw std::bad_alloc();
#if defined(__linux__)
        if (align == page) madvise(data_.get(), whole, MADV_HUGEPAGE);
#endif
        std::memset(data_.get(), 0, bytes);
    }
    float* data() { return data_.get(); }
    float operator[](size_t i) const { return data_.get()[i]; }

  private:
    struct Free {
        void operator()(float* p) const { std::free(p); }
    };
    std::unique_ptr<float, Free> data_;
};

// A model's layout, and the scratch that its training keeps between steps.
class Model {
  public:
    // The tables of a plan, by name: see Kernel in __init__.py.
    explicit Model(const nb::dict& tables) {
        Plan& p = plan_;
        p.wrap = nb::cast<bool>(tables["wrap"]);
        p.aspect = nb::cast<float>(tables["aspect"]);
        p.depth_scale = nb::cast<float>(tables["depth_scale"]);
        p.output = code_of(kOutputNames, nb::cast<std::string>(tables["output"]), "output");
        p.channels = nb::cast<int>(tables["channels"]);
        p.frames = nb::cast<int>(tables["frames"]);
        p.curved = nb::cast<bool>(tables["curved"]);
        p.holes = nb::cast<bool>(tables["holes"]);
        p.looks = nb::cast<int>(tables["looks"]);
        p.half = nb::cast<bool>(tables["rounded"]);
        p.pairs = multiplies_pairs();
        for (nb::handle t : tables["textures"])
            p.textures.push_back({nb::cast<int>(t["h"]), nb::cast<int>(t["w"]),
                                  nb::cast<int64_t>(t["start"])});
        for (nb::handle b : tables["banks"]) p.banks.push_back(bank(b));
        const nb::object heights = tables["heights"], offset = tables["offset"];
        if (!heights.is_none()) {
            p.heights = {nb::cast<int>(heights["h"]), nb::cast<int>(heights["w"]), 0};
            require(p.heights.h > 0 && p.heights.w > 0, "heights are (h, w)");
        }
        p.offset = !offset.is_none();
        if (p.offset) {
            p.offset_bank = bank(offset["bank"]);
            p.offset_mlp = network(offset["network"]);
        }
        p.decoder = network(tables["decoder"]);
        check(p);
        p.decoder.start = p.offset ? p.offset_mlp.size() : 0;
    }

    Model(const Model&) = delete;
    Model& operator=(const Model&) = delete;

    // Promises that the texels stay as they are: their range is not looked up again, and marches
    // over curved heights read them as quads.
    void freeze(In<float> t) {
        require(int64_t(t.size()) == texels() * kChannels, "size of the texels");
        frozen_ = false;
        Batch b;
        range(t.data(), b);
        top_ = b.top;
        bottom_ = b.bottom;
        frozen_ = true;
        if (!plan_.curved) return;
        const int h = plan_.heights.h, w = plan_.heights.w;
        quads_ = Quads(t.data(), h, w, plan_.wrap);
        if (plan_.holes)
            cover_quads_ = Quads(t.data() + plan_.plane() * kChannels, h, w, plan_.wrap);
    }

    int64_t weights() const { return int64_t(plan_.weights()); }
    int64_t texels() const { return plan_.texels(); }

    void evaluate(In<float> w, In<float> t, In<float> uv, In<float> light, In<float> view,
                  nb::object footprint, nb::object curvature, nb::object drift, Out<float> rgb,
                  nb::object opacity, int lit, bool raw, int threads,
                  const std::string& name) const {
        Batch b = batch(w, t, uv, view, footprint, curvature);
        if (!drift.is_none()) b.drift = floats(drift, 4 * b.size, "four numbers of drift a query");
        const int64_t outputs = raw ? plan_.decoder.widths.back() : plan_.channels;
        // One light a query, lights that all share, or several of each query's own.
        const bool shared = lit == kShared, each = lit == kEach;
        const int64_t all_lights = int64_t(light.size()) / 3;
        const int64_t lights = each ? all_lights / std::max<int64_t>(b.size, 1) : all_lights;
        require(shared || (each ? lights : 1) * b.size == all_lights, "one light a query");
        require(int64_t(rgb.size()) == (shared || each ? lights : 1) * b.size * outputs, "size of rgb");
        b.light = light.data();
        const auto v = variant(name);
        float *out = rgb.data(), *cover = nullptr;
        if (!opacity.is_none()) {
            require(plan_.curved, "opacity is that of curved heights");
            const auto array = nb::cast<Out<float>>(opacity);
            require(int64_t(array.size()) == b.size, "one opacity a query");
            cover = array.data();
        }
        const float* all = shared || each ? light.data() : nullptr;
        nb::gil_scoped_release release;
        spread(b.size, kGrain, useful(b.size, threads), [&](int, int64_t from, int64_t to) {
            v.evaluate(plan_, w.data(), t.data(), b, all, lights, each, from, to, out, cover, raw);
        });
    }

    void depths(In<float> w, In<float> t, In<float> uv, In<float> view, nb::object curvature,
                Out<float> out, int threads, const std::string& name) const {
        const Batch b = batch(w, t, uv, view, nb::none(), curvature);
        require(int64_t(out.size()) == b.size, "size of the depths");
        const auto v = variant(name);
        nb::gil_scoped_release release;
        spread(b.size, kGrain, useful(b.size, threads), [&](int, int64_t from, int64_t to) {
            v.depths(plan_, w.data(), t.data(), b, from, to, out.data());
        });
    }

    // Adds the gradients of one batch to those kept here; returns (loss, values counted).
    nb::tuple train(In<float> w, In<float> t, In<float> uv, In<float> light, In<float> view,
                    nb::object footprint, nb::object curvature, In<float> target,
                    nb::object weight, int loss, int threads, const std::string& name) {
        Batch b = batch(w, t, uv, view, footprint, curvature);
        require(int64_t(light.size()) == 3 * b.size, "one light a query");
        require(int64_t(target.size()) == plan_.channels * b.size, "size of the targets");
        b.light = light.data();
        b.target = target.data();
        if (!weight.is_none()) b.weight = floats(weight, b.size, "one weight a query");
        const auto v = variant(name);
        threads = useful(b.size, threads);
        grow(threads);
        std::vector<Gradient> part(threads);
        {
            nb::gil_scoped_release release;
            spread(b.size, kGrain, threads, [&](int i, int64_t from, int64_t to) {
                part[i].weights = weights_[i].data();
                part[i].texels = texels_[i].data();
                part[i].touched = touched_[i].data();
                v.train(plan_, w.data(), t.data(), b, loss, from, to, part[i]);
            });
        }
        double sum = 0;
        int64_t counted = 0;
        for (const auto& p : part) {
            sum += p.loss;
            counted += p.counted;
        }
        return nb::make_tuple(sum, counted);
    }

    // The gradients kept here, summed over threads; they stay.
    void gradients(Out<float> w, Out<float> t) const {
        require(int64_t(w.size()) == weights() && int64_t(t.size()) == texels() * kChannels,
                "sizes of the gradients");
        std::fill(w.data(), w.data() + w.size(), 0.f);
        std::fill(t.data(), t.data() + t.size(), 0.f);
        for (size_t i = 0; i < weights_.size(); ++i) {
            for (size_t k = 0; k < w.size(); ++k) w.data()[k] += weights_[i][k];
            for (size_t k = 0; k < t.size(); ++k) t.data()[k] += texels_[i][k];
        }
    }

    // Replaces the gradients kept here by others.
    void replace(In<float> w, In<float> t) {
        require(int64_t(w.size()) == weights() && int64_t(t.size()) == texels() * kChannels,
                "sizes of the gradients");
        grow(1);
        for (size_t i = 0; i < weights_.size(); ++i) {
            std::fill(weights_[i].begin(), weights_[i].end(), 0.f);
            std::fill_n(texels_[i].data(), t.size(), 0.f);
            std::fill(touched_[i].begin(), touched_[i].end(), uint8_t(0));
        }
        std::copy(w.data(), w.data() + w.size(), weights_[0].begin());
        std::copy(t.data(), t.data() + t.size(), texels_[0].data());
        for (size_t k = 0; k < t.size(); ++k)
            touched_[0][k / (2 * kChannels)] |= t.data()[k] != 0;
    }

    // One step of Adam with the gradients kept here, which are zeroed.
    void adam(Out<float> w, Out<float> wm, Out<float> wv, Out<float> t, Out<float> tm,
              Out<float> tv, float lr_weights, float lr_texels, float b1, float b2, float eps,
              int64_t step, bool dense, int threads, const std::string& name) {
        for (const auto& a : {w, wm, wv}) require(int64_t(a.size()) == weights(), "weights");
        for (const auto& a : {t, tm, tv}) require(int64_t(a.size()) == texels() * kChannels, "texels");
        const auto v = variant(name);
        grow(1);
        std::vector<float*> gw, gt;
        std::vector<uint8_t*> marks;
        for (size_t i = 0; i < weights_.size(); ++i) {
            gw.push_back(weights_[i].data());
            gt.push_back(texels_[i].data());
            marks.push_back(touched_[i].data());
        }
        const float s1 = float(1 / (1 - std::pow(double(b1), double(step))));
        const float s2 = float(1 / (1 - std::pow(double(b2), double(step))));
        const int buffers = int(weights_.size());
        nb::gil_scoped_release release;
        v.adam(w.data(), wm.data(), wv.data(), gw.data(), nullptr, buffers, 0, weights(),
               lr_weights, b1, b2, eps, s1, s2, true);
        const int64_t size = texels() * kChannels;
        spread(size, 16 * kChannels, useful(size / 64, threads), [&](int, int64_t from, int64_t to) {
            v.adam(t.data(), tm.data(), tv.data(), gt.data(), marks.data(), buffers, from, to,
                   lr_texels, b1, b2, eps, s1, s2, dense);
        });
    }

  private:
    static Bank bank(nb::handle b) {
        return {nb::cast<int>(b["channels"]), nb::cast<int>(b["first"]),
                nb::cast<int>(b["count"]), nb::cast<float>(b["view"]),
                nb::cast<float>(b["light"]), nb::cast<float>(b["shift"])};
    }
    static Mlp network(nb::handle n) {
        Mlp m;
        m.widths = nb::cast<std::vector<int>>(n["widths"]);
        for (const auto& name : nb::cast<std::vector<std::string>>(n["inputs"]))
            m.directions.push_back(code_of(kInputNames, name, "input"));
        m.activation = code_of(kActivationNames, nb::cast<std::string>(n["activation"]),
                               "activation");
        return m;
    }
    static constexpr int64_t kGrain = 256;
    static int useful(int64_t size, int threads) {
        // A thread below four tiles costs more to start than it saves.
        return int(std::clamp<int64_t>(size / (4 * kGrain), 1, std::max(threads, 1)));
    }
    static const float* floats(const nb::object& o, int64_t size, const char* what) {
        const auto array = nb::cast<In<float>>(o);
        require(int64_t(array.size()) == size, what);
        return array.data();
    }
    Batch batch(const In<float>& w, const In<float>& t, const In<float>& uv,
                const In<float>& view, const nb::object& footprint,
                const nb::object& curvature) const {
        require(int64_t(w.size()) == weights(), "size of the weights");
        require(int64_t(t.size()) == texels() * kChannels, "size of the texels");
        Batch b;
        b.size = int64_t(uv.size()) / 2;
        require(int64_t(view.size()) == 3 * b.size, "one view a query");
        b.uv = uv.data();
        b.view = view.data();
        range(t.data(), b);
        if (!footprint.is_none()) b.footprint = floats(footprint, b.size, "one footprint a query");
        if (!curvature.is_none()) {
            require(plan_.curved, "these heights know no curvature");
            b.curvature = floats(curvature, b.size, "one curvature a query");
        }
        return b;
    }
    // Highest and lowest height: of texels that were frozen, those found then.
    void range(const float* heights, Batch& b) const {
        const int64_t count = int64_t(plan_.heights.h) * plan_.heights.w;
        if (count == 0) return;
        if (frozen_) {
            b.top = top_;
            b.bottom = bottom_;
            b.quads = quads_.view();
            b.cover_quads = cover_quads_.view();
            return;
        }
        float top = -INFINITY, bottom = INFINITY;
        for (int64_t i = 0; i < count; ++i) {
            top = heights[i] > top ? heights[i] : top;
            bottom = heights[i] < bottom ? heights[i] : bottom;
        }
        b.top = top >= bottom ? top : 0.f;
        b.bottom = top >= bottom ? bottom : 0.f;
    }
    void grow(int threads) {
        while (int(weights_.size()) < threads) {
            weights_.emplace_back(plan_.weights(), 0.f);
            texels_.emplace_back(size_t(texels()) * kChannels);
            touched_.emplace_back(size_t(texels() + 1) / 2, 0);
        }
    }

    Plan plan_;
    bool frozen_ = false;
    float top_ = 0, bottom_ = 0;
    Quads quads_, cover_quads_;
    std::vector<std::vector<float>> weights_;
    std::vector<Zeros> texels_;
    std::vector<std::vector<uint8_t>> touched_;
};

}  // namespace

NB_MODULE(_neural, m) {
    nb::class_<Model>(m, "Model")
        .def(nb::init<const nb::dict&>())
        .def_prop_ro("weights", &Model::weights)
        .def_prop_ro("texels", &Model::texels)
        .def("evaluate", &Model::evaluate, nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg(),
             nb::arg().none(), nb::arg().none(), nb::arg().none(), nb::arg(), nb::arg().none(),
             nb::arg(), nb::arg(), nb::arg(), nb::arg())
        .def("freeze", &Model::freeze)
        .def("depths", &Model::depths, nb::arg(), nb::arg(), nb::arg(), nb::arg(),
             nb::arg().none(), nb::arg(), nb::arg(), nb::arg())
        .def("train", &Model::train, nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg(),
             nb::arg().none(), nb::arg().none(), nb::arg(), nb::arg().none(), nb::arg(),
             nb::arg(), nb::arg())
        .def("gradients", &Model::gradients)
        .def("replace", &Model::replace)
        .def("adam", &Model::adam);
    m.def("blur", &neumip::blur);
    m.def("variants", [] {
        std::vector<std::string> names;
        for (const auto& v : supported()) names.emplace_back(v.name);
        return names;
    });
    m.def("peak", [](double seconds, const std::string& name) {
        const auto v = variant(name);
        nb::gil_scoped_release release;
        return v.peak(seconds);
    });
}
