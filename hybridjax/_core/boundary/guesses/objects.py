"""What to do when a function is given the wrong object: the call that makes the one it needs, and
the step that leads there from the one it was given.

Tables for `leads.py`.

`MAKERS` has for each class how to make one, `STEPS` how to get one from another object, and
`OBJECTS` the advice of a function for a type that it was given. If a message gives the wrong
advice, change its line: `OBJECTS` is asked first, then `STEPS`, then `MAKERS`.

If a message gives no advice, add a line. Keys hold the names of classes: in `MAKERS` of the one
that is needed, in `STEPS` of (needed, given); in `OBJECTS` a key is `function.given` or
`function.argument.given`. Calls in an advice must exist (`tests/test_guesses.py` checks this).
"""

from .sentences import AT_TIMES


_OF_SAMPLES = (
    "`hj.fitting.ObservedTrajectory(hj.Guess(chart, state), times, outputs, values, input=push)` "
    "makes one of the samples of a recording"
)

MAKERS = {
    "AbstractSections": "`hj.ClockPhase(32)`, `hj.Crossing('y', 'falling')` or a list of these are "
    "sections",
    "Branch": "`hj.continuation(cycle, parameter, (low, high))` makes one",
    "Crossing": "`hj.Crossing('y', 'falling')` makes one",
    "Design": "`hj.multisine(n_sections)` makes one",
    "ExperimentData": "`hj.run_experiments(cycle, sections, design, outputs)` makes one",
    "Guess": "`hj.Guess(chart, state)` makes one",
    "HTF": "`hj.estimate_htf(data)` or `model.htf(frequencies)` makes one",
    "HybridSystem": "`hj.models` has ready ones, and subclasses of `hj.HybridSystem` are others",
    "HasMultipliers": "limit cycles, models and fits have them",
    "HasRecords": "`hj.run_experiments(cycle, sections, design, outputs)` makes data, and "
    "`hj.identify_recording` those of a recording",
    "LDTP": "`hj.linearize(cycle, sections)` or `hj.fit_ldtp(data, ...)` makes one",
    "LimitCycle": "`hj.find_limit_cycle(system)` makes one",
    "LimitCycles": "`hj.orbits.find_limit_cycles(systems)` makes one",
    "Fit": "`hj.fit_multipliers(htf, order)` or `hj.fit_series(data, order)` makes one",
    "MultiplierFit": "`hj.fit_multipliers(htf, order)` makes one",
    "OptimalDesign": "`hj.optimal_design(model)` makes one",
    "Phase": "`hj.recordings.estimate_phase(recording, sections)` makes one",
    "Plant": "`hj.plants` has ready ones",
    "RationalFit": "`hj.identify.fit_rational(htf)` makes one",
    "SectionSeries": "`data.records` has them",
    "Recording": "`hj.read_recording(path)`, or `hj.Recording(time, signals)` of arrays, makes one",
    "SectionData": "`hj.identify_recording(recording, ...).data` or "
    "`hj.recordings.sample_sections(...)` is one",
    "SeriesFit": "`hj.fit_series(data, order)` makes one",
    "Settings": "`hj.orbits.Settings(rtol=1e-9)` makes one",
    "StructuredFit": "`hj.fit_multipliers(htf, order)` makes one",
    "Validation": "`hj.validate(model, data)` makes one",
}
"""For each type, the call that makes an object of it."""

STEPS = {
    (
        "HybridSystem",
        "function",
    ): "`hj.HybridSystem.from_functions(('x', 'v'), field)` makes one of a function (t, q)",
    (
        "HybridSystem",
        "str",
    ): "models are objects, such as `hj.models.VerticalHopper()`",
    (
        "Phase",
        "ClockPhase",
    ): "recordings have no clock; its ticks are events: "
    "`hj.Recording(time, signals, events={'tick': times})`, then `hj.AtEvent('tick')`",
    (
        "Phase",
        "AbstractSections",
    ): "`hj.Crossing('y', 'falling')` of a signal 'y', with `n_sections=8`, divides cycles by time",
    (
        "Crossing",
        "str",
    ): "`hj.Crossing('y', 'falling')` of a signal 'y', or `hj.AtEvent('strike')` of an event, is "
    "one",
    ("HTF", "ExperimentData"): "`hj.estimate_htf(data)` makes one of data",
    (
        "HTF",
        "Identification",
    ): "`result.fit.htf(frequencies)` is that of the fit",
    (
        "ExperimentData",
        "SectionData",
    ): "`hj.fit_series(data, order)` fits data at sections",
    ("HTF", "SectionData"): "`hj.fit_series(data, order)` fits data at sections",
    ("HTF", "Recording"): "`hj.identify_recording(recording, ...)` takes recordings",
    ("HTF", "LDTP"): "`model.htf(frequencies)` makes one of a model",
    (
        "HTF",
        "LimitCycle",
    ): "`hj.linearize(cycle, sections).htf(frequencies)` makes one of a cycle",
    ("HTF", "Fit"): "`fit.htf(frequencies)` makes one of a fit",
    ("LDTP", "LimitCycle"): "`hj.linearize(cycle, sections)` makes one of a cycle",
    (
        "LDTP",
        "HybridSystem",
    ): "`hj.linearize(hj.find_limit_cycle(system), sections)` makes one of a system",
    ("LDTP", "HTF"): "`hj.fit_ldtp(htf, ...)` makes one of an HTF",
    (
        "ExperimentData",
        "HTF",
    ): "it takes the data: `hj.fit_multipliers(htf, order)` takes an HTF",
    (
        "ExperimentData",
        "Recording",
    ): "`hj.identify_recording(recording, ...)` takes recordings",
    (
        "ExperimentData",
        "LDTP",
    ): "`hj.experiments.simulate_experiments(model, design)` makes data of a model",
    (
        "HasRecords",
        "HTF",
    ): "it takes the data; `hj.fit_multipliers(htf, order)` takes an HTF",
    (
        "HasRecords",
        "Recording",
    ): "`hj.identify_recording(recording, ...)` takes recordings",
    (
        "HasRecords",
        "LimitCycle",
    ): "`hj.run_experiments(cycle, sections, design, outputs)` makes data",
    ("HasRecords", "LDTP"): "are `model` and `data` in the wrong order?",
    (
        "SectionData",
        "Recording",
    ): "`hj.identify_recording(recording, sections, outputs=...)` takes recordings",
    (
        "HasRecords",
        "str",
    ): "`hj.identify_recording(path, ...).data` are those of a recording",
    (
        "HasRecords",
        "Path",
    ): "`hj.identify_recording(path, ...).data` are those of a recording",
    ("ParameterFit", "MultiplierFit"): "`other.compare(fit)` compares multipliers",
    ("Recording", "ExperimentData"): "`hj.fit_series(data, order)` takes such data",
    (
        "LimitCycle",
        "LDTP",
    ): "it needs the cycle that was linearized: `hj.find_limit_cycle(system)`",
    (
        "AbstractObservation",
        "HTF",
    ): "`hj.fitting.ObservedHTF(htf, sections)` makes one of an HTF",
    (
        "AbstractObservation",
        "Recording",
    ): _OF_SAMPLES,
    (
        "AbstractObservation",
        "ExperimentData",
    ): "`hj.fitting.ObservedSeries(data, sections)` makes one of data",
}
"""For a type that is needed, and one that was given, the step between them. A given type also
stands for those derived from it."""

OBJECTS = {
    **{
        f"{function}.order.{kind}": f"`hj.select_order({given})` compares orders"
        for function, given in (("fit_multipliers", "htf"), ("fit_series", "data"))
        for kind in ("list", "tuple", "range", "ndarray")
    },
    "multisine.LDTP": "pass `model.n_sections`",
    "run_experiments.LDTP": "`hj.experiments.simulate_experiments(model, design)` runs experiments "
    "on a model",
    "optimal_design.float": "name the signal: `limit={'u': 0.01}` is its largest rms",
    "identify_recording.list": "`hj.Recording.join(recordings)` makes trials of one recording; of "
    "several subjects, `hj.identify_subjects(table, folder)`",
    "Population.list": "`hj.recordings.Population.from_fits(fits, subjects)` takes fits",
    "responses.str": "`cycle.responses().curve('u')` is that to one input",
    "fluctuations.float": "name the signal: `white={'y': 0.01}`",
    "fit_model.free.dict": "initial values are those of the system, `system.replace(k=9.0)`, and a "
    "dictionary has bounds, `{'k': (5.0, 20.0)}`",
    "fit_model.Identification": f"{_OF_SAMPLES}; `result.compare(cycle)` compares multipliers",
    "fit_model.SectionData": _OF_SAMPLES,
    "estimate_htf.LDTP": "`model.htf(frequencies)` is the exact HTF of a model",
    "fit_series.LDTP": "are the model and the data in the wrong order?",
    "continuation.int": "pass `(low, high)`, as in `hj.continuation(cycle, 'k', (0.1, 0.5))`",
    "continuation.float": "pass `(low, high)`, as in `hj.continuation(cycle, 'k', (0.1, 0.5))`",
    "ClockPhase.anchor.str": "`hj.Crossing('y', 'falling')` of a signal 'y' is one",
    "ArcLength.anchor.str": "`hj.Crossing('y', 'falling')` of a signal 'y' is one",
    "KinematicPhase.anchor.str": "`hj.Crossing('y', 'falling')` of a signal 'y' is one",
    "KinematicPhase.position.tuple": "pass two names: `hj.KinematicPhase(8, 'y', 'v')`",
    "KinematicPhase.position.list": "pass two names: `hj.KinematicPhase(8, 'y', 'v')`",
    "identify_recording.sections.tuple": "`hj.Crossing('y', 'falling')` of a signal 'y' is one",
    "identify_recording.sections.dict": "`hj.Crossing('y', 'falling')` of a signal 'y' is one",
    "estimate_phase.sections.tuple": "`hj.Crossing('y', 'falling')` of a signal 'y' is one",
    "estimate_phase.sections.dict": "`hj.Crossing('y', 'falling')` of a signal 'y' is one",
    "sample_sections.sections.tuple": "`hj.Crossing('y', 'falling')` of a signal 'y' is one",
    "sample_sections.sections.dict": "`hj.Crossing('y', 'falling')` of a signal 'y' is one",
    "linearize.sections.dict": "`hj.Crossing('y', 'falling')` of a signal 'y' is one",
    "simulate.chart.Trajectory": "`hj.flow(system, flow, until)` goes on from the end of a flow",
    "__call__.names.float": AT_TIMES,
    "__call__.names.int": AT_TIMES,
    "multipliers.estimates.ndarray": "pass the fit, which has regions: `hj.plot.multipliers(true, "
    "fit)`",
    "simulate.u.Design": "`hj.experiments.simulate_experiments(model, design)` runs one on a model",
    "simulate.state.dict": "a state by name needs no chart: `hj.simulate(system, state, duration)`",
    "simulate.chart.float": "`hj.simulate(system, duration=1.0)` starts at the guess of the model",
    "simulate.chart.int": "`hj.simulate(system, duration=1.0)` starts at the guess of the model",
    "identify_recording.sections.int": "it is the event at which cycles begin, such as "
    "`hj.Crossing('y', 'falling')`; `n_sections` is a number",
    "Guess.dict": "pass the values in the order of the chart's states, or such a state in place of "
    "the guess: `hj.find_limit_cycle(system, {'y': 2.0, 'v': 0.0})`",
    "identify_subjects.list": "name the files: `hj.identify_subjects({'file': files, 'subject': "
    "names}, folder, ...)`; `hj.recordings.Population.from_fits(fits, subjects)` compares fits",
    "cycle.x.tuple": "pass two names: `hj.plot.cycle(cycle, x, y)`",
    "cycle.x.list": "pass two names: `hj.plot.cycle(cycle, x, y)`",
    "multisine.AbstractSections": "pass `sections.n_sections`",
    "read_recording.DataFrame": "`hj.Recording.from_frame(table)` takes tables",
    "Recording.ndarray": "`hj.Recording(time, {'name': samples})` names each signal",
    "sweep.values.str": "pass the values by name: `hj.sweep(system, k=values)`",
    "save.Showable": "`hj.save('name.npz', result)` takes the name first",
    "save.LimitCycle": "it contains the code of its system; `cycle.to_pandas()` has its numbers",
    "__getitem__.list": "it takes one name at a time; `result.to_pandas()[names]` has several",
    "Branch.__getitem__.str": "`branch.values` has the values of the parameter, and "
    "`branch.to_pandas()` all numbers",
    "LimitCycle.trajectory.str": "`cycle.trajectory()('y')` has times and values of a signal",
    "HTF.select.str": "`htf.select(outputs='y')` is the HTF of an output",
    "__getitem__.str": "an index is a number; of an HTF it is the harmonic",
    "multipliers.list": "`hj.plot.multipliers(true, {'fit': fit})` takes the true ones first",
    "multipliers.dict": "`hj.plot.multipliers(true, {'fit': fit})` takes the true ones first",
    "save.HybridSystem": "a system is code: keep the script that makes it",
    "save.Recording": "`recording.to_pandas().to_csv(path)` writes it",
    "save.SectionData": "`data.to_pandas().to_csv(path)` writes it",
    "save.Identification": "save its `fit`, or write `result.write_report(folder)`",
    "save.NaturalIdentification": "save its `fit`, or write `result.write_report(folder)`",
    "simulate.LimitCycle": "`cycle.trajectory(periods)` follows a cycle",
    "to_pandas.HybridSystem": "print the system, or `hj.find_limit_cycle(system).to_pandas()`",
}
"""For a function, or one of its arguments, and the type of the object that it was given, what to
do. A given type also stands for those derived from it."""
