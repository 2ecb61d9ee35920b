"""Truth for the neurons under a periodic current, apart from hybridjax: by heyoka.

    python benchmarks/neurons_truth.py        # some seconds

Taylor integrators to machine precision, with spikes as terminal events. Cycles and multipliers by
central differences of fourth order. Printed: the state half a period after the maximum of the
current, the time of the spike, multipliers, residual.
"""

import math

import heyoka as hy
import numpy as np


def izhikevich(v, w):
    current = 10.0 + 4.0 * hy.cos(2 * math.pi / 40.0 * hy.time)
    fields = [(v, 0.04 * v**2 + 5.0 * v + 140.0 - w + current), (w, 0.02 * (0.2 * v - w))]
    return fields, 30.0, -65.0, 8.0, 40.0, (-65.0, -5.0)


def adex(v, w):
    current = 1000.0 + 200.0 * hy.cos(2 * math.pi / 40.0 * hy.time)
    leak = 30.0 * (-70.6 - v + 2.0 * hy.exp((v + 50.4) / 2.0))
    fields = [(v, (leak - w + current) / 281.0), (w, (4.0 * (v + 70.6) - w) / 144.0)]
    return fields, -30.0, -70.6, 80.5, 40.0, (-60.0, 200.0)


class Neuron:
    def __init__(self, model):
        v, w = hy.make_vars("v", "w")
        fields, peak, self.rest, self.step, self.period, self.guess = model(v, w)
        self.spikes = []

        def spike(integrator, _):
            self.spikes.append(integrator.time)
            integrator.state[:] = self.rest, integrator.state[1] + self.step
            return True

        rising = hy.event_direction.positive
        event = hy.t_event(v - peak, callback=spike, direction=rising)
        self.integrator = hy.taylor_adaptive(fields, [0.0, 0.0], t_events=[event])

    def turn(self, x):
        self.spikes.clear()
        self.integrator.time = self.period / 2
        self.integrator.state[:] = x
        self.integrator.propagate_until(1.5 * self.period)
        return self.integrator.state.copy()

    def derivative(self, x, h=2e-3):
        d = lambda e, h: (self.turn(x + h * e) - self.turn(x - h * e)) / (2 * h)  # noqa: E731
        return np.array([(4 * d(e, h) - d(e, 2 * h)) / 3 for e in np.eye(2)]).T

    def cycle(self):
        x = np.array(self.guess)
        for _ in range(200):  # it attracts
            x = self.turn(x)
        for _ in range(4):
            x = x - np.linalg.solve(self.derivative(x) - np.eye(2), self.turn(x) - x)
        values = np.linalg.eigvals(self.derivative(x))
        return x, self.spikes, values[np.argsort(-np.abs(values))], np.abs(self.turn(x) - x).max()


if __name__ == "__main__":
    for model in (izhikevich, adex):
        x, spikes, multipliers, residual = Neuron(model).cycle()
        print(model.__name__, *map(repr, map(float, x)), "spikes", *map(float, spikes))
        print(" multipliers", *map(repr, multipliers), "residual", residual)
