// Sources for the prefilter: quadrature nodes of the texels as a list, and their anterpolation onto an
// equiangular cube grid, the adjoint of ORDER-point Lagrange interpolation. Where box-filtered mips keep only
// each texel's energy, this keeps the moments: ∑ K(l_a) ∫ L φ_a dω reproduces ∫ L K dω to O((h/α)^ORDER).
//
// The grid has n × n nodes a face at u = tan((2(a + ½)/n - 1)π/4). Between neighbouring nodes the stencil is
// fixed, so work items are the (n - 1)² gaps of a face; the outer ones reach to the face's edge.
#ifndef ORDER
#define ORDER 4
#endif

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
__kernel void chosen_nodes(__global scalar *restrict list, const int count, __global const int *restrict texels,
                           __global const scalar *restrict excess, TEXELS_PARAMETERS) {
  const int g = get_global_id(0), per = cuts * cuts;
  if (g >= count * per) return;
  const int k = g / per, a = g % per, index = texels[k];
  const int face = index / (rows * columns), row = index / columns % rows, column = index % columns;
  xyz d;
  int texel;
  const scalar w = texel_node(face, row * cuts + a / cuts, column * cuts + a % cuts, &d, &texel, TEXELS_VALUES);
  __global scalar *p = list + 8 * (size_t)g;
  p[0] = d.x; p[1] = d.y; p[2] = d.z; p[3] = w;
  p[4] = w * excess[3 * k]; p[5] = w * excess[3 * k + 1]; p[6] = w * excess[3 * k + 2]; p[7] = 0;
}

static inline scalar node_coordinate(int a, int n) { return ((2 * a + 1) / (scalar)n - 1) * QUARTER_PI; }

// Lagrange basis of the ORDER nodes 0 … ORDER-1 at x.
static inline void lagrange(scalar x, scalar *w) {
  for (int a = 0; a < ORDER; a++) {
    scalar v = 1;
    for (int b = 0; b < ORDER; b++)
      if (b != a) v *= (x - b) / (scalar)(a - b);
    w[a] = v;
  }
}

static inline int stencil_start(int gap, int n) { return clamp(gap - (ORDER / 2 - 1), 0, n - ORDER); }

// moments: [gaps][ORDER][ORDER] of (wL_r, wL_g, wL_b, w), the gaps of `face` only. Each work item visits the
// source nodes in a box around its gap and takes those whose own gap it is: every node is counted once.
__kernel void anterpolate(__global scalar *restrict moments, const int n, const int target, TEXELS_PARAMETERS) {
  const int g = get_global_id(0), gaps = n - 1;
  if (g >= gaps * gaps) return;
  const int gi = g / gaps, gj = g % gaps;
  const scalar u0 = gj == 0 ? -QUARTER_PI : node_coordinate(gj, n);
  const scalar u1 = gj == gaps - 1 ? QUARTER_PI : node_coordinate(gj + 1, n);
  const scalar v0 = gi == 0 ? -QUARTER_PI : node_coordinate(gi, n);
  const scalar v1 = gi == gaps - 1 ? QUARTER_PI : node_coordinate(gi + 1, n);
  // Half-open in tangent coordinates; the outer gaps are open to the face's edge, which cube_face decides.
  const scalar s0 = gj == 0 ? -2 : tan(u0), s1 = gj == gaps - 1 ? 2 : tan(u1);
  const scalar t0 = gi == 0 ? -2 : tan(v0), t1 = gi == gaps - 1 ? 2 : tan(v1);

  const xyz centre = unit3(cube_direction(target, tan((u0 + u1) / 2), tan((v0 + v1) / 2)));
  scalar reach = 0;
  for (int k = 0; k < 4; k++) {
    const xyz corner = unit3(cube_direction(target, tan(k & 1 ? u1 : u0), tan(k & 2 ? v1 : v0)));
    const xyz d = {corner.x - centre.x, corner.y - centre.y, corner.z - centre.z};
    reach = fmax(reach, dot_xyz(d, d));
  }
  const scalar radius = 2 * asin(sqrt(reach) / 2) * (scalar)1.0001 + (scalar)2e-6;

#if PRECISION == 64
  double4 sum[ORDER][ORDER];
#define QUAD double4
#else
  float4 sum[ORDER][ORDER];
#define QUAD float4
#endif
  for (int a = 0; a < ORDER; a++)
    for (int b = 0; b < ORDER; b++) sum[a][b] = (QUAD)(0);

  const int start_i = stencil_start(gi, n), start_j = stencil_start(gj, n), all = columns * cuts;
  const scalar per_angle = n / (2 * QUARTER_PI);
  for (int face = 0; face < TEXELS_FACES; face++) {
    const int4 box = texel_box(face, centre, radius, TEXELS_VALUES);
    for (int i = box.x; i < box.y; i++) {
      for (int j = box.z; j < box.w; j++) {
        const int column = !TEXELS_WRAP ? j : j < 0 ? j + all : j >= all ? j - all : j;
        xyz d;
        int texel;
        const scalar w = texel_node(face, i, column, &d, &texel, TEXELS_VALUES);
        if (cube_face(d) != target) continue;
        const xyz q = to_face(target, d);
        const scalar s = q.x / q.z, t = q.y / q.z;
        if (!(s >= s0 && s < s1 && t >= t0 && t < t1)) continue;
        scalar wu[ORDER], wv[ORDER];
        lagrange((atan_1(s) + QUARTER_PI) * per_angle - (scalar)0.5 - start_j, wu);
        lagrange((atan_1(t) + QUARTER_PI) * per_angle - (scalar)0.5 - start_i, wv);
        __global const float *L = radiance + 3 * (size_t)texel;
        const QUAD value = (QUAD)(w * L[0], w * L[1], w * L[2], w);
        for (int a = 0; a < ORDER; a++) {
          const QUAD row = value * wv[a];
          for (int b = 0; b < ORDER; b++) sum[a][b] += row * wu[b];
        }
      }
    }
  }
  __global scalar *p = moments + (size_t)g * ORDER * ORDER * 4;
  for (int a = 0; a < ORDER; a++)
    for (int b = 0; b < ORDER; b++) {
      const QUAD v = sum[a][b];
      p[0] = v.x; p[1] = v.y; p[2] = v.z; p[3] = v.w;
      p += 4;
    }
}

// grid: [6][n][n] of (wL_r, wL_g, wL_b, w). A node collects from the gaps whose stencil covers it.
__kernel void gather(__global scalar *restrict grid, const int n, const int face,
                     __global const scalar *restrict moments) {
  const int g = get_global_id(0), gaps = n - 1;
  if (g >= n * n) return;
  const int i = g / n, j = g % n;
  scalar sum[4] = {0, 0, 0, 0};
  for (int gi = max(i - ORDER, 0); gi < min(i + ORDER, gaps); gi++) {
    const int a = i - stencil_start(gi, n);
    if (a < 0 || a >= ORDER) continue;
    for (int gj = max(j - ORDER, 0); gj < min(j + ORDER, gaps); gj++) {
      const int b = j - stencil_start(gj, n);
      if (b < 0 || b >= ORDER) continue;
      __global const scalar *p = moments + (((size_t)gi * gaps + gj) * ORDER * ORDER + a * ORDER + b) * 4;
      for (int c = 0; c < 4; c++) sum[c] += p[c];
    }
  }
  for (int c = 0; c < 4; c++) grid[((size_t)face * n * n + g) * 4 + c] = sum[c];
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
  scalar sum[4] = {0, 0, 0, 0};
  for (int i = first[a]; i < last[a]; i++) {
    const scalar m = matrix[(size_t)i * coarse + a];
    __global const scalar *p = in + 4 * (((size_t)line * fine + i) * outer_stride + inner);
    for (int c = 0; c < 4; c++) sum[c] += m * p[c];
  }
  for (int c = 0; c < 4; c++) out[4 * (size_t)g + c] = sum[c];
}

// The grid as the list that `convolve` reads, in blocks of 4 × 4 nodes within 8 × 8 (n is a multiple of 8), its directions from
// the tangent table of n coordinates.
__kernel void grid_list(__global scalar *restrict list, const int n, __global const scalar *restrict tangent,
                        __global const scalar *restrict grid) {
  const int g = get_global_id(0);
  if (g >= 6 * n * n) return;
  const int face = g / (n * n), i = g / n % n, j = g % n;
  const xyz d = unit3(cube_direction(face, tangent[j], tangent[i]));
  __global const scalar *q = grid + 4 * (size_t)g;
  const int block = (face * (n / 8) + i / 8) * (n / 8) + j / 8;
  __global scalar *p = list + 8 * ((size_t)block * 64 + (i % 8 / 4 * 2 + j % 8 / 4) * 16 + i % 4 * 4 + j % 4);
  p[0] = d.x; p[1] = d.y; p[2] = d.z; p[3] = q[3];
  p[4] = q[0]; p[5] = q[1]; p[6] = q[2]; p[7] = 0;
}
