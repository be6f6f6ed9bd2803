/* The launch on a processor: `work` of several threads, each of which takes lanes until there are none. XLA calls it
   through its C interface. */
#pragma once
#include <pthread.h>
#include <string.h>
#include "xla/ffi/api/c_api.h"

/* UNIFORM arrays, then OF_LANES and others with a leading axis of lanes; from FIRST on the results */
struct Job {
  const Array* arrays;
  i64 count, next;
};

/* Return the number of the first of `most` more lanes. */
static i64 taken(Job* job, i64 most) { return __atomic_fetch_add(&job->next, most, __ATOMIC_RELAXED); }

static void* work(void* job);

static void run(const Array* arrays, i64 count, i64 threads) {
  if (count < 1) return;
  Job job = {arrays, count, 0};
  enum { MOST = 256 };
  pthread_t others[MOST];
  int started = 0;
  const i64 useful = (count + SLOTS - 1)/SLOTS, asked = threads < useful ? threads : useful;
  while (started < MOST && started + 1 < asked && !pthread_create(&others[started], 0, work, &job)) started++;
  work(&job);
  for (int i = 0; i < started; i++) pthread_join(others[i], 0);
}

/* The arguments are the arrays. The results are the last ones, in place if XLA gives the same buffer. */
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
  Array arrays[FIRST + RESULTS + 1];
  for (int i = 0; i < FIRST + RESULTS; i++) arrays[i].data = ((XLA_FFI_Buffer*)call->args.args[i])->data;
  i64 count = 0;
  for (int i = 0; i < RESULTS; i++) {
    XLA_FFI_Buffer* out = (XLA_FFI_Buffer*)call->rets.rets[i];
    count = out->dims[0];
    Array& result = arrays[FIRST + i];
    if (out->data != result.data) memcpy(out->data, result.data, count*WIDTHS[i]);
    result.data = out->data;
  }
  i64 threads = 1;
  for (i64 i = 0; i < call->attrs.size; i++)
    if (call->attrs.names[i]->len == 7 && !memcmp(call->attrs.names[i]->ptr, "threads", 7))
      threads = *(int64_t*)((XLA_FFI_Scalar*)call->attrs.attrs[i])->value;
  run(arrays, count, threads);
  return 0;
}
