// Definitions for every exported function. No C library is used, so that results depend on the processor only. On macOS, memory is
// copied and cleared by the system's.
#pragma once

#ifdef __CUDACC__
#include "device.h"
#else
#include <stdint.h>
#endif

// Counters by which the threads inside a function share its work.
struct Shared {
  int64_t next, thread;
};

#ifndef __CUDACC__
#if defined(_WIN32)
#define EXPORT extern "C" __declspec(dllexport)
#else
#define EXPORT extern "C" __attribute__((visibility("default")))
#endif

// Define a function that several threads may enter at once to share its work.
#define KERNEL(name, Work, w) EXPORT void name(const Work* w)

static inline int64_t take(int64_t& next, int64_t n) { return __atomic_fetch_add(&next, n, __ATOMIC_RELAXED); }

// Call body(i) for each i below n. A free thread takes the next `batch` of them.
template <class Body>
static inline void share(Shared& shared, int64_t n, int64_t batch, Body body) {
  for (int64_t first; (first = take(shared.next, batch)) < n;)
    for (int64_t i = first; i < first + batch && i < n; i++) body(i);
}
#endif
