// Linearly transformed cosines against a BRDF [Heitz2016]: the error of a fit and its derivatives. Lanes are cells.
//
// With w = N ω, N = M⁻¹ of rows (xx 0 xz), (0 1 0), (zx 0 zz), the distribution is [Heitz2016, eq. 2 and 3]
//   p(ω) = det N max(w.z, 0)/(π |w|⁴),   ∫ p dω = 1 over the sphere,
// and its target is f(l, v) (n·l)/E, where E is the albedo: with v = (sin θ_v, 0, cos θ_v) both are even in y.
#define INV_PI ((scalar)0.31830988618379067154)

// Sums over half vectors (ring.clh) of m = |f̂ - p| dω over l above the surface and, for a step N <- (1 + δ) N, of its
// gradient and Gauss-Newton's matrix in δ = (xx, xz, zx, zz). With u = w/|w|, s = u/u.z,
//   J = ∂ log p/∂δ = (1 - 4 u.x², -4 u.x u.z, s.x - 4 u.x u.z, 2 - 4 u.z²).
// The sum of absolute values has no such matrix, that of r²/|r| has, with 1/|r| held [Weiszfeld1937]; `soft` (f̂ + p)
// rounds off the corner at r = 0. δ moves the lobe in its own units, so that a lobe of α = 1e-5 is as easy as another.
//
// out: [19][cells]: m, 4 of the gradient, 10 of the matrix's upper triangle by rows, ∫ f̂ (x, z, 1) dω, ∫ p dω.
__kernel void descend(__global scalar *restrict out, const int cells, const int first, const int nodes,
                      __global const scalar *restrict theta, const int azimuths,
                      __global const scalar *restrict phi, const scalar soft CELL_ARRAYS) {
  const int g = get_global_id(0);
  if ((g + 1) * W > cells) return;
  CELL_LOAD
  const View v = view_of(cell_NoV, NDF_WIDTH, NDF_REACH);
  const real at_v = MASKING_AT(v.NoV), scale = (cell_xx * cell_zz - cell_xz * cell_zx) * INV_PI;
  real sum[19];
  for (int c = 0; c < 19; c++) sum[c] = (real)0;
  for (int k = 0; k < nodes; k++) {
    const Ring r = ring(v, k >= first, theta[2 * k], theta[2 * k + 1]);
    const real D = NDF_D(r.cos_m, r.sin2_m) * cell_per_albedo;
    for (int a = 0; a < azimuths; a++) {
      const real cos_phi = cos_0_pi(r.phi_max * phi[2 * a]);
      const real VoM = fmax(v.NoV * r.cos_m + v.sin_v * r.sin_m * cos_phi, (real)0);
      const Facet facet = {v.NoV, 2 * VoM * r.cos_m - v.NoV, r.cos_m, VoM, at_v};
      const real x = 2 * VoM * r.sin_m * cos_phi - v.sin_v, z = facet.NoL;
      const real y2 = sqr(2 * VoM * r.sin_m) * one_minus_sqr(cos_phi);
      const real wx = cell_xx * x + cell_xz * z, wz = cell_zx * x + cell_zz * z;
      const real per2 = 1 / (wx * wx + y2 + wz * wz), dh = r.weight * r.phi_max * phi[2 * a + 1];
      const real f = D * VISIBLE(facet) * dh, all = 4 * VoM * dh * scale * per2 * per2, p = all * fmax(wz, (real)0);
      const real off = p - f, size = fabs(off), rest = soft * (f + p);
      const real per = 1 / fmax(sqrt(off * off + rest * rest), (real)1e-30f);
      const real xx = 4 * wx * wx * per2, xz = 4 * wx * wz * per2, zz = 4 * wz * wz * per2;
      // p J, with p s.x for what has no limit at w.z = 0.
      const real J[4] = {p * (1 - xx), -p * xz, (wz > 0 ? all * wx : (real)0) - p * xz, p * (2 - zz)};
      const real sign = off * per;
      sum[0] += size;
      int c = 5;
      for (int i = 0; i < 4; i++) {
        sum[1 + i] += J[i] * sign;
        for (int j = i; j < 4; j++) sum[c++] += J[i] * J[j] * per;
      }
      sum[15] += f * x;
      sum[16] += f * z;
      sum[17] += f;
      sum[18] += p;
    }
  }
  for (int c = 0; c < 19; c++) STORE(sum[c], g, out + (size_t)c * cells);
}

// The same m over the whole sphere and without half vectors: nodes u of the cosine lobe, ω = M u/|M u|, where p dω is
// (u.z/π) du, so that m = ∫ |f̂/p - 1| p dω + ∫ f̂ over the half of the sphere where p is 0. f from both directions
// (specular.clh). u.z runs in Gauss nodes: the ratio may grow like 1/u.z.
//
// out: [3][cells]: m, ∫ p below the horizon, ∫ f̂ over the lobe's half; theta: (u.z, w); phi: (x, w) of half a turn.
__kernel void misplaced(__global scalar *restrict out, const int cells, const int nodes,
                        __global const scalar *restrict theta, const int azimuths,
                        __global const scalar *restrict phi CELL_ARRAYS) {
  const int g = get_global_id(0);
  if ((g + 1) * W > cells) return;
  CELL_LOAD
  const real NoV = fmax(cell_NoV, (real)(scalar)1e-18f);
  const real3 v = vec3(sqrt(one_minus_sqr(NoV)), (real)0, NoV);
  const real det = cell_xx * cell_zz - cell_xz * cell_zx;
  real m = (real)0, below = (real)0, inside = (real)0;
  for (int k = 0; k < nodes; k++) {
    const scalar uz = theta[2 * k], ur = sqrt((1 - uz) * (1 + uz)), ring = 2 * uz * theta[2 * k + 1];
    for (int a = 0; a < azimuths; a++) {
      const scalar ux = ur * cos(PI * phi[2 * a]), uy = ur * sin(PI * phi[2 * a]), w = ring * phi[2 * a + 1];
      // M u, times det N in the plane of x and z.
      const real x = cell_zz * ux - cell_xz * uz, z = cell_xx * uz - cell_zx * ux, y = det * uy;
      const real length = sqrt(x * x + y * y + z * z), per = 1 / length;
      const real3 l = vec3(x * per, y * per, z * per);
      // |N l| = det/length, so p = u.z length³/(π det²).
      const real p = uz * INV_PI * length * length * length / (det * det);
      const real ratio = SPECULAR_F(l, v) * fmax(l.z, (real)0) * cell_per_albedo / p;
      m += w * fabs(ratio - 1);
      below += l.z > 0 ? (real)0 : (real)w;
      inside += w * ratio;
    }
  }
  STORE(m + fmax(1 - inside, (real)0), g, out);
  STORE(below, g, out + (size_t)cells);
  STORE(inside, g, out + 2 * (size_t)cells);
}
