/* The vertical hopper: charts flight (0) and stance (1). */

#define states(chart) ((chart) == 0 ? 4 : 2)
#define guards(chart) 1
#define CASES CASE(0) CASE(1)
#include "loop.h"

enum { m, M, K, B, L0, A, G, OMEGA, RETENTION };

CONSTANT double leg(const double *p, double t, double y, double ym) {
  return p[K] * (p[L0] - (y - ym)) + p[A] * sin(p[OMEGA] * t);
}

CONSTANT void field(const int chart, const double *p, double t, const double *q, double u,
                    double *f) {
  double force = leg(p, t, q[0], chart == 0 ? q[2] : 0.0);
  f[0] = q[1];
  f[1] = (force + u) / p[M] - p[G];
  if (chart == 0) {
    f[2] = q[3];
    f[3] = -(force + p[B] * q[3]) / p[m] - p[G];
  }
}

CONSTANT double guard(const int chart, const int j, const double *p, double t, const double *q) {
  return chart == 0 ? q[2] : leg(p, t, q[0], 0.0) + p[m] * p[G];
}

CONSTANT double guard_rate(const int chart, const int j, const double *p, double t,
                           const double *q, const double *f) {
  return chart == 0 ? f[2] : -p[K] * f[0] + p[A] * p[OMEGA] * cos(p[OMEGA] * t);
}

CONSTANT int jump(const int chart, const int j, const double *p, double t, double *q) {
  q[2] = q[3] = 0.0;
  if (chart == 1) return 0;
  q[1] *= p[RETENTION];
  return 1;
}
