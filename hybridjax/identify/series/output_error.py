r"""The output-error problem in time: numerators and unknown starts projected out.

With $\chi(q^{-N}) y = B_{n \bmod N}(q^{-1}) u$ and $v = \chi^{-1} u$, filtered from cycle to cycle,

$$y[n] = \sum_r b_{n \bmod N}[r]\, v[n-r] + (\chi^{-1} g)[n] + \varepsilon[n],$$

where g is free in the first cycles of each record: it stands for inputs and outputs before the
record. For given c every section is a linear regression of its own, in b and g.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ..._core.threads import on_all_cores
from ...errors import DefinitionError
from ..multipliers.covariance import Covariance
from ..multipliers.gauss_newton import Coefficients
from .cycle_filters import divide_by_chi, lagged_inputs, start_responses
from .cycle_grid import CycleGrid
from .section_regression import RANK, SectionRegression, weighted_alike


# Smallest share of its errors that a fit to all leaves to a block, so that dividing by it stays
# finite. Doubled: blocks that the others hardly predict weigh half as much.
_SMALLEST_REMAINDER = 0.1
# Largest correction of a covariance for the freedom that the minimum takes: to 1 / 0.5. Doubled:
# none.
_SMALLEST_FREEDOM = 0.5


class OutputErrorProblem(NamedTuple):
    """What does not depend on c."""

    u: Float[np.ndarray, "S T N nu"]
    y: Float[np.ndarray, "S T N ny"]
    """In units of `scale`; zero where there is no sample."""
    weight: Float[np.ndarray, "S T N ny"]
    """What each sample's equation is multiplied by: 1, less for outliers, zero where there is no
    sample."""
    first: Int[np.ndarray, "S N"]
    """The cycle in which a record first meets a section."""
    lags: int
    """R: numerators have the lags -lead..R-1-lead."""
    lead: int
    free: int
    """K: the cycles at the start of each record in which g is free."""
    to_lags: list[Float[np.ndarray, "columns r"]]
    """For each section: the combinations of lagged inputs that are linearly independent."""
    drift: Float[np.ndarray, "S T K"]
    """What an unknown drift of the outputs is composed of."""
    scale: Float[np.ndarray, " ny"]

    @classmethod
    def from_grid(
        cls, grid: CycleGrid, order: int, overhang: int, free_start: bool
    ) -> "OutputErrorProblem":
        """**Arguments:** `order`: d. `overhang`: lags of the numerators beyond d N. `free_start`:
        whether the state at the start of records is unknown, or zero."""
        N = grid.n_sections
        lags = grid.lead + order * N + overhang + 1
        if lags > grid.y[0, ..., 0].size:
            raise DefinitionError(
                f"numerators of {lags} lags reach beyond the longest record, of "
                f"{grid.y[0, ..., 0].size} samples: lower `order` or `overhang`."
            )
        free = order + -(-overhang // N) if free_start else 0
        sampled, first = np.isfinite(grid.y), np.argmax(grid.inside, axis=1)
        cycle = np.arange(grid.y.shape[1])

        def independent(n: int):
            tells = sampled[:, :, n].any(axis=2) & (cycle >= first[:, n, None] + free)
            rows = lagged_inputs(grid.u, n, lags, grid.lead)[tells]
            _, s, vh = np.linalg.svd(np.linalg.qr(rows, mode="r"), full_matrices=False)
            kept = s > RANK * s.max(initial=0)
            return vh[kept].T / s[kept]

        scale = np.sqrt(np.nanmean(grid.y**2, axis=(0, 1, 2)))
        return cls(
            u=grid.u,
            y=np.where(sampled, grid.y, 0.0) / scale,
            weight=sampled.astype(float),
            first=first,
            lags=lags,
            lead=grid.lead,
            free=free,
            to_lags=on_all_cores(independent, range(N)),
            drift=grid.drift,
            scale=scale,
        )

    @property
    def sampled(self) -> Bool[np.ndarray, "S T N ny"]:
        """Where there is a sample."""
        return self.weight > 0

    def rescale(self, noise: Float[np.ndarray, " ny"]) -> "OutputErrorProblem":
        """The same with each output in units of its noise, which was `noise` units before."""
        return self._replace(y=self.y / noise, scale=self.scale * noise)


class Linearization(NamedTuple):
    """What the numerators and free starts leave of the outputs at some c, and its derivative."""

    residual: Float[np.ndarray, "S T N ny C"]
    """Times the weights of the problem, as the derivative is."""
    jacobian: Float[np.ndarray, "d S T N ny C"]
    freedom: Int[np.ndarray, "N ny"]
    """Samples less unknowns."""
    leverage: Float[np.ndarray, "S T N ny"]
    """The share of its own error that the fit takes from each sample."""
    numerators: Float[np.ndarray, "N columns ny"]
    """Of the first column of outputs; rows are lags, then inputs."""
    slope: Float[np.ndarray, "d N columns ny"]
    """Their derivative with respect to c."""
    roots: list[list[Float[np.ndarray, "columns r"]]]
    """root @ root.T is the covariance of the numerators of a section and output, given c."""

    def rescale(self, noise: Float[np.ndarray, " ny"]) -> "Linearization":
        """That of the problem with each output in units of its noise."""
        return self._replace(
            residual=self.residual / noise[:, None],
            jacobian=self.jacobian / noise[:, None],
            numerators=self.numerators / noise,
            slope=self.slope / noise,
        )


def section_regressions(
    problem: OutputErrorProblem, c: Coefficients, v: Float[np.ndarray, "S T N nu"], n: int
) -> Iterator[tuple[list[int], SectionRegression]]:
    """Those of section n, and the outputs that each is for; `v`: the inputs over chi."""
    inputs = lagged_inputs(v, n, problem.lags, problem.lead) @ problem.to_lags[n]
    T = problem.y.shape[1]
    starts = start_responses(c, problem.first[:, n], T, min(problem.free, T))
    for weight, outputs in weighted_alike(problem.weight[:, :, n]):
        yield outputs, SectionRegression.make(inputs, starts, problem.drift, weight)


def linearize(
    problem: OutputErrorProblem,
    c: Coefficients,
    y: Float[np.ndarray, "S T N ny C"] | None = None,
) -> Linearization:
    """The residuals and their derivative in c, section by section.

    The derivative omits what vanishes with the residual (Kaufman 1975). `y`: other outputs than
    those measured, C of each.
    """
    S, T, N, ny = problem.y.shape
    y = problem.y[..., None] if y is None else y
    d, columns = len(c), problem.lags * problem.u.shape[3]
    found = Linearization(
        residual=np.zeros(y.shape),
        jacobian=np.zeros((d, *y.shape)),
        freedom=np.zeros((N, ny), int),
        leverage=np.zeros((S, T, N, ny)),
        numerators=np.zeros((N, columns, ny)),
        slope=np.zeros((d, N, columns, ny)),
        roots=[[np.zeros((0, 0))] * ny for _ in range(N)],
    )
    v = divide_by_chi(c, problem.u)

    def section(n: int) -> None:
        to_lags = problem.to_lags[n]
        for outputs, regression in section_regressions(problem, c, v, n):
            shape = (len(outputs), y.shape[4])
            x = y[:, :, n, outputs].reshape(S, T, -1)
            a, left = regression.solve(x)
            found.residual[:, :, n, outputs] = left.reshape(S, T, *shape)
            # The residual's derivative in c_j: q^-jN / chi of what was fitted, less what fits that.
            fitted = regression.response(a, x)
            fitted = np.concatenate([divide_by_chi(c, fitted, j + 1) for j in range(d)], axis=2)
            more, slopes = regression.solve(fitted)
            slopes = np.moveaxis(slopes.reshape(S, T, d, *shape), 2, 0)
            found.jacobian[:, :, :, n, outputs] = slopes
            found.freedom[n, outputs] = regression.freedom
            found.leverage[:, :, n, outputs] = regression.leverage[..., None]
            found.numerators[n][:, outputs] = to_lags @ a.reshape(-1, *shape)[..., 0]
            more = np.moveaxis(more.reshape(-1, d, *shape)[..., 0], 1, 0)
            found.slope[:, n][..., outputs] = to_lags @ more
            for i in outputs:
                found.roots[n][i] = to_lags @ regression.root

    on_all_cores(section, range(N))
    return found


def gradient_covariance(
    problem: OutputErrorProblem, c: Coefficients, found: Linearization, cycles: int
) -> Covariance:
    """The covariance of the gradient at the minimum, from blocks of so many cycles or more.

    Errors of neighboring cycles may depend on each other and on the inputs, as those of distortion
    do. Numerators take what these cycles have in common, and no correction of single residuals puts
    that back. Each block's errors are those of a prediction by a fit to the others (the jackknife
    that deletes blocks: Künsch 1989; Bell and McCaffrey 2002), which are larger than the true ones.
    The sum of the squares is therefore taken relative to what it is on average for white noise. Its
    freedom is that by which the blocks scatter (Pan and Wall 2002), at most that of normal errors
    (Satterthwaite 1946).
    """
    T, N, d = *problem.y.shape[1:3], len(c)
    count = max(1, T // cycles)
    length = -(-T // count)
    v = divide_by_chi(c, problem.u)

    def blocks(x):  # (S, T, ...) -> (S count, length, ...)
        padding = [(0, 0), (0, count * length - T)] + [(0, 0)] * (x.ndim - 2)
        return np.pad(x, padding).reshape(len(x) * count, length, *x.shape[2:])

    score: Float[np.ndarray, "B d"] = np.zeros((len(problem.y) * count, d))
    expected: Float[np.ndarray, "B d d"] = np.zeros((len(score), d, d))
    for n in range(N):
        for outputs, regression in section_regressions(problem, c, v, n):
            inputs, starts = blocks(regression.input_basis), blocks(regression.basis)
            left, axes = np.linalg.eigh(np.eye(length) - inputs @ inputs.swapaxes(1, 2))
            left = np.maximum(left, _SMALLEST_REMAINDER)[:, None]
            slopes = blocks(np.moveaxis(found.jacobian[:, :, :, n, outputs, 0], 0, -1))
            slopes = np.einsum("bkl,blid->bkid", axes / left @ axes.swapaxes(1, 2), slopes)
            error = blocks(found.residual[:, :, n, outputs, 0])
            score += np.einsum("bkid,bki->bd", slopes, error)
            expected += np.einsum("bkid,bkie->bde", slopes, slopes)
            for basis in (inputs, starts):
                along = np.einsum("bkr,bkid->brid", basis, slopes)
                expected -= np.einsum("brid,brie->bde", along, along)
    # In units in which white noise makes the sum one.
    try:
        half = np.linalg.inv(np.linalg.cholesky(expected.sum(axis=0)))
    except np.linalg.LinAlgError:  # nothing is left of any block
        return Covariance.unknown(d)
    score, share = score @ half.T, half @ expected @ half.T
    sum_of_squares = score.T @ score
    # Scores add up to zero at the minimum, which takes this part of the sum away.
    taken = np.einsum("bij,bji->", share, share) / d
    white = np.linalg.cholesky(np.einsum("istnac,jstnac->ij", found.jacobian, found.jacobian))
    matrix = white @ sum_of_squares @ white.T / max(1 - taken, _SMALLEST_FREEDOM)
    part = np.einsum("bi,ij,bj->b", score, np.linalg.pinv(sum_of_squares), score) / d
    normal = np.trace(share, axis1=1, axis2=2) / d
    scatter = max(((part - normal) ** 2).sum() * d / 2, (normal**2).sum())
    return Covariance(matrix, float(1 / scatter))
