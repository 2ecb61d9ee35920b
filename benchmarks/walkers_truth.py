"""Truth for the walkers with feedback, apart from hybridjax: NumPy, SciPy, and formulas by hand.

    python benchmarks/walkers_truth.py --out tests/data/walkers.npz    # about 2 minutes

Both are chains of links on one point. With absolute angles q, mass k at sum_j R[k, j] (sin q_j, cos
q_j) and A = R' diag(m) R, the mass matrix is A_ij cos(q_i - q_j) + I_i d_ij, and the forces of
motion are sum_j A_ij sin(q_i - q_j) v_j^2 - g sin(q_i) sum_k m_k R[k, i]. Torques of motors between
links have no sum. Steps are integrated with DOP853 (relative tolerance 1e-13), touchdowns located
by `brentq` on its dense output and polished by Newton steps; cycles by `fsolve`, multipliers by
central differences. The file holds, for each walker, the state after touchdown, and derivatives of
the ways from there to three angles of the stance leg and back: by the state where each begins,
(4, d, d), and by a constant torque on the way, (4, d).
"""

import argparse

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import fsolve


G = 9.81


class Chain:
    """A walker that stands on one point."""

    def __init__(self, lengths, masses, inertias, foot, swapped):
        self.R, self.m, self.I = (
            np.array(x, float) for x in (lengths, masses, inertias)
        )
        self.foot, self.swapped, self.n = np.array(foot, float), swapped, len(inertias)
        self.A = self.R.T @ np.diag(self.m) @ self.R

    def mass(self, q):
        return self.A * np.cos(q[:, None] - q) + np.diag(self.I)

    def bias(self, q, v):
        return (self.A * np.sin(q[:, None] - q)) @ v**2 - G * np.sin(q) * (
            self.m @ self.R
        )

    def field(self, t, x, u=0.0):
        q, v = x[: self.n], x[self.n :]
        along, wanted = self.feedback(q, v)
        M = self.mass(q)
        motion = -(np.sum(self.bias(q, v)) + np.sum(M @ wanted)) / np.sum(M @ along)
        further = np.linalg.solve(M, u * np.array(self.motor)) if u else 0.0
        return np.concatenate([v, wanted + motion * along + further])

    def land(self, x):
        """The swing foot sticks; the legs change their names."""
        q, v = x[: self.n], x[self.n :]
        s, c = np.sin(q), np.cos(q)
        way = np.stack([c, -s])  # of a point at (sin q, cos q), per angle
        coupling = way * (self.m @ self.R)
        M = np.block(
            [[self.mass(q), coupling.T], [coupling, np.sum(self.m) * np.eye(2)]]
        )
        J = np.concatenate([way * self.foot, np.eye(2)], axis=1)
        system = np.block([[M, -J.T], [J, np.zeros((2, 2))]])
        rest = np.concatenate([v, np.zeros(2)])
        after = np.linalg.solve(system, np.concatenate([M @ rest, np.zeros(2)]))[
            : self.n
        ]
        return np.concatenate([q[self.swapped], after[self.swapped]])

    def until(self, x, level, direction, u=0.0, wait=0.0):
        """The state where a function of the angles next crosses zero, and when it did."""
        field = lambda t, x: self.field(t, x, u)  # noqa: E731
        guard = lambda t, x: level(x[: self.n])  # noqa: E731
        guard.terminal, guard.direction = True, direction
        options = {"method": "DOP853", "rtol": 1e-13, "atol": 1e-14}
        if wait:
            x = solve_ivp(field, (0, wait), x, **options).y[:, -1]
        way = solve_ivp(field, (wait, 3), x, events=guard, **options)
        t, x = way.t_events[0][0], way.y_events[0][0]
        for _ in range(3):
            f = field(t, x)
            slope = (guard(t, x + 1e-7 * f) - guard(t, x - 1e-7 * f)) / 2e-7
            h = -guard(t, x) / slope
            x, t = x + h * field(t + h / 2, x + h / 2 * f), t + h
        return x, t

    def step(self, x):
        """The state after the next touchdown, and when it came."""
        # (The guard is near zero in the beginning: let it leave.)
        x, t = self.until(x, self.guard, self.direction, wait=0.03)
        return self.land(x), t

    def ways(self):
        """From a touchdown to each of the angles `levels` of the stance leg, and to the next."""
        for angle in self.levels:
            yield lambda x, u, angle=angle: self.until(
                x, lambda q: self.leg @ q - angle, 1, u
            )[0]
        yield lambda x, u: self.land(self.until(x, self.guard, self.direction, u)[0])

    def derivatives(self, x):
        """Of all ways, by state (4, d, d) and by torque (4, d), by differences of order 4."""
        by_state, by_input = [], []
        for way in self.ways():
            ahead = lambda e, h, x=x, way=way: way(x + h * e[:-1], h * e[-1])  # noqa: E731
            columns = []
            for e in np.diag([1.0] * 2 * self.n + [10.0]):
                near, far = (ahead(e, h) - ahead(e, -h) for h in (1e-4, 2e-4))
                columns.append((8 * near - far) / 12e-4 / np.max(e))
            by_state.append(np.array(columns[:-1]).T)
            by_input.append(columns[-1])
            x = way(x, 0.0)
        return np.array(by_state), np.array(by_input)

    def cycle(self, x):
        x = fsolve(lambda x: self.step(x)[0] - x, x, xtol=1e-13)
        x, period = self.step(x)
        h = 1e-5
        J = [
            (self.step(x + h * e)[0] - self.step(x - h * e)[0]) / (2 * h)
            for e in np.eye(2 * self.n)
        ]
        multipliers = np.linalg.eigvals(np.array(J).T)
        return x, period, multipliers[np.argsort(-np.abs(multipliers))]


def held(error, rate, stiffness=20.0):
    return -(stiffness**2) * error - 2 * stiffness * rate


class TorsoWalker(Chain):
    direction, motor = 1, [0, -1, 1]
    leg, levels = np.array([1, 0, 0]), (-0.2, 0.0, 0.2)

    def __init__(self, r=1.0, l=0.5):  # noqa: E741
        super().__init__(
            [[r / 2, 0, 0], [r, -r / 2, 0], [r, 0, 0], [r, 0, l]],
            [5, 5, 15, 10],
            [0, 0, 0],
            [r, -r, 0],
            [1, 0, 2],
        )

    def guard(self, q):
        return q[0] - np.pi / 8

    def feedback(self, q, v):
        wanted = [0.0, held(q[0] + q[1], v[0] + v[1]), held(q[2] - np.pi / 6, v[2])]
        return np.array([1.0, -1.0, 0.0]), np.array(wanted)


class FiveLinkBiped(Chain):
    direction, motor = -1, [0, 0, 1, -1, 0]
    leg, levels = np.array([0.5, 0.5, 0, 0, 0]), (-0.1, 0.0, 0.1)
    lean, stride, knee, lift = 0.2, 0.2, 0.2, 0.4

    def __init__(self):
        m, about_joint = np.array([3.2, 6.8, 12.0]), np.array([0.20, 0.47, 1.33])
        center, l, order = np.array([0.24, 0.11, 0.24]), 0.4, [0, 1, 2, 1, 0]  # noqa: E741
        shin, thigh, torso = center
        lengths = [
            [l - shin, 0, 0, 0, 0],
            [l, l - thigh, 0, 0, 0],
            [l, l, torso, 0, 0],
            [l, l, 0, -thigh, 0],
            [l, l, 0, -l, -shin],
        ]
        inertias = (about_joint - m * center**2)[order]
        super().__init__(
            lengths, m[order], inertias, [l, l, 0, -l, -l], [4, 3, 2, 1, 0]
        )

    def guard(self, q):
        return self.foot @ np.cos(q) + 1e3 * (self.foot @ np.sin(q) < 0)

    def feedback(self, q, v):
        leg, rate = (q[0] + q[1]) / 2, (v[0] + v[1]) / 2
        slope = -2 * self.lift * leg / self.stride**2
        bent = self.knee + self.lift * (1 - (leg / self.stride) ** 2)
        knee = held(q[0] - q[1] - self.knee, v[0] - v[1])
        swing = held((q[3] + q[4]) / 2 + leg, (v[3] + v[4]) / 2 + rate)
        bending = held(q[4] - q[3] - bent, v[4] - v[3] - slope * rate)
        bending -= 2 * self.lift * (rate / self.stride) ** 2
        torso = held(q[2] - self.lean, v[2])
        wanted = [knee / 2, -knee / 2, torso, swing - bending / 2, swing + bending / 2]
        return np.array([1, 1, 0, -1 - slope / 2, -1 + slope / 2]), np.array(wanted)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", required=True)
    options, found = parser.parse_args(), {}
    np.set_printoptions(precision=15)
    guesses = {
        TorsoWalker: [-0.3927, 0.3927, 0.5236, 0.9395, -0.2763, 2.0386],
        FiveLinkBiped: [
            -0.0755,
            -0.2988,
            0.2004,
            0.0874,
            0.2955,
            4.0145,
            -1.0352,
            0.2622,
            1.6457,
            1.1118,
        ],
    }
    for walker, guess in guesses.items():
        x, period, multipliers = walker().cycle(np.array(guess))
        print(
            walker.__name__,
            f"period {period:.14g}\n state {x}\n multipliers {multipliers}",
        )
        by_state, by_input = walker().derivatives(x)
        values = {"state": x, "by_state": by_state, "by_input": by_input}
        found |= {f"{walker.__name__}.{name}": value for name, value in values.items()}
    np.savez(options.out, **found)
