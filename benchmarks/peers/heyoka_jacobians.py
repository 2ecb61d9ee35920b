"""Derivatives of all section maps by heyoka's variational equations, the sections side by side in
one batch. Across an event they follow from the saltation formula."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from job import Job

from .heyoka_peer import compile_anew, hy


class Ready(NamedTuple):
    integrator: object
    section: Callable | None
    state: np.ndarray
    pars: np.ndarray


def setup(job: Job, tol: float = 1e-12) -> Ready:
    """Compile the variational equations for the job's model.

    **Raises:** `Unavailable` without heyoka.
    """
    compile_anew()
    from . import heyoka_models as models

    model = models.make(job)
    variables = [x for x, _ in model.fields]
    # Derivatives by (t, four states, u) at the start.
    system = hy.var_ode_sys(
        model.fields, [hy.time, *variables, hy.par[models.INPUT]], order=1
    )
    fields = hy.cfunc([f for _, f in model.fields], variables)
    switches = (hy.par[1], hy.par[2])

    def callback(j, guard):
        after = model.jump(j, hy.time, variables, switches, hy.cos)
        saltation = _saltation(guard, after, model, variables)

        def change(ta, sign, lane):
            t, state = ta.time[lane], ta.state[:4, lane].copy()
            pars, D = ta.pars[:, lane].copy(), ta.state[4:, lane].reshape(4, 6)
            dt, through = (
                x[..., 0]
                for x in saltation(state[:, None], D[..., None], pars[:, None], t)
            )
            state = np.array(model.jump(j, t, state, pars[models.SWITCH], np.cos))
            pars[1 + j] = ta.pars[1 + j, lane] = 1 - pars[1 + j]
            away = fields(state, pars=pars[: fields.nparams], time=t)
            ta.state[:4, lane] = state
            ta.state[4:, lane] = (through - np.outer(away, dt)).ravel()
            return True

        return change

    falls = {"direction": hy.event_direction.negative}
    events = [
        hy.t_event_batch(g, callback=callback(j, g), **falls)
        for j, g in enumerate(model.guards)
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
    return Ready(
        ta, section, np.concatenate([state, D.reshape(24, -1)]), pars[: len(ta.pars)]
    )


def _saltation(guard, after, model, variables):
    """A function (state (4, L), D (4, 6, L), pars, t (L,)) -> the derivatives dt (6, L) of the
    times of the crossings, and those of the states that `after` gives there."""
    # heyoka differentiates by variables only.
    clock = hy.expression("clock")
    symbols = (*variables, clock)
    guard, *after = (hy.subs(f, {hy.time: clock}) for f in (guard, *after))
    rates = [hy.subs(f, {hy.time: clock}) for _, f in model.fields]
    matrix = [hy.diff(f, x) for f in (guard, *after) for x in symbols]
    f = hy.cfunc(matrix + rates, symbols)

    def saltation(state, D, pars, t):
        out = f(np.vstack([state, t]), pars=np.ascontiguousarray(pars[: f.nparams]))
        (g, *after), field = out[:25].reshape(5, 5, -1), out[25:]
        after = np.array(after)
        dt = -np.einsum("il,icl->cl", g[:4], D) / (
            np.einsum("il,il->l", g[:4], field) + g[4]
        )
        D = D + field[:, None] * dt
        return dt, np.einsum("jil,icl->jcl", after[:, :4], D) + after[:, 4:] * dt

    return saltation


def run(job: Job, ready: Ready) -> np.ndarray:
    """Derivatives (N, 5, 6) of (t, four states) at section i + 1 by (t, four states, u) at
    section i, on the cycle."""
    ta, N = ready.integrator, job.sections
    ta.state[:], ta.pars[:] = ready.state, ready.pars
    ta.set_time(job.times)
    ta.reset_cooldowns()
    longest = (
        job.durations.copy() if job.clocked else np.full(N, 2 * job.durations.max())
    )
    for _ in range(20):
        ta.step(longest)
        if job.clocked:
            longest = np.maximum(job.times + job.durations - ta.time, 0.0)
            left = np.flatnonzero(longest)
        else:
            off = np.einsum("cl,cl->l", ta.pars[3:5], ta.state[:2]) + ta.pars[5]
            longest[np.abs(off) < 1e-11] = 0.0
            left = np.flatnonzero(longest)
        if not len(left):
            break
    else:
        raise RuntimeError(f"sections {left + 1} are not reached")
    D = ta.state[4:].reshape(4, 6, N)
    dt = np.zeros((6, N))
    if not job.clocked:
        dt, D = ready.section(ta.state[:4], D, ta.pars, ta.time)
    return np.moveaxis(np.concatenate([dt[None], D]), 2, 0)
