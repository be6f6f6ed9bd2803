// A loop's equations on Taylor series whose coefficients are intervals with derivatives in `nd` directions.
//
// The equations are a list of operations, operands first (`equations.py`). Order k of an operation needs orders up to k of
// its operands. A function y(u) has its factor g = dy/du as an operand; order k of y needs g up to order k - 1 only. So g
// has a lag of 1: call k of `advance` computes its order k - 1. `dlag` is the same for derivatives along directions. At
// u = 0 a power u^2.1 has two derivatives but no third: with lags, a step of order 1 that starts there needs none.
#pragma once
#include <algorithm>
#include <vector>

#include "interval.h"

enum Code { CONST, TRUTH, PARAM, STATE, ADD, SUB, NEG, MUL, INV, CLAMP, ROUND, SELECT, MEET, LT, LE, EQ, NE, AND, OR, NOT, EXP, LOG, SIN, COS, ATAN, POWER };

struct Tape {
  long count;
  const int32_t *code, *a, *b, *c;  // operands; -1: none
  const double *low, *high;         // of constants
  const int32_t *index;             // of parameters and states
  long params, states;
};

// What the operations of one purpose (a flow, a tick) are, with their lags.
struct Program {
  std::vector<int> list, order, dorder, lag, dlag;
  std::vector<char> live;
  Program(const Tape& t, const std::vector<int>& roots) : lag(t.count, 1 << 20), dlag(t.count, 1 << 20), live(t.count, 0) {
    for (int r : roots) if (r >= 0) lag[r] = dlag[r] = 0, live[r] = 1;
    // A function's factor may come later in the list than the function, so this repeats until nothing changes.
    for (bool moved = true; moved;) {
      moved = false;
      auto ask = [&](int i, int l, int d) {
        if (i < 0) return;
        if (!live[i] || l < lag[i] || d < dlag[i]) moved = true, live[i] = 1, lag[i] = l < lag[i] ? l : lag[i], dlag[i] = d < dlag[i] ? d : dlag[i];
      };
      for (int i = (int)t.count - 1; i >= 0; i--) {
        if (!live[i]) continue;
        int l = lag[i], d = dlag[i];
        if (t.code[i] >= EXP) {
          ask(t.a[i], l, d);
          ask(t.b[i], l + 1 < d ? l + 1 : d, d + 1);
          ask(t.c[i], 0, 0);
        } else ask(t.a[i], l, d), ask(t.b[i], l, d), ask(t.c[i], l, d);
      }
    }
    order = sorted(t, [&](int i) { return lag[i]; });
    dorder = sorted(t, [&](int i) { return dlag[i]; });
    for (int i = 0; i < t.count; i++) if (live[i]) list.push_back(i);
  }
  // The live operations, each after those whose coefficient it needs in the same call of `Series::advance`.
  template <class Lag> std::vector<int> sorted(const Tape& t, Lag of) const {
    std::vector<int> out;
    std::vector<char> done(t.count, 0);
    std::vector<int> stack;
    for (int root = 0; root < t.count; root++) {
      if (!live[root]) continue;
      stack.push_back(root);
      while (!stack.empty()) {
        int i = stack.back(), waits = -1;
        if (done[i]) { stack.pop_back(); continue; }
        auto need = [&](int x, int least) { if (x >= 0 && x != i && !done[x] && of(x) == least) waits = x; };
        need(t.a[i], of(i)), need(t.b[i], of(i) + (t.code[i] >= EXP)), need(t.c[i], t.code[i] >= EXP ? 0 : of(i));
        if (waits >= 0) { stack.push_back(waits); continue; }
        done[i] = 1, out.push_back(i), stack.pop_back();
      }
    }
    return out;
  }
};

struct Chord { V lambda; I c; V delta; };  // a limited number is in lambda x + c + [-delta, delta]

struct Series {
  const Tape* tape;
  const int orders, most;  // greatest order, and number of directions
  int nd;                  // of the directions, those in use
  std::vector<I> v, d;
  std::vector<M> none;      // lanes in which an operation has no value
  std::vector<M> yes, no;   // of conditions: certainly true, certainly false
  std::vector<char> kind;   // 0: constant, 1: of the parameters only, 2: changes
  std::vector<char> has_value, has_slope;  // of what does not change
  bool real_limits = true;  // a limit is itself; else it is its chord, without the disturbance unless `widths` is set
  const Chord* chords = nullptr;
  const Series* centre = nullptr;  // the same at the centre of the set, for the mean value form at order 0
  std::vector<I> forced;           // of limits over a step: the hull of the limit and of its chord with disturbance
  bool use_forced = false;

  Series(const Tape& t, int orders, int nd)
      : tape(&t), orders(orders), most(nd ? nd : 1), nd(nd), v(t.count * (orders + 2)), d(t.count * (orders + 2) * most), none(t.count), yes(t.count), no(t.count), kind(t.count), forced(t.count), computed_in(t.count, -1) {
    forget();
    for (int i = 0; i < t.count; i++) {
      auto of = [&](int j) { return j < 0 ? 0 : (int)kind[j]; };
      int k = 0;
      switch (t.code[i]) {
        case CONST: case TRUTH: break;
        case PARAM: k = 1; break;
        case STATE: case CLAMP: case ROUND: k = 2; break;
        case EXP: case LOG: case SIN: case COS: case ATAN: case POWER: k = of(t.a[i]); break;
        default: k = std::max(of(t.a[i]), std::max(of(t.b[i]), of(t.c[i])));
      }
      kind[i] = k;
      for (int o = 0; o < orders + 2; o++) {
        value(i, o) = I(0.0);
        for (int j = 0; j < nd; j++) slope(i, o)[j] = I(0.0);
      }
      if (t.code[i] == CONST) value(i, 0) = span(fill(t.low[i]), fill(t.high[i]));
      if (t.code[i] == TRUTH) yes[i] = mask(t.low[i] != 0), no[i] = ~yes[i];
    }
  }
  INLINE I& value(int i, int k) { return v[i * (orders + 2) + k]; }
  const I& value(int i, int k) const { return v[i * (orders + 2) + k]; }
  INLINE I* slope(int i, int k) { return &d[(size_t)(i * (orders + 2) + k) * most]; }
  INLINE const I* slope(int i, int k) const { return &d[(size_t)(i * (orders + 2) + k) * most]; }

  // The coefficients of order `k` of all operations of a program (of those with a lag: of an earlier order).
  void advance(const Program& p, int k) {
    if (k == 0) { pass_number++; for (int i : p.list) if (kind[i] == 2) none[i] = M{}; }
    for (int i : p.order) if (k >= p.lag[i]) once(i, k - p.lag[i], has_value, &Series::values);
    if (nd == 0) return;
    for (int i : p.dorder) if (k >= p.dlag[i]) once(i, k - p.dlag[i], has_slope, &Series::slopes);
    if (k == 0 && centre) spread_none(p);
    // Once more, operands first: each value is also within the mean value form, and so are the values made from it.
    if (k == 0 && centre) pass_number++;
    if (k == 0 && centre) for (int i : p.list) {
      if (p.lag[i] || kind[i] < 2) continue;
      values(i, 0);
      if (p.dlag[i]) continue;
      slopes(i, 0);
      if (tape->code[i] != STATE && !is_truth(tape->code[i])) meet_mean_value(i);
    }
  }
  // Marks what is made from numbers that have no value, or no derivative: a factor may come after its function.
  void spread_none(const Program& p) {
    for (int i : p.list) {
      int a = tape->a[i], b = tape->b[i], c = tape->c[i];
      auto of = [&](int x) { return x < 0 ? M{} : none[x]; };
      none[i] |= tape->code[i] == SELECT ? of(a) | (yes[a] & of(c)) | (no[a] & of(b)) : tape->code[i] == MEET ? of(a) : of(a) | of(b) | of(c);
    }
  }
  // What does not change in a run is computed once a cell. `k` is the order after the lag.
  void once(int i, int k, std::vector<char>& has, void (Series::*compute)(int, int)) {
    if (kind[i] < 2) { if (k || has[i]) return; has[i] = 1; }
    (this->*compute)(i, k);
  }
  void forget() { has_value.assign(tape->count, 0), has_slope.assign(tape->count, 0); }
  static bool is_truth(int code) { return code == TRUTH || (code >= LT && code <= NOT); }
  void meet_mean_value(int i) {
    V w = fill(0.0);
    for (int j = 0; j < nd; j++) w += slope(i, 0)[j].mag();
    I mean = centre->value(i, 0) + symmetric(w), both = meet(mean, value(i, 0));
    M bad = empty(both) | none[i] | centre->none[i];
    value(i, 0) = pick(bad, value(i, 0), both);
  }

  void values(int i, int k) {
    const Tape& t = *tape;
    int a = t.a[i], b = t.b[i], c = t.c[i];
    if (k && kind[i] < 2) { return; }
    I& y = value(i, k);
    switch (t.code[i]) {
      case CONST: case TRUTH: case PARAM: case STATE: return;
      case ADD: y = value(a, k) + value(b, k); break;
      case SUB: y = value(a, k) - value(b, k); break;
      case NEG: y = -value(a, k); break;
      case MUL:
        if (kind[a] < 2) y = value(a, 0) * value(b, k);
        else if (kind[b] < 2) y = value(a, k) * value(b, 0);
        else if (a == b && k == 0) { I x = value(a, 0); y = x * x; y.n = vmin(y.n, fill(0.0)); }
        else { y = value(a, 0) * value(b, k); for (int j = 1; j <= k; j++) y = y + value(a, j) * value(b, k - j); }
        break;
      case INV:
        if (k == 0) { M bad{}; y = inverse(value(a, 0), bad); none[i] = none[a] | bad; return; }
        none[i] |= none[a];
        { I sum = value(a, 1) * value(i, k - 1); for (int j = 2; j <= k; j++) sum = sum + value(a, j) * value(i, k - j); y = -(sum * value(i, 0)); }
        break;
      case CLAMP: {
        I low = b < 0 ? I(-1e300) : value(b, 0), high = c < 0 ? I(1e300) : value(c, 0), x = value(a, 0);
        if (real_limits) {
          if (k == 0) y = use_forced ? forced[i] : clamped(x, low, high);
          else {
            M in = (x.low() >= low.h) & (x.h <= high.low()), out = (x.low() >= high.h) | (x.h <= low.low());
            I s = value(a, k);
            y = pick(in, s, pick(out, I(0.0), hull(I(0.0), s)));
          }
        } else {
          y = point(chords[i].lambda) * value(a, k);
          if (k == 0) { y = y + chords[i].c; if (!widths.empty()) y = y + symmetric(widths[i]); }
        }
        break;
      }
      case ROUND:  // x + w, |w| <= 1/2
        y = value(a, k);
        if (real_limits || !widths.empty()) {
          if (k == 0) y = use_forced ? forced[i] : y + symmetric(fill(0.5));
          else none[i] = mask(true);
        }
        break;
      case SELECT: {
        I s = value(b, k), u = value(c, k);
        y = pick(yes[a], u, pick(no[a], s, hull(s, u)));
        M mine = none[a] | (yes[a] & none[c]) | (no[a] & none[b]) | ~(yes[a] | no[a]);
        none[i] = k ? none[i] | mine : mine;
        return;
      }
      case MEET: {  // two expressions of one number: the second is used for its value only
        I x = value(a, k);
        if (k == 0) { I both = meet(x, value(b, 0)); M out = none[b] | empty(both); x = pick(out, x, both); }
        y = x;
        none[i] = k ? none[i] | none[a] : none[a];
        return;
      }
      case LT: yes[i] = value(a, 0).h < value(b, 0).low(), no[i] = value(a, 0).low() >= value(b, 0).h; break;
      case LE: yes[i] = value(a, 0).h <= value(b, 0).low(), no[i] = value(a, 0).low() > value(b, 0).h; break;
      case EQ: case NE: {
        I x = value(a, 0), z = value(b, 0);
        M same = (x.h <= z.low()) & (x.low() >= z.h), apart = (x.h < z.low()) | (z.h < x.low());
        yes[i] = t.code[i] == EQ ? same : apart, no[i] = t.code[i] == EQ ? apart : same;
        break;
      }
      case AND: yes[i] = yes[a] & yes[b], no[i] = no[a] | no[b]; break;
      case OR: yes[i] = yes[a] | yes[b], no[i] = no[a] & no[b]; break;
      case NOT: yes[i] = no[a], no[i] = yes[a]; break;
      default: {  // functions
        if (k == 0) {
          M bad{};
          I x = value(a, 0), s, co;
          switch (t.code[i]) {
            case EXP: y = exp_of(x, bad); break;
            case LOG: y = log_of(x, bad); break;
            case ATAN: y = atan_of(x, bad); break;
            case POWER: {
              if (tape->b[i] >= 0 && computed_in[i] == pass_number) return;
              computed_in[i] = pass_number;
              // u^e = u u^(e-1), whose factor g = e u^(e-1) is the second operand
              int less = has_power_factor(i) ? t.b[b] : -1;
              if (less < 0) { y = power_of(x, value(c, 0), bad); break; }
              once(t.c[less], 0, has_value, &Series::values);
              values(less, 0);
              bad |= none[less];
              y = x * value(less, 0);
              break;
            }
            default: sin_cos(x, s, co, bad); y = t.code[i] == SIN ? s : co;
          }
          none[i] = none[a] | bad;
          return;
        }
        I sum = scaled(value(a, k), k) * value(b, 0);
        for (int j = 1; j < k; j++) sum = sum + scaled(value(a, j), j) * value(b, k - j);
        y = sum * over(k);
        none[i] |= none[a] | none[b];
        return;
      }
    }
    M any_none = (a >= 0 ? none[a] : M{}) | (b >= 0 ? none[b] : M{}) | (c >= 0 ? none[c] : M{});
    none[i] = k ? none[i] | any_none : any_none;
  }

  // t += s x on all directions
  INLINE void add(I* to, I s, const I* x) { for (int j = 0; j < nd; j++) to[j] = to[j] + s * x[j]; }
  INLINE void clear(I* to) { for (int j = 0; j < nd; j++) to[j] = I(0.0); }

  void slopes(int i, int k) {
    const Tape& t = *tape;
    int a = t.a[i], b = t.b[i], c = t.c[i];
    if (kind[i] == 0 || (k && kind[i] < 2) || is_truth(t.code[i])) return;
    I* y = slope(i, k);
    switch (t.code[i]) {
      case PARAM: case STATE: return;
      case ADD: for (int j = 0; j < nd; j++) y[j] = slope(a, k)[j] + slope(b, k)[j]; return;
      case SUB: for (int j = 0; j < nd; j++) y[j] = slope(a, k)[j] - slope(b, k)[j]; return;
      case NEG: for (int j = 0; j < nd; j++) y[j] = -slope(a, k)[j]; return;
      case MUL:
        clear(y);
        if (kind[a] < 2) { add(y, value(a, 0), slope(b, k)); if (kind[a]) add(y, value(b, k), slope(a, 0)); return; }
        if (kind[b] < 2) { add(y, value(b, 0), slope(a, k)); if (kind[b]) add(y, value(a, k), slope(b, 0)); return; }
        if (a == b) { for (int j = 0; j <= k; j++) add(y, scaled(value(a, j), 2), slope(a, k - j)); return; }
        for (int j = 0; j <= k; j++) add(y, value(b, k - j), slope(a, j)), add(y, value(a, j), slope(b, k - j));
        return;
      case INV:
        if (k == 0) { clear(y); add(y, -(value(i, 0) * value(i, 0)), slope(a, 0)); return; }
        {  // y_k = -y_0 sum: its derivative is -(dy_0 sum + y_0 dsum)
          I sum = value(a, 1) * value(i, k - 1);
          for (int j = 2; j <= k; j++) sum = sum + value(a, j) * value(i, k - j);
          clear(y);
          add(y, -sum, slope(i, 0));
          for (int j = 1; j <= k; j++) add(y, -(value(i, 0) * value(i, k - j)), slope(a, j)), add(y, -(value(i, 0) * value(a, j)), slope(i, k - j));
        }
        return;
      case CLAMP: case ROUND: {
        if (t.code[i] == ROUND) { for (int j = 0; j < nd; j++) y[j] = slope(a, k)[j]; }
        else if (!real_limits) { for (int j = 0; j < nd; j++) y[j] = point(chords[i].lambda) * slope(a, k)[j]; }
        else {
          I low = b < 0 ? I(-1e300) : value(b, 0), high = c < 0 ? I(1e300) : value(c, 0), x = value(a, 0);
          M in = (x.low() >= low.h) & (x.h <= high.low()), out = (x.low() >= high.h) | (x.h <= low.low());
          I s = pick(in, I(1.0), pick(out, I(0.0), span(fill(0.0), fill(1.0))));
          for (int j = 0; j < nd; j++) y[j] = s * slope(a, k)[j];
        }
        if (own >= 0 && k == 0) for (size_t q = 0; q < seeds.size(); q++) if (seeds[q] == i) y[own + q] = y[own + q] + (seed_scale.empty() ? I(1.0) : point(seed_scale[i]));
        return;
      }
      case MEET: for (int j = 0; j < nd; j++) y[j] = slope(a, k)[j]; return;
      case SELECT:
        for (int j = 0; j < nd; j++) { I s = slope(b, k)[j], u = slope(c, k)[j]; y[j] = pick(yes[a], u, pick(no[a], s, hull(s, u))); }
        return;
      default: {  // functions
        clear(y);
        if (k == 0) { add(y, value(b, 0), slope(a, 0)); none[i] |= none[b]; return; }
        I inv = over(k);
        for (int j = 1; j <= k; j++) {
          add(y, scaled(value(b, k - j), j) * inv, slope(a, j));
          if (kind[b] == 2) add(y, scaled(value(a, j), j) * inv, slope(b, k - j));
        }
        return;
      }
    }
  }
  // Whether the factor of u^e is e times a power: then u^e is u u^(e-1).
  bool has_power_factor(int i) const { int b = tape->b[i]; return b >= 0 && tape->code[b] == MUL && tape->code[tape->b[b]] == POWER && tape->b[b] != i; }
  std::vector<long> computed_in;  // when a power was computed
  long pass_number = 0;
  int own = -1;            // first direction of the clamps' own disturbances
  std::vector<int> seeds;  // the clamps that have one
  std::vector<V> widths, seed_scale;  // of the clamps of a tick: the disturbance over the set, and along its direction
};
