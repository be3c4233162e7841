// The CPU's blending: each tile blends its splats front to back, and sums the derivatives of its (splat, tile) pairs.
#include "raster.h"

using refgs::Splat;

namespace {

constexpr int CHUNK = 64;  // splats of a tile that are processed together

// Pixels of a tile are numbered block by block, and lane by lane within a block.
constexpr int pixel_x(int i) { return i / LANES % BLOCKS_X * BLOCK_X + i % LANES % BLOCK_X; }
constexpr int pixel_y(int i) { return i / LANES / BLOCKS_X * BLOCK_Y + i % LANES / BLOCK_X; }

bool contains(const Tile& t, int i) { return pixel_x(i) < t.width && pixel_y(i) < t.height; }
int64_t pixel(const Raster& r, const Tile& t, int i) { return (t.y + pixel_y(i)) * r.width + t.x + pixel_x(i); }

// Pixel centres relative to the middle of the tile, block by block.
struct Centres {
  alignas(64) float x[PIXELS], y[PIXELS];
  constexpr Centres() : x(), y() {
    for (int i = 0; i < PIXELS; i++) {
      x[i] = pixel_x(i) + 0.5f - TILE_X / 2;
      y[i] = pixel_y(i) + 0.5f - TILE_Y / 2;
    }
  }
};
constexpr Centres CENTRES;

// Set the transmittance to zero once the pixel is finished.
INLINE Vector unfinished(Vector T) { return select(T >= refgs::MIN_TRANSMITTANCE, T, Vector()); }

// Prefetch a tile's k-th splat: a tile's splats are scattered in memory.
INLINE void fetch(const Raster& r, const int32_t* members, int64_t k, int64_t count) {
  if (k >= count) return;
  __builtin_prefetch(&r.projected[members[k]]);
  __builtin_prefetch((const char*)&r.projected[members[k]] + 64);
  __builtin_prefetch(r.features + members[k] * r.channels);
}

// sums[c] += sum over k of weights[k] rows[k][c], for N channels of a block of pixels.
template <int N>
void blend(float* sums, const Vector* weights, const float* const* rows, int count, int64_t channel) {
  Vector s[N];
  for (int c = 0; c < N; c++) s[c] = load(sums + c * LANES);
  for (int k = 0; k < count; k++) {
    const float* row = rows[k] + channel;
    for (int c = 0; c < N; c++) s[c] += weights[k] * row[c];
  }
  for (int c = 0; c < N; c++) store(sums + c * LANES, s[c]);
}

void blend_all(float* sums, const Vector* weights, const float* const* rows, int count, int64_t channels) {
  int64_t c = 0;
  for (; c + 8 <= channels; c += 8) blend<8>(sums + c * LANES, weights, rows, count, c);
  constexpr decltype(&blend<1>) REST[] = {blend<0>, blend<1>, blend<2>, blend<3>, blend<4>, blend<5>, blend<6>, blend<7>};
  REST[channels - c](sums + c * LANES, weights, rows, count, c);
}

// Compute the alphas and depths of two splats at the pixels of a block. The two are interleaved to hide the latency of the arithmetic.
template <bool PLAIN>
INLINE void see(const Splat& s, const Splat& t, Vector x, Vector y, Vector (&alpha)[2], Vector (&z)[2]) {
  refgs::Hit<Vector> hits[] = {refgs::intersect<PLAIN>(s, x, y), refgs::intersect<PLAIN>(t, x, y)};
  Vector uncapped[] = {refgs::uncapped_alpha(s, hits[0]), refgs::uncapped_alpha(t, hits[1])};
  for (int i = 0; i < 2; i++) {
    alpha[i] = select(hits[i].covered, refgs::cap(uncapped[i]), Vector());
    z[i] = hits[i].z;
  }
}

template <bool TRIMMED>
void forward_tile(Raster& r, int64_t index, float* sums) {
  Tile t(r, (int32_t)index);
  alignas(64) float transmittance[PIXELS], depth[PIXELS] = {}, alpha[PIXELS] = {};
  for (int i = 0; i < PIXELS; i++) transmittance[i] = contains(t, i) ? 1 : 0;
  clear(sums, r.channels * PIXELS);

  uint64_t live = 0;
  for (int b = 0; b < BLOCKS; b++) live |= (uint64_t)any(load(transmittance + b * LANES) > 0.0f) << b;
  const int32_t* members = r.members + r.tile_start[index];
  int64_t count = r.tile_start[index + 1] - r.tile_start[index], reach = 0;
  Splat splats[CHUNK + 1];  // the last one covers nothing and pads a list of odd length
  const float* features[CHUNK];
  uint8_t lists[BLOCKS][CHUNK + 1];
  Vector weights[CHUNK];
  const float* rows[CHUNK];
  for (int64_t start = 0; start < count && live; start += CHUNK) {
    int lengths[BLOCKS] = {};
    int n = (int)(count - start < CHUNK ? count - start : CHUNK);
    for (int k = 0; k < n; k++) {
      fetch(r, members, start + k + AHEAD, count);
      const Projected& p = r.projected[members[start + k]];
      splats[k] = localise(p, t);
      features[k] = r.features + members[start + k] * r.channels;
      for (uint64_t m = blocks(p.octagon, t) & live; m; m &= m - 1) {
        int b = __builtin_ctzll(m);
        lists[b][lengths[b]++] = (uint8_t)k;
      }
    }
    splats[n] = splats[0], splats[n].rho_max = -1;
    for (uint64_t m = live; m; m &= m - 1) {
      int b = __builtin_ctzll(m), used = 0;
      Vector x = load(CENTRES.x + b * LANES), y = load(CENTRES.y + b * LANES);
      Vector T = load(transmittance + b * LANES), Z = load(depth + b * LANES), A = load(alpha + b * LANES);
      int64_t last = start + n;
      lists[b][lengths[b]] = (uint8_t)n;
      for (int j = 0; j < lengths[b]; j += 2) {
        int k[] = {lists[b][j], lists[b][j + 1]};
        const Splat &s = splats[k[0]], &next = splats[k[1]];
        Vector a[2], z[2];
        if (s.plain & next.plain)
          see<true>(s, next, x, y, a, z);
        else
          see<false>(s, next, x, y, a, z);
        for (int i = 0; i < 2 && k[i] < n; i++) {
          Vector w = a[i] * T;
          Vector after = unfinished(T * (1.0f - a[i]));
          Z += (TRIMMED ? clamp(T, r.lower, r.upper) - clamp(after, r.lower, r.upper) : w) * z[i];
          T = after;
          A += w;
          weights[used] = w;
          rows[used++] = features[k[i]];
        }
        if (!any(T > 0.0f)) {
          live &= ~(1ull << b);
          last = start + lesser(k[1] + 1, n);
          break;
        }
      }
      if (last > reach) reach = last;
      store(transmittance + b * LANES, T), store(depth + b * LANES, Z), store(alpha + b * LANES, A);
      blend_all(sums + b * LANES * r.channels, weights, rows, used, r.channels);
    }
  }
  r.reach[index] = (int32_t)reach;
  for (int i = 0; i < PIXELS; i++) {
    if (!contains(t, i)) continue;
    r.out_depth[pixel(r, t, i)] = depth[i], r.out_alpha[pixel(r, t, i)] = alpha[i];
  }
  for (int b = 0; b < BLOCKS; b++)
    for (int64_t c = 0; c < r.channels; c += LANES) {
      Vector v[LANES];
      for (int k = 0; k < LANES; k++) v[k] = c + k < r.channels ? load(sums + (b * r.channels + c + k) * LANES) : Vector();
      transpose(v);
      for (int k = 0; k < LANES; k++) {
        int i = b * LANES + k;
        if (contains(t, i)) write(r.out_features + pixel(r, t, i) * r.channels + c, v[k], r.channels - c);
      }
    }
}

// row[c] = sum over blocks k and their pixels of weights[k] * by_features[pixel][c], for N channels; zero from there up to LANES.
// planes[k] holds by_features of block k as (channel, lane).
template <int N>
void gather(float* row, const Vector* weights, const float* const* planes, int count, int64_t channel) {
  Vector s[LANES] = {};
  for (int k = 0; k < count; k++) {
    Vector w = weights[k];
    const float* plane = planes[k] + channel * LANES;
#pragma unroll
    for (int i = 0; i < N; i++) s[i] += w * load(plane + i * LANES);
  }
  store(row + channel, sums(s));
}

void gather_all(float* row, const Vector* weights, const float* const* planes, int count, int64_t channels) {
  constexpr int QUARTER = LANES / 4;
  constexpr decltype(&gather<1>) REST[] = {gather<QUARTER>, gather<2 * QUARTER>, gather<3 * QUARTER>, gather<LANES>};
  int64_t c = 0;
  for (; c + LANES < channels; c += LANES) gather<LANES>(row, weights, planes, count, c);
  if (c < channels) REST[(channels - c - 1) / QUARTER](row, weights, planes, count, c);
}

// Differentiate front to back. The derivative by alpha needs what the splats behind contribute to the loss. That is the pixel's total minus
// what has been passed, so one scalar a pixel (`rest`) suffices.
void backward_tile(Raster& r, int64_t index, float* scratch) {
  Tile t(r, (int32_t)index);
  int64_t channels = r.channels, C = padded(channels);
  float* planes = scratch;  // derivatives by the blended features, (block, channel, lane)
  alignas(64) float transmittance[PIXELS], by_depth[PIXELS] = {}, by_alpha[PIXELS] = {}, rest[PIXELS];
  for (int y = 0; y < t.height; y++) {
    int64_t first = ((t.y + y) * r.width + t.x) * channels;
    for (int64_t c = 0; c < t.width * channels; c += 16) {
      __builtin_prefetch(r.by_features + first + c);
      __builtin_prefetch(r.out_features + first + c);
    }
  }
  for (int b = 0; b < BLOCKS; b++) {
    Vector dots[LANES];
    for (int k = 0; k < LANES; k++) {
      int i = b * LANES + k;
      int64_t p = pixel(r, t, i);
      bool inside = contains(t, i);
      transmittance[i] = inside ? 1 : 0;
      dots[k] = Vector();
      if (inside) by_depth[i] = r.by_depth[p], by_alpha[i] = r.by_alpha[p];
      if (inside) dots[k][0] = by_depth[i] * r.out_depth[p] + by_alpha[i] * r.out_alpha[p];
    }
    for (int64_t c = 0; c < C; c += LANES) {
      Vector v[LANES];
      for (int k = 0; k < LANES; k++) {
        int64_t at = pixel(r, t, b * LANES + k) * channels + c;
        bool inside = contains(t, b * LANES + k);
        v[k] = inside ? read(r.by_features + at, channels - c) : Vector();
        if (inside) dots[k] += v[k] * read(r.out_features + at, channels - c);
      }
      transpose(v);
      for (int k = 0; k < LANES; k++) store(planes + (b * C + c + k) * LANES, v[k]);
    }
    store(rest + b * LANES, sums(dots));
  }
  uint64_t live = ~0ull >> (64 - BLOCKS);
  const int32_t* members = r.members + r.tile_start[index];
  int64_t count = r.row_start[index + 1] - r.row_start[index];
  float* row = r.rows + r.row_start[index] * (GEOMETRY + C);
  for (int64_t k = 0; k < count; k++, row += GEOMETRY + C) {
    fetch(r, members, k + AHEAD, count);
    const Projected& p = r.projected[members[k]];
    const float* features = r.features + members[k] * channels;
    Splat s = localise(p, t);
    Vector n0 = {}, n0x = {}, n0y = {}, n1 = {}, n1x = {}, n1y = {}, n2 = {}, n2x = {}, n2y = {};
    Vector determinant = {}, px = {}, py = {}, depth = {}, log_opacity = {};
    Vector weights[BLOCKS];
    const float* touched[BLOCKS];
    int used = 0;
    for (uint64_t m = blocks(p.octagon, t) & live; m; m &= m - 1) {
      int b = __builtin_ctzll(m);
      Vector x = load(CENTRES.x + b * LANES), y = load(CENTRES.y + b * LANES), T = load(transmittance + b * LANES);
      auto hit = refgs::intersect<false>(s, x, y);
      Mask covered = hit.covered & (T > 0.0f);
      if (!any(covered)) continue;
      Vector uncapped = select(covered, refgs::uncapped_alpha(s, hit), Vector()), a = refgs::cap(uncapped);
      Vector w = a * T, by_z = load(by_depth + b * LANES);
      const float* plane = planes + b * LANES * C;
      Vector here = load(by_alpha + b * LANES) + by_z * hit.z, h1 = {}, h2 = {}, h3 = {};
      int64_t c = 0;
      for (; c + 4 <= channels; c += 4) {
        here += features[c] * load(plane + c * LANES);
        h1 += features[c + 1] * load(plane + (c + 1) * LANES);
        h2 += features[c + 2] * load(plane + (c + 2) * LANES);
        h3 += features[c + 3] * load(plane + (c + 3) * LANES);
      }
      for (; c < channels; c++) h1 += features[c] * load(plane + c * LANES);
      here = (here + h1) + (h2 + h3);
      Vector behind = load(rest + b * LANES) - w * here;
      Vector by_a = select(covered, T * here - behind * reciprocal(1.0f - a), Vector());
      T = unfinished(T * (1.0f - a));
      store(rest + b * LANES, behind), store(transmittance + b * LANES, T);
      if (!any(T > 0.0f)) live &= ~(1ull << b);
      weights[used] = w;
      touched[used++] = plane;
      auto d = refgs::differentiate(hit, uncapped, by_a, w * by_z);
      n0 += d.n0, n0x += d.n0 * x, n0y += d.n0 * y;
      n1 += d.n1, n1x += d.n1 * x, n1y += d.n1 * y;
      n2 += d.n2, n2x += d.n2 * x, n2y += d.n2 * y;
      determinant += d.determinant, log_opacity += d.log_opacity;
      if (any(covered & ~hit.on_plane)) {
        Vector by_x, by_y, by_depth;
        refgs::differentiate_screen(hit, d, by_x, by_y, by_depth);
        px += by_x, py += by_y, depth += by_depth;
      }
    }
    gather_all(row + GEOMETRY, weights, touched, used, channels);
    Vector geometry[] = {n0, n0x, n0y, n1, n1x, n1y, n2, n2x, n2y, determinant, px, py, depth, log_opacity, Vector(), Vector()};
    for (int i = 0; i < GEOMETRY; i += LANES) {
      Vector part[LANES];
      for (int k = 0; k < LANES; k++) part[k] = geometry[i + k];
      store(row + i, sums(part));
    }
  }
}

}  // namespace

EXPORT int64_t refgs_scratch_size(int64_t channels) { return PIXELS * padded(channels); }

// parallel
EXPORT void refgs_forward(Raster* r) {
  float* scratch = r->scratch + take(r->shared.thread, 1) * refgs_scratch_size(r->channels);
  for (int64_t t; (t = take(r->shared.next, 1)) < tiles_x(*r) * tiles_y(*r);)
    trimmed(*r) ? forward_tile<true>(*r, t, scratch) : forward_tile<false>(*r, t, scratch);
}

// parallel
EXPORT void refgs_backward(Raster* r) {
  float* scratch = r->scratch + take(r->shared.thread, 1) * refgs_scratch_size(r->channels);
  for (int64_t t; (t = take(r->shared.next, 1)) < tiles_x(*r) * tiles_y(*r);) backward_tile(*r, t, scratch);
}
