"""Hostile calls of what concerns estimates, fits, recordings and files."""

import numpy as np

import hybridjax as hj

from .things import NAMES as STATES, PHASE
from .values import (
    CALLABLE,
    COUNT,
    FINITE,
    FLAG,
    HARMONICS,
    HUGE,
    INF,
    INTEGER,
    LIMITED,
    NAME,
    NAMES,
    NAN,
    NEW_NAME,
    NEW_NAMES,
    NONNEGATIVE,
    OUTPUT,
    OUTPUTS,
    PATH,
    POSITIVE,
    SEED,
    SHARE,
    TRACED,
    UNITS,
    WHOLE,
    WORD,
    Other,
    Right,
    array,
    instance,
    optional,
)  # fmt: skip


LIMIT = ["1", 1j, NAN, 0.0, -1.0, True, [1.0, 2.0], Other(), TRACED]  # infinite: none
FEW = [*COUNT, 10**6]

INPUT = [None, *OUTPUT]
TRUE = ["x", None, [NAN], [INF], Other(), {}]
# (Durations alone, or variability alone, are data, too.)
OR_NONE = [3, "nope", ("nope",), (3,), ("x", "x"), Other()]
SIGNAL = [None, 3, (), "nope", ("nope",), (3,), ("x", "x"), Other()]


def calls(t):
    """Name, function, good arguments, hostile values of each argument."""
    yield from estimates(t)
    yield from series(t)
    yield from fitting(t)
    yield from designs(t)
    yield from recordings(t)
    yield from testing(t)
    yield from files(t)
    yield from conversions(t)


def estimates(t):
    alone = [*instance(t.design, t.model), [], [3], ["x"]]
    shared = {"repeats": FEW, "highest": optional([*WHOLE, HUGE]), "threshold": NONNEGATIVE}
    yield "estimate_htf", hj.estimate_htf, dict(data=t.data, harmonics=0), {
        "data": alone, "harmonics": HARMONICS, "variance": WORD, "half_integers": WORD,
    } | shared  # fmt: skip
    yield "missing_frequencies", hj.identify.missing_frequencies, dict(data=t.repeated), {
        "data": alone, "threshold": NONNEGATIVE, "highest": optional([*WHOLE, HUGE]),
    }  # fmt: skip
    yield "output_levels", hj.identify.output_levels, dict(data=t.repeated), {
        "data": instance(t.design), "repeats": FEW,
    }  # fmt: skip
    yield "remove_transient", hj.identify.remove_transient, dict(
        data=t.repeated, order=2, skip=1
    ), {
        "data": instance(t.design), "order": optional(FEW), "skip": [*WHOLE, HUGE],
        "multipliers": ["x", 3, [NAN], [[0.5]], [], [0.5j], Other()],
    }  # fmt: skip
    htf = instance(t.model, t.data)
    yield "fit_rational", hj.fit_rational, dict(htf=t.estimate, output=0), {
        "htf": htf, "harmonic": INTEGER, "output": OUTPUT, "input": INPUT, "poles": FEW,
        "zeros": [*WHOLE, 10**6], "form": WORD, "weighting": WORD,
    }  # fmt: skip
    yield "RationalFit.htf", t.rational.htf, dict(f=np.array([0.1, 0.2])), {
        "f": array([0.1, 0.2], empty=True),
    }  # fmt: skip
    yield "RationalFit.compare", t.rational.compare, dict(true=[0.5]), {
        "true": TRUE, "output": OUTPUT,
    }  # fmt: skip
    order = [None, "2", 2.5, NAN, True, 0, -1, 10**6, Other(), t.design]
    yield "fit_multipliers", hj.fit_multipliers, dict(htf=t.estimate, order=2, overhang=6), {
        "htf": htf, "order": order, "harmonics": HARMONICS, "overhang": optional([*WHOLE, 10**6]),
        "errors": WORD, "check": FLAG, "max_steps": COUNT,
    }  # fmt: skip
    yield "StructuredFit.htf", t.structured.htf, dict(f=np.array([0.1, 0.2])), {
        "f": array([0.1, 0.2], empty=True), "harmonics": HARMONICS,
    }  # fmt: skip
    true = np.asarray(t.model.multipliers)
    yield "MultiplierEstimate.distance", t.structured.distance, dict(true=true), {"true": TRUE}
    yield "MultiplierEstimate.compare", t.structured.compare, dict(true=true), {"true": TRUE}
    yield "MultiplierEstimate.contains", t.structured.contains, dict(true=true), {
        "true": TRUE, "level": SHARE,
    }  # fmt: skip
    yield "MultiplierEstimate.ellipse", t.structured.ellipse, {}, {
        "index": [*INTEGER, 9], "level": SHARE, "points": LIMITED,
    }  # fmt: skip
    yield "select_order", hj.select_order, dict(htf=t.estimate, overhang=6), {
        "htf": htf, "max_order": FEW, "harmonics": HARMONICS, "max_steps": COUNT,
        "overhang": optional([*WHOLE, 10**6]),
    }  # fmt: skip
    yield "multiplier_bound", hj.identify.multiplier_bound, dict(model=t.model, htf=t.uncertain), {
        "model": instance(t.design), "htf": htf, "overhang": optional([*WHOLE, 10**6]),
    }  # fmt: skip
    dims = ["x", 2.5, NAN, 0, -1, [3], [2.5] * 6, ["2"] * 6, 10**6, Other()]
    yield "fit_ldtp", hj.fit_ldtp, dict(data=t.uncertain, guess=t.model), {
        "data": [*(x for x in htf if not isinstance(x, hj.ExperimentData)), []], "noise": WORD,
        "guess": [*(x for x in instance(t.design) if not isinstance(x, int)), *dims],
        "start": WORD, "direct": FLAG, "max_steps": COUNT,
    }  # fmt: skip
    yield "LDTPFit.htf", t.joint.htf, dict(f=np.array([0.1, 0.2])), {
        "f": array([0.1, 0.2], empty=True), "harmonics": HARMONICS,
    }  # fmt: skip
    yield "LDTPFit.noise_spectrum", t.driven.noise_spectrum, dict(f=np.array([0.1, 0.2])), {
        "f": array([0.1, 0.2], empty=True), "harmonics": HARMONICS,
    }  # fmt: skip
    yield "noise_spectrum", hj.identify.noise_spectrum, dict(noise=t.model, f=np.array([0.1])), {
        "noise": instance(t.design), "f": array([0.1, 0.2], empty=True), "harmonics": HARMONICS,
    }  # fmt: skip
    yield "ldtp_bound", hj.identify.ldtp_bound, dict(model=t.model, htf=t.uncertain), {
        "model": instance(t.design), "htf": htf,
    }  # fmt: skip
    yield "realize", hj.identify.realize, dict(source=t.exact), {
        "source": [None, "x", 3, NAN, np.zeros(3), t.design, Other()], "dims": dims,
        "order": FEW, "horizon": optional(FEW), "outputs": NEW_NAMES, "inputs": NEW_NAMES,
    }  # fmt: skip


def series(t):
    other = hj.Record(t.record.u, t.record.y, n_sections=8)
    named = hj.Record(t.record.u, t.record.y, n_sections=6, outputs=("a", "b"))
    data = [*instance(t.design, t.model), [], [3], [t.record, other], [t.record, named]]
    order = [None, "2", 2.5, NAN, True, 0, -1, 10**6, Other(), t.design]
    yield "fit_series", hj.fit_series, dict(data=t.record, order=2), {
        "data": data, "order": order, "overhang": optional([*WHOLE, 10**6]), "start": WORD,
        "errors": WORD, "check": FLAG, "max_steps": COUNT,
    }  # fmt: skip
    yield "SeriesFit.impulse_response", t.fit.impulse_response, dict(n_lags=3), {
        "n_lags": LIMITED,
    }  # fmt: skip
    yield "SeriesFit.htf", t.fit.htf, dict(f=np.array([0.1, 0.2])), {
        "f": array([0.1, 0.2], empty=True), "harmonics": HARMONICS,
    }  # fmt: skip
    yield "validate", hj.validate, dict(model=t.fit, data=t.record), {
        "model": [*instance(t.design), t.exact], "data": [*data, other], "start": WORD,
        "noise": optional(instance(t.design, t.model)), "lags": optional([*COUNT, 10**6]),
        "level": SHARE,
    }  # fmt: skip
    u = t.data.u
    yield "amplitude_sweep", hj.identify.amplitude_sweep, dict(
        run=t.run, model=t.model, u=u, amplitudes=[1.0, 2.0]
    ), {
        "run": [*CALLABLE, lambda u: 3], "model": instance(t.design), "u": array(u),
        "amplitudes": [None, "x", 1.0, [], [NAN], [-1.0], [0.0], ["1"], [1j], [INF], TRACED],
        "start": WORD,
    }  # fmt: skip
    yield "AmplitudeSweep.limit", t.sweep.limit, dict(misfit=1.0), {"misfit": POSITIVE}


def fitting(t):
    data = [*instance(t.design, t.model), [], [3], ["x"]]
    free = [None, 3, (), "nope", ("nope",), (3,), ("mu", "mu"), {}, {"mu": 3}, {"mu": (1.0, 0.5)},
            {"mu": (NAN, 1.0)}, {"mu": ("0", "1")}, {"mu": (0.5, 1.0)}, {"mu": (0.0, 1j)},
            ]  # fmt: skip
    guess = ["flow", 3, (1.0, 0.0), PHASE, Other()]
    both = dict(system=t.system, data=t.observed, free=("mu",), guess=t.cycle)
    shared = {"system": instance(PHASE), "data": data, "free": free, "guess": guess}
    yield "fit_model", hj.fit_model, both, shared | {
        "guesses": COUNT, "seed": SEED,
        "store": PATH[1:], "client": ["tcp://here", 3, Other()],
    }  # fmt: skip
    yield "identifiability", hj.fitting.identifiability, both, shared
    yield "spectral_radius", hj.fitting.spectral_radius, dict(model=t.model), {
        "model": instance(t.design), "smoothing": NONNEGATIVE,
    }  # fmt: skip
    sections = [None, "x", 8, [], [3], Other(), hj.Execution()]
    yield "ObservedHTF", hj.ObservedHTF, dict(htf=t.htf, sections=PHASE), {
        "htf": instance(t.model), "sections": sections,
    }  # fmt: skip
    yield "ObservedSeries", hj.ObservedSeries, dict(data=t.series, sections=PHASE), {
        "data": instance(t.record), "sections": sections, "std": ["x", -1.0, 0.0, NAN, 1j, [1.0]],
    }  # fmt: skip
    values = np.ones((4, 2))
    yield "ObservedCycle", hj.ObservedCycle, dict(
        sections=PHASE, outputs=STATES, values=values, times=np.arange(4.0), period=1.0
    ), {
        "sections": sections, "outputs": NAMES[1:4] + NAMES[6:],
        "values": optional(array(values, missing=True)),
        "times": optional(array(np.arange(4.0), missing=True)), "period": optional(POSITIVE),
        "std": ["x", -1.0, 0.0, NAN, 1j, [1.0] * 5], "times_std": ["x", -1.0, 0.0, NAN, 1j],
        "period_std": ["x", -1.0, 0.0, NAN, 1j],
    }  # fmt: skip
    yield (
        "ObservedCycle.of",
        hj.ObservedCycle.of,
        dict(cycle=t.cycle, sections=PHASE, outputs=STATES),
        {"cycle": instance(t.system), "sections": sections, "outputs": NAMES[1:2] + NAMES[3:]},
    )
    for name in ("ObservedCycle", "ObservedHTF"):
        made = t.observed if name == "ObservedCycle" else hj.ObservedHTF(t.htf, PHASE)
        for method in ("residuals", "prepare"):
            yield f"{name}.{method}", getattr(made, method), dict(cycle=t.cycle), {
                "cycle": instance(t.system),
            }  # fmt: skip


def designs(t):
    ask = hj.designs.Multipliers(harmonics=0, overhang=6)
    amplitudes = [*POSITIVE, lambda f: "x", lambda f: f * NAN, lambda f: -1 - f]
    weights = ["x", 3, (), (NAN,), ("1",), Other()]
    window = hj.designs.Window(np.ones(6))
    other = hj.LDTP(np.ones((2, 1, 1)), np.ones((2, 1, 1)), np.ones((2, 1, 1)))
    limits = [
        None,
        3,
        "nope",
        ["u0"],
        {},
        {"z": 1.0},
        {"u0": 0.0},
        {"u0": NAN},
        {"u0": "1"},
        Other(),
    ]
    distorted = hj.designs.Limits(distortion=hj.designs.Distortion(t.cycle, PHASE, {"x": 1.0}))
    noise = [3, "nope", {"z": 1.0}, {"y0": 0.0}, {"y0": NAN}]
    noise += [{"y0": lambda f: "x"}, {"y0": lambda f: f * NAN}, {"y0": lambda f: f - 1}]
    yield "optimal_design", hj.optimal_design, dict(
        model=t.model, design=t.design, goal=ask
    ), {
        "model": instance(t.design), "design": [3, t.model, t.one_input, np.zeros((1, 9, 2))],
        "goal": [*WORD, hj.designs.Multipliers(9), hj.designs.Multipliers(harmonics=1)],
        "limit": [*limits, distorted], "noise": optional(noise),
        "largest": optional(amplitudes), "seed": SEED, "robust": WORD,
    }  # fmt: skip
    yield "Multipliers", hj.designs.Multipliers, {}, {
        "which": optional(WHOLE), "part": WORD, "estimator": WORD,
        "weights": optional(weights),
        "harmonics": optional(HARMONICS), "overhang": optional(WHOLE),
    }  # fmt: skip
    yield "Parameters", hj.designs.Parameters, dict(cycle=t.cycle, sections=PHASE, free=("mu",)), {
        "cycle": instance(t.system), "sections": [None, "x", 8, [], [3], Other()],
        "free": [None, 3, (), (3,), ("x", "x"), Other()],
        "wanted": optional([3, (), (3,), ("x", "x"), Other()]), "harmonics": HARMONICS,
    }  # fmt: skip
    band = [None, 3, "x", (1,), (1, NAN), (2.0, 1.0), (-1.0, 1.0), (0, 1, 2), Other()]
    yield "FrequencyResponse", hj.designs.FrequencyResponse, dict(band=(0.1, 1.0)), {
        "band": band, "wanted": HARMONICS, "harmonics": optional(HARMONICS),
    }  # fmt: skip
    yield "ImpulseResponse", hj.designs.ImpulseResponse, dict(lags=4), {
        "lags": COUNT, "harmonics": optional(HARMONICS),
    }  # fmt: skip
    yield "Order", hj.designs.Order, dict(fewer=1), {
        "fewer": WHOLE, "harmonics": HARMONICS, "overhang": optional(WHOLE),
    }  # fmt: skip
    named = [None, 3, "nope", ["u0"], {"u0": 0.0}, {"u0": NAN}, {"u0": "1"}, Other()]
    yield "Limits", hj.designs.Limits, dict(rms={"u0": 1.0}), {
        "rms": named, "rate": named, "peak": named, "strides": optional(COUNT),
        "distortion": optional([3, "nope", {"y0": 1.0}, Other()]),
    }  # fmt: skip
    yield "Distortion", hj.designs.Distortion, dict(
        cycle=t.cycle, sections=PHASE, rms={"x": 1.0}
    ), {
        "cycle": instance(t.system), "sections": [None, "x", 8, [], [3], Other()],
        "rms": [*named, {}],
    }  # fmt: skip
    yield "Window", hj.designs.Window, dict(weights=np.ones(6)), {
        "weights": [*array(np.ones(6)), np.zeros(6)],
    }  # fmt: skip
    yield "Window.seen_from_signal", window.seen_from_signal, dict(model=t.model), {
        "model": instance(t.design, other),
    }  # fmt: skip
    yield "Window.pushes", window.pushes, dict(design=t.design), {
        "design": instance(t.model), "cycles": optional(LIMITED),
    }  # fmt: skip
    yield "Window.with_signal", window.with_signal, dict(data=t.data, design=t.design), {
        "data": instance(t.design), "design": instance(t.model),
    }  # fmt: skip
    yield "choose_window", hj.designs.choose_window, dict(
        model=t.model, design=t.design, noise={n: 0.01 for n in t.model.outputs},
        limit={n: 0.1 for n in t.model.inputs}, shortest=t.model.n_sections,
    ), {
        "model": instance(t.design), "design": instance(t.model, other),
        "noise": [None, 3, "nope", {}, {"nope": 1.0}], "limit": [None, 3, "input", {}, Other()],
        "goal": optional([3, "nope", Other()]), "shortest": COUNT,
    }  # fmt: skip
    yield "Study", hj.designs.Study, dict(first=t.one_input, order=1, standard_error=1.0), {
        "first": instance(t.model, t.design), "order": COUNT, "standard_error": POSITIVE,
        "goal": optional([3, "nope", hj.designs.Multipliers(estimator="fit_ldtp")]),
        "limit": [None, 3, "nope", hj.designs.Limits(strides=9), Other()],
        "largest": optional([0.0, -1.0, NAN, "x", Other()]), "seed": SEED,
    }  # fmt: skip
    yield "Study.add", t.study.add, dict(data=t.block), {
        "data": instance(t.model, t.data), "repeats": [*COUNT, 2],
    }  # fmt: skip
    yield "information_map", hj.designs.information_map, dict(
        model=t.decaying, design=t.one_input, noise={"y": 1.0}, goal=t.study.goal
    ), {
        "model": instance(t.design), "design": instance(t.model, t.design),
        "noise": [None, 3, "nope", {}, {"z": 1.0}, {"y": 0.0}, {"y": NAN}, {"y": "1"}, Other()],
        "goal": optional([3, "nope", hj.designs.Multipliers(estimator="fit_ldtp")]),
    }  # fmt: skip
    yield "draws", hj.designs.draws, dict(fit=t.joint, count=1), {
        "fit": instance(t.design), "count": COUNT, "seed": SEED,
    }  # fmt: skip
    yield "OptimalDesign.sequence", t.plan.sequence, dict(cycles=2), {
        "cycles": LIMITED, "kind": WORD, "seed": SEED,
    }  # fmt: skip
    yield "OptimalDesign.strides_for", t.plan.strides_for, dict(standard_error=1.0), {
        "standard_error": POSITIVE,
    }  # fmt: skip


def recordings(t):
    x = np.arange(5.0)
    numbers = [None, "abcde", 3.0, x[:, None], x[:3], list("abcde"), x + 1j, x * INF, Other()]
    events = [3, "x", ["x"], {"e": "x"}, {"e": 1j * x}, {"e": [INF]}, {"e": [[1.0]]}, {3: [1.0]}]
    about = {"events": events, "units": UNITS, "name": [None, 3]}
    yield "Recording", hj.Recording, dict(time=x, signals={"x": x}), {
        "time": [*numbers, x[::-1], x * NAN, x * 0, [], [0.0], TRACED],
        "signals": [None, 3, "x", x, {}, {3: x}, *({"x": each} for each in numbers)],
    } | about  # fmt: skip
    frame = {"time": x, "x": x}
    yield "Recording.from_frame", hj.Recording.from_frame, dict(frame=frame), {
        "frame": [None, 3, "x", x, {}, {"time": x}, {"time": x, "x": "abc"}, Other()], "time": NAME,
    } | about  # fmt: skip
    yield "Recording.join", hj.Recording.join, dict(recordings=[t.recording]), {
        "recordings": [None, 3, "x", [], [3], [t.recording, None], t.recording, Other()],
    }  # fmt: skip
    yield "Recording.beside", hj.Recording.beside, dict(recordings=[t.recording]), {
        "recordings": [None, 3, "x", [], [3], [t.recording] * 2, t.recording, Other()],
    }  # fmt: skip
    rises, angle = hj.Crossing("x", "rising"), hj.KinematicPhase(4, position="x", velocity="v")
    yield "Recording.mark", t.recording.mark, dict(event="e", crossing=rises), {
        "event": NEW_NAME, "bandwidth": [None, "1", 1j, NAN, 0.0, -1.0, True, Other()],
        "crossing": [*instance(PHASE, t.phase), "x", hj.Crossing("nope", "rising")],
    }  # fmt: skip
    for name in ("column", "unit"):
        yield f"Recording.{name}", getattr(t.recording, name), dict(name="x"), {"name": NAME}
    definition = [None, "x", 3, hj.AtEvent("nope"), hj.Crossing("nope", "rising"),
                  hj.ClockPhase(4), Other(), t.design, lambda time, signals: "x"]  # fmt: skip
    yield "estimate_phase", hj.recordings.estimate_phase, dict(
        recording=t.recording, definition=angle
    ), {
        "recording": instance(t.record), "definition": definition, "bandwidth": LIMIT,
        "causal": FLAG,
    }  # fmt: skip
    take = dict(recording=t.recording, phase=t.phase, inputs="f", outputs=("x", "v"), n_sections=2)
    taken = {
        "recording": instance(t.record), "phase": definition, "inputs": OR_NONE, "outputs": OR_NONE,
        "n_sections": [*optional(LIMITED), 8.5], "bandwidth": LIMIT, "sampled": WORD,
        "timing": optional(WORD),
    }  # fmt: skip
    yield "section_data", hj.recordings.section_data, take, taken
    taken.pop("sampled")
    yield (
        "identify_recording",
        hj.identify_recording,
        take | dict(order=1),
        (taken | {"order": optional(FEW), "drift": LIMIT}),
    )
    yield "SectionData.experiments", t.section_data.experiments, dict(periods=4), {
        "periods": LIMITED,
    }  # fmt: skip
    yield "inspect", hj.recordings.inspect, dict(
        recording=t.recording, inputs="f", outputs=("x", "v")
    ), {
        "recording": instance(t.record), "inputs": SIGNAL, "outputs": OR_NONE,
        "phase": ["x", 3, Other()], "data": ["x", 3, t.record, Other()],
    }  # fmt: skip
    data = instance(t.record, t.data)
    yield "advise", hj.recordings.advise, dict(data=t.section_data, fit=t.found.fit), {
        "data": data, "fit": instance(t.structured), "validation": optional(instance(t.data)),
        "findings": ["x", 3, [3], Other()], "curve": optional(instance(t.design)),
    }  # fmt: skip
    yield "choose_order", hj.recordings.choose_order, dict(data=t.section_data), {
        "data": data, "most": FEW, "share": [*SHARE, 1.0],
    }  # fmt: skip
    yield "hold_out", hj.recordings.hold_out, dict(data=t.section_data, order=1), {
        "data": data, "order": FEW, "share": [*SHARE, 1.0],
    }  # fmt: skip
    yield "impulse_responses", hj.recordings.impulse_responses, dict(
        fit=t.found.fit, data=t.found.data
    ), {
        "fit": instance(t.structured), "data": data, "cycles": optional([*POSITIVE, 10**9]),
        "width": optional(POSITIVE),
    }  # fmt: skip
    yield "without_drift", hj.recordings.without_drift, dict(
        recording=t.recording, phase=t.phase, signals="x", cycles=5.0
    ), {
        "recording": instance(t.record), "phase": instance(PHASE), "signals": SIGNAL,
        "cycles": POSITIVE,
    }  # fmt: skip
    yield "add_command", hj.recordings.add_command, dict(
        recording=t.recording, phase=t.phase, path="nope.csv"
    ), {
        "recording": instance(t.record), "phase": instance(PHASE), "path": [*PATH, "nope.csv"],
    }  # fmt: skip
    yield "write_design", hj.recordings.write_design, dict(path="d.csv", design=t.one_input), {
        "path": [*PATH, "nope/d.csv"], "design": instance(t.model), "cycles": optional(LIMITED),
        "period": optional(POSITIVE), "rate": optional(POSITIVE),
    }  # fmt: skip
    yield (
        "read_recording",
        lambda paths, **k: hj.read_recording(paths, **k),
        dict(paths="nope.csv"),
        {
            "paths": [*PATH, "nope.csv", "nope.docx"],
            "time": NEW_NAME,
            "units": UNITS,
            "signals": NEW_NAMES,
        },
    )
    pair = ["ab", None, 1.0, (1.0,), (NAN, 1.0), (1j, 0.0), (None, 1.0), ("1", "2")]
    tracker = dict(center=(0.0, 0.0), scale=(1.0, 1.0), rate=1.0)
    yield "PhaseTracker", hj.recordings.PhaseTracker, tracker, {
        "center": pair, "scale": [*pair, (0.0, 1.0), (-1.0, 1.0)], "rate": [*FINITE, 0.0],
        "anchor": FINITE, "bandwidth": optional(POSITIVE),
    }  # fmt: skip
    update = hj.recordings.PhaseTracker(**tracker).update
    sample = [Right(NAN), *(x for x in FINITE if x is not NAN)]
    yield "PhaseTracker.update", update, dict(time=0.0, position=1.0, velocity=0.0), {
        "time": FINITE, "position": sample, "velocity": sample,
    }  # fmt: skip


def testing(t):
    yield "spoil", hj.testing.spoil, dict(recording=t.recording, signals=("x",)), {
        "recording": instance(t.record), "signals": SIGNAL, "noise": NONNEGATIVE,
        "quantum": NONNEGATIVE, "missing": [*NONNEGATIVE, 1.5], "seed": SEED,
        "gap": ["ab", 1.0, (1.0,), (NAN, 1.0), (2.0, 1.0)], "spikes": [*NONNEGATIVE, 1.5],
    }  # fmt: skip
    yield "random_force", hj.testing.random_force, dict(duration=10, rate=50, bandwidth=5), {
        "duration": [*POSITIVE, 1e12], "rate": [*POSITIVE, 1e12], "bandwidth": [*POSITIVE, 40],
        "rms": NONNEGATIVE, "inputs": LIMITED, "seed": SEED,
    }  # fmt: skip
    force = np.zeros((1, 50, 1))
    yield "simulate_recording", hj.testing.simulate_recording, dict(
        cycle=t.cycle, force=force, outputs=STATES, rate=16
    ), {
        "cycle": instance(t.system), "force": array(force), "outputs": OUTPUTS,
        "rate": [*POSITIVE, 1e12], "steps": LIMITED, "accuracy": POSITIVE,
    }  # fmt: skip


def files(t):
    yield "save", hj.save, dict(path="thing.npz", thing=t.model), {
        "path": [*PATH, "thing.txt", "nope/thing.npz"],
        "thing": [*instance(t.cycle, t.recording), hj.LDTP],
    }  # fmt: skip
    yield "load", hj.load, dict(path="thing.npz"), {"path": [*PATH, "thing.npz"]}
    yield "write_report", hj.write_report, dict(folder="report", found=t.found), {
        "folder": PATH, "found": instance(t.fit),
    }  # fmt: skip


def conversions(t):
    other, period = [*instance(t.record), "x", [t.model]], {"period": POSITIVE}
    yield "to_lti", hj.convert.to_lti, dict(model=t.model), {"model": other}
    yield "to_scipy", hj.convert.to_scipy, dict(model=t.model), {"model": other} | period
    yield "to_control", hj.convert.to_control, dict(thing=t.model), {"thing": other} | period
    yield "to_xarray", hj.convert.to_xarray, dict(thing=t.model), {"thing": [None, 3, "x", Other()]}
    yield "to_pandas", hj.convert.to_pandas, dict(thing=t.fit), {"thing": [None, 3, "x", t.model]}
    yield "from_xarray", hj.convert.from_xarray, dict(dataset=hj.convert.to_xarray(t.model)), {
        "dataset": [None, 3, "x", t.model, {}, Other()],
    }  # fmt: skip
