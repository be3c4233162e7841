// Transposition between memory, where a pixel's numbers are adjacent, and vectors, which hold one number of LANES pixels.
#pragma once

#include "vector.h"

#ifdef __CUDACC__
template <int WIDTH>
struct Wide {
  typedef float type;
};
#else
template <int WIDTH>
struct Wide {
  typedef float type __attribute__((vector_size(4 * WIDTH)));
};

#if LANES == 16
#define EVERY_OTHER(n) n, n + 2, n + 4, n + 6, n + 8, n + 10, n + 12, n + 14, n + 16, n + 18, n + 20, n + 22, n + 24, n + 26, n + 28, n + 30
#elif LANES == 8
#define EVERY_OTHER(n) n, n + 2, n + 4, n + 6, n + 8, n + 10, n + 12, n + 14
#else
#define EVERY_OTHER(n) n, n + 2, n + 4, n + 6
#endif
#endif

// Division of a pixel's N numbers into blocks of WIDTH, each moved at once. If N is no multiple of WIDTH, the last block begins early and
// overlaps the one before.
template <int N>
struct Blocks {
  static constexpr int WIDTH = N >= LANES ? LANES : N > 8 ? 16 : N == 8 ? 8 : 4, COUNT = (N + WIDTH - 1) / WIDTH;
  static_assert(N >= WIDTH || WIDTH == LANES, "only whole vectors are read and written in part");
  typedef typename Wide<WIDTH>::type Numbers;
  static constexpr int at(int block) { return block * WIDTH + WIDTH <= N || N < WIDTH ? block * WIDTH : N - WIDTH; }

  static MEMBER Numbers get(const float* p) {
#ifdef __CUDACC__
    return *p;
#else
    if constexpr (N < WIDTH) return read(p, N);
    Numbers v;
    __builtin_memcpy(&v, p, sizeof v);
    return v;
#endif
  }
#ifndef __CUDACC__
  static MEMBER void put(float* p, Numbers v) {
    if constexpr (N < WIDTH) return write(p, v, N);
    __builtin_memcpy(p, &v, sizeof v);
  }
#endif
};

#ifndef __CUDACC__
// Transpose W numbers of each of LANES pixels: from pixel by pixel to a vector for each number (unzip), and back (zip).
template <int W>
INLINE void unzip(Vector (&v)[W]) {
#pragma unroll
  for (int n = 1; n < W; n *= 2) {
    Vector w[W];
#pragma unroll
    for (int i = 0; i < W / 2; i++) {
      w[i] = __builtin_shufflevector(v[2 * i], v[2 * i + 1], EVERY_OTHER(0));
      w[W / 2 + i] = __builtin_shufflevector(v[2 * i], v[2 * i + 1], EVERY_OTHER(1));
    }
#pragma unroll
    for (int i = 0; i < W; i++) v[i] = w[i];
  }
}
template <int W>
INLINE void zip(Vector (&v)[W]) {
#pragma unroll
  for (int n = 1; n < W; n *= 2) {
    Vector w[W];
#pragma unroll
    for (int i = 0; i < W / 2; i++) w[2 * i] = interleave_low(v[i], v[i + W / 2]), w[2 * i + 1] = interleave_high(v[i], v[i + W / 2]);
#pragma unroll
    for (int i = 0; i < W; i++) v[i] = w[i];
  }
}

// Concatenate the blocks of pixels k, k + 1, ... that fill a vector.
template <int W, class Row>
INLINE auto side_by_side(Row row, int k) {
  if constexpr (W == LANES) {
    return row(k);
  } else if constexpr (2 * W == LANES && LANES == 8) {
    return __builtin_shufflevector(row(k), row(k + 1), 0, 1, 2, 3, 4, 5, 6, 7);
  } else if constexpr (2 * W == LANES) {
    return __builtin_shufflevector(row(k), row(k + 1), 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
  } else {
    auto pair = [&](int i) { return __builtin_shufflevector(row(i), row(i + 1), 0, 1, 2, 3, 4, 5, 6, 7); };
    return __builtin_shufflevector(pair(k), pair(k + 2), 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
  }
}
#endif

// Fill lanes[c] with number c of each pixel. block(k, b) returns block b of pixel k.
template <int N, class Block>
INLINE void to_lanes(Block block, Vector (&lanes)[N]) {
  constexpr int W = Blocks<N>::WIDTH;
#pragma unroll
  for (int b = 0; b < Blocks<N>::COUNT; b++) {
    Vector v[W];
#ifdef __CUDACC__
    v[0] = block(0, b);
#else
#pragma unroll
    for (int i = 0; i < W; i++) v[i] = side_by_side<W>([&](int k) { return block(k, b); }, i * (LANES / W));
    unzip(v);
#endif
#pragma unroll
    for (int c = 0; c < W && Blocks<N>::at(b) + c < N; c++) lanes[Blocks<N>::at(b) + c] = v[c];
  }
}

// N numbers of each of LANES pixels, in blocks. Where two blocks overlap the later one holds zeros, so that `add` counts each number once.
template <int N>
struct Rows {
  static constexpr int W = Blocks<N>::WIDTH, COUNT = Blocks<N>::COUNT;
  typedef typename Blocks<N>::Numbers Numbers;
  alignas(64) float row[COUNT][LANES][W];

  MEMBER Rows() {}
  MEMBER explicit Rows(const Vector (&lanes)[N]) {
#pragma unroll
    for (int b = 0; b < COUNT; b++) {
      int at = Blocks<N>::at(b);
      Vector v[W];
#pragma unroll
      for (int c = 0; c < W; c++) v[c] = at + c < b * W || at + c >= N ? Vector() : lanes[at + c];
#ifndef __CUDACC__
      zip(v);
#endif
#pragma unroll
      for (int i = 0; i < W; i++) store(row[b][0] + i * LANES, v[i]);
    }
  }
  MEMBER Numbers get(int k, int b) const { return *(const Numbers*)row[b][k]; }
  MEMBER void set(int k, int b, Numbers v) { *(Numbers*)row[b][k] = v; }

#ifndef __CUDACC__
  // to[c] += weight * number c of pixel k.
  MEMBER void add(int k, float weight, float* to) const {
#pragma unroll
    for (int b = 0; b < COUNT; b++) {
      float* p = to + Blocks<N>::at(b);
      Blocks<N>::put(p, Blocks<N>::get(p) + weight * get(k, b));
    }
  }
#endif
};
