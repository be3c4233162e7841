// A sparse matrix times a dense one of three columns: the light's prefilter. Both are over texels of cubemaps in the order of
// their orbits, and the cube's 24 symmetries leave the matrix as it is (cubemap.py).
#include "vector.h"

namespace {

const int SYMMETRIES = 24, WIDTH = 3 * SYMMETRIES;

struct Product {
  int64_t orbits;                   // of rows
  const int32_t *starts, *columns;  // (orbits + 1), of the numbers of each one's first row; their columns, by symmetry
  const float* numbers;
  const int32_t* compositions;  // (24, 24): the symmetry that is the row's, then the column's
  const float* dense;           // (columns, 3)
  const int32_t* rows;          // (24 orbits) where in `out` each row goes; null where it stays in place
  float* out;                   // (24 orbits, 3)
  mutable Shared shared;

  MEMBER int64_t place(int64_t row) const { return rows ? rows[row] : row; }
};

#ifdef __CUDACC__
// A warp a row: its threads take numbers by turns, then add up what they have.
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
constexpr int VECTORS = WIDTH / LANES, REST = WIDTH % LANES;  // an orbit's floats
typedef float UnalignedFour __attribute__((vector_size(16), aligned(4)));
typedef float UnalignedRest __attribute__((vector_size(4 * (REST ? REST : LANES)), aligned(4)));

// An orbit's rows at once: what the first reads of another orbit the others read too, each another image of it.
INLINE void product(const Product& p) {
  const int64_t BATCH = 16;
  share(p.shared, p.orbits, BATCH, [&](int64_t i) {
    int64_t orbit = p.orbits - 1 - i;  // the last have most numbers
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
      for (int s = 0; s < SYMMETRIES; s++)
        sums[s] += *(const UnalignedFour*)(images + 3 * p.compositions[SYMMETRIES * symmetry + s]);
    }
    for (int s = 0; s < SYMMETRIES; s++)
      for (int c = 0; c < 3; c++) p.out[3 * p.place(SYMMETRIES * orbit + s) + c] = sums[s][c];
  });
}
#endif

}  // namespace

KERNEL(refgs_sparse_product, Product, p) { product(*p); }
