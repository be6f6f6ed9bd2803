/* The loops of a launch for values and tangents: a thread runs blocks of lanes until every lane has ended. A lane's
   numbers depend neither on the thread nor on the other lanes of its block. */
#pragma once
#include "launch.h"

static void* work(void* given) {
  Job* job = (Job*)given;
  const Array *lanes = job->arrays + UNIFORM, *carry = job->arrays + FIRST;
  Shared s;
  prepare(s, job->arrays);
  Block b;
  memset((void*)&b, 0, sizeof b);
  i64 lane[SLOTS];   /* number of the lane in each place, -1 for none */
  int left = 0;
  for (int p = 0; p < SLOTS; p++) {
    const i64 j = taken(job, 1);
    lane[p] = j < job->count ? j : -1;
    left += j < job->count;
    put(b, p, j < job->count ? j : job->count - 1, lanes, carry);
  }
  for (int q = 0; q < VECTORS; q++) begin(b, s, q);
  /* A place without a lane computes with a copy of the last one: no branch and no invalid numbers in the vectors. */
  while (left) {
    for (int k = 0; k < ROUNDS; k++) {
      renew(b, s);
      for (int i = 0; i < STEPS; i++) step(b, s);
    }
    mask on[VECTORS];
    running(b, s, on);
    for (int q = 0; q < VECTORS; q++) {
      bool fresh = false;
      for (int p = q*LANES; p < (q + 1)*LANES; p++) if (lane[p] >= 0 && !get(on[q], p - q*LANES)) {
        take(b, p, lane[p], carry);
        const i64 j = taken(job, 1);
        lane[p] = j < job->count ? j : -1;
        if (j < job->count) { put(b, p, j, lanes, carry); fresh = true; } else left--;
      }
      if (fresh) begin(b, s, q);
    }
  }
  return 0;
}
