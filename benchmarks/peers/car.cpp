// The car of diffabs/parts/plants/car.py by hand, for bench_car.py: four wheels on Burckhardt's curve, the loads by two
// linear equations, a PID on the slip of each wheel, a driver who holds the line of the start; equal steps of the
// classical Runge-Kutta method. WIDTH lanes are one vector; -ffast-math gives it vector forms of exp, expm1, sine and
// cosine too. Tyres are proportional and all wheels stay loaded. The constants come before this text.
#include <algorithm>
#include <cmath>
#include <thread>
#include <vector>

static const int WIDTH = 8;
typedef double V __attribute__((vector_size(8*WIDTH)));
#define INLINE static inline __attribute__((always_inline))
#define EACH for (int i = 0; i < WIDTH; i++)

#define OF_EACH(name) INLINE V each_##name(V x) { V y; EACH y[i] = std::name(x[i]); return y; }
OF_EACH(exp) OF_EACH(expm1) OF_EACH(sin) OF_EACH(cos) OF_EACH(sqrt)
INLINE V all(double x) { return V{} + x; }
INLINE V most(V x, V y) { return x > y ? x : y; }
INLINE V clamp(V x, double low, double high) { return most(x < all(high) ? x : all(high), all(low)); }

// w: spins; s: filtered target slips; e: integrals of the errors; front left, front right, rear left, rear right.
#define FIELDS(F) F(x) F(y) F(yaw) F(u) F(v) F(r) F(steer) \
  F(w1) F(w2) F(w3) F(w4) F(s1) F(s2) F(s3) F(s4) F(e1) F(e2) F(e3) F(e4)
#define DECLARE(name) V name;
struct State { FIELDS(DECLARE) };
struct Wheel { V slip, own, braking, lateral; };  // frictions: braking in its own axes; both in the car's axes

INLINE Wheel wheel(const V along, const V across, const V spin, const V speed,
                   const double c1, const double c2, const double c3) {
  const V rim = RADIUS*spin, slip = (along - rim) / most(most(along, rim), all(CRAWL));
  const V tangent = across / most(along, all(CRAWL)), cosine = 1 / each_sqrt(1 + tangent*tangent);
  const V sx = slip*cosine, sy = tangent*cosine, s = each_sqrt(most(sx*sx + sy*sy, all(1e-16)));
  const V friction = (-c1*each_expm1(-c2*s) - c3*s) * each_exp(-C4*s*speed) / s;
  return {slip, friction*sx, friction*sx, -friction*sy};
}

INLINE Wheel turned(Wheel k, V cosine, V sine) {
  return {k.slip, k.own, k.own*cosine + k.lateral*sine, k.lateral*cosine - k.own*sine};
}

INLINE V spin_rate(V spin, V load, const Wheel& k, V error, V integral, double inertia) {
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
  const double bases = 2*(TO_FRONT + TO_REAR);
  const V weight_front = mass*(GRAVITY*TO_REAR/bases), weight_rear = mass*(GRAVITY*TO_FRONT/bases);
  const V rolling = mass*(ROLLING*GRAVITY);
  const double pitch = HEIGHT/bases, roll_front = ROLL*HEIGHT/FRONT_TRACK, roll_rear = (1 - ROLL)*HEIGHT/REAR_TRACK;
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

INLINE State step(const State& q, const V mass, const double h) {
  State k = rates(q, mass), sum = k, z;
#define NEXT(name) z.name = q.name + far*k.name;
#define TWICE(name) sum.name += 2*k.name;
#define ENDED(name) z.name = q.name + h/6*(sum.name + k.name);
  double far = h/2;
  FIELDS(NEXT) k = rates(z, mass); FIELDS(TWICE)
  FIELDS(NEXT) k = rates(z, mass); FIELDS(TWICE)
  far = h;
  FIELDS(NEXT) k = rates(z, mass); FIELDS(ENDED)
  return z;
}

// out: x, y, yaw and speed of all lanes after `steps` steps of length h.
extern "C" void run(long count, const double* mass, const double* speed, long steps, double h, int threads,
                    double* out) {
  auto work = [&](int number) {
    for (long first = long(number)*WIDTH; first < count; first += long(threads)*WIDTH) {
      State q = {};
      V m;
      EACH {
        const long at = std::min(first + i, count - 1);
        m[i] = mass[at], q.u[i] = speed[at];
      }
      q.w1 = q.w2 = q.w3 = q.w4 = q.u/RADIUS;
      for (long n = 0; n < steps; n++) q = step(q, m, h);
      const V last = each_sqrt(q.u*q.u + q.v*q.v);
      for (int i = 0; i < WIDTH && first + i < count; i++) {
        double* to = out + first + i;
        to[0] = q.x[i], to[count] = q.y[i], to[2*count] = q.yaw[i], to[3*count] = last[i];
      }
    }
  };
  std::vector<std::thread> others;
  for (int k = 1; k < threads; k++) others.emplace_back(work, k);
  work(0);
  for (auto& other : others) other.join();
}
