// Zonal convolution by direct summation: for every output direction r the sum of a lobe K(l·r) over a list of sources
// (direction, weight, weight × radiance). Certificates use it: it evaluates the NDF itself, texel by texel.

// source: 8 scalars each, {x, y, z, w, wL_r, wL_g, wL_b, 0}. Each SIMD lane computes one output direction; sources are
// read as uniform scalars. The source is cut into fixed chunks, so that rounding does not grow with its length (393k
// terms: 5e-5 in one run, 7e-7 in chunks of 8192) and the result does not depend on the device.
// partial: [split][4][outputs] = ∑K wL (rgb) and ∑K w. direction: [3][outputs]; outputs a multiple of W·T.
// Where per_window is not 0, only sources beyond a window are summed (`convolve_texels` sums the others).
#define RUN 128

// Sums of at most RUN terms are made apart and then added: two short sums round less than one long one, and a
// constant environment stays 1 to 1e-6 though ∑K wL and ∑K w round differently.
__kernel void convolve(__global scalar *restrict partial, const int outputs, const int sources, const int chunk,
                       __global const scalar *restrict direction, __global const scalar *restrict source,
                       const scalar window, const scalar per_window NDF_SCALARS) {
  const int g = get_global_id(0) * T, split = get_global_id(1), end = min(sources, (split + 1) * chunk);
  if ((g + T) * W > outputs) return;
  real x[T], y[T], z[T], total[4][T];
  for (int t = 0; t < T; t++) {
    x[t] = LOAD(g + t, direction);
    y[t] = LOAD(g + t, direction + outputs);
    z[t] = LOAD(g + t, direction + 2 * outputs);
    for (int c = 0; c < 4; c++) total[c][t] = (real)0;
  }
  for (int first = split * chunk; first < end; first += RUN) {
    real sum[4][T];
    for (int c = 0; c < 4; c++)
      for (int t = 0; t < T; t++) sum[c][t] = (real)0;
    for (int k = first; k < min(first + RUN, end); k++) {
      __global const scalar *restrict p = source + 8 * (size_t)k;
      const scalar px = p[0], py = p[1], pz = p[2], pw = p[3], pr = p[4], pg = p[5], pb = p[6];
      for (int t = 0; t < T; t++) {
        const real dx = x[t] - px, dy = y[t] - py, dz = z[t] - pz;
        const real q = dx * dx + dy * dy + dz * dz;
        real K = lobe(q NDF_VALUES);
        if (per_window > 0) K *= step_up(q, window, per_window);
        sum[0][t] += K * pr;
        sum[1][t] += K * pg;
        sum[2][t] += K * pb;
        sum[3][t] += K * pw;
      }
    }
    for (int c = 0; c < 4; c++)
      for (int t = 0; t < T; t++) total[c][t] += sum[c][t];
  }
  for (int t = 0; t < T; t++)
    for (int c = 0; c < 4; c++) STORE(total[c][t], g + t, partial + (size_t)(4 * split + c) * outputs);
}
