// Sums that many pixels add to: derivatives by the maps at displaced pixels, and by the light. No result depends on the threads. The CPU
// divides the image into chunks of rows, whose size does not depend on the number of threads, and adds up the chunks in order. On CUDA a
// thread has a pixel, and sums are integers, which are the same in any order.
#pragma once

#include "pixels.h"

namespace {

#ifdef __CUDACC__
// Unit of fixed-point numbers: a power of two such that neither the numbers nor their sums overflow.
struct Unit {
  float per, size;  // units in 1; the value of a unit

  // For sums of up to 2^count numbers whose magnitudes are at most `largest` (a float's bits). If it is not finite, all sums are NaN.
  Unit(int32_t largest, int count) {
    int exponent = (largest >> 23) - 127;  // largest < 2^(exponent + 1)
    int bits = 60 - count - exponent;
    bits = bits < 126 ? bits : 126;
    per = __int_as_float((127 + bits) << 23);
    size = __int_as_float(exponent < 128 ? (127 - bits) << 23 : 0x7fc00000);
  }
};

// log2 of the number of addends of a pixel: (2 HALO + 1)^2 < 2^9 pixels can add to one, each with a total weight of at most 1.
constexpr int SOURCES = 9;

// log2 of the number of addends of a cell: all pixels may add to one, up to twelve numbers each.
int adders(const Shade& s) { return 4 + 64 - __clzll(s.width * s.height); }

// Derivatives of a pixel by the maps and by the light. A first pass finds the LARGEST magnitude of the numbers that are added to shared
// sums. A second pass adds them.
template <bool LARGEST>
struct Contributions {
  const Shade& s;
  float map_scale, cell_scale;
  int32_t largest_map = 0, largest_cell = 0;
  float by_exposure[3] = {};

  Contributions(const Shade& s) : s(s) {
    if (!LARGEST) map_scale = Unit(s.largest[0], SOURCES).per, cell_scale = Unit(s.largest[1], adders(s)).per;
  }

  template <int C>
  void add_own(const Pixels& p, const Vector (&by_own)[C], Vector by_alpha) {
    if (LARGEST) return;
    for (int c = 0; c < C; c++) s.by_features[(int64_t)p.at[0] * C + c] = by_own[c].value;
    s.by_alpha[p.at[0]] = by_alpha.value;
  }

  void add_sampled(const Corners& c, int, const Vector (&by_sampled)[4]) {
    Vector weight[4];
    c.weights(weight);
    for (int i = 0; i < 4; i++) {
      float by = by_sampled[i].value;
      if (LARGEST) {
        raise(largest_map, by);
      } else {
        int64_t* sums = s.map_sums + i * s.width * s.height;
        for (int j = 0; j < 4; j++) add(sums + c.at(0, j), by * weight[j].value * map_scale);
      }
    }
  }

  void add_exposure(const Vector (&by)[3]) {
    for (int c = 0; c < 3; c++) by_exposure[c] = by[c].value;
  }

  template <int N>
  void add_light(const Lookup<N, true>& l, int, const Vector (&by_light)[3]) {
    Vector weight[N][4];
    l.weights(weight);
    for (int i = 0; i < N; i++)
      for (int j = 0; j < 4; j++)
        for (int c = 0; c < 3; c++) {
          float by = by_light[c].value * weight[i][j].value;
          if (LARGEST)
            raise(largest_cell, by);
          else
            add(s.cell_sums + 3 * (int64_t)(l.cell[i][0] + (j & 1) + (j & 2 ? l.width[i][0] : 0)) + c, by * cell_scale);
        }
  }

 private:
  static void raise(int32_t& largest, float v) {
    int32_t bits = __float_as_int(v) & 0x7fffffff;  // sorts like the magnitude, with NaN above all numbers
    largest = bits > largest ? bits : largest;
  }
  static void add(int64_t* to, float v) {
    if (v != 0) atomicAdd((unsigned long long*)to, (unsigned long long)(int64_t)v);
  }
};
#else
typedef Wide<8>::type Eight;

void zero(float* p, int64_t n) {
  for (int64_t i = 0; i < n; i++) p[i] = 0;
}

// Derivatives of a chunk of rows by the maps and by the light.
struct Chunk {
  const Shade& s;
  int64_t first, end;         // pixels
  float *near, *cells;        // `near` is offset so that the image's pixel indices apply
  uint8_t *rows, *lines;      // `touched` flags of the image's rows, and of lines of cells
  Vector by_exposure[3] = {};

  Chunk(const Shade& s, int64_t index) : s(s), first(index * s.chunk_rows * s.width) {
    int64_t left = s.height - index * s.chunk_rows;
    end = first + (left < s.chunk_rows ? left : s.chunk_rows) * s.width;
    int64_t before = index * s.chunk_rows - HALO, most = s.chunk_rows + 2 * HALO;
    cells = s.by_cells + index * 4 * s.cells, near = s.near + 4 * s.width * (index * most - before);
    rows = s.touched + index * (most + s.lines) - before, lines = rows + before + most;
    zero(s.by_features + first * s.channels, (end - first) * s.channels);
    zero(s.by_alpha + first, end - first);
    for (int64_t i = before; i < before + most + s.lines; i++) rows[i] = 0;
  }

  // Add to the pixels themselves.
  template <int C>
  MEMBER void add_own(const Pixels& p, const Vector (&by_own)[C], Vector by_alpha) {
    Rows<C> own(by_own);
    alignas(64) float alpha[LANES];
    store(alpha, by_alpha);
    for (int k = 0; k < p.count; k++) own.add(k, 1, s.by_features + (int64_t)p.at[k] * C), s.by_alpha[p.at[k]] = alpha[k];
  }

  // Add to the four pixels around a displaced point, by their bilinear weights.
  MEMBER void add_sampled(const Corners& c, int count, const Vector (&by_sampled)[4]) {
    alignas(64) float w[4][LANES];
    Vector weight[4];
    c.weights(weight);
    for (int j = 0; j < 4; j++) store(w[j], weight[j]);
    Rows<4> sampled(by_sampled);
    for (int k = 0; k < count; k++) {
      int64_t row = c.row[k], below = row + (c.below > 0);
      if (!(rows[row] & rows[below])) touch_row(row), touch_row(below);
      for (int j = 0; j < 4; j++) sampled.add(k, w[j][k], near + 4 * c.at(k, j));
    }
  }

  MEMBER void add_exposure(const Vector (&by)[3]) {
    for (int c = 0; c < 3; c++) by_exposure[c] += by[c];
  }

  // Add to the cells that were looked up.
  template <int N>
  MEMBER void add_light(const Lookup<N, true>& l, int count, const Vector (&by_light)[3]) {
    Vector weight[N][4];
    l.weights(weight);
    Rows<4> by({by_light[0], by_light[1], by_light[2], Vector()});
    for (int i = 0; i < N; i++) {
      Rows<4> w(weight[i]);
      for (int k = 0; k < count; k++) {
        Four light = by.get(k, 0), four = w.get(k, 0);
        Eight twice = __builtin_shufflevector(light, light, 0, 1, 2, 3, 0, 1, 2, 3);
        int32_t line = l.line[i][k];
        if (!(lines[line] & lines[line + 1])) touch(line), touch(line + 1);
        float *above = cells + 4 * (int64_t)l.cell[i][k], *below = above + 4 * (int64_t)l.width[i][k];
        auto add = [](float* to, Eight v) {
          Eight was;
          __builtin_memcpy(&was, to, sizeof was);
          was += v;
          __builtin_memcpy(to, &was, sizeof was);
        };
        add(above, __builtin_shufflevector(four, four, 0, 0, 0, 0, 1, 1, 1, 1) * twice);
        add(below, __builtin_shufflevector(four, four, 2, 2, 2, 2, 3, 3, 3, 3) * twice);
      }
    }
  }

 private:
  __attribute__((noinline)) void touch_row(int64_t row) {
    if (!rows[row]) zero(near + 4 * row * s.width, 4 * s.width);
    rows[row] = 1;
  }
  __attribute__((noinline)) void touch(int32_t line) {
    if (lines[line]) return;
    lines[line] = 1;
    zero(cells + 4 * s.levels.first_cell(line), 4 * s.levels.width(line));
  }
};

// Add to row y what its own chunk, the one above and the one below wrote for its normals.
void add_near(const Shade& s, int64_t y) {
  int64_t chunk = y / s.chunk_rows, most = s.chunk_rows + 2 * HALO;
  for (int64_t from = chunk - 1; from <= chunk + 1; from++) {
    int64_t row = y - from * s.chunk_rows + HALO;
    if (from < 0 || from >= chunks(s) || row < 0 || row >= most || !s.touched[from * (most + s.lines) + row]) continue;
    const float* near = s.near + 4 * (from * most + row) * s.width;
    for (int64_t i = 0; i < s.width; i++) {
      for (int c = 0; c < ALBEDO; c++) s.by_features[(y * s.width + i) * s.channels + c] += near[4 * i + c];
      s.by_alpha[y * s.width + i] += near[4 * i + 3];
    }
  }
}

// Add up what all chunks wrote to a line of cells.
void add_line(const Shade& s, int32_t line) {
  int64_t first = 4 * s.levels.first_cell(line), n = 4 * s.levels.width(line);
  float* sum = s.by_cells + chunks(s) * 4 * s.cells + first;
  zero(sum, n);
  for (int64_t k = 0; k < chunks(s); k++) {
    int64_t most = s.chunk_rows + 2 * HALO;
    if (!s.touched[k * (most + s.lines) + most + line]) continue;
    const float* from = s.by_cells + k * 4 * s.cells + first;
    for (int64_t i = 0; i < n; i++) sum[i] += from[i];
  }
}
#endif

}  // namespace
