"""Fit of the form in which all sections share one state: its start, its minimum, its accuracy."""

from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from ...multipliers.covariance import Covariance
from ...multipliers.denominator import Denominator
from .channels import misfit_of
from .jackknife import jackknife
from .shared_state import SharedStateModel, SharedStateProblem, simulate_state


HORIZON = 8  # cycles of inputs from which the first model is made; doubled: more noise, less bias
# Largest modulus of a multiplier in the first model: unstable ones are brought here. Doubled:
# simulations from it would overflow.
_LARGEST_FIRST_MODULUS = 0.99
# Modulus of a multiplier beyond which a step is halved. Doubled: simulations overflow more often.
_LARGEST_MODULUS = 1.2
# Eigenvalues of the Hessian, relative to the largest, that belong to the choice of coordinates of
# x, along which nothing changes. Doubled: directions known 1.4 times better are taken for these.
_NO_CURVATURE = 1e-11
# Halvings of a step that raises the cost. Doubled: steps down to 6e-8 instead of 2e-4 are tried.
_MAX_HALVINGS = 12
# Squared length of a step, in units of its standard error, that is the last one. Doubled: the
# minimum is missed by up to 0.14 instead of 0.1 standard errors.
_SETTLED_GAIN = 1e-2
# If no halved step lowers the cost: the gain, relative to the cost, or the largest entry of the
# step, that rounding explains. Doubled: iterations that stall count as converged more often.
_STALLED_GAIN, _STALLED_STEP = 1e-6, 1e-8


class SharedStateFit(NamedTuple):
    problem: SharedStateProblem
    """With the noise that the misfit suggests."""
    model: SharedStateModel
    converged: bool


def first_model(
    responses: Float[np.ndarray, "N lags ny nu"],
    order: int,
    back: list[int],
    noise: Float[np.ndarray, "N ny"],
    input_basis: Float[np.ndarray, "columns K"],
) -> SharedStateModel:
    """By singular values (Ho and Kalman 1966) of responses to the inputs of earlier cycles.

    **Arguments:** `responses`, of a first fit. `input_basis` takes w to the inputs of a cycle.
    """
    N, _, ny, nu = responses.shape
    m = np.arange(N)
    rows = []
    for n, k in enumerate(back):
        for later in range(order):
            lag = n + (k + 1 + later + np.arange(HORIZON)[:, None]) * N - m
            late = responses[n, lag] / noise[n, :, None]  # (cycles, N, ny, nu)
            late = late.transpose(2, 0, 1, 3).reshape(ny, HORIZON, N * nu)
            rows.append(late @ input_basis)
    hankel = np.concatenate(rows)
    _, s, right = np.linalg.svd(hankel.reshape(len(hankel), -1), full_matrices=False)
    powers = (s[:order, None] * right[:order]).reshape(order, HORIZON, -1)  # A^k B
    before, after = powers[:, :-1].reshape(order, -1), powers[:, 1:].reshape(order, -1)
    A = np.linalg.lstsq(before.T, after.T)[0].T
    size = np.abs(np.linalg.eigvals(A)).max()
    return SharedStateModel(A if size < 1 else A * (_LARGEST_FIRST_MODULUS / size), powers[:, 0])


def fit_shared_state(
    problem: SharedStateProblem, model: SharedStateModel, max_steps: int
) -> SharedStateFit:
    """The best model from this one on, with the noise of each section that its misfit suggests.

    Inputs that the model does not know yet begin with coefficients zero.
    """
    new = problem.inflow.shape[2] - model.B.shape[1]
    model, converged = SharedStateModel(model.A, np.pad(model.B, ((0, 0), (0, new)))), False
    for _ in range(2):
        model, converged = _minimize(problem, model, max_steps)
        found = misfit_of(problem, model, slopes=False)
        each = found.residual.reshape(-1, found.freedom.size)
        square = each.T @ each
        # A and B are used up on as many independent errors as there are in a cycle.
        independent = np.trace(square) ** 2 / (square**2).sum()
        freedom = np.maximum(found.freedom - model.B.size / independent, 1.0)
        noise = np.sqrt(np.diag(square).reshape(freedom.shape) / freedom)
        problem = problem.with_noise(problem.noise * noise)
    return SharedStateFit(problem, model, converged)


def _minimize(
    problem: SharedStateProblem, model: SharedStateModel, max_steps: int
) -> tuple[SharedStateModel, bool]:
    """Gauss and Newton's iteration over A and B, and whether it came to its end.

    It is not that of `least_squares`, since coordinates of x are free: they are chosen anew for each
    step, steps are those of least norm, and the Jacobian, too large to be kept, is summed up to a
    Hessian. It ends where a step is small beside its standard error.
    """
    d = len(model.A)
    for _ in range(max_steps):
        model = _normalized(problem, model)
        found = misfit_of(problem, model)
        step = _pseudo_inverse(found.hessian) @ found.gradient
        gain = float(step @ found.gradient)
        for k in range(_MAX_HALVINGS):
            part = step / 2**k
            A = model.A + part[: d * d].reshape(d, d)
            trial = SharedStateModel(A, model.B + part[d * d :].reshape(d, -1))
            tame = np.abs(np.linalg.eigvals(A)).max() < _LARGEST_MODULUS
            if tame and misfit_of(problem, trial, slopes=False).cost < found.cost:
                break
        else:
            small = gain <= max(_SETTLED_GAIN, _STALLED_GAIN * found.cost)
            return model, bool(small or np.abs(step).max() < _STALLED_STEP)
        model = trial
        if gain <= _SETTLED_GAIN:
            return model, True
    return model, False


def _normalized(problem: SharedStateProblem, model: SharedStateModel) -> SharedStateModel:
    """In coordinates in which the state has variance 1."""
    x = simulate_state(problem, model).reshape(-1, len(model.A))
    half = np.linalg.qr(x, mode="r").T / np.sqrt(len(x))
    back = np.linalg.pinv(half)
    return SharedStateModel(back @ model.A @ half, back @ model.B)


def _pseudo_inverse(hessian: Float[np.ndarray, "P P"]) -> Float[np.ndarray, "P P"]:
    """Scaled: coordinates of x make the Hessian singular."""
    size = np.sqrt(np.diag(hessian))
    size = np.where(size > 0, size, 1.0)
    inverse = np.linalg.pinv(hessian / size / size[:, None], _NO_CURVATURE, True)
    return inverse / size / size[:, None]


def denominator_of(fit: SharedStateFit, errors: Literal["residuals", "white"]) -> Denominator:
    """The characteristic polynomial of A, and the covariance of its coefficients.

    By blocks of cycles, whose errors may depend on each other and on the inputs.
    """
    problem, model, converged = fit
    c, slope = _characteristic_polynomial(model.A)
    values, vectors = np.linalg.eigh(_pseudo_inverse(misfit_of(problem, model).hessian))
    root = vectors * np.sqrt(np.maximum(values, 0))
    to_c = slope @ root[: slope.shape[1]]
    white = to_c @ to_c.T
    if not np.linalg.eigvalsh(white)[0] > 0:
        covariance = Covariance.unknown(len(c))
    elif errors == "white":
        covariance = Covariance(white, np.inf)
    else:
        covariance = jackknife(problem, model, root, to_c)
    return Denominator(c, covariance, converged)


def _characteristic_polynomial(
    A: Float[np.ndarray, "d d"],
) -> tuple[Float[np.ndarray, " d"], Float[np.ndarray, "d entries"]]:
    """Coefficients of det(q - A) behind the first, and their derivatives (Faddeev, Leverrier)."""
    d = len(A)
    M, c, slope = np.eye(d), [], []
    for k in range(1, d + 1):
        slope.append(-M.T.ravel())
        c.append(-np.trace(A @ M) / k)
        M = A @ M + c[-1] * np.eye(d)
    return np.array(c), np.array(slope)
