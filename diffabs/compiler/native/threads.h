/* The launch on a GPU: each thread runs a lane and takes the next when it ends, while the rest of its warp goes on.
   Two kernels: first one thread computes the values that all lanes share, then `run_all` runs the lanes. */
#pragma once

#ifdef SINGLE
enum { BLOCKS = 3 };   /* least blocks a multiprocessor: 168 registers a thread, for double 255 */
#else
enum { BLOCKS = 2 };
#endif

struct Arrays {
  Array uniform[UNIFORM + 1], lanes[OF_LANES + 1], carry[CARRIED + 1], results[CARRIED + 1];
};

extern "C" __global__ void begin_all(const __grid_constant__ Arrays arrays, Shared* shared, i64* next, i64 threads) {
  *next = threads;
  prepare(*shared, arrays.uniform);
}

extern "C" __global__ void __launch_bounds__(THREADS, BLOCKS)
run_all(const __grid_constant__ Arrays arrays, const Shared* __restrict__ shared, i64* next, i64 count) {
  const Shared& s = *shared;
  i64 j = (i64)blockIdx.x*blockDim.x + threadIdx.x;
  if (j >= count) return;
  Block b;
  put(b, 0, j, arrays.lanes, arrays.carry);
  begin(b, s, 0);
  while (true) {
    for (int k = 0; k < ROUNDS; k++) {
      renew(b, s);
      for (int i = 0; i < STEPS; i++) step(b, s);
    }
    mask on[VECTORS];
    running(b, s, on);
    if (get(on[0], 0)) continue;
    take(b, 0, j, arrays.results);
    j = (i64)atomicAdd((u64*)next, (u64)1);
    if (j >= count) return;
    put(b, 0, j, arrays.lanes, arrays.carry);
    begin(b, s, 0);
  }
}
