/* The two-legged bar: bit j of the chart says whether leg j stands (0 hind, 1 front). */

#define states(chart) 4
#define guards(chart) 2
#define CASES CASE(0) CASE(1) CASE(2) CASE(3)
#include "loop.h"

enum { M, J, HIND, FRONT, K, B, L0, G, RHO, A, T };

CONSTANT int stands(int chart, int j) { return chart >> j & 1; }

CONSTANT void field(const int chart, const double *p, double t, const double *q, double u,
                    double *f) {
  double force = 0.0, torque = 0.0, rate = 2 * M_PI / p[T];
  double table = 0.0, speed = 0.0;
  if (chart) {
    table = p[A] * sin(rate * t) + p[L0];
    speed = p[A] * rate * cos(rate * t);
  }
  LOOP(j, 2) if (stands(chart, j)) {
    double hip = p[HIND + j];
    double F = -p[K] * (q[0] + hip * q[2] - table) - p[B] * (q[1] + hip * q[3] - speed);
    force += F;
    torque += hip * F;
  }
  f[0] = q[1];
  f[1] = (force + u) / p[M] - p[G];
  f[2] = q[3];
  f[3] = torque / p[J];
}

CONSTANT double guard(const int chart, const int j, const double *p, double t, const double *q) {
  double length = q[0] + p[HIND + j] * q[2] - p[A] * sin(2 * M_PI / p[T] * t) - p[L0];
  return stands(chart, j) ? -length : length;
}

CONSTANT double speed(int j, const double *p, double t, double v, double rate) {
  double w = 2 * M_PI / p[T];
  return v + p[HIND + j] * rate - p[A] * w * cos(w * t);
}

CONSTANT double guard_rate(const int chart, const int j, const double *p, double t,
                           const double *q, const double *f) {
  double rate = speed(j, p, t, f[0], f[2]);
  return stands(chart, j) ? -rate : rate;
}

CONSTANT int jump(const int chart, const int j, const double *p, double t, double *q) {
  double hip = p[HIND + j];
  if (!stands(chart, j)) {
    double impulse =
        -(1 - p[RHO]) * speed(j, p, t, q[1], q[3]) / (1 / p[M] + hip * hip / p[J]);
    q[1] += impulse / p[M];
    q[3] += hip * impulse / p[J];
  }
  return chart ^ (1 << j);
}
