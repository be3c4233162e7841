// Product of a sparse matrix and a dense one of three columns: the light's prefilter. Rows and columns are texels of cubemaps in the order
// of their orbits (model/cubemap.py). The cube's 24 symmetries leave the matrix unchanged, so only the first row of each orbit is stored.
#include "vector.h"

namespace {

const int SYMMETRIES = 24, WIDTH = 3 * SYMMETRIES;

struct Product {
  int64_t orbits;                   // orbits of the rows, 24 rows each
  const int32_t *starts, *columns;  // (orbits + 1), where the numbers of each orbit's first row begin; their columns, grouped by symmetry
  const float* numbers;
  const int32_t* compositions;  // (24, 24): the symmetry that applies the row's, then the column's
  const float* dense;           // (columns, 3)
  const int32_t* rows;          // (24 orbits): where in `out` each row goes; null if rows stay in place
  float* out;                   // (24 orbits, 3)
  mutable Shared shared;

  MEMBER int64_t place(int64_t row) const { return rows ? rows[row] : row; }
};

#ifdef __CUDACC__
// One warp a row: its threads take numbers by turns, then add up their sums.
INLINE void product(const Product& p) {
  share(p.shared, 32 * SYMMETRIES * p.orbits, 32, [&](int64_t i) {
    int32_t row = i / 32, orbit = row / SYMMETRIES;
    float sum[3] = {};
    for (int32_t k = p.starts[orbit] + i % 32; k < p.starts[orbit + 1]; k += 32) {
      int32_t symmetry = p.columns[k] % SYMMETRIES;
      int32_t column = p.columns[k] - symmetry + p.compositions[SYMMETRIES * symmetry + row % SYMMETRIES];
      for (int c = 0; c < 3; c++) sum[c] += p.numbers[k] * p.dense[3 * column + c];
    }
    for (int c = 0; c < 3; c++) {
      for (int apart = 16; apart; apart /= 2) sum[c] += __shfl_xor_sync(~0u, sum[c], apart);
      if (i % 32 == c) p.out[3 * p.place(row) + c] = sum[c];
    }
  });
}
#else
constexpr int VECTORS = WIDTH / LANES, REST = WIDTH % LANES;  // an orbit's floats: whole vectors, and the rest
typedef float UnalignedFour __attribute__((vector_size(16), aligned(4)));
typedef float UnalignedRest __attribute__((vector_size(4 * (REST ? REST : LANES)), aligned(4)));

// Compute all rows of an orbit at once. Where the first row reads a texel of another orbit, the other rows read that texel's images.
INLINE void product(const Product& p) {
  const int64_t BATCH = 16;
  share(p.shared, p.orbits, BATCH, [&](int64_t i) {
    int64_t orbit = p.orbits - 1 - i;  // begin with the last orbits, which have most numbers
    Four sums[SYMMETRIES] = {};
    for (int32_t k = p.starts[orbit], end = p.starts[orbit + 1]; k < end;) {
      int32_t symmetry = p.columns[k] % SYMMETRIES;
      Vector run[VECTORS] = {};
      UnalignedRest rest = {};
      for (; k < end && p.columns[k] % SYMMETRIES == symmetry; k++) {
        const float* from = p.dense + 3 * (p.columns[k] - symmetry);
        for (int v = 0; v < VECTORS; v++) run[v] += p.numbers[k] * *(const UnalignedVector*)(from + v * LANES);
        if (REST) rest += p.numbers[k] * *(const UnalignedRest*)(from + VECTORS * LANES);
      }
      float images[WIDTH + 1];
      for (int v = 0; v < VECTORS; v++) *(UnalignedVector*)(images + v * LANES) = run[v];
      if (REST) *(UnalignedRest*)(images + VECTORS * LANES) = rest;
      for (int s = 0; s < SYMMETRIES; s++) sums[s] += *(const UnalignedFour*)(images + 3 * p.compositions[SYMMETRIES * symmetry + s]);
    }
    for (int s = 0; s < SYMMETRIES; s++)
      for (int c = 0; c < 3; c++) p.out[3 * p.place(SYMMETRIES * orbit + s) + c] = sums[s][c];
  });
}
#endif

}  // namespace

KERNEL(refgs_sparse_product, Product, p) { product(*p); }
