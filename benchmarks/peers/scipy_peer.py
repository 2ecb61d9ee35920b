"""scipy's `solve_ivp` (DOP853), restarted at each section and each event, with terminal events."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from job import Job
from scipy.integrate import solve_ivp

from .errors import Unavailable


# Relative tolerances, coarse to fine; absolute ones are a tenth of them.
SETTINGS = (1e-7, 1e-8, 1e-9, 1e-10)


class Chart(NamedTuple):
    """`field(t, q, u)`; for each guard, a function (t, q, u) that falls through zero, and a
    function (t, q) -> the next chart and its state."""

    field: Callable
    guards: tuple[Callable, ...]
    jumps: tuple[Callable, ...]


def hopper(m, M, k, b, l0, a, g, omega, retention) -> dict[str, Chart]:
    def leg(t, y, ym=0.0):
        return k * (l0 - (y - ym)) + a * np.sin(omega * t)

    def flight(t, q, u):
        y, v, ym, vm = q
        force = leg(t, y, ym)
        return v, (force + u) / M - g, vm, -(force + b * vm) / m - g

    def stance(t, q, u):
        return q[1], (leg(t, q[0]) + u) / M - g

    def touchdown(t, q, u):
        return q[2]

    def liftoff(t, q, u):
        return leg(t, q[0]) + m * g

    return {
        "flight": Chart(
            flight,
            (touchdown,),
            (lambda t, q: ("stance", np.array([q[0], retention * q[1]])),),
        ),
        "stance": Chart(
            stance,
            (liftoff,),
            (lambda t, q: ("flight", np.array([q[0], q[1], 0.0, 0.0])),),
        ),
    }


def setup(job: Job) -> dict[str, Chart]:
    """The charts of the job's model.

    **Raises:** `Unavailable` for the bar.
    """
    if job.model != "hopper":
        raise Unavailable("it is written for the hopper only")
    return hopper(**job.parameters)


def run(job: Job, charts: dict[str, Chart], rtol: float = 1e-9) -> np.ndarray:
    """The record (S, n, 2). Slow: give it a job with few experiments and scale the time."""
    record = np.empty((*job.u.shape, 2))
    for s, u in enumerate(job.u):
        chart, t, q = job.charts[0], job.times[0], job.states[0]
        q = q[: 4 if chart == "flight" else 2]
        for k, force in enumerate(u):
            record[s, k] = q[:2]
            t, chart, q = _to_section(job, charts, k + 1, t, chart, q, force, rtol)
    return record


def _to_section(job, charts, k, t, chart, q, u, rtol):
    turns, i = divmod(k, job.sections)
    end = job.times[i] + turns * job.period
    slope_y, slope_v, offset = job.planes[i]

    def section(t, q, u):
        return slope_y * q[0] + slope_v * q[1] + offset

    functions = () if job.clocked else (section,)
    for function in (section, *(g for c in charts.values() for g in c.guards)):
        function.terminal, function.direction = True, -1
    while True:
        here = charts[chart]
        out = solve_ivp(
            here.field,
            (t, end if job.clocked else t + job.period / 2),
            q,
            method="DOP853",
            events=(*functions, *here.guards),
            args=(u,),
            rtol=rtol,
            atol=rtol / 10,
        )
        t, q = out.t[-1], out.y[:, -1]
        if out.status == 0 and job.clocked:
            return t, chart, q
        if out.status != 1:
            raise RuntimeError(f"section {k} is not reached: {out.message}")
        event = next(j for j, times in enumerate(out.t_events) if len(times)) - len(
            functions
        )
        if event < 0:
            return t, chart, q
        chart, q = here.jumps[event](t, q)
