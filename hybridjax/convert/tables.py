"""Results as `pandas.DataFrame`: `result.to_pandas()` (`_core/showable.py`) calls `to_pandas`.

Each type of result has a function that is registered with `_columns` and returns the columns by
their names, or a finished table. Results with named axes go through `to_xarray`. A new type of
result is one more function here; a result without one shows its findings. Names of columns must
stay: users read tables, and files that were made of them, by these.

If a table has wrong numbers, look at the fields of the result first; if a column is missing, at the
function of its type.
"""

import functools
from typing import Any

import numpy as np

from .._core.arguments import package
from .._core.boundary.values import with_article
from .._core.showable import Showable
from ..designs.optimize import OptimalDesign
from ..engine.trajectory import Trajectory
from ..errors import DefinitionError
from ..experiments.data import ExperimentData
from ..experiments.design.design import Design
from ..experiments.record import SectionSeries
from ..fitting.model_fit import Identifiability, ParameterComparison, ParameterFit
from ..identify.from_system import ModelIdentification
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
from ..orbits.responses import PhaseCurve
from ..orbits.sensitivity import Sensitivity
from ..plants.cycle import PlantCycle
from ..recordings.data import SectionData
from ..recordings.identification import Identification, NaturalIdentification
from ..recordings.impulse import ImpulseResponses
from ..recordings.natural import NaturalMultipliers
from ..recordings.population.population import Population
from ..recordings.recording import Recording
from .xarray_datasets import to_xarray


def to_pandas(thing: Showable) -> Any:
    """`result.to_pandas()`: a `pandas.DataFrame` of a result."""
    return package("pandas").DataFrame(_columns(thing))


@functools.singledispatch
def _columns(thing: Any) -> Any:
    """Return the columns of the table of a result, or a table.

    **Raises:** `DefinitionError` for a result that is no table.
    """
    findings = thing.findings
    if not findings:
        raise DefinitionError(
            f"{with_article(type(thing).__name__)} is no table: its fields have the numbers."
        )
    return {
        "cause": [x.cause for x in findings],
        "finding": [x.text for x in findings],
        "action": [x.action for x in findings],
    }


@_columns.register(Recording)
@_columns.register(SectionData)
@_columns.register(LimitCycles)
@_columns.register(Branch)
def _(thing: Recording | SectionData | LimitCycles | Branch) -> Any:
    dataset = to_xarray(thing)
    row = next(iter(dataset.data_vars.values())).dims[0]
    table: dict[str, Any] = {}
    for name, x in {**dataset.coords, **dataset.data_vars}.items():
        if x.dims[0] != row:
            continue
        numbers = {name: x.values}
        if x.ndim > 1:
            columns = enumerate(x.values.T)
            numbers = {f"{name}.{k}": values for k, values in columns}
        for key, values in numbers.items():
            table |= (
                _parts(f"{key}.", values) if np.iscomplexobj(values) else {key: values}
            )
    return table


@_columns.register
def _(thing: HTF) -> Any:
    dataset = to_xarray(thing)
    rows = dataset[[x for x in ("H", "variance") if x in dataset]].to_dataframe()
    parts = _parts("", rows["H"].values)
    if "variance" in rows:
        parts["standard_error"] = np.sqrt(rows["variance"].values)
    return rows[[]].assign(**parts)


@_columns.register
def _(thing: MultiplierFit) -> Any:
    return _with_errors(thing)


@_columns.register
def _(thing: NaturalMultipliers) -> Any:
    return _with_errors(thing)


def _with_errors(thing: MultiplierFit | NaturalMultipliers) -> Any:
    """Return multipliers, their standard errors, and intervals of their moduli."""
    covariances = np.diagonal(thing.multiplier_covariances, axis1=1, axis2=2)
    real, imaginary = np.sqrt(covariances).T
    low, high = thing.interval().T
    return {
        **_parts("", thing.multipliers),
        "real_error": real,
        "imaginary_error": imaginary,
        "standard_error": thing.standard_errors,
        "modulus_low": low,
        "modulus_high": high,
    }


@_columns.register
def _(thing: ParameterFit) -> Any:
    low, high = thing.interval().T
    return {
        "parameter": list(thing.names),
        "value": np.asarray(thing.values),
        "standard_error": thing.standard_errors,
        "low": low,
        "high": high,
        "unit": list(thing.units),
    }


@_columns.register
def _(thing: RationalFit) -> Any:
    names = list(map(str, thing.outputs))
    outputs = np.repeat(names, thing.poles.shape[1])
    poles = _parts("pole_", thing.poles.ravel())
    return {"output": outputs, **poles, **_parts("", thing.multipliers.ravel())}


@_columns.register(Identification)
@_columns.register(ModelIdentification)
@_columns.register(NaturalIdentification)
def _(thing: Identification | ModelIdentification | NaturalIdentification) -> Any:
    return _columns(thing.fit)


@_columns.register(LDTP)
@_columns.register(TransientFit)
def _(thing: LDTP | TransientFit) -> Any:
    return _parts("", thing.multipliers)


@_columns.register
def _(thing: LimitCycle) -> Any:
    table: dict[str, Any] = {}
    for name, number in thing.numbers.items():
        if np.ndim(number) == 0:
            table[name] = [float(number)]
    table["period"] = [float(thing.period)]
    for k, multiplier in enumerate(thing.multipliers):
        table |= _parts(f"multipliers.{k}.", np.array([multiplier]))
    table["stable"] = [thing.is_stable]
    return table


@_columns.register
def _(thing: ExperimentData) -> Any:
    S, n, _ = thing.u.shape
    experiment = np.repeat(np.arange(S), n)
    sample = np.tile(np.arange(n), S)
    signals = np.concatenate([thing.u, thing.y], axis=2)
    columns = _samples(thing, sample, signals.reshape(S * n, -1))
    return {"experiment": experiment} | columns


@_columns.register
def _(thing: SectionSeries) -> Any:
    sample = thing.first_section + np.arange(len(thing.u))
    return _samples(thing, sample, np.concatenate([thing.u, thing.y], axis=1))


def _samples(thing: Any, sample: np.ndarray, signals: np.ndarray) -> dict[str, Any]:
    """Return columns of samples at sections, counted from section 0 of a cycle."""
    cycle, section = np.divmod(sample, thing.n_sections)
    names = map(str, (*thing.inputs, *thing.outputs))
    columns = dict(zip(names, signals.T, strict=True))
    return {"cycle": cycle, "section": section, **columns}


@_columns.register
def _(thing: Flow) -> Any:
    return _columns(thing.require_trajectory())


@_columns.register
def _(thing: Trajectory) -> Any:
    charts = thing.structure.charts
    names = list(dict.fromkeys(x for chart in charts for x in chart.states))
    t, chart, states = thing.dense(1)
    table: dict[str, Any] = {
        "time": t,
        "chart": [thing.structure.names[a] for a in chart],
    }
    for name in names:
        table[name] = np.full(len(t), np.nan)
    for a, row, values in zip(chart, range(len(t)), states, strict=True):
        for k, name in enumerate(charts[a].states):
            table[name][row] = values[k]
    return table


@_columns.register
def _(thing: Design) -> Any:
    return {
        "experiment": thing.experiment,
        "frequency": thing.line / thing.periods,
        "channel": thing.channel,
        "amplitude": thing.amplitude,
        "phase": thing.phase,
    }


@_columns.register
def _(thing: OrderSelection) -> Any:
    return {
        "order": thing.orders,
        "strength": thing.strength,
        "deviation": thing.deviation,
        "threshold": thing.threshold,
        "chi2_per_dof": thing.cost / thing.dof,
        "mdl": thing.mdl,
    }


@_columns.register
def _(thing: Validation) -> Any:
    return {
        "output": list(map(str, thing.outputs)),
        "fit": thing.fit,
        "noise": thing.noise,
        "no_better": thing.no_better,
        "whiteness": thing.whiteness,
        "independence": thing.independence,
        "visible": thing.visible,
    }


@_columns.register
def _(thing: OptimalDesign) -> Any:
    return {
        "quantity": list(thing.names),
        "standard_error": thing.standard_errors,
        "usual_standard_error": thing.usual_standard_errors,
    }


@_columns.register
def _(thing: MultiplierComparison) -> Any:
    outputs = {"output": list(map(str, thing.outputs))} if thing.outputs else {}
    true = _parts("true_", thing.true)
    estimated = _parts("estimated_", thing.estimated)
    return {**outputs, **true, **estimated, "error": thing.error}


@_columns.register
def _(thing: ParameterComparison) -> Any:
    return {
        "parameter": list(thing.names),
        "true": thing.true,
        "estimated": thing.estimated,
        "error": thing.error,
        "standard_error": thing.standard_errors,
    }


@_columns.register
def _(thing: PhaseCurve) -> Any:
    errors = getattr(thing, "errors", None)
    table = {"phase": thing.phase, "value": thing.values}
    return table if errors is None else {**table, "standard_error": errors}


@_columns.register
def _(thing: ImpulseResponses) -> Any:
    shape = thing.values.shape
    phase, lag, output, input = (x.ravel() for x in np.indices(shape))
    return {
        "phase": thing.phase[phase],
        "lag": thing.lag[lag],
        "output": [str(thing.outputs[k]) for k in output],
        "input": [str(thing.inputs[k]) for k in input],
        "value": np.ravel(thing.values),
        "standard_error": np.ravel(thing.errors),
    }


@_columns.register
def _(thing: Identifiability) -> Any:
    lost = np.any(thing.unseen != 0, axis=0)
    return {"parameter": list(thing.names), "identified": ~lost}


@_columns.register
def _(thing: Sensitivity) -> Any:
    return {
        "event": list(thing.events),
        "time": np.asarray(thing.times),
        "duration": np.asarray(thing.durations),
    }


@_columns.register
def _(thing: PlantCycle) -> Any:
    columns = dict(zip(thing.outputs, thing.cycle_outputs.T, strict=True))
    return {"section": np.arange(len(thing.cycle_outputs)), **columns}


@_columns.register
def _(thing: Population) -> Any:
    return thing.table


def _parts(prefix: str, z: np.ndarray) -> dict[str, np.ndarray]:
    parts = {"real": np.real(z), "imaginary": np.imag(z), "modulus": np.abs(z)}
    return {f"{prefix}{name}": values for name, values in parts.items()}
