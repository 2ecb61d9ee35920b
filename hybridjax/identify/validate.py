"""Is an identified model good enough? Simulation of data that it was not fitted to."""

from typing import Literal

import equinox as eqx
import numpy as np
from jaxtyping import Float

from .._core.arguments import require_same
from .._core.boundary.checked import checked
from .._core.boundary.kinds import Count, Probability
from .._core.html import COLORS, Curve, card, picture, table, text
from .._core.signal import unit_of, with_unit
from .._core.text import p_value
from ..errors import DefinitionError
from ..experiments.record import RecordedData, uninterrupted_records
from ..linear.ldtp import LDTP
from .joint.fit import LDTPFit
from .record_simulation import can_be_compared, simulate_record
from .residual_tests import FEWEST_SAMPLES, Samples, independence_test, whiteness_test
from .series.fit import SeriesFit


# Cycles that a notebook draws. More: they are harder to see.
_DRAWN = 4
# Samples for each lag that is tested by default. Fewer: correlations of too few samples; more: late
# correlations are missed.
_SAMPLES_PER_LAG = 4


class Validation(eqx.Module):
    r"""The part of data that a model explains, and tests of the residuals.

    Printing it gives a report; `hj.plot.validation` draws it.

    **Fields:**

    - `fit` (ny,): normalized root mean square error as a fit in percent,
      $100\,(1 - \|y - \hat y\| / \|y - \bar y\|)$: 100 is perfect, 0 as good as the mean.
    - `noise` (ny,): rms of the residuals.
    - `whiteness` (ny,): p-value of the hypothesis that the residuals are white: they are not where
      it is small (process noise, or dynamics that the model lacks).
    - `independence` (ny,): p-value of the hypothesis that the residuals do not depend on the
      input: the model is wrong where it is small.
    - `level`: significance level of both tests, for all outputs together.
    - `visible` (ny,): the smallest misfit that the test of independence would detect in four of
      five such data: rms of the response to lagged inputs that the model lacks, relative to
      the rms of the simulated output. Smaller errors of a model pass.
    - `autocorrelation` (N, lags, ny): of the residual at each section with those 1, 2, ... samples
      earlier. `cross_correlation` (N, lags, ny, nu): of the residual with the inputs 0, 1, ...
      samples earlier. Both in units of their standard deviation where there is no correlation.
    - `measured`, `simulated` (n, ny): the longest record, whose first sample lies on
      `first_section`.
    - `left_out`: number of records that are too short to test more than their initial condition.
    - `n_sections`, `inputs`, `outputs`.
    """

    fit: Float[np.ndarray, " ny"]
    noise: Float[np.ndarray, " ny"]
    whiteness: Float[np.ndarray, " ny"]
    independence: Float[np.ndarray, " ny"]
    visible: Float[np.ndarray, " ny"]
    autocorrelation: Float[np.ndarray, "N lags ny"]
    cross_correlation: Float[np.ndarray, "N lags ny nu"]
    measured: Float[np.ndarray, "n ny"]
    simulated: Float[np.ndarray, "n ny"]
    level: float = eqx.field(static=True)
    first_section: int = eqx.field(static=True)
    left_out: int = eqx.field(static=True)
    n_sections: int = eqx.field(static=True)
    inputs: tuple[str, ...] = eqx.field(static=True)
    outputs: tuple[str, ...] = eqx.field(static=True)

    @property
    def white(self) -> bool:
        """True if the residuals of all outputs may be white."""
        return bool(np.min(self.whiteness) >= self.level / len(self.outputs))

    @property
    def independent(self) -> bool:
        """True if the residuals of all outputs may be independent of the inputs."""
        return bool(np.min(self.independence) >= self.level / len(self.outputs))

    def __repr__(self) -> str:
        head = f"{'output':>12}  {'fit':>9}  {'rms left':>9}"
        rows = [f"{head}  {'white':>11}  {'independent':>11}"]
        for i, name in enumerate(self.outputs):
            tests = p_value(self.whiteness[i]), p_value(self.independence[i])
            rows.append(
                f"{with_unit(name, unit_of(name)):>12}  {self.fit[i]:8.4f}%  {self.noise[i]:9.2e}"
                f"  {tests[0]:>11}  {tests[1]:>11}"
            )
        verdict = {True: "no sign of it", False: "yes"}
        rows.append(
            f"correlated in time: {verdict[self.white]}; with the input: "
            f"{verdict[self.independent]} (level {self.level:g})"
        )
        if self.left_out:
            rows.append(f"records too short to be compared, left out: {self.left_out}")
        visible = ", ".join(
            f"{100 * x:.2g} % of {name}" for x, name in zip(self.visible, self.outputs, strict=True)
        )
        rows.append(f"misfits that would be noticed in four of five such data: {visible}")
        return "\n".join(rows)

    def _repr_html_(self) -> str:
        names = [with_unit(y, unit_of(y)) for y in self.outputs]
        rows = [
            (names[i], f"{self.fit[i]:.4g} %", f"{self.noise[i]:.3g}",
             p_value(self.whiteness[i]), p_value(self.independence[i]))
            for i in range(len(names))
        ]  # fmt: skip
        k = slice(0, _DRAWN * self.n_sections)
        t = (self.first_section + np.arange(len(self.measured[k]))) / self.n_sections
        curves = [
            Curve(t, self.measured[k, 0], "measured", COLORS[-1]),
            Curve(t, self.simulated[k, 0], "simulated"),
        ]
        verdict = "\n".join(repr(self).splitlines()[1 + len(names) :])
        return card(
            "Validation",
            "",
            table(("output", "fit", "rms left", "white", "independent"), rows),
            picture(curves, "cycles", names[0]),
            text(verdict),
        )


@checked
def validate(
    model: LDTP | SeriesFit | LDTPFit,
    data: RecordedData,
    *,
    start: Literal["free", "cycle"] = "free",
    lags: Count | None = None,
    level: Probability = 0.01,
) -> Validation:
    r"""Simulate a model on data and test the residuals.

    Both tests are made for each section of the period and then summed up, since the statistics of a
    periodic system's residuals are periodic themselves. *Whiteness*: sums of squared correlations
    with earlier residuals are chi-squared (the portmanteau test of Box and Pierce; for periodic
    models McLeod 1994). The means of the correlations over the sections, and the deviations from
    these means, are tested separately; the p-value is the smaller one, corrected for the choice.
    *Independence*: the part of the residuals that lagged inputs explain, compared with the rest (an
    F ratio for each section), for any spectrum of the input; its level holds for residuals that are
    white.

    For a fit of `fit_ldtp` to series, the errors of predictions one step ahead are tested (Ljung
    1999): they are white for a true model with any noise that drives the system, if that noise is
    described. All fields of the result then refer to these predictions.

    Records with three samples or fewer for each unknown of their initial condition and drift are
    left out: they agree with any model.

    **Arguments:**

    - `model`: identified or exact; a `SeriesFit` is simulated as it is.
    - `data`: as for `fit_series`, preferably not the data of the fit, which always agree too well.
    - `start`: "free", the default, estimates the state at the start of each record from it; "cycle"
      takes it as zero. Declared drift of the records is estimated in either case.
    - `lags`: number of lags that are tested. Default: one period, less for few cycles.
    - `level`: significance level of the tests. Default: 0.01.

    **Raises:** `DefinitionError` if model and data have different N or names, there are too few
    cycles, or all records are too short to be compared or for so many lags.
    """
    free_start = start == "free"
    tested = (model.predictor or model.model) if isinstance(model, LDTPFit) else model
    records = uninterrupted_records(data)
    require_same("model and data", model, records[0])
    compared = [r for r in records if can_be_compared(tested, r, free_start)]
    N, outputs, ny = records[0].n_sections, records[0].outputs, len(records[0].outputs)
    if not compared:
        raise DefinitionError(
            f"the longest of {len(records)} uninterrupted records has "
            f"{max(len(r.u) for r in records) / N:.3g} cycles: too few to tell the model from an "
            "unknown start."
        )
    y = np.concatenate([r.y for r in compared])
    samples, present = Samples.of(compared), np.isfinite(y)
    spread = np.ma.masked_invalid(y).std(axis=0).filled(0.0)
    sampled = samples.count(present, 0)
    for name, few, size in zip(outputs, sampled.min(axis=0), spread, strict=True):
        if not size:
            raise DefinitionError(f"the output {name} is constant or missing at every sample.")
        if few < FEWEST_SAMPLES:
            raise DefinitionError(
                f"a section was sampled {few} times only; the tests need {FEWEST_SAMPLES} or more "
                "cycles."
            )
    if lags is None:
        tried = range(1, min(N, int(sampled.min()) // _SAMPLES_PER_LAG) + 1)
        enough = [samples.count(present, lag).min() >= FEWEST_SAMPLES for lag in tried]
        lags = max(sum(map(bool, enough)), 1)
    if (samples.count(present, lags).max(axis=0) < FEWEST_SAMPLES).any():
        raise DefinitionError(
            f"`lags` is {lags}, and the records are too short for it: no section was sampled "
            f"{FEWEST_SAMPLES} times with so many samples before it in its record."
        )
    simulated = np.concatenate([simulate_record(tested, r, free_start) for r in compared])
    error = y - simulated
    square = np.stack([np.nansum(error[at] ** 2, axis=0) for at in samples.at(0)])
    rms = np.sqrt(square.sum(axis=0) / sampled.sum(axis=0))
    size = np.sqrt(np.mean(simulated**2, axis=0))
    auto, whiteness = whiteness_test(samples, error, np.sqrt(square / sampled), lags)
    cross, independence, visible = independence_test(samples, error, lags, level / ny)
    first = int(np.argmax([len(r.u) for r in compared]))
    longest, begin = compared[first], sum(len(r.u) for r in compared[:first])
    shown = slice(begin, begin + len(longest.u) - longest.lead)  # later inputs are unknown
    return Validation(
        fit=100 * (1 - rms / spread),
        noise=rms,
        whiteness=whiteness,
        independence=independence,
        visible=np.where(size > 0, visible * rms / np.where(size > 0, size, 1.0), np.inf),
        autocorrelation=auto,
        cross_correlation=cross,
        measured=y[shown],
        simulated=simulated[shown],
        level=level,
        first_section=longest.first_section,
        left_out=len(records) - len(compared),
        n_sections=N,
        inputs=longest.inputs,
        outputs=outputs,
    )
