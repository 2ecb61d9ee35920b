"""Derivatives of all section maps by heyoka's variational equations, the sections side by side in
one batch. Across an event they follow from the saltation formula."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from job import Job

from .errors import Unavailable
from .heyoka_peer import hy


class Ready(NamedTuple):
    integrator: object
    section: Callable | None
    state: np.ndarray
    pars: np.ndarray


def setup(job: Job, tol: float = 1e-12) -> Ready:
    """Compile the variational equations for the job's model.

    **Raises:** `Unavailable` without heyoka.
    """
    if hy is None:
        raise Unavailable("not installed")
    from . import heyoka_models as models

    model = models.make(job)
    variables = [x for x, _ in model.fields]
    # Derivatives by (t, four states, u) at the start.
    system = hy.var_ode_sys(model.fields, [hy.time, *variables, hy.par[models.INPUT]], order=1)
    fields = hy.cfunc([f for _, f in model.fields], variables)
    switches = (hy.par[1], hy.par[2])

    def callback(j, guard):
        after = model.jump(j, hy.time, variables, switches, hy.cos)
        saltation = _saltation(guard, after, model, variables)

        def change(ta, sign, lane):
            t, state, pars = ta.time[lane], ta.state[:, lane], ta.pars[:, lane].copy()
            D = state[4:].reshape(4, 6)
            dt, through = saltation(state[:4], D, pars, t)
            state[:4] = model.jump(j, t, state[:4], pars[models.SWITCH], np.cos)
            pars[1 + j] = ta.pars[1 + j, lane] = 1 - pars[1 + j]
            away = fields(state[:4].copy(), pars=pars[: fields.nparams], time=t)
            state[4:] = (through - np.outer(away, dt)).ravel()
            return True

        return change

    falls = {"direction": hy.event_direction.negative}
    events = [
        hy.t_event_batch(g, callback=callback(j, g), **falls) for j, g in enumerate(model.guards)
    ]
    section = None
    if not job.clocked:
        level = models.section(model)
        section = _saltation(level, variables, model, variables)
        events.append(hy.t_event_batch(level, **falls))
    begin = [models.start(job, model, i) for i in range(job.sections)]
    state, pars = (np.array(x).T for x in zip(*begin, strict=True))
    ta = hy.taylor_adaptive_batch(
        system, np.zeros((4, job.sections)), tol=tol, t_events=events, compact_mode=True
    )
    # At the start the state does not depend on u, and a later start is a step that is missing.
    D = np.zeros((4, 6, job.sections))
    D[:, 1:5] = np.eye(4)[:, :, None]
    for i, t in enumerate(job.times):
        own = pars[: fields.nparams, i].copy()
        D[:, 0, i] = -fields(state[:, i].copy(), pars=own, time=t)
    return Ready(ta, section, np.concatenate([state, D.reshape(24, -1)]), pars[: len(ta.pars)])


def _saltation(guard, after, model, variables):
    """A function (state, D (4, 6), pars, t) -> the derivatives dt (6,) of the time of the
    crossing, and those of the state that `after` gives there."""
    # heyoka differentiates by variables only.
    clock = hy.expression("clock")
    symbols = (*variables, clock)
    guard, *after = (hy.subs(f, {hy.time: clock}) for f in (guard, *after))
    rates = [hy.subs(f, {hy.time: clock}) for _, f in model.fields]
    matrix = [hy.diff(f, x) for f in (guard, *after) for x in symbols]
    f = hy.cfunc(matrix + rates, symbols)

    def saltation(state, D, pars, t):
        out = f(np.append(state, t), pars=pars[: f.nparams])
        (g, *after), field = out[:25].reshape(5, 5), out[25:]
        after = np.array(after)
        dt = -(g[:4] @ D) / (g[:4] @ field + g[4])
        D = D + np.outer(field, dt)
        return dt, after[:, :4] @ D + np.outer(after[:, 4], dt)

    return saltation


def run(job: Job, ready: Ready) -> np.ndarray:
    """Derivatives (N, 5, 6) of (t, four states) at section i + 1 by (t, four states, u) at
    section i, on the cycle."""
    ta, N = ready.integrator, job.sections
    ta.state[:], ta.pars[:] = ready.state, ready.pars
    ta.set_time(job.times)
    ta.reset_cooldowns()
    out = np.zeros((N, 5, 6))
    longest = job.durations.copy() if job.clocked else np.full(N, 2 * job.durations.max())
    left = np.arange(N)
    for _ in range(20):
        ta.step(longest)
        if job.clocked:
            longest = np.maximum(job.times + job.durations - ta.time, 0.0)
            left = np.flatnonzero(longest)
        else:
            off = np.einsum("cl,cl->l", ta.pars[3:5], ta.state[:2]) + ta.pars[5]
            here = left[np.abs(off[left]) < 1e-11]
            for i in here:
                state, pars = ta.state[:4, i], ta.pars[:, i].copy()
                D = ta.state[4:, i].reshape(4, 6)
                out[i, 0], out[i, 1:] = ready.section(state, D, pars, ta.time[i])
            longest[here] = 0.0
            left = np.flatnonzero(longest)
        if not len(left):
            break
    else:
        raise RuntimeError(f"sections {left + 1} are not reached")
    if job.clocked:
        out[:, 1:] = np.moveaxis(ta.state[4:].reshape(4, 6, N), 2, 0)
    return out
