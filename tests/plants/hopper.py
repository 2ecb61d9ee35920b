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
        self.accuracy = accuracy
        self.dt = dt
        self.in_stance = self.integrator(self.stance)
        self.in_flight = self.integrator(self.flight)

    def integrator(self, field):
        solver = ode(field)
        return solver.set_integrator(
            "dop853", rtol=self.accuracy, atol=self.accuracy, nsteps=10000
        )

    def __reduce__(self):
        return type(self), (self.accuracy, self.dt)

    @staticmethod
    def leg(t, yM, ym):
        """The force of the leg."""
        spring = 10 * (2 - (yM - ym))
        motor = 20 * math.sin(2 * math.pi * t)
        return spring + motor

    def stance(self, t, q, u):
        yM, vM = q
        force = self.leg(t, yM, 0.0) + u
        acceleration = force / 2 - 2
        return vM, acceleration

    def flight(self, t, q, u):
        yM, vM, ym, vm = q
        leg = self.leg(t, yM, ym)
        body = (leg + u) / 2 - 2
        foot = -leg - 5 * vm - 2
        return vM, body, vm, foot

    def reset(self, seed):
        self.set_state((0.0, 2.2, -0.5, 0.3, -0.5))
        return self.observe()

    def observe(self):
        return {"yM": self.q[0], "vM": self.q[1]}

    def get_state(self):
        foot = (0.0, 0.0)
        if self.flies(self.q):
            foot = self.q[2:]
        return (self.t, *self.q[:2], *foot)

    def set_state(self, x):
        self.t, *q = map(float, x)
        foot_rests = q[2] == 0 and q[3] == 0
        self.q = q[:2] if foot_rests else q

    @staticmethod
    def flies(q):
        return len(q) == 4

    def guard(self, t, q):
        """The height of the foot, or the force that holds it on the ground."""
        if self.flies(q):
            return q[2]
        return self.leg(t, q[0], 0.0) + 2

    def flow(self, h, u):
        """The state after a time h without an event."""
        flies = self.flies(self.q)
        if h < 1e-9:  # shorter than steps of the method can be
            field = self.flight if flies else self.stance
            rates = field(self.t, self.q, u)
            return [x + h * rate for x, rate in zip(self.q, rates, strict=True)]
        solver = self.in_flight if flies else self.in_stance
        solver.set_initial_value(self.q, self.t).set_f_params(u)
        return solver.integrate(self.t + h).tolist()

    def step(self, u, duration):
        end = self.t + duration
        while end - self.t > 1e-15:
            left = end - self.t
            q = self.flow(left, u[0])
            before = self.guard(self.t, self.q)
            has_event = before > 0 > self.guard(end, q)
            if not has_event:
                self.t = end
                self.q = q
                break

            def guard_after(h):
                q = self.flow(h, u[0])
                return self.guard(self.t + h, q)

            until_event = brentq(guard_after, 1e-15, left, xtol=1e-15)
            q = self.flow(until_event, u[0])
            self.t = self.t + until_event
            if self.flies(q):
                self.q = q[:2]
            else:
                self.q = [*q, 0.0, 0.0]
        return self.observe()
