// Enclosures of every run of a cell of parameters: several cells at a time, one for each lane.
//
// A set of states is {c + G p + B r} (`set.h`). One step of a flow has a Taylor polynomial at c, its derivatives along
// (G, B) over the whole set (mean value theorem), and a remainder over a box that no run leaves (Picard, Schauder).
//
// A torque limit, and any other limit (minimum, maximum, rounding), is a chord lambda x + c with a disturbance
// |w| <= delta. delta is 0 unless the set straddles the limit. At a tick, w is one more direction. Within a step, w(t) is
// measurable, and Alekseev's formula bounds its effect. Limits are constants: engine.py refuses others.
//
// docs/proofs.md has the method. cover.py splits cells; engine.py compiles this file, calls `rounds_upward` at load, and
// chooses the settings and the units of the axes (weights). In a paced loop the variable of integration is eta with
// d eta = dt/v, not time.
//
//     Group::prove    start, then periods until every lane is over or lost
//     Group::period   tick, steps of the flow up to the next tick (without a clock: one step), new axes
//     Group::step     lengths are tried until `attempt` succeeds, then `commit`
//
// A settled set, which is inside a piece of the tail (tail.py), is followed no further: its runs were proved already.
#include <cstring>

#include "series.h"
#include "set.h"

struct Task {
  Tape tape;
  long states, kept, quadratures;      // states: first those kept over a tick, then the others of a flow; then quadratures
  const int32_t *start, *flow, *tick;  // operations, for each state (tick: -1 for a continuous loop)
  long signals;
  const int32_t* signal;
  long margin, travelled, clock;  // operation of the stop's margin; places of distance and time among states and quadratures, or -1
  long nonnegative;               // a state that is never negative, or -1
  long speed;                     // a state that stays above `slowest`, or -1
  long acceleration;              // operation of its rate in time, or -1
  double slowest, period_low, period_high, horizon;  // m/s, s
  double tolerance;                 // greatest remainder of a step, relative to the state
  double longest, shortest, first;  // of steps [s], paced [s^2/m]; a step of `shortest` or below may have any remainder
  long order, tables;
  const double* weights;  // units of the axes, tables x kept, by the logarithm of the speed, or by the time
  double keys_low, keys_high;
  // The tail: sets of settled states, slowest first. Every run from a set enters a slower one, or stops. With a
  // speed v in [low, high] and parameters p, a state i is in centre + by_speed (v - middle) + by_param (p - at) + [-width, width].
  long pieces, settled_params;
  const double *slow, *fast, *middle;                        // for each piece
  const double *settled_centre, *settled_by_speed, *settled_width;  // for each piece and kept state
  const double *settled_by_param, *settled_at;                      // for each piece, kept state and parameter; for each parameter
  const double *later_states;         // for each piece and state: low and high from there to the stop
  const double *later_signals;        // the same for each signal
  double stop_low, stop_high;         // speed at which a run ends [m/s]
  double latest;                      // time by which a settled run must stop [s]
};

constexpr long MOST_STEPS = 50000;    // of a group
constexpr int MOST_IN_PERIOD = 100;   // steps
constexpr int MOST_LIMITS = 6;        // limits that a set lies across in one tick; all limits of a flow
constexpr double WIDEST_SLIP = 0.3;        // a set of slips wider than this proves nothing: a smaller cell may
constexpr double NEVER = 1e300;
constexpr double LARGEST = 1e150;     // of states, also LARGEST_INPUT in equations.py
constexpr int SLICES = 24;            // of the speeds that a settled run passes, for its time to the stop

struct Quadrature { I c; std::vector<V> G; V R; };  // c + G p + [-R, R]

// When and where runs end: the margin falls at rates a. The captured set is the first one, after a run may have ended,
// with a margin of at most 0 in its middle. A run with margin m there, at time t, ends at t + m/a; m may be negative.
struct Ending {
  M captured{}, seen{};
  I inverse_rate = I(0.0), speed = I(0.0), pace = I(0.0);  // 1/a and rates of distance and time, in all late steps
  I margin_c = I(0.0), margin = I(0.0);            // of the captured set: at its centre, and over it
  std::vector<I> margin_slope;
  I time_c = I(0.0), way_c = I(0.0);
  std::vector<V> time_G, way_G;
  V time_R = fill(0.0), way_R = fill(0.0);
  Ending(int np, int nb) : margin_slope(np + nb, I(0.0)), time_G(np, fill(0.0)), way_G(np, fill(0.0)) {}
  void note_late_step(M late, I margin_rate, I speed_, I pace_) {
    I a = inverse(pick(late, -margin_rate, I(1.0)));
    auto add = [&](I& to, I x) { to = pick(late, pick(seen, hull(to, x), x), to); };
    add(inverse_rate, a), add(speed, speed_), add(pace, pace_);
    seen |= late;
  }
  // A quadrature at the end. From the captured set it goes on for m/a at a rate in `rate`. Its slope in each direction is
  // its own plus that of m/a times the middle of the rate.
  I at_end(I c, const std::vector<V>& G, V R, I rate) const {
    I alpha = point(inverse_rate.mid()), spread = symmetric(vmax(inverse_rate.h - alpha.h, inverse_rate.n + alpha.h));
    I tau = alpha * margin_c + spread * margin;  // from the captured set to the end, at the set's centre
    V slopes = fill(0.0), w = R;
    for (const I& d : margin_slope) slopes += (alpha * d).mag();
    I middle = point(rate.mid());
    for (size_t j = 0; j < margin_slope.size(); j++) w += ((j < G.size() ? point(G[j]) : I(0.0)) + middle * (alpha * margin_slope[j])).mag();
    return c + middle * tau + symmetric(w) + (rate - middle) * (tau + symmetric(slopes));
  }
  I time() const { return at_end(time_c, time_G, time_R, pace); }
  I way() const { return at_end(way_c, way_G, way_R, speed); }
  // About the half width that parameter j causes in a quadrature at the end: for the choice of a side to halve.
  V caused(const std::vector<V>& G, I rate, int j) const { return vabs(G[j] + rate.mid() * (inverse_rate.mid() * margin_slope[j].mid())); }
};

// Of an attempted step. NO_SERIES: a higher Taylor coefficient is undefined; a step of order 1 may have none.
enum Fate { ACCEPTED, TOO_LONG, NO_SERIES };

// Why a lane was lost, in the order of `FAILURES` in engine.py. NO_BOX: no step encloses the runs with a slip below 1 and
// a speed above `slowest`. TOO_WIDE: also an overflow, or an invalid operation, in any lane of the group.
enum Why { NOTHING, NO_VALUE, NEGATIVE, NO_BOX, TOO_WIDE, RISING, TOO_MANY_STEPS, ENDED_AT_START };

struct Group {
  const Task& task;
  const int n, nb, np, nd, K;
  const bool sampled;
  const I period_;
  std::vector<int> limits, tick_limits, state_op;
  bool nested = false;  // a limit of the flow reads another one
  Program flow, tick, starts, margin_, fall;
  // The equations' series, each over another set. mid: at C. whole: over X and C, with slopes. rest: over B, for the
  // remainder. box: over B, for rates. edge: on faces of B. jac: over B, with derivatives by states and disturbances.
  // falling: the speed's rate over settled states.
  Series mid, whole, rest, box, edge, jac, at_tick, at_tick_mid, falling;
  std::vector<Chord> chords, tick_chords;
  Set set;
  std::vector<Quadrature> rows;
  // Within a period, all runs are in C + J (p, r, w), p, r, w in [-1, 1], and in X. C is the Taylor value at the centre
  // plus the remainder and the disturbance of every run.
  std::vector<I> C, J, X;
  int used;                             // directions of J that are not 0
  bool fresh = false;                   // `mid` and `whole` hold order 0 at C and X, with real limits
  std::vector<I> B, f, push, remainder; // of a step: a box no run leaves, rates in it, effect of disturbances
  M crossing{};
  std::vector<V> top, bottom;   // of signals
  std::vector<I> now;           // of signals, within the last step
  std::vector<V> above, below;  // every run of the cell goes above, and below, these values of the signals; bottom and below are negated
  std::vector<V> reach;         // greatest half width that each parameter causes in the slip, or in state 0 without a slip
  std::vector<V> pmid, phalf;   // middle and half width of each parameter
  const volatile int32_t* stop; // not 0 once the caller wants no result
  // alive: still followed. dead: the proof failed. done: ended, or at the horizon (timed). ended: a run may have ended.
  M alive{}, dead{}, done{}, timed{}, ended{};
  M doomed{};                                   // lanes that are dead once the attempted step is committed
  int why[LANES];                               // why a lane was lost
  Ending end;
  M settled{};                                  // lanes whose runs are in the tail; their time and distance at the stop
  I settled_time = I(0.0), settled_way = I(0.0);
  std::vector<V> settled_time_reach, settled_way_reach;  // about the half width that each parameter causes in them
  I elapsed = I(0.0), gone = I(0.0);  // the variable of integration up to this period, and in it
  // box_limit: 0.6 of the last length without a box; grows by 1 % a step. cross_step: longest step across a limit.
  // excess: greatest remainder of the step, in tolerances. about: approximate time or eta, for the choice of weights.
  double h_next = 0, about = 0, box_limit = NEVER, cross_step = NEVER, excess = 0;
  long steps = 0;
  bool begun = false;

  static std::vector<int> roots(const int32_t* a, long count) { return std::vector<int>(a, a + count); }
  static std::vector<int> flow_roots(const Task& t) {
    std::vector<int> r = roots(t.flow, t.states + t.quadratures);
    r.insert(r.end(), t.signal, t.signal + t.signals);
    r.push_back((int)t.margin);
    return r;
  }
  Group(const Task& t, const volatile int32_t* stop_)
      : task(t), n((int)t.states), nb((int)t.kept), np((int)t.tape.params), nd(np + nb + (t.period_high > 0 ? MOST_LIMITS : 0)), K((int)t.order),
        sampled(t.period_high > 0), period_(span(fill(t.period_low), fill(t.period_high))), state_op(n, -1),
        flow(t.tape, flow_roots(t)), tick(t.tape, roots(t.tick, t.states)), starts(t.tape, roots(t.start, t.states + t.quadratures)), margin_(t.tape, {(int)t.margin}), fall(t.tape, {(int)(t.acceleration >= 0 ? t.acceleration : t.margin)}),
        mid(t.tape, K, 0), whole(t.tape, K, nd), rest(t.tape, K + 1, 0), box(t.tape, 1, 0), edge(t.tape, 1, 0), jac(t.tape, 0, n + MOST_LIMITS),
        at_tick(t.tape, 0, nd), at_tick_mid(t.tape, 0, 0), falling(t.tape, 0, 0), chords(t.tape.count), tick_chords(t.tape.count),
        set(nb, np), rows(t.quadratures), C(n), J(n * nd), X(n), used(np + nb), B(n), f(n), push(n), remainder(n),
        top(t.signals), bottom(t.signals), now(t.signals), above(t.signals), below(t.signals), reach(np), pmid(np), phalf(np), stop(stop_), end(np, nb), settled_time_reach(np), settled_way_reach(np) {
    for (int i : flow.list) if (is_limit(i)) limits.push_back(i);
    for (int i : tick.list) if (is_limit(i)) tick_limits.push_back(i);
    for (int i : limits)
      for (int j : Program(t.tape, {t.tape.a[i]}).list) nested |= is_limit(j);
    for (int i = 0; i < t.tape.count; i++) if (t.tape.code[i] == STATE && t.tape.index[i] < n) state_op[t.tape.index[i]] = i;
    whole.centre = &mid, at_tick.centre = &at_tick_mid;
    mid.chords = whole.chords = rest.chords = jac.chords = chords.data();
    at_tick.chords = at_tick_mid.chords = tick_chords.data();
    rest.real_limits = jac.real_limits = false;
    jac.own = n;
    for (int i : limits) if ((int)jac.seeds.size() < MOST_LIMITS) jac.seeds.push_back(i);
  }
  bool is_limit(int i) const { return task.tape.code[i] == CLAMP || task.tape.code[i] == ROUND; }
  void note(M which, Why because) { for (int l = 0; l < LANES; l++) if (which[l] && alive[l] && !doomed[l]) why[l] = because; }
  void lose(M which, Why because) { note(which, because), dead |= which & alive, alive &= ~which; }
  void doom(M which, Why because) { note(which, because), doomed |= which; }

  // Values of parameters and states in a series. `load_params` also clears what it has cached.

  void load_params(Series& s, bool centre) {
    s.forget();
    for (int i = 0; i < task.tape.count; i++)
      if (task.tape.code[i] == PARAM) {
        int p = task.tape.index[i];
        s.value(i, 0) = centre ? point(pmid[p]) : point(pmid[p]) + symmetric(phalf[p]);
        if (s.nd && &s != &jac) s.slope(i, 0)[p] = point(phalf[p]);
      }
  }
  void load_states(Series& s, const std::vector<I>& at, bool slopes) {
    for (int k = 0; k < n; k++) {
      int i = state_op[k];
      if (i < 0) continue;
      s.value(i, 0) = at[k];
      if (slopes) for (int j = 0; j < s.nd; j++) s.slope(i, 0)[j] = J[k * nd + j];
    }
  }
  // Coefficient k + 1 of the states from coefficient k of their rates.
  void integrate(Series& s, int k) {
    I inv = over(k + 1);
    for (int i = 0; i < n; i++) {
      if (state_op[i] < 0) continue;
      int r = task.flow[i];
      bool still = s.kind[r] < 2 && k;
      s.value(state_op[i], k + 1) = still ? I(0.0) : s.value(r, k) * inv;
      for (int j = 0; j < s.nd; j++) s.slope(state_op[i], k + 1)[j] = still ? I(0.0) : s.slope(r, k)[j] * inv;
    }
  }
  I coefficient(const Series& s, int op, int k) const { return s.kind[op] < 2 && k ? I(0.0) : s.value(op, k); }
  I slope_of(const Series& s, int op, int k, int j) const { return !s.kind[op] || (s.kind[op] < 2 && k) ? I(0.0) : s.slope(op, k)[j]; }
  I lower_limit(const Series& s, int i) const { int b = task.tape.b[i]; return b < 0 ? I(-NEVER) : s.value(b, 0); }
  I upper_limit(const Series& s, int i) const { int c = task.tape.c[i]; return c < 0 ? I(NEVER) : s.value(c, 0); }

  // The chord of a limit over a range: exact unless the range lies across it. A rounding is x + w, |w| <= 1/2.
  Chord chord_over(I raw, int i, const Series& s) const {
    if (task.tape.code[i] == ROUND) return {fill(1.0), I(0.0), fill(0.5)};
    I low = lower_limit(s, i), high = upper_limit(s, i);
    V a = raw.low(), b = raw.h, zero = fill(0.0);
    M linear = (a >= low.h) & (b <= high.low()), above = a >= high.h, under = b <= low.low();
    V wide = vmax(b - a, fill(1e-300)), fa = vmin(vmax(a, low.h), high.h), fb = vmin(vmax(b, low.h), high.h);
    Chord r;
    r.lambda = linear ? fill(1.0) : (above | under) ? zero : vmin(vmax((fb - fa) / wide, zero), fill(1.0));
    I slope = point(r.lambda);
    auto gap = [&](I at) { return clamped(at, low, high) - slope * at; };
    I gaps = hull(gap(point(a)), gap(point(b)));  // the gap is extreme at the ends, or at a limit between them
    for (int side = 0; side < 2; side++) {
      if ((side ? task.tape.c[i] : task.tape.b[i]) < 0) continue;
      I limit = side ? high : low;
      M in = (limit.h >= a) & (limit.low() <= b);
      gaps = pick(in, hull(gaps, gap(limit)), gaps);
    }
    V middle = gaps.mid();
    r.c = pick(linear, I(0.0), pick(above, high, pick(under, low, point(middle))));
    r.delta = (linear | above | under) ? zero : vmax(gaps.h - middle, gaps.n + middle);
    return r;
  }

  // Attempts at a step.

  // Order 0 of all operations at the start of a step, with limits as they are.
  void evaluate_at_start() {
    if (fresh) return;
    mid.real_limits = whole.real_limits = true, whole.nd = used;
    load_states(mid, C, false), mid.advance(flow, 0);
    std::vector<I> every(n);
    for (int i = 0; i < n; i++) every[i] = hull(X[i], C[i]);  // the mean value theorem goes from a point of C to one of X
    load_states(whole, every, true), whole.advance(flow, 0);
    fresh = true;
  }

  // A length that ends short of the next limit. While the set crosses one, it is a tenth of the time that this takes.
  double shorten_before_limits(double h) {
    evaluate_at_start();
    integrate(mid, 0), mid.advance(flow, 1);
    V want = fill(h), near = fill(NEVER);
    for (int i : limits) {
      I raw = whole.value(task.tape.a[i], 0);
      V speed = vabs(coefficient(mid, task.tape.a[i], 1).mid()) + 1e-9;
      V mine = vmax(0.1 * raw.width() / speed, fill(task.shortest));
      for (int side : {task.tape.b[i], task.tape.c[i]}) {
        if (side < 0) continue;
        I limit = whole.value(side, 0);
        V gap = raw.low() > limit.h ? raw.low() - limit.h : limit.low() > raw.h ? limit.low() - raw.h : fill(0.0);
        want = vmin(want, vmax(gap * 0.9 / speed, mine));
      }
      near = vmin(near, mine);
    }
    cross_step = std::fmax(least(alive ? near : fill(NEVER)), task.shortest);
    return least(alive ? want : fill(h));
  }

  // A box B that no run leaves within [0, h]: in each direction, X + [0, h] f(B) is in it, or the rates on its faces point
  // inward. (With f continued constantly outside of B, neither kind of direction lets a run out.) Also finds the chords of
  // all limited numbers; false if there is no such box. `forced` holds the limit and its chord, so that one box serves both.
  bool enclose(double h) {
    const int s0 = (int)task.nonnegative;
    const I HH = span(fill(0.0), fill(h));
    std::vector<I> raw0, raw;
    for (int i : limits) raw0.push_back(whole.value(task.tape.a[i], 0));
    raw = raw0;
    for (Series* one : {&box, &edge}) one->real_limits = true, one->use_forced = !limits.empty();
    auto rates_in = [&](Series& at, const std::vector<I>& where, std::vector<I>& to) {
      for (size_t q = 0; q < limits.size(); q++) {
        int i = limits[q];
        Chord& r = chords[i] = chord_over(raw[q], i, whole);
        I relaxed = point(r.lambda) * raw[q] + r.c + symmetric(r.delta);
        at.forced[i] = task.tape.code[i] == ROUND ? relaxed : hull(clamped(raw[q], lower_limit(whole, i), upper_limit(whole, i)), relaxed);
      }
      load_states(at, where, false);
      at.advance(flow, 0);
      M none{};
      for (int i = 0; i < n; i++) to[i] = at.value(task.flow[i], 0), none |= at.none[task.flow[i]];
      for (int q = 0; q < task.quadratures; q++) none |= at.none[task.flow[n + q]];
      if (!limits.empty()) integrate(at, 0), at.advance(flow, 1);
      for (int i : limits) none |= at.none[task.tape.a[i]];
      return none;
    };
    auto rates = [&](const std::vector<I>& where) { return rates_in(box, where, f); };
    std::vector<I> there(n);
    auto moved = [&](int i) {  // where a state may be by h
      I next = X[i] + HH * f[i];
      if (i == s0) next.n = vmin(next.n, fill(0.0));
      return next;
    };
    auto faces_inward = [&](int i) {  // no run crosses the faces of B in direction i: the rates there point inward
      std::vector<I> face = B;
      M ok = mask(true);
      for (bool upper : {false, true}) {
        face[i] = point(upper ? B[i].h : B[i].low());
        ok &= ~rates_in(edge, face, there);
        ok &= upper ? there[i].h <= 0 : there[i].n <= 0;
      }
      return ok;
    };
    auto wider = [](I x, double share) { return x + symmetric(x.width() * share + 1e-14); };
    rates(X);
    for (int i = 0; i < n; i++) B[i] = wider(X[i] + HH * f[i], 0.05);
    bool found = false;
    for (int tries = 0; tries < 40 && !found; tries++) {
      if (s0 >= 0) B[s0].n = vmin(B[s0].n, fill(0.0));
      M ok = ~rates(B);
      if (task.speed >= 0) ok &= B[task.speed].low() > task.slowest;
      if (s0 >= 0) ok &= B[s0].h < 1;
      for (int i = 0; i < n; i++) {
        I next = moved(i);
        M in = inside(next, B[i]);
        if (tries && any(~in & alive)) in |= faces_inward(i);
        ok &= in;
        if (any(~in)) B[i] = pick(in, B[i], wider(hull(next, B[i]), 0.1));
      }
      for (size_t q = 0; q < limits.size(); q++) {
        I next = raw0[q] + HH * coefficient(box, task.tape.a[limits[q]], 1);
        M in = inside(next, raw[q]);
        ok &= in;
        raw[q] = pick(in, raw[q], wider(hull(next, raw[q]), 0.1));
      }
      found = all(ok | ~alive | doomed);
    }
    if (!found) { box_limit = 0.6 * h; return false; }
    for (int again = 0; again < 2; again++) {  // X + [0, h] f(B) holds the runs as well, and is narrower
      if (again) rates(B);
      for (int i = 0; i < n; i++) B[i] = pick(alive, meet(moved(i), B[i]), B[i]);
    }
    // Where slip is 0 its rate must not be negative: then no run leaves {slip >= 0}.
    M at_zero = s0 >= 0 ? (M)(B[s0].low() <= 0) & alive : M{};
    if (any(at_zero)) {
      std::vector<I> face = B;
      face[s0] = I(0.0);
      M wrong = rates_in(edge, face, there);
      doom(at_zero & (wrong | ~(there[s0].n <= 0)), NEGATIVE);
    }
    rates(B);
    crossing = M{};
    for (int i : limits) crossing |= chords[i].delta > 0;
    return true;
  }

  // The effect of the limits' disturbances on the states by the end of a step; false if no bound is found.
  bool bound_disturbances(double h) {
    for (I& x : push) x = I(0.0);
    if (!any(crossing)) return true;
    const I HH = span(fill(0.0), fill(h));
    jac.widths.assign(task.tape.count, fill(0.0));  // the range of a limited number includes its disturbance
    for (int i : limits) jac.widths[i] = chords[i].delta;
    load_states(jac, B, false);
    for (int i = 0; i < n; i++) if (state_op[i] >= 0) for (int j = 0; j < jac.nd; j++) jac.slope(state_op[i], 0)[j] = I(i == j ? 1.0 : 0.0);
    jac.advance(flow, 0), jac.spread_none(flow);
    if (nested || jac.seeds.size() < limits.size()) doom(crossing, NO_VALUE);
    for (int i = 0; i < n + task.quadratures; i++) doom(crossing & jac.none[task.flow[i]], NO_VALUE);
    for (size_t q = 0; q < jac.seeds.size(); q++) {
      V delta = chords[jac.seeds[q]].delta;
      if (!any((delta > 0) & alive)) continue;
      // Y is a box for the flow's derivative by w: Y = b + [0, h] A Y, with b and A over the box of the step.
      std::vector<I> b(n), Y(n), y(n);
      for (int i = 0; i < n; i++) Y[i] = b[i] = slope_of(jac, task.flow[i], 0, n + (int)q);
      bool ok = false;
      for (int tries = 0; tries < 30 && !ok; tries++) {
        M in = mask(true);
        for (int i = 0; i < n; i++) {
          I sum(0.0);
          for (int j = 0; j < n; j++) sum = sum + slope_of(jac, task.flow[i], 0, j) * Y[j];
          y[i] = b[i] + HH * sum;
          in &= inside(y[i], Y[i]);
        }
        ok = all(in | ~alive);
        if (!ok) for (int i = 0; i < n; i++) Y[i] = hull(Y[i], y[i]) + symmetric(y[i].width() * 0.1 + 1e-14);
      }
      if (!ok) return false;
      for (int i = 0; i < n; i++) push[i] = push[i] + Y[i] * symmetric(delta) * HH;
    }
    return true;
  }

  // Everything that a step of length H, at most h, needs. Nothing of the set changes.
  Fate attempt(I H, double h, int order) {
    evaluate_at_start();
    doomed = M{};
    for (int i = 0; i < n + task.quadratures; i++) doom(whole.none[task.flow[i]], NO_VALUE);
    if (!any(alive & ~doomed)) return ACCEPTED;
    if (!enclose(h)) return TOO_LONG;
    if (any(crossing & alive)) {
      if (h > 1.01 * cross_step) return TOO_LONG;  // up to a limit first, then across it in short steps
      mid.real_limits = whole.real_limits = false, fresh = false;
      mid.advance(flow, 0), whole.advance(flow, 0);
    }
    for (int k = 0; k < order; k++) {
      if (k) mid.advance(flow, k), whole.advance(flow, k);
      integrate(mid, k), integrate(whole, k);
    }
    load_states(rest, B, false);
    for (int k = 0; k <= order; k++) rest.advance(flow, k), integrate(rest, k);
    M singular{};
    for (int i = 0; i < n + task.quadratures; i++) for (Series* s : {&mid, &whole, &rest}) singular |= s->none[task.flow[i]];
    if (order > 1 && any(singular & alive & ~doomed)) return NO_SERIES;
    doom(singular, NO_VALUE);
    if (!bound_disturbances(h)) return TOO_LONG;
    I power = power_of_step(H, order);
    excess = 1e-30;
    for (int i = 0; i < n; i++) {
      if (state_op[i] < 0) { remainder[i] = I(0.0); continue; }
      remainder[i] = rest.value(state_op[i], order + 1) * power;
      V share = remainder[i].width() / (task.tolerance * (vabs(C[i].h) + 1e-3));
      excess = std::fmax(excess, largest(alive & ~doomed ? share : fill(0.0)));
    }
    return order > 1 && excess > 2 && h > task.shortest ? TOO_LONG : ACCEPTED;
  }
  static I power_of_step(I H, int order) {
    I power(1.0);
    for (int k = 0; k <= order; k++) power = power * H;
    return power;
  }

  // The set at the end of the attempted step, and what signals, quadratures and margin did within it.
  void commit(I H, double h, int order) {
    dead |= doomed & alive, alive &= ~doomed;
    if (!any(alive)) return;
    I power = power_of_step(H, order);
    M early = time_now().h <= task.horizon;
    for (int s = 0; s < task.signals; s++) {
      I start = whole.value(task.signal[s], 0);
      // Only while no run can have ended, or be at the horizon, and not across a limit: `whole` then has chords without their disturbance.
      M seen = alive & early & ~ended & ~crossing & ~whole.none[task.signal[s]] & (M)(box.value((int)task.margin, 0).low() > 0);
      above[s] = seen ? vmax(above[s], start.low()) : above[s], below[s] = seen ? vmax(below[s], -start.h) : below[s];
      now[s] = signal_within(task.signal[s], order, h, H, s);
      top[s] = alive ? vmax(top[s], now[s].h) : top[s];
      bottom[s] = alive ? vmax(bottom[s], now[s].n) : bottom[s];
    }
    note_possible_end();
    for (int q = 0; q < task.quadratures; q++) move_quadrature(rows[q], task.flow[n + q], order, h, H, power);
    for (int i = 0; i < n; i++) {
      int a = state_op[i];
      if (a < 0) continue;
      I sum = mid.value(a, order);
      for (int k = order; k-- > 0;) sum = sum * H + mid.value(a, k);
      V w = fill(0.0);
      for (int j = 0; j < used; j++) {
        I g = whole.slope(a, order)[j];
        for (int k = order; k-- > 0;) g = g * H + whole.slope(a, k)[j];
        J[i * nd + j] = g, w += g.mag();
      }
      C[i] = sum + remainder[i] + push[i];
      X[i] = meet(C[i] + symmetric(w), B[i]);
      lose(empty(X[i]) | ~((X[i].n < LARGEST) & (X[i].h < LARGEST)), TOO_WIDE);
    }
    if (task.nonnegative >= 0) lose(~(X[task.nonnegative].width() < WIDEST_SLIP), TOO_WIDE);
    fresh = false, steps++;
  }

  // While a run may have ended, the margin must fall: its rates there bound the time from the captured set to the end.
  void note_possible_end() {
    M late = alive & (end.captured | (M)(box.value((int)task.margin, 0).low() <= 0) | box.none[task.margin]);
    ended |= late;
    if (!any(late)) return;
    if (limits.empty()) integrate(box, 0), box.advance(flow, 1);
    I rate = coefficient(box, (int)task.margin, 1);
    M falls = (rate.h < 0) & ~box.none[task.margin];
    lose(late & ~falls, RISING);
    auto quadrature_rate = [&](long q, double without) { return q < 0 ? I(without) : box.value(task.flow[q], 0); };
    end.note_late_step(late & falls, rate, quadrature_rate(task.travelled, 0.0), quadrature_rate(task.clock, 1.0));
  }

  void move_quadrature(Quadrature& row, int rate, int order, double h, I H, I power) {
    I sum(0.0), left = coefficient(rest, rate, order) * over(order + 1) * power;
    for (int k = order; k-- > 0;) sum = (sum + coefficient(mid, rate, k) * over(k + 1)) * H;
    for (int j = 0; j < used; j++) {
      I g(0.0);
      for (int k = order; k-- > 0;) g = (g + slope_of(whole, rate, k, j) * over(k + 1)) * H;
      if (j < np) {
        I both = point(row.G[j]) + g;
        row.G[j] = both.mid();
        left = left + symmetric((both - point(row.G[j])).mag());
      } else left = left + symmetric(g.mag());
    }
    if (any(crossing))
      for (int j = 0; j < jac.nd; j++) {
        V much = j < n ? push[j].mag() : (size_t)(j - n) < jac.seeds.size() ? chords[jac.seeds[j - n]].delta : fill(0.0);
        left = left + slope_of(jac, rate, 0, j) * symmetric(much) * span(fill(0.0), fill(h));
      }
    row.c = row.c + sum, row.R = row.R + left.mag();
  }

  // The values of a signal within a step.
  I signal_within(int g, int order, double h, I H, int s) {
    int state = -1;
    for (int i = 0; i < n; i++) if (state_op[i] == g) state = i;
    if (state < 0) {
      if (box.kind[g] < 2) return pick(whole.none[g], symmetric(fill(INFINITY)), whole.value(g, 0));
      I smooth = whole.value(g, 0) + span(fill(0.0), fill(h)) * rest.value(g, 1), natural = box.value(g, 0);
      I both = pick(crossing | whole.none[g] | rest.none[g], natural, meet(smooth, natural));
      return pick(box.none[g], symmetric(fill(INFINITY)), both);
    }
    std::vector<I> coefs(order + 1);
    I extra = hull(I(0.0), remainder[state]) + hull(I(0.0), push[state]), range(0.0);
    for (int k = 0; k <= order; k++) {
      V w = fill(0.0);
      for (int j = 0; j < used; j++) w += whole.slope(g, k)[j].mag();
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

  // One step of at most `left` (the exact time up to the tick, or none); returns whether the period is over. Without a
  // tick, each step is a period.
  bool step(I left) {
    double h = std::fmin(h_next, std::fmin(task.longest, box_limit)), room = largest(alive ? left.h : fill(0.0));
    box_limit = std::fmin(1.01 * box_limit, NEVER), cross_step = NEVER;
    if (!begun) h = std::fmin(h, task.first);
    if (!limits.empty()) h = shorten_before_limits(h);
    bool last = sampled && h > 0.9 * room;
    if (sampled && !last && h > 0.5 * room) h = 0.5 * room;
    int order = K;
    Fate fate = TOO_LONG;
    excess = 0;
    for (int tries = 0; tries < 40; tries++) {
      if (last) h = room;
      fate = attempt(last ? left : I(h), h, order);
      if (fate == ACCEPTED) break;
      fresh = false;  // higher orders may have set `none`
      if (fate == NO_SERIES) order = 1, h = std::fmin(h, task.first);
      else if (excess > 2) h = std::fmax(task.shortest, h * std::fmin(0.8, std::fmax(0.1, 0.8 * std::pow(excess, -1.0 / (order + 1)))));
      else if (h < task.shortest * 0.01 || h < 1e-12) break;
      else h *= 0.5;
      excess = 0, last = false;
    }
    begun = true;
    if (fate == ACCEPTED) commit(last ? left : I(h), h, order);
    else doomed = M{}, lose(alive, NO_BOX);
    gone = last ? period_ : gone + I(h), about += h;
    double best = order > 1 ? 0.9 * h * std::pow(std::fmax(excess, 1e-30), -1.0 / (order + 1)) : 1.5 * h;  // the remainder meets the tolerance
    h_next = std::fmax(task.shortest, std::fmin(best, sampled ? 2 * std::fmax(h, h_next * 0.5) : 2 * h));
    return last || !sampled;
  }

  // Periods.

  // C, J, X of the kept states from the set; the others are 0 until a tick gives them.
  void load_set() {
    used = np + nb;
    for (int i = 0; i < n; i++) {
      bool kept = i < nb;
      C[i] = kept ? point(set.c[i]) : I(0.0), X[i] = kept ? set.range(i) : I(0.0);
      for (int j = 0; j < nd; j++) J[i * nd + j] = I(0.0);
      if (!kept) continue;
      for (int j = 0; j < np; j++) J[i * nd + j] = point(set.G[i * np + j]);
      for (int j = 0; j < nb; j++) J[i * nd + np + j] = point(set.B[i * nb + j]) * point(set.r[j]);
      if (i == task.nonnegative) X[i].n = vmin(X[i].n, fill(0.0));
    }
    fresh = false;
  }

  // A tick: every state through the tick's operations, with one direction for each limit that the set lies across.
  void apply_tick() {
    at_tick.real_limits = at_tick_mid.real_limits = true, at_tick.nd = np + nb;
    at_tick.widths.clear(), at_tick.seeds.clear(), at_tick.own = -1;
    load_states(at_tick_mid, C, false), at_tick_mid.advance(tick, 0);
    load_states(at_tick, X, true), at_tick.advance(tick, 0);
    std::vector<V> delta(task.tape.count, fill(0.0));
    for (int i : tick_limits) {
      tick_chords[i] = chord_over(at_tick.value(task.tape.a[i], 0), i, at_tick);
      delta[i] = tick_chords[i].delta;
      if (any((delta[i] > 0) & alive)) at_tick.seeds.push_back(i);
    }
    if (at_tick.seeds.size() > MOST_LIMITS) { lose(alive, NO_VALUE); return; }
    at_tick.real_limits = at_tick_mid.real_limits = false;
    // The values of a limited number over the set include its disturbance; along its own direction it has this size.
    at_tick.own = np + nb, at_tick.widths = at_tick.seed_scale = delta;
    at_tick.nd = used = np + nb + (int)at_tick.seeds.size();
    at_tick_mid.advance(tick, 0), at_tick.advance(tick, 0);
    std::vector<I> c = C, x = X, slopes = J;
    M bad{};
    for (int i = 0; i < n; i++) {
      int r = task.tick[i];
      if (r < 0) continue;
      c[i] = at_tick_mid.value(r, 0);
      V w = fill(0.0);
      for (int q = 0; q < used; q++) slopes[i * nd + q] = slope_of(at_tick, r, 0, q), w += slopes[i * nd + q].mag();
      x[i] = meet(at_tick.value(r, 0), c[i] + symmetric(w));
      bad |= at_tick.none[r] | at_tick_mid.none[r] | empty(x[i]);
    }
    C = c, X = x, J = slopes;
    lose(bad, NO_VALUE);
    fresh = false;
  }

  const double* weights_now() {
    double key = task.speed >= 0 ? std::log(std::fmax(least(alive ? set.c[task.speed] : fill(NEVER)), 1e-3)) : about;
    double place = (key - task.keys_low) / std::fmax(task.keys_high - task.keys_low, 1e-9) * task.tables;
    return task.weights + nb * (long)std::fmin(std::fmax(place, 0), task.tables - 1);
  }

  // A tick, the flow up to the next one, and new axes; `seen` is called after every step.
  template <class Seen> void period(long number, Seen seen) {
    if (sampled) apply_tick();
    gone = I(0.0);
    int count = 0;
    for (bool is_over = false; !is_over && any(alive) && !*stop;) {
      is_over = step(sampled ? period_ - gone : I(NEVER));
      seen();
      if (++count > MOST_IN_PERIOD || steps > MOST_STEPS) lose(alive, TOO_MANY_STEPS);
    }
    elapsed = sampled ? period_ * I((double)(number + 1)) : elapsed + gone;
  }
  void renew() {
    M broken{};
    renew_axes(set, C, J, nd, used, weights_now(), task.nonnegative, broken);
    for (int i = 0; i < nb; i++) broken |= ~((vabs(set.c[i]) < LARGEST) & (set.r[i] < LARGEST));
    lose(broken, TOO_WIDE);
    int first = task.nonnegative >= 0 ? (int)task.nonnegative : 0;
    if (nb > 0) for (int p = 0; p < np; p++) reach[p] = alive ? vmax(reach[p], vabs(set.G[first * np + p])) : reach[p];
  }

  void look_at_margin() {
    mid.real_limits = whole.real_limits = true, whole.nd = used;
    load_states(mid, C, false), mid.advance(margin_, 0), load_states(whole, X, true), whole.advance(margin_, 0);
    lose(mid.none[task.margin] | whole.none[task.margin], NO_VALUE);
  }
  // Whether all runs have ended, or are at the horizon. The margin reads only states that a tick does not change.
  void end_runs() {
    gone = I(0.0);
    load_set();
    look_at_margin();
    int m = (int)task.margin;
    I margin = whole.value(m, 0);
    M capture = alive & ended & ~end.captured & (margin.mid() <= 0);
    if (any(capture)) {
      auto set_ = [&](I& to, I from) { to = pick(capture, from, to); };
      set_(end.margin_c, mid.value(m, 0)), set_(end.margin, margin), set_(end.time_c, elapsed);
      for (int j = 0; j < np + nb; j++) set_(end.margin_slope[j], slope_of(whole, m, 0, j));
      auto take = [&](long q, I& c, std::vector<V>& G, V& R) {
        if (q < 0) return;
        V rest_ = fill(0.0);
        if (q < n) for (int j = 0; j < nb; j++) rest_ += vabs(set.B[q * nb + j]) * set.r[j];
        else rest_ = rows[q - n].R;
        set_(c, q < n ? C[q] : rows[q - n].c);
        for (int j = 0; j < np; j++) G[j] = capture ? (q < n ? set.G[q * np + j] : rows[q - n].G[j]) : G[j];
        R = capture ? rest_ : R;
      };
      take(task.clock, end.time_c, end.time_G, end.time_R), take(task.travelled, end.way_c, end.way_G, end.way_R);
      end.captured |= capture;
    }
    M is_over = alive & end.captured & (margin.h < 0);
    M late = alive & ~is_over & (M)(time_now().low() >= task.horizon);
    timed |= late, done |= is_over | late, alive &= ~(is_over | late);
    settle();
  }

  // A quadrature, or a state that is one, at this time.
  struct Sum { I c; std::vector<V> G; V R; };
  Sum sum_of(long q, I otherwise) const {
    if (q < 0) return {otherwise, std::vector<V>(np, fill(0.0)), fill(0.0)};
    if (q >= n) return {rows[q - n].c, rows[q - n].G, rows[q - n].R};
    Sum s{C[q], std::vector<V>(np), fill(0.0)};
    for (int j = 0; j < np; j++) s.G[j] = set.G[q * np + j];
    for (int j = 0; j < nb; j++) s.R += vabs(set.B[q * nb + j]) * set.r[j];
    return s;
  }

  // Which lanes lie within the piece of the tail that `piece` names for each lane (-1: none).
  M within(const int* piece) const {
    auto gather = [&](const double* from, long width, long i) {
      V x;
      for (int l = 0; l < LANES; l++) x[l] = piece[l] < 0 ? 0.0 : from[piece[l] * width + i];
      return point(x);
    };
    const int v = (int)task.speed, tp = (int)task.settled_params;
    M in = mask(true);
    for (int l = 0; l < LANES; l++) if (piece[l] < 0) in[l] = 0;
    I faster = point(set.c[v]) - gather(task.middle, 1, 0);
    for (int i = 0; i < nb; i++) {
      if (i == v) continue;
      I by_speed = gather(task.settled_by_speed, nb, i);
      I off = point(set.c[i]) - gather(task.settled_centre, nb, i) - by_speed * faster;
      V spread = fill(0.0);
      for (int j = 0; j < np; j++) {
        I g = point(set.G[i * np + j]) - by_speed * point(set.G[v * np + j]);
        if (j < tp) {
          I by_param = gather(task.settled_by_param, nb * tp, i * tp + j);
          off = off - by_param * (point(pmid[j]) - I(task.settled_at[j]));
          g = g - by_param * point(phalf[j]);
        }
        spread += g.mag();
      }
      for (int l = 0; l < nb; l++) spread += (point(set.B[i * nb + l]) - by_speed * point(set.B[v * nb + l])).mag() * set.r[l];
      in &= off.mag() + spread <= gather(task.settled_width, nb, i).h;
    }
    return in;
  }

  // Ends the lanes that have settled. Every run passes each speed down to the stop once, with states in `later_states`:
  // time and distance are integrals of 1/a and v/a over the speed v, a being the rate at which it falls.
  void settle() {
    if (!task.pieces || !any(alive & ~ended)) return;
    const int v = (int)task.speed;
    int piece[LANES];
    bool some = false;
    for (int l = 0; l < LANES; l++) {
      piece[l] = -1;
      if (!alive[l] || ended[l]) continue;
      for (long k = task.pieces; k-- > 0;)
        if (task.slow[k] <= -X[v].n[l] && X[v].h[l] <= task.fast[k]) { piece[l] = (int)k, some = true; break; }
    }
    if (!some) return;
    M in = within(piece) & alive;
    if (!any(in)) return;
    auto slowing = [&](I speed, M& none) {
      std::vector<I> at(n);
      for (int i = 0; i < n; i++)
        for (int l = 0; l < LANES; l++) {
          const double* ends = task.later_states + 2 * (std::max(piece[l], 0) * n + i);
          at[i].n[l] = -ends[0], at[i].h[l] = ends[1];
        }
      at[v] = speed;
      load_states(falling, at, false), falling.advance(fall, 0);
      I a = -falling.value((int)task.acceleration, 0);
      none |= falling.none[task.acceleration] | ~(a.low() > 0);
      return inverse(pick(none, I(1.0), a), none);
    };
    M none{};
    I stop_speed = span(fill(task.stop_low), fill(task.stop_high)), time(0.0), way(0.0), above_ = point(set.c[v]);
    for (int k = 1; k <= SLICES; k++) {
      V next;
      for (int l = 0; l < LANES; l++) next[l] = set.c[v][l] * std::pow(task.stop_high / set.c[v][l], (double)k / SLICES);
      I below_ = k < SLICES ? point(vmin(vmax(next, fill(task.stop_high)), above_.h)) : stop_speed;
      I inv = slowing(hull(above_, below_), none);
      time = time + (above_ - below_) * inv;
      way = way + scaled((above_ - below_) * (above_ + below_), 0.5) * inv;
      above_ = below_;
    }
    I alpha = slowing(X[v], none);
    auto total = [&](const Sum& now_, I integral, I rate, std::vector<V>& reach_) {
      V w = now_.R;
      for (int j = 0; j < np; j++) {
        V mine = (point(now_.G[j]) + rate * point(set.G[v * np + j])).mag();
        reach_[j] = in ? mine : reach_[j], w += mine;
      }
      for (int j = 0; j < nb; j++) w += (rate * point(set.B[v * nb + j])).mag() * set.r[j];
      return now_.c + integral + symmetric(w);
    };
    I stop_time = total(sum_of(task.clock, elapsed), time, alpha, settled_time_reach);
    I stop_way = total(sum_of(task.travelled, I(0.0)), way, alpha * X[v], settled_way_reach);
    in &= ~none & (M)(stop_time.h <= task.latest) & ~empty(stop_time);
    settled_time = pick(in, stop_time, settled_time), settled_way = pick(in, stop_way, settled_way);
    for (int s = 0; s < task.signals; s++)
      for (int l = 0; l < LANES; l++) {
        if (!in[l]) continue;
        const double* ends = task.later_signals + 2 * (piece[l] * task.signals + s);
        bottom[s][l] = std::fmax(bottom[s][l], -ends[0]), top[s][l] = std::fmax(top[s][l], ends[1]);
      }
    settled |= in, done |= in, alive &= ~in;
  }

  void start(const double* cells, long count) {
    alive = mask(true), dead = done = timed = ended = doomed = settled = M{};
    for (int& w : why) w = NOTHING;
    end = Ending(np, nb), elapsed = I(0.0);
    steps = 0, h_next = task.first, about = 0, box_limit = NEVER, begun = false;
    for (int p = 0; p < np; p++)
      for (int l = 0; l < LANES; l++) {
        const double* c = cells + 2 * np * (l < count ? l : count - 1) + 2 * p;
        double m = 0.5 * (c[0] + c[1]);
        pmid[p][l] = m, phalf[p][l] = std::fmax(c[1] - m, m - c[0]);
      }
    for (Series* s : {&mid, &rest, &whole, &box, &edge, &jac, &at_tick, &at_tick_mid, &falling}) load_params(*s, s == &mid || s == &at_tick_mid);
    at_tick.real_limits = at_tick_mid.real_limits = true, at_tick.nd = np + nb;
    at_tick.widths.clear(), at_tick.seeds.clear(), at_tick.own = -1;
    at_tick_mid.advance(starts, 0), at_tick.advance(starts, 0);
    for (V& x : set.B) x = fill(0.0);
    for (int i = 0; i < nb; i++) {
      int r = task.start[i];
      I c = at_tick_mid.value(r, 0);
      set.c[i] = c.mid(), set.B[i * nb + i] = fill(1.0);
      I e = c - point(set.c[i]);
      for (int j = 0; j < np; j++) {
        I d = slope_of(at_tick, r, 0, j);
        set.G[i * np + j] = d.mid(), e = e + symmetric((d - point(set.G[i * np + j])).mag());
      }
      set.r[i] = e.mag();
    }
    for (int i = 0; i < n; i++) lose(at_tick.none[task.start[i]], NO_VALUE);
    if (task.nonnegative >= 0) lose(at_tick.value(task.start[task.nonnegative], 0).low() < 0, NEGATIVE);
    for (int q = 0; q < task.quadratures; q++) rows[q] = {at_tick.value(task.start[n + q], 0), std::vector<V>(np, fill(0.0)), fill(0.0)};
    for (auto* every : {&top, &above, &below, &bottom}) for (auto& x : *every) x = fill(-INFINITY);
    for (auto& x : reach) x = fill(0.0);
    load_set();
    look_at_margin();
    lose(~(whole.value((int)task.margin, 0).low() > 0), ENDED_AT_START);
  }

  // A lane that is lost goes along as one run of another, so that its numbers stay harmless.
  void refill() {
    M going = ~(dead | done), gone_ = ~alive;
    int good = -1;
    for (int l = 0; l < LANES; l++) if (going[l]) good = l;
    if (good < 0) return;
    for (int i = 0; i < nb; i++) {
      set.c[i] = gone_ ? fill(set.c[i][good]) : set.c[i], set.r[i] = gone_ ? fill(0.0) : set.r[i];
      for (int j = 0; j < np; j++) set.G[i * np + j] = gone_ ? fill(0.0) : set.G[i * np + j];
      for (int j = 0; j < nb; j++) set.B[i * nb + j] = gone_ ? fill(i == j) : set.B[i * nb + j];
    }
  }

  // For the choice of weights: one run, from whose axes the Jacobian of a period is read.
  void restart_axes() {
    for (int i = 0; i < nb; i++) {
      for (int j = 0; j < nb; j++) set.B[i * nb + j] = fill(i == j ? 1.0 : 0.0);
      set.r[i] = (vabs(set.c[i]) + 1e-3) * 1e-9;
      for (int j = 0; j < np; j++) set.G[i * np + j] = fill(0.0);
    }
  }

  I time_now() const {
    if (task.clock < n) return elapsed + gone;
    const Quadrature& row = rows[task.clock - n];
    V w = row.R;
    for (const V& g : row.G) w += vabs(g);
    return row.c + symmetric(w);
  }
  void write(double* out, int lane, bool sound) const {
    const int ns = (int)task.signals;
    bool fine = done[lane] && !dead[lane] && sound, stopped = fine && !timed[lane];
    I T = pick(settled, settled_time, end.time()), W = pick(settled, settled_way, end.way());
    out[0] = fine ? (timed[lane] ? 2 : 1) : 0;
    out[1] = stopped ? -T.n[lane] : 0, out[2] = stopped ? T.h[lane] : INFINITY;
    bool moved = stopped && task.travelled >= 0;
    out[3] = moved ? -W.n[lane] : task.travelled >= 0 ? 0 : -INFINITY, out[4] = moved ? W.h[lane] : INFINITY;
    double* signal = out + 5;
    for (int s = 0; s < ns; s++, signal += 2) signal[0] = fine ? -bottom[s][lane] : -INFINITY, signal[1] = fine ? top[s][lane] : INFINITY;
    for (int s = 0; s < ns; s++, signal += 2) signal[0] = sound ? -below[s][lane] : INFINITY, signal[1] = sound ? above[s][lane] : -INFINITY;
    for (int p = 0; p < np; p++) *signal++ = reach[p][lane];
    for (int p = 0; p < np; p++) *signal++ = settled[lane] ? settled_time_reach[p][lane] : end.caused(end.time_G, end.pace, p)[lane];
    for (int p = 0; p < np; p++) *signal++ = settled[lane] ? settled_way_reach[p][lane] : end.caused(end.way_G, end.speed, p)[lane];
    *signal = sound ? why[lane] : TOO_WIDE;
  }
};

extern "C" {

int lanes() { return LANES; }

// Whether sums, products and quotients are rounded upward as compiled, also those of numbers known at compile time.
int rounds_upward() {
  Upward upward;
  volatile double third = 3.0, tenth = 0.1;
  V a = fill(1.0) / fill(third), b = fill(tenth) * fill(tenth), c = fill(1.0) + fill(1e-30), d = fill(1.0) / fill(3.0);
  V negative = -fill(tenth) * fill(tenth), tiny = fill(1e-300 * tenth) * fill(1e-300 * tenth);
  return a[0] > 0x1.5555555555555p-2 && b[0] > 0x1.47ae147ae147bp-7 && c[0] > 1.0 && d[0] == a[0] &&
         -(fill(-1.0) / fill(third))[0] < a[0] && -negative[0] < b[0] && tiny[0] > 0;
}

// One operation on `count` pairs of intervals, for tests. codes: those of `Code`; out: low and high.
void apply(int code, long count, const double* a, const double* b, double* out) {
  Upward upward;
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
}

// Proves at most LANES cells, each params x (low, high), into `out`, a row of results for each (`Group::write`).
// scout, if not null: for each period the speed or time, the states and the Jacobian of one run.
// trail, if not null: for each step and each cell its time (low, high) and that of each signal; NaN once a cell is over.
// Returns the number of rows in scout or trail, which have room for `room` rows. A lane that is still followed when
// *stop becomes other than 0 is not proved.
long prove(const Task* task, long count, const double* cells, double* out, double* scout, double* trail, long room, const volatile int32_t* stop) {
  Upward upward;
  std::feclearexcept(FE_ALL_EXCEPT);
  const int nb = (int)task->kept, ns = (int)task->signals, width = 6 + 4 * ns + 3 * (int)task->tape.params;
  Group g(*task, stop);
  long written = 0;
  auto follow = [&]() {
    if (!trail || written >= room) return;
    double* to = trail + written++ * LANES * (2 + 2 * ns);
    for (int l = 0; l < LANES; l++, to += 2 + 2 * ns) {
      I t = g.time_now();
      to[0] = g.alive[l] ? -t.n[l] : NAN, to[1] = g.alive[l] ? t.h[l] : NAN;
      for (int s = 0; s < ns; s++) to[2 + 2 * s] = -g.now[s].n[l], to[3 + 2 * s] = g.now[s].h[l];
    }
  };
  auto report = [&]() {
    if (!scout || written >= room) return;
    double* to = scout + written++ * (1 + nb + nb * nb);
    to[0] = task->speed >= 0 ? g.X[task->speed].mid()[0] : g.about;
    for (int i = 0; i < nb; i++) to[1 + i] = g.X[i].mid()[0];
    for (int i = 0; i < nb; i++)
      for (int j = 0; j < nb; j++) to[1 + nb + i * nb + j] = g.J[i * g.nd + g.np + j].mid()[0] / g.set.r[j][0];
  };
  g.start(cells, count);
  for (long number = 0; any(g.alive) && !*stop; number++) {
    g.period(number, follow);
    if (*stop) break;
    report();
    g.renew();
    if (scout) g.restart_axes();
    g.refill();
    g.end_runs();
  }
  bool sound = !std::fetestexcept(FE_INVALID | FE_OVERFLOW | FE_DIVBYZERO);
  for (int l = 0; l < LANES && l < count; l++) g.write(out + width * l, l, sound);
  return written;
}
}
