"""A part of second order in recorded series: whether to allow for it.

A little nonlinearity adds a part of second order, which obeys the same equations as the first-order
response (`shared_state`) with products of the first-order state and the input in place of the input
(perturbation expansion). Since that state is simulated, and free of noise, such products are inputs
like others. They cost many unknowns: the estimate counts only where they explain much of the
misfit, and the plain one (`output_error`) is kept elsewhere.
"""

from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from ...denominator import Denominator
from ..cycle_grid import CycleGrid
from ..section_regression import RANK
from .shared_state import ProductInputs, set_up, simulate_state, smallest_noise
from .shared_state_fit import SharedStateFit, denominator_of, first_model, fit_shared_state


# Parts of a cycle, the mean inputs of which take part in products. Doubled: two to four times as
# many products, which follow the response more closely.
_BLOCKS = 4
# Share of the samples of a section that products must leave. Doubled: they are tried less often.
_SHARE_LEFT = 1 / 3
# Factor by which products must lower the variance of the misfit. Larger by a third: where nearly
# half of the misfit is distortion, regions hold less often than they say. (The smaller of two
# standard errors must not decide: the one that is chosen is too small then.)
_EXPLAINED = 1.5


class _CycleInputs(NamedTuple):
    """The inputs of each cycle in independent combinations of variance 1."""

    values: Float[np.ndarray, "S T K"]
    basis: Float[np.ndarray, "columns K"]
    """Takes them to the inputs, by section and input."""


def allow_for_second_order(
    grid: CycleGrid,
    responses: Float[np.ndarray, "N lags ny nu"],
    order: int,
    overhang: int,
    noise: Float[np.ndarray, "N ny"],
    *,
    free_start: bool,
    errors: Literal["residuals", "white"],
    always: bool,
    max_steps: int,
) -> Denominator | None:
    """An estimate that allows for a part of second order, from the responses of a first fit.

    None where products leave too little freedom or, unless `always`, explain little of the misfit.
    """
    N = grid.n_sections
    back = [max(0, -(-(overhang - n) // N)) for n in range(N)]
    noise = np.maximum(noise, smallest_noise(grid.y, np.isfinite(grid.y)))
    inputs = _whitened(grid.u)
    problem = set_up(grid, inputs.values, back, noise, free_start)
    model = first_model(responses, order, back, noise, inputs.basis)
    plain = fit_shared_state(problem, model, max_steps)
    products = _products(grid, simulate_state(plain.problem, plain.model))
    problem = set_up(grid, inputs.values, back, plain.problem.noise, free_start, products)
    if problem.smallest_share_left < (0 if always else _SHARE_LEFT):
        return None
    full = fit_shared_state(problem, plain.model, max_steps)
    if always or _explained(plain, full) > _EXPLAINED:
        return denominator_of(full, errors)
    return None


def _explained(plain: SharedStateFit, full: SharedStateFit) -> float:
    """Factor by which products lower the variance of the misfit."""
    return float(np.exp(-2 * np.log(full.problem.noise / plain.problem.noise).mean()))


def _whitened(u: Float[np.ndarray, "S T N nu"]) -> _CycleInputs:
    S, T = u.shape[:2]
    rows = u.reshape(S * T, -1)
    left, s, right = np.linalg.svd(rows, full_matrices=False)
    kept = s > RANK * s.max(initial=0)
    size = np.sqrt(len(rows))
    return _CycleInputs((left[:, kept] * size).reshape(S, T, -1), right[kept].T * (s[kept] / size))


def _products(grid: CycleGrid, x: Float[np.ndarray, "S T d"]) -> ProductInputs:
    """Products of two of the states and mean inputs of each cycle."""
    N = grid.n_sections
    blocks = np.array_split(np.arange(N), min(_BLOCKS, N))
    factors = np.concatenate([x, *(grid.u[:, :, part].mean(axis=2) for part in blocks)], axis=2)
    first_section = np.repeat(
        [0, *(part[0] for part in blocks)], [x.shape[2]] + [grid.u.shape[3]] * len(blocks)
    )
    size = np.sqrt((factors**2).mean(axis=(0, 1)))
    factors = factors / np.where(size > 0, size, 1.0)
    i, j = np.triu_indices(len(first_section))
    inside = grid.inside.any(axis=2)[..., None]
    return ProductInputs(factors[..., i] * factors[..., j] * inside, first_section[j])
