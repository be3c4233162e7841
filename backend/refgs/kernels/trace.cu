// Visibility of each pixel's mirror direction: rays are traced against a tree of boxes over the object's triangles.
#include "library.h"

namespace {

constexpr int LEAF = 4;         // triangles a leaf
constexpr int DEEPEST = 32;     // most levels of the tree
constexpr int PASSES = 3;       // faces that a ray may meet: it passes through two back faces
constexpr float COVERED = 1.0f / 255.0f;
constexpr float AGAIN = 0.1f;   // distance behind a back face where a ray continues, as a fraction of the lift
constexpr float FAR = 1e30f;

struct Trace {
  int64_t width, height;
  double view[12];  // world to camera, 3x4, row-major
  double camera[3], fx, fy, cx, cy;
  double centre[3], size, lift;              // centre and size of the mesh; the height above it where rays start, in units of `size`
  const float *mirrored, *depth, *alpha;     // (height, width, 3): mirror directions, 0 on background; (height, width): depth sums; alpha
  int64_t leaves;                            // a power of two
  const float* boxes;                        // (2 leaves, 6): least and greatest corner; root: node 1, children of i: 2 i, 2 i + 1
  const float* triangles;                    // (leaves LEAF, 9): a corner and the two edges from it
  float* visible;                            // (height, width)
  mutable Shared shared;
};

struct Ray {
  float origin[3], way[3], inverse[3];
};

inline float dot(const float* a, const float* b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }
inline void cross(const float* a, const float* b, float* c) {
  c[0] = a[1] * b[2] - a[2] * b[1], c[1] = a[2] * b[0] - a[0] * b[2], c[2] = a[0] * b[1] - a[1] * b[0];
}

// Distance at which the ray enters a box, or FAR if it does not before `nearest`.
inline float enter(const Ray& r, const float* box, float nearest) {
  if (!(box[0] <= box[3])) return FAR;  // an empty box
  float first = 0, last = nearest;
  for (int a = 0; a < 3; a++) {
    float t0 = (box[a] - r.origin[a]) * r.inverse[a], t1 = (box[3 + a] - r.origin[a]) * r.inverse[a];
    first = fmaxf(first, fminf(t0, t1)), last = fminf(last, fmaxf(t0, t1));
  }
  return first <= last ? first : FAR;
}

// Return whether the ray meets a triangle before `nearest` (Moeller and Trumbore 1997). If so, set `nearest` to the distance, and `front`
// to whether it meets the front.
inline bool meet(const Ray& r, const float* triangle, float& nearest, bool& front) {
  const float *u = triangle + 3, *v = triangle + 6;
  float p[3], q[3], from[3];
  cross(r.way, v, p);
  float determinant = dot(u, p);  // positive where the ray comes from the front
  if (determinant == 0) return false;
  float inverse = 1 / determinant;
  for (int a = 0; a < 3; a++) from[a] = r.origin[a] - triangle[a];
  float s = dot(from, p) * inverse;
  if (!(s >= 0 && s <= 1)) return false;
  cross(from, u, q);
  float t = dot(r.way, q) * inverse, distance = dot(v, q) * inverse;
  if (!(t >= 0 && s + t <= 1 && distance > 0 && distance < nearest)) return false;
  nearest = distance, front = determinant > 0;
  return true;
}

// Find the nearest triangle; results as those of `meet`.
inline bool cast(const Trace& s, const Ray& r, float& nearest, bool& front) {
  int waiting[DEEPEST], count = 0;
  int64_t node = 1;
  bool found = false;
  for (;;) {
    if (node >= s.leaves) {
      for (int i = 0; i < LEAF; i++) found |= meet(r, s.triangles + 9 * ((node - s.leaves) * LEAF + i), nearest, front);
    } else {
      float left = enter(r, s.boxes + 12 * node, nearest), right = enter(r, s.boxes + 12 * node + 6, nearest);
      int close = (int)(2 * node) + (right < left), other = close ^ 1;
      if (fmaxf(left, right) < FAR) waiting[count++] = other;
      if (fminf(left, right) < FAR) {
        node = close;
        continue;
      }
    }
    // Skip boxes that lie behind a triangle found since they were pushed.
    do {
      if (!count) return found;
      node = waiting[--count];
    } while (found && enter(r, s.boxes + 6 * node, nearest) >= FAR);
  }
}

// Return whether the mirror direction of pixel i is unoccluded. The ray starts at the pixel's surface point, lifted a little above it.
// Only front faces occlude. A ray that meets a back face started below the mesh or passes an open side of it, so it continues behind.
inline bool free_way(const Trace& s, int64_t i) {
  double x = ((double)(i % s.width) + 0.5 - s.cx) / s.fx, y = ((double)(i / s.width) + 0.5 - s.cy) / s.fy;
  double depth = s.depth[i] / s.alpha[i], length = 1 / sqrt(x * x + y * y + 1);
  Ray r;
  float normal[3];
  for (int a = 0; a < 3; a++) {
    double seen = x * s.view[a] + y * s.view[4 + a] + s.view[8 + a];
    r.way[a] = s.mirrored[3 * i + a];
    normal[a] = r.way[a] - (float)(seen * length);  // along the normal: the sum of the mirror direction and the one to the camera
    r.origin[a] = (float)((s.camera[a] + depth * seen - s.centre[a]) / s.size);
    r.inverse[a] = 1 / r.way[a];
  }
  float lift = (float)s.lift / sqrtf(dot(normal, normal) + 1e-24f);
  for (int a = 0; a < 3; a++) r.origin[a] += lift * normal[a];
  for (int pass = 0; pass < PASSES; pass++) {
    float nearest = FAR;
    bool front;
    if (!cast(s, r, nearest, front)) return true;
    if (front) return false;
    for (int a = 0; a < 3; a++) r.origin[a] += (nearest + AGAIN * (float)s.lift) * r.way[a];
  }
  return true;
}

}  // namespace

KERNEL(refgs_trace, Trace, s) {
  share(s->shared, s->width * s->height, 1, [&](int64_t i) { s->visible[i] = s->alpha[i] > COVERED && !free_way(*s, i) ? 0 : 1; });
}
