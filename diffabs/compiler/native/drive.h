/* The launch on a processor: threads run blocks of lanes until every lane has ended. XLA calls it through its C
   interface. A lane's numbers depend neither on the thread nor on the other lanes of its block. */
#pragma once
#include <pthread.h>
#include <string.h>
#include "xla/ffi/api/c_api.h"

struct Job {
  const Shared* shared;
  const Array *lanes, *carry;
  i64 count, next;
};

static i64 taken(Job* job) { return __atomic_fetch_add(&job->next, 1, __ATOMIC_RELAXED); }

static void* work(void* given) {
  Job* job = (Job*)given;
  const Shared& s = *job->shared;
  Block b;
  memset((void*)&b, 0, sizeof b);
  i64 lane[SLOTS];   /* number of the lane in each place, -1 for none */
  int left = 0;
  for (int p = 0; p < SLOTS; p++) {
    const i64 j = taken(job);
    lane[p] = j < job->count ? j : -1;
    left += j < job->count;
    put(b, p, j < job->count ? j : job->count - 1, job->lanes, job->carry);
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
        take(b, p, lane[p], job->carry);
        const i64 j = taken(job);
        lane[p] = j < job->count ? j : -1;
        if (j < job->count) { put(b, p, j, job->lanes, job->carry); fresh = true; } else left--;
      }
      if (fresh) begin(b, s, q);
    }
  }
  return 0;
}

static void run(const Array* uniform, const Array* lanes, const Array* carry, i64 count, i64 threads) {
  if (count < 1) return;
  Shared s;
  prepare(s, uniform);
  Job job = {&s, lanes, carry, count, 0};
  enum { MOST = 256 };
  pthread_t others[MOST];
  int started = 0;
  const i64 useful = (count + SLOTS - 1)/SLOTS, asked = threads < useful ? threads : useful;
  while (started < MOST && started + 1 < asked && !pthread_create(&others[started], 0, work, &job)) started++;
  work(&job);
  for (int i = 0; i < started; i++) pthread_join(others[i], 0);
}

/* The arguments: UNIFORM arrays, then OF_LANES and CARRIED arrays with a leading axis of lanes. The results are the
   carry, in place if XLA gives the same buffer. */
extern "C" XLA_FFI_Error* diffabs_kernel(XLA_FFI_CallFrame* call) {
  auto* more = call->extension_start;   // the type's name differs between versions of jaxlib
  if (more && more->type == XLA_FFI_Extension_Metadata) {
    XLA_FFI_Metadata* told = ((XLA_FFI_Metadata_Extension*)more)->metadata;
    told->api_version.major_version = XLA_FFI_API_MAJOR;
    told->api_version.minor_version = XLA_FFI_API_MINOR;
    told->traits = 0;
    return 0;
  }
  if (call->stage != XLA_FFI_ExecutionStage_EXECUTE) return 0;
  Array arrays[UNIFORM + OF_LANES + CARRIED + 1];
  for (int i = 0; i < UNIFORM + OF_LANES + CARRIED; i++) arrays[i].data = ((XLA_FFI_Buffer*)call->args.args[i])->data;
  Array* const carry = arrays + UNIFORM + OF_LANES;
  i64 count = 0;
  for (int i = 0; i < CARRIED; i++) {
    XLA_FFI_Buffer* out = (XLA_FFI_Buffer*)call->rets.rets[i];
    count = out->dims[0];
    if (out->data != carry[i].data) memcpy(out->data, carry[i].data, count*WIDTHS[i]);
    carry[i].data = out->data;
  }
  i64 threads = 1;
  for (i64 i = 0; i < call->attrs.size; i++)
    if (call->attrs.names[i]->len == 7 && !memcmp(call->attrs.names[i]->ptr, "threads", 7))
      threads = *(int64_t*)((XLA_FFI_Scalar*)call->attrs.attrs[i])->value;
  run(arrays, arrays + UNIFORM, carry, count, threads);
  return 0;
}
