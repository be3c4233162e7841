// The rasteriser on CUDA cards. Splats are projected, one thread each, and sorted by depth. All (splat, tile) pairs are listed in that
// order, and the list is sorted by tile. Torch does both sorts (render/raster_cuda.py). A thread block blends the pixels of a tile, and
// sums the derivatives of its pairs. Then each splat adds up its pairs. Every sum has a fixed order, so results are deterministic.
#include "project.h"

using refgs::Splat;

namespace {

constexpr int WARP = 32, WARPS = 4, THREADS = WARPS * WARP;
constexpr int HALVES = PIXELS / THREADS;  // pixels of a thread: at the same place in two blocks, one above the other
static_assert(BLOCK_X * BLOCK_Y == WARP && BLOCKS_X == 2 && BLOCKS_Y == 4 && HALVES == 2, "a warp has a quarter of the tile");

struct Pair {
  int32_t tile, splat;
};

struct Raster : Scene {
  int32_t *depths, *counts;     // (splats) sort keys, the depths' bits; number of tiles that each meets
  const int64_t *order, *ends;  // (splats) splats front to back; number of pairs up to and including each of `order`
  int32_t* starts;              // (splats) index of a splat's first pair
  int64_t pair_count;
  Pair* pairs;                  // (pair_count) splat by splat, front to back
  const int64_t* sorted;        // (pair_count) indices into `pairs`: tile by tile, each front to back
  int32_t* tile_start;          // (tiles + 1) into `members` and `places`
  int32_t *members, *places;    // (pair_count) in the order of `sorted`: the splat of a pair, and the pair's index in `pairs`
  int32_t *reach, *last;        // (tiles) number of members up to the last that any pixel sees; its index in `pairs`, or -1
  int64_t size;                 // number of channels that the kernels are compiled for; `channels` of them are used
  float* rows;                  // (pair_count, GEOMETRY + size) derivatives of a pair, written if its tile reaches it
};

INLINE int lane() { return threadIdx.x % WARP; }

// Sum V numbers a lane over groups of WIDTH neighbouring lanes. Lane l returns the sum of number l V / WIDTH; v is overwritten. In each
// step a lane passes half of its numbers to a lane that keeps that half. This takes about V exchanges; summing the numbers one by one would
// take V log WIDTH.
template <int WIDTH, int V>
INLINE float sums(float* v) {
  constexpr int APART = WIDTH / 2, REST = V / 2;
  bool upper = lane() & APART;
#pragma unroll
  for (int i = 0; i < REST; i++) {
    float kept = upper ? v[i + REST] : v[i], sent = upper ? v[i] : v[i + REST];
    v[i] = kept + __shfl_xor_sync(~0u, sent, APART);
  }
  if constexpr (V == 1) v[0] += __shfl_xor_sync(~0u, v[0], APART);
  if constexpr (WIDTH > 2) return sums<APART, V == 1 ? 1 : REST>(v);
  return v[0];
}

// to[i] = sum over the warp of v[i], for M numbers.
template <int M>
INLINE void add_up(float* to, const float* v) {
  constexpr int V = M >= 16 ? 16 : M >= 8 ? 8 : 4;
  float part[V];
#pragma unroll
  for (int i = 0; i < V; i++) part[i] = v[i];
  float sum = sums<WARP, V>(part);
  if (lane() % (WARP / V) == 0) to[lane() / (WARP / V)] = sum;
  if constexpr (M > V) add_up<M - V>(to + V, v + V);
}

// A splat in shared memory, as vectors of four. The fourth lanes of Affine's vectors hold other fields.
struct alignas(16) Stored {
  float value[4], slope_x[4], slope_y[4];              // fourth lanes: x, y, depth
  float rest[4];                                       // determinant, log2_opacity, rho_max, plain
  float low_value[4], low_slope_x[4], low_slope_y[4];  // fourth lanes: n2_min, n2_max, unused
};

INLINE float total(Four f) { return (f[0] + f[1]) + (f[2] + f[3]); }

INLINE void copy(float* to, const float* from) { *(Four*)to = *(const Four*)from; }

INLINE void keep(Stored& to, Splat s) {
  copy(to.low_value, s.low.value), copy(to.low_slope_x, s.low.slope_x), copy(to.low_slope_y, s.low.slope_y);
  to.low_value[3] = s.n2_min, to.low_slope_x[3] = s.n2_max;
  copy(to.value, s.high.value), copy(to.slope_x, s.high.slope_x), copy(to.slope_y, s.high.slope_y);
  to.value[3] = s.x, to.slope_x[3] = s.y, to.slope_y[3] = s.depth;
  to.rest[0] = s.determinant, to.rest[1] = s.log2_opacity, to.rest[2] = s.rho_max, to.rest[3] = s.plain;
}

// Load a splat without the fields that a plain one does not need.
INLINE Splat plain(const Stored& from) {
  Splat s;
  alignas(16) float rest[4];
  copy(s.high.value, from.value), copy(s.high.slope_x, from.slope_x), copy(s.high.slope_y, from.slope_y), copy(rest, from.rest);
  s.x = s.high.value[3], s.y = s.high.slope_x[3], s.depth = s.high.slope_y[3];
  s.determinant = rest[0], s.log2_opacity = rest[1], s.rho_max = rest[2], s.plain = rest[3] != 0;
  return s;
}

INLINE refgs::Hit<Vector> intersect(const Stored& from, Splat s, Vector x, Vector y) {
  if (s.plain) return refgs::intersect<true>(s, x, y);
  copy(s.low.value, from.low_value), copy(s.low.slope_x, from.low_slope_x), copy(s.low.slope_y, from.low_slope_y);
  s.n2_min = s.low.value[3], s.n2_max = s.low.slope_x[3];
  return refgs::intersect<false>(s, x, y);
}

// Members of a tile that its threads process together, localised to the tile.
template <int SIZE, int N>
struct Chunk {
  Stored splats[SIZE];
  alignas(16) float features[SIZE][N];
  Bits met[SIZE];  // the blocks that each splat meets
};

// Load the first n <= SIZE of `members`. The first SIZE threads localise the splats, the others fetch the features.
template <int SIZE, int N>
INLINE void fetch(Chunk<SIZE, N>& chunk, const Raster& r, const Tile& t, const int32_t* members, int n) {
  int i = threadIdx.x;
  if (i < SIZE) {
    if (i >= n) return;
    const Projected& p = r.projected[members[i]];
    keep(chunk.splats[i], localise(p, t));
    chunk.met[i] = blocks(p.octagon, t);
  } else {
#pragma unroll 4
    for (int k = i - SIZE; k < n * N; k += THREADS - SIZE) {
      int c = k % N;
      chunk.features[k / N][c] = c < r.channels ? r.features[members[k / N] * r.channels + c] : 0;
    }
  }
}

// Pixels of a thread.
struct Place {
  int first;  // index of the warp's first block; its next is the one below
  int x, y;   // first pixel within the tile; the next is BLOCK_Y below
  Place() {
    int warp = threadIdx.x / WARP;
    first = warp / BLOCKS_X * HALVES * BLOCKS_X + warp % BLOCKS_X;
    x = warp % BLOCKS_X * BLOCK_X + lane() % BLOCK_X, y = warp / BLOCKS_X * HALVES * BLOCK_Y + lane() / BLOCK_X;
  }
  bool inside(const Tile& t, int half) const { return x < t.width && y + half * BLOCK_Y < t.height; }
  int64_t pixel(const Raster& r, const Tile& t, int half) const { return (t.y + y + half * BLOCK_Y) * r.width + t.x + x; }
  Vector centre_x() const { return x + 0.5f - TILE_X / 2; }
  Vector centre_y(int half) const { return y + half * BLOCK_Y + 0.5f - TILE_Y / 2; }
};

// Call body(k, in) in order for the members k of a chunk that meet the warp's live blocks. `in` tells which of these blocks k meets.
template <class Body>
INLINE void each_met(const Bits* met, int n, const Place& place, const bool (&live)[HALVES], Body body) {
  for (int base = 0; base < n; base += WARP) {
    uint32_t mine = base + lane() < n ? met[base + lane()] >> place.first : 0, lists[HALVES];
    for (int h = 0; h < HALVES; h++) lists[h] = __ballot_sync(~0u, live[h] && mine >> (h * BLOCKS_X) & 1);
    while (uint32_t left = lists[0] | lists[1]) {
      uint32_t bit = left & -left;
      bool in[HALVES] = {(lists[0] & bit) != 0, (lists[1] & bit) != 0};
      body(base + __ffs(bit) - 1, in);
      for (int h = 0; h < HALVES; h++) lists[h] = live[h] ? lists[h] & ~bit : 0;
    }
  }
}

// Set the transmittance to zero once the pixel is finished.
INLINE Vector unfinished(Vector T) { return select(T >= refgs::MIN_TRANSMITTANCE, T, Vector()); }

INLINE bool anywhere(Mask mask) { return __any_sync(~0u, any(mask)); }

template <int N, bool TRIMMED = false>
INLINE void forward(const Raster& r) {
  constexpr int SIZE = 64;
  __shared__ Chunk<SIZE, N> chunk;
  __shared__ int32_t reached;
  Tile t(r, (int32_t)blockIdx.x);
  Place place;
  Vector x = place.centre_x(), T[HALVES], Z[HALVES], A[HALVES];
  Four blended[HALVES][N / 4];
  bool live[HALVES];
  for (int h = 0; h < HALVES; h++) T[h] = place.inside(t, h) ? 1 : 0, live[h] = true;
  if (threadIdx.x == 0) reached = 0;
  int32_t first = r.tile_start[t.index], count = r.tile_start[t.index + 1] - first, mine = 0;
  for (int32_t start = 0; start < count; start += SIZE) {
    if (!__syncthreads_or(live[0] || live[1])) break;
    int n = lesser(count - start, SIZE);
    fetch(chunk, r, t, r.members + first + start, n);
    __syncthreads();
    each_met(chunk.met, n, place, live, [&](int k, const bool (&in)[HALVES]) {
      Splat s = plain(chunk.splats[k]);
#pragma unroll
      for (int h = 0; h < HALVES; h++) {
        if (!in[h]) continue;
        auto hit = intersect(chunk.splats[k], s, x, place.centre_y(h));
        Mask covered = hit.covered & (T[h] > 0);
        if (!anywhere(covered)) {
          live[h] = anywhere(T[h] > 0);
          continue;
        }
        Vector a = select(covered, refgs::cap(refgs::uncapped_alpha(s, hit)), Vector()), w = a * T[h];
        Vector after = unfinished(T[h] * (1 - a));
        Z[h] += (TRIMMED ? clamp(T[h], r.lower, r.upper) - clamp(after, r.lower, r.upper) : w) * hit.z, A[h] += w;
        T[h] = after;
#pragma unroll
        for (int c = 0; c < N / 4; c++) blended[h][c] += w.value * *(const Four*)&chunk.features[k][4 * c];
        mine = start + k + 1;
      }
    });
  }
  if (lane() == 0) atomicMax(&reached, mine);
  __syncthreads();
  if (threadIdx.x == 0) r.reach[t.index] = reached, r.last[t.index] = reached ? r.places[first + reached - 1] : -1;
#pragma unroll
  for (int h = 0; h < HALVES; h++) {
    if (!place.inside(t, h)) continue;
    int64_t p = place.pixel(r, t, h);
    r.out_depth[p] = Z[h].value, r.out_alpha[p] = A[h].value;
    float* out = r.out_features + p * r.channels;
#pragma unroll
    for (int c = 0; c < N; c += 4)
      if (r.channels == N)
        *(Four*)(out + c) = blended[h][c / 4];
      else
#pragma unroll
        for (int i = 0; i < 4; i++)
          if (c + i < r.channels) out[c + i] = blended[h][c / 4][i];
  }
}

template <int QUADS>
INLINE void read_channels(const Raster& r, const float* from, Four (&v)[QUADS]) {
  bool whole = r.channels == 4 * QUADS && (int64_t)from % sizeof(Four) == 0;
#pragma unroll
  for (int c = 0; c < QUADS; c++)
    if (whole)
      v[c] = *(const Four*)(from + 4 * c);
    else
#pragma unroll
      for (int i = 0; i < 4; i++) v[c][i] = 4 * c + i < r.channels ? from[4 * c + i] : 0;
}

// Differentiate front to back. The derivative by alpha needs what the splats behind contribute to the loss. That is the pixel's total minus
// what has been passed, so one scalar a pixel (`rest`) suffices.
template <int N>
INLINE void backward(const Raster& r) {
  constexpr int SIZE = 32, ROW = GEOMETRY + N;
  __shared__ Chunk<SIZE, N> chunk;
  __shared__ float parts[WARPS][SIZE][ROW];  // each warp's part of the rows
  __shared__ uint32_t given[WARPS];          // bit mask of the splats that a warp has a part for
  Tile t(r, (int32_t)blockIdx.x);
  Place place;
  Vector x = place.centre_x(), T[HALVES], rest[HALVES], by_z[HALVES], by_alpha[HALVES];
  Four by[HALVES][N / 4];
  bool live[HALVES];
#pragma unroll
  for (int h = 0; h < HALVES; h++) {
    T[h] = place.inside(t, h) ? 1 : 0, live[h] = true;
    if (!place.inside(t, h)) continue;
    int64_t p = place.pixel(r, t, h);
    by_z[h] = r.by_depth[p], by_alpha[h] = r.by_alpha[p];
    rest[h] = by_z[h] * r.out_depth[p] + by_alpha[h] * r.out_alpha[p];
    Four out[N / 4], products;
    read_channels(r, r.by_features + p * r.channels, by[h]), read_channels(r, r.out_features + p * r.channels, out);
#pragma unroll
    for (int c = 0; c < N / 4; c++) products += by[h][c] * out[c];
    rest[h] += total(products);
  }
  int32_t first = r.tile_start[t.index], count = r.reach[t.index];
  for (int32_t start = 0; start < count; start += SIZE) {
    int n = lesser(count - start, SIZE);
    fetch(chunk, r, t, r.members + first + start, n);
    __syncthreads();
    uint32_t gave = 0;
    each_met(chunk.met, n, place, live, [&](int k, const bool (&in)[HALVES]) {
      Splat s = plain(chunk.splats[k]);
      alignas(16) float g[GEOMETRY] = {}, w[HALVES] = {};
      bool gives = false;
#pragma unroll
      for (int h = 0; h < HALVES; h++) {
        if (!in[h]) continue;
        Vector y = place.centre_y(h);
        auto hit = intersect(chunk.splats[k], s, x, y);
        Mask covered = hit.covered & (T[h] > 0);
        if (!anywhere(covered)) {
          live[h] = anywhere(T[h] > 0);
          continue;
        }
        gives = true;
        Vector uncapped = select(covered, refgs::uncapped_alpha(s, hit), Vector()), a = refgs::cap(uncapped), weight = a * T[h];
        Four products;
#pragma unroll
        for (int c = 0; c < N / 4; c++) products += *(const Four*)&chunk.features[k][4 * c] * by[h][c];
        Vector here = by_alpha[h] + by_z[h] * hit.z + total(products);
        rest[h] -= weight * here;
        Vector by_a = select(covered, T[h] * here - rest[h] * reciprocal(1 - a), Vector());
        T[h] = unfinished(T[h] * (1 - a));
        auto d = refgs::differentiate(hit, uncapped, by_a, weight * by_z[h]);
        Vector by_x, by_y, by_depth;
        refgs::differentiate_screen(hit, d, by_x, by_y, by_depth);
        const Vector n[] = {d.n0, d.n1, d.n2}, others[] = {d.determinant, by_x, by_y, by_depth, d.log_opacity};
#pragma unroll
        for (int i = 0; i < 3; i++) g[3 * i] += n[i].value, g[3 * i + 2] += (n[i] * y).value;
#pragma unroll
        for (int i = 0; i < 5; i++) g[9 + i] += others[i].value;
        w[h] = weight.value;
      }
      if (!gives) return;
      gave |= 1u << k;
#pragma unroll
      for (int i = 0; i < 3; i++) g[3 * i + 1] = g[3 * i] * x.value;
      float* part = parts[threadIdx.x / WARP][k];
      add_up<GEOMETRY>(part, g);
      float v[N];
#pragma unroll
      for (int c = 0; c < N; c++) v[c] = w[0] * by[0][c / 4][c % 4] + w[1] * by[1][c / 4][c % 4];
      add_up<N>(part + GEOMETRY, v);
    });
    if (lane() == 0) given[threadIdx.x / WARP] = gave;
    __syncthreads();
    for (int i = threadIdx.x; i < n * ROW; i += THREADS) {
      int k = i / ROW;
      float sum = 0;
      for (int warp = 0; warp < WARPS; warp++)
        if (given[warp] >> k & 1) sum += parts[warp][k][i % ROW];
      r.rows[(int64_t)r.places[first + start + k] * ROW + i % ROW] = sum;
    }
  }
}

constexpr int SUMMED = 14;  // used numbers of a row's geometry

// Add up every `step`-th row of a splat from `k` on, skipping rows that their tiles do not reach. Return whether there was any.
INLINE bool add_rows(const Raster& r, int32_t k, int32_t end, int step, double (&sum)[SUMMED]) {
  bool touched = false;
  for (; k < end; k += step) {
    int32_t tile = r.pairs[k].tile;
    if (k > r.last[tile]) continue;
    touched = true;
    alignas(16) float g[GEOMETRY];
#pragma unroll
    for (int i = 0; i < GEOMETRY; i += 4) copy(g + i, r.rows + k * (GEOMETRY + r.size) + i);
#pragma unroll
    for (int i = 0; i < SUMMED; i++) sum[i] += g[i];
    Tile t(r, tile);
    double x = t.x + TILE_X / 2, y = t.y + TILE_Y / 2;
#pragma unroll
    for (int i = 0; i < 9; i += 3) sum[i + 1] += x * g[i], sum[i + 2] += y * g[i];
  }
  return touched;
}

}  // namespace

KERNEL(refgs_raster_project, Raster, r) {
  share({}, r->splats, 1, [&](int64_t first) {
    project(*r, first, [&](int64_t i, const Octagon& octagon, float depth) {
      int32_t tiles = 0;
      each_row(octagon, [&](int32_t, int32_t x0, int32_t x1) { tiles += x1 - x0 + 1; });
      r->counts[i] = tiles;
      r->depths[i] = tiles ? __float_as_int(depth) : 0x7fffffff;  // the bits of positive floats sort like the floats
    });
  });
}

KERNEL(refgs_raster_list, Raster, r) {
  share({}, r->splats, 1, [&](int64_t k) {
    int64_t i = r->order[k];
    int32_t count = r->counts[i], at = (int32_t)(r->ends[k] - count);
    r->starts[i] = at;
    if (count) each_tile(*r, r->projected[i].octagon, [&](int64_t tile, int, int) { r->pairs[at++] = {(int32_t)tile, (int32_t)i}; });
  });
}

KERNEL(refgs_raster_bin, Raster, r) {
  int64_t n = r->pair_count;
  share({}, n + 1, 1, [&](int64_t at) {
    int32_t before = at ? r->pairs[r->sorted[at - 1]].tile : -1, here = (int32_t)(tiles_x(*r) * tiles_y(*r));
    if (at < n) {
      int32_t place = (int32_t)r->sorted[at];
      r->members[at] = r->pairs[place].splat, r->places[at] = place, here = r->pairs[place].tile;
    }
    for (int32_t tile = before + 1; tile <= here; tile++) r->tile_start[tile] = (int32_t)at;  // those before `here` are empty, and few
  });
}

KERNEL(refgs_raster_forward_4, Raster, r, __launch_bounds__(THREADS, 5)) { forward<4>(*r); }
KERNEL(refgs_raster_forward_8, Raster, r, __launch_bounds__(THREADS, 5)) { forward<8>(*r); }
KERNEL(refgs_raster_forward_12, Raster, r, __launch_bounds__(THREADS, 5)) { forward<12>(*r); }
KERNEL(refgs_raster_forward_16, Raster, r, __launch_bounds__(THREADS, 5)) { forward<16>(*r); }
KERNEL(refgs_raster_forward_20, Raster, r, __launch_bounds__(THREADS, 5)) { forward<20>(*r); }
KERNEL(refgs_raster_forward_trimmed, Raster, r, __launch_bounds__(THREADS, 5)) { forward<4, true>(*r); }

KERNEL(refgs_raster_backward_4, Raster, r, __launch_bounds__(THREADS, 4)) { backward<4>(*r); }
KERNEL(refgs_raster_backward_8, Raster, r, __launch_bounds__(THREADS, 4)) { backward<8>(*r); }
KERNEL(refgs_raster_backward_12, Raster, r, __launch_bounds__(THREADS, 4)) { backward<12>(*r); }
KERNEL(refgs_raster_backward_16, Raster, r, __launch_bounds__(THREADS, 4)) { backward<16>(*r); }
KERNEL(refgs_raster_backward_20, Raster, r, __launch_bounds__(THREADS, 4)) { backward<20>(*r); }

// One thread a splat. If a splat has many rows, all threads of its warp read them.
KERNEL(refgs_raster_gather, Raster, r) {
  constexpr int32_t MANY = 64;
  int64_t i = (int64_t)blockIdx.x * blockDim.x + threadIdx.x;
  bool exists = i < r->splats;
  int32_t begin = exists ? r->starts[i] : 0, end = exists ? begin + r->counts[i] : 0;
  double sum[SUMMED] = {};
  bool many = end - begin > MANY, touched = !many && add_rows(*r, begin, end, 1, sum);
  for (uint32_t left = __ballot_sync(~0u, many); left; left &= left - 1) {
    int whose = __ffs(left) - 1;
    double part[SUMMED] = {};
    bool some = add_rows(*r, __shfl_sync(~0u, begin, whose) + lane(), __shfl_sync(~0u, end, whose), WARP, part);
    some = __any_sync(~0u, some);
    if (lane() == whose) touched = some;
#pragma unroll
    for (int j = 0; j < SUMMED; j++) {
      for (int apart = WARP / 2; apart; apart /= 2) part[j] += __shfl_xor_sync(~0u, part[j], apart);
      if (lane() == whose) sum[j] = part[j];
    }
  }
  if (!exists) return;
  Sums sums;
#pragma unroll
  for (int j = 0; j < 9; j++) sums.n[j / 3][j % 3] = sum[j];
  sums.determinant = sum[9], sums.x = sum[10], sums.y = sum[11], sums.depth = sum[12], sums.log_opacity = sum[13];
  sums.touched = touched ? -1 : 0;
  carry(*r, i, sums);
}

// Sum the rows of each splat's features: eight threads for four features.
KERNEL(refgs_raster_gather_features, Raster, r) {
  constexpr int PHASES = 8;
  uint32_t thread = blockIdx.x * blockDim.x + threadIdx.x, quads = (uint32_t)(r->channels + 3) / 4;
  int phase = thread % PHASES, quad = thread / PHASES % quads;
  int64_t i = thread / PHASES / quads;
  Four sum;
  if (i < r->splats) {
    int32_t end = r->starts[i] + r->counts[i];
#pragma unroll 4
    for (int32_t k = r->starts[i] + phase; k < end; k += PHASES)
      if (k <= r->last[r->pairs[k].tile]) sum += *(const Four*)(r->rows + k * (GEOMETRY + r->size) + GEOMETRY + 4 * quad);
  }
  float total = sums<PHASES, 4>(sum.value);
  int channel = 4 * quad + phase / 2;
  if (i < r->splats && phase % 2 == 0 && channel < r->channels) r->by_splat_features[i * r->channels + channel] = total;
}
