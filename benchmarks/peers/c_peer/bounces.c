/* Balls that bounce with drag, one after the other, in scalar code: DOP853, by the pair of
   tableau.h, which cycles.py writes. */

#include <math.h>

#include "tableau.h"

#define INLINE static inline __attribute__((always_inline))
#define LOOP(i, n) for (int i = 0; i < (n); i++)

enum { GRAVITY, RESTITUTION, DRAG };

/* Steps of a ball. More: hopeless balls cost more. Fewer: some are given up. */
#define STEPS 10000
/* Corrections of a bounce. More: hopeless ones cost more. Fewer: good ones end. */
#define CORRECTIONS 20
/* Corrections (s) of a bounce that Euler's method makes, the last. Larger: its error, half
   their square times the rate of the field, would be seen. Smaller: more steps. */
#define CLOSE 1e-8
/* Bounds of the ratio of a step to the one before, and its margin. Wider bounds, or a margin
   nearer to one: more steps are rejected. Narrower, or a smaller margin: more steps. */
#define SHRINK 0.2
#define GROW 5.0
#define MARGIN 0.9

INLINE void field(const double *p, const double *z, double *f) {
  f[0] = z[1];
  f[1] = -p[GRAVITY] - p[DRAG] * z[1];
}

/* One step from `z`, where the field is `k[0]`, to `next`; the square of its error by
   `tolerance`. */
INLINE double step(const double *p, double h, double tolerance, const double *z, double k[][2],
                   double *next) {
  double y[2];
#define RATE(i) k[i][d]
#define STAGE(i, c, sum)              \
  LOOP(d, 2) y[d] = z[d] + h * (sum); \
  field(p, y, k[i]);
  STAGES
  LOOP(d, 2) next[d] = z[d] + h * (WEIGHTS);
  double fifth = 0.0, third = 0.0;
  LOOP(d, 2) {
    double scale = tolerance * (1.0 + fmax(fabs(z[d]), fabs(next[d])));
    double e = h * (ERROR_5) / scale;
    fifth += e * e;
    e = h * (ERROR_3) / scale;
    third += e * e;
  }
  if (fifth == 0.0) return 0.0;
  return fifth * fifth / ((fifth + 0.01 * third) * 2);
}

/* The state at height zero, within a step of length h to `next`, and the time to it. */
INLINE double land(const double *p, double h, double tolerance, const double *z, double k[][2],
                   double *next) {
  double tau = h;
  LOOP(i, CORRECTIONS) {
    double correction = -next[0] / next[1];
    tau += correction;
    if (fabs(correction) < CLOSE) {
      double f[2];
      field(p, next, f);
      LOOP(d, 2) next[d] += correction * f[d];
      return tau;
    }
    step(p, tau, tolerance, z, k, next);
  }
  return NAN;
}

/* Time and speed after some bounces of balls that are dropped from `heights`; the number of
   steps that were accepted. */
long bounce(int balls, int bounces, const double *p, const double *heights, double tolerance,
            double *times, double *speeds) {
  long accepted = 0;
  LOOP(ball, balls) {
    double t = 0.0, h = 0.01, z[2] = {heights[ball], 0.0}, next[2], k[STAGE_COUNT][2];
    int left = bounces;
    field(p, z, k[0]);
    LOOP(i, STEPS) {
      if (left == 0) break;
      double error = step(p, h, tolerance, z, k, next);
      double factor = error > 0 ? MARGIN * pow(error, -0.5 / 8) : GROW;
      factor = fmin(GROW, fmax(SHRINK, factor));
      if (error <= 1.0) {
        double moved = h;
        if (next[0] < 0) {
          moved = land(p, h, tolerance, z, k, next);
          next[0] = 0.0;
          next[1] *= -p[RESTITUTION];
          left--;
        }
        t += moved;
        LOOP(d, 2) z[d] = next[d];
        field(p, z, k[0]);
        accepted++;
      }
      h *= factor;
    }
    times[ball] = t;
    speeds[ball] = z[1];
  }
  return accepted;
}
