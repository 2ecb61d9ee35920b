"""Is an identified model good enough? Simulation of data that it was not fitted to."""

from collections.abc import Iterator
from typing import Literal

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from .._core.arguments import require_same
from .._core.boundary.checked import checked
from .._core.boundary.kinds import Count, Probability
from .._core.html import COLORS, Curve, card, picture, table, text
from .._core.signal import unit_of, with_unit
from .._core.text import p_value
from ..errors import DefinitionError
from ..experiments.record import HasRecords, Record, RecordedData, each_uninterrupted_record
from ..linear.ldtp import LDTP
from .joint.fit import LDTPFit
from .joint.noise import Predictor
from .record_simulation import can_be_compared, simulate_record
from .residual_tests import FEWEST_SAMPLES, Independence, Whiteness, sections_of
from .series.fit import SeriesFit
from .series.records import in_groups


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
    noise: LDTP | None = None,
    start: Literal["free", "cycle"] = "free",
    lags: Count | None = None,
    level: Probability = 0.01,
) -> Validation:
    r"""Simulate a model on data and test the residuals.

    Both tests are made for each section of the period and then summed up, since the statistics of
    a periodic system's residuals are periodic themselves. *Whiteness*: the sums of squared
    correlations with earlier residuals, chi-squared (the portmanteau test of Box and Pierce, for
    periodic models McLeod 1994): of their means over the sections and of the differences from
    these, of which the smaller p-value is taken, corrected for the choice. *Independence*: the
    part of the residuals that lagged inputs explain, compared with the rest (an F ratio for each
    section), for any spectrum of the input; its level holds for residuals that are white.

    With `noise`, or a fit of `fit_ldtp` to series, the errors of predictions one step ahead are
    tested (Ljung 1999): they are white for a true model with any noise that drives the system, if
    that noise is described. All fields are then those of the predictions.

    Records with three samples or fewer for each unknown of their initial condition and drift are
    left out: they agree with any model.

    **Arguments:**

    - `model`: identified or exact; a `SeriesFit` is simulated as it is.
    - `data`: as for `fit_series`, best those that the model was not fitted to; the data of the fit
      always fit too well. `StoredExperiments` are read twice, part by part.
    - `noise`: an `LDTP` that makes the noise of the outputs from white inputs of variance one, as
      `LDTPFit.noise`; for an LDTP as `model` only. Default: the residuals are tested as they are.
    - `start`: "free", the default, estimates the state at the start of each record from it;
      "cycle" takes it as zero. A drift that the records announce is estimated from them in either
      case.
    - `lags`: number of lags that are tested. Default: one period, less for few cycles.
    - `level`: significance level of the tests. Default: 0.01.

    **Raises:** `DefinitionError` if model and data have different N or names, there are too few
    cycles, or all records are too short to be compared or for so many lags; for noise that does not
    belong to the model, or has an output without noise.
    """
    free_start, tested = start == "free", _with_noise(model, noise)
    records = _Comparable(tested, data, free_start, lags)
    longest, sampled = records.longest, records.with_past(0)
    N, outputs, ny = longest.n_sections, longest.outputs, len(longest.outputs)
    fewest, spread = sampled.min(axis=0), records.spread
    for name, few, size in zip(outputs, fewest, spread, strict=True):
        if size == 0 or not np.isfinite(size):
            raise DefinitionError(f"the output {name} is constant or missing at every sample.")
        if few < FEWEST_SAMPLES:
            raise DefinitionError(
                f"a section was sampled {few} times only; the tests need {FEWEST_SAMPLES} or more "
                "cycles."
            )
    if lags is None:
        most = min(N, int(fewest.min()) // _SAMPLES_PER_LAG)
        enough = [records.with_past(lag).min() >= FEWEST_SAMPLES for lag in range(1, most + 1)]
        lags = max(sum(map(bool, enough)), 1)
    if (records.with_past(lags).max(axis=0) < FEWEST_SAMPLES).any():
        raise DefinitionError(
            f"`lags` is {lags}, and the records are too short for it: no section was sampled "
            f"{FEWEST_SAMPLES} times with so many samples before it in its record."
        )
    white, independent = Whiteness(N, lags, ny), Independence(N, lags, ny, len(longest.inputs))
    square, power, samples = np.zeros((N, ny)), np.zeros(ny), 0
    for group in in_groups(records.all()):
        simulated = [simulate_record(tested, record, free_start) for record in group]
        residuals = [r.y - y for r, y in zip(group, simulated, strict=True)]
        section, error = sections_of(group), np.concatenate(residuals)
        square += [np.nansum(error[section == n] ** 2, axis=0) for n in range(N)]
        power += (np.concatenate(simulated) ** 2).sum(axis=0)
        samples += len(error)
        white.add(group, residuals)
        independent.add(group, residuals)
    rms, size = np.sqrt(square.sum(axis=0) / sampled.sum(axis=0)), np.sqrt(power / samples)
    auto, whiteness = white.result(np.sqrt(square / sampled))
    cross, independence, visible = independent.result(level / ny)
    shown = slice(0, len(longest.u) - longest.lead)  # later inputs are unknown
    return Validation(
        fit=100 * (1 - rms / spread),
        noise=rms,
        whiteness=whiteness,
        independence=independence,
        visible=np.where(size > 0, visible * rms / np.where(size > 0, size, 1.0), np.inf),
        autocorrelation=auto,
        cross_correlation=cross,
        measured=longest.y[shown],
        simulated=simulate_record(tested, longest, free_start)[shown],
        level=level,
        first_section=longest.first_section,
        left_out=records.left_out,
        n_sections=N,
        inputs=longest.inputs,
        outputs=outputs,
    )


def _with_noise(
    model: LDTP | SeriesFit | LDTPFit, noise: LDTP | None
) -> LDTP | SeriesFit | Predictor:
    """Return a predictor where the noise is described, otherwise the model."""
    if noise is not None and not isinstance(model, LDTP):
        raise DefinitionError(
            f"`noise` belongs to an LDTP, but `model` is a {type(model).__name__}: give an LDTP, "
            "as `LDTPFit.model`, or a result of `hj.identify.realize`."
        )
    if isinstance(model, LDTPFit):
        return model.predictor or model.model
    if noise is not None and isinstance(model, LDTP):
        return Predictor.of(model, noise)
    return model


class _Comparable:
    """Records with enough samples for a comparison, and how many samples they have.

    Data other than sequences are read anew each time.

    **Raises:** `DefinitionError` if there are none, or model and data do not belong together.
    """

    def __init__(
        self,
        model: LDTP | SeriesFit | Predictor,
        data: RecordedData,
        free_start: bool,
        lags: int | None,
    ):
        if not isinstance(data, HasRecords) and iter(data) is data:
            data = list(data)
        self._data = data
        self._compared = lambda record: can_be_compared(model, record, free_start)
        self.left_out, compared, first, most = 0, None, None, 0
        for record in each_uninterrupted_record(self._data):
            if first is None:
                first, (_, ny) = record, record.y.shape
                require_same("model and data", model, record)
                self._lags = lags or record.n_sections
                self._late = np.zeros((self._lags + 1, record.n_sections, ny), int)
                self._moments = np.zeros((3, ny))
            most = max(most, len(record.u))
            if not self._compared(record):
                self.left_out += 1
                continue
            self._count(record)
            if compared is None or len(record.u) > len(compared.u):
                compared = record
        if compared is None:
            raise DefinitionError(
                f"the longest of {self.left_out} uninterrupted records has "
                f"{most / first.n_sections if first else 0:.3g} cycles: too few to tell the model "
                "from an unknown start."
            )
        self.longest: Record = compared

    def _count(self, record: Record) -> None:
        sampled = np.isfinite(record.y)
        before = np.minimum(np.arange(len(sampled)), self._lags)
        np.add.at(self._late, (before, sections_of([record])), sampled)
        # Means and squares of two sets as one (Chan, Golub and LeVeque 1983).
        count, (old, mean, square) = sampled.sum(axis=0), self._moments
        y = np.where(sampled, record.y, 0.0)
        new = y.sum(axis=0) / np.maximum(count, 1)
        part = count / np.maximum(old + count, 1)
        square = square + ((y - new) ** 2 * sampled).sum(axis=0) + (new - mean) ** 2 * old * part
        self._moments = np.stack([old + count, mean + (new - mean) * part, square])

    def all(self) -> Iterator[Record]:
        return filter(self._compared, each_uninterrupted_record(self._data))

    def with_past(self, lags: int) -> Int[np.ndarray, "N ny"]:
        """Return how often each section was sampled with so many samples before it."""
        return self._late[lags:].sum(axis=0)

    @property
    def spread(self) -> Float[np.ndarray, " ny"]:
        """Standard deviation of each output."""
        return np.sqrt(self._moments[2] / np.maximum(self._moments[0], 1))
