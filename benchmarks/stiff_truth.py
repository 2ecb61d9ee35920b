"""Stiff cycles by scipy alone: the numbers that tests and gallery compare with.

    python benchmarks/stiff_truth.py          # some minutes

Planar flows by scipy: Radau's method of order 5 to a relative tolerance of 2.3e-14 (`--rtol`),
crossings by Newton's method on the true function along DOP853 from the last step before them. The
logarithm of the multiplier is the divergence of the field, integrated over one period (Liouville).
Printed: period, largest value of the first state, logarithm of the multiplier, steps in a turn,
seconds of the processor for it.

The hopper on a compliant ground by mpmath: linear in each chart, hence matrix exponentials, and
Newton's method with them for the times of the events. Printed: the state at t = 0.5, multipliers,
times from there to both events, residual.
"""

import argparse
import time

import numpy as np
from scipy.integrate import DOP853, Radau, solve_ivp


def van_der_pol(mu):
    field = lambda x, v: (v, mu * (1 - x * x) * v - x)  # noqa: E731
    jacobian = lambda x, v: [[0, 1], [-2 * mu * x * v - 1, mu * (1 - x * x)]]  # noqa: E731
    return field, jacobian, (2.0, -2 / (3 * mu))


def fitzhugh_nagumo(eps):
    field = lambda v, w: ((v - v**3 / 3 - w + 0.5) / eps, v + 0.7 - 0.8 * w)  # noqa: E731
    jacobian = lambda v, w: [[(1 - v * v) / eps, -1 / eps], [1, -0.8]]  # noqa: E731
    return field, jacobian, (1.9, 0.1)


CASES = {
    "van der Pol, mu = 100": van_der_pol(100.0),
    "van der Pol, mu = 1000": van_der_pol(1000.0),
    "FitzHugh-Nagumo, eps = 0.01": fitzhugh_nagumo(0.01),
    "FitzHugh-Nagumo, eps = 0.001": fitzhugh_nagumo(0.001),
}


def cycle(field, jacobian, start, rtol, atol=1e-16):
    """Period, largest first state, logarithm of the multiplier, steps and seconds of one turn."""

    def whole(t, z):
        J = jacobian(z[0], z[1])
        return np.array([*field(z[0], z[1]), J[0][0] + J[1][1]])

    def derivative(t, z):
        J = np.zeros((3, 3))
        J[:2, :2] = jacobian(z[0], z[1])
        for k in range(2):  # of the divergence, by differences of complex numbers
            shifted = z[:2].astype(complex)
            shifted[k] += 1e-30j
            K = jacobian(*shifted)
            J[2, k] = (K[0][0] + K[1][1]).imag / 1e-30
        return J

    def crossing(t0, z0, t1, value, rate):
        """Time and state where `value` is zero."""
        t, z = t0, z0
        guess = t0 + (t1 - t0) * value(z0) / (value(z0) - value(after))
        for _ in range(6):
            found = solve_ivp(whole, (t0, guess), z0, DOP853, rtol=2.3e-14, atol=1e-16)
            t, z = guess, found.y[:, -1]
            guess = t - value(z) / rate(whole(t, z))
        return t, z

    solver = Radau(
        whole,
        0.0,
        np.array([*start, 0.0]),
        np.inf,
        rtol=rtol,
        atol=atol,
        jac=derivative,
    )
    rises, top, steps, begin = [], -np.inf, [], time.process_time()
    clock = []
    while len(rises) < 3:
        t0, before = solver.t, solver.y.copy()
        solver.step()
        after = solver.y
        steps.append(t0)
        if before[0] < 0 <= after[0]:
            rises.append(crossing(t0, before, solver.t, lambda z: z[0], lambda f: f[0]))
            clock.append((time.process_time() - begin, len(steps)))
        speed = lambda z: field(z[0], z[1])[0]  # noqa: E731
        if len(rises) == 2 and speed(before) > 0 >= speed(after):
            turn = lambda f, z=after: np.dot(jacobian(z[0], z[1])[0], f[:2])  # noqa: E731
            _, z = crossing(t0, before, solver.t, speed, turn)
            top = max(top, z[0])
    (t1, z1), (t2, z2) = rises[-2:]
    return (
        t2 - t1,
        top,
        z2[2] - z1[2],
        clock[-1][1] - clock[-2][1],
        clock[-1][0] - clock[-2][0],
    )


def compliant_hopper():
    """The state at t = 0.5 and the multipliers of the hopper on a compliant ground, 30 digits."""
    import mpmath as mp

    mp.mp.dps = 40
    m, M, k, b, l0, a, g, w = (mp.mpf(x) for x in (1, 2, 10, 5, 2, 20, 2, 2 * mp.pi))
    ground = mp.mpf(10) ** 5, 3 * mp.mpf(10) ** 3

    def matrix(stiffness, damping):
        """Of (yM, vM, ym, vm, 1, sin wt, cos wt)."""
        A = mp.zeros(7, 7)
        A[0, 1] = A[2, 3] = 1
        A[1, 0], A[1, 2], A[1, 4], A[1, 5] = -k / M, k / M, k * l0 / M - g, a / M
        A[3, 0], A[3, 2], A[3, 4], A[3, 5] = k / m, -k / m, -k * l0 / m - g, -a / m
        A[3, 2] -= stiffness / m
        A[3, 3] -= damping / m
        A[5, 6], A[6, 5] = w, -w
        return A

    contact, flight = matrix(*ground), matrix(mp.mpf(0), b)
    lift = mp.matrix([[0, 0, -ground[0], -ground[1], 0, 0, 0]])
    touch = mp.matrix([[0, 0, 1, 0, 0, 0, 0]])

    def until(A, z, row, time):
        """State and time where row @ z is zero, and the flow's derivative to there."""
        for _ in range(30):
            P = mp.expm(A * time)
            end = P * z
            step = (row * end)[0] / (row * A * end)[0]
            time -= step
            if abs(step) < mp.mpf(10) ** -32:
                break
        P = mp.expm(A * time)
        return time, P * z, P

    def turn(q):
        z = mp.matrix([*q, 1, 0, -1])  # t = 0.5: sin = 0, cos = -1
        t1, z1, P1 = until(contact, z, lift, mp.mpf("0.0163"))
        t2, z2, P2 = until(flight, z1, touch, mp.mpf("0.8347"))
        P3 = mp.expm(contact * (1 - t1 - t2))
        jumps = []
        for before, after, row, x in (
            (contact, flight, lift, z1),
            (flight, contact, touch, z2),
        ):
            slow = (row * before * x)[0]
            jumps.append(mp.eye(7) + (after * x - before * x) * row / slow)
        return P3 * z2, P3 * jumps[1] * P2 * jumps[0] * P1, (t1, t2)

    q = mp.matrix(["1.965144", "1.875535", "-7.3256e-5", "1.66169e-3"])
    for _ in range(8):
        end, P, times = turn(q)
        residual = end[:4] - q
        q -= mp.lu_solve(P[:4, :4] - mp.eye(4), residual)
    values = sorted(mp.eig(P[:4, :4])[0], key=lambda x: -abs(x))
    return [mp.nstr(x, 20) for x in (*q, *values, *times, mp.norm(residual))]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rtol", type=float, default=2.3e-14)
    parser.add_argument("--only", default="")
    options = parser.parse_args()
    if options.only in "compliant hopper":
        print("compliant hopper", *compliant_hopper(), flush=True)
    for name, case in CASES.items():
        if options.only in name:
            print(
                name, *(repr(float(x)) for x in cycle(*case, options.rtol)), flush=True
            )
