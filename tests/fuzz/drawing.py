"""Numbers for random hybrid systems: a few structures, and how the systems of each are drawn.

All numbers are of order one, so that trajectories stay bounded and guards are met often.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from .structures import Arrow, Plan, Sample, Start


def still(n: int, /, **given) -> dict[str, Any]:
    """Numbers of a chart that are all zero but for those given."""
    zero = np.zeros(n)
    flat = {
        "b": zero,
        "cube": zero,
        "a": zero,
        "w": 1.0,
        "p": 0.0,
        "B": np.zeros((n, 2)),
    }
    return (
        flat
        | {"A": np.zeros((n, n)), "S": np.zeros((n, n)), "T": np.zeros((n, n))}
        | given
    )


def swinging(rng, n: int, rate=(0.8, 2.5), damping=(0.0, 0.1)) -> dict[str, Any]:
    """Lightly damped oscillators in skew coordinates, forced, in half the systems non-linear."""
    A = np.zeros((n, n))
    for k in range(0, n - 1, 2):
        w = rng.uniform(*rate)
        z = rng.uniform(*damping)
        A[k : k + 2, k : k + 2] = [[-z, w], [-w, -z]]
    if n % 2:
        A[-1, -1] = -rng.uniform(0.2, 1.0)
    rotation = np.linalg.qr(rng.normal(size=(n, n)))[0]
    basis = rotation * rng.uniform(0.7, 1.4, n)
    mild = float(rng.random() < 0.5)
    return still(
        n,
        A=basis @ A @ np.linalg.inv(basis),
        b=rng.normal(0.0, 0.1, n),
        B=rng.normal(0.0, 0.2, (n, 2)),
        cube=mild * rng.uniform(0.0, 0.05, n),
        S=mild * rng.normal(0.0, 0.2 / max(n, 1), (n, n)),
        T=mild * rng.normal(0.0, 0.2 / max(n, 1), (n, n)),
        a=rng.normal(0.0, 0.5, n),
        w=rng.uniform(0.5, 3.0),
        p=rng.uniform(0.0, 2 * np.pi),
    )


def drifting(rng, n: int, direction: float) -> dict[str, Any]:
    """The first state moves in one direction at a changing speed, and drives the others."""
    x = still(n)
    rest = swinging(rng, n - 1)
    for name in ("A", "S", "T"):
        x[name][1:, 1:] = rest[name]
    x["A"][0, 0] = -rng.uniform(0.0, 0.1)
    x["A"][1:, 0] = rng.normal(0.0, 0.3, n - 1)
    x["T"][0, 0] = rng.normal(0.0, 0.1)
    return x | {
        "b": np.append(direction * rng.uniform(0.7, 1.5), rest["b"]),
        "B": rng.normal(0.0, 0.1, (n, 2)),
        "cube": np.append(0.0, rest["cube"]),
        "a": np.append(rng.normal(0.0, 0.3), rest["a"]),
        "w": rest["w"],
        "p": rest["p"],
    }


def arrow(rng, n: int, after: int, /, spread=0.3, **given) -> dict[str, Any]:
    """A flat guard near zero, and a reset that turns and stretches the state and moves it."""
    larger = max(n, after)
    turn, _ = np.linalg.qr(rng.normal(size=(larger, larger)))
    turn = turn[:after, :n]
    normal = rng.normal(size=n)
    numbers = {
        "n": normal / np.linalg.norm(normal),
        "Q": np.zeros((n, n)),
        "c": rng.uniform(-spread, spread),
        "m": rng.normal(0.0, 0.1, 2),
        "a": 0.0,
        "w": 1.0,
        "p": 0.0,
        "k": rng.normal(size=n),
        "k0": rng.normal(0.0, 0.5) + 0.3,
        "R": turn * rng.uniform(0.8, 1.2),
        "r": rng.normal(0.0, 0.4, after),
        "V": rng.normal(0.0, 0.1, (after, 2)),
        "period": 1.0,
        "offset": 0.0,
    }
    return numbers | given


def start(rng, n: int, limit=25.0, size=1.2) -> Start:
    t = rng.uniform(0.0, 5.0)
    state = rng.normal(0.0, size, n)
    return Start(t, state, rng.normal(size=2), t + limit)


def unit(n: int, k: int = 0) -> np.ndarray:
    return np.eye(n)[k]


def wave(rng, size, rate) -> dict[str, Any]:
    """A term of a guard that changes with time."""
    return {
        "a": rng.uniform(*size),
        "w": rng.uniform(*rate),
        "p": rng.uniform(0.0, 2 * np.pi),
    }


def beside(rng, x, sign: float) -> dict[str, Any]:
    """A curved guard that crosses shortly before or after the flat guard of the arrow `x`."""
    side = rng.choice([-1.0, 1.0])
    exponent = rng.uniform(-5.5, -1.5)
    gap = side * 10**exponent
    bend = rng.normal(0.0, 3.0)
    # sign * (n.q + c + gap + bend * (n.q + c)^2)
    n = x["n"]
    c = x["c"]
    return {
        "n": sign * (1 + 2 * bend * c) * n,
        "Q": sign * 2 * bend * np.outer(n, n),
        "c": sign * (c + gap + bend * c**2),
        "m": np.zeros(2),
    }


STRUCTURES: dict[str, tuple[Plan, Callable[[np.random.Generator], Sample]]] = {}


def structure(*arrows, dims):
    """List a function that draws systems of this plan."""
    all_arrows = tuple(Arrow(*a) for a in arrows)
    plan = Plan(dims, all_arrows)
    return lambda function: STRUCTURES.setdefault(function.__name__, (plan, function))[
        1
    ]


@structure((0, 0, "falling"), (0, 0, "rising"), (0, 0, "falling", True), dims=(3,))
def kicks(rng) -> Sample:
    """An oscillator that three guards kick, one of them only where it is enabled.

    Some kicks are along the guard, which then is zero up to rounding after the event.
    """
    arrows = [arrow(rng, 3, 3, m=np.zeros(2), V=np.zeros((3, 2))) for _ in range(3)]
    for x in arrows:
        if rng.random() < 0.5:
            along = x["n"] @ x["r"]
            kept = x["r"] - x["n"] * along
            x |= {"R": np.eye(3), "r": kept}
    return Sample([swinging(rng, 3)], arrows, start(rng, 3))


@structure((0, 0, "falling"), (0, 0, "falling", True), dims=(2,))
def dips(rng) -> Sample:
    """Guards that are negative in a thin layer only: they dip and return within a step."""

    def layer():
        normal = rng.normal(size=2)
        normal = normal / np.linalg.norm(normal)
        level = rng.uniform(-0.6, 0.6)
        width = 10 ** rng.uniform(-2.5, -0.5)  # (n.q - level)^2 - width^2
        return {
            "n": -2 * level * normal,
            "Q": 2 * np.outer(normal, normal),
            "c": level**2 - width**2,
            "m": np.zeros(2),
        }

    arrows = [arrow(rng, 2, 2, **layer()) for _ in range(2)]
    return Sample([swinging(rng, 2)], arrows, start(rng, 2))


@structure((0, 1, "falling"), (1, 0, "rising"), dims=(4, 2))
def hop(rng) -> Sample:
    """Two oscillators, of which one stops at touchdown and starts again at liftoff, in half of
    the systems where touchdown's guard is zero."""
    air = swinging(rng, 4)
    ground = swinging(rng, 2)
    upper = np.eye(4)[:2]
    land = arrow(rng, 4, 2, n=unit(4, 2), R=upper, r=rng.normal(0.0, 0.1, 2))
    land |= {"c": 0.0, "m": np.zeros(2)}
    left = np.eye(4)[:, :2]
    none = np.zeros((4, 2))
    lift = arrow(rng, 2, 4, R=left, V=none)
    if rng.random() < 0.5:  # start right on the guard of touchdown
        lift["r"][2] = 0.0
    return Sample([air, ground], [land, lift], start(rng, 4))


@structure((0, 1, "rising"), (1, 2, "falling"), (2, 0, "rising"), dims=(1, 3, 5))
def ladder(rng) -> Sample:
    """Three charts in turn, of dimensions 1, 3 and 5."""
    charts = [drifting(rng, 1, 1.0), drifting(rng, 3, -1.0), drifting(rng, 5, 1.0)]
    arrows = []
    for n, after, level in ((1, 3, 1.0), (3, 5, -1.0), (5, 1, 1.0)):
        back = np.zeros((after, n))
        back[0, 0] = rng.uniform(-0.5, 0.5)
        spread = rng.normal(0.0, 0.5, (after - 1, n))
        back[1:, :] = spread
        c = -level * rng.uniform(0.5, 1.5)
        offset = rng.normal(0.0, 0.3, after)
        arrows.append(
            arrow(
                rng,
                n,
                after,
                n=unit(n),
                c=c,
                R=back,
                r=offset,
            )
        )
    return Sample(charts, arrows, start(rng, 1, size=0.3))


@structure(
    (0, 1, "falling"),
    (0, 2, "rising"),
    (1, 0, "falling"),
    (2, 0, "rising"),
    dims=(2, 3, 2),
)
def fork(rng) -> Sample:
    """Whichever of two guards comes first, one close to the other, decides on the next chart."""
    charts = [swinging(rng, 2), swinging(rng, 3), swinging(rng, 2)]
    arrows = [arrow(rng, *n, m=np.zeros(2)) for n in ((2, 3), (2, 2), (3, 2), (2, 2))]
    arrows[1] |= beside(rng, arrows[0], -1.0)
    return Sample(charts, arrows, start(rng, 2))


@structure((0, 1, "scheduled"), (1, 0, "scheduled"), (0, 0, "falling"), dims=(2, 2))
def switch(rng) -> Sample:
    """Switched by a clock, with a guard in between."""
    period = rng.uniform(1.0, 3.0)
    offset = rng.uniform(0.0, period)
    keep = {"R": np.eye(2), "r": np.zeros(2), "V": np.zeros((2, 2))}
    arrows = [
        arrow(rng, 2, 2, period=period, offset=offset, **keep),
        arrow(
            rng,
            2,
            2,
            period=period,
            offset=offset + rng.uniform(0.2, 0.8) * period,
            **keep,
        ),
        arrow(rng, 2, 2),
    ]
    charts = [swinging(rng, 2), swinging(rng, 2)]
    return Sample(charts, arrows, start(rng, 2))


@structure(
    (0, 0, "falling"),
    (0, 0, "rising"),
    (0, 0, "falling", True),
    (0, 0, "rising", True),
    dims=(5,),
)
def crowd(rng) -> Sample:
    """Five dimensions and four guards of all kinds, in slow motion: many crossings in one step."""
    chart = swinging(rng, 5, rate=(0.1, 0.5))
    chart["w"] = rng.uniform(0.05, 0.4)
    chart["S"] = 0.3 * chart["S"]
    chart["T"] = 0.3 * chart["T"]
    root = 0.3 * rng.normal(size=(5, 5))
    straight = arrow(rng, 5, 5, m=np.zeros(2))
    slow_wave = wave(rng, (0.0, 0.3), (1.0, 5.0))
    curved = arrow(rng, 5, 5, Q=root + root.T, **slow_wave)
    neighbor = arrow(rng, 5, 5)
    large_wave = wave(rng, (0.1, 0.5), (1.0, 5.0))
    spread = arrow(rng, 5, 5, spread=1.0, **large_wave)
    neighbor |= beside(rng, straight, 1.0)
    arrows = [straight, curved, neighbor, spread]
    return Sample([chart], arrows, start(rng, 5, limit=60.0))


@structure(
    (0, 1, "falling"),
    (0, 2, "rising"),
    (1, 2, "falling"),
    (2, 0, "rising", True),
    (2, 2, "scheduled"),
    dims=(5, 1, 4),
)
def tour(rng) -> Sample:
    """Three charts of dimensions 5, 1 and 4, a clock, and a guard of every kind."""
    charts = [swinging(rng, 5), drifting(rng, 1, -1.0), swinging(rng, 4)]
    period = rng.uniform(2.0, 5.0)
    arrows = [
        arrow(rng, 5, 1, R=rng.normal(0.0, 0.2, (1, 5)), r=np.ones(1)),
        arrow(rng, 5, 4, **wave(rng, (0.1, 0.5), (1.0, 5.0))),
        arrow(rng, 1, 4, n=np.ones(1), c=rng.uniform(0.0, 1.0)),
        arrow(rng, 4, 5),
        arrow(rng, 4, 4, period=period, offset=rng.uniform(0.0, period)),
    ]
    return Sample(charts, arrows, start(rng, 5))


def draw(name: str, number: int, seed: int = 0) -> Sample:
    """System `number` of a structure."""
    # (So that "dips:28" stays the system that failed once.)
    place = 2 + list(STRUCTURES).index(name)
    rng = np.random.default_rng([seed, place, number])
    _, draw_sample = STRUCTURES[name]
    return draw_sample(rng)
