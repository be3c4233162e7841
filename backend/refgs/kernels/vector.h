// The CPU's number type: LANES floats, in the compilers' vector extensions, so that one source serves every instruction set.
#pragma once

#include <stdint.h>

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

#define INLINE static inline __attribute__((always_inline))

INLINE Vector select(Mask mask, Vector a, Vector b) { return mask ? a : b; }
INLINE Vector smaller(Vector a, Vector b) { return a < b ? a : b; }
INLINE bool any(Mask mask) { return __builtin_reduce_or(mask) != 0; }
INLINE Vector load(const float* p) { return *(const UnalignedVector*)p; }
INLINE void store(float* p, Vector v) { *(UnalignedVector*)p = v; }

// exp(-x/2) for x >= 0 to 1.5 ulp; garbage, but no trap, for NaN. 2^t = 2^round(t) 2^f, |f| <= 1/2, the latter by its
// Chebyshev expansion of degree 6 (error 1e-9).
INLINE Vector exp_half(Vector x) {
  const float ROUND = 12582912.0f;  // 1.5 * 2^23: adding it rounds to an integer, held in the low bits
  Vector t = x * -0.72134752f;
  t = t > -126.0f ? t : Vector() - 126.0f;
  Vector shifted = t + ROUND;
  Vector f = t - (shifted - ROUND);
  Vector p = 0.00015461445f * f + 0.0013400428f;
  p = p * f + 0.009618057f;
  p = p * f + 0.055503272f;
  p = p * f + 0.24022651f;
  p = p * f + 0.6931472f;
  p = p * f + 1.0f;
  Mask exponent = ((Mask)shifted - (Mask)(Vector() + ROUND)) << 23;
  return (Vector)((Mask)p + exponent);
}
