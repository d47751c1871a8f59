// Sources for the prefilter: quadrature nodes of the texels as a list, and their anterpolation onto an
// equiangular cube grid, the adjoint of ORDER-point Lagrange interpolation. Where box-filtered mips keep only
// each texel's energy, this keeps the moments: ∑ K(l_a) ∫ L φ_a dω reproduces ∫ L K dω to O((h/α)^ORDER).
// The host defines PATCH and TAPS.

#if W == 1
#define FLOATS float
#define LOAD_FLOATS(p) (*(p))
#define STORE_FLOATS(v, p) (*(p) = (v))
#else
#define FLOATS JOIN(float, W)
#define LOAD_FLOATS(p) JOIN(vload, W)(0, p)
#define STORE_FLOATS(v, p) JOIN(vstore, W)(v, 0, p)
#endif
#if ORDER != 8
#error "a row of a stencil is two vectors of 16 numbers here: 8 nodes of 4"
#endif

// Each texel in cuts × cuts parts of its radiance; columns are those of `out`.
__kernel void cut_texels(__global float *restrict out, __global const float *restrict in, const int columns,
                         const int rows, const int cuts) {
  const int g = get_global_id(0);
  if (g >= rows) return;
  __global const float *p = in + (size_t)(g / cuts) * (columns / cuts) * 3;
  __global float *to = out + (size_t)g * columns * 3;
  for (int j = 0; j < columns / cuts; j++)
    for (int k = 0; k < cuts; k++, to += 3) {
      to[0] = p[3 * j]; to[1] = p[3 * j + 1]; to[2] = p[3 * j + 2];
    }
}

// A piecewise constant image as point masses at its texel centres, exact for polynomials to degree 5 across texels: every
// texel is replaced by its mean of the quartic through the centres around it, the adjoint of which is this filter, first
// by rows, then by columns. tap: for each output TAPS inputs, ~k for row k turned by half the image (over a pole).
__kernel void correct_rows(__global float *restrict out, __global const float *restrict in, const int rows,
                           const int length, __global const int *restrict tap, __global const float *restrict factor) {
  const int g = get_global_id(0), row = g % rows, face = g / rows;
  if (face >= TEXELS_FACES) return;
  const int half_length = length / 2;
  __global float *to = out + (size_t)g * length;
  for (int x = 0; x < length; x++) to[x] = 0;
  for (int k = 0; k < TAPS; k++) {
    const int from = tap[row * TAPS + k];
    const float f = factor[row * TAPS + k];
    if (f == 0) continue;
    __global const float *p = in + ((size_t)face * rows + (from < 0 ? ~from : from)) * length;
    for (int part = 0; part < 2; part++) {
      const int begin = part ? half_length : 0, end = part ? length : half_length;
      const int shift = from >= 0 ? 0 : part ? -half_length : half_length;
      int x = begin;
      for (; x + W <= end; x += W) STORE_FLOATS(LOAD_FLOATS(to + x) + f * LOAD_FLOATS(p + x + shift), to + x);
      for (; x < end; x++) to[x] += f * p[x + shift];
    }
  }
}

__kernel void correct_columns(__global float *restrict out, __global const float *restrict in, const int rows,
                              const int columns, __global const int *restrict tap,
                              __global const float *restrict factor, const float f0, const float f1, const float f2) {
  const int g = get_global_id(0);
  if (g >= TEXELS_FACES * rows) return;
  __global const float *p = in + (size_t)g * columns * 3;
  __global float *to = out + (size_t)g * columns * 3;
  for (int side = 0; side < 2; side++)
    for (int j = side ? columns - TAPS / 2 - 1 : 0; j < (side ? columns : TAPS / 2 + 1); j++)
      for (int c = 0; c < 3; c++) {
        float sum = 0;
        for (int k = 0; k < TAPS; k++) sum += factor[j * TAPS + k] * p[3 * tap[j * TAPS + k] + c];
        to[3 * j + c] = sum;
      }
  int x = 3 * (TAPS / 2 + 1);
  const int end = 3 * (columns - TAPS / 2 - 1);
  for (; x + W <= end; x += W)
    STORE_FLOATS(f0 * LOAD_FLOATS(p + x) + f1 * (LOAD_FLOATS(p + x - 3) + LOAD_FLOATS(p + x + 3)) +
                     f2 * (LOAD_FLOATS(p + x - 6) + LOAD_FLOATS(p + x + 6)), to + x);
  for (; x < end; x++) to[x] = f0 * p[x] + f1 * (p[x - 3] + p[x + 3]) + f2 * (p[x - 6] + p[x + 6]);
}

// Nodes of faces × rows·cuts × columns·cuts, whole rows of them from `first_row`: the list `convolve` reads.
__kernel void nodes(__global scalar *restrict list, const int first_row, const int count, TEXELS_PARAMETERS) {
  const int g = get_global_id(0);
  if (g >= count) return;
  const int width = columns * cuts, height = rows * cuts, row = first_row + g / width;
  const int face = row / height, i = row - face * height, j = g % width;
  xyz d;
  int texel;
  const scalar w = texel_node(face, i, j, &d, &texel, TEXELS_VALUES);
  __global const float *L = radiance + 3 * (size_t)texel;
  __global scalar *p = list + 8 * (size_t)g;
  p[0] = d.x; p[1] = d.y; p[2] = d.z; p[3] = w;
  p[4] = w * L[0]; p[5] = w * L[1]; p[6] = w * L[2]; p[7] = 0;
}

// The nodes of chosen texels, each texel's radiance given apart: bright texels and their excess.
__kernel void chosen_nodes(__global scalar *restrict list, const int first, const int count,
                           __global const int *restrict texels,
                           __global const scalar *restrict excess, TEXELS_PARAMETERS) {
  const int g = get_global_id(0), per = cuts * cuts;
  if (g >= count * per) return;
  const int k = g / per, a = g % per, index = texels[k];
  const int face = index / (rows * columns), row = index / columns % rows, column = index % columns;
  xyz d;
  int texel;
  const scalar w = texel_node(face, row * cuts + a / cuts, column * cuts + a % cuts, &d, &texel, TEXELS_VALUES);
  __global scalar *p = list + 8 * (size_t)(first + g);
  p[0] = d.x; p[1] = d.y; p[2] = d.z; p[3] = w;
  p[4] = w * excess[3 * k]; p[5] = w * excess[3 * k + 1]; p[6] = w * excess[3 * k + 2]; p[7] = 0;
}

static inline int stencil_start(int gap, int n) { return clamp(gap - (ORDER / 2 - 1), 0, n - ORDER); }

// Gaps of a face are served in blocks of PATCH × PATCH, each by one work item that sums into the nodes its stencils reach.
#define REACHED (PATCH + ORDER - 1)
#if PRECISION == 64
#define QUAD double4
#define SIXTEEN double16
#else
#define QUAD float4
#define SIXTEEN float16
#endif

static inline int first_reached(int block, int n) { return stencil_start(block * PATCH, n); }

// patch: [faces][blocks][REACHED][REACHED] of (wL_r, wL_g, wL_b, w), of the faces from `first_face` on. Each work item
// visits the source nodes in a box around its block and takes those whose own gap it holds: every node is counted once.
__kernel void anterpolate(__global scalar *restrict patch, const int n, const int first_face, TEXELS_PARAMETERS) {
  const int g = get_global_id(0), gaps = n - 1, blocks = (gaps + PATCH - 1) / PATCH;
  const int target = first_face + get_global_id(1);
  if (g >= blocks * blocks) return;
  const int bi = g / blocks, bj = g % blocks, gi0 = bi * PATCH, gj0 = bj * PATCH;
  const int gi1 = min(gi0 + PATCH, gaps), gj1 = min(gj0 + PATCH, gaps);
  const scalar u0 = fmax(node_coordinate(gj0, n), -QUARTER_PI), u1 = fmin(node_coordinate(gj1, n), QUARTER_PI);
  const scalar v0 = fmax(node_coordinate(gi0, n), -QUARTER_PI), v1 = fmin(node_coordinate(gi1, n), QUARTER_PI);
  // Half-open in tangent coordinates; blocks at the face's edge are open to it, which cube_face decides.
  const scalar s0 = u0 == -QUARTER_PI ? -2 : tan(u0), s1 = u1 == QUARTER_PI ? 2 : tan(u1);
  const scalar t0 = v0 == -QUARTER_PI ? -2 : tan(v0), t1 = v1 == QUARTER_PI ? 2 : tan(v1);

  __global scalar *p = patch + ((size_t)get_global_id(1) * blocks * blocks + g) * REACHED * REACHED * 4;
  if (u0 >= u1 || v0 >= v1) {  // wholly past an edge
    for (int a = 0; a < REACHED * REACHED * 4; a++) p[a] = 0;
    return;
  }
  const xyz centre = unit3(cube_direction(target, tan((u0 + u1) / 2), tan((v0 + v1) / 2)));
  scalar reach = 0;
  for (int k = 0; k < 4; k++) {
    const xyz corner = unit3(cube_direction(target, tan(k & 1 ? u1 : u0), tan(k & 2 ? v1 : v0)));
    const xyz d = {corner.x - centre.x, corner.y - centre.y, corner.z - centre.z};
    reach = fmax(reach, dot_xyz(d, d));
  }
  const scalar radius = 2 * asin(sqrt(reach) / 2) * (scalar)1.0001 + (scalar)2e-6;

  // Rows of quadruples, so that the ORDER nodes of one stencil row are one vector.
  scalar sum[REACHED * REACHED * 4];
  for (int a = 0; a < REACHED * REACHED * 4; a++) sum[a] = 0;

  const xyz ex = {1, 0, 0}, ey = {0, 1, 0}, ez = {0, 0, 1};
  const xyz fx = to_face(target, ex), fy = to_face(target, ey), fz = to_face(target, ez);  // to_face, column by column
  const int first_i = first_reached(bi, n), first_j = first_reached(bj, n), all = columns * cuts;
  const int at_edge = s0 == -2 || t0 == -2 || s1 == 2 || t1 == 2;
  const scalar last = n - ORDER, back = ORDER / 2 - 1;
  for (int face = 0; face < TEXELS_FACES; face++) {
    const int4 box = texel_box(face, centre, radius, TEXELS_VALUES);
    for (int i = box.x; i < box.y; i++)
      for (int j0 = box.z; j0 < box.w; j0 += W) {
        // W columns side by side as far as the weights; then one by one into the patch.
        scalar direction[3][W], weight[W];
        int texels[W];
        const int count = min(W, box.w - j0);
        for (int l = 0; l < W; l++) {
          const int j = j0 + min(l, count - 1);
          xyz d;
          weight[l] = texel_node(face, i, !TEXELS_WRAP ? j : j < 0 ? j + all : j >= all ? j - all : j, &d, &texels[l],
                                 TEXELS_VALUES);
          direction[0][l] = d.x; direction[1][l] = d.y; direction[2][l] = d.z;
        }
        const real dx = LOAD(0, direction[0]), dy = LOAD(0, direction[1]), dz = LOAD(0, direction[2]);
        const real z = dx * fx.z + dy * fy.z + dz * fz.z, per_z = 1 / (z > 0 ? z : (real)1e-3f);
        const real s = (dx * fx.x + dy * fy.x + dz * fz.x) * per_z, t = (dx * fx.y + dy * fy.y + dz * fz.y) * per_z;
        scalar s_of[W], t_of[W], z_of[W];
        STORE(s, 0, s_of); STORE(t, 0, t_of); STORE(z, 0, z_of);
        int inside[W], some = 0;
        for (int l = 0; l < W; l++) {
          inside[l] = (l < count) & (z_of[l] > 0) & (s_of[l] >= s0) & (s_of[l] < s1) & (t_of[l] >= t0) & (t_of[l] < t1);
          some |= inside[l];
        }
        if (!some) continue;
        const real x = node_number(s, n), y = node_number(t, n);
        // A node that rounding puts on the wrong side of a block's end is met by extrapolating its last stencil.
        const real start_x = fmin(fmax(fmin(fmax(floor(x), (real)gj0), (real)(gj1 - 1)) - back, (real)0), (real)last);
        const real start_y = fmin(fmax(fmin(fmax(floor(y), (real)gi0), (real)(gi1 - 1)) - back, (real)0), (real)last);
        real wu[ORDER], wv[ORDER];
        lagrange(x - start_x, wu);
        lagrange(y - start_y, wv);
        scalar wu_of[ORDER][W], wv_of[ORDER][W], x_of[W], y_of[W];
        for (int a = 0; a < ORDER; a++) { STORE(wu[a], 0, wu_of[a]); STORE(wv[a], 0, wv_of[a]); }
        STORE(start_x, 0, x_of); STORE(start_y, 0, y_of);
        for (int l = 0; l < count; l++) {
          if (!inside[l]) continue;
          if (at_edge) {
            const xyz d = {direction[0][l], direction[1][l], direction[2][l]};
            if (cube_face(d) != target) continue;
          }
          __global const float *L = radiance + 3 * (size_t)texels[l];
          const scalar w = weight[l];
          const QUAD value = (QUAD)(w * L[0], w * L[1], w * L[2], w);
          const SIXTEEN left = (SIXTEEN)(value * wu_of[0][l], value * wu_of[1][l], value * wu_of[2][l],
                                         value * wu_of[3][l]);
          const SIXTEEN right = (SIXTEEN)(value * wu_of[4][l], value * wu_of[5][l], value * wu_of[6][l],
                                          value * wu_of[7][l]);
          scalar *at = sum + 4 * (((int)y_of[l] - first_i) * REACHED + (int)x_of[l] - first_j);
          for (int a = 0; a < ORDER; a++, at += 4 * REACHED) {
            vstore16(vload16(0, at) + left * wv_of[a][l], 0, at);
            vstore16(vload16(1, at) + right * wv_of[a][l], 1, at);
          }
        }
      }
  }
  for (int a = 0; a < REACHED * REACHED * 4; a++) p[a] = sum[a];
}

// grid: [6][n][n] of (wL_r, wL_g, wL_b, w). A node collects from the blocks whose stencils reach it.
__kernel void gather(__global scalar *restrict grid, const int n, const int first_face,
                     __global const scalar *restrict patch) {
  const int g = get_global_id(0), gaps = n - 1, blocks = (gaps + PATCH - 1) / PATCH;
  const int part = get_global_id(1), face = first_face + part;
  if (g >= n * n) return;
  const int i = g / n, j = g % n;
  QUAD sum = (QUAD)(0);
  for (int bi = max((i - ORDER) / PATCH - 1, 0); bi <= min(i / PATCH + 1, blocks - 1); bi++) {
    const int a = i - first_reached(bi, n);
    if (a < 0 || a >= REACHED) continue;
    for (int bj = max((j - ORDER) / PATCH - 1, 0); bj <= min(j / PATCH + 1, blocks - 1); bj++) {
      const int b = j - first_reached(bj, n);
      if (b < 0 || b >= REACHED) continue;
      const size_t block = ((size_t)part * blocks + bi) * blocks + bj;
      sum += vload4(block * REACHED * REACHED + a * REACHED + b, patch);
    }
  }
  vstore4(sum, (size_t)face * n * n + g, grid);
}

// One axis of the anterpolation of a fine grid onto a coarser one: out[face][a][k] = ∑_i M[i][a] in[face][i][k]
// for `inner` values k of 4 scalars; called with the axes exchanged for the second. M is fine × coarse.
__kernel void coarsen(__global scalar *restrict out, __global const scalar *restrict in,
                      __global const scalar *restrict matrix, __global const int *restrict first,
                      __global const int *restrict last, const int fine, const int coarse, const int outer_stride,
                      const int count) {
  // Item (face·lines + line, a): `outer_stride` is 1 when the axis is the innermost, else the line length.
  const int g = get_global_id(0);
  if (g >= count * coarse) return;
  const int a = outer_stride == 1 ? g % coarse : g / outer_stride % coarse;
  const int line = outer_stride == 1 ? g / coarse : g / (outer_stride * coarse);
  const int inner = outer_stride == 1 ? 0 : g % outer_stride;
  QUAD sum = (QUAD)(0);
  for (int i = first[a]; i < last[a]; i++)
    sum += matrix[(size_t)i * coarse + a] * vload4(((size_t)line * fine + i) * outer_stride + inner, in);
  vstore4(sum, g, out);
}

// The grid as the list that `convolve` reads, its directions from the tangent table of n coordinates.
__kernel void grid_list(__global scalar *restrict list, const int n, __global const scalar *restrict tangent,
                        __global const scalar *restrict grid) {
  const int g = get_global_id(0);
  if (g >= 6 * n * n) return;
  const xyz d = unit3(cube_direction(g / (n * n), tangent[g % n], tangent[g / n % n]));
  __global const scalar *q = grid + 4 * (size_t)g;
  __global scalar *p = list + 8 * (size_t)g;
  p[0] = d.x; p[1] = d.y; p[2] = d.z; p[3] = q[3];
  p[4] = q[0]; p[5] = q[1]; p[6] = q[2]; p[7] = 0;
}
