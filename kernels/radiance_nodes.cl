// L_o(v) = ∑ w L f(l, v)(n·l) over a list of nodes {x, y, z, weight, weight × radiance} of an environment. Lanes are
// nodes, since views are few and nodes many; a work item takes every items-th vector of them for one view.
// out: [COMPONENTS][views][items·W], to be added up in float64. The rows of a view are repeated W times.

__kernel void integrate(__global scalar *restrict out, const int cells, const int items, const int steps,
                        __global const scalar *restrict list CELL_ARRAYS) {
  const int item = get_global_id(0), g = get_global_id(1);
  CELL_LOAD
  const real NoV = fmax(cell_NoV, (real)LEAST_COSINE), sin_v = sqrt(one_minus_sqr(NoV));
  const real3 v = vec3(sin_v * cos(cell_phi), sin_v * sin(cell_phi), NoV);
  const size_t stride = (size_t)items * steps * W;
  real sum[3] = {(real)0, (real)0, (real)0};
  for (int k = 0; k < steps; k++) {
    const size_t at = (size_t)k * items + item;
    const real z = LOAD(at, list + 2 * stride);
    const real3 l = vec3(LOAD(at, list), LOAD(at, list + stride), fmax(z, (real)LEAST_COSINE));
    real f[3] = {(real)0, (real)0, (real)0};
    scatter(f, z > 0 ? z : (real)0, l, v CELL_VALUES);
    for (int c = 0; c < 3; c++) {
      const real share = LOAD(at, list + (4 + c) * stride) * f[c];
      sum[c] += z > 0 ? share : (real)0;
    }
  }
  const size_t views = (size_t)cells / W;
  for (int c = 0; c < 3; c++) STORE(sum[c], item, out + ((size_t)c * views + g) * items * W);
}
