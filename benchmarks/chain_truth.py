"""Truth for the chain of bouncing masses, apart from hybridjax: NumPy, SciPy, formulas by hand.

    python benchmarks/chain_truth.py > tests/data/bouncing_chain.json        # half a minute

Flights by DOP853 (relative tolerance 1e-13) to its events, which Newton's method moves onto the
true gap along further flights. Newton's method for the cycle, and multipliers, by the matrix
exponential of the linear flight and the saltation matrices of the impacts. Printed for each number
of masses: the state at t = 0, multipliers (real and imaginary parts), the times of the impacts in
order, and the residual.
"""

import json

import numpy as np
from scipy.integrate import solve_ivp
from scipy.linalg import expm


M, K, C, G, E, A, W = 1.0, 0.3, 0.05, 9.81, 0.5, 0.3, 2 * np.pi


class Row:
    def __init__(self, n):
        self.n = n
        joints = np.diff(np.eye(n), axis=0)
        laplace = -joints.T @ joints / M
        self.matrix = np.block(
            [[np.zeros((n, n)), np.eye(n)], [K * laplace, C * laplace]]
        )
        self.weight = np.concatenate([np.zeros(n), np.full(n, -G)])

    def field(self, t, x):
        return self.matrix @ x + self.weight

    def table(self, t, i):
        phase = W * t - 2 * np.pi * i / self.n
        return A * np.sin(phase), A * W * np.cos(phase), -A * W**2 * np.sin(phase)

    def fly(self, t, x, end, **options):
        return solve_ivp(
            self.field, (t, end), x, "DOP853", rtol=1e-13, atol=1e-14, **options
        )

    def next_impact(self, t, x, end, last):
        """Time, mass and state before the next impact; none before `end`."""
        gaps = []
        for i in range(self.n):
            gap = lambda t, x, i=i: x[i] - self.table(t, i)[0]  # noqa: E731
            gap.terminal, gap.direction = True, -1
            gaps.append(gap)
        way = self.fly(t, x, end, events=gaps, max_step=0.05)
        hits = [
            (times[0], i)
            for i, times in enumerate(way.t_events)
            if len(times) and not (i == last and times[0] - t < 1e-3)
        ]
        if not hits:
            return None, None, way.y[:, -1]
        at, i = min(hits)
        for _ in range(4):
            before = self.fly(t, x, at).y[:, -1]
            height, speed, _ = self.table(at, i)
            at -= (before[i] - height) / (before[self.n + i] - speed)
        return at, i, self.fly(t, x, at).y[:, -1]

    def turn(self, x):
        """The state one period later, its derivative, and the impacts."""
        n, t, last, D, impacts = self.n, 0.0, None, np.eye(2 * self.n), []
        while True:
            at, i, before = self.next_impact(t, x, 1.0, last)
            D = expm(self.matrix * ((1.0 if at is None else at) - t)) @ D
            if at is None:
                return before, D, impacts
            _, speed, acceleration = self.table(at, i)
            x, R = before.copy(), np.eye(2 * n)
            x[n + i] = (1 + E) * speed - E * before[n + i]
            R[n + i, n + i] = -E
            by_time = np.zeros(2 * n)
            by_time[n + i] = (1 + E) * acceleration
            jump = R @ self.field(at, before) + by_time - self.field(at, x)
            delay = np.zeros(2 * n)
            delay[i] = -1 / (before[n + i] - speed)
            D = (R + np.outer(jump, delay)) @ D
            t, last = at, i
            impacts.append((at, i))

    def cycle(self):
        speed = (1 - E) / (1 + E) * G / 2
        first = np.arccos(speed / (A * W)) / W
        past = -(first + np.arange(self.n) / self.n) % 1.0
        rise = A * np.sin(W * first) + G / 2 * past - G * past**2 / 2
        x = np.concatenate([rise, G / 2 - G * past])
        for _ in range(12):
            end, D, impacts = self.turn(x)
            residual = end - x
            if np.max(np.abs(residual)) < 1e-13:
                break
            x = x - np.linalg.solve(D - np.eye(len(x)), residual)
        values = np.linalg.eigvals(D)
        order = np.lexsort([values.imag, -np.abs(values).round(12)])
        return x, values[order], impacts, np.max(np.abs(residual))


def found(n):
    x, values, impacts, residual = Row(n).cycle()
    return {
        "state": x.tolist(),
        "multipliers": [[z.real, z.imag] for z in values.tolist()],
        "impacts": [[t, i + 1] for t, i in impacts],
        "residual": residual,
    }


if __name__ == "__main__":
    print(json.dumps({str(n): found(n) for n in (1, 2, 5, 10)}, indent=1))
