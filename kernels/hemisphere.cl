// E(v) = ∫ f(l, v)(n·l) dω_l of a BRDF given as a function of l and v; lanes are cells.
//
// SMOOTH (diffuse models): over l, θ in two panels that meet at θv, where Oren and Nayar's maximum of two angles has
// its kink, the second smoothed at the horizon (n·l to a power); φ in two that meet at π/2, where their clamped cosine
// has one, doubled by symmetry.
// Otherwise (a user's BRDF, whose lobe nobody knows): over half vectors by the nodes of ring.clh, graded to a lobe of
// any width, φ in both directions.
// out: [COMPONENTS][cells]; theta: (x, w) of both panels, `first` in panel 0; phi: (x, w) of a panel.
__kernel void integrate(__global scalar *restrict out, const int cells, const int first, const int nodes,
                        __global const scalar *restrict theta, const int azimuths,
                        __global const scalar *restrict phi CELL_ARRAYS) {
  const int g = get_global_id(0);
  if ((g + 1) * W > cells) return;
  CELL_LOAD
  const real NoV = fmax(cell_NoV, (real)LEAST_COSINE), sin_v = sqrt(one_minus_sqr(NoV));
#ifdef SMOOTH
  const real3 v = vec3(sin_v, (real)0, NoV);
  const real theta_v = atan2(sin_v, NoV);
#else
  const real cos_phi_v = cos(cell_phi), sin_phi_v = sin(cell_phi);
  const real3 v = vec3(sin_v * cos_phi_v, sin_v * sin_phi_v, NoV);
  const View view = view_of(NoV, (real)LOBE_WIDTH, (real)HALF_PI);
#endif
  real sum[COMPONENTS], rest[COMPONENTS];
  for (int c = 0; c < COMPONENTS; c++) sum[c] = rest[c] = (real)0;
  for (int k = 0; k < nodes; k++) {
    const scalar x = theta[2 * k], w = theta[2 * k + 1];
#ifdef SMOOTH
    const real from = k < first ? (real)0 : theta_v, length = k < first ? theta_v : HALF_PI - theta_v;
    // θ from the horizon is known to full precision where n·l is small: cos θ = sin(π/2 - θ).
    const scalar y = 1 - x, q = k < first ? x : 1 - y * y * y, dq = k < first ? w : 3 * y * y * w;
    const real up = HALF_PI - from - length * q;
    const real cos_t = sin(up), sin_t = cos(up), weight = length * dq * sin_t * cos_t;
#else
    const Ring r = ring(view, k >= first, x, w);
#endif
    real inner[COMPONENTS];
    for (int c = 0; c < COMPONENTS; c++) inner[c] = (real)0;
    for (int a = 0; a < AZIMUTH_PANELS * azimuths; a++) {
      const scalar p = phi[2 * (a / AZIMUTH_PANELS)], pw = phi[2 * (a / AZIMUTH_PANELS) + 1];
#ifdef SMOOTH
      const scalar angle = (a & 1 ? 1 - p / 2 : p / 2) * PI;
      const real3 l = vec3(sin_t * cos(angle), sin_t * sin(angle), cos_t);
      const real measure = weight * (PI * pw);
#else
      const real angle = r.phi_max * (a & 1 ? 1 - p / 2 : p / 2), side = a & 2 ? (real)-1 : (real)1;
      const real cx = r.sin_m * cos(angle), cy = side * r.sin_m * sin(angle);
      const real3 m = vec3(cx * cos_phi_v - cy * sin_phi_v, cx * sin_phi_v + cy * cos_phi_v, r.cos_m);
      const real VoM = fmax(v.z * r.cos_m + sin_v * cx, (real)0);
      const real NoL = 2 * VoM * m.z - v.z;
      const real3 l = vec3(2 * VoM * m.x - v.x, 2 * VoM * m.y - v.y, fmax(NoL, (real)LEAST_COSINE));
      const real measure = NoL > 0 ? r.weight * r.phi_max * (pw / 4) * 4 * VoM * NoL : (real)0;
#endif
      scatter(inner, measure, l, v CELL_VALUES);
    }
    for (int c = 0; c < COMPONENTS; c++) add(&sum[c], &rest[c], inner[c]);
  }
  for (int c = 0; c < COMPONENTS; c++) STORE(sum[c], g, out + (size_t)c * cells);
}
