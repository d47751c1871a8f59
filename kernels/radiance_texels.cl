// The nodes of an environment's texels in the frame of a surface: seven rows {x, y, z, weight, and weight × radiance},
// so that lanes read neighbours. Texels that a view sums more finely are left out.
// frame: rows of the matrix to the local frame; skip: one byte per texel, or a null pointer.

__kernel void frame_nodes(__global scalar *restrict list, const int stride, const int first_row, const int count,
                          __global const scalar *restrict frame, __global const uchar *restrict skip,
                          TEXELS_PARAMETERS) {
  const int g = get_global_id(0);
  if (g >= stride) return;
  const int width = columns * cuts, height = rows * cuts, at = min(g, count - 1), row = first_row + at / width;
  const int face = row / height;
  xyz d;
  int texel;
  const scalar full = texel_node(face, row - face * height, at % width, &d, &texel, TEXELS_VALUES);
  const scalar w = g < count && !(skip && skip[texel]) ? full : 0;
  __global const float *L = radiance + 3 * (size_t)texel;
  for (int k = 0; k < 3; k++)
    list[(size_t)k * stride + g] = frame[3 * k] * d.x + frame[3 * k + 1] * d.y + frame[3 * k + 2] * d.z;
  list[3 * (size_t)stride + g] = w;
  for (int k = 0; k < 3; k++) list[(4 + (size_t)k) * stride + g] = w * L[k];
}
