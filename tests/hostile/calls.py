"""A good call of every public function and method; `run.py` replaces their arguments."""

import functools as ft

import jax.numpy as jnp
import numpy as np

import hybridjax as hj
from hybridjax.recordings.sampling import without_drift

from .things import APEX, NAMES as STATES, PHASE


BEAT = hj.AtEvent("strike")


def positional(function):
    """A function of the first of the values that `function` takes by position."""

    @ft.wraps(function)
    def call(values, **more):
        return function(values, **more)

    return call


def scale(t):
    yield hj.sweep, dict(model=t.system, values={"nope": [1.0]}, guess=t.cycle)
    yield hj.scale.monte_carlo, dict(function=lambda rng: "no number", draws=3)
    yield hj.scale.SweepPoints, dict(values={"x": [1.0]})
    yield hj.scale.SweepPoints.sobol, dict(ranges={"x": (0.0, 1.0)}, count=4)


def systems(t):

    def flow(time, q, u):
        return q[0]

    yield (
        hj.Guess,
        dict(
            chart="plane",
            state=(1.0, 0.0),
            time=0.0,
            after="hit",
        ),
    )
    yield hj.Output, dict(name="z", function=flow)
    yield hj.Output("z", flow).in_chart, dict(name="plane")
    ends = dict(
        name="hit",
        source="flow",
        target="flow",
        guard=flow,
    )
    yield hj.Transition, ends | dict(direction="falling", reset=flow)
    yield hj.systems.Scheduled, dict(period=1.0, offset=0.0)
    yield hj.parameter, dict(default=1.0)
    yield hj.models.VerticalHopper, dict(k=10.0)
    yield hj.models.BouncingChain, dict(n=2)
    yield hj.scale.enable_progress, dict(enabled=False)
    yield hj.scale.enable_compilation_cache, dict(folder=None)
    yield hj.orbits.Settings, dict(rtol=1e-09, atol=1e-09)
    begin = dict(
        chart="plane",
        state=(1.0, 0.0),
        duration=0.1,
        time=0.0,
    )
    yield hj.simulate, dict(system=t.system) | begin
    guess = hj.Guess("plane", (1.0, 0.0))
    yield (
        hj.flow,
        dict(
            system=t.system,
            start=guess,
            until=0.1,
            max_events=2,
        ),
    )
    samples = dict(
        times=(0.1, 0.2),
        outputs="x",
        values=[[1.0], [2.0]],
        std=0.1,
    )
    yield hj.fitting.ObservedTrajectory, dict(start=guess) | samples


def sections(t):
    yield hj.Crossing, dict(signal="y", direction="falling", value=0.0)
    yield hj.AtEvent, dict(name="hit")
    yield hj.ClockPhase, dict(n_sections=8, anchor=0.0)
    turn = dict(
        n_sections=8, position="x", velocity="y", center=(0.0, 0.0), scale=(1.0, 1.0)
    )
    yield hj.KinematicPhase, turn
    yield hj.sections.SectionList, dict(items=[APEX])
    yield hj.sections.place_sections, dict(cycle=t.cycle, sections=PHASE)
    yield t.placed.observe, dict(outputs=STATES)
    yield hj.linearize, dict(cycle=t.cycle, sections=t.placed, outputs=STATES)
    yield (
        hj.sections.section_map,
        dict(
            cycle=t.cycle,
            sections=t.placed,
            i=0,
            j=1,
        ),
    )
    yield t.map, dict(q=t.map.fixed_point)


def cycles(t):
    yield hj.find_limit_cycle, dict(system=t.system, guess=t.cycle)
    yield hj.orbits.find_limit_cycles, dict(systems=[t.system, t.system], guess=t.cycle)
    yield t.cycles.__getitem__, dict(i=0)
    yield (
        hj.continuation,
        dict(
            cycle=t.cycle,
            parameter="mu",
            range=(0.1, 0.2),
            step=0.05,
        ),
    )
    yield t.cycle.responses, dict(modes=0)
    yield (
        t.cycle.asymptotic_phase,
        dict(chart="plane", state=np.array([2.0, 0.1]), cycles=9),
    )
    yield t.cycle.htf, dict(frequencies=np.array([0.3]), harmonics=0, outputs=STATES)
    yield t.cycle.sensitivity, dict(parameter="mu")
    yield t.cycle.fluctuations, dict(white={"v": 0.1}, guards={}, resets={})
    yield t.cycle.sensitivity("mu").shape, dict(phase=np.array([0.3]))
    yield t.branch.__getitem__, dict(k=0)
    yield t.branch.largest, dict(output="x")


def linear(t):
    A = np.asarray(t.model.A)
    B = np.asarray(t.model.B)
    C = np.asarray(t.model.C)
    D = np.asarray(t.model.D)
    yield (
        hj.linear.LDTP,
        dict(
            A=A,
            B=B,
            C=C,
            D=D,
            dims=np.asarray(t.model.dims),
        ),
    )
    square = [np.eye(2)] * 3
    yield (
        hj.linear.LDTP.from_blocks,
        dict(
            A=square,
            B=square,
            C=square,
            D=square,
        ),
    )
    u = np.ones((12, 2))
    for name in ("states", "simulate"):
        yield getattr(t.model, name), dict(u=u)
    for name, v in (("periodic_state", u), ("periodic_states", u[None])):
        yield getattr(t.model, name), dict(u=v, periods=2)
    yield t.model.impulse_response, dict(n_lags=3)
    yield t.model.htf, dict(frequencies=np.array([0.1, 0.2]))
    yield (
        t.model.feedback,
        dict(controller=np.zeros((len(t.model.inputs), len(t.model.outputs)))),
    )


def transfer_functions(t):
    f = np.asarray(t.estimate.frequencies)
    H = np.asarray(t.estimate.H)
    size = np.ones(H.shape)
    variance_dof = hj.linear.VarianceDof(f, size)
    errors = dict(
        variance=size,
        noise_variance=size,
        variance_dof=hj.linear.VarianceDof(np.ones(len(f)), size),
    )
    yield (
        hj.linear.HTF,
        dict(
            frequencies=f,
            H=H,
            harmonics=(-1, 0, 1),
            n_sections=6,
        )
        | errors,
    )
    yield hj.linear.VarianceDof, dict(dof=f, roundness=size)
    yield variance_dof.quantile, dict(level=0.9)
    yield variance_dof.sources, dict(frequencies=f)
    lines = np.arange(12) / 4 + 0.125
    signals = dict(inputs=t.model.outputs, outputs=t.model.inputs)
    gain = np.zeros((6, len(t.model.inputs), len(t.model.outputs)))
    still = hj.linear.LDTP(
        np.zeros((6, 1, 1)), 0 * gain[:, :1], 0 * gain[:, :, :1], gain, **signals
    )
    yield t.model.htf(lines).feedback, dict(controller=still.htf(lines))
    yield t.estimate.require_sampled, dict(name="a fit")
    htf = t.estimate
    yield htf.__getitem__, dict(m=0)
    yield htf.select, dict(harmonics=0, outputs=None, inputs=None)
    yield htf.predict, dict(u=np.ones((12, 2)))
    for name in ("error", "harmonic_errors"):
        yield getattr(htf, name), dict(other=t.exact)


def designs(t):
    lines = dict(
        n_sections=6,
        periods=16,
        frequencies=(0.0, 3.0),
        amplitude=0.01,
    )
    yield hj.multisine, lines | dict(experiments=8, inputs=1)
    yield (
        hj.experiments.paper_design,
        dict(
            n_sections=20,
            periods=16,
            experiments=40,
            division="random",
        ),
    )
    cosines = dict(frequencies=[[0.25], [0.5]], amplitudes=0.01, phases=0.0)
    yield hj.experiments.Design.from_lines, cosines | dict(n_sections=6, periods=16)
    good = {
        name: getattr(t.one_input, name) for name in t.one_input.__dataclass_fields__
    }
    yield hj.experiments.Design, good
    yield t.design.scaled, dict(rms=1.0)
    yield t.design.realizations, dict(count=2)
    yield t.design.optimize_phases, dict(seed=0)


def experiments(t):
    to_run = dict(
        cycle=t.cycle,
        sections=t.placed,
        design=t.one_input,
        outputs=STATES,
    )
    yield hj.run_experiments, to_run
    small = hj.multisine(4, periods=16, amplitude=1e-4)
    whole = dict(
        system=t.cycle,
        sections=PHASE,
        outputs="x",
        order=1,
        design=small,
    )
    yield hj.identify_model, whole
    yield hj.experiments.StoredExperiments, dict(store="nope")
    yield (
        hj.experiments.response_function,
        {name: to_run[name] for name in ("cycle", "sections", "outputs")},
    )
    yield t.response, dict(u=np.zeros((1, 8, 1)))
    yield hj.experiments.simulate_experiments, dict(ldtp=t.model, design=t.design)
    yield hj.experiments.ProcessNoise, dict(std=0.1)
    yield hj.experiments.add_noise, dict(data=t.data, std=0.1)
    y = np.ones(t.data.y.shape)
    yield (
        hj.experiments.ExperimentData,
        dict(
            u=t.data.u,
            y=y,
            n_sections=6,
            periods=16,
        ),
    )
    one = t.record
    yield hj.experiments.SectionSeries, dict(u=one.u, y=one.y, n_sections=6)
    yield one.part, dict(first=0, stop=12)


def estimates(t):
    yield hj.estimate_htf, dict(data=t.data, harmonics=0)
    yield hj.identify.estimate_loop, dict(data=t.data, at_input=t.data.inputs[1])
    yield hj.identify.remove_transient, dict(data=t.repeated, order=2)
    yield hj.identify.fit_rational, dict(htf=t.estimate, output=0)
    yield t.rational.htf, dict(frequencies=np.array([0.1, 0.2]))
    yield t.rational.compare, dict(true=[0.5])
    yield hj.fit_multipliers, dict(htf=t.estimate, order=2, extra_lags=6)
    yield t.structured.htf, dict(frequencies=np.array([0.1, 0.2]))
    true = np.asarray(t.model.multipliers)
    yield t.structured.distance, dict(true=true)
    yield t.structured.compare, dict(true=true)
    yield t.structured.contains, dict(true=true)
    yield t.structured.interval, dict(level=0.9)
    yield t.data.__getitem__, dict(name=t.data.outputs[0])
    yield hj.select_order, dict(data=t.estimate, extra_lags=6)
    yield hj.identify.cramer_rao, dict(model=t.model, htf=t.uncertain)
    yield hj.fit_ldtp, dict(data=t.uncertain, initial=t.model)
    yield t.joint.htf, dict(frequencies=np.array([0.1, 0.2]))
    yield t.driven.noise_spectrum, dict(frequencies=np.array([0.1, 0.2]))
    yield (
        hj.identify.cramer_rao,
        dict(estimator="fit_ldtp", model=t.model, htf=t.uncertain),
    )


def series(t):
    yield hj.fit_series, dict(data=t.record, order=2)
    yield t.fit.impulse_response, dict(n_lags=3)
    yield t.fit.interval, dict(level=0.9)
    yield t.fit.htf, dict(frequencies=np.array([0.1, 0.2]))
    yield hj.validate, dict(model=t.fit, data=t.record)


def fitting(t):
    both = dict(
        system=t.system,
        data=t.observed,
        free=("mu",),
        guess=t.cycle,
    )
    yield hj.fit_model, both
    yield hj.fitting.identifiability, both
    yield hj.fitting.spectral_radius, dict(model=t.model)
    yield hj.fitting.ObservedHTF, dict(htf=t.htf, sections=PHASE)
    yield hj.fitting.ObservedSeries, dict(data=t.series, sections=PHASE)
    seen = dict(
        outputs=STATES, values=np.ones((4, 2)), times=np.arange(4.0), period=1.0
    )
    yield hj.fitting.ObservedCycle, dict(sections=PHASE) | seen
    yield (
        hj.fitting.ObservedCycle.of,
        dict(cycle=t.cycle, sections=PHASE, outputs=STATES),
    )
    for name in ("ObservedCycle", "ObservedHTF"):
        made = (
            t.observed
            if name == "ObservedCycle"
            else hj.fitting.ObservedHTF(t.htf, PHASE)
        )
        for method in ("residuals", "prepare"):
            yield getattr(made, method), dict(cycle=t.cycle)


def designs_data(t):
    ask = hj.designs.MultiplierGoal(harmonics=0, extra_lags=6)
    yield hj.optimal_design, dict(model=t.model, design=t.design, goal=ask)
    yield hj.designs.ParameterGoal, dict(cycle=t.cycle, sections=PHASE, free=("mu",))
    yield hj.designs.ResponseGoal, dict(frequencies=(0.1, 1.0))
    yield hj.designs.Limits, dict(rms={"u0": 1.0})
    limits = hj.designs.Limits(rms={"u0": 1.0}, cycles=64)
    yield limits.require_inputs, dict(inputs=("u0",))
    yield limits.experiments, dict(design=t.design, cosines=4)
    yield hj.designs.Distortion, dict(cycle=t.cycle, sections=PHASE, rms={"x": 1.0})
    yield (
        hj.designs.SequentialDesign,
        dict(first=t.one_input, order=1, standard_error=1.0),
    )
    yield t.study.add, dict(data=t.block)
    yield hj.designs.draw_models, dict(fit=t.joint, count=1)
    yield t.plan.cycles_for, dict(standard_error=1.0)


def recordings(t):
    x = np.arange(5.0)
    yield hj.Recording, dict(time=x, signals={"x": x})
    yield hj.Recording.from_frame, dict(frame={"time": x, "x": x})
    yield t.recording.with_trials, dict(trials=t.recording.trials)
    yield hj.Recording.join, dict(recordings=[t.recording])
    yield hj.Recording.beside, dict(recordings=[t.recording])
    rises = hj.Crossing("x", "rising")
    angle = hj.KinematicPhase(4, position="x", velocity="v")
    yield t.recording.mark, dict(event="e", crossing=rises)
    yield t.recording.crop, dict(start=0.0, stop=1.0)
    for name in ("column", "samples", "unit", "__getitem__"):
        yield getattr(t.recording, name), dict(name="x")
    yield hj.recordings.estimate_phase, dict(recording=t.recording, sections=angle)
    take = dict(
        recording=t.recording,
        sections=t.phase,
        inputs="f",
        outputs=("x", "v"),
        n_sections=2,
    )
    yield hj.recordings.sample_sections, take
    yield hj.identify_recording, take | dict(order=1)
    yield t.section_data.experiments, dict(periods=4)
    yield t.section_data.of_inputs, dict(names=("f",))
    yield t.section_data.with_drift, dict(cycles=10)
    yield (
        hj.recordings.check_recording,
        dict(recording=t.recording, inputs="f", outputs=("x", "v")),
    )
    yield hj.recordings.diagnose, dict(data=t.section_data, fit=t.found.fit)
    yield hj.select_order, dict(data=t.section_data)
    yield hj.recordings.hold_out, dict(data=t.section_data, order=1)
    yield hj.recordings.impulse_responses, dict(fit=t.found.fit, data=t.found.data)
    yield t.found.responses.of_model, dict(model=t.model)
    yield (
        without_drift,
        dict(
            recording=t.recording,
            phase=t.phase,
            signals="x",
            cycles=5.0,
        ),
    )
    table = dict(recording=t.recording, phase=t.phase, path="nope.csv")
    yield hj.recordings.attach_design, table
    yield t.one_input.write, dict(path="missing/d.csv")
    yield positional(hj.read_recording), dict(values="nope.csv")


def subjects(t):
    population = t.population
    maps = t.maps
    yield population.from_fits, dict(fits=[t.fit, t.fit], table={"subject": ["a", "b"]})
    for call in (population.mean, population.predictions, population.allocation):
        yield call, dict(quantity="m")
    two = dict(a="old", b="new")
    yield population.difference, dict(quantity="m") | two
    yield (
        population.power,
        dict(
            quantity="m",
            difference=0.1,
            subjects=(4,),
            draws=2,
        ),
    )
    yield maps.mean, dict(label="old")
    yield maps.difference, two
    yield population.plot, dict(quantity="m")
    yield hj.plot.paired, dict(population=population, quantity="m") | two
    yield maps.mean().plot, dict(ax=None)
    study = dict(table="nope.csv", folder="missing/x", identify=hj.identify_recording)
    yield hj.identify_subjects, study


def plants(t):
    yield (
        hj.plants.find_cycle,
        dict(plant=t.plant, sections=hj.ClockPhase(4), outputs=("x", "v")),
    )
    yield t.settled.run_experiments, dict(design=np.zeros((1, 88, 1)))
    yield t.settled.trajectory, dict(u=np.zeros((4, 1)))
    yield t.settled.perturbed_returns, dict(coordinates=("x", "v"))
    names = dict(inputs=("u",), signals=("x",), dt=0.1)
    yield hj.plants.MuJoCoPlant, dict(model=None, inputs=())
    yield hj.plants.FMUPlant, dict(file="nope.fmu") | names
    yield hj.plants.GymnasiumPlant, dict(environment=dict) | names


def testing(t):
    yield hj.testing.add_artifacts, dict(recording=t.recording, signals=("x",))
    yield hj.experiments.random_input, dict(duration=10, rate=50, bandwidth=5)
    force = np.zeros((1, 50, 1))
    yield (
        hj.testing.simulate_recording,
        dict(
            cycle=t.cycle,
            force=force,
            outputs=STATES,
            rate=16,
        ),
    )


def files(t):
    yield hj.save, dict(path="missing/thing.npz", thing=t.model)
    yield hj.load, dict(path="thing.npz")
    yield t.found.write_report, dict(folder="report")
    yield t.found_without_push.write_report, dict(folder="report")


def conversions(t):
    yield hj.convert.to_lti, dict(model=t.model)
    yield hj.convert.to_scipy, dict(model=t.model)
    yield hj.convert.to_control, dict(thing=t.model)
    yield hj.convert.to_harmonic_state_space, dict(cycle=t.cycle)
    lifted = hj.convert.to_harmonic_state_space(t.cycle)
    yield lifted.transfer, dict(frequencies=[0.1], period=1.0)
    yield hj.convert.to_xarray, dict(thing=t.model)
    yield hj.convert.from_xarray, dict(dataset=hj.convert.to_xarray(t.model))


def plots(t):
    plot = hj.plot
    yield positional(plot.bode), dict(values=t.estimate)
    yield positional(plot.bode), dict(values={"a": t.estimate})
    yield positional(plot.htf), dict(values={"a": t.estimate})
    yield positional(plot.htf), dict(values=t.estimate)
    yield plot.spectrum, dict(plan=t.plan, model=t.model)
    yield plot.standard_errors, dict(plan=t.plan, studies={"a": t.studied})
    yield plot.cycle, dict(cycle=t.cycle)
    yield plot.animate, dict(motion=t.cycle)
    yield hj.explore, dict(system=t.cycle, ranges={"a": (-9.0, 9.0)})
    yield hj.experiments.perturbed_trajectory, dict(placed=t.placed, inputs=t.data.u[0])
    yield plot.return_map, dict(cycle=t.cycle)
    yield positional(plot.branch), dict(values=t.branch)
    yield t.data.plot, dict(index=0)
    yield plot.multipliers, dict(true=np.array([0.5]))
    yield plot.poles_zeros, dict(fits={"a": t.rational})
    yield t.found.responses.plot, dict(model=None, input=0)
    yield t.phase.plot, dict(ax=None)
    yield t.section_data.plot, dict(ax=None)
    yield t.validation.plot, dict(cycles=4)
    yield t.plot.save, dict(path="missing/figure")


def rhythms(t):
    charts = {"up": t.system.charts()["plane"], "down": t.system.charts()["plane"]}

    def surface(time, q):
        return q[0]

    yield hj.systems.filippov, dict(charts=charts, surface=surface)
    yield t.cycle.simultaneous_events, {}
    about = dict(recording=t.recording, sections=BEAT, input="f")
    yield hj.recordings.phase_response, about
    yield hj.plot.phase_response, dict(curve=t.beats)
    at = dict(phase=[0.1, 0.2])
    yield t.beats, at
    yield t.beats.interval, at
    yield t.beats.with_jitter, at
    on = dict(recording=t.recording, sections=hj.AtEvent("strike"))
    yield t.beats.forecast, on
    yield hj.recordings.natural_multipliers, dict(data=t.variability)
    natural = hj.recordings.natural_multipliers(t.variability)
    yield natural.compare, dict(true=[0.5])
    yield natural.contains, dict(true=[0.5])
    yield hj.testing.simulate_beats, dict(curve=[1.0], force=jnp.ones((1, 99)))


def without_arguments(t):
    natural = hj.recordings.natural_multipliers(t.variability)
    data = t.data
    design = t.design
    for call in (
        hj.scale.Execution,
        hj.designs.MultiplierGoal,
        natural.interval,
        t.trajectory,
        t.trajectory.dense,
        t.cycle.trajectory,
        t.cycles.summary,
        t.model.monodromy,
        t.model.rank,
        t.estimate.confidence_radius,
        design.signals,
        design.expected_variance,
        design.cycles,
        data.windows,
        data.summary,
        t.structured.ellipse,
    ):
        yield call, {}


def short_forms(t):
    """Parameters as keywords, and states by name."""
    yield hj.sweep, dict(model=t.system, values={"nope": [1.0]}, mu=[0.1, 0.2])
    yield hj.continuation, dict(cycle=t.cycle, mu=(0.1, 0.2), step=0.05)
    start = hj.Guess("plane", (1.0, 0.0))
    yield hj.flow(t.system, start, 0.1).__getitem__, dict(name="x")


PARTS = (
    without_arguments,
    scale,
    systems,
    sections,
    cycles,
    linear,
    transfer_functions,
    designs,
    experiments,
    estimates,
    series,
    fitting,
    designs_data,
    recordings,
    subjects,
    plants,
    testing,
    files,
    conversions,
    plots,
    rhythms,
    short_forms,
)
