// Enclosures of every run of a cell of parameters: eight cells at a time, one for each lane.
//
// A set of states is {c + G p + B r}: p in [-1, 1]^P are the cell's own parameters, kept through time, and r is a box in
// axes B (Lohner's QR). One step: a Taylor polynomial at c, its derivatives along (G, B) over the whole set (mean value
// theorem), and a remainder over a box that no run leaves (Picard, Schauder).
//
// A limit is the chord lambda x + c with a disturbance |w| <= delta, which is 0 unless the set lies across the limit. At
// a tick, w is one more direction. Within a step, w(t) is measurable, and Alekseev's formula bounds its effect.
#include <cstdio>
#include <cstring>

#include "series.h"

struct Task {
  Tape tape;
  long states, kept, quadratures;   // states: first those kept over a tick, then the others of a flow; then quadratures
  const int32_t *start, *flow, *tick;  // operations, for each state (tick: -1 for a continuous loop)
  long signals;
  const int32_t* signal;
  long margin, travelled, clock;       // operation of the stop's margin; which quadratures are distance and time, or -1
  long nonnegative;                    // a state that is never negative, or -1
  long speed;                          // a state that stays above `slowest`, or -1
  double slowest, period_low, period_high, horizon, tolerance, longest, shortest, first;
  long order, tables;
  const double* weights;               // tables x kept, by the logarithm of the speed, or by the time
  double keys_low, keys_high;
};

constexpr long MAX_STEPS = 200000;  // of a group
constexpr int MAX_CLAMPS = 6;  // disturbances of one tick

struct Row { I c; std::vector<V> G; V R; };  // a quadrature: c + G p + [-R, R]

struct Set {
  int n, np;
  std::vector<V> c, G, B, r;
  Set(int n, int np) : n(n), np(np), c(n), G(n * np), B(n * n), r(n) {}
  I box(int i) const {
    V w = fill(0.0);
    for (int j = 0; j < np; j++) w += vabs(G[i * np + j]);
    for (int j = 0; j < n; j++) w += vabs(B[i * n + j]) * r[j];
    return {w - c[i], w + c[i]};
  }
};

// Orthonormal columns near those of A (n x n), longest first. A guess: its inverse is enclosed below.
static void orthonormal(std::vector<V>& A, int n) {
  std::vector<V> len(n);
  for (int j = 0; j < n; j++) { len[j] = fill(0.0); for (int i = 0; i < n; i++) len[j] += A[i * n + j] * A[i * n + j]; }
  for (int a = 0; a < n; a++)
    for (int b = 0; b + 1 < n - a; b++) {
      M swap = len[b] < len[b + 1];
      V x = swap ? len[b + 1] : len[b]; len[b + 1] = swap ? len[b] : len[b + 1]; len[b] = x;
      for (int i = 0; i < n; i++) {
        V y = swap ? A[i * n + b + 1] : A[i * n + b];
        A[i * n + b + 1] = swap ? A[i * n + b] : A[i * n + b + 1]; A[i * n + b] = y;
      }
    }
  for (int j = 0; j < n; j++) {
    V before = fill(0.0), norm = fill(0.0);
    for (int i = 0; i < n; i++) before += A[i * n + j] * A[i * n + j];
    for (int pass = 0; pass < 2; pass++)
      for (int l = 0; l < j; l++) {
        V dot = fill(0.0);
        for (int i = 0; i < n; i++) dot += A[i * n + l] * A[i * n + j];
        for (int i = 0; i < n; i++) A[i * n + j] -= dot * A[i * n + l];
      }
    for (int i = 0; i < n; i++) norm += A[i * n + j] * A[i * n + j];
    M tiny = (norm <= 1e-16 * before) | (norm < 1e-200);  // no direction left: the unit vector that is most new
    if (any(tiny)) {
      V best = fill(-1.0);
      std::vector<V> e(n, fill(0.0)), w(n);
      for (int u = 0; u < n; u++) {
        V n2 = fill(0.0);
        for (int i = 0; i < n; i++) w[i] = fill(i == u ? 1.0 : 0.0);
        for (int pass = 0; pass < 2; pass++)
          for (int l = 0; l < j; l++) {
            V dot = fill(0.0);
            for (int i = 0; i < n; i++) dot += A[i * n + l] * w[i];
            for (int i = 0; i < n; i++) w[i] -= dot * A[i * n + l];
          }
        for (int i = 0; i < n; i++) n2 += w[i] * w[i];
        M better = n2 > best;
        best = better ? n2 : best;
        for (int i = 0; i < n; i++) e[i] = better ? w[i] : e[i];
      }
      norm = tiny ? best : norm;
      for (int i = 0; i < n; i++) A[i * n + j] = tiny ? e[i] : A[i * n + j];
    }
    V k;
    for (int i = 0; i < LANES; i++) k[i] = 1 / std::sqrt(norm[i]);
    for (int i = 0; i < n; i++) A[i * n + j] *= k;
  }
}

// Q^-1 = Q' (Q Q')^-1, which is in Q' (I + [-e, e]) with e = |I - Q Q'|/(1 - |I - Q Q'|) in the norm of rows.
static void inverted(const std::vector<V>& Q, std::vector<I>& inv, int n, M& lost) {
  V worst = fill(0.0);
  for (int i = 0; i < n; i++) {
    V row = fill(0.0);
    for (int j = 0; j < n; j++) {
      I sum = I(i == j ? -1.0 : 0.0);
      for (int l = 0; l < n; l++) sum = sum + point(Q[i * n + l]) * point(Q[j * n + l]);
      row += sum.mag();
    }
    worst = vmax(worst, row);
  }
  lost |= ~(worst < 0.5);
  worst = worst < 0.5 ? worst : fill(0.5);
  V e = (inverse(I(1.0) - point(worst)) * point(worst)).h;
  for (int j = 0; j < n; j++) {
    V total = fill(0.0);
    for (int l = 0; l < n; l++) total += vabs(Q[l * n + j]);
    for (int i = 0; i < n; i++) inv[j * n + i] = point(Q[i * n + j]) + symmetric(e * total);
  }
}

struct Group {
  const Task& task;
  const int n, nb, np, nw, nd, K;
  std::vector<int> flow_roots, tick_roots, clamps, tick_clamps;
  Program flow, tick, starts;
  Series mid, whole, rest, box, jac, at_tick, at_tick_mid;
  std::vector<Clamp> law, tick_law;
  Set set;
  std::vector<Row> rows;
  std::vector<I> C, J, X, B, f, push, low_high;
  std::vector<V> top, bottom;   // of signals
  std::vector<V> above, below;  // every run of the cell goes above, and below, these values of the signals (low, -high)
  std::vector<V> reach;         // greatest |G| of signal 0 by each parameter: where a cell is split
  V pmid[16], phalf[16];
  M dead{}, done{};
  double h_next = 0, now = 0;
  long steps = 0, across = 0;
  bool limited = false;

  static std::vector<int> roots_of(const Task& t) {
    std::vector<int> r(t.flow, t.flow + t.states + t.quadratures);
    r.insert(r.end(), t.signal, t.signal + t.signals);
    r.push_back((int)t.margin);
    return r;
  }
  static std::vector<int> ticks_of(const Task& t) { return std::vector<int>(t.tick, t.tick + t.states); }
  static std::vector<int> starts_of(const Task& t) { return std::vector<int>(t.start, t.start + t.states + t.quadratures); }

  Group(const Task& t)
      : task(t), n((int)t.states), nb((int)t.kept), np((int)t.tape.params), nw(t.period_high > 0 ? MAX_CLAMPS : 0), nd(np + nb + nw), K((int)t.order),
        flow(t.tape, roots_of(t)), tick(t.tape, ticks_of(t)), starts(t.tape, starts_of(t)),
        mid(t.tape, K, 0), whole(t.tape, K, nd), rest(t.tape, K + 1, 0), box(t.tape, 1, 0), jac(t.tape, 0, n + MAX_CLAMPS),
        at_tick(t.tape, 0, nd), at_tick_mid(t.tape, 0, 0), law(t.tape.count), tick_law(t.tape.count),
        set(nb, np), rows(t.quadratures), C(n), J(n * nd), X(n), B(n), f(n), push(n),
        top(t.signals), bottom(t.signals), above(t.signals), below(t.signals), reach(np) {
    for (int i : flow.list) if (t.tape.code[i] == CLAMP) clamps.push_back(i);
    for (int i : tick.list) if (t.tape.code[i] == CLAMP) tick_clamps.push_back(i);
    limited = !clamps.empty();
    whole.centre = &mid, at_tick.centre = &at_tick_mid;
    mid.clamps = whole.clamps = rest.clamps = jac.clamps = law.data();
    at_tick.clamps = at_tick_mid.clamps = tick_law.data();
    jac.own = n;
    for (int i : clamps) if ((int)jac.seeds.size() < MAX_CLAMPS) jac.seeds.push_back(i);
  }
  void params(Series& s, bool centre) {
    s.forget();
    for (int i = 0; i < task.tape.count; i++)
      if (task.tape.code[i] == PARAM) {
        int p = task.tape.index[i];
        s.value(i, 0) = centre ? point(pmid[p]) : point(pmid[p]) + symmetric(phalf[p]);
        if (s.nd && &s != &jac) s.slope(i, 0)[p] = point(phalf[p]);
      }
  }
  void states(Series& s, const std::vector<I>& at, bool slopes) {
    for (int i = 0; i < task.tape.count; i++)
      if (task.tape.code[i] == STATE) {
        int k = task.tape.index[i];
        if (k >= n) continue;  // a quadrature, which nothing reads
        s.value(i, 0) = at[k];
        if (slopes) for (int j = 0; j < nd; j++) s.slope(i, 0)[j] = J[k * nd + j];
      }
  }
  // Coefficient k + 1 of the states from coefficient k of their rates.
  void integrate(Series& s, int k) {
    I inv = over(k + 1);
    for (int i = 0; i < task.tape.count; i++)
      if (task.tape.code[i] == STATE && task.tape.index[i] < n) {
        int r = task.flow[task.tape.index[i]];
        s.value(i, k + 1) = (s.kind[r] < 2 && k ? I(0.0) : s.value(r, k)) * inv;
        for (int j = 0; j < s.nd; j++) s.slope(i, k + 1)[j] = (s.kind[r] < 2 && k ? I(0.0) : s.slope(r, k)[j]) * inv;
      }
  }
  I rate(Series& s, int i, int k) { int r = task.flow[i]; return s.kind[r] < 2 && k ? I(0.0) : s.value(r, k); }
  I* rate_slope(Series& s, int i, int k) { return s.slope(task.flow[i], k); }
  std::vector<int> state_op() {
    std::vector<int> at(n, -1);
    for (int i = 0; i < task.tape.count; i++) if (task.tape.code[i] == STATE && task.tape.index[i] < n) at[task.tape.index[i]] = i;
    return at;
  }

  Clamp relaxed(I raw, int i) {
    const Tape& t = task.tape;
    I low = t.b[i] < 0 ? I(-1e300) : whole.value(t.b[i], 0), high = t.c[i] < 0 ? I(1e300) : whole.value(t.c[i], 0);
    return relaxed(raw, low, high, t.b[i] >= 0, t.c[i] >= 0);
  }
  static Clamp relaxed(I raw, I low, I high, bool has_low, bool has_high) {
    V a = raw.low(), b = raw.h;
    M linear = (a >= low.h) & (b <= high.low()), above = a >= high.h, under = b <= low.low(), pure = linear | above | under;
    V wide = (b - a) > 1e-300 ? b - a : fill(1e-300);
    V fa = vmin(vmax(a, low.h), high.h), fb = vmin(vmax(b, low.h), high.h);
    V lam = vmin(vmax((fb - fa) / wide, fill(0.0)), fill(1.0));
    Clamp r;
    r.lambda = linear ? fill(1.0) : (above | under) ? fill(0.0) : lam;
    I L = point(r.lambda);
    auto gap = [&](I at) { return clamped(at, low, high) - L * at; };
    I every = hull(gap(point(a)), gap(point(b)));
    for (int side = 0; side < 2; side++) {
      if (side ? !has_high : !has_low) continue;
      I limit = side ? high : low;
      M in = (limit.h >= a) & (limit.low() <= b);
      I g = gap(limit);
      every = {in ? vmax(every.n, g.n) : every.n, in ? vmax(every.h, g.h) : every.h};
    }
    V m = every.mid(), dev = vmax(every.h - m, every.n + m), zero = fill(0.0);
    r.c = {linear ? zero : above ? high.n : under ? low.n : -m, linear ? zero : above ? high.h : under ? low.h : m};
    r.delta = pure ? zero : dev;
    return r;
  }

  // One step of at most h from the set (C, J, X); false if no box was found. Afterwards C, J, X are those at its end.
  bool step(I H, double h, int order, M alive, M& lost, M& running_low) {
    const Tape& t = task.tape;
    std::vector<int> at = state_op();
    I HH = span(fill(0.0), fill(h));
    // 1. The ranges of what is limited, at the start of the step.
    mid.natural = whole.natural = true;
    states(mid, C, false), mid.advance(flow, 0);
    states(whole, X, true), whole.advance(flow, 0);
    M bad{};
    for (int i = 0; i < n; i++) bad |= whole.none[task.flow[i]];
    for (int i = 0; i < task.quadratures; i++) bad |= whole.none[task.flow[n + i]];
    lost |= bad & alive;
    alive &= ~lost;
    if (!any(alive)) return true;
    for (int q = 0; q < task.signals; q++) {
      I now_ = whole.value(task.signal[q], 0);
      // Only while no run of the cell can have ended.
      M seen_ = alive & ~whole.none[task.signal[q]] & (M)(whole.value((int)task.margin, 0).low() > 0);
      above[q] = seen_ ? vmax(above[q], now_.low()) : above[q], below[q] = seen_ ? vmax(below[q], -now_.h) : below[q];
    }
    std::vector<I> R0, R;
    for (int i : clamps) R0.push_back(whole.value(t.a[i], 0));
    R = R0;
    // 2. A box that no run leaves.
    box.natural = true, box.use_forced = limited;
    auto rates = [&](const std::vector<I>& where) {
      for (size_t q = 0; q < clamps.size(); q++) {
        int i = clamps[q];
        law[i] = relaxed(R[q], i);
        I low = t.b[i] < 0 ? I(-1e300) : whole.value(t.b[i], 0), high = t.c[i] < 0 ? I(1e300) : whole.value(t.c[i], 0);
        box.forced[i] = hull(clamped(R[q], low, high), point(law[i].lambda) * R[q] + law[i].c + symmetric(law[i].delta));
      }
      states(box, where, false);
      box.advance(flow, 0);
      M none{};
      for (int i = 0; i < n; i++) f[i] = rate(box, i, 0), none |= box.none[task.flow[i]];
      if (limited || any(running_low)) integrate(box, 0), box.advance(flow, 1);
      return none;
    };
    int s0 = (int)task.nonnegative;
    M none = rates(X);
    for (int i = 0; i < n; i++) B[i] = X[i] + HH * f[i], B[i] = B[i] + symmetric(B[i].width() * 0.05 + 1e-14);
    bool found = false;
    for (int tries = 0; tries < 40 && !found; tries++) {
      if (s0 >= 0) B[s0].n = vmin(B[s0].n, fill(-0.0));
      none = rates(B);
      M ok = ~none;
      if (task.speed >= 0) ok &= B[task.speed].low() > task.slowest;
      if (s0 >= 0) ok &= B[s0].h < 1;
      for (int i = 0; i < n; i++) {
        I next = X[i] + HH * f[i];
        if (i == s0) next.n = vmin(next.n, fill(-0.0));
        M in = inside(next, B[i]);
        ok &= in;
        if (any(~in)) B[i] = pick(in, B[i], hull(next, B[i]) + symmetric(hull(next, B[i]).width() * 0.1 + 1e-14));
      }
      for (size_t q = 0; q < clamps.size(); q++) {
        I next = R0[q] + HH * box.value(t.a[clamps[q]], 1);
        if (box.kind[t.a[clamps[q]]] < 2) next = R0[q];
        M in = inside(next, R[q]);
        ok &= in;
        R[q] = pick(in, R[q], hull(next, R[q]) + symmetric(hull(next, R[q]).width() * 0.1 + 1e-12));
      }
      if (all(ok | ~alive)) { found = true; break; }
    }
    if (!found) { box_limit = 0.6 * h; return false; }
    // X + [0, h] f(B) holds the runs as well, and is narrower.
    for (int again = 0; again < 2; again++) {
      rates(B);
      for (int i = 0; i < n; i++) {
        I next = X[i] + HH * f[i];
        if (i == s0) next.n = vmin(next.n, fill(-0.0));
        B[i] = pick(alive, meet(next, B[i]), B[i]);
      }
    }
    // Where slip is 0 its rate must not be negative: then no run leaves {slip >= 0}.
    if (s0 >= 0 && any((B[s0].low() <= 0) & alive)) {
      std::vector<I> face = B;
      face[s0] = I(0.0);
      M wrong = rates(face);
      wrong |= ~(f[s0].n <= 0);
      lost |= wrong & alive & (B[s0].low() <= 0);
      lost |= (C[s0].low() < 0) & (B[s0].low() <= 0) & alive;
      rates(B);
    }
    M crossing{};
    for (int i : clamps) crossing |= law[i].delta > 0;
    if (any(crossing & alive)) {
      across++;
      if (h > 1.01 * near_step) return false;  // up to a limit first, then across it in short steps
    }
    // 3. Taylor series.
    mid.natural = whole.natural = rest.natural = jac.natural = false;
    for (int k = 0; k < order; k++) {
      mid.advance(flow, k), integrate(mid, k);
      whole.advance(flow, k), integrate(whole, k);
    }
    states(rest, B, false);
    for (int k = 0; k <= order; k++) rest.advance(flow, k), integrate(rest, k);
    I power(1.0);
    for (int k = 0; k <= order; k++) power = power * H;
    I power_all = span(fill(0.0), power.h);
    // 4. The effect of the limits' disturbances.
    for (int i = 0; i < n; i++) push[i] = I(0.0);
    if (any(crossing)) {
      // The rates may depend on a limited number in any way: its range here includes the disturbance.
      jac.widths.assign(t.count, fill(0.0));
      for (int i : clamps) jac.widths[i] = law[i].delta;
      states(jac, B, false);
      for (int i = 0; i < n; i++) if (at[i] >= 0) for (int j = 0; j < jac.nd; j++) jac.slope(at[i], 0)[j] = I(i == j ? 1.0 : 0.0);
      jac.advance(flow, 0);
      if (jac.seeds.size() < clamps.size()) { lost |= crossing & alive; }
      for (size_t q = 0; q < jac.seeds.size(); q++) {
        V delta = law[jac.seeds[q]].delta;
        if (!any((delta > 0) & alive)) continue;
        std::vector<I> b(n), Y(n), y(n);
        for (int i = 0; i < n; i++) b[i] = jac.kind[task.flow[i]] < 1 ? I(0.0) : rate_slope(jac, i, 0)[n + q], Y[i] = b[i];
        bool ok = false;
        for (int tries = 0; tries < 30 && !ok; tries++) {
          M in = mask(true);
          for (int i = 0; i < n; i++) {
            I sum(0.0);
            if (jac.kind[task.flow[i]] == 2) for (int j = 0; j < n; j++) sum = sum + rate_slope(jac, i, 0)[j] * Y[j];
            y[i] = b[i] + HH * sum;
            in &= inside(y[i], Y[i]);
          }
          ok = all(in | ~alive);
          if (!ok) for (int i = 0; i < n; i++) Y[i] = hull(Y[i], y[i]) + symmetric(y[i].width() * 0.1 + 1e-14);
        }
        if (!ok) return false;
        for (int i = 0; i < n; i++) push[i] = push[i] + Y[i] * symmetric(delta) * HH;
      }
    }
    // 5. Signals within the step.
    for (int s = 0; s < task.signals; s++) {
      int g = task.signal[s];
      I range = within(g, order, h, H, power_all, at, crossing, alive, s);
      top[s] = alive & (range.h > top[s]) ? range.h : top[s];
      bottom[s] = alive & (range.n > bottom[s]) ? range.n : bottom[s];
    }
    // 6. Quadratures.
    for (int q = 0; q < task.quadratures; q++) {
      int r = task.flow[n + q];
      auto coefficient = [&](Series& s, int k) { return (s.kind[r] < 2 && k > 1 ? I(0.0) : s.value(r, k - 1)) * over(k); };
      I sum = coefficient(mid, order), left = coefficient(rest, order + 1) * power;
      for (int k = order; k-- > 1;) sum = sum * H + coefficient(mid, k);
      sum = sum * H;
      for (int j = 0; j < nd; j++) {
        I g(0.0);
        if (whole.kind[r]) {
          g = whole.slope(r, order - 1)[j] * over(order);
          if (whole.kind[r] < 2 && order > 1) g = I(0.0);
          for (int k = order; k-- > 1;) g = g * H + (whole.kind[r] < 2 && k > 1 ? I(0.0) : whole.slope(r, k - 1)[j]) * over(k);
          g = g * H;
        }
        if (j < np) {
          I all_ = point(rows[q].G[j]) + g;
          rows[q].G[j] = all_.mid();
          left = left + symmetric((all_ - point(rows[q].G[j])).mag());
        } else left = left + symmetric(g.mag());
      }
      if (any(crossing) && jac.kind[r] == 2)
        for (int j = 0; j < jac.nd; j++) {
          V much = j < n ? push[j].mag() : (size_t)(j - n) < jac.seeds.size() ? law[jac.seeds[j - n]].delta : fill(0.0);
          left = left + jac.slope(r, 0)[j] * symmetric(much) * HH;
        }
      rows[q].c = rows[q].c + sum, rows[q].R = rows[q].R + left.mag();
    }
    // 7. The set at the end.
    excess = 1e-30;
    for (int i = 0; i < n; i++) {
      if (at[i] < 0) continue;
      int a = at[i];
      I sum = mid.value(a, order);
      for (int k = order; k-- > 0;) sum = sum * H + mid.value(a, k);
      V w = fill(0.0);
      for (int j = 0; j < nd; j++) {
        I g = whole.slope(a, order)[j];
        for (int k = order; k-- > 0;) g = g * H + whole.slope(a, k)[j];
        J[i * nd + j] = g, w += g.mag();
      }
      I remainder = rest.value(a, order + 1) * power;
      for (int l = 0; l < LANES; l++) if (alive[l] && !lost[l]) excess = std::fmax(excess, remainder.width()[l] / (task.tolerance * (std::fabs(C[i].h[l]) + 1e-3)));
      C[i] = sum + remainder + push[i];
      if (i == s0) C[i].n = vmin(C[i].n, fill(-0.0));  // the run from the centre is never negative, either
      X[i] = meet(C[i] + symmetric(w), B[i]);
      lost |= empty(X[i]) & alive;
    }
    steps++;
    return true;
  }
  double near_step = 1e300;
  double box_limit = 1e9;  // longer steps had no box; it is forgotten slowly
  double excess = 0;  // the greatest remainder of the last step, in tolerances

  // The values of an operation within a step.
  I within(int g, int order, double h, I H, I power, const std::vector<int>& at, M crossing, M alive, int s) {
    int state = -1;
    for (int i = 0; i < n; i++) if (at[i] == g) state = i;
    if (state < 0) {
      if (box.kind[g] < 2) return whole.value(g, 0);
      I smooth = whole.value(g, 0) + span(fill(0.0), fill(h)) * rest.value(g, 1), natural = box.value(g, 0);
      return pick(crossing, natural, meet(smooth, natural));
    }
    std::vector<I> coefs(order + 1);
    I extra = hull(I(0.0), rest.value(g, order + 1) * power) + hull(I(0.0), push[state]), range(0.0);
    for (int k = 0; k <= order; k++) {
      V w = fill(0.0);
      for (int j = 0; j < nd; j++) w += whole.slope(g, k)[j].mag();
      coefs[k] = mid.value(g, k) + symmetric(w);
    }
    // On a piece of the step: the value at its middle, plus the slope over the piece times the distance.
    auto pieces = [&](int count) {
      for (int p = 0; p < count; p++) {
        I place = scaled(span(fill(p), fill(p + 1)) * point(H.h), 1.0 / count), middle = point(place.mid());
        I value = coefs[order], slope = scaled(coefs[order], order);
        for (int k = order; k-- > 0;) value = value * middle + coefs[k];
        for (int k = order; k-- > 1;) slope = slope * place + scaled(coefs[k], k);
        I one = value + slope * (place - middle);
        range = p ? hull(range, one) : one;
      }
      range = meet(range + extra, B[state]);
    };
    pieces(1);
    if (any(((range.h > top[s]) | (range.n > bottom[s])) & alive)) pieces(32);
    return range;
  }

  // The new set from x = C + J (p, r), Lohner's step. Directions are orthogonal in units of 1/weight (powers of 2).
  void renew(M& lost, M alive) {
    double key = task.speed >= 0 ? std::log(std::fmax(least(alive ? set.c[task.speed] : fill(1e300)), 1e-3)) : now;
    double place = (key - task.keys_low) / (task.keys_high - task.keys_low) * task.tables;
    const double* weight = task.weights + nb * (long)std::fmin(std::fmax(place, 0), task.tables - 1);
    std::vector<I> E(nb), inv(nb * nb);
    std::vector<V> A(nb * nb);
    for (int i = 0; i < nb; i++) {
      set.c[i] = C[i].mid();
      E[i] = C[i] - point(set.c[i]);
      for (int j = 0; j < np; j++) {
        I g = J[i * nd + j];
        set.G[i * np + j] = g.mid();
        E[i] = E[i] + symmetric((g - point(set.G[i * np + j])).mag());
      }
      for (int j = np + nb; j < nd; j++) E[i] = E[i] + symmetric(J[i * nd + j].mag());
      for (int j = 0; j < nb; j++) A[i * nb + j] = weight[i] * J[i * nd + np + j].mid();
    }
    orthonormal(A, nb);
    M broken{};
    inverted(A, inv, nb, broken);
    lost |= broken & alive;
    for (int l = 0; l < nb; l++) {
      I mine(0.0);
      for (int i = 0; i < nb; i++) mine = mine + inv[l * nb + i] * scaled(E[i], weight[i]);
      V r = mine.mag();
      for (int j = 0; j < nb; j++) {
        I sum(0.0);
        for (int i = 0; i < nb; i++) sum = sum + inv[l * nb + i] * scaled(J[i * nd + np + j], weight[i]);
        r += sum.mag();
      }
      set.r[l] = r;
      for (int i = 0; i < nb; i++) set.B[i * nb + l] = A[i * nb + l] * (1 / weight[i]);
    }
  }
  // C, J, X of the kept states from the set; the others are 0 until a tick gives them.
  void open() {
    for (int i = 0; i < n; i++) {
      bool kept = i < nb;
      C[i] = kept ? point(set.c[i]) : I(0.0), X[i] = kept ? set.box(i) : I(0.0);
      for (int j = 0; j < nd; j++) J[i * nd + j] = I(0.0);
      if (!kept) continue;
      for (int j = 0; j < np; j++) J[i * nd + j] = point(set.G[i * np + j]);
      for (int j = 0; j < nb; j++) J[i * nd + np + j] = point(set.B[i * nb + j]) * point(set.r[j]);
      if (i == task.nonnegative) X[i].n = vmin(X[i].n, fill(0.0));
    }
  }
  // A tick: every state through the tick's operations, with one direction for each limit that the set lies across.
  void apply_tick(M& lost, M alive) {
    const Tape& t = task.tape;
    at_tick.natural = at_tick_mid.natural = true;
    states(at_tick_mid, C, false), at_tick_mid.advance(tick, 0);
    states(at_tick, X, true), at_tick.advance(tick, 0);
    int used = 0;
    std::vector<int> which;
    // Each limit in its turn: its range depends on the relaxations before it.
    for (int i : tick_clamps) {
      I low = t.b[i] < 0 ? I(-1e300) : at_tick.value(t.b[i], 0), high = t.c[i] < 0 ? I(1e300) : at_tick.value(t.c[i], 0);
      tick_law[i] = relaxed(at_tick.value(t.a[i], 0), low, high, t.b[i] >= 0, t.c[i] >= 0);
      if (any((tick_law[i].delta > 0) & alive)) { across++; which.push_back(i); used++; }
    }
    if (used > nw) { lost |= alive; return; }
    at_tick.natural = at_tick_mid.natural = false;
    at_tick.own = np + nb, at_tick.seeds = which;
    disturb(which);
    at_tick_mid.advance(tick, 0);
    at_tick.advance(tick, 0);
    std::vector<I> c(n), x(n), j(n * nd);
    M bad{};
    for (int i = 0; i < n; i++) {
      int r = task.tick[i];
      if (r < 0) { c[i] = C[i], x[i] = X[i]; for (int q = 0; q < nd; q++) j[i * nd + q] = J[i * nd + q]; continue; }
      c[i] = at_tick_mid.value(r, 0);
      V w = fill(0.0);
      for (int q = 0; q < nd; q++) {
        j[i * nd + q] = at_tick.kind[r] ? at_tick.slope(r, 0)[q] : I(0.0);
        w += j[i * nd + q].mag();
      }
      x[i] = meet(at_tick.value(r, 0), c[i] + symmetric(w));
      bad |= at_tick.none[r] | at_tick_mid.none[r] | empty(x[i]);
    }
    lost |= bad & alive;
    C = c, X = x, J = j;
  }
  void disturb(const std::vector<int>& which) {
    // The values of a relaxed limit over the set include its disturbance; `widths` adds it, `own` gives its direction.
    at_tick.widths.assign(task.tape.count, fill(0.0)), at_tick.seed_scale.assign(task.tape.count, fill(1.0));
    for (int i : which) at_tick.widths[i] = tick_law[i].delta, at_tick.seed_scale[i] = tick_law[i].delta;
  }
};

struct Ending {
  I m_c, x_c, t_c;
  std::vector<I> m_d;   // of the margin at the captured set
  std::vector<V> xG; V xR;
  I inv = I(0.0), speed = I(0.0), pace = I(0.0), m_box = I(0.0);
  std::vector<V> tG; V tR;
  M snapped{}, any_rate{};
};

extern "C" {

// Whether sums, products and quotients are rounded upward as compiled, also those of numbers known at compile time.
int rounds_upward() {
  round_upward();
  volatile double third = 3.0, tenth = 0.1;
  V a = fill(1.0) / fill(third), b = fill(tenth) * fill(tenth), c = fill(1.0) + fill(1e-30), d = fill(1.0) / fill(3.0);
  bool up = a[0] > 0x1.5555555555555p-2 && b[0] > 0x1.47ae147ae147bp-7 && c[0] > 1.0 && d[0] == a[0] && -(fill(-1.0) / fill(third))[0] < a[0];
  std::fesetround(FE_TONEAREST);
  return up;
}

// One operation on `count` pairs of intervals, for tests. codes: those of `Code`; out: low and high.
void apply(int code, long count, const double* a, const double* b, double* out) {
  round_upward();
  for (long first = 0; first < count; first += LANES) {
    I x(1.0), y(1.0), r(0.0), other;
    for (int l = 0; l < LANES; l++) {
      long i = first + l < count ? first + l : count - 1;
      x.n[l] = -a[2 * i], x.h[l] = a[2 * i + 1], y.n[l] = -b[2 * i], y.h[l] = b[2 * i + 1];
    }
    M none{};
    switch (code) {
      case ADD: r = x + y; break;
      case SUB: r = x - y; break;
      case MUL: r = x * y; break;
      case INV: r = inverse(x, none); break;
      case EXP: r = exp_of(x, none); break;
      case LOG: r = log_of(x, none); break;
      case SIN: sin_cos(x, r, other, none); break;
      case COS: sin_cos(x, other, r, none); break;
      case ATAN: r = atan_of(x, none); break;
      case POWER: r = power_of(x, y, none); break;
    }
    for (int l = 0; l < LANES && first + l < count; l++) {
      out[2 * (first + l)] = none[l] ? -INFINITY : -r.n[l], out[2 * (first + l) + 1] = none[l] ? INFINITY : r.h[l];
    }
  }
  std::fesetround(FE_TONEAREST);
}

// cells: params x (low, high) for each cell. out for each cell: status (1 ended, 2 horizon, 0 not proved), stop time low,
// high, distance low, high, time reached, steps, ticks or steps across a limit, then (bottom, top) of signals, then reach.
// scout: if not null, the Jacobian of every period (or step) of the first cell's centre, with its time; returns how many.
long prove(const Task* task, long count, const double* cells, double* out, double* scout, long scouts) {
  round_upward();
  const int np = (int)task->tape.params, nb = (int)task->kept, n = (int)task->states, ns = (int)task->signals, width = 8 + 4 * ns + np;
  long scouted = 0;
  Group g(*task);
  const std::vector<int> at = g.state_op();
  const I period = span(fill(task->period_low), fill(task->period_high));
  for (long first = 0; first < count; first += LANES) {
    std::feclearexcept(FE_ALL_EXCEPT);
    g.dead = g.done = M{};
    g.steps = g.across = 0, g.h_next = task->first, g.now = 0, g.box_limit = 1e9;
    for (int p = 0; p < np; p++)
      for (int l = 0; l < LANES; l++) {
        const double* c = cells + 2 * np * (first + l < count ? first + l : count - 1) + 2 * p;
        double m = 0.5 * (c[0] + c[1]);
        g.pmid[p][l] = m, g.phalf[p][l] = std::fmax(c[1] - m, m - c[0]);
      }
    for (Series* s : {&g.mid, &g.rest, &g.whole, &g.box, &g.jac, &g.at_tick, &g.at_tick_mid}) g.params(*s, s == &g.mid || s == &g.at_tick_mid);
    // the start
    g.at_tick.natural = g.at_tick_mid.natural = true;
    g.at_tick.own = -1;
    g.at_tick_mid.advance(g.starts, 0), g.at_tick.advance(g.starts, 0);
    for (int i = 0; i < n; i++) {
      int r = task->start[i];
      g.C[i] = g.at_tick_mid.value(r, 0);
      V w = fill(0.0);
      for (int j = 0; j < g.nd; j++) g.J[i * g.nd + j] = g.at_tick.kind[r] ? g.at_tick.slope(r, 0)[j] : I(0.0), w += g.J[i * g.nd + j].mag();
      g.dead |= g.at_tick.none[r];
    }
    for (int i = 0; i < nb * nb; i++) g.set.B[i] = fill(0.0);
    for (int i = 0; i < nb; i++) {
      g.set.c[i] = g.C[i].mid(), g.set.B[i * nb + i] = fill(1.0);
      I e = g.C[i] - point(g.set.c[i]);
      for (int j = 0; j < np; j++) {
        I d = g.J[i * g.nd + j];
        g.set.G[i * np + j] = d.mid(), e = e + symmetric((d - point(g.set.G[i * np + j])).mag());
      }
      g.set.r[i] = e.mag();
    }
    for (auto& q : g.rows) { q.c = I(0.0), q.R = fill(0.0); q.G.assign(np, fill(0.0)); }
    for (int q = 0; q < task->quadratures; q++) g.rows[q].c = g.at_tick.value(task->start[n + q], 0);
    for (auto* every : {&g.top, &g.above, &g.below}) for (auto& x : *every) x = fill(-1e300);
    for (auto& x : g.bottom) x = fill(-1e300);
    for (auto& x : g.reach) x = fill(0.0);
    Ending end;
    end.m_d.assign(np + nb, I(0.0)), end.xG.assign(np, fill(0.0)), end.tG.assign(np, fill(0.0)), end.tR = fill(0.0), end.xR = fill(0.0), end.m_c = end.x_c = end.t_c = I(0.0);
    I elapsed(0.0);
    V reached = fill(0.0);
    M timed{};
    double longest = task->longest;
    bool begun = false;
    for (long tick = 0; tick < 2000000 && !all(g.dead | g.done); tick++) {
      M active = ~(g.dead | g.done), lost{};
      g.open();
      M ending{};
      bool sampled = task->period_high > 0;
      if (sampled) g.apply_tick(lost, active);
      active &= ~lost;
      double span_left = sampled ? task->period_high : (task->clock >= 0 ? 1e300 : task->horizon - g.now + 1e-12), at_time = 0;
      I gone(0.0);
      I slope_seen(0.0), speed_seen(0.0), pace_seen(0.0);
      M seen{};
      bool over_period = false;
      int substeps = 0;
      while (!over_period && any(active)) {
        // the length of the step
        double h = std::fmin(g.h_next, std::fmin(longest, g.box_limit));
        g.box_limit = std::fmin(1.01 * g.box_limit, 1e9);
        g.near_step = 1e300;
        if (!begun) h = std::fmin(h, task->first);
        if (g.limited) {
          // up to a limit first, then across it in steps of a quarter of the set's own extent
          g.mid.natural = g.whole.natural = true;
          g.states(g.mid, g.C, false), g.mid.advance(g.flow, 0);
          g.states(g.whole, g.X, true), g.whole.advance(g.flow, 0);
          g.integrate(g.mid, 0), g.mid.advance(g.flow, 1);
          V want = fill(h), near = fill(1e300);
          for (int i : g.clamps) {
            const Tape& t = task->tape;
            I raw = g.whole.value(t.a[i], 0);
            V speed = vabs(g.mid.value(t.a[i], 1).mid()) + 1e-9;
            V mine = vmax(0.25 * raw.width() / speed, fill(task->shortest));
            for (int side : {t.b[i], t.c[i]}) {
              if (side < 0) continue;
              I limit = g.whole.value(side, 0);
              V gap = raw.low() > limit.h ? raw.low() - limit.h : limit.low() > raw.h ? limit.low() - raw.h : fill(0.0);
              want = vmin(want, vmax(gap * 0.9 / speed, mine));
            }
            near = vmin(near, mine);
          }
          want = active ? want : fill(h), near = active ? near : fill(1e300);
          h = least(want), g.near_step = std::fmax(least(near), task->shortest);
        }
        double left = span_left - at_time;
        bool last = sampled && h > 0.9 * left;
        if (sampled && !last && h > 0.5 * left) h = 0.5 * left;
        I H(h);
        if (last) H = period - gone, h = largest(H.h);
        std::vector<I> C0 = g.C, J0 = g.J, X0 = g.X;
        std::vector<Row> rows0 = g.rows;
        std::vector<V> top0 = g.top, bottom0 = g.bottom;
        // The margin's rate is needed once it may be 0.
        g.states(g.mid, g.C, false);
        bool ok = false;
        M lost_now{};
        int order = g.K;
        M near_end = ending;
        {  // is the margin's zero near?
          Series& s = g.box;
          s.natural = true, s.use_forced = false;
          g.states(s, g.X, false), s.advance(g.flow, 0);
          V m = s.value(task->margin, 0).low();
          near_end = active & (m <= 0.05 * vabs(s.value(task->margin, 0).h) + 1e-9);
        }
        for (int tries = 0; tries < 40; tries++) {
          lost_now = M{};
          M stop_soon = mask(true);
          ok = g.step(H, h, order, active, lost_now, stop_soon);
          if (ok && order > 1) {  // no third derivative of a power at 0: a step of order 1
            M singular{};
            for (int i = 0; i < n; i++) if (at[i] >= 0) singular |= g.mid.none[task->flow[i]] | g.whole.none[task->flow[i]] | g.rest.none[task->flow[i]];
            if (any(singular & active)) { ok = false; lost_now = M{}; order = 1, h = std::fmin(h, task->first), H = I(h), last = false; g.C = C0, g.J = J0, g.X = X0, g.rows = rows0, g.top = top0, g.bottom = bottom0; continue; }
          }
          if (ok && order > 1 && g.excess > 2 && h > task->shortest) { ok = false; h = std::fmax(task->shortest, std::fmax(0.8 * h * std::pow(g.excess, -1.0 / (order + 1)), 0.1 * h)); H = I(h), last = false; g.C = C0, g.J = J0, g.X = X0, g.rows = rows0, g.top = top0, g.bottom = bottom0; continue; }
          if (ok) break;
          g.C = C0, g.J = J0, g.X = X0, g.rows = rows0, g.top = top0, g.bottom = bottom0;
          if (h < task->shortest * 0.01 || h < 1e-12) break;
          h *= 0.5, H = I(h), last = false;
        }
        begun = true;
        if (!ok) lost_now |= active;
        if (order == 1) {
          M singular{};
          for (int i = 0; i < n; i++) singular |= g.mid.none[task->flow[i]] | g.whole.none[task->flow[i]] | g.rest.none[task->flow[i]];
          lost_now |= singular & active;
        }
        // A set that grows without end, or that needs ever shorter steps, proves nothing: a smaller cell may.
        if (task->nonnegative >= 0) lost_now |= ~(g.X[task->nonnegative].width() < 0.3) & active;
        if (++substeps > (sampled ? 100 : 1) || g.steps > MAX_STEPS) lost_now |= active;
        for (int i = 0; i < n; i++) lost_now |= ~((g.X[i].n < 1e200) & (g.X[i].h < 1e200)) & active;
        lost |= lost_now, active &= ~lost_now;
        gone = gone + H, at_time += h;
        // the rates of the margin and of the distance within this step, from the box that no run leaves
        {
          I dm = g.box.value(task->margin, 1);
          I v = task->travelled < 0 ? I(0.0) : g.box.value(task->flow[task->travelled], 0);
          I pace = task->clock < 0 ? I(1.0) : g.box.value(task->flow[task->clock], 0);
          pace_seen = any(seen) ? hull(pace_seen, pace) : pace;
          slope_seen = any(seen) ? hull(slope_seen, dm) : dm, speed_seen = any(seen) ? hull(speed_seen, v) : v;
          seen = mask(true);
        }
        // the next length: the last coefficient of the series should not count
        double best = 1e300;
        if (order > 1) {
          best = 0.9 * h * std::pow(g.excess, -1.0 / (order + 1));
          g.h_next = std::fmin(best, 2 * std::fmax(h, g.h_next * 0.5));
          if (!sampled) g.h_next = std::fmin(best, 2 * h);
        } else g.h_next = 1.5 * h;
        if (g.h_next < task->shortest) g.h_next = task->shortest;
        if (sampled) over_period = last;
        else over_period = true;
      }
      if (scout && scouted < scouts && first == 0) {
        double* to = scout + scouted * (2 + nb * nb);
        to[0] = task->speed >= 0 ? g.X[task->speed].mid()[0] : g.now;
        to[1] = 1;  // is no limit reached? Then the Jacobian is that of the closed loop
        for (int i : g.clamps) to[1] = std::fmin(to[1], g.law[i].lambda[0]);
        for (int i : g.tick_clamps) to[1] = std::fmin(to[1], g.tick_law[i].lambda[0]);
        for (int i = 0; i < nb; i++)
          for (int j = 0; j < nb; j++) to[2 + i * nb + j] = g.J[i * g.nd + np + j].mid()[0] / g.set.r[j][0];
        scouted++;
      }
      g.renew(lost, active);
      if (scout) for (int i = 0; i < nb; i++) { for (int j = 0; j < nb; j++) g.set.B[i * nb + j] = fill(i == j ? 1.0 : 0.0); g.set.r[i] = (vabs(g.set.c[i]) + 1e-3) * 1e-9; for (int j = 0; j < np; j++) g.set.G[i * np + j] = fill(0.0); }
      for (int i = 0; i < nb; i++) lost |= ~((vabs(g.set.c[i]) < 1e200) & (g.set.r[i] < 1e200)) & active;
      elapsed = sampled ? period * I((double)(tick + 1)) : elapsed + gone;
      g.now += at_time;
      g.dead |= lost, active &= ~lost;
      reached = active ? (task->clock >= n ? g.rows[task->clock - n].c.low() : -elapsed.n) : reached;
      for (int p = 0; p < np; p++) g.reach[p] = active ? vmax(g.reach[p], vabs(g.set.G[(task->nonnegative >= 0 ? task->nonnegative : 0) * np + p])) : g.reach[p];
      // the end of the run
      {
        g.open();
        g.mid.natural = g.whole.natural = true;
        // the margin reads only states that a tick does not change
        g.states(g.mid, g.C, false), g.mid.advance(g.flow, 0), g.states(g.whole, g.X, true), g.whole.advance(g.flow, 0);
        I m = g.whole.value(task->margin, 0);
        M some = active & (m.low() <= 0);
        if (any(some)) {
          M none{};
          M falls = slope_seen.h < 0;
          M first_time = ~end.any_rate;
          I a = inverse(-slope_seen, none);
          end.inv = pick(some & falls, pick(first_time, a, hull(end.inv, a)), end.inv);
          end.speed = pick(some & falls, pick(first_time, speed_seen, hull(end.speed, speed_seen)), end.speed);
          end.pace = pick(some & falls, pick(first_time, pace_seen, hull(end.pace, pace_seen)), end.pace);
          M not_monotone = some & ~falls;
          g.dead |= not_monotone, active &= ~not_monotone;
          end.any_rate |= some & falls;
        }
        M snap = active & ~end.snapped & (m.mid() <= 0);
        if (any(snap)) {
          auto set = [&](I& to, I from) { to = pick(snap, from, to); };
          set(end.m_c, g.mid.value(task->margin, 0)), set(end.t_c, elapsed);
          for (int j = 0; j < np + nb; j++) set(end.m_d[j], g.whole.kind[task->margin] ? g.whole.slope(task->margin, 0)[j] : I(0.0));
          set(end.m_box, m);
          if (task->clock >= n) {
            Row& q = g.rows[task->clock - n];
            set(end.t_c, q.c);
            for (int j = 0; j < np; j++) end.tG[j] = snap ? q.G[j] : end.tG[j];
            end.tR = snap ? q.R : end.tR;
          }
          if (task->travelled >= n) {
            Row& q = g.rows[task->travelled - n];
            set(end.x_c, q.c);
            for (int j = 0; j < np; j++) end.xG[j] = snap ? q.G[j] : end.xG[j];
            end.xR = snap ? q.R : end.xR;
          }
          end.snapped |= snap;
        }
        M ended = active & end.snapped & (m.h < 0);
        g.done |= ended;
        M out_of_time = active & ~ended & (task->clock >= n ? (M)((g.rows[task->clock - n].c - symmetric(g.rows[task->clock - n].R)).low() >= task->horizon) : mask(g.now >= task->horizon - 1e-9));
        timed |= out_of_time, g.done |= out_of_time;
      }
      if (any(lost)) {  // a lane that is lost goes along as one run of another
        int good = -1;
        for (int l = 0; l < LANES; l++) if (!g.dead[l] && !g.done[l]) good = l;
        if (good < 0) { if (all(g.dead | g.done)) break; for (int l = 0; l < LANES; l++) if (!g.dead[l]) good = l; }
        if (good < 0) break;
        for (int i = 0; i < nb; i++) {
          g.set.c[i] = lost ? fill(g.set.c[i][good]) : g.set.c[i], g.set.r[i] = lost ? fill(0.0) : g.set.r[i];
          for (int j = 0; j < np; j++) g.set.G[i * np + j] = lost ? fill(0.0) : g.set.G[i * np + j];
          for (int j = 0; j < nb; j++) g.set.B[i * nb + j] = lost ? fill(i == j) : g.set.B[i * nb + j];
        }
      }
    }
    // when and where the margin is 0: t = t_c + m_c/a with -m' = a in the hull of all rates near the end
    I alpha = point(end.inv.mid()), spread = symmetric(vmax(end.inv.h - alpha.h, end.inv.n + alpha.h));
    I tau = alpha * end.m_c + spread * end.m_box;  // from the captured set to the end, without the slopes of m
    V slopes = fill(0.0);
    for (int j = 0; j < np + nb; j++) slopes += (alpha * end.m_d[j]).mag();
    I whole_tau = tau + symmetric(slopes);
    // A quadrature goes on at a rate in `rate`: its middle times tau, whose slopes add to its own.
    auto at_end = [&](I c, const std::vector<V>& G, V R, I rate) {
      I m = point(rate.mid());
      V w = R;
      for (int j = 0; j < np + nb; j++) w += ((j < np ? point(G[j]) : I(0.0)) + m * (alpha * end.m_d[j])).mag();
      return c + m * tau + symmetric(w) + (rate - m) * whole_tau;
    };
    I T = at_end(end.t_c, end.tG, end.tR, task->clock < 0 ? I(1.0) : end.pace), X = at_end(end.x_c, end.xG, end.xR, end.speed);
    bool sound = !std::fetestexcept(FE_INVALID | FE_OVERFLOW | FE_DIVBYZERO);
    for (int l = 0; l < LANES && first + l < count; l++) {
      double* o = out + width * (first + l);
      bool fine = g.done[l] && !g.dead[l] && sound;
      o[0] = fine ? (timed[l] ? 2 : 1) : 0;
      bool stopped = fine && !timed[l];
      o[1] = stopped ? -T.n[l] : 0, o[2] = stopped ? T.h[l] : INFINITY, o[3] = stopped ? -X.n[l] : 0, o[4] = stopped ? X.h[l] : INFINITY;
      o[5] = reached[l], o[6] = (double)g.steps, o[7] = (double)g.across;
      for (int s = 0; s < ns; s++) o[8 + 2 * s] = fine ? -g.bottom[s][l] : -INFINITY, o[9 + 2 * s] = fine ? g.top[s][l] : INFINITY;
      for (int s = 0; s < ns; s++) o[8 + 2 * ns + 2 * s] = sound ? -g.below[s][l] : INFINITY, o[9 + 2 * ns + 2 * s] = sound ? g.above[s][l] : -INFINITY;
      for (int p = 0; p < np; p++) o[8 + 4 * ns + p] = g.reach[p][l];
    }
  }
  std::fesetround(FE_TONEAREST);
  return scouted;
}
}
