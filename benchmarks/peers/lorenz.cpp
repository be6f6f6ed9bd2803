// The Lorenz ensemble by hand, for bench_yardsticks.py: x' = sigma (y - x), y' = x (rho - z) - y, z' = x y - beta z from
// (1, 0, 0) over the time 1. Lanes go in blocks of WIDTH, whose loops a compiler turns into vectors. Equal steps of the
// classical Runge-Kutta method, or Tsitouras' method with a step and an error of its own in every lane. The numbers
// A21 to E7 of the latter are given on the command line or before this text.
#include <algorithm>
#include <cmath>
#include <thread>
#include <vector>

static const int WIDTH = 16;
static const REAL SIGMA = 10, BETA = REAL(8) / 3;

#define EACH for (int i = 0; i < WIDTH; i++)
#define RATES(dx, dy, dz, x, y, z) \
  const REAL dx = SIGMA*((y) - (x)), dy = (x)*(r[i] - (z)) - (y), dz = (x)*(y) - BETA*(z)

static void fixed(const REAL* r, REAL* x, REAL* y, REAL* z, long steps) {
  const REAL h = REAL(1) / steps, half = h / 2, sixth = h / 6;
  for (long n = 0; n < steps; n++) EACH {
    const REAL a = x[i], b = y[i], c = z[i];
    RATES(x1, y1, z1, a, b, c);
    RATES(x2, y2, z2, a + half*x1, b + half*y1, c + half*z1);
    RATES(x3, y3, z3, a + half*x2, b + half*y2, c + half*z2);
    RATES(x4, y4, z4, a + h*x3, b + h*y3, c + h*z3);
    x[i] = a + sixth*(x1 + 2*(x2 + x3) + x4);
    y[i] = b + sixth*(y1 + 2*(y2 + y3) + y4);
    z[i] = c + sixth*(z1 + 2*(z2 + z3) + z4);
  }
}

static long adaptive(const REAL* r, REAL* x, REAL* y, REAL* z, REAL tolerance) {
  REAL t[WIDTH], h[WIDTH], error[WIDTH], u[WIDTH], v[WIDTH], w[WIDTH];
  EACH t[i] = 0, h[i] = REAL(1e-3);
  long tried = 0;
  for (bool busy = true; busy; tried++) {
    EACH {
      const REAL a = x[i], b = y[i], c = z[i], s = h[i];
      RATES(x1, y1, z1, a, b, c);
      RATES(x2, y2, z2, a + s*(A21*x1), b + s*(A21*y1), c + s*(A21*z1));
#define STAGE(n, sum) RATES(x##n, y##n, z##n, a + s*sum(x), b + s*sum(y), c + s*sum(z))
#define S3(q) (A31*q##1 + A32*q##2)
      STAGE(3, S3);
#define S4(q) (A41*q##1 + A42*q##2 + A43*q##3)
      STAGE(4, S4);
#define S5(q) (A51*q##1 + A52*q##2 + A53*q##3 + A54*q##4)
      STAGE(5, S5);
#define S6(q) (A61*q##1 + A62*q##2 + A63*q##3 + A64*q##4 + A65*q##5)
      STAGE(6, S6);
#define S7(q) (A71*q##1 + A72*q##2 + A73*q##3 + A74*q##4 + A75*q##5 + A76*q##6)
      u[i] = a + s*S7(x), v[i] = b + s*S7(y), w[i] = c + s*S7(z);
      RATES(x7, y7, z7, u[i], v[i], w[i]);
#define ERR(q) (E1*q##1 + E2*q##2 + E3*q##3 + E4*q##4 + E5*q##5 + E6*q##6 + E7*q##7)
      const REAL p = s*ERR(x) / (1 + std::max(std::abs(a), std::abs(u[i])));
      const REAL q = s*ERR(y) / (1 + std::max(std::abs(b), std::abs(v[i])));
      const REAL o = s*ERR(z) / (1 + std::max(std::abs(c), std::abs(w[i])));
      error[i] = std::sqrt((p*p + q*q + o*o) / 3) / tolerance;
    }
    busy = false;
    EACH {
      const bool good = error[i] <= 1;
      t[i] = good ? t[i] + h[i] : t[i];
      x[i] = good ? u[i] : x[i], y[i] = good ? v[i] : y[i], z[i] = good ? w[i] : z[i];
      const REAL left = REAL(1) - t[i];
      const REAL factor = REAL(0.9)*std::exp(REAL(-0.2)*std::log(std::max(error[i], REAL(1e-8))));
      h[i] = std::min(left, h[i]*std::min(REAL(5), std::max(REAL(0.2), factor)));
      busy |= left > 0;
    }
  }
  return tried;
}

// out: x, y and z of all lanes. steps: of equal length, or 0 for `tolerance`. Returns the steps tried of all blocks.
extern "C" long run(long count, const REAL* rho, long steps, double tolerance, int threads, REAL* out) {
  std::vector<long> tried(threads, 0);
  auto work = [&](int number) {
    for (long first = long(number)*WIDTH; first < count; first += long(threads)*WIDTH) {
      REAL r[WIDTH], x[WIDTH], y[WIDTH], z[WIDTH];
      EACH r[i] = rho[std::min(first + i, count - 1)], x[i] = 1, y[i] = 0, z[i] = 0;
      if (steps) fixed(r, x, y, z, steps), tried[number] += steps;
      else tried[number] += adaptive(r, x, y, z, REAL(tolerance));
      for (int i = 0; i < WIDTH && first + i < count; i++)
        out[first + i] = x[i], out[count + first + i] = y[i], out[2*count + first + i] = z[i];
    }
  };
  std::vector<std::thread> all;
  for (int k = 1; k < threads; k++) all.emplace_back(work, k);
  work(0);
  for (auto& one : all) one.join();
  long sum = 0;
  for (long one : tried) sum += one;
  return sum;
}
