"""heyoka.py (F. Biscani and D. Izzo, MNRAS 504, 2021): Taylor integrators compiled by LLVM, with
events that are part of a step.

Scalar: one experiment after the other. Batch: vectors of experiments side by side, as heyoka's
SIMD batch mode has them. In both the guards are terminal events whose callbacks change the chart.
"""

import math
from typing import NamedTuple

import numpy as np
from job import Job

from .errors import Unavailable


try:
    import heyoka as hy
except ImportError:
    hy = None


# Tolerances, coarse to fine. They set the order of the Taylor series; steps end at sections,
# before these tolerances would end them, so that errors are far smaller.
SETTINGS = (1e-4, 1e-5, 1e-6, 1e-7, 1e-9)


class Ready(NamedTuple):
    integrator: object
    guards: int


def compile_anew() -> None:
    """See to it that compiled code of earlier calls and processes is not used again.

    **Raises:** `Unavailable` without heyoka.
    """
    if hy is None:
        raise Unavailable("not installed")
    hy.llvm_state.set_diskcache_enabled(False)
    hy.llvm_state.clear_memcache()


def setup(job: Job, tol: float = 1e-7, batch: int = 1) -> Ready:
    """Compile an integrator for the job's model: scalar, or for `batch` lanes.

    **Raises:** `Unavailable` without heyoka.
    """
    compile_anew()
    from . import heyoka_models as models

    model = models.make(job)
    scalar = batch == 1
    event = hy.t_event if scalar else hy.t_event_batch
    falls = {"direction": hy.event_direction.negative}

    def callback(j):
        if scalar:

            def change(ta, sign):
                _jump(model, j, ta.time, ta.state, ta.pars[models.SWITCH])
                return True

        else:

            def change(ta, sign, lane):
                switch = ta.pars[models.SWITCH, lane]
                _jump(model, j, ta.time[lane], ta.state[:, lane], switch)
                return True

        return change

    events = [
        event(g, callback=callback(j), **falls) for j, g in enumerate(model.guards)
    ]
    if not job.clocked:
        events.append(event(models.section(model), **falls))
    make = hy.taylor_adaptive if scalar else hy.taylor_adaptive_batch
    state = np.zeros(4 if scalar else (4, batch))
    ta = make(model.fields, state, tol=tol, t_events=events)
    return Ready(ta, len(model.guards))


def run(job: Job, ready: Ready) -> np.ndarray:
    """The record (S, n, 2), by the integrator that `setup` made."""
    scalar = ready.integrator.state.ndim == 1
    if scalar:
        work = _scalar_clocked if job.clocked else _scalar_kinematic
        return np.stack([work(job, ready, u) for u in job.u])
    size = ready.integrator.batch_size
    work = _batch_clocked if job.clocked else _batch_kinematic
    parts = []
    for first in range(0, len(job.u), size):
        u = job.u[first : first + size]
        fill = np.pad(u, ((0, size - len(u)), (0, 0)), mode="edge")
        parts.append(work(job, ready, fill)[: len(u)])
    return np.concatenate(parts)


def _jump(model, j, t, state, switch):
    """Change state (4,) and switches in place where guard j fell."""
    state[:] = model.jump(j, t, state.tolist(), switch.tolist(), math.cos)
    switch[j] = 1 - switch[j]


def _begin(job, ta):
    """Put an integrator at section 0."""
    from . import heyoka_models as models

    state, pars = models.start(job, models.make(job))
    pars = pars[: len(ta.pars)]
    if ta.state.ndim == 1:
        ta.state[:], ta.pars[:], ta.time = state, pars, job.times[0]
    else:
        ta.state[:], ta.pars[:] = state[:, None], pars[:, None]
        ta.set_time(job.times[0])
    ta.reset_cooldowns()


def _arrivals(job, n):
    """Times (n,) at which clock sections end the intervals."""
    turns, i = np.divmod(np.arange(1, n + 1), job.sections)
    return job.times[i] + turns * job.period


def _scalar_clocked(job, ready, u):
    ta = ready.integrator
    _begin(job, ta)
    record = np.empty((len(u), 2))
    state, pars, go = ta.state, ta.pars, ta.propagate_until
    for k, (force, time) in enumerate(
        zip(u.tolist(), _arrivals(job, len(u)), strict=True)
    ):
        record[k] = state[:2]
        pars[0] = force
        go(time)
    return record


def _scalar_kinematic(job, ready, u):
    ta = ready.integrator
    _begin(job, ta)
    record = np.empty((len(u), 2))
    state, pars, go = ta.state, ta.pars, ta.propagate_for
    reached = hy.taylor_outcome(-ready.guards - 1)
    planes = np.roll(job.planes, -1, axis=0)
    late = job.period / 2
    for k, force in enumerate(u.tolist()):
        record[k] = state[:2]
        pars[0] = force
        pars[3:] = planes[k % job.sections]
        if go(late)[0] != reached:
            raise RuntimeError(f"section {k + 1} is not reached")
    return record


def _batch_clocked(job, ready, u):
    ta = ready.integrator
    _begin(job, ta)
    record = np.empty((u.shape[1], 2, u.shape[0]))
    state, pars, go = ta.state, ta.pars, ta.propagate_until
    for k, (force, time) in enumerate(
        zip(u.T.copy(), _arrivals(job, u.shape[1]), strict=True)
    ):
        record[k] = state[:2]
        pars[0] = force
        go(time)
    return np.moveaxis(record, 2, 0)


def _batch_kinematic(job, ready, u):
    """Every lane has its own coming section: none waits for another one."""
    ta = ready.integrator
    _begin(job, ta)
    L, n = u.shape
    # Lanes that are done before the others run on, for a cycle or two at most.
    end = n + 2 * job.sections
    u = np.pad(u, ((0, 0), (0, end - n))).ravel()
    record = np.empty((L * end, 2))
    planes = np.resize(np.roll(job.planes, -1, axis=0), (end, 3)).T.copy()
    first = np.arange(L) * end
    k = np.zeros(L, int)
    state, pars, step = ta.state, ta.pars, ta.step
    longest = [2 * job.durations.max()] * L
    here = np.arange(L)
    for steps in range(2 * end):
        count = k[here]
        row = first[here] + count
        record[row] = state[:2, here].T
        pars[0, here] = u[row]
        pars[3:, here] = planes[:, count]
        k[here] = count + 1
        if steps >= n and k.min() > n:
            return record.reshape(L, end, 2)[:, :n]
        step(longest)
        # Faster to see than the outcomes of the lanes, a list of tuples: which lie on a section.
        here = np.flatnonzero(
            np.abs(pars[3] * state[0] + pars[4] * state[1] + pars[5]) < 1e-10
        )
    raise RuntimeError("a section is not reached")
