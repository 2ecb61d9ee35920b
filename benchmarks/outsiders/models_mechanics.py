"""Machines with impacts, friction and legs, fixed before the first run of hybridjax on them.

Later models get a new file. Afterwards only errors against the sources are mended here.
"""

import math

from form import Event, Model, Start, around


def bouncing_ball(restitution: float, gamma: float) -> Model:
    """`gamma` is the table's largest acceleration, in units of gravity."""

    def height(xp, t, p):
        return p.gamma * p.g / (2 * math.pi) ** 2 * xp.sin(2 * math.pi * t)

    def speed(xp, t, p):
        return p.gamma * p.g / (2 * math.pi) * xp.cos(2 * math.pi * t)

    def field(xp, t, q, p):
        return q[1], -p.g

    def gap(xp, t, q, p):
        return q[0] - height(xp, t, p)

    def bounce(xp, t, q, p):
        return q[0], (1 + p.e) * speed(xp, t, p) - p.e * q[1]

    return Model(
        name=f"ball on a vibrating table, e = {restitution}",
        source="Guckenheimer and Holmes, Nonlinear Oscillations, 1983, Sec. 2.4",
        charts={"flight": (("y", "v"), field)},
        events=(Event("impact", "flight", "flight", gap, "falling", bounce),),
        parameters={"e": restitution, "gamma": gamma, "g": 9.81},
        clock=lambda p: 1.0,
        guesses=(
            *around("flight", (0.5, 4.0), 0.2),
            Start("flight", (1.0, 0.0), 0.5, kind="fair"),
            Start("flight", (-1.0, 0.0), 0.0, kind="below the table"),
            Start("flight", (0.0, 5.0), 0.0, kind="on the guard"),
            Start("flight", (1e-8, -4.0), 0.0, kind="1e-8 before the event"),
            Start("flight", (0.0, 0.0), 0.0, kind="at rest on the table"),
            Start("flight", (60.0, 0.0), 0.0, kind="far"),
        ),
        truth="a stable and an unstable cycle with one impact a period",
    )


def impact_oscillator() -> Model:
    def field(xp, t, q, p):
        return q[1], -q[0] - 2 * p.zeta * q[1] + xp.cos(p.omega * t)

    return Model(
        name="impact oscillator with one stop",
        source="Shaw and Holmes, Journal of Sound and Vibration 90, 1983, p. 129",
        charts={"free": (("x", "v"), field)},
        events=(
            Event(
                "impact",
                "free",
                "free",
                lambda xp, t, q, p: q[0] - p.stop,
                "rising",
                lambda xp, t, q, p: (q[0], -p.r * q[1]),
            ),
        ),
        parameters={"zeta": 0.05, "omega": 2.0, "stop": 0.1, "r": 0.7},
        clock=lambda p: 2 * math.pi / p.omega,
        guesses=(
            *around("free", (-0.5, 0.2)),
            Start("free", (0.0, 0.0), 1.0, kind="poor"),
            Start("free", (0.1, 1.0), 0.0, kind="on the guard"),
            Start("free", (0.1 - 1e-8, 1.0), 0.0, kind="1e-8 before the event"),
            Start("free", (0.5, 0.0), 0.0, kind="beyond the guard"),
            Start("free", (-20.0, 0.0), 0.0, kind="far"),
        ),
    )


def impact_oscillator_free() -> Model:
    def field(xp, t, q, p):
        return q[1], -q[0] - 2 * p.zeta * q[1] + xp.cos(p.omega * t)

    return Model(
        name="impact oscillator whose stop is out of reach",
        source="Shaw and Holmes, Journal of Sound and Vibration 90, 1983, p. 129",
        charts={"free": (("x", "v"), field)},
        events=(
            Event(
                "impact",
                "free",
                "free",
                lambda xp, t, q, p: q[0] - p.stop,
                "rising",
                lambda xp, t, q, p: (q[0], -p.r * q[1]),
            ),
        ),
        parameters={"zeta": 0.1, "omega": 2.0, "stop": 0.5, "r": 0.7},
        clock=lambda p: 2 * math.pi / p.omega,
        guesses=(
            *around("free", (-0.3, 0.05)),
            Start("free", (0.5, 1.0), 0.0, kind="on the guard"),
            Start("free", (0.5 - 1e-8, 1.0), 0.0, kind="1e-8 before the event"),
            Start("free", (0.8, 0.0), 0.0, kind="beyond the guard"),
            Start("free", (-5.0, 0.0), 0.0, kind="far"),
        ),
        truth="a stable cycle without impacts (amplitude 1/3), perhaps cycles with impacts",
    )


def rattle() -> Model:
    def field(xp, t, q, p):
        return q[1], -p.drag * q[1] + p.a * xp.cos(t)

    def bounce(xp, t, q, p):
        return q[0], -p.e * q[1]

    return Model(
        name="gear rattle, two stops",
        source="Karagiannis and Pfeiffer, Nonlinear Dynamics 2, 1991, p. 367",
        charts={"backlash": (("x", "v"), field)},
        events=(
            Event(
                "right",
                "backlash",
                "backlash",
                lambda xp, t, q, p: q[0] - p.gap,
                "rising",
                bounce,
            ),
            Event(
                "left",
                "backlash",
                "backlash",
                lambda xp, t, q, p: q[0] + p.gap,
                "falling",
                bounce,
            ),
        ),
        parameters={"drag": 0.1, "a": 1.0, "gap": 0.5, "e": 0.3},
        clock=lambda p: 2 * math.pi,
        guesses=(
            *around("backlash", (0.1, 0.5)),
            Start("backlash", (0.5, 1.0), 0.0, kind="on the guard"),
            Start("backlash", (0.5 - 1e-8, 1.0), 0.0, kind="1e-8 before the event"),
            Start("backlash", (0.8, 0.0), 0.0, kind="beyond the guard"),
            Start("backlash", (0.0, -1.0), 3.0, kind="poor"),
            Start("backlash", (-0.2, 0.0), 1.5, kind="poor"),
        ),
    )


def reversing_table() -> Model:
    def drive(sign):
        def field(xp, t, q, p):
            return q[1], (sign * p.speed - q[1]) / p.tau

        return field

    return Model(
        name="planer table with limit switches",
        source="Tsypkin, Relay Control Systems, 1984, reversing drives",
        charts={
            "forward": (("x", "v"), drive(1.0)),
            "backward": (("x", "v"), drive(-1.0)),
        },
        events=(
            Event(
                "front switch",
                "forward",
                "backward",
                lambda xp, t, q, p: q[0] - p.half,
                "rising",
            ),
            Event(
                "back switch",
                "backward",
                "forward",
                lambda xp, t, q, p: q[0] + p.half,
                "falling",
            ),
        ),
        parameters={"speed": 0.5, "tau": 0.2, "half": 1.0},
        guesses=(
            *around("forward", (0.2, 0.5)),
            Start("backward", (0.0, 0.0), kind="poor"),
            Start("forward", (1.1, 0.5), kind="beyond the guard"),
            Start("forward", (1.0, 0.5), kind="on the guard"),
            Start("forward", (1.0 - 1e-8, 0.5), kind="1e-8 before the event"),
            Start("backward", (-4.0, -0.5), kind="beyond the guard"),
        ),
    )


def gate_valve() -> Model:
    """A valve that a clock opens and closes, and that limit switches stop."""

    def rising(xp, t, q, p):
        return (p.speed,)

    def falling(xp, t, q, p):
        return (-p.speed,)

    def still(xp, t, q, p):
        return (0.0 * q[0],)

    def at(share):
        return lambda p: (p.beat, share * p.beat)

    x = ("x",)
    return Model(
        name="motor valve with limit switches, timed",
        source="Smith and Corripio, Principles and Practice of Automatic Process Control",
        charts={
            "opens": (x, rising),
            "open": (x, still),
            "closes": (x, falling),
            "closed": (x, still),
        },
        events=(
            Event("is open", "opens", "open", lambda xp, t, q, p: q[0] - 1.0, "rising"),
            Event("is closed", "closes", "closed", lambda xp, t, q, p: q[0], "falling"),
            Event("close", "open", "closes", schedule=at(0.5)),
            Event("close early", "opens", "closes", schedule=at(0.5)),
            Event("open", "closed", "opens", schedule=at(0.0)),
            Event("open early", "closes", "opens", schedule=at(0.0)),
        ),
        parameters={"speed": 0.5, "beat": 6.0},
        clock=lambda p: p.beat,
        guesses=(
            *around("opens", (0.4,), 0.8),
            Start("open", (1.0,), 2.5, kind="good"),
            Start("closed", (0.0,), 5.5, kind="good"),
            Start("opens", (1.2,), 0.5, kind="beyond the guard"),
            Start("closes", (-0.5,), 4.0, kind="beyond the guard"),
            Start("closed", (0.7,), 5.5, kind="stuck half open"),
            Start("opens", (1.0 - 1e-8,), 2.0, kind="1e-8 before the event"),
        ),
        truth="one deadbeat cycle, without multipliers",
    )


def belt() -> Model:
    def slip(xp, t, q, p):
        x, v = q
        slide = p.belt - v
        kinetic = p.static * (p.ratio + (1 - p.ratio) * xp.exp(-slide / p.fade))
        return v, -p.k * x - p.c * v + kinetic

    def stick(xp, t, q, p):
        return (p.belt,)

    return Model(
        name="stick-slip on a belt",
        source="Popp and Stelter, Phil. Trans. R. Soc. London A 332, 1990, p. 89",
        charts={"slip": (("x", "v"), slip), "stick": (("x",), stick)},
        events=(
            Event(
                "catch",
                "slip",
                "stick",
                lambda xp, t, q, p: p.belt - q[1],
                "falling",
                lambda xp, t, q, p: (q[0],),
            ),
            Event(
                "release",
                "stick",
                "slip",
                lambda xp, t, q, p: p.k * q[0] + p.c * p.belt - p.static,
                "rising",
                lambda xp, t, q, p: (q[0], p.belt),
            ),
        ),
        parameters={
            "k": 1.0,
            "c": 0.01,
            "belt": 0.2,
            "static": 1.0,
            "ratio": 0.5,
            "fade": 0.3,
        },
        guesses=(
            *around("stick", (0.5,)),
            Start("slip", (1.0, -0.2), kind="good"),
            Start("slip", (0.8, 0.0), kind="near the equilibrium"),
            Start("stick", (1.5,), kind="beyond the guard"),
            Start("slip", (0.0, 1.0), kind="beyond the guard"),
            Start("slip", (0.5, 0.2), kind="on the guard"),
            Start("stick", (-10.0,), kind="far"),
        ),
    )


def coulomb_forced() -> Model:
    def moving(sign):
        def field(xp, t, q, p):
            return q[1], -q[0] - sign * p.f + xp.cos(p.omega * t)

        return field

    return Model(
        name="forced oscillator with Coulomb friction",
        source="Den Hartog, Trans. ASME 53, APM-53-9, 1931, p. 107",
        charts={"right": (("x", "v"), moving(1.0)), "left": (("x", "v"), moving(-1.0))},
        events=(
            Event("turn left", "right", "left", lambda xp, t, q, p: q[1], "falling"),
            Event("turn right", "left", "right", lambda xp, t, q, p: q[1], "rising"),
        ),
        parameters={"f": 0.2, "omega": 0.8},
        clock=lambda p: 2 * math.pi / p.omega,
        guesses=(
            *around("right", (-1.0, 1.0)),
            Start("left", (2.0, -0.5), 0.0, kind="fair"),
            Start("left", (2.0, 0.0), 0.0, kind="on the guard"),
            Start("right", (0.0, 0.0), 0.0, kind="at rest"),
            Start("right", (1.0, 1e-8), 4.0, kind="1e-8 before the event"),
            Start("right", (0.0, -2.0), 0.0, kind="wrong chart"),
        ),
    )


def rocking_block() -> Model:
    def tilt(side):
        def field(xp, t, q, p):
            return q[1], q[0] - side + p.beta * xp.cos(p.omega * t)

        return field

    def impact(xp, t, q, p):
        return q[0], p.r * q[1]

    return Model(
        name="rocking block",
        source="Hogan, Proceedings of the Royal Society A 425, 1989, p. 441",
        charts={"right": (("x", "v"), tilt(1.0)), "left": (("x", "v"), tilt(-1.0))},
        events=(
            Event(
                "to left",
                "right",
                "left",
                lambda xp, t, q, p: q[0],
                "falling",
                impact,
            ),
            Event(
                "to right",
                "left",
                "right",
                lambda xp, t, q, p: q[0],
                "rising",
                impact,
            ),
        ),
        parameters={"beta": 3.0, "omega": 4.0, "r": 0.8},
        clock=lambda p: 2 * math.pi / p.omega,
        guesses=(
            *around("right", (0.1, 0.3), 0.2),
            Start("left", (-0.2, 0.0), 0.0, kind="poor"),
            Start("right", (0.0, 0.0), 0.0, kind="at rest"),
            Start("right", (0.0, 1.0), 1.0, kind="on the guard"),
            Start("right", (1e-8, -1.0), 0.0, kind="1e-8 before the event"),
            Start("right", (3.0, 1.0), 0.0, kind="falls over"),
            Start("right", (-0.5, 0.0), 0.0, kind="wrong chart"),
        ),
        truth="rocking cycles, stable or not; blocks that tilt too far fall over",
    )


def escapement() -> Model:
    def swing(sign):
        def field(xp, t, q, p):
            return q[1], -q[0] - sign * p.f

        return field

    def kick(xp, t, q, p):
        return q[0], xp.sqrt(q[1] ** 2 + p.h**2)

    return Model(
        name="clock with Coulomb friction and energy impulses",
        source="Andronov, Vitt and Khaikin, Theory of Oscillators, 1966, Ch. III",
        charts={"up": (("x", "v"), swing(1.0)), "down": (("x", "v"), swing(-1.0))},
        events=(
            Event(
                "kick",
                "up",
                "up",
                lambda xp, t, q, p: q[0] + p.f,
                "rising",
                kick,
                domain=False,
            ),
            Event("top", "up", "down", lambda xp, t, q, p: q[1], "falling"),
            Event("bottom", "down", "up", lambda xp, t, q, p: q[1], "rising"),
        ),
        parameters={"f": 0.1, "h": 0.7},
        section="kick",
        guesses=(
            *around("up", (-0.3, 0.6)),
            Start("down", (0.5, -0.3), kind="poor"),
            Start("up", (0.0, 0.0), kind="inside of the dead zone"),
            Start("up", (-0.1, 0.5), kind="on the guard"),
            Start("up", (-0.1 - 1e-8, 0.5), kind="1e-8 before the event"),
            Start("down", (0.05, 0.0), kind="inside of the dead zone"),
            Start("up", (0.0, -2.0), kind="wrong chart"),
        ),
        truth="one stable cycle, from every motion that reaches the kick",
    )


def kicked_pendulum() -> Model:
    def field(xp, t, q, p):
        return q[1], -p.c * q[1] - xp.sin(q[0])

    return Model(
        name="damped pendulum with periodic kicks",
        source="Zaslavsky, Physics Letters A 69, 1978, p. 145",
        charts={"swing": (("angle", "rate"), field)},
        events=(
            Event(
                "kick",
                "swing",
                "swing",
                reset=lambda xp, t, q, p: (q[0], q[1] + p.kick),
                schedule=lambda p: (p.beat, 0.0),
            ),
        ),
        parameters={"c": 0.2, "kick": 0.6, "beat": 5.0},
        clock=lambda p: p.beat,
        guesses=(
            *around("swing", (0.3, 0.2), 1.0),
            Start("swing", (0.0, 0.0), 0.0, kind="at the kick"),
            Start("swing", (0.0, 0.0), 2.5, kind="rest"),
            Start("swing", (math.pi, 0.0), 2.5, kind="upright"),
            Start("swing", (6.5, 0.0), 4.9, kind="one turn further"),
            Start("swing", (0.0, 40.0), 1.0, kind="far"),
        ),
    )


def slip_runner() -> Model:
    def flight(xp, t, q, p):
        y, vx, vy = q
        return vy, 0.0 * vx, -p.g

    def stance(xp, t, q, p):
        x, y, vx, vy = q
        length = xp.sqrt(x**2 + y**2)
        push = p.k / p.m * (p.rest / length - 1)
        return vx, vy, push * x, push * y - p.g

    def above(xp, t, q, p):
        return q[0] - p.rest * xp.sin(p.attack)

    def touchdown(xp, t, q, p):
        return -p.rest * xp.cos(p.attack), q[0], q[1], q[2]

    def length(xp, t, q, p):
        return xp.sqrt(q[0] ** 2 + q[1] ** 2) - p.rest

    def liftoff(xp, t, q, p):
        return q[1], q[2], q[3]

    return Model(
        name="spring-mass runner",
        source="Seyfarth et al., Journal of Biomechanics 35, 2002, p. 649",
        charts={
            "flight": (("y", "vx", "vy"), flight),
            "stance": (("x", "y", "vx", "vy"), stance),
        },
        events=(
            Event("touchdown", "flight", "stance", above, "falling", touchdown),
            Event("liftoff", "stance", "flight", length, "rising", liftoff),
        ),
        parameters={
            "m": 80.0,
            "k": 20e3,
            "rest": 1.0,
            "g": 9.81,
            "attack": 68 * math.pi / 180,
        },
        guesses=(
            *around("flight", (1.0, 5.0, 0.0)),
            Start("flight", (0.99, 4.9, 0.1), kind="good"),
            Start("flight", (0.5, 5.0, 0.0), kind="beyond the guard"),
            Start("stance", (0.0, 0.9, 5.0, 0.0), kind="good"),
            Start("flight", (1.0, 0.0, 0.0), kind="vertical"),
            Start("stance", (1.0, 1.0, 0.0, 0.0), kind="beyond the guard"),
            Start("flight", (0.9271838545667874, 5.0, -1.0), kind="on the guard"),
        ),
        truth="a family of cycles by energy, none isolated: must be refused",
    )


def rimless_wheel() -> Model:
    def field(xp, t, q, p):
        return q[1], xp.sin(q[0])

    return Model(
        name="rimless wheel",
        source="McGeer, International Journal of Robotics Research 9(2), 1990, p. 62",
        charts={"roll": (("angle", "rate"), field)},
        events=(
            Event(
                "forward",
                "roll",
                "roll",
                lambda xp, t, q, p: q[0] - p.slope - p.half,
                "rising",
                lambda xp, t, q, p: (q[0] - 2 * p.half, xp.cos(2 * p.half) * q[1]),
            ),
            Event(
                "backward",
                "roll",
                "roll",
                lambda xp, t, q, p: q[0] - p.slope + p.half,
                "falling",
                lambda xp, t, q, p: (q[0] + 2 * p.half, xp.cos(2 * p.half) * q[1]),
            ),
        ),
        parameters={"slope": 0.08, "half": 0.3},
        section="forward",
        guesses=(
            *around("roll", (-0.1, 0.4)),
            Start("roll", (0.0, 0.0), kind="unstable equilibrium"),
            Start("roll", (-0.22, 0.3), kind="on the guard"),
            Start("roll", (0.38 - 1e-8, 0.5), kind="1e-8 before the event"),
            Start("roll", (0.6, 0.5), kind="beyond the guard"),
            Start("roll", (0.0, -0.5), kind="backward"),
            Start("roll", (0.0, 0.1), kind="poor"),
        ),
        truth="a stable cycle with the multiplier cos(2 half)^2; slow wheels come to rest",
    )


def hopper() -> Model:
    def flight(xp, t, q, p):
        return q[1], -p.g

    def stance(stiffness):
        def field(xp, t, q, p):
            y, v = q
            return v, -p.g + stiffness(p) * (1 - y) - p.c * v

        return field

    names = ("y", "v")
    return Model(
        name="hopping leg with a thrust at the bottom",
        source="Koditschek and Buhler, International Journal of Robotics Research 10, 1991, p. 587",
        charts={
            "flight": (names, flight),
            "compression": (names, stance(lambda p: p.soft)),
            "thrust": (names, stance(lambda p: p.stiff)),
        },
        events=(
            Event(
                "touchdown",
                "flight",
                "compression",
                lambda xp, t, q, p: q[0] - 1.0,
                "falling",
            ),
            Event(
                "bottom",
                "compression",
                "thrust",
                lambda xp, t, q, p: q[1],
                "rising",
            ),
            Event(
                "liftoff",
                "thrust",
                "flight",
                lambda xp, t, q, p: q[0] - 1.0,
                "rising",
            ),
        ),
        parameters={"g": 9.81, "soft": 100.0, "stiff": 150.0, "c": 2.0},
        guesses=(
            *around("flight", (1.1, 0.2)),
            Start("thrust", (0.8, 0.5), kind="fair"),
            Start("compression", (0.9, -1.0), kind="good"),
            Start("flight", (1.0, -1.0), kind="on the guard"),
            Start("flight", (1.0 + 1e-8, -1.0), kind="1e-8 before the event"),
            Start("flight", (0.5, 0.0), kind="beyond the guard"),
            Start("compression", (0.9, 1.0), kind="beyond the guard"),
            Start("compression", (0.9019, 0.0), kind="equilibrium"),
        ),
    )


def faucet() -> Model:
    def field(xp, t, q, p):
        x, v, m = q
        return v, (m * p.g - p.k * x - p.b * v - p.flow * v) / m, p.flow

    def drop(xp, t, q, p):
        return p.back, 0.0, q[2] - p.share * q[2]

    return Model(
        name="dripping faucet",
        source="Martien, Pope, Scott and Shaw, Physics Letters A 110, 1985, p. 399",
        charts={"hang": (("x", "v", "m"), field)},
        events=(
            Event(
                "drop",
                "hang",
                "hang",
                lambda xp, t, q, p: q[0] - p.length,
                "rising",
                drop,
            ),
        ),
        parameters={
            "g": 1.0,
            "k": 1.0,
            "b": 0.8,
            "flow": 0.2,
            "length": 1.0,
            "back": 0.4,
            "share": 0.6,
        },
        guesses=(
            *around("hang", (0.5, 0.0, 0.5)),
            Start("hang", (0.4, 0.0, 0.4), kind="good"),
            Start("hang", (1.0, 0.3, 1.0), kind="on the guard"),
            Start("hang", (1.0 - 1e-8, 0.3, 1.0), kind="1e-8 before the event"),
            Start("hang", (2.0, 0.0, 1.0), kind="beyond the guard"),
            Start("hang", (0.0, 0.0, 20.0), kind="far"),
        ),
    )


def shaken_table_inelastic() -> Model:
    """A completely inelastic ball: it rests on the table until the table falls away."""

    def height(xp, t, p):
        return p.gamma / (2 * math.pi) ** 2 * xp.sin(2 * math.pi * t)

    def flight(xp, t, q, p):
        return q[1], -1.0

    def rest(xp, t, q, p):
        return (0.0 * q[0],)

    def lift(xp, t, q, p):
        return 1.0 - p.gamma * xp.sin(2 * math.pi * t)

    def leave(xp, t, q, p):
        return height(xp, t, p), p.gamma / (2 * math.pi) * xp.cos(2 * math.pi * t)

    return Model(
        name="inelastic ball on a vibrating table",
        source="Mehta and Luck, Physical Review Letters 65, 1990, p. 393",
        charts={"flight": (("y", "v"), flight), "rest": (("waiting",), rest)},
        events=(
            Event(
                "landing",
                "flight",
                "rest",
                lambda xp, t, q, p: q[0] - height(xp, t, p),
                "falling",
                lambda xp, t, q, p: (0.0,),
            ),
            Event("leaves", "rest", "flight", lift, "falling", leave, domain=False),
        ),
        parameters={"gamma": 1.5},
        clock=lambda p: 1.0,
        guesses=(
            *around("flight", (0.05, 0.1), 0.3),
            Start("rest", (0.0,), 0.0, kind="good"),
            Start("rest", (0.0,), 0.25, kind="beyond the guard"),
            Start("flight", (0.0, 0.5), 0.0, kind="on the guard"),
            Start("flight", (-1.0, 0.0), 0.0, kind="beyond the guard"),
            Start("rest", (5.0,), 0.9, kind="another value of the dummy"),
        ),
        truth="one deadbeat cycle, without multipliers",
    )


MODELS = (
    bouncing_ball(0.2, 2.4),
    bouncing_ball(0.5, 1.3),
    bouncing_ball(0.8, 0.7),
    impact_oscillator(),
    impact_oscillator_free(),
    rattle(),
    reversing_table(),
    gate_valve(),
    belt(),
    coulomb_forced(),
    rocking_block(),
    escapement(),
    kicked_pendulum(),
    slip_runner(),
    rimless_wheel(),
    hopper(),
    faucet(),
    shaken_table_inelastic(),
)
