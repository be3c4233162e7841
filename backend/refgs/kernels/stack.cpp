// Concatenation of tensors along their last dimension: a surfel's features from its parts; and the split of their derivative.
#include "library.h"

namespace {

struct Part {
  int64_t width;
  float* numbers;  // (rows, width); null if its derivative is not wanted
};

constexpr int MOST = 8;  // parts

struct Stack {
  int64_t rows, parts, width;  // width: of the stack
  Part part[MOST];
  float* stacked;              // (rows, width)
  mutable Shared shared;
};

#ifdef __CUDACC__
constexpr int BATCH = 1;
#else
constexpr int BATCH = 256;
#endif

// Call body(number of a part, the same number in the stack) for some rows of a part. WIDTH is the part's width if known at compile
// time, else 0.
template <int WIDTH, class Body>
inline void each(const Part& part, float* stacked, int64_t stride, int64_t first, int64_t end, Body body) {
  int64_t width = WIDTH ? WIDTH : part.width;
  for (int64_t row = first; row < end; row++)
    for (int64_t c = 0; c < width; c++) body(part.numbers[row * width + c], stacked[row * stride + c]);
}

template <class Body>
inline void each(const Stack& s, Body body) {
  share(s.shared, (s.rows + BATCH - 1) / BATCH, 1, [&](int64_t batch) {
    int64_t first = batch * BATCH, end = first + BATCH < s.rows ? first + BATCH : s.rows;
    float* stacked = s.stacked;
    for (int64_t p = 0; p < s.parts; stacked += s.part[p++].width) {
      if (!s.part[p].numbers) continue;
      auto* rows = s.part[p].width == 1 ? each<1, Body> : s.part[p].width == 3 ? each<3, Body> : each<0, Body>;
      rows(s.part[p], stacked, s.width, first, end, body);
    }
  });
}

}  // namespace

KERNEL(refgs_stack, Stack, s) {
  each(*s, [](float part, float& stacked) { stacked = part; });
}

KERNEL(refgs_unstack, Stack, s) {
  each(*s, [](float& part, float stacked) { part = stacked; });
}
