"""Truth for the trotting quadruped, apart from hybridjax: NumPy, SciPy and finite differences.

    python benchmarks/trot_truth.py           # some seconds

DOP853 (relative tolerance 1e-13), feet that land and let go located by `brentq` on its dense output
and polished by Newton steps. Without the reflex: the cycle by `fsolve`, multipliers by central
differences. With it: derivatives across both pairs of events that coincide, in either order, by
one-sided differences of second order.
"""

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import fsolve


M, J, HIP, K, B, L0, G, A, T = (
    1.0,
    0.2,
    np.array([-0.5, 0.5]),
    15.0,
    1.0,
    1.0,
    10.0,
    0.2,
    1.0,
)
RATE = 2 * np.pi / T


def lengths(t, x):
    """Of both legs, less their rest length, and their rates."""
    legs = x[0] + HIP * x[2] - A * np.sin(RATE * t) - L0
    return legs, x[1] + HIP * x[3] - A * RATE * np.cos(RATE * t)


def field(t, x, down, thrust):
    length, rate = lengths(t, x)
    forces = down * (-K * length - B * rate)
    push = np.sum(forces) + thrust * down.all()
    return np.array([x[1], push / M - G, x[3], HIP @ forces / J])


def flow(t, end, x, down, thrust, events=True):
    """State, and feet that stand, at the time `end`; `events=False` keeps the feet."""
    down = np.array(down)
    while True:
        moving = lambda t, x, down=down: field(t, x, down, thrust)  # noqa: E731
        guards = [lambda t, x, i=i: lengths(t, x)[0][i] for i in (0, 1)]
        for i, guard in enumerate(guards):
            guard.direction, guard.terminal = (1 if down[i] else -1), True
        way = solve_ivp(
            moving,
            (t, end),
            x,
            "DOP853",
            rtol=1e-13,
            atol=1e-14,
            events=guards if events else None,
        )
        t, x = way.t[-1], way.y[:, -1]
        if way.status == 0:
            return x, down
        i = int(np.argmax([len(found) for found in way.t_events]))
        for _ in range(3):
            length, rate = lengths(t, x)
            h = -length[i] / rate[i]
            x, t = x + h * moving(t + h / 2, x + h / 2 * moving(t, x)), t + h
        length, rate = lengths(t, x)
        # (Also a foot that is due by rounding: its guard might pass zero unseen.)
        due = (np.abs(length) < 1e-13) & (np.sign(rate) == np.where(down, 1, -1))
        down = np.where(due | (np.arange(2) == i), ~down, down)


def cycle(thrust, x=(0.4, -1.0)):
    """Height and speed at t = 0: what does not pitch goes on without pitch."""
    back = lambda x: flow(0.0, T, [*x, 0, 0], (True, True), thrust)[0][[0, 1]] - x  # noqa: E731
    return np.array([*fsolve(back, x, xtol=1e-13), 0.0, 0.0])


def central(function, x, h=1e-4):
    return np.array(
        [(function(x + h * e) - function(x - h * e)) / (2 * h) for e in np.eye(4)]
    ).T


def one_sided(function, x, direction, h=1e-4):
    """The derivative that holds for neighbors in this direction."""
    directions = [direction + 0.2 * e for e in np.eye(4)]
    to = [
        (4 * function(x + h * d) - function(x + 2 * h * d) - 3 * function(x)) / (2 * h)
        for d in directions
    ]
    return np.linalg.solve(np.array(directions), np.array(to)).T


def across(x, time, down, thrust, first, tau=0.02):
    """The derivative across events of both feet at `time`, foot `first` first."""
    before, after = (down, down), (not down, not down)
    start = flow(0.0, time - tau, x, (True, True), thrust)[0]
    to = lambda y: flow(time - tau, time, y, before, thrust, events=False)[0]  # noqa: E731
    on = lambda y: flow(time, time + tau, y, after, thrust, events=False)[0]  # noqa: E731
    whole = lambda y: flow(time - tau, time + tau, y, before, thrust)[0]  # noqa: E731
    lower = (
        1.0 if (first == 0) != down else -1.0
    )  # a lower foot lands first, a higher lets go first
    D = one_sided(whole, start, np.array([0.0, 0.0, lower, 0.0]))
    return np.linalg.solve(central(on, to(start)), D) @ np.linalg.inv(
        central(to, start)
    )


def times(x, thrust):
    """When both feet let go, and when they land again."""
    found, t, down = [], 0.0, True
    while len(found) < 2:
        guard = lambda t, x: lengths(t, x)[0][0]  # noqa: E731
        guard.direction, guard.terminal = (1 if down else -1), True
        way = solve_ivp(
            lambda t, x, down=down: field(t, x, np.array([down, down]), thrust),
            (t, T),
            x,
            "DOP853",
            rtol=1e-13,
            atol=1e-14,
            events=guard,
        )
        t, x, down = way.t[-1], way.y[:, -1], not down
        found.append(float(t))
    return found


if __name__ == "__main__":
    np.set_printoptions(precision=12, suppress=True)
    x = cycle(0.0)
    turn = central(lambda x: flow(0.0, T, x, (True, True), 0.0)[0], x)
    print("without the reflex", x, times(x, 0.0), *np.linalg.eigvals(turn))
    x = cycle(1.0)
    print("with it", x, times(x, 1.0))
    for time, down in zip(times(x, 1.0), (True, False), strict=True):
        for first, name in enumerate(("hind", "front")):
            print(f"feet {'let go' if down else 'land'}, {name} first")
            print(across(x, time, down, 1.0, first))
