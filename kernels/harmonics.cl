// Spherical harmonics of a source list, to degree 2: real orthonormal basis in world x, y, z without the
// Condon-Shortley sign, in the order L00, L1-1, L10, L11, L2-2, L2-1, L20, L21, L22. [Ramamoorthi2001, eq. 3]

// partial: [chunks][28]: the 9 × 3 coefficients of wL, then ∑w.
__kernel void harmonics(__global scalar *restrict partial, const int sources, const int chunk,
                        __global const scalar *restrict source) {
  const int g = get_global_id(0), end = min(sources, (g + 1) * chunk);
  if (g * chunk >= sources) return;
  scalar sum[28];
  for (int k = 0; k < 28; k++) sum[k] = 0;
  for (int k = g * chunk; k < end; k++) {
    __global const scalar *p = source + 8 * (size_t)k;
    const scalar x = p[0], y = p[1], z = p[2];
    const scalar Y[9] = {(scalar)0.28209479177387814,             // ½√(1/π)
                         (scalar)0.48860251190291992 * y,         // √(3/4π)
                         (scalar)0.48860251190291992 * z,
                         (scalar)0.48860251190291992 * x,
                         (scalar)1.09254843059207907 * x * y,     // ½√(15/π)
                         (scalar)1.09254843059207907 * y * z,
                         (scalar)0.31539156525252001 * (2 * z * z - x * x - y * y),  // ¼√(5/π), 3z² - 1 on the unit sphere
                         (scalar)1.09254843059207907 * x * z,
                         (scalar)0.54627421529603954 * (x * x - y * y)};  // ¼√(15/π)
    for (int l = 0; l < 9; l++)
      for (int c = 0; c < 3; c++) sum[3 * l + c] += Y[l] * p[4 + c];
    sum[27] += p[3];
  }
  for (int k = 0; k < 28; k++) partial[(size_t)g * 28 + k] = sum[k];
}
