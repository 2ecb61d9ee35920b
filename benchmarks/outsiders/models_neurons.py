"""Neurons and hearts with events, fixed before the first run of hybridjax on them.

Later models get a new file. Afterwards only errors against the sources are mended here.
"""

import math

from form import Event, Model, Start, around


def lif() -> Model:
    def field(xp, t, q, p):
        return ((-q[0] + p.drive) / p.tau,)

    return Model(
        name="leaky integrate-and-fire",
        source="Gerstner et al., Neuronal Dynamics, 2014, Sec. 1.3",
        charts={"membrane": (("v",), field)},
        events=(
            Event(
                "spike",
                "membrane",
                "membrane",
                lambda xp, t, q, p: q[0] - p.threshold,
                "rising",
                lambda xp, t, q, p: (0.0,),
            ),
        ),
        parameters={"tau": 10.0, "drive": 20.0, "threshold": 15.0},
        guesses=(
            *around("membrane", (5.0,)),
            Start("membrane", (15.0,), kind="on the guard"),
            Start("membrane", (15.0 - 1e-8,), kind="1e-8 before the event"),
            Start("membrane", (16.0,), kind="beyond the guard"),
            Start("membrane", (20.0,), kind="equilibrium beyond the guard"),
            Start("membrane", (-70.0,), kind="far"),
        ),
        truth="one stable cycle of period tau ln 4, without multipliers",
    )


def lif_subthreshold() -> Model:
    def field(xp, t, q, p):
        return ((-q[0] + p.drive + p.swing * xp.cos(2 * math.pi * t / p.beat)) / p.tau,)

    return Model(
        name="integrate-and-fire below threshold, driven",
        source="Gerstner et al., Neuronal Dynamics, 2014, Sec. 1.3",
        charts={"membrane": (("v",), field)},
        events=(
            Event(
                "spike",
                "membrane",
                "membrane",
                lambda xp, t, q, p: q[0] - p.threshold,
                "rising",
                lambda xp, t, q, p: (0.0,),
            ),
        ),
        parameters={
            "tau": 10.0,
            "drive": 10.0,
            "threshold": 15.0,
            "swing": 5.0,
            "beat": 20.0,
        },
        clock=lambda p: p.beat,
        guesses=(
            *around("membrane", (9.0,)),
            Start("membrane", (15.0,), kind="on the guard"),
            Start("membrane", (15.0 - 1e-8,), kind="1e-8 before the event"),
            Start("membrane", (16.0,), kind="beyond the guard"),
            Start("membrane", (40.0,), 7.0, kind="beyond the guard"),
        ),
        truth="one stable cycle without spikes; multiplier exp(-2)",
    )


def lif_driven() -> Model:
    def field(xp, t, q, p):
        drive = p.drive + p.swing * xp.cos(2 * math.pi * t / p.beat)
        return (-q[0] / p.tau + drive,)

    return Model(
        name="integrate-and-fire, driven, one spike a period",
        source="Keener, Hoppensteadt and Rinzel, SIAM J. Appl. Math. 41, 1981, p. 503",
        charts={"membrane": (("v",), field)},
        events=(
            Event(
                "spike",
                "membrane",
                "membrane",
                lambda xp, t, q, p: q[0] - 1.0,
                "rising",
                lambda xp, t, q, p: (0.0,),
            ),
        ),
        parameters={"tau": 1.0, "drive": 1.3, "swing": 0.5, "beat": 1.4},
        clock=lambda p: p.beat,
        guesses=(
            *around("membrane", (0.3,)),
            Start("membrane", (0.3,), 0.7, kind="another time"),
            Start("membrane", (1.0,), kind="on the guard"),
            Start("membrane", (1.0 - 1e-8,), kind="1e-8 before the event"),
            Start("membrane", (1.2,), kind="beyond the guard"),
            Start("membrane", (-30.0,), kind="far"),
        ),
        truth="a stable cycle with one spike a period, perhaps an unstable one",
    )


def half_center() -> Model:
    """Two integrate-and-fire cells whose spikes open an inhibitory synapse of the other."""

    def field(xp, t, q, p):
        v1, v2, s1, s2 = q
        return (
            -v1 + p.drive - p.weight * s2,
            -v2 + p.drive - p.weight * s1,
            -s1 / p.decay,
            -s2 / p.decay,
        )

    return Model(
        name="two integrate-and-fire cells that inhibit each other",
        source="van Vreeswijk, Abbott and Ermentrout, J. Comput. Neurosci. 1, 1994, p. 313",
        charts={"cells": (("v1", "v2", "s1", "s2"), field)},
        events=(
            Event(
                "spike 1",
                "cells",
                "cells",
                lambda xp, t, q, p: q[0] - 1.0,
                "rising",
                lambda xp, t, q, p: (0.0, q[1], q[2] + 1.0, q[3]),
            ),
            Event(
                "spike 2",
                "cells",
                "cells",
                lambda xp, t, q, p: q[1] - 1.0,
                "rising",
                lambda xp, t, q, p: (q[0], 0.0, q[2], q[3] + 1.0),
            ),
        ),
        parameters={"drive": 1.6, "weight": 0.4, "decay": 0.3},
        guesses=(
            *around("cells", (0.0, 0.6, 1.0, 0.1)),
            Start("cells", (0.2, 0.2, 0.3, 0.3), kind="synchronous"),
            Start("cells", (1.0, 0.5, 0.0, 0.0), kind="on the guard"),
            Start("cells", (0.0, 1.0 - 1e-8, 0.5, 0.5), kind="1e-8 before the event"),
            Start("cells", (0.0, 1.3, 0.5, 0.5), kind="beyond the guard"),
            Start("cells", (0.9, -5.0, 0.0, 3.0), kind="far"),
            Start("cells", (1.6, 1.6, 0.0, 0.0), kind="equilibrium beyond the guards"),
        ),
        truth="alternating spikes; synchronous spikes coincide",
    )


def pulse_coupled() -> Model:
    def field(xp, t, q, p):
        return p.drive - q[0], p.drive - q[1]

    return Model(
        name="two cells with inhibitory pulses",
        source="Mirollo and Strogatz, SIAM J. Appl. Math. 50, 1990, p. 1645 (sign reversed)",
        charts={"cells": (("x", "y"), field)},
        events=(
            Event(
                "spike x",
                "cells",
                "cells",
                lambda xp, t, q, p: q[0] - 1.0,
                "rising",
                lambda xp, t, q, p: (0.0, q[1] - p.pulse),
            ),
            Event(
                "spike y",
                "cells",
                "cells",
                lambda xp, t, q, p: q[1] - 1.0,
                "rising",
                lambda xp, t, q, p: (q[0] - p.pulse, 0.0),
            ),
        ),
        parameters={"drive": 1.3, "pulse": 0.1},
        guesses=(
            *around("cells", (0.0, 0.5)),
            Start("cells", (0.4, 0.4), kind="synchronous"),
            Start("cells", (1.0, 0.5), kind="on the guard"),
            Start("cells", (0.0, 1.0 - 1e-8), kind="1e-8 before the event"),
            Start("cells", (1.2, 0.5), kind="beyond the guard"),
            Start("cells", (1.3, 1.3), kind="equilibrium beyond the guards"),
        ),
        truth="alternating spikes, stable; synchronous spikes coincide",
    )


def quadratic() -> Model:
    def field(xp, t, q, p):
        return (q[0] ** 2 + p.current,)

    return Model(
        name="quadratic integrate-and-fire",
        source="Izhikevich, Dynamical Systems in Neuroscience, 2007, Ch. 8",
        charts={"membrane": (("v",), field)},
        events=(
            Event(
                "spike",
                "membrane",
                "membrane",
                lambda xp, t, q, p: q[0] - p.peak,
                "rising",
                lambda xp, t, q, p: (-p.peak,),
            ),
        ),
        parameters={"current": 0.05, "peak": 10.0},
        guesses=(
            *around("membrane", (-1.0,)),
            Start("membrane", (0.0,), kind="bottleneck"),
            Start("membrane", (10.0,), kind="on the guard"),
            Start("membrane", (10.0 - 1e-8,), kind="1e-8 before the event"),
            Start("membrane", (11.0,), kind="beyond the guard, blows up"),
            Start("membrane", (-10.0,), kind="good"),
        ),
    )


def quadratic_bistable() -> Model:
    def field(xp, t, q, p):
        return (q[0] ** 2 + p.current,)

    return Model(
        name="quadratic integrate-and-fire, bistable",
        source="Izhikevich, Dynamical Systems in Neuroscience, 2007, Ch. 8",
        charts={"membrane": (("v",), field)},
        events=(
            Event(
                "spike",
                "membrane",
                "membrane",
                lambda xp, t, q, p: q[0] - 10.0,
                "rising",
                lambda xp, t, q, p: (2.0,),
            ),
        ),
        parameters={"current": -1.0},
        guesses=(
            *around("membrane", (3.0,)),
            Start("membrane", (1.0,), kind="unstable equilibrium"),
            Start("membrane", (-1.0,), kind="stable equilibrium"),
            Start("membrane", (0.5,), kind="other basin"),
            Start("membrane", (1.0 + 1e-6,), kind="near the unstable equilibrium"),
            Start("membrane", (10.0 - 1e-8,), kind="1e-8 before the event"),
            Start("membrane", (12.0,), kind="beyond the guard, blows up"),
        ),
        truth="a stable cycle and a stable equilibrium",
    )


def adaptive_exponential() -> Model:
    def field(xp, t, q, p):
        v, w = q
        spike = p.gl * p.slope * xp.exp((v - p.vt) / p.slope)
        return (-p.gl * (v - p.el) + spike - w + p.current) / p.c, (
            p.a * (v - p.el) - w
        ) / p.tau

    return Model(
        name="adaptive exponential integrate-and-fire",
        source="Brette and Gerstner, Journal of Neurophysiology 94, 2005, p. 3637",
        charts={"membrane": (("v", "w"), field)},
        events=(
            Event(
                "spike",
                "membrane",
                "membrane",
                lambda xp, t, q, p: q[0] - p.peak,
                "rising",
                lambda xp, t, q, p: (p.el, q[1] + p.b),
            ),
        ),
        # mV, ms, pA, nS, pF
        parameters={
            "c": 281.0,
            "gl": 30.0,
            "el": -70.6,
            "vt": -50.4,
            "slope": 2.0,
            "tau": 144.0,
            "a": 4.0,
            "b": 80.5,
            "current": 1000.0,
            "peak": 0.0,
        },
        section="spike",
        guesses=(
            *around("membrane", (-65.0, 150.0)),
            Start("membrane", (-70.6, 200.0), kind="good"),
            Start("membrane", (0.0, 100.0), kind="on the guard"),
            Start("membrane", (-1e-8, 100.0), kind="1e-8 before the event"),
            Start("membrane", (10.0, 100.0), kind="beyond the guard, blows up"),
            Start("membrane", (-60.0, 2000.0), kind="far"),
        ),
    )


def resonate_and_fire() -> Model:
    def field(xp, t, q, p):
        x, y = q
        push = p.force * xp.sin(2 * math.pi * t / p.beat)
        return p.b * x - p.omega * y + push, p.omega * x + p.b * y

    return Model(
        name="resonate-and-fire, driven",
        source="Izhikevich, Neural Networks 14, 2001, p. 883",
        charts={"membrane": (("x", "y"), field)},
        events=(
            Event(
                "spike",
                "membrane",
                "membrane",
                lambda xp, t, q, p: q[1] - 1.0,
                "rising",
                lambda xp, t, q, p: (0.0, 0.5),
            ),
        ),
        parameters={"b": -0.3, "omega": 2.0, "force": 1.5, "beat": 3.1},
        clock=lambda p: p.beat,
        guesses=(
            *around("membrane", (0.0, 0.5)),
            Start("membrane", (0.0, 0.0), kind="rest"),
            Start("membrane", (0.0, 0.5), 1.5, kind="another time"),
            Start("membrane", (0.5, 1.0), kind="on the guard"),
            Start("membrane", (0.5, 1.0 - 1e-8), kind="1e-8 before the event"),
            Start("membrane", (0.0, 2.0), kind="beyond the guard"),
        ),
    )


def theta_pair() -> Model:
    def field(xp, t, q, p):
        def rate(angle, synapse):
            return 1 - xp.cos(angle) + (1 + xp.cos(angle)) * (p.current - p.g * synapse)

        return rate(q[0], q[3]), rate(q[1], q[2]), -q[2] / p.tau, -q[3] / p.tau

    return Model(
        name="pair of theta neurons",
        source="Ermentrout, Neural Computation 8, 1996, p. 979",
        charts={"cells": (("a", "b", "s", "r"), field)},
        events=(
            Event(
                "spike a",
                "cells",
                "cells",
                lambda xp, t, q, p: q[0] - math.pi,
                "rising",
                lambda xp, t, q, p: (-math.pi, q[1], q[2] + 1.0, q[3]),
            ),
            Event(
                "spike b",
                "cells",
                "cells",
                lambda xp, t, q, p: q[1] - math.pi,
                "rising",
                lambda xp, t, q, p: (q[0], -math.pi, q[2], q[3] + 1.0),
            ),
        ),
        parameters={"current": 0.3, "g": 0.2, "tau": 1.5},
        guesses=(
            *around("cells", (-3.0, 0.5, 1.0, 0.2)),
            Start("cells", (0.0, 0.0, 0.1, 0.1), kind="synchronous"),
            Start("cells", (math.pi, 0.0, 0.1, 0.1), kind="on the guard"),
            Start(
                "cells", (math.pi - 1e-8, 0.0, 0.0, 0.0), kind="1e-8 before the event"
            ),
            Start("cells", (4.0, 0.0, 0.0, 0.0), kind="beyond the guard"),
            Start("cells", (-2.0, -1.9, 0.5, 0.5), kind="almost synchronous"),
        ),
        truth="alternating spikes; synchronous spikes coincide",
    )


def izhikevich(name: str, c: float, d: float, truth: str) -> Model:
    def field(xp, t, q, p):
        v, u = q
        return 0.04 * v**2 + 5 * v + 140 - u + p.current, p.a * (p.b * v - u)

    return Model(
        name=f"Izhikevich, {name}",
        source="Izhikevich, IEEE Transactions on Neural Networks 14, 2003, p. 1569",
        charts={"membrane": (("v", "u"), field)},
        events=(
            Event(
                "spike",
                "membrane",
                "membrane",
                lambda xp, t, q, p: q[0] - 30.0,
                "rising",
                lambda xp, t, q, p: (p.c, q[1] + p.d),
            ),
        ),
        parameters={"a": 0.02, "b": 0.2, "c": c, "d": d, "current": 10.0},
        guesses=(
            *around("membrane", (c, 0.0)),
            Start("membrane", (-65.0, -13.0), kind="rest"),
            Start("membrane", (30.0, 0.0), kind="on the guard"),
            Start("membrane", (30.0 - 1e-8, 0.0), kind="1e-8 before the event"),
            Start("membrane", (35.0, 0.0), kind="beyond the guard, blows up"),
            Start("membrane", (-80.0, 20.0), kind="far"),
        ),
        truth=truth,
    )


def mckean() -> Model:
    def branch(slope, offset):
        def field(xp, t, q, p):
            v, w = q
            return slope * v + offset(p) - w + p.current, p.eps * (v - p.gamma * w)

        return field

    left = branch(-1.0, lambda p: 0.0)
    middle = branch(1.0, lambda p: -p.a)
    right = branch(-1.0, lambda p: 1.0)
    names = ("v", "w")
    return Model(
        name="McKean, piecewise linear",
        source="McKean, Advances in Mathematics 4, 1970, p. 209",
        charts={
            "left": (names, left),
            "middle": (names, middle),
            "right": (names, right),
        },
        events=(
            Event(
                "up 1",
                "left",
                "middle",
                lambda xp, t, q, p: q[0] - p.a / 2,
                "rising",
            ),
            Event(
                "up 2",
                "middle",
                "right",
                lambda xp, t, q, p: q[0] - (1 + p.a) / 2,
                "rising",
            ),
            Event(
                "down 2",
                "right",
                "middle",
                lambda xp, t, q, p: q[0] - (1 + p.a) / 2,
                "falling",
            ),
            Event(
                "down 1",
                "middle",
                "left",
                lambda xp, t, q, p: q[0] - p.a / 2,
                "falling",
            ),
        ),
        parameters={"a": 0.25, "eps": 0.1, "gamma": 0.5, "current": 0.5},
        guesses=(
            *around("right", (1.0, 0.4)),
            Start("left", (-0.2, 0.6), kind="fair"),
            Start("middle", (0.375, 0.6), kind="poor"),
            Start("left", (0.5, 0.5), kind="wrong chart"),
            Start("middle", (0.125, 0.2), kind="on the guard"),
            Start("right", (0.0, 0.5), kind="wrong chart"),
            Start("middle", (0.25, 0.5), kind="equilibrium"),
        ),
    )


def glass_mackey() -> Model:
    """Integrate and fire with a threshold that the heart's drive moves."""

    def field(xp, t, q, p):
        return (p.rate,)

    return Model(
        name="integrate and fire with a moving threshold",
        source="Glass and Mackey, Journal of Mathematical Biology 7, 1979, p. 339",
        charts={"fill": (("activity",), field)},
        events=(
            Event(
                "fire",
                "fill",
                "fill",
                lambda xp, t, q, p: q[0] - 1 - p.swing * xp.sin(2 * math.pi * t),
                "rising",
                lambda xp, t, q, p: (0.0,),
            ),
        ),
        parameters={"rate": 1.0, "swing": 0.1},
        clock=lambda p: 1.0,
        guesses=(
            *around("fill", (0.4,)),
            Start("fill", (0.4,), 0.6, kind="another time"),
            Start("fill", (1.0,), kind="on the guard"),
            Start("fill", (1.0 - 1e-8,), kind="1e-8 before the event"),
            Start("fill", (1.3,), kind="beyond the guard"),
            Start("fill", (-5.0,), kind="far"),
        ),
        truth="a stable cycle and an unstable one, each with one beat a period",
    )


MODELS = (
    lif(),
    lif_subthreshold(),
    lif_driven(),
    half_center(),
    pulse_coupled(),
    quadratic(),
    quadratic_bistable(),
    adaptive_exponential(),
    resonate_and_fire(),
    theta_pair(),
    izhikevich("regular spiking", -65.0, 8.0, "one stable cycle"),
    izhikevich("chattering", -50.0, 2.0, "stable bursts of several spikes"),
    mckean(),
    glass_mackey(),
)
