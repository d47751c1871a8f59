// Zonal convolution by the symmetries of the cube. An equiangular grid and the texel centres of a cube or a lat-long
// image are both mapped onto themselves by reflections of the axes and by exchanges of axes (PERMS of them: all 6
// for a cube, x with z alone for a lat-long), and K(l·r) does not change when the same symmetry maps both directions.
// With outputs o of one fundamental domain, sources c of the positive octant, reflections t, s and exchanges ρ,
//   out[ρ t o] = ∑_c ∑_s K(o·s c) (wL)[ρ (t s) c],
// so each value of the kernel serves 8·PERMS pairs. Each SIMD lane computes one output o; classes c are read as uniform
// scalars.
//
// Where much of the sphere counts, the sum over s is a convolution on the group of reflections, which a Walsh-Hadamard
// transform of K and of wL makes 8 products instead of 64 (`convolve_all`). The transform adds the values of eight
// mirrored directions and then separates them again: in float32 a dark one among them has an error of 1e-7 of the
// brightest. A narrow part of a lobe, whose values differ most, reaches at most one image of a class and is summed
// without a transform (`convolve_close`).
//
// partial: [split][8·CHANNELS + 1][outputs], CHANNELS = 3·PERMS: the sums, then ∑K w.

// The host defines RUN, the classes whose kernel values wait in cache while they are summed, TILE, those that are taken
// or left together, and RUN_EDGE and TILE_EDGE, their roots: classes are neighbours in squares.
#if PRECISION == 64
#define QUAD double4
#else
#define QUAD float4
#endif

// A class as whole numbers: its grid coordinates, odd and positive, and n along its face's axis. Classes are quarter
// faces +x +y +z, in tiles within runs where a quarter face is made of whole runs.
static inline xyz class_numbers(int c, int n) {
  const int half_n = n / 2, face = c / (half_n * half_n), rest = c % (half_n * half_n);
  const int run = rest / RUN, tile = rest / TILE % (RUN / TILE), in_tile = rest % TILE;
  const int across = half_n / RUN_EDGE, tiles = RUN_EDGE / TILE_EDGE, tiled = half_n % RUN_EDGE == 0;
  const int i = tiled ? run / across * RUN_EDGE + tile / tiles * TILE_EDGE + in_tile / TILE_EDGE : rest / half_n;
  const int j = tiled ? run % across * RUN_EDGE + tile % tiles * TILE_EDGE + in_tile % TILE_EDGE : rest % half_n;
  const scalar s = 2 * j + 1, t = 2 * i + 1;
  const xyz d = {face == 0 ? n : face == 1 ? t : s, face == 1 ? n : face == 2 ? t : s, face == 2 ? n : face == 1 ? s : t};
  return d;
}

// Index of a node or a texel of faces of n × n, from its coordinates as whole numbers, all as odd as n - 1.
static inline int face_index(xyz d, int n) {
  const int face = cube_face(d);
  const xyz q = to_face(face, d);
  return (face * n + ((int)q.y + n - 1) / 2) * n + ((int)q.x + n - 1) / 2;
}

// place: [classes][6][8], where the images ρ u c of each class lie in the grid.
__kernel void class_places(__global int *restrict place, const int n) {
  const int c = get_global_id(0);
  if (c >= 3 * n * n / 4) return;
  const xyz d = class_numbers(c, n);
  for (int e = 0; e < 6; e++)
    for (int u = 0; u < 8; u++) place[48 * (size_t)c + 8 * e + u] = face_index(exchanged(reflected(d, u), e), n);
}

// Of a fine grid the places would take more memory than the grid and are found again each time: place is null.
static inline int place_of(int c, int e, int u, int n, __global const int *restrict place) {
  return place ? place[48 * (size_t)c + 8 * e + u] : face_index(exchanged(reflected(class_numbers(c, n), u), e), n);
}

// node: [classes] of (x, y, z, w), w the weight of one source, the mean over all 48 images: what no texel's shape
// disturbs.
__kernel void class_nodes(__global scalar *restrict node, const int n, __global const scalar *restrict tangent,
                          __global const int *restrict place, __global const scalar *restrict grid) {
  const int c = get_global_id(0);
  if (c >= 3 * n * n / 4) return;
  const xyz k = class_numbers(c, n);
  const xyz p = {k.x == n ? 1 : tangent[((int)k.x + n - 1) / 2], k.y == n ? 1 : tangent[((int)k.y + n - 1) / 2],
                 k.z == n ? 1 : tangent[((int)k.z + n - 1) / 2]};
  const xyz d = unit3(p);
  scalar w = 0;
  for (int e = 0; e < 6; e++)
    for (int u = 0; u < 8; u++) w += grid[4 * (size_t)place_of(c, e, u, n, place) + 3];
  node[4 * c] = d.x; node[4 * c + 1] = d.y; node[4 * c + 2] = d.z; node[4 * c + 3] = w / 48;
}

// moment: [8][classes][CHANNELS]: the transform of (wL)[ρ u c] over u, ∑_u (-1)^|p & u|.
__kernel void class_moments(__global scalar *restrict moment, const int n, __global const int *restrict place,
                            __global const scalar *restrict grid) {
  const int c = get_global_id(0), classes = 3 * n * n / 4;
  if (c >= classes) return;
  for (int e = 0; e < PERMS; e++) {
    QUAD v[8];
    for (int u = 0; u < 8; u++) v[u] = vload4(place_of(c, e, u, n, place), grid);
    HADAMARD_8(QUAD, v)
    for (int p = 0; p < 8; p++) {
      __global scalar *m = moment + ((size_t)p * classes + c) * CHANNELS + 3 * e;
      m[0] = v[p].x; m[1] = v[p].y; m[2] = v[p].z;
    }
  }
}

// image: [PERMS][count][24], of `count` classes from `origin` on: (wL)[ρ u c] by u, then channel.
__kernel void class_images(__global scalar *restrict image, const int n, const int origin, const int count,
                           __global const int *restrict place, __global const scalar *restrict grid) {
  const int c = get_global_id(0);
  if (c >= count) return;
  for (int e = 0; e < PERMS; e++)
    for (int u = 0; u < 8; u++) {
      const QUAD v = vload4(place_of(origin + c, e, u, n, place), grid);
      __global scalar *q = image + ((size_t)e * count + c) * 24 + 3 * u;
      q[0] = v.x; q[1] = v.y; q[2] = v.z;
    }
}

static inline void add_to(__global scalar *restrict at, int g, real value) { STORE(LOAD(g, at) + value, g, at); }

// Adds classes [first, first + count), at most RUN.
static inline void add_classes(__global scalar *restrict out, int g, int outputs, real x, real y, real z, int first,
                               int count, int classes, __global const scalar *restrict node,
                               __global const scalar *restrict moment LOBE_SCALARS) {
  real K[8][RUN], weight = 0;
  for (int k = 0; k < count; k++) {
    __global const scalar *p = node + 4 * (size_t)(first + k);
    real q[8], v[8];
    mirror_distances(q, x, y, z, p[0], p[1], p[2]);
    lobe_of_8(v, q LOBE_VALUES);
    const real a0 = v[0] + v[1], a1 = v[0] - v[1], a2 = v[2] + v[3], a3 = v[2] - v[3];
    const real a4 = v[4] + v[5], a5 = v[4] - v[5], a6 = v[6] + v[7], a7 = v[6] - v[7];
    const real b0 = a0 + a2, b1 = a1 + a3, b2 = a0 - a2, b3 = a1 - a3;
    const real b4 = a4 + a6, b5 = a5 + a7, b6 = a4 - a6, b7 = a5 - a7;
    K[0][k] = b0 + b4; K[1][k] = b1 + b5; K[2][k] = b2 + b6; K[3][k] = b3 + b7;
    K[4][k] = b0 - b4; K[5][k] = b1 - b5; K[6][k] = b2 - b6; K[7][k] = b3 - b7;
    weight += K[0][k] * p[3];
  }
  add_to(out + (size_t)8 * CHANNELS * outputs, g, weight);
  for (int p = 0; p < 8; p++) {
    __global const scalar *restrict m = moment + ((size_t)p * classes + first) * CHANNELS;
    real sum[CHANNELS];
    for (int j = 0; j < CHANNELS; j++) sum[j] = 0;
    for (int k = 0; k < count; k++) {
      const real v = K[p][k];
      for (int j = 0; j < CHANNELS; j++) sum[j] += v * m[k * CHANNELS + j];
    }
    for (int j = 0; j < CHANNELS; j++) add_to(out + (size_t)(p * CHANNELS + j) * outputs, g, sum[j]);
  }
}

// A chunk is a multiple of RUN classes. T groups of outputs, one after the other, take the same RUN while it is in
// cache.
__kernel void convolve_all(__global scalar *restrict partial, const int outputs, const int classes, const int chunk,
                           const int first_split, __global const scalar *restrict direction,
                           __global const scalar *restrict node, __global const scalar *restrict moment LOBE_SCALARS) {
  const int g0 = get_global_id(0) * T, split = get_global_id(1), end = min(classes, (split + 1) * chunk);
  const int g1 = min(g0 + T, outputs / W);
  __global scalar *restrict out = partial + (size_t)(first_split + split) * (8 * CHANNELS + 1) * outputs;
  for (int g = g0; g < g1; g++)
    for (int k = 0; k < 8 * CHANNELS + 1; k++) STORE((real)0, g, out + (size_t)k * outputs);
  for (int first = split * chunk; first < end; first += RUN)
    for (int g = g0; g < g1; g++)
      add_classes(out, g, outputs, LOAD(g, direction), LOAD(g, direction + outputs), LOAD(g, direction + 2 * outputs),
                  first, min(RUN, end - first), classes, node, moment LOBE_VALUES);
}

// group: {x, y, z, radius} of the W outputs of a work item; tile: of every RUN classes, then of each TILE of them. By
// the triangle inequality of chords no pair is nearer than `reach` if this holds.
static inline int beyond(__global const scalar *restrict bound, xyz sign, __global const scalar *restrict group,
                         scalar reach) {
  const scalar dx = sign.x * bound[0] - group[0], dy = sign.y * bound[1] - group[1], dz = sign.z * bound[2] - group[2];
  const scalar apart = reach + bound[3] + group[3];
  return dx * dx + dy * dy + dz * dz > apart * apart;
}

// Of `classes` images from class `origin` on, a multiple of RUN; the first piece, of origin 0, finds `partial`
// undefined.
__kernel void convolve_close(__global scalar *restrict partial, const int outputs, const int origin, const int classes,
                             const int chunk, const int first_split, __global const scalar *restrict direction,
                             __global const scalar *restrict node, __global const scalar *restrict image,
                             __global const scalar *restrict group, __global const scalar *restrict tile,
                             const scalar reach2 LOBE_SCALARS) {
  const int g0 = get_global_id(0) * T, split = get_global_id(1), end = min(classes, (split + 1) * chunk);
  const int g1 = min(g0 + T, outputs / W);
  const scalar reach = sqrt(reach2);
  __global scalar *restrict out = partial + (size_t)(first_split + split) * (8 * CHANNELS + 1) * outputs;
  for (int g = origin ? g1 : g0; g < g1; g++)
    for (int k = 0; k < 8 * CHANNELS + 1; k++) STORE((real)0, g, out + (size_t)k * outputs);
  real K[RUN];
  for (int first = split * chunk; first < end; first += RUN)
    for (int g = g0; g < g1; g++) {
      __global const scalar *bound = tile + (size_t)((origin + first) / RUN) * (1 + RUN / TILE) * 4, *own = group + 4 * g;
      const real x = LOAD(g, direction), y = LOAD(g, direction + outputs), z = LOAD(g, direction + 2 * outputs);
      for (int s = 0; s < 8; s++) {
        const xyz one = {1, 1, 1}, sign = reflected(one, s);
        if (beyond(bound, sign, own, reach)) continue;
        int from = 0, to = min(RUN, end - first);
        while (from < to && beyond(bound + 4 + from / TILE * 4, sign, own, reach)) from += TILE;
        while (to > from && beyond(bound + to / TILE * 4, sign, own, reach)) to -= TILE;
        if (to <= from) continue;
        real weight = 0;
        for (int k = from; k < to; k++) {
          __global const scalar *p = node + 4 * (size_t)(origin + first + k);
          K[k] = lobe(sqr(x - sign.x * p[0]) + sqr(y - sign.y * p[1]) + sqr(z - sign.z * p[2]) LOBE_VALUES);
          weight += K[k] * p[3];
        }
        add_to(out + (size_t)8 * CHANNELS * outputs, g, weight);
        for (int e = 0; e < PERMS; e++) {
          __global const scalar *restrict m = image + ((size_t)e * classes + first) * 24;
          real sum[24];
          for (int j = 0; j < 24; j++) sum[j] = 0;
          for (int k = from; k < to; k++) {
            const real v = K[k];
            for (int j = 0; j < 24; j++) sum[j] += v * m[24 * k + j];
          }
          // (wL)[ρ u c] goes to the output ρ (u s) o.
          for (int u = 0; u < 8; u++)
            for (int k = 0; k < 3; k++)
              add_to(out + (size_t)((u ^ s) * CHANNELS + 3 * e + k) * outputs, g, sum[3 * u + k]);
        }
      }
    }
}

// number: two whole numbers of each output o. Of a cube of size × size: its two smaller coordinates, odd (0 where size
// is 1). Of a lat-long image of size rows: its row, and its azimuth from +X in units of π/columns, odd.
static inline int texel_of(int a, int b, int e, int t, int size, int latlong) {
  if (!latlong) {
    const xyz o = {a, b, size};
    return face_index(exchanged(reflected(o, t), e), size);
  }
  const int columns = 2 * size, row = t & 2 ? size - 1 - a : a;
  int m = t & 1 ? columns - b : b;
  if (t & 4) m = -m;
  if (e == 1) m = columns / 2 - m;
  return row * columns + ((m - 1) / 2 + columns / 2 + 2 * columns) % columns;
}

// Every texel of the level: ∑ wL K/∑ w K + apart·per_norm + base, scattered to all images of the outputs, `stride`
// numbers a texel. Without sums (alls = 0) the rest is added to what the level holds.
__kernel void unfold(__global float *restrict level, const int stride, const int outputs, const int count, const int size,
                     const int latlong, __global const int *restrict number, __global const scalar *restrict all,
                     const int alls, __global const scalar *restrict close, const int closes,
                     __global const scalar *restrict apart, const int aparts, const scalar per_norm,
                     const scalar base_r, const scalar base_g, const scalar base_b) {
  const int g = get_global_id(0), e = get_global_id(1);
  if ((g + 1) * W > outputs) return;
  const size_t split_size = (size_t)(8 * CHANNELS + 1) * outputs;
  const scalar base[3] = {base_r, base_g, base_b};
  real weight = 0;
  for (int n = 0; n < alls; n++) weight += LOAD(g, all + n * split_size + (size_t)8 * CHANNELS * outputs);
  for (int n = 0; n < closes; n++) weight += LOAD(g, close + n * split_size + (size_t)8 * CHANNELS * outputs);
  for (int k = 0; k < 3; k++) {
    real v[8];
    for (int p = 0; p < 8; p++) {
      v[p] = 0;
      for (int n = 0; n < alls; n++)
        v[p] += LOAD(g, all + n * split_size + (size_t)(p * CHANNELS + 3 * e + k) * outputs);
    }
    HADAMARD_8(real, v)
    for (int t = 0; t < 8; t++) {
      real sum = v[t] / 8;
      for (int n = 0; n < closes; n++)
        sum += LOAD(g, close + n * split_size + (size_t)(t * CHANNELS + 3 * e + k) * outputs);
      if (alls) sum /= weight;
      if (aparts) sum += per_norm * LOAD(g, apart + (size_t)(t * CHANNELS + 3 * e + k) * outputs);
      scalar lane[W];
      STORE(sum + base[k], 0, lane);
      for (int l = 0; l < W; l++) {
        const int o = g * W + l;
        if (o >= count) continue;
        const int a = number[2 * o], b = number[2 * o + 1];
        // On a mirror plane of an odd cube two reflections are one: the one that leaves the coordinate alone writes.
        if (!latlong && (((t & 1) && a == 0) || ((t & 2) && b == 0))) continue;
        // An output on a mirror plane between two axes has each image twice: by even exchanges alone, once.
        const int twice = latlong ? 8 * b == 4 * size : a == b;
        if (twice && (latlong ? e == 1 : e == 1 || e >= 4)) continue;
        __global float *at = level + stride * (size_t)texel_of(a, b, e, t, size, latlong) + k;
        *at = alls ? lane[l] : *at + lane[l];
      }
    }
  }
}
