"""The vertical hopper in plain numpy and scipy, written independently of the package.

A point is (t, yM, vM, ym, vm) in flight and (t, yM, vM) in stance. A section is ("clock", time) or
("angle", angle): the level set of the angle of (yM - 1.9) / 0.3 + i vM / 1.9, which decreases.
"""

import functools

import numpy as np
from scipy.integrate import solve_ivp


NAMES = ("t", "yM", "vM", "ym", "vm")


def _leg(t, yM, ym):
    spring = 10.0 * (2.0 - (yM - ym))
    motor = 20.0 * np.sin(2 * np.pi * t)
    return spring + motor


def _field(t, q, u):
    yM, vM = q[:2]
    if len(q) == 2:
        force = _leg(t, yM, 0.0) + u
        acceleration = force / 2.0 - 2.0
        return np.array([vM, acceleration])
    ym, vm = q[2:]
    leg = _leg(t, yM, ym)
    body = (leg + u) / 2.0 - 2.0
    foot = -leg - 5.0 * vm - 2.0
    return np.array([vM, body, vm, foot])


def plane(point):
    x = (point[1] - 1.9) / 0.3
    return x, point[2] / 1.9


def _level(section, t, q):
    """Falls through zero at the section."""
    kind, value = section
    if kind == "clock":
        return value - t
    x, y = plane((t, *q))
    along = y * np.cos(value)
    return along - x * np.sin(value)


def _guard(t, q):
    if len(q) == 2:
        return _leg(t, q[0], 0.0) + 2.0
    return q[2]


def _polish(function, t, q, u):
    """Newton along the flow: corrections of about 1e-12 to the root of a dense output."""
    for _ in range(2):
        e = 1e-6
        f = _field(t, q, u)
        later = function(t + e, q + e * f)
        earlier = function(t - e, q - e * f)
        rate = (later - earlier) / (2 * e)
        dt = -function(t, q) / rate
        t = t + dt
        q = q + dt * f
    return t, q


def solve(t, q, u, end, events=()):
    return solve_ivp(
        lambda t, q: _field(t, q, u),
        (t, end),
        q,
        method="DOP853",
        rtol=1e-13,
        atol=1e-14,
        events=list(events),
    )


def flow(point, section, u=0.0, retention=1.0):
    """The point at which the flow from `point` reaches `section`."""

    def guard(t, q):
        return _guard(t, q)

    def level(t, q):
        return _level(section, t, q)

    for watched in (guard, level):
        watched.terminal = True
        watched.direction = -1.0
    t = point[0]
    q = np.asarray(point[1:])
    while True:
        path = solve(t, q, u, t + 2.0, events=(guard, level))
        assert path.status == 1, f"nothing happens after {point}"
        at_section = len(path.t_events[1]) > 0
        # Once more over the last step, so that its end is a true step and no interpolant.
        before = path.t[-2]
        end = path.t[-1]
        if end > before:
            begin = path.y[:, -2]
            last = solve(before, begin, u, end)
            watched = level if at_section else guard
            start = last.y[:, -1]
            t, q = _polish(watched, end, start, u)
        if at_section:
            return np.array([t, *q])
        if len(q) == 4:  # touchdown
            speed = retention * q[1]
            q = np.array([q[0], speed])
        else:  # liftoff
            q = np.array([q[0], q[1], 0.0, 0.0])


def onto(section, point, names):
    """`point` with the one coordinate that is not in `names` set so that it lies on `section`."""
    point = np.array(point)
    kind, value = section
    if kind == "clock":
        point[0] = value
    elif "vM" not in names:
        height = point[1] - 1.9
        slope = 1.9 * np.tan(value)
        point[2] = slope * height / 0.3
    else:
        assert "yM" not in names
        ratio = point[2] / 1.9
        shift = 0.3 * ratio / np.tan(value)
        point[1] = 1.9 + shift
    return point


def jacobian(point, here, there, names, names_after, retention=1.0, e=2e-4):
    """Derivatives of the coordinates `names_after` on `there` with respect to `names` on `here`,
    and (last column) to an input held in between; central differences of fourth order."""
    rows = [NAMES.index(name) for name in names_after]

    def by_coordinate(name, x):
        start = np.array(point)
        start[NAMES.index(name)] += x
        return flow(onto(here, start, names), there, 0.0, retention)[rows]

    def by_input(x):
        start = onto(here, np.array(point), names)
        return flow(start, there, x, retention)[rows]

    def derivative(value):
        once = value(e) - value(-e)
        ahead = value(2 * e)
        twice = ahead - value(-2 * e)
        return (8 * once - twice) / (12 * e)

    columns = []
    for name in names:
        columns.append(derivative(functools.partial(by_coordinate, name)))
    columns.append(derivative(by_input))
    return np.stack(columns, axis=1)
