"""Is an identified model good enough? Simulation of data that it has not seen."""

from collections.abc import Sequence
from typing import Literal

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int
from scipy import stats

from ..._core.boundary.checked import checked
from ..._core.boundary.kinds import Count, Probability
from ..._core.html.parts import card, table, text
from ..._core.html.svg import COLORS, Curve, picture
from ..._core.signal import unit_of, with_unit
from ..._core.text import p_value
from ...errors import DefinitionError
from ...experiments.data import ExperimentData
from ...experiments.record import Record, RecordedData, uninterrupted_records
from ...linear.ldtp import LDTP
from .power import smallest_visible
from .series_fit import SeriesFit
from .simulation import can_be_compared, simulate_record


# Cycles that a notebook draws. Doubled: they are harder to see.
_DRAWN = 4
# Samples of a section, below which a correlation says nothing. Doubled: more records are refused.
_FEWEST_SAMPLES = 8
# Samples for each lag that is looked at by default. Doubled: half as many lags.
_SAMPLES_PER_LAG = 4
# Singular values of lagged inputs below this part of the largest one are rounding errors. Doubled:
# none but rounding.
_RANK = 1e-9


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
    model: LDTP | SeriesFit,
    data: RecordedData,
    *,
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

    Records with three samples or fewer for each unknown of their start and drift are left out: they
    agree with any model.

    **Arguments:**

    - `model`: identified or exact, or a `SeriesFit`, which is simulated as it is.
    - `data`: as for `fit_series`, best those that the model was not made from; those that it was
      made from always fit too well.
    - `start`: "free" estimates the state at the start of each record from it; "cycle" takes it as
      zero. A drift that the records announce is estimated from them in either case.
    - `lags`: how many are looked at; default one period, less for few cycles.
    - `level`: of the tests.

    **Raises:** `DefinitionError` if model and data have different N or names, there are too few
    cycles, or all records are too short to be compared or for so many lags.
    """
    free_start = start == "free"
    everything = uninterrupted_records(data)
    N, outputs = everything[0].n_sections, everything[0].outputs
    require_same_kind(model, everything[0])
    records = [r for r in everything if can_be_compared(model, r, free_start)]
    if not records:
        longest = max(len(r.u) for r in everything) / N
        raise DefinitionError(
            f"the longest of {len(everything)} uninterrupted records has {longest:.3g} cycles: too "
            "few to tell the model from an unknown start."
        )
    simulated = [simulate_record(model, record, free_start) for record in records]
    seen = np.concatenate([np.isfinite(r.y) for r in records])
    y = np.concatenate([r.y for r in records])
    e = [r.y - y for r, y in zip(records, simulated, strict=True)]
    error = np.concatenate(e)
    for i, name in enumerate(outputs):
        if seen[:, i].sum() < 2 or np.nanstd(y[:, i]) == 0:
            raise DefinitionError(f"the output {name} is constant or missing at every sample.")
    noise = np.sqrt(np.nanmean(error**2, axis=0))
    spread = np.sqrt(np.nanmean((y - np.nanmean(y, axis=0)) ** 2, axis=0))
    fewest = min(np.bincount(_sections(records)[seen[:, i]], minlength=N).min()
                 for i in range(len(outputs)))  # fmt: skip
    if fewest < _FEWEST_SAMPLES:
        raise DefinitionError(
            f"a section was sampled {fewest} times only; the tests need {_FEWEST_SAMPLES} or more "
            "cycles."
        )
    if lags is None:
        most = min(N, int(fewest) // _SAMPLES_PER_LAG)
        enough = [_with_past(records, lag).min() >= _FEWEST_SAMPLES for lag in range(1, most + 1)]
        lags = max(int(sum(enough)), 1)
    if (_with_past(records, lags).max(axis=0) < _FEWEST_SAMPLES).any():
        raise DefinitionError(
            f"`lags` is {lags}, and the records are too short for it: no section was sampled "
            f"{_FEWEST_SAMPLES} times with so many samples before it in its record."
        )
    auto, white = _whiteness(records, e, N, lags)
    longest = max(range(len(records)), key=lambda k: len(records[k].u))
    shown = slice(0, len(records[longest].u) - records[longest].lead)  # later inputs are unknown
    cross, independent, ratios = _independence(records, e, N, lags)
    size = np.sqrt(np.mean(np.concatenate(simulated) ** 2, axis=0))
    hidden = np.array([smallest_visible(r, level / len(outputs)) for r in ratios])
    return Validation(
        fit=100 * (1 - noise / spread),
        noise=noise,
        whiteness=white,
        independence=independent,
        visible=np.where(size > 0, hidden * noise / np.where(size > 0, size, 1.0), np.inf),
        autocorrelation=auto,
        cross_correlation=cross,
        measured=records[longest].y[shown],
        simulated=simulated[longest][shown],
        level=level,
        first_section=records[longest].first_section,
        left_out=len(everything) - len(records),
        n_sections=N,
        inputs=records[0].inputs,
        outputs=outputs,
    )


def require_same_kind(model: LDTP | SeriesFit, data: Record | ExperimentData) -> None:
    """**Raises:** `DefinitionError` if model and data have different N, inputs or outputs."""
    for name in ("n_sections", "inputs", "outputs"):
        its, of_data = getattr(model, name), getattr(data, name)
        if its != of_data:
            raise DefinitionError(f"model and data have different {name}: {its} and {of_data}.")


def _sections(records: Sequence[Record]) -> Int[np.ndarray, " n"]:
    """Of all samples."""
    return np.concatenate([(r.first_section + np.arange(len(r.u))) % r.n_sections for r in records])


def _with_past(records: Sequence[Record], lags: int) -> Int[np.ndarray, "N ny"]:
    """How often each output was sampled at each section, with so many samples before it."""
    late = [np.isfinite(r.y) & (np.arange(len(r.y)) >= lags)[:, None] for r in records]
    section, late = _sections(records), np.concatenate(late)
    return np.stack([late[section == n].sum(axis=0) for n in range(records[0].n_sections)])


def _earlier(x: np.ndarray, lag: int) -> np.ndarray:
    """x, `lag` samples earlier; NaN before its start."""
    out = np.full_like(x, np.nan)
    out[lag:] = x[: max(len(x) - lag, 0)]
    return out


def _whiteness(
    records: Sequence[Record], e: Sequence[np.ndarray], N: int, lags: int
) -> tuple[Float[np.ndarray, "N lags ny"], Float[np.ndarray, " ny"]]:
    """Correlations with earlier residuals, and the p-values."""
    section = _sections(records)
    ny = e[0].shape[1]
    now = np.concatenate(e)
    size = np.stack([np.sqrt(np.nanmean(now[section == n] ** 2, axis=0)) for n in range(N)])
    scale = np.where(size > 0, size, 1.0)
    scaled = [x / scale[_sections([r])] for r, x in zip(records, e, strict=True)]
    z = np.zeros((N, lags, ny))
    total = np.zeros((N, lags, ny), bool)
    now = np.concatenate(scaled)
    for lag in range(1, lags + 1):
        product = now * np.concatenate([_earlier(x, lag) for x in scaled])
        for n in range(N):
            values = product[section == n]
            count = np.isfinite(values).sum(axis=0)
            z[n, lag - 1] = np.nansum(values, axis=0) / np.sqrt(np.maximum(count, 1))
            total[n, lag - 1] = count >= _FEWEST_SAMPLES
    # The mean over the sections of each lag, and what the sections differ from it: independent.
    z = z * total
    count = total.sum(axis=0)
    pooled = z.sum(axis=0) ** 2 / np.maximum(count, 1)
    rest = (z**2).sum(axis=(0, 1)) - pooled.sum(axis=0)
    few = (count > 0).sum(axis=0)
    p = stats.chi2.sf(pooled.sum(axis=0), few)
    if N > 1:
        p = np.minimum(p, stats.chi2.sf(rest, count.sum(axis=0) - few))
        p = -np.expm1(2 * np.log1p(-p))
    return z, p


def _independence(
    records: Sequence[Record], e: Sequence[np.ndarray], N: int, lags: int
) -> tuple[
    Float[np.ndarray, "N lags ny nu"], Float[np.ndarray, " ny"], list[list[tuple[int, int]]]
]:
    """Correlations with earlier inputs, the p-values, and the degrees of freedom of the F ratios of
    each output."""
    section = _sections(records)
    ny, nu = e[0].shape[1], records[0].u.shape[1]
    now = np.concatenate(e)
    past = [np.concatenate([_earlier(r.u, lag) for r in records]) for lag in range(lags)]
    past = np.stack(past, axis=1)
    z = np.zeros((N, lags, ny, nu))
    square: Float[np.ndarray, " ny"] = np.zeros(ny)
    ratios: list[list[tuple[int, int]]] = [[] for _ in range(ny)]
    for n in range(N):
        inputs, residual = past[section == n], now[section == n]
        for i in range(ny):
            rows = np.isfinite(residual[:, i]) & np.isfinite(inputs).all(axis=(1, 2))
            U, r = inputs[rows].reshape(rows.sum(), -1), residual[rows, i]
            if rows.sum() < _FEWEST_SAMPLES or not r.any():
                continue
            size = np.sqrt((U**2).sum(axis=0) * np.mean(r**2))
            z[n, :, i] = (U.T @ r / np.where(size > 0, size, 1.0)).reshape(lags, nu)
            left, s, _ = np.linalg.svd(U, full_matrices=False)
            left = left[:, s > _RANK * s[0]]
            if left.shape[1] > len(r) // 2:
                left = left[:, : len(r) // 2]
            # Explained against unexplained part: an F ratio, as its normal deviate squared.
            a, b = left.shape[1], len(r) - left.shape[1]
            inside = ((left.T @ r) ** 2).sum()
            ratio = (inside / a) / ((r @ r - inside) / b)
            square[i] += stats.norm.isf(np.clip(stats.f.sf(ratio, a, b), 1e-300, 1 - 1e-16))
            ratios[i].append((a, b))
    count = np.array([len(r) for r in ratios])
    return z, stats.norm.sf(square / np.sqrt(np.maximum(count, 1))), ratios
