"""The figures of the paper, from what `reproduce` finds: each with its name."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib import pyplot

from .. import plot
from .._core.writing import Format
from ..engine.trajectory import Trajectory
from ..orbits.cycle import LimitCycle
from ..plot.look import Plot
from ..sections.placed import PlacedSections
from .paper_report import OUTPUTS


_SYMBOLS = {"yM": "$y_M$", "vM": r"$\dot y_M$"}
_DEVIATIONS = {"yM": r"$\delta y_M$", "vM": r"$\delta \dot y_M$"}
Figures = Iterator[tuple[str, Plot]]


def save(out: Path, formats: Sequence[Format], figures: Figures) -> Iterator[str]:
    """Write and close the figures one by one, yielding their names."""
    for name, drawn in figures:
        plot.save(out / name, drawn, formats)
        pyplot.close(drawn.figure)
        yield name


def cycles(placed: Mapping[str, PlacedSections], perturbed: Trajectory) -> Figures:
    """Fig. 1, for each family of sections."""
    for name, sections in placed.items():
        yield (
            f"fig1_cycle_{name}",
            plot.cycle(
                sections.cycle, *OUTPUTS, sections=sections, perturbed=perturbed, labels=_SYMBOLS
            ),
        )


def comparisons(cycle: LimitCycle, families: Mapping[str, Any]) -> Figures:
    """Figs. 3 and 4, multipliers, poles and zeros: all families in each."""
    pairs = {name: (family.estimate, family.exact) for name, family in families.items()}
    rational = {name: family.rational for name, family in families.items()}
    estimates = {}
    for name, family in families.items():
        estimates[f"2p1z, {name}"] = family.rational
        estimates[f"structured, {name}"] = family.structured
    yield "fig3_harmonics", plot.harmonics(pairs, labels=_DEVIATIONS)
    yield "fig4_bode", plot.bodes(pairs, fits=rational, labels=_DEVIATIONS)
    yield "multipliers", plot.multipliers(cycle, estimates, labels=_SYMBOLS)
    yield "poles_zeros", plot.poles_zeros(rational, labels=_SYMBOLS)
