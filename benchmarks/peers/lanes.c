/* The problem of problem.py by hand: RK4 whose last rates are the first of the next step, in blocks of lanes, every lane
   its own step. REAL is float or double; constants come from problem.py by -D.

   adaptive   error: that of the embedded third-order formula in x1, h (k5 - k4)/2; a step ends where the torque is
              predicted to meet a limit; no step exceeds half the limit of stability, which goes as the root of the speed
   fixed      all steps equal

   Distance, IAE and peak come from the cubic through values and rates at both ends of a step, and so does the stop. */
#include <math.h>
#include <tgmath.h>

typedef REAL R;
#define LANES 64
#define INLINE static inline __attribute__((always_inline))
#define ARRAY(name) R name[LANES] __attribute__((aligned(64)))
enum { FIXED, ADAPTIVE };

typedef struct {
  ARRAY(mass); ARRAY(hold); ARRAY(body); ARRAY(wheel); ARRAY(x1);  /* parameters; the state */
  ARRAY(body_rate); ARRAY(wheel_rate); ARRAY(error); ARRAY(slip); ARRAY(slip_rate); ARRAY(torque);
  ARRAY(t); ARRAY(h); ARRAY(over);
  ARRAY(time); ARRAY(distance); ARRAY(peak); ARRAY(iae);  /* what is asked for */
} Block;

typedef struct { R body, wheel, error, slip, speed_inverse, torque; } Rates;
typedef struct { R tolerance, longest, least; } Steps;

INLINE R least(R a, R b) { return a < b ? a : b; }
INLINE R most(R a, R b) { return a > b ? a : b; }
INLINE R size(R a) { return a < 0 ? -a : a; }

INLINE R friction(R s) {
  R power = exp((R)P * log(s));
  return (R)W4 * power / ((R)A + power) + (((R)W3 * s + (R)W2) * s + (R)W1) * s;
}

INLINE Rates rates(R mass, R hold, R body, R wheel, R x1) {
  Rates k;
  k.speed_inverse = 1 / ((R)R2 * body);
  k.slip = 1 - (R)R1 * wheel * k.speed_inverse;
  k.error = k.slip - (R)SLIP;
  k.torque = hold + (R)K1 * x1 + (R)K2 * k.error;
  R mu = friction(least(most(k.slip, (R)1e-6), (R)1));
  k.body = (R)(-2 * G / R2) * mu;
  k.wheel = mass * (R)(G * R1 / J1) * mu - least(most(k.torque, (R)0), (R)U) * (R)(1 / J1);
  return k;
}

INLINE R slip_rate(Rates k) { return (-(R)R1 * k.wheel + (1 - k.slip) * (R)R2 * k.body) * k.speed_inverse; }

/* What a cubic gains in the part z of its interval: its whole gain, and its rates at both ends times the interval. */
INLINE R gained(R z, R whole, R first, R last) {
  return z * z * ((3 - 2 * z) * whole - (1 - z) * last) + z * (1 - z) * (1 - z) * first;
}

/* The step that ends where the torque is predicted to meet a limit; two halves where that is little beyond it. */
INLINE R to_limit(R h, R torque, R rate, R shortest) {
  R gap = rate > 0 ? (torque < 0 ? -torque : (R)U - torque) : (torque > (R)U ? torque - (R)U : torque);
  R ahead = gap / (size(rate) + (R)1e-20);
  R tried = ahead >= h && ahead < (R)1.2 * h ? (R)0.6 * h : h;
  return ahead > (R)1e-6 && ahead < h ? most(ahead, shortest) : tried;
}

/* One step of every lane of a block; how many still run. */
INLINE R step(const int method, Block *restrict b, const Steps steps) {
  R running = 0;
#pragma GCC ivdep
  for (int i = 0; i < LANES; i++) {
    R m = b->mass[i], hold = b->hold[i], y2 = b->body[i], y1 = b->wheel[i], y3 = b->x1[i];
    R a2 = b->body_rate[i], a1 = b->wheel_rate[i], a3 = b->error[i], s0 = b->slip[i], r0 = b->slip_rate[i];
    R h = b->h[i];
    if (method == ADAPTIVE) h = to_limit(h, b->torque[i], (R)K1 * a3 + (R)K2 * r0, steps.least);
    R half = (R)0.5 * h, sixth = h * (R)(1.0 / 6);
    Rates k2 = rates(m, hold, y2 + half * a2, y1 + half * a1, y3 + half * a3);
    Rates k3 = rates(m, hold, y2 + half * k2.body, y1 + half * k2.wheel, y3 + half * k2.error);
    Rates k4 = rates(m, hold, y2 + h * k3.body, y1 + h * k3.wheel, y3 + h * k3.error);
    R n2 = y2 + sixth * (a2 + 2 * (k2.body + k3.body) + k4.body);
    R n1 = y1 + sixth * (a1 + 2 * (k2.wheel + k3.wheel) + k4.wheel);
    R n3 = y3 + sixth * (a3 + 2 * (k2.error + k3.error) + k4.error);
    Rates k5 = rates(m, hold, n2, n1, n3);
    R s1 = k5.slip, r1 = slip_rate(k5), accepted = 1;
    if (method == ADAPTIVE) {
      R excess = size(k5.error - k4.error) * ((R)0.5 / steps.tolerance);
      R factor = least(most((R)0.85 / sqrt(sqrt(excess + (R)1e-4)), (R)0.25), (R)2.5);
      accepted = excess > 1 && h > steps.least ? (R)0 : (R)1;
      R next = accepted > 0 && h < b->h[i] ? most(h * factor, b->h[i]) : h * factor; /* cut short, but not too long */
      b->h[i] = most(least(next, steps.longest * sqrt(n2 * (R)(R2 * 0.72))), steps.least);
    }
    R keep = b->over[i] > 0 ? (R)0 : accepted;
    R v0 = (R)R2 * y2, v1 = (R)R2 * n2, d0 = (R)R2 * a2, d1 = (R)R2 * k5.body, x = n3 - y3;
    R stops = v1 <= (R)STOP ? keep : (R)0, per = 1 / (v0 - v1 + (R)1e-30);
    R z = (v0 - (R)STOP) * per;
    z = stops > 0 ? z - (d1 - d0) * half * z * (1 - z) * per : (R)1;
    R part = h * z, end = stops > 0 ? (R)STOP : v1, gain = stops > 0 ? gained(z, x, h * a3, h * k5.error) : x;
    R way = part * (R)0.5 * (v0 + end) + part * part * (R)(1.0 / 12) * (z * (d0 - d1));
    R zero = least(most(a3 / (a3 - k5.error + (R)1e-30), (R)0), (R)1), turn = gained(zero, x, h * a3, h * k5.error);
    R area = a3 * (a3 + z * (k5.error - a3)) < 0 ? size(turn) + size(gain - turn) : size(gain);
    R top = least(most(r0 / (r0 - r1 + (R)1e-30), (R)0), (R)1);
    R peak = r0 > 0 && r1 <= 0 ? most(s0 + gained(top, s1 - s0, h * r0, h * r1), s1) : s1;
    int on = keep > 0;
    b->peak[i] = on ? most(b->peak[i], peak) : b->peak[i];
    b->distance[i] += on ? way : (R)0;
    b->iae[i] += on ? area : (R)0;
    b->time[i] = on ? b->t[i] + part : b->time[i];
    b->t[i] += on ? h : (R)0;
    b->body[i] = on ? n2 : y2, b->wheel[i] = on ? n1 : y1, b->x1[i] = on ? n3 : y3;
    b->body_rate[i] = on ? k5.body : a2, b->wheel_rate[i] = on ? k5.wheel : a1, b->error[i] = on ? k5.error : a3;
    b->slip[i] = on ? s1 : s0, b->slip_rate[i] = on ? r1 : r0, b->torque[i] = on ? k5.torque : b->torque[i];
    b->over[i] = stops > 0 ? (R)1 : b->over[i];
    running += b->over[i] > 0 ? (R)0 : (R)1;
  }
  return running;
}

INLINE void begin(Block *b, int i, R mass, R hold, R speed, R h) {
  b->mass[i] = mass, b->hold[i] = hold, b->body[i] = speed / (R)R2, b->wheel[i] = speed / (R)R1, b->h[i] = h;
  b->x1[i] = b->t[i] = b->over[i] = b->time[i] = b->distance[i] = b->peak[i] = b->iae[i] = 0;
  Rates k = rates(mass, hold, b->body[i], b->wheel[i], (R)0);
  b->body_rate[i] = k.body, b->wheel_rate[i] = k.wheel, b->error[i] = k.error, b->torque[i] = k.torque;
  b->slip[i] = k.slip, b->slip_rate[i] = slip_rate(k);
}

/* count lanes: mass, hold, speed (count,) -> out (4, count). Returns the attempted steps of all blocks. */
long run(int method, int count, const R *mass, const R *hold, const R *speed, double first, double tolerance,
         double longest, double shortest, long limit, R *out) {
  long total = 0;
  const Steps steps = {tolerance, longest, shortest};
#pragma omp parallel for schedule(dynamic, 1) reduction(+ : total)
  for (int at = 0; at < count; at += LANES) {
    Block b;
    for (int i = 0; i < LANES; i++) {
      int j = at + i < count ? at + i : count - 1;
      begin(&b, i, mass[j], hold[j], speed[j], first);
    }
    long n = 0;
    if (method == ADAPTIVE) while (n++ < limit && step(ADAPTIVE, &b, steps) > 0) {}
    else while (n++ < limit && step(FIXED, &b, steps) > 0) {}
    total += n;
    for (int i = 0; i < LANES && at + i < count; i++) {
      int j = at + i;
      out[j] = b.time[i], out[count + j] = b.distance[i], out[2 * count + j] = b.peak[i], out[3 * count + j] = b.iae[i];
    }
  }
  return total;
}
