// The CUDA side of library.h, for sources that serve both the CPU and CUDA: kernels, and threads that share numbered work items.
// NVRTC compiles every function for the device (--device-as-default-execution-space).
#pragma once

#ifdef __CUDACC_RTC__
typedef unsigned char uint8_t;
typedef short int16_t;
typedef unsigned short uint16_t;
typedef int int32_t;
typedef unsigned int uint32_t;
typedef long long int64_t;
typedef unsigned long long uint64_t;
#endif

#define EXPORT extern "C"

// Define a kernel. It takes its work by value, and `w` points at it. Launch bounds may follow.
#ifndef KERNEL
#define KERNEL(name, Work, w, ...)                                                                          \
  static void name##_threads(const Work* w);                                                                \
  extern "C" __global__ void __VA_ARGS__ name(const __grid_constant__ Work work) { name##_threads(&work); } \
  static void name##_threads(const Work* w)
#endif

struct Shared;  // library.h

// Call body(i) for each i below n, one thread an i. If there are fewer threads than n, each takes several.
template <class Body>
inline void share(const Shared&, int64_t n, int64_t, Body body) {
  int64_t threads = (int64_t)gridDim.x * blockDim.x;
  for (int64_t i = (int64_t)blockIdx.x * blockDim.x + threadIdx.x; i < n; i += threads) body(i);
}

// Sum N numbers over the threads of a block of whole warps: in float within a warp, then in double over warps. The order is fixed, so
// the result is deterministic. A kernel may call it only once: its shared memory is not guarded.
template <int N>
inline void sum_over_block(float (&numbers)[N], double* sums) {
  __shared__ float of_warps[N][32];
  for (int i = 0; i < N; i++) {
    for (int apart = 16; apart; apart /= 2) numbers[i] += __shfl_xor_sync(~0u, numbers[i], apart);
    if (threadIdx.x % 32 == 0) of_warps[i][threadIdx.x / 32] = numbers[i];
  }
  __syncthreads();
  if (threadIdx.x >= N) return;
  double sum = 0;
  for (int warp = 0; warp < blockDim.x / 32; warp++) sum += of_warps[threadIdx.x][warp];
  sums[threadIdx.x] = sum;
}
