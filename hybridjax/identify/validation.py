"""`validate`: simulate an identified model on data to which it was not fitted, and test the
residuals.

The model is simulated from the initial states that fit best (`predicted` of the fits), and a
`Validation` is returned. The tests themselves are in `series/residuals.py`. If a good model is
rejected, look first at `whitened` there, which takes the errors of the fit into account; if records
are left out, at `can_be_compared`; if cycles are said to be too few, at `_lags`. Independence
must be tested on samples all of whose lagged inputs are known (`late` in `validate`).
"""

import itertools
from typing import Any, Literal

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int
from scipy import stats

from .._core.arguments import require_same
from .._core.boundary.checked import checked
from .._core.boundary.kinds import PeriodCount, Probability, SignalNames
from .._core.findings import Finding, print_findings
from .._core.html import COLORS, Curve, card, picture, text
from .._core.showable import Showable
from .._core.text import folded, listed, p_value
from ..errors import DefinitionError
from ..experiments.record import RecordedData, SectionSeries, uninterrupted_records
from ..linear.ldtp import LDTP
from .descent import positive
from .fit import Fit
from .instrument import in_loop
from .joint.fit import LDTPFit
from .multipliers import StructuredFit
from .periodic import PeriodicModel
from .series.fit import SeriesFit
from .series.prediction import Predictor
from .series.records import CycleGrid, PreparedRecords, Signals, drift_waves
from .series.residuals import (
    FEWEST_SAMPLES,
    independence_test,
    is_exact,
    whitened,
    whiteness_test,
)


# A record must have more than this many samples for each unknown of its initial condition and
# drift. Fewer: short records agree with any model. More: records that could be compared are left
# out.
_SAMPLES_PER_UNKNOWN = 3


def can_be_compared(
    model: LDTP | SeriesFit | Predictor, record: SectionSeries, free_start: bool
) -> bool:
    """Test whether a record has enough samples, beyond those that determine its initial condition
    and drift."""
    N = record.n_sections
    ny = record.y.shape[1]
    unknown = N * ny * drift_waves(record).shape[1]
    if isinstance(model, SeriesFit):
        unknown += N * ny * model.free_cycles * free_start
    elif free_start:
        unknown += int(np.asarray(model.dims)[record.first_section])
    return int(np.isfinite(record.y).sum()) > _SAMPLES_PER_UNKNOWN * unknown


# Cycles that a notebook draws. More: they are harder to see.
_DRAWN = 4
# Number of samples for each lag that is tested by default. Fewer: correlations of too few samples.
# More: correlations at large lags are missed.
_SAMPLES_PER_LAG = 4


class Validation(Showable, eqx.Module):
    r"""The part of data that a model explains, and tests of the residuals.

    Printing it gives a report; `validation.plot()` draws it.

    **Fields:**

    - `fit` (ny,): normalized root mean square error as a fit in percent,
      $100\,(1 - \|y - \hat y\| / \|y - \bar y\|)$: 100 is perfect, 0 as good as the mean.
    - `noise` (ny,): rms of the residuals.
    - `no_better` (ny,): p-value of the hypothesis that the model predicts a cycle no better than
      the mean of all other cycles. Under this hypothesis, squared residuals are on average no
      smaller than squared deviations from this mean. If the p-value is large, the model explains
      nothing.
    - `whiteness` (ny,): p-value of the hypothesis that the residuals are white: they are not where
      it is small (process noise, or dynamics that the model lacks).
    - `independence` (ny,): p-value of the hypothesis that the residuals do not depend on the
      input, or on the references of a loop: the model is wrong where it is small.
    - `alpha`: significance level of both tests, for all outputs together.
    - `visible` (ny,): the smallest model error that the test of independence would detect in four
      of five such records. The error is the response to lagged inputs that the model lacks: its
      rms, relative to the rms of the simulated output. Smaller errors pass the test.
    - `autocorrelation` (N, lags, ny): of the residual at each section with those 1, 2, ... samples
      earlier. `cross_correlation` (N, lags, ny, nu): of the residual with these inputs 0, 1, ...
      samples earlier. Both in units of their standard deviation where there is no correlation.
    - `measured`, `simulated` (n, ny): the longest record, whose first sample lies on
      `first_section`.
    - `left_out`: number of records that are too short for a test: their unknown initial condition
      explains nearly all of their samples.
    - `findings`: "harmonics" if the model lacks some harmonics: the responses at these count as
      residuals.
    - `n_sections`, `inputs`, `outputs`.
    """

    fit: Float[np.ndarray, " ny"]
    noise: Float[np.ndarray, " ny"]
    no_better: Float[np.ndarray, " ny"]
    whiteness: Float[np.ndarray, " ny"]
    independence: Float[np.ndarray, " ny"]
    visible: Float[np.ndarray, " ny"]
    autocorrelation: Float[np.ndarray, "N lags ny"]
    cross_correlation: Float[np.ndarray, "N lags ny nu"]
    measured: Float[np.ndarray, "n ny"]
    simulated: Float[np.ndarray, "n ny"]
    alpha: float = eqx.field(static=True)
    first_section: int = eqx.field(static=True)
    left_out: int = eqx.field(static=True)
    n_sections: int = eqx.field(static=True)
    inputs: tuple[str, ...] = eqx.field(static=True)
    outputs: tuple[str, ...] = eqx.field(static=True)
    findings: tuple[Finding, ...] = eqx.field(static=True, default=())

    @property
    def residuals(self) -> Float[np.ndarray, "n ny"]:
        """Measured less simulated outputs, of the longest record."""
        return self.measured - self.simulated

    @checked
    def plot(self, *, cycles: PeriodCount = 4, ax: object = None) -> Any:
        """Draw measured and simulated outputs, and correlations of the residuals; one row per
        output.

        Left: the last cycles of the longest record. Middle: correlations of the residuals with
        earlier ones, right: with earlier inputs. Bars are means of the correlations over all
        sections, in units of their standard deviation. If there is no correlation, 1 % of the bars
        lie outside of the shaded band.

        **Arguments:**

        - `cycles`: number of cycles to show. Default: 4.
        - `ax`: three Axes per output. Default: a new figure.

        **Returns:** `hj.plot.Plot` with `axes` (ny, 3). Time is in cycles, lags are in sections,
        and outputs in their units.

        **Raises:** `DefinitionError` if `ax` does not hold three Axes per output.

        **Example:**

        ```python
        hj.validate(model, data).plot(cycles=4)
        ```
        """
        return super().plot(cycles=cycles, ax=ax)

    @property
    def _threshold(self) -> float:
        """p-value below which a single output fails a test, if all outputs are tested
        (Bonferroni)."""
        return self.alpha / len(self.outputs)

    @property
    def white(self) -> bool:
        """True if the residuals of all outputs may be white."""
        return bool(np.min(self.whiteness) >= self._threshold)

    @property
    def independent(self) -> bool:
        """True if the residuals of all outputs may be independent of the inputs."""
        return bool(np.min(self.independence) >= self._threshold)

    @property
    def unexplained(self) -> tuple[str, ...]:
        """Outputs that the model predicts no better, beyond chance, than their mean cycle does."""
        pairs = zip(self.outputs, self.no_better, strict=True)
        return tuple(name for name, p in pairs if p > self._threshold)

    def __repr__(self) -> str:
        names = [listed([name]) for name in self.outputs]
        width = max(12, *map(len, names))
        tests = f"{'white':>11}  {'independent':>11}"
        rows = [f"{'output':>{width}}  {'fit':>9}  {'rms left':>9}  {tests}"]
        for i, name in enumerate(names):
            white = p_value(self.whiteness[i])
            independent = p_value(self.independence[i])
            rows.append(
                f"{name:>{width}}  {self.fit[i]:7.2f} %  {self.noise[i]:9.2e}  "
                f"{white:>11}  {independent:>11}"
            )
        if self.unexplained:
            rows.append(
                f"predicted no better than by the mean cycle: {listed(self.unexplained)}"
            )
        verdict = {True: "not rejected", False: "rejected"}
        rows.append(
            f"residuals: whiteness {verdict[self.white]}, independence of the input "
            f"{verdict[self.independent]} (alpha {self.alpha:g})"
        )
        if self.left_out:
            rows.append(f"records too short to compare, left out: {self.left_out}")
        pairs = zip(self.visible, self.outputs, strict=True)
        visible = ", ".join(f"{100 * x:.2g} % of {name}" for x, name in pairs)
        rows.append(
            folded(f"smallest model error detectable with 80 % power: {visible}")
        )
        if self.findings:
            rows.append(print_findings(self.findings))
        return "\n".join(rows)

    def _repr_html_(self) -> str:
        k = slice(0, _DRAWN * self.n_sections)
        sections = self.first_section + np.arange(len(self.measured[k]))
        t = sections / self.n_sections
        curves = [
            Curve(t, self.measured[k, 0], "measured", COLORS[-1]),
            Curve(t, self.simulated[k, 0], "simulated"),
        ]
        drawn = picture(curves, "cycles", listed(self.outputs[:1]))
        return card("Validation", "", drawn, text(repr(self)))


@checked
def validate(
    model: LDTP | Fit,
    data: RecordedData,
    *,
    start: Literal["free", "cycle"] = "free",
    alpha: Probability = 0.01,
    references: SignalNames | None = None,
) -> Validation:
    r"""Simulate a model on data and test the residuals.

    Both tests are made for each section of the period and then summed up, since the statistics of a
    periodic system's residuals are periodic themselves. *Whiteness*: sums of squared correlations
    with earlier residuals are chi-squared (the portmanteau test of Box and Pierce; for periodic
    models McLeod 1994). The means of the correlations over the sections, and the deviations from
    these means, are tested separately; the p-value is the smaller one, corrected for the choice.
    *Independence*: the part of the residuals that lagged inputs explain, compared with the rest (an
    F ratio for each section). It is valid for any spectrum of the input, and has the significance
    level `alpha` if the residuals are white. Both tests allow for the errors of the numerators of
    `fit_series`, and of fits of `fit_ldtp` to series. They ignore the errors of the multipliers: if
    a correct fit used far fewer cycles than the test, whiteness is rejected too often.

    For a fit of `fit_ldtp` to series, the errors of predictions one step ahead are tested (Ljung
    1999): they are white for a true model if the fit also models the noise. All fields of the
    result then refer to these predictions.

    A record is left out if it has three samples or fewer for each unknown of its initial condition
    and drift, because it would agree with any model.

    **Arguments:**

    - `model`: identified or exact. A fit of `fit_series` or `fit_multipliers` is simulated as it
      is; a fit of `fit_multipliers` should have all harmonics. For a fit of `fit_model`, the
      linearization at the sections of its observations is simulated.
    - `data`: data as for `fit_series`, preferably other data than those of the fit, with which a
      model always agrees too well.
    - `start`: "free" estimates the initial state of each record from the record; "cycle" takes it
      as zero. Declared drift of the records is estimated in either case. Default: "free".
    - `alpha`: significance level of the tests. Default: 0.01.
    - `references`: names of the inputs that enter a control loop from outside. The controller sets
      the other inputs, which therefore respond to noise; `model` is that of the plant, from these
      inputs to the outputs. Residuals are tested for independence of the references. Default: None.

    **Returns:** `hj.identify.Validation`: for each output (ny,) the `fit` in percent, the `noise`
    in units of the output, and p-values, `whiteness` and `independence`. Printing it gives a
    report.

    **Raises:** `DefinitionError` if model and data have different N or names, if there are too few
    cycles, or if all records are too short to be compared or for so many lags. `DefinitionError`
    for a plant that is unstable outside of its loop or grows without bound, unless it is a fit of
    `fit_ldtp`.

    **Example:**

    ```python
    fit = hj.fit_series(data, order=2)
    validation = hj.validate(fit, data, alpha=0.01)
    print(validation)
    ```

    **Before:** `hj.fit_series`, `hj.fit_ldtp` or `hj.linearize`. **After:** `validation.plot()`.
    """
    # The model, and the records that can be compared with it.
    free_start = start == "free"
    records = uninterrupted_records(data)
    findings = _about_harmonics(model)
    model = _simulated(model, records[0])
    tested: LDTP | SeriesFit | Predictor = _tested(model)
    outside = records
    if references is not None:
        records, outside = in_loop(data, references)
    require_same("model and data", model, records[0])
    kept = [can_be_compared(tested, record, free_start) for record in records]
    compared = list(itertools.compress(records, kept))
    N = records[0].n_sections
    ny = len(records[0].outputs)
    if not compared:
        longest = max(len(record.u) for record in records)
        raise DefinitionError(
            f"{longest / N:.3g} cycles without gaps are too few for an unknown initial state: "
            "record longer without gaps, or use `validate(start='cycle')`."
        )
    prepared = PreparedRecords(compared)
    grid = prepared.whole()
    lags = _lags(prepared, grid)
    roots = []
    if not isinstance(tested, LDTP) and not isinstance(model, LDTP):
        roots = list(model.spread(grid))
    if isinstance(tested, LDTP):
        # (Outputs in units of their magnitude, so that all have the same weight.)
        of_section = np.diag(prepared.scale**2)
        S = np.tile(of_section, (N, 1, 1))
        tested = Predictor(PeriodicModel.of(tested, np.ones(ny)), S)
    # Simulated outputs and residuals.
    y = np.where(grid.sampled, grid.y, np.nan)
    with np.errstate(all="ignore"):
        simulated = tested.predicted(grid, free_start)
        error = y - simulated
        no_better = _no_better(y, error)
    predicts = isinstance(model, LDTPFit) and model.predictor is not None
    if not predicts and (np.abs(model.multipliers) >= 1).any():
        finite = np.isfinite(simulated[grid.inside]).all()
        if references is not None or not finite:
            raise DefinitionError(
                "the simulation of an unstable plant grows without bound: validate "
                "`fit_ldtp(series)`."
            )
    square = np.nanmean(error**2, axis=(0, 1, 2))
    rms = np.sqrt(square)
    square_of_outputs = np.mean(simulated[grid.inside] ** 2, axis=0)
    size = np.sqrt(square_of_outputs)

    # The two tests.
    autocorrelation, whiteness = whiteness_test(whitened(error, roots), lags)
    # (From these samples on, all lagged inputs are known.)
    is_late = (grid.age >= lags)[..., None]
    late = np.where(is_late, error, np.nan)
    driving = list(itertools.compress(outside, kept))
    inputs = CycleGrid.from_records(driving).u
    cross_correlation, independence, visible = independence_test(
        inputs, late, lags, alpha / ny, roots
    )
    rounding = is_exact(grid, error)  # (shows nothing)
    # The longest record is shown.
    k, longest = max(enumerate(compared), key=lambda pair: len(pair[1].u))
    first = longest.first_section
    # Inputs after the last samples are unknown.
    shown = slice(first, first + len(longest.u) - longest.lead)
    share = visible * rms / positive(size)
    unexplained = rms / np.nanstd(y, axis=(0, 1, 2))
    return Validation(
        fit=100 * (1 - unexplained),
        noise=rms,
        no_better=no_better,
        whiteness=np.maximum(whiteness, rounding),
        independence=np.maximum(independence, rounding),
        visible=np.where(size > 0, share, np.inf),
        autocorrelation=autocorrelation,
        cross_correlation=cross_correlation,
        measured=y[k].reshape(-1, ny)[shown],
        simulated=simulated[k].reshape(-1, ny)[shown],
        alpha=alpha,
        first_section=first,
        left_out=len(records) - len(compared),
        n_sections=N,
        inputs=longest.inputs,
        outputs=longest.outputs,
        findings=findings,
    )


def _about_harmonics(model: LDTP | Fit) -> tuple[Finding, ...]:
    """Return a finding if a fit lacks harmonics."""
    if not isinstance(model, StructuredFit):
        return ()
    missing = model.n_sections - len(model.harmonics)
    if not missing:
        return ()
    text = (
        f"the fit has {len(model.harmonics)} of {model.n_sections} harmonics; responses at the "
        "others count as residuals: estimate all harmonics."
    )
    return (Finding("harmonics", text),)


def _simulated(model: LDTP | Fit, record: SectionSeries) -> LDTP | SeriesFit | LDTPFit:
    """Return the model that is simulated to validate a fit.

    **Raises:** `DefinitionError` for a fit without a model.
    """
    if isinstance(model, StructuredFit):
        return _as_series_fit(model)
    if isinstance(model, LDTP | SeriesFit | LDTPFit):
        return model
    return model._linear_model(record)


def _as_series_fit(fit: StructuredFit) -> SeriesFit:
    """Return the model of a fit to HTFs as a `SeriesFit`, with numerators at the sections. Their
    errors are not known."""
    N = fit.n_sections
    lags = np.outer(np.arange(N), fit.harmonics)
    waves = np.exp(2j * np.pi * lags / N)
    numerators = np.einsum("nm,mrij->nrij", waves, fit.numerators).real
    _, R, ny, nu = numerators.shape
    return SeriesFit(
        fit.multipliers,
        fit.coefficients,
        fit.covariance,
        fit.covariance_dof,
        numerators,
        slopes=np.zeros((len(fit.coefficients), *numerators.shape)),
        roots=np.zeros((N, ny, R, nu, 0)),
        noise=np.zeros(ny),
        n_sections=N,
        inputs=fit.inputs,
        outputs=fit.outputs,
    )


def _tested(model: LDTP | SeriesFit | LDTPFit) -> LDTP | SeriesFit | Predictor:
    """Return the model that predicts the outputs."""
    if isinstance(model, LDTPFit):
        return model.predictor or model.model
    return model


def _lags(prepared: PreparedRecords, grid: CycleGrid) -> int:
    """Return the number of lags that the tests use: one period, less for few cycles.

    **Raises:** `DefinitionError` for too few samples of a section.
    """

    def count(lags: int) -> Int[np.ndarray, "N ny"]:
        """Return how many samples each section has with at least `lags` samples before them."""
        is_late = (grid.age > lags)[..., None]
        return (grid.sampled & is_late).sum(axis=(0, 1))

    few = int(prepared.sampled.min())
    if few < FEWEST_SAMPLES:
        raise DefinitionError(
            f"a section was sampled {few} times: record {FEWEST_SAMPLES} cycles."
        )
    most = min(prepared.n_sections, few // _SAMPLES_PER_LAG)
    enough = [k for k in range(1, most + 1) if count(k).min() >= FEWEST_SAMPLES]
    lags = max(enough, default=1)
    if (count(lags).max(axis=0) < FEWEST_SAMPLES).any():
        raise DefinitionError(
            f"the records are too short: each section must be sampled {FEWEST_SAMPLES} times with "
            f"{lags} samples before it. Record longer without gaps."
        )
    return lags


def _no_better(y: Signals, error: Signals) -> Float[np.ndarray, " ny"]:
    """Return p-values of the hypothesis that squared errors are no smaller than deviations from the
    mean of the other cycles, cycle by cycle (Diebold and Mariano 1995)."""
    sampled = np.isfinite(y)
    n = np.maximum(sampled.sum(axis=(0, 1)), 2)
    mean = np.nanmean(y, axis=(0, 1))
    alone = (y - mean) * n / (n - 1)
    by_cycle = np.nansum(alone**2 - error**2, axis=2)
    gain = by_cycle[sampled.any(axis=(2, 3))]
    deviate = gain.mean(axis=0) * np.sqrt(len(gain))
    return stats.norm.sf(deviate, scale=gain.std(axis=0))
