// The one loop over cells and nodes; lanes are cells. The rule is in ring.clh, the integrands are in integrand/.

// out: [COMPONENTS][cells]; theta: (x, w) of both panels, `first` nodes in panel 0; phi: (x, w).
__kernel void integrate(__global scalar *restrict out, const int cells, const int first, const int nodes,
                        __global const scalar *restrict theta, const int azimuths,
                        __global const scalar *restrict phi CELL_ARRAYS) {
  const int g = get_global_id(0);
  if ((g + 1) * W > cells) return;
  CELL_LOAD
  const View v = view_of(cell_NoV, NDF_WIDTH, NDF_REACH);
  const real at_v = MASKING_AT(v.NoV);
  real sum[COMPONENTS], rest[COMPONENTS];
  for (int c = 0; c < COMPONENTS; c++) sum[c] = rest[c] = (real)0;
  for (int k = 0; k < nodes; k++) {
    const Ring r = ring(v, k >= first, theta[2 * k], theta[2 * k + 1]);
    real inner[COMPONENTS];
    for (int c = 0; c < COMPONENTS; c++) inner[c] = (real)0;
    for (int a = 0; a < azimuths; a++) {
      const real cos_phi = cos_0_pi(r.phi_max * phi[2 * a]);
      const real VoM = fmax(v.NoV * r.cos_m + v.sin_v * r.sin_m * cos_phi, (real)0);
      const Facet f = {v.NoV, 2 * VoM * r.cos_m - v.NoV, r.cos_m, VoM, at_v};
      integrand(inner, phi[2 * a + 1], f CELL_VALUES);
    }
    const real D = NDF_D(r.cos_m, r.sin2_m) * (r.weight * r.phi_max);
    for (int c = 0; c < COMPONENTS; c++) add(&sum[c], &rest[c], inner[c] * D);
  }
  for (int c = 0; c < COMPONENTS; c++) STORE(sum[c], g, out + (size_t)c * cells);
}
