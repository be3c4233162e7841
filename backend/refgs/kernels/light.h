// Look-ups of shading with their derivatives, LANES pixels at a time: prefiltered light in a direction (paper Eq. 8), irradiance for a
// normal, reflectance (Eq. 7), and the sRGB curve.
#pragma once

#include "rows.h"

// Stacked cubemaps: one for each of several roughnesses, then one of irradiance / pi. refgs.model.cubemap defines the order of texels.
// Each face is padded by one cell all around, so that the four cells of a bilinear look-up are two adjacent pairs.
struct Levels {
  int64_t count;
  int32_t side[8], start[8], line[8];  // `start` counts cells and `line` counts lines before a level; a line is a row of cells
  float alpha[8];  // GGX alpha of the level: roughness²
  const float* cells;  // (cells, 4): red, green, blue, unused

  MEMBER int level_of(int32_t at) const {
    int k = 0;
    while (k + 1 < count && at >= line[k + 1]) k++;
    return k;
  }
  MEMBER int64_t width(int32_t at) const { return side[level_of(at)] + 2; }  // length of a line, in cells
  MEMBER int64_t first_cell(int32_t at) const {
    int k = level_of(at);
    return start[k] + (at - line[k]) * width(at);
  }
};

// Look-up of a direction, bilinear within a level. N = 2 blends the two levels around a roughness, linearly in roughness², which is
// about the width of a lobe. N = 1 reads the last level: irradiance / pi for a normal.
template <int N, bool DERIVATIVES>
struct Lookup {
  Vector s, t, inverse_major;  // coordinates on the face; 1 / the direction's largest component
  Mask on_x, on_y, face;
  Vector share[N], slope;      // weights of the levels; the derivative of the upper one's by roughness
  Vector x[N], y[N];           // bilinear weights within each level
  alignas(64) int32_t cell[N][LANES], width[N][LANES], line[N][LANES];  // of the first cell: index, length of its line, line
  Vector light[3] = {}, by_s[3] = {}, by_t[3] = {}, by_share[3] = {};   // the light and its derivatives

  MEMBER Lookup(const Levels& levels, Vectors d) {
    static_assert(N == 1);
    find_face(d);
    int last = (int)levels.count - 1;
    share[0] = Vector() + 1.0f;
    blend(levels, 0, Mask() + levels.side[last], Mask() + levels.start[last], Mask() + levels.line[last]);
  }

  MEMBER Lookup(const Levels& levels, Vectors d, Vector roughness) {
    static_assert(N == 2);
    find_face(d);
    Vector alpha = roughness * roughness, low = Vector() + levels.alpha[0], high = Vector() + levels.alpha[1];
    Mask side[2], start[2], first_line[2];
    for (int i = 0; i < 2; i++) {
      side[i] = Mask() + levels.side[i], start[i] = Mask() + levels.start[i], first_line[i] = Mask() + levels.line[i];
    }
    for (int k = 1; k + 2 < levels.count; k++) {
      Mask above = alpha > levels.alpha[k];
      low = select(above, Vector() + levels.alpha[k], low), high = select(above, Vector() + levels.alpha[k + 1], high);
      for (int i = 0; i < 2; i++) {
        side[i] = select(above, Mask() + levels.side[k + i], side[i]);
        start[i] = select(above, Mask() + levels.start[k + i], start[i]);
        first_line[i] = select(above, Mask() + levels.line[k + i], first_line[i]);
      }
    }
    Vector by_alpha = reciprocal(high - low);
    share[N - 1] = (alpha - low) * by_alpha, share[0] = 1.0f - share[N - 1], slope = 2.0f * roughness * by_alpha;
#pragma unroll
    for (int i = 0; i < 2; i++) blend(levels, i, side[i], start[i], first_line[i]);
  }

  // Derivatives by direction (returned) and by roughness.
  MEMBER Vectors backward(const Vector (&by_light)[3], Vector& by_roughness) const {
    by_roughness = Vector();
    for (int c = 0; c < 3; c++) by_roughness += by_light[c] * slope * by_share[c];
    return backward(by_light);
  }
  MEMBER Vectors backward(const Vector (&by_light)[3]) const {
    Vector s_sum = {}, t_sum = {};
    for (int c = 0; c < 3; c++) s_sum += by_light[c] * by_s[c], t_sum += by_light[c] * by_t[c];
    Vector scale = larger(inverse_major, -inverse_major), by_major = -(s_sum * s + t_sum * t) * inverse_major;
    s_sum *= scale, t_sum *= scale;
    return {choose(by_major, t_sum, s_sum), choose(s_sum, by_major, t_sum), choose(t_sum, s_sum, by_major)};
  }

  // Weights of the four cells of each level.
  MEMBER void weights(Vector (&w)[N][4]) const {
    for (int i = 0; i < N; i++) {
      Vector below = share[i] * y[i], above = share[i] - below;
      w[i][1] = above * x[i], w[i][0] = above - w[i][1], w[i][3] = below * x[i], w[i][2] = below - w[i][3];
    }
  }

 private:
  MEMBER void find_face(Vectors d) {
    Vector ax = larger(d.x, -d.x), ay = larger(d.y, -d.y), az = larger(d.z, -d.z);
    on_x = (ax >= ay) & (ax >= az), on_y = ~on_x & (ay >= az);
    Vector major = choose(d.x, d.y, d.z), size = larger(major, -major);
    inverse_major = reciprocal(select(size > 1e-20f, major, Vector() + 1e-20f));
    Vector scale = larger(inverse_major, -inverse_major);
    s = choose(d.y, d.z, d.x) * scale, t = choose(d.z, d.x, d.y) * scale;
    face = select(on_x, Mask(), select(on_y, Mask() + 2, Mask() + 4)) - (major < 0.0f);
  }

  // Add the look-up in one level, given its side and its first cell and line.
  MEMBER void blend(const Levels& levels, int i, Mask side, Mask start, Mask first_line) {
    Vector sides = convert<Vector>(side), half = 0.5f * sides, column, row;
    x[i] = along(s, half, sides, column), y[i] = along(t, half, sides, row);
    Mask across = side + 2, down = face * across + convert<Mask>(row);
    store(cell[i], start + down * across + convert<Mask>(column)), store(width[i], across), store(line[i], first_line + down);
    Vector top[8], bottom[8];  // two adjacent cells each
    two_cells(levels, i, 0, top), two_cells(levels, i, 1, bottom);
    for (int c = 0; c < 3; c++) {
      Vector across_top = top[4 + c] - top[c], across_bottom = bottom[4 + c] - bottom[c];
      Vector above = top[c] + x[i] * across_top, further = bottom[c] + x[i] * across_bottom - above;
      Vector value = above + y[i] * further;
      light[c] += share[i] * value;
      if (DERIVATIVES) {
        by_s[c] += share[i] * half * (across_top + y[i] * (across_bottom - across_top));
        by_t[c] += share[i] * half * further;
        by_share[c] += i ? value : -value;
      }
    }
  }

  MEMBER Vector choose(Vector if_x, Vector if_y, Vector if_z) const { return select(on_x, if_x, select(on_y, if_y, if_z)); }

  // Load two adjacent cells of the i-th level, of the upper line (second = 0) or the lower one (second = 1).
  MEMBER void two_cells(const Levels& levels, int i, int second, Vector (&v)[8]) const {
    auto at = [&](int k) { return levels.cells + 4 * ((int64_t)cell[i][k] + second * width[i][k]); };
#ifdef __CUDACC__
    Four one = ((const Four*)at(0))[0], other = ((const Four*)at(0))[1];
    for (int c = 0; c < 4; c++) v[c] = one[c], v[4 + c] = other[c];
#else
    to_lanes<8>([&](int k, int b) { return Blocks<8>::get(at(k) + Blocks<8>::at(b)); }, v);
#endif
  }

  // Find the first cell along one axis of the padded face (`at`), and return the bilinear weight of the next.
  static MEMBER Vector along(Vector s, Vector half, Vector side, Vector& at) {
    Vector x = (s + 1.0f) * half + 0.5f;
    at = smaller(larger(round_down(x), Vector()), side);
    return x - at;
  }
};

// Look-up of the reflectance under uniform light. Table (side, side, 4) of refgs.render.brdf, bilinear in the square roots of
// roughness (row) and N.V (column).
struct ReflectanceTable {
  static constexpr int FG0 = 0, FG1 = 1, AVERAGE = 2, DIELECTRIC = 3;
  Vector value[4], by_n_v[4], by_roughness[4];  // derivatives are zero below LEAST and above 1

  MEMBER ReflectanceTable(const float* table, int64_t side, Vector n_v, Vector roughness) {
    constexpr float LEAST = 1e-4f;
    float last = (float)(side - 1);
    Vector x = clamp(n_v, LEAST, 1), y = clamp(roughness, LEAST, 1);
    Vector along_x = inverse_root(x), along_y = inverse_root(y);
    Vector by_x = select(x == n_v, (0.5f * last) * along_x, Vector()), by_y = select(y == roughness, (0.5f * last) * along_y, Vector());
    x *= last * along_x, y *= last * along_y;
    Vector column = smaller(round_down(x), Vector() + (last - 1)), row = smaller(round_down(y), Vector() + (last - 1));
    alignas(64) int32_t first[LANES];
    store(first, convert<Mask>(row) * (int32_t)side + convert<Mask>(column));
    x -= column, y -= row;
    Vector top[8], bottom[8];
    two_cells(table, first, 0, top), two_cells(table, first, side, bottom);
#pragma unroll
    for (int i = 0; i < 4; i++) {
      Vector across_top = top[4 + i] - top[i], across_bottom = bottom[4 + i] - bottom[i];
      Vector above = top[i] + x * across_top, down = bottom[i] + x * across_bottom - above;
      value[i] = above + y * down;
      by_n_v[i] = by_x * (across_top + y * (across_bottom - across_top));
      by_roughness[i] = by_y * down;
    }
  }

 private:
  static MEMBER void two_cells(const float* table, const int32_t (&first)[LANES], int64_t further, Vector (&v)[8]) {
    auto at = [&](int k) { return table + 4 * (first[k] + further); };
#ifdef __CUDACC__
    Four one = ((const Four*)at(0))[0], other = ((const Four*)at(0))[1];
    for (int c = 0; c < 4; c++) v[c] = one[c], v[4 + c] = other[c];
#else
    to_lanes<8>([&](int k, int b) { return Blocks<8>::get(at(k) + Blocks<8>::at(b)); }, v);
#endif
  }
};

// Reflectance of a metal under uniform light: single scattering F0 fg0 + fg1 with Schlick's Fresnel term, times the gain by multiple
// scattering between microfacets. The gain is `bounces` of refgs.render.brdf, for the mean Fresnel term F0 + (1 - F0) / 21.
struct Metal {
  Vector value, by_f0, by_fg[2], by_average;

  MEMBER Metal(const ReflectanceTable& table, Vector f0) {
    Vector fg0 = table.value[ReflectanceTable::FG0], fg1 = table.value[ReflectanceTable::FG1];
    Vector average = table.value[ReflectanceTable::AVERAGE];
    Vector inverse_energy = reciprocal(fg0 + fg1), missing = inverse_energy - 1.0f;
    Vector fresnel = (20 / 21.0f) * f0 + 1 / 21.0f;
    Vector series = reciprocal(1.0f - fresnel * (1.0f - average)), again = fresnel * average * series;
    Vector once = f0 * fg0 + fg1, bounces = 1.0f + again * missing;
    value = once * bounces;
    Vector by_again = once * missing, by_energy = once * again * inverse_energy * inverse_energy;
    by_f0 = fg0 * bounces + (20 / 21.0f) * by_again * average * series * series;
    by_fg[0] = f0 * bounces - by_energy, by_fg[1] = bounces - by_energy;
    by_average = by_again * fresnel * (1.0f - fresnel) * series * series;
  }
};

// The sRGB curve (IEC 61966-2-1), unclamped as in refgs.color, and its derivative. A NaN stays one: `larger` returns its second argument
// then.
INLINE Vector srgb_encode(Vector linear, Vector& derivative) {
  constexpr float LINEAR_END = 0.0031308f;
  Vector x = larger(Vector() + LINEAR_END, linear), square_root = x * inverse_root(x);
  // x^(5/12) = x x^(-1/4) x^(-1/3). y = (x^(1/2))^(-1/3) by Newton's method, from an estimate made from the float's bits.
  Vector third = convert<Vector>(bits(square_root)) * (1 / 3.0f);
  Vector y = from_bits((Mask() + 0x54a2fa8c) - convert<Mask>(third));
#pragma unroll
  for (int i = 0; i < 3; i++) y = y * (4 / 3.0f - (1 / 3.0f) * square_root * (y * y * y));
  Vector power = inverse_root(square_root) * (y * y);  // x^(-7/12)
  Mask straight = linear <= LINEAR_END;
  derivative = select(straight, Vector() + 12.92f, (1.055f / 2.4f) * power);
  return select(straight, 12.92f * linear, 1.055f * x * power - 0.055f);
}
