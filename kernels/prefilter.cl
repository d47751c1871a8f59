// Zonal convolution: for every output direction r the sum of a lobe K(l·r) over a list of sources
// (direction, weight, weight × radiance). Grid nodes, bright texels and the exact texel sum are all such lists.

// source: 8 scalars each, {x, y, z, w, wL_r, wL_g, wL_b, 0}. Lanes are outputs; sources stream by as uniform
// scalars. The source is cut into fixed chunks, so that rounding does not grow with its length (393k terms:
// 5e-5 in one run, 7e-7 in chunks of 8192) and the result does not depend on the device.
// partial: [split][4][outputs] = ∑K wL (rgb) and ∑K w. direction: [3][outputs]; outputs a multiple of W·T.
__kernel void convolve(__global scalar *restrict partial, const int outputs, const int sources, const int chunk,
                       const int first_split, __global const scalar *restrict direction,
                       __global const scalar *restrict source NDF_SCALARS) {
  const int g = get_global_id(0) * T, split = get_global_id(1);
  if ((g + T) * W > outputs) return;
  real x[T], y[T], z[T], r[T], gr[T], b[T], n[T];
  for (int t = 0; t < T; t++) {
    x[t] = LOAD(g + t, direction);
    y[t] = LOAD(g + t, direction + outputs);
    z[t] = LOAD(g + t, direction + 2 * outputs);
    r[t] = gr[t] = b[t] = n[t] = (real)0;
  }
  const int end = min(sources, (split + 1) * chunk);
  for (int k = split * chunk; k < end; k++) {
    __global const scalar *restrict p = source + 8 * (size_t)k;
    const scalar px = p[0], py = p[1], pz = p[2], pw = p[3], pr = p[4], pg = p[5], pb = p[6];
    for (int t = 0; t < T; t++) {
      real dx = x[t] - px, dy = y[t] - py, dz = z[t] - pz;
      real K = lobe((scalar)0.5 * (dx * dx + dy * dy + dz * dz) NDF_VALUES);
      r[t] += K * pr;
      gr[t] += K * pg;
      b[t] += K * pb;
      n[t] += K * pw;
    }
  }
  partial += (size_t)(first_split + split) * 4 * outputs;
  for (int t = 0; t < T; t++) {
    STORE(r[t], g + t, partial);
    STORE(gr[t], g + t, partial + outputs);
    STORE(b[t], g + t, partial + 2 * outputs);
    STORE(n[t], g + t, partial + 3 * outputs);
  }
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
