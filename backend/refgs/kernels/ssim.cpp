// Structural similarity of two images (Wang et al. 2004): 11x11 Gaussian window, sigma 1.5, zero padding, and its derivative.
//
// Images are (height, width * channels) rows; with the channels interleaved, a neighbour along x is `channels` floats away. Windows
// are separable: columns first, straight from the image, then rows of what that gave.
#include "vector.h"

namespace {

struct Ssim {
  int64_t height, width, channels;
  const float *image, *target;
  float *by_mean, *by_square, *by_product;  // derivatives of a pixel's SSIM by the windowed image, x^2 + y^2 and x y; or null
  double* sums;                             // (height) of SSIM over a row
  double scale;                             // of the derivative
  float* by_image;
  float* scratch;                           // (threads, refgs_ssim_scratch_size)
  mutable Shared shared;
};

constexpr int RADIUS = 5;
constexpr float C1 = 0.01f * 0.01f, C2 = 0.03f * 0.03f;
// exp(-k^2 / (2 1.5^2)) over their sum
constexpr float WINDOW[RADIUS + 1] = {0.26601171f, 0.21300553f, 0.10936069f, 0.03600077f, 0.00759876f, 0.00102838f};

// Of a thread: four rows with zeros around, as far as a window along x may reach.
struct Lines {
  int64_t margin, stride;
  float* memory;
  Lines(int64_t width, int64_t channels) : memory() {
    margin = (RADIUS * channels + LANES - 1) / LANES * LANES;
    stride = 2 * margin + (width * channels + LANES - 1) / LANES * LANES;
  }
  explicit Lines(const Ssim& s) : Lines(s.width, s.channels) {
    memory = s.scratch + take(s.shared.thread, 1) * 4 * stride;
    clear(memory, 4 * stride);
  }
  float* operator[](int i) const { return memory + i * stride + margin; }
};

INLINE Vector along(const float* line, int64_t step) {
  Vector sum = WINDOW[0] * load(line);
  for (int k = 1; k <= RADIUS; k++) sum += WINDOW[k] * (load(line - k * step) + load(line + k * step));
  return sum;
}

// body(first, count) for each vector of a row; the last may be shorter.
template <class Body>
INLINE void each(int64_t n, Body body) {
  for (int64_t x = 0; x < n; x += LANES) body(x, n - x < LANES ? n - x : LANES);
}

void forward_row(const Ssim& s, int64_t y, const Lines& lines) {
  int64_t n = s.width * s.channels;
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
    Vector x = along(lines[0] + i, s.channels), t = along(lines[1] + i, s.channels);
    Vector square = along(lines[2] + i, s.channels), product = along(lines[3] + i, s.channels);
    Vector xt = x * t, means = x * x + t * t;
    Vector a1 = 2.0f * xt + C1, a2 = 2.0f * (product - xt) + C2, b1 = means + C1, b2 = square - means + C2;
    Vector inverse1 = reciprocal(b1), inverse2 = reciprocal(b2), both = inverse1 * inverse2;
    Vector ssim = a1 * a2 * both;
    for (int64_t k = count; k < LANES; k++) ssim[k] = 0;  // beyond the row
    sum += convert<Sum>(ssim);
    if (!s.by_mean) return;
    write(s.by_mean + y * n + i, 2.0f * (t * (a2 - a1) * both + x * ssim * (inverse2 - inverse1)), count);
    write(s.by_square + y * n + i, -ssim * inverse2, count);
    write(s.by_product + y * n + i, 2.0f * a1 * both, count);
  });
  s.sums[y] = 0;
  for (int k = 0; k < LANES; k++) s.sums[y] += sum[k];
}

// The window is symmetric, so the derivative of windowing is windowing.
void backward_row(const Ssim& s, int64_t y, const Lines& lines) {
  int64_t n = s.width * s.channels;
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
    Vector mean = along(lines[0] + i, s.channels), square = along(lines[1] + i, s.channels);
    Vector product = along(lines[2] + i, s.channels);
    Vector by = mean + 2.0f * read(s.image + at, count) * square + read(s.target + at, count) * product;
    write(s.by_image + at, by * (float)s.scale, count);
  });
}

}  // namespace

EXPORT int64_t refgs_ssim_scratch_size(int64_t width, int64_t channels) { return 4 * Lines(width, channels).stride; }

KERNEL(refgs_ssim_forward, Ssim, s) {
  Lines lines(*s);
  for (int64_t y; (y = take(s->shared.next, 1)) < s->height;) forward_row(*s, y, lines);
}

KERNEL(refgs_ssim_backward, Ssim, s) {
  Lines lines(*s);
  for (int64_t y; (y = take(s->shared.next, 1)) < s->height;) backward_row(*s, y, lines);
}

#if defined(_WIN32)
extern "C" int _fltused = 0;  // names that Windows' linker wants
extern "C" int _DllMainCRTStartup(void*, unsigned, void*) { return 1; }
#endif
