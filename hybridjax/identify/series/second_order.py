r"""A part of second order in recorded series: all sections share one state.

With $w[p]$ the inputs of cycle p, a system with d non-zero multipliers obeys

$$x[p+1] = A x[p] + B w[p], \qquad
y_n[p] = C_n x[p - k_n] + \sum_r b_n[r]\, u[pN + n - r] + \varepsilon_n[p].$$

The sum takes the inputs since the beginning of cycle $p - k_n$, so long ago that only d dimensions
are left of the state (the others die within the overhang). Multipliers are the eigenvalues of A. A
and B are found by Gauss and Newton's method; C and b are solved for inside, section by section.
Coordinates of x are free: steps are those of least norm.

A little nonlinearity adds a part of second order, which obeys the same equations with products of
the first-order state and the input in place of the input (perturbation expansion). Since that state
is simulated, and free of noise, such products are inputs like others. They cost many unknowns: the
estimate counts only where they pay, and the plain one (`regression`) is kept elsewhere.
"""

from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ..multipliers.likelihood import dependent, memory, sandwich
from .layout import Layout
from .regression import lagged


_RANK = 1e-10  # combinations of regressors that are smaller than this part of the largest
_GAUGE = 1e-11  # eigenvalues of the Hessian that are: they belong to coordinates of x
_BLOCKS = 4  # of a cycle; the mean input in each takes part in products
HORIZON = 8  # cycles of inputs from which the first model is made
_HALVINGS = 12
_SETTLED = 1e-2  # squared step, in units of its standard error, that is the last one
_UNSTABLE = 1.2
_ROUNDING = 1e-12  # part of an output that no noise is taken to be smaller than
_LEFT = 1 / 3  # of the samples of a section: if products leave fewer, they are not tried
_EXPLAINED = 2.0  # products must lower the variance of the misfit so much, or they are left out
_SURER = 0.9  # products must lower standard errors to this part, or they are left out


class Lifted(NamedTuple):
    """What does not depend on A and B."""

    w: Float[np.ndarray, "S T K"]
    """What enters the state at the beginning of each cycle: the inputs of the cycle before, and
    products; at a record's beginning, what the state is there."""
    y: Float[np.ndarray, "S T N ny"]
    good: Bool[np.ndarray, "S T N ny"]
    back: list[int]
    """k_n."""
    direct: list[list[Float[np.ndarray, "rows k"]]]
    """For each section and output an orthonormal basis of what is linear, at the rows sampled."""
    noise: Float[np.ndarray, "N ny"]


class Model(NamedTuple):
    A: Float[np.ndarray, "d d"]
    B: Float[np.ndarray, "d K"]


class Misfit(NamedTuple):
    cost: float
    left: Float[np.ndarray, "S T N ny"]
    """Over the noise."""
    freedom: Float[np.ndarray, "N ny"]
    hessian: Float[np.ndarray, "P P"] | None
    gradient: Float[np.ndarray, " P"] | None


class Estimate(NamedTuple):
    """Coefficients of chi."""

    coefficients: Float[np.ndarray, " d"]
    covariance: Float[np.ndarray, "d d"]
    freedom: float
    """Degrees of freedom of the covariance."""
    converged: bool


def with_products(
    layout: Layout,
    responses: Float[np.ndarray, "N lags ny nu"],
    order: int,
    overhang: int,
    noise: Float[np.ndarray, "N ny"],
    *,
    rest: bool,
    errors: Literal["residuals", "white"],
    always: bool,
    max_steps: int,
) -> Estimate | None:
    """An estimate that allows for a part of second order, from the responses of a first fit.

    None where products leave too little freedom, or unless `always`, do not pay.
    """
    N = layout.y.shape[2]
    back = [max(0, -(-(overhang - n) // N)) for n in range(N)]
    noise = np.maximum(noise, _rounding(layout.y, np.isfinite(layout.y)))
    w, basis = _whitened(layout.u)
    model = _first_model(responses, order, back, noise, basis)
    lifted = _lift(layout, w, back, noise, rest)
    lifted, model, _ = _fit(lifted, model, max_steps)
    products = _products(layout, simulate(lifted, model))
    second = _lift(layout, w, back, lifted.noise, rest, products)
    left = [1 - (basis.shape[1] + second.w.shape[2]) / good.sum() for good, basis in _pairs(second)]
    if min(left) < (0 if always else _LEFT):
        return None
    plain = _covariance(lifted, model, errors)
    second, model, ended = _fit(second, model, max_steps)
    full = _covariance(second, model, errors)
    if always or _pays(lifted, second, plain[1], full[1]):
        return Estimate(*full, ended)
    return None


def _pays(lifted: Lifted, second: Lifted, plain, full) -> bool:
    """Is most of the misfit explained by products, and are the coefficients surer?"""
    explained = -2 * np.log(second.noise / lifted.noise).mean()
    sizes = [np.linalg.slogdet(x)[1] / (2 * len(x)) for x in (full, plain)]
    return bool(explained > np.log(_EXPLAINED) and sizes[0] < sizes[1] + np.log(_SURER))


def _pairs(lifted: Lifted):
    """Rows and direct regressors of each section and output."""
    for n, bases in enumerate(lifted.direct):
        for i, basis in enumerate(bases):
            yield lifted.good[:, :, n, i], basis


def _whitened(u: Float[np.ndarray, "S T N nu"]):
    """Inputs of each cycle in independent combinations of variance 1, and u = basis @ these."""
    S, T = u.shape[:2]
    rows = u.reshape(S * T, -1)
    left, s, right = np.linalg.svd(rows, full_matrices=False)
    kept = s > _RANK * s.max(initial=0)
    size = np.sqrt(len(rows))
    return (left[:, kept] * size).reshape(S, T, -1), right[kept].T * (s[kept] / size)


def _first_model(h, order: int, back: list[int], noise, basis) -> Model:
    """By singular values (Ho and Kalman 1966) of responses to the inputs of earlier cycles."""
    N, _, ny, nu = h.shape
    m = np.arange(N)
    rows = []
    for n, k in enumerate(back):
        for later in range(order):
            lag = n + (k + 1 + later + np.arange(HORIZON)[:, None]) * N - m
            late = h[n, lag] / noise[n, :, None]  # (cycles, N, ny, nu)
            rows.append(late.transpose(2, 0, 1, 3).reshape(ny, HORIZON, N * nu) @ basis)
    hankel = np.concatenate(rows)
    _, s, right = np.linalg.svd(hankel.reshape(len(hankel), -1), full_matrices=False)
    powers = (s[:order, None] * right[:order]).reshape(order, HORIZON, -1)  # A^k B
    before, after = powers[:, :-1].reshape(order, -1), powers[:, 1:].reshape(order, -1)
    A = np.linalg.lstsq(before.T, after.T)[0].T
    size = np.abs(np.linalg.eigvals(A)).max()
    return Model(A if size < 1 else A * (0.99 / size), powers[:, 0])


def _lift(layout: Layout, w, back: list[int], noise, rest: bool, products=None) -> Lifted:
    S, T, N, ny = layout.y.shape
    whole = layout.inside.all(axis=2)
    first = np.zeros(S, int) if rest else np.where(whole.any(axis=1), np.argmax(whole, axis=1), T)
    cycle = np.arange(T)
    starts = np.zeros((S, T, 0 if rest else S))
    if not rest:
        s = np.flatnonzero(first < T)
        starts[s, first[s], s] = 1.0
    enters = [w] if products is None else [w, products[0]]
    enters = [_later(x, 1) * (cycle > first[:, None])[..., None] for x in enters]
    good = np.isfinite(layout.y)
    good &= (cycle[:, None] >= first[:, None, None] + np.array(back))[..., None]
    slow = np.zeros((S, T, S, layout.slow.shape[2]))
    slow[np.arange(S), :, np.arange(S)] = layout.slow
    size = np.sqrt((layout.u**2).mean())
    direct = []
    for n, k in enumerate(back):
        lags = layout.lead + n + k * N + 1
        columns = [lagged(layout.u, n, lags, layout.lead) / size, slow.reshape(S, T, -1)]
        if products is not None:
            values, begun = products
            columns += [_later(values, j) for j in range(1, k + 1)]
            columns.append(values[:, :, begun <= n + layout.lead])
        every = np.concatenate(columns, axis=2)
        bases = []
        for i in range(ny):
            if i and np.array_equal(good[:, :, n, i], good[:, :, n, i - 1]):
                bases.append(bases[-1])
                continue
            left, s, _ = np.linalg.svd(every[good[:, :, n, i]], full_matrices=False)
            bases.append(left[:, s > _RANK * s.max(initial=0)])
        direct.append(bases)
    y = np.where(good, layout.y, 0.0)
    w = np.concatenate([enters[0], starts, *enters[1:]], axis=2)
    return Lifted(w, y, good, back, direct, noise)


def _products(layout: Layout, x: Float[np.ndarray, "S T d"]):
    """Products of two of the states and mean inputs of each cycle, and the sections from which on
    they may act."""
    N = layout.y.shape[2]
    parts = np.array_split(np.arange(N), min(_BLOCKS, N))
    factors = np.concatenate([x, *(layout.u[:, :, part].mean(axis=2) for part in parts)], axis=2)
    begun = np.repeat(
        [0, *(part[0] for part in parts)], [x.shape[2]] + [layout.u.shape[3]] * len(parts)
    )
    size = np.sqrt((factors**2).mean(axis=(0, 1)))
    factors = factors / np.where(size > 0, size, 1.0)
    i, j = np.triu_indices(len(begun))
    inside = layout.inside.any(axis=2)[..., None]
    return factors[..., i] * factors[..., j] * inside, begun[j]


def simulate(lifted: Lifted, model: Model) -> Float[np.ndarray, "S T d"]:
    """x at the beginning of each cycle."""
    drive = lifted.w @ model.B.T
    x = np.zeros_like(drive)
    now = np.zeros(drive[:, 0].shape)
    for p in range(x.shape[1]):
        now = now @ model.A.T + drive[:, p]
        x[:, p] = now
    return x


def _slopes(lifted: Lifted, model: Model, x) -> Float[np.ndarray, "S T d P"]:
    """Derivatives of x with respect to A and B, row by row."""
    S, T, d = x.shape
    K = lifted.w.shape[2]
    Z = np.zeros((S, T, d, d * (d + K)))
    for j in range(d):
        Z[:, 1:, j, j * d : (j + 1) * d] = x[:, :-1]
        Z[:, :, j, d * d + j * K : d * d + (j + 1) * K] = lifted.w
    for p in range(1, T):
        Z[:, p] += model.A @ Z[:, p - 1]
    return Z


def _sections(lifted: Lifted, model: Model, slopes: bool = True):
    """For each section and output what is left, over its noise, and the derivative of the fit."""
    x = simulate(lifted, model)
    Z = _slopes(lifted, model, x) if slopes else None
    for n, k in enumerate(lifted.back):
        before = _later(x, k)
        late = _later(Z, k) if slopes else None
        for i, Q in enumerate(lifted.direct[n]):
            good = lifted.good[:, :, n, i]

            def rest(v, Q=Q):
                return v - Q @ (Q.T @ v)

            X, _ = np.linalg.qr(rest(before[good]))
            y = rest(rest(lifted.y[good][:, n, i]))
            C = np.linalg.lstsq(rest(before[good]), y)[0]
            e = y - X @ (X.T @ y)
            J = None
            if slopes:
                J = rest(np.einsum("rdk,d->rk", late[good], C))
                J = (J - X @ (X.T @ J)) / lifted.noise[n, i]
            yield n, i, good, e / lifted.noise[n, i], J, (Q**2).sum(axis=1) + (X**2).sum(axis=1)


def _evaluate(lifted: Lifted, model: Model, slopes: bool = True) -> Misfit:
    N, ny = lifted.noise.shape
    left, freedom = np.zeros(lifted.y.shape), np.zeros((N, ny))
    P = model.A.size + model.B.size
    hessian, gradient = np.zeros((P, P)), np.zeros(P)
    for n, i, good, e, J, leverage in _sections(lifted, model, slopes):
        left[good, n, i], freedom[n, i] = e, len(e) - leverage.sum()
        if slopes:
            hessian += J.T @ J
            gradient += J.T @ e
    return Misfit(float((left**2).sum()), left, freedom, hessian, gradient)


def _inverse(hessian: np.ndarray) -> np.ndarray:
    """Pseudo-inverse, scaled: coordinates of x make it singular."""
    size = np.sqrt(np.diag(hessian))
    size = np.where(size > 0, size, 1.0)
    return np.linalg.pinv(hessian / size / size[:, None], _GAUGE, True) / size / size[:, None]


def _normal(lifted: Lifted, model: Model) -> Model:
    """In coordinates in which the state has variance 1."""
    x = simulate(lifted, model).reshape(-1, len(model.A))
    half = np.linalg.qr(x, mode="r").T / np.sqrt(len(x))
    back = np.linalg.pinv(half)
    return Model(back @ model.A @ half, back @ model.B)


def _fit(lifted: Lifted, model: Model, max_steps: int) -> tuple[Lifted, Model, bool]:
    """The best model, with the noise of each section that its misfit suggests."""
    new = lifted.w.shape[2] - model.B.shape[1]
    model = Model(model.A, np.pad(model.B, ((0, 0), (0, new))))
    for _ in range(2):
        model, ended = _minimize(lifted, model, max_steps)
        found = _evaluate(lifted, model, False)
        each = found.left.reshape(-1, found.freedom.size)
        square = each.T @ each
        # A and B are used up on as many independent errors as there are in a cycle.
        independent = np.trace(square) ** 2 / (square**2).sum()
        freedom = np.maximum(found.freedom - model.B.size / independent, 1.0)
        noise = lifted.noise * np.sqrt(np.diag(square).reshape(freedom.shape) / freedom)
        lifted = lifted._replace(noise=np.maximum(noise, _rounding(lifted.y, lifted.good)))
    return lifted, model, ended


def _rounding(y, good) -> Float[np.ndarray, "N ny"]:
    """What no noise is taken to be smaller than."""
    count = np.maximum(good.sum(axis=(0, 1)), 1)
    size = np.sqrt((np.where(good, y, 0.0) ** 2).sum(axis=(0, 1)) / count)
    return _ROUNDING * np.maximum(size, 1e-6 * size.max(axis=0))


def _minimize(lifted: Lifted, model: Model, max_steps: int) -> tuple[Model, bool]:
    d = len(model.A)
    for _ in range(max_steps):
        model = _normal(lifted, model)
        found = _evaluate(lifted, model)
        step = _inverse(found.hessian) @ found.gradient
        gain = float(step @ found.gradient)
        for k in range(_HALVINGS):
            part = step / 2**k
            A = model.A + part[: d * d].reshape(d, d)
            trial = Model(A, model.B + part[d * d :].reshape(d, -1))
            stable = np.abs(np.linalg.eigvals(A)).max() < _UNSTABLE
            if stable and _evaluate(lifted, trial, False).cost < found.cost:
                break
        else:
            small = gain <= max(_SETTLED, 1e-6 * found.cost) or np.abs(step).max() < 1e-8
            return model, bool(small)
        model = trial
        if gain <= _SETTLED:
            return model, True
    return model, False


def _covariance(lifted: Lifted, model: Model, errors: str):
    """The coefficients of chi, their covariance and its degrees of freedom."""
    d = len(model.A)
    found = _evaluate(lifted, model)
    c, slope = _characteristic(model.A)
    inverse = _inverse(found.hessian)
    to_c = np.zeros((d, len(inverse)))
    to_c[:, : d * d] = slope
    to_c = to_c @ inverse
    white = to_c @ found.hessian @ to_c.T
    if not np.linalg.eigvalsh(white)[0] > 0:
        return c, np.full((d, d), np.inf), np.inf
    if errors == "white":
        return c, white, np.inf
    # In units in which white noise makes the covariance of c one.
    half = np.linalg.cholesky(white)
    to_c = np.linalg.solve(half, to_c)
    values, vectors = np.linalg.eigh(inverse)
    root = vectors * np.sqrt(np.maximum(values, 0))
    S, T, N, ny = lifted.y.shape
    error, slopes = np.zeros((S, T, N, ny)), np.zeros((S, T, N, ny, len(inverse)), np.float32)
    for n, i, good, e, J, leverage in _sections(lifted, model):
        error[good, n, i] = e / np.maximum(1 - leverage, 1e-3)
        slopes[good, n, i] = J @ root
    error, slopes = error.reshape(S, T, -1), slopes.reshape(S, T, N * ny, -1)
    # What each cycle would miss a fit to the others by: errors that are large where inputs are, as
    # those of distortion, draw the fit to themselves (MacKinnon and White 1985, HC3).
    own = np.eye(N * ny) * (1 + 1e-6) - slopes @ slopes.swapaxes(2, 3)
    error = np.linalg.solve(own, error[..., None])[..., 0]
    mine = slopes @ (to_c @ found.hessian @ root).T
    score = np.einsum("stad,sta->std", mine, error)
    parts = np.einsum("stad,stae->stde", mine, mine)
    gradient, terms = dependent(score, memory(np.linalg.eigvals(model.A), T))
    scaled, freedom = sandwich(np.eye(d), gradient, parts.reshape(-1, d, d))
    return c, half @ scaled @ half.T, freedom / terms


def _characteristic(A: Float[np.ndarray, "d d"]):
    """Coefficients of det(q - A) behind the first, and their derivatives (Faddeev, Leverrier)."""
    d = len(A)
    M, c, slope = np.eye(d), [], []
    for k in range(1, d + 1):
        slope.append(-M.T.ravel())
        c.append(-np.trace(A @ M) / k)
        M = A @ M + c[-1] * np.eye(d)
    return np.array(c), np.array(slope)


def _later(x: np.ndarray, cycles: int) -> np.ndarray:
    """x delayed along axis 1."""
    out = np.zeros_like(x)
    out[:, cycles:] = x[:, : x.shape[1] - cycles]
    return out
