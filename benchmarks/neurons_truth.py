"""Truth for the neurons under a periodic current, apart from hybridjax: by heyoka.

    python benchmarks/neurons_truth.py        # some seconds

Taylor integrators to machine precision, with spikes as terminal events. Cycles and multipliers by
central differences of fourth order; the smaller multiplier by Liouville's formula, from the field's
divergence and what a spike makes of an area. Printed: the state half a period after the maximum of
the current, the time of the spike, multipliers, residual.
"""

import math

import heyoka as hy
import numpy as np


def izhikevich(v, w):
    current = 10.0 + 4.0 * hy.cos(2 * math.pi / 40.0 * hy.time)
    fields = [
        (v, 0.04 * v**2 + 5.0 * v + 140.0 - w + current),
        (w, 0.02 * (0.2 * v - w)),
    ]
    return fields, 30.0, -65.0, 8.0, 40.0, (-65.0, -5.0)


def adex(v, w):
    current = 1000.0 + 200.0 * hy.cos(2 * math.pi / 40.0 * hy.time)
    leak = 30.0 * (-70.6 - v + 2.0 * hy.exp((v + 50.4) / 2.0))
    fields = [(v, (leak - w + current) / 281.0), (w, (4.0 * (v + 70.6) - w) / 144.0)]
    return fields, -30.0, -70.6, 80.5, 40.0, (-60.0, 200.0)


class Neuron:
    def __init__(self, model):
        v, w, area = hy.make_vars("v", "w", "area")
        fields, peak, rest, step, self.period, self.guess = model(v, w)
        rate = hy.cfunc([fields[0][1]], [v, w])
        self.spikes = []

        def spike(integrator, _):
            before, t = integrator.state.copy(), integrator.time
            after = np.array([rest, before[1] + step])
            speeds = [rate(x, time=t)[0] for x in (before[:2], after)]
            self.spikes.append(t)
            integrator.state[:] = (
                *after,
                before[2] + math.log(abs(speeds[1] / speeds[0])),
            )
            self.sign = math.copysign(1.0, speeds[1] / speeds[0])
            return True

        rising = hy.event_direction.positive
        event = hy.t_event(v - peak, callback=spike, direction=rising)
        divergence = sum(hy.diff(right, x) for x, right in fields)
        self.integrator = hy.taylor_adaptive(
            [*fields, (area, divergence)], [0.0, 0.0, 0.0], t_events=[event]
        )

    def turn(self, x):
        self.spikes.clear()
        self.integrator.time = self.period / 2
        self.integrator.state[:] = *x, 0.0
        self.integrator.propagate_until(1.5 * self.period)
        return self.integrator.state[:2].copy()

    def derivative(self, x, h=2e-3):
        d = lambda e, h: (self.turn(x + h * e) - self.turn(x - h * e)) / (2 * h)  # noqa: E731
        return np.array([(4 * d(e, h) - d(e, 2 * h)) / 3 for e in np.eye(2)]).T

    def cycle(self):
        x = np.array(self.guess)
        for _ in range(200):  # it attracts
            x = self.turn(x)
        for _ in range(4):
            x = x - np.linalg.solve(self.derivative(x) - np.eye(2), self.turn(x) - x)
        largest = max(np.linalg.eigvals(self.derivative(x)), key=abs)
        residual = np.abs(self.turn(x) - x).max()
        area = self.sign * math.exp(self.integrator.state[2])
        return x, self.spikes, (largest, area / largest), residual


if __name__ == "__main__":
    for model in (izhikevich, adex):
        x, spikes, multipliers, residual = Neuron(model).cycle()
        print(model.__name__, *map(float, x), "spikes", *map(float, spikes))
        print(" multipliers", *map(float, multipliers), "residual", residual)
