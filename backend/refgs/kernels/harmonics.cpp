// Directional colour of each surfel: real spherical harmonics in the viewing direction, or mirrored (paper Eq. 10); and derivatives.
#include "vector.h"

namespace {

constexpr int MOST = 16;  // coefficients of a colour channel at degree 3

struct Harmonics {
  int64_t count, coefficients;
  const float *constant, *rest;               // (count, 1, 3), (count, coefficients - 1, 3)
  const float *positions, *normals;           // (count, 3), (count, 3) or null
  double camera[3];
  float offset;
  float* color;  // (count, 3)
  const float* by_color;
  float *by_constant, *by_rest;
  mutable Shared shared;
};

// Direction from the camera to a surfel, mirrored at its normal if there are normals.
void direction(const Harmonics& h, int64_t i, float (&d)[3]) {
  double towards[3], square = 1e-24;
  for (int a = 0; a < 3; a++) towards[a] = h.camera[a] - h.positions[3 * i + a], square += towards[a] * towards[a];
  float inverse = (float)(1 / root(square)), along = 0;
  for (int a = 0; a < 3; a++) d[a] = -(float)towards[a] * inverse;
  if (!h.normals) return;
  const float* n = h.normals + 3 * i;
  for (int a = 0; a < 3; a++) along += n[a] * d[a];
  for (int a = 0; a < 3; a++) d[a] -= 2 * along * n[a];
}

// Evaluate the harmonics, with the constants, order and signs of refgs.model.harmonics.
void basis(const float (&d)[3], int64_t coefficients, float (&y)[MOST]) {
  float x = d[0], v = d[1], z = d[2], xx = x * x, vv = v * v, zz = z * z;
  y[0] = 0.28209479f;
  if (coefficients < 4) return;
  y[1] = -0.48860251f * v, y[2] = 0.48860251f * z, y[3] = -0.48860251f * x;
  if (coefficients < 9) return;
  y[4] = 1.0925485f * x * v, y[5] = -1.0925485f * v * z, y[6] = 0.31539157f * (3 * zz - 1);
  y[7] = -1.0925485f * x * z, y[8] = 0.54627422f * (xx - vv);
  if (coefficients < 16) return;
  y[9] = -0.59004359f * v * (3 * xx - vv), y[10] = 2.8906114f * x * v * z, y[11] = -0.45704579f * v * (5 * zz - 1);
  y[12] = 0.37317633f * z * (5 * zz - 3), y[13] = -0.45704579f * x * (5 * zz - 1);
  y[14] = 1.4453057f * z * (xx - vv), y[15] = -0.59004359f * x * (xx - 3 * vv);
}

constexpr int BATCH = 512;  // surfels at a time

template <class Body>
void each(const Harmonics* h, Body body) {
  share(h->shared, h->count, BATCH, [&](int64_t i) {
    float d[3], y[MOST];
    direction(*h, i, d);
    basis(d, h->coefficients, y);
    body(i, y);
  });
}

}  // namespace

KERNEL(refgs_harmonics_forward, Harmonics, h) {
  each(h, [&](int64_t i, const float* y) {
    const float *v = h->constant + 3 * i, *rest = h->rest + 3 * (h->coefficients - 1) * i;
    float sum[3];
    for (int c = 0; c < 3; c++) sum[c] = h->offset + y[0] * v[c];
    for (int64_t k = 1; k < h->coefficients; k++)
      for (int c = 0; c < 3; c++) sum[c] += y[k] * rest[3 * (k - 1) + c];
    for (int c = 0; c < 3; c++) h->color[3 * i + c] = sum[c] <= 0 ? 0 : sum[c];  // a NaN stays one
  });
}

KERNEL(refgs_harmonics_backward, Harmonics, h) {
  each(h, [&](int64_t i, const float* y) {
    float by[3], *rest = h->by_rest + 3 * (h->coefficients - 1) * i;
    for (int c = 0; c < 3; c++) by[c] = h->color[3 * i + c] <= 0 ? 0 : h->by_color[3 * i + c];
    for (int c = 0; c < 3; c++) h->by_constant[3 * i + c] = y[0] * by[c];
    for (int64_t k = 1; k < h->coefficients; k++)
      for (int c = 0; c < 3; c++) rest[3 * (k - 1) + c] = y[k] * by[c];
  });
}
