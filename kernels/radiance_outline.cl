// L_o(v) = ∫ f(l, v)(n·l) dω_l over the part of the sphere inside an outline: an area light above the horizon. Lanes
// are panels of outlines, pieces of curves P(t) = C + A cos t + B sin t seen from the origin, l = P/|P|.
//
// By Green's theorem, with polar coordinates (θ, φ) about n of whatever the region is made of,
//   ∫∫ g sin θ dθ dφ = ∮ G(θ(t), φ(t)) φ'(t) dt,   G(θ, φ) = ∫_0^θ g(θ', φ) sin θ' dθ',
// every azimuth from n to the outline. HALF_ANGLE (lobes): over half vectors, φ' of H = l + v, where the lobe is a
// function about n that knows no grazing stretch; f (n·l) dω_l = F D V (n·l)(v·h) dω_h (facet.clh). The half vectors of
// all l above n are star-shaped about n, so the inner path stays above the horizon. SMOOTH (diffuse models): over l.
//
// A panel starts where the outline passes n nearest, or where something else is short there, and is graded away from it
// by t = s sinh(Rx). The inner path is graded from n by the lobe's width and from its end, where l may set.
// out: [COMPONENTS][panels]; theta: (x, w) of the inner path, `first` from n, the rest from its end; along: (x, w) of t.

// ∫ over [0, length] of a variable y = s sinh(Rx): y and dy. s is at most the length: log cancels for a ratio below 1.
static inline void graded(real scale, real length, scalar x, scalar w, real *y, real *dy) {
  const real s = fmin(scale, length), ratio = length / s, range = log(ratio + sqrt(ratio * ratio + 1)), u = range * x;
  const real e = exp(u), i = 1 / e;
#if PRECISION == 64
  const real sinh_u = sinh(u);
#else
  const real u2 = u * u, sinh_u = u < (real)0.3 ? u * (1 + u2 / 6 * (1 + u2 / 20 * (1 + u2 / 42))) : (e - i) / 2;
#endif
  *y = s * sinh_u;
  *dy = s * (e + i) / 2 * range * w;
}

__kernel void integrate(__global scalar *restrict out, const int cells, const int first, const int nodes,
                        __global const scalar *restrict theta, const int alongs,
                        __global const scalar *restrict along CELL_ARRAYS) {
  const int g = get_global_id(0);
  if ((g + 1) * W > cells) return;
  CELL_LOAD
  const real NoV = fmax(cell_NoV, (real)LEAST_COSINE), sin_v = sqrt(one_minus_sqr(NoV));
  const real3 v = vec3(sin_v * cos(cell_phi), sin_v * sin(cell_phi), NoV);
#ifdef SMOOTH
  const real theta_v = atan2(sin_v, NoV);
#elif defined(ANISOTROPIC)
  const real ax = NDF_STRETCH_X, ay = NDF_STRETCH_Y, at_v = MASKING_AT(v);
#elif defined(WHOLE)
  const real width = (real)LOBE_WIDTH;
#else
  const real width = NDF_WIDTH, reach = NDF_REACH, at_v = MASKING_AT(NoV);
#endif
  real sum[COMPONENTS];
  for (int c = 0; c < COMPONENTS; c++) sum[c] = (real)0;
  for (int a = 0; a < alongs; a++) {
    real t, dt;
    graded(cell_scale, fabs(cell_length), along[2 * a], along[2 * a + 1], &t, &dt);
    t = cell_length < 0 ? -t : t;  // graded backwards; the way itself runs forwards
    const real ct = cos(t), st = sin(t);
    const real3 P = vec3(cell_Cx + cell_Ax * ct + cell_Bx * st, cell_Cy + cell_Ay * ct + cell_By * st,
                         fmax(cell_Cz + cell_Az * ct + cell_Bz * st, (real)0));
    const real per = 1 / sqrt(dot3(P, P));
    const real3 l = vec3(P.x * per, P.y * per, P.z * per);
    const real3 d = vec3((cell_Bx * ct - cell_Ax * st) * per, (cell_By * ct - cell_Ay * st) * per,
                         (cell_Bz * ct - cell_Az * st) * per);
    const real ld = dot3(l, d), dx = d.x - l.x * ld, dy = d.y - l.y * ld;
#ifdef SMOOTH
    const real hx = l.x, hy = l.y, hz = l.z;
#else
    const real hx = l.x + v.x, hy = l.y + v.y, hz = l.z + v.z;
#endif
    // 1e-36 keeps the azimuth of n itself finite; what is summed there is 0.
    const real q = fmax(hx * hx + hy * hy, (real)1e-36f), root = sqrt(q), cx = hx / root, cy = hy / root;
    const real turn = (hx * dy - hy * dx) / q * dt, end = atan2(root, hz);
    real inner[COMPONENTS];
    for (int c = 0; c < COMPONENTS; c++) inner[c] = (real)0;
#ifdef SMOOTH
    const real middle = fmin(theta_v, end);  // where Oren and Nayar's maximum of two angles has its kink
#else
#ifdef ANISOTROPIC
    const real width = 1 / sqrt(sqr(cx / ax) + sqr(cy / ay)), upper = end, sets = fmin(NoV, width) + l.z;
#elif defined(WHOLE)
    const real upper = end, sets = fmin(NoV, width) + l.z;
#else
    const real upper = fmin(end, reach), sets = end > reach ? (real)1 : fmin(NoV, width) + l.z;
#endif
    const real middle = upper / 2;
#endif
    for (int k = 0; k < nodes; k++) {
      const scalar x = theta[2 * k], w = theta[2 * k + 1];
      real angle, weight;
#ifdef SMOOTH
      const scalar y = 1 - x;  // smoothed at the horizon, n·l to a power
      angle = k < first ? middle * x : middle + (end - middle) * (1 - y * y * y);
      weight = k < first ? middle * w : (end - middle) * (3 * y * y * w);
      const real sin_t = sin(angle), cos_t = fmax(sin(HALF_PI - angle), (real)0);
      const real3 to = vec3(sin_t * cx, sin_t * cy, cos_t);
      scatter(inner, weight * sin_t * cos_t, to, v CELL_VALUES);
#else
      // From its end the path is graded by the cosine n·l at which masking turns.
      const real s = k < first ? fmin(width, (real)1) : fmin(fmax(sets, (real)1e-3f), (real)1);
      graded(s, fmax(middle, (real)1e-30f), x, w, &angle, &weight);
      angle = k < first ? angle : upper - angle;
      const real sin_m = sin(angle), cos_m = cos(angle);
      const real3 m = vec3(sin_m * cx, sin_m * cy, cos_m);
      const real VoM = fmax(dot3(v, m), (real)0), NoL = fmax(2 * VoM * cos_m - NoV, (real)0);
      const real measure = weight * sin_m;
#if defined(WHOLE)
      const real3 to = vec3(2 * VoM * m.x - v.x, 2 * VoM * m.y - v.y, fmax(NoL, (real)LEAST_COSINE));
      scatter(inner, measure * (4 * VoM * NoL), to, v CELL_VALUES);
#else
#ifdef ANISOTROPIC
      const real3 to = vec3(2 * VoM * m.x - v.x, 2 * VoM * m.y - v.y, NoL);
      const Facet f = {NoV, NoL, cos_m, VoM, at_v, to};
      const real D = NDF_D(m);
#else
      const Facet f = {NoV, NoL, cos_m, VoM, at_v};
      const real D = NDF_D(cos_m, sin_m * sin_m);
#endif
      inner[0] += measure * D * VISIBLE(f) * FRESNEL_F(VoM);
#endif
#endif
    }
    for (int c = 0; c < COMPONENTS; c++) sum[c] += inner[c] * turn;
  }
  for (int c = 0; c < COMPONENTS; c++) STORE(sum[c], g, out + (size_t)c * cells);
}
