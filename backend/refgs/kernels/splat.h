// One splat at one pixel: coverage, alpha, depth and their derivatives. All backends share this file, so that they agree. F is the number
// type: `float`, or a vector of floats with one pixel a lane.
//
// The includer provides, for its F: select(mask, a, b), exp2(x) = 2^x for -126 <= x <= 0, smaller(a, b), reciprocal(x).
#pragma once

#ifdef __CUDACC_RTC__
#define REFGS_INLINE __device__ __forceinline__
#else
#define REFGS_INLINE static inline __attribute__((always_inline))
#endif

namespace refgs {

constexpr float ALPHA_CUT = 1.0f / 255.0f;  // a splat ends where its alpha falls below this
constexpr float ALPHA_CAP = 0.99f;          // largest alpha of a splat: it never completely hides what is behind it
constexpr float MIN_TRANSMITTANCE = 1e-4f;  // a pixel is finished below this
// 1 / variance of the screen-space low-pass filter, in pixels^-2. 2DGS uses 2, which blurs (docs/notebook/approximations.md).
constexpr float LOW_PASS = 8.0f;
constexpr double UNIT = 1.4142135623730951;  // standard deviations in a unit of u and v, so that alpha = opacity e^-(u^2 + v^2)
constexpr double LOG2_E = 1.4426950408889634;
constexpr double FAR = 1e12;                // greater depths are not drawn: this keeps every product finite in float

// Three affine functions of the pixel: values at the origin, slopes along x and y. The fourth lane is padding.
struct alignas(16) Affine {
  float value[4], slope_x[4], slope_y[4];
};

// A splat localised to a tile: pixels (x, y) are relative to the middle of the tile. With M = [UNIT s_u t_u, UNIT s_v t_v, p] in camera
// space, Eq. 4 reads M (u, v, 1)^T = z (X, Y, 1)^T. So (n0, n1, n2) = k det(M) M^-1 (X, Y, 1)^T is affine in the pixel, and
// u = n0 / n2, v = n1 / n2, z = k det(M) / n2. The factor k is free.
//
// Near an edge-on view n2 is a small difference of large numbers, and single floats would lose the accuracy of u, v and z. Therefore
// n0, n1, n2 are sums of two parts. `high` is rounded so that it is computed without error at the half-integers of a tile; `low` is the
// remainder. Most discs do not need `low`, and do not meet the near plane or FAR within the tile. Such a disc is `plain`: it has no `low`,
// and every ray of the tile meets its plane.
struct Splat {
  Affine high, low;
  float determinant;          // k det(M), >= 0
  float n2_min, n2_max;       // n2_min <= n2 <= n2_max: the ray meets the splat's plane between the near plane and FAR
  float x, y, depth;          // projected centre, and its depth
  float log2_opacity;
  float rho_max;              // alpha >= ALPHA_CUT  <=>  rho <= ln(opacity / ALPHA_CUT)
  int32_t plain;
};

template <class F>
REFGS_INLINE F affine(const Affine& a, int i, F x, F y) {
  return a.value[i] + a.slope_x[i] * x + a.slope_y[i] * y;
}

template <class F>
struct Hit {
  F u, v, inverse, dx, dy;  // `inverse` is 1 / n2; dx, dy are relative to the projected centre
  F rho, z;                 // alpha = opacity e^-rho: rho is half the squared distance in standard deviations; z is the depth
  decltype(F() < F()) on_plane, covered;
};

// rho = min(u^2 + v^2, LOW_PASS |pixel - centre|^2 / 2), with the low-pass filter of 2DGS. The first gives the depth on the plane, the
// second that of the centre. Where the ray misses the plane, or meets it nearer than the near plane, only the low-pass filter remains: an
// edge-on splat is a dot. Comparisons are written so that a NaN (0/0 at a horizon) counts as a miss.
//
// PLAIN: the splat is known to be plain when compiling. Otherwise `s.plain` is read.
template <bool PLAIN, class F>
REFGS_INLINE Hit<F> intersect(const Splat& s, F x, F y) {
  Hit<F> h;
  F n0 = affine(s.high, 0, x, y);
  F n1 = affine(s.high, 1, x, y);
  F n2 = affine(s.high, 2, x, y);
  if (!PLAIN && !s.plain) {
    n0 += affine(s.low, 0, x, y);
    n1 += affine(s.low, 1, x, y);
    n2 += affine(s.low, 2, x, y);
  }
  h.inverse = reciprocal(n2);
  h.u = n0 * h.inverse;
  h.v = n1 * h.inverse;
  h.dx = x - s.x;
  h.dy = y - s.y;
  F plane = h.u * h.u + h.v * h.v;
  F screen = LOW_PASS / 2 * (h.dx * h.dx + h.dy * h.dy);
  h.on_plane = plane <= screen;
  if (!PLAIN && !s.plain) h.on_plane &= (n2 >= s.n2_min) & (n2 <= s.n2_max);
  h.rho = select(h.on_plane, plane, screen);
  h.z = select(h.on_plane, s.determinant * h.inverse, s.depth - F());
  h.covered = h.rho <= s.rho_max;
  return h;
}

// Alpha before the cap. It is arbitrary, even NaN, where the splat doesn't cover the pixel.
template <class F>
REFGS_INLINE F uncapped_alpha(const Splat& s, const Hit<F>& h) {
  return exp2(s.log2_opacity - (float)LOG2_E * h.rho);
}

template <class F>
REFGS_INLINE F cap(F alpha) {
  return smaller(alpha, F() + ALPHA_CAP);
}

// Derivatives of the loss by Splat's fields, at one pixel. Those by n0, n1, n2 are by their values at the pixel.
template <class F>
struct Derivative {
  F log_opacity, n0, n1, n2, determinant;  // n0, n1, n2, determinant: zero where the low-pass filter draws the splat
  F by_z;                                  // by z: the derivative by the centre's depth where the low-pass filter draws the splat
};

// Differentiate, given the uncapped alpha and the derivatives by the capped alpha and by z. These three must be zero where the splat
// doesn't cover the pixel.
template <class F>
REFGS_INLINE Derivative<F> differentiate(const Hit<F>& h, F uncapped_alpha, F by_alpha, F by_z) {
  Derivative<F> d;
  F zero = F();
  d.log_opacity = select(uncapped_alpha < ALPHA_CAP, uncapped_alpha * by_alpha, zero);  // equals the derivative by -rho
  d.by_z = by_z;
  F inverse = select(h.on_plane, h.inverse, zero);
  F twice = 2.0f * d.log_opacity, scale = -twice * inverse;
  d.n0 = select(h.on_plane, scale * h.u, zero);
  d.n1 = select(h.on_plane, scale * h.v, zero);
  d.n2 = inverse * (twice * h.rho - by_z * h.z);
  d.determinant = by_z * inverse;
  return d;
}

// Derivatives by the projected centre's x, y and depth: zero except where the low-pass filter draws the splat.
template <class F>
REFGS_INLINE void differentiate_screen(const Hit<F>& h, const Derivative<F>& d, F& by_x, F& by_y, F& by_depth) {
  F zero = F();
  F scale = select(h.on_plane, zero, LOW_PASS * d.log_opacity);
  by_x = scale * h.dx;
  by_y = scale * h.dy;
  by_depth = select(h.on_plane, zero, d.by_z);
}

}  // namespace refgs
