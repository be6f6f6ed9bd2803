/* Numbers of one lane under the vector names of lanes.h, because a thread of a GPU has one lane. The elementary
   functions are CUDA's, and without CUDA the C library's. */
#pragma once
#ifdef __CUDACC_RTC__
#define FN static __device__ __forceinline__
typedef int i32;
typedef long long i64;
typedef unsigned int u32;
typedef unsigned long long u64;
typedef unsigned char u8;
#define INT32_MIN (-2147483647 - 1)
#define INT32_MAX 2147483647
#define INT64_MIN (-9223372036854775807ll - 1)
#define INT64_MAX 9223372036854775807ll
#define UINT32_MAX 4294967295u
#define UINT64_MAX 18446744073709551615ull
#define INFINITY __int_as_float(0x7f800000)
#define NAN __int_as_float(0x7fc00000)
#else
#include <math.h>
#include <stdint.h>
#define FN static inline
typedef int32_t i32;
typedef int64_t i64;
typedef uint32_t u32;
typedef uint64_t u64;
typedef uint8_t u8;
#endif
#define all in_all   /* CUDA and C have functions of these names */
#define any in_any
#define finite is_finite
#define PART FN
#define BODY FN
#define LANES 1

typedef float f32;
typedef double f64;
typedef f32 vf32;
typedef f64 vf64;
typedef i32 vi32;
typedef i64 vi64;
typedef u32 vu32;
typedef u64 vu64;

/* truths: a type of their own, so that ~ negates them */
struct mask { bool m; };
FN mask operator&(mask a, mask b) { return mask{a.m && b.m}; }
FN mask operator|(mask a, mask b) { return mask{a.m || b.m}; }
FN mask operator^(mask a, mask b) { return mask{a.m != b.m}; }
FN mask operator~(mask a) { return mask{!a.m}; }
FN bool any(mask a) { return a.m; }
FN bool get(mask a, int) { return a.m; }
FN void set(mask& a, int, bool on) { a.m = on; }
FN mask all(bool on) { return mask{on}; }
FN f32 all(f32 x) { return x; }
FN f64 all(f64 x) { return x; }
FN i32 all(i32 x) { return x; }
FN i64 all(i64 x) { return x; }
FN u32 all(u32 x) { return x; }
FN u64 all(u64 x) { return x; }
template<class T> FN T at(T x, int) { return x; }
template<class T> FN void place(T& x, int, T value) { x = value; }
template<class T> FN T first(T x) { return x; }
FN u8 first(mask a) { return a.m; }

template<class T> FN T sel(mask a, T yes, T no) { return a.m ? yes : no; }
FN mask sel(mask a, mask yes, mask no) { return mask{a.m ? yes.m : no.m}; }
template<class T> FN mask lt(T a, T b) { return mask{a < b}; }
template<class T> FN mask le(T a, T b) { return mask{a <= b}; }
template<class T> FN mask eq(T a, T b) { return mask{a == b}; }
template<class T> FN mask ne(T a, T b) { return mask{a != b}; }
FN mask eq(mask a, mask b) { return mask{a.m == b.m}; }
FN mask ne(mask a, mask b) { return mask{a.m != b.m}; }
template<class T> FN T higher(T a, T b) { return b < a ? a : b; }   /* b where either is NaN */
template<class T> FN T lower(T a, T b) { return a < b ? a : b; }
template<class T> FN T most(T a, T b) { return a == a ? higher(a, b) : a; }   /* NaN where either is */
template<class T> FN T least(T a, T b) { return a == a ? lower(a, b) : a; }

FN f32 size(f32 x) { return fabsf(x); }
FN f64 size(f64 x) { return fabs(x); }
FN i32 size(i32 x) { return x < 0 ? -x : x; }
FN i64 size(i64 x) { return x < 0 ? -x : x; }
FN u32 size(u32 x) { return x; }
FN u64 size(u64 x) { return x; }
FN mask finite(f32 x) { return mask{fabsf(x) <= 3.40282346638528859812e38f}; }
FN mask finite(f64 x) { return mask{fabs(x) <= 1.79769313486231570815e308}; }
template<class T> FN T rest(T x, T y) { return x % y; }
FN f32 rest(f32 x, f32 y) { return fmodf(x, y); }
FN f64 rest(f64 x, f64 y) { return fmod(x, y); }
#define OF_ONE(name, g) FN f64 name(f64 x) { return g(x); } FN f32 name(f32 x) { return g##f(x); }
#define OF_TWO(name, g) FN f64 name(f64 x, f64 y) { return g(x, y); } FN f32 name(f32 x, f32 y) { return g##f(x, y); }
OF_ONE(root, sqrt) OF_ONE(whole, rint) OF_ONE(down, floor) OF_ONE(up, ceil)
OF_ONE(k_exp, exp) OF_ONE(k_log, log) OF_ONE(k_log1p, log1p) OF_ONE(k_expm1, expm1) OF_ONE(k_sin, sin) OF_ONE(k_cos, cos)
OF_ONE(k_tan, tan) OF_ONE(k_tanh, tanh) OF_ONE(k_atan, atan) OF_ONE(k_asin, asin) OF_ONE(k_acos, acos)
OF_ONE(k_sinh, sinh) OF_ONE(k_cosh, cosh) OF_TWO(k_atan2, atan2) OF_TWO(k_pow, pow)

/* Conversions. As in XLA, a real number outside the integers' range becomes the nearest integer, and NaN becomes 0. */
template<class V, class T> FN V to(T x, V) { return (V)x; }
template<class V> FN V to(mask a, V) { return (V)(a.m ? 1 : 0); }
template<class V, class T> FN V bounded(T x, T low, T high, V least, V greatest) {
  return x != x ? (V)0 : low < x ? x < high ? (V)x : greatest : least; }
#define TO_WHOLE(T, V, low, high, least, greatest) \
  FN V to(T x, V) { return bounded(x, (T)low, (T)high, (V)least, (V)greatest); }
#define TO_WHOLES(T) TO_WHOLE(T, i32, -2147483649.0, 2147483648.0, INT32_MIN, INT32_MAX) \
  TO_WHOLE(T, i64, -9223372036854775808.0, 9223372036854775808.0, INT64_MIN, INT64_MAX) \
  TO_WHOLE(T, u32, -1.0, 4294967296.0, 0, UINT32_MAX) TO_WHOLE(T, u64, -1.0, 18446744073709551616.0, 0, UINT64_MAX)
TO_WHOLES(f32) TO_WHOLES(f64)

/* the same bits as a number of another type */
template<class V, class T> FN V bits_as(T x, V) {
  static_assert(sizeof(V) == sizeof(T), "types of one size");
  union { T from; V to; } both;
  both.from = x;
  return both.to; }

/* The entry of a shared column at a valid index. */
template<class T, class I> FN T entry(const T* column, I at) { return column[at]; }

struct Array { void* data; };
