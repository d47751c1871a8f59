// The split-sum pair of GGX for a masking that does not depend on azimuth at fixed n·l (Smith's): a sum over the polar
// angle of l with the azimuth of D in closed form, which leaves a short sum for Schlick's part. Lanes are cells.
//
// With φ counted from the mirror direction, l = (θ, φ), N = (n·l + n·v)², S = sin²(φ/2), s_l and s_v the sines,
//   |l + v|² = w = q + κ,   q = A + (B - A) S,   A = (s_l - s_v)² + α²N,   B = (s_l + s_v)² + α²N,   κ = (1 - α²) N,
// GGX is D = α²/π (w/q)² [Walter2007, eq. 33, times |l + v|⁴], and over a turn, with ∆ = √(AB),
//   ∫ D dφ = 2α² (1 + 2κ/∆ + κ²(A + B)/(2∆³)):   E = ∫ n·l V/4 ∫ D dφ d(n·l), f = D V/4, V = G/((n·l)(n·v)).
// Schlick's part has (1 - v·h)⁵ under the same integral, v·h = √w/2. All its poles and its root lie at tan²(φ/2) between
// -1 and -A/B, the branch points of dφ/√q, so two steps of Gauss's transformation of that integral (the arithmetic and
// geometric means of √A and √B) spread them: with s = sin of the angle before and s' after it,
//   s = 2a s'/((a + b) + (a - b) s'²),   dφ/√q keeps its form with (a + b)/2 and √(ab).
// The integrand is periodic then, and the midpoint rule takes it to 3e-6 with 12 nodes, 1e-7 with 14. Two steps, not
// three: a narrow lobe is a double pole, which the third spreads too thin.
//
// In θ three panels meet at θ_v and half-way to the horizon, graded from θ_v both ways and from the horizon like sinh with
// the scale 2 min(α, √(α n·v)), the width of the lobe across the plane of incidence.

// out: [2][cells]; theta: (x, w) of a panel; turns: (s, 1 - s) of the midpoints.
__kernel void integrate(__global scalar *restrict out, const int cells, const int nodes,
                        __global const scalar *restrict theta, const int azimuths,
                        __global const scalar *restrict turns CELL_ARRAYS) {
  const int g = get_global_id(0);
  if ((g + 1) * W > cells) return;
  CELL_LOAD
  const real alpha = ndf_alpha, a2 = sqr(alpha), NoV = cell_NoV, sin_v = sqrt(one_minus_sqr(NoV));
  const real theta_v = atan2(sin_v, NoV), above = atan2(NoV, sin_v), at_v = MASKING_AT(NoV);
  const real grade = 2 * fmin(alpha, sqrt(alpha * NoV));
  real E = (real)0, E_rest = (real)0, F = (real)0, F_rest = (real)0;
  for (int panel = 0; panel < 3; panel++) {
    const real length = panel == 0 ? theta_v : above / 2, ratio = length / grade, root = sqrt(ratio * ratio + 1);
    const real range = log_near(ratio + root, ratio + ratio * ratio / (1 + root));  // asinh
    // From the rounded range the scale follows again, so that panels meet.
    const real all = expm1_(range), scale = range > (real)0.3f ? 2 * length / (all + all / (1 + all)) : grade;
    for (int k = 0; k < nodes; k++) {
      const scalar x = theta[2 * k], weight = theta[2 * k + 1];
      const real m = expm1_(range * x), e = 1 + m;
      const real off = scale * (m + m / e) / 2, dtheta = scale * (e + 1 / e) / 2 * range * weight;
      // All differences by half angles: s_l - s_v is what the peak of D is made of.
      const real half_sin = sin_half(off / 2), half_cos = sqrt(one_minus_sqr(half_sin));
      const real sin_off = 2 * half_sin * half_cos, cos_off = (half_cos - half_sin) * (half_cos + half_sin);
      const real side = panel == 0 ? (real)1 : (real)-1;
      const real NoL = fmax(panel == 2 ? sin_off : NoV * cos_off + side * (sin_v * sin_off), (real)0);
      const real sin_l = fmax(panel == 2 ? cos_off : sin_v * cos_off - side * (NoV * sin_off), (real)0);
      const real apart = panel == 2 ? 2 * sin_half((above + off) / 2) * sin_half((above - off) / 2)
                                    : -2 * side * half_sin * (NoV * half_cos + side * (sin_v * half_sin));
      const real N = sqr(NoL + NoV), A = apart * apart + a2 * N, spread = 4 * sin_l * sin_v, B = A + spread;
      const real kappa = (1 - alpha) * (1 + alpha) * N, a = sqrt(A), b = sqrt(B), delta = a * b, u = kappa / delta;
      const real before = NoL * sin_l * dtheta * MASKING_V(NoV, NoL, (real)1, (real)1, at_v, MASKING_AT(NoL)) / 4;
      add(&E, &E_rest, before * (2 * a2) * (1 + 2 * u + u * u * ((A + B) / 2 / delta)));
      // b - a from its squares: at α = 1 and towards n both are alike.
      const real wide = spread / (a + b), a_1 = (a + b) / 2, b_1 = sqrt(delta), sum = a_1 + b_1;
      const real less = sqr(wide / 2) / sum;  // a_1 - b_1, as a_1² - b_1² = ((b - a)/2)²
      const real last = sqr(sum / 2), fall = -sqr(less / 2);  // a_2² and b_2² - a_2²
      real inner = (real)0;
      for (int j = 0; j < azimuths; j++) {
        const scalar s = turns[2 * j], left = turns[2 * j + 1];
        // Both steps as p/q; (q - p)(q + p) of the first without its cancellation at s = 1.
        const real p = 2 * a_1 * s, q = sum + less * (s * s);
        const real top = 2 * a * p * q, bottom = 2 * a * q * q + wide * ((sum - less * s) * left * (q + p));
        const real S = sqr(top / bottom), den = A + spread * S, w = den + kappa;
        const real up = 1 - sqrt(fmin(w, (real)4)) / 2, up2 = up * up;
        inner += w * w / (den * sqrt(den * (last + fall * (s * s)))) * (up2 * up2 * up);
      }
      add(&F, &F_rest, before * a2 * 2 / azimuths * inner);
    }
  }
  STORE(E - F, g, out);
  STORE(F, g, out + (size_t)cells);
}
