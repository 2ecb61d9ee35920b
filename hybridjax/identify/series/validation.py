"""Is an identified model good enough? Simulation of data that it has not seen."""

from collections.abc import Sequence
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy import stats

from ...errors import DefinitionError
from ...linear.ldtp import LDTP
from .fit import SeriesFit
from .layout import Piece, Recorded, pieces_of, slow_waves
from .prediction import predict


_FEWEST = 8  # samples of a section, below which a correlation says nothing


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
    - `autocorrelation` (N, lags, ny): of the residual at each section with those 1, 2, ... samples
      earlier. `cross_correlation` (N, lags, ny, nu): of the residual with the inputs 0, 1, ...
      samples earlier. Both in units of their standard deviation where there is no correlation.
    - `measured`, `simulated` (n, ny): the first record; `start`, its first section.
    - `n_sections`, `inputs`, `outputs`.
    """

    fit: Float[np.ndarray, " ny"]
    noise: Float[np.ndarray, " ny"]
    whiteness: Float[np.ndarray, " ny"]
    independence: Float[np.ndarray, " ny"]
    autocorrelation: Float[np.ndarray, "N lags ny"]
    cross_correlation: Float[np.ndarray, "N lags ny nu"]
    measured: Float[np.ndarray, "n ny"]
    simulated: Float[np.ndarray, "n ny"]
    level: float = eqx.field(static=True)
    start: int = eqx.field(static=True)
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
        return "\n".join(rows)


def validate(
    model: LDTP | SeriesFit,
    data: Recorded,
    *,
    start: Literal["free", "rest"] = "free",
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
    - `data`: `ExperimentData`, a `Record` or several, best those that the model was not made from;
      those that it was made from always fit too well.
    - `start`: "free" estimates the state at the start of each record from it; "rest" takes it as
      zero. A drift that the records announce is estimated from them in either case.
    - `lags`: how many are looked at; default one period, less for few cycles.
    - `level`: of the tests.

    **Raises:** `DefinitionError` if model and data have different N or names, or there are too few
    cycles for any lag.
    """
    if not 0 < level < 1:
        raise DefinitionError(f"level must lie between 0 and 1, not {level}.")
    pieces, N, inputs, outputs, *_ = pieces_of(data)
    check_model(model, N, inputs, outputs)
    simulated = [simulate_piece(model, piece, start == "free") for piece in pieces]
    seen = np.concatenate([np.isfinite(p.y) for p in pieces])
    y = np.concatenate([p.y for p in pieces])
    e = [p.y - y for p, y in zip(pieces, simulated, strict=True)]
    error = np.concatenate(e)
    for i, name in enumerate(outputs):
        if seen[:, i].sum() < 2 or np.nanstd(y[:, i]) == 0:
            raise DefinitionError(f"the output {name} is constant or missing at every sample.")
    noise = np.sqrt(np.nanmean(error**2, axis=0))
    spread = np.sqrt(np.nanmean((y - np.nanmean(y, axis=0)) ** 2, axis=0))
    fewest = min(np.bincount(_sections(pieces, N)[seen[:, i]], minlength=N).min()
                 for i in range(len(outputs)))  # fmt: skip
    if fewest < _FEWEST:
        raise DefinitionError(
            f"a section was sampled {fewest} times only; the tests need {_FEWEST} or more cycles."
        )
    lags = min(N, int(fewest) // 4) if lags is None else lags
    if lags < 1:
        raise DefinitionError(f"lags must be at least 1, not {lags}.")
    auto, white = _whiteness(pieces, e, N, lags)
    cross, independent = _independence(pieces, e, N, lags)
    return Validation(
        fit=100 * (1 - noise / spread),
        noise=noise,
        whiteness=white,
        independence=independent,
        autocorrelation=auto,
        cross_correlation=cross,
        measured=pieces[0].y,
        simulated=simulated[0],
        level=level,
        start=pieces[0].start,
        n_sections=N,
        inputs=inputs,
        outputs=outputs,
    )


def check_model(model: LDTP | SeriesFit, N: int, inputs, outputs) -> None:
    of_data = {"n_sections": N, "inputs": inputs, "outputs": outputs}
    for name, value in of_data.items():
        if getattr(model, name) != value:
            raise DefinitionError(
                f"model and data have different {name}: {getattr(model, name)} and {value}."
            )


def simulate_piece(model: LDTP | SeriesFit, piece: Piece, free: bool) -> Float[np.ndarray, "n ny"]:
    """The outputs of the model from the state that fits the record best, or from rest, with the
    drift that does."""
    if isinstance(model, SeriesFit):
        return predict(model, piece, free)
    forced = np.asarray(model.simulate(piece.u, start=piece.start))
    left = (piece.y - forced)[..., None]
    if not free:
        return forced + _slow(left, piece, model.n_sections)[..., 0]
    d = int(model.dims[piece.start])
    still = jnp.zeros_like(jnp.asarray(piece.u))
    states = jnp.eye(model.A.shape[-1])[:d]
    alone = jax.vmap(lambda x0: model.simulate(still, x0, piece.start))(states)
    alone = np.moveaxis(np.asarray(alone), 0, -1)
    both = np.concatenate([left, alone], axis=2)
    both = both - _slow(both, piece, model.n_sections)
    seen = np.isfinite(piece.y)
    # Outputs in units of their size, so that none is neglected.
    size = np.sqrt(np.nanmean(piece.y**2, axis=0, where=seen)) if seen.any() else 1.0
    weight = np.broadcast_to(1 / np.where(size > 0, size, 1.0), piece.y.shape)[seen]
    x0 = np.linalg.lstsq(both[seen][:, 1:] * weight[:, None], both[seen][:, 0] * weight)[0]
    out = forced + alone @ x0
    return out + _slow((piece.y - out)[..., None], piece, model.n_sections)[..., 0]


def _slow(
    x: Float[np.ndarray, "n ny m"], piece: Piece, n_sections: int
) -> Float[np.ndarray, "n ny m"]:
    """The drift that explains most of x at the samples of a piece, section by section."""
    out = np.zeros_like(x)
    waves = slow_waves(piece, n_sections, piece.drift)
    cycle, section = np.divmod(piece.start + np.arange(len(x)), n_sections)
    for n, i in np.ndindex(n_sections, x.shape[1]):
        rows = section == n
        seen = rows & np.isfinite(piece.y[:, i])
        if waves.shape[1] and seen.any():
            out[rows, i] = waves[cycle[rows]] @ np.linalg.lstsq(waves[cycle[seen]], x[seen, i])[0]
    return out


def _sections(pieces: Sequence[Piece], N: int) -> np.ndarray:
    return np.concatenate([(p.start + np.arange(len(p.u))) % N for p in pieces])


def _earlier(x: np.ndarray, lag: int) -> np.ndarray:
    """x, `lag` samples earlier; NaN before its start."""
    out = np.full_like(x, np.nan)
    out[lag:] = x[: len(x) - lag] if lag else x
    return out


def _whiteness(pieces, e, N: int, lags: int):
    section = _sections(pieces, N)
    ny = e[0].shape[1]
    now = np.concatenate(e)
    size = np.stack([np.sqrt(np.nanmean(now[section == n] ** 2, axis=0)) for n in range(N)])
    scale = np.where(size > 0, size, 1.0)
    scaled = [x / scale[(p.start + np.arange(len(x))) % N] for p, x in zip(pieces, e, strict=True)]
    z = np.zeros((N, lags, ny))
    total = np.zeros((N, lags, ny), bool)
    now = np.concatenate(scaled)
    for lag in range(1, lags + 1):
        product = now * np.concatenate([_earlier(x, lag) for x in scaled])
        for n in range(N):
            values = product[section == n]
            count = np.isfinite(values).sum(axis=0)
            z[n, lag - 1] = np.nansum(values, axis=0) / np.sqrt(np.maximum(count, 1))
            total[n, lag - 1] = count >= _FEWEST
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


def _independence(pieces, e, N: int, lags: int):
    section = _sections(pieces, N)
    ny, nu = e[0].shape[1], pieces[0].u.shape[1]
    now = np.concatenate(e)
    past = [np.concatenate([_earlier(p.u, lag) for p in pieces]) for lag in range(lags)]
    past = np.stack(past, axis=1)
    z = np.zeros((N, lags, ny, nu))
    square, freedom = np.zeros(ny), np.zeros(ny)
    for n in range(N):
        inputs, residual = past[section == n], now[section == n]
        for i in range(ny):
            rows = np.isfinite(residual[:, i]) & np.isfinite(inputs).all(axis=(1, 2))
            U, r = inputs[rows].reshape(rows.sum(), -1), residual[rows, i]
            if rows.sum() < _FEWEST or not r.any():
                continue
            size = np.sqrt((U**2).sum(axis=0) * np.mean(r**2))
            z[n, :, i] = (U.T @ r / np.where(size > 0, size, 1.0)).reshape(lags, nu)
            left, s, _ = np.linalg.svd(U, full_matrices=False)
            left = left[:, s > 1e-9 * s[0]]
            if left.shape[1] > len(r) // 2:
                left = left[:, : len(r) // 2]
            # Explained against unexplained part: an F ratio, as its normal deviate squared.
            a, b = left.shape[1], len(r) - left.shape[1]
            inside = ((left.T @ r) ** 2).sum()
            ratio = (inside / a) / ((r @ r - inside) / b)
            square[i] += stats.norm.isf(np.clip(stats.f.sf(ratio, a, b), 1e-300, 1 - 1e-16))
            freedom[i] += 1
    return z, stats.norm.sf(square / np.sqrt(np.maximum(freedom, 1)))
