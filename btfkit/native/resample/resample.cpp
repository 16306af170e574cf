// Pixels of a frame gathered into texels, each with its own footprint. Face and twin: __init__.py.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <stdexcept>
#include <vector>

#include "../arrays.hpp"
#include "../spread.hpp"

namespace nb = nanobind;

namespace {

constexpr int kMostChannels = 32;
constexpr int64_t kGrain = 256;
constexpr int kColours = 3;
// Weights of a row that are made before they are spent.
constexpr int64_t kRun = 256;

struct Frame {
    const float *image, *variance;  // variance may be null
    const float* colours;           // (h, w, 3) of a mosaic between its samples, or null
    int64_t h, w;
    int c, channels;
    int site[2][2];  // channel of a pixel of a mosaic; -1: every pixel has all
};

struct Texels {
    const double* place;  // (t, 2) pixel, column first
    const float* shape;
    float *value, *variance, *coverage;
};

// What a texel has gathered so far.
struct Sums {
    double all[kMostChannels], seen[kMostChannels], value[kMostChannels], variance[kMostChannels];
    double between[kColours], known;  // of the colours at every pixel, and their weight

    void clear(int channels) {
        for (double* sum : {all, seen, value, variance}) std::fill(sum, sum + channels, 0.0);
        std::fill(between, between + kColours, known = 0.0);
    }
    // A run of pixels of a row, from x0 on.
    void run(const Frame& f, int64_t y, int64_t x0, const double* weight, int64_t count) {
        if (f.site[0][0] < 0) {
            for (int64_t i = 0; i < count; ++i) add(f, y, x0 + i, weight[i]);
            return;
        }
        const bool inside = y >= 0 && y < f.h;
        const int64_t first = inside ? std::clamp<int64_t>(-x0, 0, count) : count;
        const int64_t last = inside ? std::clamp<int64_t>(f.w - x0, first, count) : count;
        const int64_t at = y * f.w + x0;
        for (int parity = 0; parity < 2; ++parity) {
            const int channel = f.site[y & 1][(x0 + parity) & 1];
            double a = 0, s = 0, v = 0, q = 0;
            for (int64_t i = parity; i < count; i += 2) a += weight[i];
            for (int64_t i = first + ((first ^ parity) & 1); i < last; i += 2) {
                const float sample = f.image[at + i];
                if (!std::isfinite(sample)) continue;
                s += weight[i];
                v += weight[i] * sample;
                if (f.variance) q += weight[i] * weight[i] * f.variance[at + i];
            }
            all[channel] += a;
            seen[channel] += s;
            value[channel] += v;
            variance[channel] += q;
        }
        if (!f.colours) return;
        double k = 0, r = 0, g = 0, b = 0;
        for (int64_t i = first; i < last; ++i) {
            const float* c = f.colours + (at + i) * kColours;
            if (!std::isfinite(c[0] + c[1] + c[2])) continue;
            k += weight[i];
            r += weight[i] * c[0];
            g += weight[i] * c[1];
            b += weight[i] * c[2];
        }
        known += k;
        between[0] += r;
        between[1] += g;
        between[2] += b;
    }
    void add(const Frame& f, int64_t y, int64_t x, double weight) {
        const bool inside = y >= 0 && y < f.h && x >= 0 && x < f.w;
        if (f.site[0][0] >= 0) {
            one(f, f.site[y & 1][x & 1], inside, y * f.w + x, weight);
        } else {
            for (int k = 0; k < f.c; ++k) one(f, k, inside, (y * f.w + x) * f.c + k, weight);
        }
    }
    void one(const Frame& f, int channel, bool inside, int64_t at, double weight) {
        all[channel] += weight;
        if (!inside) return;
        const float v = f.image[at];
        if (!std::isfinite(v)) return;
        seen[channel] += weight;
        value[channel] += weight * v;
        if (f.variance) variance[channel] += weight * weight * f.variance[at];
    }
    void finish(const Frame& f, const Texels& t, int64_t at) const {
        for (int k = 0; k < f.channels; ++k) {
            const int64_t to = at * f.channels + k;
            const bool any = seen[k] > 1e-6 * std::fabs(all[k]) && all[k] != 0;
            if (f.colours)
                t.value[to] = any && known > 0 ? float(between[k] / known) : NAN;
            else
                t.value[to] = any ? float(value[k] / seen[k]) : NAN;
            t.coverage[to] = all[k] != 0 ? float(seen[k] / all[k]) : 0.f;
            if (f.variance) t.variance[to] = any ? float(variance[k] / (seen[k] * seen[k])) : NAN;
        }
    }
};

// Gaussian of inverse covariance (a, b; b, d), lowered so that it ends at q = cut without a step.
void ewa_some(const Frame& f, const Texels& t, double cut, int64_t from, int64_t to) {
    Sums sums;
    const double floor = std::exp(-cut / 2);
    for (int64_t at = from; at < to; ++at) {
        const double cx = t.place[2 * at], cy = t.place[2 * at + 1];
        const double a = t.shape[3 * at], b = t.shape[3 * at + 1], d = t.shape[3 * at + 2];
        const double det = a * d - b * b;
        sums.clear(f.channels);
        if (std::isfinite(cx + cy) && a > 0 && det > 0) {
            const double tall = std::sqrt(cut * a / det), step = std::exp(-a);
            const int64_t y0 = int64_t(std::ceil(std::max(cy - tall, -1e9)));
            const int64_t y1 = int64_t(std::floor(std::min(cy + tall, 1e9)));
            for (int64_t y = y0; y <= y1; ++y) {
                const double dy = y - cy;
                const double left = cut - det / a * dy * dy;
                if (left <= 0) continue;
                const double half = std::sqrt(left / a), mid = cx - b * dy / a;
                const int64_t x0 = int64_t(std::ceil(mid - half)), x1 = int64_t(std::floor(mid + half));
                const double dx = x0 - cx;
                // Along a row a Gaussian is a geometric series of a geometric series.
                double weight = std::exp(-0.5 * (a * dx * dx + 2 * b * dx * dy + d * dy * dy));
                double ratio = std::exp(-0.5 * (a * (2 * dx + 1) + 2 * b * dy));
                double run[kRun];
                for (int64_t x = x0; x <= x1; x += kRun) {
                    const int64_t count = std::min(kRun, x1 + 1 - x);
                    for (int64_t i = 0; i < count; ++i) {
                        run[i] = std::max(weight - floor, 0.0);
                        weight *= ratio;
                        ratio *= step;
                    }
                    sums.run(f, y, x, run, count);
                }
            }
        }
        sums.finish(f, t, at);
    }
}

// Weights of five pixels in the parabola of the middle one at u = 0..1 across it. The parabola
// has the pixel's mean and fourth-order edges.
inline void parabola(double u, double* weight) {
    const double left = 1 - 4 * u + 3 * u * u, right = u * (3 * u - 2), mean = 6 * u * (1 - u);
    weight[0] = -left / 12;
    weight[1] = 7 * left / 12 - right / 12;
    weight[2] = 7 * (left + right) / 12 + mean;
    weight[3] = 7 * right / 12 - left / 12;
    weight[4] = -right / 12;
}

// The mean over a parallelogram: shape (t, 4) holds d pixel / d texel by rows.
void area_some(const Frame& f, const Texels& t, const double* nodes, const double* weights, int most,
               int64_t from, int64_t to) {
    Sums sums;
    std::vector<double> patch;
    for (int64_t at = from; at < to; ++at) {
        const double cx = t.place[2 * at], cy = t.place[2 * at + 1];
        const float* j = t.shape + 4 * at;
        sums.clear(f.channels);
        const double wide = 0.5 * (std::fabs(j[0]) + std::fabs(j[1]));
        const double tall = 0.5 * (std::fabs(j[2]) + std::fabs(j[3]));
        if (std::isfinite(cx + cy + wide + tall) && std::fabs(cx) < 1e9 && std::fabs(cy) < 1e9) {
            const int64_t x0 = int64_t(std::floor(cx - wide + 0.5)) - 2, y0 = int64_t(std::floor(cy - tall + 0.5)) - 2;
            const int64_t nx = int64_t(std::floor(cx + wide + 0.5)) + 3 - x0;
            const int64_t ny = int64_t(std::floor(cy + tall + 0.5)) + 3 - y0;
            patch.assign(size_t(nx * ny), 0.0);
            const int n = std::clamp(int(std::ceil(1.5 * std::hypot(double(j[0]), double(j[2])))), 3, most);
            const int m = std::clamp(int(std::ceil(1.5 * std::hypot(double(j[1]), double(j[3])))), 3, most);
            const double *pu = nodes + n * most, *wu = weights + n * most;
            const double *pv = nodes + m * most, *wv = weights + m * most;
            for (int r = 0; r < m; ++r)
                for (int s = 0; s < n; ++s) {
                    const double x = cx + j[0] * pu[s] + j[1] * pv[r], y = cy + j[2] * pu[s] + j[3] * pv[r];
                    const double ix = std::floor(x + 0.5), iy = std::floor(y + 0.5);
                    double kx[5], ky[5];
                    parabola(x + 0.5 - ix, kx);
                    parabola(y + 0.5 - iy, ky);
                    double* to_patch = patch.data() + (int64_t(iy) - 2 - y0) * nx + int64_t(ix) - 2 - x0;
                    const double w = wu[s] * wv[r];
                    for (int q = 0; q < 5; ++q)
                        for (int p = 0; p < 5; ++p) to_patch[q * nx + p] += w * ky[q] * kx[p];
                }
            for (int64_t y = 0; y < ny; ++y)
                for (int64_t x = 0; x < nx; ++x) sums.add(f, y0 + y, x0 + x, patch[y * nx + x]);
        }
        sums.finish(f, t, at);
    }
}

void require(bool good, const char* what) {
    if (!good) throw std::invalid_argument(what);
}

Frame framed(In<float> image, In<float> variance, In<int32_t> sites, const In<float>* colours = nullptr) {
    require(image.ndim() == 3 && image.shape(2) >= 1 && image.shape(2) <= kMostChannels, "image is (h, w, c)");
    require(variance.size() == 0 || variance.size() == image.size(), "variance does not fit the image");
    require(sites.size() == 4, "sites are (2, 2)");
    Frame f{image.data(), variance.size() ? variance.data() : nullptr, nullptr, int64_t(image.shape(0)),
            int64_t(image.shape(1)), int(image.shape(2)), int(image.shape(2)), {}};
    int most = -1;
    for (int i = 0; i < 4; ++i) most = std::max(most, f.site[i / 2][i % 2] = sites.data()[i]);
    if (most >= 0) {
        require(f.c == 1 && most < kMostChannels, "a mosaic has one value a pixel");
        for (int i = 0; i < 4; ++i) require(sites.data()[i] >= 0, "a site without a channel");
        f.channels = most + 1;
    }
    if (colours && colours->size()) {
        require(most == kColours - 1 && colours->size() == image.size() * kColours, "colours do not fit a mosaic of three");
        f.colours = colours->data();
    }
    return f;
}

Texels asked(const Frame& f, In<double> place, In<float> shape, size_t numbers, Out<float> value,
             Out<float> variance, Out<float> coverage) {
    require(place.ndim() == 2 && place.shape(1) == 2, "places are (t, 2)");
    const size_t t = place.shape(0);
    require(shape.size() == t * numbers, "shapes do not fit the places");
    require(value.size() == t * f.channels && coverage.size() == value.size(), "out does not fit");
    require(!f.variance || variance.size() == value.size(), "variance out does not fit");
    return {place.data(), shape.data(), value.data(), variance.data(), coverage.data()};
}

void ewa(In<float> image, In<float> image_variance, In<int32_t> sites, In<float> colours, In<double> place,
         In<float> shape, double cut, int threads, Out<float> value, Out<float> variance, Out<float> coverage) {
    const Frame f = framed(image, image_variance, sites, &colours);
    const Texels t = asked(f, place, shape, 3, value, variance, coverage);
    nb::gil_scoped_release release;
    spread(int64_t(place.shape(0)), kGrain, threads,
           [&](int, int64_t from, int64_t to) { ewa_some(f, t, cut, from, to); });
}

void area(In<float> image, In<float> image_variance, In<int32_t> sites, In<double> place, In<float> shape,
          In<double> nodes, In<double> weights, int threads, Out<float> value, Out<float> variance,
          Out<float> coverage) {
    const Frame f = framed(image, image_variance, sites);
    require(f.site[0][0] < 0, "area integration takes no mosaic");
    const Texels t = asked(f, place, shape, 4, value, variance, coverage);
    const int most = int(nodes.shape(1));
    require(nodes.size() == size_t(most + 1) * most && weights.size() == nodes.size() && most >= 3, "nodes are (m + 1, m)");
    nb::gil_scoped_release release;
    spread(int64_t(place.shape(0)), kGrain, threads, [&](int, int64_t from, int64_t to) {
        area_some(f, t, nodes.data(), weights.data(), most, from, to);
    });
}

}  // namespace

NB_MODULE(_resample, m) {
    m.def("ewa", &ewa, nb::arg("image"), nb::arg("image_variance"), nb::arg("sites"), nb::arg("colours"),
          nb::arg("place"), nb::arg("shape"), nb::arg("cut"), nb::arg("threads"), nb::arg("value").noconvert(),
          nb::arg("variance").noconvert(), nb::arg("coverage").noconvert());
    m.def("area", &area, nb::arg("image"), nb::arg("image_variance"), nb::arg("sites"), nb::arg("place"),
          nb::arg("shape"), nb::arg("nodes"), nb::arg("weights"), nb::arg("threads"),
          nb::arg("value").noconvert(), nb::arg("variance").noconvert(), nb::arg("coverage").noconvert());
}
