// Rasteriser: the part that the CPU and CUDA share. It divides the image into tiles, and localises splats to a tile. Splats are projected
// (project.h), sorted by depth and binned to tiles; then each tile blends its splats. Derivatives go back the same way. The CPU's part is
// in project.cpp and blend.cpp, CUDA's in raster.cu.
#pragma once

#include "vector.h"

#include "splat.h"

INLINE int32_t larger(int32_t a, int32_t b) { return a > b ? a : b; }
INLINE int32_t lesser(int32_t a, int32_t b) { return a < b ? a : b; }
INLINE float larger(float a, float b) { return a > b ? a : b; }  // both return b if either is NaN
INLINE float lesser(float a, float b) { return a < b ? a : b; }

// Sizes in pixels. The pixels of a block are computed at once: they fill a vector, or a warp.
#ifdef __CUDACC__
constexpr int TILE_X = 16, TILE_Y = 16, BLOCK_X = 8, BLOCK_Y = 4;
typedef uint32_t Bits;  // one bit a block
#else
constexpr int TILE_X = LANES == 4 ? 16 : 32, TILE_Y = 16, BLOCK_X = LANES == 4 ? 2 : 4, BLOCK_Y = LANES / BLOCK_X;
typedef uint64_t Bits;
#endif
constexpr int PIXELS = TILE_X * TILE_Y;
constexpr int BLOCKS_X = TILE_X / BLOCK_X, BLOCKS_Y = TILE_Y / BLOCK_Y;
constexpr int BLOCKS = BLOCKS_X * BLOCKS_Y, MOST_BLOCKS = 8 * sizeof(Bits);
static_assert(BLOCKS <= MOST_BLOCKS);
constexpr int GEOMETRY = 16;  // floats of a gradient row before its features; 14 are used

// Bounds of the pixels that a splat can cover: inclusive ranges of x, y, x + y and x - y. It is empty if x1 < x0.
struct alignas(16) Octagon {
  int16_t x0, x1, y0, y1, sum0, sum1, difference0, difference1;
};

struct alignas(64) Projected {
  double value[3], slope_x[3], slope_y[3];  // n0, n1, n2 of Splat, with the origin at the image's corner
  double x, y;
  float determinant, n2_min, n2_max, depth, log2_opacity, rho_max;
  Octagon octagon;
};

static_assert(sizeof(Projected) == 128, "two cache lines");

// Input and output of rendering. Names that begin with `by_` are derivatives of the loss.
struct Scene {
  int64_t splats, channels, width, height;
  const float *positions, *rotations, *scales, *opacities, *features;
  double view[12];  // world to camera, 3x4, row-major
  double fx, fy, cx, cy, near;
  double upper, lower;  // depth counts only what a ray meets while its transmittance falls from `upper` to `lower`
  Projected* projected;  // (splats)
  float *out_features, *out_depth, *out_alpha;
  const float *by_features, *by_depth, *by_alpha;
  float *by_positions, *by_rotations, *by_scales, *by_opacities, *by_splat_features;
};

// Whether the depth is trimmed, so that it does not count all that a ray meets.
INLINE bool trimmed(const Scene& r) { return r.upper < 1 || r.lower > 0; }

INLINE int64_t tiles_x(const Scene& r) { return (r.width + TILE_X - 1) / TILE_X; }
INLINE int64_t tiles_y(const Scene& r) { return (r.height + TILE_Y - 1) / TILE_Y; }

// Find the columns of pixels where the octagon can meet the rows from `top` to `bottom`. Return whether there are any.
INLINE bool columns(const Octagon& p, int32_t top, int32_t bottom, int32_t& x0, int32_t& x1) {
  x0 = larger(larger(p.x0, p.sum0 - bottom), p.difference0 + top);
  x1 = lesser(lesser(p.x1, p.sum1 - top), p.difference1 + bottom);
  return x0 <= x1;
}

// Call body(y, x0, x1) for each row y of tiles that the octagon meets, with its first and last tile.
template <class Body>
INLINE void each_row(const Octagon& p, Body body) {
  if (p.x1 < p.x0) return;
  for (int32_t y = p.y0 / TILE_Y; y <= p.y1 / TILE_Y; y++) {
    int32_t x0, x1;
    if (columns(p, y * TILE_Y, y * TILE_Y + TILE_Y - 1, x0, x1)) body(y, x0 / TILE_X, x1 / TILE_X);
  }
}

// Call body(tile, x, y) for each tile that the octagon meets, row by row.
template <class Body>
INLINE void each_tile(const Scene& r, const Octagon& p, Body body) {
  each_row(p, [&](int32_t y, int32_t x0, int32_t x1) {
    for (int32_t x = x0; x <= x1; x++) body(y * tiles_x(r) + x, x, y);
  });
}

struct Tile {
  int64_t index, x, y, width, height;  // x, y: its first pixel; width, height: its part inside the image
  MEMBER Tile(const Scene& r, int32_t i) : index(i), x(i % (int32_t)tiles_x(r) * TILE_X), y(i / (int32_t)tiles_x(r) * TILE_Y) {
    width = r.width - x < TILE_X ? r.width - x : TILE_X;
    height = r.height - y < TILE_Y ? r.height - y : TILE_Y;
  }
};

INLINE Bits bits(int low, int high) { return (~(Bits)0 >> (MOST_BLOCKS - 1 - (high - low))) << low; }

// Bit mask of the tile's blocks that the splat's octagon meets.
INLINE Bits blocks(const Octagon& p, const Tile& t) {
  int32_t tx = (int32_t)t.x, ty = (int32_t)t.y;
  Bits mask = 0;
  for (int y = larger(p.y0 - ty, 0) / BLOCK_Y; y <= lesser(p.y1 - ty, TILE_Y - 1) / BLOCK_Y; y++) {
    int32_t top = ty + y * BLOCK_Y, x0, x1;
    if (!columns(p, top, top + BLOCK_Y - 1, x0, x1) || x1 < tx || x0 >= tx + TILE_X) continue;
    mask |= bits(larger(x0 - tx, 0) / BLOCK_X, lesser(x1 - tx, TILE_X - 1) / BLOCK_X) << (y * BLOCKS_X);
  }
  return mask;
}

// Four doubles, of which three are used.
#ifdef __CUDACC__
struct Quad {
  double value[4];
  friend Quad operator+(Quad a, Quad b) { return {a.value[0] + b.value[0], a.value[1] + b.value[1], a.value[2] + b.value[2]}; }
  friend Quad operator-(Quad a, Quad b) { return {a.value[0] - b.value[0], a.value[1] - b.value[1], a.value[2] - b.value[2]}; }
  friend Quad operator*(double s, Quad a) { return {s * a.value[0], s * a.value[1], s * a.value[2]}; }
};
INLINE Quad load_quad(const double* p) { return {p[0], p[1], p[2]}; }
INLINE Four narrow(Quad q) { return {(float)q.value[0], (float)q.value[1], (float)q.value[2]}; }
INLINE Quad widen(Four f) { return {f[0], f[1], f[2]}; }
INLINE Four magnitude(Four f) { return {fabsf(f[0]), fabsf(f[1]), fabsf(f[2])}; }
#else
typedef double Quad __attribute__((vector_size(32)));
INLINE Quad load_quad(const double* p) {  // the fourth lane reads the number that follows in memory
  typedef double Unaligned __attribute__((vector_size(32), aligned(8)));
  return *(const Unaligned*)p;
}
INLINE Four narrow(Quad q) { return __builtin_convertvector(q, Four); }
INLINE Quad widen(Four f) { return __builtin_convertvector(f, Quad); }
INLINE Four magnitude(Four f) { return f < 0 ? -f : f; }
#endif

INLINE float near_zero(double x) { return lesser(larger((float)x, -1e9f), 1e9f); }

// n0, n1, n2 are split into two floats each if they sum terms larger than this many times n2: in single floats the errors of u and v would
// be 2^-24 times that ratio.
constexpr float SPLIT = 32;

// Move the splat's origin to the middle of the tile, and round it to float.
INLINE refgs::Splat localise(const Projected& p, const Tile& t) {
  double x = t.x + TILE_X / 2, y = t.y + TILE_Y / 2;
  refgs::Splat s;
  Quad slope_x = load_quad(p.slope_x), slope_y = load_quad(p.slope_y), value = load_quad(p.value) + x * slope_x + y * slope_y;
  Four v = narrow(value), along_x = narrow(slope_x), along_y = narrow(slope_y);
  Four spread = (TILE_X / 2.0f) * magnitude(along_x) + (TILE_Y / 2.0f) * magnitude(along_y), most = magnitude(v) + spread;
  float n2_low = v[2] - spread[2], n2_high = v[2] + spread[2];
  s.plain = larger(larger(most[0], most[1]), most[2]) <= SPLIT * n2_low && n2_low >= p.n2_min && n2_high <= p.n2_max;
  if (!s.plain) {
    // Adding and subtracting 1.5 * 2^52 q rounds to a multiple of q, here 2^-22 of the largest sum. At half-integer pixels sums are
    // multiples of q / 2, which fit in a float.
    Quad round = (1.5 * (1ll << 30)) * widen(most + spread);
    auto part = [&](Quad exact, Four& high, float* low) {
      high = narrow(exact + round - round);
      *(Four*)low = narrow(exact - widen(high));
    };
    part(value, v, s.low.value);
    part(slope_x, along_x, s.low.slope_x);
    part(slope_y, along_y, s.low.slope_y);
  }
  *(Four*)s.high.value = v, *(Four*)s.high.slope_x = along_x, *(Four*)s.high.slope_y = along_y;
  s.determinant = p.determinant, s.n2_min = p.n2_min, s.n2_max = p.n2_max;
  s.x = near_zero(p.x - x), s.y = near_zero(p.y - y), s.depth = p.depth;
  s.log2_opacity = p.log2_opacity, s.rho_max = p.rho_max;
  return s;
}

#ifndef __CUDACC__
// Work of the CPU's rasteriser, one object that the caller allocates. Functions marked `parallel` may be entered by several threads at
// once. They share the work through `shared`, which the caller sets to zero. No result depends on which thread does what.
struct Raster : Scene {
  Octagon* octagons;          // (splats) copies of those in `projected`, contiguous for binning
  uint32_t* keys;             // (4, splats) scratch of the sort; refgs_project writes the depths to the third row
  int32_t* order;             // (visible) splats, front to back
  int64_t visible, pairs;     // pairs: number of (splat, tile) that meet
  int64_t* splat_start;       // (splats + 1) into `places`
  int64_t* tile_start;        // (tiles + 1) into `members`
  int32_t* members;           // (pairs) splats of each tile, front to back
  int32_t* places;            // (pairs) for each splat's tiles, row by row: the splat's index among the tile's members
  int32_t* reach;             // (tiles) number of members after which every pixel is finished
  int64_t* row_start;         // (tiles + 1) into `rows`
  int64_t row_count;
  float* rows;                // (row_count, GEOMETRY + padded channels) derivatives of a pair that its tile reaches
  float* scratch;             // (threads, refgs_scratch_size)
  Shared shared;
};

constexpr int AHEAD = 12;     // number of splats that are prefetched

INLINE int64_t padded(int64_t channels) { return (channels + LANES - 1) / LANES * LANES; }
#endif
