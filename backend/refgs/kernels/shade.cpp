// Maps to a picture and back: deferred shading of what the rasteriser blended (paper Eq. 5-10). Or surfels to their colours, before
// they are blended (paper 3.3, the initial stage): there a "pixel" is a surfel, seen from where it is.
//
// Pixels that nothing covers cost nothing: the others are taken LANES at a time, wherever they lie. The CPU works on the picture in
// chunks of rows whose size does not depend on the threads, and sums are taken in the chunks' order, so neither does any result.
// With CUDA, where a thread has a pixel, what many add to is summed up in integers: in whatever order, the sum is the same.
#include "light.h"

namespace {

constexpr float COVERED = 1.0f / 255.0f;    // less alpha than this is background
constexpr float SHIFT_LIMIT = 8;            // pixels
constexpr float SHIFT_ALPHA = 0.3f;         // a silhouette's blended position says nothing about its surface
constexpr int HALO = (int)SHIFT_LIMIT + 1;  // rows that a displaced look-up reaches beyond its own
constexpr int NORMAL = 0, ALBEDO = 3, METALLIC = 6, ROUGHNESS = 7;  // channels; Shaded has those that may follow

struct Shade {
  int64_t width, height, channels, chunk_rows;
  float view[12];  // world to camera, 3x4, row-major
  float turn[9];   // world to where the light stands, a rotation, row-major
  float fx, fy, cx, cy;
  const float* background;        // (3)
  const float* exposure;          // (1): what radiance is multiplied by before it is encoded
  int64_t harmonics;              // whether there are channels of colour by direction
  int64_t splats, display;        // whether pixels are surfels; whether colours are blended and compared as they are, not encoded
  int64_t mirror;                 // whether the light that is mirrored is the sharp one, and metallic its share, as in 3DGS-DR
  int64_t matte;                  // whether none is: there are no channels of metallic and roughness then
  const float *features, *alpha;  // (height, width, channels), (height, width): sums over a pixel's splats
  const float* visibility;        // (height, width): 0 where the object itself stands in the mirror direction; or null
  Levels levels;
  int64_t texels, cells, lines;
  const float* light;             // (texels, 3)
  const int32_t* texel;           // (cells): under each cell of the padded faces
  float* padded;                  // (cells, 4): for levels.cells
  const int32_t *starts, *cell;   // the cells of texel i: `cell` from starts[i] to starts[i + 1]
  const float* reflectance;       // (reflectance_side, reflectance_side, 4)
  int64_t reflectance_side;
  float *mirrored;                                        // (height, width, 3)
  float *color, *normal, *material, *radiance;            // (height, width, 3 | 3 | 5 | 3)
  const float *by_color, *by_normal, *by_material;
  float *by_features, *by_alpha;
  float *by_light, *by_exposure;    // (texels, 3), (chunks or, with CUDA, blocks)
  float* near;                      // (chunks, chunk_rows + 2 HALO, width, 4): by the normals that a chunk looked up, and by their alpha
  float* by_cells;                  // (chunks + 1, cells, 4): the last, their sum
  uint8_t* touched;                 // (chunks, chunk_rows + 2 HALO + lines): the rows of those that a chunk has written
  // With CUDA in place of those three, zero at first:
  int64_t *map_sums, *cell_sums;    // (4, height, width), (cells, 3)
  int32_t* largest;                 // (2): of the numbers that are added to each
  float* scratch;                   // none is used
  mutable Shared shared;
};

int64_t chunks(const Shade& s) { return (s.height + s.chunk_rows - 1) / s.chunk_rows; }

// LANES covered pixels, the last one repeated where there are fewer.
struct Pixels {
  int count;
  int32_t at[LANES];
  alignas(64) float column[LANES], row[LANES], alpha[LANES];

  MEMBER void set(int k, int64_t i, int64_t x, int64_t y, float a) {
    at[k] = (int32_t)i, column[k] = (float)x, row[k] = (float)y, alpha[k] = a;
  }
};

// body(pixels) for all covered ones from pixel i on.
template <class Body>
INLINE void each_covered(const Shade& s, int64_t i, int64_t end, Body body) {
  Pixels p;
  int64_t y = (int32_t)i / (int32_t)s.width, x = i - y * s.width;
  if constexpr (LANES == 1) {  // of one pixel
    if (s.alpha[i] > COVERED) p.count = 1, p.set(0, i, x, y, s.alpha[i]), body(p);
    return;
  }
  for (;;) {
    int n = 0;
    for (; i < end && n < LANES; i++) {
      if (s.alpha[i] > COVERED) p.set(n++, i, x, y, s.alpha[i]);
      if (++x == s.width) x = 0, y++;
    }
    if (!n) return;
    p.count = n;
    for (; n < LANES; n++) p.at[n] = p.at[n - 1], p.column[n] = p.column[n - 1], p.row[n] = p.row[n - 1], p.alpha[n] = p.alpha[n - 1];
    body(p);
  }
}

// Zero for those that are repeated.
template <int N>
INLINE void gather(const float* map, const Pixels& p, Vector (&v)[N]) {
  alignas(64) float lanes[N][LANES] = {};
  for (int k = 0; k < p.count; k++)
    for (int c = 0; c < N; c++) lanes[c][k] = map[(int64_t)p.at[k] * N + c];
  for (int c = 0; c < N; c++) v[c] = load(lanes[c]);
}

template <int N>
INLINE void scatter(float* map, const Pixels& p, const Vector (&v)[N]) {
  alignas(64) float lanes[N][LANES];
  for (int c = 0; c < N; c++) store(lanes[c], v[c]);
  for (int k = 0; k < p.count; k++)
    for (int c = 0; c < N; c++) map[(int64_t)p.at[k] * N + c] = lanes[c][k];
}

// The four pixels about each of LANES points: the first, and how far it is to the one beside it and to the one below.
struct Corners {
  int32_t first[LANES], row[LANES];
  int64_t next, below;
  Vector x, y;  // how far the point is along

  MEMBER int64_t at(int k, int j) const { return first[k] + (j & 1 ? next : 0) + (j & 2 ? below : 0); }
  MEMBER void weights(Vector (&w)[4]) const {
    w[0] = (1.0f - x) * (1.0f - y), w[1] = x * (1.0f - y), w[2] = (1.0f - x) * y, w[3] = x * y;
  }
};

#ifdef __CUDACC__
// What fixed-point numbers count, such that neither they nor their sums overflow: a power of two.
struct Unit {
  float per, size;  // how many make one; one of them

  // For sums of up to 2^count numbers up to `largest`, the bits of a float. Where that is not finite no sum is a number.
  Unit(int32_t largest, int count) {
    int exponent = (largest >> 23) - 127;  // largest < 2^(exponent + 1)
    int bits = 60 - count - exponent;
    bits = bits < 126 ? bits : 126;
    per = __int_as_float((127 + bits) << 23);
    size = __int_as_float(exponent < 128 ? (127 - bits) << 23 : 0x7fc00000);
  }
};

constexpr int SOURCES = 9;  // 2^9 > (2 HALO + 1)^2: the pixels that can add to one, each with weights of up to 1 in all

// Of cells: all pixels may add to one, twelve numbers each.
int adders(const Shade& s) { return 4 + 64 - __clzll(s.width * s.height); }

// The derivatives by the maps and by the light of a pixel: what it adds to others. A first pass takes the LARGEST of that in
// magnitude, a second adds it.
template <bool LARGEST>
struct Contributions {
  const Shade& s;
  float map_scale, cell_scale;
  int32_t largest_map = 0, largest_cell = 0;
  float by_exposure = 0;

  Contributions(const Shade& s) : s(s) {
    if (!LARGEST) map_scale = Unit(s.largest[0], SOURCES).per, cell_scale = Unit(s.largest[1], adders(s)).per;
  }

  template <int C>
  void add_own(const Pixels& p, const Vector (&by_own)[C], Vector by_alpha) {
    if (LARGEST) return;
    for (int c = 0; c < C; c++) s.by_features[(int64_t)p.at[0] * C + c] = by_own[c].value;
    s.by_alpha[p.at[0]] = by_alpha.value;
  }

  void add_sampled(const Corners& c, int, const Vector (&by_sampled)[4]) {
    Vector weight[4];
    c.weights(weight);
    for (int i = 0; i < 4; i++) {
      float by = by_sampled[i].value;
      if (LARGEST) {
        raise(largest_map, by);
      } else {
        int64_t* sums = s.map_sums + i * s.width * s.height;
        for (int j = 0; j < 4; j++) add(sums + c.at(0, j), by * weight[j].value * map_scale);
      }
    }
  }

  void add_exposure(Vector by) { by_exposure = by.value; }

  template <int N>
  void add_light(const Lookup<N, true>& l, int, const Vector (&by_light)[3]) {
    Vector weight[N][4];
    l.weights(weight);
    for (int i = 0; i < N; i++)
      for (int j = 0; j < 4; j++)
        for (int c = 0; c < 3; c++) {
          float by = by_light[c].value * weight[i][j].value;
          if (LARGEST)
            raise(largest_cell, by);
          else
            add(s.cell_sums + 3 * (int64_t)(l.cell[i][0] + (j & 1) + (j & 2 ? l.width[i][0] : 0)) + c, by * cell_scale);
        }
  }

 private:
  static void raise(int32_t& largest, float v) {
    int32_t bits = __float_as_int(v) & 0x7fffffff;  // in the order of the magnitudes, a NaN beyond all
    largest = bits > largest ? bits : largest;
  }
  static void add(int64_t* to, float v) {
    if (v != 0) atomicAdd((unsigned long long*)to, (unsigned long long)(int64_t)v);
  }
};
#else
typedef Wide<8>::type Eight;

void zero(float* p, int64_t n) {
  for (int64_t i = 0; i < n; i++) p[i] = 0;
}

// The derivatives by the maps and by the light of a chunk of rows.
struct Chunk {
  const Shade& s;
  int64_t first, end;         // pixels
  float *near, *cells;        // near: as for the picture's first pixel
  uint8_t *rows, *lines;      // touched
  Vector by_exposure = {};

  Chunk(const Shade& s, int64_t index) : s(s), first(index * s.chunk_rows * s.width) {
    int64_t left = s.height - index * s.chunk_rows;
    end = first + (left < s.chunk_rows ? left : s.chunk_rows) * s.width;
    int64_t before = index * s.chunk_rows - HALO, most = s.chunk_rows + 2 * HALO;
    cells = s.by_cells + index * 4 * s.cells, near = s.near + 4 * s.width * (index * most - before);
    rows = s.touched + index * (most + s.lines) - before, lines = rows + before + most;
    zero(s.by_features + first * s.channels, (end - first) * s.channels);
    zero(s.by_alpha + first, end - first);
    for (int64_t i = before; i < before + most + s.lines; i++) rows[i] = 0;
  }

  // To the pixels themselves.
  template <int C>
  MEMBER void add_own(const Pixels& p, const Vector (&by_own)[C], Vector by_alpha) {
    Rows<C> own(by_own);
    alignas(64) float alpha[LANES];
    store(alpha, by_alpha);
    for (int k = 0; k < p.count; k++) own.add(k, 1, s.by_features + (int64_t)p.at[k] * C), s.by_alpha[p.at[k]] = alpha[k];
  }

  // To the corners, by their weights.
  MEMBER void add_sampled(const Corners& c, int count, const Vector (&by_sampled)[4]) {
    alignas(64) float w[4][LANES];
    Vector weight[4];
    c.weights(weight);
    for (int j = 0; j < 4; j++) store(w[j], weight[j]);
    Rows<4> sampled(by_sampled);
    for (int k = 0; k < count; k++) {
      int64_t row = c.row[k], below = row + (c.below > 0);
      if (!(rows[row] & rows[below])) touch_row(row), touch_row(below);
      for (int j = 0; j < 4; j++) sampled.add(k, w[j][k], near + 4 * c.at(k, j));
    }
  }

  MEMBER void add_exposure(Vector by) { by_exposure += by; }

  // To the cells that were looked up.
  template <int N>
  MEMBER void add_light(const Lookup<N, true>& l, int count, const Vector (&by_light)[3]) {
    Vector weight[N][4];
    l.weights(weight);
    Rows<4> by({by_light[0], by_light[1], by_light[2], Vector()});
    for (int i = 0; i < N; i++) {
      Rows<4> w(weight[i]);
      for (int k = 0; k < count; k++) {
        Four light = by.get(k, 0), four = w.get(k, 0);
        Eight twice = __builtin_shufflevector(light, light, 0, 1, 2, 3, 0, 1, 2, 3);
        int32_t line = l.line[i][k];
        if (!(lines[line] & lines[line + 1])) touch(line), touch(line + 1);
        float *above = cells + 4 * (int64_t)l.cell[i][k], *below = above + 4 * (int64_t)l.width[i][k];
        auto add = [](float* to, Eight v) {
          Eight was;
          __builtin_memcpy(&was, to, sizeof was);
          was += v;
          __builtin_memcpy(to, &was, sizeof was);
        };
        add(above, __builtin_shufflevector(four, four, 0, 0, 0, 0, 1, 1, 1, 1) * twice);
        add(below, __builtin_shufflevector(four, four, 2, 2, 2, 2, 3, 3, 3, 3) * twice);
      }
    }
  }

 private:
  __attribute__((noinline)) void touch_row(int64_t row) {
    if (!rows[row]) zero(near + 4 * row * s.width, 4 * s.width);
    rows[row] = 1;
  }
  __attribute__((noinline)) void touch(int32_t line) {
    if (lines[line]) return;
    lines[line] = 1;
    zero(cells + 4 * s.levels.first_cell(line), 4 * s.levels.width(line));
  }
};
#endif

// Discs sorted and blended by their centres favour those in front: on a curved surface the blend at a pixel is that of a point
// nearer to the camera, whose normal leans towards it. The blended position tells which point; the pixel whose blend is *this*
// pixel's point lies the same way back, and the normal is read there. The other channels are this pixel's own: what a surface looks
// like is learned where it shows, and reading it elsewhere would blur it. C channels.
template <int C, bool DERIVATIVES>
struct Displaced {
  static constexpr int S = C - 3;
  const Pixels& pixels;
  Vector alpha, inverse, own[C], value[S];
  Vector x, y, inverse_z, px, py;  // the blended point in camera space; where it projects
  Mask moves_x, moves_y;           // the derivative passes the limits
  Corners corners;
  Vector there, trust, scale, inverse_there;
  Vector sampled[4], by_x[4], by_y[4], there_by_x, there_by_y;  // normals blended over the four corners, and how that changes along x and y

  MEMBER Displaced(const Shade& s, const Pixels& p) : pixels(p), alpha(load(p.alpha)), inverse(reciprocal(alpha)) {
    to_lanes<C>([&](int k, int b) { return Blocks<C>::get(s.features + (int64_t)p.at[k] * C + Blocks<C>::at(b)); }, own);
    for (int c = 0; c < C; c++) own[c] *= inverse;

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
    Vector u = column - select(solid, clamp(shift_x, -SHIFT_LIMIT, SHIFT_LIMIT), Vector());
    Vector v = line - select(solid, clamp(shift_y, -SHIFT_LIMIT, SHIFT_LIMIT), Vector());
    float right = (float)(s.width - 1), bottom = (float)(s.height - 1);
    moves_x &= (u > 0.0f) & (u < right), moves_y &= (v > 0.0f) & (v < bottom);
    u = clamp(u, 0, right), v = clamp(v, 0, bottom);
    // At the right and at the bottom the last two, unless there is but one.
    corners.next = s.width > 1, corners.below = s.height > 1 ? s.width : 0;
    Vector u0 = smaller(round_down(u), Vector() + (right - (float)corners.next));
    Vector v0 = smaller(round_down(v), Vector() + (s.height > 1 ? bottom - 1 : 0));
    Mask first_row = convert<Mask>(v0);
    store(corners.row, first_row), store(corners.first, first_row * (int32_t)s.width + convert<Mask>(u0));
    corners.x = u - u0, corners.y = v - v0;

    alignas(64) float along_x[LANES], along_y[LANES];
    store(along_x, corners.x), store(along_y, corners.y);
    typedef typename Blocks<4>::Numbers Numbers;  // the normal's, and one more, as four are quick to load
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
    // At a silhouette the way back leads off the object: there the pixel keeps its own blend.
    trust = clamp((there - SHIFT_ALPHA) * (1 / SHIFT_ALPHA), 0, 1);
    inverse_there = reciprocal(larger(there, Vector() + SHIFT_ALPHA));
    scale = trust * inverse_there;
    for (int c = 0; c < S; c++) value[c] = c < ALBEDO ? scale * sampled[c] + (1.0f - trust) * own[c] : own[c];
  }

  // From the derivatives by `value` and by the pixel's own alpha.
  template <class Sums>
  MEMBER void backward(const Shade& s, const Vector (&by_value)[S], Vector by_alpha, Sums& sums) const {
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
    for (int c = 0; c < S; c++) by_own[c] = c < ALBEDO ? (1.0f - trust) * by_value[c] : by_value[c];
    for (int c = 0; c < C; c++) by_own[c] *= inverse, by_alpha -= by_own[c] * own[c];
    sums.add_own(pixels, by_own, by_alpha);
    sums.add_sampled(corners, pixels.count, by_sampled);
  }
};

INLINE Vector inverse_norm(Vectors n) { return inverse_root(dot(n, n) + 1e-24f); }

// Surfels: their own channels.
template <int C>
struct Own {
  static constexpr int S = C - 3;
  const Pixels& pixels;
  Vector alpha, value[C];

  MEMBER Own(const Shade& s, const Pixels& p) : pixels(p), alpha(Vector() + 1.0f) { gather<C>(s.features, p, value); }

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

INLINE Vectors towards_camera(const Shade& s, const Pixels& p) {
  const float* m = s.view;
  Vector x = ((s.cx - 0.5f) - load(p.column)) * (1 / s.fx), y = ((s.cy - 0.5f) - load(p.row)) * (1 / s.fy);
  auto along = [&](int i) { return x * m[i] + y * m[4 + i] - m[8 + i]; };
  Vectors v = {along(0), along(1), along(2)};
  return inverse_norm(v) * v;
}

// By a rotation; by its inverse.
INLINE Vectors turned(const float* m, Vectors v) {
  auto row = [&](int i) { return m[i] * v.x + m[i + 1] * v.y + m[i + 2] * v.z; };
  return {row(0), row(3), row(6)};
}
INLINE Vectors turned_back(const float* m, Vectors v) {
  auto column = [&](int i) { return m[i] * v.x + m[i + 3] * v.y + m[i + 6] * v.z; };
  return {column(0), column(1), column(2)};
}

INLINE Vectors mirror(Vectors normal, Vectors view, Vector& n_dot_v) {
  n_dot_v = dot(normal, view);
  return 2.0f * n_dot_v * normal - view;
}

// From exposed radiance to what is blended over the background, and its derivative. Of surfels it is blended as it is.
template <bool SPLATS>
INLINE void encode(const Shade& s, Vector exposed, Vector& encoded, Vector& slope) {
  if (SPLATS || s.display)
    encoded = exposed, slope = Vector() + 1.0f;
  else
    encoded = srgb_encode(exposed, slope);
}

template <bool SPLATS, class Map>
INLINE void write_pixels(const Shade& s, const Map& map, const Vector (&radiance)[3], const Vector (&encoded)[3], const Vector (&material)[5]) {
  if (SPLATS) return scatter<3>(s.color, map.pixels, radiance);
  Vector color[3];
  for (int c = 0; c < 3; c++) color[c] = encoded[c] * map.alpha + (1.0f - map.alpha) * s.background[c];
  scatter<3>(s.color, map.pixels, color);
  scatter<3>(s.normal, map.pixels, {map.value[NORMAL], map.value[NORMAL + 1], map.value[NORMAL + 2]});
  scatter<5>(s.material, map.pixels, material);
  scatter<3>(s.radiance, map.pixels, radiance);
}

// The split sum over a metallic-roughness material, of LANES pixels. HARMONICS: colour by direction in place of the reflected
// irradiance. INDIRECT: light from the object itself where it stands in the mirror direction (Eq. 9), and its shadow on the irradiance.
// SPLATS: of surfels. Directions are those of the light's frame, for it may stand with the camera.
template <bool HARMONICS, bool INDIRECT, bool SPLATS, bool DERIVATIVES>
struct Shaded {
  static constexpr bool SHADOW = INDIRECT && !HARMONICS;
  static constexpr int DIFFUSE = 8, FROM_OBJECT = INDIRECT ? 11 : 0;  // channels: the first of colour by direction, or of the shadow
  static constexpr int C = 11 + 3 * (HARMONICS || INDIRECT) + 3 * INDIRECT, S = C - 3;
  Map<SPLATS, C, DERIVATIVES> map;
  Vector inverse_length, n_dot_v, visibility;
  Vectors normal, view;
  Lookup<2, DERIVATIVES> lookup;
  Lookup<1, DERIVATIVES> irradiance;
  ReflectanceTable table;
  Vector light[3], received[3], radiance[3], encoded[3], slope[3];
  float exposure;

  MEMBER Shaded(const Shade& s, const Pixels& pixels)
      : map(s, pixels),
        inverse_length(inverse_norm({map.value[NORMAL], map.value[NORMAL + 1], map.value[NORMAL + 2]})),
        normal(inverse_length * turned(s.turn, {map.value[NORMAL], map.value[NORMAL + 1], map.value[NORMAL + 2]})),
        view(turned(s.turn, seen_from(s))),
        lookup(s.levels, mirrored(), s.mirror ? Vector() : map.value[ROUGHNESS]),
        irradiance(s.levels, normal),
        table(s.reflectance, s.reflectance_side, n_dot_v, map.value[ROUGHNESS]),
        exposure(s.exposure[0]) {
    const auto& v = map.value;
    Vector metallic = v[METALLIC];
    visibility = Vector() + 1.0f;
    if (INDIRECT) {
      Vector free[1];
      gather<1>(s.visibility, pixels, free);
      visibility = free[0];
      for (int c = 0; c < 3; c++) light[c] = visibility * lookup.light[c] + (1.0f - visibility) * v[FROM_OBJECT + c];
    } else {
      for (int c = 0; c < 3; c++) light[c] = lookup.light[c];
    }
    Vector dielectric = table.value[ReflectanceTable::DIELECTRIC];
#pragma unroll
    for (int c = 0; c < 3; c++) {
      received[c] = HARMONICS ? v[DIFFUSE + c] : SHADOW ? v[DIFFUSE + c] * irradiance.light[c] : irradiance.light[c];
      Vector diffuse = (1.0f - metallic) * received[c];
      if (!HARMONICS) diffuse *= (1.0f - dielectric) * v[ALBEDO + c];
      radiance[c] = light[c] * reflected(s, Metal(table, v[ALBEDO + c])) + diffuse;
      encode<SPLATS>(s, exposure * radiance[c], encoded[c], slope[c]);
    }
  }

  MEMBER void write(const Shade& s) const {
    const auto& v = map.value;
    write_pixels<SPLATS>(s, map, radiance, encoded, {v[ALBEDO], v[ALBEDO + 1], v[ALBEDO + 2], v[METALLIC], v[ROUGHNESS]});
  }

  template <class Sums>
  MEMBER void backward(const Shade& s, Sums& sums) const {
    Vector by_color[3], by_normal[3] = {}, by_material[5] = {}, by_alpha = {}, by_exposure = {};
    gather<3>(s.by_color, map.pixels, by_color);
    if (!SPLATS) gather<3>(s.by_normal, map.pixels, by_normal), gather<5>(s.by_material, map.pixels, by_material);

    const auto& v = map.value;
    Vector metallic = v[METALLIC], dielectric = table.value[ReflectanceTable::DIELECTRIC];
    Vector by[S] = {}, by_light[3], by_table[4] = {}, by_irradiance[3];
    by[METALLIC] = by_material[3], by[ROUGHNESS] = by_material[4];
    Vectors by_n = {};
#pragma unroll
    for (int c = 0; c < 3; c++) {
      Metal metal(table, v[ALBEDO + c]);
      if (!SPLATS) by_alpha += by_color[c] * (encoded[c] - s.background[c]);
      Vector by_exposed = by_color[c] * map.alpha * slope[c], by_radiance = exposure * by_exposed;
      by_exposure += by_exposed * radiance[c];
      by_light[c] = by_radiance * reflected(s, metal);
      if (INDIRECT) {
        by[FROM_OBJECT + c] = (1.0f - visibility) * by_light[c];
        by_light[c] *= visibility;
      }
      Vector by_reflectance = by_radiance * light[c];
      if (s.mirror) by[METALLIC] += by_reflectance, by_reflectance = Vector();
      Vector by_metal = by_reflectance * metallic;
      by[METALLIC] += by_reflectance * (metal.value - dielectric);
      by[ALBEDO + c] = by_material[c] + by_metal * metal.by_f0;
      for (int i = 0; i < 2; i++) by_table[i] += by_metal * metal.by_fg[i];
      by_table[ReflectanceTable::AVERAGE] += by_metal * metal.by_average;
      by_table[ReflectanceTable::DIELECTRIC] += by_reflectance - by_metal;
      if (HARMONICS) {
        by[DIFFUSE + c] = by_radiance * (1.0f - metallic);
        by[METALLIC] -= by_radiance * received[c];
      } else {
        Vector by_diffuse = by_radiance * received[c], base = (1.0f - metallic) * (1.0f - dielectric);
        by[ALBEDO + c] += by_diffuse * base;
        by_diffuse *= v[ALBEDO + c];
        by[METALLIC] -= by_diffuse * (1.0f - dielectric);
        by_table[ReflectanceTable::DIELECTRIC] -= by_diffuse * (1.0f - metallic);
        by_irradiance[c] = by_radiance * base * v[ALBEDO + c];
        if (SHADOW) by[DIFFUSE + c] = by_irradiance[c] * irradiance.light[c], by_irradiance[c] *= v[DIFFUSE + c];
      }
    }
    if (!HARMONICS) by_n = irradiance.backward(by_irradiance), sums.add_light(irradiance, map.pixels.count, by_irradiance);
    sums.add_exposure(by_exposure);
    Vector by_n_v = {};
    for (int i = 0; i < 4; i++) {
      by[ROUGHNESS] += by_table[i] * table.by_roughness[i];
      by_n_v += by_table[i] * table.by_n_v[i];
    }
    Vector by_roughness;
    Vectors by_mirrored = lookup.backward(by_light, by_roughness);
    sums.add_light(lookup, map.pixels.count, by_light);
    if (!s.mirror) by[ROUGHNESS] += by_roughness;
    Vector by_dot = 2.0f * dot(by_mirrored, normal) + by_n_v;
    by_n = by_n + 2.0f * n_dot_v * by_mirrored + by_dot * view;
    by_n = turned_back(s.turn, inverse_length * (by_n - dot(by_n, normal) * normal));
    by[NORMAL] = by_n.x + by_normal[0], by[NORMAL + 1] = by_n.y + by_normal[1], by[NORMAL + 2] = by_n.z + by_normal[2];
    if constexpr (SPLATS) {
      Vectors by_view = by_dot * normal - by_mirrored;
      by_view = turned_back(s.turn, inverse_norm(map.to_camera(s)) * (by_view - dot(by_view, view) * view));
      Vector by_own[C] = {};
      for (int c = 0; c < S; c++) by_own[c] = by[c];
      by_own[S] = -by_view.x, by_own[S + 1] = -by_view.y, by_own[S + 2] = -by_view.z;
      sums.add_own(map.pixels, by_own, by_alpha);
    } else {
      map.backward(s, by, by_alpha, sums);
    }
  }

 private:
  // The part of the light in the mirror direction that is sent on.
  MEMBER Vector reflected(const Shade& s, const Metal& metal) const {
    Vector metallic = map.value[METALLIC], dielectric = table.value[ReflectanceTable::DIELECTRIC];
    return s.mirror ? metallic : dielectric + metallic * (metal.value - dielectric);
  }
  MEMBER Vectors seen_from(const Shade& s) const {
    if constexpr (SPLATS) {
      Vectors v = map.to_camera(s);
      return inverse_norm(v) * v;
    } else {
      return towards_camera(s, map.pixels);
    }
  }

  MEMBER Vectors mirrored() { return mirror(normal, view, n_dot_v); }
};

// What is blended, over alpha: C channels.
template <int C>
struct Mean {
  const Pixels& pixels;
  Vector alpha, inverse, value[C];

  MEMBER Mean(const Shade& s, const Pixels& p) : pixels(p), alpha(load(p.alpha)), inverse(reciprocal(alpha)) {
    to_lanes<C>([&](int k, int b) { return Blocks<C>::get(s.features + (int64_t)p.at[k] * C + Blocks<C>::at(b)); }, value);
    for (int c = 0; c < C; c++) value[c] *= inverse;
  }

  // From the derivatives by `value` and by the pixel's own alpha.
  template <class Sums>
  MEMBER void backward(const Vector (&by_value)[C], Vector by_alpha, Sums& sums) const {
    Vector by_own[C];
    for (int c = 0; c < C; c++) by_own[c] = inverse * by_value[c], by_alpha -= by_own[c] * value[c];
    sums.add_own(pixels, by_own, by_alpha);
  }
};

// A surface that mirrors nothing: its albedo times the irradiance, of LANES pixels or SPLATS. Irradiance changes too slowly with the normal
// for the way back that Displaced goes to show: without it normals and relit pictures were better, and the photos explained as well.
template <bool SPLATS, bool DERIVATIVES>
struct Matte {
  static constexpr int C = 6;  // normal, albedo
  Mean<C> map;
  Vector inverse_length;
  Vectors normal;
  Lookup<1, DERIVATIVES> irradiance;
  Vector radiance[3], encoded[3], slope[3];
  float exposure;

  MEMBER Matte(const Shade& s, const Pixels& pixels)
      : map(s, pixels),
        inverse_length(inverse_norm({map.value[NORMAL], map.value[NORMAL + 1], map.value[NORMAL + 2]})),
        normal(inverse_length * turned(s.turn, {map.value[NORMAL], map.value[NORMAL + 1], map.value[NORMAL + 2]})),
        irradiance(s.levels, normal),
        exposure(s.exposure[0]) {
#pragma unroll
    for (int c = 0; c < 3; c++) {
      radiance[c] = map.value[ALBEDO + c] * irradiance.light[c];
      encode<SPLATS>(s, exposure * radiance[c], encoded[c], slope[c]);
    }
  }

  MEMBER void write(const Shade& s) const {
    const auto& v = map.value;
    write_pixels<SPLATS>(s, map, radiance, encoded, {v[ALBEDO], v[ALBEDO + 1], v[ALBEDO + 2], Vector(), Vector() + 1.0f});
  }

  template <class Sums>
  MEMBER void backward(const Shade& s, Sums& sums) const {
    Vector by_color[3], by_normal[3] = {}, by_material[5] = {}, by_alpha = {}, by_exposure = {}, by[C] = {}, by_irradiance[3];
    gather<3>(s.by_color, map.pixels, by_color);
    if (!SPLATS) gather<3>(s.by_normal, map.pixels, by_normal), gather<5>(s.by_material, map.pixels, by_material);
#pragma unroll
    for (int c = 0; c < 3; c++) {
      if (!SPLATS) by_alpha += by_color[c] * (encoded[c] - s.background[c]);
      Vector by_exposed = by_color[c] * map.alpha * slope[c], by_radiance = exposure * by_exposed;
      by_exposure += by_exposed * radiance[c];
      by[ALBEDO + c] = by_material[c] + by_radiance * irradiance.light[c];
      by_irradiance[c] = by_radiance * map.value[ALBEDO + c];
    }
    sums.add_exposure(by_exposure);
    sums.add_light(irradiance, map.pixels.count, by_irradiance);
    Vectors by_n = irradiance.backward(by_irradiance);
    by_n = turned_back(s.turn, inverse_length * (by_n - dot(by_n, normal) * normal));
    by[NORMAL] = by_n.x + by_normal[0], by[NORMAL + 1] = by_n.y + by_normal[1], by[NORMAL + 2] = by_n.z + by_normal[2];
    map.backward(by, by_alpha, sums);
  }
};

void mirrored_pixels(const Shade& s, int64_t first, int64_t end) {
  for (int64_t i = 3 * first; i < 3 * end; i++) s.mirrored[i] = 0;
  each_covered(s, first, end, [&](const Pixels& pixels) {
    Displaced<17, false> map(s, pixels);  // INDIRECT's channels
    Vectors normal = {map.value[NORMAL], map.value[NORMAL + 1], map.value[NORMAL + 2]}, view = towards_camera(s, pixels);
    Vector n_dot_v;
    Vectors m = mirror(inverse_norm(normal) * normal, view, n_dot_v);
    scatter<3>(s.mirrored, pixels, {m.x, m.y, m.z});
  });
}

template <bool SPLATS, class Shown, class Differentiated>
struct Kind {
  static void forward(const Shade& s, int64_t first, int64_t end) {
    const float background[3] = {s.background[0], s.background[1], s.background[2]};
    for (int64_t i = first; !SPLATS && i < end; i++) {
      for (int c = 0; c < 3; c++) s.color[3 * i + c] = background[c], s.normal[3 * i + c] = s.radiance[3 * i + c] = 0;
      for (int c = 0; c < 5; c++) s.material[5 * i + c] = 0;
    }
    each_covered(s, first, end, [&](const Pixels& pixels) { Shown(s, pixels).write(s); });
  }

  template <class Sums>
  static void backward(const Shade& s, int64_t first, int64_t end, Sums& sums) {
    each_covered(s, first, end, [&](const Pixels& pixels) { Differentiated(s, pixels).backward(s, sums); });
  }
};
template <bool HARMONICS, bool INDIRECT, bool SPLATS = false>
using Glossy = Kind<SPLATS, Shaded<HARMONICS, INDIRECT, SPLATS, false>, Shaded<HARMONICS, INDIRECT, SPLATS, true>>;
template <bool SPLATS = false>
using Dull = Kind<SPLATS, Matte<SPLATS, false>, Matte<SPLATS, true>>;

// body(kind) of what the pixels are.
template <class Body>
void by_kind(const Shade& s, Body body) {
  if (s.matte)
    s.splats ? body(Dull<true>()) : body(Dull<>());
  else if (s.splats)
    s.harmonics ? body(Glossy<true, false, true>()) : body(Glossy<false, false, true>());
  else if (s.visibility)
    s.harmonics ? body(Glossy<true, true>()) : body(Glossy<false, true>());
  else
    s.harmonics ? body(Glossy<true, false>()) : body(Glossy<false, false>());
}

// body(first, end) for all pixels, some at a time.
template <class Body>
void share_pixels(const Shade& s, Body body) {
  const int64_t STRIP = LANES == 1 ? 1 : 8 * s.width;
  int64_t pixels = s.width * s.height;
  share(s.shared, (pixels + STRIP - 1) / STRIP, 1, [&](int64_t i) {
    int64_t first = i * STRIP;
    body(first, first + STRIP < pixels ? first + STRIP : pixels);
  });
}

#ifdef __CUDACC__
// A thread a pixel.
template <bool LARGEST>
void backward_block(const Shade& s) {
  int64_t pixels = s.width * s.height, i = (int64_t)blockIdx.x * blockDim.x + threadIdx.x;
  Contributions<LARGEST> sums(s);
  bool covered = i < pixels && s.alpha[i] > COVERED;
  if (covered) by_kind(s, [&](auto kind) { kind.backward(s, i, i + 1, sums); });
  int lane = threadIdx.x % 32, warp = threadIdx.x / 32, warps = (blockDim.x + 31) / 32;
  if (LARGEST) {
    for (int step = 16; step; step /= 2) {
      int32_t map = __shfl_xor_sync(~0u, sums.largest_map, step), cell = __shfl_xor_sync(~0u, sums.largest_cell, step);
      sums.largest_map = map > sums.largest_map ? map : sums.largest_map;
      sums.largest_cell = cell > sums.largest_cell ? cell : sums.largest_cell;
    }
    if (lane == 0 && sums.largest_map) atomicMax(s.largest, sums.largest_map);
    if (lane == 0 && sums.largest_cell) atomicMax(s.largest + 1, sums.largest_cell);
    return;
  }
  if (i < pixels && !covered) {
    for (int64_t c = 0; c < s.channels; c++) s.by_features[i * s.channels + c] = 0;
    s.by_alpha[i] = 0;
  }
  __shared__ float by_warp[32];
  float sum = sums.by_exposure;
  for (int step = 16; step; step /= 2) sum += __shfl_xor_sync(~0u, sum, step);
  if (lane == 0) by_warp[warp] = sum;
  __syncthreads();
  if (threadIdx.x == 0) {
    for (int w = 1; w < warps; w++) sum += by_warp[w];
    s.by_exposure[blockIdx.x] = sum;
  }
}
#else
void backward_chunk(const Shade& s, int64_t index) {
  Chunk chunk(s, index);
  by_kind(s, [&](auto kind) { kind.backward(s, chunk.first, chunk.end, chunk); });
  s.by_exposure[index] = total(chunk.by_exposure);
}

// What chunks added to the normals of a row: its own, that above and that below.
void add_near(const Shade& s, int64_t y) {
  int64_t chunk = y / s.chunk_rows, most = s.chunk_rows + 2 * HALO;
  for (int64_t from = chunk - 1; from <= chunk + 1; from++) {
    int64_t row = y - from * s.chunk_rows + HALO;
    if (from < 0 || from >= chunks(s) || row < 0 || row >= most || !s.touched[from * (most + s.lines) + row]) continue;
    const float* near = s.near + 4 * (from * most + row) * s.width;
    for (int64_t i = 0; i < s.width; i++) {
      for (int c = 0; c < ALBEDO; c++) s.by_features[(y * s.width + i) * s.channels + c] += near[4 * i + c];
      s.by_alpha[y * s.width + i] += near[4 * i + 3];
    }
  }
}

// What the chunks added to a line of cells.
void add_line(const Shade& s, int32_t line) {
  int64_t first = 4 * s.levels.first_cell(line), n = 4 * s.levels.width(line);
  float* sum = s.by_cells + chunks(s) * 4 * s.cells + first;
  zero(sum, n);
  for (int64_t k = 0; k < chunks(s); k++) {
    int64_t most = s.chunk_rows + 2 * HALO;
    if (!s.touched[k * (most + s.lines) + most + line]) continue;
    const float* from = s.by_cells + k * 4 * s.cells + first;
    for (int64_t i = 0; i < n; i++) sum[i] += from[i];
  }
}

#endif

constexpr int BATCH = 1024;  // cells or texels

}  // namespace

// The light's cells from its texels.
KERNEL(refgs_shade_pad, Shade, s) {
  share(s->shared, s->cells, BATCH, [light = s->light, texel = s->texel, padded = s->padded](int64_t i) {
    const float* from = light + 3 * texel[i];
    *(Four*)(padded + 4 * i) = Four{from[0], from[1], from[2], 0};
  });
}

KERNEL(refgs_shade_mirrored, Shade, s) {
  share_pixels(*s, [&](int64_t first, int64_t end) { mirrored_pixels(*s, first, end); });
}

KERNEL(refgs_shade_forward, Shade, s) {
  share_pixels(*s, [&](int64_t first, int64_t end) { by_kind(*s, [&](auto kind) { kind.forward(*s, first, end); }); });
}

#ifdef __CUDACC__
KERNEL(refgs_shade_largest, Shade, s) { backward_block<true>(*s); }
KERNEL(refgs_shade_backward, Shade, s) { backward_block<false>(*s); }

KERNEL(refgs_shade_gather, Shade, s) {
  int64_t pixels = s->width * s->height;
  float unit = Unit(s->largest[0], SOURCES).size;
  share(s->shared, pixels, 1, [&](int64_t i) {
    for (int64_t c = 0; c < ALBEDO; c++) s->by_features[i * s->channels + c] += unit * (float)s->map_sums[c * pixels + i];
    s->by_alpha[i] += unit * (float)s->map_sums[3 * pixels + i];
  });
}

KERNEL(refgs_shade_unpad, Shade, s) {
  float unit = Unit(s->largest[1], adders(*s)).size;
  share(s->shared, s->texels, BATCH, [&](int64_t i) {
    int64_t sum[3] = {};
    for (int32_t k = s->starts[i]; k < s->starts[i + 1]; k++)
      for (int c = 0; c < 3; c++) sum[c] += s->cell_sums[3 * (int64_t)s->cell[k] + c];
    for (int c = 0; c < 3; c++) s->by_light[3 * i + c] = unit * (float)sum[c];
  });
}
#else
KERNEL(refgs_shade_backward, Shade, s) {
  share(s->shared, chunks(*s), 1, [&](int64_t k) { backward_chunk(*s, k); });
}

KERNEL(refgs_shade_gather, Shade, s) {
  share(s->shared, s->height + s->lines, 8, [&](int64_t k) {
    k < s->height ? add_near(*s, k) : add_line(*s, (int32_t)(k - s->height));
  });
}

KERNEL(refgs_shade_unpad, Shade, s) {
  const float* sums = s->by_cells + chunks(*s) * 4 * s->cells;
  share(s->shared, s->texels, BATCH, [&](int64_t i) {
    Four sum = {};
    for (int32_t k = s->starts[i]; k < s->starts[i + 1]; k++) sum += *(const Four*)(sums + 4 * (int64_t)s->cell[k]);
    for (int c = 0; c < 3; c++) s->by_light[3 * i + c] = sum[c];
  });
}

EXPORT int64_t refgs_shade_halo() { return 2 * HALO; }
#endif
