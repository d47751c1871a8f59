// The reflectance integral of surface points by importance sampling: L_o(v) = ∫ L(l) f(l, v)(n·l) dω as the mean of
// L f (n·l)/pdf over samples l, each read from the level of the pyramid whose texels are as large as the sample's
// solid angle Ω = 1/(N pdf) [Krivanek2008, sec. 3]. How l is drawn is compiled in:
//
//   VISIBLE  normals that v sees, of an ellipsoid: spherical caps in the space where it is a sphere [Dupuy2023]. Then
//            pdf = D/(4 A(v)), A Smith's projected area, and what is left of f (n·l)/pdf is F V (n·l) A(v)
//   NORMALS  normals of density D (n·h), any isotropic NDF: pdf = D (n·h)/(4 v·h), left is F V (n·l)(v·h)/(n·h)
//   COSINE   directions of density n·l/π for a diffuse model: left is π f
//
// Each SIMD lane computes one output; samples are read as uniform scalars, in the frame of x along v's projection,
// z = n. SETS sets of
// the models' numbers share the directions and the reads (Schlick of F0 0 and 1 gives all others; a metal's R, G, B): a
// cell_values column each. The weights are summed too: their mean is the albedo, which the host computes more exactly.
//
// surface: [8][outputs]: n, x (world), n·v, √(1 - (n·v)²). sample: 4 scalars, the last what Ω takes of it alone.
// partial: [split][SETS][4][outputs].

// ½ log2 x: the exponent and a parabola of the mantissa, |error| < 3e-3 of a level. x > 0.
static inline real level_of(real x) {
#if PRECISION == 64
  return log2(x) / 2;
#else
  const bits i = AS_INT(x);
  const real m = AS_REAL((i & 0x7fffff) | 0x3f800000), e = TO_REAL((i >> 23) - 127);
  return (e + fma(fma((real)-0.34484843f, m, (real)2.02466578f), m, (real)-1.67487759f)) / 2;
#endif
}

__kernel void reflect(__global scalar *restrict partial, const int outputs, const int samples, const int chunk,
                      __global const scalar *restrict surface, __global const scalar *restrict sample, const int size,
                      const int levels, __global const QUAD *restrict pyramid, const int cells CELL_ARRAYS) {
  const int item = get_global_id(0), split = get_global_id(1);
  if ((item + 1) * W > outputs) return;
  const real nx = LOAD(item, surface), ny = LOAD(item, surface + outputs), nz = LOAD(item, surface + 2 * outputs);
  const real tx = LOAD(item, surface + 3 * outputs), ty = LOAD(item, surface + 4 * outputs);
  const real tz = LOAD(item, surface + 5 * outputs);
  const real bx = ny * tz - nz * ty, by = nz * tx - nx * tz, bz = nx * ty - ny * tx;
  const real NoV = LOAD(item, surface + 6 * outputs), sin_v = LOAD(item, surface + 7 * outputs);
  const int g = 0;
  CELL_LOAD
#ifdef VISIBLE
  // v where the ellipsoid of α = NDF_WIDTH is a sphere.
  const real stretch = NDF_WIDTH, longer = 1 / sqrt(sqr(stretch * sin_v) + sqr(NoV));
  const real wx = stretch * sin_v * longer, wz = NoV * longer, area = NDF_AREA(NoV);
#endif
#ifndef COSINE
  const real at_v = MASKING_AT(NoV);
#endif
  QUAD sum[SETS][W];
  real all[SETS];
  for (int f = 0; f < SETS; f++) {
    all[f] = (real)0;
    for (int k = 0; k < W; k++) sum[f][k] = (QUAD)(0);
  }
  const real top = (real)(levels - 1);
  const int end = min(samples, (split + 1) * chunk);
  __global const scalar *restrict p = sample + 4 * (size_t)split * chunk;
  Taps low, high;
  for (int i = split * chunk; i < end; i++, p += 4) {
    const scalar s0 = p[0], s1 = p[1], s2 = p[2], s3 = p[3];
#ifdef COSINE
    const real lx = (real)s0, ly = (real)s1, lz = (real)s2, above = (real)1;
    const real lod_of = (real)s3;
#else
#ifdef VISIBLE
    const real z = (1 - s0) * (1 + wz) - wz, ring = sqrt(fmax(one_minus_sqr(z), (real)0));
    const real mx = stretch * fma(ring, (real)s1, wx), my = stretch * ring * s2, mz = fmax(z + wz, (real)0);
    const real per = 1 / sqrt(fmax(mx * mx + my * my + mz * mz, (real)1e-30f));
    const real hx = mx * per, hy = my * per, NoH = fmin(mz * per, (real)1);
#else
    const real hx = (real)s0, hy = (real)s1, NoH = (real)s2;
#endif
    const real VoH = fma(sin_v, hx, NoV * NoH);
    const real lx = 2 * VoH * hx - sin_v, ly = 2 * VoH * hy, lz = 2 * VoH * NoH - NoV;
    const real NoL = fmin(fmax(lz, (real)0), (real)1), at_l = MASKING_AT(NoL);
    const real V = MASKING_V(NoV, NoL, NoH, fmin(VoH, (real)1), at_v, at_l);
#ifdef VISIBLE
    const real above = lz > 0 ? V * NoL * area : (real)0;
    const real D = NDF_D(NoH, hx * hx + hy * hy);
    const real lod_of = s3 + level_of(area / fmax(D, (real)1e-20f));
#else
    const real above = (lz > 0 & VoH > 0) ? V * NoL * VoH / NoH : (real)0;
    const real lod_of = s3 + level_of(fmax(VoH, (real)1e-20f));
#endif
#endif
    // Of unit length already; what is below the horizon is read too, and weighs nothing.
    const real3 l = vec3(lx * tx + ly * bx + lz * nx, lx * ty + ly * by + lz * ny, lx * tz + ly * bz + lz * nz);
    const Place at = place_of(l, (scalar)0);
    const real lod_here = at.lod + lod_of;
    const real lod = lod_here > top ? top : lod_here > 0 ? lod_here : (real)0;
    const whole level = TO_WHOLE(lod < top - 1 ? lod : top - 1);
    const real lower = TO_REAL(level), n = TO_REAL((whole)(size) >> level);
    scalar blend[W], weight[SETS][W];
    STORE(lod - lower, 0, blend);
    taps_of(&low, at, lower, n, size);
    taps_of(&high, at, lower + 1, n / 2, size);
    for (int f = 0; f < SETS; f++) {
      const int g = f;
      CELL_LOAD
#ifdef COSINE
      const real w = PI * DIFFUSE_F(vec3(lx, ly, lz), vec3(sin_v, (real)0, NoV));
#else
      const real w = above * FRESNEL_F(fmin(VoH, (real)1));
#endif
      all[f] += w;
      STORE(w, 0, weight[f]);
    }
    for (int k = 0; k < W; k++) {
      QUAD L = bilinear(pyramid, &low, k);
      if (blend[k] > 0) L += blend[k] * (bilinear(pyramid, &high, k) - L);
      for (int f = 0; f < SETS; f++) sum[f][k] += weight[f][k] * L;
    }
  }
  for (int f = 0; f < SETS; f++) {
    __global scalar *out = partial + ((size_t)split * SETS + f) * 4 * outputs;
    for (int k = 0; k < W; k++) {
      out[(size_t)item * W + k] = sum[f][k].x;
      out[(size_t)item * W + k + outputs] = sum[f][k].y;
      out[(size_t)item * W + k + 2 * outputs] = sum[f][k].z;
    }
    STORE(all[f], item, out + 3 * (size_t)outputs);
  }
}

// The same integral over a list of lights as small as points beside the lobe: bright texels, or the means of some.
// light: 8 scalars each, {x, y, z, 0, ΩL_r, ΩL_g, ΩL_b, 0}. partial: [split][SETS][3][outputs].
__kernel void gather(__global scalar *restrict partial, const int outputs, const int lights, const int chunk,
                     __global const scalar *restrict surface, __global const scalar *restrict light,
                     const int cells CELL_ARRAYS) {
  const int item = get_global_id(0), split = get_global_id(1);
  if ((item + 1) * W > outputs) return;
  const real nx = LOAD(item, surface), ny = LOAD(item, surface + outputs), nz = LOAD(item, surface + 2 * outputs);
  const real tx = LOAD(item, surface + 3 * outputs), ty = LOAD(item, surface + 4 * outputs);
  const real tz = LOAD(item, surface + 5 * outputs);
  const real NoV = LOAD(item, surface + 6 * outputs), sin_v = LOAD(item, surface + 7 * outputs);
  const real vx = fma(NoV, nx, sin_v * tx), vy = fma(NoV, ny, sin_v * ty), vz = fma(NoV, nz, sin_v * tz);
  const int g = 0;
  CELL_LOAD
#ifndef COSINE
  const real at_v = MASKING_AT(NoV);
#endif
  real sum[SETS][3];
  for (int f = 0; f < SETS; f++)
    for (int c = 0; c < 3; c++) sum[f][c] = (real)0;
  const int end = min(lights, (split + 1) * chunk);
  __global const scalar *restrict p = light + 8 * (size_t)split * chunk;
  for (int i = split * chunk; i < end; i++, p += 8) {
    const real x = (real)p[0], y = (real)p[1], z = (real)p[2];
    const real lz = x * nx + y * ny + z * nz, NoL = fmin(fmax(lz, (real)0), (real)1);
#ifdef COSINE
    const real lx = x * tx + y * ty + z * tz, bx = ny * tz - nz * ty, by = nz * tx - nx * tz, bz = nx * ty - ny * tx;
    const real3 l = vec3(lx, x * bx + y * by + z * bz, fmax(lz, (real)1e-9f)), v = vec3(sin_v, (real)0, NoV);
#else
    // sin²θ_h = |H - (n·H) n|²/|H|², H = l + v, whose difference keeps the digits that 1 - (n·h)² loses.
    const real Hx = x + vx, Hy = y + vy, Hz = z + vz, NH = NoL + NoV;
    const real h2 = fmax(Hx * Hx + Hy * Hy + Hz * Hz, (real)1e-30f), per = 1 / sqrt(h2);
    const real ax = Hx - NH * nx, ay = Hy - NH * ny, az = Hz - NH * nz;
    const real NoH = fmin(NH * per, (real)1), VoH = fmin(h2 * per / 2, (real)1);
    const real at_l = MASKING_AT(NoL), D = NDF_D(NoH, (ax * ax + ay * ay + az * az) * (per * per));
    const real some = NoL * D * MASKING_V(NoV, NoL, NoH, VoH, at_v, at_l) / 4;
#endif
    for (int f = 0; f < SETS; f++) {
      const int g = f;
      CELL_LOAD
#ifdef COSINE
      const real w = lz > 0 ? NoL * DIFFUSE_F(l, v) : (real)0;
#else
      const real w = lz > 0 ? some * FRESNEL_F(VoH) : (real)0;
#endif
      for (int c = 0; c < 3; c++) sum[f][c] = fma(w, (real)p[4 + c], sum[f][c]);
    }
  }
  for (int f = 0; f < SETS; f++)
    for (int c = 0; c < 3; c++) STORE(sum[f][c], item, partial + (((size_t)split * SETS + f) * 3 + c) * outputs);
}
