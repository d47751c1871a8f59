// Level 0: the mean radiance of the source over each output texel, by exact areas of overlap. Built in
// float64: beside a sun 1e5 times the mean, a sliver of 1e-7 of a texel is an error
// of 1 %, and float32 places edges no better than that.

// ---- a lat-long source on a cube face, by Green's theorem ------------------------------------------------
// With azimuth φ and y = cos θ, dω = dφ dy. Let C(φ, y) = ∫_y^1 L dy', linear in y within a texel; the integral
// of L over a cube texel is the sum of ∫ C dφ along its four edges. Each edge is a piece of a great circle
// tan(latitude) = A cos ψ, ψ = φ - φ0, on which y = A cos ψ / √(1 + A² cos² ψ), and
// ∫ y dψ = asin(A sin ψ / √(1 + A²)): closed form between the crossings of rows and columns.

// above: [rows of the band][columns][3], ∫ L dy from the north pole to the top of each row; carry: [columns][3], the
// same at the end of the band, for the next.
__kernel void accumulate_rows(__global scalar *restrict above, __global scalar *restrict carry, const int columns,
                              const int first_row, const int last_row, __global const scalar *restrict row_edge,
                              __global const float *restrict radiance) {
  const int g = get_global_id(0);
  if (g >= 3 * columns) return;
  scalar sum = carry[g];
  for (int r = first_row; r < last_row; r++) {
    above[(size_t)(r - first_row) * 3 * columns + g] = sum;
    sum += radiance[(size_t)r * 3 * columns + g] * (row_edge[2 * r] - row_edge[2 * r + 2]);
  }
  carry[g] = sum;
}

// row_edge: (cos θ, cot θ) of each of the rows + 1 row edges. total: [columns][3], ∫ L dy from pole to pole, taken from C
// on the -Y face: C may shift by any function of φ alone, and must vanish at the face's pole. Adds to edge[2][size + 1][size][3]: the edges t = const by line and
// column, then the edges s = const.
__kernel void cut_edges(__global scalar *restrict edge, const int size, const int face, const int rows,
                        const int columns, const scalar rotation, const int first_row, const int last_row,
                        __global const scalar *restrict row_edge, __global const scalar *restrict above,
                        __global const scalar *restrict total, __global const float *restrict radiance) {
  const int g = get_global_id(0), lines = (size + 1) * size;
  if (g >= 2 * lines) return;
  const int along_s = g < lines, line = g % lines / size, piece = g % size;
  if (!along_s && face != 2 && face != 3) return;  // meridians: dφ = 0

  // The edge as a great circle: A, φ0 and ψ at its two ends, in the direction of growing s or t.
  const scalar fixed = 2 * line / (scalar)size - 1, from = 2 * piece / (scalar)size - 1;
  const scalar to = 2 * (piece + 1) / (scalar)size - 1;
  scalar A, phi0, psi0, psi1;
  if (face == 2 || face == 3) {
    // ±Y: x = s, z = ±t. A line at distance |fixed| from the pole, its foot at azimuth φ0.
    if (fixed == 0) return;  // through the pole: a meridian
    const scalar flip = face == 3 ? -1 : 1, d = fabs(fixed), up = along_s ? flip * fixed : fixed;
    A = flip / d;
    phi0 = along_s ? (up > 0 ? HALF_PI : -HALF_PI) : (up > 0 ? 0 : PI);
    const scalar sense = along_s ? (up > 0 ? -1 : 1) : (up > 0 ? flip : -flip);
    psi0 = sense * atan(from / d);
    psi1 = sense * atan(to / d);
  } else {
    A = -fixed;
    phi0 = face == 0 ? 0 : face == 1 ? PI : face == 4 ? HALF_PI : -HALF_PI;
    psi0 = -atan(from);
    psi1 = -atan(to);
  }
  const scalar sign = psi0 < psi1 ? 1 : -1, low = fmin(psi0, psi1), high = fmax(psi0, psi1);
  const scalar start = phi0 - rotation + PI, per = columns / (2 * PI), B = A / sqrt(1 + A * A);

  scalar sum[3] = {0, 0, 0};
  for (int half_edge = 0; half_edge < 2; half_edge++) {
    // Latitude is extreme at ψ = 0; on either side it is monotone.
    const scalar p = half_edge ? fmax(low, (scalar)0) : low, q = half_edge ? high : fmin(high, (scalar)0);
    if (!(q > p)) continue;
    const int c0 = (int)floor((start + p) * per), c1 = (int)floor((start + q) * per);
    scalar psi = p, asin_psi = asin(B * sin(p));
    int r = clamp((int)floor((HALF_PI - atan(A * cos(p))) / PI * rows), 0, rows - 1);
    // Away from ψ = 0 the edge nears the equator: rows grow in the north (A > 0), fall in the south.
    const int step = (A > 0) == half_edge ? 1 : -1;
    for (int c = c0; c <= c1; c++) {
      const scalar b = c == c1 ? q : fmin(q, (c + 1) / per - start);
      if (!(b > psi)) continue;
      const int column = ((c % columns) + columns) % columns;
      const scalar cot_b = A * cos(b);
      for (;;) {
        const scalar cot_edge = row_edge[2 * (step > 0 ? r + 1 : r) + 1];
        const int crosses = step > 0 ? cot_b < cot_edge && r + 1 < rows : cot_b > cot_edge && r > 0;
        scalar next = b;
        if (crosses) {
          const scalar crossing = acos(clamp(cot_edge / A, (scalar)-1, (scalar)1));
          next = clamp(half_edge ? crossing : -crossing, psi, b);
        }
        const scalar asin_next = asin(B * sin(next));
        if (r >= first_row && r < last_row) {
          __global const float *L = radiance + 3 * ((size_t)r * columns + column);
          __global const scalar *C = above + 3 * ((size_t)(r - first_row) * columns + column);
          for (int k = 0; k < 3; k++)
            sum[k] += (C[k] - total[3 * column + k] * (face == 3) + L[k] * row_edge[2 * r]) * (next - psi) -
                      L[k] * (asin_next - asin_psi);
        }
        psi = next;
        asin_psi = asin_next;
        if (!crosses) break;
        r += step;
      }
    }
  }
  for (int k = 0; k < 3; k++) edge[3 * (size_t)g + k] += sign * sum[k];
}

// level: [size][size][3] of one face: the four edges of each texel over its exact solid angle.
__kernel void close_texels(__global float *restrict level, const int size, __global const scalar *restrict edge) {
  const int g = get_global_id(0), lines = (size + 1) * size;
  if (g >= size * size) return;
  const int i = g / size, j = g % size;
  const scalar s0 = 2 * j / (scalar)size - 1, s1 = 2 * (j + 1) / (scalar)size - 1;
  const scalar t0 = 2 * i / (scalar)size - 1, t1 = 2 * (i + 1) / (scalar)size - 1;
  const scalar area = cube_solid_angle(s0, s1, t0, t1);
  for (int k = 0; k < 3; k++) {
    const scalar top = edge[3 * (i * size + j) + k], bottom = edge[3 * ((i + 1) * size + j) + k];
    const scalar left = edge[3 * (lines + j * size + i) + k], right = edge[3 * (lines + (j + 1) * size + i) + k];
    // A texel of black source can come out at -1e-17 × its neighbours; radiance is never negative.
    level[3 * (size_t)g + k] = fmax((top + right - bottom - left) / area, (scalar)0);
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
