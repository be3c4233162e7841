// Projection of splats and their bounds in the image, in double; and derivatives from those by Splat's fields to the splats' parameters.
#pragma once

#include "raster.h"

// BATCH splats are processed at once, one a lane. On CUDA the bounds in the image are computed in float (Bound): most cards are slow with
// doubles.
#ifdef __CUDACC__
constexpr int BATCH = 1;
typedef Lane<double> Real;
typedef Lane<int32_t> Truth;
typedef Lane<float> Bound;
INLINE Bound bound(Real a) { return (float)a.value; }
INLINE Bound round_up(Bound a) { return ceilf(a.value); }
INLINE Real root(Real a) { return sqrt(a.value); }
INLINE Real inverse_root(Real a) { return rsqrt(a.value); }
INLINE double logarithm(float x) { return logf(x); }
#else
constexpr int BATCH = LANES / 2;
typedef double Real __attribute__((vector_size(8 * BATCH)));
typedef int64_t Truth __attribute__((vector_size(8 * BATCH)));
typedef Real Bound;
INLINE Bound bound(Real a) { return a; }
INLINE Bound round_up(Bound a) { return __builtin_elementwise_ceil(a); }
INLINE Bound round_down(Bound a) { return __builtin_elementwise_floor(a); }
INLINE Real root(Real a) { return __builtin_elementwise_sqrt(a); }
INLINE Real inverse_root(Real a) { return 1 / root(a); }
// Natural logarithm, to 2 ulp; of what is not positive, minus infinity. x = 2^e m with sqrt(1/2) <= m < sqrt(2), and
// log m = 2 artanh s = 2 (s + s^3/3 + s^5/5 + ...) with s = (m - 1) / (m + 1).
INLINE double logarithm(float x) {
  uint32_t bits;
  __builtin_memcpy(&bits, &x, sizeof x);
  int32_t e = (int32_t)(bits - 0x3f3504f3) >> 23;  // the bits of sqrt(1/2)
  bits -= (uint32_t)e << 23;
  float m;
  __builtin_memcpy(&m, &bits, sizeof m);
  double s = (m - 1.0) / (m + 1.0), square = s * s, sum = 1.0 / 19;
  for (int k = 17; k > 0; k -= 2) sum = sum * square + 1.0 / k;
  return x > 0 ? e * 0.69314718055994531 + 2 * s * sum : -__builtin_inf();
}
#endif
INLINE Real larger(Real a, Real b) { return a > b ? a : b; }
INLINE Real smaller(Real a, Real b) { return a < b ? a : b; }
INLINE Real magnitude(Real a) { return a < 0 ? -a : a; }

struct Vec3 {
  Real x, y, z;
};
INLINE Vec3 operator+(Vec3 a, Vec3 b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
INLINE Vec3 operator*(Real s, Vec3 a) { return {s * a.x, s * a.y, s * a.z}; }
INLINE Real dot(Vec3 a, Vec3 b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
INLINE Vec3 cross(Vec3 a, Vec3 b) { return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x}; }

// A batch of splats. (p, stride, k) loads number k of each splat from an array with `stride` floats a splat. Lanes past the last splat
// repeat it.
struct Batch {
  int64_t first, last;
  MEMBER int64_t operator[](int lane) const { return first + lane < last ? first + lane : last; }
  MEMBER Real operator()(const float* p, int stride, int k) const {
    Real v;
    for (int lane = 0; lane < BATCH; lane++) v[lane] = p[(*this)[lane] * stride + k];
    return v;
  }
};

// Splats in camera space: centre c, axes a = s_u t_u and b = s_v t_v; their homographies (see Splat) without the factors k and UNIT.
struct Disc {
  Real q[4], per_norm;  // unit quaternion; the factor that normalised it, 0 for one of zero length, which stands for the identity
  Vec3 u, v;            // unit tangents, camera space
  Real scale_u, scale_v;
  Vec3 a, b, c;
  Real per_z;           // 1 / c.z
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

constexpr double MIN_NORM = 1e-12;  // a shorter quaternion stands for the identity

INLINE Disc disc(const Scene& r, Batch i) {
  Disc d;
  Real q[4], square = {};
  for (int k = 0; k < 4; k++) q[k] = i(r.rotations, 4, k), square += q[k] * q[k];
  d.per_norm = square >= MIN_NORM * MIN_NORM ? inverse_root(square) : Real();
  for (int k = 0; k < 4; k++) d.q[k] = d.per_norm > 0 ? q[k] * d.per_norm : Real() + (k == 0);
  Real w = d.q[0], x = d.q[1], y = d.q[2], z = d.q[3];
  d.u = rotate(r.view, {1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)});
  d.v = rotate(r.view, {2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)});
  d.scale_u = i(r.scales, 2, 0), d.scale_v = i(r.scales, 2, 1);
  d.a = d.scale_u * d.u, d.b = d.scale_v * d.v;
  d.c = rotate(r.view, {i(r.positions, 3, 0), i(r.positions, 3, 1), i(r.positions, 3, 2)}) +
        Vec3{Real() + r.view[3], Real() + r.view[7], Real() + r.view[11]};
  d.per_z = 1 / d.c.z;

  d.n0 = cross(d.b, d.c), d.n1 = cross(d.c, d.a), d.n2 = cross(d.a, d.b);
  d.determinant = dot(d.c, d.n2);
  // The factor k scales the coefficients of Eq. 4 to the order of one and makes the determinant positive. It is 0 for a degenerate disc.
  double per_fx = 1 / r.fx, per_fy = 1 / r.fy;
  Real height = magnitude(d.determinant) * d.per_z, largest = height;
  const Vec3 rows[] = {d.n0, d.n1, d.n2};
  for (Vec3 n : rows) largest = larger(largest, larger(magnitude(n.x) * per_fx, magnitude(n.y) * per_fy));
  Truth proper = (largest > 0) & (height > 1e-18 * largest);
  d.k = proper ? (d.determinant < 0 ? Real() - 1 : Real() + 1) / largest : Real();
  return d;
}

// Bounds along an image axis of the image of {c + u a + v b: u^2 + v^2 <= k2}, relative to the image of c. The set must be wholly in front
// of the camera. The bounds are tangents to the outline, which is a conic. `a` and `b` are the vectors' homogeneous coordinates along the
// axis, az and bz their depths, relative to c at 0; `zz` < 0.
INLINE void extent(Bound a, Bound b, Bound az, Bound bz, Bound k2, Bound zz, Bound per_zz, Bound& low, Bound& high) {
  Bound uz = k2 * (a * az + b * bz), uu = k2 * (a * a + b * b), side = root(uz * uz - uu * zz);
  low = (uz + side) * per_zz, high = (uz - side) * per_zz;
}

// Fill `projected` for the visible splats of a batch. Call each(i, octagon, depth) for all splats; the octagon is empty for invisible ones.
template <class Each>
INLINE void project(const Scene& r, int64_t first, Each each) {
  Batch i = {first, r.splats - 1};
  Disc d = disc(r, i);
  Real log_opacity;
  for (int lane = 0; lane < BATCH; lane++) log_opacity[lane] = logarithm(r.opacities[i[lane]]);
  Real rho_max = log_opacity - logarithm(refgs::ALPHA_CUT);
  Truth visible = (d.c.z >= r.near) & (d.c.z <= refgs::FAR) & (rho_max >= 0), proper = ~(d.k == 0);

  Real k2 = 2 * rho_max, slopes = d.a.z * d.a.z + d.b.z * d.b.z, zz = k2 * slopes - d.c.z * d.c.z, ahead = d.c.z - r.near;
  Truth whole = ahead * ahead >= k2 * slopes, cut = visible & proper & ~whole;
  bool some_cut = false;
  for (int lane = 0; lane < BATCH; lane++) some_cut |= cut[lane] != 0;
  Real px[4], py[4];  // for a disc that the near plane cuts: projected corners of a rectangle around its front part
  if (some_cut) {
    Real slope = root(slopes), reach = root(k2), eu = d.a.z / slope, ev = d.b.z / slope;
    for (int j = 0; j < 4; j++) {
      Real t = j & 1 ? reach : -ahead / slope, s = j & 2 ? reach : -reach;
      Vec3 corner = d.c + (t * eu - s * ev) * d.a + (t * ev + s * eu) * d.b;
      corner.z = larger(corner.z, Real() + r.near);
      px[j] = r.fx * corner.x / corner.z + r.cx, py[j] = r.fy * corner.y / corner.z + r.cy;
    }
  }
  // Along the octagon's axes x, y, x + y, x - y: the projected centre, a and b relative to it, and the reach of the low-pass filter.
  Real from_x = d.c.x * d.per_z, from_y = d.c.y * d.per_z, x = r.fx * from_x + r.cx, y = r.fy * from_y + r.cy;
  Bound ax = bound(r.fx * (d.a.x - from_x * d.a.z)), ay = bound(r.fy * (d.a.y - from_y * d.a.z)), az = bound(d.a.z);
  Bound bx = bound(r.fx * (d.b.x - from_x * d.b.z)), by = bound(r.fy * (d.b.y - from_y * d.b.z)), bz = bound(d.b.z);
  const Bound as[] = {ax, ay, ax + ay, ax - ay}, bs[] = {bx, by, bx + by, bx - by};
  const Bound centres[] = {bound(x), bound(y), bound(x + y), bound(x - y)};
  const float diagonal[] = {1, 1, (float)refgs::UNIT, (float)refgs::UNIT}, first_pixel[] = {0.5f, 0.5f, 1, 0};  // first pixel's centre
  const float LIMIT = 32767, lowest[] = {0, 0, -LIMIT, -LIMIT}, highest[] = {r.width - 1.0f, r.height - 1.0f, LIMIT, LIMIT};
  Bound bound_k2 = bound(k2), radius = root(bound_k2 * (1 / refgs::LOW_PASS)), bound_zz = bound(zz), per_zz = 1 / bound_zz;
  Bound lows[4], highs[4];
#pragma unroll
  for (int j = 0; j < 4; j++) {
    Bound low = -radius * diagonal[j], high = radius * diagonal[j], a, b;
    auto include = [&](Truth where, Bound a, Bound b) {
      low = (where & (a < low)) ? a : low;
      high = (where & (b > high)) ? b : high;
    };
    extent(as[j], bs[j], az, bz, bound_k2, bound_zz, per_zz, a, b);
    include(proper & whole, a, b);
    Bound slack = 1e-6f * (larger(centres[j], -centres[j]) + high - low) + 1 / 64.0f;  // covers rounding in float
    low += centres[j], high += centres[j];
    if (some_cut)
      for (int k = 0; k < 4; k++) {
        Bound at = bound(j == 0 ? px[k] : j == 1 ? py[k] : j == 2 ? px[k] + py[k] : px[k] - py[k]);
        include(cut, at, at);
      }
    low = round_up(low - first_pixel[j] - slack), high = round_down(high - first_pixel[j] + slack);
    lows[j] = smaller(larger(low, Bound() + lowest[j]), Bound() + LIMIT);
    highs[j] = smaller(larger(high, Bound() - LIMIT), Bound() + highest[j]);
  }

  Vec3 rows[] = {d.k * (1 / refgs::UNIT) * d.n0, d.k * (1 / refgs::UNIT) * d.n1, d.k * d.n2};
  double per_fx = 1 / r.fx, per_fy = 1 / r.fy;
  Real slope_x[3], slope_y[3], value[3];
  for (int j = 0; j < 3; j++) {
    slope_x[j] = rows[j].x * per_fx, slope_y[j] = rows[j].y * per_fy;
    value[j] = rows[j].z - slope_x[j] * r.cx - slope_y[j] * r.cy;
  }
  Real determinant = d.determinant * d.k;
  Real n2_min = proper ? larger(determinant * (1 / refgs::FAR), Real() + 1e-18) : Real() + 1,
       n2_max = proper ? determinant * (1 / r.near) : Real() - 1;
  for (int lane = 0; lane < BATCH && first + lane < r.splats; lane++) {
    Octagon o = {0, -1};
    if (!visible[lane]) {
      each(first + lane, o, 0.0f);
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
    each(first + lane, o, (float)d.c.z[lane]);
  }
}

// Derivatives of a batch: by value, x slope and y slope of n0, n1 and n2, with the origin at the image's corner; and by the other fields.
struct Sums {
  Real n[3][3], determinant, x, y, depth, log_opacity;
  Truth touched;  // whether any tile gave derivatives
};

// Carry the derivatives `sums` through the projection to the splats' parameters.
INLINE void carry(const Scene& r, int64_t first, const Sums& sums) {
  Batch i = {first, r.splats - 1};
  bool any_touched = false;
  for (int lane = 0; lane < BATCH; lane++) any_touched |= sums.touched[lane] != 0;
  auto put = [&](float* p, int stride, int k, Real v) {
    v = sums.touched ? smaller(Real() + 3.4028234e38, larger(Real() - 3.4028234e38, v)) : Real();  // this order of arguments keeps a NaN
    for (int lane = 0; lane < BATCH && first + lane < r.splats; lane++) p[(first + lane) * stride + k] = (float)v[lane];
  };
  Disc d = {};
  Vec3 by_a = {}, by_b = {}, by_c = {};
  Real by_q[4] = {}, along = {};
  if (any_touched) {
    d = disc(r, i);
    double per_fx = 1 / r.fx, per_fy = 1 / r.fy;
    auto raw = [&](const Real* g) { return Vec3{d.k * (g[1] - g[0] * r.cx) * per_fx, d.k * (g[2] - g[0] * r.cy) * per_fy, d.k * g[0]}; };
    Real determinant = sums.determinant * d.k, x = sums.x * r.fx * d.per_z, y = sums.y * r.fy * d.per_z;
    Vec3 g0 = (Real() + 1 / refgs::UNIT) * raw(sums.n[0]), g1 = (Real() + 1 / refgs::UNIT) * raw(sums.n[1]);
    Vec3 g2 = raw(sums.n[2]) + determinant * d.c;
    by_a = cross(g1, d.c) + cross(d.b, g2);
    by_b = cross(d.c, g0) + cross(g2, d.a);
    by_c = cross(g0, d.b) + cross(d.a, g1) + determinant * d.n2;
    by_c.x += x, by_c.y += y;
    by_c.z += sums.depth - (x * d.c.x + y * d.c.y) * d.per_z;

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
  put(r.by_opacities, 1, 0, sums.log_opacity / i(r.opacities, 1, 0));
  for (int j = 0; j < 4; j++) put(r.by_rotations, 4, j, (by_q[j] - along * d.q[j]) * d.per_norm);
}
