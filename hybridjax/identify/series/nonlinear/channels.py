"""What the form with one state leaves of each output at each section, and its derivatives."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ..cycle_filters import delay_cycles
from .shared_state import SharedStateModel, SharedStateProblem, simulate_state


def _state_slopes(
    problem: SharedStateProblem, model: SharedStateModel, x: Float[np.ndarray, "S T d"]
) -> tuple[Float[np.ndarray, "S T d P"], Float[np.ndarray, "S T d d"]]:
    """Derivatives of x: with respect to the entries of A and B, row by row, that all records share;
    and of each record's with respect to its own state at the beginning."""
    S, T, d = x.shape
    inflow = np.delete(problem.inflow, problem.starts, axis=2)
    K = inflow.shape[2]
    slopes = np.zeros((S, T, d, d * (d + K)))
    for j in range(d):
        slopes[:, 1:, j, j * d : (j + 1) * d] = x[:, :-1]
        slopes[:, :, j, d * d + j * K : d * d + (j + 1) * K] = inflow
    starts = problem.inflow[:, :, problem.starts.start : problem.starts.stop]
    own = starts.sum(axis=2)[..., None, None] * np.eye(d)
    for p in range(1, T):
        slopes[:, p] += model.A @ slopes[:, p - 1]
        own[:, p] += model.A @ own[:, p - 1]
    return slopes, own


class Columns(NamedTuple):
    """Which entries of A and B, row by row, belong to what."""

    shared: Int[np.ndarray, " P"]
    """To all records."""
    starts: Int[np.ndarray, "S d"]
    """To the state at the beginning of each."""

    @classmethod
    def of(cls, problem: SharedStateProblem, model: SharedStateModel) -> "Columns":
        d, K = model.B.shape
        starts = d * d + np.arange(d) * K + np.array(problem.starts, int)[:, None]
        return cls(np.delete(np.arange(model.A.size + model.B.size), starts.ravel()), starts)


class Slopes(NamedTuple):
    """The derivative of what is fitted to one output at one section, over the noise."""

    shared: Float[np.ndarray, "rows P"]
    """By what all records share."""
    starts: Float[np.ndarray, "S T d"]
    """By each record's state at its beginning, before `basis` is projected out."""
    basis: Float[np.ndarray, "S T z"]
    """Orthonormal, of inputs and state."""

    @property
    def taken(self) -> Float[np.ndarray, "z columns"]:
        """What the basis takes from the derivatives by the states at the beginning."""
        each = self.basis.swapaxes(1, 2) @ self.starts
        return each.transpose(1, 0, 2).reshape(each.shape[1], -1)

    def dense(
        self, columns: Columns, rows: Bool[np.ndarray, "S T"]
    ) -> Float[np.ndarray, "rows P2"]:
        """All columns, at the rows sampled."""
        out = np.zeros((len(self.shared), columns.shared.size + columns.starts.size))
        out[:, columns.shared] = self.shared
        if columns.starts.size:
            S, T, d = self.starts.shape
            own = np.zeros((S, T, S, d))
            own[np.arange(S), :, np.arange(S)] = self.starts
            left = own.reshape(S, T, -1)[rows] - self.basis[rows] @ self.taken
            out[:, columns.starts.ravel()] = left
        return out

    def add_products(
        self,
        hessian: Float[np.ndarray, "P2 P2"],
        gradient: Float[np.ndarray, " P2"],
        error: Float[np.ndarray, " rows"],
        columns: Columns,
        rows: Bool[np.ndarray, "S T"],
    ) -> None:
        """Add those of all columns with each other, and with an error that nothing is left of in
        the basis. Records meet in the basis only: so the cost is that of the samples."""
        g = columns.shared
        hessian[np.ix_(g, g)] += self.shared.T @ self.shared
        gradient[g] += self.shared.T @ error
        if not columns.starts.size:
            return
        s = columns.starts.ravel()
        S, T, d = self.starts.shape
        shared, errors = np.zeros((S, T, len(g))), np.zeros((S, T, 1))
        shared[rows], errors[rows, 0] = self.shared, error
        across = self.starts.swapaxes(1, 2)
        mixed = (across @ shared).reshape(len(s), -1)
        hessian[np.ix_(s, g)] += mixed
        hessian[np.ix_(g, s)] += mixed.T
        gradient[s] += (across @ errors).ravel()
        own = across @ self.starts
        each = columns.starts
        hessian[each[:, :, None], each[:, None]] += own
        hessian[np.ix_(s, s)] -= self.taken.T @ self.taken


class ChannelMisfit(NamedTuple):
    """What C_n and b_n leave of one output at one section, at the rows sampled."""

    section: int
    output: int
    rows: Bool[np.ndarray, "S T"]
    error: Float[np.ndarray, " rows"]
    """Over its noise."""
    slopes: Slopes | None
    """None where they were not asked for."""
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
        dx_before = None if dx is None else [delay_cycles(one, k) for one in dx]
        for i, direct in enumerate(problem.direct[n]):
            rows, noise = problem.sampled[:, :, n, i], problem.noise[n, i]
            state = direct.without(before[rows], rows)
            X, _ = np.linalg.qr(state)
            y = problem.y[rows][:, n, i, None]
            for _ in range(2):  # the second time for accuracy
                y = direct.without(y, rows)
            C = np.linalg.lstsq(state, y[:, 0])[0]
            error, found = y[:, 0] - X @ (X.T @ y[:, 0]), None
            if dx_before is not None:
                shared, starts = (one.swapaxes(2, 3) @ C for one in dx_before)
                left = direct.without(shared[rows], rows)
                basis = np.zeros((*rows.shape, direct.inputs.shape[1] + X.shape[1]))
                basis[rows] = np.concatenate([direct.inputs, X], axis=1)
                starts = direct.without_drift(starts * rows[..., None])
                found = Slopes((left - X @ (X.T @ left)) / noise, starts / noise, basis)
            leverage = (direct.inputs**2).sum(axis=1) + (X**2).sum(axis=1)
            leverage += (direct.drift**2).sum(axis=2)[rows]
            yield ChannelMisfit(n, i, rows, error / noise, found, leverage)


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
    P, columns = model.A.size + model.B.size, Columns.of(problem, model)
    hessian, gradient = np.zeros((P, P)), np.zeros(P)
    for n, i, rows, error, found, leverage in channel_misfits(problem, model, slopes):
        residual[rows, n, i], freedom[n, i] = error, len(error) - leverage.sum()
        if found is not None:
            found.add_products(hessian, gradient, error, columns, rows)
    return Misfit(float((residual**2).sum()), residual, freedom, hessian, gradient)
