"""The paper from end to end: from the hopper to its Floquet multipliers, beside the exact answer.

Ankarali & Cowan, Sec. VI. `hybridjax reproduce --out DIR` runs this.
"""

import dataclasses
import json
import os
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import equinox as eqx
import numpy as np

from .. import __version__
from .._core.compilation.compilation_cache import enable_compilation_cache
from .._core.files.results_folder import results_folder
from .._core.precision import enable_x64
from ..engine.trajectory import Trajectory, simulate
from ..errors import ComputationError, DefinitionError
from ..experiments.data import ExperimentData
from ..experiments.design.design import Design
from ..experiments.design.multisine import paper_design
from ..experiments.run import run_experiments
from ..identify.htf.nonparametric import estimate_htf
from ..identify.multipliers.structured import StructuredFit, fit_multipliers
from ..identify.rational.fit import RationalFit, fit_rational
from ..linear.htf import HTF
from ..linear.ldtp import LDTP
from ..maps.linearize import linearize
from ..maps.place import place_sections
from ..maps.placed import PlacedSections
from ..models.hopper import VerticalHopper
from ..orbits.cycle import LimitCycle
from ..orbits.find import find_limit_cycle
from ..sections.clock import ClockPhase
from ..sections.crossing import Crossing
from ..sections.kinematic import KinematicPhase
from .paper_report import OUTPUTS, summarize, table


SYMBOLS = {"yM": "$y_M$", "vM": r"$\dot y_M$"}
DEVIATIONS = {"yM": r"$\delta y_M$", "vM": r"$\delta \dot y_M$"}


@dataclasses.dataclass(frozen=True)
class Protocol:
    """What is done. The defaults are the paper's."""

    families: tuple[str, ...] = ("isochron", "kinematic")
    experiments: int = 80
    cycles: int = 84
    keep: int = 64
    n_sections: int = 32
    amplitude: float = 0.01
    seed: int = 0
    parameters: Mapping[str, float] = dataclasses.field(default_factory=dict)


class Family(eqx.Module):
    """Everything that was found with one family of sections."""

    placed: PlacedSections
    ldtp: LDTP
    exact: HTF
    data: ExperimentData
    estimate: HTF
    rational: RationalFit
    rational_exact: RationalFit
    structured: StructuredFit


class _Clock:
    """Prints what is being done, and keeps how long it took."""

    def __init__(self):
        self.begin = self.last = time.perf_counter()
        self.seconds: dict[str, float] = {}

    def done(self, what: str, text: str) -> None:
        now = time.perf_counter()
        self.seconds[what] = now - self.last
        print(f"[{now - self.begin:6.1f} s] {text}", flush=True)
        self.last = now


def reproduce(out: str | os.PathLike, protocol: Protocol) -> dict:
    """Run the protocol and write figures, `summary.json` and `results.npz` into the folder `out`.

    They appear when all of them are ready, and replace those of an earlier run. Other files in the
    folder stay as they are.

    **Returns:** what `summary.json` holds.

    **Raises:** `DefinitionError` for a protocol that cannot be carried out, a folder that cannot be
    written, or one in which another file has the name of a result; `ComputationError` if a step
    fails.
    """
    with results_folder(Path(out), "reproduce", _names(protocol.families)) as folder:
        return _reproduce(folder, protocol)


def _names(families: Sequence[str]) -> list[str]:
    """Of all that is written."""
    cycles = [f"fig1_cycle_{family}" for family in families]
    figures = [*cycles, "fig3_harmonics", "fig4_bode", "multipliers", "poles_zeros"]
    files = [f"{figure}{suffix}" for figure in figures for suffix in (".png", ".pdf")]
    return ["summary.json", "results.npz", *files]


def _reproduce(out: Path, protocol: Protocol) -> dict:
    enable_x64()
    enable_compilation_cache()
    clock = _Clock()
    hopper = _hopper(protocol.parameters)
    design = _design(protocol)
    clock.done("design", f"design: {design.experiments} experiments, {len(design.f)} frequencies")
    cycle = _find(hopper)
    multipliers = ", ".join(f"{z:.9f}" for z in cycle.multipliers)
    clock.done("cycle", f"limit cycle: period {float(cycle.period):.6g}, multipliers {multipliers}")
    families = {}
    for name in protocol.families:
        families[name] = _identify(cycle, name, design, protocol, clock)
    orbit = cycle.trajectory()
    perturbed = _perturbed(cycle)
    summary = summarize(protocol, cycle, families)
    _write_results(out / "results.npz", protocol, cycle, orbit, families)
    clock.done("results", "results.npz")
    for name in _figures(out, cycle, families, perturbed):
        clock.done(name, f"{name}.png, {name}.pdf")
    summary["seconds"] = {**clock.seconds, "total": time.perf_counter() - clock.begin}
    (out / "summary.json").write_text(json.dumps(summary, indent=2) + "\n")
    print(table(summary))
    return summary


def _hopper(parameters: Mapping[str, float]) -> VerticalHopper:
    known = [field.name for field in dataclasses.fields(VerticalHopper)]
    for name in parameters:
        if name not in known:
            raise DefinitionError(
                f"the hopper has no parameter '{name}'; parameters are {', '.join(known)}."
            )
    return VerticalHopper(**parameters)


def _design(protocol: Protocol) -> Design:
    """The paper's design, with second-order products kept off the lines where there is room."""
    if protocol.keep >= protocol.cycles:
        raise DefinitionError(
            f"--keep {protocol.keep} of --cycles {protocol.cycles} leaves no cycle to discard: the "
            "transient must die out first."
        )
    f_max = min(10.0, protocol.n_sections / 2 - 1 / protocol.keep)
    band = (0.0, f_max)
    arguments = (protocol.n_sections, protocol.keep, band, protocol.amplitude, protocol.seed)
    cosines = 2 * f_max * protocol.keep / protocol.experiments
    room = cosines <= protocol.keep / 4  # a quarter of the classes in each experiment
    return paper_design(
        *arguments,
        division="sum-free" if room else "random",
        experiments=protocol.experiments,
    )


def _find(hopper: VerticalHopper) -> LimitCycle:
    """The hopper's cycle by Newton from its own guess, or after the paper's 60 s of settling."""
    try:
        return find_limit_cycle(hopper)
    except ComputationError:
        return find_limit_cycle(hopper, settle=60.0)


def _sections(name: str, count: int):
    apex = Crossing("vM", "falling")
    if name == "isochron":
        return ClockPhase(count, anchor=apex)
    return KinematicPhase(
        count, position="yM", velocity="vM", center=(1.9, 0.0), scale=(0.3, 1.9), anchor=apex
    )


def _identify(cycle, name, design, protocol, clock) -> Family:
    placed = place_sections(cycle, _sections(name, protocol.n_sections))
    ldtp = linearize(cycle, placed, OUTPUTS)
    exact = ldtp.htf(design.frequencies)
    clock.done(f"exact_{name}", f"{name}: sections, exact A, B, C, D and HTF")
    data = run_experiments(cycle, placed, design, OUTPUTS, discard=protocol.cycles - protocol.keep)
    clock.done(f"experiments_{name}", f"{name}: experiments, {data.summary()}")
    if not data.ok.any():
        raise ComputationError(
            f"no experiment on {name} sections ran to its end: {data.summary()}. Take a smaller "
            "--amplitude."
        )
    estimate = estimate_htf(data)
    family = Family(
        placed,
        ldtp,
        exact,
        data,
        estimate,
        fit_rational(estimate),
        fit_rational(exact),
        fit_multipliers(estimate, ldtp),
    )
    clock.done(f"fits_{name}", f"{name}: HTF estimate, 2-pole 1-zero fits, structured fit")
    return family


def _perturbed(cycle: LimitCycle) -> Trajectory:
    start = dict(cycle.state)
    start["yM"] += 0.05
    chart = list(cycle.system.charts())[int(cycle.anchor.chart[0])]
    period = float(cycle.period)
    state = np.array(list(start.values()))
    return simulate(
        cycle.system, chart, state, 12 * period, time=float(cycle.anchor.t[0]), throw=False
    )


def _write_results(path, protocol, cycle, orbit, families: Mapping[str, Family]) -> None:
    first = next(iter(families.values()))
    begin, period = float(first.placed.lanes.t[0]), float(cycle.period)
    times = np.array([event.time for event in orbit.events])
    arrays = {
        "f": np.asarray(first.exact.f),
        "harmonics": np.array(first.estimate.harmonics),
        "multipliers": cycle.multipliers,
        "event_times": np.sort(begin + (times - begin) % period),
    }
    coordinates = {}
    for name, family in families.items():
        placed, ldtp = family.placed, family.ldtp
        chart = np.asarray(placed.lanes.chart)
        dims = np.array([len(c.states) for c in cycle.system.charts().values()])[chart]
        states = np.asarray(placed.lanes.q).T
        states = np.where(np.arange(states.shape[1]) < dims[:, None], states, np.nan)
        coordinates[name] = [list(c) for c in ldtp.coordinates]
        arrays |= {
            f"H_exact_{name}": np.asarray(family.exact.H),
            f"H_estimate_{name}": _on_grid(family.estimate, family.exact.f),
            f"A_{name}": np.asarray(ldtp.A),
            f"B_{name}": np.asarray(ldtp.B),
            f"C_{name}": np.asarray(ldtp.C),
            f"D_{name}": np.asarray(ldtp.D),
            f"dims_{name}": np.asarray(ldtp.dims),
            f"section_times_{name}": np.asarray(placed.lanes.t),
            f"section_states_{name}": states,
            f"multipliers_fit_2p1z_{name}": family.rational.multipliers,
            f"multipliers_fit_structured_{name}": family.structured.multipliers,
        }
    header = {
        "format": "hybridjax reproduce",
        "version": __version__,
        "protocol": dataclasses.asdict(protocol),
        "outputs": OUTPUTS,
        "inputs": cycle.system.inputs,
        "coordinates": coordinates,
        "conventions": {
            "f": "input frequency in cycles per period",
            "H": "axes (harmonic, frequency, output, input); H_m is evaluated at the input "
            "frequency f, the output frequency is f + m; n is counted from section 0",
            "A, B, C, D": "x[n+1] = A[n]x[n] + B[n]u[n], y[n] = C[n]x[n] + D[n]u[n], padded with "
            "zeros; the valid block of A[i] is [:dims[i+1], :dims[i]]; the coordinates of x[n] "
            "are deviations from the cycle, named in `coordinates`: t is the time of crossing, "
            "and the state that is missing from a kinematic section's list follows from it",
            "times": "clock time, from section 0 to one period later",
        },
    }
    np.savez_compressed(path, header=np.array(json.dumps(header)), **arrays)


def _on_grid(estimate: HTF, f) -> np.ndarray:
    """H on the frequencies f, NaN where a failed experiment left it unknown."""
    H = np.full((len(estimate.harmonics), len(f), *estimate.H.shape[2:]), np.nan, complex)
    H[:, np.isin(np.asarray(f), np.asarray(estimate.f))] = np.asarray(estimate.H)
    return H


def _figures(out, cycle, families: Mapping[str, Family], perturbed):
    """Draw and save the figures one by one, yielding their names."""
    import matplotlib

    matplotlib.use("Agg")  # files only: no window is opened, and none is needed
    from matplotlib import pyplot

    from .. import plot

    pairs = {name: (family.estimate, family.exact) for name, family in families.items()}
    rational = {name: family.rational for name, family in families.items()}
    estimates = {}
    for name, family in families.items():
        estimates[f"2p1z, {name}"] = family.rational
        estimates[f"structured, {name}"] = family.structured
    drawings = {
        f"fig1_cycle_{name}": lambda family=family: plot.cycle(
            cycle, *OUTPUTS, sections=family.placed, perturbed=perturbed, labels=SYMBOLS
        )
        for name, family in families.items()
    }
    drawings |= {
        "fig3_harmonics": lambda: plot.harmonics(pairs, labels=DEVIATIONS),
        "fig4_bode": lambda: plot.bodes(pairs, fits=rational, labels=DEVIATIONS),
        "multipliers": lambda: plot.multipliers(cycle, estimates, labels=SYMBOLS),
        "poles_zeros": lambda: plot.poles_zeros(rational, labels=SYMBOLS),
    }
    for name, draw in drawings.items():
        plot.save(out / name, draw())
        pyplot.close("all")
        yield name
