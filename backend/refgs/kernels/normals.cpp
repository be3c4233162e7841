// Normals of surfels, flipped towards a camera; and derivatives back to the rotations.
#include "vector.h"

namespace {

constexpr float PAST_HORIZON = -0.3f;  // cosine to the camera below which a surfel's normal is flipped
constexpr float MIN_NORM = 1e-12f;

struct Normals {
  int64_t count;
  const float *rotations, *positions;  // (count, 4) quaternions wxyz of any length, (count, 3)
  double camera[3];
  float* normals;                      // (count, 3)
  const float* by_normals;
  float* by_rotations;
  mutable Shared shared;
};

struct Turned {
  float q[4], inverse, n[3], sign;
};

// Normalise the quaternion; take the rotation's third column as normal, and the sign that turns it towards the camera.
inline Turned turned(const Normals& s, int64_t i) {
  Turned t;
  const float* q = s.rotations + 4 * i;
  float norm = root(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
  t.inverse = norm < MIN_NORM ? 0 : 1 / norm;  // a zero quaternion stands for the identity, as in project.h
  for (int k = 0; k < 4; k++) t.q[k] = q[k] * t.inverse;
  float w = t.q[0], x = t.q[1], y = t.q[2], z = t.q[3];
  t.n[0] = 2 * (x * z + w * y), t.n[1] = 2 * (y * z - w * x), t.n[2] = 1 - 2 * (x * x + y * y);
  float along = 0, square = 0;
  for (int k = 0; k < 3; k++) {
    float towards = (float)(s.camera[k] - s.positions[3 * i + k]);
    along += t.n[k] * towards, square += towards * towards;
  }
  t.sign = along < PAST_HORIZON * root(square) ? -1 : 1;
  return t;
}

template <class Body>
void each(const Normals* s, Body body) {
  const int64_t BATCH = 512;
  share(s->shared, s->count, BATCH, [&](int64_t i) { body(i, turned(*s, i)); });
}

}  // namespace

KERNEL(refgs_normals_forward, Normals, s) {
  each(s, [&](int64_t i, const Turned& t) {
    for (int k = 0; k < 3; k++) s->normals[3 * i + k] = t.sign * t.n[k];
  });
}

KERNEL(refgs_normals_backward, Normals, s) {
  each(s, [&](int64_t i, const Turned& t) {
    const float *g = s->by_normals + 3 * i, *q = t.q;
    float by[4] = {q[2] * g[0] - q[1] * g[1], q[3] * g[0] - q[0] * g[1] - 2 * q[1] * g[2], q[0] * g[0] + q[3] * g[1] - 2 * q[2] * g[2],
                   q[1] * g[0] + q[2] * g[1]};
    float along = 0;
    for (int k = 0; k < 4; k++) along += by[k] * q[k];
    for (int k = 0; k < 4; k++) s->by_rotations[4 * i + k] = 2 * t.sign * t.inverse * (by[k] - along * q[k]);
  });
}
