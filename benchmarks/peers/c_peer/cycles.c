/* Limit cycles and multipliers of vertical hoppers, one after the other, in scalar code.

   A turn is one period from the clock's phase 0.5, in flight (chart 0) or in stance (1). The
   state is integrated beside its derivatives by the state at the start (columns), by the pair
   of tableau.h, which cycles.py writes. */

#include <math.h>
#include <string.h>

#include "tableau.h"

#define INLINE static inline __attribute__((always_inline))
#define LOOP(i, n) for (int i = 0; i < (n); i++)

enum { m, M, K, B, L0, A, G, OMEGA, RETENTION };
enum { FLIGHT, STANCE };

/* Most numbers of a state with its columns: 4 x (1 + 4). */
#define MOST 20
/* Steps of a turn, turns of a hopper. More: hopeless hoppers cost more. Fewer: some are given
   up. */
#define STEPS 1000
#define TURNS 100
/* Events of a turn, corrections of an event. More: hopeless turns cost more. Fewer: good ones
   end. */
#define EVENTS 20
#define CORRECTIONS 20
/* Corrections (s) of an event that Euler's method makes, the last. Larger: its error, half
   their square times the rate of the field, would be seen. Smaller: more steps. */
#define CLOSE 1e-8
/* Residual of a cycle. Larger: multipliers of states beside the cycle. Smaller: error of the
   steps. */
#define RESIDUAL 1e-10
/* Bounds of the ratio of a step to the one before, and its margin. Wider bounds, or a margin
   nearer to one: more steps are rejected. Narrower, or a smaller margin: more steps. */
#define SHRINK 0.2
#define GROW 5.0
#define MARGIN 0.9

/* `z[i * width]` is state i, and `z[i * width + 1 + j]` its derivative by state j at the start. */
typedef struct {
  int chart, start;
  double t;
  double z[MOST];
} Point;

INLINE int states(int chart) { return chart == FLIGHT ? 4 : 2; }
INLINE int width(int start) { return 1 + states(start); }

/* Each chart is affine: columns have its field without the constants. */
INLINE void field(const int chart, const int start, const double *p, double t, const double *z,
                  double *f) {
  const int w = width(start);
  double constant = p[K] * p[L0] + p[A] * sin(p[OMEGA] * t);
  LOOP(j, w) {
    double leg = -p[K] * (chart == FLIGHT ? z[j] - z[2 * w + j] : z[j]);
    leg += j == 0 ? constant : 0.0;
    double gravity = j == 0 ? p[G] : 0.0;
    f[j] = z[w + j];
    f[w + j] = leg / p[M] - gravity;
    if (chart == FLIGHT) {
      f[2 * w + j] = z[3 * w + j];
      f[3 * w + j] = -(leg + p[B] * z[3 * w + j]) / p[m] - gravity;
    }
  }
}

/* Height of the foot, or force on the ground. */
INLINE double guard(const int chart, const int start, const double *p, double t, const double *z) {
  if (chart == FLIGHT) return z[2 * width(start)];
  return p[K] * (p[L0] - z[0]) + p[A] * sin(p[OMEGA] * t) + p[m] * p[G];
}

INLINE double guard_rate(const int chart, const int start, const double *p, double t,
                         const double *f) {
  if (chart == FLIGHT) return f[2 * width(start)];
  return -p[K] * f[0] + p[A] * p[OMEGA] * cos(p[OMEGA] * t);
}

/* One step from `z`, where the field is `k[0]`, to `next`; the square of its error by
   `tolerance`. */
INLINE double step(const int chart, const int start, const double *p, double t, double h,
                   double tolerance, const double *z, double k[][MOST], double *next) {
  const int n = states(chart) * width(start);
  double y[MOST];
#define RATE(i) k[i][d]
#define STAGE(i, c, sum)                                   \
  LOOP(d, n) y[d] = z[d] + h * (sum);                      \
  field(chart, start, p, t + (c) * h, y, k[i]);
  STAGES
  LOOP(d, n) next[d] = z[d] + h * (WEIGHTS);
  double fifth = 0.0, third = 0.0;
  LOOP(d, n) {
    double scale = tolerance * (1.0 + fmax(fabs(z[d]), fabs(next[d])));
    double e = h * (ERROR_5) / scale;
    fifth += e * e;
    e = h * (ERROR_3) / scale;
    third += e * e;
  }
  if (fifth == 0.0) return 0.0;
  return fifth * fifth / ((fifth + 0.01 * third) * n);
}

/* The time from the end of a step of length h back to the zero of the cubic that has a guard's
   values g (the first positive, the last negative) and rates r at both ends: where Newton's
   method begins. */
INLINE double back_to_zero(double h, const double *g, const double *r) {
  double low = 0.0, high = 1.0;
  double s = g[0] / (g[0] - g[1]);
  LOOP(i, 8) {
    double u = 1 - s;
    double value = u * u * ((1 + 2 * s) * g[0] + s * h * r[0])
                   + s * s * ((3 - 2 * s) * g[1] - u * h * r[1]);
    double slope = 6 * s * u * (g[1] - g[0])
                   + h * (u * (1 - 3 * s) * r[0] + s * (3 * s - 2) * r[1]);
    if (value > 0) low = s;
    else high = s;
    double next = s - value / slope;
    if (!(next > low && next < high)) next = 0.5 * (low + high);
    double change = fabs(next - s);
    s = next;
    if (change < 1e-3) break;
  }
  return (s - 1) * h;
}

/* From the event on: reset, and the columns by the saltation matrix. `f`: the field before. */
INLINE void jump(const int chart, const int start, const double *p, double t, double *z,
                 const double *f) {
  const int w = width(start);
  double rate = guard_rate(chart, start, p, t, f);
  double delay[MOST], after[MOST];
  double r = chart == FLIGHT ? p[RETENTION] : 1.0;
  LOOP(j, w - 1) {
    double change = chart == FLIGHT ? z[2 * w + 1 + j] : -p[K] * z[1 + j];
    delay[j] = -change / rate;
  }
  LOOP(j, w - 1) {
    z[1 + j] += f[0] * delay[j];
    z[w + 1 + j] += f[w] * delay[j];
  }
  LOOP(j, w) z[w + j] *= r;
  if (chart == STANCE) LOOP(d, 2 * w) z[2 * w + d] = 0.0;
  if (chart == STANCE) field(FLIGHT, start, p, t, z, after);
  else field(STANCE, start, p, t, z, after);
  const int n = chart == STANCE ? 4 : 2;
  LOOP(i, n) LOOP(j, w - 1) z[i * w + 1 + j] -= after[i * w] * delay[j];
}

/* Flow in one chart, to its event or to `end`. `*h`: the step to begin with, and that for the
   next leg. Returns 0 at the end, 1 at an event after the jump, -1 without success. */
INLINE int leg(const int chart, const int start, const double *p, double end, double tolerance,
               double *h, Point *x) {
  double k[STAGE_COUNT][MOST], next[MOST], g[2], rates[2];
  const int n = states(chart) * width(start);
  field(chart, start, p, x->t, x->z, k[0]);
  g[0] = guard(chart, start, p, x->t, x->z);
  LOOP(count, STEPS) {
    int last = x->t + *h >= end;
    double length = last ? end - x->t : *h;
    double square = step(chart, start, p, x->t, length, tolerance, x->z, k, next);
    double ratio = MARGIN * pow(square, -1.0 / (2 * ORDER));
    ratio = fmin(fmax(ratio, SHRINK), GROW);
    if (!(square < 1.0)) {
      *h = length * ratio;
      continue;
    }
    if (!last || ratio < 1.0) *h = length * ratio;
    rates[0] = guard_rate(chart, start, p, x->t, k[0]);
    x->t = last ? end : x->t + length;
    memcpy(x->z, next, n * sizeof(double));
    g[1] = guard(chart, start, p, x->t, x->z);
    if (g[1] >= 0.0) {
      if (last) return 0;
      field(chart, start, p, x->t, x->z, k[0]);
      g[0] = g[1];
      continue;
    }
    field(chart, start, p, x->t, x->z, k[0]);
    rates[1] = guard_rate(chart, start, p, x->t, k[0]);
    double change = back_to_zero(length, g, rates);
    LOOP(i, CORRECTIONS) {
      if (fabs(change) < CLOSE) {
        LOOP(d, n) x->z[d] += change * k[0][d];
        x->t += change;
        field(chart, start, p, x->t, x->z, k[0]);
        jump(chart, start, p, x->t, x->z, k[0]);
        x->chart = !chart;
        return 1;
      }
      step(chart, start, p, x->t, change, tolerance, x->z, k, next);
      x->t += change;
      memcpy(x->z, next, n * sizeof(double));
      field(chart, start, p, x->t, x->z, k[0]);
      change = -guard(chart, start, p, x->t, x->z) / guard_rate(chart, start, p, x->t, k[0]);
    }
    return -1;
  }
  return -1;
}

/* One period from a state `q`. `h`: steps to begin with, by chart. Returns 0, or -1. */
INLINE int turn(const int start, const double *p, double tolerance, const double *q, double *h,
                Point *x) {
  const int w = width(start);
  double period = 2 * M_PI / p[OMEGA];
  double end = 1.5 * period;
  *x = (Point){.chart = start, .start = start, .t = 0.5 * period};
  LOOP(i, w - 1) {
    x->z[i * w] = q[i];
    x->z[i * w + 1 + i] = 1.0;
  }
  int event;
  int events = 0;
  do {
    if (x->chart == FLIGHT) event = leg(FLIGHT, start, p, end, tolerance, h, x);
    else event = leg(STANCE, start, p, end, tolerance, h + 1, x);
    events += event;
  } while (event == 1 && events < EVENTS);
  return event == 0 ? 0 : -1;
}

/* Gaussian elimination with pivots; the solution takes the place of b. Returns 0, or -1. */
INLINE int solve(const int n, double a[4][4], double *b) {
  LOOP(c, n) {
    int pivot = c;
    for (int i = c + 1; i < n; i++)
      if (fabs(a[i][c]) > fabs(a[pivot][c])) pivot = i;
    if (a[pivot][c] == 0.0) return -1;
    LOOP(j, n) {
      double kept = a[c][j];
      a[c][j] = a[pivot][j];
      a[pivot][j] = kept;
    }
    double kept = b[c];
    b[c] = b[pivot];
    b[pivot] = kept;
    for (int i = c + 1; i < n; i++) {
      double factor = a[i][c] / a[c][c];
      for (int j = c; j < n; j++) a[i][j] -= factor * a[c][j];
      b[i] -= factor * b[c];
    }
  }
  for (int c = n - 1; c >= 0; c--) {
    for (int j = c + 1; j < n; j++) b[c] -= a[c][j] * b[j];
    b[c] /= a[c][c];
  }
  return 0;
}

/* The two multipliers (real and imaginary parts) that are not zero because of the stance. */
INLINE void multipliers(const int n, const double *z, double *value) {
  const int w = n + 1;
  double half = 0.0;
  double minors = 0.0; /* the sum of the principal minors of order two */
#define ENTRY(i, j) z[(i) * w + 1 + (j)]
  LOOP(i, n) {
    half += 0.5 * ENTRY(i, i);
    LOOP(j, i) minors += ENTRY(i, i) * ENTRY(j, j) - ENTRY(i, j) * ENTRY(j, i);
  }
  double square = half * half - minors;
  double root = sqrt(fabs(square));
  value[0] = square > 0 ? half + root : half;
  value[1] = square > 0 ? 0.0 : root;
  value[2] = square > 0 ? half - root : half;
  value[3] = square > 0 ? 0.0 : -root;
}

/* One turn, and Newton's correction of `q` unless the turn ends in another chart, where its end
   is the next start, with an infinite residual. Returns the residual, or NAN without success. */
INLINE double correct(const int start, const double *p, double tolerance, double *h, int *chart,
                      double *q, double *value) {
  const int n = states(start);
  const int w = width(start);
  double a[4][4], b[4];
  double residual = 0.0;
  Point x;
  if (turn(start, p, tolerance, q, h, &x)) return NAN;
  if (x.chart != start) {
    *chart = x.chart;
    LOOP(i, 4) q[i] = i < states(x.chart) ? x.z[i * w] : 0.0;
    return INFINITY;
  }
  LOOP(i, n) {
    b[i] = x.z[i * w] - q[i];
    residual = fmax(residual, fabs(b[i]));
    LOOP(j, n) a[i][j] = (i == j) - x.z[i * w + 1 + j];
  }
  multipliers(n, x.z, value);
  if (residual < RESIDUAL) return residual;
  if (solve(n, a, b)) return NAN;
  LOOP(i, n) q[i] += b[i];
  return residual;
}

/* Cycles of `rows` x `columns` hoppers, whose parameters (nine each) are p. Each begins at the
   cycle of the one before in its row, or above, the first at `chart` and `state`. Returns how
   many are found.

   charts: where they are at phase 0.5, -1 without a cycle; q: their states there (4 each);
   values: multipliers (two complex numbers each); turns: how many each has taken. */
int sweep(int rows, int columns, const double *p, double tolerance, int chart, const double *state,
          int *charts, double *q, double *values, int *turns) {
  double h[2] = {0.1, 0.1};
  int found = 0;
  LOOP(s, rows * columns) {
    int near = s % columns ? s - 1 : s - columns;
    int known = near >= 0 && charts[near] >= 0;
    double *own = q + 4 * s;
    int here = known ? charts[near] : chart;
    memcpy(own, known ? q + 4 * near : state, 4 * sizeof(double));
    double residual = INFINITY;
    int count = 0;
    while (residual >= RESIDUAL && count++ < TURNS) {
      if (here == FLIGHT)
        residual = correct(FLIGHT, p + 9 * s, tolerance, h, &here, own, values + 4 * s);
      else
        residual = correct(STANCE, p + 9 * s, tolerance, h, &here, own, values + 4 * s);
    }
    turns[s] = count;
    charts[s] = here;
    if (residual < RESIDUAL) {
      found += 1;
      continue;
    }
    charts[s] = -1;
    LOOP(i, 4) own[i] = values[4 * s + i] = NAN;
  }
  return found;
}
