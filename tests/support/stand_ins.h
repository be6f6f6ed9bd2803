/* What a kernel of CUDA asks of its GPU, on a processor: one thread after the other. */
#define __global__
#define __grid_constant__
#define __launch_bounds__(threads, blocks)
#define __device__
struct Index { int x; };
static Index blockIdx, blockDim, threadIdx;
template<class T> static T atomicAdd(T* place, T more) { T old = *place; *place += more; return old; }
