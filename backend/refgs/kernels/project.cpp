// The CPU's projection: project the splats, sort them by depth, bin them to tiles; and carry derivatives from the tiles to the splats'
// parameters.
#include "project.h"

namespace {

void prefetch(const Raster& r, int64_t i) {
  int64_t stride = GEOMETRY + padded(r.channels);
  const int32_t* place = r.places + r.splat_start[i];
  each_tile(r, r.octagons[i], [&](int64_t tile, int, int) {
    const float* row = r.rows + (r.row_start[tile] + *place++) * stride;
    for (int64_t c = 0; c < stride; c += 16) __builtin_prefetch(row + c);
  });
}

// Geometry of a gradient row: derivatives by the value, x slope and y slope of n0, n1 and n2 relative to the middle of the tile; then by
// the determinant, the centre's x, y and depth, and the logarithm of the opacity.
typedef double Row __attribute__((vector_size(8 * GEOMETRY)));
typedef float FloatRow __attribute__((vector_size(4 * GEOMETRY), aligned(4)));

// Add up a splat's rows: features in place; geometry plain (`sum`) and times the x and y of each tile's middle, to change the origin to the
// image's corner. Return whether there were any.
INLINE bool add_rows(const Raster& r, int64_t i, Row& sum, Row& sum_x, Row& sum_y) {
  int64_t channels = r.channels, stride = GEOMETRY + padded(channels);
  float* __restrict by_features = r.by_splat_features + i * channels;
  for (int64_t c = 0; c < channels; c++) by_features[c] = 0;
  bool touched = false;
  sum = sum_x = sum_y = Row();
  const int32_t* place = r.places + r.splat_start[i];
  each_tile(r, r.octagons[i], [&](int64_t tile, int tx, int ty) {
    int32_t at = *place++;
    if (at >= r.row_start[tile + 1] - r.row_start[tile]) return;
    const float* __restrict row = r.rows + (r.row_start[tile] + at) * stride;
    touched = true;
    Row g = __builtin_convertvector(*(const FloatRow*)row, Row);
    sum += g, sum_x += (tx * TILE_X + TILE_X / 2) * g, sum_y += (ty * TILE_Y + TILE_Y / 2) * g;
    for (int64_t c = 0; c < channels; c++) by_features[c] += row[GEOMETRY + c];
  });
  return touched;
}

// Carry the derivatives of a batch of splats from their rows to their parameters.
void gather(const Raster& r, int64_t first) {
  Sums sums;
  for (int lane = 0; lane < BATCH; lane++) {
    Row sum = {}, sum_x = {}, sum_y = {};
    sums.touched[lane] = first + lane < r.splats && add_rows(r, first + lane, sum, sum_x, sum_y) ? -1 : 0;
    for (int k = 0; k < 3; k++) {
      sums.n[k][0][lane] = sum[3 * k];
      sums.n[k][1][lane] = sum[3 * k + 1] + sum_x[3 * k];
      sums.n[k][2][lane] = sum[3 * k + 2] + sum_y[3 * k];
    }
    sums.determinant[lane] = sum[9], sums.x[lane] = sum[10], sums.y[lane] = sum[11], sums.depth[lane] = sum[12];
    sums.log_opacity[lane] = sum[13];
  }
  carry(r, first, sums);
}

}  // namespace

EXPORT int64_t refgs_tiles(int64_t width, int64_t height) { return ((width + TILE_X - 1) / TILE_X) * ((height + TILE_Y - 1) / TILE_Y); }
EXPORT int64_t refgs_row_size(int64_t channels) { return GEOMETRY + padded(channels); }

// parallel
EXPORT void refgs_project(Raster* r) {
  for (int64_t i; (i = take(r->shared.next, 256)) < r->splats;)
    for (int64_t j = i; j < i + 256 && j < r->splats; j += BATCH)
      project(*r, j, [&](int64_t k, const Octagon& octagon, float depth) {
        r->octagons[k] = octagon;
        __builtin_memcpy(r->keys + 2 * r->splats + k, &depth, 4);  // the bits of positive floats sort like the floats
      });
}

// Sort the visible splats by depth (a radix sort of floats; ties by index), and count the (splat, tile) pairs.
EXPORT void refgs_sort(Raster* r) {
  constexpr int BITS = 11, DIGITS = 3, SIZE = 1 << BITS;  // a positive float has 31 bits
  int64_t n = 0, pairs = 0;
  uint32_t *keys = r->keys, *values = keys + r->splats, *keys2 = values + r->splats, *values2 = keys2 + r->splats;
  uint32_t starts[DIGITS][SIZE + 1] = {};
  int64_t tiles = tiles_x(*r) * tiles_y(*r);
  for (int64_t t = 0; t <= tiles; t++) r->tile_start[t] = 0;
  for (int64_t i = 0; i < r->splats; i++) {
    r->splat_start[i] = pairs;
    int64_t before = pairs;
    each_tile(*r, r->octagons[i], [&](int64_t tile, int, int) { r->tile_start[tile + 1]++, pairs++; });
    if (pairs == before) continue;
    keys[n] = keys2[i], values[n++] = (uint32_t)i;
    for (int d = 0; d < DIGITS; d++) starts[d][(keys2[i] >> d * BITS) % SIZE + 1]++;
  }
  r->splat_start[r->splats] = r->pairs = pairs;
  r->visible = n;
  for (int64_t t = 0; t < tiles; t++) r->tile_start[t + 1] += r->tile_start[t];
  for (int d = 0; d < DIGITS; d++) {
    for (int k = 0; k < SIZE; k++) starts[d][k + 1] += starts[d][k];
    for (int64_t i = 0; i < n; i++) {
      uint32_t to = starts[d][(keys[i] >> d * BITS) % SIZE]++;
      keys2[to] = keys[i], values2[to] = values[i];
    }
    uint32_t* swap = keys;
    keys = keys2, keys2 = swap;
    swap = values, values = values2, values2 = swap;
  }
  for (int64_t i = 0; i < n; i++) r->order[i] = (int32_t)values[i];
}

// Bin the sorted splats into tiles by a counting scatter.
EXPORT void refgs_bin(Raster* r) {
  int32_t* counts = r->reach;  // borrowed: refgs_forward fills it later
  for (int64_t t = 0; t < tiles_x(*r) * tiles_y(*r); t++) counts[t] = 0;
  for (int64_t k = 0; k < r->visible; k++) {
    int32_t i = r->order[k], ahead = r->order[k + AHEAD < r->visible ? k + AHEAD : k];
    __builtin_prefetch(&r->octagons[ahead]);
    __builtin_prefetch(&r->splat_start[ahead]);
    int32_t* place = r->places + r->splat_start[i];
    each_tile(*r, r->octagons[i], [&](int64_t tile, int, int) {
      *place = counts[tile]++;
      r->members[r->tile_start[tile] + *place++] = i;
    });
  }
}

// Find where each tile's gradient rows begin, and how many there are in all. A tile has one for each member up to its reach.
EXPORT void refgs_rows(Raster* r) {
  int64_t tiles = tiles_x(*r) * tiles_y(*r);
  r->row_count = 0;
  for (int64_t t = 0; t < tiles; t++) r->row_start[t] = r->row_count, r->row_count += r->reach[t];
  r->row_start[tiles] = r->row_count;
}

// parallel
EXPORT void refgs_gather(Raster* r) {
  const int64_t SHARE = 128;
  for (int64_t i; (i = take(r->shared.next, SHARE)) < r->splats;) {
    int64_t end = i + SHARE < r->splats ? i + SHARE : r->splats;
    for (int64_t j = i; j < end && j < i + AHEAD; j++) prefetch(*r, j);
    for (int64_t j = i; j < end; j += BATCH) {
      for (int64_t k = j + AHEAD; k < end && k < j + AHEAD + BATCH; k++) prefetch(*r, k);
      gather(*r, j);
    }
  }
}
