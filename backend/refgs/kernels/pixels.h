// Input of shading: the maps, groups of LANES covered pixels, and the four pixels around a point.
#pragma once

#include "light.h"

namespace {

constexpr float COVERED = 1.0f / 255.0f;    // pixels with less alpha are background
constexpr float SHIFT_LIMIT = 8;            // longest shift of Displaced's look-up, in pixels
constexpr float SHIFT_ALPHA = 0.3f;         // below this alpha, at silhouettes, the blended position does not lie on the surface
constexpr float SHIFT_BEND = 5;             // curvature at which Displaced trusts both normals alike; a unit of length is about the object's radius
constexpr int HALO = (int)SHIFT_LIMIT + 1;  // rows that a displaced look-up can reach beyond its own
constexpr int NORMAL = 0, ALBEDO = 3, METALLIC = 6, ROUGHNESS = 7;  // first channels; Shaded defines those that may follow

struct Shade {
  int64_t width, height, channels, chunk_rows;
  float view[12];  // world to camera, 3x4, row-major
  float turn[9];   // world to the light's frame, a rotation, row-major
  float fx, fy, cx, cy;
  const float* background;        // (3)
  const float* exposure;          // (3): factors of radiance before it is encoded
  int64_t harmonics;              // whether there are channels of directional colour
  int64_t splats, display;        // whether pixels are surfels; whether colours are blended without sRGB encoding
  int64_t mirror;                 // whether reflections are sharp mirror reflections weighted by metallic, as in 3DGS-DR
  int64_t matte;                  // whether nothing is reflected: channels of metallic and roughness are absent then
  const float *features, *alpha;  // (height, width, channels), (height, width): blended sums over a pixel's splats
  const float* visibility;        // (height, width): 0 where the object occludes the mirror direction, else 1; or null
  Levels levels;
  int64_t texels, cells, lines;
  const float* light;             // (texels, 3)
  const int32_t* texel;           // (cells): index of the texel of each cell of the padded faces
  float* padded;                  // (cells, 4): written by refgs_shade_pad; levels.cells points here
  const int32_t *starts, *cell;   // cells of texel i: cell[starts[i]] up to, not including, cell[starts[i + 1]]
  const float* reflectance;       // (reflectance_side, reflectance_side, 4)
  int64_t reflectance_side;
  float* mirrored;                                        // (height, width, 3)
  float *color, *normal, *material, *radiance;            // (height, width, 3 | 3 | 5 | 3)
  const float *by_color, *by_normal, *by_material;
  float *by_features, *by_alpha;
  float *by_light, *by_exposure;    // (texels, 3), (chunks, or blocks on CUDA; 3): partial sums
  float* near;                      // (chunks, chunk_rows + 2 HALO, width, 4): a chunk's derivatives by displaced normals and their alpha
  float* by_cells;                  // (chunks + 1, cells, 4): each chunk's derivatives by cells, then their sum
  uint8_t* touched;                 // (chunks, chunk_rows + 2 HALO + lines): rows of `near` and lines of `by_cells` that a chunk wrote
  // On CUDA instead of those three, zeroed by the caller:
  int64_t *map_sums, *cell_sums;    // (4, height, width), (cells, 3): fixed-point sums
  int32_t* largest;                 // (2): largest magnitude of the numbers added to each, as a float's bits
  mutable Shared shared;
};

int64_t chunks(const Shade& s) { return (s.height + s.chunk_rows - 1) / s.chunk_rows; }

// LANES covered pixels; with fewer (`count`), the last one is repeated.
struct Pixels {
  int count;
  int32_t at[LANES];
  alignas(64) float column[LANES], row[LANES], alpha[LANES];

  MEMBER void set(int k, int64_t i, int64_t x, int64_t y, float a) { at[k] = (int32_t)i, column[k] = (float)x, row[k] = (float)y, alpha[k] = a; }
};

// Call body(pixels) for all covered pixels from i up to `end`.
template <class Body>
INLINE void each_covered(const Shade& s, int64_t i, int64_t end, Body body) {
  Pixels p;
  int64_t y = (int32_t)i / (int32_t)s.width, x = i - y * s.width;
  if constexpr (LANES == 1) {  // on CUDA a thread has one pixel
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

// Load N channels of each pixel; zero for repeated pixels.
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

// The four pixels around each of LANES points: the index of the first and its row, and the steps to the next column and to the next row.
struct Corners {
  int32_t first[LANES], row[LANES];
  int64_t next, below;
  Vector x, y;  // bilinear weights of the next column and row

  MEMBER int64_t at(int k, int j) const { return first[k] + (j & 1 ? next : 0) + (j & 2 ? below : 0); }
  MEMBER void weights(Vector (&w)[4]) const { w[0] = (1.0f - x) * (1.0f - y), w[1] = x * (1.0f - y), w[2] = (1.0f - x) * y, w[3] = x * y; }
};

}  // namespace
