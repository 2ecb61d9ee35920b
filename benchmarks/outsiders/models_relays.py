"""Relays and hysteresis, fixed before the first run of hybridjax on them.

Later models get a new file. Afterwards only errors against the sources are mended here.
"""

import math

from form import Event, Model, Start, around


def schmitt_trigger() -> Model:
    def charging(xp, t, q, p):
        return ((p.supply - q[0]) / p.rc,)

    def discharging(xp, t, q, p):
        return ((-p.supply - q[0]) / p.rc,)

    return Model(
        name="Schmitt trigger with RC",
        source="Sedra and Smith, Microelectronic Circuits, astable multivibrator",
        charts={"high": (("v",), charging), "low": (("v",), discharging)},
        events=(
            Event("top", "high", "low", lambda xp, t, q, p: q[0] - p.level, "rising"),
            Event(
                "bottom", "low", "high", lambda xp, t, q, p: q[0] + p.level, "falling"
            ),
        ),
        parameters={"supply": 12.0, "rc": 1e-4, "level": 6.0},
        guesses=(
            *around("high", (1.0,)),
            Start("high", (8.0,), kind="beyond the guard"),
            Start("low", (-9.0,), kind="beyond the guard"),
            Start("high", (6.0,), kind="on the guard"),
            Start("high", (6.0 - 1e-8,), kind="1e-8 before the event"),
            Start("high", (12.0,), kind="equilibrium beyond the guard"),
            Start("low", (40.0,), kind="far"),
        ),
        truth="one stable cycle of period 2 RC ln 3",
    )


def schmitt_clocked() -> Model:
    def threshold(xp, t, p):
        return p.level + p.swing * xp.sin(2 * math.pi * t / p.beat)

    def charging(xp, t, q, p):
        return (p.supply - q[0],)

    def discharging(xp, t, q, p):
        return (-p.supply - q[0],)

    def top(xp, t, q, p):
        return q[0] - threshold(xp, t, p)

    def bottom(xp, t, q, p):
        return q[0] + threshold(xp, t, p)

    return Model(
        name="Schmitt trigger with moving thresholds",
        source="Horowitz and Hill, The Art of Electronics, 2015, Ch. 7 (synchronized oscillators)",
        charts={"high": (("v",), charging), "low": (("v",), discharging)},
        events=(
            Event("top", "high", "low", top, "rising"),
            Event("bottom", "low", "high", bottom, "falling"),
        ),
        parameters={"supply": 12.0, "level": 6.0, "swing": 1.5, "beat": 2.2},
        clock=lambda p: p.beat,
        guesses=(
            *around("high", (1.0,)),
            Start("high", (1.0,), 1.1, kind="another time"),
            Start("low", (1.0,), 0.0, kind="poor"),
            Start("high", (7.0,), 0.0, kind="beyond the guard"),
            Start("low", (-11.0,), 0.5, kind="beyond the guard"),
            Start("high", (6.0,), 0.0, kind="on the guard"),
            Start("high", (6.0 - 1e-8,), 0.0, kind="1e-8 before the event"),
            Start("high", (12.0,), 0.0, kind="equilibrium beyond the guard"),
        ),
    )


def relay_first_order() -> Model:
    def raised(xp, t, q, p):
        return ((p.gain - q[0]) / p.tau,)

    def lowered(xp, t, q, p):
        return ((-p.gain - q[0]) / p.tau,)

    return Model(
        name="relay with hysteresis, first order",
        source="Astrom and Hagglund, Automatica 20, 1984, p. 645",
        charts={"plus": (("y",), raised), "minus": (("y",), lowered)},
        events=(
            Event("off", "plus", "minus", lambda xp, t, q, p: q[0] - p.width, "rising"),
            Event("on", "minus", "plus", lambda xp, t, q, p: q[0] + p.width, "falling"),
        ),
        parameters={"gain": 1.0, "tau": 3.0, "width": 0.05},
        section="off",
        guesses=(
            *around("plus", (-0.02,)),
            Start("plus", (0.06,), kind="beyond the guard"),
            Start("plus", (0.05,), kind="on the guard"),
            Start("minus", (0.9,), kind="poor"),
            Start("minus", (-0.5,), kind="beyond the guard"),
            Start("minus", (-1.0,), kind="equilibrium beyond the guard"),
        ),
    )


def relay_second_order() -> Model:
    def plant(sign):
        def field(xp, t, q, p):
            x, y = q
            return (sign * p.gain - x) / p.tau, x - y

        return field

    return Model(
        name="relay with hysteresis, second order",
        source="Astrom, Oscillations in systems with relay feedback, 1995",
        charts={"plus": (("x", "y"), plant(1)), "minus": (("x", "y"), plant(-1))},
        events=(
            Event("off", "plus", "minus", lambda xp, t, q, p: q[1] - p.width, "rising"),
            Event("on", "minus", "plus", lambda xp, t, q, p: q[1] + p.width, "falling"),
        ),
        parameters={"gain": 1.0, "tau": 2.0, "width": 0.1},
        guesses=(
            *around("plus", (-0.2, -0.1)),
            Start("plus", (1.0, 1.0), kind="equilibrium beyond the guard"),
            Start(
                "plus", (0.0, 0.1 - 1e-8), kind="1e-8 before the guard, away from it"
            ),
            Start("plus", (0.0, 0.1), kind="on the guard"),
            Start("plus", (0.5, 0.1 - 1e-8), kind="1e-8 before the event"),
            Start("minus", (0.0, 0.0), kind="poor"),
            Start("minus", (-1.0, -0.3), kind="beyond the guard"),
        ),
    )


def relay_third_order() -> Model:
    def plant(sign):
        def field(xp, t, q, p):
            x, y, z = q
            return -x - sign * p.gain, x - y, y - z

        return field

    return Model(
        name="ideal relay, third order",
        source="Astrom, Oscillations in systems with relay feedback, 1995",
        charts={
            "above": (("x", "y", "z"), plant(1)),
            "below": (("x", "y", "z"), plant(-1)),
        },
        events=(
            Event("fall", "above", "below", lambda xp, t, q, p: q[2], "falling"),
            Event("rise", "below", "above", lambda xp, t, q, p: q[2], "rising"),
        ),
        parameters={"gain": 1.0},
        guesses=(
            *around("above", (0.3, 0.3, 0.05)),
            Start("above", (0.0, 0.0, 0.0), kind="on the guard, at the center"),
            Start("above", (-1.0, -1.0, -1.0), kind="equilibrium beyond the guard"),
            Start("above", (0.0, -0.2, 1e-8), kind="1e-8 before the event"),
            Start("below", (0.0, 0.0, 0.5), kind="beyond the guard"),
            Start("below", (0.0, 0.0, -0.5), kind="poor"),
        ),
    )


def relay_double_integrator() -> Model:
    def push(sign):
        def field(xp, t, q, p):
            return q[1], -sign * p.force

        return field

    return Model(
        name="bang-bang position control without damping",
        source="Ogata, Modern Control Engineering, on-off control",
        charts={"right": (("x", "v"), push(1)), "left": (("x", "v"), push(-1))},
        events=(
            Event("to left", "right", "left", lambda xp, t, q, p: q[0], "falling"),
            Event("to right", "left", "right", lambda xp, t, q, p: q[0], "rising"),
        ),
        parameters={"force": 1.0},
        guesses=(
            *around("right", (0.5, 0.3)),
            Start("right", (0.0, 0.0), kind="equilibrium"),
            Start("right", (0.0, 1.0), kind="on the guard"),
            Start("left", (1.0, 0.0), kind="beyond the guard"),
            Start("right", (1e-8, -1.0), kind="1e-8 before the event"),
        ),
        truth="a family of cycles, none isolated: must be refused",
    )


def bang_bang_damped() -> Model:
    def push(sign):
        def field(xp, t, q, p):
            return q[1], -sign * p.force - p.c * q[1]

        return field

    return Model(
        name="bang-bang position control with hysteresis",
        source="Gelb and Vander Velde, Multiple-Input Describing Functions, 1968, Ch. 3",
        charts={"push": (("x", "v"), push(1)), "pull": (("x", "v"), push(-1))},
        events=(
            Event("low", "push", "pull", lambda xp, t, q, p: q[0] + p.width, "falling"),
            Event("high", "pull", "push", lambda xp, t, q, p: q[0] - p.width, "rising"),
        ),
        parameters={"force": 1.0, "c": 0.4, "width": 0.1},
        guesses=(
            *around("push", (0.5, 0.3)),
            Start("push", (-0.1, 0.5), kind="on the guard"),
            Start("pull", (0.0, 0.0), kind="poor"),
            Start("pull", (0.1 - 1e-8, 1.0), kind="1e-8 before the event"),
            Start("push", (-3.0, -1.0), kind="beyond the guard"),
            Start("push", (0.0, -2.5), kind="equilibrium of the speed"),
        ),
    )


def thermostat() -> Model:
    def heating(xp, t, q, p):
        room, heater = q
        return p.a * (heater - room) - p.loss * (room - p.outside), p.b * (
            p.hot - heater
        )

    def cooling(xp, t, q, p):
        room, heater = q
        return p.a * (heater - room) - p.loss * (room - p.outside), p.b * (
            room - heater
        )

    names = ("room", "heater")
    return Model(
        name="thermostat with a heater that lags",
        source="Alur et al., Theoretical Computer Science 138, 1995, p. 3 (thermostat)",
        charts={"on": (names, heating), "off": (names, cooling)},
        events=(
            Event("off", "on", "off", lambda xp, t, q, p: q[0] - p.upper, "rising"),
            Event("on", "off", "on", lambda xp, t, q, p: q[0] - p.lower, "falling"),
        ),
        parameters={
            "a": 0.5,
            "b": 0.3,
            "loss": 0.1,
            "hot": 60.0,
            "outside": 5.0,
            "lower": 19.0,
            "upper": 21.0,
        },
        section="on",
        guesses=(
            *around("on", (20.0, 30.0)),
            Start("off", (25.0, 25.0), kind="fair"),
            Start("on", (22.0, 30.0), kind="beyond the guard"),
            Start("off", (18.0, 18.0), kind="beyond the guard"),
            Start("on", (19.0, 20.0), kind="poor"),
            Start("off", (5.0, 5.0), kind="equilibrium beyond the guard"),
            Start("off", (19.0 + 1e-8, 19.0), kind="1e-8 before the event"),
        ),
    )


def level_control() -> Model:
    def pumping(xp, t, q, p):
        return (p.inflow - p.a * xp.sqrt(xp.maximum(q[0], 1e-9)),)

    def draining(xp, t, q, p):
        return (-p.a * xp.sqrt(xp.maximum(q[0], 1e-9)),)

    return Model(
        name="on-off level control of a tank",
        source="Franklin, Powell and Emami-Naeini, Feedback Control of Dynamic Systems, tank",
        charts={"pump": (("h",), pumping), "drain": (("h",), draining)},
        events=(
            Event(
                "full", "pump", "drain", lambda xp, t, q, p: q[0] - p.upper, "rising"
            ),
            Event(
                "low", "drain", "pump", lambda xp, t, q, p: q[0] - p.lower, "falling"
            ),
        ),
        parameters={"inflow": 2.0, "a": 1.0, "upper": 3.0, "lower": 1.0},
        guesses=(
            *around("pump", (2.0,)),
            Start("pump", (4.0,), kind="equilibrium beyond the guard"),
            Start("pump", (3.5,), kind="beyond the guard"),
            Start("drain", (0.5,), kind="beyond the guard"),
            Start("drain", (1.0,), kind="on the guard"),
            Start("drain", (1.0 + 1e-8,), kind="1e-8 before the event"),
        ),
    )


def level_control_unreachable() -> Model:
    def pumping(xp, t, q, p):
        return (p.inflow - p.a * xp.sqrt(xp.maximum(q[0], 1e-9)),)

    def draining(xp, t, q, p):
        return (-p.a * xp.sqrt(xp.maximum(q[0], 1e-9)),)

    return Model(
        name="level control whose upper switch is never reached",
        source="Franklin, Powell and Emami-Naeini, Feedback Control of Dynamic Systems, tank",
        charts={"pump": (("h",), pumping), "drain": (("h",), draining)},
        events=(
            Event(
                "full", "pump", "drain", lambda xp, t, q, p: q[0] - p.upper, "rising"
            ),
            Event(
                "low", "drain", "pump", lambda xp, t, q, p: q[0] - p.lower, "falling"
            ),
        ),
        parameters={"inflow": 1.5, "a": 1.0, "upper": 3.0, "lower": 1.0},
        guesses=(
            *around("pump", (2.0,)),
            Start("pump", (2.25,), kind="equilibrium"),
            Start("drain", (2.9,), kind="poor"),
            Start("drain", (1.0 + 1e-8,), kind="1e-8 before the event"),
        ),
        truth="no cycle: the pump runs for ever",
    )


def timer_555() -> Model:
    def charging(xp, t, q, p):
        return ((p.supply - q[0]) / ((p.ra + p.rb) * p.c),)

    def discharging(xp, t, q, p):
        return (-q[0] / (p.rb * p.c),)

    return Model(
        name="555 timer, astable",
        source="Texas Instruments, NE555 data sheet, astable operation",
        charts={"charge": (("v",), charging), "discharge": (("v",), discharging)},
        events=(
            Event(
                "threshold",
                "charge",
                "discharge",
                lambda xp, t, q, p: q[0] - 2 * p.supply / 3,
                "rising",
            ),
            Event(
                "trigger",
                "discharge",
                "charge",
                lambda xp, t, q, p: q[0] - p.supply / 3,
                "falling",
            ),
        ),
        parameters={"supply": 5.0, "ra": 1e3, "rb": 2e3, "c": 1e-8},
        guesses=(
            *around("charge", (2.0,)),
            Start("discharge", (3.0,), kind="fair"),
            Start("charge", (4.0,), kind="beyond the guard"),
            Start("charge", (5.0,), kind="equilibrium beyond the guard"),
            Start("discharge", (0.5,), kind="beyond the guard"),
            Start("discharge", (0.0,), kind="equilibrium beyond the guard"),
        ),
        truth="one stable cycle of period ln 2 (RA + 2 RB) C",
    )


def timer_555_modulated() -> Model:
    def control(xp, t, p):
        return 2 * p.supply / 3 * (1 + p.depth * xp.sin(2 * math.pi * t / p.beat))

    def charging(xp, t, q, p):
        return ((p.supply - q[0]) / ((p.ra + p.rb) * p.c),)

    def discharging(xp, t, q, p):
        return (-q[0] / (p.rb * p.c),)

    def threshold(xp, t, q, p):
        return q[0] - control(xp, t, p)

    def trigger(xp, t, q, p):
        return q[0] - control(xp, t, p) / 2

    return Model(
        name="555 timer, control voltage modulated",
        source="Texas Instruments, NE555 data sheet, pulse-position modulation",
        charts={"charge": (("v",), charging), "discharge": (("v",), discharging)},
        events=(
            Event("threshold", "charge", "discharge", threshold, "rising"),
            Event("trigger", "discharge", "charge", trigger, "falling"),
        ),
        parameters={
            "supply": 5.0,
            "ra": 1e3,
            "rb": 2e3,
            "c": 1e-8,
            "depth": 0.2,
            "beat": 3.5e-5,
        },
        clock=lambda p: p.beat,
        guesses=(
            *around("charge", (2.0,)),
            Start("discharge", (3.0,), kind="fair"),
            Start("charge", (2.0,), 2e-5, kind="another time"),
            Start("charge", (4.5,), kind="beyond the guard"),
            Start("discharge", (0.5,), kind="beyond the guard"),
            Start("charge", (5.0,), 1.0, kind="equilibrium beyond the guard"),
        ),
    )


def relay_with_delay() -> Model:
    """A heater whose relay acts a fixed time after the thermostat asks."""

    def warm(xp, t, q, p):
        return p.power - p.loss * q[0], 0.0

    def cool(xp, t, q, p):
        return -p.loss * q[0], 0.0

    def warm_counting(xp, t, q, p):
        return p.power - p.loss * q[0], 1.0

    def cool_counting(xp, t, q, p):
        return -p.loss * q[0], 1.0

    def start(xp, t, q, p):
        return q[0], 0.0

    names = ("T", "timer")
    return Model(
        name="on-off control with a dead time",
        source="Tsypkin, Relay Control Systems, 1984, delay in the plant",
        charts={
            "warm": (names, warm),
            "asked off": (names, warm_counting),
            "cool": (names, cool),
            "asked on": (names, cool_counting),
        },
        events=(
            Event(
                "ask off",
                "warm",
                "asked off",
                lambda xp, t, q, p: q[0] - p.set,
                "rising",
                start,
            ),
            Event(
                "off",
                "asked off",
                "cool",
                lambda xp, t, q, p: q[1] - p.delay,
                "rising",
                start,
            ),
            Event(
                "ask on",
                "cool",
                "asked on",
                lambda xp, t, q, p: q[0] - p.set,
                "falling",
                start,
            ),
            Event(
                "on",
                "asked on",
                "warm",
                lambda xp, t, q, p: q[1] - p.delay,
                "rising",
                start,
            ),
        ),
        parameters={"power": 2.0, "loss": 0.7, "set": 1.0, "delay": 0.3},
        guesses=(
            *around("warm", (0.8, 0.0)),
            Start("asked off", (1.1, 0.1), kind="fair"),
            Start("asked off", (1.1, 0.5), kind="beyond the guard"),
            Start("cool", (0.9, 0.0), kind="beyond the guard"),
            Start("warm", (1.0, 0.0), kind="on the guard"),
            Start("warm", (1.0 - 1e-8, 0.0), kind="1e-8 before the event"),
            Start("warm", (2.0 / 0.7, 0.0), kind="equilibrium beyond the guard"),
        ),
    )


def attitude() -> Model:
    """Thrusters with a dead band, hysteresis and a constant torque by the sun."""

    def drift(torque):
        def field(xp, t, q, p):
            return q[1], torque * p.thrust + p.sun

        return field

    def line(xp, q, p):
        return q[0] + p.lead * q[1]

    names = ("angle", "rate")
    return Model(
        name="spacecraft attitude with a dead band",
        source="Sidi, Spacecraft Dynamics and Control, 1997, Ch. 9",
        charts={
            "coast": (names, drift(0)),
            "positive": (names, drift(1)),
            "negative": (names, drift(-1)),
        },
        events=(
            Event(
                "fire positive",
                "coast",
                "positive",
                lambda xp, t, q, p: line(xp, q, p) + p.band,
                "falling",
            ),
            Event(
                "stop positive",
                "positive",
                "coast",
                lambda xp, t, q, p: line(xp, q, p) + p.band - p.width,
                "rising",
            ),
            Event(
                "fire negative",
                "coast",
                "negative",
                lambda xp, t, q, p: line(xp, q, p) - p.band,
                "rising",
            ),
            Event(
                "stop negative",
                "negative",
                "coast",
                lambda xp, t, q, p: line(xp, q, p) - p.band + p.width,
                "falling",
            ),
        ),
        parameters={"thrust": 1.0, "sun": 0.05, "lead": 0.5, "band": 1.0, "width": 0.1},
        guesses=(
            *around("coast", (0.9, -0.1)),
            Start("coast", (0.0, 0.0), kind="poor"),
            Start("negative", (0.95, 0.1), kind="fair"),
            Start("coast", (2.0, 0.0), kind="beyond the guard"),
            Start("coast", (1.0 - 1e-8, 0.0), kind="1e-8 before the event"),
            Start("coast", (0.0, 1.5), kind="the other side"),
            Start("positive", (0.0, 0.0), kind="beyond the guard"),
        ),
    )


def sliding_relay() -> Model:
    def pushed(sign):
        def field(xp, t, q, p):
            return (-sign * p.force,)

        return field

    return Model(
        name="relay without hysteresis, first order",
        source="Filippov, Differential Equations with Discontinuous Righthand Sides, 1988",
        charts={"above": (("x",), pushed(1)), "below": (("x",), pushed(-1))},
        events=(
            Event("fall", "above", "below", lambda xp, t, q, p: q[0], "falling"),
            Event("rise", "below", "above", lambda xp, t, q, p: q[0], "rising"),
        ),
        parameters={"force": 1.0},
        guesses=(
            *around("above", (1.0,)),
            Start("above", (0.0,), kind="on the guard"),
            Start("above", (1e-8,), kind="1e-8 before the event"),
            Start("below", (3.0,), kind="beyond the guard"),
        ),
        truth="no cycle: the motion ends in sliding",
    )


def sleep() -> Model:
    """The two-process model: sleep pressure between thresholds that move with the day."""

    def rhythm(xp, t, p):
        return p.amplitude * xp.sin(2 * math.pi * t / 24)

    def awake(xp, t, q, p):
        return ((1 - q[0]) / p.rise,)

    def asleep(xp, t, q, p):
        return (-q[0] / p.fall,)

    def tired(xp, t, q, p):
        return q[0] - p.upper - rhythm(xp, t, p)

    def rested(xp, t, q, p):
        return q[0] - p.lower - rhythm(xp, t, p)

    return Model(
        name="sleep, two-process model",
        source="Daan, Beersma and Borbely, American Journal of Physiology 246, 1984, p. R161",
        charts={"awake": (("pressure",), awake), "asleep": (("pressure",), asleep)},
        events=(
            Event("fall asleep", "awake", "asleep", tired, "rising"),
            Event("wake up", "asleep", "awake", rested, "falling"),
        ),
        parameters={
            "rise": 18.2,
            "fall": 4.2,
            "upper": 0.67,
            "lower": 0.17,
            "amplitude": 0.1,
        },
        clock=lambda p: 24.0,
        guesses=(
            *around("awake", (0.4,)),
            Start("asleep", (0.5,), 0.0, kind="poor"),
            Start("awake", (0.9,), 0.0, kind="beyond the guard"),
            Start("awake", (0.67,), 0.0, kind="on the guard"),
            Start("awake", (0.2,), 7.0, kind="fair"),
            Start("asleep", (0.05,), 12.0, kind="beyond the guard"),
            Start("awake", (0.4,), 2400.0, kind="late"),
        ),
    )


MODELS = (
    schmitt_trigger(),
    schmitt_clocked(),
    relay_first_order(),
    relay_second_order(),
    relay_third_order(),
    relay_double_integrator(),
    bang_bang_damped(),
    thermostat(),
    level_control(),
    level_control_unreachable(),
    timer_555(),
    timer_555_modulated(),
    relay_with_delay(),
    attitude(),
    sliding_relay(),
    sleep(),
)
