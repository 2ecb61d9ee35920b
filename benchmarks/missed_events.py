"""Events that `simulate` misses or invents, on random flows whose zeros are known.

    python benchmarks/missed_events.py                      # 10 300 flows, 15 CPU minutes
    python benchmarks/missed_events.py --flows 8 --families chain --methods Verner

A flow is a function x(t) on 0 <= t <= 1 with values up to 1: a polynomial (as a chain of
integrators, whose steps may be as long as one likes, or as an integral over time), a cubic spline,
or a sum of sines (of oscillators, or as an integral over time). An event happens where x falls
through zero. In half of the flows a constant moves an extremum of x close to zero. Every other
guard is nonlinear in x, with the same zeros.

The truth are the zeros between the extrema of x, which are found in the closed form. An event is
*found* if exactly one event of the flow lies between the extrema on both sides of its zero. Its
*excursion* is the smaller height of x at both, relative to the tolerance of the integration. Events
whose excursion is ten times the tolerance, or lasts a tenth of the step in which it lies, must be
found; the others may be.
"""

import argparse
import sys
import time
from collections.abc import Callable
from typing import NamedTuple

import diffrax
import equinox as eqx
import jax.numpy as jnp
import numpy as np

import hybridjax as hj
from hybridjax.engine.lanes import IDLE, start_lanes
from hybridjax.engine.move import Options, move
from hybridjax.engine.settings import Settings
from hybridjax.engine.target import until
from hybridjax.systems.chart import FieldChart
from hybridjax.systems.structure import Structure


METHODS = {
    "Verner": None,
    "Tsit5": diffrax.Tsit5(),
    "Dopri5": diffrax.Dopri5(),
    "Dopri8": diffrax.Dopri8(),
    "Radau": hj.systems.Radau(),
}
TOLERANCES = (1e-3, 1e-6, 1e-9, 1e-12)
# Intervals in which extrema of x are sought. Fewer: pairs of extrema are missed. More: time.
GRID = 4000
DEGREE, KNOTS, SINES = 8, 12, 5
# Iterations of a search. Fewer: flows at small tolerances do not end. More: memory for tapes.
STEPS = 2048


class Family(NamedTuple):
    """Functions x(t) with coefficients (flows, k), and the field that has them as its first
    state."""

    draw: Callable
    """(rng, flows) -> coefficients."""
    value: Callable
    """(coefficients, t (flows, p), derivative) -> x or its derivative at times."""
    start: Callable
    """(coefficients, x at the start) -> states at the start (n, flows)."""
    field: Callable
    """(t, q) -> rates of the states."""


def drawn_polynomials(rng, flows):
    """Degrees 2 to 8: half of them with all zeros in the interval, half with random values at
    Chebyshev's points."""
    c = np.zeros((flows, DEGREE + 1))
    for k, degree in enumerate(rng.integers(2, DEGREE + 1, flows)):
        if rng.random() < 0.5:
            c[k, : degree + 1] = np.poly(rng.uniform(0, 1, degree))[::-1]
        else:
            points = (1 - np.cos(np.pi * np.arange(degree + 1) / degree)) / 2
            values = rng.normal(size=degree + 1)
            c[k, : degree + 1] = np.polynomial.polynomial.polyfit(
                points, values, degree
            )
    return c


def polynomial(c, t, derivative=0):
    for _ in range(derivative):
        c = c[:, 1:] * np.arange(1, c.shape[1])
    return sum(c[:, k, None] * t**k for k in range(c.shape[1]))


def derivatives_at_zero(c, x):
    factorials = np.cumprod([1.0, *range(1, DEGREE + 1)])
    states = (c * factorials).T
    states[0] = x
    return states


def chain(t, q):
    return (*(q[k + 1] for k in range(DEGREE)), 0.0)


def with_coefficients(c, x):
    return np.concatenate([x[None], c.T])


def polynomial_rate(t, q):
    rate = sum(k * q[1 + k] * t ** (k - 1) for k in range(1, DEGREE + 1))
    return (rate, *[0.0] * (DEGREE + 1))


def basis(s, derivative, maximum):
    """The cubic B-spline on -2 < s < 2 or its derivative."""
    inner, outer = maximum(1 - abs(s), 0.0), maximum(2 - abs(s), 0.0)
    if derivative == 0:
        return (outer**3 - 4 * inner**3) / 6
    sign = 1 - 2 * (s > 0)
    return sign * (outer**2 - 4 * inner**2) / 2


def spline(c, t, derivative=0):
    scale = (KNOTS - 3.0) ** derivative
    place = t * (KNOTS - 3)
    parts = (
        c[:, k, None] * basis(place - (k - 1), derivative, np.maximum)
        for k in range(KNOTS)
    )
    return scale * sum(parts)


def spline_rate(t, q):
    place = t * (KNOTS - 3)
    parts = (q[1 + k] * basis(place - (k - 1), 1, jnp.maximum) for k in range(KNOTS))
    return ((KNOTS - 3.0) * sum(parts), *[0.0] * KNOTS)


def drawn_sines(rng, flows):
    """Amplitudes, frequencies and phases."""
    amplitudes = rng.normal(size=(flows, SINES))
    frequencies = np.exp(rng.uniform(np.log(2), np.log(60), (flows, SINES)))
    phases = rng.uniform(0, 2 * np.pi, (flows, SINES))
    return np.concatenate([amplitudes, frequencies, phases], axis=1)


def sines(c, t, derivative=0):
    a, w, p = (x[..., None] for x in np.split(c, 3, axis=1))
    angle = w * t[:, None] + p + derivative * np.pi / 2
    return (a * w**derivative * np.sin(angle)).sum(axis=1)


def sines_rate(t, q):
    a, w, p = (q[1 + k * SINES : 1 + (k + 1) * SINES] for k in range(3))
    return (jnp.sum(a * w * jnp.cos(w * t + p)), *[0.0] * (3 * SINES))


def oscillators_start(c, x):
    a, w, p = np.split(c.T, 3)
    return np.concatenate([x[None], a * w * np.cos(p), -a * w**2 * np.sin(p), w])


def oscillators(t, q):
    """The rate of x is a sum of oscillations with the frequencies w."""
    v, dv, w = (q[1 + k * SINES : 1 + (k + 1) * SINES] for k in range(3))
    return (jnp.sum(v), *dv, *(-(w**2) * v), *[0.0] * SINES)


FAMILIES = {
    "chain": Family(drawn_polynomials, polynomial, derivatives_at_zero, chain),
    "polynomial": Family(
        drawn_polynomials, polynomial, with_coefficients, polynomial_rate
    ),
    "spline": Family(
        lambda rng, flows: rng.normal(size=(flows, KNOTS)),
        spline,
        with_coefficients,
        spline_rate,
    ),
    "sines": Family(drawn_sines, sines, with_coefficients, sines_rate),
    "oscillators": Family(drawn_sines, sines, oscillators_start, oscillators),
}


def guard(t, q, u):
    """x or, where the last state is 1, a nonlinear function of it with the same zeros."""
    return jnp.where(q[-1] > 0.5, jnp.expm1(2 * q[0]), q[0])


def system(family: Family, states: int, solver) -> hj.HybridSystem:
    names = tuple(f"x{k}" for k in range(states))
    field = FieldChart(lambda t, q, u: (*family.field(t, q[:-1]), 0.0), names)

    class Flow(hj.HybridSystem):
        def charts(self):
            return {"flow": field}

        def transitions(self):
            return [hj.Transition("fall", "flow", "flow", guard=guard)]

    return Flow(solver=solver)


class Flows(NamedTuple):
    """Random flows, and the ends of their monotone pieces, in order."""

    c: np.ndarray
    offset: np.ndarray
    amplitude: np.ndarray
    ends: list[np.ndarray]
    heights: list[np.ndarray]


def draw(family: Family, flows: int, tolerance: np.ndarray, rng) -> Flows:
    """Flows; half of them with an extremum at a distance from zero between a tolerance and 10 000
    tolerances."""
    c = family.draw(rng, flows)
    ends = extrema(family, c)
    values = [family.value(c[k : k + 1], x[None])[0] for k, x in enumerate(ends)]
    low, high = (np.array([f(x) for x in values]) for f in (np.min, np.max))
    part = rng.uniform(0.2, 0.8, flows)
    amplitude = high - low
    offset = -(low + part * amplitude)
    for k in range(flows):
        inside = values[k][1:-1]
        if k % 2 and len(inside):
            near = tolerance[k] * 10 ** rng.uniform(0, 4) * rng.choice([-1, 1])
            offset[k] = near * amplitude[k] - rng.choice(inside)
    heights = [(x + o) / a for x, o, a in zip(values, offset, amplitude, strict=True)]
    return Flows(c, offset, amplitude, ends, heights)


def extrema(family: Family, c: np.ndarray) -> list[np.ndarray]:
    """0, the extrema between 0 and 1 by bisection of the derivative, and 1."""
    t = np.broadcast_to(np.linspace(0, 1, GRID + 1), (len(c), GRID + 1))
    rate = family.value(c, t, 1)
    flow, place = np.nonzero(np.diff(np.sign(rate), axis=1))
    left, right = t[0, place], t[0, place + 1]
    rising = rate[flow, place + 1] > rate[flow, place]
    for _ in range(60):
        middle = 0.5 * (left + right)
        above = family.value(c[flow], middle[:, None], 1)[:, 0] > 0
        low = above != rising
        left, right = np.where(low, middle, left), np.where(low, right, middle)
    return [np.concatenate([[0.0], left[flow == k], [1.0]]) for k in range(len(c))]


class Found(NamedTuple):
    """Events and steps of one flow."""

    events: np.ndarray
    steps: np.ndarray
    ok: bool


def simulated(
    family: Family, flows: Flows, solver, tolerance: np.ndarray
) -> list[Found]:
    """All flows side by side, with the accuracy of `hj.simulate`."""
    c = flows.c / flows.amplitude[:, None]
    if family.value is sines:
        c = flows.c.copy()
        c[:, :SINES] /= flows.amplitude[:, None]
    x = np.array([x[0] for x in flows.heights])
    L = len(x)
    states = np.concatenate([family.start(c, x), [np.arange(L) // 2 % 2]])
    s = Structure(system(family, len(states), solver))
    lanes = start_lanes(
        s, jnp.zeros(L), jnp.zeros(L, jnp.int32), jnp.asarray(states, float)
    )
    accuracy = jnp.asarray(tolerance)
    settings = Settings(1.0, 1.0, STEPS)
    settings = eqx.tree_at(lambda x: (x.rtol, x.atol), settings, (accuracy, accuracy))
    moved, tape = move(
        s,
        lanes,
        jnp.zeros((0, L)),
        until(jnp.ones(L)),
        settings,
        options=Options(tape=True),
    )
    code, t, result = (np.asarray(x) for x in (tape.code, tape.t, moved.result))
    rows = [code[:, k] != IDLE for k in range(L)]
    return [
        Found(t[code[:, k] == 0, k], np.append(0.0, t[rows[k], k]), result[k] == 0)
        for k in range(L)
    ]


class Count(NamedTuple):
    flows: int = 0
    steps: int = 0
    events: int = 0
    found: int = 0
    high: int = 0
    """Missed though the excursion is ten times the tolerance high."""
    long: int = 0
    """Missed though it lasts a tenth of the step."""
    other: int = 0
    """Missed, but neither."""
    spurious: int = 0
    """Events where none is, though x stays ten times the tolerance away from zero."""
    failed: int = 0
    """Flows that end with a result code, as grazing."""


def compare(
    family: Family, flows: Flows, k: int, found: Found, tolerance: float
) -> Count:
    """Count the events of one flow."""
    ends, heights = flows.ends[k], flows.heights[k]
    until = np.inf if found.ok else found.steps[-1]
    count = Count(1, len(found.steps) - 1, failed=not found.ok)._asdict()
    for place in range(len(ends) - 1):
        left, right = ends[place], ends[place + 1]
        within = int(((found.events > left) & (found.events <= right)).sum())
        falls = heights[place] > 0 and heights[place + 1] < 0
        excursion = np.abs(heights[place : place + 2]).min()
        if falls and right < until:
            count["events"] += 1
            count["found"] += within == 1
            if within == 0:
                how = kind(family, flows, k, found, place, excursion, tolerance)
                count[how] += 1
        wrong = within > 1 if falls else within > 0
        count["spurious"] += wrong and excursion > 10 * tolerance
    return Count(**count)


def kind(family, flows, k, found, place, excursion, tolerance) -> str:
    """How a missed event in a monotone piece is counted."""
    if excursion >= 10 * tolerance:
        return "high"
    zero = crossing(family, flows, k, place)
    step = np.searchsorted(found.steps, zero)
    length = np.diff(found.steps)[min(step, len(found.steps) - 1) - 1]
    before = zero - crossing(family, flows, k, place - 1, default=0)
    after = crossing(family, flows, k, place + 1, default=1) - zero
    return "long" if min(before, after) >= 0.1 * length else "other"


def crossing(
    family: Family, flows: Flows, k: int, place: int, default: int = 0
) -> float:
    """The zero of a flow in a monotone piece; its first (0) or last (1) end if there is none."""
    ends, heights = flows.ends[k], flows.heights[k]
    place = min(max(place, 0), len(ends) - 2)
    if heights[place] * heights[place + 1] >= 0:
        return ends[place + default]
    c, offset = flows.c[k : k + 1], flows.offset[k]
    left, right = ends[place], ends[place + 1]
    for _ in range(60):
        middle = 0.5 * (left + right)
        value = family.value(c, np.array([[middle]]))[0, 0] + offset
        same = value * heights[place] > 0
        left, right = (middle, right) if same else (left, middle)
    return left


def total(counts: list[Count]) -> Count:
    return Count(*map(sum, zip(*counts, strict=True)))


def campaign(flows: int, seed: int, methods=tuple(METHODS), families=tuple(FAMILIES)):
    """Yield a family, a method, a tolerance and the counts of so many flows of each."""
    for name in families:
        family = FAMILIES[name]
        for method in methods:
            rng = np.random.default_rng([seed, list(FAMILIES).index(name)])
            tolerance = np.repeat(TOLERANCES, flows)
            drawn = draw(family, len(tolerance), tolerance, rng)
            found = simulated(family, drawn, METHODS[method], tolerance)
            for i, accuracy in enumerate(TOLERANCES):
                lanes = range(i * flows, (i + 1) * flows)
                yield (
                    name,
                    method,
                    accuracy,
                    total(
                        [compare(family, drawn, k, found[k], accuracy) for k in lanes]
                    ),
                )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--flows", type=int, default=103, help="of each kind")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--families", nargs="*", default=list(FAMILIES))
    parser.add_argument("--methods", nargs="*", default=list(METHODS))
    options = parser.parse_args()
    hj.enable_x64()
    begin, counts = time.time(), []
    print(f"{'':30}", *(f"{x:>8}" for x in Count._fields))
    for name, method, accuracy, count in campaign(
        options.flows, options.seed, options.methods, options.families
    ):
        counts.append(count)
        print(
            f"{name:12} {method:8} {accuracy:8.0e}",
            *(f"{int(x):8}" for x in count),
            flush=True,
        )
    whole = total(counts)
    print(
        f"{'all':30}", *(f"{int(x):8}" for x in whole), f"  {time.time() - begin:.0f} s"
    )
    return int(whole.high + whole.long + whole.spurious > 0)


if __name__ == "__main__":
    sys.exit(main())
