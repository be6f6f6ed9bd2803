/* Runs all lanes to their ends on a GPU: a thread for each; one whose lane has ended takes the next, while the others of
   its warp go on. Two launches: what all lanes share is worked out by one thread first. */
#pragma once

#ifdef SINGLE
enum { BLOCKS = 3 };   /* that a multiprocessor holds at least, so that a thread has 168 registers, or 255 */
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
