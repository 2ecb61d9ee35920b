"""All 32 pairs A, B: in a user's compiled function, by `linearize`, and by heyoka.

`program` computes A and B of sections that are placed on a cycle, inside of an outer jit; `placing`
finds the sections on the cycle first, as a fit does at every step. `linearize` is one call from
Python, which is compiled quickly and runs slower.
"""

import dataclasses
import functools as ft

import equinox as eqx
import numpy as np
import truth
from peers import contest

import hybridjax as hj

from .problems import ALL, Problem, first_and_later, problem


RTOL = (1e-10, 1e-12)


@eqx.filter_jit
def _program(placed):
    return placed.flow_jacobians


@eqx.filter_jit
def _placing(cycle, family):
    return hj.sections.place_sections(cycle, family).flow_jacobians


def run(show, options) -> None:
    repeat = 4 * options.repeat
    for model, family in ALL:
        task = problem(model, family, options.quick)
        full = truth.jacobians(task.job)
        exact = _on_sections(task, full)
        for rtol in RTOL:
            name = f"{task.label}.program.rtol_{rtol:.0e}"
            settings = hj.orbits.Settings(rtol, rtol, scale=task.cycle.settings.scale)
            cycle = dataclasses.replace(task.cycle, settings=settings)
            work = ft.partial(
                _program, hj.sections.place_sections(cycle, task.placed.family)
            )
            (A, B), compiling, seconds = first_and_later(work, repeat)
            if rtol == RTOL[0]:
                show(f"{name}.compile", compiling)
            show(f"{name}.cpu", seconds.cpu)
            show(f"{name}.error", _error((A, B), exact))
            work = ft.partial(_placing, cycle, task.placed.family)
            show(
                f"{task.label}.placing.rtol_{rtol:.0e}.cpu",
                first_and_later(work, repeat)[2].cpu,
            )
        name = f"{task.label}.linearize"
        work = ft.partial(hj.linearize, task.cycle, task.placed, task.outputs)
        ldtp, compiling, seconds = first_and_later(work, repeat)
        show(f"{name}.compile", compiling)
        show(f"{name}.cpu", seconds.cpu)
        show(f"{name}.error", _error((ldtp.A, ldtp.B), exact))
        contest.jacobians(task.job, full, show, repeat)


def _on_sections(task: Problem, full: np.ndarray):
    """A and B in the coordinates of the sections, from derivatives (N, 5, 6) by (t, q, u)."""
    embed, select = (np.asarray(x) for x in task.placed.frames())
    after = np.roll(select, -1, axis=0)
    return after @ full[:, :, :5] @ embed, after @ full[:, :, 5:]


def _error(found, exact) -> float:
    """Largest difference; what pads the arrays to one size is zero in both."""
    worst = 0.0
    for x, y in zip(found, exact, strict=True):
        x = np.asarray(x)
        rows, columns = x.shape[1:]
        worst = max(worst, np.abs(x - y[:, :rows, :columns]).max())
    return float(worst)
