// The rasteriser's work: what a caller allocates, and how the picture is divided. Splats are projected, sorted and binned
// (project.cpp), then blended (blend.cpp), and their derivatives go back the same way.
//
// Every function works on one Raster that the caller allocates. The ones marked `parallel` may be entered by several threads at
// once: they share the work through `shared`, which the caller sets to zero. No result depends on who does what.
#pragma once

#include "vector.h"

#include "splat.h"

INLINE int32_t larger(int32_t a, int32_t b) { return a > b ? a : b; }
INLINE int32_t lesser(int32_t a, int32_t b) { return a < b ? a : b; }
INLINE double larger(double a, double b) { return a > b ? a : b; }  // b where one is NaN
INLINE double lesser(double a, double b) { return a < b ? a : b; }

constexpr int TILE_X = LANES == 4 ? 16 : 32, TILE_Y = 16;  // pixels; 64 blocks at most
constexpr int PIXELS = TILE_X * TILE_Y;
constexpr int BLOCK_X = LANES == 4 ? 2 : 4;  // a block is one vector of pixels
constexpr int BLOCK_Y = LANES / BLOCK_X;
constexpr int BLOCKS_X = TILE_X / BLOCK_X, BLOCKS_Y = TILE_Y / BLOCK_Y;
constexpr int BLOCKS = BLOCKS_X * BLOCKS_Y;
constexpr int AHEAD = 12;     // splats that are fetched before they are needed
constexpr int GEOMETRY = 16;  // floats of a gradient row before its features; 14 are used

// Pixels that a splat can cover, all inclusive: bounds of x, y, x + y and x - y; x1 < x0 where there are none.
struct alignas(16) Octagon {
  int16_t x0, x1, y0, y1, sum0, sum1, difference0, difference1;
};

struct alignas(64) Projected {
  double value[3], slope_x[3], slope_y[3];  // of n0, n1, n2 as in Splat, the origin at the image's corner
  double x, y;
  float determinant, n2_min, n2_max, depth, log2_opacity, rho_max;
  Octagon octagon;
};

static_assert(sizeof(Projected) == 128, "two cache lines");

struct Raster {
  int64_t splats, channels, width, height;
  const float *positions, *rotations, *scales, *opacities, *features;
  double view[12];  // world to camera, 3x4, row-major
  double fx, fy, cx, cy, near;
  Projected* projected;       // (splats)
  Octagon* octagons;          // (splats) once more, close together: what binning reads
  uint32_t* keys;             // (4 splats) scratch of the sort; the third quarter begins as the splats' depths
  int32_t* order;             // (visible) splats, front to back
  int64_t visible, pairs;     // pairs: (splat, tile) that meet
  int64_t* splat_start;       // (splats + 1) into `places`
  int64_t* tile_start;        // (tiles + 1) into `members`
  int32_t* members;           // (pairs) splats of each tile, front to back
  int32_t* places;            // (pairs) of each splat's tiles, row by row: where in the tile's members it is
  float *out_features, *out_depth, *out_alpha;
  int32_t* reach;             // (tiles) members after which every pixel is finished
  const float *by_features, *by_depth, *by_alpha;
  int64_t* row_start;         // (tiles + 1) into `rows`
  int64_t row_count;
  float* rows;                // (row_count, GEOMETRY + padded channels) derivatives of a pair
  float *by_positions, *by_rotations, *by_scales, *by_opacities, *by_splat_features;
  float* scratch;             // (threads, refgs_scratch_size)
  Shared shared;
};

INLINE int64_t tiles_x(const Raster& r) { return (r.width + TILE_X - 1) / TILE_X; }
INLINE int64_t tiles_y(const Raster& r) { return (r.height + TILE_Y - 1) / TILE_Y; }

// body(tile) for the tiles that the splat's octagon meets, row by row.
template <class Body>
INLINE void each_tile(const Raster& r, const Octagon& p, Body body) {
  if (p.x1 < p.x0) return;
  for (int32_t y = p.y0 / TILE_Y; y <= p.y1 / TILE_Y; y++)
    for (int32_t x = p.x0 / TILE_X; x <= p.x1 / TILE_X; x++) {
      int32_t sum = x * TILE_X + y * TILE_Y, difference = x * TILE_X - y * TILE_Y;  // of the tile's first pixel
      if (sum <= p.sum1 && sum + TILE_X + TILE_Y - 2 >= p.sum0 && difference - TILE_Y < p.difference1 && difference + TILE_X > p.difference0)
        body(y * tiles_x(r) + x, x, y);
    }
}

INLINE int64_t padded(int64_t channels) { return (channels + LANES - 1) / LANES * LANES; }
