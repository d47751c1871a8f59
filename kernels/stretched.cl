// Integrals over an anisotropic NDF: nodes in the stretched slopes, where it is isotropic. Lanes are cells.
//
// m = (αx r cos φ, αy r sin φ, 1)/|·|, r = sinh u: dω = αx αy r dr dφ m.z³. At given φ, with e = (αx cos φ, αy sin φ)
// and t the tangent vector of v over v.z, the support ends
//   HALF_ANGLE (l above n):  r² e² - 2 r t·e < 1  =>  r = (t·e + √((t·e)² + e²))/e²
//   POLAR (v·m > 0):         r < -1/(t·e) where t·e < 0
// an analytic function of φ with one short scale: e/|T| about t·e = 0, T = (αx tx, αy ty), at grazing views. So φ
// runs in four panels from there, each graded away from it, and u in one, from 0 to where the support or the NDF ends:
// the lobe at r = 1, its tail and the horizon at r = 1/α are all of size 1 in u.
// out: [COMPONENTS][cells]; radial: (x, w) of u; azimuthal: (x, w) of a panel of φ.
__kernel void integrate(__global scalar *restrict out, const int cells, const int radials,
                        __global const scalar *restrict radial, const int azimuths,
                        __global const scalar *restrict azimuthal CELL_ARRAYS) {
  const int g = get_global_id(0);
  if ((g + 1) * W > cells) return;
  CELL_LOAD
  const real ax = NDF_STRETCH_X, ay = NDF_STRETCH_Y;
  const real NoV = fmax(cell_NoV, (real)(scalar)1e-18f), sin_v = sqrt(one_minus_sqr(NoV));
  const real3 v = vec3(sin_v * cos(cell_phi), sin_v * sin(cell_phi), NoV);
  const real tx = ax * v.x / NoV, ty = ay * v.y / NoV, T_ = sqrt(tx * tx + ty * ty);
  // Unit vectors of the stretched azimuth of v, and across it.
  const real ux = T_ > 0 ? tx / T_ : (real)1, uy = T_ > 0 ? ty / T_ : (real)0;
  const real across = sqrt(sqr(ax * uy) + sqr(ay * ux));
  const real ratio = HALF_PI / fmin(across / fmax(T_, (real)1e-20f), (real)1);
  // From the rounded range the scale follows again, so that the panels end at π/2: 1e-6 of their length counts.
  const real range = log(ratio + sqrt(ratio * ratio + 1)), scale = HALF_PI / sinh(range);
  const real at_v = MASKING_AT(v);
  real sum[COMPONENTS], rest[COMPONENTS];
  for (int c = 0; c < COMPONENTS; c++) sum[c] = rest[c] = (real)0;
  for (int a = 0; a < 4 * azimuths; a++) {
    const int quarter = a & 3;
    const real u = range * azimuthal[2 * (a >> 2)], offset = fmin(scale * sinh(u), (real)HALF_PI);
    const real dphi = scale * cosh(u) * range * azimuthal[2 * (a >> 2) + 1];
    // φ = ±(π/2 ∓ offset) about v's azimuth: its cosine is ± sin(offset), exact where t·e is small.
    const real cos_p = (quarter & 1) ? -sin(offset) : sin(offset), sin_p = (quarter & 2) ? -cos(offset) : cos(offset);
    const real ex = ax * (ux * cos_p - uy * sin_p), ey = ay * (uy * cos_p + ux * sin_p);
    const real te = T_ * cos_p;
#ifdef HALF_ANGLE
    const real e2 = ex * ex + ey * ey, root = sqrt(te * te + e2);
    const real last = te > 0 ? (te + root) / e2 : 1 / (root - te);
#else
    const real last = te < 0 ? -1 / te : (real)NDF_REACH;
#endif
    const real limit = fmin(last, (real)NDF_REACH), end = log(limit + sqrt(limit * limit + 1));
    real inner[COMPONENTS];
    for (int c = 0; c < COMPONENTS; c++) inner[c] = (real)0;
    for (int k = 0; k < radials; k++) {
      // sinh u cancels to a rounding of 1 near u = 0, where r dr has no weight.
      const real e = exp_(end * radial[2 * k]), i = 1 / e, r = (e - i) / 2;
      const real z = 1 / sqrt(1 + sqr(r * ex) + sqr(r * ey));
      const real3 m = vec3(r * ex * z, r * ey * z, z);
      const real VoM = fmax(dot3(v, m), (real)0);
      const real3 l = vec3(2 * VoM * m.x - v.x, 2 * VoM * m.y - v.y, fmax(2 * VoM * m.z - v.z, (real)0));
      const Facet f = {NoV, l.z, z, VoM, at_v, l};
      real node[COMPONENTS];
      for (int c = 0; c < COMPONENTS; c++) node[c] = (real)0;
      integrand(node, radial[2 * k + 1], f CELL_VALUES);
      const real measure = NDF_D(m) * r * z * z * z * ((e + i) / 2);
      for (int c = 0; c < COMPONENTS; c++) inner[c] += node[c] * measure;
    }
    for (int c = 0; c < COMPONENTS; c++) add(&sum[c], &rest[c], inner[c] * (end * dphi));
  }
  for (int c = 0; c < COMPONENTS; c++) STORE(sum[c] * (ax * ay), g, out + (size_t)c * cells);
}
