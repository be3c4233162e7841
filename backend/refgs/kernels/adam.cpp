// Adam's step (Kingma and Ba 2015) for several tensors in one call. Elements with a zero gradient keep their value and moments: they
// belong to surfels that this view does not see. Plain Adam would move them by the moments of earlier views.
#include "vector.h"

namespace {

struct Learned {
  int64_t count;
  float *value, *mean, *square;  // running means of the gradient and of its square
  const float* gradient;
  double rate, square_scale;     // with bias correction: α / (1 − β1^t), and 1 / √(1 − β2^t)
  double low, high;              // values are clamped to this range
};

constexpr int MOST = 16;  // tensors

struct Adam {
  int64_t tensors;
  Learned learned[MOST];
  double beta1, beta2, epsilon;
  const float* accepted;  // (1): zero skips the step; or null
  mutable Shared shared;
};

INLINE void step(const Adam& a, const Learned& t, int64_t i, int64_t n) {
  Vector g = read(t.gradient + i, n);
  Mask felt = ~(g == 0.0f);  // true for a NaN: it must not go unnoticed
  if (!any(felt)) return;
  Vector m = read(t.mean + i, n), v = read(t.square + i, n), x = read(t.value + i, n);
  Vector mean = m + (float)(1 - a.beta1) * (g - m);
  Vector square = (float)a.beta2 * v + (float)(1 - a.beta2) * (g * g);
  Vector value = x - (float)t.rate * mean / ((float)t.square_scale * root(square) + (float)a.epsilon);
  write(t.mean + i, select(felt, mean, m), n), write(t.square + i, select(felt, square, v), n);
  Vector low = Vector() + (float)t.low, high = Vector() + (float)t.high;
  value = select(value < low, low, select(value > high, high, value));
  write(t.value + i, select(felt, value, x), n);
}

}  // namespace

KERNEL(refgs_adam_step, Adam, a) {
  if (a->accepted && !*a->accepted) return;
  share_vectors(a->shared, a->learned, a->tensors, [&](const Learned& l, int64_t i, int64_t n) { step(*a, l, i, n); });
}
