// Several intervals at once, each stored as (-low, high), computed in upward rounding only.
//
// In upward rounding fl(a op b) >= a op b for +, * and /. So a sum or a product of upper bounds is an upper bound, and
// -low is an upper bound of minus the number. No operation here subtracts a bound from a bound of the same side. No
// function of the C library is trusted: exp, sin, cos and atan are series with a remainder, and log is verified by exp.
//
// Compile with -frounding-math -ffp-contract=off. Every computation lives in the scope of an `Upward`.
#pragma once
#include <cfenv>
#include <cmath>
#include <cstdint>
#include <cstring>
#if defined(__SSE2__)
#include <immintrin.h>
#endif

#define INLINE inline __attribute__((always_inline))

// As many lanes as a register has: gcc computes comparisons of longer vectors one number after the other.
#if defined(__AVX512F__)
constexpr int LANES = 8;
#elif defined(__AVX__)
constexpr int LANES = 4;
#else
constexpr int LANES = 2;
#endif
typedef double V __attribute__((vector_size(8 * LANES)));
typedef long long M __attribute__((vector_size(8 * LANES)));  // a mask: 0 or -1 in each lane

INLINE V fill(double x) { V v; for (int i = 0; i < LANES; i++) v[i] = x; return v; }
INLINE M mask(bool on) { M m; for (int i = 0; i < LANES; i++) m[i] = on ? -1 : 0; return m; }
// a > b ? a : b, which is what the instruction computes, also for NaN.
INLINE V vmax(V a, V b) {
#if defined(__AVX512F__)
  return (V)_mm512_max_pd((__m512d)a, (__m512d)b);
#elif defined(__AVX__)
  return (V)_mm256_max_pd((__m256d)a, (__m256d)b);
#else
  return a > b ? a : b;
#endif
}
INLINE V vmin(V a, V b) { return -vmax(-a, -b); }
INLINE V vabs(V a) { return vmax(a, -a); }
inline bool all(M m) { long long x = -1; for (int i = 0; i < LANES; i++) x &= m[i]; return x != 0; }
inline bool any(M m) { long long x = 0; for (int i = 0; i < LANES; i++) x |= m[i]; return x != 0; }
inline double largest(V a) { double x = a[0]; for (int i = 1; i < LANES; i++) x = a[i] > x ? a[i] : x; return x; }
inline double least(V a) { double x = a[0]; for (int i = 1; i < LANES; i++) x = a[i] < x ? a[i] : x; return x; }
// Upward rounding, with numbers below 1e-308 kept, as long as it lives.
struct Upward {
  std::fenv_t before;
  Upward() {
    std::fegetenv(&before);
    std::fesetround(FE_UPWARD);
#if defined(__SSE2__)
    _mm_setcsr(_mm_getcsr() & ~0x8040u);
#endif
  }
  ~Upward() { std::fesetenv(&before); }
};

struct I {
  V n, h;  // -low, high
  I() = default;
  I(V n, V h) : n(n), h(h) {}
  explicit I(double x) : n(fill(-x)), h(fill(x)) {}
  V low() const { return -n; }
  V mid() const { return 0.5 * (h - n); }  // near the middle: a guess, not a bound
  V mag() const { return vmax(n, h); }     // max |x|
  V width() const { return h + n; }        // an upper bound of the width
};
INLINE I point(V x) { return {-x, x}; }
INLINE I span(V low, V high) { return {-low, high}; }
INLINE I symmetric(V r) { return {r, r}; }
INLINE I operator-(I a) { return {a.h, a.n}; }
INLINE I operator+(I a, I b) { return {a.n + b.n, a.h + b.h}; }
INLINE I operator-(I a, I b) { return {a.n + b.h, a.h + b.n}; }
INLINE I operator*(I a, I b) {
  V ma = -a.n, mb = -b.n, mh = -a.h;
  return {vmax(vmax(a.n * mb, mh * b.h), vmax(a.n * b.h, a.h * b.n)),
          vmax(vmax(a.n * b.n, a.h * b.h), vmax(ma * b.h, a.h * mb))};
}
INLINE I scaled(I a, double k) { return k >= 0 ? I(a.n * k, a.h * k) : I(a.h * -k, a.n * -k); }
INLINE I hull(I a, I b) { return {vmax(a.n, b.n), vmax(a.h, b.h)}; }
INLINE I meet(I a, I b) { return {vmin(a.n, b.n), vmin(a.h, b.h)}; }
INLINE M inside(I a, I b) { return (a.n <= b.n) & (a.h <= b.h); }
INLINE M empty(I a) { return (-a.n) > a.h; }
INLINE I pick(M m, I a, I b) { return {m ? a.n : b.n, m ? a.h : b.h}; }

// 1/a. A lane whose interval has 0 is `none`, and its result is 1.
inline I inverse(I a, M& none) {
  M fine = (a.n < 0) | (a.h < 0);
  none |= ~fine;
  V low = fine ? -a.n : fill(1.0), high = fine ? a.h : fill(1.0);
  return {fill(-1.0) / high, fill(1.0) / low};
}
inline I inverse(I a) { M none{}; return inverse(a, none); }  // of an interval known to have no 0
inline I clamped(I x, I low, I high) {
  return {vmin(low.n, vmax(x.n, high.n)), vmin(high.h, vmax(x.h, low.h))};
}

inline const I* inverses() {
  static thread_local I table[32];
  static thread_local bool made = false;
  if (!made) { for (int k = 1; k < 32; k++) table[k] = inverse(I((double)k)); made = true; }  // in upward rounding
  return table;
}
inline I over(int k) { return k < 32 ? inverses()[k] : inverse(I((double)k)); }
// exp of points, |x| < 700: exp(x) = 2^n exp(y), |y| < 0.7, by a Taylor sum with its remainder.
inline I exp_at(V x) {
  const double ln2 = 0x1.62e42fefa39efp-1;  // log(2) is in ln2 + [2.3190e-17, 2.3191e-17]
  V shifted = x / ln2 + fill(0x1.8p52);      // its last bits are the integer n, above or near x/ln2
  V n = shifted - fill(0x1.8p52), two = (V)(((M)shifted + 1023) << 52);
  I y = point(x) - point(n) * (I(ln2) + span(fill(2.3190e-17), fill(2.3191e-17))), sum(1.0), term(1.0);
  for (int k = 1; k <= 16; k++) term = term * y * inverses()[k], sum = sum + term;
  sum = sum + symmetric(term.mag());  // the rest is below the last term
  return {sum.n * two, sum.h * two};
}
// exp of every number of an interval, in the lanes where |x| < 700; the others are `none`.
inline I exp_of(I x, M& none) {
  M fine = (x.n < 700.0) & (x.h < 700.0);
  none |= ~fine;
  V low = fine ? -x.n : fill(0.0), high = fine ? x.h : fill(0.0);
  return {exp_at(low).n, exp_at(high).h};
}
// log of an interval above 0: guessed, then proved by exp at both guesses.
inline I log_of(I x, M& none) {
  M fine = (x.n < -1e-300) & (x.h < 1e300);
  none |= ~fine;
  V low = fine ? -x.n : fill(1.0), high = fine ? x.h : fill(1.0), gl, gh;
  for (int i = 0; i < LANES; i++) gl[i] = std::log(low[i]), gh[i] = std::log(high[i]);
  I r(0.0);
  M open = mask(true);
  for (double e = 4e-15; e < 1e-6; e *= 8) {
    V l = gl - (vabs(gl) + 1.0) * e, h = gh + (vabs(gh) + 1.0) * e;
    M ok = open & (exp_at(l).h <= low) & (-exp_at(h).n >= high);
    r = pick(ok, span(l, h), r);
    open &= ~ok;
    if (!any(open)) return r;
  }
  none |= open;
  return r;
}
// sin and cos of an interval, |x| < 1e4: by the mean value from the middle.
inline void sin_cos_at(V x, I& s, I& c) {
  const double quarter = 1.5707963267948966;  // pi/2 is in quarter + [6.1232e-17, 6.1233e-17]
  V n;
  for (int i = 0; i < LANES; i++) n[i] = std::floor(x[i] / quarter + 0.5);
  I y = point(x) - point(n) * (I(quarter) + span(fill(6.1232e-17), fill(6.1233e-17)));  // |y| < 0.8
  I term(1.0);
  s = y, c = I(1.0);
  for (int k = 1; k <= 20; k++) {
    term = (k == 1 ? y : term) * y * over(k + 1);
    I signed_ = ((k + 1) / 2) % 2 ? -term : term;
    if (k % 2) c = c + signed_; else s = s + signed_;
  }
  I rest = symmetric(term.mag());
  s = s + rest, c = c + rest;
  I s0 = s, c0 = c;
  for (int i = 0; i < LANES; i++) {
    long q = ((long)n[i] % 4 + 4) % 4;
    auto set = [&](I& to, I from, bool minus) { to.n[i] = minus ? from.h[i] : from.n[i], to.h[i] = minus ? from.n[i] : from.h[i]; };
    if (q == 0) set(s, s0, false), set(c, c0, false);
    if (q == 1) set(s, c0, false), set(c, s0, true);
    if (q == 2) set(s, s0, true), set(c, c0, true);
    if (q == 3) set(s, c0, true), set(c, s0, false);
  }
}
inline void sin_cos(I x, I& s, I& c, M& none) {
  M fine = (x.n < 1e4) & (x.h < 1e4);
  none |= ~fine;
  V m = fine ? x.mid() : fill(0.0);
  I off = pick(fine, x - point(m), I(0.0)), r = symmetric(off.mag()), one = span(fill(-1.0), fill(1.0)), sm, cm;
  sin_cos_at(m, sm, cm);
  s = meet(sm + meet(cm + r, one) * off, one), c = meet(cm - meet(sm + r, one) * off, one);
}
inline I root_at(V x) {  // sqrt(x), x >= 1: guessed, then proved by its square
  V low, high;
  for (int i = 0; i < LANES; i++) low[i] = high[i] = std::sqrt(x[i]);
  low = low * (1 - 1e-15), high = high * (1 + 1e-15);
  M ok = ((point(low) * point(low)).h <= x) & (-(point(high) * point(high)).n >= x);
  return {ok ? -low : fill(0.0), ok ? high : x};
}
inline I atan_at(V x) {  // |x| <= 1e8: atan(x) = 4 atan(y), y = x/(1 + sqrt(1 + x^2)) twice, then a series
  I y = point(x);
  for (int i = 0; i < 2; i++) {
    I u = I(1.0) + y * y;
    I root{root_at(u.low()).n, root_at(u.h).h};
    y = y * inverse(I(1.0) + root);
  }
  I y2 = y * y, sum = y, term = y;  // |y| <= tan(pi/8) < 0.4143
  for (int k = 1; k <= 22; k++) {
    term = -(term * y2);
    sum = sum + term * over(2 * k + 1);
  }
  return scaled(sum + symmetric(term.mag()), 4);
}
inline I atan_of(I x, M& none) {
  M fine = (x.n < 1e8) & (x.h < 1e8);
  none |= ~fine;
  return {atan_at(fine ? -x.n : fill(0.0)).n, atan_at(fine ? x.h : fill(0.0)).h};
}
// max(x, 0)^e for e > 0: 0 where x is negative, as the operation means it.
inline I power_of(I x, I e, M& none) {
  M fine = e.n < 0;
  none |= ~fine;
  V low = vmax(-x.n, fill(0.0)), high = vmax(x.h, fill(0.0));
  M tiny_low = (low <= 1e-290) | ~fine, tiny_high = (high <= 1e-290) | ~fine;
  M bad{};
  // A lane without logarithms gets those of 1. Below exp(-690) the power counts as [0, exp(-690)].
  I logs = log_of(span(tiny_low ? (tiny_high ? fill(1.0) : high) : low, tiny_high ? fill(1.0) : high), bad) * e;
  M small = logs.low() < -690;
  I found = exp_of(span(vmax(logs.low(), fill(-690.0)), vmax(logs.h, fill(-690.0))), bad);
  none |= bad;
  V tiny = fill(0.0);  // of a number below 1e-290: at most the power of 1e-290
  if (any(tiny_high & (high > 0))) tiny = exp_at(vmax((log_of(I(1e-290), bad) * e).h, fill(-690.0))).h;
  return {(tiny_low | small) ? fill(0.0) : found.n, tiny_high ? (high == 0 ? fill(0.0) : tiny) : found.h};
}
