// What a shaded pixel looks up, LANES pixels at a time, with derivatives: the prefiltered light along a direction (paper
// Eq. 8), irradiance about a normal, the FG table (Eq. 7), the sRGB curve.
#pragma once

#include "vector.h"

// Bilinear weights between four neighbours: (0, 0), (1, 0), (0, 1), (1, 1).
INLINE void bilinear(Vector x, Vector y, Vector (&weight)[4]) {
  weight[0] = (1.0f - x) * (1.0f - y), weight[1] = x * (1.0f - y), weight[2] = (1.0f - x) * y, weight[3] = x * y;
}

// Cubemaps of several roughnesses, one after another; see refgs.model.cubemap for the order of texels and the padding.
struct Levels {
  static constexpr int MOST = 8;
  int64_t count;
  int32_t side[MOST], start[MOST];  // start: of the level's padded faces in `padded`
  float roughness[MOST];
  const float* texels;    // (texels, 4): red, green, blue, nothing
  const int32_t* padded;  // texel under each cell of the faces padded by one
};

// Trilinear look-up: linear in roughness between two levels, bilinear in direction in each.
struct Lookup {
  Vector s, t, inverse_major;  // on the face: the two coordinates; 1 / the direction's largest component
  Mask on_x, on_y;
  Vector fraction, slope;      // towards the upper level; its derivative by roughness
  Vector half[2], x[2], y[2], weight[2][4];
  int32_t texel[2][4][LANES];

  MEMBER Lookup(const Levels& levels, Vectors d, Vector roughness) {
    Vector ax = larger(d.x, -d.x), ay = larger(d.y, -d.y), az = larger(d.z, -d.z);
    on_x = (ax >= ay) & (ax >= az), on_y = ~on_x & (ay >= az);
    Vector major = choose(d.x, d.y, d.z), size = larger(major, -major);
    inverse_major = 1.0f / (size > 1e-20f ? major : Vector() + 1e-20f);
    Vector scale = larger(inverse_major, -inverse_major);
    s = choose(d.y, d.z, d.x) * scale, t = choose(d.z, d.x, d.y) * scale;
    Mask face = (on_x ? Mask() : on_y ? Mask() + 2 : Mask() + 4) - (major < 0.0f);

    Vector low = Vector() + levels.roughness[0], high = Vector() + levels.roughness[1];
    Mask side[2] = {Mask() + levels.side[0], Mask() + levels.side[1]};
    Mask start[2] = {Mask() + levels.start[0], Mask() + levels.start[1]};
    for (int k = 1; k + 1 < levels.count; k++) {
      Mask above = roughness > levels.roughness[k];
      low = select(above, Vector() + levels.roughness[k], low), high = select(above, Vector() + levels.roughness[k + 1], high);
      for (int i = 0; i < 2; i++) {
        side[i] = above ? Mask() + levels.side[k + i] : side[i];
        start[i] = above ? Mask() + levels.start[k + i] : start[i];
      }
    }
    slope = 1.0f / (high - low);
    fraction = (roughness - low) * slope;

    for (int i = 0; i < 2; i++) {
      Vector sides = convert<Vector>(side[i]);
      half[i] = 0.5f * sides;
      Vector column, row;
      x[i] = cell(s, half[i], sides, column), y[i] = cell(t, half[i], sides, row);
      bilinear(x[i], y[i], weight[i]);
      Mask width = side[i] + 2;
      Mask first = start[i] + (face * width + convert<Mask>(row)) * width + convert<Mask>(column);
      for (int k = 0; k < LANES; k++) {
        const int32_t* at = levels.padded + first[k];
        texel[i][0][k] = at[0], texel[i][1][k] = at[1], texel[i][2][k] = at[width[k]], texel[i][3][k] = at[width[k] + 1];
      }
    }
  }

  MEMBER Vectors light(const Levels& levels) const {
    alignas(64) float weights[2][4][LANES], sum[3][LANES];
    spread(weights);
    for (int k = 0; k < LANES; k++) {
      Four value = {};
      for (int i = 0; i < 2; i++)
        for (int j = 0; j < 4; j++) value += weights[i][j][k] * *(const Four*)(levels.texels + 4 * (int64_t)texel[i][j][k]);
      sum[0][k] = value[0], sum[1][k] = value[1], sum[2][k] = value[2];
    }
    return {load(sum[0]), load(sum[1]), load(sum[2])};
  }

  // Adds to by_texels (texels, 4); returns the derivatives by direction and by roughness.
  MEMBER Vectors backward(const Levels& levels, Vectors by_light, int count, float* by_texels, Vector& by_roughness) const {
    alignas(64) float weights[2][4][LANES], by_weight[2][4][LANES] = {};
    spread(weights);
    for (int k = 0; k < count; k++) {
      Four by = {by_light.x[k], by_light.y[k], by_light.z[k], 0};
      for (int i = 0; i < 2; i++)
        for (int j = 0; j < 4; j++) {
          int64_t at = 4 * (int64_t)texel[i][j][k];
          Four product = by * *(const Four*)(levels.texels + at);
          by_weight[i][j][k] = product[0] + product[1] + product[2];
          *(Four*)(by_texels + at) += weights[i][j][k] * by;
        }
    }
    Vector by_s = {}, by_t = {};
    by_roughness = Vector();
    for (int i = 0; i < 2; i++) {
      Vector g[4], share = i ? fraction : 1.0f - fraction;
      for (int j = 0; j < 4; j++) {
        g[j] = load(by_weight[i][j]);
        by_roughness += (i ? slope : -slope) * weight[i][j] * g[j];
      }
      by_s += share * half[i] * ((1.0f - y[i]) * (g[1] - g[0]) + y[i] * (g[3] - g[2]));
      by_t += share * half[i] * ((1.0f - x[i]) * (g[2] - g[0]) + x[i] * (g[3] - g[1]));
    }
    Vector scale = larger(inverse_major, -inverse_major), by_major = -(by_s * s + by_t * t) * inverse_major;
    by_s *= scale, by_t *= scale;
    return {choose(by_major, by_t, by_s), choose(by_s, by_major, by_t), choose(by_t, by_s, by_major)};
  }

 private:
  MEMBER Vector choose(Vector if_x, Vector if_y, Vector if_z) const { return select(on_x, if_x, select(on_y, if_y, if_z)); }

  // The cell of the padded face, and how far along it.
  static MEMBER Vector cell(Vector s, Vector half, Vector side, Vector& at) {
    Vector x = (s + 1.0f) * half + 0.5f;
    at = smaller(larger(round_down(x), Vector()), side);
    return x - at;
  }

  MEMBER void spread(float (&weights)[2][4][LANES]) const {
    for (int j = 0; j < 4; j++) store(weights[0][j], (1.0f - fraction) * weight[0][j]), store(weights[1][j], fraction * weight[1][j]);
  }
};

// Irradiance / pi about a unit normal from nine coefficients a colour (9, 3): real harmonics in the order and signs of
// refgs.model.harmonics. Never negative.
struct Irradiance {
  static constexpr float Y0 = 0.28209479f, Y1 = 0.48860251f, XY = 1.0925485f, ZZ = 0.31539157f, XX = 0.54627422f;
  Vector basis[9];
  Vectors n;

  MEMBER explicit Irradiance(Vectors n) : n(n) {
    basis[0] = Vector() + Y0;
    basis[1] = -Y1 * n.y, basis[2] = Y1 * n.z, basis[3] = -Y1 * n.x;
    basis[4] = XY * n.x * n.y, basis[5] = -XY * n.y * n.z, basis[6] = ZZ * (3.0f * n.z * n.z - 1.0f);
    basis[7] = -XY * n.x * n.z, basis[8] = XX * (n.x * n.x - n.y * n.y);
  }

  MEMBER Vector value(const float* coefficients, int c) const {
    Vector sum = {};
    for (int k = 0; k < 9; k++) sum += basis[k] * coefficients[3 * k + c];
    return larger(sum, Vector());
  }

  // Adds to by_coefficients (9, 3), a sum a lane, and to by_normal. `by` is zero where the value was cut off.
  MEMBER void backward(const float* coefficients, int c, Vector by, Vector* by_coefficients, Vectors& by_normal) const {
    for (int k = 0; k < 9; k++) by_coefficients[3 * k + c] += by * basis[k];
    const float* i = coefficients + c;
    by_normal.x += by * (-Y1 * i[9] + XY * i[12] * n.y - XY * i[21] * n.z + 2.0f * XX * i[24] * n.x);
    by_normal.y += by * (-Y1 * i[3] + XY * i[12] * n.x - XY * i[15] * n.z - 2.0f * XX * i[24] * n.y);
    by_normal.z += by * (Y1 * i[6] - XY * i[15] * n.y + 6.0f * ZZ * i[18] * n.z - XY * i[21] * n.x);
  }
};

// FG0 and FG1 by N.V (column) and roughness (row), bilinear between the cells' centres; table (2, side, side).
struct ReflectanceTable {
  Vector value[2], by_n_v[2], by_roughness[2];  // derivatives: zero beyond the outermost centres

  MEMBER ReflectanceTable(const float* table, int64_t side, Vector n_v, Vector roughness) {
    float last = (float)(side - 1);
    Vector x = n_v * (float)side - 0.5f, y = roughness * (float)side - 0.5f;
    Mask inside_x = (x > 0.0f) & (x < last), inside_y = (y > 0.0f) & (y < last);
    x = clamp(x, 0, last), y = clamp(y, 0, last);
    Vector column = smaller(round_down(x), Vector() + (last - 1)), row = smaller(round_down(y), Vector() + (last - 1));
    Mask first = convert<Mask>(row) * (int32_t)side + convert<Mask>(column);
    x -= column, y -= row;
    for (int i = 0; i < 2; i++) {
      alignas(64) float corner[4][LANES];
      for (int k = 0; k < LANES; k++) {
        const float* at = table + i * side * side + first[k];
        corner[0][k] = at[0], corner[1][k] = at[1], corner[2][k] = at[side], corner[3][k] = at[side + 1];
      }
      Vector v0 = load(corner[0]), v1 = load(corner[1]), v2 = load(corner[2]), v3 = load(corner[3]);
      value[i] = (1.0f - y) * ((1.0f - x) * v0 + x * v1) + y * ((1.0f - x) * v2 + x * v3);
      by_n_v[i] = select(inside_x, (float)side * ((1.0f - y) * (v1 - v0) + y * (v3 - v2)), Vector());
      by_roughness[i] = select(inside_y, (float)side * ((1.0f - x) * (v2 - v0) + x * (v3 - v1)), Vector());
    }
  }
};

// The sRGB curve (IEC 61966-2-1), unclamped as in refgs.color, and its derivative.
INLINE Vector srgb_encode(Vector linear, Vector& derivative) {
  constexpr float LINEAR_END = 0.0031308f;
  Vector x = larger(linear, Vector() + LINEAR_END), square_root = root(x);
  // x^(5/12) = x^(1/4) x^(1/6); y = (x^(1/2))^(-1/3) by Newton from an estimate in the exponent's bits.
  Vector third = convert<Vector>(bits(square_root)) * (1 / 3.0f);
  Vector y = from_bits((Mask() + 0x54a2fa8c) - convert<Mask>(third));
#pragma unroll
  for (int i = 0; i < 3; i++) y = y * (4 / 3.0f - (1 / 3.0f) * square_root * (y * y * y));
  Vector power = root(square_root) * square_root * (y * y);
  Mask straight = linear <= LINEAR_END;
  derivative = select(straight, Vector() + 12.92f, (1.055f / 2.4f) * power / x);
  return select(straight, 12.92f * linear, 1.055f * power - 0.055f);
}
