"""Doses, harvests, queues and processes with resets, fixed before the first run of hybridjax.

Later models get a new file. Afterwards only errors against the sources are mended here.
"""

import math

from form import Event, Model, Start, around


def dose(xp, t, q, p):
    return (q[0] + p.dose, *q[1:])


def pharmacokinetics() -> Model:
    def field(xp, t, q, p):
        return (-p.k * q[0],)

    return Model(
        name="drug, one compartment, doses",
        source="Gibaldi and Perrier, Pharmacokinetics, 1982, Ch. 3 (multiple dosing)",
        charts={"body": (("c",), field)},
        events=(
            Event("dose", "body", "body", reset=dose, schedule=lambda p: (p.tau, 0.0)),
        ),
        parameters={"k": 0.1, "dose": 5.0, "tau": 8.0},
        clock=lambda p: p.tau,
        guesses=(
            *around("body", (7.0,), 1.0),
            Start("body", (0.0,), 0.0, kind="at the dose"),
            Start("body", (0.0,), 4.0, kind="poor"),
            Start("body", (3.0,), 8.0 - 1e-8, kind="1e-8 before the event"),
            Start("body", (3.0,), -16.0, kind="at the dose, early"),
        ),
        truth="one stable cycle with the multiplier exp(-k tau)",
    )


def pharmacokinetics_saturated(rate: float, truth: str) -> Model:
    def field(xp, t, q, p):
        gut, body = q
        return -p.ka * gut, p.ka * gut - p.vmax * body / (p.km + body)

    return Model(
        name=f"drug, saturable elimination, Vmax = {rate}",
        source="Gibaldi and Perrier, Pharmacokinetics, 1982, Ch. 7 (nonlinear)",
        charts={"body": (("gut", "body"), field)},
        events=(
            Event("dose", "body", "body", reset=dose, schedule=lambda p: (p.tau, 2.0)),
        ),
        parameters={"ka": 1.0, "vmax": rate, "km": 4.0, "dose": 6.0, "tau": 12.0},
        clock=lambda p: p.tau,
        guesses=(
            *around("body", (1.0, 5.0)),
            Start("body", (0.0, 0.0), 0.0, kind="poor"),
            Start("body", (0.0, 0.0), 2.0, kind="at the dose"),
            Start("body", (6.0, 100.0), 3.0, kind="far"),
            Start("body", (0.0, 20.0), 2.0 - 1e-8, kind="1e-8 before the event"),
        ),
        truth=truth,
    )


def pest_control() -> Model:
    def field(xp, t, q, p):
        prey, hunter = q
        eaten = p.a * prey * hunter / (1 + p.h * prey)
        return prey * (p.r - prey) - eaten, eaten - p.m * hunter

    return Model(
        name="predators released at fixed times",
        source="Liu and Chen, Chaos, Solitons and Fractals 16, 2003, p. 311",
        charts={"field": (("prey", "hunter"), field)},
        events=(
            Event(
                "release",
                "field",
                "field",
                reset=lambda xp, t, q, p: (q[0], q[1] + p.released),
                schedule=lambda p: (p.beat, 0.0),
            ),
        ),
        parameters={
            "a": 1.0,
            "h": 0.3,
            "r": 2.0,
            "m": 0.6,
            "released": 0.3,
            "beat": 4.0,
        },
        clock=lambda p: p.beat,
        guesses=(
            *around("field", (0.6, 1.2), 1.0),
            Start("field", (0.0, 0.3), 1.0, kind="without prey"),
            Start("field", (2.0, 0.1), 0.0, kind="at the release"),
            Start("field", (1e-6, 0.5), 2.0, kind="almost without prey"),
            Start("field", (1.0, 10.0), 2.0, kind="far"),
        ),
        truth="a cycle without prey (unstable), and one with prey, if it exists",
    )


def allee_harvest() -> Model:
    def field(xp, t, q, p):
        x = q[0]
        return (p.r * x * (x / p.low - 1) * (1 - x),)

    return Model(
        name="harvest with an Allee effect",
        source="Clark, Mathematical Bioeconomics, 1976 (depensation); impulsive harvest",
        charts={"stock": (("x",), field)},
        events=(
            Event(
                "harvest",
                "stock",
                "stock",
                reset=lambda xp, t, q, p: ((1 - p.share) * q[0],),
                schedule=lambda p: (1.0, 0.25),
            ),
        ),
        parameters={"r": 1.0, "low": 0.2, "share": 0.2},
        clock=lambda p: 1.0,
        guesses=(
            *around("stock", (0.9,)),
            Start("stock", (0.25,), 0.0, kind="near the unstable cycle"),
            Start("stock", (0.3,), 0.0, kind="near the unstable cycle"),
            Start("stock", (0.0,), 0.0, kind="extinct"),
            Start("stock", (0.05,), 0.0, kind="other basin"),
            Start("stock", (0.8,), 0.25, kind="at the harvest"),
        ),
        truth="a stable and an unstable cycle, and extinction",
    )


def vaccination() -> Model:
    def field(xp, t, q, p):
        s, i = q
        return p.m - p.beta * s * i - p.m * s, p.beta * s * i - (p.g + p.m) * i

    return Model(
        name="pulse vaccination",
        source="Shulgin, Stone and Agur, Bulletin of Mathematical Biology 60, 1998, p. 1123",
        charts={"people": (("s", "i"), field)},
        events=(
            Event(
                "pulse",
                "people",
                "people",
                reset=lambda xp, t, q, p: ((1 - p.share) * q[0], q[1]),
                schedule=lambda p: (p.beat, 0.0),
            ),
        ),
        parameters={"m": 0.02, "beta": 180.0, "g": 10.0, "share": 0.5, "beat": 2.0},
        clock=lambda p: p.beat,
        guesses=(
            *around("people", (0.05, 1e-3), 0.5),
            Start("people", (0.05, 0.0), 0.5, kind="without infection"),
            Start("people", (0.9, 0.1), 0.0, kind="at the pulse"),
            Start("people", (0.04, 1e-12), 1.0, kind="poor"),
            Start("people", (0.5, 0.5), 1.9, kind="far"),
        ),
        truth="a stable cycle with infection, an unstable one without",
    )


def batch_tank() -> Model:
    """Fill, mix for a while, drain: a recipe with two level switches and a timer."""

    def fill(xp, t, q, p):
        return p.inflow, 0.0

    def mix(xp, t, q, p):
        return 0.0 * q[0], 1.0

    def drain(xp, t, q, p):
        return -p.a * xp.sqrt(xp.maximum(q[0], 1e-9)), 0.0

    def timer_zero(xp, t, q, p):
        return q[0], 0.0

    names = ("h", "timer")
    return Model(
        name="batch tank: fill, mix, drain",
        source="Lygeros, Lecture Notes on Hybrid Systems, 2004 (water tanks)",
        charts={"fill": (names, fill), "mix": (names, mix), "drain": (names, drain)},
        events=(
            Event(
                "full",
                "fill",
                "mix",
                lambda xp, t, q, p: q[0] - p.upper,
                "rising",
                timer_zero,
            ),
            Event(
                "mixed",
                "mix",
                "drain",
                lambda xp, t, q, p: q[1] - p.mixing,
                "rising",
                timer_zero,
            ),
            Event(
                "empty", "drain", "fill", lambda xp, t, q, p: q[0] - p.lower, "falling"
            ),
        ),
        parameters={"inflow": 1.0, "a": 0.8, "upper": 2.0, "lower": 0.2, "mixing": 1.5},
        guesses=(
            *around("fill", (1.0, 0.0)),
            Start("mix", (2.0, 0.5), kind="good"),
            Start("mix", (1.3, 0.5), kind="poor"),
            Start("mix", (2.0, 3.0), kind="beyond the guard"),
            Start("drain", (1.0, 0.0), kind="good"),
            Start("drain", (0.1, 0.0), kind="beyond the guard"),
            Start("fill", (2.5, 0.0), kind="beyond the guard"),
            Start("fill", (2.0 - 1e-8, 0.0), kind="1e-8 before the event"),
        ),
        truth="one deadbeat cycle, without multipliers",
    )


def traffic_light() -> Model:
    def red(xp, t, q, p):
        return (p.arrivals,)

    def green(xp, t, q, p):
        return (p.arrivals - p.service,)

    def empty(xp, t, q, p):
        return (0.0 * q[0],)

    def at(share):
        return lambda p: (p.cycle, share(p) * p.cycle)

    x = ("queue",)
    return Model(
        name="queue at a traffic light",
        source="Newell, Applications of Queueing Theory, 1982, Ch. 2 (fluid queues)",
        charts={"red": (x, red), "green": (x, green), "empty": (x, empty)},
        events=(
            Event("cleared", "green", "empty", lambda xp, t, q, p: q[0], "falling"),
            Event("turns green", "red", "green", schedule=at(lambda p: p.red)),
            Event("turns red", "green", "red", schedule=at(lambda p: 0.0)),
            Event("turns red, empty", "empty", "red", schedule=at(lambda p: 0.0)),
        ),
        parameters={"arrivals": 0.2, "service": 0.6, "cycle": 60.0, "red": 0.5},
        clock=lambda p: p.cycle,
        guesses=(
            *around("red", (3.0,), 15.0),
            Start("green", (5.0,), 32.0, kind="good"),
            Start("empty", (0.0,), 50.0, kind="good"),
            Start("red", (0.0,), 0.0, kind="at the event"),
            Start("green", (-2.0,), 32.0, kind="beyond the guard"),
            Start("empty", (4.0,), 50.0, kind="wrong chart"),
            Start("red", (60.0,), 15.0, kind="many cars"),
        ),
        truth="one deadbeat cycle, without multipliers",
    )


def cell_cycle() -> Model:
    def field(xp, t, q, p):
        mass, protein = q
        return p.mu * mass, p.made * mass - p.k * protein

    return Model(
        name="cell that grows and divides",
        source="Tyson and Novak, Journal of Theoretical Biology 210, 2001, p. 249 (division)",
        charts={"cell": (("mass", "protein"), field)},
        events=(
            Event(
                "division",
                "cell",
                "cell",
                lambda xp, t, q, p: q[1] - p.level,
                "rising",
                lambda xp, t, q, p: (q[0] / 2, p.rest * q[1]),
            ),
        ),
        parameters={"mu": 0.1, "made": 0.5, "k": 0.6, "level": 1.0, "rest": 0.2},
        guesses=(
            *around("cell", (1.0, 0.5)),
            Start("cell", (1.0, 1.0), kind="on the guard"),
            Start("cell", (1.5, 1.0 - 1e-8), kind="1e-8 before the event"),
            Start("cell", (1.0, 2.0), kind="beyond the guard"),
            Start("cell", (0.0, 0.0), kind="equilibrium"),
            Start("cell", (0.01, 0.0), kind="poor"),
        ),
    )


def self_cycling_fermentor() -> Model:
    def field(xp, t, q, p):
        s, x = q
        growth = p.m * s / (p.a + s) * x
        return -growth / p.y, growth

    return Model(
        name="self-cycling fermentor",
        source="Smith and Wolkowicz, Rocky Mountain J. Math. 31, 2001 (self-cycling fermentation)",
        charts={"tank": (("s", "x"), field)},
        events=(
            Event(
                "exchange",
                "tank",
                "tank",
                lambda xp, t, q, p: q[0] - p.low,
                "falling",
                lambda xp, t, q, p: (
                    p.share * p.fresh + (1 - p.share) * q[0],
                    (1 - p.share) * q[1],
                ),
            ),
        ),
        parameters={
            "m": 1.0,
            "a": 0.5,
            "y": 0.5,
            "low": 0.1,
            "share": 0.5,
            "fresh": 2.0,
        },
        section="exchange",
        guesses=(
            *around("tank", (1.0, 0.5)),
            Start("tank", (0.1, 0.9), kind="on the guard"),
            Start("tank", (0.1 + 1e-8, 0.9), kind="1e-8 before the event"),
            Start("tank", (0.05, 0.5), kind="beyond the guard"),
            Start("tank", (1.0, 0.0), kind="equilibrium without cells"),
            Start("tank", (5.0, 5.0), kind="far"),
        ),
        truth="one stable cycle with the multiplier 1 - share",
    )


def event_triggered() -> Model:
    """An unstable plant with a held input that is renewed when the state reaches a level."""

    def field(xp, t, q, p):
        x, u = q
        return p.a * x + u, 0.0 * u

    return Model(
        name="event-triggered control of an unstable plant",
        source="Astrom and Bernhardsson, IEEE Conf. Decision and Control 2002, p. 2011",
        charts={"hold": (("x", "u"), field)},
        events=(
            Event(
                "high",
                "hold",
                "hold",
                lambda xp, t, q, p: q[0] - p.level,
                "rising",
                lambda xp, t, q, p: (q[0], -p.force),
            ),
            Event(
                "low",
                "hold",
                "hold",
                lambda xp, t, q, p: q[0] + p.level,
                "falling",
                lambda xp, t, q, p: (q[0], p.force),
            ),
        ),
        parameters={"a": 1.0, "level": 1.0, "force": 1.5},
        guesses=(
            *around("hold", (0.5, -1.5)),
            Start("hold", (0.0, 1.5), kind="good"),
            Start("hold", (0.0, 0.0), kind="equilibrium"),
            Start("hold", (1.0, -1.5), kind="on the guard"),
            Start("hold", (1.0 - 1e-8, 1.5), kind="1e-8 before the event"),
            Start("hold", (2.0, 0.0), kind="beyond the guard, blows up"),
            Start("hold", (0.1, 0.3), kind="poor"),
        ),
        truth="one deadbeat cycle, without multipliers",
    )


def switched_server() -> Model:
    """One server fills two leaking buffers in turn; the total amount is constant."""

    def serve(first):
        def field(xp, t, q, p):
            x, y = q
            return first * 1.0 - p.leak, (1 - first) * 1.0 - (1 - p.leak)

        return field

    return Model(
        name="switched arrival system with two buffers",
        source="Chase, Serrano and Ramadge, IEEE Trans. Automatic Control 38, 1993, p. 70",
        charts={"first": (("x", "y"), serve(1.0)), "second": (("x", "y"), serve(0.0))},
        events=(
            Event("y empty", "first", "second", lambda xp, t, q, p: q[1], "falling"),
            Event("x empty", "second", "first", lambda xp, t, q, p: q[0], "falling"),
        ),
        parameters={"leak": 0.4},
        guesses=(
            *around("first", (0.3, 0.7)),
            Start("first", (1.0, 0.0), kind="on the guard"),
            Start("second", (0.5, 0.5), kind="good"),
            Start("first", (0.5, 1e-8), kind="1e-8 before the event"),
            Start("first", (0.5, -0.5), kind="beyond the guard"),
            Start("second", (-1.0, 2.0), kind="beyond the guard"),
        ),
        truth="a family of cycles by the total amount: must be refused",
    )


def water_tanks_zeno() -> Model:
    """Two tanks that drain faster than one pipe can fill them: the events accumulate."""

    def fill(first):
        def field(xp, t, q, p):
            x, y = q
            return first * p.inflow - p.v1, (1 - first) * p.inflow - p.v2

        return field

    return Model(
        name="two tanks, Zeno",
        source="Lygeros, Lecture Notes on Hybrid Systems, 2004 (water tanks)",
        charts={"first": (("x", "y"), fill(1.0)), "second": (("x", "y"), fill(0.0))},
        events=(
            Event(
                "y low", "first", "second", lambda xp, t, q, p: q[1] - 1.0, "falling"
            ),
            Event(
                "x low", "second", "first", lambda xp, t, q, p: q[0] - 1.0, "falling"
            ),
        ),
        parameters={"inflow": 0.75, "v1": 0.5, "v2": 0.5},
        guesses=(
            *around("first", (1.5, 1.5)),
            Start("first", (1.0, 1.0), kind="on the guard"),
            Start("second", (1.2, 1.0), kind="poor"),
            Start("second", (1.0 + 1e-8, 2.0), kind="1e-8 before the event"),
        ),
        truth="no cycle: Zeno",
    )


def traffic_two_phases() -> Model:
    """A signal that serves a street until its queue is empty, with a lost time between."""

    def rates(serves_x, serves_y):
        def field(xp, t, q, p):
            lost = 1.0 - serves_x - serves_y
            return (
                p.ax - serves_x * p.service,
                p.ay - serves_y * p.service,
                1.0 * lost,
            )

        return field

    def clock_zero(xp, t, q, p):
        return q[0], q[1], 0.0

    names = ("x", "y", "lost")
    return Model(
        name="traffic signal that serves until empty",
        source="Newell, Applications of Queueing Theory, 1982; Perkins and Kumar, IEEE TAC 1989",
        charts={
            "serve x": (names, rates(1.0, 0.0)),
            "lost 1": (names, rates(0.0, 0.0)),
            "serve y": (names, rates(0.0, 1.0)),
            "lost 2": (names, rates(0.0, 0.0)),
        },
        events=(
            Event(
                "x empty",
                "serve x",
                "lost 1",
                lambda xp, t, q, p: q[0],
                "falling",
                clock_zero,
            ),
            Event(
                "green for y",
                "lost 1",
                "serve y",
                lambda xp, t, q, p: q[2] - p.change,
                "rising",
                clock_zero,
            ),
            Event(
                "y empty",
                "serve y",
                "lost 2",
                lambda xp, t, q, p: q[1],
                "falling",
                clock_zero,
            ),
            Event(
                "green for x",
                "lost 2",
                "serve x",
                lambda xp, t, q, p: q[2] - p.change,
                "rising",
                clock_zero,
            ),
        ),
        parameters={"ax": 0.2, "ay": 0.25, "service": 0.8, "change": 5.0},
        guesses=(
            *around("serve x", (3.0, 2.0, 0.0)),
            Start("lost 1", (0.0, 5.0, 1.0), kind="good"),
            Start("serve y", (2.0, 4.0, 0.0), kind="good"),
            Start("serve x", (0.0, 5.0, 0.0), kind="on the guard"),
            Start("serve x", (1e-8, 5.0, 0.0), kind="1e-8 before the event"),
            Start("serve x", (-3.0, 5.0, 0.0), kind="beyond the guard"),
            Start("lost 1", (0.0, 5.0, 9.0), kind="beyond the guard"),
        ),
        truth="one stable cycle with the multiplier (ax ay) / ((s - ax) (s - ay))",
    )


def respiration() -> Model:
    """Breathing by off-switch: inspiration ends at a threshold that falls with time."""

    def breath_in(xp, t, q, p):
        return p.rate - q[0] / p.tau, -q[1] / p.fade

    def breath_out(xp, t, q, p):
        return -q[0] / p.tau, -q[1] / p.fade

    names = ("volume", "threshold")
    return Model(
        name="respiratory off-switch",
        source="Clark and von Euler, Journal of Physiology 222, 1972, p. 267 (off-switch)",
        charts={"in": (names, breath_in), "out": (names, breath_out)},
        events=(
            Event(
                "off",
                "in",
                "out",
                lambda xp, t, q, p: q[0] - p.base - q[1],
                "rising",
            ),
            Event(
                "on",
                "out",
                "in",
                lambda xp, t, q, p: q[0] - p.low,
                "falling",
                lambda xp, t, q, p: (q[0], 1.0),
            ),
        ),
        parameters={"rate": 1.0, "tau": 1.5, "fade": 0.8, "base": 0.3, "low": 0.15},
        guesses=(
            *around("in", (0.2, 0.9)),
            Start("out", (0.6, 0.3), kind="good"),
            Start("in", (1.5, 0.0), kind="equilibrium beyond the guard"),
            Start("out", (0.1, 0.1), kind="beyond the guard"),
            Start("in", (0.5, 0.2), kind="on the guard"),
            Start("in", (0.5 - 1e-8, 0.2), kind="1e-8 before the event"),
        ),
    )


def seasonal_switch() -> Model:
    """A population that grows in summer and dies in winter, by the calendar."""

    def summer(xp, t, q, p):
        return (p.r * q[0] * (1 - q[0]),)

    def winter(xp, t, q, p):
        return (-p.d * q[0],)

    return Model(
        name="population with summer and winter",
        source="Hsu and Zhao, Journal of Mathematical Biology 64, 2012, p. 109",
        charts={"summer": (("x",), summer), "winter": (("x",), winter)},
        events=(
            Event(
                "winter",
                "summer",
                "winter",
                schedule=lambda p: (1.0, p.share),
            ),
            Event("summer", "winter", "summer", schedule=lambda p: (1.0, 0.0)),
        ),
        parameters={"r": 4.0, "d": 1.0, "share": 0.6},
        clock=lambda p: 1.0,
        guesses=(
            *around("summer", (0.7,), 0.3),
            Start("winter", (0.7,), 0.8, kind="good"),
            Start("winter", (0.7,), 0.3, kind="wrong chart"),
            Start("summer", (0.0,), 0.3, kind="extinct"),
            Start("summer", (1.0,), 0.6 - 1e-8, kind="1e-8 before the event"),
            Start("summer", (0.7,), 0.0, kind="at the event"),
        ),
    )


def ratchet() -> Model:
    """A pawl: a spring is wound by a sinusoidal drive and slips back a tooth when too tight."""

    def field(xp, t, q, p):
        return (p.speed * (1 + p.swing * xp.cos(2 * math.pi * t)),)

    return Model(
        name="ratchet that slips a tooth",
        source="Den Hartog, Mechanical Vibrations, 1956 (relaxation); a winding ratchet",
        charts={"wind": (("angle",), field)},
        events=(
            Event(
                "slip",
                "wind",
                "wind",
                lambda xp, t, q, p: q[0] - 1.0,
                "rising",
                lambda xp, t, q, p: (q[0] - p.tooth,),
            ),
        ),
        parameters={"speed": 0.7, "swing": 0.4, "tooth": 0.7},
        clock=lambda p: 1.0,
        guesses=(
            *around("wind", (0.6,)),
            Start("wind", (1.0,), 0.0, kind="on the guard"),
            Start("wind", (1.0 - 1e-8,), 0.0, kind="1e-8 before the event"),
            Start("wind", (1.5,), 0.0, kind="beyond the guard"),
            Start("wind", (0.4,), 0.5, kind="poor"),
        ),
        truth="a family of cycles, none isolated: must be refused",
    )


MODELS = (
    pharmacokinetics(),
    pharmacokinetics_saturated(2.0, "one stable cycle"),
    pharmacokinetics_saturated(0.4, "no cycle: the drug accumulates"),
    pest_control(),
    allee_harvest(),
    vaccination(),
    batch_tank(),
    traffic_light(),
    cell_cycle(),
    self_cycling_fermentor(),
    event_triggered(),
    switched_server(),
    water_tanks_zeno(),
    traffic_two_phases(),
    respiration(),
    seasonal_switch(),
    ratchet(),
)
