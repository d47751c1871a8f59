// The loop of integrate.cl over half vectors for models with kinks: panels meet wherever the integrand has one.
//
// A kink lies at a value c of v·m that may depend on the ring (MASKING_KINK, FRESNEL_KINK), and v·m falls with the
// azimuth, so it is one point of each half ring: cos φ = (c - cos θv cos θ)/(sin θv sin θ). In θ panels meet where such a
// point enters or leaves a ring, where two of them cross, and at the θ1 of ring.clh: the host knows these angles.
// Panels end in square roots on both sides: φ leaves 0 and φmax leaves π like one, F at the critical angle is one, and
// the ring's integral has a power 3/2 where a kink enters. x -> x²(3 - 2x) makes all of these smooth.
// In θ all panels are parts of one variable u, θ = s sinh u, s the lobe's width or θ1 if that is smaller (ring.clh), so
// that neighbours meet to the last digit.
//
// out: [COMPONENTS][cells]; theta: (x, w) of a panel; phi: (x, w) of a panel. The cell's edges are angles θ and, beside
// them, π/2 - θ, which is exact where θ is at grazing.
#ifndef MASKING_KINK
#define MASKING_KINK(NoV, NoM) ((real)2)
#endif
#ifndef MASKING_KINK_2
#define MASKING_KINK_2(NoV, NoM) ((real)2)
#endif
#ifndef FRESNEL_KINK
#define FRESNEL_KINK(NoV, NoM) ((real)2)
#endif

__kernel void integrate(__global scalar *restrict out, const int cells, const int nodes,
                        __global const scalar *restrict theta, const int azimuths,
                        __global const scalar *restrict phi CELL_ARRAYS) {
  const int g = get_global_id(0);
  if ((g + 1) * W > cells) return;
  CELL_LOAD
  const View v = view_of(cell_NoV, NDF_WIDTH, NDF_REACH);
  const real at_v = MASKING_AT(v.NoV), above = atan2(v.NoV, v.sin_v);
  const real edges[EDGES + 2] = {(real)0, CELL_EDGES, HALF_PI - above / 2};
  const real rests[EDGES + 2] = {(real)HALF_PI, CELL_RESTS, above / 2};
  const real grade = fmin(v.width, fmax(above / 2, v.width * (scalar)1e-4));
  real sum[COMPONENTS], rest[COMPONENTS];
  for (int c = 0; c < COMPONENTS; c++) sum[c] = rest[c] = (real)0;
  for (int k = 0; k < (EDGES + 1) * nodes; k++) {
    const int panel = k / nodes;
    const scalar x = theta[2 * (k % nodes)], y = 1 - x, q = x * x * (1 + 2 * y), left = y * y * (1 + 2 * x);
    const real low = fmin(edges[panel], v.reach), high = fmin(edges[panel + 1], v.reach);
    const real from = low / grade, to = high / grade;
    const real u_0 = log(from + sqrt(from * from + 1)), u_1 = log(to + sqrt(to * to + 1)), range = u_1 - u_0;
    const real u = u_0 + range * q, e = exp(u), i = 1 / e, theta_m = grade * sinh_(u, e);
    // sinh(u_1) - sinh(u), with no cancellation.
    const real apart = range * left / 2, f = exp(u + apart);
    const real up = rests[panel + 1] + (edges[panel + 1] - high) + grade * (f + 1 / f) * sinh_(apart, exp(apart));
    const real cos_m = theta_m > QUARTER_PI ? sin(up) : cos(theta_m), sin_m = theta_m > QUARTER_PI ? cos(up) : sin(theta_m);
    const real sin2_m = sin_m * sin_m;
    const real weight = 2 * sin_m * (grade * (e + i) / 2) * range * (6 * x * y * theta[2 * (k % nodes) + 1]);
    const real edge = -v.cot_v * (cos_m * cos_m - sin2_m) / fmax(2 * sin_m * cos_m, (real)1e-30f);
    const real least = fmin(fmax(edge, (real)-1), (real)1);
    // The azimuths of the kinks in their order, those off the half ring at its ends.
    const real middle = v.NoV * cos_m, per = 1 / fmax(v.sin_v * sin_m, (real)1e-30f);
    real a = (MASKING_KINK(v.NoV, cos_m) - middle) * per, b = (MASKING_KINK_2(v.NoV, cos_m) - middle) * per;
    real c = (FRESNEL_KINK(v.NoV, cos_m) - middle) * per;
    const real most = fmax(a, fmax(b, c)), fewest = fmin(a, fmin(b, c)), third = fmax(fmin(a, b), fmin(fmax(a, b), c));
    real turns[5];
    turns[0] = (real)0;
    turns[1] = acos(fmin(fmax(most, least), (real)1));
    turns[2] = acos(fmin(fmax(third, least), (real)1));
    turns[3] = acos(fmin(fmax(fewest, least), (real)1));
    turns[4] = acos(least);
    real inner[COMPONENTS];
    for (int n = 0; n < COMPONENTS; n++) inner[n] = (real)0;
    // Missing kinks are at v·m = 2 and sort to the front, where their panels are empty.
    for (int part = 3 - KINKS; part < 4; part++) {
      const real length = turns[part + 1] - turns[part];
      real some[COMPONENTS];
      for (int n = 0; n < COMPONENTS; n++) some[n] = (real)0;
      for (int j = 0; j < azimuths; j++) {
        const scalar t = phi[2 * j], s = 1 - t;
        const real cos_phi = cos_0_pi(turns[part] + length * (t * t * (1 + 2 * s)));
        const real VoM = fmax(middle + v.sin_v * sin_m * cos_phi, (real)0);
        const Facet f_ = {v.NoV, 2 * VoM * cos_m - v.NoV, cos_m, VoM, at_v};
        integrand(some, 6 * t * s * phi[2 * j + 1], f_ CELL_VALUES);
      }
      for (int n = 0; n < COMPONENTS; n++) inner[n] += some[n] * length;
    }
    const real D = NDF_D(cos_m, sin2_m) * weight;
    for (int n = 0; n < COMPONENTS; n++) add(&sum[n], &rest[n], high > low ? inner[n] * D : (real)0);
  }
  for (int c = 0; c < COMPONENTS; c++) STORE(sum[c], g, out + (size_t)c * cells);
}
