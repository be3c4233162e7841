// A sparse matrix times a dense one of three columns: the light's prefilter.
#include "vector.h"

namespace {

struct Product {
  int64_t rows;
  const int32_t *starts, *columns;  // (rows + 1), of the numbers of each row; their columns
  const float *numbers, *dense;     // (columns, 3), and one float more that may be read
  float* out;                       // (rows, 3)
  float* scratch;                   // none is used
  mutable Shared shared;
};

#ifdef __CUDACC__
// A warp a row: its threads take numbers by turns, then add up what they have.
INLINE void product(const Product& p) {
  share(p.shared, 32 * p.rows, 32, [&](int64_t i) {
    int64_t row = i / 32;
    float sum[3] = {};
    for (int32_t k = p.starts[row] + i % 32; k < p.starts[row + 1]; k += 32)
      for (int c = 0; c < 3; c++) sum[c] += p.numbers[k] * p.dense[3 * p.columns[k] + c];
    for (int c = 0; c < 3; c++) {
      for (int apart = 16; apart; apart /= 2) sum[c] += __shfl_xor_sync(~0u, sum[c], apart);
      if (i % 32 == c) p.out[3 * row + c] = sum[c];
    }
  });
}
#else
typedef float UnalignedFour __attribute__((vector_size(16), aligned(4)));

INLINE void product(const Product& p) {
  const int64_t BATCH = 64, AT_ONCE = 4;  // sums that do not wait for each other
  share(p.shared, p.rows, BATCH, [&](int64_t row) {
    Four sums[AT_ONCE] = {};
    int32_t k = p.starts[row], end = p.starts[row + 1];
    for (; k + AT_ONCE <= end; k += AT_ONCE)
      for (int i = 0; i < AT_ONCE; i++) sums[i] += p.numbers[k + i] * *(const UnalignedFour*)(p.dense + 3 * p.columns[k + i]);
    for (; k < end; k++) sums[0] += p.numbers[k] * *(const UnalignedFour*)(p.dense + 3 * p.columns[k]);
    Four sum = (sums[0] + sums[1]) + (sums[2] + sums[3]);
    for (int c = 0; c < 3; c++) p.out[3 * row + c] = sum[c];
  });
}
#endif

}  // namespace

KERNEL(refgs_sparse_product, Product, p) { product(*p); }
