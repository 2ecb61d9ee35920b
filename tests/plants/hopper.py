"""The paper's hopper as a plant: equations in plain Python, integrated by scipy."""

import math

from scipy.integrate import ode
from scipy.optimize import brentq


class Hopper:
    """A plant in the sense of `hj.plants.Plant`: nothing of JAX, nothing of hybridjax."""

    inputs = {"u": "N"}
    units = {"yM": "m", "vM": "m/s"}
    states = ("time", "yM", "vM", "ym", "vm")
    period = 1.0

    def __init__(self, accuracy=1e-10, dt=1 / 40):
        self.accuracy, self.dt = accuracy, dt
        how = {"rtol": accuracy, "atol": accuracy, "nsteps": 10000}
        fields = self.stance, self.flight
        self.solvers = [ode(f).set_integrator("dop853", **how) for f in fields]

    def __reduce__(self):
        return type(self), (self.accuracy, self.dt)

    @staticmethod
    def leg(t, yM, ym):
        return 10 * (2 - (yM - ym)) + 20 * math.sin(2 * math.pi * t)

    def stance(self, t, q, u):
        return q[1], (self.leg(t, q[0], 0.0) + u) / 2 - 2

    def flight(self, t, q, u):
        leg = self.leg(t, q[0], q[2])
        return q[1], (leg + u) / 2 - 2, q[3], -leg - 5 * q[3] - 2

    def reset(self, seed):
        self.set_state((0.0, 2.2, -0.5, 0.3, -0.5))
        return self.observe()

    def observe(self):
        return {"yM": self.q[0], "vM": self.q[1]}

    def get_state(self):
        return (self.t, *self.q, 0.0, 0.0)[:5]

    def set_state(self, x):
        self.t, *q = map(float, x)
        self.q = q if q[2] or q[3] else q[:2]

    def guard(self, t, q):
        return q[2] if len(q) == 4 else self.leg(t, q[0], 0.0) + 2

    def flow(self, h, u):
        if h < 1e-9:  # (shorter than steps of the method can be)
            rate = (self.flight if len(self.q) == 4 else self.stance)(self.t, self.q, u)
            return [x + h * r for x, r in zip(self.q, rate, strict=True)]
        solver = self.solvers[len(self.q) == 4]
        solver.set_initial_value(self.q, self.t).set_f_params(u)
        return solver.integrate(self.t + h).tolist()

    def step(self, u, duration):
        end = self.t + duration
        while (left := end - self.t) > 1e-15:
            q = self.flow(left, u[0])
            if not self.guard(self.t, self.q) > 0 > self.guard(end, q):
                self.t, self.q = end, q
                break

            def ahead(h):
                return self.guard(self.t + h, self.flow(h, u[0]))

            when = brentq(ahead, 1e-15, left, xtol=1e-15)
            q = self.flow(when, u[0])
            self.t = self.t + when
            self.q = q[:2] if len(q) == 4 else [*q, 0.0, 0.0]
        return self.observe()
