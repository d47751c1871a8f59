// The excess of bright texels, a list of (x, y, z, w, wL_r, wL_g, wL_b, 0), exactly for every output: the sums of
// `convolve_close` (octahedral.cl), one exchange of axes for each work item, times `factor`; with `add` they are added
// to the buffer. The NDF itself is evaluated, not its series: a sun of 1e5 times the mean is visible where its lobe is
// 1e-9 of its peak.
__kernel void convolve_apart(__global scalar *restrict partial, const int outputs, const int sources,
                             __global const scalar *restrict direction, __global const scalar *restrict source,
                             const scalar factor, const int add NDF_SCALARS) {
  const int g = get_global_id(0), e = get_global_id(1);
  if ((g + 1) * W > outputs) return;
  const real x = LOAD(g, direction), y = LOAD(g, direction + outputs), z = LOAD(g, direction + 2 * outputs);
  // K(ρ t o·b) = K(o·t ρ⁻¹ b); of the exchanges only the two cycles are not their own inverse.
  const xyz numbers = {0, 1, 2}, order = exchanged(numbers, e == 2 ? 3 : e == 3 ? 2 : e);
  const int ox = order.x, oy = order.y, oz = order.z;
  real total[8][3];
  for (int u = 0; u < 8; u++)
    for (int k = 0; k < 3; k++) total[u][k] = 0;
  for (int first = 0; first < sources; first += 128) {
    const int end = min(first + 128, sources);
    real sum[8][3];
    for (int u = 0; u < 8; u++)
      for (int k = 0; k < 3; k++) sum[u][k] = 0;
    for (int j = first; j < end; j++) {
      __global const scalar *p = source + 8 * (size_t)j;
      real q[8];
      mirror_distances(q, x, y, z, p[ox], p[oy], p[oz]);
      for (int u = 0; u < 8; u++) {
        const real K = lobe(q[u] NDF_VALUES);
        for (int k = 0; k < 3; k++) sum[u][k] += K * p[4 + k];
      }
    }
    for (int u = 0; u < 8; u++)
      for (int k = 0; k < 3; k++) total[u][k] += sum[u][k];
  }
  for (int u = 0; u < 8; u++)
    for (int k = 0; k < 3; k++) {
      __global scalar *at = partial + (size_t)(u * CHANNELS + 3 * e + k) * outputs;
      STORE(factor * total[u][k] + (add ? LOAD(g, at) : (real)0), g, at);
    }
}
