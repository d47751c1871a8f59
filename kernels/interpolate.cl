// A level from its values at the nodes of an equiangular grid: where a level has more texels than its lobe has
// detail, it is convolved at the nodes and interpolated at the texels by ORDER-point Lagrange interpolation.

// level: texels [first, first + count), RGB. grid: [6][n][n] of 4 numbers. latlong: size rows of 2·size texels.
__kernel void interpolate(__global float *restrict level, const int first, const int count, const int size,
                          const int latlong, __global const float *restrict grid, const int n, const scalar base_r,
                          const scalar base_g, const scalar base_b) {
  const int g = first + get_global_id(0);
  if (g >= first + count) return;
  int face = g / (size * size);
  scalar s = (2 * (g % size) + 1) / (scalar)size - 1, t = (2 * (g / size % size) + 1) / (scalar)size - 1;
  if (latlong) {
    const int columns = 2 * size;
    const scalar theta = (g / columns + (scalar)0.5) * PI / size, phi = (g % columns + (scalar)0.5) * PI / size - PI;
    const xyz d = {sin(theta) * cos(phi), cos(theta), sin(theta) * sin(phi)};
    face = cube_face(d);
    const xyz q = to_face(face, d);
    s = q.x / q.z;
    t = q.y / q.z;
  }
  const scalar x = node_number(s, n), y = node_number(t, n);
  const int i = clamp((int)floor(y) - (ORDER / 2 - 1), 0, n - ORDER), j = clamp((int)floor(x) - (ORDER / 2 - 1), 0, n - ORDER);
  scalar wu[ORDER], wv[ORDER];
  lagrange(x - j, wu);
  lagrange(y - i, wv);
  float4 sum = (float4)(0);
  for (int a = 0; a < ORDER; a++) {
    float4 row = (float4)(0);
    for (int b = 0; b < ORDER; b++) row += (float)wu[b] * vload4(((size_t)face * n + i + a) * n + j + b, grid);
    sum += (float)wv[a] * row;
  }
  __global float *p = level + 3 * (size_t)g;
  p[0] = sum.x + base_r; p[1] = sum.y + base_g; p[2] = sum.z + base_b;
}
