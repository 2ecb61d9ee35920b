r"""The form of a periodic system in which all sections share one state, cycle by cycle.

With $w[p]$ the inputs of cycle p, a system with d non-zero multipliers obeys

$$x[p+1] = A x[p] + B w[p], \qquad
y_n[p] = C_n x[p - k_n] + \sum_r b_n[r]\, u[pN + n - r] + \varepsilon_n[p].$$

The sum takes the inputs since the beginning of cycle $p - k_n$, so long ago that only d dimensions
are left of the state (the others die within the overhang). Multipliers are the eigenvalues of A.
For given A and B the state is simulated; C and b are then linear unknowns, section by section.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ..cycle_filters import delay_cycles, lagged_inputs
from ..cycle_grid import CycleGrid
from ..section_regression import RANK


# Part of the rms of an output that no noise is taken to be smaller than: rounding. Doubled:
# sections without noise count half as much beside noisy ones.
_ROUNDING = 1e-12
# Part of an output's largest rms that its rms at a section is taken to be at least, for this.
# Doubled: sections where an output is nearly zero count half as much, if they have no noise.
_SMALLEST_OUTPUT = 1e-6


class SharedStateModel(NamedTuple):
    A: Float[np.ndarray, "d d"]
    B: Float[np.ndarray, "d K"]


class ProductInputs(NamedTuple):
    """Products of states and inputs, which act as if they were inputs of their own."""

    values: Float[np.ndarray, "S T K"]
    """One of each in a cycle."""
    first_section: Int[np.ndarray, " K"]
    """The section from which on each may act."""


class SharedStateProblem(NamedTuple):
    """What does not depend on A and B."""

    inflow: Float[np.ndarray, "S T K"]
    """What enters the state at the beginning of each cycle: the inputs of the cycle before, and
    products; at a record's beginning, what the state is there."""
    y: Float[np.ndarray, "S T N ny"]
    sampled: Bool[np.ndarray, "S T N ny"]
    back: list[int]
    """k_n, for each section."""
    direct: list[list[Float[np.ndarray, "rows k"]]]
    """For each section and output an orthonormal basis of what is linear, at the rows sampled."""
    noise: Float[np.ndarray, "N ny"]
    """Standard deviation of the noise that residuals are divided by."""

    @property
    def smallest_share_left(self) -> float:
        """Of the samples of a section, by the unknowns of that section and those of B."""
        return min(
            1 - (basis.shape[1] + self.inflow.shape[2]) / self.sampled[:, :, n, i].sum()
            for n, bases in enumerate(self.direct)
            for i, basis in enumerate(bases)
        )

    def with_noise(self, noise: Float[np.ndarray, "N ny"]) -> "SharedStateProblem":
        """The same with other noise, but none below rounding."""
        return self._replace(noise=np.maximum(noise, smallest_noise(self.y, self.sampled)))


def smallest_noise(
    y: Float[np.ndarray, "S T N ny"], sampled: Bool[np.ndarray, "S T N ny"]
) -> Float[np.ndarray, "N ny"]:
    """What no noise is taken to be smaller than."""
    count = np.maximum(sampled.sum(axis=(0, 1)), 1)
    size = np.sqrt((np.where(sampled, y, 0.0) ** 2).sum(axis=(0, 1)) / count)
    return _ROUNDING * np.maximum(size, _SMALLEST_OUTPUT * size.max(axis=0))


def set_up(
    grid: CycleGrid,
    cycle_inputs: Float[np.ndarray, "S T K"],
    back: list[int],
    noise: Float[np.ndarray, "N ny"],
    free_start: bool,
    products: ProductInputs | None = None,
) -> SharedStateProblem:
    """The problem of some records.

    **Arguments:** `cycle_inputs`: w. `back`: k_n. `free_start`: whether the state at the start of
    records is unknown, or zero. `products`: inputs besides.
    """
    S, T, N, ny = grid.y.shape
    cycle = np.arange(T)
    first = np.zeros(S, int)
    starts = np.zeros((S, T, S if free_start else 0))
    if free_start:
        whole = grid.inside.all(axis=2)
        first = np.where(whole.any(axis=1), np.argmax(whole, axis=1), T)
        s = np.flatnonzero(first < T)
        starts[s, first[s], s] = 1.0
    parts = [cycle_inputs] if products is None else [cycle_inputs, products.values]
    later, *others = [delay_cycles(x, 1) * (cycle > first[:, None])[..., None] for x in parts]
    sampled = np.isfinite(grid.y)
    sampled &= (cycle[:, None] >= first[:, None, None] + np.array(back))[..., None]
    return SharedStateProblem(
        inflow=np.concatenate([later, starts, *others], axis=2),
        y=np.where(sampled, grid.y, 0.0),
        sampled=sampled,
        back=back,
        direct=[_direct(grid, n, back[n], sampled[:, :, n], products) for n in range(N)],
        noise=noise,
    )


def _direct(
    grid: CycleGrid,
    n: int,
    back: int,
    sampled: Bool[np.ndarray, "S T ny"],
    products: ProductInputs | None,
) -> list[Float[np.ndarray, "rows k"]]:
    """Bases, for each output at section n, of the inputs since cycle p - k_n, and of drift."""
    S, T, N, ny = grid.y.shape
    lags = grid.lead + n + back * N + 1
    size = np.sqrt((grid.u**2).mean())
    drift = np.zeros((S, T, S, grid.drift.shape[2]))  # each record has its own
    drift[np.arange(S), :, np.arange(S)] = grid.drift
    columns = [lagged_inputs(grid.u, n, lags, grid.lead) / size, drift.reshape(S, T, -1)]
    if products is not None:
        columns += [delay_cycles(products.values, j) for j in range(1, back + 1)]
        columns.append(products.values[:, :, products.first_section <= n + grid.lead])
    every = np.concatenate(columns, axis=2)
    bases = []
    for i in range(ny):
        if i and np.array_equal(sampled[..., i], sampled[..., i - 1]):
            bases.append(bases[-1])
            continue
        left, s, _ = np.linalg.svd(every[sampled[..., i]], full_matrices=False)
        bases.append(left[:, s > RANK * s.max(initial=0)])
    return bases


def simulate_state(
    problem: SharedStateProblem, model: SharedStateModel
) -> Float[np.ndarray, "S T d"]:
    """x at the beginning of each cycle."""
    drive = problem.inflow @ model.B.T
    x = np.zeros_like(drive)
    now = np.zeros(drive[:, 0].shape)
    for p in range(x.shape[1]):
        now = now @ model.A.T + drive[:, p]
        x[:, p] = now
    return x


def _state_slopes(
    problem: SharedStateProblem, model: SharedStateModel, x: Float[np.ndarray, "S T d"]
) -> Float[np.ndarray, "S T d P"]:
    """Derivatives of x with respect to the entries of A and B, row by row."""
    S, T, d = x.shape
    K = problem.inflow.shape[2]
    slopes = np.zeros((S, T, d, d * (d + K)))
    for j in range(d):
        slopes[:, 1:, j, j * d : (j + 1) * d] = x[:, :-1]
        slopes[:, :, j, d * d + j * K : d * d + (j + 1) * K] = problem.inflow
    for p in range(1, T):
        slopes[:, p] += model.A @ slopes[:, p - 1]
    return slopes


class ChannelMisfit(NamedTuple):
    """What C_n and b_n leave of one output at one section, at the rows sampled."""

    section: int
    output: int
    rows: Bool[np.ndarray, "S T"]
    error: Float[np.ndarray, " rows"]
    """Over its noise."""
    jacobian: Float[np.ndarray, "rows P"] | None
    """Derivative of what is fitted, over the noise; None where it was not asked for."""
    leverage: Float[np.ndarray, " rows"]
    """The share of its own error that the fit takes from each sample."""


def channel_misfits(
    problem: SharedStateProblem, model: SharedStateModel, slopes: bool = True
) -> Iterator[ChannelMisfit]:
    """For each section and output; `slopes`: whether derivatives are wanted."""
    x = simulate_state(problem, model)
    dx = _state_slopes(problem, model, x) if slopes else None
    for n, k in enumerate(problem.back):
        before = delay_cycles(x, k)
        slopes_before = None if dx is None else delay_cycles(dx, k)
        for i, Q in enumerate(problem.direct[n]):
            rows = problem.sampled[:, :, n, i]

            def rest(v, Q=Q):
                return v - Q @ (Q.T @ v)

            X, _ = np.linalg.qr(rest(before[rows]))
            y = rest(rest(problem.y[rows][:, n, i]))  # the second time for accuracy
            C = np.linalg.lstsq(rest(before[rows]), y)[0]
            error, jacobian = y - X @ (X.T @ y), None
            if slopes_before is not None:
                jacobian = rest(np.einsum("rdk,d->rk", slopes_before[rows], C))
                jacobian = (jacobian - X @ (X.T @ jacobian)) / problem.noise[n, i]
            leverage = (Q**2).sum(axis=1) + (X**2).sum(axis=1)
            yield ChannelMisfit(n, i, rows, error / problem.noise[n, i], jacobian, leverage)


class Misfit(NamedTuple):
    """All outputs together."""

    cost: float
    residual: Float[np.ndarray, "S T N ny"]
    """Over the noise."""
    freedom: Float[np.ndarray, "N ny"]
    """Samples less the unknowns C and b."""
    hessian: Float[np.ndarray, "P P"]
    """Of Gauss and Newton, by entries of A and B; zero where slopes were not asked for."""
    gradient: Float[np.ndarray, " P"]


def misfit_of(problem: SharedStateProblem, model: SharedStateModel, slopes: bool = True) -> Misfit:
    residual, freedom = np.zeros(problem.y.shape), np.zeros(problem.noise.shape)
    P = model.A.size + model.B.size
    hessian, gradient = np.zeros((P, P)), np.zeros(P)
    for n, i, rows, error, jacobian, leverage in channel_misfits(problem, model, slopes):
        residual[rows, n, i], freedom[n, i] = error, len(error) - leverage.sum()
        if jacobian is not None:
            hessian += jacobian.T @ jacobian
            gradient += jacobian.T @ error
    return Misfit(float((residual**2).sum()), residual, freedom, hessian, gradient)
