"""Closed form of the job: both models are linear in each chart, and so are guards and resets.

With z = (four states, 1, sin wt, cos wt, u) a chart is z' = G z. Its solution, the power series
sum_k (G tau)^k z / k!, is cut where the rest is below rounding (tau is at most a fraction of a
period), so guards and sections are polynomials in tau, whose first zeros are found by Newton
inside a bracket. Numpy only; all experiments side by side.
"""

from typing import NamedTuple

import numpy as np
from job import Job


TERMS = 22
SAMPLES = np.linspace(0, 1, 17)[1:]
# A guard fires only after it was this far above zero; it is at zero right after its own event.
ARMED = 1e-13
SIN, COS, U = 5, 6, 7


class Piecewise(NamedTuple):
    """A hybrid system in z: matrices (C, 8, 8), and for each chart two guards that fall through
    zero (C, 2, 8), the charts that they lead to (C, 2) and their resets (C, 2, 8, 8)."""

    charts: tuple[str, ...]
    rate: float
    G: np.ndarray
    guard: np.ndarray
    to: np.ndarray
    reset: np.ndarray


def hopper(m, M, k, b, l0, a, g, omega, retention) -> Piecewise:
    y, v, ym, vm, one, sin, cos, u = np.eye(8)
    zero = 0 * one
    leg = k * (l0 * one - y + ym) + a * sin
    body = [v, (leg + u) / M - g * one]
    clock = [zero, omega * cos, -omega * sin, zero]
    flight = [*body, vm, -(leg + b * vm) / m - g * one, *clock]
    stance = [*body, zero, zero, *clock]
    rest = [one, sin, cos, u]
    touchdown = [y, retention * v, zero, zero, *rest]
    liftoff = [y, v, zero, zero, *rest]
    return Piecewise(
        ("flight", "stance"),
        omega,
        np.array([flight, stance]),
        np.array([[ym, one], [leg - k * ym + m * g * one, one]]),
        np.array([[1, 0], [0, 1]]),
        np.array([[touchdown, np.eye(8)], [liftoff, np.eye(8)]]),
    )


def bar(m, J, hind, front, k, b, l0, g, rho, A, T) -> Piecewise:
    y, v, q, p, one, sin, cos, u = np.eye(8)
    rate = 2 * np.pi / T
    hips = (hind, front)
    length = [y + s * q - A * sin - l0 * one for s in hips]
    speed = [v + s * p - A * rate * cos for s in hips]
    force = [-k * x - b * c for x, c in zip(length, speed, strict=True)]
    G, guard, to, reset = [], [], [], []
    for chart in range(4):  # bit j: leg j stands
        on = [chart >> j & 1 for j in range(2)]
        total = sum(on[j] * force[j] for j in range(2))
        torque = sum(on[j] * hips[j] * force[j] for j in range(2))
        clock = [0 * one, rate * cos, -rate * sin, 0 * one]
        G.append([v, (total + u) / m - g * one, p, torque / J, *clock])
        guard.append([-length[j] if on[j] else length[j] for j in range(2)])
        to.append([chart ^ 1, chart ^ 2])
        reset.append([])
        for j, s in enumerate(hips):
            impulse = -(1 - on[j]) * (1 - rho) * speed[j] / (1 / m + s**2 / J)
            reset[-1].append(
                [y, v + impulse / m, q, p + s * impulse / J, one, sin, cos, u]
            )
    charts = ("air", "hind", "front", "both")
    return Piecewise(charts, rate, *(np.array(x) for x in (G, guard, to, reset)))


class Lanes(NamedTuple):
    """Many states: time (L,), chart (L,), and z (8, 1 + c, L), first itself and then its c
    derivatives; `dt` (c, L) are those of the time."""

    t: np.ndarray
    chart: np.ndarray
    z: np.ndarray
    dt: np.ndarray


def experiments(job: Job) -> np.ndarray:
    """The record (S, n, 2)."""
    system = _system(job)
    S, n = job.u.shape
    N = job.sections
    lanes = _start(job, system, np.zeros(S, int), 0)
    out = np.empty((n, 2, S))
    for k in range(n):
        out[k] = lanes.z[:2, 0]
        lanes.z[U, 0] = job.u[:, k]
        lanes = _to_section(job, system, lanes, np.full(S, (k + 1) % N))
    return np.moveaxis(out, 2, 0)


def jacobians(job: Job) -> np.ndarray:
    """Derivatives (N, 5, 6) of (t, four states) at section i + 1 by (t, four states, u) at
    section i, on the cycle."""
    system, N = _system(job), job.sections
    lanes = _start(job, system, np.arange(N), 6)
    lanes.dt[0] = 1.0
    for state in range(4):
        lanes.z[state, 2 + state] = 1.0
    phase = system.rate * lanes.t
    lanes.z[SIN, 1] = system.rate * np.cos(phase)
    lanes.z[COS, 1] = -system.rate * np.sin(phase)
    lanes.z[U, 6] = 1.0
    lanes = _to_section(job, system, lanes, (np.arange(N) + 1) % N)
    return np.moveaxis(np.concatenate([lanes.dt[None], lanes.z[:4, 1:]]), 2, 0)


def _system(job: Job) -> Piecewise:
    return {"hopper": hopper, "bar": bar}[job.model](**job.parameters)


def _start(job, system, sections, derivatives) -> Lanes:
    chart = np.array([system.charts.index(job.charts[i]) for i in sections])
    t = job.times[sections]
    z = np.zeros((8, 1 + derivatives, len(sections)))
    z[:4, 0] = job.states[sections].T
    z[4, 0], z[SIN, 0], z[COS, 0] = (
        1.0,
        np.sin(system.rate * t),
        np.cos(system.rate * t),
    )
    return Lanes(t, chart, z, np.zeros((derivatives, len(sections))))


def _to_section(job: Job, system: Piecewise, lanes: Lanes, i) -> Lanes:
    """Flow lanes to section i (L,), the coming one; time is counted within one period."""
    t, chart, z, dt = (x.copy() for x in lanes)
    arrival = job.times[i] + np.where(i == 0, job.period, 0.0)
    longest = job.period / 32
    live = np.arange(len(t))
    for _ in range(100):
        a, C = chart[live], _series(system.G[chart[live]], z[..., live])
        window = np.full(len(live), longest)
        functions = np.zeros((3, 8, len(live)))
        functions[:2] = np.moveaxis(system.guard[a], 0, -1)
        if job.clocked:
            window = np.minimum(window, arrival[live] - t[live])
            functions[2, 4] = 1.0
        else:
            functions[2, [0, 1, 4]] = job.planes[i[live]].T
        zero = _first_zeros(np.einsum("jnl,knl->kjl", functions, C[:, :, 0]), window)
        which = np.argmin(zero, axis=0)
        tau = np.minimum(zero.min(axis=0), window)
        hit = zero.min(axis=0) <= window
        end = _value(C, tau)
        rate = np.einsum("lmn,nl->ml", system.G[a], end[:, 0])
        g = functions[which, :, np.arange(len(live))].T
        down = np.where(hit, np.einsum("nl,nl->l", g, rate), 1.0)
        dtau = -np.einsum("nl,ncl->cl", g, end[:, 1:]) / down
        timed = ~hit & (t[live] + tau >= arrival[live] - 1e-15) & job.clocked
        dtau = np.where(hit, dtau, np.where(timed, -dt[:, live], 0.0))
        end[:, 1:] += rate[:, None] * dtau
        t[live] += tau
        dt[:, live] += dtau
        event = hit & (which < 2)
        j = np.where(event, which, 0)
        after = np.einsum("lmn,ncl->mcl", system.reset[a, j], end)
        z[..., live] = np.where(event, after, end)
        chart[live] = np.where(event, system.to[a, j], a)
        live = live[~timed & ~(hit & (which == 2))]
        if not len(live):
            t = np.where(job.clocked, arrival, t) - np.where(i == 0, job.period, 0.0)
            z[SIN, 0], z[COS, 0] = np.sin(system.rate * t), np.cos(system.rate * t)
            return Lanes(t, chart, z, dt)
    raise RuntimeError(f"experiments {live[:5]} do not come to section {i[live][:5]}")


def _series(G, z):
    """Coefficients (TERMS, 8, c, L) of the flow from z in powers of tau."""
    C = [z]
    for k in range(1, TERMS):
        C.append(np.einsum("lmn,ncl->mcl", G, C[-1]) / k)
    return np.array(C)


def _value(C, tau):
    out = C[-1]
    for c in C[-2::-1]:
        out = out * tau + c
    return out


def _first_zeros(P, window):
    """First falling zeros (J, L) of polynomials P (TERMS, J, L) in (0, window], or infinity."""
    powers = (SAMPLES[:, None, None] * window) ** np.arange(TERMS)[:, None, None, None]
    values = np.einsum("ksjl,kjl->sjl", powers, P)
    values = np.concatenate([P[:1], values])
    armed = np.maximum.accumulate(values, axis=0)[:-1] > ARMED
    falls = armed & (values[:-1] >= 0) & (values[1:] < 0)
    found = falls.any(axis=0)
    if not found.any():
        return np.full(found.shape, np.inf)
    at = np.argmax(falls, axis=0)[None]
    before, after = (np.take_along_axis(x, at, 0)[0] for x in (values[:-1], values[1:]))
    width = window / len(SAMPLES)
    slope = np.where(found, before - after, 1.0)
    tau = at[0] * width + np.where(found, before / slope, 0.0) * width
    D = P[1:] * np.arange(1, TERMS)[:, None, None]
    for _ in range(5):
        tau = tau - np.where(
            found, _value(P, tau) / np.where(found, _value(D, tau), 1.0), 0.0
        )
    return np.where(found, tau, np.inf)
