// Tiles to pixels: blend front to back; and the derivatives of each pair of splat and tile.
#include "raster.h"

using refgs::Splat;

namespace {

typedef double Quad __attribute__((vector_size(32)));

// n0, n1, n2 are taken apart where they sum up terms larger than this many times n2: u and v err by 2^-24 of it.
constexpr double SPLIT = 32;
constexpr int CHUNK = 64;      // splats of a tile that are treated together

// A tile's pixels are numbered block by block, and within a block lane by lane.
constexpr int pixel_x(int i) { return i / LANES % BLOCKS_X * BLOCK_X + i % LANES % BLOCK_X; }
constexpr int pixel_y(int i) { return i / LANES / BLOCKS_X * BLOCK_Y + i % LANES / BLOCK_X; }

struct Tile {
  int64_t index, x, y, width, height;  // x, y: its first pixel; width, height: its part inside the image
  Tile(const Raster& r, int64_t i) : index(i), x(i % tiles_x(r) * TILE_X), y(i / tiles_x(r) * TILE_Y) {
    width = r.width - x < TILE_X ? r.width - x : TILE_X;
    height = r.height - y < TILE_Y ? r.height - y : TILE_Y;
  }
  bool inside(int i) const { return pixel_x(i) < width && pixel_y(i) < height; }
  int64_t pixel(const Raster& r, int i) const { return (y + pixel_y(i)) * r.width + x + pixel_x(i); }
};

// Pixel centres of a tile from its middle, block by block.
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

float near_zero(double x) { return (float)lesser(larger(x, -1e9), 1e9); }

INLINE Quad load_quad(const double* p) {
  typedef double Unaligned __attribute__((vector_size(32), aligned(8)));
  return *(const Unaligned*)p;
}

// A pixel's transmittance, zero from where it is finished.
INLINE Vector unfinished(Vector T) { return select(T >= refgs::MIN_TRANSMITTANCE, T, Vector()); }

INLINE Quad magnitude(Quad v) { return v < 0 ? -v : v; }

INLINE Splat localise(const Projected& p, const Tile& t) {
  double x = t.x + TILE_X / 2, y = t.y + TILE_Y / 2;
  Splat s;
  // A fourth lane reads what comes next in `p`, and is not used.
  Quad slope_x = load_quad(p.slope_x), slope_y = load_quad(p.slope_y), value = load_quad(p.value) + slope_x * x + slope_y * y;
  Quad spread = (TILE_X / 2) * magnitude(slope_x) + (TILE_Y / 2) * magnitude(slope_y), most = magnitude(value) + spread;
  double n2_low = value[2] - spread[2], n2_high = value[2] + spread[2];
  s.plain = larger(larger(most[0], most[1]), most[2]) <= SPLIT * n2_low && n2_low >= p.n2_min && n2_high <= p.n2_max;
  if (!s.plain) {
    // Adding 1.5 * 2^52 q rounds to multiples of q, here 2^-22 of the largest sum: its multiples of q / 2 fit in a float.
    Quad round = (most + spread) * (1.5 * (1ll << 30));
    auto part = [&](Quad exact, float* high, float* low) {
      Four h = __builtin_convertvector(exact + round - round, Four);
      *(Four*)high = h;
      *(Four*)low = __builtin_convertvector(exact - __builtin_convertvector(h, Quad), Four);
    };
    part(value, s.high.value, s.low.value);
    part(slope_x, s.high.slope_x, s.low.slope_x);
    part(slope_y, s.high.slope_y, s.low.slope_y);
  } else {
    *(Four*)s.high.value = __builtin_convertvector(value, Four);
    *(Four*)s.high.slope_x = __builtin_convertvector(slope_x, Four);
    *(Four*)s.high.slope_y = __builtin_convertvector(slope_y, Four);
  }
  s.determinant = p.determinant, s.n2_min = p.n2_min, s.n2_max = p.n2_max;
  s.x = near_zero(p.x - x), s.y = near_zero(p.y - y), s.depth = p.depth;
  s.log2_opacity = p.log2_opacity, s.rho_max = p.rho_max;
  return s;
}

// Start fetching what a tile's member holds: they lie anywhere.
INLINE void fetch(const Raster& r, const int32_t* members, int64_t k, int64_t count) {
  if (k >= count) return;
  __builtin_prefetch(&r.projected[members[k]]);
  __builtin_prefetch((const char*)&r.projected[members[k]] + 64);
  __builtin_prefetch(r.features + members[k] * r.channels);
}

uint64_t bits(int low, int high) { return (~0ull >> (63 - (high - low))) << low; }

// Blocks of the tile that the splat's octagon meets, one bit each.
uint64_t blocks(const Octagon& p, const Tile& t) {
  int32_t tx = (int32_t)t.x, ty = (int32_t)t.y;
  uint64_t mask = 0;
  for (int y = larger(p.y0 - ty, 0) / BLOCK_Y; y <= lesser(p.y1 - ty, TILE_Y - 1) / BLOCK_Y; y++) {
    int32_t top = ty + y * BLOCK_Y, bottom = top + BLOCK_Y - 1;
    int32_t x0 = larger(larger(p.x0, p.sum0 - bottom), p.difference0 + top) - tx;
    int32_t x1 = lesser(lesser(p.x1, p.sum1 - top), p.difference1 + bottom) - tx;
    if (x0 > x1 || x1 < 0 || x0 >= TILE_X) continue;
    mask |= bits(larger(x0, 0) / BLOCK_X, lesser(x1, TILE_X - 1) / BLOCK_X) << (y * BLOCKS_X);
  }
  return mask;
}

// sums[c] += sum_k weights[k] features[which[k]][c], for N channels of a block.
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

// Two splats' alphas and depths at the pixels of a block. Two at once, step by step: the one's arithmetic goes on while the other's waits.
template <bool PLAIN>
INLINE void see(const Splat& s, const Splat& t, Vector x, Vector y, Vector (&alpha)[2], Vector (&z)[2]) {
  refgs::Hit<Vector> hits[] = {refgs::intersect<PLAIN>(s, x, y), refgs::intersect<PLAIN>(t, x, y)};
  Vector uncapped[] = {refgs::uncapped_alpha(s, hits[0]), refgs::uncapped_alpha(t, hits[1])};
  for (int i = 0; i < 2; i++) {
    alpha[i] = select(hits[i].covered, refgs::cap(uncapped[i]), Vector());
    z[i] = hits[i].z;
  }
}

void forward_tile(Raster& r, int64_t index, float* sums) {
  Tile t(r, index);
  alignas(64) float transmittance[PIXELS], depth[PIXELS] = {}, alpha[PIXELS] = {};
  for (int i = 0; i < PIXELS; i++) transmittance[i] = t.inside(i) ? 1 : 0;
  clear(sums, r.channels * PIXELS);

  uint64_t live = 0;
  for (int b = 0; b < BLOCKS; b++) live |= (uint64_t)any(load(transmittance + b * LANES) > 0.0f) << b;
  const int32_t* members = r.members + r.tile_start[index];
  int64_t count = r.tile_start[index + 1] - r.tile_start[index], reach = 0;
  Splat splats[CHUNK + 1];  // the one after the last covers nothing, and completes an odd list
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
          T = unfinished(T * (1.0f - a[i]));
          Z += w * z[i];
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
    if (!t.inside(i)) continue;
    r.out_depth[t.pixel(r, i)] = depth[i], r.out_alpha[t.pixel(r, i)] = alpha[i];
  }
  for (int b = 0; b < BLOCKS; b++)
    for (int64_t c = 0; c < r.channels; c += LANES) {
      Vector v[LANES];
      for (int k = 0; k < LANES; k++) v[k] = c + k < r.channels ? load(sums + (b * r.channels + c + k) * LANES) : Vector();
      transpose(v);
      for (int k = 0; k < LANES; k++) {
        int i = b * LANES + k;
        if (t.inside(i)) write(r.out_features + t.pixel(r, i) * r.channels + c, v[k], r.channels - c);
      }
    }
}

// row[c] = sum over the pixels of some blocks of weight * by_features[pixel][c]; a block's plane is (channel, lane).
void gather_features(float* row, const Vector* weights, const float* const* planes, int count, int64_t channels) {
  for (int64_t c = 0; c < channels; c += LANES) {
    Vector s[LANES] = {};
    for (int k = 0; k < count; k++) {
      Vector w = weights[k];
      const float* plane = planes[k] + c * LANES;
#pragma unroll
      for (int i = 0; i < LANES; i++) s[i] += w * load(plane + i * LANES);
    }
    store(row + c, sums(s));
  }
}

// Front to back again. What lies behind a splat is what is left of the pixel's total, so one scalar a pixel suffices.
void backward_tile(Raster& r, int64_t index, float* scratch) {
  Tile t(r, index);
  int64_t channels = r.channels, C = padded(channels);
  float* planes = scratch;  // derivatives by features, (block, channel, lane)
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
      int64_t p = t.pixel(r, i);
      bool inside = t.inside(i);
      transmittance[i] = inside ? 1 : 0;
      dots[k] = Vector();
      if (inside) by_depth[i] = r.by_depth[p], by_alpha[i] = r.by_alpha[p];
      if (inside) dots[k][0] = by_depth[i] * r.out_depth[p] + by_alpha[i] * r.out_alpha[p];
    }
    for (int64_t c = 0; c < C; c += LANES) {
      Vector v[LANES];
      for (int k = 0; k < LANES; k++) {
        int64_t at = t.pixel(r, b * LANES + k) * channels + c;
        bool inside = t.inside(b * LANES + k);
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
    gather_features(row + GEOMETRY, weights, touched, used, C);
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
  for (int64_t t; (t = take(r->shared.next, 1)) < tiles_x(*r) * tiles_y(*r);) forward_tile(*r, t, scratch);
}

// parallel
EXPORT void refgs_backward(Raster* r) {
  float* scratch = r->scratch + take(r->shared.thread, 1) * refgs_scratch_size(r->channels);
  for (int64_t t; (t = take(r->shared.next, 1)) < tiles_x(*r) * tiles_y(*r);) backward_tile(*r, t, scratch);
}
