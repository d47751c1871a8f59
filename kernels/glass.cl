// The light from direction v that a rough boundary of two insulators reflects and transmits, by microfacets m that each
// reflect F(v·m) and refract the rest. [Walter2007, eqs. 20, 21 and 22] Lanes are cells.
//
// Over microfacets the Jacobians of reflection (eq. 14) and refraction (eq. 17) leave the same form for both,
//   R = ∫ F D V (n·l_r)(v·m) dω_m,   T = ∫ (1 - F) D V |n·l_t|(v·m) dω_m,   V = G/((n·v)|n·l|),
// energy of light that arrives from v, whichever way it is followed; radiance in T has n² besides, which is no energy.
// G is the masking's for |n·l| on either side: of Smith's height-correlated form 1/(1 + Λ(v) + Λ(l)), as in renderers.
//
// Microfacets are counted in the frame of v: θ_c between m and v, ψ about v from the normal. Fresnel's term depends on
// θ_c alone, and every bound on m is one on n·m at fixed θ_c, thus on σ = sin²(ψ/2): n·m = cos δ - 2 sin θ_c sin θ_v σ,
// δ = θ_c - θ_v. Reflected light is above the horizon where n·m > n·v/(2 cos θ_c), a front face has n·m > 0, and
// refracted light is below it where n·m < n·v/(cos θ_c - n cos θ_t), which binds for n < 1 only.
// The polar variable x is the larger of θ_c and θ_t: sin θ_c = κ sin x with κ = min(n, 1) and sin θ_t = sin x/max(n,
// 1), so total reflection ends the range at x = π/2, where 1 - F falls like cos x without the root it has in θ_c. Nodes
// in x are graded by sinh from the lobe, x_v, with its width w; in ψ so from 0, with the distance to the lobe at that
// θ_c. Panels end at x_v and where a bound on ψ begins to bind:
//   reflected  θ_c = (π/2 - θ_v)/2 (from there n·l_r > 0 binds)  and  θ_c = (π/2 + θ_v)/2, the last
//   refracted  θ_c = π/2 - θ_v (n·m > 0)  and, n < 1,  tan θ_c = n·v/(1/n - sin θ_v), where l_t meets the horizon at ψ = 0.
// Bounds begin to bind like a root there: x -> x²(3 - 2x) in every panel takes it.

static inline real asinh_(real x) {
  const real a = fabs(x);
  const real y = log_near(a + sqrt(a * a + 1), a + a * a / (1 + sqrt(a * a + 1)));
  return x < 0 ? -y : y;
}

// out: [2][cells], first the reflected share, of n < 1 what would have been reflected but is not: ∫ (1 - F) …, since F
// = 1 beyond the range of x; theta and psi: (x, w) of a panel.
__kernel void integrate(__global scalar *restrict out, const int cells, const int nodes,
                        __global const scalar *restrict theta, const int azimuths,
                        __global const scalar *restrict psi CELL_ARRAYS) {
  const int g = get_global_id(0);
  if ((g + 1) * W > cells) return;
  CELL_LOAD
  const real n = fresnel_ior, NoV = fmax(cell_NoV, (real)1e-18f), sin_v = sqrt(one_minus_sqr(NoV));
  const real theta_v = atan2(sin_v, NoV), above = atan2(NoV, sin_v), at_v = MASKING_AT(cell_NoV);
  const real kappa = fmin(n, (real)1), lambda = 1 / fmax(n, (real)1), steep = (n - 1) * (n + 1);
  const real width = fmin(NDF_WIDTH, (real)1);
  // Of a lobe beyond total reflection the range has what lies nearest.
  const real x_v = n < 1 ? asin(fmin(sin_v / kappa, (real)1)) : theta_v, gap = fmin(kappa - sin_v, (real)0);
  real sum[2] = {(real)0, (real)0}, rest[2] = {(real)0, (real)0};
  for (int side = 0; side < 2; side++) {
    // The ends of panels as angles between m and v, then as x, in their order.
    const real low = side ? above : above / 2, high = side ? (real)HALF_PI : HALF_PI - above / 2;
    const real horizon = atan2(NoV, 1 / n - sin_v);
    const bool refracts = side == 1;
    const real third = n < 1 ? fmin(horizon + above, (real)HALF_PI) : (real)HALF_PI;
    const real second = asin(fmin(sin(low) / kappa, (real)1));
    real end[5];
    end[0] = (real)0;
    end[1] = fmin(fmin(x_v, second), refracts ? third : second);
    end[3] = refracts ? fmax(fmax(x_v, second), third) : fmax(x_v, second);
    end[2] = refracts ? x_v + second + third - end[1] - end[3] : end[3];
    end[4] = refracts ? (real)HALF_PI : asin(fmin(sin(high) / kappa, (real)1));
    for (int panel = 0; panel < 4; panel++) {
      if (side == 0 && panel == 2) continue;
      const real from = asinh_((fmin(end[panel], end[4]) - x_v) / width);
      const real length = fmax(asinh_((fmin(end[panel + 1], end[4]) - x_v) / width) - from, (real)0);
      for (int k = 0; k < nodes; k++) {
        const scalar t = theta[2 * k];
        const real u = from + length * (t * t * (3 - 2 * t)), du = length * (6 * t * (1 - t) * theta[2 * k + 1]);
        const real grow = exp(fabs(u)), more = expm1(fabs(u)), arm = width * (more + more / grow) / 2;
        const real off = u < 0 ? -arm : arm, x = x_v + off;
        const real sin_x = sin(fmin(fmax(x, (real)0), (real)HALF_PI));
        const real cos_x = sin(fmin(fmax(HALF_PI - x, (real)0), (real)HALF_PI));
        const real sin_c = kappa * sin_x;
        const real c = sqrt(cos_x * cos_x + (1 - kappa) * (1 + kappa) * (sin_x * sin_x));
        const real ct = sqrt(cos_x * cos_x + (1 - lambda) * (1 + lambda) * (sin_x * sin_x));
        // By differences of sines where x is θ_t: the lobe is made of δ.
        const real middle = sin(fmax(HALF_PI - x_v - off / 2, (real)0));
        const real apart = gap + kappa * (2 * middle * sin(off / 2));
        const real between = 2 * cos((atan2(sin_c, c) + theta_v) / 2);
        const real half_d = n < 1 ? fmin(fmax(apart / fmax(between, (real)1e-12f), (real)-1), (real)1) : sin(off / 2);
        const real cos_d = 1 - 2 * half_d * half_d, across = sin_c * sin_v, wide = fmax(2 * across, (real)1e-30f);
        // n cos θ_t - cos θ_c and Fresnel's term by its two transmittances, which do not cancel for n -> 1.
        const real nct = n * ct, both = fmax(c + nct, (real)1e-18f), p = fmax(n * c + ct, (real)1e-18f);
        const real bend = steep / both;
        const real through = 2 * c * nct * (1 / (both * both) + 1 / (p * p));
        // r_p = (n²c - n cos θ_t)/…: (n² c)² - (n cos θ_t)² = (n² - 1)((n² + 1)c² - 1)
        const real r_s = steep / (both * both), r_p = steep * ((n * n + 1) * c * c - 1) / (n * n * p * p);
        const real share = side || n < 1 ? through : (r_s * r_s + r_p * r_p) / 2;
        const real least = refracts ? (real)0 : NoV / (2 * fmax(c, (real)1e-18f));
        const real most = refracts && n < 1 ? NoV / fmax(-bend, (real)1e-30f) : (real)2;
        const real first = asin(sqrt(fmin(fmax((cos_d - most) / wide, (real)0), (real)1)));
        const real last = asin(sqrt(fmin(fmax((cos_d - least) / wide, (real)0), (real)1)));
        const real scale = fmin(sqrt((width * width / 4 + half_d * half_d) / fmax(across, (real)1e-30f)), (real)8);
        const real begin = asinh_(first / scale), range = fmax(asinh_(last / scale) - begin, (real)0);
        real inner = (real)0;
        for (int j = 0; j < azimuths; j++) {
          const real v = begin + range * psi[2 * j], m = expm1_(v), e = 1 + m, i = 1 / e;
          const real y = scale * (m + m * i) / 2, half_sin = sin_half(y);
          const real fall = 2 * half_d * half_d + 2 * across * (half_sin * half_sin), NoM = 1 - fall;
          const real NoL = fmax(refracts ? (NoV + bend * NoM) / n : 2 * c * NoM - NoV, (real)0);
          inner += psi[2 * j + 1] * (e + i) * NoL * NDF_D(NoM, fall * (2 - fall)) *
                   MASKING_V(NoV, NoL, NoM, c, at_v, MASKING_AT(NoL));
        }
        // dω_m (v·m) = κ² sin x cos x dx dψ, both halves of ψ = 2y; dx = w cosh u du, dy = scale cosh v dv.
        const real dx = width * (grow + 1 / grow) / 2 * du;
        add(&sum[side], &rest[side], inner * (2 * scale * range) * (kappa * kappa * sin_x * cos_x * dx) * share);
      }
    }
  }
  STORE(sum[0], g, out);
  STORE(sum[1], g, out + (size_t)cells);
}
