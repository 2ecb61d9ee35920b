"""The covariance of the coefficients c of an output-error fit, from blocks of cycles.

`fit.py` calls `uncertainty`, and `jackknife` where residuals are distortion. Errors of neighboring
cycles depend on each other, so that sums over blocks take the place of single residuals. A block
must be longer than the slowest response (`denominator.correlated_cycles`), and both must use the
same length.

If all standard errors are wrong, look at `block_scores`, which compares residuals with noise like
theirs; if those of a fit with distortion are, at `jackknife`; if a finding says that multipliers
change along the data where they do not, at `BlockScores.trend`.
"""

import itertools
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy import special

from .. import denominator
from ..denominator import (
    Covariance,
    fading,
    in_blocks,
    multipliers_of,
    sandwich,
)
from ..descent import Coefficients, NormalEquations
from ..variable_projection import amounts
from .linearization import (
    Linearization,
    SectionFit,
    each_fit,
    filtered_response,
    linearize,
)
from .output_error import OutputErrorProblem, SectionRegression
from .records import (
    CycleGrid,
    count_cycles,
    divide_by_chi,
)


# Number of draws of white noise, from which the noise in the Jacobian is estimated; and number of
# draws of noise filtered by the system. Fewer: standard errors scatter with the draws, by 3 % for
# 16; more: time.
_WHITE_DRAWS = 4
_FILTERED_DRAWS = 16
# Changes in time are tested if there are at least this many blocks more than coefficients. Fewer:
# the test has no power.
_FEWEST_BLOCKS = 6
# A jackknife leaves out at least this number of blocks more than coefficients, and at most so many.
# Fewer: it scatters. More: time.
_FEWEST_LEFT_OUT = 6
_MOST_LEFT_OUT = 20


def coefficient_covariance(
    problem: OutputErrorProblem, solution: Linearization
) -> Covariance:
    """Return the covariance of c, for errors that may depend on each other and on the inputs."""
    covariance, _ = uncertainty(problem, solution)
    return covariance


def uncertainty(
    problem: OutputErrorProblem, solution: Linearization
) -> tuple[Covariance, float]:
    """Return the covariance of c, and the p-value of a c that does not change along the data."""

    def draws(k: int, part: CycleGrid, n: int) -> Float[np.ndarray, "S T ny C"]:
        sampled = part.sampled[:, :, n, :, None]
        white = np.random.default_rng((k, n)).standard_normal(
            (*sampled.shape[:3], _WHITE_DRAWS)
        )
        return white * sampled

    noise = linearize(problem, solution.c, draws).curvature / _WHITE_DRAWS
    curvature = (solution.curvature - noise).sum(axis=0)
    whole = solution.curvature.sum(axis=0)
    if not np.linalg.eigvalsh(whole)[0] > 0:
        return sandwich(curvature, whole), 1.0
    cycles = problem.records.cycles
    lags = denominator.correlated_cycles(multipliers_of(solution.c), cycles)
    scores = block_scores(problem, solution, lags + 1)
    if scores is None:
        return sandwich(curvature, Covariance.unknown(len(whole)).matrix), 1.0
    gradient = scores.covariance()
    covariance = sandwich(curvature, gradient.matrix)._replace(dof=gradient.dof)
    return covariance, scores.trend()


def jackknife(
    problem: OutputErrorProblem, solution: Linearization, stated: Covariance
) -> Covariance:
    r"""Return the covariance of c from fits that leave out one block of cycles each.

    $$\frac{B - 1}{B} \sum_b (c_b - \bar c)(c_b - \bar c)^T$$

    (Delete-block jackknife: Künsch 1989.) Each $c_b$ is one Gauss-Newton step from c. Where errors
    grow with the regressors, as distortion does, the fit hides the largest errors, and a covariance
    that is right for errors of equal size is too small. The jackknife is not; for errors of equal
    size it is too large (HC3: MacKinnon and White, J. Econometrics 29, 1985).

    **Arguments:** `stated`: the covariance for errors of equal size. In directions in which it is
    larger, it is kept; in all of them, if there are too few blocks.
    """
    c = solution.c
    cycles = problem.records.cycles
    lags = denominator.correlated_cycles(multipliers_of(c), cycles)
    parts = list(_without_blocks(problem, lags + 1))
    blocks = len(parts)
    if blocks < len(c) + _FEWEST_LEFT_OUT or not np.isfinite(stated.matrix).all():
        return stated
    linear = [linearize(part, c) for part in parts]
    # (A section without residuals has no gradient, and the step would be arbitrary.)
    if any((part.dof <= len(c)).any() for part in linear):
        return stated
    steps = np.array([_step(part) for part in linear])
    deviation = steps - steps.mean(axis=0)
    matrix = (blocks - 1) / blocks * deviation.T @ deviation
    larger = _larger(matrix, stated.matrix)
    if larger is None:
        return stated
    return Covariance(larger, min(stated.dof, blocks - 1))


def _larger(
    matrix: Float[np.ndarray, "d d"], least: Float[np.ndarray, "d d"]
) -> Float[np.ndarray, "d d"] | None:
    """Return the covariance that has the larger variance of two in each of the directions in which
    both are diagonal. None if they are equal to `least`, or if that is singular."""
    values, vectors = np.linalg.eigh(least)
    if values[0] <= 0:
        return None
    root = vectors * np.sqrt(values)
    inverse = vectors / np.sqrt(values)
    ratios, directions = np.linalg.eigh(inverse.T @ matrix @ inverse)
    if ratios[-1] <= 1:
        return None
    axes = root @ directions
    return axes * np.maximum(ratios, 1.0) @ axes.T


def _step(solution: Linearization) -> Coefficients:
    """Return a Gauss-Newton step from c."""
    curvature = solution.curvature.sum(axis=0)
    gradient = solution.gradient.sum(axis=0)
    step, _ = NormalEquations(curvature, gradient).step(0.0)
    return step


def _without_blocks(
    problem: OutputErrorProblem, cycles: int
) -> Iterator[OutputErrorProblem]:
    """Iterate over the blocks of all records: the problem without the samples of a block.

    **Arguments:** `cycles`: the least length of a block.
    """
    records = problem.records
    times = []
    for grid, begins in zip(records.grids, records.begins, strict=True):
        cycle = np.arange(grid.y.shape[1])
        times.append(begins[:, None] + cycle)
    total = sum(map(count_cycles, records.records))
    blocks = min(total // cycles, _MOST_LEFT_OUT)
    for block in range(blocks):
        grids = [
            grid.where(time * blocks // total != block)
            for grid, time in zip(records.grids, times, strict=True)
        ]
        yield problem._replace(records=records.on(grids))


class _BlockSums(NamedTuple):
    """Sums over the blocks of a section, for some outputs."""

    score: Float[np.ndarray, "B C d"]
    """Products of errors and slopes in each block, for the outputs and for drawn noise."""
    expected: Float[np.ndarray, "B d d"]
    """Expected products of the scores, for white noise of variance one."""
    squares: Float[np.ndarray, "2 C"]
    """Sums of squares of the errors, and of the errors filtered backward by 1 / chi."""
    filtered: Float[np.ndarray, "d d"]
    """Products of the slopes filtered backward."""


class BlockScores(NamedTuple):
    """The gradient at a minimum, as a sum over blocks of cycles."""

    scaled: Float[np.ndarray, "B d"]
    """Scores of the blocks, in units in which the expected sum of their squares is one, for noise
    like that of the data."""
    share: Float[np.ndarray, "B d d"]
    """Expected products of the scores for white noise."""
    root: Float[np.ndarray, "d d"]
    """A root of the expected covariance of the gradient."""
    time: Float[np.ndarray, " B"]
    """The middle of each block, in cycles since the first record."""

    def covariance(self) -> Covariance:
        """Return the covariance of the gradient."""
        d = self.scaled.shape[1]
        # At the minimum, scores add up to zero, which reduces the sum of squares by this part.
        taken = np.einsum("bij,bji->", self.share, self.share) / d
        share = max(1 - taken, 0.5)
        square = self.scaled.T @ self.scaled / share
        matrix = self.root @ square @ self.root.T
        return Covariance(matrix, denominator.block_freedom(self.scaled, self.share))

    def trend(self) -> float:
        """Return the p-value of the hypothesis that coefficients do not change linearly in time.

        A score test: if coefficients change, scores of earlier and later blocks differ. The test
        statistic is the sum of the scores times the time of their block, relative to its covariance
        (Hotelling's T; for constancy of parameters: Nyblom, J. Amer. Stat. Assoc. 84, 1989).
        """
        blocks, d = self.scaled.shape
        if blocks < d + _FEWEST_BLOCKS:
            return 1.0
        weight = np.trace(self.share, axis1=1, axis2=2)
        # (Less the weighted mean, so that errors of the fit itself have no effect.)
        late = self.time - weight @ self.time / weight.sum()
        weighted = late[:, None] * self.scaled
        total = weighted.sum(axis=0)
        inverse = np.linalg.pinv(weighted.T @ weighted)
        square = float(total @ inverse @ total)
        rest = max(blocks - square, 1e-300)
        ratio = square / rest * (blocks - d) / d
        return float(special.fdtrc(d, blocks - d, ratio))


def block_scores(
    problem: OutputErrorProblem, solution: Linearization, cycles: int
) -> BlockScores | None:
    """Return the gradient at the minimum as a sum over blocks of cycles; None if no block has
    degrees of freedom left.

    Errors of neighboring cycles may depend on each other and on the inputs. Numerators fit the
    common part of these errors, and no correction of single residuals restores it. Therefore the
    residuals of a block are errors of a prediction by a fit to the other blocks (delete-block
    jackknife: Künsch 1989; Bell and McCaffrey 2002). They are larger than the true errors. So the
    sum of squares is divided by its expectation for noise like that of the data. This noise has two
    parts: white noise, and noise filtered by 1 / chi (process noise). The amounts of both follow
    from two sums of squares of the residuals (variance components: Rao 1971).
    """
    memory = fading(solution.c)

    def outputs(k: int, part: CycleGrid, n: int) -> Float[np.ndarray, "S T ny C"]:
        """Return the outputs, and noise filtered by the system."""
        y = part.y[:, :, n, :, None]
        rng = np.random.default_rng((k, n))
        draws = rng.standard_normal((*y.shape[:3], _FILTERED_DRAWS))
        return np.concatenate([y, divide_by_chi(memory, draws)], axis=-1)

    def section(k, part, n, fit, regression) -> _BlockSums:
        x = outputs(k, part, n)[:, :, fit.outputs]
        count = max(1, part.y.shape[1] // cycles)
        sampled = part.sampled[:, :, n, fit.outputs, None]
        return _block_sums(x, sampled, fit, regression, solution.c, memory, count)

    fits = linearize(problem, solution.c, outputs).fits
    grids = each_fit(problem, solution._replace(fits=fits), section)
    # Scores of the same block add, over all sections and outputs.
    by_grid = [sum(part.score for part in grid) for grid in grids]
    score = np.concatenate(by_grid)
    expected_by_grid = [sum(part.expected for part in grid) for grid in grids]
    by_white = np.concatenate(expected_by_grid)
    parts = list(itertools.chain(*grids))
    squares = np.sum([part.squares for part in parts], axis=0)
    filtered = sum(part.filtered for part in parts)
    # (Filtered noise contributes as much to the first sum of squares as white noise to the second.)
    first, second = squares[:, 1:].mean(axis=1)
    dof = solution.dof.sum()
    white = np.array([[dof, first], [first, second]])
    of_white, of_filtered = amounts(white, squares[:, 0])
    drawn = score[:, 1:]
    by_filtered = np.einsum("bcd,bce->de", drawn, drawn) / _FILTERED_DRAWS
    expected_by_white = by_white.sum(axis=0)
    expected = of_white * expected_by_white + of_filtered * by_filtered
    true = of_white * solution.curvature.sum(axis=0) + of_filtered * filtered
    # Scale scores so that, for noise like that of the data, the expected sum of squares is one.
    try:
        half = np.linalg.inv(np.linalg.cholesky(expected))
        true = np.linalg.cholesky(true)
        share = np.linalg.inv(np.linalg.cholesky(expected_by_white))
    except np.linalg.LinAlgError:
        return None
    time = []
    for grid, begins in zip(problem.parts(), problem.records.begins, strict=True):
        T = grid.y.shape[1]
        count = max(1, T // cycles)
        length = -(-T // count)
        middle = (np.arange(count) + 0.5) * length
        time.append((begins[:, None] + middle).ravel())
    return BlockScores(
        scaled=score[:, 0] @ half.T,
        share=share @ by_white @ share.T,
        root=true,
        time=np.concatenate(time),
    )


def _block_sums(
    x: Float[np.ndarray, "S T m C"],
    sampled: Bool[np.ndarray, "S T m 1"],
    fit: SectionFit,
    regression: SectionRegression,
    c: Coefficients,
    memory: Coefficients,
    count: int,
) -> _BlockSums:
    """Return the sums over the blocks of each record.

    **Arguments:** `x`: columns for each output, the first measured. `memory`: c, fading.
    """

    # (backward(x) times white noise equals x times filtered noise)
    def backward(x):
        return divide_by_chi(memory, (sampled * x)[:, ::-1])

    rows = (regression.remainder @ fit.root).reshape(*sampled.shape[:2], -1)
    inputs = in_blocks(rows, count)
    starts = in_blocks(regression.basis, count)
    weights = denominator.inverse_of_remainder(inputs @ inputs.mT)
    error = regression.residual(fit.coefficients, x).reshape(x.shape)
    measured = fit.coefficients[..., :1]
    response = filtered_response(measured, c, regression, x[..., :1])
    slopes = regression.residual(fit.slopes[..., :1], response)
    slopes = np.moveaxis(slopes[..., 0], 1, -1)
    shape = error.shape[:3]
    slopes = slopes.reshape(*shape, len(c))
    late = backward(slopes)
    squares = [(e**2).sum(axis=(0, 1, 2)) for e in (error, backward(error))]
    slopes = np.einsum("bkl,blid->bkid", weights, in_blocks(slopes, count))
    expected = np.einsum("bkid,bkie->bde", slopes, slopes)
    for basis in (inputs, starts):
        along = np.einsum("bkr,bkid->brid", basis, slopes)
        expected -= np.einsum("brid,brie->bde", along, along)
    return _BlockSums(
        score=np.einsum("bkid,bkic->bcd", slopes, in_blocks(error, count)),
        expected=expected,
        squares=np.array(squares),
        filtered=np.einsum("stid,stie->de", late, late),
    )
