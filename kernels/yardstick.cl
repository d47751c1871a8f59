// The limits of a device, measured together with the kernels so that their speed is a ratio: multiply-adds in
// registers, memory that is only read, and memory that is streamed.

// Twelve chains side by side: a core with two units of four cycles each has 8 in flight, and twelve chains with their
// two constants still fit AVX2's 16 registers. Named one by one, because an array might be kept in memory.
#define EACH(f) f(0) f(1) f(2) f(3) f(4) f(5) f(6) f(7) f(8) f(9) f(10) f(11)
#define CHAINS 12
#define ROUND EACH(STEP) EACH(STEP) EACH(STEP) EACH(STEP)  // so that the loop's own counting hides behind them
#define BEGIN(k) real x##k = LOAD(k, start);
#define STEP(k) x##k = fma(x##k, a, b);
#define TOTAL(k) +x##k

// 8·CHAINS·W operations a round and work item. start: [CHAINS][W]; each chain nears offset/(1 - factor), so that
// nothing overflows or becomes subnormal, and no compiler knows it.
__kernel void multiply_add(__global scalar *restrict out, const int rounds, const scalar factor, const scalar offset,
                           __global const scalar *restrict start) {
  const real a = (real)factor, b = (real)offset;
  EACH(BEGIN)
  for (int k = 0; k < rounds; k++) { ROUND }
  STORE(0 EACH(TOTAL), get_global_id(0), out);
}

// Every group has a stretch of `count` vectors for each of its items, and neighbours read neighbours: one item reads on
// and on where a group is one (CPUs), all of a group read one piece of memory where they go in step (GPUs).
static inline size_t first_vector(int count) {
  return get_group_id(0) * (size_t)count * get_local_size(0) + get_local_id(0);
}

// out: [items][W]. Four sums, since one alone would wait for its own addition. `count` is a multiple of 4.
__kernel void read(__global scalar *restrict out, const int count, __global const scalar *restrict in) {
  const size_t first = first_vector(count), step = get_local_size(0);
  real a = (real)0, b = (real)0, c = (real)0, d = (real)0;
  for (int k = 0; k < count; k += 4) {
    a += LOAD(first + k * step, in);
    b += LOAD(first + (k + 1) * step, in);
    c += LOAD(first + (k + 2) * step, in);
    d += LOAD(first + (k + 3) * step, in);
  }
  STORE(a + b + c + d, get_global_id(0), out);
}

// out = a + factor·b, the third of the STREAM benchmark. [McCalpin1995]
__kernel void triad(__global scalar *restrict out, const int count, const scalar factor,
                    __global const scalar *restrict in_a, __global const scalar *restrict in_b) {
  const size_t first = first_vector(count), step = get_local_size(0);
  for (int k = 0; k < count; k++) {
    const size_t at = first + k * step;
    STORE(LOAD(at, in_a) + factor * LOAD(at, in_b), at, out);
  }
}
