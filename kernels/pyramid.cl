// The mip pyramid of a cube that is read between texels: 4 scalars per texel (rgb and a pad, so that a row's two
// neighbours are one load), level k of n = size >> k texels per edge at texel PYRAMID_OFFSET, six faces of (n + 2)²
// texels each. The frame around a face holds the texels beyond its edges, so that a bilinear read never asks which face
// a neighbour is on.

// Texels before the level of n: 6 ∑ (m + 2)² over m = size, size/2, … 2n, with ∑ m² = 4/3 (size² - n²).
#define PYRAMID_OFFSET(size, n, k) (8 * ((size) * (size) - (n) * (n)) + 48 * ((size) - (n)) + 24 * (k))

static inline size_t at_texel(int size, int level, int face, int i, int j) {
  const int n = size >> level, edge = n + 2;
  return 4 * ((size_t)PYRAMID_OFFSET(size, n, level) + ((size_t)face * edge + i + 1) * edge + j + 1);
}

// texels: [6][size][size][3]; what lies above `base`, which the sum over samples adds again.
__kernel void first_level(__global scalar *restrict pyramid, const int size, __global const float *restrict texels,
                          const float r, const float g, const float b) {
  const int k = get_global_id(0);
  if (k >= 6 * size * size) return;
  __global scalar *p = pyramid + at_texel(size, 0, k / (size * size), k / size % size, k % size);
  p[0] = texels[3 * (size_t)k] - r;
  p[1] = texels[3 * (size_t)k + 1] - g;
  p[2] = texels[3 * (size_t)k + 2] - b;
  p[3] = 0;
}

// The mean over each texel from its four children, weighted by their exact solid angles: [2n][2n] of one face, from the
// host, since in float32 the difference of four arctangents has no digits left for a texel of 1024.
__kernel void next_level(__global scalar *restrict pyramid, const int size, const int level,
                         __global const scalar *restrict solid_angle) {
  const int n = size >> level, k = get_global_id(0);
  if (k >= 6 * n * n) return;
  const int face = k / (n * n), i = k / n % n, j = k % n;
  scalar sum[3] = {0, 0, 0}, weight = 0;
  for (int child = 0; child < 4; child++) {
    const int y = 2 * i + child / 2, x = 2 * j + child % 2;
    const scalar w = solid_angle[y * 2 * n + x];
    __global const scalar *p = pyramid + at_texel(size, level - 1, face, y, x);
    for (int c = 0; c < 3; c++) sum[c] += w * p[c];
    weight += w;
  }
  __global scalar *p = pyramid + at_texel(size, level, face, i, j);
  for (int c = 0; c < 3; c++) p[c] = sum[c] / weight;
  p[3] = 0;
}

// The texel of an n × n face that a point of the cube's surface lies in, by face coordinates.
static inline size_t at_point(int size, int level, int face, xyz d) {
  const int n = size >> level;
  const xyz q = to_face(face, d);
  const int i = clamp((int)floor((q.y + 1) / 2 * n), 0, n - 1), j = clamp((int)floor((q.x + 1) / 2 * n), 0, n - 1);
  return at_texel(size, level, face, i, j);
}

// Frame texel k of a face, 4 (n + 1) of them: beyond an edge the texel that shares it, on the face whose axis the
// middle of that shared edge lies on too; beyond a corner, where three faces meet, the mean of the three. Bilinear
// reads from two faces then agree along their edge, and from three at their corner.
__kernel void frame_level(__global scalar *restrict pyramid, const int size, const int level) {
  const int n = size >> level, count = 4 * (n + 1), k = get_global_id(0);
  if (k >= 6 * count) return;
  const int face = k / count, side = k % count / (n + 1), along = k % count % (n + 1) - 1;
  // Sides run from their corner: left column down from the upper left, then bottom, right and top rows, turning.
  const int i = side == 0 ? along : side == 1 ? n : side == 2 ? n - 1 - along : -1;
  const int j = side == 0 ? -1 : side == 1 ? along : side == 2 ? n : n - 1 - along;
  const scalar s = clamp((2 * j + 1) / (scalar)n - 1, (scalar)-1, (scalar)1);
  const scalar t = clamp((2 * i + 1) / (scalar)n - 1, (scalar)-1, (scalar)1);
  const xyz d = cube_direction(face, s, t);
  const int axis = face / 2, corner = along < 0;
  const int faces[3] = {d.x < 0, 2 + (d.y < 0), 4 + (d.z < 0)};
  const scalar size_of[3] = {fabs(d.x), fabs(d.y), fabs(d.z)};
  scalar sum[3] = {0, 0, 0};
  for (int a = 0; a < 3; a++) {
    if (!corner && (a == axis || size_of[a] < 1)) continue;
    __global const scalar *p = pyramid + at_point(size, level, faces[a], d);
    for (int c = 0; c < 3; c++) sum[c] += p[c];
  }
  __global scalar *p = pyramid + at_texel(size, level, face, i, j);
  for (int c = 0; c < 3; c++) p[c] = corner ? sum[c] / 3 : sum[c];
  p[3] = 0;
}
