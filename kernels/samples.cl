// Filtered importance sampling [Krivanek2008, sec. 3; Colbert2007, GPU Gems 3, eq. 12-13]: for every output direction n
// a sum over one set of samples l, drawn by the NDF in the frame of n, each read from the level of the pyramid whose
// texels are as large as the solid angle of the sample, Ω = 1/(N pdf).
//
// sample: 5 scalars each, {x, y, z, weight, lod}: l in the frame of n, its share n·l/∑ n·l of the result, and ½ log2 of
// Ω over the solid angle of a texel at the middle of a face. Each SIMD lane computes one output; samples are read as
// uniform scalars. They are sorted by lod: the first `flat` never leave level 0 and need one read, the others two.
// Directions and addresses are made in W lanes, then a scalar loop reads: a gather of 16 lanes is slower than 16 loads.

#if W == 1
typedef int whole;
#define TO_WHOLE(x) convert_int(x)
#define TO_REAL(x) ((scalar)(x))
#define STORE_WHOLE(v, p) ((p)[0] = (v))
#else
typedef JOIN(int, W) whole;
#define TO_WHOLE(x) JOIN(convert_int, W)(x)
#define TO_REAL(x) JOIN(JOIN(convert_, SCALAR), W)(x)
#define STORE_WHOLE(v, p) JOIN(vstore, W)(v, 0, p)
#endif

#define QUAD JOIN(SCALAR, 4)
#define PAIR JOIN(SCALAR, 8)

typedef struct {
  real face, x, y, lod;  // x, y in [0, 1]
} Place;

// Face and place on it, as cube_face and to_face have them: with 1/d of the largest component, signed, s and t are
// products. A texel at (s, t) has q^(-3/2) of the solid angle at the middle, q = 1 + s² + t², so its samples are ¾ log2
// q levels higher: a polynomial on [1, 3], |error| < 1e-3 of a level, continuous from face to face since q is.
static inline Place place_of(real3 d, scalar lod) {
  const real ax = fabs(d.x), ay = fabs(d.y), az = fabs(d.z);
  const real face = (ax >= ay) & (ax >= az) ? (real)0 : ay >= az ? (real)2 : (real)4;
  const real major = face == 0 ? d.x : face == 2 ? d.y : d.z, per = 1 / major, size = fabs(per), q = per * per;
  const real s = face == 0 ? -d.z * per : d.x * (face == 2 ? size : per);
  const real t = face == 2 ? d.z * per : -d.y * size;
  Place p;
  p.face = major < 0 ? face + 1 : face;
  p.x = fma(s, (real)0.5, (real)0.5);
  p.y = fma(t, (real)0.5, (real)0.5);
  real higher = (real)-0.02124243f;
  higher = fma(higher, q, (real)0.22532556f);
  higher = fma(higher, q, (real)-0.97624957f);
  higher = fma(higher, q, (real)2.41916117f);
  p.lod = lod + fma(higher, q, (real)-1.64604976f);
  return p;
}

typedef struct {
  int at[W], row[W];
  scalar fx[W], fy[W];
} Taps;

// The upper left of the four texels around a place, in texels from the pyramid's start, and how far between them it is:
// texel centres are at (k + ½)/n, and with the frame of one texel, texel k is at k + 1. Addresses are sums in `real`,
// which float32 holds exactly: a pyramid of 1024 has 8.4e6 texels, below 2^24.
static inline void taps_of(Taps *taps, Place p, real level, real n, int size) {
  const real x = fma(p.x, n, (real)0.5), y = fma(p.y, n, (real)0.5);
  const real x0 = TO_REAL(TO_WHOLE(x)), y0 = TO_REAL(TO_WHOLE(y)), edge = n + 2;  // both positive: rounded down
  const real before = fma(level, (real)24, (real)PYRAMID_OFFSET(size, 0, 0)) - n * fma(n, (real)8, (real)48);
  STORE(x - x0, 0, taps->fx);
  STORE(y - y0, 0, taps->fy);
  STORE_WHOLE(TO_WHOLE(fma(fma(p.face, edge, y0), edge, x0 + before)), taps->at);
  STORE_WHOLE(TO_WHOLE(edge), taps->row);
}

static inline QUAD bilinear(__global const QUAD *restrict pyramid, const Taps *taps, int k) {
  __global const QUAD *p = pyramid + taps->at[k];
  const PAIR above = vload8(0, (__global const scalar *)p);
  const PAIR below = vload8(0, (__global const scalar *)(p + taps->row[k]));
  const PAIR row = above + taps->fy[k] * (below - above);
  return row.lo + taps->fx[k] * (row.hi - row.lo);
}

// partial: [split][3][outputs]; split `chunk` samples. direction: [3][outputs], outputs a multiple of W.
__kernel void add_samples(__global scalar *restrict partial, const int outputs, const int samples, const int flat,
                          const int chunk, __global const scalar *restrict direction,
                          __global const scalar *restrict sample, const int size, const int levels,
                          __global const QUAD *restrict pyramid) {
  const int g = get_global_id(0), split = get_global_id(1);
  if ((g + 1) * W > outputs) return;
  const real x = LOAD(g, direction), y = LOAD(g, direction + outputs), z = LOAD(g, direction + 2 * outputs);
  // A frame that turns slowly from texel to texel, over face edges too, so that the errors of neighbours agree and no
  // seam shows [Frisvad2012, eq. 6]: one point must be left out, here straight down. 1 + y = (x² + z²)/(1 - y) does not
  // cancel; 1e-30 stands for x² + z² at that point, where the products vanish.
  const real a = y < 0 ? (1 - y) / fmax(x * x + z * z, (real)1e-30f) : 1 / (1 + y), xz = -x * z * a;
  const real3 right = vec3(1 - x * x * a, -x, xz), up = vec3(xz, -z, 1 - z * z * a);
  QUAD sum[W];
  for (int k = 0; k < W; k++) sum[k] = (QUAD)(0);
  const int begin = split * chunk, end = min(samples, begin + chunk), middle = clamp(flat, begin, end);
  __global const scalar *restrict p = sample + 5 * (size_t)begin;
  Taps low, high;
  for (int i = begin; i < middle; i++, p += 5) {
    const scalar sx = p[0], sy = p[1], sz = p[2], weight = p[3];
    const real3 l = vec3(sx * right.x + sy * up.x + sz * x, sx * right.y + sy * up.y + sz * y,
                         sx * right.z + sy * up.z + sz * z);
    taps_of(&low, place_of(l, 0), (real)0, (real)size, size);
    for (int k = 0; k < W; k++) sum[k] += weight * bilinear(pyramid, &low, k);
  }
  const real top = (real)(levels - 1);
  for (int i = middle; i < end; i++, p += 5) {
    const scalar sx = p[0], sy = p[1], sz = p[2], weight = p[3];
    const real3 l = vec3(sx * right.x + sy * up.x + sz * x, sx * right.y + sy * up.y + sz * y,
                         sx * right.z + sy * up.z + sz * z);
    const Place at = place_of(l, p[4]);
    const real lod = at.lod > top ? top : at.lod > 0 ? at.lod : (real)0;
    const whole level = TO_WHOLE(lod < top - 1 ? lod : top - 1);
    const real lower = TO_REAL(level), n = TO_REAL((whole)(size) >> level);
    scalar blend[W];
    STORE(lod - lower, 0, blend);
    taps_of(&low, at, lower, n, size);
    taps_of(&high, at, lower + 1, n / 2, size);
    for (int k = 0; k < W; k++) {
      const QUAD fine = bilinear(pyramid, &low, k), coarse = bilinear(pyramid, &high, k);
      sum[k] += weight * (fine + blend[k] * (coarse - fine));
    }
  }
  __global scalar *out = partial + (size_t)split * 3 * outputs + (size_t)g * W;
  for (int k = 0; k < W; k++) {
    out[k] = sum[k].x;
    out[k + outputs] = sum[k].y;
    out[k + 2 * outputs] = sum[k].z;
  }
}

// level[c] = ∑ over splits, planar [3][outputs].
__kernel void finish_samples(__global scalar *restrict level, const int outputs,
                             __global const scalar *restrict partial, const int splits) {
  const int g = get_global_id(0);
  if ((g + 1) * W > outputs) return;
  for (int c = 0; c < 3; c++) {
    real sum = (real)0;
    for (int k = 0; k < splits; k++) sum += LOAD(g, partial + ((size_t)3 * k + c) * outputs);
    STORE(sum, g, level + (size_t)c * outputs);
  }
}
