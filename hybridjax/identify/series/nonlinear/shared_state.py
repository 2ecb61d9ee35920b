r"""The form of a periodic system in which all sections share one state, cycle by cycle.

With $w[p]$ the inputs of cycle p, a system with d non-zero multipliers obeys

$$x[p+1] = A x[p] + B w[p], \qquad
y_n[p] = C_n x[p - k_n] + \sum_r b_n[r]\, u[pN + n - r] + \varepsilon_n[p].$$

The sum takes the inputs since the beginning of cycle $p - k_n$, so long ago that only d dimensions
are left of the state (the others die within the overhang). Multipliers are the eigenvalues of A.
For given A and B the state is simulated; C and b are then linear unknowns, section by section.
"""

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


class Direct(NamedTuple):
    """Orthonormal bases of what is linear in an output at a section."""

    drift: Float[np.ndarray, "S T k"]
    """Record by record; zero at rows that are not sampled."""
    inputs: Float[np.ndarray, "rows r"]
    """At the rows sampled, of what the drift leaves of inputs."""

    @property
    def size(self) -> float:
        """How many unknowns these are."""
        return float((self.drift**2).sum()) + self.inputs.shape[1]

    def without(
        self, v: Float[np.ndarray, "rows C"], rows: Bool[np.ndarray, "S T"]
    ) -> Float[np.ndarray, "rows C"]:
        """What they leave of columns."""
        if self.drift.shape[2]:
            everywhere = np.zeros((*rows.shape, v.shape[1]))
            everywhere[rows] = v
            v = self.without_drift(everywhere)[rows]
        return v - self.inputs @ (self.inputs.T @ v)

    def without_drift(self, v: Float[np.ndarray, "S T C"]) -> Float[np.ndarray, "S T C"]:
        return v - self.drift @ (self.drift.swapaxes(1, 2) @ v)


class SharedStateProblem(NamedTuple):
    """What does not depend on A and B."""

    inflow: Float[np.ndarray, "S T K"]
    """What enters the state at the beginning of each cycle: the inputs of the cycle before, and
    products; at a record's beginning, what the state is there."""
    y: Float[np.ndarray, "S T N ny"]
    sampled: Bool[np.ndarray, "S T N ny"]
    back: list[int]
    """k_n, for each section."""
    direct: list[list[Direct]]
    """For each section and output."""
    starts: range
    """Which columns of the inflow are the states at the beginning of records, one for each."""
    noise: Float[np.ndarray, "N ny"]
    """Standard deviation of the noise that residuals are divided by."""

    @property
    def smallest_share_left(self) -> float:
        """Of the samples of a section, by the unknowns of that section and those of B."""
        return min(
            1 - (one.size + self.inflow.shape[2]) / self.sampled[:, :, n, i].sum()
            for n, each in enumerate(self.direct)
            for i, one in enumerate(each)
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
        starts=range(later.shape[2], later.shape[2] + starts.shape[2]),
        noise=noise,
    )


def _direct(
    grid: CycleGrid,
    n: int,
    back: int,
    sampled: Bool[np.ndarray, "S T ny"],
    products: ProductInputs | None,
) -> list[Direct]:
    """For each output at section n: drift, and the inputs since cycle p - k_n."""
    lags = grid.lead + n + back * grid.n_sections + 1
    size = np.sqrt((grid.u**2).mean())
    columns = [lagged_inputs(grid.u, n, lags, grid.lead) / size]
    if products is not None:
        columns += [delay_cycles(products.values, j) for j in range(1, back + 1)]
        columns.append(products.values[:, :, products.first_section <= n + grid.lead])
    every = np.concatenate(columns, axis=2)
    found: list[Direct] = []
    for i in range(sampled.shape[2]):
        if i and np.array_equal(sampled[..., i], sampled[..., i - 1]):
            found.append(found[-1])
            continue
        rows = sampled[..., i]
        drift, s, _ = np.linalg.svd(grid.drift * rows[..., None], full_matrices=False)
        drift = drift * (s > RANK * s.max(axis=1, initial=0, keepdims=True))[:, None]
        nothing = Direct(drift, np.zeros((int(rows.sum()), 0)))
        left, s, _ = np.linalg.svd(nothing.without(every[rows], rows), full_matrices=False)
        found.append(Direct(drift, left[:, s > RANK * s.max(initial=0)]))
    return found


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
