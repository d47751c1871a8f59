// The one loop over cells and nodes; lanes are cells. The rule is in ring.clh, what is integrated in integrand/.

// out: [COMPONENTS][cells]; theta: (x, w) of both panels, `first` nodes in panel 0; phi: (x, w).
__kernel void integrate(__global scalar *restrict out, const int cells, const int first, const int nodes,
                        __global const scalar *restrict theta, const int azimuths,
                        __global const scalar *restrict phi CELL_ARRAYS) {
  const int g = get_global_id(0);
  if ((g + 1) * W > cells) return;
  CELL_LOAD
  View v;
  v.NoV = cell_NoV;
  v.sin_v = sqrt(one_minus_sqr(v.NoV));
  v.cot_v = v.NoV / fmax(v.sin_v, (real)1e-30f);
  v.width = NDF_WIDTH;
  real sum[COMPONENTS];
  for (int c = 0; c < COMPONENTS; c++) sum[c] = (real)0;
  for (int k = 0; k < nodes; k++) {
    const Ring r = ring(v, k >= first, theta[2 * k], theta[2 * k + 1] CELL_VALUES);
    real inner[COMPONENTS];
    for (int c = 0; c < COMPONENTS; c++) inner[c] = (real)0;
    for (int a = 0; a < azimuths; a++) {
      const real cos_phi = cos_0_pi(r.phi_max * phi[2 * a]);
      const real VoM = fmax(v.NoV * r.cos_m + v.sin_v * r.sin_m * cos_phi, (real)0);
      integrand(inner, phi[2 * a + 1], v, r, VoM CELL_VALUES);
    }
    const real D = NDF_D(r.cos_m, r.sin2_m) * r.weight;
    for (int c = 0; c < COMPONENTS; c++) sum[c] += inner[c] * D;
  }
  for (int c = 0; c < COMPONENTS; c++) STORE(sum[c], g, out + (size_t)c * cells);
}
