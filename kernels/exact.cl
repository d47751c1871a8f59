// The exact integral of a lobe much narrower than a texel, near its direction: only the texels within reach, each cut as
// finely as the lobe needs. The rest, smooth on the scale of the window, is `convolve`'s. Lanes are nodes.

// sum: [count][4] = ∑K wL (rgb) and ∑K w of the nodes within `window`; direction: [3][count]. radius: of the window's end.
__kernel void convolve_texels(__global scalar *restrict sum, const int count, __global const scalar *restrict direction,
                              const scalar window, const scalar per_window, const scalar radius,
                              TEXELS_PARAMETERS NDF_SCALARS) {
  const int g = get_global_id(0);
  if (g >= count) return;
  const xyz r = {direction[g], direction[count + g], direction[2 * count + g]};
  const int all = columns * cuts;
  real total[4];
  for (int c = 0; c < 4; c++) total[c] = (real)0;
  for (int face = 0; face < TEXELS_FACES; face++) {
    const int4 box = texel_box(face, r, radius, TEXELS_VALUES);
    for (int i = box.x; i < box.y; i++) {
      real row[4];
      for (int c = 0; c < 4; c++) row[c] = (real)0;
      for (int j0 = box.z; j0 < box.w; j0 += W) {
        scalar q_of[W], w_of[4][W];
        for (int l = 0; l < W; l++) {
          const int j = min(j0 + l, box.w - 1);
          xyz d;
          int texel;
          const scalar w = texel_node(face, i, !TEXELS_WRAP ? j : j < 0 ? j + all : j >= all ? j - all : j, &d, &texel,
                                      TEXELS_VALUES);
          const xyz apart = {d.x - r.x, d.y - r.y, d.z - r.z};
          __global const float *L = radiance + 3 * (size_t)texel;
          q_of[l] = dot_xyz(apart, apart);
          w_of[3][l] = j0 + l < box.w ? w : 0;
          for (int c = 0; c < 3; c++) w_of[c][l] = w_of[3][l] * L[c];
        }
        const real q = LOAD(0, q_of), K = lobe(q NDF_VALUES) * (1 - step_up(q, window, per_window));
        for (int c = 0; c < 4; c++) row[c] += K * LOAD(0, w_of[c]);
      }
      for (int c = 0; c < 4; c++) total[c] += row[c];
    }
  }
  for (int c = 0; c < 4; c++) {
    scalar lane[W], whole = 0;
    STORE(total[c], 0, lane);
    for (int l = 0; l < W; l++) whole += lane[l];
    sum[4 * g + c] = whole;
  }
}
