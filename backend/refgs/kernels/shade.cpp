// Deferred shading of the blended maps (paper Eq. 5-10), and its derivatives. It also shades surfels before they are blended (paper 3.3,
// the initial stage): a "pixel" is a surfel then, with its own direction to the camera. Covered pixels are gathered LANES at a time, so
// that background costs nothing.
#include "blended.h"
#include "sums.h"

namespace {

INLINE Vectors towards_camera(const Shade& s, const Pixels& p) {
  const float* m = s.view;
  Vector x = ((s.cx - 0.5f) - load(p.column)) * (1 / s.fx), y = ((s.cy - 0.5f) - load(p.row)) * (1 / s.fy);
  auto along = [&](int i) { return x * m[i] + y * m[4 + i] - m[8 + i]; };
  Vectors v = {along(0), along(1), along(2)};
  return inverse_norm(v) * v;
}

// Rotate by m; by its inverse.
INLINE Vectors turned(const float* m, Vectors v) {
  auto row = [&](int i) { return m[i] * v.x + m[i + 1] * v.y + m[i + 2] * v.z; };
  return {row(0), row(3), row(6)};
}
INLINE Vectors turned_back(const float* m, Vectors v) {
  auto column = [&](int i) { return m[i] * v.x + m[i + 3] * v.y + m[i + 6] * v.z; };
  return {column(0), column(1), column(2)};
}

INLINE Vectors mirror(Vectors normal, Vectors view, Vector& n_dot_v) {
  n_dot_v = dot(normal, view);
  return 2.0f * n_dot_v * normal - view;
}

// Encode exposed radiance for blending over the background, with the derivative. Surfels are blended unencoded.
template <bool SPLATS>
INLINE void encode(const Shade& s, Vector exposed, Vector& encoded, Vector& slope) {
  if (SPLATS || s.display)
    encoded = exposed, slope = Vector() + 1.0f;
  else
    encoded = srgb_encode(exposed, slope);
}

template <bool SPLATS, class Map>
INLINE void write_pixels(const Shade& s, const Map& map, const Vector (&radiance)[3], const Vector (&encoded)[3], const Vector (&material)[5]) {
  if (SPLATS) return scatter<3>(s.color, map.pixels, radiance);
  Vector color[3];
  for (int c = 0; c < 3; c++) color[c] = encoded[c] * map.alpha + (1.0f - map.alpha) * s.background[c];
  scatter<3>(s.color, map.pixels, color);
  scatter<3>(s.normal, map.pixels, {map.value[NORMAL], map.value[NORMAL + 1], map.value[NORMAL + 2]});
  scatter<5>(s.material, map.pixels, material);
  scatter<3>(s.radiance, map.pixels, radiance);
}

// Split-sum shading of a metallic-roughness material, LANES pixels at a time.
// HARMONICS: directional colour replaces the reflected irradiance.
// INDIRECT: light from the object itself where it occludes the mirror direction (Eq. 9), and its shadow on the irradiance.
// SPLATS: pixels are surfels.
// Irradiance varies too slowly with the normal to need Displaced's. It uses the blended normal, as what is matte does: the derivative by the
// displacement would move surfels wherever neighbouring normals differ, and photos were fitted less well.
// Directions are in the light's frame, because the light may turn with the camera.
template <bool HARMONICS, bool INDIRECT, bool SPLATS, bool DERIVATIVES>
struct Shaded {
  static constexpr bool SHADOW = INDIRECT && !HARMONICS;
  static constexpr int DIFFUSE = 8, FROM_OBJECT = INDIRECT ? 11 : 0;  // channels: directional colour or shadow; the object's light
  static constexpr int C = 11 + 3 * (HARMONICS || INDIRECT) + 3 * INDIRECT, S = C - 3;
  Map<SPLATS, C, DERIVATIVES> map;
  Vector inverse_length, inverse_blended, n_dot_v, visibility;
  Vectors normal, blended, view;
  Lookup<2, DERIVATIVES> lookup;
  Lookup<1, DERIVATIVES> irradiance;
  ReflectanceTable table;
  Vector light[3], received[3], radiance[3], encoded[3], slope[3];
  float exposure[3];

  MEMBER Shaded(const Shade& s, const Pixels& pixels)
      : map(s, pixels),
        inverse_length(inverse_norm(normal_of(map.value))),
        inverse_blended(inverse_norm(map.blended())),
        normal(inverse_length * turned(s.turn, normal_of(map.value))),
        blended(inverse_blended * turned(s.turn, map.blended())),
        view(turned(s.turn, seen_from(s))),
        lookup(s.levels, mirrored(), s.mirror ? Vector() : map.value[ROUGHNESS]),
        irradiance(s.levels, blended),
        table(s.reflectance, s.reflectance_side, n_dot_v, map.value[ROUGHNESS]),
        exposure{s.exposure[0], s.exposure[1], s.exposure[2]} {
    const auto& v = map.value;
    Vector metallic = v[METALLIC];
    visibility = Vector() + 1.0f;
    if (INDIRECT) {
      Vector free[1];
      gather<1>(s.visibility, pixels, free);
      visibility = free[0];
      for (int c = 0; c < 3; c++) light[c] = visibility * lookup.light[c] + (1.0f - visibility) * v[FROM_OBJECT + c];
    } else {
      for (int c = 0; c < 3; c++) light[c] = lookup.light[c];
    }
    Vector dielectric = table.value[ReflectanceTable::DIELECTRIC];
#pragma unroll
    for (int c = 0; c < 3; c++) {
      received[c] = HARMONICS ? v[DIFFUSE + c] : SHADOW ? v[DIFFUSE + c] * irradiance.light[c] : irradiance.light[c];
      Vector diffuse = (1.0f - metallic) * received[c];
      if (!HARMONICS) diffuse *= (1.0f - dielectric) * v[ALBEDO + c];
      radiance[c] = light[c] * reflected(s, Metal(table, v[ALBEDO + c])) + diffuse;
      encode<SPLATS>(s, exposure[c] * radiance[c], encoded[c], slope[c]);
    }
  }

  MEMBER void write(const Shade& s) const {
    const auto& v = map.value;
    write_pixels<SPLATS>(s, map, radiance, encoded, {v[ALBEDO], v[ALBEDO + 1], v[ALBEDO + 2], v[METALLIC], v[ROUGHNESS]});
  }

  template <class Sums>
  MEMBER void backward(const Shade& s, Sums& sums) const {
    Vector by_color[3], by_normal[3] = {}, by_material[5] = {}, by_alpha = {}, by_exposure[3];
    gather<3>(s.by_color, map.pixels, by_color);
    if (!SPLATS) gather<3>(s.by_normal, map.pixels, by_normal), gather<5>(s.by_material, map.pixels, by_material);

    const auto& v = map.value;
    Vector metallic = v[METALLIC], dielectric = table.value[ReflectanceTable::DIELECTRIC];
    Vector by[S] = {}, by_light[3], by_table[4] = {}, by_irradiance[3];
    by[METALLIC] = by_material[3], by[ROUGHNESS] = by_material[4];
    Vectors by_n = {};
#pragma unroll
    for (int c = 0; c < 3; c++) {
      Metal metal(table, v[ALBEDO + c]);
      if (!SPLATS) by_alpha += by_color[c] * (encoded[c] - s.background[c]);
      Vector by_exposed = by_color[c] * map.alpha * slope[c], by_radiance = exposure[c] * by_exposed;
      by_exposure[c] = by_exposed * radiance[c];
      by_light[c] = by_radiance * reflected(s, metal);
      if (INDIRECT) {
        by[FROM_OBJECT + c] = (1.0f - visibility) * by_light[c];
        by_light[c] *= visibility;
      }
      Vector by_reflectance = by_radiance * light[c];
      if (s.mirror) by[METALLIC] += by_reflectance, by_reflectance = Vector();
      Vector by_metal = by_reflectance * metallic;
      by[METALLIC] += by_reflectance * (metal.value - dielectric);
      by[ALBEDO + c] = by_material[c] + by_metal * metal.by_f0;
      for (int i = 0; i < 2; i++) by_table[i] += by_metal * metal.by_fg[i];
      by_table[ReflectanceTable::AVERAGE] += by_metal * metal.by_average;
      by_table[ReflectanceTable::DIELECTRIC] += by_reflectance - by_metal;
      if (HARMONICS) {
        by[DIFFUSE + c] = by_radiance * (1.0f - metallic);
        by[METALLIC] -= by_radiance * received[c];
      } else {
        Vector by_diffuse = by_radiance * received[c], base = (1.0f - metallic) * (1.0f - dielectric);
        by[ALBEDO + c] += by_diffuse * base;
        by_diffuse *= v[ALBEDO + c];
        by[METALLIC] -= by_diffuse * (1.0f - dielectric);
        by_table[ReflectanceTable::DIELECTRIC] -= by_diffuse * (1.0f - metallic);
        by_irradiance[c] = by_radiance * base * v[ALBEDO + c];
        if (SHADOW) by[DIFFUSE + c] = by_irradiance[c] * irradiance.light[c], by_irradiance[c] *= v[DIFFUSE + c];
      }
    }
    Vector by_blended[3] = {};
    if (!HARMONICS) {
      Vectors by_b = irradiance.backward(by_irradiance);
      by_b = turned_back(s.turn, inverse_blended * (by_b - dot(by_b, blended) * blended));
      by_blended[0] = by_b.x, by_blended[1] = by_b.y, by_blended[2] = by_b.z;
      sums.add_light(irradiance, map.pixels.count, by_irradiance);
    }
    sums.add_exposure(by_exposure);
    Vector by_n_v = {};
    for (int i = 0; i < 4; i++) {
      by[ROUGHNESS] += by_table[i] * table.by_roughness[i];
      by_n_v += by_table[i] * table.by_n_v[i];
    }
    Vector by_roughness;
    Vectors by_mirrored = lookup.backward(by_light, by_roughness);
    sums.add_light(lookup, map.pixels.count, by_light);
    if (!s.mirror) by[ROUGHNESS] += by_roughness;
    Vector by_dot = 2.0f * dot(by_mirrored, normal) + by_n_v;
    by_n = by_n + 2.0f * n_dot_v * by_mirrored + by_dot * view;
    by_n = turned_back(s.turn, inverse_length * (by_n - dot(by_n, normal) * normal));
    by[NORMAL] = by_n.x + by_normal[0], by[NORMAL + 1] = by_n.y + by_normal[1], by[NORMAL + 2] = by_n.z + by_normal[2];
    if constexpr (SPLATS) {
      Vectors by_view = by_dot * normal - by_mirrored;
      by_view = turned_back(s.turn, inverse_norm(map.to_camera(s)) * (by_view - dot(by_view, view) * view));
      Vector by_own[C] = {};
      for (int c = 0; c < S; c++) by_own[c] = c < ALBEDO ? by[c] + by_blended[c] : by[c];
      by_own[S] = -by_view.x, by_own[S + 1] = -by_view.y, by_own[S + 2] = -by_view.z;
      sums.add_own(map.pixels, by_own, by_alpha);
    } else {
      map.backward(s, by, by_blended, by_alpha, sums);
    }
  }

 private:
  // Fraction of the light from the mirror direction that is reflected.
  MEMBER Vector reflected(const Shade& s, const Metal& metal) const {
    Vector metallic = map.value[METALLIC], dielectric = table.value[ReflectanceTable::DIELECTRIC];
    return s.mirror ? metallic : dielectric + metallic * (metal.value - dielectric);
  }
  MEMBER Vectors seen_from(const Shade& s) const {
    if constexpr (SPLATS) {
      Vectors v = map.to_camera(s);
      return inverse_norm(v) * v;
    } else {
      return towards_camera(s, map.pixels);
    }
  }

  MEMBER Vectors mirrored() { return mirror(normal, view, n_dot_v); }
};

// Shading of a matte surface: albedo times irradiance, for LANES pixels or surfels (SPLATS).
template <bool SPLATS, bool DERIVATIVES>
struct Matte {
  static constexpr int C = 6;  // normal, albedo
  Mean<C> map;
  Vector inverse_length;
  Vectors normal;
  Lookup<1, DERIVATIVES> irradiance;
  Vector radiance[3], encoded[3], slope[3];
  float exposure[3];

  MEMBER Matte(const Shade& s, const Pixels& pixels)
      : map(s, pixels),
        inverse_length(inverse_norm(normal_of(map.value))),
        normal(inverse_length * turned(s.turn, normal_of(map.value))),
        irradiance(s.levels, normal),
        exposure{s.exposure[0], s.exposure[1], s.exposure[2]} {
#pragma unroll
    for (int c = 0; c < 3; c++) {
      radiance[c] = map.value[ALBEDO + c] * irradiance.light[c];
      encode<SPLATS>(s, exposure[c] * radiance[c], encoded[c], slope[c]);
    }
  }

  MEMBER void write(const Shade& s) const {
    const auto& v = map.value;
    write_pixels<SPLATS>(s, map, radiance, encoded, {v[ALBEDO], v[ALBEDO + 1], v[ALBEDO + 2], Vector(), Vector() + 1.0f});
  }

  template <class Sums>
  MEMBER void backward(const Shade& s, Sums& sums) const {
    Vector by_color[3], by_normal[3] = {}, by_material[5] = {}, by_alpha = {}, by_exposure[3], by[C] = {}, by_irradiance[3];
    gather<3>(s.by_color, map.pixels, by_color);
    if (!SPLATS) gather<3>(s.by_normal, map.pixels, by_normal), gather<5>(s.by_material, map.pixels, by_material);
#pragma unroll
    for (int c = 0; c < 3; c++) {
      if (!SPLATS) by_alpha += by_color[c] * (encoded[c] - s.background[c]);
      Vector by_exposed = by_color[c] * map.alpha * slope[c], by_radiance = exposure[c] * by_exposed;
      by_exposure[c] = by_exposed * radiance[c];
      by[ALBEDO + c] = by_material[c] + by_radiance * irradiance.light[c];
      by_irradiance[c] = by_radiance * map.value[ALBEDO + c];
    }
    sums.add_exposure(by_exposure);
    sums.add_light(irradiance, map.pixels.count, by_irradiance);
    Vectors by_n = irradiance.backward(by_irradiance);
    by_n = turned_back(s.turn, inverse_length * (by_n - dot(by_n, normal) * normal));
    by[NORMAL] = by_n.x + by_normal[0], by[NORMAL + 1] = by_n.y + by_normal[1], by[NORMAL + 2] = by_n.z + by_normal[2];
    map.backward(by, by_alpha, sums);
  }
};

void mirrored_pixels(const Shade& s, int64_t first, int64_t end) {
  for (int64_t i = 3 * first; i < 3 * end; i++) s.mirrored[i] = 0;
  each_covered(s, first, end, [&](const Pixels& pixels) {
    Displaced<17, false> map(s, pixels);  // the number of channels with INDIRECT
    Vectors normal = normal_of(map.value), view = towards_camera(s, pixels);
    Vector n_dot_v;
    Vectors m = mirror(inverse_norm(normal) * normal, view, n_dot_v);
    scatter<3>(s.mirrored, pixels, {m.x, m.y, m.z});
  });
}

template <bool SPLATS, class Shown, class Differentiated>
struct Kind {
  static void forward(const Shade& s, int64_t first, int64_t end) {
    const float background[3] = {s.background[0], s.background[1], s.background[2]};
    for (int64_t i = first; !SPLATS && i < end; i++) {
      for (int c = 0; c < 3; c++) s.color[3 * i + c] = background[c], s.normal[3 * i + c] = s.radiance[3 * i + c] = 0;
      for (int c = 0; c < 5; c++) s.material[5 * i + c] = 0;
    }
    each_covered(s, first, end, [&](const Pixels& pixels) { Shown(s, pixels).write(s); });
  }

  template <class Sums>
  static void backward(const Shade& s, int64_t first, int64_t end, Sums& sums) {
    each_covered(s, first, end, [&](const Pixels& pixels) { Differentiated(s, pixels).backward(s, sums); });
  }
};
template <bool HARMONICS, bool INDIRECT, bool SPLATS = false>
using Glossy = Kind<SPLATS, Shaded<HARMONICS, INDIRECT, SPLATS, false>, Shaded<HARMONICS, INDIRECT, SPLATS, true>>;
template <bool SPLATS = false>
using Dull = Kind<SPLATS, Matte<SPLATS, false>, Matte<SPLATS, true>>;

// Call body(kind) with the kind of shading that `s` asks for.
template <class Body>
void by_kind(const Shade& s, Body body) {
  if (s.matte)
    s.splats ? body(Dull<true>()) : body(Dull<>());
  else if (s.splats)
    s.harmonics ? body(Glossy<true, false, true>()) : body(Glossy<false, false, true>());
  else if (s.visibility)
    s.harmonics ? body(Glossy<true, true>()) : body(Glossy<false, true>());
  else
    s.harmonics ? body(Glossy<true, false>()) : body(Glossy<false, false>());
}

// Call body(first, end) for strips of pixels until all are done.
template <class Body>
void share_pixels(const Shade& s, Body body) {
  const int64_t STRIP = LANES == 1 ? 1 : 8 * s.width;
  int64_t pixels = s.width * s.height;
  share(s.shared, (pixels + STRIP - 1) / STRIP, 1, [&](int64_t i) {
    int64_t first = i * STRIP;
    body(first, first + STRIP < pixels ? first + STRIP : pixels);
  });
}

#ifdef __CUDACC__
// One thread a pixel. With LARGEST, only find the largest contributions.
template <bool LARGEST>
void backward_block(const Shade& s) {
  int64_t pixels = s.width * s.height, i = (int64_t)blockIdx.x * blockDim.x + threadIdx.x;
  Contributions<LARGEST> sums(s);
  bool covered = i < pixels && s.alpha[i] > COVERED;
  if (covered) by_kind(s, [&](auto kind) { kind.backward(s, i, i + 1, sums); });
  int lane = threadIdx.x % 32, warp = threadIdx.x / 32, warps = (blockDim.x + 31) / 32;
  if (LARGEST) {
    for (int step = 16; step; step /= 2) {
      int32_t map = __shfl_xor_sync(~0u, sums.largest_map, step), cell = __shfl_xor_sync(~0u, sums.largest_cell, step);
      sums.largest_map = map > sums.largest_map ? map : sums.largest_map;
      sums.largest_cell = cell > sums.largest_cell ? cell : sums.largest_cell;
    }
    if (lane == 0 && sums.largest_map) atomicMax(s.largest, sums.largest_map);
    if (lane == 0 && sums.largest_cell) atomicMax(s.largest + 1, sums.largest_cell);
    return;
  }
  if (i < pixels && !covered) {
    for (int64_t c = 0; c < s.channels; c++) s.by_features[i * s.channels + c] = 0;
    s.by_alpha[i] = 0;
  }
  __shared__ float by_warp[3][32];
  for (int c = 0; c < 3; c++) {
    float sum = sums.by_exposure[c];
    for (int step = 16; step; step /= 2) sum += __shfl_xor_sync(~0u, sum, step);
    if (lane == 0) by_warp[c][warp] = sum;
  }
  __syncthreads();
  if (threadIdx.x < 3) {
    float sum = 0;
    for (int w = 0; w < warps; w++) sum += by_warp[threadIdx.x][w];
    s.by_exposure[3 * (int64_t)blockIdx.x + threadIdx.x] = sum;
  }
}
#else
void backward_chunk(const Shade& s, int64_t index) {
  Chunk chunk(s, index);
  by_kind(s, [&](auto kind) { kind.backward(s, chunk.first, chunk.end, chunk); });
  for (int c = 0; c < 3; c++) s.by_exposure[3 * index + c] = total(chunk.by_exposure[c]);
}
#endif

constexpr int BATCH = 1024;  // cells or texels at a time

}  // namespace

// Copy the light's texels to the cells of the padded faces.
KERNEL(refgs_shade_pad, Shade, s) {
  share(s->shared, s->cells, BATCH, [light = s->light, texel = s->texel, padded = s->padded](int64_t i) {
    const float* from = light + 3 * texel[i];
    *(Four*)(padded + 4 * i) = Four{from[0], from[1], from[2], 0};
  });
}

KERNEL(refgs_shade_mirrored, Shade, s) {
  share_pixels(*s, [&](int64_t first, int64_t end) { mirrored_pixels(*s, first, end); });
}

KERNEL(refgs_shade_forward, Shade, s) {
  share_pixels(*s, [&](int64_t first, int64_t end) { by_kind(*s, [&](auto kind) { kind.forward(*s, first, end); }); });
}

#ifdef __CUDACC__
KERNEL(refgs_shade_largest, Shade, s) { backward_block<true>(*s); }
KERNEL(refgs_shade_backward, Shade, s) { backward_block<false>(*s); }

KERNEL(refgs_shade_gather, Shade, s) {
  int64_t pixels = s->width * s->height;
  float unit = Unit(s->largest[0], SOURCES).size;
  share(s->shared, pixels, 1, [&](int64_t i) {
    for (int64_t c = 0; c < ALBEDO; c++) s->by_features[i * s->channels + c] += unit * (float)s->map_sums[c * pixels + i];
    s->by_alpha[i] += unit * (float)s->map_sums[3 * pixels + i];
  });
}

KERNEL(refgs_shade_unpad, Shade, s) {
  float unit = Unit(s->largest[1], adders(*s)).size;
  share(s->shared, s->texels, BATCH, [&](int64_t i) {
    int64_t sum[3] = {};
    for (int32_t k = s->starts[i]; k < s->starts[i + 1]; k++)
      for (int c = 0; c < 3; c++) sum[c] += s->cell_sums[3 * (int64_t)s->cell[k] + c];
    for (int c = 0; c < 3; c++) s->by_light[3 * i + c] = unit * (float)sum[c];
  });
}
#else
KERNEL(refgs_shade_backward, Shade, s) {
  share(s->shared, chunks(*s), 1, [&](int64_t k) { backward_chunk(*s, k); });
}

KERNEL(refgs_shade_gather, Shade, s) {
  share(s->shared, s->height + s->lines, 8, [&](int64_t k) { k < s->height ? add_near(*s, k) : add_line(*s, (int32_t)(k - s->height)); });
}

KERNEL(refgs_shade_unpad, Shade, s) {
  const float* sums = s->by_cells + chunks(*s) * 4 * s->cells;
  share(s->shared, s->texels, BATCH, [&](int64_t i) {
    Four sum = {};
    for (int32_t k = s->starts[i]; k < s->starts[i + 1]; k++) sum += *(const Four*)(sums + 4 * (int64_t)s->cell[k]);
    for (int c = 0; c < 3; c++) s->by_light[3 * i + c] = sum[c];
  });
}

EXPORT int64_t refgs_shade_halo() { return 2 * HALO; }
#endif
