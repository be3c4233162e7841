// Splats to the picture's tiles: project, sort by depth, bin. And back: derivatives from the tiles to the splats' parameters.
#include "raster.h"

namespace {

constexpr int BATCH = LANES / 2;  // splats that are treated at once, one a lane
typedef double Real __attribute__((vector_size(8 * BATCH)));
typedef int64_t Truth __attribute__((vector_size(8 * BATCH)));

INLINE Real larger(Real a, Real b) { return a > b ? a : b; }
INLINE Real lesser(Real a, Real b) { return a < b ? a : b; }
INLINE Real magnitude(Real a) { return a < 0 ? -a : a; }
INLINE Real root(Real a) { return __builtin_elementwise_sqrt(a); }

struct Vec3 {
  Real x, y, z;
};
INLINE Vec3 operator+(Vec3 a, Vec3 b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
INLINE Vec3 operator*(Real s, Vec3 a) { return {s * a.x, s * a.y, s * a.z}; }
INLINE Real dot(Vec3 a, Vec3 b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
INLINE Vec3 cross(Vec3 a, Vec3 b) { return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x}; }

// A batch of splats: of an array with `stride` floats a splat, the number `k` of each. Past the last splat stands the last one.
struct Batch {
  int64_t first, last;
  MEMBER int64_t operator[](int lane) const { return first + lane < last ? first + lane : last; }
  MEMBER Real operator()(const float* p, int stride, int k) const {
    Real v;
    for (int lane = 0; lane < BATCH; lane++) v[lane] = p[(*this)[lane] * stride + k];
    return v;
  }
};

// Splats in camera space: centre c, axes a = s_u t_u and b = s_v t_v; their homographies (see Splat) before the factors k and UNIT.
struct Disc {
  Real q[4], norm;  // unit quaternion; the norm it came with, 0 where it had none and stands for the identity
  Vec3 u, v;        // unit tangents, camera space
  Real scale_u, scale_v;
  Vec3 a, b, c;
  Vec3 n0, n1, n2;
  Real determinant, k;
};

INLINE Vec3 rotate(const double* view, Vec3 p) {
  return {view[0] * p.x + view[1] * p.y + view[2] * p.z, view[4] * p.x + view[5] * p.y + view[6] * p.z,
          view[8] * p.x + view[9] * p.y + view[10] * p.z};
}

INLINE Vec3 rotate_back(const double* view, Vec3 p) {
  return {view[0] * p.x + view[4] * p.y + view[8] * p.z, view[1] * p.x + view[5] * p.y + view[9] * p.z,
          view[2] * p.x + view[6] * p.y + view[10] * p.z};
}

constexpr double MIN_NORM = 1e-12;  // a quaternion shorter than this says nothing

INLINE Disc disc(const Raster& r, Batch i) {
  Disc d;
  Real q[4], square = {};
  for (int k = 0; k < 4; k++) q[k] = i(r.rotations, 4, k), square += q[k] * q[k];
  d.norm = root(square);
  d.norm = d.norm >= MIN_NORM ? d.norm : Real();
  for (int k = 0; k < 4; k++) d.q[k] = d.norm > 0 ? q[k] / d.norm : Real() + (k == 0);
  Real w = d.q[0], x = d.q[1], y = d.q[2], z = d.q[3];
  d.u = rotate(r.view, {1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)});
  d.v = rotate(r.view, {2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)});
  d.scale_u = i(r.scales, 2, 0), d.scale_v = i(r.scales, 2, 1);
  d.a = d.scale_u * d.u, d.b = d.scale_v * d.v;
  d.c = rotate(r.view, {i(r.positions, 3, 0), i(r.positions, 3, 1), i(r.positions, 3, 2)}) + Vec3{Real() + r.view[3], Real() + r.view[7], Real() + r.view[11]};

  d.n0 = cross(d.b, d.c), d.n1 = cross(d.c, d.a), d.n2 = cross(d.a, d.b);
  d.determinant = dot(d.c, d.n2);
  // The factor that makes the coefficients of Eq. 4 of the order of one, and the determinant positive; 0 for a degenerate disc.
  Real height = magnitude(d.determinant) / d.c.z, largest = height;
  const Vec3 rows[] = {d.n0, d.n1, d.n2};
  for (Vec3 n : rows) largest = larger(largest, larger(magnitude(n.x) / r.fx, magnitude(n.y) / r.fy));
  Truth proper = (largest > 0) & (height > 1e-18 * largest);
  d.k = proper ? (d.determinant < 0 ? Real() - 1 : Real() + 1) / largest : Real();
  return d;
}

// Bounds of the images of {c + u a + v b: u^2 + v^2 <= k2}, wholly in front of the camera, along an image axis: the tangents to
// the outline, a conic. `a`, `b`, `c` are the axis' homogeneous coordinates of the three vectors.
INLINE void extent(Real a, Real b, Real c, const Disc& d, Real k2, Real& low, Real& high) {
  Real zz = k2 * (d.a.z * d.a.z + d.b.z * d.b.z) - d.c.z * d.c.z;  // < 0
  Real uz = k2 * (a * d.a.z + b * d.b.z) - c * d.c.z;
  Real uu = k2 * (a * a + b * b) - c * c;
  Real side = root(larger(uz * uz - uu * zz, Real()));
  low = (uz + side) / zz, high = (uz - side) / zz;
}

void project(const Raster& r, int64_t first) {
  Batch i = {first, r.splats - 1};
  Disc d = disc(r, i);
  Real log_opacity;
  for (int lane = 0; lane < BATCH; lane++) log_opacity[lane] = __builtin_log(r.opacities[i[lane]]);
  Real rho_max = log_opacity - __builtin_log(refgs::ALPHA_CUT);
  Truth visible = (d.c.z >= r.near) & (d.c.z <= refgs::FAR) & (rho_max >= 0), proper = d.k != 0;

  // The octagon's axes x, y, x + y, x - y, as coefficients of homogeneous coordinates; how far the screen-space filter reaches.
  const double mx[] = {r.fx, 0, r.fx, r.fx}, my[] = {0, r.fy, r.fy, -r.fy}, mz[] = {r.cx, r.cy, r.cx + r.cy, r.cx - r.cy};
  const double diagonal[] = {1, 1, refgs::UNIT, refgs::UNIT}, first_pixel[] = {0.5, 0.5, 1, 0};  // its centre along the axes
  const double LIMIT = 32767, lowest[] = {0, 0, -LIMIT, -LIMIT}, highest[] = {r.width - 1.0, r.height - 1.0, LIMIT, LIMIT};
  const double slack = 1e-3;  // pixels: for the rounding of the tiles' float arithmetic
  Real k2 = 2 * rho_max, radius = root(k2 / (double)refgs::LOW_PASS), reach = root(k2);
  Real slope = root(d.a.z * d.a.z + d.b.z * d.b.z);  // of z over the disc, along (d.a.z, d.b.z)
  Truth whole = d.c.z - reach * slope >= r.near, cut = visible & proper & ~whole;
  bool some_cut = false;
  for (int lane = 0; lane < BATCH; lane++) some_cut |= cut[lane] != 0;
  Real lows[4], highs[4];
  for (int j = 0; j < 4; j++) {
    auto axis = [&](Vec3 p) { return mx[j] * p.x + my[j] * p.y + mz[j] * p.z; };
    Real centre = axis(d.c) / d.c.z, low = centre - radius * diagonal[j], high = centre + radius * diagonal[j], a, b;
    auto include = [&](Truth where, Real a, Real b) {
      low = (where & (a < low)) ? a : low;
      high = (where & (b > high)) ? b : high;
    };
    extent(axis(d.a), axis(d.b), axis(d.c), d, k2, a, b);
    include(proper & whole, a, b);
    if (some_cut) {  // what is left of the disc lies in a rectangle, cut off at the near plane, whose image is convex
      Real eu = d.a.z / slope, ev = d.b.z / slope;
      const Real ts[] = {(r.near - d.c.z) / slope, reach}, ss[] = {-reach, reach};
      for (Real t : ts)
        for (Real s : ss) {
          Vec3 corner = d.c + (t * eu - s * ev) * d.a + (t * ev + s * eu) * d.b;
          corner.z = larger(corner.z, Real() + r.near);
          Real at = axis(corner) / corner.z;
          include(cut, at, at);
        }
    }
    low = __builtin_elementwise_ceil(low - first_pixel[j] - slack), high = __builtin_elementwise_floor(high - first_pixel[j] + slack);
    lows[j] = lesser(larger(low, Real() + lowest[j]), Real() + LIMIT), highs[j] = lesser(larger(high, Real() - LIMIT), Real() + highest[j]);
  }

  Vec3 rows[] = {d.k / refgs::UNIT * d.n0, d.k / refgs::UNIT * d.n1, d.k * d.n2};
  Real slope_x[3], slope_y[3], value[3];
  for (int j = 0; j < 3; j++) {
    slope_x[j] = rows[j].x / r.fx, slope_y[j] = rows[j].y / r.fy;
    value[j] = rows[j].z - slope_x[j] * r.cx - slope_y[j] * r.cy;
  }
  Real determinant = d.determinant * d.k;
  Real n2_min = proper ? larger(determinant / refgs::FAR, Real() + 1e-18) : Real() + 1, n2_max = proper ? determinant / r.near : Real() - 1;
  Real x = r.fx * d.c.x / d.c.z + r.cx, y = r.fy * d.c.y / d.c.z + r.cy;
  for (int lane = 0; lane < BATCH && first + lane < r.splats; lane++) {
    Octagon& o = r.octagons[first + lane];
    if (!visible[lane]) {
      o.x0 = 0, o.x1 = -1;
      continue;
    }
    o.x0 = lows[0][lane], o.x1 = highs[0][lane], o.y0 = lows[1][lane], o.y1 = highs[1][lane];
    o.sum0 = lows[2][lane], o.sum1 = highs[2][lane], o.difference0 = lows[3][lane], o.difference1 = highs[3][lane];
    if (o.y1 < o.y0) o.x1 = o.x0 - 1;
    Projected& p = r.projected[first + lane];
    for (int j = 0; j < 3; j++) p.slope_x[j] = slope_x[j][lane], p.slope_y[j] = slope_y[j][lane], p.value[j] = value[j][lane];
    p.x = x[lane], p.y = y[lane], p.depth = d.c.z[lane];
    p.determinant = determinant[lane], p.n2_min = n2_min[lane], p.n2_max = n2_max[lane];
    p.log2_opacity = log_opacity[lane] * refgs::LOG2_E, p.rho_max = rho_max[lane];
    p.octagon = o;
    __builtin_memcpy(r.keys + 2 * r.splats + first + lane, &p.depth, 4);  // a positive float's bits are in its order
  }
}

void prefetch(const Raster& r, int64_t i) {
  int64_t stride = GEOMETRY + padded(r.channels);
  const int32_t* place = r.places + r.splat_start[i];
  each_tile(r, r.octagons[i], [&](int64_t tile, int, int) {
    const float* row = r.rows + (r.row_start[tile] + *place++) * stride;
    for (int64_t c = 0; c < stride; c += 16) __builtin_prefetch(row + c);
  });
}

// A gradient row's geometry: n0, n0 x, n0 y, and so on, and the rest; x and y from the middle of the tile.
typedef double Row __attribute__((vector_size(8 * GEOMETRY)));
typedef float FloatRow __attribute__((vector_size(4 * GEOMETRY), aligned(4)));

// Add up a splat's rows: those of its features in place, its geometry as values and as moments, x and y times as much. Whether there were any.
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

// Carry the derivatives of a batch from its rows through its projection to its parameters.
void gather(const Raster& r, int64_t first) {
  Batch i = {first, r.splats - 1};
  bool any_touched = false;
  Real n[3][3], determinant, x, y, depth, log_opacity, touched;
  for (int lane = 0; lane < BATCH; lane++) {
    Row sum = {}, sum_x = {}, sum_y = {};
    touched[lane] = first + lane < r.splats && add_rows(r, first + lane, sum, sum_x, sum_y);
    any_touched |= touched[lane] != 0;
    for (int k = 0; k < 3; k++) {
      n[k][0][lane] = sum[3 * k];
      n[k][1][lane] = sum[3 * k + 1] + sum_x[3 * k];
      n[k][2][lane] = sum[3 * k + 2] + sum_y[3 * k];
    }
    determinant[lane] = sum[9], x[lane] = sum[10], y[lane] = sum[11], depth[lane] = sum[12], log_opacity[lane] = sum[13];
  }
  auto put = [&](float* p, int stride, int k, Real v) {
    v = touched != 0 ? lesser(larger(v, Real() - 3.4028234e38), Real() + 3.4028234e38) : Real();
    for (int lane = 0; lane < BATCH && first + lane < r.splats; lane++) p[(first + lane) * stride + k] = (float)v[lane];
  };
  Disc d = {};
  Vec3 by_a = {}, by_b = {}, by_c = {};
  Real by_q[4] = {}, along = {};
  if (any_touched) {
    d = disc(r, i);
    auto raw = [&](const Real* g) {
      return Vec3{d.k * (g[1] - g[0] * r.cx) / r.fx, d.k * (g[2] - g[0] * r.cy) / r.fy, d.k * g[0]};
    };
    determinant *= d.k;
    Vec3 g0 = (Real() + 1 / refgs::UNIT) * raw(n[0]), g1 = (Real() + 1 / refgs::UNIT) * raw(n[1]), g2 = raw(n[2]) + determinant * d.c;
    by_a = cross(g1, d.c) + cross(d.b, g2);
    by_b = cross(d.c, g0) + cross(g2, d.a);
    by_c = cross(g0, d.b) + cross(d.a, g1) + determinant * d.n2;
    by_c.x += x * r.fx / d.c.z, by_c.y += y * r.fy / d.c.z;
    by_c.z += depth - (x * r.fx * d.c.x + y * r.fy * d.c.y) / (d.c.z * d.c.z);

    Vec3 g = rotate_back(r.view, d.scale_u * by_a), h = rotate_back(r.view, d.scale_v * by_b);
    Real qw = d.q[0], qx = d.q[1], qy = d.q[2], qz = d.q[3];
    by_q[0] = 2 * (qz * g.y - qy * g.z - qz * h.x + qx * h.z);
    by_q[1] = 2 * (qy * g.y + qz * g.z + qy * h.x - 2 * qx * h.y + qw * h.z);
    by_q[2] = 2 * (-2 * qy * g.x + qx * g.y - qw * g.z + qx * h.x + qz * h.z);
    by_q[3] = 2 * (-2 * qz * g.x + qw * g.y + qx * g.z - qw * h.x - 2 * qz * h.y + qy * h.z);
    for (int j = 0; j < 4; j++) along += by_q[j] * d.q[j];
  }
  Vec3 position = rotate_back(r.view, by_c);
  put(r.by_positions, 3, 0, position.x), put(r.by_positions, 3, 1, position.y), put(r.by_positions, 3, 2, position.z);
  put(r.by_scales, 2, 0, dot(by_a, d.u)), put(r.by_scales, 2, 1, dot(by_b, d.v));
  put(r.by_opacities, 1, 0, log_opacity / i(r.opacities, 1, 0));
  for (int j = 0; j < 4; j++) put(r.by_rotations, 4, j, d.norm > 0 ? (by_q[j] - along * d.q[j]) / d.norm : Real());
}

}  // namespace

EXPORT int64_t refgs_tiles(int64_t width, int64_t height) { return ((width + TILE_X - 1) / TILE_X) * ((height + TILE_Y - 1) / TILE_Y); }
EXPORT int64_t refgs_projected_size() { return sizeof(Projected); }
EXPORT int64_t refgs_octagon_size() { return sizeof(Octagon); }
EXPORT int64_t refgs_row_size(int64_t channels) { return GEOMETRY + padded(channels); }

// parallel
EXPORT void refgs_project(Raster* r) {
  for (int64_t i; (i = take(r->shared.next, 256)) < r->splats;)
    for (int64_t j = i; j < i + 256 && j < r->splats; j += BATCH) project(*r, j);
}

// Order the visible splats by depth (in float, ties by index) and count the pairs.
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

// Counting scatter of the sorted splats into tiles.
EXPORT void refgs_bin(Raster* r) {
  int32_t* counts = r->reach;  // not in use yet
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

// Where each tile's rows begin, one for each member up to its reach, and how many there are.
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
