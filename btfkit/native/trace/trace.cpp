// Light on a relief: view ray, shadow ray, Lambert and GGX, bounces; on the plane and on cylinders.
// Face and numpy twin: __init__.py. Lengths in texels.

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <atomic>
#include <cstdint>
#include <stdexcept>
#include <thread>
#include <vector>

#include "march.hpp"

namespace nb = nanobind;
using namespace trace;

namespace {

constexpr float kPi = 3.14159265358979f;
constexpr float kLift = 1e-3f;       // start of secondary rays above the surface, texels
constexpr float kSteepest = 0.01f;   // lowest z of a traced direction: 89.4 degrees
constexpr float kWidest = 1e6f;      // footprints beyond this are taken for this, texels
constexpr float kLevels = 253;       // of the table of cells over the range of heights
constexpr int kMostChannels = 64;
constexpr int kSeen = 5;             // column, row, height, visibility, met

using FloatIn = nb::ndarray<const float, nb::c_contig, nb::device::cpu>;
using ByteIn = nb::ndarray<const unsigned char, nb::c_contig, nb::device::cpu>;
using IntIn = nb::ndarray<const int, nb::c_contig, nb::device::cpu>;
using FloatOut = nb::ndarray<float, nb::c_contig, nb::device::cpu>;

// Counter-based random numbers (PCG output function): sample i of query q is the same on any thread.
inline uint32_t hash(uint32_t x) {
  uint32_t state = x * 747796405u + 2891336453u;
  uint32_t word = ((state >> ((state >> 28u) + 4u)) ^ state) * 277803737u;
  return (word >> 22u) ^ word;
}
inline uint32_t mixed(uint32_t a, uint32_t b, uint32_t c, uint32_t d) {
  return hash(a ^ hash(b ^ hash(c ^ hash(d))));
}
inline float to_unit(uint32_t x) {
  return (static_cast<float>(x >> 8) + 0.5f) * (1.0f / 16777216.0f);
}

// Three channels have code of their own (C = 3); any other number shares the rest (C = kMostChannels).
template <int C>
struct Surface {
  Vec normal, tangent, bitangent;
  float albedo[C], specular[C];
  float along, across, opacity;
};

template <int C>
inline int channels(const Relief& r) { return C == 3 ? 3 : r.c; }

template <int C>
inline void surface_at(const Relief& r, const Patch& p, Point at, bool framed, Surface<C>& s) {
  const int c = channels<C>(r), k = r.k;
  int i0 = wrapped(at.i, r.w, r.wrap), i1 = wrapped(at.i + 1, r.w, r.wrap);
  int j0 = wrapped(at.j, r.h, r.wrap), j1 = wrapped(at.j + 1, r.h, r.wrap);
  const float* m00 = r.maps + (static_cast<size_t>(j0) * r.w + i0) * k;
  const float* m10 = r.maps + (static_cast<size_t>(j0) * r.w + i1) * k;
  const float* m01 = r.maps + (static_cast<size_t>(j1) * r.w + i0) * k;
  const float* m11 = r.maps + (static_cast<size_t>(j1) * r.w + i1) * k;
  // By differences: four equal values give just that value, whatever rounding and contraction do.
  auto bilinear = [&](int plane) {
    const int n = r.slot[plane];
    if (n < 0) return r.constant[plane];
    float upper = m10[n] - m00[n], lower = m11[n] - m01[n];
    return m00[n] + at.a * upper + at.b * (m01[n] - m00[n] + at.a * (lower - upper));
  };
  for (int n = 0; n < c; ++n) {
    s.albedo[n] = bilinear(n);
    s.specular[n] = bilinear(c + n);
  }
  s.along = bilinear(2 * c);
  s.across = bilinear(2 * c + 1);
  s.opacity = std::min(std::max(bilinear(2 * c + 3), 0.0f), 1.0f);
  Corners q = corners(r, at.i, at.j);
  // Rows run against y: dz/dy = -dz/drow.
  Vec n{-(q.ha + q.hab * at.b), q.hb + q.hab * at.a, 1};
  const float wide = 1 + p.k * at.z;  // a cylinder is so much wider at height z
  if (p.k != 0) {
    float slope = (n.x * p.ex + n.y * p.ey) * (1 / wide - 1);
    n = {n.x + p.ex * slope, n.y + p.ey * slope, 1};
  }
  s.normal = unit(n);
  if (!framed && s.along == s.across) return;
  // Angles do not average: the tangent is that of the nearest centre.
  const float* nearest = at.a < 0.5f ? (at.b < 0.5f ? m00 : m01) : (at.b < 0.5f ? m10 : m11);
  const int slot = r.slot[2 * c + 2];
  const float angle = slot < 0 ? r.constant[2 * c + 2] : nearest[slot];
  Vec t{1, 0, 0};
  if (angle != 0) t = {std::cos(angle), std::sin(angle), 0};
  if (p.k != 0) {
    float flat = (t.x * p.ex + t.y * p.ey) * (wide - 1);
    t = {t.x + p.ex * flat, t.y + p.ey * flat, 0};
  }
  s.tangent = unit(sum(t, scaled(s.normal, -dot(t, s.normal))));
  s.bitangent = cross(s.normal, s.tangent);
}

inline float schlick(float f0, float f90, float cosine) {
  float m = 1 - cosine, m2 = m * m;
  return f0 + (f90 - f0) * (m2 * m2 * m);
}

// pi f (n . light) of Lambert under GGX with Smith's masking and Schlick's Fresnel; adds scale times it.
// Sources: Walter et al. 2007 (GGX), Heitz 2014 (masking), Schlick 1994, Ashikhmin and Shirley 2000
// (what the gloss leaves to the diffuse part).
template <int C>
inline void shade(const Surface<C>& s, int c, Vec light, Vec view, const float* scale, float* out) {
  float nl = dot(s.normal, light), nv = dot(s.normal, view);
  if (nl <= 0) return;
  nv = std::max(nv, 1e-4f);
  Vec half = unit(sum(light, view));
  float nh = std::max(dot(s.normal, half), 0.0f), vh = std::max(dot(view, half), 0.0f);
  // The square of the half vector, and of light and view, in the ellipse of the roughness.
  auto squared = [&](Vec v, float along, float across) {
    float x = along * dot(s.tangent, v), y = across * dot(s.bitangent, v);
    return x * x + y * y;
  };
  float h2, l2, v2;
  if (s.along == s.across) {
    Vec aside = sum(half, scaled(s.normal, -dot(s.normal, half)));
    float alpha2 = s.along * s.along;
    h2 = dot(aside, aside) / alpha2, l2 = alpha2 * (1 - nl * nl), v2 = alpha2 * (1 - nv * nv);
  } else {
    h2 = squared(half, 1 / s.along, 1 / s.across);
    l2 = squared(light, s.along, s.across), v2 = squared(view, s.along, s.across);
  }
  float d = h2 + nh * nh;
  float masked = (nl + std::sqrt(nl * nl + std::max(l2, 0.0f))) *
                 (nv + std::sqrt(nv * nv + std::max(v2, 0.0f)));
  // pi D G1 G1 / (4 nl nv), both Smith factors with their cosines cancelled.
  float lobe = 1 / (s.along * s.across * (d * d) * masked);
  for (int n = 0; n < c; ++n) {
    float f0 = s.specular[n], f90 = std::min(1.0f, 50 * f0);
    float diffuse = s.albedo[n] * (1 - schlick(f0, f90, nl)) * (1 - schlick(f0, f90, nv));
    out[n] += scale[n] * (diffuse + lobe * schlick(f0, f90, vh)) * nl;
  }
}

inline Vec lifted(Vec v) {
  if (v.z >= kSteepest) return v;
  float flat = std::sqrt(std::max(v.x * v.x + v.y * v.y, 1e-30f));
  float keep = std::sqrt(1 - kSteepest * kSteepest) / flat;
  return {v.x * keep, v.y * keep, kSteepest};
}

// From a point along d until it hits, or leaves.
inline CurvedHit intersect(const Relief& r, const Patch& p, Point at, Vec d) {
  if (p.k != 0) return march_curved(r, p, at, d);
  // Nothing is met after this: below the lowest point, or above the highest; one more for rounding.
  float last = d.z < 0 ? (at.z - r.lowest) / -d.z : (d.z > 0 ? (r.highest - at.z) / d.z : kFar);
  Hit hit = march(r, {at, d.x, -d.y, d.z}, std::min(std::max(last, 0.0f), kFar) + 1);
  // Rounding may let a ray end below all heights: it has hit the last cell it was in.
  if (!hit.met && d.z < 0) hit = {true, {hit.at.i, hit.at.j, hit.at.a, hit.at.b, r.lowest}, hit.t};
  return {hit, {}};
}

inline Point above(Point at, Vec normal) {
  return moved(at, kLift * normal.x, -kLift * normal.y, kLift * normal.z);
}

// The view ray: through the place on z = 0, from where it comes into the layer of the relief.
inline CurvedHit first_hit(const Relief& r, const Patch& p, float col, float row, Vec v) {
  float up = r.highest + kLift;
  if (p.k == 0) {
    float slope = up / v.z;
    return intersect(r, p, point(col + v.x * slope, row - v.y * slope, up), scaled(v, -1));
  }
  // |centre + t v| = 1/k + up; where a concave patch has no such t, the ray begins half-way across.
  float c = up * (2 + p.k * up), square = v.z * v.z + p.k * c;
  if (square < 0 && p.k > 0) return {{false, point(col, row, 0), 0}, {}};
  Line line(p, 0, v);
  Line::At start = line.at(square < 0 ? -v.z / p.k : c / (v.z + std::sqrt(square)));
  float da = start.s * p.ex - start.a * p.ey, db = -(start.s * p.ey + start.a * p.ex);
  Point from = moved(point(col, row, 0), da, db, start.dz);
  CurvedHit inside = march_curved(r, p, from, p.turned(scaled(v, -1), start.turn));
  Turn a = start.turn, b = inside.turn;
  return {inside.hit, {a.cosine * b.cosine - a.sine * b.sine, a.sine * b.cosine + a.cosine * b.sine}};
}

// One ray of a query, followed to the relief: its offset in the footprint, and what it met.
struct Look { uint32_t query, index; float dc, dr; Patch patch; CurvedHit seen; };

// pi x radiance that reaches a ray from its hit, added to rgb; whether the light reaches the hit.
template <int C>
inline bool lit(const Relief& r, const Look& ray, Surface<C>& s, Vec light, Vec view, int bounces,
                uint32_t seed, float* rgb) {
  const Patch& p = ray.patch;
  const int c = channels<C>(r);
  // The plane goes on for ever and hides every light below its horizon; a cylinder does not.
  if (p.k == 0 && light.z <= 0) return false;
  Point at = ray.seen.hit.at;
  bool visible = false;
  float throughput[C];
  for (int n = 0; n < c; ++n) throughput[n] = 1;
  light = p.turned(light, ray.seen.turn);
  Vec outgoing = p.turned(view, ray.seen.turn);
  for (int bounce = 0;; ++bounce) {
    if (dot(s.normal, light) > 0) {
      Vec towards = p.k == 0 ? lifted(light) : light;
      if (!intersect(r, p, above(at, s.normal), towards).hit.met) {
        visible |= bounce == 0;
        shade(s, c, light, outgoing, throughput, rgb);
      }
    }
    if (bounce == bounces) return visible;
    // Cosine-weighted about the normal: f cos / pdf = pi f.
    float u1 = to_unit(mixed(ray.query, ray.index, 16 + 2 * bounce, seed));
    float u2 = to_unit(mixed(ray.query, ray.index, 17 + 2 * bounce, seed));
    float radius = std::sqrt(u1), angle = 2 * kPi * u2;
    Vec next = sum(sum(scaled(s.tangent, radius * std::cos(angle)),
                       scaled(s.bitangent, radius * std::sin(angle))),
                   scaled(s.normal, std::sqrt(1 - u1)));
    float gain[C];
    for (int n = 0; n < c; ++n) gain[n] = 0;
    shade(s, c, next, outgoing, throughput, gain);
    float nl = std::max(dot(s.normal, next), 1e-6f);
    for (int n = 0; n < c; ++n) throughput[n] = gain[n] / nl;
    CurvedHit onward = intersect(r, p, above(at, s.normal), next);
    if (!onward.hit.met) return visible;
    at = onward.hit.at;
    surface_at(r, p, at, true, s);
    light = p.turned(light, onward.turn);
    outgoing = p.turned(scaled(next, -1), onward.turn);
    if (dot(s.normal, outgoing) <= 0) return visible;
  }
}

struct Queries { const float *place, *light, *view, *footprint, *curvature; };
struct Answers { float *rgb, *opacity, *seen; };

inline Patch patch(float curvature, const float* view) {
  if (curvature == 0) return {};
  float flat = std::sqrt(view[0] * view[0] + view[1] * view[1]);
  if (flat < 1e-6f) return {curvature, 1, 0};
  return {curvature, view[0] / flat, view[1] / flat};
}

inline Vec vec(const float* v) { return {v[0], v[1], v[2]}; }

inline Look look(const Relief& r, const Queries& in, size_t q, int i, int samples, uint32_t seed) {
  const float *place = in.place + 2 * q, *view = in.view + 3 * q;
  const uint32_t query = static_cast<uint32_t>(q), index = static_cast<uint32_t>(i);
  float dc = 0, dr = 0;
  if (samples > 1) {
    // Strata of equal probability from the middle outwards, turned by the golden angle.
    float u1 = static_cast<float>(i) + to_unit(mixed(query, index, 0, seed));
    u1 = std::min(u1 / static_cast<float>(samples), 0.99999994f);
    float angle = 2 * kPi * to_unit(mixed(query, 1, 1, seed) + index * 2654435769u);
    float radius = std::min(in.footprint[q], kWidest) * std::sqrt(-2 * std::log1p(-u1));
    dc = radius * std::cos(angle);
    dr = radius * std::sin(angle);
  }
  const Patch p = patch(in.curvature[q], view);
  return {query, index, dc, dr, p, first_hit(r, p, place[0] + dc, place[1] + dr, lifted(vec(view)))};
}

// The maps are far larger than the near caches, and where a ray ends is known late: ask for them as
// soon as it is, and use them after other rays have been followed. (Always inline: GCC takes a
// function that does nothing else for one without effect, and drops the call.)
[[gnu::always_inline]] inline void fetch(const Relief& r, const Hit& hit) {
  if (!hit.met) return;
  for (int down = 0; down < 2; ++down) {
    int i = wrapped(hit.at.i, r.w, r.wrap), j = wrapped(hit.at.j + down, r.h, r.wrap);
    const float* texel = r.maps + (static_cast<size_t>(j) * r.w + i) * r.k;
    __builtin_prefetch(texel);
    if (r.k > 0) __builtin_prefetch(texel + 2 * r.k - 1);
  }
}

// Adds one ray to the sums of its query.
template <int C>
inline void add(const Relief& r, const Queries& in, const Answers& out, const Look& ray, int bounces,
                uint32_t seed) {
  if (!ray.seen.hit.met) return;
  const size_t q = ray.query;
  const int c = channels<C>(r);
  const Point at = ray.seen.hit.at;
  float one[C], *rgb = out.rgb + q * c, *seen = out.seen + kSeen * q;
  for (int n = 0; n < c; ++n) one[n] = 0;
  Surface<C> s;
  surface_at(r, ray.patch, at, bounces > 0, s);
  const float opacity = s.opacity;
  if (opacity > 0)
    seen[3] += lit(r, ray, s, vec(in.light + 3 * q), vec(in.view + 3 * q), bounces, seed, one);
  for (int n = 0; n < c; ++n) rgb[n] += opacity * one[n];
  out.opacity[q] += opacity;
  seen[0] += static_cast<float>(at.i) + (at.a - ray.dc);
  seen[1] += static_cast<float>(at.j) + (at.b - ray.dr);
  seen[2] += at.z;
  seen[4] += 1;
}

// From sums over the samples to means.
inline void finish(const Relief& r, const Queries& in, const Answers& out, size_t q, int samples) {
  float *rgb = out.rgb + q * r.c, *seen = out.seen + kSeen * q;
  const float cover = out.opacity[q], met = seen[4];
  for (int n = 0; n < r.c; ++n) rgb[n] = cover > 0 ? rgb[n] / cover : 0;
  for (int n = 0; n < 4; ++n) seen[n] = met > 0 ? seen[n] / met : (n < 2 ? in.place[2 * q + n] : 0);
  out.opacity[q] = cover / static_cast<float>(samples);
  seen[4] = met / static_cast<float>(samples);
}

template <int C>
void answer(const Relief& r, const Queries& in, const Answers& out, size_t begin, size_t end,
            int samples, int bounces, uint32_t seed) {
  constexpr int kBlock = 32;
  Look rays[kBlock];
  std::fill(out.rgb + begin * r.c, out.rgb + end * r.c, 0.0f);
  std::fill(out.opacity + begin, out.opacity + end, 0.0f);
  std::fill(out.seen + begin * kSeen, out.seen + end * kSeen, 0.0f);
  int waiting = 0;
  for (size_t q = begin; q < end; ++q)
    for (int i = 0; i < samples; ++i) {
      rays[waiting] = look(r, in, q, i, samples, seed);
      fetch(r, rays[waiting].seen.hit);
      if (++waiting < kBlock && (q + 1 < end || i + 1 < samples)) continue;
      for (int n = 0; n < waiting; ++n) add<C>(r, in, out, rays[n], bounces, seed);
      waiting = 0;
    }
  for (size_t q = begin; q < end; ++q) finish(r, in, out, q, samples);
}

void run(FloatIn height, ByteIn level, float lowest, float highest, FloatIn maps, IntIn slot,
         FloatIn constant, bool wrap, FloatIn place, FloatIn light,
         FloatIn view, FloatIn footprint, FloatIn curvature, int samples, int bounces, uint32_t seed,
         int threads, FloatOut rgb, FloatOut opacity, FloatOut seen) {
  const Relief r{height.data(), level.data(), maps.data(), slot.data(), constant.data(),
                 static_cast<int>(height.shape(0)), static_cast<int>(height.shape(1)), static_cast<int>(rgb.shape(1)),
                 static_cast<int>(maps.shape(2)), wrap, lowest, highest,
                 highest > lowest ? kLevels / (highest - lowest) : 0};
  if (r.c > kMostChannels) throw std::invalid_argument("at most 64 channels");
  const Queries in{place.data(), light.data(), view.data(), footprint.data(), curvature.data()};
  const Answers out{rgb.data(), opacity.data(), seen.data()};
  const size_t count = place.shape(0), chunk = 1024;
  const auto many = r.c == 3 ? answer<3> : answer<kMostChannels>;
  std::atomic<size_t> next{0};
  auto work = [&]() {
    for (size_t begin; (begin = next.fetch_add(chunk)) < count;)
      many(r, in, out, begin, std::min(begin + chunk, count), samples, bounces, seed);
  };
  nb::gil_scoped_release release;
  std::vector<std::thread> pool;
  for (int n = 1; n < threads; ++n) pool.emplace_back(work);
  work();
  for (auto& thread : pool) thread.join();
}

}  // namespace

NB_MODULE(_trace, m) {
  m.def("trace", &run, nb::arg("height"), nb::arg("level"), nb::arg("lowest"), nb::arg("highest"), nb::arg("maps"), nb::arg("slot"), nb::arg("constant"), nb::arg("wrap"),
        nb::arg("place"), nb::arg("light"), nb::arg("view"), nb::arg("footprint"),
        nb::arg("curvature"), nb::arg("samples"), nb::arg("bounces"), nb::arg("seed"),
        nb::arg("threads"), nb::arg("rgb").noconvert(), nb::arg("opacity").noconvert(),
        nb::arg("seen").noconvert());
}
