// Splats to the picture's tiles: project, sort by depth, bin. And back: derivatives from the tiles to the splats' parameters.
#include "raster.h"

namespace {

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
  r.octagons[i].x0 = 0, r.octagons[i].x1 = -1;
  Disc d = disc(r, i);
  double log_opacity = __builtin_log(r.opacities[i]), rho_max = log_opacity - __builtin_log(refgs::ALPHA_CUT);
  if (!(d.c.z >= r.near && d.c.z <= refgs::FAR && rho_max >= 0)) return;
  p.x = r.fx * d.c.x / d.c.z + r.cx;
  p.y = r.fy * d.c.y / d.c.z + r.cy;
  p.depth = d.c.z;
  __builtin_memcpy(r.keys + 2 * r.splats + i, &p.depth, 4);  // a positive float's bits are in its order
  p.log2_opacity = log_opacity * refgs::LOG2_E;
  p.rho_max = rho_max;

  Vec3 n0 = cross(d.b, d.c), n1 = cross(d.c, d.a), n2 = cross(d.a, d.b);
  double determinant = dot(d.c, n2);
  double k = normaliser(r, d, n0, n1, n2, determinant);
  const Vec3 rows[] = {n0, n1, n2};
  for (int j = 0; j < 3; j++) {
    double scale = j < 2 ? k / refgs::UNIT : k;
    p.slope_x[j] = scale * rows[j].x / r.fx, p.slope_y[j] = scale * rows[j].y / r.fy;
    p.value[j] = scale * rows[j].z - p.slope_x[j] * r.cx - p.slope_y[j] * r.cy;
  }
  determinant *= k;
  p.determinant = determinant;
  p.n2_min = k != 0 ? larger(determinant / refgs::FAR, 1e-18) : 1;
  p.n2_max = k != 0 ? determinant / r.near : -1;

  // The octagon's axes x, y, x + y, x - y, as coefficients of homogeneous coordinates; how far the screen-space filter reaches.
  const Quad mx = {r.fx, 0, r.fx, r.fx}, my = {0, r.fy, r.fy, -r.fy}, mz = {r.cx, r.cy, r.cx + r.cy, r.cx - r.cy};
  auto axes = [&](Vec3 p) { return mx * p.x + my * p.y + mz * p.z; };
  double k2 = 2 * rho_max, radius = __builtin_sqrt(k2 / refgs::LOW_PASS), reach = __builtin_sqrt(k2);
  const Quad diagonal = {1, 1, 1.4142135623730951, 1.4142135623730951}, centre = axes(d.c) / d.c.z;
  Quad low = centre - radius * diagonal, high = centre + radius * diagonal;
  auto include = [&](Quad a, Quad b) { low = a < low ? a : low, high = b > high ? b : high; };
  double slope = __builtin_sqrt(d.a.z * d.a.z + d.b.z * d.b.z);  // of z over the disc, along (d.a.z, d.b.z)
  if (k != 0 && d.c.z - reach * slope >= r.near) {
    Quad first, last;
    extent(axes(d.a), axes(d.b), axes(d.c), d, k2, first, last);
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
  Octagon& o = r.octagons[i];
  o.x0 = larger(integer(low[0]), 0), o.x1 = lesser(integer(high[0]), r.width - 1);
  o.y0 = larger(integer(low[1]), 0), o.y1 = lesser(integer(high[1]), r.height - 1);
  o.sum0 = integer(low[2]), o.sum1 = integer(high[2]), o.difference0 = integer(low[3]), o.difference1 = integer(high[3]);
  if (o.y1 < o.y0) o.x1 = o.x0 - 1;
  p.octagon = o;
}

float finite(double x) { return (float)lesser(larger(x, -3.4028234e38), 3.4028234e38); }

void prefetch(const Raster& r, int64_t i) {
  int64_t stride = GEOMETRY + padded(r.channels);
  const int32_t* place = r.places + r.splat_start[i];
  each_tile(r, r.octagons[i], [&](int64_t tile, int, int) {
    const float* row = r.rows + (r.row_start[tile] + *place++) * stride;
    for (int64_t c = 0; c < stride; c += 16) __builtin_prefetch(row + c);
  });
}

// Add up a splat's rows, and carry the derivatives from its projection to its parameters.
void gather(const Raster& r, int64_t i) {
  int64_t channels = r.channels, stride = GEOMETRY + padded(channels);
  double n[3][3] = {}, determinant = 0, x = 0, y = 0, depth = 0, log_opacity = 0;
  float* __restrict by_features = r.by_splat_features + i * channels;
  for (int64_t c = 0; c < channels; c++) by_features[c] = 0;
  bool touched = false;
  const int32_t* place = r.places + r.splat_start[i];
  each_tile(r, r.octagons[i], [&](int64_t tile, int tx, int ty) {
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
    determinant += row[9], x += row[10], y += row[11], depth += row[12], log_opacity += row[13];
    for (int64_t c = 0; c < channels; c++) by_features[c] += row[GEOMETRY + c];
  });
  float *by_position = r.by_positions + 3 * i, *by_rotation = r.by_rotations + 4 * i, *by_scale = r.by_scales + 2 * i;
  by_position[0] = by_position[1] = by_position[2] = 0;
  by_rotation[0] = by_rotation[1] = by_rotation[2] = by_rotation[3] = 0;
  by_scale[0] = by_scale[1] = r.by_opacities[i] = 0;
  if (!touched) return;
  r.by_opacities[i] = finite(log_opacity / r.opacities[i]);

  Disc d = disc(r, i);
  Vec3 v0 = cross(d.b, d.c), v1 = cross(d.c, d.a), v2 = cross(d.a, d.b);
  double k = normaliser(r, d, v0, v1, v2, dot(d.c, v2));
  auto raw = [&](const double* g) {
    return Vec3{k * (g[1] - g[0] * r.cx) / r.fx, k * (g[2] - g[0] * r.cy) / r.fy, k * g[0]};
  };
  determinant *= k;
  Vec3 g0 = 1 / refgs::UNIT * raw(n[0]), g1 = 1 / refgs::UNIT * raw(n[1]), g2 = raw(n[2]) + determinant * d.c;
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
EXPORT int64_t refgs_octagon_size() { return sizeof(Octagon); }
EXPORT int64_t refgs_row_size(int64_t channels) { return GEOMETRY + padded(channels); }

// parallel
EXPORT void refgs_project(Raster* r) {
  for (int64_t i; (i = take(r->shared.next, 256)) < r->splats;)
    for (int64_t j = i; j < i + 256 && j < r->splats; j++) project(*r, j);
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
  const int BATCH = 32;  // splats whose rows are on their way while the ones before are added up
  for (int64_t i; (i = take(r->shared.next, BATCH)) < r->splats;) {
    int64_t end = i + BATCH < r->splats ? i + BATCH : r->splats;
    for (int64_t j = i; j < end; j++) prefetch(*r, j);
    for (int64_t j = i; j < end; j++) gather(*r, j);
  }
}
