"""Is an identified model good enough? Simulation of data that it has not seen."""

from collections.abc import Sequence
from typing import Literal

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int
from scipy import stats

from ...errors import DefinitionError
from ...experiments.data import ExperimentData
from ...experiments.record import Record, RecordedData, uninterrupted_records
from ...linear.ldtp import LDTP
from .fit import check_start
from .power import smallest_visible
from .series_fit import SeriesFit
from .simulation import simulate_record


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
    - `measured`, `simulated` (n, ny): the first record, whose first sample lies on
      `first_section`.
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
        rows = [f"{'output':>12}  {'fit':>9}  {'rms left':>9}  {'p white':>8}  {'p input':>8}"]
        for i, name in enumerate(self.outputs):
            rows.append(
                f"{name:>12}  {self.fit[i]:8.4f}%  {self.noise[i]:9.2e}  "
                f"{self.whiteness[i]:8.2g}  {self.independence[i]:8.2g}"
            )
        verdict = {True: "no sign of it", False: "yes"}
        rows.append(
            f"correlated in time: {verdict[self.white]}; with the input: "
            f"{verdict[self.independent]} (level {self.level:g})"
        )
        seen = ", ".join(
            f"{100 * x:.2g} % of {name}" for x, name in zip(self.visible, self.outputs, strict=True)
        )
        rows.append(f"misfits that would be noticed in four of five such data: {seen}")
        return "\n".join(rows)


def validate(
    model: LDTP | SeriesFit,
    data: RecordedData,
    *,
    start: Literal["free", "cycle"] = "free",
    lags: int | None = None,
    level: float = 0.01,
) -> Validation:
    r"""Simulate a model on data and test what it leaves.

    Both tests are made for each section of the period and then summed up, since the statistics of
    a periodic system's residuals are periodic themselves. *Whiteness*: the sums of squared
    correlations with earlier residuals, chi-squared (the portmanteau test of Box and Pierce, for
    periodic models McLeod 1994): of their means over the sections and of the differences from
    these, of which the smaller p-value is taken, corrected for the choice. *Independence*: the
    part of the residuals that lagged inputs explain, compared with the rest (an F ratio for each
    section), whatever the spectrum of the input; its level holds for residuals that are white.

    **Arguments:**

    - `model`: identified or exact, or a `SeriesFit`, which is simulated as it is.
    - `data`: as for `fit_series`, best those that the model was not made from; those that it was
      made from always fit too well.
    - `start`: "free" estimates the state at the start of each record from it; "cycle" takes it as
      zero. A drift that the records announce is estimated from them in either case.
    - `lags`: how many are looked at; default one period, less for few cycles.
    - `level`: of the tests.

    **Raises:** `DefinitionError` if model and data have different N or names, or there are too few
    cycles for any lag.
    """
    if not 0 < level < 1:
        raise DefinitionError(f"level must lie between 0 and 1, not {level}.")
    free_start = check_start(start) == "free"
    records = uninterrupted_records(data)
    N, outputs = records[0].n_sections, records[0].outputs
    require_same_kind(model, records[0])
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
    lags = min(N, int(fewest) // _SAMPLES_PER_LAG) if lags is None else lags
    if lags < 1:
        raise DefinitionError(f"lags must be at least 1, not {lags}.")
    auto, white = _whiteness(records, e, N, lags)
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
        measured=records[0].y,
        simulated=simulated[0],
        level=level,
        first_section=records[0].first_section,
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


def _earlier(x: np.ndarray, lag: int) -> np.ndarray:
    """x, `lag` samples earlier; NaN before its start."""
    out = np.full_like(x, np.nan)
    out[lag:] = x[: len(x) - lag] if lag else x
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
