"""Switching converters, fixed before the first run of hybridjax on them.

Later models get a new file. Afterwards only errors against the sources are mended here.
"""

from form import Event, Model, Start, around


CURRENT = ("i", "v")


def boost_on(xp, t, q, p):
    i, v = q
    return p.vin / p.l, -v / (p.r * p.c)


def boost_off(xp, t, q, p):
    i, v = q
    return (p.vin - v) / p.l, (i - v / p.r) / p.c


def buck_on(xp, t, q, p):
    i, v = q
    return (p.vin - v) / p.l, (i - v / p.r) / p.c


def buck_off(xp, t, q, p):
    i, v = q
    return -v / p.l, (i - v / p.r) / p.c


def buck_voltage_mode(vin: float, truth: str) -> Model:
    def ramp(xp, t, p):
        phase = t / p.beat - xp.floor(t / p.beat)
        return p.low + (p.high - p.low) * phase

    def comparator(xp, t, q, p):
        return p.gain * (q[1] - p.vref) - ramp(xp, t, p)

    def above_ramp(xp, t, q, p):
        return p.gain * (q[1] - p.vref) > p.low

    return Model(
        name=f"buck, voltage mode, Vin = {vin}",
        source="Hamill, Deane and Jefferies, IEEE Trans. Power Electronics 7, 1992, p. 25",
        charts={"off": (CURRENT, buck_off), "on": (CURRENT, buck_on)},
        events=(
            Event("on", "off", "on", comparator, "falling"),
            Event(
                "tick",
                "on",
                "off",
                enabled=above_ramp,
                schedule=lambda p: (p.beat, 0.0),
            ),
        ),
        parameters={
            "vin": vin,
            "l": 20e-3,
            "c": 47e-6,
            "r": 22.0,
            "gain": 8.4,
            "vref": 11.3,
            "low": 3.8,
            "high": 8.2,
            "beat": 400e-6,
        },
        clock=lambda p: p.beat,
        guesses=(
            *around("off", (0.55, 12.0)),
            Start("on", (0.5, 12.0), 3e-4, kind="fair"),
            Start("off", (0.0, 0.0), 0.0, kind="start-up, beyond the guard"),
            Start("on", (0.0, 0.0), 0.0, kind="start-up"),
            Start("off", (0.5, 15.0), 0.0, kind="poor"),
            Start("off", (0.55, 12.0), 2e-4, kind="another time"),
            Start("off", (0.5, 11.3 + 3.8 / 8.4), 0.0, kind="on the guard"),
        ),
        truth=truth,
    )


def boost_current_mode(iref: float, truth: str) -> Model:
    return Model(
        name=f"boost, current mode, Iref = {iref}",
        source="Deane, IEEE Trans. Circuits and Systems I 39, 1992, p. 680",
        charts={"on": (CURRENT, boost_on), "off": (CURRENT, boost_off)},
        events=(
            Event("peak", "on", "off", lambda xp, t, q, p: q[0] - p.iref, "rising"),
            Event("tick", "off", "on", schedule=lambda p: (p.beat, 0.0)),
        ),
        parameters={
            "vin": 10.0,
            "l": 1e-3,
            "c": 12e-6,
            "r": 20.0,
            "iref": iref,
            "beat": 100e-6,
        },
        clock=lambda p: p.beat,
        guesses=(
            *around("on", (iref - 0.6, 14.0)),
            Start("off", (iref, 14.0), 6e-5, kind="fair"),
            Start("on", (0.0, 0.0), 0.0, kind="start-up"),
            Start("on", (iref, 14.0), 2e-5, kind="on the guard"),
            Start("on", (iref - 1e-8, 14.0), 2e-5, kind="1e-8 before the event"),
            Start("on", (iref + 0.5, 14.0), 2e-5, kind="beyond the guard"),
            Start("off", (0.0, 30.0), 5e-5, kind="poor"),
        ),
        truth=truth,
    )


def buck_compensated() -> Model:
    """Peak current mode with slope compensation; the ramp is a state that the tick resets."""

    def with_ramp(field):
        def extended(xp, t, q, p):
            return (*field(xp, t, q[:2], p), 1.0)

        return extended

    def peak(xp, t, q, p):
        return q[0] - p.iref + p.slope * q[2]

    def tick(xp, t, q, p):
        return q[0], q[1], 0.0

    names = (*CURRENT, "ramp")
    return Model(
        name="buck, current mode with slope compensation",
        source="Erickson and Maksimovic, Fundamentals of Power Electronics, current-mode control",
        charts={"on": (names, with_ramp(buck_on)), "off": (names, with_ramp(buck_off))},
        events=(
            Event("peak", "on", "off", peak, "rising"),
            Event("tick", "off", "on", reset=tick, schedule=lambda p: (p.beat, 0.0)),
            Event(
                "late tick", "on", "on", reset=tick, schedule=lambda p: (p.beat, 0.0)
            ),
        ),
        parameters={
            "vin": 12.0,
            "l": 50e-6,
            "c": 100e-6,
            "r": 2.0,
            "iref": 5.0,
            "slope": 1e5,
            "beat": 10e-6,
        },
        clock=lambda p: p.beat,
        guesses=(
            *around("on", (3.5, 8.0, 1e-6), 1e-6),
            Start("off", (4.0, 8.0, 7e-6), 7e-6, kind="fair"),
            Start("on", (0.0, 0.0, 0.0), 0.0, kind="start-up"),
            Start("on", (5.0, 8.0, 0.0), 0.0, kind="on the guard"),
            Start("on", (6.0, 8.0, 0.0), 0.0, kind="beyond the guard"),
            Start("off", (4.0, 8.0, 3e-5), 0.0, kind="ramp out of step"),
        ),
    )


def buck_duty_one() -> Model:
    """The input is too low for the reference: the comparator does not act, the switch stays on."""

    return Model(
        name="buck, current mode, duty 1",
        source="Erickson and Maksimovic, Fundamentals of Power Electronics, current-mode control",
        charts={"on": (CURRENT, buck_on), "off": (CURRENT, buck_off)},
        events=(
            Event("peak", "on", "off", lambda xp, t, q, p: q[0] - p.iref, "rising"),
            Event("tick", "off", "on", schedule=lambda p: (p.beat, 0.0)),
        ),
        parameters={
            "vin": 8.0,
            "l": 50e-6,
            "c": 100e-6,
            "r": 2.0,
            "iref": 5.0,
            "beat": 10e-6,
        },
        clock=lambda p: p.beat,
        guesses=(
            *around("on", (3.9, 7.9)),
            Start("off", (4.5, 8.0), 7e-6, kind="poor"),
            Start("on", (4.0, 8.0), 0.0, kind="equilibrium"),
            Start("on", (5.0 - 1e-8, 5.0), 0.0, kind="1e-8 before the event"),
            Start("on", (6.0, 8.0), 0.0, kind="beyond the guard"),
        ),
        truth="no switching: the motion ends at the equilibrium of the closed switch",
    )


def pwm_with_duty(duty: float, truth: str) -> Model:
    return Model(
        name=f"buck, open loop, duty {duty}",
        source="Erickson and Maksimovic, Fundamentals of Power Electronics, Ch. 2",
        charts={"on": (CURRENT, buck_on), "off": (CURRENT, buck_off)},
        events=(
            Event(
                "open",
                "on",
                "off",
                schedule=lambda p: (p.beat, p.duty * p.beat),
            ),
            Event("close", "off", "on", schedule=lambda p: (p.beat, 0.0)),
        ),
        parameters={
            "vin": 12.0,
            "l": 50e-6,
            "c": 100e-6,
            "r": 2.0,
            "beat": 10e-6,
            "duty": duty,
        },
        clock=lambda p: p.beat,
        guesses=(
            *around("on", (3.0, 6.0), 1e-6),
            Start("off", (3.0, 6.0), 7e-6, kind="fair"),
            Start("on", (3.0, 6.0), 0.0, kind="at the tick"),
            Start("on", (3.0, 6.0), 9e-6, kind="wrong chart"),
            Start("off", (0.0, 0.0), 0.0, kind="start-up"),
        ),
        truth=truth,
    )


def buck_duty_zero() -> Model:
    """Every current of interest is above the reference when the switch closes."""

    return Model(
        name="buck, comparator on at the tick, duty 0",
        source="Erickson and Maksimovic, Fundamentals of Power Electronics, current-mode control",
        charts={"on": (CURRENT, buck_on), "off": (CURRENT, buck_off)},
        events=(
            Event("peak", "on", "off", lambda xp, t, q, p: q[0] - p.iref, "rising"),
            Event("tick", "off", "on", schedule=lambda p: (p.beat, 0.0)),
        ),
        parameters={
            "vin": 12.0,
            "l": 50e-6,
            "c": 100e-6,
            "r": 2.0,
            "iref": -1.0,
            "beat": 10e-6,
        },
        clock=lambda p: p.beat,
        guesses=(
            *around("on", (3.0, 6.0), 1e-6),
            Start("off", (0.5, 1.0), 5e-6, kind="poor"),
            Start("off", (0.0, 0.0), 5e-6, kind="equilibrium of the open switch"),
            Start("on", (-1.0 - 1e-8, 0.0), 1e-6, kind="1e-8 before the event"),
            Start("on", (6.0, 12.0), 1e-6, kind="equilibrium beyond the guard"),
        ),
        truth="at rest: the comparator opens the switch at once at each tick",
    )


def hysteretic_buck() -> Model:
    def output(xp, q, p):
        i, v = q
        return v + p.esr * (i - v / p.r)

    def field(closed):
        def rates(xp, t, q, p):
            i, v = q
            return (closed * p.vin - output(xp, q, p)) / p.l, (i - v / p.r) / p.c

        return rates

    return Model(
        name="buck, hysteretic",
        source="Texas Instruments, application report SLVA301 (hysteretic buck converters)",
        charts={"on": (CURRENT, field(1.0)), "off": (CURRENT, field(0.0))},
        events=(
            Event(
                "open",
                "on",
                "off",
                lambda xp, t, q, p: output(xp, q, p) - p.vref - p.width,
                "rising",
            ),
            Event(
                "close",
                "off",
                "on",
                lambda xp, t, q, p: output(xp, q, p) - p.vref + p.width,
                "falling",
            ),
        ),
        parameters={
            "vin": 12.0,
            "l": 10e-6,
            "c": 100e-6,
            "r": 1.0,
            "esr": 0.05,
            "vref": 3.3,
            "width": 0.02,
        },
        guesses=(
            *around("on", (3.3, 3.3)),
            Start("off", (3.5, 3.3), kind="good"),
            Start("on", (0.0, 0.0), kind="start-up"),
            Start("on", (12.0, 12.0), kind="equilibrium beyond the guard"),
            Start("off", (0.0, 0.0), kind="equilibrium beyond the guard"),
            Start("on", (3.7, 3.3 - 1e-8), kind="1e-8 before the event"),
            Start("off", (3.0, 3.4), kind="poor"),
        ),
    )


def boost_dcm() -> Model:
    def idle(xp, t, q, p):
        return (-q[0] / (p.r * p.c),)

    return Model(
        name="boost, discontinuous conduction",
        source="Erickson and Maksimovic, Fundamentals of Power Electronics, Ch. 5",
        charts={
            "on": (CURRENT, boost_on),
            "off": (CURRENT, boost_off),
            "idle": (("v",), idle),
        },
        events=(
            Event(
                "open",
                "on",
                "off",
                schedule=lambda p: (p.beat, p.duty * p.beat),
            ),
            Event(
                "empty",
                "off",
                "idle",
                lambda xp, t, q, p: q[0],
                "falling",
                lambda xp, t, q, p: (q[1],),
            ),
            Event("close", "off", "on", schedule=lambda p: (p.beat, 0.0)),
            Event(
                "close from idle",
                "idle",
                "on",
                reset=lambda xp, t, q, p: (0.0, q[0]),
                schedule=lambda p: (p.beat, 0.0),
            ),
        ),
        parameters={
            "vin": 10.0,
            "l": 20e-6,
            "c": 20e-6,
            "r": 100.0,
            "beat": 20e-6,
            "duty": 0.4,
        },
        clock=lambda p: p.beat,
        guesses=(
            *around("on", (0.5, 25.0), 1e-6),
            Start("idle", (25.0,), 1.9e-5, kind="good"),
            Start("off", (2.0, 20.0), 1e-5, kind="fair"),
            Start("idle", (0.0,), 1.9e-5, kind="poor"),
            Start("off", (-1.0, 20.0), 1e-5, kind="beyond the guard"),
            Start("off", (1e-8, 25.0), 1e-5, kind="1e-8 before the event"),
        ),
    )


def boost_ccm() -> Model:
    return Model(
        name="boost, continuous conduction, open loop",
        source="Erickson and Maksimovic, Fundamentals of Power Electronics, Ch. 2",
        charts={"on": (CURRENT, boost_on), "off": (CURRENT, boost_off)},
        events=(
            Event("open", "on", "off", schedule=lambda p: (p.beat, p.duty * p.beat)),
            Event("close", "off", "on", schedule=lambda p: (p.beat, 0.0)),
        ),
        parameters={
            "vin": 10.0,
            "l": 200e-6,
            "c": 20e-6,
            "r": 10.0,
            "beat": 20e-6,
            "duty": 0.4,
        },
        clock=lambda p: p.beat,
        guesses=(
            *around("on", (2.5, 16.0), 1e-6),
            Start("off", (2.8, 16.0), 1e-5, kind="good"),
            Start("off", (2.8, 16.0), 2e-6, kind="wrong chart"),
            Start("on", (0.0, 0.0), 0.0, kind="start-up"),
            Start("on", (2.5, 16.0), 8e-6, kind="at the opening"),
        ),
    )


def buck_dead_time() -> Model:
    def diode(xp, t, q, p):
        i, v = q
        return (-v - p.drop) / p.l, (i - v / p.r) / p.c

    def event(name, source, target, share):
        return Event(
            name,
            source,
            target,
            schedule=lambda p: (p.beat, share(p) * p.beat),
        )

    return Model(
        name="synchronous buck, dead times of 1e-7 of the period",
        source="Erickson and Maksimovic, Fundamentals of Power Electronics, Ch. 4",
        charts={
            "high": (CURRENT, buck_on),
            "dead 1": (CURRENT, diode),
            "low": (CURRENT, buck_off),
            "dead 2": (CURRENT, diode),
        },
        events=(
            event("high off", "high", "dead 1", lambda p: p.duty),
            event("low on", "dead 1", "low", lambda p: p.duty + p.dead),
            event("low off", "low", "dead 2", lambda p: 1 - p.dead),
            event("high on", "dead 2", "high", lambda p: 0.0),
        ),
        parameters={
            "vin": 12.0,
            "l": 50e-6,
            "c": 100e-6,
            "r": 2.0,
            "beat": 10e-6,
            "duty": 0.3,
            "dead": 1e-7,
            "drop": 0.7,
        },
        clock=lambda p: p.beat,
        guesses=(
            *around("high", (1.8, 3.6), 1e-6),
            Start("low", (1.8, 3.6), 7e-6, kind="good"),
            Start("dead 1", (1.8, 3.6), 3e-6, kind="at the event"),
            Start("dead 2", (1.8, 3.6), 10e-6 - 5e-13, kind="inside of a dead time"),
            Start("high", (0.0, 0.0), 0.0, kind="start-up, at the tick"),
        ),
    )


def cuk() -> Model:
    def on(xp, t, q, p):
        i1, v1, i2, v2 = q
        return p.vin / p.l1, -i2 / p.c1, (v1 - v2) / p.l2, (i2 - v2 / p.r) / p.c2

    def off(xp, t, q, p):
        i1, v1, i2, v2 = q
        return (p.vin - v1) / p.l1, i1 / p.c1, -v2 / p.l2, (i2 - v2 / p.r) / p.c2

    names = ("i1", "v1", "i2", "v2")
    return Model(
        name="Cuk, open loop",
        source="Middlebrook and Cuk, IEEE Power Electronics Specialists Conference 1976, p. 18",
        charts={"on": (names, on), "off": (names, off)},
        events=(
            Event("open", "on", "off", schedule=lambda p: (p.beat, p.duty * p.beat)),
            Event("close", "off", "on", schedule=lambda p: (p.beat, 0.0)),
        ),
        parameters={
            "vin": 10.0,
            "l1": 1e-3,
            "c1": 10e-6,
            "l2": 1e-3,
            "c2": 10e-6,
            "r": 20.0,
            "beat": 50e-6,
            "duty": 0.5,
        },
        clock=lambda p: p.beat,
        guesses=(
            *around("on", (0.5, 20.0, 0.5, 10.0), 1e-6),
            Start("off", (0.5, 20.0, 0.5, 10.0), 3e-5, kind="good"),
            Start("on", (0.0, 0.0, 0.0, 0.0), 0.0, kind="start-up"),
            Start("on", (0.5, 20.0, 0.5, 10.0), 2.5e-5, kind="at the opening"),
            Start("off", (10.0, 0.0, -10.0, 100.0), 1e-6, kind="far, wrong chart"),
        ),
    )


def inverter_sampled() -> Model:
    """An H-bridge whose duty is computed from the sampled current at every tick."""

    def bridge(sign):
        def field(xp, t, q, p):
            return (sign * p.vin - p.r * q[0]) / p.l, 1.0 / p.beat, 0.0

        return field

    def sample(xp, t, q, p):
        duty = xp.clip(0.5 + p.gain * (p.iref - q[0]), 0.05, 0.95)
        return q[0], 0.0, duty

    names = ("i", "phase", "duty")
    return Model(
        name="H-bridge with sampled current control",
        source="Robert and Robert, IEEE Trans. Circuits and Systems I 49, 2002, p. 1088",
        charts={"plus": (names, bridge(1.0)), "minus": (names, bridge(-1.0))},
        events=(
            Event("switch", "plus", "minus", lambda xp, t, q, p: q[1] - q[2], "rising"),
            Event(
                "tick",
                "minus",
                "plus",
                reset=sample,
                schedule=lambda p: (p.beat, 0.0),
            ),
        ),
        parameters={
            "vin": 130.0,
            "r": 10.0,
            "l": 20e-3,
            "beat": 500e-6,
            "gain": 0.15,
            "iref": 5.0,
        },
        clock=lambda p: p.beat,
        guesses=(
            *around("plus", (4.5, 0.1, 0.6), 5e-5),
            Start("minus", (5.0, 0.8, 0.6), 4e-4, kind="fair"),
            Start("plus", (0.0, 0.0, 0.5), 0.0, kind="start-up, at the tick"),
            Start("plus", (5.0, 0.6, 0.6), 3e-4, kind="on the guard"),
            Start("plus", (5.0, 0.9, 0.6), 4.5e-4, kind="beyond the guard"),
            Start("plus", (5.0, 0.5, 0.6), 0.0, kind="phase out of step"),
        ),
    )


MODELS = (
    buck_voltage_mode(20.0, "one stable cycle"),
    buck_voltage_mode(24.0, "one stable cycle near a period doubling"),
    buck_voltage_mode(30.0, "a stable cycle of two periods, unstable one of one"),
    boost_current_mode(1.5, "one stable cycle"),
    boost_current_mode(3.5, "an unstable cycle of one period, subharmonics"),
    buck_compensated(),
    buck_duty_one(),
    pwm_with_duty(0.5, "one stable cycle"),
    pwm_with_duty(1.0, "opening and closing coincide: must be refused"),
    pwm_with_duty(0.0, "opening and closing coincide: must be refused"),
    buck_duty_zero(),
    hysteretic_buck(),
    boost_dcm(),
    boost_ccm(),
    buck_dead_time(),
    cuk(),
    inverter_sampled(),
)
