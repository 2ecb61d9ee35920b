"""The figures of data and fits that one would ask for first: `result.plot()` (see `first.py`).

`first.draw` imports this file for types that it does not know itself. The figure of a type is
registered with `draw.register`, or is drawn by a function here. A new type of result is one more
such line; a subclass without a line gets the figure of its base class. Every figure must take `ax`
and return a `Plot`.

If a result has no figure or the wrong one, look at its line here; if a figure has wrong numbers, at
the function in that line, and then at the fields of the result.
"""

from typing import Any

import numpy as np

from .._core.signal import with_unit
from ..designs.optimize import OptimalDesign
from ..designs.study import SequentialDesign
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
from . import data as of_data, designs, frequency, plane, subjects
from .first import draw, rows
from .look import COLORS, COLUMN, CYCLE, AxesLike, Plot, panels


# Leads at which a coupling is drawn. Fewer: corners show; more: figures grow.
_LEADS = 201


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
def _(
    result: Recording, *names: str, trial: int = 0, ax: AxesLike | None = None
) -> Plot:
    """Signals (or the named ones) of one trial against time."""
    names = names or result.signals
    signals = {}
    for name in names:
        label = with_unit(name, result.unit(name))
        signals[label] = result.samples(name)[trial][1]
    plot = rows(result.trials[trial].time, signals, ax)
    plot.axes[-1, 0].set_xlabel("time (s)")
    return plot


@draw.register
def _(result: SectionSeries, *, ax: AxesLike | None = None) -> Plot:
    """Inputs and outputs against time in cycles."""
    time = (result.first_section + np.arange(len(result.u))) / result.n_sections
    signals = dict(zip(result.inputs, result.u.T, strict=True))
    signals |= dict(zip(result.outputs, result.y.T, strict=True))
    plot = rows(time, signals, ax)
    plot.axes[-1, 0].set_xlabel("time (cycles)")
    return plot


@draw.register
def _(result: PlantCycle, *, ax: AxesLike | None = None) -> Plot:
    """Mean outputs at the sections."""
    N = len(result.cycle_outputs)
    signals = dict(zip(result.outputs, result.cycle_outputs.T, strict=True))
    plot = rows(np.arange(N) / N, signals, ax)
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
