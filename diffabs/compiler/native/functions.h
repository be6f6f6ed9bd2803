/* Elementary functions of vectors, without branches, accurate to about one unit in the last place
   (tests/compiler/test_kernel_native.py). Polynomials are Taylor's, so that their coefficients can be checked by eye.
   Only the inverse tangent and the logarithm in single precision have Chebyshev polynomials. Functions in single
   precision do not go by way of double: 16 doubles fill two registers, and compilers then compare lane by lane. */
#pragma once
#include "lanes.h"

/* x * 2^n for an integer n, without AVX-512's instruction: two factors, so that a subnormal result is rounded once and
   an overflow gives infinity. `parted` splits x into its part m between 3/4 and 3/2 and the exponent n. */
#if !defined(WIDE) || defined(SINGLE)
FN vf64 scaled(vf64 x, vf64 n) {
  const vi64 k = CAST(vi64, n), half = k >> 1;
  return x*(vf64)((half + 1023) << 52)*(vf64)((k - half + 1023) << 52); }
FN vf64 parted(vf64 x, vf64& n) {
  const mask small = lt(size(x), all(2.2250738585072014e-308));
  const vf64 normal = sel(small, x*0x1p54, x);
  const vu64 b = (vu64)normal + (0x3ff0000000000000ull - 0x3fe8000000000000ull);
  const vf64 e = CAST(vf64, (vi64)(b >> 52 & 0x7ff)) - sel(small, all(1023.0 + 54.0), all(1023.0));
  const vf64 m = (vf64)((b & 0x000fffffffffffffull) + 0x3fe8000000000000ull);
  const mask end = eq(x, vf64{}) | ~lt(size(x), all((f64)INFINITY));
  n = sel(end, sel(eq(x, vf64{}), all((f64)-INFINITY), size(x)), e);
  return sel(end, all(1.0), sel(lt(x, vf64{}), -m, m)); }
#endif
#if !defined(WIDE) || !defined(SINGLE)
FN vf32 scaled(vf32 x, vf32 n) {
  const vi32 k = CAST(vi32, n), half = k >> 1;
  return x*(vf32)((half + 127) << 23)*(vf32)((k - half + 127) << 23); }
FN vf32 parted(vf32 x, vf32& n) {
  const mask small = lt(size(x), all(1.17549435e-38f));
  const vf32 normal = sel(small, x*0x1p25f, x);
  const vu32 b = (vu32)normal + (0x3f800000u - 0x3f400000u);
  const vf32 e = CAST(vf32, (vi32)(b >> 23 & 0xff)) - sel(small, all(127.f + 25.f), all(127.f));
  const vf32 m = (vf32)((b & 0x007fffffu) + 0x3f400000u);
  const mask end = eq(x, vf32{}) | ~lt(size(x), all((f32)INFINITY));
  n = sel(end, sel(eq(x, vf32{}), all((f32)-INFINITY), size(x)), e);
  return sel(end, all(1.f), sel(lt(x, vf32{}), -m, m)); }
#endif

/* e^x - 1 = r + r^2 q(r) for |r| <= log(2)/2 */
FN vf64 tail_of_exp(vf64 r) {
  vf64 q = r*(1/87178291200.0) + 1/6227020800.0;
  q = q*r + 1/479001600.0; q = q*r + 1/39916800.0; q = q*r + 1/3628800.0; q = q*r + 1/362880.0; q = q*r + 1/40320.0;
  q = q*r + 1/5040.0; q = q*r + 1/720.0; q = q*r + 1/120.0; q = q*r + 1/24.0; q = q*r + 1/6.0;
  return q*r + 0.5; }
/* x = n log(2) + r + low */
FN vf64 reduced_exp(vf64 x, vf64& n, vf64& low) {
  n = whole(x*1.4426950408889634074);
  const vf64 high = x - n*0x1.62e42feep-1, part = n*0x1.a39ef35793c76p-33, r = high - part;
  low = (high - r) - part;
  return r; }
/* x is clamped to the range where exp is neither 0 nor infinite. `higher` and `lower` return their second operand for
   NaN, so x stands second and NaN stays. */
template<class V, class T> FN V clamped(V x, T least, T most) { return lower(all(most), higher(all(least), x)); }
FN vf64 k_exp(vf64 x) {
  vf64 n, low;
  const vf64 r = reduced_exp(clamped(x, -750.0, 710.0), n, low);
  return scaled((r*r*tail_of_exp(r) + low) + r + 1.0, n); }
/* In single precision the rounding error of r costs a tenth of a unit in the last place. */
FN vf32 k_exp(vf32 x) {
  const vf32 y = clamped(x, -105.f, 89.f), n = whole(y*1.44269504f), r = (y - n*0x1.62e0p-1f) - n*0x1.0bfbe8p-15f;
  vf32 q = r*(1/5040.f) + 1/720.f;
  q = q*r + 1/120.f; q = q*r + 1/24.f; q = q*r + 1/6.f; q = q*r + 0.5f; q = q*r + 1.f;
  return scaled(q*r + 1.f, n); }

FN vf64 k_expm1(vf64 x) {   /* (2^n - 1) + 2^n r, its rounding error `lost`, and 2^n (e^r - 1 - r) */
  vf64 n, low;
  const vf64 y = lower(sel(lt(all(-50.0), x), x, all(-50.0)), all(50.0)), r = reduced_exp(y, n, low);
  const vf64 power = scaled(all(1.0), n), whole = power - 1.0, sum = whole + power*r, lost = (whole - sum) + power*r;
  const vf64 found = sum + (power*(r*r*tail_of_exp(r) + low) + lost);
  return sel(lt(all(50.0), x), k_exp(x) - 1.0, sel(ne(x, x) | eq(x, vf64{}), x, found)); }

FN vf32 k_expm1(vf32 x) {
  const vf32 y = lower(sel(lt(all(-50.f), x), x, all(-50.f)), all(50.f)), n = whole(y*1.44269504f);
  const vf32 high = y - n*0x1.62e0p-1f, part = n*0x1.0bfbe8p-15f, r = high - part, low = (high - r) - part;
  vf32 q = r*(1/5040.f) + 1/720.f;
  q = q*r + 1/120.f; q = q*r + 1/24.f; q = q*r + 1/6.f; q = q*r + 0.5f;
  const vf32 power = scaled(all(1.f), n), less = power - 1.f, sum = less + power*r, lost = (less - sum) + power*r;
  const vf32 found = sum + (power*(r*r*q + low) + lost);
  return sel(lt(all(50.f), x), k_exp(x) - 1.f, sel(ne(x, x) | eq(x, vf32{}), x, found)); }

/* log(m 2^e) + error: m between 3/4 and 3/2, s = (m - 1)/(m + 1), log(m) = 2 (s + s^3/3 + s^5/5 ...) */
FN vf64 series_of_log(vf64 z) {
  vf64 p = z*(2/25.0) + 2/23.0;
  p = p*z + 2/21.0;
  p = p*z + 2/19.0; p = p*z + 2/17.0; p = p*z + 2/15.0; p = p*z + 2/13.0; p = p*z + 2/11.0; p = p*z + 2/9.0;
  p = p*z + 2/7.0; p = p*z + 2/5.0; p = p*z + 2/3.0;
  return p*z; }
FN vf64 log_parts(vf64 m, vf64 e, vf64 error) {
  const vf64 f = m - 1.0, s = f/(m + 1.0), half = 0.5*f*f, p = series_of_log(s*s);
  return e*0x1.62e42feep-1 - ((half - (s*(half + p) + (e*0x1.a39ef35793c76p-33 + error))) - f); }
/* In single precision f - f^2/2 + f^3 p(f), f = m - 1: a division would cost more than the longer polynomial p. It is
   Chebyshev's, with an error of a seventh of a unit in the last place. */
FN vf32 log_parts(vf32 m, vf32 e, vf32 error) {
  const vf32 f = m - 1.f, z = f*f;
  vf32 p = f*0.042871978f - 0.0956134f;
  p = p*f + 0.11680682f; p = p*f - 0.12639311f; p = p*f + 0.14268306f; p = p*f - 0.16660817f; p = p*f + 0.2000014f;
  p = p*f - 0.25000057f; p = p*f + 0.33333334f;
  return e*0x1.62e0p-1f + (((f*z)*p + (e*0x1.0bfbe8p-15f + error) - 0.5f*z) + f); }
/* For 0 and infinity `parted` gives m = 1 and an infinite n, so the logarithm is infinite too. */
FN vf64 k_log(vf64 x) {
  vf64 e;
  const vf64 m = parted(x, e), found = log_parts(m, e, vf64{});
  return sel(le(vf64{}, x), found, all((f64)NAN)); }
FN vf32 k_log(vf32 x) {
  vf32 e;
  const vf32 m = parted(x, e), found = log_parts(m, e, vf32{});
  return sel(le(vf32{}, x), found, all((f32)NAN)); }
FN vf64 k_log1p(vf64 x) {   /* the rounding error of 1 + x is corrected by the derivative, lost/u */
  const vf64 u = 1.0 + x, lost = sel(lt(x, all(1.0)), x - (u - 1.0), 1.0 - (u - x));
  vf64 e;
  const vf64 m = parted(u, e), found = log_parts(m, e, sel(lt(vf64{}, u) & finite(u), lost/u, vf64{}));
  return sel(eq(x, vf64{}), x, sel(le(vf64{}, u), found, all((f64)NAN))); }
FN vf32 k_log1p(vf32 x) {
  const vf32 u = 1.f + x, lost = sel(lt(x, all(1.f)), x - (u - 1.f), 1.f - (u - x));
  vf32 e;
  const vf32 m = parted(u, e), found = log_parts(m, e, sel(lt(vf32{}, u) & finite(u), lost/u, vf32{}));
  return sel(eq(x, vf32{}), x, sel(le(vf32{}, u), found, all((f32)NAN))); }

/* sine and cosine: x = n pi/2 + r; the C library computes large x */
FN vf64 sin_series(vf64 r, vf64 low) {
  const vf64 z = r*r;
  vf64 p = z*(1/355687428096000.0) - 1/1307674368000.0;
  p = p*z + 1/6227020800.0; p = p*z - 1/39916800.0; p = p*z + 1/362880.0; p = p*z - 1/5040.0; p = p*z + 1/120.0;
  return r + ((p*z - 1/6.0)*z*r + low*(1.0 - 0.5*z)); }
FN vf64 cos_series(vf64 r, vf64 low) {
  const vf64 z = r*r, half = 0.5*z, w = 1.0 - half;
  vf64 p = z*(1/20922789888000.0) - 1/87178291200.0;
  p = p*z + 1/479001600.0; p = p*z - 1/3628800.0; p = p*z + 1/40320.0; p = p*z - 1/720.0; p = p*z + 1/24.0;
  return w + (((1.0 - w) - half) + (p*z*z - r*low)); }
FN vf32 sin_series(vf32 r, vf32 low) {
  const vf32 z = r*r;
  vf32 p = z*(1/362880.f) - 1/5040.f;
  p = p*z + 1/120.f;
  return r + ((p*z - 1/6.f)*z*r + low); }
FN vf32 cos_series(vf32 r, vf32 low) {
  const vf32 z = r*r, half = 0.5f*z, w = 1.f - half;
  vf32 p = z*(1/40320.f) - 1/720.f;
  p = p*z + 1/24.f;
  return w + (((1.f - w) - half) + (p*z*z - r*low)); }
FN vf64 quarter(vf64 x, vf64& n, vf64& low) {
  n = whole(x*0.63661977236758134308);
  const vf64 high = x - n*0x1.921fb544p+0, part = n*0x1.0b4611a6p-34, next = high - part;
  const vf64 last = n*0x1.3198a2e037073p-69 - ((high - next) - part), r = next - last;
  low = (next - r) - last;
  return r; }
FN vf32 quarter(vf32 x, vf32& n, vf32& low) {
  n = whole(x*0.636619772f);
  const vf32 high = (x - n*0x1.92p+0f) - n*0x1.fb4p-12f, part = n*0x1.444p-24f, next = high - part;
  const vf32 last = n*0x1.68c234p-39f - ((high - next) - part), r = next - last;
  low = (next - r) - last;
  return r; }
FN vi64 number(vf64 n) { return CAST(vi64, n); }
FN vi32 number(vf32 n) { return CAST(vi32, n); }
template<int shift, class V, class T> FN V turned(V x, T most, T (*library)(T)) {
  const mask large = lt(all(most), size(x)), far = large & finite(x);
  V n, low;
  const V r = quarter(sel(large, V{}, x), n, low);
  const auto k = number(n) + shift;
  const V part = sel(eq(k & 1, k - k), sin_series(r, low), cos_series(r, low));
  V found = sel(eq(k & 2, k - k), part, -part);
  if (__builtin_expect(any(far), 0)) for (int q = 0; q < LANES; q++) if (get(far, q)) found[q] = library(x[q]);
  return sel(large & ~far, x - x, found); }
FN f64 library_sin(f64 x) { return sin(x); }
FN f64 library_cos(f64 x) { return cos(x); }
FN f32 library_sin(f32 x) { return sinf(x); }
FN f32 library_cos(f32 x) { return cosf(x); }
FN vf64 k_sin(vf64 x) { return sel(eq(x, vf64{}), x, turned<0, vf64, f64>(x, 1e5, library_sin)); }
FN vf64 k_cos(vf64 x) { return turned<1, vf64, f64>(x, 1e5, library_cos); }
FN vf32 k_sin(vf32 x) { return sel(eq(x, vf32{}), x, turned<0, vf32, f32>(x, 8e3f, library_sin)); }
FN vf32 k_cos(vf32 x) { return turned<1, vf32, f32>(x, 8e3f, library_cos); }

/* tanh(x) = t/(t + 2), t = e^(2|x|) - 1 */
FN vf64 k_tanh(vf64 x) {
  const vf64 y = lower(size(x), all(22.0)), t = k_expm1(2.0*y);
  const vf64 found = sel(lt(y, all(0.5)), t/(t + 2.0), 1.0 - 2.0/(t + 2.0));
  return sel(ne(x, x), x, (vf64)((vu64)found | ((vu64)x & 0x8000000000000000ull))); }
FN vf32 k_tanh(vf32 x) {
  const vf32 y = lower(size(x), all(10.f)), t = k_expm1(2.f*y);
  const vf32 found = sel(lt(y, all(0.5f)), t/(t + 2.f), 1.f - 2.f/(t + 2.f));
  return sel(ne(x, x), x, (vf32)((vu32)found | ((vu32)x & 0x80000000u))); }

/* atan(x) = atan(c) + atan((x - c)/(1 + c x)) with c = 0, 1/2, 1, 3/2 or infinity: no quotient exceeds 7/16. There a
   Chebyshev polynomial of the square has an error of 4e-18, in single precision of 6e-9. */
FN vf64 k_atan(vf64 x) {
  const vf64 y = size(x);
  vf64 top = y, bottom = all(1.0), high = vf64{}, low = vf64{};
#define BEYOND(limit, a, b, h, l) { const mask m = lt(all(limit), y); \
  top = sel(m, a, top); bottom = sel(m, b, bottom); high = sel(m, all(h), high); low = sel(m, all(l), low); }
  BEYOND(7/16.0, y - 0.5, 1.0 + 0.5*y, 0x1.dac670561bb4fp-2, 0x1.a2b7f222f65e2p-56)
  BEYOND(11/16.0, y - 1.0, y + 1.0, 0x1.921fb54442d18p-1, 0x1.1a62633145c07p-55)
  BEYOND(19/16.0, y - 1.5, 1.0 + 1.5*y, 0x1.f730bd281f69bp-1, 0x1.007887af0cbbdp-56)
  BEYOND(39/16.0, all(-1.0), y, 0x1.921fb54442d18p+0, 0x1.1a62633145c07p-54)
#undef BEYOND
  const vf64 t = top/bottom, z = t*t;
  vf64 p = z*0.014773184616983805334 - 0.033128134256069583238;
  p = p*z + 0.044922592931936561876; p = p*z - 0.052166797393136561936; p = p*z + 0.058769464567550611842;
  p = p*z - 0.066662419233599635451; p = p*z + 0.076922855548892857769; p = p*z - 0.090909083556025927138;
  p = p*z + 0.11111111096645037124; p = p*z - 0.14285714285566806143; p = p*z + 0.19999999999999409627;
  p = p*z - 0.33333333333333332941;
  const vf64 found = high + (t + (p*z*t + low));
  return sel(ne(x, x), x, (vf64)((vu64)found | ((vu64)x & 0x8000000000000000ull))); }
FN vf32 k_atan(vf32 x) {
  const vf32 y = size(x);
  vf32 top = y, bottom = all(1.f), high = vf32{}, low = vf32{};
#define BEYOND(limit, a, b, h, l) { const mask m = lt(all(limit), y); \
  top = sel(m, a, top); bottom = sel(m, b, bottom); high = sel(m, all(h), high); low = sel(m, all(l), low); }
  BEYOND(7/16.f, y - 0.5f, 1.f + 0.5f*y, 0x1.dac670p-2f, 0x1.586ed4p-28f)
  BEYOND(11/16.f, y - 1.f, y + 1.f, 0x1.921fb6p-1f, -0x1.777a5cp-26f)
  BEYOND(19/16.f, y - 1.5f, 1.f + 1.5f*y, 0x1.f730bep-1f, -0x1.afc12cp-26f)
  BEYOND(39/16.f, all(-1.f), y, 0x1.921fb6p+0f, -0x1.777a5cp-25f)
#undef BEYOND
  const vf32 t = top/bottom, z = t*t;
  vf32 p = z*-0.062135886f + 0.10667636f;
  p = p*z - 0.14256498f; p = p*z + 0.19999312f; p = p*z - 0.33333331f;
  const vf32 found = high + (t + (p*z*t + low));
  return sel(ne(x, x), x, (vf32)((vu32)found | ((vu32)x & 0x80000000u))); }

/* rare functions, one lane after the other by the C library */
ALONE(k_tan, tan) ALONE(k_asin, asin) ALONE(k_acos, acos) ALONE(k_sinh, sinh) ALONE(k_cosh, cosh)
IN_PAIRS(k_atan2, atan2) IN_PAIRS(k_pow, pow)
