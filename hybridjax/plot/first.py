"""The figure of each type of result that one would ask for first: `result.plot()`."""

import functools
from typing import Any

import numpy as np

from .._core.boundary.values import with_article
from .._core.showable import Showable
from .._core.signal import with_unit
from ..designs.optimize import OptimalDesign
from ..designs.study import SequentialDesign
from ..engine.trajectory import Trajectory
from ..errors import DefinitionError
from ..experiments.data import ExperimentData
from ..experiments.design.design import Design
from ..experiments.record import SectionSeries
from ..fitting.model_fit import Identifiability, ParameterFit
from ..identify.from_system import ModelIdentification
from ..identify.loops import Loop
from ..identify.multiplier_estimate import MultiplierComparison, MultiplierFit
from ..identify.multipliers import OrderSelection
from ..identify.rational import RationalFit
from ..identify.transient import TransientFit
from ..identify.validation import Validation
from ..linear.htf import HTF
from ..linear.ldtp import LDTP
from ..orbits.branches import Branch
from ..orbits.cycle import LimitCycle
from ..orbits.flow import Flow
from ..orbits.limit_cycles import LimitCycles
from ..orbits.responses import Coupling, PhaseCurve, Responses
from ..plants.cycle import PlantCycle
from ..recordings.data import SectionData
from ..recordings.identification import Identification, NaturalIdentification
from ..recordings.impulse import ImpulseResponses
from ..recordings.natural import NaturalMultipliers
from ..recordings.phase import Phase
from ..recordings.population.maps import MapResult
from ..recordings.population.population import Population
from ..recordings.recording import Recording
from ..sections.placed import PlacedSections
from . import data as of_data, designs, frequency, orbit, plane, subjects
from .look import COLORS, COLUMN, CYCLE, AxesLike, Plot, axis_of, panels
from .over_parameters import branch


# Leads at which a coupling is drawn. Fewer: corners show; more: figures grow.
_LEADS = 201


@functools.singledispatch
def draw(result: Showable, *args: Any, **options: Any) -> Plot:
    """Draw a result.

    **Raises:** `DefinitionError` for a type that has no figure.
    """
    raise DefinitionError(
        f"there is no figure of {with_article(type(result).__name__)}: print it, or draw its "
        "fields."
    )


draw.register(LimitCycle, orbit.cycle)
draw.register(Branch, branch)
draw.register(HTF, frequency.bode)
draw.register(LDTP, plane.multipliers)
draw.register(MultiplierFit, plane.multipliers)
draw.register(ExperimentData, of_data.experiment)
draw.register(SectionData, of_data.section_data)
draw.register(Phase, of_data.phase)
draw.register(ImpulseResponses, of_data.impulse_responses)
draw.register(PhaseCurve, of_data.phase_response)
draw.register(Validation, of_data.validation)
draw.register(OptimalDesign, designs.standard_errors)
draw.register(MapResult, subjects.subject_maps)
draw.register(Population, subjects.forest)


@draw.register
def _(result: RationalFit, **options: Any) -> Plot:
    return plane.poles_zeros({"fit": result}, **options)


@draw.register
def _(result: MultiplierComparison, **options: Any) -> Plot:
    return plane.multipliers(result.true, {"estimated": result.estimated}, **options)


@draw.register(TransientFit)
@draw.register(NaturalMultipliers)
def _(result: TransientFit | NaturalMultipliers, **options: Any) -> Plot:
    return plane.multipliers(result.multipliers, **options)


@draw.register
def _(result: LimitCycles, **options: Any) -> Plot:
    found = result.multipliers[np.isfinite(result.multipliers)]
    return plane.multipliers(found, **options)


@draw.register(Identification)
@draw.register(NaturalIdentification)
def _(result: Identification | NaturalIdentification, **options: Any) -> Plot:
    return draw(result.fit, **options)


@draw.register
def _(result: ModelIdentification, **options: Any) -> Plot:
    return plane.multipliers(result.model, {"fit": result.fit}, **options)


@draw.register
def _(result: SequentialDesign, **options: Any) -> Plot:
    if result.fit is None:
        raise DefinitionError("the study has no data yet: `study.design.plot()`.")
    return draw(result.fit, **options)


@draw.register
def _(result: Loop, **options: Any) -> Plot:
    plant = result.closed if result.plant is None else result.plant
    return frequency.bode(plant, **options)


@draw.register
def _(result: Responses, input: str | None = None, **options: Any) -> Plot:
    return of_data.phase_response(result.curve(input), **options)


@draw.register
def _(result: Coupling, *, ax: AxesLike | None = None) -> Plot:
    """The effect on the rate of the phase by the lead of the push; dots are locked leads."""
    lead = np.linspace(0, 1, _LEADS)
    with panels(ax, height=2.2) as axes:
        panel = axes[0, 0]
        panel.plot(lead, result(lead))
        for locked in result.locked():
            is_stable = locked.rate < 0
            fill = CYCLE[0] if is_stable else "none"
            panel.plot(
                locked.lead, result([locked.lead]), "o", color=CYCLE[0], mfc=fill
            )
        panel.axhline(0, color="black", lw=0.4)
        panel.set(xlabel="lead of the push (cycles)", ylabel="effect per strength")
        panel.set_xlim(0, 1)
    return Plot(axes)


@draw.register
def _(result: PlacedSections, *names: str, **options: Any) -> Plot:
    return orbit.cycle(result.cycle, *names, sections=result, **options)


@draw.register
def _(result: Trajectory, *names: str, ax: AxesLike | None = None) -> Plot:
    """States (or the named states and outputs) against time; events are dotted lines."""
    names = names or _states(result)
    t, *values = result(*names)
    labels = result.structure.resolve_outputs(names).names
    plot = _rows(t, dict(zip(labels, values, strict=True)), ax)
    unit = result.system.time_unit
    for panel in plot.axes[:, 0]:
        for event in result.events:
            panel.axvline(event.time, color=COLORS["gray"], lw=0.5, ls=":")
    plot.axes[-1, 0].set_xlabel(with_unit("time", unit))
    return plot


@draw.register
def _(result: Flow, *names: str, ax: AxesLike | None = None) -> Plot:
    """The same, of a single flow."""
    return draw(result.require_trajectory(), *names, ax=ax)


@draw.register
def _(
    result: Recording, *names: str, trial: int = 0, ax: AxesLike | None = None
) -> Plot:
    """Signals (or the named ones) of one trial against time."""
    names = names or result.signals
    signals = {}
    for name in names:
        label = with_unit(name, result.unit(name))
        signals[label] = result.samples(name)[trial][1]
    plot = _rows(result.trials[trial].time, signals, ax)
    plot.axes[-1, 0].set_xlabel("time (s)")
    return plot


@draw.register
def _(result: SectionSeries, *, ax: AxesLike | None = None) -> Plot:
    """Inputs and outputs against time in cycles."""
    time = (result.first_section + np.arange(len(result.u))) / result.n_sections
    signals = dict(zip(result.inputs, result.u.T, strict=True))
    signals |= dict(zip(result.outputs, result.y.T, strict=True))
    plot = _rows(time, signals, ax)
    plot.axes[-1, 0].set_xlabel("time (cycles)")
    return plot


@draw.register
def _(result: PlantCycle, *, ax: AxesLike | None = None) -> Plot:
    """Mean outputs at the sections."""
    N = len(result.cycle_outputs)
    signals = dict(zip(result.outputs, result.cycle_outputs.T, strict=True))
    plot = _rows(np.arange(N) / N, signals, ax)
    plot.axes[-1, 0].set_xlabel("time (cycles)")
    return plot


@draw.register
def _(result: Design, *, ax: AxesLike | None = None) -> Plot:
    """The amplitude of each excited frequency: the largest over all experiments."""
    f = result.line / result.periods
    with panels(ax, height=2.2) as axes:
        panel = axes[0, 0]
        for channel in np.unique(result.channel):
            chosen = result.channel == channel
            excited = np.unique(f[chosen])
            tops = [result.amplitude[chosen & (f == x)].max() for x in excited]
            color = CYCLE[channel % len(CYCLE)]
            panel.vlines(excited, 0, tops, color=color, lw=0.8)
            panel.plot(excited, tops, "o", ms=2, color=color)
        panel.set_ylim(bottom=0)
        panel.set(xlabel=frequency.FREQUENCY, ylabel="amplitude")
    return Plot(axes)


@draw.register
def _(result: OrderSelection, *, ax: AxesLike | None = None) -> Plot:
    """What is left for one more multiplier, in standard deviations of noise, for each order."""
    with panels(ax, height=2.2) as axes:
        panel = axes[0, 0]
        panel.plot(result.orders, result.deviation, "o-", ms=3, label="left over")
        line = {"color": COLORS["gray"], "ls": "--"}
        panel.plot(result.orders, result.threshold, label="noise, 1 %", **line)
        panel.axvline(result.order, color=COLORS["red"], lw=0.8, label="selected")
        panel.set(xlabel="number of multipliers", yscale="symlog")
        panel.set_ylabel("standard deviations")
        panel.set_xticks(result.orders)
        panel.legend()
    return Plot(axes)


@draw.register
def _(result: ParameterFit, *, ax: AxesLike | None = None) -> Plot:
    """95 % intervals of the fitted parameters, relative to their values."""
    size = np.where(result.values == 0, 1.0, np.abs(result.values))
    reach = 100 * (result.interval()[:, 1] - result.values) / size
    rows = -np.arange(len(result.names))
    labels = []
    for name, value, _, unit in result.rows():
        labels.append(with_unit(f"{name} = {value}", unit))
    with panels(ax, width=COLUMN, height=0.8 + 0.25 * len(rows)) as axes:
        panel = axes[0, 0]
        known = np.isfinite(reach)
        places = np.zeros(len(rows))
        look: Any = {"fmt": "o", "ms": 3, "capsize": 2}
        panel.errorbar(places[known], rows[known], xerr=reach[known], **look)
        # (A cross: the parameter is not identified alone.)
        panel.plot(places[~known], rows[~known], "x", color=COLORS["red"])
        panel.set_yticks(rows, labels)
        panel.set_ylim(rows[-1] - 0.5, 0.5)
        panel.set_xlabel("95 % interval (% of the value)")
    return Plot(axes)


@draw.register
def _(result: Identifiability, *, ax: AxesLike | None = None) -> Plot:
    """Singular values of the sensitivities; those of combinations that are not identified last."""
    values = result.singular_values
    with panels(ax, height=2.2) as axes:
        panel = axes[0, 0]
        number = 1 + np.arange(len(values))
        seen = number <= result.rank
        panel.plot(number[seen], values[seen], "o", label="identified")
        panel.plot(number[~seen], values[~seen], "x", label="not identified")
        panel.set(yscale="log", xlabel="combination", ylabel="singular value")
        panel.set_xticks(number)
        panel.legend()
    return Plot(axes)


def _states(trajectory: Trajectory) -> tuple[str, ...]:
    """Return the states of all charts in which a trajectory is."""
    charts = [trajectory.structure.charts[a] for a in np.unique(trajectory.chart)]
    return tuple(dict.fromkeys(name for chart in charts for name in chart.states))


def _rows(t: np.ndarray, signals: dict[Any, Any], ax: AxesLike | None) -> Plot:
    """Draw signals against time, one row for each."""
    size = {"width": COLUMN, "height": 0.5 + 0.85 * len(signals)}
    with panels(ax, len(signals), 1, **size, sharex=True) as axes:
        for panel, (name, values) in zip(axes[:, 0], signals.items(), strict=True):
            panel.plot(t, values, lw=0.7, color=CYCLE[0])
            panel.set_ylabel(axis_of(name))
            panel.margins(x=0)
    return Plot(axes)
