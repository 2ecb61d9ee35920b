"""Limit cycles and multipliers of 10 000 hoppers in one call, beside C, and some against scipy.

k in linspace(8, 13, 100) x b in linspace(3, 7, 100), other parameters the paper's. At some points
the clock's phase 0.5, where the return map is taken, lies in flight. `times_c`: multiple of the
time of the sweep in C (peers/c_peer/cycles.c); `c.trace_error`: the largest difference of the sums
of multipliers.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from peers.contest import measure
from peers.scipy_peer import hopper as scipy_hopper
from scipy.integrate import solve_ivp
from scipy.optimize import fsolve

import hybridjax as hj
from hybridjax._core.results import Result
from hybridjax.orbits.limit_cycles import LimitCycles, find_limit_cycles

from .problems import cycle, hoppers_in_c


def run(show, options) -> None:
    side = 20 if options.quick else 100
    k, b = np.meshgrid(np.linspace(8, 13, side), np.linspace(3, 7, side), indexing="ij")
    make = eqx.filter_vmap(lambda k, b: hj.models.VerticalHopper(k=k, b=b))
    systems = make(jnp.asarray(k.ravel()), jnp.asarray(b.ravel()))
    base = cycle("hopper")

    def work():
        cycles = find_limit_cycles(systems, base)
        return cycles, cycles.multipliers

    _, first = measure(work)
    (cycles, multipliers), later = measure(
        work, 1 if options.quick else min(options.repeat, 3)
    )
    show("hoppers", len(cycles))
    show("compile", first.wall - later.wall)
    show("cpu", later.cpu)
    show("wall", later.wall)
    show("found", float(cycles.ok.mean()))
    for code in np.unique(cycles.result[~cycles.ok]):
        show(
            f"failed.{Result(int(code)).name.lower()}",
            int((cycles.result == code).sum()),
        )
    show("residual", float(cycles.residual[cycles.ok].max()))
    show("good", float((cycles.ok & (cycles.residual <= 1e-10)).mean()))
    show("in_flight", int((cycles.anchor.chart.ravel() == 0).sum()))
    c = hoppers_in_c(base, k, b, 1 if options.quick else options.repeat)
    if c is not None:
        show("c.cpu", c.seconds.cpu)
        show("c.found", float((c.cycles.charts >= 0).mean()))
        show("times_c", later.cpu / c.seconds.cpu)
        both = cycles.ok & (c.cycles.charts >= 0)
        apart = (multipliers.sum(axis=1) - c.cycles.multipliers.sum(axis=1))[both]
        show("c.trace_error", float(np.abs(apart).max()))
    _check(cycles, multipliers, show, 5 if options.quick else 20)


def _check(cycles: LimitCycles, multipliers, show, count: int) -> None:
    """Random points against a return map by scipy, solved from a start that is a bit off."""
    rng = np.random.default_rng(0)
    errors = []
    for i in rng.choice(np.flatnonzero(cycles.ok), count, replace=False):
        here = cycles[int(i)]
        name = ("flight", "stance")[int(here.anchor.chart[0])]
        ours = np.asarray(here.anchor.q)[: 4 if name == "flight" else 2, 0]
        charts = scipy_hopper(**_numbers(here.system))
        t0, period = float(here.anchor.t[0]), float(here.period)

        def turn(q, charts=charts, t0=t0, period=period, name=name):
            return _flow(charts, name, q, t0, t0 + period)

        off = ours + 1e-3 * rng.standard_normal(ours.shape)
        theirs = fsolve(lambda q, turn=turn: turn(q) - q, off, xtol=1e-13)
        h = 1e-5
        J = [
            (turn(theirs + h * e) - turn(theirs - h * e)) / (2 * h)
            for e in np.eye(len(ours))
        ]
        values = np.linalg.eigvals(np.array(J).T)
        distance = np.abs(values[:, None] - multipliers[i][None, :2]).min(axis=0).max()
        errors.append((np.abs(theirs - ours).max(), distance))
    show("scipy.points", count)
    show("scipy.state_error", float(np.max(errors, axis=0)[0]))
    show("scipy.multiplier_error", float(np.max(errors, axis=0)[1]))


def _numbers(system) -> dict[str, float]:
    return {x: float(v) for x, v in vars(system).items() if isinstance(v, jax.Array)}


def _flow(charts, name: str, q, t: float, end: float):
    """The state at `end`, which has to lie in the chart of the start."""
    home = name
    while True:
        chart = charts[name]
        for guard in chart.guards:
            guard.terminal, guard.direction = True, -1
        out = solve_ivp(
            chart.field,
            (t, end),
            q,
            method="DOP853",
            events=chart.guards,
            args=(0.0,),
            rtol=1e-12,
            atol=1e-13,
        )
        t, q = out.t[-1], out.y[:, -1]
        if out.status == 0:
            if name != home:
                raise RuntimeError(f"one period from {home} ends in {name}")
            return q
        event = next(j for j, times in enumerate(out.t_events) if len(times))
        name, q = chart.jumps[event](t, q)
