// The loss of a view except D-SSIM, and its derivatives by the rendered maps, in two passes over the pixels.
//
// Colour: |C - C_gt|, with C clipped to C_gt only where the photo is clipped: there C_gt is a lower bound.
// Normals: 1 - N.n, N being the normal of the depth map and n the blended normal.
// Smoothness: |grad n| exp(-|grad C_gt|); with the `even` weights also of metallic and roughness.
// Mask: |alpha - mask|.
// Metallic: m (1 - m), which is zero at 0 and at 1.
// Roughness: the excess above GLOSSY.
//
// A weight applies to one pixel's term.
#include "vector.h"

namespace {

struct Losses {
  int64_t width, height;
  const float *color, *normal, *depth, *alpha, *material;  // (H, W, 3), (H, W, 3), (H, W) blended sum of depths, (H, W), (H, W, 5) or null
  const uint8_t *image, *mask;                             // (H, W, 3) or null, (H, W) or null: 8-bit codes, of which 255 is 1
  const uint16_t* fine;                                    // (H, W, 3) or null: 16-bit codes instead of `image`
  const float* background;                                 // (3)
  float white, largest;                                    // codes: of 1; of a clipped pixel
  float rotation[9], across, down, left, top;              // world to camera; at depth 1: a pixel's size, the first pixel's position
  float color_weight, normal_weight, smooth_x_weight, smooth_y_weight, even_x_weight, even_y_weight, alpha_weight, metallic_weight, matte_weight;
  float *photo, *clipped;   // (H, W, 3) the photo over the background; the clipped C, for D-SSIM
  const float* by_clipped;  // (H, W, 3) derivatives of D-SSIM by `clipped`
  float *by_color, *by_normal, *by_depth, *by_alpha, *by_material;
  float* slopes;            // (4, H, W) derivatives of a pixel's normal term by the depths of its right, left, lower and upper neighbour
  double* sums;             // (SUMS) for each row, or on CUDA for each block
  const double *first, *second;  // (SUMS) totals of each pass
  const float* structure;   // (1): D-SSIM, or null
  const float* light;  // (3): the light's mean radiance; or null
  float dssim_weight, light_weight;
  float *loss, *square, *by_light;  // results: the loss; the mean squared error; (3) the derivative by `light`
  mutable Shared shared;
};

enum { LOSS, SURFACES, SQUARES, SUMS };  // sum of weighted terms; number of pixels with a surface; sum of squared errors
constexpr float SOLID = 0.5f, COVERED = 1 / 255.0f;  // least alpha of an opaque pixel, and of one that is not background
constexpr int MATERIAL = 5, METAL = 3, ROUGH = 4;    // channels of a material; the index of metallic, and of roughness
constexpr float FLAT = 0.01f;                        // Huber threshold: smaller differences of metallic or roughness cost quadratically
constexpr float GLOSSY = 0.3f;                       // roughness above this costs: only the photos can justify it

// LANES adjacent pixels of a row.
struct Pixels {
  int64_t x, width;
  MEMBER bool whole() const { return x >= 0 && x + LANES <= width; }
  MEMBER bool has(int lane) const { return x + lane >= 0 && x + lane < width; }
  MEMBER Pixels beside(int64_t dx) const { return {x + dx, width}; }
  MEMBER Mask inside() const {
    Mask m;
    for (int lane = 0; lane < LANES; lane++) m[lane] = -has(lane);
    return m;
  }
  // Load one channel of each pixel from a row with `stride` channels a pixel; zero beyond the row.
  template <class T>
  MEMBER Vector get(const T* row, int stride) const {
    Vector v = {};
    row += x * stride;
    if (whole())
      for (int lane = 0; lane < LANES; lane++) v[lane] = row[lane * stride];
    else
      for (int lane = 0; lane < LANES; lane++)
        if (has(lane)) v[lane] = row[lane * stride];
    return v;
  }
  MEMBER void put(float* row, int stride, Vector v) const {
    row += x * stride;
    if (whole())
      for (int lane = 0; lane < LANES; lane++) row[lane * stride] = v[lane];
    else
      for (int lane = 0; lane < LANES; lane++)
        if (has(lane)) row[lane * stride] = v[lane];
  }
};

INLINE Vector magnitude(Vector v) { return select(v < 0.0f, -v, v); }
INLINE Vector sign(Vector v) { return select(v > 0.0f, Vector() + 1.0f, select(v < 0.0f, Vector() - 1.0f, Vector())); }
INLINE Vector inverse_length(Vectors v) { return reciprocal(root(smaller(dot(v, v) + 1e-24f, Vector() + 1e36f))); }
// The derivative by v, from that by `unit` = v / |v|.
INLINE Vectors by_length(Vectors by, Vectors unit, Vector inverse) { return inverse * (by - dot(by, unit) * unit); }

// Some pixels (`at`) of row y.
struct Row {
  const Losses& l;
  int64_t y;
  Pixels at;
  Mask inside = at.inside();

  MEMBER const float* of(const float* map, int64_t numbers, int64_t dy = 0) const { return map + (y + dy) * l.width * numbers; }
  MEMBER float* of(float* map, int64_t numbers, int64_t dy = 0) const { return map + (y + dy) * l.width * numbers; }
  MEMBER Vectors get3(const float* map, int64_t dx = 0, int64_t dy = 0) const {
    const float* row = of(map, 3, dy);
    Pixels p = at.beside(dx);
    return {p.get(row, 3), p.get(row + 1, 3), p.get(row + 2, 3)};
  }
  MEMBER Vector get(const float* map, int64_t dx = 0, int64_t dy = 0) const { return at.beside(dx).get(of(map, 1, dy), 1); }
  MEMBER Vector inverse_alpha(int64_t dx = 0, int64_t dy = 0) const { return reciprocal(larger(get(l.alpha, dx, dy), Vector() + COVERED)); }
  MEMBER Vector mean_depth(int64_t dx = 0, int64_t dy = 0) const { return get(l.depth, dx, dy) * inverse_alpha(dx, dy); }
  MEMBER void put(float* map, Vector v) const { at.put(of(map, 1), 1, v); }
  MEMBER void put3(float* map, Vectors v) const {
    float* row = of(map, 3);
    at.put(row, 3, v.x), at.put(row + 1, 3, v.y), at.put(row + 2, 3, v.z);
  }
  MEMBER void add(Sum& sum, Vector v) const { sum += convert<Sum>(select(inside, v, Vector())); }
};

// Compose the photo over the background, and compute the colour and mask terms.
INLINE void pixel_terms(const Row& r, Sum (&sums)[SUMS]) {
  const Losses& l = r.l;
  Vector opaque = Vector() + 1.0f, code[3], photo[3], color[3], loss = {}, squares = {};
  if (l.mask) opaque = r.at.get(l.mask + r.y * l.width, 1) / 255.0f;
  for (int c = 0; c < 3; c++) {
    int64_t first = r.y * l.width * 3 + c;
    code[c] = l.fine ? r.at.get(l.fine + first, 3) : r.at.get(l.image + first, 3);
    photo[c] = code[c] / l.white * opaque + (1.0f - opaque) * l.background[c];
    color[c] = r.at.get(r.of(l.color, 3) + c, 3);
  }
  Vector alpha = r.get(l.alpha), by_alpha = {};
  for (int c = 0; c < 3; c++) {
    Vector seen = clamp(color[c], 0, 1) - clamp(photo[c], 0, 1);
    // A clipped pixel is no bound where it is mostly background.
    Mask open = (code[c] < l.largest) | (opaque < SOLID) | (color[c] <= photo[c]);
    Vector clipped = select(open, color[c], photo[c]), error = clipped - photo[c];
    squares += seen * seen;
    loss += l.color_weight * magnitude(error);
    r.at.put(r.of(l.photo, 3) + c, 3, photo[c]);
    r.at.put(r.of(l.clipped, 3) + c, 3, clipped);
    r.at.put(r.of(l.by_color, 3) + c, 3, select(open, l.color_weight * sign(error), Vector()));
  }
  if (l.mask) loss += l.alpha_weight * magnitude(alpha - opaque), by_alpha = l.alpha_weight * sign(alpha - opaque);
  r.put(l.by_alpha, by_alpha);
  r.add(sums[LOSS], loss), r.add(sums[SQUARES], squares);
  r.add(sums[SURFACES], select(alpha > COVERED, Vector() + 1.0f, Vector()));
}

// The normal term. The normal of the depth map is found by central differences. The pixel's ray meets depth 1 at (X, Y); p and t are the
// differences of depth along x and y; q and s are the widths of two pixels at those depths. The tangents are (X p + q, Y p, p) and
// (X t, Y t + s, t). Their cross product, turned towards the camera, is N = (p s, q t, -(q s + X p s + Y q t)).
INLINE void normal_term(const Row& r, Sum& loss) {
  const Losses& l = r.l;
  float* slopes[4];
  for (int i = 0; i < 4; i++) slopes[i] = l.slopes + i * l.width * l.height;
  Mask solid = l.normal_weight > 0 && r.y > 0 && r.y + 1 < l.height ? r.inside : Mask();
  for (int lane = 0; lane < LANES; lane++) solid[lane] &= -(r.at.x + lane > 0 && r.at.x + lane + 1 < l.width);
  if (any(solid))
    solid &= (r.get(l.alpha, 1) > SOLID) & (r.get(l.alpha, -1) > SOLID) & (r.get(l.alpha, 0, 1) > SOLID) & (r.get(l.alpha, 0, -1) > SOLID);
  if (!any(solid)) {
    for (float* slope : slopes) r.put(slope, Vector());
    return r.put3(l.by_normal, {});
  }
  Vectors n = r.get3(l.normal);
  float Y = (float)(int32_t)r.y * l.down + l.top;
  Vector X;
  for (int lane = 0; lane < LANES; lane++) X[lane] = (float)(int32_t)(r.at.x + lane) * l.across + l.left;
  // Depths are zero in lanes that are not solid: an outlier there must not become a NaN that enters the sums.
  auto depth = [&](int dx, int dy) { return select(solid, r.mean_depth(dx, dy), Vector()); };
  Vector right = depth(1, 0), left = depth(-1, 0), below = depth(0, 1), above = depth(0, -1);
  Vector p = right - left, q = (right + left) * l.across, t = below - above, s = (below + above) * l.down;
  Vectors N = {p * s, q * t, -(q * s + X * p * s + Y * q * t)};
  const float* R = l.rotation;
  Vectors m = {R[0] * n.x + R[1] * n.y + R[2] * n.z, R[3] * n.x + R[4] * n.y + R[5] * n.z, R[6] * n.x + R[7] * n.y + R[8] * n.z};
  Vector inverse_N = inverse_length(N), inverse_m = inverse_length(m);
  Vectors of_depth = inverse_N * N, blended = inverse_m * m;
  Vector w = select(solid, Vector() + l.normal_weight, Vector());
  r.add(loss, w * (1.0f - dot(of_depth, blended)));
  Vectors g = by_length(-w * blended, of_depth, inverse_N), h = by_length(-w * of_depth, blended, inverse_m);
  r.put3(l.by_normal, {R[0] * h.x + R[3] * h.y + R[6] * h.z, R[1] * h.x + R[4] * h.y + R[7] * h.z, R[2] * h.x + R[5] * h.y + R[8] * h.z});
  Vector by_p = s * (g.x - X * g.z), by_q = (t * g.y - (s + Y * t) * g.z) * l.across;
  Vector by_t = q * (g.y - Y * g.z), by_s = (p * g.x - (q + X * p) * g.z) * l.down;
  r.put(slopes[0], by_q + by_p), r.put(slopes[1], by_q - by_p), r.put(slopes[2], by_s + by_t), r.put(slopes[3], by_s - by_t);
}

// The smoothness term between a pixel and its neighbour at (dx, dy): differences of the normal, of metallic and of roughness. Both pixels
// compute it for their own derivatives. Only the first of the two adds it to the loss.
INLINE void smooth_term(const Row& r, int dx, int dy, float smooth, float even, Sum& loss, Vectors& by_normal, Vector (&by_material)[2]) {
  const Losses& l = r.l;
  Mask both = r.inside & r.at.beside(dx).inside();
  if ((smooth == 0 && even == 0) || r.y + dy < 0 || r.y + dy >= l.height) return;
  both &= (r.get(l.alpha) > SOLID) & (r.get(l.alpha, dx, dy) > SOLID);
  if (!any(both)) return;
  Vectors n = r.get3(l.normal) - r.get3(l.normal, dx, dy), photo = r.get3(l.photo) - r.get3(l.photo, dx, dy);
  Vector edge = magnitude(photo.x) + magnitude(photo.y) + magnitude(photo.z), kept = select(both, exp2(-1.442695f * edge), Vector());
  Vector w = smooth * kept, by_even = even * kept, cost = w * (magnitude(n.x) + magnitude(n.y) + magnitude(n.z));
  by_normal = by_normal + Vectors{w * sign(n.x), w * sign(n.y), w * sign(n.z)};
  for (int i = 0; i < 2 && even != 0; i++) {
    Vector m =
        r.at.get(r.of(l.material, MATERIAL) + METAL + i, MATERIAL) - r.at.beside(dx).get(r.of(l.material, MATERIAL, dy) + METAL + i, MATERIAL);
    Vector slope = clamp(m * (1 / FLAT), -1, 1);  // Huber loss: in even regions the sign of rounding errors must not matter
    cost += by_even * slope * (m - 0.5f * FLAT * slope), by_material[i] += by_even * slope;
  }
  if (dx + dy > 0) r.add(loss, cost);
}

// Call body(row, sums) for all pixels. Sums are kept for each row; on CUDA for each block, which has a tile of 32 x 8 pixels.
template <class Body>
void each(const Losses* l, Body body) {
#ifdef __CUDACC__
  int block = blockIdx.x, thread = threadIdx.x, tiles = (int)((l->width + 31) / 32);
  int64_t x = block % tiles * 32 + thread % 32, y = block / tiles * 8 + thread / 32;
  Sum sums[SUMS];
  if (x < l->width && y < l->height) body(Row{*l, y, {x, l->width}}, sums);
  float numbers[SUMS];
  for (int i = 0; i < SUMS; i++) numbers[i] = sums[i][0];
  sum_over_block(numbers, l->sums + blockIdx.x * SUMS);
#else
  const int64_t ROWS = 4;
  share(l->shared, l->height, ROWS, [&](int64_t y) {
    Sum sums[SUMS] = {};
    for (int64_t x = 0; x < l->width; x += LANES) body(Row{*l, y, {x, l->width}}, sums);
    for (int i = 0; i < SUMS; i++) {
      l->sums[y * SUMS + i] = 0;
      for (int lane = 0; lane < LANES; lane++) l->sums[y * SUMS + i] += sums[i][lane];
    }
  });
#endif
}

}  // namespace

// First pass: terms of a pixel by itself, and the normal term, which reads the depths around it.
KERNEL(refgs_losses_first, Losses, l) {
  each(l, [](const Row& r, Sum(&sums)[SUMS]) {
    pixel_terms(r, sums);
    normal_term(r, sums[LOSS]);
  });
}

// Second pass: terms between neighbours, and derivatives that come from the neighbours' normal terms.
KERNEL(refgs_losses_second, Losses, l) {
  each(l, [](const Row& r, Sum(&sums)[SUMS]) {
    const Losses& l = r.l;
    Vectors by_normal = r.get3(l.by_normal);
    Vector by_smooth[2] = {};  // of metallic and roughness
    for (int step = -1; step <= 1; step += 2) {
      smooth_term(r, step, 0, l.smooth_x_weight, l.even_x_weight, sums[LOSS], by_normal, by_smooth);
      smooth_term(r, 0, step, l.smooth_y_weight, l.even_y_weight, sums[LOSS], by_normal, by_smooth);
    }

    int64_t size = l.width * l.height;
    Vector by_depth = r.get(l.slopes, -1) + r.get(l.slopes + size, 1);
    if (r.y > 0) by_depth += r.get(l.slopes + 2 * size, 0, -1);
    if (r.y + 1 < l.height) by_depth += r.get(l.slopes + 3 * size, 0, 1);
    Vector inverse = r.inverse_alpha(), alpha = r.get(l.alpha);
    Vector by_alpha = r.get(l.by_alpha) - select(alpha >= COVERED, by_depth * r.mean_depth() * inverse, Vector());

    Vectors color = r.get3(l.color), clipped = r.get3(l.clipped), by = r.get3(l.by_color), share = r.get3(l.by_clipped);
    auto open = [](Vector color, Vector clipped, Vector share) { return select(color == clipped, share, Vector()); };
    r.put3(l.by_normal, by_normal), r.put(l.by_depth, by_depth * inverse), r.put(l.by_alpha, by_alpha);
    r.put3(l.by_color, by + Vectors{open(color.x, clipped.x, share.x), open(color.y, clipped.y, share.y), open(color.z, clipped.z, share.z)});

    if (!l.material) return;
    const float* material = r.of(l.material, MATERIAL);
    auto of_material = [&](int i) { return r.at.get(material + i, MATERIAL); };
    Vector metallic = of_material(METAL);
    float surfaces = (float)l.first[SURFACES], share_of_each = 1 / (surfaces > 1 ? surfaces : 1);
    float weight = share_of_each * l.metallic_weight;
    Vector matte = of_material(ROUGH) - GLOSSY, slope = clamp(matte * (1 / FLAT), 0, 1);  // Huber loss, as surfels may start at the kink
    Vector felt = share_of_each * l.matte_weight * slope;
    r.add(sums[LOSS], weight * metallic * (1.0f - metallic) + felt * (matte - 0.5f * FLAT * slope));
    by_smooth[0] += weight * (1.0f - 2.0f * metallic), by_smooth[1] += felt;
    float* row = r.of(l.by_material, MATERIAL);
    for (int i = 0; i < MATERIAL; i++) r.at.put(row + i, MATERIAL, i < METAL ? Vector() : by_smooth[i - METAL]);
  });
}

// Add up the loss, including the light's term: the squared departure of its mean radiance from grey. For channels m with mean u it is
// mean((m / u - 1)^2).
KERNEL(refgs_losses_total, Losses, l) {
  share(l->shared, 1, 1, [&](int64_t) {
    const double *first = l->first, *second = l->second;
    double loss = first[LOSS] + second[LOSS];
    if (l->structure) loss += l->dssim_weight * (double)*l->structure;
    if (l->light) {
      double mean = 0, square = 0, along = 0, departure[3];  // along: the derivative through the mean
      for (int c = 0; c < 3; c++) mean += l->light[c] / 3.0;
      double weight = mean > 1e-9 ? l->light_weight : 0;  // a black light has no hue
      mean = mean > 1e-9 ? mean : 1;
      for (int c = 0; c < 3; c++) {
        departure[c] = l->light[c] / mean - 1;
        square += departure[c] * departure[c] / 3, along += departure[c] * (departure[c] + 1) / 3;
      }
      loss += weight * square;
      for (int c = 0; c < 3; c++) l->by_light[c] = (float)(weight * 2 / 3 * (departure[c] - along) / mean);
    }
    *l->loss = (float)loss;
    *l->square = (float)(first[SQUARES] / (3 * l->width * l->height));
  });
}
