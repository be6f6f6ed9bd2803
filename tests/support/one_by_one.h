/* The launch, thread by thread. */
extern "C" void start(const Arrays* arrays, char* room, i64 count, i64 blocks, i64 threads, i64 counter) {
  i64* next = (i64*)room;
  Shared* shared = (Shared*)(room + counter);
  blockDim.x = threads;
  begin_all(*arrays, shared, next, blocks*threads);
  for (int block = 0; block < blocks; block++)
    for (int thread = 0; thread < threads; thread++) {
      blockIdx.x = block, threadIdx.x = thread;
      run_all(*arrays, shared, next, count);
    }
}
extern "C" i64 needed(i64 counter) { return counter + sizeof(Shared); }
