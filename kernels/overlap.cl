// Level 0: the mean radiance of the source over each output texel, by exact areas of overlap. Areas are made in
// float64: next to a sun of 1e5 times the mean, a sliver of 1e-7 of a texel is an error of 1 %, and float32 places
// edges no better than that.

// ---- a lat-long source on a cube: a list of source texels and weights for each output texel --------------------- The
// areas depend on the two grids alone, so they are made once (`overlap_list`) and every image of that size is a sum
// over them (`mean_by_list`). With azimuth φ and V = 1 - cos θ, dω = dφ dV. A cube texel is cut into strips of azimuth
// that lie in one source column, between two great circles cot θ = A cos ψ, ψ = φ - φ0; the area of row r above one of
// them is ∫ clamp(V, V_r, V_r+1) - V_r dφ in closed form, because with B = A/√(1 + A²)
//     ∫ cos θ dψ = asin(B sin ψ).
//
// The cube has the grid's symmetries: the equator mirrors both, and where 4 divides the columns a quarter turn brings
// columns onto columns. So lists are made for "generators" only: rows of the upper half of a side face (of one of
// the four with TURNS = 4, of all with TURNS = 1), then texels of +Y (a quarter of them, or all).
#ifndef TURNS
#define TURNS 1
#endif

typedef struct {
  int polar, turn, i, j;  // on +Y, or on the side face at azimuth 90° · turn: row and column
} generator;

static inline generator generator_at(int g, const int size) {
  const int upper = (size + 1) / 2, sides = (TURNS == 4 ? 1 : 4) * upper * size;
  if (g < sides) {
    const generator found = {0, g / (upper * size), g / size % upper, g % size};
    return found;
  }
  g -= sides;
  // Quarters of an odd face are a vane each, and the centre.
  const int wide = TURNS == 4 ? size - size / 2 : size;
  const int centre = TURNS == 4 && g == size / 2 * wide;
  const generator found = {1, 0, centre ? size / 2 : g / wide, centre ? size / 2 : g % wide};
  return found;
}

typedef struct {
  scalar A, B, origin;  // cot θ = A cos ψ; B = A/√(1 + A²); φ0
  int pole;             // the pole itself in the place of a circle
} arc;

static inline arc arc_of(scalar A, scalar origin) {
  const arc made = {A, A / sqrt(1 + A * A), origin, 0};
  return made;
}

// On ±Y the line at distance d from the pole, its foot at azimuth `origin`.
static inline arc line_at(scalar d, scalar origin) {
  const arc pole = {0, 0, origin, 1};
  return d > 0 ? arc_of(1 / d, origin) : pole;
}

// An angle along an arc: ψ, its sine and cosine.
typedef struct {
  scalar psi, s, c;
} place;

static inline place place_at(arc side, scalar phi) {
  const scalar psi = phi - side.origin;
  const place found = {psi, sin(psi), cos(psi)};
  return found;
}

// sin x and asin x, by their series where 1e-16 of them is left: pieces of an arc are short.
static inline scalar sin_short(scalar x) {
  const scalar z = x * x;
  return fabs(x) < (scalar)0.05 ? x * (1 - z / 6 * (1 - z / 20 * (1 - z / 42 * (1 - z / 72)))) : sin(x);
}

static inline scalar asin_short(scalar x, scalar cosine) {
  const scalar z = x * x;
  if (!(fabs(x) < (scalar)0.1 && cosine > 0)) return atan2(x, cosine);
  return x * (1 + z * ((scalar)1 / 6 + z * ((scalar)3 / 40 + z * ((scalar)5 / 112 + z * ((scalar)35 / 1152 +
         z * ((scalar)63 / 2816 + z * ((scalar)231 / 13312)))))));
}

// asin(B sin b) - asin(B sin a) for a and b on one side of 0, without the cancellation of the difference.
static inline scalar below_arc(scalar B, place a, place b) {
  const scalar u = B * a.s, v = B * b.s, cu = sqrt((1 - u) * (1 + u)), cv = sqrt((1 - v) * (1 + v));
  const scalar half_s = sin_short((b.psi - a.psi) / 2), half_c = sqrt((1 - half_s) * (1 + half_s));
  const scalar rise = 2 * B * (a.c * half_c - a.s * half_s) * half_s;  // v - u
  return asin_short(rise * (cu + u * (u + v) / (cu + cv)), cu * cv + u * v);
}

// Where the arc crosses a row edge between a and b, on the side of ψ = 0 where they are.
static inline place crossing(arc side, place a, place b, scalar edge) {
  const scalar sign = a.psi + b.psi < 0 ? -1 : 1, c = clamp(edge / side.A, (scalar)-1, (scalar)1);
  const place found = {sign * acos(c), sign * sqrt((1 - c) * (1 + c)), c};
  return found.psi <= a.psi ? a : found.psi >= b.psi ? b : found;
}

// ∫ clamp(V, V_r, V_r+1) - V_r over the azimuths a … b, where V is monotone. row_edge: (V, cot θ) by row edge.
static inline scalar above_arc(arc side, place a, place b, __global const scalar *row_edge) {
  if (side.pole) return 0;
  const scalar tau_a = side.A * a.c, tau_b = side.A * b.c, top = row_edge[1], bottom = row_edge[3];
  const scalar step = row_edge[2] - row_edge[0];
  if (fmin(tau_a, tau_b) >= top) return 0;
  if (fmax(tau_a, tau_b) <= bottom) return (b.psi - a.psi) * step;
  // From the northern end of the arc to the southern: above the row, in it, below it.
  const int falls = tau_a >= tau_b;
  const place south = falls ? b : a;
  place from = falls ? a : b, to = south;
  if (fmax(tau_a, tau_b) > top) from = crossing(side, a, b, top);
  if (fmin(tau_a, tau_b) < bottom) to = crossing(side, a, b, bottom);
  const place low = falls ? from : to, high = falls ? to : from;
  return (1 - row_edge[0]) * (high.psi - low.psi) - below_arc(side.B, low, high) + fabs(south.psi - to.psi) * step;
}

// The row of a cotangent, looked for from row r on.
static inline int row_near(int r, scalar tau, const int rows, __global const scalar *row_edge) {
  while (r > 0 && tau > row_edge[2 * r + 1]) r--;
  while (r + 1 < rows && tau < row_edge[2 * r + 3]) r++;
  return r;
}

// Azimuths are known to an ulp or two: what is narrower is no overlap.
#define NARROWEST ((scalar)1e-15)

// The overlaps of the azimuths a … b between two arcs, from slot k on: the next slot. Azimuth 0 lies `zero` columns
// from the image's left edge.
static inline long strip(const int fill, long k, const long end, scalar a, scalar b, arc top, arc bottom,
                         const scalar zero, const int rows, const int columns, __global const scalar *row_edge,
                         __global int2 *restrict where, __global scalar *restrict weight) {
  if (!(b - a > NARROWEST)) return k;
  const scalar per = columns / (2 * PI);
  place top_a = place_at(top, a), bottom_a = place_at(bottom, a);
  int last = clamp((int)(atan2((scalar)1, bottom.A * bottom_a.c) / PI * rows), 0, rows - 1);
  int first = top.pole ? 0 : last;
  for (int c = (int)floor(a * per + zero); a < b; c++) {
    const scalar edge = (c + 1 - zero) / per, next = fmin(b, edge);
    if (next - a > NARROWEST) {
      const place top_b = place_at(top, next), bottom_b = top.origin == bottom.origin ? top_b : place_at(bottom, next);
      if (!top.pole) first = row_near(first, fmax(top.A * top_a.c, top.A * top_b.c), rows, row_edge);
      last = row_near(last, fmin(bottom.A * bottom_a.c, bottom.A * bottom_b.c), rows, row_edge);
      const int column = ((c % columns) + columns) % columns;
      for (int r = first; r <= last; r++, k++)
        if (fill && k < end) {
          where[k] = (int2)(r, column);
          weight[k] = fmax(above_arc(bottom, bottom_a, bottom_b, row_edge + 2 * r) -
                           above_arc(top, top_a, top_b, row_edge + 2 * r), (scalar)0);
        }
      top_a = top_b;
      bottom_a = bottom_b;
      a = next;
    }
    if (edge >= b) break;
  }
  return k;
}

// For generators first … first + count - 1: the number of their overlaps (fill = 0), or at slots start[g] …
// start[g + 1] - 1 of this batch the source texel (row, column) of each and its share of the output texel. One kernel
// for both, so that rounding does not tell them apart. row_edge: (V, cot θ) of each of the rows + 1 row edges.
__kernel void overlap_list(const int fill, __global int *restrict counts, const int first, const int count,
                           const int size, const int rows, const int columns, const scalar rotation,
                           __global const scalar *restrict row_edge, __global const int *restrict start,
                           __global int2 *restrict where, __global scalar *restrict weight) {
  const int g = get_global_id(0);
  if (g >= count) return;
  const generator at = generator_at(first + g, size);
  const long begin = fill ? start[g] : 0, end = fill ? start[g + 1] : 0;
  const scalar centre = columns / (scalar)2 - rotation / (2 * PI) * columns, quarter = columns / (scalar)4;
  const scalar s0 = 2 * at.j / (scalar)size - 1, s1 = 2 * (at.j + 1) / (scalar)size - 1;
  const scalar t0 = 2 * at.i / (scalar)size - 1, t1 = 2 * (at.i + 1) / (scalar)size - 1;
  long k = begin;
  if (!at.polar) {
    // s = -tan ψ and cot θ = -t cos ψ: two meridians and two arcs.
    const arc top = arc_of(-t0, 0), bottom = arc_of(-t1, 0);
    const scalar zero = centre + at.turn * quarter, a = -atan(s1), b = -atan(s0);
    for (int half_edge = 0; half_edge < 2; half_edge++)  // an arc is monotone on either side of ψ = 0
      k = strip(fill, k, end, half_edge ? fmax(a, (scalar)0) : a, half_edge ? b : fmin(b, (scalar)0), top, bottom,
                zero, rows, columns, row_edge, where, weight);
  } else {
    for (int q = 0; q < 4; q++) {
      // The part of the texel in quadrant q, turned onto x, z ≥ 0: (x, z) -> (z, -x) is a quarter turn back.
      scalar x0 = s0, x1 = s1, z0 = t0, z1 = t1;
      for (int m = 0; m < q; m++) {
        const scalar x = x0;
        x0 = z0; z0 = -x1; x1 = z1; z1 = -x;
      }
      x0 = fmax(x0, (scalar)0);
      z0 = fmax(z0, (scalar)0);
      if (!(x1 > x0 && z1 > z0)) continue;
      // A ray comes in by the side z0, then x0, and leaves by x1, then z1.
      const scalar in = x0 == 0 && z0 == 0 ? 0 : atan2(z0, x0), out = atan2(z1, x1);
      const scalar bend[4] = {atan2(z0, x1), fmin(in, out), fmax(in, out), atan2(z1, x0)};
      for (int m = 0; m < 3; m++) {
        const scalar middle = (bend[m] + bend[m + 1]) / 2;
        k = strip(fill, k, end, bend[m], bend[m + 1], middle < in ? line_at(z0, HALF_PI) : line_at(x0, 0),
                  middle < out ? line_at(x1, 0) : line_at(z1, HALF_PI), centre + q * quarter, rows, columns, row_edge,
                  where, weight);
      }
    }
  }
  if (!fill) {
    counts[g] = (int)(k - begin);
    return;
  }
  // A compiler that fuses multiply-adds of the two passes in other ways may find a sliver less.
  for (; k < end; k++) {
    where[k] = (int2)(0, 0);
    weight[k] = 0;
  }
  scalar total = 0;
  for (long n = begin; n < end; n++) total += weight[n];
  for (long n = begin; n < end; n++) weight[n] /= total;
}

// The generators' means and those of their mirror images and turns. level: [6][size][size][3].
__kernel void mean_by_list(__global float *restrict level, const int first, const int count, const int size,
                           const int rows, const int columns, __global const int *restrict start,
                           __global const int2 *restrict where, __global const scalar *restrict weight,
                           __global const float *restrict radiance) {
  const int g = get_global_id(0);
  if (g >= count) return;
  scalar sum[2][TURNS][3];
  for (int m = 0; m < 2; m++)
    for (int t = 0; t < TURNS; t++)
      for (int k = 0; k < 3; k++) sum[m][t][k] = 0;
  for (int n = start[g]; n < start[g + 1]; n++) {
    const int r = where[n].x;
    const scalar w = weight[n];
    for (int t = 0; t < TURNS; t++) {
      int c = where[n].y + t * (columns / 4);
      c -= c >= columns ? columns : 0;
      __global const float *north = radiance + 3 * ((size_t)r * columns + c);
      __global const float *south = radiance + 3 * ((size_t)(rows - 1 - r) * columns + c);
      for (int k = 0; k < 3; k++) {
        sum[0][t][k] += w * north[k];
        sum[1][t][k] += w * south[k];
      }
    }
  }
  const generator at = generator_at(first + g, size);
  int i = at.i, j = at.j;
  for (int t = 0; t < TURNS; t++) {
    const int turn = (at.turn + t) % 4, face = turn == 0 ? 0 : turn == 1 ? 4 : turn == 2 ? 1 : 5;
    for (int m = 0; m < 2; m++) {
      const int on = at.polar ? 2 + m : face;
      __global float *out = level + 3 * (((size_t)on * size + (m ? size - 1 - i : i)) * size + j);
      for (int k = 0; k < 3; k++) out[k] = sum[m][t][k];
    }
    if (at.polar) {  // a quarter turn: (x, z) -> (-z, x)
      const int old = i;
      i = j;
      j = size - 1 - old;
    }
  }
}

// ---- a lat-long source on a lat-long grid: rectangles in (φ, y) ------------------------------------------
__kernel void mean_latlong(__global float *restrict level, const int height, const int width, const int rows,
                           const int columns, const scalar rotation, __global const scalar *restrict row_edge,
                           __global const scalar *restrict out_edge, __global const float *restrict radiance) {
  const int g = get_global_id(0);
  if (g >= height * width) return;
  const int i = g / width, j = g % width;
  const scalar ratio = columns / (scalar)width, shift = rotation / (2 * PI) * columns;
  const scalar x0 = j * ratio - shift, x1 = (j + 1) * ratio - shift;
  const int r0 = (int)((long)i * rows / height), r1 = (int)(((long)(i + 1) * rows + height - 1) / height);
  scalar sum[3] = {0, 0, 0}, weight = 0;
  for (int r = r0; r < r1; r++) {
    const scalar dy = fmin(out_edge[2 * i], row_edge[2 * r]) - fmax(out_edge[2 * i + 2], row_edge[2 * r + 2]);
    for (int c = (int)floor(x0); c < x1; c++) {
      const scalar w = dy * (fmin(x1, (scalar)(c + 1)) - fmax(x0, (scalar)c));
      __global const float *L = radiance + 3 * ((size_t)r * columns + ((c % columns) + columns) % columns);
      for (int k = 0; k < 3; k++) sum[k] += w * L[k];
      weight += w;
    }
  }
  for (int k = 0; k < 3; k++) level[3 * (size_t)g + k] = sum[k] / weight;
}

// ---- a cube source on a cube that is not turned: rectangles of the faces --------------------------------------- The
// edges of both grids cut a face into pieces of one source texel and one output texel each: `source` is the source row
// (or column) of each strip of pieces, first[i] … first[i + 1] - 1 are the strips of output row i, and `area`,
// [pieces][pieces], their solid angles, which all six faces share. A work item makes the texels (i, j) of all of them.
// level: [6][height][height][3].
__kernel void mean_aligned(__global float *restrict level, const int height, const int size, const int pieces,
                           __global const int *restrict first, __global const int *restrict source,
                           __global const scalar *restrict area, __global const float *restrict radiance) {
  const int g = get_global_id(0);
  if (g >= height * height) return;
  const int i = g / height, j = g % height;
  scalar sum[6][3], total = 0;
  for (int f = 0; f < 6; f++)
    for (int k = 0; k < 3; k++) sum[f][k] = 0;
  for (int r = first[i]; r < first[i + 1]; r++)
    for (int c = first[j]; c < first[j + 1]; c++) {
      const scalar w = area[(size_t)r * pieces + c];
      total += w;
      for (int f = 0; f < 6; f++) {
        __global const float *L = radiance + 3 * (((size_t)f * size + source[r]) * size + source[c]);
        for (int k = 0; k < 3; k++) sum[f][k] += w * L[k];
      }
    }
  for (int f = 0; f < 6; f++)
    for (int k = 0; k < 3; k++) level[3 * (((size_t)f * height + i) * height + j) + k] = sum[f][k] / total;
}

// ---- a cube source on any grid: great-circle polygons, clipped ------------------------------------------
#define MOST 112  // corners: an output polygon has at most 98, and each of the 9 clips can add one

// Keep the part of the polygon with p·n ≥ 0 (Sutherland-Hodgman; the planes hold the origin, so the edges of
// the result are great circles again).
static inline int clip(xyz *p, int count, xyz n) {
  xyz out[MOST];
  int m = 0;
  for (int k = 0; k < count; k++) {
    const xyz a = p[k], b = p[k + 1 == count ? 0 : k + 1];
    const scalar da = dot_xyz(a, n), db = dot_xyz(b, n);
    if (da >= 0) out[m++] = a;
    if ((da > 0 && db < 0) || (da < 0 && db > 0)) {
      const scalar t = da / (da - db);
      const xyz c = {a.x + t * (b.x - a.x), a.y + t * (b.y - a.y), a.z + t * (b.z - a.z)};
      out[m++] = c;
    }
  }
  for (int k = 0; k < m; k++) p[k] = out[k];
  return m;
}

// Solid angle of a polygon as a fan of triangles, signed. [VanOosterom1983, eq. 8] Corners need not be unit.
static inline scalar polygon_solid_angle(const xyz *p, int count) {
  scalar area = 0;
  if (count < 3) return 0;
  const xyz a = unit3(p[0]);
  xyz b = unit3(p[1]);
  for (int k = 2; k < count; k++) {
    const xyz c = unit3(p[k]);
    // Differences first: the triple product of nearly equal unit vectors cancels.
    const xyz e = {b.x - a.x, b.y - a.y, b.z - a.z}, f = {c.x - a.x, c.y - a.y, c.z - a.z};
    const scalar triple = a.x * (e.y * f.z - e.z * f.y) + a.y * (e.z * f.x - e.x * f.z) + a.z * (e.x * f.y - e.y * f.x);
    area += 2 * atan2(triple, 1 + dot_xyz(a, b) + dot_xyz(b, c) + dot_xyz(c, a));
    b = c;
  }
  return area;
}

static inline int clip_box(xyz *p, int count, scalar s0, scalar s1, scalar t0, scalar t1) {
  const xyz planes[4] = {{1, 0, -s0}, {-1, 0, s1}, {0, 1, -t0}, {0, -1, t1}};
  for (int k = 0; k < 4 && count >= 3; k++) count = clip(p, count, planes[k]);
  return count;
}

// level: texels of a cube (latlong = 0: [6][height][height]) or a lat-long (1: [height][2 height]) from `first`,
// 3 floats each. A lat-long texel's parallels are cut into `chords` great-circle pieces.
__kernel void mean_cube(__global float *restrict level, const int first, const int count, const int height,
                        const int latlong, const int chords, const int size, const scalar turn_c,
                        const scalar turn_s, __global const float *restrict radiance) {
  const int g = get_global_id(0);
  if (g >= count) return;
  const int index = first + g;
  xyz texel[MOST];
  int corners = 0;
  if (latlong) {
    const int i = index / (2 * height), j = index % (2 * height);
    for (int side = 0; side < 2; side++)
      for (int k = 0; k <= chords; k++) {
        const scalar along = side ? k / (scalar)chords : 1 - k / (scalar)chords;
        const scalar theta = (i + side) * PI / height, phi = (j + along) * PI / height - PI;
        if ((i + side == 0 || i + side == height) && k > 0) continue;  // a pole is one corner
        const xyz d = {sin(theta) * cos(phi), cos(theta), sin(theta) * sin(phi)};
        texel[corners++] = turn_y(d, turn_c, -turn_s);
      }
  } else {
    const int face = index / (height * height), i = index / height % height, j = index % height;
    for (int k = 0; k < 4; k++) {
      const scalar s = 2 * (j + (k == 1 || k == 2)) / (scalar)height - 1, t = 2 * (i + (k > 1)) / (scalar)height - 1;
      texel[corners++] = turn_y(cube_direction(face, s, t), turn_c, -turn_s);
    }
  }
  scalar sum[3] = {0, 0, 0}, weight = 0;
  for (int face = 0; face < 6; face++) {
    xyz on_face[MOST];
    for (int k = 0; k < corners; k++) on_face[k] = to_face(face, texel[k]);
    const xyz ahead = {0, 0, 1};
    int n = clip_box(on_face, clip(on_face, corners, ahead), -1, 1, -1, 1);
    if (n < 3) continue;
    scalar s0 = 1, s1 = -1, t0 = 1, t1 = -1;
    for (int k = 0; k < n; k++) {
      if (!(on_face[k].z > 0)) continue;
      const scalar s = on_face[k].x / on_face[k].z, t = on_face[k].y / on_face[k].z;
      s0 = fmin(s0, s); s1 = fmax(s1, s); t0 = fmin(t0, t); t1 = fmax(t1, t);
    }
    const int j0 = max((int)floor((s0 + 1) / 2 * size), 0), j1 = min((int)ceil((s1 + 1) / 2 * size), size);
    const int i0 = max((int)floor((t0 + 1) / 2 * size), 0), i1 = min((int)ceil((t1 + 1) / 2 * size), size);
    for (int i = i0; i < i1; i++)
      for (int j = j0; j < j1; j++) {
        xyz cell[MOST];
        for (int k = 0; k < n; k++) cell[k] = on_face[k];
        const int m = clip_box(cell, n, 2 * j / (scalar)size - 1, 2 * (j + 1) / (scalar)size - 1,
                               2 * i / (scalar)size - 1, 2 * (i + 1) / (scalar)size - 1);
        const scalar w = fabs(polygon_solid_angle(cell, m));
        __global const float *L = radiance + 3 * (((size_t)face * size + i) * size + j);
        for (int k = 0; k < 3; k++) sum[k] += w * L[k];
        weight += w;
      }
  }
  for (int k = 0; k < 3; k++) level[3 * (size_t)g + k] = sum[k] / weight;
}
