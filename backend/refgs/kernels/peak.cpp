// Peak arithmetic rate of this processor: benchmarks compare the other kernels with it.
#include "vector.h"

namespace {

struct Peak {
  int64_t rounds;
  float* out;  // (1): never written, but it keeps the compiler from removing the loop
  mutable Shared shared;
};

constexpr int CHAINS = 12;  // independent products and sums, to hide latency

}  // namespace

// A round is 1000 × CHAINS × LANES products and as many sums.
KERNEL(refgs_peak, Peak, p) {
  Vector chains[CHAINS];
  for (int i = 0; i < CHAINS; i++) chains[i] = Vector() + (float)i;
  Vector factor = Vector() + 0.999f, term = Vector() + 1e-3f;
  share(p->shared, p->rounds, 1, [&](int64_t) {
    for (int k = 0; k < 1000; k++)
#pragma unroll
      for (int i = 0; i < CHAINS; i++) chains[i] = chains[i] * factor + term;
  });
  Vector sum = {};
  for (int i = 0; i < CHAINS; i++) sum += chains[i];
  if (total(sum) < 0) *p->out = total(sum);
}

EXPORT int64_t refgs_peak_round() { return 1000ll * CHAINS * LANES * 2; }
