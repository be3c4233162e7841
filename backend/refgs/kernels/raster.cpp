// Surfels to pixels and back on the CPU: project, sort, bin into tiles, blend front to back; then the derivatives.
//
// Every function works on one Raster that the caller allocates. The ones marked `parallel` may be entered by several threads at
// once: they share the work through `shared`, which the caller sets to zero. No result depends on who does what.
#include "library.h"
#include "vector.h"

#include "splat.h"

using refgs::Splat;

namespace {

int32_t larger(int32_t a, int32_t b) { return a > b ? a : b; }
int32_t lesser(int32_t a, int32_t b) { return a < b ? a : b; }
double larger(double a, double b) { return a > b ? a : b; }  // b where one is NaN
double lesser(double a, double b) { return a < b ? a : b; }

constexpr int TILE_X = LANES == 4 ? 16 : 32, TILE_Y = 16;  // pixels; 64 blocks at most
constexpr int PIXELS = TILE_X * TILE_Y;
constexpr int BLOCK_X = LANES == 4 ? 2 : 4;  // a block is one vector of pixels
constexpr int BLOCK_Y = LANES / BLOCK_X;
constexpr int BLOCKS_X = TILE_X / BLOCK_X, BLOCKS_Y = TILE_Y / BLOCK_Y;
constexpr int BLOCKS = BLOCKS_X * BLOCKS_Y;
// n0, n1, n2 are taken apart where they sum up terms larger than this many times n2: u and v err by 2^-24 of it.
constexpr double SPLIT = 32;
constexpr int AHEAD = 12;     // splats that are fetched before they are needed
constexpr int CHUNK = 64;      // splats of a tile that are treated together
constexpr int GEOMETRY = 16;   // floats of a gradient row before its features; 14 are used

struct alignas(64) Projected {
  double value[3], slope_x[3], slope_y[3];  // of n0, n1, n2 as in Splat, the origin at the image's corner
  double x, y;
  float determinant, n2_min, n2_max, depth, opacity, rho_max;
  // Pixels that it can cover, all inclusive: bounds of x, y, x + y and x - y, an octagon; x1 < x0 where there are none.
  int16_t x0, x1, y0, y1, sum0, sum1, difference0, difference1;
};

static_assert(sizeof(Projected) == 128, "two cache lines");

struct Raster {
  int64_t splats, channels, width, height;
  const float *positions, *rotations, *scales, *opacities, *features;
  double view[12];  // world to camera, 3x4, row-major
  double fx, fy, cx, cy, near;
  Projected* projected;       // (splats)
  uint32_t* keys;             // (4 splats) scratch of the sort
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
  float* rows;                // (row_start[tiles], GEOMETRY + padded channels) derivatives of a pair
  float *by_positions, *by_rotations, *by_scales, *by_opacities, *by_splat_features;
  float* scratch;             // (threads, refgs_scratch_size)
  Shared shared;
};

typedef double Quad __attribute__((vector_size(32)));
typedef float FloatQuad __attribute__((vector_size(16)));

int64_t tiles_x(const Raster& r) { return (r.width + TILE_X - 1) / TILE_X; }
int64_t tiles_y(const Raster& r) { return (r.height + TILE_Y - 1) / TILE_Y; }

// body(tile) for the tiles that the splat's octagon meets, row by row.
template <class Body>
INLINE void each_tile(const Raster& r, const Projected& p, Body body) {
  if (p.x1 < p.x0) return;
  for (int32_t y = p.y0 / TILE_Y; y <= p.y1 / TILE_Y; y++)
    for (int32_t x = p.x0 / TILE_X; x <= p.x1 / TILE_X; x++) {
      int32_t sum = x * TILE_X + y * TILE_Y, difference = x * TILE_X - y * TILE_Y;  // of the tile's first pixel
      if (sum <= p.sum1 && sum + TILE_X + TILE_Y - 2 >= p.sum0 && difference - TILE_Y < p.difference1 && difference + TILE_X > p.difference0)
        body(y * tiles_x(r) + x, x, y);
    }
}

int64_t padded(int64_t channels) { return (channels + LANES - 1) / LANES * LANES; }

struct Vec3 {
  double x, y, z;
};
Vec3 operator+(Vec3 a, Vec3 b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
Vec3 operator*(double s, Vec3 a) { return {s * a.x, s * a.y, s * a.z}; }
double dot(Vec3 a, Vec3 b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
Vec3 cross(Vec3 a, Vec3 b) { return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x}; }

// A splat in camera space: centre c, axes a = s_u t_u and b = s_v t_v.
struct Disc {
  double q[4], norm;  // unit quaternion; the norm it came with, 0 where it had none and stands for the identity
  Vec3 u, v;          // unit tangents, camera space
  double scale_u, scale_v;
  Vec3 a, b, c;
};

Vec3 rotate(const double* view, Vec3 p) {
  return {view[0] * p.x + view[1] * p.y + view[2] * p.z, view[4] * p.x + view[5] * p.y + view[6] * p.z,
          view[8] * p.x + view[9] * p.y + view[10] * p.z};
}

Vec3 rotate_back(const double* view, Vec3 p) {
  return {view[0] * p.x + view[4] * p.y + view[8] * p.z, view[1] * p.x + view[5] * p.y + view[9] * p.z,
          view[2] * p.x + view[6] * p.y + view[10] * p.z};
}

constexpr double MIN_NORM = 1e-12;  // a quaternion shorter than this says nothing

INLINE Disc disc(const Raster& r, int64_t i) {
  Disc d;
  const float* q = r.rotations + 4 * i;
  d.norm = __builtin_sqrt((double)q[0] * q[0] + (double)q[1] * q[1] + (double)q[2] * q[2] + (double)q[3] * q[3]);
  if (d.norm < MIN_NORM) d.norm = 0;
  for (int k = 0; k < 4; k++) d.q[k] = d.norm > 0 ? q[k] / d.norm : k == 0;
  double w = d.q[0], x = d.q[1], y = d.q[2], z = d.q[3];
  d.u = rotate(r.view, {1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)});
  d.v = rotate(r.view, {2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)});
  d.scale_u = r.scales[2 * i], d.scale_v = r.scales[2 * i + 1];
  d.a = d.scale_u * d.u, d.b = d.scale_v * d.v;
  const float* p = r.positions + 3 * i;
  d.c = rotate(r.view, {p[0], p[1], p[2]}) + Vec3{r.view[3], r.view[7], r.view[11]};
  return d;
}

// The factor that makes the coefficients of Eq. 4 of the order of one, and the determinant positive; 0 for a degenerate disc.
double normaliser(const Raster& r, const Disc& d, Vec3 n0, Vec3 n1, Vec3 n2, double determinant) {
  double largest = __builtin_fabs(determinant) / d.c.z;
  const Vec3 rows[] = {n0, n1, n2};
  for (Vec3 n : rows) largest = larger(largest, larger(__builtin_fabs(n.x) / r.fx, __builtin_fabs(n.y) / r.fy));
  if (!(largest > 0) || __builtin_fabs(determinant) / d.c.z <= 1e-18 * largest) return 0;
  return (determinant < 0 ? -1 : 1) / largest;
}

// Bounds of the image of {c + u a + v b: u^2 + v^2 <= k2}, wholly in front of the camera, along four image axes: the tangents to
// its outline, a conic. `a`, `b`, `c` are the axes' homogeneous coordinates of the three vectors.
INLINE void extent(Quad a, Quad b, Quad c, const Disc& d, double k2, Quad& low, Quad& high) {
  double zz = k2 * (d.a.z * d.a.z + d.b.z * d.b.z) - d.c.z * d.c.z;  // < 0
  Quad uz = k2 * (a * d.a.z + b * d.b.z) - c * d.c.z;
  Quad uu = k2 * (a * a + b * b) - c * c;
  Quad square = uz * uz - uu * zz;
  Quad root = __builtin_elementwise_sqrt(square > 0 ? square : Quad());
  low = (uz + root) / zz, high = (uz - root) / zz;
}

int16_t integer(double x) { return (int16_t)lesser(larger(x, -32767.0), 32767.0); }

void project(const Raster& r, int64_t i) {
  Projected& p = r.projected[i];
  p.x0 = 0, p.x1 = -1;
  Disc d = disc(r, i);
  double rho_max = 2 * __builtin_log(r.opacities[i] / (double)refgs::ALPHA_CUT);
  if (!(d.c.z >= r.near && d.c.z <= refgs::FAR && rho_max >= 0)) return;
  p.x = r.fx * d.c.x / d.c.z + r.cx;
  p.y = r.fy * d.c.y / d.c.z + r.cy;
  p.depth = d.c.z;
  p.opacity = r.opacities[i];
  p.rho_max = rho_max;

  Vec3 n0 = cross(d.b, d.c), n1 = cross(d.c, d.a), n2 = cross(d.a, d.b);
  double determinant = dot(d.c, n2);
  double k = normaliser(r, d, n0, n1, n2, determinant);
  const Vec3 rows[] = {n0, n1, n2};
  for (int j = 0; j < 3; j++) {
    p.slope_x[j] = k * rows[j].x / r.fx, p.slope_y[j] = k * rows[j].y / r.fy;
    p.value[j] = k * rows[j].z - p.slope_x[j] * r.cx - p.slope_y[j] * r.cy;
  }
  determinant *= k;
  p.determinant = determinant;
  p.n2_min = k != 0 ? larger(determinant / refgs::FAR, 1e-18) : 1;
  p.n2_max = k != 0 ? determinant / r.near : -1;

  // The octagon's axes x, y, x + y, x - y, as coefficients of homogeneous coordinates; how far the screen-space filter reaches.
  const Quad mx = {r.fx, 0, r.fx, r.fx}, my = {0, r.fy, r.fy, -r.fy}, mz = {r.cx, r.cy, r.cx + r.cy, r.cx - r.cy};
  auto axes = [&](Vec3 p) { return mx * p.x + my * p.y + mz * p.z; };
  double radius = __builtin_sqrt(rho_max / refgs::LOW_PASS), reach = __builtin_sqrt(rho_max);
  const Quad diagonal = {1, 1, 1.4142135623730951, 1.4142135623730951}, centre = axes(d.c) / d.c.z;
  Quad low = centre - radius * diagonal, high = centre + radius * diagonal;
  auto include = [&](Quad a, Quad b) { low = a < low ? a : low, high = b > high ? b : high; };
  double slope = __builtin_sqrt(d.a.z * d.a.z + d.b.z * d.b.z);  // of z over the disc, along (d.a.z, d.b.z)
  if (k != 0 && d.c.z - reach * slope >= r.near) {
    Quad first, last;
    extent(axes(d.a), axes(d.b), axes(d.c), d, rho_max, first, last);
    include(first, last);
  } else if (k != 0) {  // what is left of the disc lies in a rectangle, cut off at the near plane, whose image is convex
    double eu = d.a.z / slope, ev = d.b.z / slope;
    const double ts[] = {(r.near - d.c.z) / slope, reach}, ss[] = {-reach, reach};
    for (double t : ts)
      for (double s : ss) {
        Vec3 corner = d.c + (t * eu - s * ev) * d.a + (t * ev + s * eu) * d.b;
        corner.z = larger(corner.z, r.near);
        include(axes(corner) / corner.z, axes(corner) / corner.z);
      }
  }
  const Quad first_pixel = {0.5, 0.5, 1, 0};  // the first pixel's centre along the axes
  const double slack = 1e-3;                  // pixels: for the rounding of the tiles' float arithmetic
  low = __builtin_elementwise_ceil(low - first_pixel - slack), high = __builtin_elementwise_floor(high - first_pixel + slack);
  p.x0 = larger(integer(low[0]), 0), p.x1 = lesser(integer(high[0]), r.width - 1);
  p.y0 = larger(integer(low[1]), 0), p.y1 = lesser(integer(high[1]), r.height - 1);
  p.sum0 = integer(low[2]), p.sum1 = integer(high[2]), p.difference0 = integer(low[3]), p.difference1 = integer(high[3]);
  if (p.y1 < p.y0) p.x1 = p.x0 - 1;
}

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

INLINE Quad magnitude(Quad v) { return v < 0 ? -v : v; }

INLINE Splat localise(const Projected& p, const Tile& t) {
  double x = t.x + TILE_X / 2, y = t.y + TILE_Y / 2;
  Splat s;
  // A fourth lane reads what comes next in `p`, and is not used.
  Quad slope_x = load_quad(p.slope_x), slope_y = load_quad(p.slope_y), value = load_quad(p.value) + slope_x * x + slope_y * y;
  Quad spread = (TILE_X / 2) * magnitude(slope_x) + (TILE_Y / 2) * magnitude(slope_y), most = magnitude(value) + spread;
  s.split = !(larger(larger(most[0], most[1]), most[2]) <= SPLIT * (value[2] - spread[2]));
  if (s.split) {
    // Adding 1.5 * 2^52 q rounds to multiples of q, here 2^-22 of the largest sum: its multiples of q / 2 fit in a float.
    Quad round = (most + spread) * (1.5 * (1ll << 30));
    auto part = [&](Quad exact, float* high, float* low) {
      FloatQuad h = __builtin_convertvector(exact + round - round, FloatQuad);
      *(FloatQuad*)high = h;
      *(FloatQuad*)low = __builtin_convertvector(exact - __builtin_convertvector(h, Quad), FloatQuad);
    };
    part(value, s.high.value, s.low.value);
    part(slope_x, s.high.slope_x, s.low.slope_x);
    part(slope_y, s.high.slope_y, s.low.slope_y);
  } else {
    *(FloatQuad*)s.high.value = __builtin_convertvector(value, FloatQuad);
    *(FloatQuad*)s.high.slope_x = __builtin_convertvector(slope_x, FloatQuad);
    *(FloatQuad*)s.high.slope_y = __builtin_convertvector(slope_y, FloatQuad);
  }
  s.determinant = p.determinant, s.n2_min = p.n2_min, s.n2_max = p.n2_max;
  s.x = near_zero(p.x - x), s.y = near_zero(p.y - y), s.depth = p.depth;
  s.opacity = p.opacity, s.rho_max = p.rho_max;
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
uint64_t blocks(const Projected& p, const Tile& t) {
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
  if (c + 4 <= channels) blend<4>(sums + c * LANES, weights, rows, count, c), c += 4;
  for (; c < channels; c++) blend<1>(sums + c * LANES, weights, rows, count, c);
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
  Splat splats[CHUNK];
  uint8_t lists[BLOCKS][CHUNK];
  Vector weights[CHUNK];
  const float* rows[CHUNK];
  for (int64_t start = 0; start < count && live; start += CHUNK) {
    int lengths[BLOCKS] = {};
    int n = (int)(count - start < CHUNK ? count - start : CHUNK);
    for (int k = 0; k < n; k++) {
      fetch(r, members, start + k + AHEAD, count);
      const Projected& p = r.projected[members[start + k]];
      splats[k] = localise(p, t);
      for (uint64_t m = blocks(p, t) & live; m; m &= m - 1) {
        int b = __builtin_ctzll(m);
        lists[b][lengths[b]++] = (uint8_t)k;
      }
    }
    for (uint64_t m = live; m; m &= m - 1) {
      int b = __builtin_ctzll(m), used = 0;
      Vector x = load(CENTRES.x + b * LANES), y = load(CENTRES.y + b * LANES);
      Vector T = load(transmittance + b * LANES), Z = load(depth + b * LANES), A = load(alpha + b * LANES);
      int64_t last = start + n;
      for (int j = 0; j < lengths[b]; j++) {
        int k = lists[b][j];
        const Splat& s = splats[k];
        auto hit = refgs::intersect<Vector>(s, x, y);
        Mask covered = hit.covered & (T >= refgs::MIN_TRANSMITTANCE);
        if (!any(covered)) continue;
        Vector a = select(covered, refgs::alpha(s, refgs::gaussian(hit)), Vector());
        Vector w = a * T;
        T = T * (1.0f - a);
        Z += w * hit.z;
        A += w;
        weights[used] = w;
        rows[used++] = r.features + members[start + k] * r.channels;
        if (!any(T >= refgs::MIN_TRANSMITTANCE)) {
          live &= ~(1ull << b);
          last = start + k + 1;
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
    Vector determinant = {}, px = {}, py = {}, depth = {}, opacity = {};
    Vector weights[BLOCKS];
    const float* touched[BLOCKS];
    int used = 0;
    for (uint64_t m = blocks(p, t) & live; m; m &= m - 1) {
      int b = __builtin_ctzll(m);
      Vector x = load(CENTRES.x + b * LANES), y = load(CENTRES.y + b * LANES), T = load(transmittance + b * LANES);
      auto hit = refgs::intersect<Vector>(s, x, y);
      Mask covered = hit.covered & (T >= refgs::MIN_TRANSMITTANCE);
      if (!any(covered)) continue;
      Vector g = refgs::gaussian(hit);
      Vector a = select(covered, refgs::alpha(s, g), Vector());
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
      T = T * (1.0f - a);
      store(rest + b * LANES, behind), store(transmittance + b * LANES, T);
      if (!any(T >= refgs::MIN_TRANSMITTANCE)) live &= ~(1ull << b);
      weights[used] = w;
      touched[used++] = plane;
      auto d = refgs::differentiate(s, hit, g, by_a, w * by_z);
      n0 += d.n0, n0x += d.n0 * x, n0y += d.n0 * y;
      n1 += d.n1, n1x += d.n1 * x, n1y += d.n1 * y;
      n2 += d.n2, n2x += d.n2 * x, n2y += d.n2 * y;
      determinant += d.determinant, opacity += d.opacity;
      if (any(covered & ~hit.on_plane)) {
        Vector by_x, by_y, by_depth;
        refgs::differentiate_screen(hit, d, by_x, by_y, by_depth);
        px += by_x, py += by_y, depth += by_depth;
      }
    }
    gather_features(row + GEOMETRY, weights, touched, used, C);
    Vector geometry[] = {n0, n0x, n0y, n1, n1x, n1y, n2, n2x, n2y, determinant, px, py, depth, opacity, Vector(), Vector()};
    for (int i = 0; i < GEOMETRY; i += LANES) {
      Vector part[LANES];
      for (int k = 0; k < LANES; k++) part[k] = geometry[i + k];
      store(row + i, sums(part));
    }
  }
}

float finite(double x) { return (float)lesser(larger(x, -3.4028234e38), 3.4028234e38); }

void prefetch(const Raster& r, int64_t i) {
  int64_t stride = GEOMETRY + padded(r.channels);
  const int32_t* place = r.places + r.splat_start[i];
  each_tile(r, r.projected[i], [&](int64_t tile, int, int) {
    const float* row = r.rows + (r.row_start[tile] + *place++) * stride;
    for (int64_t c = 0; c < stride; c += 16) __builtin_prefetch(row + c);
  });
}

// Add up a splat's rows, and carry the derivatives from its projection to its parameters.
void gather(const Raster& r, int64_t i) {
  const Projected& p = r.projected[i];
  int64_t channels = r.channels, stride = GEOMETRY + padded(channels);
  double n[3][3] = {}, determinant = 0, x = 0, y = 0, depth = 0, opacity = 0;
  float* __restrict by_features = r.by_splat_features + i * channels;
  for (int64_t c = 0; c < channels; c++) by_features[c] = 0;
  bool touched = false;
  const int32_t* place = r.places + r.splat_start[i];
  each_tile(r, p, [&](int64_t tile, int tx, int ty) {
    int32_t at = *place++;
    if (at >= r.row_start[tile + 1] - r.row_start[tile]) return;
    const float* __restrict row = r.rows + (r.row_start[tile] + at) * stride;
    touched = true;
    double mx = tx * TILE_X + TILE_X / 2, my = ty * TILE_Y + TILE_Y / 2;
    for (int k = 0; k < 3; k++) {
      n[k][0] += row[3 * k];
      n[k][1] += row[3 * k + 1] + mx * row[3 * k];
      n[k][2] += row[3 * k + 2] + my * row[3 * k];
    }
    determinant += row[9], x += row[10], y += row[11], depth += row[12], opacity += row[13];
    for (int64_t c = 0; c < channels; c++) by_features[c] += row[GEOMETRY + c];
  });
  float *by_position = r.by_positions + 3 * i, *by_rotation = r.by_rotations + 4 * i, *by_scale = r.by_scales + 2 * i;
  by_position[0] = by_position[1] = by_position[2] = 0;
  by_rotation[0] = by_rotation[1] = by_rotation[2] = by_rotation[3] = 0;
  by_scale[0] = by_scale[1] = r.by_opacities[i] = 0;
  if (!touched) return;
  r.by_opacities[i] = finite(opacity);

  Disc d = disc(r, i);
  Vec3 v0 = cross(d.b, d.c), v1 = cross(d.c, d.a), v2 = cross(d.a, d.b);
  double k = normaliser(r, d, v0, v1, v2, dot(d.c, v2));
  auto raw = [&](const double* g) {
    return Vec3{k * (g[1] - g[0] * r.cx) / r.fx, k * (g[2] - g[0] * r.cy) / r.fy, k * g[0]};
  };
  determinant *= k;
  Vec3 g0 = raw(n[0]), g1 = raw(n[1]), g2 = raw(n[2]) + determinant * d.c;
  Vec3 by_a = cross(g1, d.c) + cross(d.b, g2);
  Vec3 by_b = cross(d.c, g0) + cross(g2, d.a);
  Vec3 by_c = cross(g0, d.b) + cross(d.a, g1) + determinant * v2;
  by_c.x += x * r.fx / d.c.z, by_c.y += y * r.fy / d.c.z;
  by_c.z += depth - (x * r.fx * d.c.x + y * r.fy * d.c.y) / (d.c.z * d.c.z);

  Vec3 position = rotate_back(r.view, by_c);
  by_position[0] = finite(position.x), by_position[1] = finite(position.y), by_position[2] = finite(position.z);
  by_scale[0] = finite(dot(by_a, d.u)), by_scale[1] = finite(dot(by_b, d.v));
  if (d.norm == 0) return;
  Vec3 g = rotate_back(r.view, d.scale_u * by_a), h = rotate_back(r.view, d.scale_v * by_b);
  double qw = d.q[0], qx = d.q[1], qy = d.q[2], qz = d.q[3];
  double by_q[4] = {2 * (qz * g.y - qy * g.z - qz * h.x + qx * h.z),
                    2 * (qy * g.y + qz * g.z + qy * h.x - 2 * qx * h.y + qw * h.z),
                    2 * (-2 * qy * g.x + qx * g.y - qw * g.z + qx * h.x + qz * h.z),
                    2 * (-2 * qz * g.x + qw * g.y + qx * g.z - qw * h.x - 2 * qz * h.y + qy * h.z)};
  double along = by_q[0] * qw + by_q[1] * qx + by_q[2] * qy + by_q[3] * qz;
  for (int j = 0; j < 4; j++) by_rotation[j] = finite((by_q[j] - along * d.q[j]) / d.norm);
}

}  // namespace

EXPORT int64_t refgs_tiles(int64_t width, int64_t height) { return ((width + TILE_X - 1) / TILE_X) * ((height + TILE_Y - 1) / TILE_Y); }
EXPORT int64_t refgs_projected_size() { return sizeof(Projected); }
EXPORT int64_t refgs_row_size(int64_t channels) { return GEOMETRY + padded(channels); }
EXPORT int64_t refgs_scratch_size(int64_t channels) { return PIXELS * padded(channels); }

// parallel
EXPORT void refgs_project(Raster* r) {
  for (int64_t i; (i = take(r->shared.next, 256)) < r->splats;)
    for (int64_t j = i; j < i + 256 && j < r->splats; j++) project(*r, j);
}

// Order the visible splats by depth (in float, ties by index) and count the pairs.
EXPORT void refgs_sort(Raster* r) {
  int64_t n = 0, pairs = 0;
  uint32_t *keys = r->keys, *values = keys + r->splats, *keys2 = values + r->splats, *values2 = keys2 + r->splats;
  int64_t tiles = tiles_x(*r) * tiles_y(*r);
  for (int64_t t = 0; t <= tiles; t++) r->tile_start[t] = 0;
  for (int64_t i = 0; i < r->splats; i++) {
    const Projected& p = r->projected[i];
    r->splat_start[i] = pairs;
    int64_t before = pairs;
    each_tile(*r, p, [&](int64_t tile, int, int) { r->tile_start[tile + 1]++, pairs++; });
    if (pairs == before) continue;
    __builtin_memcpy(keys + n, &p.depth, 4);  // a positive float's bits are in its order
    values[n++] = (uint32_t)i;
  }
  r->splat_start[r->splats] = r->pairs = pairs;
  r->visible = n;
  for (int64_t t = 0; t < tiles; t++) r->tile_start[t + 1] += r->tile_start[t];
  for (int shift = 0; shift < 33; shift += 11) {
    uint32_t starts[2049] = {};
    for (int64_t i = 0; i < n; i++) starts[(keys[i] >> shift & 2047) + 1]++;
    for (int d = 0; d < 2048; d++) starts[d + 1] += starts[d];
    for (int64_t i = 0; i < n; i++) {
      uint32_t to = starts[keys[i] >> shift & 2047]++;
      keys2[to] = keys[i], values2[to] = values[i];
    }
    uint32_t* swap = keys;
    keys = keys2, keys2 = swap;
    swap = values, values = values2, values2 = swap;
  }
  for (int64_t i = 0; i < n; i++) r->order[i] = (int32_t)values[i];
}

// Counting scatter of the sorted splats into tiles.
EXPORT void refgs_bin(Raster* r) {
  int32_t* counts = r->reach;  // not in use yet
  for (int64_t t = 0; t < tiles_x(*r) * tiles_y(*r); t++) counts[t] = 0;
  for (int64_t k = 0; k < r->visible; k++) {
    int32_t i = r->order[k], ahead = r->order[k + AHEAD < r->visible ? k + AHEAD : k];
    __builtin_prefetch((const char*)&r->projected[ahead] + 64);
    __builtin_prefetch(&r->splat_start[ahead]);
    int32_t* place = r->places + r->splat_start[i];
    each_tile(*r, r->projected[i], [&](int64_t tile, int, int) {
      *place = counts[tile]++;
      r->members[r->tile_start[tile] + *place++] = i;
    });
  }
}

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

// parallel
EXPORT void refgs_gather(Raster* r) {
  const int BATCH = 32;  // splats whose rows are on their way while the ones before are added up
  for (int64_t i; (i = take(r->shared.next, BATCH)) < r->splats;) {
    int64_t end = i + BATCH < r->splats ? i + BATCH : r->splats;
    for (int64_t j = i; j < end; j++) prefetch(*r, j);
    for (int64_t j = i; j < end; j++) gather(*r, j);
  }
}
