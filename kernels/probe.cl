// Tests whether a listed device works: lanes, sqrt, fma, a division and a loop with a
// uniform scalar, in the working precision. host/whitefurnace/opencl/device.py knows the right answer.
// -DSCALAR=float|double  -DW=1|2|4|8|16 lanes

#ifdef cl_khr_fp64
#pragma OPENCL EXTENSION cl_khr_fp64 : enable
#endif

#define JOIN_(a, b) a##b
#define JOIN(a, b) JOIN_(a, b)
#if W == 1
typedef SCALAR real;
#define LOAD(i, p) ((p)[i])
#define STORE(v, i, p) ((p)[i] = (v))
#else
typedef JOIN(SCALAR, W) real;
#define LOAD(i, p) JOIN(vload, W)(i, p)
#define STORE(v, i, p) JOIN(vstore, W)(v, i, p)
#endif

// y = (sum over k < terms of a·sqrt(x + k)), then 1/y where that sum is above `bend`
kernel void probe(global const SCALAR *x, global SCALAR *y, SCALAR a, SCALAR bend, int terms)
{
    const size_t i = get_global_id(0);
    const real v = LOAD(i, x);
    real sum = (real)(0);
    for (int k = 0; k < terms; ++k)
        sum = fma(sqrt(v + (SCALAR)k), (real)(a), sum);
    STORE(sum > (real)(bend) ? (real)(1) / sum : sum, i, y);
}
