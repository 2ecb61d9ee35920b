/* Experiments on a hybrid system: DOPRI5 steps placed by hand, Newton at crossings.

The file that includes this one has defined `states(chart)`, `guards(chart)`, `field`, `guard` and
`jump`, all inlined with a constant chart, for charts 0 to CHARTS - 1 of at most 4 states. */

#include <math.h>
#include <string.h>

#define CONSTANT static inline __attribute__((always_inline))
#define LOOP(i, n) for (int i = 0; i < (n); i++)

enum { ARRIVED = -1, LOST = -2 };

/* Where an interval ends: at an instant (clocked), or where plane . (q0, q1, 1) falls through
zero, about `time` on the cycle's count. */
struct target {
  int clocked;
  double time;
  const double *plane;
};

struct lane {
  int chart;
  double t, q[4];
};

CONSTANT void field(const int chart, const double *p, double t, const double *q, double u,
                    double *f);
CONSTANT double guard(const int chart, const int j, const double *p, double t, const double *q);
CONSTANT double guard_rate(const int chart, const int j, const double *p, double t,
                           const double *q, const double *f);
CONSTANT int jump(const int chart, const int j, const double *p, double t, double *q);

/* Dormand and Prince, J. Comput. Appl. Math. 6, 1980; `k1` is the field at (t, q). */
CONSTANT void rk5(const int chart, const double *p, double t, const double *q, double u,
                  const double *k1, double h, double *out) {
  const int d = states(chart);
  double k2[4], k3[4], k4[4], k5[4], k6[4], x[4];
  LOOP(i, d) x[i] = q[i] + h * (1. / 5 * k1[i]);
  field(chart, p, t + h / 5, x, u, k2);
  LOOP(i, d) x[i] = q[i] + h * (3. / 40 * k1[i] + 9. / 40 * k2[i]);
  field(chart, p, t + 3 * h / 10, x, u, k3);
  LOOP(i, d) x[i] = q[i] + h * (44. / 45 * k1[i] - 56. / 15 * k2[i] + 32. / 9 * k3[i]);
  field(chart, p, t + 4 * h / 5, x, u, k4);
  LOOP(i, d)
  x[i] = q[i] + h * (19372. / 6561 * k1[i] - 25360. / 2187 * k2[i] + 64448. / 6561 * k3[i] -
                     212. / 729 * k4[i]);
  field(chart, p, t + 8 * h / 9, x, u, k5);
  LOOP(i, d)
  x[i] = q[i] + h * (9017. / 3168 * k1[i] - 355. / 33 * k2[i] + 46732. / 5247 * k3[i] +
                     49. / 176 * k4[i] - 5103. / 18656 * k5[i]);
  field(chart, p, t + h, x, u, k6);
  LOOP(i, d)
  out[i] = q[i] + h * (35. / 384 * k1[i] + 500. / 1113 * k3[i] + 125. / 192 * k4[i] -
                       2187. / 6784 * k5[i] + 11. / 84 * k6[i]);
}

/* A short step of the classical fourth-order method. */
CONSTANT void rk4(const int chart, const double *p, double t, const double *q, double u,
                  const double *k1, double h, double *out) {
  const int d = states(chart);
  double k2[4], k3[4], k4[4], x[4];
  LOOP(i, d) x[i] = q[i] + 0.5 * h * k1[i];
  field(chart, p, t + 0.5 * h, x, u, k2);
  LOOP(i, d) x[i] = q[i] + 0.5 * h * k2[i];
  field(chart, p, t + 0.5 * h, x, u, k3);
  LOOP(i, d) x[i] = q[i] + h * k3[i];
  field(chart, p, t + h, x, u, k4);
  LOOP(i, d) out[i] = q[i] + h / 6 * (k1[i] + 2 * k2[i] + 2 * k3[i] + k4[i]);
}

/* Newton to the zero of guard j, or of the section (j < 0), from (t0, q0) with the first guess h
and the state x there. Far corrections repeat the step; near ones, shorter than `near`, step on
from where it landed; the last ones are Euler's. Returns h, with the state in x. */
CONSTANT double polish(const int chart, const int j, const double *plane, const double *p,
                       double t0, const double *q0, double u, const double *k0, double h,
                       double near, double *x) {
  const int d = states(chart);
  LOOP(iteration, 12) {
    double f[4], t = t0 + h, g, rate;
    field(chart, p, t, x, u, f);
    if (j < 0) {
      g = plane[0] * x[0] + plane[1] * x[1] + plane[2];
      rate = plane[0] * f[0] + plane[1] * f[1];
    } else {
      g = guard(chart, j, p, t, x);
      rate = guard_rate(chart, j, p, t, x, f);
    }
    double delta = -g / rate, size = fabs(delta);
    h += delta;
    if (size < 1e-7) {
      LOOP(i, d) x[i] += delta * f[i];
      return h;
    } else if (size < near) {
      double y[4];
      rk4(chart, p, t, x, u, f, delta, y);
      LOOP(i, d) x[i] = y[i];
    } else {
      rk5(chart, p, t0, q0, u, k0, h, x);
    }
  }
  return NAN;
}

/* Flow in one chart until the target or the first event: ARRIVED, or the guard's number. */
CONSTANT int flow(const int chart, const double *p, struct lane *lane, double u,
                  const struct target *target, double longest, double near) {
  const int d = states(chart);
  LOOP(steps, 1000) {
    double k[4], x[4], t = lane->t, *q = lane->q;
    double rest = target->time - t, h = rest;
    int last = 1, event = ARRIVED;
    if (!target->clocked && rest < 1e-3) h = 1e-3;
    if (h > longest * (1 + 1e-9)) {
      h = longest;
      last = 0;
    }
    field(chart, p, t, q, u, k);
    rk5(chart, p, t, q, u, k, h, x);
    if (last && !target->clocked)
      h = polish(chart, -1, target->plane, p, t, q, u, k, h, near, x);
    double first = h, y[4];
    LOOP(i, d) y[i] = x[i];
    LOOP(j, guards(chart)) {
      double g1 = guard(chart, j, p, t + h, x);
      if (g1 < 0) {
        double g0 = guard(chart, j, p, t, q), f[4], z[4];
        field(chart, p, t + h, x, u, f);
        if (guard_rate(chart, j, p, t + h, x, f) > -1e-6) continue; /* not armed yet */
        double guess = g0 > 0 ? h * g0 / (g0 - g1) : 0.5 * h;
        rk5(chart, p, t, q, u, k, guess, z);
        double to = polish(chart, j, 0, p, t, q, u, k, guess, near, z);
        if (!(to >= first)) {
          first = to;
          event = j;
          LOOP(i, d) y[i] = z[i];
        }
      }
    }
    LOOP(i, d) q[i] = y[i];
    lane->t = t + first;
    if (!isfinite(first)) return LOST;
    if (event >= 0) return event;
    if (last) {
      if (target->clocked) lane->t = target->time;
      return ARRIVED;
    }
  }
  return LOST;
}

static int to_section(const double *p, struct lane *lane, double u, const struct target *target,
                      double longest, double near) {
  LOOP(events, 20) {
    int j = LOST;
#define CASE(a)                                                                       \
  case a:                                                                             \
    j = flow(a, p, lane, u, target, longest, near);                                   \
    if (j >= 0) lane->chart = jump(a, j, p, lane->t, lane->q);                        \
    break;
    switch (lane->chart) { CASES }
    if (j < 0) return j;
  }
  return LOST;
}

/* Record (S, n, 2) of inputs u (S, n). `steps` of equal length on average are made from section
to section. Returns the number of the first experiment that is lost, or -1. */
int run(const double *p, int S, int n, const double *u, int N, int clocked, double period,
        const double *times, const double *durations, const double *planes, int chart,
        const double *q, int steps, double near, double *record) {
  LOOP(s, S) {
    struct lane lane = {chart, times[0], {q[0], q[1], q[2], q[3]}};
    LOOP(k, n) {
      int i = k % N, next = (i + 1) % N;
      double turn = next ? 0 : period;
      struct target target = {clocked, times[next] + turn, planes + 3 * next};
      if (!clocked) target.time = lane.t + durations[i];
      memcpy(record, lane.q, 2 * sizeof(double));
      record += 2;
      if (to_section(p, &lane, *u++, &target, durations[i] / steps, near) != ARRIVED) return s;
      lane.t -= turn;
    }
  }
  return -1;
}
