"""Hostile calls of `hj.plot`."""

import numpy as np

import hybridjax as hj

from .things import PHASE
from .values import (
    AXES,
    FLAG,
    INTEGER,
    LABELS,
    LIMITED,
    NAN,
    OUTPUT,
    PATH,
    POSITIVE,
    WHOLE,
    Other,
    instance,
    optional,
)  # fmt: skip


HARMONICS = [None, "0", 0.5, (), (NAN,), ("0",), (99,), Other()]


def calls(t):
    """Name, function, good arguments, hostile values of each argument."""
    plot, htf = hj.plot, instance(t.model, t.data)
    look = {"labels": LABELS, "ax": AXES}
    one = lambda function: lambda htfs, **given: function(htfs, **given)  # noqa: E731
    drawn = [None, *OUTPUT]
    fits = ["x", 3, [3], PHASE, Other()]
    yield "plot.bode", one(plot.bode), dict(htfs=t.estimate), {
        "htfs": htf, "fits": fits, "harmonic": [*INTEGER, 9], "input": drawn,
        "outputs": [3, (), ("nope",), "nope", ("y0", "y0"), Other()],
    } | look  # fmt: skip
    families = [None, 3, "x", t.estimate, {}, {"a": 3}, {3: t.estimate}, {"a": []}, Other()]
    yield "plot.bodes", plot.bodes, dict(families={"a": t.estimate}), {
        "families": families, "fits": ["x", 3, {"a": 3}, {"nope": t.rational}, Other()],
        "harmonic": [*INTEGER, 9], "input": drawn,
    } | look  # fmt: skip
    yield "plot.harmonics", plot.harmonics, dict(families={"a": t.estimate}), {
        "families": families, "harmonics": HARMONICS, "input": drawn, "decades": POSITIVE,
    } | look  # fmt: skip
    yield "plot.magnitude", one(plot.magnitude), dict(htfs=t.estimate), {
        "htfs": htf, "output": drawn, "input": drawn, "harmonics": HARMONICS, "decades": POSITIVE,
    } | look  # fmt: skip
    yield "plot.spectrum", plot.spectrum, dict(plan=t.plan, model=t.model), {
        "plan": instance(t.design), "model": instance(t.design, t.decaying),
    } | look  # fmt: skip
    yield "plot.information", plot.information, dict(found=t.information), {
        "found": instance(t.plan),
    } | look  # fmt: skip
    yield "plot.strides", plot.strides, dict(plan=t.plan, studies={"a": t.studied}), {
        "plan": instance(t.design), "ax": AXES,
        "studies": [3, "x", {"a": 3}, {"a": t.study}, {3: t.studied}, Other()],
    }  # fmt: skip
    named = ["nope", 3, ["x"], Other()]
    yield "plot.cycle", plot.cycle, dict(cycle=t.cycle), {
        "cycle": instance(t.system), "x": named, "y": named, "sections": ["x", 3, PHASE],
        "perturbed": ["x", 3, PHASE], "numbers": optional(WHOLE),
    } | look  # fmt: skip
    yield (
        "plot.branch",
        lambda branches, **k: plot.branch(branches, **k),
        dict(branches=t.branch),
        {"branches": instance(t.cycle), "output": named} | look,
    )
    yield "plot.experiment", plot.experiment, dict(data=t.data), {
        "data": instance(t.record), "index": [*INTEGER, 10**6],
    } | look  # fmt: skip
    true = [None, "x", [NAN], {}, Other(), PHASE, t.design]
    yield "plot.multipliers", plot.multipliers, dict(true=np.array([0.5])), {
        "true": true, "estimates": ["x", 3, {"a": "x"}, {3: [0.5]}, {"a": [NAN]}, Other()],
        "zoom": FLAG,
    } | look  # fmt: skip
    yield "plot.poles_zeros", plot.poles_zeros, dict(fits={"a": t.rational}), {
        "fits": [None, "x", 3, {}, {"a": 3}, {3: t.rational}, t.rational, Other()],
    } | look  # fmt: skip
    yield "plot.impulse_responses", plot.impulse_responses, dict(found=t.found.responses), {
        "found": instance(t.found), "input": [None, "f", 9, 0.5, NAN, True],
    } | look  # fmt: skip
    yield "plot.phase", plot.phase, dict(found=t.phase), {"found": instance(PHASE), "ax": AXES}
    yield "plot.section_data", plot.section_data, dict(data=t.section_data), {
        "data": instance(t.record),
    } | look  # fmt: skip
    yield "plot.validation", plot.validation, dict(found=t.validation), {
        "found": instance(t.fit), "cycles": LIMITED,
    } | look  # fmt: skip
    yield "plot.amplitude", plot.amplitude, dict(sweep=t.sweep), {
        "sweep": instance(t.fit), "misfit": optional(POSITIVE),
    } | look  # fmt: skip
    yield "plot.save", plot.save, dict(path="figure", plot=t.plot), {
        "path": [*PATH, "nope/figure"], "plot": instance(t.fit)[:-1], "dpi": LIMITED,
    }  # fmt: skip
