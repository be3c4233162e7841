// Emulator of CUDA on the CPU, to test kernels without a card. Blocks run one after another. The threads of a block are fibres that take
// turns where they wait for each other. Their order changes from block to block, so that a missing barrier shows.
#pragma once

#include <math.h>
#include <setjmp.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#include <ucontext.h>

#define __CUDACC__
#define __global__
#define __device__
#define __forceinline__ inline
#define __restrict__
#define __launch_bounds__(...)
#define __shared__ static

struct Dimensions {
  unsigned x, y, z;
};

namespace emulator {

struct Group {  // threads that wait for each other
  int alive, arrived, generation;
};

struct Thread {
  jmp_buf here;
  ucontext_t start;
  Dimensions index;
  bool done;
  uint64_t sent;  // its value for the others of its warp
};

constexpr int MOST = 1024;
constexpr size_t STACK = 256 << 10;

inline Thread threads[MOST];
inline Group block, warps[MOST / 32];
inline int count, current, ready, order[MOST], place[MOST];
inline Dimensions grid_size, block_size, block_index;
inline jmp_buf launcher;
inline void (*body)(const void*);
inline const void* work;

inline void resume(int thread) {
  current = thread;
  _longjmp(threads[thread].here, 1);
}

// Resume the next thread that is not done; if all are, leave the block.
inline void next() {
  for (int step = 1; step <= count; step++) {
    int thread = order[(place[current] + step) % count];
    if (!threads[thread].done) resume(thread);
  }
  _longjmp(launcher, 1);
}

inline void yield() {
  if (!_setjmp(threads[current].here)) next();
}

inline void release(Group& g) {
  if (g.arrived && g.arrived == g.alive) g.arrived = 0, g.generation++;
}

inline void wait(Group& g) {
  int mine = g.generation;
  g.arrived++;
  release(g);
  while (g.generation == mine) yield();
}

inline void fibre() {
  for (;;) {
    body(work);
    threads[current].done = true;
    Group* mine[] = {&block, &warps[current / 32]};
    for (Group* g : mine) g->alive--, release(*g);
    if (!_setjmp(threads[current].here)) next();
  }
}

inline void prepare(int n) {
  static int prepared = 0;
  static ucontext_t back;
  for (; prepared < n; prepared++) {
    Thread& t = threads[prepared];
    getcontext(&t.start);
    t.start.uc_stack.ss_sp = malloc(STACK), t.start.uc_stack.ss_size = STACK, t.start.uc_link = nullptr;
    current = prepared;
    // clang-format off
    makecontext(&t.start, (void (*)())+[] {
      int me = current;
      if (!_setjmp(threads[me].here)) setcontext(&back);
      fibre();
    }, 0);
    // clang-format on
    swapcontext(&back, &t.start);
  }
}

inline void launch(int blocks, int size, void (*kernel)(const void*), const void* argument) {
  prepare(size);
  count = size, body = kernel, work = argument;
  grid_size = {(unsigned)blocks, 1, 1}, block_size = {(unsigned)size, 1, 1};
  unsigned random = 1;
  for (int b = 0; b < blocks; b++) {
    block_index = {(unsigned)b, 0, 0};
    block = {size, 0, 0};
    for (int w = 0; w < (size + 31) / 32; w++) warps[w] = {size - 32 * w < 32 ? size - 32 * w : 32, 0, 0};
    for (int i = 0; i < size; i++) threads[i].done = false, threads[i].index = {(unsigned)i, 0, 0}, order[i] = i;
    for (int i = size - 1; i > 0; i--) {
      random = random * 1664525 + 1013904223;
      int j = (random >> 8) % (i + 1), kept = order[i];
      order[i] = order[j], order[j] = kept;
    }
    for (int i = 0; i < size; i++) place[order[i]] = i;
    if (!_setjmp(launcher)) resume(order[0]);
  }
}

// Return the value that lane `lane` of the warp sent. All threads of the warp must call this.
template <class T>
T exchange(T value, int lane) {
  Group& warp = warps[current / 32];
  memcpy(&threads[current].sent, &value, sizeof value);
  wait(warp);
  memcpy(&value, &threads[current / 32 * 32 + lane % 32].sent, sizeof value);
  wait(warp);
  return value;
}

inline unsigned ballot(bool vote) {
  Group& warp = warps[current / 32];
  threads[current].sent = vote;
  wait(warp);
  unsigned votes = 0;
  for (int i = 0; i < 32 && current / 32 * 32 + i < count; i++) {
    const Thread& t = threads[current / 32 * 32 + i];
    votes |= (unsigned)(!t.done && t.sent) << i;
  }
  wait(warp);
  return votes;
}

}  // namespace emulator

#define threadIdx (emulator::threads[emulator::current].index)
#define blockIdx (emulator::block_index)
#define blockDim (emulator::block_size)
#define gridDim (emulator::grid_size)

#define KERNEL(name, Work, w, ...)                                                                  \
  static void name##_threads(const Work* w);                                                        \
  extern "C" void name(const void* work, int blocks, int threads) {                                 \
    emulator::launch(blocks, threads, [](const void* w) { name##_threads((const Work*)w); }, work); \
  }                                                                                                 \
  static void name##_threads(const Work* w)

inline void __syncthreads() { emulator::wait(emulator::block); }
inline void __syncwarp(unsigned = ~0u) { emulator::wait(emulator::warps[emulator::current / 32]); }
template <class T>
T __shfl_xor_sync(unsigned, T v, int mask) {
  return emulator::exchange(v, emulator::current % 32 ^ mask);
}
template <class T>
T __shfl_sync(unsigned, T v, int lane) {
  return emulator::exchange(v, lane);
}
template <class T>
T __shfl_down_sync(unsigned, T v, int by) {
  int lane = emulator::current % 32;
  return emulator::exchange(v, lane + by < 32 ? lane + by : lane);
}
template <class T>
T __shfl_up_sync(unsigned, T v, int by) {
  int lane = emulator::current % 32;
  return emulator::exchange(v, lane >= by ? lane - by : lane);
}
inline unsigned __ballot_sync(unsigned, bool vote) { return emulator::ballot(vote); }
inline bool __any_sync(unsigned, bool vote) { return emulator::ballot(vote) != 0; }
inline int __syncthreads_or(int vote) {
  static int result;
  __syncthreads();
  result = 0;
  __syncthreads();
  result |= vote;
  __syncthreads();
  return result;
}
inline int __syncthreads_count(int vote) {
  static int result;
  __syncthreads();
  result = 0;
  __syncthreads();
  result += vote != 0;
  __syncthreads();
  return result;
}
inline int __popc(unsigned v) { return __builtin_popcount(v); }
inline int __ffs(int v) { return __builtin_ffs(v); }
inline int __clz(int v) { return v ? __builtin_clz(v) : 32; }
inline int __clzll(long long v) { return v ? __builtin_clzll(v) : 64; }

template <class T>
T atomicAdd(T* to, T v) {
  T was = *to;
  *to += v;
  return was;
}
template <class T>
T atomicMax(T* to, T v) {
  T was = *to;
  if (v > was) *to = v;
  return was;
}

inline int __float_as_int(float v) {
  int bits;
  memcpy(&bits, &v, 4);
  return bits;
}
inline float __int_as_float(int v) {
  float number;
  memcpy(&number, &v, 4);
  return number;
}

inline double rsqrt(double x) { return 1 / sqrt(x); }
