// The CUDA counterpart of vector.h: the same names for one number a thread, so that code written for the CPU's vectors compiles for CUDA.
#pragma once

#define LANES 1
#define MEMBER inline __attribute__((always_inline))
#define INLINE static MEMBER

template <class T>
struct Lane {
  T value;
  Lane() : value() {}
  Lane(T v) : value(v) {}
  T& operator[](int) { return value; }
  T operator[](int) const { return value; }
  explicit operator bool() const { return value != 0; }
  friend Lane operator+(Lane a, Lane b) { return a.value + b.value; }
  friend Lane operator-(Lane a, Lane b) { return a.value - b.value; }
  friend Lane operator*(Lane a, Lane b) { return a.value * b.value; }
  friend Lane operator/(Lane a, Lane b) { return a.value / b.value; }
  friend Lane operator&(Lane a, Lane b) { return a.value & b.value; }
  friend Lane operator|(Lane a, Lane b) { return a.value | b.value; }
  friend Lane operator<<(Lane a, int n) { return a.value << n; }
  Lane operator-() const { return -value; }
  Lane operator~() const { return ~value; }
  Lane& operator+=(Lane b) { return value += b.value, *this; }
  Lane& operator-=(Lane b) { return value -= b.value, *this; }
  Lane& operator*=(Lane b) { return value *= b.value, *this; }
  Lane& operator&=(Lane b) { return value &= b.value, *this; }
  friend Lane<int32_t> operator<(Lane a, Lane b) { return -(a.value < b.value); }
  friend Lane<int32_t> operator<=(Lane a, Lane b) { return -(a.value <= b.value); }
  friend Lane<int32_t> operator>(Lane a, Lane b) { return -(a.value > b.value); }
  friend Lane<int32_t> operator>=(Lane a, Lane b) { return -(a.value >= b.value); }
  friend Lane<int32_t> operator==(Lane a, Lane b) { return -(a.value == b.value); }
};

typedef Lane<float> Vector;
typedef Lane<int32_t> Mask;  // -1 (true) or 0 (false), or an integer
typedef Lane<float> Sum;     // float: a thread adds up few numbers; sum_over_block adds up warps in double

struct alignas(16) Four {
  float value[4] = {};
  float& operator[](int i) { return value[i]; }
  float operator[](int i) const { return value[i]; }
  Four& operator+=(Four b) {
    for (int i = 0; i < 4; i++) value[i] += b.value[i];
    return *this;
  }
  friend Four operator+(Four a, Four b) { return a += b; }
  friend Four operator*(float s, Four a) {
    for (int i = 0; i < 4; i++) a.value[i] *= s;
    return a;
  }
  friend Four operator*(Four a, Four b) {
    for (int i = 0; i < 4; i++) a.value[i] *= b.value[i];
    return a;
  }
};

template <class To, class From>
INLINE To convert(Lane<From> v) {
  return To((decltype(To().value))v.value);
}
INLINE Mask bits(Vector v) { return __float_as_int(v.value); }
INLINE Vector from_bits(Mask m) { return __int_as_float(m.value); }

INLINE Vector select(Mask mask, Vector a, Vector b) { return mask.value ? a : b; }
INLINE Mask select(Mask mask, Mask a, Mask b) { return mask.value ? a : b; }
INLINE Vector smaller(Vector a, Vector b) { return a.value < b.value ? a : b; }
INLINE Vector larger(Vector a, Vector b) { return a.value > b.value ? a : b; }
INLINE Vector root(Vector x) { return sqrtf(x.value); }
INLINE float root(float x) { return sqrtf(x); }
INLINE double root(double x) { return sqrt(x); }
INLINE Vector round_down(Vector x) { return floorf(x.value); }
INLINE Vector inverse_root(Vector x) { return 1.0f / sqrtf(x.value); }
#ifdef __CUDACC_RTC__  // one instruction each; they flush denormal numbers to zero, unlike 1 / x and exp2f
INLINE Vector reciprocal(Vector x) {
  float y;
  asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x.value));
  return y;
}
INLINE Vector exp2(Vector x) {
  float y;
  asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x.value));
  return y;
}
#else
INLINE Vector reciprocal(Vector x) { return 1.0f / x.value; }
INLINE Vector exp2(Vector x) { return exp2f(x.value); }
#endif
INLINE float total(Vector x) { return x.value; }
INLINE bool any(Mask mask) { return mask.value != 0; }
INLINE Vector load(const float* p) { return *p; }
INLINE void store(float* p, Vector v) { *p = v.value; }
INLINE void store(int32_t* p, Mask v) { *p = v.value; }
INLINE Vector read(const float* p, int64_t) { return *p; }
INLINE void write(float* p, Vector v, int64_t) { *p = v.value; }
