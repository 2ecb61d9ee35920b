"""Hostile calls of what concerns systems, cycles, sections, linear models and experiments."""

import jax.numpy as jnp
import numpy as np

import hybridjax as hj

from .things import APEX, NAMES as STATES, PHASE
from .values import (
    CALLABLE,
    COUNT,
    EXECUTION,
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
    NUMBER,
    OUTPUTS,
    PATH,
    POSITIVE,
    SEED,
    SHARE,
    TRACED,
    WHOLE,
    WORD,
    Other,
    Right,
    array,
    instance,
    optional,
)  # fmt: skip


SECTIONS = [None, "ClockPhase", 8, [], [3], NAN, Other(), hj.Execution(), TRACED]
PAIR = ["ab", 1.0, (1.0,), (1.0, 2.0, 3.0), (NAN, 1.0), (1j, 0.0), (None, 1.0), TRACED]
SIZES = ["x", 3, ["x"], {"x": -1.0}, {"x": NAN}, {"x": "1"}, {"x": 1j}, {"nope": 1.0}]
CLIENTS = [
    "tcp://here", 3, Other(), 1, (0,), (2, 2), (-1, 2), (0, 0), (0.5, 2), ("0", "2"),
]  # fmt: skip
RANGES = [None, 3, {}, {"x": 3}, {"x": (1.0,)}, {"x": (1.0, 0.0)}, {"x": (0.0, NAN)}, Other()]
VALUES = [None, 3, {}, {"x": []}, {"x": [NAN]}, {"x": ["1"]}, {"x": [1.0], "y": [1.0, 2.0]}]
BAND = [2.0, (1.0,), ("0", "1"), (NAN, 1.0), (0.0, INF), (-1.0, 1.0), (1.0, 0.5), (0.0, 1j)]
CHANNELS = [None, 0, -1, 1.5, True, (), ("u", "u"), (3, 4), HUGE, Other()]


def calls(t):
    """Name, function, good arguments, hostile values of each argument."""
    yield from systems(t)
    yield from sections(t)
    yield from cycles(t)
    yield from linear(t)
    yield from designs(t)
    yield from experiments(t)
    yield from scale(t)


def scale(t):
    """In pieces."""
    pieces = {"chunk": COUNT[1:], "store": PATH[1:], "client": CLIENTS}
    yield (
        "sweep",
        hj.sweep,
        dict(model=t.system, over={"nope": [1.0]}, guess=t.cycle),
        {
            "model": [None, "Hopper", 3, Other()],
            "over": [*VALUES, {"nope": [1.0]}],
            "want": WORD,
            "guess": [3, "cycle", Other()],
            "force": FLAG,
            **pieces,
        },
    )
    yield (
        "monte_carlo",
        hj.monte_carlo,
        dict(function=lambda rng: "no number", draws=3),
        {"function": CALLABLE, "draws": LIMITED, "seed": SEED, **pieces},
    )
    yield "Points", hj.scale.Points, dict(values={"x": [1.0]}), {"values": VALUES}
    good = dict(ranges={"x": (0.0, 1.0)}, count=4)
    wrong = {"ranges": RANGES, "count": LIMITED, "seed": SEED}
    yield "Points.sobol", hj.scale.Points.sobol, good, wrong


def systems(t):
    def flow(time, q, u):
        return q[0]

    yield "Guess", hj.Guess, dict(chart="plane", state=(1.0, 0.0), time=0.0, after="hit"), {
        "chart": NEW_NAME, "state": array([1.0, 0.0], free=True), "time": FINITE,
        "after": optional(NEW_NAME),
    }  # fmt: skip
    yield "Output", hj.Output, dict(name="z", function=flow), {
        "name": NEW_NAME, "function": [*CALLABLE, {3: flow}, {"flow": 3}],
    }  # fmt: skip
    ends = dict(name="hit", source="flow", target="flow", guard=flow)
    yield "Transition", hj.Transition, ends | dict(direction="falling", reset=flow), {
        "name": NEW_NAME, "source": NEW_NAME, "target": NEW_NAME, "guard": CALLABLE,
        "direction": WORD, "reset": CALLABLE, "enabled": optional(CALLABLE),
    }  # fmt: skip
    yield "Scheduled", hj.Scheduled, dict(period=1.0, offset=0.0), {
        "period": POSITIVE, "offset": FINITE,
    }  # fmt: skip
    yield "parameter", hj.parameter, dict(default=1.0), {
        "default": ["1", 1j, NAN, [1.0, "x"], Other()], "doc": [None, 3], "unit": [None, 3],
    }  # fmt: skip
    yield "VerticalHopper", hj.models.VerticalHopper, dict(k=10.0), {
        "k": ["10", 1j, NAN, INF, Other(), {}],
    }  # fmt: skip
    yield "BouncingChain", hj.models.BouncingChain, dict(n=2), {"n": COUNT, "k": ["1", NAN]}
    yield "enable_vector_math", hj.enable_vector_math, dict(enabled=True), {"enabled": FLAG}
    yield "enable_progress", hj.enable_progress, dict(enabled=False), {"enabled": FLAG}
    yield "enable_compilation_cache", hj.enable_compilation_cache, dict(folder=None), {
        "folder": optional(PATH),
    }  # fmt: skip
    yield "Execution", hj.Execution, {}, {
        "batch": optional(COUNT), "workers": optional(LIMITED), "precision": WORD,
    }  # fmt: skip
    yield "Settings", hj.Settings, dict(rtol=1e-9, atol=1e-9), {
        "rtol": optional([*POSITIVE, Right(np.float32(1e-6)), Right(jnp.array(1e-6))]),
        "atol": optional(POSITIVE),
        "max_steps": LIMITED, "scale": ["x", 1.0, [1.0], [[NAN]], [[-1.0]], [[1j]], Other()],
    }  # fmt: skip
    yield "simulate", hj.simulate, dict(
        system=t.system, chart="plane", state=(1.0, 0.0), duration=0.1, time=0.0
    ), {
        "system": instance(t.design), "chart": NAME, "state": array([1.0, 0.0]),
        "duration": POSITIVE, "time": FINITE, "input": ["f", [1.0, 2.0, 3.0], [NAN], [1j], Other()],
        "settings": ["fast", 1e-9, PHASE], "max_steps": LIMITED, "throw": FLAG,
    }  # fmt: skip
    yield "Trajectory", t.trajectory, {}, {"per_step": LIMITED}
    yield "Trajectory.dense", t.trajectory.dense, {}, {"per_step": LIMITED}


def sections(t):
    yield "Crossing", hj.Crossing, dict(function="y", direction="falling", value=0.0), {
        "function": CALLABLE[:2] + CALLABLE[3:], "direction": WORD, "value": FINITE,
        "charts": [3, (3,), (), ("plane", "plane"), Other()],
    }  # fmt: skip
    yield "AtEvent", hj.AtEvent, dict(name="hit"), {"name": NEW_NAME}
    yield "ClockPhase", hj.ClockPhase, dict(n_sections=8, anchor=0.0), {
        "n_sections": [*LIMITED, Right(np.int64(8))], "anchor": ["v", 1j, NAN, INF, [1.0], Other()],
    }  # fmt: skip
    turn = dict(n_sections=8, position="x", velocity="y", center=(0.0, 0.0), scale=(1.0, 1.0))
    yield "KinematicPhase", hj.KinematicPhase, turn, {
        "n_sections": LIMITED, "position": NEW_NAME, "velocity": NEW_NAME, "center": PAIR,
        "scale": [*PAIR, (0.0, 1.0), (-1.0, 1.0)], "anchor": ["v", 1j, NAN, INF, [1.0], Other()],
    }  # fmt: skip
    yield "SectionList", hj.SectionList, dict(items=[APEX]), {
        "items": [None, "y", [], [3], APEX, [PHASE], ["y"], Other()],
    }  # fmt: skip
    yield "place_sections", hj.place_sections, dict(cycle=t.cycle, sections=PHASE), {
        "cycle": instance(t.system), "sections": [*SECTIONS, hj.AtEvent("nope"), t.model],
    }  # fmt: skip
    yield "PlacedSections.observe", t.placed.observe, dict(outputs=STATES), {"outputs": OUTPUTS}
    yield "linearize", hj.linearize, dict(cycle=t.cycle, sections=t.placed, outputs=STATES), {
        "cycle": instance(t.system), "sections": SECTIONS, "outputs": optional(OUTPUTS),
        "inputs": optional(NAMES),
    }  # fmt: skip
    yield "section_map", hj.section_map, dict(cycle=t.cycle, sections=t.placed, i=0, j=1), {
        "cycle": instance(t.system), "sections": SECTIONS, "i": [*INTEGER, HUGE],
        "j": [*INTEGER, HUGE, -HUGE],
    }  # fmt: skip
    yield "SectionMap", t.map, dict(q=t.map.fixed_point), {
        "q": array(t.map.fixed_point), "u": ["x", [1.0, 2.0], [1j], [NAN], Other()],
        "t": ["x", 1j, NAN, [1.0, 2.0], Other()],
    }  # fmt: skip


def cycles(t):
    yield "find_limit_cycle", hj.find_limit_cycle, dict(system=t.system, guess=t.cycle), {
        "system": instance(PHASE, t.cycle), "guess": ["flow", (1.0, 0.0), 3, Other(), PHASE],
        "section": ["y", 3, PHASE, Other()], "multiplicity": optional(LIMITED),
        "conserved": ["x", 3, ["x"], {"x": NAN}, {"x": "1"}, {"nope": 1.0}], "settle": NONNEGATIVE,
        "max_period": optional(POSITIVE), "scale": SIZES, "settings": ["fast", 1e-9, PHASE],
        "throw": FLAG,
    }  # fmt: skip
    yield "LimitCycle.trajectory", t.cycle.trajectory, {}, {"periods": POSITIVE}
    yield "find_limit_cycles", hj.find_limit_cycles, dict(
        systems=[t.system, t.system], guess=t.cycle
    ), {
        "systems": [*instance(PHASE), [], [3], [t.system, PHASE]], "guess": instance(t.system),
        "scale": SIZES, "settings": ["fast", 1e-9, PHASE], "execution": EXECUTION,
    }  # fmt: skip
    yield "LimitCycles.__getitem__", t.cycles.__getitem__, dict(i=0), {"i": INTEGER}
    yield "LimitCycles.summary", t.cycles.summary, {}, {"limit": WHOLE}
    yield "continuation", hj.continuation, dict(
        cycle=t.cycle, parameter="mu", values=(0.1, 0.2), step=0.05
    ), {
        "cycle": instance(t.system), "parameter": NAME, "step": POSITIVE, "max_points": COUNT,
        "values": [None, "ab", 0.1j, (), (0.2, 0.3), (0.1, NAN), (0.1, INF), (0.1, 0.1), TRACED],
    }  # fmt: skip
    yield "Branch.__getitem__", t.branch.__getitem__, dict(k=0), {"k": INTEGER}
    yield "Branch.find", t.branch.find, dict(kind="fold"), {"kind": WORD}
    yield "Branch.largest", t.branch.largest, dict(output="x"), {"output": NAME}


def linear(t):
    A, B, C, D = (np.asarray(x) for x in (t.model.A, t.model.B, t.model.C, t.model.D))
    matrices = dict(A=A, B=B, C=C, D=D, dims=np.asarray(t.model.dims))
    yield "LDTP", hj.LDTP, matrices, {
        "A": array(A), "B": array(B), "C": array(C), "D": optional(array(D)),
        "dims": ["x", [3], [3, 2] * 2, [3.5, 2] * 3, [-1] * 6, [9] * 6, [NAN] * 6, [1j] * 6],
        "inputs": NEW_NAMES, "outputs": NEW_NAMES,
        "coordinates": ["x", 3, [], [[3]] * 6],
    }  # fmt: skip
    square = [np.eye(2)] * 3
    blocks = [None, "x", 3, [], square[:2], [np.eye(3), *square[1:]], [[[NAN]]] * 3, [[[1j]]] * 3]
    yield "LDTP.from_blocks", hj.LDTP.from_blocks, dict(A=square, B=square, C=square, D=square), {
        "A": blocks, "B": blocks, "C": blocks, "D": optional(blocks), "inputs": NEW_NAMES,
        "outputs": NEW_NAMES, "coordinates": ["x", 3, [], [[3]] * 3],
    }  # fmt: skip
    u = np.ones((12, 2))
    start = ["x", np.zeros(9), [NAN] * 3, [1j] * 3, Other()]
    first = INTEGER
    for name in ("states", "simulate"):
        yield f"LDTP.{name}", getattr(t.model, name), dict(u=u), {
            "u": array(u), "x0": start, "first_section": first,
        }  # fmt: skip
    for name, v in (("periodic_state", u), ("periodic_states", u[None])):
        yield f"LDTP.{name}", getattr(t.model, name), dict(u=v, periods=2), {
            "u": array(v), "periods": LIMITED,
        }  # fmt: skip
    yield "LDTP.impulse_response", t.model.impulse_response, dict(n_lags=3), {"n_lags": LIMITED}
    yield "LDTP.htf", t.model.htf, dict(f=np.array([0.1, 0.2])), {
        "f": array([0.1, 0.2], empty=True), "harmonics": HARMONICS,
    }  # fmt: skip
    yield "LDTP.monodromy", t.model.monodromy, {}, {"section": first}
    yield "LDTP.rank", t.model.rank, {}, {"section": first, "rtol": NONNEGATIVE}
    f, H = np.asarray(t.estimate.f), np.asarray(t.estimate.H)
    size = np.ones(H.shape)
    yield "HTF", hj.HTF, dict(
        f=f, H=H, harmonics=(-1, 0, 1), n_sections=6, variance=size, noise_variance=size,
        scatter=hj.Scatter(np.ones(len(f)), size),
    ), {
        "f": array(f), "H": [*array(H.real)[:7], H[:1], H[..., :1], H * NAN], "n_sections": LIMITED,
        "harmonics": [None, *HARMONICS], "inputs": NEW_NAMES, "outputs": NEW_NAMES,
        "source": [None, 3], "variance": ["abc", size[:1], -size, size + 1j],
        "noise_variance": ["abc", size[:1], -size, size + 1j],
        "scatter": [3, "abc", f, hj.Scatter(f[:1]), hj.Scatter(f, size[:1])],
    }  # fmt: skip
    scatter = hj.Scatter(f, size)
    yield "Scatter", hj.Scatter, dict(freedom=f, roundness=size), {
        "freedom": [*array(f), -f - 1], "roundness": ["abc", size[0], -size, 4 * size, size + 1j],
    }  # fmt: skip
    yield "Scatter.quantile", scatter.quantile, dict(level=0.9), {"level": SHARE}
    htf = t.estimate
    yield "HTF.harmonic", htf.harmonic, dict(m=0), {"m": INTEGER}
    yield "HTF.__getitem__", htf.__getitem__, dict(m=0), {"m": INTEGER}
    yield "HTF.select", htf.select, dict(harmonics=0), {"harmonics": [None, *HARMONICS, 5]}
    yield "HTF.at", htf.at, dict(f=f[:2]), {"f": [*array(f[:2], empty=True), f[:2] + 0.01]}
    yield "HTF.interpolate", htf.interpolate, dict(f=f[:2]), {"f": array(f[:2], empty=True)}
    yield "HTF.confidence_radius", htf.confidence_radius, {}, {"level": SHARE}
    yield "HTF.predict", htf.predict, dict(u=u), {"u": array(u)}
    for name in ("error", "harmonic_errors"):
        yield f"HTF.{name}", getattr(htf, name), dict(other=t.exact), {"other": instance(t.model)}


def designs(t):
    lines = dict(n_sections=6, periods=16, band=(0.0, 3.0), amplitude=0.01)
    yield "multisine", hj.multisine, lines | dict(experiments=8, inputs=1), {
        "n_sections": LIMITED, "periods": LIMITED, "band": BAND,
        "amplitude": [*POSITIVE, Other(), lambda f: "x", lambda f: -f, lambda f: f * NAN],
        "seed": SEED, "lines": WORD, "division": WORD, "experiments": optional(LIMITED),
        "highest_harmonic": optional(WHOLE), "inputs": CHANNELS,
    }  # fmt: skip
    yield "paper_design", hj.paper_design, lines | dict(experiments=8), {
        "n_sections": LIMITED, "periods": LIMITED, "band": BAND, "amplitude": POSITIVE,
        "seed": SEED, "division": WORD, "experiments": LIMITED,
    }  # fmt: skip
    yield "single_cosine", hj.experiments.single_cosine, dict(f=0.25, n_sections=6, periods=16), {
        "f": [*NUMBER[:5], (), [NAN], -0.25, 0.3, 1e9], "n_sections": LIMITED, "periods": LIMITED,
        "amplitude": POSITIVE, "phase": FINITE, "half_integers": WORD, "inputs": CHANNELS,
    }  # fmt: skip
    amounts = ["1", 1j, NAN, -1.0, [[1.0]], [["x"]], Other()]
    yield "Design.from_lines", hj.Design.from_lines, dict(
        frequencies=[[0.25], [0.5]], amplitudes=0.01, phases=0.0, n_sections=6, periods=16
    ), {
        "frequencies": [None, "x", 0.25, [], [[NAN]], [["x"]], [[1j]], [[9e9]], [[-0.25]], [[]]],
        "amplitudes": amounts, "phases": amounts[:3] + amounts[4:], "n_sections": LIMITED,
        "periods": LIMITED, "channels": ["0", 0.5, -1, 5, [[0]], [["x"], [0]], Other()],
        "inputs": CHANNELS,
    }  # fmt: skip
    good = {name: getattr(t.one_input, name) for name in t.one_input.__dataclass_fields__}
    yield "Design", hj.Design, good, {
        "experiment": [None, "x", good["experiment"][:-1], good["experiment"] + 0.5, Other()],
        "line": [None, "x", good["line"][:-1], -good["line"] - 1, Other()],
        "channel": [None, "x", good["channel"][:-1], good["channel"] + 1, Other()],
        "amplitude": array(good["amplitude"]), "phase": array(good["phase"]),
        "n_sections": LIMITED, "periods": LIMITED, "experiments": LIMITED,
        "input_names": [None, (), (3,), ("u", "v", "v"), Other()],
        "highest_harmonic": optional(WHOLE),
    }  # fmt: skip
    yield "Design.inputs", t.design.inputs, {}, {
        "cycles": optional(LIMITED), "experiments": [3, "x", (0, 1), Other()],
    }  # fmt: skip
    yield "Design.scaled", t.design.scaled, dict(rms=1.0), {"rms": POSITIVE}
    yield "Design.realizations", t.design.realizations, dict(count=2), {
        "count": LIMITED, "seed": SEED,
    }  # fmt: skip
    yield "Design.expected_variance", t.design.expected_variance, {}, {
        "noise": NONNEGATIVE, "repeats": COUNT,
    }  # fmt: skip
    yield "Design.cycles", t.design.cycles, {}, {"discard": WHOLE}
    yield "optimize_phases", hj.experiments.optimize_phases, dict(design=t.design), {
        "design": instance(t.model), "seed": SEED,
    }  # fmt: skip


def experiments(t):
    to_run = dict(cycle=t.cycle, sections=t.placed, design=t.one_input, outputs=STATES)
    inputs = np.zeros((1, 80, 1))
    drive = {
        "cycle": instance(t.system), "sections": SECTIONS, "outputs": OUTPUTS,
        "design": [None, "x", 3, t.design, np.zeros((2, 2)), inputs * NAN, inputs + 1j, Other()],
    }  # fmt: skip
    options = {
        "start": WORD, "discard": optional(WHOLE), "process_noise": [0.1, "x", PHASE],
        "accuracy": optional(POSITIVE), "record_events": FLAG, "execution": EXECUTION,
    }  # fmt: skip
    yield "run_experiments", hj.run_experiments, to_run, drive | options
    yield "Options", hj.experiments.Options, {}, options
    stored = {"options": instance(PHASE), "chunk": LIMITED, "store": PATH[1:], "client": CLIENTS}
    yield "stream_experiments", hj.experiments.stream_experiments, to_run, drive | stored
    yield "StoredExperiments", hj.experiments.StoredExperiments, dict(store="nope"), {
        "store": [*PATH, "nope"],
    }  # fmt: skip
    yield (
        "response_function",
        hj.response_function,
        {name: to_run[name] for name in ("cycle", "sections", "outputs")},
        {name: drive[name] for name in ("cycle", "sections", "outputs")} | {"accuracy": POSITIVE},
    )
    u = np.zeros((1, 8, 1))
    yield "ResponseFunction", t.response, dict(u=u), {
        "u": array(u), "start": ["x", np.zeros(9), Other()], "system": ["x", 3, PHASE],
    }  # fmt: skip
    yield "steady_start", t.response.steady_start, dict(u=u), {
        "u": array(u),
        "system": ["x", 3, PHASE], "accuracy": POSITIVE,
    }  # fmt: skip
    yield "simulate_experiments", hj.experiments.simulate_experiments, dict(
        ldtp=t.model, design=t.design
    ), {
        "ldtp": instance(t.design), "design": instance(t.model, t.one_input),
        "discard": optional(WHOLE), "start": WORD, "process_noise": [0.1, "x", PHASE],
    }  # fmt: skip
    yield "ProcessNoise", hj.experiments.ProcessNoise, dict(std=0.1), {
        "std": ["1", 1j, NAN, True, INF, -1.0, [0.1, -0.1], [[0.1]], Other()], "seed": SEED,
        "memory": NONNEGATIVE,
    }  # fmt: skip
    yield "add_noise", hj.experiments.add_noise, dict(data=t.data, std=0.1), {
        "data": instance(t.design), "std": ["1", 1j, NAN, True, INF, -1.0, [0.1] * 3, Other()],
        "seed": SEED, "memory": NONNEGATIVE,
        "snr": ["x", 1j, NAN, Other(), 10.0],
    }  # fmt: skip
    y = np.ones(t.data.y.shape)
    yield "ExperimentData", hj.ExperimentData, dict(u=t.data.u, y=y, n_sections=6, periods=16), {
        "u": array(t.data.u), "y": array(y, missing=True), "n_sections": LIMITED,
        "periods": LIMITED, "inputs": NEW_NAMES, "outputs": NEW_NAMES,
        "result": ["x", [0], [0.5] * len(y), [99] * len(y), Other()],
        "simulated": [3, "x", PHASE, Other()], "cycle_outputs": ["x", [1.0], y[0] * NAN, Other()],
        "label": [None, 3],
    }  # fmt: skip
    yield "ExperimentData.windows", t.data.windows, {}, {"repeats": LIMITED}
    yield "ExperimentData.summary", t.data.summary, {}, {"limit": WHOLE}
    one = t.record
    yield "Record", hj.Record, dict(u=one.u, y=one.y, n_sections=6), {
        "u": array(one.u, missing=True), "y": array(one.y, missing=True), "n_sections": LIMITED,
        "first_section": [*INTEGER, HUGE], "inputs": NEW_NAMES, "outputs": NEW_NAMES,
        "lead": WHOLE, "drift": ["x", 1j, NAN, 0.0, -1.0, True],
    }  # fmt: skip
    yield "Record.part", one.part, dict(first=0, stop=12), {"first": INTEGER, "stop": INTEGER}
