// Rays against a relief: cells, the marcher on the plane, and the one on a cylinder. Twin: march.py.
//
// All lengths are in texels: column and row count texel centres (row runs down, so it is -y),
// heights are in texel edges. Between four centres the height is bilinear; along a straight ray
// through such a cell, ray height minus relief is a quadratic, so the first hit is exact.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstddef>

namespace trace {

constexpr float kInf = 1e30f;
constexpr float kFar = 1e6f;          // a ray that has gone so far without a hit has left, texels
constexpr float kSag = 1.0f / 256;    // most that a piece of a curved path leaves it, texels
constexpr float kBend = 0.25f;        // most that such a piece turns, radians
constexpr float kLongest = 1024;      // and its length: cells are counted in fractions of it, texels

struct Vec { float x, y, z; };        // surface frame: x right, y up, z out

inline float dot(Vec a, Vec b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
inline Vec scaled(Vec a, float s) { return {a.x * s, a.y * s, a.z * s}; }
inline Vec sum(Vec a, Vec b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
inline Vec unit(Vec a) { return scaled(a, 1.0f / std::sqrt(std::max(dot(a, a), 1e-30f))); }
inline Vec cross(Vec a, Vec b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}

struct Relief {
  const float* height;   // (h, w)
  // (h, w): no less than the highest corner of the cell below and right of a centre, as
  // (height - lowest) scale; bytes, because this table is read in every step and must stay near.
  const unsigned char* level;
  // Albedo c, specular c, alpha, alpha across, tangent, opacity: plane n is plane slot[n] of maps
  // (h, w, k), or the same everywhere (slot < 0); what is not stored need not be fetched.
  const float* maps;
  const int* slot;
  const float* constant;
  int h, w, c, k;
  bool wrap;
  float lowest, highest, scale;
};

inline int wrapped(int i, int n, bool wrap) {
  if (static_cast<unsigned>(i) < static_cast<unsigned>(n)) return i;
  if (!wrap) return i < 0 ? 0 : n - 1;
  i %= n;
  return i < 0 ? i + n : i;
}

// A point over the relief: cell (column i, row j), place in it (0..1), height. Keeping the cell
// apart keeps the precision of the place whatever the size of the relief.
struct Point { int i, j; float a, b, z; };

inline Point point(float col, float row, float z) {
  int i = static_cast<int>(col), j = static_cast<int>(row);
  i -= col < static_cast<float>(i);
  j -= row < static_cast<float>(j);
  return {i, j, col - static_cast<float>(i), row - static_cast<float>(j), z};
}

inline Point moved(Point p, float da, float db, float dz) {
  Point q = point(p.a + da, p.b + db, p.z + dz);
  return {p.i + q.i, p.j + q.j, q.a, q.b, q.z};
}

// height = h00 + ha a + hb b + hab a b
struct Corners { float h00, ha, hb, hab; };

inline Corners corners(const Relief& r, int i, int j) {
  int i0 = wrapped(i, r.w, r.wrap), j0 = wrapped(j, r.h, r.wrap);
  int i1 = wrapped(i + 1, r.w, r.wrap), j1 = wrapped(j + 1, r.h, r.wrap);
  const float *upper = r.height + static_cast<size_t>(j0) * r.w;
  const float *lower = r.height + static_cast<size_t>(j1) * r.w;
  float h00 = upper[i0], h10 = upper[i1], h01 = lower[i0], h11 = lower[i1];
  return {h00, h10 - h00, h01 - h00, h11 - h10 - h01 + h00};
}

struct Hit { bool met; Point at; float t; };

struct Ray {
  Point at;
  float da, db, dz;  // columns, rows and height a unit of t

  float a(int i, float t) const {
    return std::min(std::max(at.a + static_cast<float>(at.i - i) + da * t, 0.0f), 1.0f);
  }
  float b(int j, float t) const {
    return std::min(std::max(at.b + static_cast<float>(at.j - j) + db * t, 0.0f), 1.0f);
  }
};

// Where the ray first meets the height of cell (i, j) from time t on, as time after t. Out of line:
// the way from cell to cell needs the registers.
[[gnu::noinline]] inline float crossing(const Relief& r, const Ray& ray, int i, int j, float t) {
  const Corners q = corners(r, i, j);
  const float a = ray.a(i, t), b = ray.b(j, t), z = ray.at.z + ray.dz * t;
  const float q0 = z - (q.h00 + q.ha * a + q.hb * b + q.hab * (a * b));
  const float q1 = ray.dz - q.ha * ray.da - q.hb * ray.db - q.hab * (a * ray.db + b * ray.da);
  const float q2 = -q.hab * (ray.da * ray.db);
  if (q0 <= 0) return 0;
  const float square = q1 * q1 - 4 * q2 * q0;
  if (square < 0) return kInf;
  const float below = -q1 + std::sqrt(square);
  return below > 0 ? 2 * q0 / below : kInf;
}

// Lanes 0 and 1 count columns and rows. Which side a cell is left by is a coin toss: as masks, not
// as a branch, of which every second would be mispredicted.
typedef float Pair __attribute__((vector_size(16)));
typedef int Steps __attribute__((vector_size(16)));

// First crossing from above to below of at + t (da, db, dz), 0 <= t <= most.
inline Hit march(const Relief& r, const Ray& ray, float most) {
  const float da = ray.da, db = ray.db;
  // Bounded: 0 times the inverse of a denormal must not be NaN, or the way would never end.
  const float pa = da != 0 ? std::min(1 / std::fabs(da), kInf) : kInf;
  const float pb = db != 0 ? std::min(1 / std::fabs(db), kInf) : kInf;
  const Pair pace{pa, pb, kInf, kInf};
  const Steps step{da > 0 ? 1 : -1, db > 0 ? 1 : -1, 0, 0};
  Pair leave{da != 0 ? (da > 0 ? 1 - ray.at.a : ray.at.a) * pa : kInf,
             db != 0 ? (db > 0 ? 1 - ray.at.b : ray.at.b) * pb : kInf, kInf, kInf};
  // Cells are counted within the tile, which itself begins at (ti, tj).
  Steps cell{wrapped(ray.at.i, r.w, r.wrap), wrapped(ray.at.j, r.h, r.wrap), 0, 0};
  int ti = ray.at.i - cell[0], tj = ray.at.j - cell[1];
  if (!r.wrap) cell[0] = ray.at.i, cell[1] = ray.at.j, ti = tj = 0;
  // The lower end of the ray's way through a cell: where it leaves it, or where it comes into it.
  const float rise = ray.dz * r.scale, ahead = std::min(rise, 0.0f), behind = std::max(rise, 0.0f);
  const float base = (ray.at.z - r.lowest) * r.scale;
  float t0 = 0;
  for (;;) {
    int i = cell[0], j = cell[1];
    if (static_cast<unsigned>(i) >= static_cast<unsigned>(r.w) ||
        static_cast<unsigned>(j) >= static_cast<unsigned>(r.h)) {
      int wi = wrapped(i, r.w, r.wrap), wj = wrapped(j, r.h, r.wrap);
      if (r.wrap) {
        ti += i - wi, tj += j - wj;
        cell[0] = wi, cell[1] = wj;
      }
      i = wi, j = wj;
    }
#if defined(__clang__)
    const Pair other = __builtin_shufflevector(leave, leave, 1, 0, 2, 3);
#else
    const Pair other = __builtin_shuffle(leave, Steps{1, 0, 2, 3});
#endif
    const float t1 = std::min(std::min(leave[0], other[0]), most);
    if (base + (ahead * t1 + behind * t0) <= static_cast<float>(r.level[static_cast<size_t>(j) * r.w + i])) {
      const int ui = ti + cell[0], uj = tj + cell[1];
      const float t = crossing(r, ray, ui, uj, t0);
      if (t <= t1 - t0)
        return {true, {ui, uj, ray.a(ui, t0) + da * t, ray.b(uj, t0) + db * t,
                       ray.at.z + ray.dz * t0 + ray.dz * t}, t0 + t};
    }
    if (t1 >= most) break;
    t0 = t1;
    const Steps sides = leave <= other;  // through a corner, both
    leave += reinterpret_cast<Pair>(sides & reinterpret_cast<Steps>(pace));
    cell += sides & step;
  }
  const int i = ti + cell[0], j = tj + cell[1];
  return {false, {i, j, ray.a(i, most), ray.b(j, most), ray.at.z + ray.dz * most}, most};
}

// The frame at the place that a ray has come to, seen from the frame that it started in: turned
// about the axis of the cylinder. On the plane it is the same.
struct Turn { float cosine = 1, sine = 0; };

// The surface that z = 0 is: the plane, or a cylinder bent along (ex, ey) with curvature k.
struct Patch {
  float k = 0, ex = 1, ey = 0;

  Vec turned(Vec v, Turn by) const {
    if (k == 0) return v;
    float along = v.x * ex + v.y * ey, axis = v.y * ex - v.x * ey;
    float s = along * by.cosine - v.z * by.sine, z = along * by.sine + v.z * by.cosine;
    return {s * ex - axis * ey, s * ey + axis * ex, z};
  }
};

// A straight line in the unrolled coordinates of a cylinder: arc along (ex, ey), axis, height.
struct Line {
  float k, above, dx, da, dz, q;

  Line(const Patch& p, float z, Vec d)
      : k(p.k), above(1 + p.k * z), dx(d.x * p.ex + d.y * p.ey), da(d.y * p.ex - d.x * p.ey),
        dz(d.z), q(dx * dx + dz * dz) {}

  struct At { float s, a, dz; Turn turn; };  // arc, axis, rise since t = 0, and the frame there

  At at(float t) const {
    float x = k * t * dx, up = above + k * t * dz, m = std::sqrt(x * x + up * up);
    // Height and arc without the differences of almost equal numbers that small k would bring.
    float rise = t * (2 * above * dz + k * t * q) / (m + above);
    float y = x / up;
    float arc = std::fabs(y) < 0.05f
                    ? t * dx / up * (1 - y * y * (1.0f / 3 - y * y * (0.2f - y * y / 7)))
                    : std::atan2(x, up) / k;
    return {arc, t * da, rise, {up / m, x / m}};
  }
};

struct CurvedHit { Hit hit; Turn turn; };

// The same on a cylinder: its straight ray is a curve over the unrolled relief, followed in pieces.
inline CurvedHit march_curved(const Relief& r, const Patch& p, Point at, Vec d) {
  const Line line(p, at.z, d);
  const float thin = std::min(1 + p.k * r.lowest, 1 + p.k * r.highest), bend = std::fabs(p.k);
  const float flat = std::max(std::sqrt(line.q), 1e-3f);
  const float sagging = thin * std::min(std::sqrt(8 * kSag / bend), kBend / bend) / flat;
  const float piece = std::min(sagging, kLongest);
  Line::At from{0, 0, 0, {}};
  Point here = at;
  for (float t = 0; t < kFar;) {
    t += piece;
    const Line::At to = line.at(t);
    const float s = to.s - from.s, a = to.a - from.a;
    const float da = s * p.ex - a * p.ey, db = -(s * p.ey + a * p.ex), dz = to.dz - from.dz;
    Hit hit = march(r, {here, da, db, dz}, 1);
    if (hit.met || at.z + to.dz < r.lowest) {
      hit.met = true;
      return {hit, line.at(t - piece * (1 - hit.t)).turn};
    }
    here = moved(at, to.s * p.ex - to.a * p.ey, -(to.s * p.ey + to.a * p.ex), to.dz);
    // Above everything and rising: on a convex patch it never comes back, on a concave one it has
    // left through the opening.
    if (dz > 0 && here.z > r.highest) return {{false, here, 1}, to.turn};
    from = to;
  }
  return {{false, here, 1}, from.turn};
}

}  // namespace trace
