// What shading works on: the picture, those of its pixels that are covered, LANES at a time, and the corners about points of it.
#pragma once

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

}  // namespace
