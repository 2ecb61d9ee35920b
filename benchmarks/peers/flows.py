"""Flows through events by scipy with differences, and by heyoka with variational equations.

A `Row` has plain arithmetic for its functions, so that both can use it. heyoka has no derivatives
across events: the saltation matrix is written here, as its users have to.
"""

import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.integrate import solve_ivp

from .errors import Unavailable


try:
    import heyoka as hy
except ImportError:
    hy = None


# Error of a step. Smaller: rounding. Larger: derivatives lose digits.
_TOLERANCE = 1e-13
# Steps of central differences, relative to one and to the parameter, near the cube root of the
# error of a flow. Smaller: rounding. Larger: third derivatives.
_ASIDE = 1e-5


class Event(NamedTuple):
    """From chart `source`, where `guard(t, q, p)` falls through zero, to chart `target` with the
    state `reset(t, q, p)`."""

    source: int
    target: int
    guard: Callable
    reset: Callable


class Row(NamedTuple):
    """A flow from `start(p)` (functions of states and parameters return sequences) in the first
    chart, to a time, or until some events have happened."""

    fields: tuple[Callable, ...]
    """By chart: f(t, q, p)."""
    events: tuple[Event, ...]
    start: tuple[float, ...]
    until: float | None
    count: int | None
    wanted: str
    """`time` or `state`: the time of the end, or the first state there."""


def stay(t, q, p):
    return q


ROWS = {
    "ramp": Row(
        (lambda t, q, p: (1.0,), lambda t, q, p: (0.0,)),
        (Event(0, 1, lambda t, q, p: p[0] - t, stay),),
        (0.0,),
        2.0,
        None,
        "state",
    ),
    "after_eleven_resets": Row(
        (lambda t, q, p: (1.0,),),
        (Event(0, 0, lambda t, q, p: p[0] - q[0], lambda t, q, p: (0.0,)),),
        (0.0,),
        1.0,
        None,
        "state",
    ),
    "third_bounce": Row(
        (lambda t, q, p: (q[1], -p[0]),),
        (Event(0, 0, lambda t, q, p: q[0], lambda t, q, p: (0.0, -p[1] * q[1])),),
        (1.0, 0.0),
        None,
        3,
        "time",
    ),
    "stop": Row(
        (lambda t, q, p: (q[1], -p[0] * p[0] * q[0]),),
        (
            Event(
                0, 0, lambda t, q, p: q[0] + p[1], lambda t, q, p: (q[0], -p[2] * q[1])
            ),
        ),
        (1.0, 0.0),
        2.5,
        None,
        "state",
    ),
    "thermostat": Row(
        (lambda t, q, p: (p[0] * (p[3] - q[0]),), lambda t, q, p: (-p[0] * q[0],)),
        (
            Event(0, 1, lambda t, q, p: p[2] - q[0], stay),
            Event(1, 0, lambda t, q, p: q[0] - p[1], stay),
        ),
        (20.0,),
        None,
        5,
        "time",
    ),
    "moving_guard": Row(
        (lambda t, q, p: (-q[0],),),
        (Event(0, 0, lambda t, q, p: q[0] - p[0] * t, lambda t, q, p: (q[0] + 1.0,)),),
        (1.0,),
        1.0,
        None,
        "state",
    ),
}


# scipy.


def by_scipy(row: Row, p: np.ndarray) -> float:
    """The value of a row, by solve_ivp that begins anew after each event."""
    t = 0.0
    q = np.array(row.start)
    a = 0
    count = 0
    end = 50.0 if row.until is None else row.until
    while True:
        own = [event for event in row.events if event.source == a]
        found = solve_ivp(
            lambda t, q, a=a: row.fields[a](t, q, p),
            (t, end),
            q,
            method="DOP853",
            rtol=_TOLERANCE,
            atol=_TOLERANCE,
            events=[_falling(event, p) for event in own],
        )
        t = found.t[-1]
        q = found.y[:, -1]
        if found.status == 0:
            break
        fired = next(k for k, x in enumerate(found.t_events) if len(x))
        q = np.array(own[fired].reset(t, q, p), float)
        a = own[fired].target
        count += 1
        if count == row.count:
            break
    return t if row.wanted == "time" else q[0]


def _falling(event: Event, p: np.ndarray) -> Callable:
    def value(t, q):
        return event.guard(t, q, p)

    value.terminal = True
    value.direction = -1
    return value


def scipy_gradient(row: Row) -> Callable:
    """The gradient of a row by its parameters, by central differences."""

    def gradient(p):
        out = np.empty(len(p))
        for k in range(len(p)):
            aside = _ASIDE * (1 + abs(p[k])) * (np.arange(len(p)) == k)
            change = by_scipy(row, p + aside) - by_scipy(row, p - aside)
            out[k] = change / (2 * aside[k])
        return out

    return gradient


# heyoka.


def heyoka_gradient(row: Row, parameters: int) -> Callable:
    """The gradient of a row by its parameters, by variational equations.

    **Raises:** `Unavailable` without heyoka.
    """
    if hy is None:
        raise Unavailable("not installed")
    n = len(row.start)
    q = hy.make_vars(*(f"q{k}" for k in range(n)))
    q = q if isinstance(q, list) else [q]
    p = [hy.par[k] for k in range(parameters)]
    clock = hy.expression("clock")
    numbers = [hy.expression(f"p{k}") for k in range(parameters)]
    symbols = [clock, *q, *numbers]

    def function(expressions):
        """Values of some functions of (t, q, p), and their derivatives."""
        values = [x + 0.0 * clock for x in expressions]
        columns = [hy.diff(x, y) for x in values for y in symbols]
        return hy.cfunc(values + columns, symbols)

    fields = [function(f(clock, q, numbers)) for f in row.fields]
    guards = [function([event.guard(clock, q, numbers)]) for event in row.events]
    resets = [function(event.reset(clock, q, numbers)) for event in row.events]
    integrators = []
    for a, f in enumerate(row.fields):
        right = [x + 0.0 * y for x, y in zip(f(hy.time, q, p), q, strict=True)]
        system = hy.var_ode_sys(list(zip(q, right, strict=True)), p, order=1)
        stops = [
            hy.t_event(
                event.guard(hy.time, q, p), direction=hy.event_direction.negative
            )
            for event in row.events
            if event.source == a
        ]
        integrators.append(
            hy.taylor_adaptive(system, list(row.start), t_events=stops, tol=_TOLERANCE)
        )

    def expanded(compiled, t, q, p):
        out = compiled(np.concatenate([[t], q, p]))
        rows = len(out) // (1 + len(symbols))
        return out[:rows], out[rows:].reshape(rows, -1)

    def gradient(p):
        t = 0.0
        a = 0
        last = None
        count = 0
        state = np.concatenate([row.start, np.zeros(n * parameters)])
        end = 50.0 if row.until is None else row.until
        while True:
            ta = integrators[a]
            ta.pars[:] = p[: len(ta.pars)]
            ta.time = t
            ta.state[:] = state
            # (In the same chart heyoka knows that the guard has just been crossed.)
            if ta.with_events and a != last:
                ta.reset_cooldowns()
            last = a
            outcome = int(ta.propagate_until(end)[0].value)
            t = ta.time
            x = ta.state[:n].copy()
            D = ta.state[n:].reshape(n, parameters).copy()
            if outcome == int(hy.taylor_outcome.time_limit.value):
                return D[0]
            own = [k for k, event in enumerate(row.events) if event.source == a]
            g = own[-outcome - 1]
            before, _ = expanded(fields[a], t, x, p)
            _, slope = expanded(guards[g], t, x, p)
            after, by = expanded(resets[g], t, x, p)
            rate = slope[0, 0] + slope[0, 1 : 1 + n] @ before
            delay = -(slope[0, 1 : 1 + n] @ D + slope[0, 1 + n :]) / rate
            moved = D + np.outer(before, delay)
            a = row.events[g].target
            later, _ = expanded(fields[a], t, after, p)
            D = by[:, 1 : 1 + n] @ moved + by[:, 1 + n :]
            D += np.outer(by[:, 0], delay) - np.outer(later, delay)
            state = np.concatenate([after, D.ravel()])
            count += 1
            if count == row.count:
                return delay

    return gradient


def timed(make: Callable, point: np.ndarray, repeat: int = 20) -> tuple:
    """A gradient, and the CPU seconds of its first call, with all that is made for it, and of a
    later one."""
    begin = time.process_time()
    gradient = make()
    value = np.asarray(gradient(point))
    first = time.process_time() - begin
    later = []
    for _ in range(repeat):
        begin = time.process_time()
        np.asarray(gradient(point))
        later.append(time.process_time() - begin)
    return value, first, min(later)
