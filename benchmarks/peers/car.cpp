// The car of diffabs/parts/plants/car.py by hand, for bench_car.py: four wheels on Burckhardt's curve, the loads by two
// linear equations, a PID on the slip of each wheel, a driver who holds the line of the start. WIDTH lanes are one
// vector; -ffast-math gives it vector forms of exp, expm1, sine and cosine too. Tyres are proportional and all wheels
// stay loaded. REAL (float or double), the constants and Tsitouras' tableau (A21 to E7) come before this text.
//
// Equal steps of the classical Runge-Kutta method; or Tsitouras' method of order 5(4), with a step and an error of its
// own in every lane, and Hairer's PI control. Lanes of a vector wait for its last one. Steps do not end on kinks.
#include <algorithm>
#include <cmath>
#include <thread>
#include <vector>

static const int WIDTH = 64/sizeof(REAL);
typedef REAL V __attribute__((vector_size(64)));
#define INLINE static inline __attribute__((always_inline))
#define EACH for (int i = 0; i < WIDTH; i++)

#define OF_EACH(name) INLINE V each_##name(V x) { V y; EACH y[i] = std::name(x[i]); return y; }
OF_EACH(exp) OF_EACH(expm1) OF_EACH(sin) OF_EACH(cos) OF_EACH(sqrt) OF_EACH(log)
INLINE V all(REAL x) { return V{} + x; }
INLINE V most(V x, V y) { return x > y ? x : y; }
INLINE V clamp(V x, REAL low, REAL high) { return most(x < all(high) ? x : all(high), all(low)); }

// w: spins; s: filtered target slips; e: integrals of the errors; front left, front right, rear left, rear right.
#define FIELDS(F) F(x) F(y) F(yaw) F(u) F(v) F(r) F(steer) \
  F(w1) F(w2) F(w3) F(w4) F(s1) F(s2) F(s3) F(s4) F(e1) F(e2) F(e3) F(e4)
#define DECLARE(name) V name;
struct State { FIELDS(DECLARE) };
struct Wheel { V slip, own, braking, lateral; };  // frictions: braking in its own axes; both in the car's axes

INLINE Wheel wheel(const V along, const V across, const V spin, const V speed,
                   const REAL c1, const REAL c2, const REAL c3) {
  const V rim = RADIUS*spin, slip = (along - rim) / most(most(along, rim), all(CRAWL));
  const V tangent = across / most(along, all(CRAWL)), cosine = 1 / each_sqrt(1 + tangent*tangent);
  const V sx = slip*cosine, sy = tangent*cosine, s = each_sqrt(most(sx*sx + sy*sy, all(1e-16)));
  const V friction = (-c1*each_expm1(-c2*s) - c3*s) * each_exp(-C4*s*speed) / s;
  return {slip, friction*sx, friction*sx, -friction*sy};
}

INLINE Wheel turned(Wheel k, V cosine, V sine) {
  return {k.slip, k.own, k.own*cosine + k.lateral*sine, k.lateral*cosine - k.own*sine};
}

INLINE V spin_rate(V spin, V load, const Wheel& k, V error, V integral, REAL inertia) {
  const V rate = (RADIUS*load*k.own - clamp(KP*error + KI*integral, 0, TORQUE)) / inertia;
  return spin > all(0) ? rate : most(rate, all(0));
}

INLINE State rates(const State& q, const V mass) {
  const V sine = each_sin(q.yaw), cosine = each_cos(q.yaw);
  const V steer_sine = each_sin(q.steer), steer_cosine = each_cos(q.steer);
  const V speed = each_sqrt(q.u*q.u + q.v*q.v);
  const V front = q.v + q.r*TO_FRONT, rear = q.v - q.r*TO_REAR;
  const V left = q.u - q.r*(FRONT_TRACK/2), right = q.u + q.r*(FRONT_TRACK/2);
#define FRONT(along, spin, road) turned(wheel(along*steer_cosine + front*steer_sine, \
    front*steer_cosine - along*steer_sine, spin, speed, road), steer_cosine, steer_sine)
  const Wheel k1 = FRONT(left, q.w1, LEFT), k2 = FRONT(right, q.w2, RIGHT);
  const Wheel k3 = wheel(q.u - q.r*(REAR_TRACK/2), rear, q.w3, speed, LEFT);
  const Wheel k4 = wheel(q.u + q.r*(REAR_TRACK/2), rear, q.w4, speed, RIGHT);

  // Load of a wheel: its weight, and what X and Y add. X = rolling + sum of load times braking, Y = that of lateral.
  const REAL bases = 2*(TO_FRONT + TO_REAR);
  const V weight_front = mass*(GRAVITY*TO_REAR/bases), weight_rear = mass*(GRAVITY*TO_FRONT/bases);
  const V rolling = mass*(ROLLING*GRAVITY);
  const REAL pitch = HEIGHT/bases, roll_front = ROLL*HEIGHT/FRONT_TRACK, roll_rear = (1 - ROLL)*HEIGHT/REAR_TRACK;
#define SOLVED(force, still, by_x, by_y) \
  const V still = weight_front*(k1.force + k2.force) + weight_rear*(k3.force + k4.force); \
  const V by_x = pitch*((k1.force + k2.force) - (k3.force + k4.force)); \
  const V by_y = roll_front*(k2.force - k1.force) + roll_rear*(k4.force - k3.force);
  SOLVED(braking, f, fx, fy)
  SOLVED(lateral, g, gx, gy)
  const V inverse = 1 / ((1 - fx)*(1 - gy) - fy*gx);
  const V X = ((f + rolling)*(1 - gy) + fy*g)*inverse, Y = ((1 - fx)*g + gx*(f + rolling))*inverse;
  const V n1 = weight_front + pitch*X - roll_front*Y, n2 = weight_front + pitch*X + roll_front*Y;
  const V n3 = weight_rear - pitch*X - roll_rear*Y, n4 = weight_rear - pitch*X + roll_rear*Y;

  const V moment = TO_FRONT*(n1*k1.lateral + n2*k2.lateral) - TO_REAR*(n3*k3.lateral + n4*k4.lateral)
    + FRONT_TRACK/2*(n1*k1.braking - n2*k2.braking) + REAR_TRACK/2*(n3*k3.braking - n4*k4.braking);
  const V e1 = q.s1 - k1.slip, e2 = q.s2 - k2.slip, e3 = q.s3 - k3.slip, e4 = q.s4 - k4.slip;
  const V ahead = GAIN*(q.y + PREVIEW*sine), per_mass = 1/mass;
  return {
    q.u*cosine - q.v*sine, q.u*sine + q.v*cosine, q.r,
    q.r*q.v - (X + DRAG*q.u*q.u)*per_mass, Y*per_mass - q.r*q.u, moment/YAW_INERTIA,
    (-clamp(ahead, -FULL, FULL) - q.steer)/LAG,
    spin_rate(q.w1, n1, k1, e1, q.e1, FRONT_INERTIA), spin_rate(q.w2, n2, k2, e2, q.e2, FRONT_INERTIA),
    spin_rate(q.w3, n3, k3, e3, q.e3, REAR_INERTIA), spin_rate(q.w4, n4, k4, e4, q.e4, REAR_INERTIA),
    (SLIP - q.s1)/FILTER, (SLIP - q.s2)/FILTER, (SLIP - q.s3)/FILTER, (SLIP - q.s4)/FILTER, e1, e2, e3, e4};
}

INLINE State step(const State& q, const V mass, const REAL h) {
  State k = rates(q, mass), sum = k, z;
#define NEXT(name) z.name = q.name + far*k.name;
#define TWICE(name) sum.name += 2*k.name;
#define ENDED(name) z.name = q.name + h/6*(sum.name + k.name);
  REAL far = h/2;
  FIELDS(NEXT) k = rates(z, mass); FIELDS(TWICE)
  FIELDS(NEXT) k = rates(z, mass); FIELDS(TWICE)
  far = h;
  FIELDS(NEXT) k = rates(z, mass); FIELDS(ENDED)
  return z;
}

static const REAL FLOOR = 0.1;  // of the size of a state, below which its error is absolute

// One step of each lane with its own length h; `slope` has the rates at q, then those at its end. Returns the error.
INLINE V try_step(State& q, State& slope, const V mass, const V h) {
  const State k1 = slope, begin = q;
#define STAGE(name) q.name = begin.name + h*SUM(name);
#define SUM(f) (A21*k1.f)
  FIELDS(STAGE) const State k2 = rates(q, mass);
#undef SUM
#define SUM(f) (A31*k1.f + A32*k2.f)
  FIELDS(STAGE) const State k3 = rates(q, mass);
#undef SUM
#define SUM(f) (A41*k1.f + A42*k2.f + A43*k3.f)
  FIELDS(STAGE) const State k4 = rates(q, mass);
#undef SUM
#define SUM(f) (A51*k1.f + A52*k2.f + A53*k3.f + A54*k4.f)
  FIELDS(STAGE) const State k5 = rates(q, mass);
#undef SUM
#define SUM(f) (A61*k1.f + A62*k2.f + A63*k3.f + A64*k4.f + A65*k5.f)
  FIELDS(STAGE) const State k6 = rates(q, mass);
#undef SUM
#define SUM(f) (A71*k1.f + A72*k2.f + A73*k3.f + A74*k4.f + A75*k5.f + A76*k6.f)
  FIELDS(STAGE) slope = rates(q, mass);
  V error = {};
#define SIZE(x) most(x, -(x))
#define SCALED(f) { const V part = (E1*k1.f + E2*k2.f + E3*k3.f + E4*k4.f + E5*k5.f + E6*k6.f + E7*slope.f) \
    / (FLOOR + most(SIZE(begin.f), SIZE(q.f))); error += part*part; }
  FIELDS(SCALED)
#define COUNTED(f) + 1
  return h*each_sqrt(error/(0 FIELDS(COUNTED)));
}

INLINE V power(V x, REAL exponent) { return each_exp(exponent*each_log(x)); }

INLINE long adaptive(State& q, const V mass, const REAL duration, const REAL tolerance) {
  V left = all(duration), h = all(1e-4), before = all(1e-4);
  State slope = rates(q, mass);
  for (long tried = 1; ; tried++) {
    State next = q, end = slope;
    const V error = most(try_step(next, end, mass, h)/tolerance, all(1e-8));
    const auto good = error <= all(1);
#define KEEP(f) q.f = good ? next.f : q.f; slope.f = good ? end.f : slope.f;
    FIELDS(KEEP)
    left = good ? left - h : left;
    V factor = REAL(0.9)*power(error, -0.17)*power(before, 0.04);
    factor = good ? clamp(factor, 0.2, 10) : clamp(factor, 0.2, 1);
    before = good ? most(error, all(1e-4)) : before;
    h = h*factor < left ? h*factor : left;
    bool busy = false;
    EACH busy |= left[i] > 0;
    if (!busy) return tried;
  }
}

// out: x, y, yaw and speed of all lanes. setting: a step [s], or with `adapts` a tolerance. Returns the steps tried of
// all vectors.
extern "C" long run(long count, const REAL* mass, const REAL* speed, int adapts, double duration, double setting,
                    int threads, REAL* out) {
  std::vector<long> tried(threads, 0);
  auto work = [&](int number) {
    for (long first = long(number)*WIDTH; first < count; first += long(threads)*WIDTH) {
      State q = {};
      V m;
      EACH {
        const long at = std::min(first + i, count - 1);
        m[i] = mass[at], q.u[i] = speed[at];
      }
      q.w1 = q.w2 = q.w3 = q.w4 = q.u/RADIUS;
      if (adapts) tried[number] += adaptive(q, m, duration, setting);
      else {
        const long steps = std::lround(duration/setting);
        for (long n = 0; n < steps; n++) q = step(q, m, setting);
        tried[number] += steps;
      }
      const V last = each_sqrt(q.u*q.u + q.v*q.v);
      for (int i = 0; i < WIDTH && first + i < count; i++) {
        REAL* to = out + first + i;
        to[0] = q.x[i], to[count] = q.y[i], to[2*count] = q.yaw[i], to[3*count] = last[i];
      }
    }
  };
  std::vector<std::thread> others;
  for (int k = 1; k < threads; k++) others.emplace_back(work, k);
  work(0);
  for (auto& other : others) other.join();
  long total = 0;
  for (long number : tried) total += number;
  return total;
}
