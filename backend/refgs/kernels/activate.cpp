// Activations: raw parameters to values, and derivatives back, element by element for several tensors in one call.
#include "vector.h"

namespace {

enum Kind : int64_t { EXP, SIGMOID, SMOOTHSTEP };  // SMOOTHSTEP is 3 s² − 2 s³, s = sigmoid(raw)

struct Activation {
  int64_t count, kind;
  const float* raw;
  float* value;
  const float* by_value;
  float* by_raw;
};

constexpr int MOST = 8;  // tensors

struct Activate {
  int64_t tensors;
  Activation activations[MOST];
  mutable Shared shared;
};

constexpr float LOG2_E = 1.4426950f, LN_2_HIGH = 0.693359375f, LN_2_LOW = -2.1219444e-4f;  // ln 2 in two parts; k LN_2_HIGH is exact

// e^x = 2^k e^r, with x clamped to [-87, 87]. A NaN is passed through: exp2 would turn some NaNs into numbers.
INLINE Vector exponential(Vector x) {
  Vector within = clamp(x, -87, 87), k = round_down(within * LOG2_E + 0.5f), r = within - k * LN_2_HIGH - k * LN_2_LOW;
  return select(x == x, exp2(k) * exp2(r * LOG2_E), x);
}

INLINE Vector logistic(Vector x) { return 1.0f / (1.0f + exponential(-x)); }

}  // namespace

KERNEL(refgs_activate_forward, Activate, a) {
  share_vectors(a->shared, a->activations, a->tensors, [](const Activation& v, int64_t i, int64_t n) {
    Vector raw = read(v.raw + i, n), s = v.kind == EXP ? exponential(raw) : logistic(raw);
    write(v.value + i, v.kind == SMOOTHSTEP ? s * s * (3.0f - 2.0f * s) : s, n);
  });
}

KERNEL(refgs_activate_backward, Activate, a) {
  share_vectors(a->shared, a->activations, a->tensors, [](const Activation& v, int64_t i, int64_t n) {
    Vector s = v.kind == SMOOTHSTEP ? logistic(read(v.raw + i, n)) : read(v.value + i, n), change = s * (1.0f - s);
    Vector slope = v.kind == EXP ? s : v.kind == SIGMOID ? change : 6.0f * change * change;
    write(v.by_raw + i, read(v.by_value + i, n) * slope, n);
  });
}
