// The CPU's number type: LANES floats. It uses the compiler's vector extensions, so that one source serves every instruction set.
#pragma once

#include "library.h"

#ifdef __CUDACC__
#include "lane.h"
#else

#if defined(__AVX512F__)
#define LANES 16
#elif defined(__AVX2__)
#define LANES 8
#else
#define LANES 4
#endif

typedef float Vector __attribute__((vector_size(4 * LANES)));
typedef int32_t Mask __attribute__((vector_size(4 * LANES)));
typedef float UnalignedVector __attribute__((vector_size(4 * LANES), aligned(4)));

#define MEMBER inline __attribute__((always_inline))
#define INLINE static MEMBER

typedef float Four __attribute__((vector_size(16)));
typedef double Sum __attribute__((vector_size(8 * LANES)));  // accumulates many vectors

INLINE Vector select(Mask mask, Vector a, Vector b) { return mask ? a : b; }
INLINE Vector smaller(Vector a, Vector b) { return a < b ? a : b; }
INLINE Vector larger(Vector a, Vector b) { return a > b ? a : b; }
INLINE Mask select(Mask mask, Mask a, Mask b) { return mask ? a : b; }
INLINE Vector root(Vector x) { return __builtin_elementwise_sqrt(x); }
INLINE float root(float x) { return __builtin_sqrtf(x); }
INLINE double root(double x) { return __builtin_sqrt(x); }
INLINE Vector round_down(Vector x) { return __builtin_elementwise_floor(x); }
template <class To, class From>
INLINE To convert(From v) {
  return __builtin_convertvector(v, To);
}
INLINE Mask bits(Vector v) { return (Mask)v; }
INLINE Vector from_bits(Mask m) { return (Vector)m; }
INLINE float total(Vector x) {
  float sum = 0;
  for (int i = 0; i < LANES; i++) sum += x[i];
  return sum;
}
INLINE bool any(Mask mask) { return __builtin_reduce_or(mask) != 0; }
INLINE Vector load(const float* p) { return *(const UnalignedVector*)p; }
INLINE void store(float* p, Vector v) { *(UnalignedVector*)p = v; }
INLINE void store(int32_t* p, Mask v) { __builtin_memcpy(p, &v, sizeof v); }

// 1/x to about 1 ulp, for magnitudes from 1e-37 to 1e37. Beyond, a NaN may replace an infinity.
INLINE Vector reciprocal(Vector x) {
#if LANES == 16  // an estimate to 2^-14 and a Newton step: a division of 16 numbers would block the arithmetic for four times as long
  Vector r = (Vector)__builtin_ia32_rcp14ps512_mask(x, Vector(), 0xffff);
  Vector error = 1.0f - x * r;
  return r + r * error;
#else
  return 1.0f / x;
#endif
}

// 1/sqrt(x) to about 2 ulp, for x from 1e-37 to 1e37.
INLINE Vector inverse_root(Vector x) {
#if LANES == 16  // estimate and Newton step, as above
  Vector r = (Vector)__builtin_ia32_rsqrt14ps512_mask(x, Vector(), 0xffff);
  return r + r * (0.5f - 0.5f * x * r * r);
#else
  return 1.0f / root(x);
#endif
}

// 2^x to 2.3 ulp for -126 <= x <= 126; garbage beyond, but no trap. 2^x = 2^round(x) 2^f with |f| <= 1/2. 2^f is approximated by the
// polynomial of degree 5 with the least error (9e-8) among those that are 1 at 0.
INLINE Vector exp2(Vector x) {
  const float ROUND = 12582912.0f;  // 1.5 * 2^23: adding it rounds to an integer, held in the low bits
  Vector shifted = x + ROUND;
  Vector f = x - (shifted - ROUND);
  Vector p = 0.0013264727f * f + 0.009671513f;
  p = p * f + 0.055507336f;
  p = p * f + 0.24022242f;
  p = p * f + 0.693147f;
  p = p * f + 1.0f;
  Mask exponent = ((Mask)shifted - (Mask)(Vector() + ROUND)) << 23;
  return (Vector)((Mask)p + exponent);
}

#if LANES == 8
INLINE Mask first_lanes(int64_t n) {
  Mask lane;
  for (int i = 0; i < LANES; i++) lane[i] = i;
  return lane < (int32_t)n;
}
#endif

// Load the first n lanes; the others are zero.
INLINE Vector read(const float* p, int64_t n) {
  if (n >= LANES) return load(p);
#if LANES == 16
  return __builtin_ia32_loadups512_mask(p, Vector(), (uint16_t)((1 << n) - 1));
#elif LANES == 8
  return __builtin_ia32_maskloadps256((const Vector*)p, first_lanes(n));
#else
  Vector v = {};
  for (int i = 0; i < n; i++) v[i] = p[i];
  return v;
#endif
}

INLINE void write(float* p, Vector v, int64_t n) {
  if (n >= LANES) return store(p, v);
#if LANES == 16
  __builtin_ia32_storeups512_mask(p, v, (uint16_t)((1 << n) - 1));
#elif LANES == 8
  __builtin_ia32_maskstoreps256((Vector*)p, first_lanes(n), v);
#else
  for (int i = 0; i < n; i++) p[i] = v[i];
#endif
}

INLINE void clear(float* p, int64_t n) {  // n: a multiple of LANES
  for (int64_t i = 0; i < n; i += LANES) store(p + i, Vector());
}

// Interleave the lower, or the upper, halves of two vectors lane by lane.
#if LANES == 16
#define INTERLEAVE(n) n, n + 16, n + 1, n + 17, n + 2, n + 18, n + 3, n + 19, n + 4, n + 20, n + 5, n + 21, n + 6, n + 22, n + 7, n + 23
#elif LANES == 8
#define INTERLEAVE(n) n, n + 8, n + 1, n + 9, n + 2, n + 10, n + 3, n + 11
#else
#define INTERLEAVE(n) n, n + 4, n + 1, n + 5
#endif
INLINE Vector interleave_low(Vector a, Vector b) { return __builtin_shufflevector(a, b, INTERLEAVE(0)); }
INLINE Vector interleave_high(Vector a, Vector b) { return __builtin_shufflevector(a, b, INTERLEAVE(LANES / 2)); }

// Lane k of the result is the sum of v[k]'s lanes; v is overwritten.
INLINE Vector sums(Vector (&v)[LANES]) {
#pragma unroll
  for (int n = LANES / 2; n; n /= 2)
#pragma unroll
    for (int i = 0; i < n; i++) v[i] = interleave_low(v[i], v[i + n]) + interleave_high(v[i], v[i + n]);
  return v[0];
}

INLINE void transpose(Vector (&v)[LANES]) {  // by log2(LANES) perfect shuffles
#pragma unroll
  for (int n = 1; n < LANES; n *= 2) {
    Vector w[LANES];
#pragma unroll
    for (int i = 0; i < LANES / 2; i++) {
      w[2 * i] = interleave_low(v[i], v[i + LANES / 2]);
      w[2 * i + 1] = interleave_high(v[i], v[i + LANES / 2]);
    }
#pragma unroll
    for (int i = 0; i < LANES; i++) v[i] = w[i];
  }
}
#endif

INLINE Vector clamp(Vector x, float low, float high) { return larger(smaller(x, Vector() + high), Vector() + low); }

struct Vectors {
  Vector x, y, z;
};
INLINE Vectors operator+(Vectors a, Vectors b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
INLINE Vectors operator-(Vectors a, Vectors b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
INLINE Vectors operator*(Vector s, Vectors a) { return {s * a.x, s * a.y, s * a.z}; }
INLINE Vector dot(Vectors a, Vectors b) { return a.x * b.x + a.y * b.y + a.z * b.z; }

// Call body(tensor, first, numbers) for each vector of several tensors, which have a `count`; the last vector of a tensor may be partial. A
// thread takes BATCH numbers of a tensor at a time.
template <class Tensor, class Body>
INLINE void share_vectors(Shared& shared, const Tensor* tensors, int64_t n, Body body) {
  constexpr int64_t BATCH = LANES == 1 ? 1 : 4096;
  auto batches = [&](int64_t t) { return (tensors[t].count + BATCH - 1) / BATCH; };
  int64_t all = 0;
  for (int64_t t = 0; t < n; t++) all += batches(t);
  share(shared, all, 1, [&](int64_t batch) {
    int64_t t = 0;
    for (; batch >= batches(t); t++) batch -= batches(t);
    int64_t first = batch * BATCH, end = first + BATCH < tensors[t].count ? first + BATCH : tensors[t].count;
    for (int64_t i = first; i < end; i += LANES) body(tensors[t], i, end - i);
  });
}
