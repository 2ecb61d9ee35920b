"""Harmonic transfer functions in continuous time (`cycle.htf`) beside simulated small sines.

With a clock: cycles of four periods under the sine, and their Fourier integrals. The wheel: a
simulation of 32 periods. Central differences in the amplitude, with Richardson's extrapolation.
Prints the largest relative error of H_1 at 0.25 cycles per period, after minutes.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import hybridjax as hj
from hybridjax.orbits.linear_flow import linear_flow, rule
from hybridjax.systems.chart import FieldChart
from hybridjax.systems.system import Driven


class Wave(eqx.Module):
    """A sine of the time."""

    size: jax.Array
    angle: jax.Array
    rate: jax.Array

    def __call__(self, t):
        return jnp.atleast_1d(self.size * jnp.cos(self.rate * t - self.angle))


class Pushed(Driven):
    """Four periods of a clocked system, with a sine as its input, as one."""

    def period(self):
        return 4 * self.system.period()


class PushedWheel(hj.models.RimlessWheel):
    """The wheel under a sine, with integrals of its speed times a wave."""

    push: Wave = None
    wave: Wave = None

    def charts(self):
        def field(t, q, u):
            angle = self.wave.rate * t
            rates = q[1], jnp.sin(q[0]) + self.push(t)[0]
            return *rates, q[1] * jnp.cos(angle), -q[1] * jnp.sin(angle)

        return {"swing": FieldChart(field, ("th", "w", "c", "s"))}

    def transitions(self):
        (x,) = super().transitions()
        return [
            dataclasses.replace(x, reset=lambda t, q, u: (*x.reset(t, q, u), *q[2:]))
        ]


class Circuit(hj.Chart):
    """A boost converter whose duty cycle is its input, as on the page on responses."""

    states = ("i", "v", "ramp")
    opened: float

    def field(self, t, q, u):
        charge = (self.opened * q[0] - q[1] / 5.0) * 1e4
        return (12.0 - self.opened * q[1]) * 1e4, charge, 1e5


class Boost(hj.HybridSystem):
    def charts(self):
        return {"closed": Circuit(0.0), "open": Circuit(1.0)}

    def transitions(self):
        yield hj.Transition(
            "opens", "closed", "open", lambda t, q, u: 0.4 + u[0] - q[2]
        )
        anew = lambda t, q, u: (q[0], q[1], 0.0)  # noqa: E731
        yield hj.Transition(
            "closes", "open", "closed", hj.systems.Scheduled(1e-5), reset=anew
        )

    def period(self):
        return 1e-5

    def guess(self):
        return hj.Guess("closed", (6.0, 20.0, 0.1), 1e-6)


def slope(mean, size):
    """The response to a complex wave, by differences of responses to real ones of some sizes."""

    def by(angle):
        coarse, fine = (
            (mean(h, angle) - mean(-h, angle)) / (2 * h) for h in (size, size / 2)
        )
        return (4 * fine - coarse) / 3

    return by(0.0) + 1j * by(np.pi / 2)


def clocked(system, outputs, size):
    cycle = hj.find_limit_cycle(system)
    s, period = cycle.structure, float(cycle.period)
    columns = np.array([[c.states.index(x) for x in outputs] for c in s.charts])
    chart, state = s.names[int(cycle.anchor.chart[0])], list(cycle.state.values())
    begin = hj.Guess(chart, state, float(cycle.anchor.t[0]))

    def mean(size, angle):
        push = Wave(*map(jnp.asarray, (size, angle, np.pi / 2 / period)))
        flow = linear_flow(hj.find_limit_cycle(Pushed(system, push), begin), 1 / 64)
        y = np.take_along_axis(flow.q, columns[flow.chart][:, None], axis=2)
        weight = flow.length[:, None] * rule().weights / (4 * period)
        return np.einsum(
            "pk,pky->y", weight * np.exp(-2.5j * np.pi * flow.t / period), y
        )

    return cycle.htf(0.25, 1, outputs).H[0, 0, :, 0], slope(mean, size)


def wheel():
    cycle = hj.find_limit_cycle(hj.models.RimlessWheel())
    period, tight = float(cycle.period), hj.orbits.Settings(1e-12, 1e-13)
    wave = Wave(*map(jnp.asarray, (1.0, 0.0, 2.5 * np.pi / period)))

    def mean(size, angle):
        """The Fourier integral over four periods, after 28."""
        push = Wave(*map(jnp.asarray, (size, angle, np.pi / 2 / period)))
        begin, system = (
            [*np.asarray(cycle.anchor.q[:2, 0]), 0.0, 0.0],
            PushedWheel(push=push, wave=wave),
        )
        ends = [
            hj.simulate(system, "swing", begin, n * period, settings=tight)
            for n in (28, 32)
        ]
        return (ends[1].after[-1][2:] - ends[0].after[-1][2:]) @ [1, 1j] / (4 * period)

    return cycle.htf(0.25, 1, "w").H[0, 0, :, 0], slope(mean, 1e-4)


if __name__ == "__main__":
    hj.enable_x64()
    cases = [
        (hj.models.PaddleJuggler(), ("v", "y"), 1e-3),
        (hj.models.VerticalHopper(), ("yM", "vM"), 1e-2),
        (hj.models.BuckConverter(), ("v", "i"), 1e-3),
        (hj.models.CukConverter(), ("v2", "i1"), 1e-3),
        (Boost(), ("v", "i"), 1e-4),
    ]
    for system, outputs, size in cases:
        H, response = clocked(system, outputs, size)
        print(
            f"{type(system).__name__:15} {np.max(np.abs(H / response - 1)):.1e}",
            flush=True,
        )
    H, response = wheel()
    print(f"{'RimlessWheel':15} {np.max(np.abs(H / response - 1)):.1e}")
