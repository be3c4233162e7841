// Structural similarity of two images (Wang et al. 2004) and its derivative: 11x11 Gaussian window, sigma 1.5, zero padding.
//
// Images are (height, width * CHANNELS). Channels are interleaved, so a neighbour along x is CHANNELS floats away. The window is separable:
// columns are filtered first, straight from the image, then the rows of the result.
#include "vector.h"

namespace {

struct Ssim {
  int64_t height, width;
  const float *image, *target;
  float *by_mean, *by_square, *by_product;  // derivatives of a pixel's SSIM by the windowed x, x^2 + t^2 and x t (x: image, t: target)
  double* sums;                             // of SSIM over each row, or on CUDA over each block's pixels
  float scale;                              // factor of the derivative
  float* by_image;
  float* scratch;                           // (threads, refgs_ssim_scratch_size)
  mutable Shared shared;
};

constexpr int CHANNELS = 3, RADIUS = 5;
constexpr float C1 = 0.01f * 0.01f, C2 = 0.03f * 0.03f;
// Weights exp(-k^2 / (2 * 1.5^2)), normalised.
constexpr float WINDOW[RADIUS + 1] = {0.26601171f, 0.21300553f, 0.10936069f, 0.03600077f, 0.00759876f, 0.00102838f};

INLINE Vector along(const float* line) {
  Vector sum = WINDOW[0] * load(line);
  for (int k = 1; k <= RADIUS; k++) sum += WINDOW[k] * (load(line - k * CHANNELS) + load(line + k * CHANNELS));
  return sum;
}

struct Similarity {
  Vector ssim, by_mean, by_square, by_product;
};

// SSIM and its derivatives, given the windowed image x, target t, x^2 + t^2 and x t.
INLINE Similarity similarity(Vector x, Vector t, Vector square, Vector product) {
  Vector xt = x * t, means = x * x + t * t;
  Vector a1 = 2.0f * xt + C1, a2 = 2.0f * (product - xt) + C2, b1 = means + C1, b2 = square - means + C2;
  Vector inverse1 = reciprocal(b1), inverse2 = reciprocal(b2), both = inverse1 * inverse2;
  Vector ssim = a1 * a2 * both;
  return {ssim, 2.0f * (t * (a2 - a1) * both + x * ssim * (inverse2 - inverse1)), -ssim * inverse2, 2.0f * a1 * both};
}

INLINE Vector derivative(const Ssim& s, Vector mean, Vector square, Vector product, Vector x, Vector t) {
  return (mean + 2.0f * x * square + t * product) * s.scale;
}

#ifdef __CUDACC__
// A block has a tile of ROWS rows and THREADS columns of numbers. The outer MARGIN columns at the left and right only serve the windows of
// the inner ones. A thread has a column: it filters it from the image into shared memory, then filters the rows there.
constexpr int THREADS = 256, MARGIN = 16, ROWS = 6;
static_assert(MARGIN >= RADIUS * CHANNELS);

struct Column {
  int64_t x, y, width, height;  // position of the column's first number; size of the image, in numbers and rows
  bool ours;                    // whether the column is an inner one

  explicit Column(const Ssim& s) : width(s.width * CHANNELS), height(s.height) {
    const int OURS = THREADS - 2 * MARGIN;
    int block = blockIdx.x, thread = threadIdx.x, tiles = (int)((width + OURS - 1) / OURS);
    x = block % tiles * OURS + thread - MARGIN, y = block / tiles * ROWS;
    ours = thread >= MARGIN && thread < THREADS - MARGIN && x < width;
  }

  // Filter the column of N maps into `lines`. get(at, values) loads their values; beyond the image they count as zero.
  template <int N, class Get>
  void down(float (&lines)[N][ROWS][THREADS], Get get) const {
    float sums[N][ROWS] = {};
    if (x >= 0 && x < width) {
#pragma unroll
      for (int k = -RADIUS; k < ROWS + RADIUS; k++) {
        bool inside = y + k >= 0 && y + k < height;  // no branch, so that the loads of all rows are in flight at once
        float values[N];
        get((inside ? y + k : y) * width + x, values);
        for (float& value : values) value = inside ? value : 0;
#pragma unroll
        for (int row = 0; row < ROWS; row++) {
          int apart = k < row ? row - k : k - row;
          if (apart <= RADIUS)
            for (int i = 0; i < N; i++) sums[i][row] += WINDOW[apart] * values[i];
        }
      }
    }
    for (int i = 0; i < N; i++)
      for (int row = 0; row < ROWS; row++) lines[i][row][threadIdx.x] = sums[i][row];
    __syncthreads();
  }

  // Call body(at, row) for the thread's numbers.
  template <class Body>
  void each(Body body) const {
    if (!ours) return;
    for (int row = 0; row < ROWS && y + row < height; row++) body((y + row) * width + x, row);
  }
};

}  // namespace

KERNEL(refgs_ssim_forward, Ssim, s) {
  __shared__ float lines[4][ROWS][THREADS];
  Column column(*s);
  column.down(lines, [&](int64_t at, float (&values)[4]) {
    float x = s->image[at], t = s->target[at];
    values[0] = x, values[1] = t, values[2] = x * x + t * t, values[3] = x * t;
  });
  float sum[1] = {};
  column.each([&](int64_t at, int row) {
    Vector v[4];
    for (int i = 0; i < 4; i++) v[i] = along(&lines[i][row][threadIdx.x]);
    Similarity c = similarity(v[0], v[1], v[2], v[3]);
    sum[0] += c.ssim[0];
    s->by_mean[at] = c.by_mean[0], s->by_square[at] = c.by_square[0], s->by_product[at] = c.by_product[0];
  });
  sum_over_block(sum, s->sums + blockIdx.x);
}

KERNEL(refgs_ssim_backward, Ssim, s) {
  __shared__ float lines[3][ROWS][THREADS];
  Column column(*s);
  column.down(lines,
              [&](int64_t at, float (&values)[3]) { values[0] = s->by_mean[at], values[1] = s->by_square[at], values[2] = s->by_product[at]; });
  column.each([&](int64_t at, int row) {
    Vector v[3];
    for (int i = 0; i < 3; i++) v[i] = along(&lines[i][row][threadIdx.x]);
    s->by_image[at] = derivative(*s, v[0], v[1], v[2], s->image[at], s->target[at])[0];
  });
}
#else
// Scratch of a thread: four rows, padded with zeros as far as a window along x reaches.
struct Lines {
  int64_t margin, stride;
  float* memory;
  explicit Lines(int64_t width) : memory() {
    margin = (RADIUS * CHANNELS + LANES - 1) / LANES * LANES;
    stride = 2 * margin + (width * CHANNELS + LANES - 1) / LANES * LANES;
  }
  explicit Lines(const Ssim& s) : Lines(s.width) {
    memory = s.scratch + take(s.shared.thread, 1) * 4 * stride;
    clear(memory, 4 * stride);
  }
  float* operator[](int i) const { return memory + i * stride + margin; }
};

// Call body(first, count) for each vector of a row of n numbers. The last may be shorter than LANES.
template <class Body>
INLINE void each(int64_t n, Body body) {
  for (int64_t x = 0; x < n; x += LANES) body(x, n - x < LANES ? n - x : LANES);
}

void forward_row(const Ssim& s, int64_t y, const Lines& lines) {
  int64_t n = s.width * CHANNELS;
  each(n, [&](int64_t i, int64_t count) {
    Vector x = {}, t = {}, square = {}, product = {};
    for (int k = -RADIUS; k <= RADIUS; k++) {
      if (y + k < 0 || y + k >= s.height) continue;
      Vector a = read(s.image + (y + k) * n + i, count), b = read(s.target + (y + k) * n + i, count);
      Vector w = Vector() + WINDOW[k < 0 ? -k : k], wa = w * a, wb = w * b;
      x += wa, t += wb, square += wa * a + wb * b, product += wa * b;
    }
    write(lines[0] + i, x, count), write(lines[1] + i, t, count);
    write(lines[2] + i, square, count), write(lines[3] + i, product, count);
  });
  Sum sum = {};
  each(n, [&](int64_t i, int64_t count) {
    Similarity c = similarity(along(lines[0] + i), along(lines[1] + i), along(lines[2] + i), along(lines[3] + i));
    write(s.by_mean + y * n + i, c.by_mean, count), write(s.by_square + y * n + i, c.by_square, count);
    write(s.by_product + y * n + i, c.by_product, count);
    for (int64_t k = count; k < LANES; k++) c.ssim[k] = 0;  // beyond the row
    sum += convert<Sum>(c.ssim);
  });
  s.sums[y] = 0;
  for (int k = 0; k < LANES; k++) s.sums[y] += sum[k];
}

// Derivatives are filtered by the same window: it is symmetric, so the filter is its own transpose.
void backward_row(const Ssim& s, int64_t y, const Lines& lines) {
  int64_t n = s.width * CHANNELS;
  each(n, [&](int64_t i, int64_t count) {
    Vector mean = {}, square = {}, product = {};
    for (int k = -RADIUS; k <= RADIUS; k++) {
      if (y + k < 0 || y + k >= s.height) continue;
      float w = WINDOW[k < 0 ? -k : k];
      int64_t at = (y + k) * n + i;
      mean += w * read(s.by_mean + at, count), square += w * read(s.by_square + at, count);
      product += w * read(s.by_product + at, count);
    }
    write(lines[0] + i, mean, count), write(lines[1] + i, square, count), write(lines[2] + i, product, count);
  });
  each(n, [&](int64_t i, int64_t count) {
    int64_t at = y * n + i;
    Vector mean = along(lines[0] + i), square = along(lines[1] + i), product = along(lines[2] + i);
    write(s.by_image + at, derivative(s, mean, square, product, read(s.image + at, count), read(s.target + at, count)), count);
  });
}

}  // namespace

EXPORT int64_t refgs_ssim_scratch_size(int64_t width) { return 4 * Lines(width).stride; }

KERNEL(refgs_ssim_forward, Ssim, s) {
  Lines lines(*s);
  for (int64_t y; (y = take(s->shared.next, 1)) < s->height;) forward_row(*s, y, lines);
}

KERNEL(refgs_ssim_backward, Ssim, s) {
  Lines lines(*s);
  for (int64_t y; (y = take(s->shared.next, 1)) < s->height;) backward_row(*s, y, lines);
}

#if defined(_WIN32)
extern "C" int _fltused = 0;  // symbols that Windows' linker requires
extern "C" int _DllMainCRTStartup(void*, unsigned, void*) { return 1; }
#endif
#endif
