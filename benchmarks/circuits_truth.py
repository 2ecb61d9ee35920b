"""Truth for cycles that are linear between events, apart from hybridjax: mpmath, 40 digits.

    python benchmarks/circuits_truth.py       # about a minute

Ćuk's converter, Chua's circuit and the two coupled hoppers. States stand beside 1, and sin and cos
of the clock where there is one, so that each chart is a matrix; the flow is its exponential, events
are found by Newton's method, and cycles by Newton's method with saltation matrices. Printed: the
state at the start, the times between events, all multipliers, the residual.
"""

from typing import NamedTuple

import mpmath as mp


mp.mp.dps = 40
SMALL = mp.mpf(10) ** -34


class Piece(NamedTuple):
    """A stay in a chart: its matrix; its end, where row @ z is zero, or the end of the turn; the
    reset, into the next chart; and a guess of how long it lasts."""

    field: mp.matrix
    row: mp.matrix | None
    reset: mp.matrix
    lasts: float


def turn(pieces, z, period):
    """State after a turn, its derivative by the state before, and how long the pieces took.

    Without a period it ends at the last event, which is the section.
    """
    P, times = mp.eye(len(z)), []
    for k, piece in enumerate(pieces):
        A, last = piece.field, k + 1 == len(pieces)
        t = mp.mpf(piece.lasts) if piece.row is not None else period - sum(times)
        for _ in range(50 * (piece.row is not None)):
            end = mp.expm(A * t) * z
            step = (piece.row * end)[0] / (piece.row * A * end)[0]
            t -= step
            if abs(step) < SMALL:
                break
        flow = mp.expm(A * t)
        end, jump = flow * z, piece.reset
        z = piece.reset * end
        if piece.row is not None:
            after = (
                mp.zeros(len(z), 1)
                if last and period is None
                else pieces[k + 1].field * z
            )
            jump = (
                jump + (after - jump * A * end) * piece.row / (piece.row * A * end)[0]
            )
        P, times = jump * flow * P, [*times, t]
    return z, P, times


def cycle(pieces, z, n, period=None):
    """The first n states are free, the others stay as they are."""
    z = mp.matrix(z)
    for _ in range(12):
        end, P, times = turn(pieces, z, period)
        residual = (end - z)[:n]
        z[:n] = z[:n] - mp.lu_solve(P[:n, :n] - mp.eye(n), residual)
        if mp.norm(residual) < SMALL:
            break
    with mp.workdps(70):  # small multipliers need digits below those of large ones
        values = sorted(mp.eig(P[:n, :n])[0], key=lambda x: -abs(x))
    show = lambda x: mp.nstr(mp.chop(x, mp.mpf(10) ** -33 * abs(x)), 18)  # noqa: E731
    print(" state", *map(show, z[:n]))
    print(" times", *map(show, times), " period", show(sum(times)))
    print(" multipliers", *map(show, values))
    print(" residual", mp.nstr(mp.norm(residual), 3), flush=True)


def matrix(rows):
    return mp.matrix([[mp.mpf(x) for x in row] for row in rows])


def cuk():
    """From the closing of the switch on."""
    E, L, C, R, Iref, T = (mp.mpf(x) for x in (15, "2e-3", "20e-6", 10, 2, "1e-4"))
    load = [0, 0, 1 / C, -1 / (R * C), 0]
    closed = [
        [0, 0, 0, 0, E / L],
        [0, 0, -1 / C, 0, 0],
        [0, 1 / L, 0, -1 / L, 0],
        load,
        [0] * 5,
    ]
    opened = [
        [0, -1 / L, 0, 0, E / L],
        [1 / C, 0, 0, 0, 0],
        [0, 0, 0, -1 / L, 0],
        load,
        [0] * 5,
    ]
    pieces = [
        Piece(matrix(closed), matrix([[-1, 0, -1, 0, Iref]]), mp.eye(5), 4e-5),
        Piece(matrix(opened), None, mp.eye(5), 0.0),
    ]
    cycle(pieces, ["0.5", "25", "0.8", "10", "1"], 4, T)


def chua():
    """From the entry into the middle on."""
    alpha, beta, inner, outer = (
        mp.mpf(8),
        mp.mpf(100) / 7,
        mp.mpf(-1) / 7,
        mp.mpf(2) / 7,
    )

    def slab(slope, offset):
        return matrix(
            [
                [-alpha * slope, alpha, 0, -alpha * offset],
                [1, -1, 1, 0],
                [0, -beta, 0, 0],
                [0] * 4,
            ]
        )

    row, one = matrix([[1, 0, 0, -1]]), mp.eye(4)
    pieces = [
        Piece(slab(inner, 0), row, one, CHUA[0]),
        Piece(slab(outer, inner - outer), row, one, CHUA[1]),
    ]
    cycle(pieces, [*CHUA[2], "1"], 3)


CHUA = (0.895, 1.355, ("1", "-0.353956", "-1.307456"))
M, FOOT, K, B, L0, A, G, W = (mp.mpf(x) for x in (2, 1, 10, 5, 2, 20, 2, 2 * mp.pi))
COUPLING, LAG = mp.mpf(1), mp.mpf("0.3")
PAIR = ["yM1", "vM1", "yM2", "vM2", "ym1", "vm1", "ym2", "vm2", "one", "sin", "cos"]


def hoppers():
    """From t = 0.5 on, when the first hopper is on the ground and the other in the air."""

    def leg(i):
        """The force of a leg, as a row."""
        turned = W * LAG * i  # sin(w (t - lag)) = sin wt cos - cos wt sin
        return row(
            {
                f"yM{i + 1}": -K,
                f"ym{i + 1}": K,
                "one": K * L0,
                "sin": A * mp.cos(turned),
                "cos": -A * mp.sin(turned),
            }
        )

    def row(entries):
        return matrix([[entries.get(name, 0) for name in PAIR]])

    def chart(down):
        rows = {"sin": row({"cos": W}), "cos": row({"sin": -W}), "one": row({})}
        for i in (0, 1):
            one, other = f"yM{i + 1}", f"yM{2 - i}"
            pull = row({one: -COUPLING, other: COUPLING})
            rows[one] = row({f"vM{i + 1}": 1})
            rows[f"vM{i + 1}"] = (leg(i) + pull) / M + row({"one": -G})
            feet = i not in down
            rows[f"ym{i + 1}"] = row({f"vm{i + 1}": feet})
            drag = row({f"vm{i + 1}": B})
            rows[f"vm{i + 1}"] = (-(leg(i) + drag) / FOOT + row({"one": -G})) * feet
        return mp.matrix([list(rows[name]) for name in PAIR])

    lift = [leg(i) + row({"one": FOOT * G}) for i in (0, 1)]
    touch = [row({f"ym{i + 1}": 1}) for i in (0, 1)]
    still = mp.eye(len(PAIR))
    rest = []
    for i in (0, 1):
        J = mp.eye(len(PAIR))
        J[4 + 2 * i, 4 + 2 * i] = J[5 + 2 * i, 5 + 2 * i] = 0
        rest.append(J)
    pieces = [
        Piece(chart({0}), lift[0], still, 0.02),
        Piece(chart(set()), touch[1], rest[1], 0.13),
        Piece(chart({1}), lift[1], still, 0.16),
        Piece(chart(set()), touch[0], rest[0], 0.5),
        Piece(chart({0}), None, still, 0.0),
    ]
    # The states of a foot on the ground are free as well: two of the multipliers are zero.
    cycle(pieces, [*HOPPERS, "1", "0", "-1"], 8, mp.mpf(1))


HOPPERS = ("1.965", "1.876", "1.6066", "-0.2323", "0", "0", "0.5477", "-2.7034")


if __name__ == "__main__":
    for case in (cuk, chua, hoppers):
        print(case.__name__)
        case()
