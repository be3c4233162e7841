// Visual hull (Laurentini 1994): carve a grid of voxels by the views' masks.
#include "vector.h"

namespace {

constexpr int BLOCK = 8;  // voxels along two sides of a block, LANES along the third: its part of a mask fits the cache
constexpr float EMPTY = 0.01f;

struct Silhouette {
  double first[3], step[9];  // (column × depth, row × depth, depth) of voxel 0, 0, 0; its change by a voxel along x, y, z (3, 3)
  const uint8_t* mask;       // (height, width), of which 255 is 1
  int64_t width, height, whole;  // whole: the mask keeps clear of the border
};

struct Carve {
  int64_t resolution, views;
  const Silhouette* silhouettes;
  float *least, *second;    // (resolution, resolution, resolution)
  int32_t *carver, *seen;
  mutable Shared shared;
};

// Sample the mask bilinearly at pixel positions inside it. Positions are clamped to the centres of the border's pixels.
INLINE Vector sample(const Silhouette& s, Vector x, Vector y, Mask lanes) {
  x = clamp(x - 0.5f, 0, (float)(s.width - 1)), y = clamp(y - 0.5f, 0, (float)(s.height - 1));
  Vector left = round_down(x), top = round_down(y);
  Mask column = convert<Mask>(left), row = convert<Mask>(top);
  Vector corners[4] = {};
  for (int i = 0; i < LANES; i++) {
    if (!lanes[i]) continue;
    const uint8_t* p = s.mask + row[i] * s.width + column[i];
    int64_t right = column[i] + 1 < s.width, below = row[i] + 1 < s.height ? s.width : 0;
    corners[0][i] = p[0], corners[1][i] = p[right], corners[2][i] = p[below], corners[3][i] = p[below + right];
  }
  x -= left, y -= top;
  Vector upper = corners[0] + x * (corners[1] - corners[0]), lower = corners[2] + x * (corners[3] - corners[2]);
  return (upper + y * (lower - upper)) * (1.0f / 255);
}

}  // namespace

// Find for each voxel the smallest and second smallest mask value over the views that see it, the view with the smallest, and how many
// views see it. A `whole` view shows the whole object, so it also sees all voxels outside its image, as empty. Once two views show a
// voxel as empty, the views that follow skip it.
EXPORT void refgs_carve(const Carve* c) {
  int64_t n = c->resolution, side = (n + BLOCK - 1) / BLOCK, along = (n + LANES - 1) / LANES;
  Vector lane;
  for (int i = 0; i < LANES; i++) lane[i] = i;
  share(c->shared, side * side * along, 1, [&](int64_t block) {
    int64_t z0 = block % along * LANES, y0 = block / along % side * BLOCK, x0 = block / along / side * BLOCK;
    Vector least[BLOCK * BLOCK], second[BLOCK * BLOCK];
    Mask carver[BLOCK * BLOCK] = {}, seen[BLOCK * BLOCK] = {};
    for (int i = 0; i < BLOCK * BLOCK; i++) least[i] = second[i] = Vector() + 1.0f;
    for (int64_t view = 0; view < c->views; view++) {
      const Silhouette& s = c->silhouettes[view];
      for (int i = 0; i < BLOCK * BLOCK; i++) {
        Mask alive = second[i] > EMPTY;
        if (!any(alive)) continue;
        Vector p[3];
        for (int k = 0; k < 3; k++) {
          double first = s.first[k] + s.step[3 * k] * (x0 + i / BLOCK) + s.step[3 * k + 1] * (y0 + i % BLOCK);
          p[k] = (float)(first + s.step[3 * k + 2] * z0) + lane * (float)s.step[3 * k + 2];
        }
        Vector inverse = 1.0f / p[2], x = p[0] * inverse, y = p[1] * inverse;
        Mask inside = alive & (p[2] > 0) & (x >= 0) & (x <= (float)s.width) & (y >= 0) & (y <= (float)s.height);
        Vector value = Vector() + (s.whole ? 0.0f : 1.0f);
        if (any(inside)) value = select(inside, sample(s, x, y, inside), value);
        seen[i] -= alive & (s.whole ? alive : inside);
        Mask less = alive & (value < least[i]);
        second[i] = select(alive, smaller(second[i], larger(least[i], value)), second[i]);
        carver[i] = select(less, Mask() + (int32_t)view, carver[i]);
        least[i] = select(less, value, least[i]);
      }
    }
    for (int i = 0; i < BLOCK * BLOCK; i++) {
      int64_t x = x0 + i / BLOCK, y = y0 + i % BLOCK, at = (x * n + y) * n + z0, some = n - z0;
      if (x >= n || y >= n) continue;
      write(c->least + at, least[i], some), write(c->second + at, second[i], some);
      write((float*)c->carver + at, from_bits(carver[i]), some), write((float*)c->seen + at, from_bits(seen[i]), some);
    }
  });
}
