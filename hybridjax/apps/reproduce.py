"""The paper from end to end: from the hopper to its Floquet multipliers, beside the exact answer.

Ankarali & Cowan, Sec. VI. `hybridjax reproduce --out DIR` runs this.

`_reproduce` takes the stages in order, and `_identify` those for one family of sections. The
defaults of `Protocol` and the numbers in `_identify` are the paper's, and must stay. If a result
differs from the paper, compare the fields of a `Family`: where `exact` and `rational_exact` differ,
too, the cause lies in the cycle or the sections, otherwise in the experiments or the fits.
"""

import dataclasses
import itertools
import json
import os
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

from .._core.archive import write_module
from .._core.writing import Format, results_folder
from ..engine.settings import Settings
from ..engine.trajectory import Trajectory, simulate
from ..experiments.design.design import Design
from ..experiments.design.multisine import paper_design
from ..experiments.stored import run_experiments
from ..identify.htf_estimate import estimate_htf
from ..identify.multipliers import StructuredFit, fit_multipliers
from ..identify.rational import RationalFit, fit_rational
from ..linear.htf import HTF
from ..linear.ldtp import LDTP
from ..models.hoppers import VerticalHopper
from ..orbits.crossing import Crossing
from ..orbits.cycle import LimitCycle
from ..orbits.find import find_limit_cycle
from ..sections.families import ClockPhase, KinematicPhase
from ..sections.linearization import linearize
from ..sections.place import place_sections
from ..sections.placed import PlacedSections
from .paper_report import OUTPUTS, summarize, table


_FAMILIES = "isochron", "kinematic"
_SAVED = ("ldtp", "exact", "estimate", "rational", "structured")


@dataclasses.dataclass(frozen=True)
class Protocol:
    """The sizes of a run. The defaults are the paper's."""

    experiments: int = 80
    cycles: int = 84
    """Cycles in each experiment,"""
    keep: int = 64
    """the last of which are used for estimation."""
    seed: int = 0
    """Of the random subsets and phases of the design."""


class Family(NamedTuple):
    """All results with one family of sections."""

    placed: PlacedSections
    ldtp: LDTP
    exact: HTF
    experiments: str
    """The outcome of the experiments in words."""
    estimate: HTF
    rational: RationalFit
    rational_exact: RationalFit
    structured: StructuredFit


def _log(begin: float, text: str) -> None:
    """Print a finished step with the seconds since `begin`."""
    since = time.time() - begin
    print(f"[{since:6.1f} s] {text}", flush=True)


def reproduce(
    out: str | os.PathLike, protocol: Protocol, formats: Sequence[Format]
) -> dict:
    """Run the protocol and write figures, `summary.json` and files for `hj.load` into a folder.

    They appear when all of them are ready, and replace those of an earlier run. Other files in the
    folder stay as they are.

    **Arguments:** `formats`: of the figures, as in `plot.save`.

    **Returns:** what `summary.json` holds.

    **Raises:** `DefinitionError` for a folder that cannot be written, or one in which another file
    has the name of a result; `ComputationError` if a step fails.
    """
    cycles = [f"fig1_cycle_{family}" for family in _FAMILIES]
    figures = [*cycles, "fig3_harmonics", "fig4_bode", "multipliers", "poles_zeros"]
    files = ["summary.json"]
    files += map(".".join, itertools.product(figures, formats))
    pairs = itertools.product(_FAMILIES, _SAVED)
    files += [f"{x}_{family}.npz" for family, x in pairs]
    with results_folder(Path(out), "reproduce", files) as folder:
        return _reproduce(folder, protocol, formats)


def _reproduce(out: Path, protocol: Protocol, formats: Sequence[Format]) -> dict:
    begin = time.time()
    # Lines without second-order products on them need many experiments.
    division: Literal["random", "sum-free"] = "random"
    if protocol.experiments >= 80:
        division = "sum-free"
    design = paper_design(
        periods=protocol.keep,
        seed=protocol.seed,
        division=division,
        experiments=protocol.experiments,
    )
    _log(
        begin,
        f"design: {design.experiments} experiments, {len(design.frequency)} frequencies",
    )
    cycle = find_limit_cycle(VerticalHopper())
    multipliers = ", ".join(f"{z:.9f}" for z in cycle.multipliers)
    _log(
        begin,
        f"limit cycle: period {float(cycle.period):.6g}, multipliers {multipliers}",
    )

    discard = protocol.cycles - protocol.keep
    families = {
        name: _identify(name, cycle, design, discard, begin) for name in _FAMILIES
    }
    _draw(cycle, families, out, formats, begin)
    summary = summarize(protocol, cycle, families)
    for name, family in families.items():
        for result in _SAVED:
            write_module(out / f"{result}_{name}.npz", getattr(family, result))
    summary["seconds"] = time.time() - begin
    (out / "summary.json").write_text(json.dumps(summary, indent=2) + "\n")
    print(table(summary))
    return summary


def _identify(
    name: str,
    cycle: LimitCycle,
    design: Design,
    discard: int,
    begin: float,
) -> Family:
    """Return all results with one family of sections."""
    apex = Crossing("vM", "falling")
    N = design.n_sections
    sections: Any = ClockPhase(N, anchor=apex)
    if name == "kinematic":
        plane: Any = {
            "position": "yM",
            "velocity": "vM",
            "center": (1.9, 0.0),
            "scale": (0.3, 1.9),
        }
        sections = KinematicPhase(N, **plane, anchor=apex)
    placed = place_sections(cycle, sections)
    ldtp = linearize(cycle, placed, OUTPUTS)
    exact = ldtp.htf(design.frequencies)
    _log(begin, f"{name}: sections, exact A, B, C, D and HTF")
    data = run_experiments(cycle, placed, design, OUTPUTS, discard=discard)
    experiments = data.summary()
    _log(begin, f"{name}: experiments, {experiments}")
    data.require_ok()
    estimate = estimate_htf(data)
    rational = fit_rational(estimate)
    rational_exact = fit_rational(exact)
    structured = fit_multipliers(estimate, ldtp)
    _log(begin, f"{name}: HTF estimate, 2-pole 1-zero fits, structured fit")
    return Family(
        placed, ldtp, exact, experiments, estimate, rational, rational_exact, structured
    )


def _draw(
    cycle: LimitCycle,
    families: Mapping[str, Family],
    out: Path,
    formats,
    begin,
) -> None:
    """Write the figures."""
    from .. import plot  # here, since it is heavy
    from ..plot.look import save_and_close

    for name, drawn in _figures(plot, cycle, families):
        save_and_close(out / name, drawn, formats)
        _log(begin, name)


def _figures(plot: Any, cycle: LimitCycle, families: Mapping[str, Family]) -> Iterator:
    """Fig. 1 for each family of sections; Figs. 3 and 4, multipliers, poles and zeros with all."""
    perturbed = _perturbed(cycle)
    estimates = dict[str, Any]()
    for name, family in families.items():
        drawn = plot.cycle(cycle, *OUTPUTS, sections=family.placed, perturbed=perturbed)
        yield f"fig1_cycle_{name}", drawn
        estimates |= {
            f"2 poles, 1 zero, {name}": family.rational,
            f"structured, {name}": family.structured,
        }
    pairs = {name: (family.estimate, family.exact) for name, family in families.items()}
    rational = {name: family.rational for name, family in families.items()}
    yield "fig3_harmonics", plot.htf(pairs, harmonics=(0, 1, -1, 2, -2))
    yield "fig4_bode", plot.bode(pairs, fits=rational)
    yield "multipliers", plot.multipliers(cycle, estimates)
    yield "poles_zeros", plot.poles_zeros(rational)


def _perturbed(cycle: LimitCycle) -> Trajectory:
    """Return twelve periods from a state that is 5 cm above the cycle."""
    state = dict(cycle.state)
    state["yM"] += 0.05
    chart = list(cycle.system.charts())[int(cycle.anchor.chart[0])]
    return simulate(
        cycle.system,
        chart,
        list(state.values()),
        12 * float(cycle.period),
        time=float(cycle.anchor.t[0]),
        throw=False,
        settings=Settings(rtol=1e-6, atol=1e-6),  # a figure shows no more
    )
