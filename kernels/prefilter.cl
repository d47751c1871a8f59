// Zonal convolution: for every output direction r the sum of a lobe K(l·r) over a list of sources
// (direction, weight, weight × radiance). Grid nodes, bright texels and the exact texel sum are all such lists.

// source: 8 scalars each, {x, y, z, w, wL_r, wL_g, wL_b, 0}. Lanes are outputs; sources stream by as uniform
// scalars. The source is cut into fixed chunks, so that rounding does not grow with its length (393k terms:
// 5e-5 in one run, 7e-7 in chunks of 8192) and the result does not depend on the device.
// partial: [split][4][outputs] = ∑K wL (rgb) and ∑K w. direction: [3][outputs]; outputs a multiple of W·T.

// A sharp lobe needs a fine grid near r only. K = K (1 - ω) + K ω with ω a smooth step in q = |l - r|² from 0 at q0 to 1
// at q1: the first part has compact support and goes over the fine grid, whole blocks of sources skipped; the
// second is smooth on the scale √q1 and goes over a coarse grid. The sum is K exactly.
#define WHOLE 0
#define FAR 1
#define NEAR 2
#define BLOCK 16
#define RUN 128

typedef struct {
  scalar q0, per_q;  // ω's start and 1/(q1 - q0)
} Window;

static inline real step_up(real q, Window window) {
  const real t = fmin(fmax((q - window.q0) * window.per_q, (real)0), (real)1), t2 = t * t;
  return t2 * t2 * (35 + t * (-84 + t * (70 - 20 * t)));  // three continuous derivatives
}

typedef struct {
  real x[T], y[T], z[T], sum[4][T];
} Outputs;

static inline void load_outputs(Outputs *o, int g, int outputs, __global const scalar *restrict direction) {
  for (int t = 0; t < T; t++) {
    o->x[t] = LOAD(g + t, direction);
    o->y[t] = LOAD(g + t, direction + outputs);
    o->z[t] = LOAD(g + t, direction + 2 * outputs);
    for (int c = 0; c < 4; c++) o->sum[c][t] = (real)0;
  }
}

// Sums of at most RUN terms are made apart and then added: two short sums round less than one long one, and a
// constant environment stays 1 to 1e-6 though ∑K wL and ∑K w round differently.
static inline void add_run(Outputs *o, __global const scalar *restrict source, int begin, int end, const int part,
                           Window window NDF_SCALARS) {
  real sum[4][T];
  for (int c = 0; c < 4; c++)
    for (int t = 0; t < T; t++) sum[c][t] = (real)0;
  for (int k = begin; k < end; k++) {
    __global const scalar *restrict p = source + 8 * (size_t)k;
    const scalar px = p[0], py = p[1], pz = p[2], pw = p[3], pr = p[4], pg = p[5], pb = p[6];
    for (int t = 0; t < T; t++) {
      const real dx = o->x[t] - px, dy = o->y[t] - py, dz = o->z[t] - pz;
      const real q = dx * dx + dy * dy + dz * dz;
      real K = lobe(q NDF_VALUES);
      if (part == FAR) K *= step_up(q, window);
      if (part == NEAR) K *= 1 - step_up(q, window);
      sum[0][t] += K * pr;
      sum[1][t] += K * pg;
      sum[2][t] += K * pb;
      sum[3][t] += K * pw;
    }
  }
  for (int c = 0; c < 4; c++)
    for (int t = 0; t < T; t++) o->sum[c][t] += sum[c][t];
}

static inline void add_sources(Outputs *o, __global const scalar *restrict source, int begin, int end, const int part,
                               Window window NDF_SCALARS) {
  for (int k = begin; k < end; k += RUN) add_run(o, source, k, min(k + RUN, end), part, window NDF_VALUES);
}

static inline void store_outputs(Outputs *o, int g, int outputs, __global scalar *restrict partial) {
  for (int t = 0; t < T; t++)
    for (int c = 0; c < 4; c++) STORE(o->sum[c][t], g + t, partial + (size_t)c * outputs);
}

__kernel void convolve(__global scalar *restrict partial, const int outputs, const int sources, const int chunk,
                       const int first_split, __global const scalar *restrict direction,
                       __global const scalar *restrict source NDF_SCALARS) {
  const int g = get_global_id(0) * T, split = get_global_id(1);
  if ((g + T) * W > outputs) return;
  const Window none = {0, 0};
  Outputs o;
  load_outputs(&o, g, outputs, direction);
  add_sources(&o, source, split * chunk, min(sources, (split + 1) * chunk), WHOLE, none NDF_VALUES);
  store_outputs(&o, g, outputs, partial + (size_t)(first_split + split) * 4 * outputs);
}

__kernel void convolve_far(__global scalar *restrict partial, const int outputs, const int sources, const int chunk,
                           const int first_split, __global const scalar *restrict direction,
                           __global const scalar *restrict source, const scalar q0, const scalar q1 NDF_SCALARS) {
  const int g = get_global_id(0) * T, split = get_global_id(1);
  if ((g + T) * W > outputs) return;
  const Window window = {q0, 1 / (q1 - q0)};
  Outputs o;
  load_outputs(&o, g, outputs, direction);
  add_sources(&o, source, split * chunk, min(sources, (split + 1) * chunk), FAR, window NDF_VALUES);
  store_outputs(&o, g, outputs, partial + (size_t)(first_split + split) * 4 * outputs);
}

// group, block: {x, y, z, radius} of the W·T outputs of a work item, and for every 4 BLOCK sources of them all,
// then of each BLOCK: a block is skipped when no pair can be nearer than the window's end, by the triangle
// inequality of chords.
static inline int out_of_reach(__global const scalar *restrict bound, scalar x, scalar y, scalar z, scalar reach) {
  const scalar dx = bound[0] - x, dy = bound[1] - y, dz = bound[2] - z, apart = reach + bound[3];
  return dx * dx + dy * dy + dz * dz > apart * apart;
}

__kernel void convolve_near(__global scalar *restrict partial, const int outputs, const int sources, const int chunk,
                            const int first_split, __global const scalar *restrict direction,
                            __global const scalar *restrict source, const scalar q0, const scalar q1,
                            __global const scalar *restrict group, __global const scalar *restrict block NDF_SCALARS) {
  const int item = get_global_id(0), g = item * T, split = get_global_id(1);
  if ((g + T) * W > outputs) return;
  const Window window = {q0, 1 / (q1 - q0)};
  const scalar cx = group[4 * item], cy = group[4 * item + 1], cz = group[4 * item + 2];
  const scalar reach = sqrt(q1) + group[4 * item + 3];
  Outputs o;
  load_outputs(&o, g, outputs, direction);
  for (int k = split * chunk; k < min(sources, (split + 1) * chunk); k += 4 * BLOCK) {
    __global const scalar *bound = block + 20 * (k / (4 * BLOCK));
    if (out_of_reach(bound, cx, cy, cz, reach)) continue;
    for (int b = 0; b < 4; b++)
      if (!out_of_reach(bound + 4 + 4 * b, cx, cy, cz, reach))
        add_run(&o, source, k + b * BLOCK, k + (b + 1) * BLOCK, NEAR, window NDF_VALUES);
  }
  store_outputs(&o, g, outputs, partial + (size_t)(first_split + split) * 4 * outputs);
}

// level[c] = ∑_splits rgb / ∑_splits w + bright[c] · bright_norm, planar [3][outputs].
// The grid is normalized by its own discrete weights, so a constant environment comes out at 1 exactly
// where its bright list is empty; the bright texels by the lobe's integral, 1/∫K dω = bright_norm.
__kernel void finish(__global scalar *restrict level, const int outputs, __global const scalar *restrict partial,
                     const int splits, __global const scalar *restrict bright, const int bright_splits,
                     const scalar bright_norm) {
  const int g = get_global_id(0);
  if ((g + 1) * W > outputs) return;
  real sum[4], extra[3];
  for (int c = 0; c < 4; c++) {
    sum[c] = (real)0;
    for (int k = 0; k < splits; k++) sum[c] += LOAD(g, partial + ((size_t)4 * k + c) * outputs);
  }
  for (int c = 0; c < 3; c++) {
    extra[c] = (real)0;
    for (int k = 0; k < bright_splits; k++) extra[c] += LOAD(g, bright + ((size_t)4 * k + c) * outputs);
    STORE(sum[c] / sum[3] + extra[c] * bright_norm, g, level + (size_t)c * outputs);
  }
}
