"""Is an identified model good enough? Simulation of data that it has not seen."""

from typing import Literal

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..._core.boundary.checked import checked
from ..._core.boundary.kinds import Count, Probability
from ..._core.html import COLORS, Curve, card, picture, table, text
from ..._core.signal import unit_of, with_unit
from ..._core.text import p_value
from ...errors import DefinitionError
from ...experiments.record import RecordedData
from ...linear.ldtp import LDTP
from ..joint.fit import LDTPFit
from ..joint.noise import Predictor
from ..series.fit import SeriesFit
from .comparable import Comparable
from .power import smallest_visible
from .residual_tests import FEWEST_SAMPLES, Independence, Whiteness, sections_of
from .simulation import simulate_record


# Cycles that a notebook draws. Doubled: they are harder to see.
_DRAWN = 4
# Samples for each lag that is looked at by default. Doubled: half as many lags.
_SAMPLES_PER_LAG = 4


class Validation(eqx.Module):
    r"""What a model explains of data, and whether anything is left to explain.

    Printing it gives a report; `hj.plot.validation` draws it.

    **Fields:**

    - `fit` (ny,): normalized root mean square error as a fit in percent,
      $100\,(1 - \|y - \hat y\| / \|y - \bar y\|)$: 100 is perfect, 0 as good as the mean.
    - `noise` (ny,): rms of the residuals.
    - `whiteness` (ny,): p-value of the hypothesis that the residuals are white: a small one says
      that they are not (process noise, or dynamics that the model lacks).
    - `independence` (ny,): p-value of the hypothesis that the residuals do not depend on the
      input: a small one says that the model is wrong.
    - `level`: of both tests, for all outputs together.
    - `visible` (ny,): the smallest misfit that the test of independence would notice in four of
      five such data: rms of what lagged inputs do to the output that the model lacks, relative to
      the rms of the simulated output. Smaller errors of a model pass.
    - `autocorrelation` (N, lags, ny): of the residual at each section with those 1, 2, ... samples
      earlier. `cross_correlation` (N, lags, ny, nu): of the residual with the inputs 0, 1, ...
      samples earlier. Both in units of their standard deviation where there is no correlation.
    - `measured`, `simulated` (n, ny): the longest record, whose first sample lies on
      `first_section`.
    - `left_out`: records that are too short to say more than where they started.
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
        """Whether the residuals of all outputs may be white."""
        return bool(np.min(self.whiteness) >= self.level / len(self.outputs))

    @property
    def independent(self) -> bool:
        """Whether the residuals of all outputs may be independent of the inputs."""
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
        seen = ", ".join(
            f"{100 * x:.2g} % of {name}" for x, name in zip(self.visible, self.outputs, strict=True)
        )
        rows.append(f"misfits that would be noticed in four of five such data: {seen}")
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
    r"""Simulate a model on data and test what it leaves.

    Both tests are made for each section of the period and then summed up, since the statistics of
    a periodic system's residuals are periodic themselves. *Whiteness*: the sums of squared
    correlations with earlier residuals, chi-squared (the portmanteau test of Box and Pierce, for
    periodic models McLeod 1994): of their means over the sections and of the differences from
    these, of which the smaller p-value is taken, corrected for the choice. *Independence*: the
    part of the residuals that lagged inputs explain, compared with the rest (an F ratio for each
    section), whatever the spectrum of the input; its level holds for residuals that are white.

    With `noise`, or a fit of `fit_ldtp` to series, what is tested are the errors of predictions one
    step ahead (Ljung 1999): they are white for a true model whatever noise drives the system, if
    that is described. All fields are then those of the predictions.

    Records with three samples or fewer for each unknown of their start and drift are left out: they
    agree with any model.

    **Arguments:**

    - `model`: identified or exact, or a `SeriesFit`, which is simulated as it is, or an `LDTPFit`.
    - `noise`: an `LDTP` that makes the noise of the outputs from white inputs of variance one, as
      `LDTPFit.noise`; for an LDTP as `model` only. None: what is left is tested as it is.
    - `data`: as for `fit_series`, best those that the model was not made from; those that it was
      made from always fit too well. `StoredExperiments` are read twice, part by part.
    - `start`: "free" estimates the state at the start of each record from it; "cycle" takes it as
      zero. A drift that the records announce is estimated from them in either case.
    - `lags`: how many are looked at; default one period, less for few cycles.
    - `level`: of the tests.

    **Raises:** `DefinitionError` if model and data have different N or names, there are too few
    cycles, or all records are too short to be compared or for so many lags; for noise that does not
    belong to the model, or leaves an output without any of its own.
    """
    free_start = start == "free"
    model = _with_noise(model, noise)
    records = Comparable(model, data, free_start, lags)
    N, outputs, ny = records.n_sections, records.outputs, len(records.outputs)
    counts = records.counts
    fewest = counts.sampled.min(axis=0)
    for name, few, spread in zip(outputs, fewest, counts.spread, strict=True):
        if spread == 0 or not np.isfinite(spread):
            raise DefinitionError(f"the output {name} is constant or missing at every sample.")
        if few < FEWEST_SAMPLES:
            raise DefinitionError(
                f"a section was sampled {few} times only; the tests need {FEWEST_SAMPLES} or more "
                "cycles."
            )
    if lags is None:
        most = min(N, int(fewest.min()) // _SAMPLES_PER_LAG)
        enough = [counts.with_past(lag).min() >= FEWEST_SAMPLES for lag in range(1, most + 1)]
        lags = max(int(sum(enough)), 1)
    if (counts.with_past(lags).max(axis=0) < FEWEST_SAMPLES).any():
        raise DefinitionError(
            f"`lags` is {lags}, and the records are too short for it: no section was sampled "
            f"{FEWEST_SAMPLES} times with so many samples before it in its record."
        )
    white = Whiteness(N, lags, ny)
    independent = Independence(N, lags, ny, len(records.inputs))
    square, size, samples = np.zeros((N, ny)), np.zeros(ny), 0
    for group in records.groups():
        simulated = [simulate_record(model, record, free_start) for record in group]
        e = [r.y - y for r, y in zip(group, simulated, strict=True)]
        section, error = sections_of(group), np.concatenate(e)
        square += [np.nansum(error[section == n] ** 2, axis=0) for n in range(N)]
        size += (np.concatenate(simulated) ** 2).sum(axis=0)
        samples += len(error)
        white.add(group, e)
        independent.add(group, e)
    noise = np.sqrt(square.sum(axis=0) / counts.sampled.sum(axis=0))
    auto, whiteness = white.result(np.sqrt(square / counts.sampled))
    cross, independence, ratios = independent.result()
    size = np.sqrt(size / samples)
    hidden = np.array([smallest_visible(r, level / ny) for r in ratios])
    longest = records.longest
    shown = slice(0, len(longest.u) - longest.lead)  # later inputs are unknown
    return Validation(
        fit=100 * (1 - noise / counts.spread),
        noise=noise,
        whiteness=whiteness,
        independence=independence,
        visible=np.where(size > 0, hidden * noise / np.where(size > 0, size, 1.0), np.inf),
        autocorrelation=auto,
        cross_correlation=cross,
        measured=longest.y[shown],
        simulated=simulate_record(model, longest, free_start)[shown],
        level=level,
        first_section=longest.first_section,
        left_out=records.left_out,
        n_sections=N,
        inputs=records.inputs,
        outputs=outputs,
    )


def _with_noise(
    model: LDTP | SeriesFit | LDTPFit, noise: LDTP | None
) -> LDTP | SeriesFit | Predictor:
    """A predictor where noise is known, of a fit or beside a model; otherwise the model."""
    if noise is not None and not isinstance(model, LDTP):
        raise DefinitionError(
            f"`noise` belongs to an LDTP, but `model` is a {type(model).__name__}: give an LDTP, "
            "as `LDTPFit.model`, or one of `hj.identify.realize`."
        )
    if isinstance(model, LDTPFit):
        return model.predictor or model.model
    if noise is not None and isinstance(model, LDTP):
        return Predictor.of(model, noise)
    return model
