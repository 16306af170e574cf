// Light on a relief: view ray, shadow ray, Lambert and GGX, bounces. Twin: trace.py.
//
// All lengths are in texels: column and row count texel centres (row runs down, so it is -y),
// heights are in texel edges. Between four centres the height is bilinear; along a ray through
// such a cell, ray height minus relief is a quadratic, so the first hit is exact and none is skipped.

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <atomic>
#include <cmath>
#include <cstdint>
#include <thread>
#include <vector>

namespace nb = nanobind;

namespace {

constexpr float kPi = 3.14159265358979f;
constexpr float kLift = 1e-3f;          // start of secondary rays above the surface, texels
constexpr float kSteepest = 0.01f;      // lowest z of a traced direction: 89.4 degrees
constexpr int kMostChannels = 64;

using FloatIn = nb::ndarray<const float, nb::c_contig, nb::device::cpu>;
using FloatOut = nb::ndarray<float, nb::c_contig, nb::device::cpu>;

struct Vec { float x, y, z; };          // surface frame: x right, y up, z out

inline float dot(Vec a, Vec b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
inline Vec scaled(Vec a, float s) { return {a.x * s, a.y * s, a.z * s}; }
inline Vec sum(Vec a, Vec b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
inline Vec unit(Vec a) { return scaled(a, 1.0f / std::sqrt(std::max(dot(a, a), 1e-30f))); }
inline Vec cross(Vec a, Vec b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}

// Counter-based random numbers (PCG output function): sample i of query q is the same on any thread.
inline uint32_t hash(uint32_t x) {
  uint32_t state = x * 747796405u + 2891336453u;
  uint32_t word = ((state >> ((state >> 28u) + 4u)) ^ state) * 277803737u;
  return (word >> 22u) ^ word;
}
inline float uniform(uint32_t a, uint32_t b, uint32_t c, uint32_t d) {
  uint32_t h = hash(a ^ hash(b ^ hash(c ^ hash(d))));
  return (static_cast<float>(h >> 8) + 0.5f) * (1.0f / 16777216.0f);
}

struct Relief {
  const float* height;   // (h, w)
  const float* cellmax;  // (h, w): highest corner of the cell below and right of a centre
  const float* maps;     // (h, w, k): albedo c, specular c, alpha, alpha across, tangent, opacity
  int h, w, c, k;
  bool wrap;
  float lowest, highest;
};

inline int wrapped(int i, int n, bool wrap) {
  if (!wrap) return i < 0 ? 0 : (i >= n ? n - 1 : i);
  i %= n;
  return i < 0 ? i + n : i;
}

struct Place { int i, j; float a, b; };  // cell (column i, row j) and place in it, 0..1

inline Place placed(float col, float row) {
  float fc = std::floor(col), fr = std::floor(row);
  return {static_cast<int>(fc), static_cast<int>(fr), col - fc, row - fr};
}

struct Corners { float h00, ha, hb, hab; };  // height = h00 + ha a + hb b + hab a b

inline Corners corners(const Relief& r, int i, int j) {
  int i1 = wrapped(i + 1, r.w, r.wrap), j1 = wrapped(j + 1, r.h, r.wrap);
  int i0 = wrapped(i, r.w, r.wrap), j0 = wrapped(j, r.h, r.wrap);
  float h00 = r.height[j0 * r.w + i0], h10 = r.height[j0 * r.w + i1];
  float h01 = r.height[j1 * r.w + i0], h11 = r.height[j1 * r.w + i1];
  return {h00, h10 - h00, h01 - h00, h11 - h10 - h01 + h00};
}

inline float height_at(const Corners& q, float a, float b) {
  return q.h00 + q.ha * a + q.hb * b + q.hab * a * b;
}

struct Hit { bool found; Place at; float z; };

// First crossing from above to below of a ray from (col, row, z) along (da, db, dz) texels.
inline Hit march(const Relief& r, float col, float row, float z0, float da, float db, float dz) {
  const float inf = 1e30f;
  Place at = placed(col, row);
  const int si = da > 0 ? 1 : -1, sj = db > 0 ? 1 : -1;
  const float pa = da != 0 ? 1 / std::fabs(da) : inf, pb = db != 0 ? 1 / std::fabs(db) : inf;
  float ta = da != 0 ? (da > 0 ? 1 - at.a : at.a) * pa : inf;
  float tb = db != 0 ? (db > 0 ? 1 - at.b : at.b) * pb : inf;
  // Nothing is met after this: below the lowest point, or above the highest.
  const float last = dz < 0 ? (z0 - r.lowest) / -dz : (dz > 0 ? (r.highest - z0) / dz : 1e6f);
  int i = at.i, j = at.j;
  int wi = wrapped(i, r.w, r.wrap), wj = wrapped(j, r.h, r.wrap);
  float t0 = 0, z = z0;
  for (;;) {
    const float t1 = std::min(std::min(ta, tb), std::max(last, 0.0f) + 1);
    const float zend = z0 + dz * t1;
    const size_t cell = static_cast<size_t>(wj) * r.w + wi;
    if (std::min(z, zend) <= r.cellmax[cell]) {
      const Corners q = corners(r, i, j);
      const float a = std::min(std::max(at.a + (at.i - i) + da * t0, 0.0f), 1.0f);
      const float b = std::min(std::max(at.b + (at.j - j) + db * t0, 0.0f), 1.0f);
      const float q0 = z - height_at(q, a, b);
      const float q1 = dz - q.ha * da - q.hb * db - q.hab * (a * db + b * da);
      const float q2 = -q.hab * da * db;
      float t = inf;
      if (q0 <= 0) {
        t = 0;
      } else {
        const float disc = q1 * q1 - 4 * q2 * q0;
        if (disc >= 0) {
          const float below = -q1 + std::sqrt(disc);
          if (below > 0) t = 2 * q0 / below;
        }
      }
      if (t <= t1 - t0) return {true, {i, j, a + da * t, b + db * t}, z + dz * t};
    }
    if (t1 > last) break;
    z = zend;
    t0 = t1;
    if (ta <= tb) {
      ta += pa;
      i += si;
      if (r.wrap) { wi += si; if (wi == r.w) wi = 0; else if (wi < 0) wi = r.w - 1; }
      else wi = wrapped(i, r.w, false);
    } else {
      tb += pb;
      j += sj;
      if (r.wrap) { wj += sj; if (wj == r.h) wj = 0; else if (wj < 0) wj = r.h - 1; }
      else wj = wrapped(j, r.h, false);
    }
  }
  // Rounding may let a ray end below all heights: it has hit the last cell it was in.
  return {dz < 0, {i, j, std::min(std::max(at.a + (at.i - i) + da * t0, 0.0f), 1.0f),
                   std::min(std::max(at.b + (at.j - j) + db * t0, 0.0f), 1.0f)},
          dz < 0 ? r.lowest : z};
}

struct Surface {
  Vec normal, tangent, bitangent;
  float albedo[kMostChannels], specular[kMostChannels];
  float along, across, opacity;
};

inline Vec normal_at(const Relief& r, Place at) {
  Corners q = corners(r, at.i, at.j);
  // Rows run against y: dz/dy = -dz/drow.
  return unit({-(q.ha + q.hab * at.b), q.hb + q.hab * at.a, 1});
}

inline void surface_at(const Relief& r, Place at, Surface& s) {
  int i0 = wrapped(at.i, r.w, r.wrap), i1 = wrapped(at.i + 1, r.w, r.wrap);
  int j0 = wrapped(at.j, r.h, r.wrap), j1 = wrapped(at.j + 1, r.h, r.wrap);
  float w11 = at.a * at.b, w10 = at.a - w11, w01 = at.b - w11, w00 = 1 - at.a - at.b + w11;
  const float* m00 = r.maps + static_cast<size_t>(j0 * r.w + i0) * r.k;
  const float* m10 = r.maps + static_cast<size_t>(j0 * r.w + i1) * r.k;
  const float* m01 = r.maps + static_cast<size_t>(j1 * r.w + i0) * r.k;
  const float* m11 = r.maps + static_cast<size_t>(j1 * r.w + i1) * r.k;
  auto mixed = [&](int n) { return w00 * m00[n] + w10 * m10[n] + w01 * m01[n] + w11 * m11[n]; };
  for (int n = 0; n < r.c; ++n) {
    s.albedo[n] = mixed(n);
    s.specular[n] = mixed(r.c + n);
  }
  s.along = mixed(2 * r.c);
  s.across = mixed(2 * r.c + 1);
  s.opacity = std::min(mixed(2 * r.c + 3), 1.0f);
  // Angles do not average: the tangent is that of the nearest centre.
  const float* nearest = at.a < 0.5f ? (at.b < 0.5f ? m00 : m01) : (at.b < 0.5f ? m10 : m11);
  float angle = nearest[2 * r.c + 2];
  s.normal = normal_at(r, at);
  Vec t{1, 0, 0};
  if (angle != 0) t = {std::cos(angle), std::sin(angle), 0};
  t = unit(sum(t, scaled(s.normal, -dot(t, s.normal))));
  s.tangent = t;
  s.bitangent = cross(s.normal, t);
}

inline float schlick(float f0, float f90, float cosine) {
  float m = 1 - cosine, m2 = m * m;
  return f0 + (f90 - f0) * m2 * m2 * m;
}

// pi f (n . light) of Lambert under GGX with Smith's masking and Schlick's Fresnel; adds scale times it.
inline void shade(const Surface& s, int c, Vec light, Vec view, const float* scale, float* out) {
  float nl = dot(s.normal, light), nv = dot(s.normal, view);
  if (nl <= 0) return;
  nv = std::max(nv, 1e-4f);
  Vec half = unit(sum(light, view));
  float nh = std::max(dot(s.normal, half), 0.0f), vh = std::max(dot(view, half), 0.0f);
  float hx = dot(s.tangent, half) / s.along, hy = dot(s.bitangent, half) / s.across;
  float d = hx * hx + hy * hy + nh * nh;
  float distribution = 1 / (kPi * s.along * s.across * d * d);
  auto masked = [&](Vec v, float nvv) {
    float x = s.along * dot(s.tangent, v), y = s.across * dot(s.bitangent, v);
    return nvv + std::sqrt(nvv * nvv + x * x + y * y);
  };
  // G1 G1 / (4 nl nv), both Smith factors with their cosines cancelled.
  float visible = 1 / (masked(light, nl) * masked(view, nv));
  for (int n = 0; n < c; ++n) {
    float f0 = s.specular[n], f90 = std::min(1.0f, 50 * f0);
    float diffuse = s.albedo[n] * (1 - schlick(f0, f90, nl)) * (1 - schlick(f0, f90, nv));
    float gloss = kPi * distribution * visible * schlick(f0, f90, vh);
    out[n] += scale[n] * (diffuse + gloss) * nl;
  }
}

inline Vec lifted(Vec v) {
  if (v.z >= kSteepest) return v;
  float flat = std::sqrt(std::max(v.x * v.x + v.y * v.y, 1e-30f));
  float keep = std::sqrt(1 - kSteepest * kSteepest) / flat;
  return {v.x * keep, v.y * keep, kSteepest};
}

inline bool occluded(const Relief& r, Place at, float z, Vec normal, Vec light) {
  float col = at.i + at.a + kLift * normal.x, row = at.j + at.b - kLift * normal.y;
  Vec l = lifted(light);
  return march(r, col, row, z + kLift * normal.z, l.x, -l.y, l.z).found;
}

// One sample: radiance times pi, opacity, and where it was seen.
struct Sample { float opacity, col, row, z, visible; };

inline Sample sample(const Relief& r, float col, float row, Vec light, Vec view, int bounces,
                     uint32_t query, uint32_t index, uint32_t seed, float* rgb) {
  Vec v = lifted(view);
  float up = r.highest + kLift;
  float slope = up / v.z;
  Hit hit = march(r, col + v.x * slope, row - v.y * slope, up, -v.x, v.y, -v.z);
  Surface s;
  surface_at(r, hit.at, s);
  Sample found{s.opacity, hit.at.i + hit.at.a, hit.at.j + hit.at.b, hit.z, 0};
  if (s.opacity <= 0 || light.z <= 0) return found;
  float throughput[kMostChannels];
  for (int n = 0; n < r.c; ++n) throughput[n] = 1;
  Vec outgoing = view;
  for (int bounce = 0;; ++bounce) {
    if (dot(s.normal, light) > 0 && !occluded(r, hit.at, hit.z, s.normal, light)) {
      if (bounce == 0) found.visible = 1;
      shade(s, r.c, light, outgoing, throughput, rgb);
    }
    if (bounce == bounces) break;
    // Cosine-weighted about the normal: f cos / pdf = pi f.
    float u1 = uniform(query, index, 16 + 2 * bounce, seed);
    float u2 = uniform(query, index, 17 + 2 * bounce, seed);
    float radius = std::sqrt(u1), angle = 2 * kPi * u2;
    Vec next = sum(sum(scaled(s.tangent, radius * std::cos(angle)),
                       scaled(s.bitangent, radius * std::sin(angle))),
                   scaled(s.normal, std::sqrt(1 - u1)));
    float gain[kMostChannels] = {};
    shade(s, r.c, next, outgoing, throughput, gain);
    float nl = std::max(dot(s.normal, next), 1e-6f);
    for (int n = 0; n < r.c; ++n) throughput[n] = gain[n] / nl;
    float c0 = hit.at.i + hit.at.a + kLift * s.normal.x;
    float r0 = hit.at.j + hit.at.b - kLift * s.normal.y;
    hit = march(r, c0, r0, hit.z + kLift * s.normal.z, next.x, -next.y, next.z);
    if (!hit.found) break;
    surface_at(r, hit.at, s);
    outgoing = scaled(next, -1);
    if (dot(s.normal, outgoing) <= 0) break;
  }
  return found;
}

void trace(FloatIn height, FloatIn cellmax, FloatIn maps, bool wrap, FloatIn place, FloatIn light,
           FloatIn view, FloatIn footprint, int samples, int bounces, uint32_t seed, int threads,
           FloatOut rgb, FloatOut opacity, FloatOut seen) {
  Relief r{height.data(), cellmax.data(), maps.data(), static_cast<int>(height.shape(0)),
           static_cast<int>(height.shape(1)), static_cast<int>(rgb.shape(1)),
           static_cast<int>(maps.shape(2)), wrap, 1e30f, -1e30f};
  if (r.c > kMostChannels) throw std::invalid_argument("at most 64 channels");
  for (int n = 0; n < r.h * r.w; ++n) {
    r.lowest = std::min(r.lowest, r.height[n]);
    r.highest = std::max(r.highest, r.height[n]);
  }
  const size_t count = place.shape(0), chunk = 1024;
  std::atomic<size_t> next{0};
  auto work = [&]() {
    float one[kMostChannels];
    for (size_t begin; (begin = next.fetch_add(chunk)) < count;) {
      for (size_t q = begin; q < std::min(begin + chunk, count); ++q) {
        const float* p = place.data() + 2 * q;
        const float* l = light.data() + 3 * q;
        const float* v = view.data() + 3 * q;
        float* out = rgb.data() + q * r.c;
        float cover = 0, total[5] = {};
        for (int n = 0; n < r.c; ++n) out[n] = 0;
        for (int i = 0; i < samples; ++i) {
          float dc = 0, dr = 0;
          if (samples > 1) {
            float u1 = uniform(q, i, 0, seed), u2 = uniform(q, i, 1, seed);
            float radius = footprint.data()[q] * std::sqrt(-2 * std::log(u1));
            dc = radius * std::cos(2 * kPi * u2);
            dr = radius * std::sin(2 * kPi * u2);
          }
          for (int n = 0; n < r.c; ++n) one[n] = 0;
          Sample s = sample(r, p[0] + dc, p[1] + dr, {l[0], l[1], l[2]}, {v[0], v[1], v[2]},
                            bounces, static_cast<uint32_t>(q), i, seed, one);
          for (int n = 0; n < r.c; ++n) out[n] += s.opacity * one[n];
          cover += s.opacity;
          total[0] += s.col - dc; total[1] += s.row - dr; total[2] += s.z; total[3] += s.visible;
        }
        if (cover > 0) for (int n = 0; n < r.c; ++n) out[n] /= cover;
        opacity.data()[q] = cover / samples;
        for (int n = 0; n < 4; ++n) seen.data()[4 * q + n] = total[n] / samples;
      }
    }
  };
  nb::gil_scoped_release release;
  std::vector<std::thread> pool;
  for (int n = 1; n < threads; ++n) pool.emplace_back(work);
  work();
  for (auto& thread : pool) thread.join();
}

}  // namespace

NB_MODULE(_trace, m) {
  m.def("trace", &trace, nb::arg("height"), nb::arg("cellmax"), nb::arg("maps"), nb::arg("wrap"),
        nb::arg("place"), nb::arg("light"), nb::arg("view"), nb::arg("footprint"), nb::arg("samples"),
        nb::arg("bounces"), nb::arg("seed"), nb::arg("threads"), nb::arg("rgb").noconvert(),
        nb::arg("opacity").noconvert(), nb::arg("seen").noconvert());
}
