"""Stiff cycles beside scipy's Radau, and what explicit methods cost.

One turn of van der Pol's oscillator from 80 points of its cycle, compiled, and from one of them.
The error is the distance from the start after the period that benchmarks/stiff_truth.py gives.
scipy's tolerance is the largest power of ten at which it is as accurate. `ratio` is its time for
one turn per turn of ours, in one thread each.
"""

import time

import jax
import numpy as np
from scipy.integrate import solve_ivp

import hybridjax as hj
from hybridjax.engine.lanes import start_lanes
from hybridjax.engine.move import move
from hybridjax.engine.settings import Settings
from hybridjax.engine.target import until
from hybridjax.systems.structure import Structure

from .problems import first_and_later


PERIODS = {100.0: 162.83707109237, 1000.0: 1614.40112580836}
RTOL = 1e-11


def run(show, options) -> None:
    for mu in (100.0,) if options.quick else PERIODS:
        _relaxation(
            lambda name, x, mu=mu: show(f"vanderpol_{mu:g}.{name}", x), mu, options
        )
    for model in (hj.models.VerticalHopper(), hj.models.CompliantHopper()):
        name, work = (
            type(model).__name__,
            lambda model=model: hj.find_limit_cycle(model),
        )
        _, _, seconds = first_and_later(work, options.repeat)
        show(f"{name}.find_limit_cycle.cpu", seconds.cpu)


def _relaxation(show, mu: float, options) -> None:
    system, period = hj.models.VanDerPol(mu, solver=hj.systems.Radau()), PERIODS[mu]
    sizes = np.array([2.0, 1.34 * mu])
    points = _points(mu, period, 1 if options.quick else 80)
    settings = Settings(RTOL, RTOL, 100_000, sizes[None])

    @jax.jit
    def turn(q):
        s = Structure(system)
        t = jax.numpy.zeros(q.shape[1])
        lanes = start_lanes(s, t, jax.numpy.zeros(q.shape[1], int), q)
        return move(
            s, lanes, jax.numpy.zeros((1, q.shape[1])), until(t + period), settings
        ).moved

    def seconds_of(q):
        moved, compiling, seconds = first_and_later(
            lambda: jax.block_until_ready(turn(q)), options.repeat
        )
        assert not np.any(moved.result)
        return np.asarray(moved.lanes.q), compiling, seconds

    points = np.asarray(
        turn(points).lanes.q
    )  # they were on the cycle up to interpolation
    one, compiling, alone = seconds_of(points[:, :1])
    show("compile", compiling)
    error = _distance(one, points[:, :1], sizes)
    show("one.error", error)
    show("one.cpu", alone.cpu)
    for digits in range(6, 14):
        end, cpu, steps = _scipy(mu, points[:, 0], period, 10.0**-digits)
        if _distance(end[:, None], points[:, :1], sizes) <= error:
            break
    show("scipy.rtol", 10.0**-digits)
    show("scipy.error", _distance(end[:, None], points[:, :1], sizes))
    show("scipy.steps", steps)
    show("scipy.cpu", cpu)
    show("one.ratio", cpu / alone.cpu)
    many, _, together = seconds_of(points)
    show("eighty.error", _distance(many, points, sizes))
    show("eighty.cpu", together.cpu)
    show("eighty.ratio", cpu * points.shape[1] / together.cpu)


def _points(mu: float, period: float, count: int) -> np.ndarray:
    """States (2, count) on the cycle, at equal distances in time."""
    start = [2.0, -2 / (3 * mu)]
    times = 2 * period + period * np.arange(count) / count
    found = solve_ivp(
        *_flow(mu),
        (0, 3 * period),
        start,
        "Radau",
        t_eval=times,
        rtol=1e-12,
        atol=1e-15,
        jac=_jacobian(mu),
    )
    return found.y


def _flow(mu):
    return (lambda t, z: (z[1], mu * (1 - z[0] ** 2) * z[1] - z[0]),)


def _jacobian(mu):
    return lambda t, z: [[0, 1], [-2 * mu * z[0] * z[1] - 1, mu * (1 - z[0] ** 2)]]


def _scipy(mu, start, period, rtol):
    begin = time.process_time()
    found = solve_ivp(
        *_flow(mu),
        (0, period),
        start,
        "Radau",
        rtol=rtol,
        atol=rtol * 1e-3,
        jac=_jacobian(mu),
    )
    return found.y[:, -1], time.process_time() - begin, len(found.t)


def _distance(end, start, sizes) -> float:
    """Relative to the sizes of the states."""
    return float(np.max(np.abs(end - start) / sizes[:, None]))
