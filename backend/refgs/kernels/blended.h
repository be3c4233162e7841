// Channels that a pixel is shaded with: the blended ones (Mean), those with the normal read at the blended surface point (Displaced),
// or a surfel's own (Own).
#pragma once

#include "pixels.h"

namespace {

INLINE Vector inverse_norm(Vectors n) { return inverse_root(dot(n, n) + 1e-24f); }

// The normal among a pixel's channels.
INLINE Vectors normal_of(const Vector* value) { return {value[NORMAL], value[NORMAL + 1], value[NORMAL + 2]}; }

// Blended means: the sums over a pixel's splats divided by alpha, C channels.
template <int C>
struct Mean {
  const Pixels& pixels;
  Vector alpha, inverse, value[C];

  MEMBER Mean(const Shade& s, const Pixels& p) : pixels(p), alpha(load(p.alpha)), inverse(reciprocal(alpha)) {
    to_lanes<C>([&](int k, int b) { return Blocks<C>::get(s.features + (int64_t)p.at[k] * C + Blocks<C>::at(b)); }, value);
    for (int c = 0; c < C; c++) value[c] *= inverse;
  }

  // Pass on the derivatives by `value` and by the pixel's alpha.
  template <class Sums>
  MEMBER void backward(const Vector (&by_value)[C], Vector by_alpha, Sums& sums) const {
    Vector by_own[C];
    for (int c = 0; c < C; c++) by_own[c] = inverse * by_value[c], by_alpha -= by_own[c] * value[c];
    sums.add_own(pixels, by_own, by_alpha);
  }
};

// Blended means whose normal is read at a displaced pixel; C channels, the last three of which are the blended position.
//
// Splats are sorted by the depths of their centres, so blending favours those in front. On a curved surface the blend at a pixel p then
// belongs to a surface point q nearer to the camera, whose normal is turned towards the camera. The blended position tells q, which
// projects to p + shift. The pixel p - shift has a blend that belongs to p's own surface point, so the normal is read there, bilinearly.
// All other channels are read at p: a material is learned where it is seen, and reading it elsewhere would blur it.
template <int C, bool DERIVATIVES>
struct Displaced {
  static constexpr int S = C - 3;
  const Pixels& pixels;
  Mean<C> mean;
  Vector alpha, value[S];
  Vector x, y, inverse_z, px, py;  // the blended position in camera space, and its projection relative to (cx, cy)
  Mask moves_x, moves_y;           // where no clamp stops the derivative
  Corners corners;
  Vector there, trust, scale, inverse_there;
  Vector sampled[4], by_x[4], by_y[4], there_by_x, there_by_y;  // bilinear normal; its and alpha's derivatives along x, y

  MEMBER Displaced(const Shade& s, const Pixels& p) : pixels(p), mean(s, p), alpha(mean.alpha) {
    const auto& own = mean.value;
    const float* m = s.view;
    auto row = [&](int i) { return m[i] * own[S] + m[i + 1] * own[S + 1] + m[i + 2] * own[S + 2] + m[i + 3]; };
    x = row(0), y = row(4);
    Vector z = row(8);
    Mask ahead = z > 1e-12f;
    inverse_z = 1.0f / select(ahead, z, Vector() + 1e-12f);
    px = s.fx * x * inverse_z, py = s.fy * y * inverse_z;
    Vector column = load(p.column), line = load(p.row);
    Vector shift_x = px + s.cx - (column + 0.5f), shift_y = py + s.cy - (line + 0.5f);
    Mask solid = (alpha > SHIFT_ALPHA) & ahead;
    moves_x = solid & (shift_x > -SHIFT_LIMIT) & (shift_x < SHIFT_LIMIT);
    moves_y = solid & (shift_y > -SHIFT_LIMIT) & (shift_y < SHIFT_LIMIT);
    shift_x = select(solid, clamp(shift_x, -SHIFT_LIMIT, SHIFT_LIMIT), Vector());
    shift_y = select(solid, clamp(shift_y, -SHIFT_LIMIT, SHIFT_LIMIT), Vector());
    Vector u = column - shift_x, v = line - shift_y;
    float right = (float)(s.width - 1), bottom = (float)(s.height - 1);
    moves_x &= (u > 0.0f) & (u < right), moves_y &= (v > 0.0f) & (v < bottom);
    u = clamp(u, 0, right), v = clamp(v, 0, bottom);
    // Use the last two columns or rows at the right or bottom border; there may be only one.
    corners.next = s.width > 1, corners.below = s.height > 1 ? s.width : 0;
    Vector u0 = smaller(round_down(u), Vector() + (right - (float)corners.next));
    Vector v0 = smaller(round_down(v), Vector() + (s.height > 1 ? bottom - 1 : 0));
    Mask first_row = convert<Mask>(v0);
    store(corners.row, first_row), store(corners.first, first_row * (int32_t)s.width + convert<Mask>(u0));
    corners.x = u - u0, corners.y = v - v0;

    alignas(64) float along_x[LANES], along_y[LANES];
    store(along_x, corners.x), store(along_y, corners.y);
    typedef typename Blocks<4>::Numbers Numbers;  // the normal's three channels and an unused one: four load faster
    Rows<4> rows_by_x, rows_by_y;
    to_lanes<4>(
        [&](int k, int b) {
          auto corner = [&](int j) { return Blocks<4>::get(s.features + corners.at(k, j) * C + Blocks<4>::at(b)); };
          Numbers first = corner(0), second = corner(2), across = corner(1) - first, across_below = corner(3) - second;
          Numbers above = first + along_x[k] * across, down = second + along_x[k] * across_below - above;
          if (DERIVATIVES) rows_by_x.set(k, b, across + along_y[k] * (across_below - across)), rows_by_y.set(k, b, down);
          return above + along_y[k] * down;
        },
        sampled);
    if (DERIVATIVES) {
      to_lanes<4>([&](int k, int b) { return rows_by_x.get(k, b); }, by_x);
      to_lanes<4>([&](int k, int b) { return rows_by_y.get(k, b); }, by_y);
    }
    alignas(64) float a[4][LANES];
    for (int k = 0; k < LANES; k++)
      for (int j = 0; j < 4; j++) a[j][k] = s.alpha[corners.at(k, j)];
    Vector across = load(a[1]) - load(a[0]), across_below = load(a[3]) - load(a[2]);
    Vector above = load(a[0]) + corners.x * across;
    there_by_x = across + corners.y * (across_below - across), there_by_y = load(a[2]) + corners.x * across_below - above;
    there = above + corners.y * there_by_y;
    // At a silhouette the displaced pixel may lie off the object. Where its alpha is low, fall back to the pixel's own normal. So do where
    // the surface would be bent too sharply if it were the same one: beyond an edge the displaced normal is that of another surface. The
    // shift is as long as |shift| z / f at the surface; over a length l, a curvature c turns a normal by c l.
    Vectors moved = normal_of(sampled), normal = normal_of(own);
    Vectors turned = inverse_norm(moved) * moved - inverse_norm(normal) * normal;
    Vector bent_x = shift_x * (SHIFT_BEND / s.fx), bent_y = shift_y * (SHIFT_BEND / s.fy);
    Vector bent = bent_x * bent_x + bent_y * bent_y + 1e-12f;
    trust = clamp((there - SHIFT_ALPHA) * (1 / SHIFT_ALPHA), 0, 1) * (bent / (bent + dot(turned, turned) * inverse_z * inverse_z));
    inverse_there = reciprocal(larger(there, Vector() + SHIFT_ALPHA));
    scale = trust * inverse_there;
    for (int c = 0; c < S; c++) value[c] = c < ALBEDO ? scale * sampled[c] + (1.0f - trust) * own[c] : own[c];
  }

  MEMBER Vectors blended() const { return normal_of(mean.value); }

  // Pass on the derivatives by `value`, by the blended normal and by the pixel's alpha.
  template <class Sums>
  MEMBER void backward(const Shade& s, const Vector (&by_value)[S], const Vector (&by_blended)[3], Vector by_alpha, Sums& sums) const {
    Vector by_sampled[4], by_own[C], by_there = {}, by_u = {}, by_v = {};
    for (int c = 0; c < ALBEDO; c++) {
      by_sampled[c] = scale * by_value[c];
      by_there -= by_sampled[c] * sampled[c];
      by_u += by_sampled[c] * by_x[c], by_v += by_sampled[c] * by_y[c];
    }
    by_there = by_sampled[3] = select(there > SHIFT_ALPHA, by_there * inverse_there, Vector());
    by_u += by_there * there_by_x, by_v += by_there * there_by_y;
    Vector by_px = select(moves_x, -by_u, Vector()), by_py = select(moves_y, -by_v, Vector());
    Vector by_camera_x = s.fx * inverse_z * by_px, by_camera_y = s.fy * inverse_z * by_py;
    Vector by_z = -inverse_z * (px * by_px + py * by_py);
    for (int i = 0; i < 3; i++) by_own[S + i] = s.view[i] * by_camera_x + s.view[4 + i] * by_camera_y + s.view[8 + i] * by_z;
    for (int c = 0; c < S; c++) by_own[c] = c < ALBEDO ? (1.0f - trust) * by_value[c] + by_blended[c] : by_value[c];
    mean.backward(by_own, by_alpha, sums);
    sums.add_sampled(corners, pixels.count, by_sampled);
  }
};

// Channels of a surfel itself, for shading before blending.
template <int C>
struct Own {
  static constexpr int S = C - 3;
  const Pixels& pixels;
  Vector alpha, value[C];

  MEMBER Own(const Shade& s, const Pixels& p) : pixels(p), alpha(Vector() + 1.0f) { gather<C>(s.features, p, value); }

  MEMBER Vectors blended() const { return normal_of(value); }

  MEMBER Vectors to_camera(const Shade& s) const {
    const float* m = s.view;
    auto along = [&](int i) { return -(m[i] * m[3] + m[4 + i] * m[7] + m[8 + i] * m[11]) - value[S + i]; };
    return {along(0), along(1), along(2)};
  }
};

template <bool SPLATS, int C, bool DERIVATIVES>
struct Map : Displaced<C, DERIVATIVES> {
  using Displaced<C, DERIVATIVES>::Displaced;
};
template <int C, bool DERIVATIVES>
struct Map<true, C, DERIVATIVES> : Own<C> {
  using Own<C>::Own;
};

}  // namespace
