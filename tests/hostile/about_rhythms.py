"""Hostile calls of what concerns rhythms of events, natural variability, and contacts."""

import jax.numpy as jnp

import hybridjax as hj

from .about_data import FEW, FLAG, SIGNAL
from .values import (
    CALLABLE,
    LABELS,
    NEW_NAME,
    NONNEGATIVE,
    POSITIVE,
    SEED,
    SHARE,
    Other,
    array,
    instance,
)


BEAT = hj.AtEvent("strike")


def calls(t):
    """Name, function, good arguments, hostile values of each argument."""
    charts = {"up": t.system.charts()["plane"], "down": t.system.charts()["plane"]}
    surface = lambda time, q: q[0]  # noqa: E731
    yield "sliding", hj.sliding, dict(charts=charts, surface=surface), {
        "charts": [None, 3, {}, {"a": 3, "b": 4}, {"a": charts["up"]}, Other()],
        "surface": CALLABLE, "name": NEW_NAME,
    }  # fmt: skip
    yield "coincidences", hj.orbits.coincidences, dict(cycle=t.cycle), {"cycle": instance(t.design)}
    definition = [None, "x", 3, hj.AtEvent("nope"), hj.ClockPhase(4), Other()]
    about = dict(recording=t.recording, phase=BEAT, input="f")
    wrong = {"recording": instance(t.record), "phase": definition, "input": SIGNAL}
    yield "phase_response", hj.recordings.phase_response, about, wrong
    yield "phase_response", hj.plot.phase_response, dict(found=t.beats), {
        "found": instance(t.design), "labels": LABELS,
    }  # fmt: skip
    at = dict(phase=[0.1, 0.2])
    yield "PhaseResponse", t.beats, at, {"phase": array([0.1, 0.2], free=True)}
    yield "PhaseResponse.interval", t.beats.interval, at, {
        "phase": array([0.1, 0.2], free=True), "level": SHARE,
    }  # fmt: skip
    yield "natural_multipliers", hj.recordings.natural_multipliers, dict(data=t.variability), {
        "data": instance(t.record), "order": [*FEW, 99], "seed": SEED,
    }  # fmt: skip
    natural = hj.recordings.natural_multipliers(t.variability)
    yield "NaturalMultipliers.interval", natural.interval, {}, {"level": SHARE, "plain": FLAG}
    yield "MultiplierEstimate.half_widths", t.structured.half_widths, {}, {"level": SHARE}
    yield "simulate_beats", hj.testing.simulate_beats, dict(curve=[1.0], force=jnp.ones((1, 99))), {
        "curve": array([1.0, 0.0, 0.0]), "force": array([[1.0, 0.0]]), "rate": POSITIVE,
        "rhythm": POSITIVE, "jitter": NONNEGATIVE, "seed": SEED,
    }  # fmt: skip
