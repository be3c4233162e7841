// A step of Adam (Kingma and Ba 2015) for several tensors at once.
#include "library.h"
#include "vector.h"

namespace {

struct Learned {
  int64_t count;
  float *value, *mean, *square;  // running means of the gradient and of its square
  const float* gradient;
  double rate, square_scale;     // with the corrections of the means' start: α / (1 − β1^t), and 1 / √(1 − β2^t)
};

struct Adam {
  int64_t tensors;
  const Learned* learned;
  double beta1, beta2, epsilon;
  float* scratch;  // none is used
  Shared shared;
};

INLINE void step(const Adam& a, const Learned& t, int64_t i, int64_t n) {
  Vector g = read(t.gradient + i, n), m = read(t.mean + i, n), v = read(t.square + i, n);
  m += (float)(1 - a.beta1) * (g - m);
  v = (float)a.beta2 * v + (float)(1 - a.beta2) * (g * g);
  write(t.mean + i, m, n), write(t.square + i, v, n);
  write(t.value + i, read(t.value + i, n) - (float)t.rate * m / ((float)t.square_scale * root(v) + (float)a.epsilon), n);
}

}  // namespace

// parallel
EXPORT void refgs_adam_step(Adam* a) {
  const int64_t BATCH = 8192;  // numbers of a tensor
  int64_t wanted = take(a->shared.next, 1), passed = 0;
  for (int64_t t = 0; t < a->tensors; t++) {
    const Learned& l = a->learned[t];
    int64_t batches = (l.count + BATCH - 1) / BATCH;
    for (; wanted < passed + batches; wanted = take(a->shared.next, 1)) {
      int64_t first = (wanted - passed) * BATCH, end = first + BATCH < l.count ? first + BATCH : l.count;
      for (int64_t i = first; i < end; i += LANES) step(*a, l, i, end - i);
    }
    passed += batches;
  }
}
