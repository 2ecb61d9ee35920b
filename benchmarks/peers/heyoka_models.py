"""The models in heyoka's symbols.

All charts are one system of differential equations: parameters of the integrator switch forces on
and off, so that neither a change of chart nor lanes in different charts need another integrator.
Likewise a guard is one event whose function changes with the chart.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import heyoka as hy
import numpy as np


# Parameters of the integrators: the input, the switches, and the plane of the coming section.
INPUT, SWITCH, PLANE = 0, slice(1, 3), slice(3, 6)
COUNT = 6


class Model(NamedTuple):
    """`fields`, pairs of a variable and its rate; `guards`, which fall through zero; `jump(j, t,
    state, switch, cos)`, the four states after guard j fell, in numbers or symbols; `switches` of
    each chart, the j-th of which changes when guard j falls."""

    fields: list
    guards: list
    jump: Callable
    switches: dict[str, tuple[float, float]]


def hopper(m, M, k, b, l0, a, g, omega, retention) -> Model:
    y, v, ym, vm = hy.make_vars("y", "v", "ym", "vm")
    u, flight = hy.par[INPUT], hy.par[1]
    leg = k * (l0 - y + ym) + a * hy.sin(omega * hy.time)
    fields = [
        (y, v),
        (v, (leg + u) / M - g),
        (ym, flight * vm),
        (vm, flight * (-(leg + b * vm) / m - g)),
    ]
    guard = flight * ym + (1 - flight) * (leg + m * g)

    def jump(j, t, state, switch, cos):
        y, v, _, _ = state
        return [y, v * (1 + switch[0] * (retention - 1)), 0.0 * y, 0.0 * y]

    return Model(fields, [guard], jump, {"flight": (1, 0), "stance": (0, 0)})


def bar(m, J, hind, front, k, b, l0, g, rho, A, T) -> Model:
    y, v, q, p = hy.make_vars("y", "v", "q", "p")
    u, on = hy.par[INPUT], (hy.par[1], hy.par[2])
    rate = 2 * math.pi / T
    table, speed = A * hy.sin(rate * hy.time), A * rate * hy.cos(rate * hy.time)
    hips = (hind, front)
    length = [y + s * q - table - l0 for s in hips]
    force = [on[j] * (-k * length[j] - b * (v + hips[j] * p - speed)) for j in range(2)]
    fields = [
        (y, v),
        (v, (force[0] + force[1] + u) / m - g),
        (q, p),
        (p, (hind * force[0] + front * force[1]) / J),
    ]
    guards = [(1 - 2 * on[j]) * length[j] for j in range(2)]

    def jump(j, t, state, switch, cos):
        y, v, q, p = state
        s = hips[j]
        approach = v + s * p - A * rate * cos(rate * t)
        impulse = (switch[j] - 1) * (1 - rho) / (1 / m + s**2 / J) * approach
        return [y, v + impulse / m, q, p + s * impulse / J]

    switches = {"air": (0, 0), "hind": (1, 0), "front": (0, 1), "both": (1, 1)}
    return Model(fields, guards, jump, switches)


def section(model: Model):
    """Falls through zero at a section in the plane of the first two states."""
    (height, _), (speed, _), *_ = model.fields
    return hy.par[3] * height + hy.par[4] * speed + hy.par[5]


def make(job) -> Model:
    return {"hopper": hopper, "bar": bar}[job.model](**job.parameters)


def start(job, model: Model, i: int = 0):
    """State (4,) and parameters (6,) at section i of the cycle."""
    pars = np.zeros(COUNT)
    pars[SWITCH] = model.switches[job.charts[i]]
    pars[PLANE] = job.planes[(i + 1) % job.sections]
    return job.states[i].copy(), pars
