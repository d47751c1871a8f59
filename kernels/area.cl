// A(v) = ∫ D (v·m)₊ dω for the table of Smith's term: the azimuth in closed form, one sum over θ.
// ∫ (v·m)₊ dφ over [-φmax, φmax] = 2 (cos θv cos θ φmax + sin θv sin θ sin φmax). An error of φmax is harmless: v·m is 0
// there. out: [cells]; the cells are n·v, then the NDF's numbers; theta as in integrate.cl.
__kernel void area(__global scalar *restrict out, const int cells, const int first, const int nodes,
                   __global const scalar *restrict theta CELL_ARRAYS) {
  const int g = get_global_id(0);
  if ((g + 1) * W > cells) return;
  CELL_LOAD
  const View v = view_of(cell_NoV, NDF_WIDTH, NDF_REACH);
  real sum = (real)0, rest = (real)0;
  for (int k = 0; k < nodes; k++) {
    const Ring r = ring(v, k >= first, theta[2 * k], theta[2 * k + 1]);
    const real azimuths = cell_NoV * r.cos_m * r.phi_max + v.sin_v * r.sin_m * sin(r.phi_max);
    add(&sum, &rest, NDF_D(r.cos_m, r.sin2_m) * r.weight * azimuths);
  }
  STORE(sum, g, out);
}
