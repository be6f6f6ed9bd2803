// Sets of states {c + G p + B r}: p in [-1, 1]^P are the cell's own parameters, r is a box in the axes B (Lohner).
#pragma once
#include <vector>

#include "interval.h"

struct Set {
  int n, np;
  std::vector<V> c, G, B, r;
  Set(int n, int np) : n(n), np(np), c(n), G(n * np), B(n * n), r(n) {}
  I range(int i) const {
    V w = fill(0.0);
    for (int j = 0; j < np; j++) w += vabs(G[i * np + j]);
    for (int j = 0; j < n; j++) w += vabs(B[i * n + j]) * r[j];
    return {w - c[i], w + c[i]};
  }
};

// An approximate Q of Lohner's QR of A (n x n): the columns are first sorted by length, longest first, so that the units of
// the states decide which axis is kept. `enclose_inverse` makes up for rounding.
static void orthonormalise(std::vector<V>& A, int n) {
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
  auto remove_earlier = [&](std::vector<V>& x, int j) {  // Gram and Schmidt, twice
    for (int pass = 0; pass < 2; pass++)
      for (int l = 0; l < j; l++) {
        V dot = fill(0.0);
        for (int i = 0; i < n; i++) dot += A[i * n + l] * x[i];
        for (int i = 0; i < n; i++) x[i] -= dot * A[i * n + l];
      }
    V norm = fill(0.0);
    for (int i = 0; i < n; i++) norm += x[i] * x[i];
    return norm;
  };
  std::vector<V> x(n), e(n), unit(n);
  for (int j = 0; j < n; j++) {
    V before = fill(0.0);
    for (int i = 0; i < n; i++) x[i] = A[i * n + j], before += x[i] * x[i];
    V norm = remove_earlier(x, j);
    M tiny = (norm <= 1e-16 * before) | (norm < 1e-200);  // no direction left: the unit vector with the largest rest
    if (any(tiny)) {
      V best = fill(-1.0);
      for (int u = 0; u < n; u++) {
        for (int i = 0; i < n; i++) unit[i] = fill(i == u ? 1.0 : 0.0);
        V left = remove_earlier(unit, j);
        M better = left > best;
        best = better ? left : best;
        for (int i = 0; i < n; i++) e[i] = better ? unit[i] : e[i];
      }
      norm = tiny ? best : norm;
      for (int i = 0; i < n; i++) x[i] = tiny ? e[i] : x[i];
    }
    V k;
    for (int i = 0; i < LANES; i++) k[i] = 1 / std::sqrt(norm[i]);
    for (int i = 0; i < n; i++) A[i * n + j] = x[i] * k;
  }
}

// Q^-1 = Q' (Q Q')^-1, which is in Q' (I + [-e, e]) with e = |I - Q Q'|/(1 - |I - Q Q'|) in the norm of rows.
static void enclose_inverse(const std::vector<V>& Q, std::vector<I>& inv, int n, M& lost) {
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

// The set of all C + J (p, r, w) with p, r, w in [-1, 1]: p keeps its matrix, r gets new axes, and all else goes into r.
// J has `nd` columns a row, of which `used` are not 0. The axes are orthogonal in units of 1/weight (powers of 2). The
// state `nonnegative`, if there is one, gets a centre that is not negative.
static void renew_axes(Set& set, const std::vector<I>& C, const std::vector<I>& J, int nd, int used, const double* weight, long nonnegative, M& lost) {
  const int n = set.n, np = set.np;
  std::vector<I> E(n), inv(n * n);
  std::vector<V> A(n * n);
  for (int i = 0; i < n; i++) {
    set.c[i] = i == nonnegative ? vmax(C[i].mid(), fill(0.0)) : C[i].mid();
    E[i] = C[i] - point(set.c[i]);
    for (int j = 0; j < np; j++) {
      I g = J[i * nd + j];
      set.G[i * np + j] = g.mid();
      E[i] = E[i] + symmetric((g - point(set.G[i * np + j])).mag());
    }
    for (int j = np + n; j < used; j++) E[i] = E[i] + symmetric(J[i * nd + j].mag());
    for (int j = 0; j < n; j++) A[i * n + j] = weight[i] * J[i * nd + np + j].mid();
  }
  orthonormalise(A, n);
  enclose_inverse(A, inv, n, lost);
  for (int l = 0; l < n; l++) {
    I mine(0.0);
    for (int i = 0; i < n; i++) mine = mine + inv[l * n + i] * scaled(E[i], weight[i]);
    V r = mine.mag();
    for (int j = 0; j < n; j++) {
      I sum(0.0);
      for (int i = 0; i < n; i++) sum = sum + inv[l * n + i] * scaled(J[i * nd + np + j], weight[i]);
      r += sum.mag();
    }
    set.r[l] = r;
    for (int i = 0; i < n; i++) set.B[i * n + l] = A[i * n + l] * (1 / weight[i]);
  }
}
