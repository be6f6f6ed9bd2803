/* Vectors with one number for each of LANES lanes, by the vector types of GCC and Clang. Comparisons return masks. With
   AVX-512 a mask has a bit for each lane; otherwise, and with -DPLAIN, it is a vector of integers 0 or -1.

   To be defined before: SINGLE, if a vector of float fills a register, instead of a vector of double. */
#pragma once
#include <math.h>
#include <stdint.h>
#if defined(__AVX512F__) && defined(__AVX512VL__) && defined(__AVX512DQ__) && defined(__AVX512BW__) && !defined(PLAIN)
#define WIDE
#endif
#ifdef __AVX__
#include <immintrin.h>
#endif
#ifdef WIDE
#define BYTES 64
#elif defined(__AVX__)
#define BYTES 32
#else
#define BYTES 16
#endif
#ifdef SINGLE
#define REAL float
#else
#define REAL double
#endif
#define LANES (BYTES/sizeof(REAL))
#define FN static inline __attribute__((always_inline, unused))
#define PART static
#define BODY static __attribute__((noinline))

typedef float f32;
typedef double f64;
typedef int32_t i32;
typedef int64_t i64;
typedef uint32_t u32;
typedef uint64_t u64;
typedef uint8_t u8;
#define VECTOR(type) typedef type v##type __attribute__((vector_size(LANES*sizeof(type)))); \
  FN v##type all(type x) { return x - v##type{}; }   /* one number in every lane; x - 0 keeps -0, x + 0 would not */
VECTOR(f32) VECTOR(f64) VECTOR(i32) VECTOR(i64) VECTOR(u32) VECTOR(u64)
#define CAST(V, x) __builtin_convertvector(x, V)

/* the integer vector that a comparison returns */
template<int size> struct Whole;
template<> struct Whole<4> { typedef vi32 type; };
template<> struct Whole<8> { typedef vi64 type; };
#define WHOLE(V) typename Whole<sizeof(V)/LANES>::type

/* masks */
#ifdef WIDE
#ifdef SINGLE
typedef __mmask16 bits;
FN bits narrow(vi32 x) { return _mm512_movepi32_mask((__m512i)x); }
FN bits narrow(vi64 x) { return narrow(CAST(vi32, x)); }
FN vi32 spread(bits m, vi32) { return (vi32)_mm512_movm_epi32(m); }
FN vi64 spread(bits m, vi64) { return CAST(vi64, spread(m, vi32{})); }
#else
typedef __mmask8 bits;
FN bits narrow(vi32 x) { return _mm256_movepi32_mask((__m256i)x); }
FN bits narrow(vi64 x) { return _mm512_movepi64_mask((__m512i)x); }
FN vi32 spread(bits m, vi32) { return (vi32)_mm256_movm_epi32(m); }
FN vi64 spread(bits m, vi64) { return (vi64)_mm512_movm_epi64(m); }
#endif
struct mask { bits m; };
FN mask packed(vi32 x) { return mask{narrow(x)}; }
FN mask packed(vi64 x) { return mask{narrow(x)}; }
FN vi32 spread(mask a, vi32 like) { return spread(a.m, like); }
FN vi64 spread(mask a, vi64 like) { return spread(a.m, like); }
FN mask operator&(mask a, mask b) { return mask{(bits)(a.m & b.m)}; }
FN mask operator|(mask a, mask b) { return mask{(bits)(a.m | b.m)}; }
FN mask operator^(mask a, mask b) { return mask{(bits)(a.m ^ b.m)}; }
FN mask operator~(mask a) { return mask{(bits)~a.m}; }
FN bool any(mask a) { return a.m != 0; }
FN bool get(mask a, int q) { return a.m >> q & 1; }
FN void set(mask& a, int q, bool on) { a.m = (bits)((a.m & ~(1u << q)) | ((u32)on << q)); }
FN mask all(bool on) { return mask{(bits)(on ? -1 : 0)}; }
#else
#ifdef SINGLE
typedef vi32 word;
#else
typedef vi64 word;
#endif
struct mask { word m; };
FN mask packed(vi32 x) { return mask{CAST(word, x)}; }
FN mask packed(vi64 x) { return mask{CAST(word, x)}; }
FN vi32 spread(mask a, vi32) { return CAST(vi32, a.m); }
FN vi64 spread(mask a, vi64) { return CAST(vi64, a.m); }
FN mask operator&(mask a, mask b) { return mask{a.m & b.m}; }
FN mask operator|(mask a, mask b) { return mask{a.m | b.m}; }
FN mask operator^(mask a, mask b) { return mask{a.m ^ b.m}; }
FN mask operator~(mask a) { return mask{~a.m}; }
#ifdef __AVX__
FN bool any(mask a) { return !_mm256_testz_si256((__m256i)a.m, (__m256i)a.m); }
#else
FN bool any(mask a) { bool on = false; for (int q = 0; q < LANES; q++) on |= a.m[q] != 0; return on; }
#endif
FN bool get(mask a, int q) { return a.m[q] != 0; }
FN void set(mask& a, int q, bool on) { a.m[q] = on ? -1 : 0; }
FN mask all(bool on) { return mask{word{} - (on ? 1 : 0)}; }
#endif
template<class V> FN V sel(mask a, V yes, V no) { return spread(a, WHOLE(V){}) ? yes : no; }
template<class V> FN mask lt(V a, V b) { return packed((WHOLE(V))(a < b)); }
template<class V> FN mask le(V a, V b) { return packed((WHOLE(V))(a <= b)); }
template<class V> FN mask eq(V a, V b) { return packed((WHOLE(V))(a == b)); }
template<class V> FN mask ne(V a, V b) { return packed((WHOLE(V))(a != b)); }
FN vf32 size(vf32 x) { return (vf32)((vu32)x & 0x7fffffffu); }
FN vf64 size(vf64 x) { return (vf64)((vu64)x & 0x7fffffffffffffffull); }
FN mask eq(mask a, mask b) { return ~(a ^ b); }
FN mask ne(mask a, mask b) { return a ^ b; }

/* For vectors that fill a register, one instruction each: compilers do not find these themselves. */
#ifdef WIDE
#define COMPARED(V, T, I) \
  FN mask lt(V a, V b) { return mask{I(cmplt)((T)a, (T)b)}; } FN mask le(V a, V b) { return mask{I(cmple)((T)a, (T)b)}; } \
  FN mask eq(V a, V b) { return mask{I(cmpeq)((T)a, (T)b)}; } FN mask ne(V a, V b) { return mask{I(cmpneq)((T)a, (T)b)}; }
#ifdef SINGLE
#define REALLY(f) _mm512_##f##_ps
#define R_MASK(f) _mm512_##f##_ps_mask
#define I_MASK(f) _mm512_##f##_epi32_mask
#define U_MASK(f) _mm512_##f##_epu32_mask
#define BLENDED(a, b, c) _mm512_mask_blend_epi32(a, b, c)
typedef vf32 vreal; typedef vi32 vint; typedef vu32 vnat; typedef __m512 register_of_reals;
#else
#define REALLY(f) _mm512_##f##_pd
#define R_MASK(f) _mm512_##f##_pd_mask
#define I_MASK(f) _mm512_##f##_epi64_mask
#define U_MASK(f) _mm512_##f##_epu64_mask
#define BLENDED(a, b, c) _mm512_mask_blend_epi64(a, b, c)
typedef vf64 vreal; typedef vi64 vint; typedef vu64 vnat; typedef __m512d register_of_reals;
#endif
COMPARED(vreal, register_of_reals, R_MASK) COMPARED(vint, __m512i, I_MASK) COMPARED(vnat, __m512i, U_MASK)
FN vreal sel(mask a, vreal yes, vreal no) {
  return (vreal)REALLY(mask_blend)(a.m, (register_of_reals)no, (register_of_reals)yes); }
FN vint sel(mask a, vint yes, vint no) { return (vint)BLENDED(a.m, (__m512i)no, (__m512i)yes); }
FN vnat sel(mask a, vnat yes, vnat no) { return (vnat)BLENDED(a.m, (__m512i)no, (__m512i)yes); }
FN vreal higher(vreal a, vreal b) { return (vreal)REALLY(max)((register_of_reals)a, (register_of_reals)b); }
FN vreal lower(vreal a, vreal b) { return (vreal)REALLY(min)((register_of_reals)a, (register_of_reals)b); }
FN vreal most(vreal a, vreal b) {
  const register_of_reals x = (register_of_reals)a, y = (register_of_reals)b;
  return (vreal)REALLY(mask_max)(x, R_MASK(cmpeq)(x, x), x, y); }
FN vreal least(vreal a, vreal b) {
  const register_of_reals x = (register_of_reals)a, y = (register_of_reals)b;
  return (vreal)REALLY(mask_min)(x, R_MASK(cmpeq)(x, x), x, y); }
FN vreal root(vreal x) { return (vreal)REALLY(sqrt)((register_of_reals)x); }
FN vreal whole(vreal x) { return (vreal)REALLY(roundscale)((register_of_reals)x, 8); }
FN vreal down(vreal x) { return (vreal)REALLY(roundscale)((register_of_reals)x, 9); }
FN vreal up(vreal x) { return (vreal)REALLY(roundscale)((register_of_reals)x, 10); }
/* `scaled` is x * 2^n. `parted` returns the part m of x between 3/4 and 3/2, and n with x = m * 2^n; NaN for x < 0. */
FN vreal scaled(vreal x, vreal n) { return (vreal)REALLY(scalef)((register_of_reals)x, (register_of_reals)n); }
FN vreal parted(vreal x, vreal& n) {
  const vreal m = (vreal)REALLY(getmant)((register_of_reals)x, _MM_MANT_NORM_p75_1p5, _MM_MANT_SIGN_src);
  /* the exponent of m is 0, or -1 for m < 1 */
  n = (vreal)REALLY(getexp)((register_of_reals)x) - (vreal)REALLY(getexp)((register_of_reals)m);
  return m; }
#endif
FN mask sel(mask a, mask yes, mask no) { return (a & yes) | (~a & no); }
template<class V> FN V higher(V a, V b) { return sel(lt(b, a), a, b); }   /* b where either is NaN */
template<class V> FN V lower(V a, V b) { return sel(lt(a, b), a, b); }
template<class V> FN V most(V a, V b) { return sel(eq(a, a), higher(a, b), a); }   /* NaN where either is */
template<class V> FN V least(V a, V b) { return sel(eq(a, a), lower(a, b), a); }

/* one lane after the other */
template<class V> FN V root(V x) { for (int q = 0; q < LANES; q++) x[q] = sqrt(x[q]); return x; }
template<class V> FN V whole(V x) { for (int q = 0; q < LANES; q++) x[q] = rint(x[q]); return x; }
template<class V> FN V down(V x) { for (int q = 0; q < LANES; q++) x[q] = floor(x[q]); return x; }
template<class V> FN V up(V x) { for (int q = 0; q < LANES; q++) x[q] = ceil(x[q]); return x; }
#define ALONE(name, f) template<class V> FN V name(V x) { for (int q = 0; q < LANES; q++) x[q] = f(x[q]); return x; }
#define IN_PAIRS(name, f) \
  template<class V> FN V name(V x, V y) { for (int q = 0; q < LANES; q++) x[q] = f(x[q], y[q]); return x; }
IN_PAIRS(rest, fmod)
FN vi32 rest(vi32 x, vi32 y) { return x % y; }
FN vi64 rest(vi64 x, vi64 y) { return x % y; }
FN vu32 rest(vu32 x, vu32 y) { return x % y; }
FN vu64 rest(vu64 x, vu64 y) { return x % y; }

FN vi32 size(vi32 x) { return sel(lt(x, vi32{}), -x, x); }
FN vi64 size(vi64 x) { return sel(lt(x, vi64{}), -x, x); }
FN vu32 size(vu32 x) { return x; }
FN vu64 size(vu64 x) { return x; }
FN mask finite(vf32 x) { return le(size(x), all(3.40282346638528859812e38f)); }
FN mask finite(vf64 x) { return le(size(x), all(1.79769313486231570815e308)); }

template<class V> FN auto at(V x, int q) -> decltype(x[0] + 0*x[0]) { return x[q]; }
template<class V, class T> FN void place(V& x, int q, T value) { x[q] = value; }
template<class V, class T> FN V bits_as(T x, V) { return (V)x; }

/* Conversions. As in XLA, a real number outside the integers' range becomes the nearest integer, and NaN becomes 0. */
template<class V, class T> FN V to(T x, V) { return CAST(V, x); }
template<class V> FN V to(mask a, V) { return sel(a, V{} + 1, V{}); }
#ifndef WIDE
/* Without AVX-512 no instruction converts vectors of i64. The halves are the last bits of 2^52 and of 2^84 + 2^63, so
   both parts are exact, and the last sum rounds once. */
FN vf64 to(vi64 x, vf64) {
  const vf64 low = (vf64)(((vu64)x & 0xffffffffull) | 0x4330000000000000ull);
  const vf64 high = (vf64)((vu64)x >> 32 ^ 0x4530000080000000ull);
  return (high - 0x1.00000801p84) + low; }
#endif
template<class V, class T> FN V bounded(T x, T low, T high, V first, V last) {
  const mask fits = lt(low, x) & lt(x, high);
  const V inside = CAST(V, sel(fits, x, T{}));
  return sel(fits | ne(x, x), inside, sel(lt(x, high), first, last)); }
#define TO_WHOLE(T, V, low, high, first, last) \
  FN v##V to(v##T x, v##V) { return bounded(x, all((T)low), all((T)high), all((V)first), all((V)last)); }
#define TO_WHOLES(T) TO_WHOLE(T, i32, -2147483649.0, 2147483648.0, INT32_MIN, INT32_MAX) \
  TO_WHOLE(T, i64, -9223372036854775808.0, 9223372036854775808.0, INT64_MIN, INT64_MAX) \
  TO_WHOLE(T, u32, -1.0, 4294967296.0, 0, UINT32_MAX) TO_WHOLE(T, u64, -1.0, 18446744073709551616.0, 0, UINT64_MAX)
TO_WHOLES(f32) TO_WHOLES(f64)

/* The entry of a shared column at a valid index. */
template<class T, class I> FN auto entry(const T* column, I at) -> decltype(all(*column)) {
  decltype(all(*column)) x;
  for (int q = 0; q < LANES; q++) x[q] = column[at[q]];
  return x; }

/* An array of XLA, and the value of a number that all lanes share. */
struct Array { void* data; };
template<class V> FN auto first(V x) -> decltype(x[0] + 0*x[0]) { return x[0]; }
FN u8 first(mask a) { return get(a, 0); }
