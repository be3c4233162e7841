// Maps to a picture and back: deferred shading of what the rasteriser blended (paper Eq. 5-10).
//
// Pixels that nothing covers cost nothing: the others are taken LANES at a time, wherever they lie. The picture is worked on in
// chunks of rows whose size does not depend on the threads, and sums are taken in the chunks' order, so neither does any result.
#include "light.h"

namespace {

constexpr float COVERED = 1.0f / 255.0f;    // less alpha than this is background
constexpr float SHIFT_LIMIT = 8;            // pixels
constexpr float SHIFT_ALPHA = 0.3f;         // a silhouette's blended position says nothing about its surface
constexpr float DIELECTRIC_F0 = 0.04f;
constexpr int HALO = (int)SHIFT_LIMIT + 1;  // rows that a displaced look-up reaches beyond its own
constexpr int NORMAL = 0, ALBEDO = 3, METALLIC = 6, ROUGHNESS = 7;  // channels; Shaded has those that may follow

struct Shade {
  int64_t width, height, channels, chunk_rows;
  double view[12];  // world to camera, 3x4, row-major
  double fx, fy, cx, cy;
  float background[3];
  int64_t harmonics;              // whether there are channels of colour by direction
  const float *features, *alpha;  // (height, width, channels), (height, width): sums over a pixel's splats
  const float* visibility;        // (height, width): 0 where the object itself stands in the mirror direction; or null
  Levels levels;
  int64_t texels;
  const float* irradiance;  // (9, 3)
  const float* fg;          // (2, fg_side, fg_side)
  int64_t fg_side;
  float *mirrored;                                        // (height, width, 3)
  float *color, *normal, *material, *radiance;            // (height, width, 3 | 3 | 5 | 3)
  const float *by_color, *by_normal, *by_material;
  float *by_features, *by_alpha;
  float* halo;                             // (chunks, 2 HALO, width, channels - 2): what a chunk adds to the rows above and below
  float *by_chunk_texels, *by_irradiance;  // (chunks, texels, 4), (chunks, 27)
  float* by_levels;                        // (texels, 3)
  float* scratch;                          // none is used
  mutable Shared shared;
};

void zero(float* p, int64_t n) {
  for (int64_t i = 0; i < n; i++) p[i] = 0;
}

int64_t chunks(const Shade& s) { return (s.height + s.chunk_rows - 1) / s.chunk_rows; }
int64_t last_row(const Shade& s, int64_t chunk) {
  int64_t end = (chunk + 1) * s.chunk_rows;
  return end < s.height ? end : s.height;
}

// The covered pixels of some rows, LANES at a time: body(pixels, count), the last one repeated where there are fewer.
template <class Body>
INLINE void each_covered(const Shade& s, int64_t first, int64_t end, Body body) {
  int64_t at[LANES];
  int count = 0;
  for (int64_t i = first * s.width; i < end * s.width; i++) {
    if (!(s.alpha[i] > COVERED)) continue;
    at[count++] = i;
    if (count == LANES) body(at, count), count = 0;
  }
  if (!count) return;
  for (int k = count; k < LANES; k++) at[k] = at[count - 1];
  body(at, count);
}

template <int N>
INLINE void gather(const float* map, const int64_t* at, Vector (&v)[N]) {
  alignas(64) float lanes[N][LANES];
  for (int k = 0; k < LANES; k++)
    for (int c = 0; c < N; c++) lanes[c][k] = map[at[k] * N + c];
  for (int c = 0; c < N; c++) v[c] = load(lanes[c]);
}

template <int N>
INLINE void scatter(float* map, const int64_t* at, int count, const Vector (&v)[N]) {
  for (int k = 0; k < count; k++)
    for (int c = 0; c < N; c++) map[at[k] * N + c] = v[c][k];
}

typedef float Eight __attribute__((vector_size(32)));

template <class Numbers>
INLINE Numbers get(const float* p) {  // aligned or not
  Numbers v;
  __builtin_memcpy(&v, p, sizeof v);
  return v;
}

template <class Numbers>
INLINE void put(float* p, Numbers v) {
  __builtin_memcpy(p, &v, sizeof v);
}

// N numbers of each of LANES pixels, a pixel's side by side: as they lie in a map, and quick to move. Lanes: the other way round.
template <int N>
struct Rows {
  static constexpr int WIDTH = (N + 15) / 16 * 16;
  alignas(64) float row[LANES][WIDTH];

  MEMBER void to_lanes(float (&lanes)[N][LANES]) const {
    for (int b = 0; b < N; b += LANES) {
      Vector v[LANES];
      for (int k = 0; k < LANES; k++) v[k] = load(row[k] + b);
      transpose(v);
      for (int c = 0; c < LANES && b + c < N; c++) store(lanes[b + c], v[c]);
    }
  }
  MEMBER void from_lanes(const float (&lanes)[N][LANES]) {
    for (int b = 0; b < N; b += LANES) {
      Vector v[LANES];
      for (int c = 0; c < LANES; c++) v[c] = b + c < N ? load(lanes[b + c]) : Vector();
      transpose(v);
      for (int k = 0; k < LANES; k++) store(row[k] + b, v[k]);
    }
  }
};

// to[c] += weight * row[c] for N numbers.
template <int N>
INLINE void add(float* to, const float* row, float weight) {
  int c = 0;
  for (; c + 8 <= N; c += 8) put(to + c, get<Eight>(to + c) + weight * get<Eight>(row + c));
  if (c + 4 <= N) put(to + c, get<Four>(to + c) + weight * get<Four>(row + c)), c += 4;
  for (; c < N; c++) to[c] += weight * row[c];
}

// Discs sorted and blended by their centres favour those in front: on a curved surface the blend at a pixel is that of a point
// nearer to the camera, whose normal leans towards it. The blended position tells which point; the pixel whose blend is *this*
// pixel's point lies the same way back. C channels, of which all but the position are read there.
template <int C>
struct Displaced {
  static constexpr int S = C - 3;
  const int64_t* at;
  Vector alpha, own[C], value[S];
  Vector x, y, inverse_z, px, py;  // the blended point in camera space; where it projects
  Mask moves_x, moves_y;           // the derivative passes the limits
  Vector along_x, along_y, weight[4];
  int64_t corner[4][LANES];
  Vector there, trust, scale, inverse_there;
  alignas(64) float sampled[S + 1][LANES], difference_x[S + 1][LANES], difference_y[S + 1][LANES];

  MEMBER Displaced(const Shade& s, const int64_t* at) : at(at) {
    Vector a[1];
    gather<1>(s.alpha, at, a);
    alpha = a[0];
    Vector inverse = 1.0f / alpha;
    Rows<C> rows;
    alignas(64) float lanes[C][LANES];
    for (int k = 0; k < LANES; k++) __builtin_memcpy(rows.row[k], s.features + at[k] * C, C * sizeof(float));
    rows.to_lanes(lanes);
    for (int c = 0; c < C; c++) own[c] = load(lanes[c]) * inverse;

    const double* m = s.view;
    Vectors p = {own[S], own[S + 1], own[S + 2]};
    auto row = [&](int i) { return (float)m[i] * p.x + (float)m[i + 1] * p.y + (float)m[i + 2] * p.z + (float)m[i + 3]; };
    x = row(0), y = row(4);
    Vector z = row(8);
    Mask ahead = z > 1e-12f;
    inverse_z = 1.0f / select(ahead, z, Vector() + 1e-12f);
    px = (float)s.fx * x * inverse_z, py = (float)s.fy * y * inverse_z;
    Vector column, line;
    for (int k = 0; k < LANES; k++) column[k] = (float)(at[k] % s.width), line[k] = (float)(at[k] / s.width);
    Vector shift_x = px + (float)s.cx - (column + 0.5f), shift_y = py + (float)s.cy - (line + 0.5f);
    Mask solid = (alpha > SHIFT_ALPHA) & ahead;
    moves_x = solid & (shift_x > -SHIFT_LIMIT) & (shift_x < SHIFT_LIMIT);
    moves_y = solid & (shift_y > -SHIFT_LIMIT) & (shift_y < SHIFT_LIMIT);
    Vector u = column - select(solid, clamp(shift_x, -SHIFT_LIMIT, SHIFT_LIMIT), Vector());
    Vector v = line - select(solid, clamp(shift_y, -SHIFT_LIMIT, SHIFT_LIMIT), Vector());
    float right = (float)(s.width - 1), bottom = (float)(s.height - 1);
    moves_x &= (u > 0.0f) & (u < right), moves_y &= (v > 0.0f) & (v < bottom);
    u = clamp(u, 0, right), v = clamp(v, 0, bottom);
    Vector u0 = round_down(u), v0 = round_down(v);
    along_x = u - u0, along_y = v - v0;
    bilinear(along_x, along_y, weight);

    alignas(64) float w[4][LANES], along[2][LANES];
    for (int j = 0; j < 4; j++) store(w[j], weight[j]);
    store(along[0], along_x), store(along[1], along_y);
    Rows<S + 1> at_point, by_x, by_y;  // blended over the four corners, and how that changes along x and y
    for (int k = 0; k < LANES; k++) {
      int64_t first = (int64_t)v0[k] * s.width + (int64_t)u0[k];
      int64_t next = u0[k] < right ? 1 : 0, below = v0[k] < bottom ? s.width : 0;
      corner[0][k] = first, corner[1][k] = first + next, corner[2][k] = first + below, corner[3][k] = first + below + next;
      auto blend = [&](auto type, const float* map, int stride, int c, int to) {
        typedef decltype(type) Numbers;
        Numbers value[4];
        for (int j = 0; j < 4; j++) value[j] = get<Numbers>(map + corner[j][k] * stride + c);
        Numbers top = value[1] - value[0], low = value[3] - value[2];
        put<Numbers>(at_point.row[k] + to, w[0][k] * value[0] + w[1][k] * value[1] + w[2][k] * value[2] + w[3][k] * value[3]);
        put<Numbers>(by_x.row[k] + to, top + along[1][k] * (low - top));
        put<Numbers>(by_y.row[k] + to, value[2] - value[0] + along[0][k] * (low - top));
      };
      blend(Eight(), s.features, C, 0, 0);
      if (S > 8) blend(Eight(), s.features, C, S - 8, S - 8);  // some once more
      blend(float(), s.alpha, 1, 0, S);
    }
    at_point.to_lanes(sampled), by_x.to_lanes(difference_x), by_y.to_lanes(difference_y);
    // At a silhouette the way back leads off the object: there the pixel keeps its own blend.
    there = load(sampled[S]);
    trust = clamp((there - SHIFT_ALPHA) * (1 / SHIFT_ALPHA), 0, 1);
    inverse_there = 1.0f / larger(there, Vector() + SHIFT_ALPHA);
    scale = trust * inverse_there;
    for (int c = 0; c < S; c++) value[c] = scale * load(sampled[c]) + (1.0f - trust) * own[c];
  }

  // From the derivatives by `value` and by the pixel's own alpha.
  MEMBER void backward(const Shade& s, const Vector (&by_value)[S], Vector by_alpha, int64_t chunk, int count) const {
    alignas(64) float by_sampled[S + 1][LANES], by_own[C + 1][LANES], w[4][LANES];
    Vector by_there = {}, by_u = {}, by_v = {}, inverse = 1.0f / alpha;
    for (int c = 0; c < S; c++) {
      Vector by = scale * by_value[c];
      store(by_sampled[c], by);
      by_there -= by * load(sampled[c]) * inverse_there;
      by_u += by * load(difference_x[c]), by_v += by * load(difference_y[c]);
      Vector to_own = (1.0f - trust) * by_value[c];
      by_alpha -= to_own * own[c] * inverse;
      store(by_own[c], to_own * inverse);
    }
    by_there = select(there > SHIFT_ALPHA, by_there, Vector());
    store(by_sampled[S], by_there);
    by_u += by_there * load(difference_x[S]), by_v += by_there * load(difference_y[S]);
    Vector by_px = select(moves_x, -by_u, Vector()), by_py = select(moves_y, -by_v, Vector());
    Vector by_x = (float)s.fx * inverse_z * by_px, by_y = (float)s.fy * inverse_z * by_py;
    Vector by_z = -inverse_z * (px * by_px + py * by_py);
    for (int i = 0; i < 3; i++) {
      Vector by = (float)s.view[i] * by_x + (float)s.view[4 + i] * by_y + (float)s.view[8 + i] * by_z;
      by_alpha -= by * own[S + i] * inverse;
      store(by_own[S + i], by * inverse);
    }
    store(by_own[C], by_alpha);
    for (int j = 0; j < 4; j++) store(w[j], weight[j]);
    Rows<S + 1> sampled_rows;
    Rows<C + 1> own_rows;
    sampled_rows.from_lanes(by_sampled), own_rows.from_lanes(by_own);
    int64_t first = chunk * s.chunk_rows, end = last_row(s, chunk);
    float* halo = s.halo + chunk * 2 * HALO * s.width * (S + 1);
    for (int k = 0; k < count; k++) {
      add<C>(s.by_features + at[k] * C, own_rows.row[k], 1);
      s.by_alpha[at[k]] += own_rows.row[k][C];
      for (int j = 0; j < 4; j++) {
        int64_t to = corner[j][k], y = to / s.width;
        float *features = s.by_features + to * C, *alpha = s.by_alpha + to;
        if (y < first || y >= end) {
          features = halo + (to - (y < first ? first - HALO : end - HALO) * s.width) * (S + 1);
          alpha = features + S;
        }
        add<S>(features, sampled_rows.row[k], w[j][k]);
        *alpha += w[j][k] * sampled_rows.row[k][S];
      }
    }
  }
};

INLINE Vector inverse_norm(Vectors n) { return 1.0f / root(dot(n, n) + 1e-24f); }

INLINE Vectors towards_camera(const Shade& s, const int64_t* at) {
  const double* m = s.view;
  Vector x, y;
  for (int k = 0; k < LANES; k++) {
    x[k] = (float)((s.cx - 0.5 - (double)(at[k] % s.width)) / s.fx), y[k] = (float)((s.cy - 0.5 - (double)(at[k] / s.width)) / s.fy);
  }
  auto along = [&](int i) { return x * (float)m[i] + y * (float)m[4 + i] - (float)m[8 + i]; };
  Vectors v = {along(0), along(1), along(2)};
  return inverse_norm(v) * v;
}

INLINE Vectors mirror(Vectors normal, Vectors view, Vector& n_dot_v) {
  n_dot_v = dot(normal, view);
  return 2.0f * n_dot_v * normal - view;
}

// The split sum over a metallic-roughness material, of LANES pixels. HARMONICS: colour by direction in place of the reflected
// irradiance. INDIRECT: light from the object itself where it stands in the mirror direction (Eq. 9).
template <bool HARMONICS, bool INDIRECT>
struct Shaded {
  static constexpr int APPEARANCE = HARMONICS ? 8 : 0, FROM_OBJECT = INDIRECT ? 8 + 3 * HARMONICS : 0;  // channels
  static constexpr int C = 11 + 3 * HARMONICS + 3 * INDIRECT, S = C - 3;
  Displaced<C> map;
  Vector inverse_length, n_dot_v, coat, visibility;
  Vectors normal, view;
  Lookup lookup;
  Irradiance irradiance;
  ReflectanceTable fg;
  Vector light[3], received[3], radiance[3], encoded[3], slope[3];

  MEMBER Shaded(const Shade& s, const int64_t* at)
      : map(s, at),
        inverse_length(inverse_norm({map.value[NORMAL], map.value[NORMAL + 1], map.value[NORMAL + 2]})),
        normal(inverse_length * Vectors{map.value[NORMAL], map.value[NORMAL + 1], map.value[NORMAL + 2]}),
        view(towards_camera(s, at)),
        lookup(s.levels, mirrored(), map.value[ROUGHNESS]),
        irradiance(normal),
        fg(s.fg, s.fg_side, clamp(n_dot_v, 1e-4f, 1), map.value[ROUGHNESS]) {
    const Vector(&v)[S] = map.value;
    Vector metallic = v[METALLIC];
    Vectors l = lookup.light(s.levels);
    light[0] = l.x, light[1] = l.y, light[2] = l.z;
    visibility = Vector() + 1.0f;
    if (INDIRECT) {
      Vector free[1];
      gather<1>(s.visibility, at, free);
      visibility = free[0];
      for (int c = 0; c < 3; c++) light[c] = visibility * light[c] + (1.0f - visibility) * v[FROM_OBJECT + c];
    }
    coat = 1.0f - DIELECTRIC_F0 * fg.value[0] - fg.value[1];
    for (int c = 0; c < 3; c++) {
      received[c] = HARMONICS ? v[APPEARANCE + c] : irradiance.value(s.irradiance, c);
      Vector diffuse = (1.0f - metallic) * received[c];
      if (!HARMONICS) diffuse *= coat * v[ALBEDO + c];
      radiance[c] = light[c] * (f0(c) * fg.value[0] + fg.value[1]) + diffuse;
      encoded[c] = srgb_encode(radiance[c], slope[c]);
    }
  }

  MEMBER void write(const Shade& s, int count) const {
    const Vector(&v)[S] = map.value;
    Vector color[3];
    for (int c = 0; c < 3; c++) color[c] = encoded[c] * map.alpha + (1.0f - map.alpha) * s.background[c];
    scatter<3>(s.color, map.at, count, color);
    scatter<3>(s.normal, map.at, count, {v[NORMAL], v[NORMAL + 1], v[NORMAL + 2]});
    scatter<5>(s.material, map.at, count, {v[ALBEDO], v[ALBEDO + 1], v[ALBEDO + 2], v[METALLIC], v[ROUGHNESS]});
    scatter<3>(s.radiance, map.at, count, radiance);
  }

  MEMBER void backward(const Shade& s, int64_t chunk, int count, Vector* by_irradiance) const {
    Vector by_color[3], by_normal[3], by_material[5], by_alpha = {};
    gather<3>(s.by_color, map.at, by_color), gather<3>(s.by_normal, map.at, by_normal), gather<5>(s.by_material, map.at, by_material);
    Mask counted;
    for (int k = 0; k < LANES; k++) counted[k] = k < count ? -1 : 0;

    const Vector(&v)[S] = map.value;
    Vector metallic = v[METALLIC], by[S] = {}, by_light[3], by_fg[2] = {}, by_coat = {};
    by[METALLIC] = by_material[3], by[ROUGHNESS] = by_material[4];
    Vectors by_n = {};
    for (int c = 0; c < 3; c++) {
      Vector by_c = select(counted, by_color[c], Vector());
      by_alpha += by_c * (encoded[c] - s.background[c]);
      Vector by_radiance = by_c * map.alpha * slope[c];
      by_light[c] = by_radiance * (f0(c) * fg.value[0] + fg.value[1]);
      if (INDIRECT) {
        by[FROM_OBJECT + c] = (1.0f - visibility) * by_light[c];
        by_light[c] *= visibility;
      }
      Vector reflected = by_radiance * light[c], by_f0 = reflected * fg.value[0];
      by_fg[0] += reflected * f0(c), by_fg[1] += reflected;
      by[ALBEDO + c] = by_material[c] + by_f0 * metallic;
      by[METALLIC] += by_f0 * (v[ALBEDO + c] - DIELECTRIC_F0);
      if (HARMONICS) {
        by[APPEARANCE + c] = by_radiance * (1.0f - metallic);
        by[METALLIC] -= by_radiance * received[c];
      } else {
        Vector by_diffuse = by_radiance * received[c], base = (1.0f - metallic) * coat;
        by[ALBEDO + c] += by_diffuse * base;
        by[METALLIC] -= by_diffuse * v[ALBEDO + c] * coat;
        by_coat += by_diffuse * v[ALBEDO + c] * (1.0f - metallic);
        Vector by_received = select(received[c] > 0.0f, by_radiance * base * v[ALBEDO + c], Vector());
        irradiance.backward(s.irradiance, c, by_received, by_irradiance, by_n);
      }
    }
    by_fg[0] -= DIELECTRIC_F0 * by_coat, by_fg[1] -= by_coat;
    by[ROUGHNESS] += by_fg[0] * fg.by_roughness[0] + by_fg[1] * fg.by_roughness[1];
    Vector by_n_v = by_fg[0] * fg.by_n_v[0] + by_fg[1] * fg.by_n_v[1];
    by_n_v = select((n_dot_v > 1e-4f) & (n_dot_v < 1.0f), by_n_v, Vector());
    Vector by_roughness;
    Vectors by_mirrored = lookup.backward(s.levels, {by_light[0], by_light[1], by_light[2]}, count,
                                          s.by_chunk_texels + chunk * 4 * s.texels, by_roughness);
    by[ROUGHNESS] += by_roughness;
    by_n = by_n + 2.0f * n_dot_v * by_mirrored + (2.0f * dot(by_mirrored, normal) + by_n_v) * view;
    by_n = inverse_length * (by_n - dot(by_n, normal) * normal);
    by[NORMAL] = by_n.x + by_normal[0], by[NORMAL + 1] = by_n.y + by_normal[1], by[NORMAL + 2] = by_n.z + by_normal[2];
    map.backward(s, by, by_alpha, chunk, count);
  }

 private:
  MEMBER Vector f0(int c) const { return DIELECTRIC_F0 * (1.0f - map.value[METALLIC]) + map.value[ALBEDO + c] * map.value[METALLIC]; }

  MEMBER Vectors mirrored() { return mirror(normal, view, n_dot_v); }
};

template <int C>
void mirrored_rows(const Shade& s, int64_t first, int64_t end) {
  zero(s.mirrored + 3 * first * s.width, 3 * (end - first) * s.width);
  each_covered(s, first, end, [&](const int64_t* at, int count) {
    Displaced<C> map(s, at);
    Vectors normal = {map.value[NORMAL], map.value[NORMAL + 1], map.value[NORMAL + 2]}, view = towards_camera(s, at);
    Vector n_dot_v;
    Vectors m = mirror(inverse_norm(normal) * normal, view, n_dot_v);
    scatter<3>(s.mirrored, at, count, {m.x, m.y, m.z});
  });
}

template <bool HARMONICS, bool INDIRECT>
void forward_rows(const Shade& s, int64_t first, int64_t end) {
  for (int64_t i = first * s.width; i < end * s.width; i++) {
    for (int c = 0; c < 3; c++) s.color[3 * i + c] = s.background[c], s.normal[3 * i + c] = s.radiance[3 * i + c] = 0;
    for (int c = 0; c < 5; c++) s.material[5 * i + c] = 0;
  }
  each_covered(s, first, end, [&](const int64_t* at, int count) { Shaded<HARMONICS, INDIRECT>(s, at).write(s, count); });
}

template <bool HARMONICS, bool INDIRECT>
void backward_chunk(const Shade& s, int64_t chunk) {
  using Pixels = Shaded<HARMONICS, INDIRECT>;
  constexpr int C = Pixels::C;
  int64_t first = chunk * s.chunk_rows, end = last_row(s, chunk);
  zero(s.by_features + first * s.width * C, (end - first) * s.width * C);
  zero(s.by_alpha + first * s.width, (end - first) * s.width);
  zero(s.halo + chunk * 2 * HALO * s.width * (C - 2), 2 * HALO * s.width * (C - 2));
  zero(s.by_chunk_texels + chunk * 4 * s.texels, 4 * s.texels);
  Vector by_irradiance[27] = {};
  each_covered(s, first, end, [&](const int64_t* at, int count) { Pixels(s, at).backward(s, chunk, count, by_irradiance); });
  for (int i = 0; i < 27; i++) s.by_irradiance[chunk * 27 + i] = total(by_irradiance[i]);
}

// What the chunks above and below added to a row.
void add_halo(const Shade& s, int64_t y) {
  int64_t chunk = y / s.chunk_rows, first = chunk * s.chunk_rows, end = last_row(s, chunk), S = s.channels - 3;
  for (int64_t from = chunk - 1; from <= chunk + 1; from += 2) {
    int64_t row = from < chunk ? HALO + y - first : y - (end - HALO);
    if (from < 0 || from >= chunks(s) || row < 0 || row >= 2 * HALO) continue;
    const float* halo = s.halo + (from * 2 * HALO + row) * s.width * (S + 1);
    for (int64_t x = 0; x < s.width; x++, halo += S + 1) {
      float* features = s.by_features + (y * s.width + x) * s.channels;
      for (int64_t c = 0; c < S; c++) features[c] += halo[c];
      s.by_alpha[y * s.width + x] += halo[S];
    }
  }
}

constexpr int ROWS = 8;        // at a time, forward
constexpr int TEXELS = 1024;   // at a time

}  // namespace

EXPORT int64_t refgs_shade_halo_size(int64_t width, int64_t channels) { return 2 * HALO * width * (channels - 2); }

KERNEL(refgs_shade_mirrored, Shade, s) {
  auto* rows = s->channels == 14 ? mirrored_rows<14> : mirrored_rows<17>;
  for (int64_t y; (y = take(s->shared.next, ROWS)) < s->height;) rows(*s, y, y + ROWS < s->height ? y + ROWS : s->height);
}

KERNEL(refgs_shade_forward, Shade, s) {
  auto* rows = s->visibility ? (s->harmonics ? forward_rows<true, true> : forward_rows<false, true>)
                             : (s->harmonics ? forward_rows<true, false> : forward_rows<false, false>);
  for (int64_t y; (y = take(s->shared.next, ROWS)) < s->height;) rows(*s, y, y + ROWS < s->height ? y + ROWS : s->height);
}

KERNEL(refgs_shade_backward, Shade, s) {
  auto* chunk = s->visibility ? (s->harmonics ? backward_chunk<true, true> : backward_chunk<false, true>)
                              : (s->harmonics ? backward_chunk<true, false> : backward_chunk<false, false>);
  for (int64_t k; (k = take(s->shared.next, 1)) < chunks(*s);) chunk(*s, k);
}

KERNEL(refgs_shade_gather, Shade, s) {
  int64_t batches = (s->texels + TEXELS - 1) / TEXELS;
  for (int64_t k; (k = take(s->shared.next, 1)) < s->height + batches;) {
    if (k < s->height) {
      add_halo(*s, k);
      continue;
    }
    int64_t first = (k - s->height) * TEXELS, end = first + TEXELS < s->texels ? first + TEXELS : s->texels;
    for (int64_t i = first; i < end; i++) {
      Four sum = {};
      for (int64_t c = 0; c < chunks(*s); c++) sum += *(const Four*)(s->by_chunk_texels + 4 * (c * s->texels + i));
      for (int j = 0; j < 3; j++) s->by_levels[3 * i + j] = sum[j];
    }
  }
}
