// The built-in environment: a sky by a smooth gradient, a sun with sharp edges, a checkered ground. It is
// not a sky model but a hard test input that anybody can compute again.

// radiance: [height][2 height][3]; `sun` is a unit direction, cos_sun the cosine of its angular radius, and
// `power` its radiance. Each texel is the mean of `cuts` × `cuts` points with the weight sin θ.
__kernel void demo(__global float *restrict radiance, const int height, const int cuts, const scalar sun_x,
                   const scalar sun_y, const scalar sun_z, const scalar cos_sun, const scalar power) {
  const int g = get_global_id(0), width = 2 * height;
  if (g >= height * width) return;
  const int i = g / width, j = g % width;
  scalar r = 0, gr = 0, b = 0, weight = 0;
  for (int a = 0; a < cuts * cuts; a++) {
    const scalar theta = (i + (a / cuts + (scalar)0.5) / cuts) * PI / height;
    const scalar phi = (j + (a % cuts + (scalar)0.5) / cuts) * PI / height - PI;
    const scalar w = sin(theta), x = w * cos(phi), y = cos(theta), z = w * sin(phi);
    const scalar c = x * sun_x + y * sun_y + z * sun_z;
    scalar sky[3];
    if (y > 0) {
      const scalar h2 = (1 - y) * (1 - y), haze = h2 * h2 * h2;                  // horizon band
      const scalar a = fmax(c, (scalar)0), a2 = a * a, a4 = a2 * a2, glow = a4 * a4 * a4;  // aureole
      sky[0] = (scalar)0.18 + (scalar)0.62 * haze + (scalar)1.5 * glow;
      sky[1] = (scalar)0.34 + (scalar)0.50 * haze + (scalar)1.2 * glow;
      sky[2] = (scalar)0.75 + (scalar)0.20 * haze + (scalar)0.8 * glow;
      if (c > cos_sun) {
        sky[0] += power;
        sky[1] += power * (scalar)0.94;
        sky[2] += power * (scalar)0.82;
      }
    } else {
      // Squares of one unit on a plane one unit below, fading into haze before they alias.
      const scalar near = -y, u = x / fmax(near, (scalar)1e-4), v = z / fmax(near, (scalar)1e-4);
      const scalar check = (((int)floor(u) + (int)floor(v)) & 1) ? (scalar)0.32 : (scalar)0.10;
      const scalar fade = 1 - exp(-near * near * 30), shade = check * fade + (scalar)0.24 * (1 - fade);
      sky[0] = shade * (scalar)1.05;
      sky[1] = shade * (scalar)0.95;
      sky[2] = shade * (scalar)0.80;
    }
    r += w * sky[0];
    gr += w * sky[1];
    b += w * sky[2];
    weight += w;
  }
  radiance[3 * g] = r / weight;
  radiance[3 * g + 1] = gr / weight;
  radiance[3 * g + 2] = b / weight;
}
