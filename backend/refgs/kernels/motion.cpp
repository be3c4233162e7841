// Screen-space gradient of each surfel's position under a view's loss, accumulated over views for densification.
#include "vector.h"

namespace {

struct Motion {
  int64_t count;
  const float *positions, *gradients;  // (count, 3) in world space
  double view[12];                     // world to camera, 3x4, row-major
  const float* accepted;               // (1): zero skips the view; or null
  double scale;                        // converts the derivative by a unit across at depth 1 to that by half an image's width
  float *total, *views;                // (count)
  mutable Shared shared;
};

}  // namespace

KERNEL(refgs_motion, Motion, m) {
  const int64_t BATCH = 1024;
  if (m->accepted && !*m->accepted) return;
  share(m->shared, m->count, BATCH, [&](int64_t i) {
    const float *p = m->positions + 3 * i, *g = m->gradients + 3 * i;
    float across[2] = {}, depth = (float)m->view[11];
    for (int a = 0; a < 3; a++) {
      depth += (float)m->view[8 + a] * p[a];
      across[0] += (float)m->view[a] * g[a], across[1] += (float)m->view[4 + a] * g[a];
    }
    float length = root(across[0] * across[0] + across[1] * across[1]);
    // A pixel at depth z is z / f wide.
    m->total[i] += depth > 0 ? length * depth * (float)m->scale : 0;
    m->views[i] += length > 0 ? 1 : 0;
  });
}
