"""Steps of Runge-Kutta methods, explicit and implicit, for many lanes of one chart at once.

`take_step` is the entry: it is called by `watch.ChartFlow.step` in the search and the replay, and
by `kernels.py`. Lanes (trajectories side by side) stand on the last axis: `t` and `h` are (L,), or
(1,) if they are the same for all lanes, and `q` is (n, L). A field is a function (t, q) -> (n, L)
of all lanes at once: as one array for each stage, XLA computes every stage once. The default method
of a chart is in `systems/verner.py`. Of a wrong step, compare `_looped_stages` with
`_unrolled_stages` (explicit), or see `increments` (implicit); a step that is too long has its cause
in `errors`.
"""

import functools as ft
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Inexact

from .._core.executor import for_each_row, namespace
from ..systems.solver import Method
from .arrays import AnyTimes, Array, States, Times
from .cubic import halfway_cubic
from .halfway import halfway


LaneField = Callable[[Array, Array], Array]

# Number of lanes from which on stages are unrolled. Higher: large batches run up to twice as long.
# Lower: small batches compile for twice as long.
_UNROLLED_LANES = 128


class Step(NamedTuple):
    """Result of one step."""

    q: States
    """State at t + h."""
    f0: States
    """Field at the start."""
    f1: States
    """Field at the end."""
    estimate: States
    """Embedded estimate of lower order. The error of the step is a power of it, relative to the
    magnitude of the state's change."""
    error: States
    """Estimate of the error that is also right if fast modes are hardly excited."""
    middle: States
    """State halfway, of lower order."""
    rate: States
    """Rate halfway."""


def take_step(
    method: Method,
    field: LaneField,
    t: AnyTimes,
    q: States,
    h: AnyTimes,
    still: LaneField | None = None,
) -> Step:
    """One step of a method from (t, q) over h.

    For many lanes, the stages of an explicit method are unrolled, which runs faster and compiles
    more slowly.

    **Arguments:** `still`: the field without derivatives, for an implicit step that is
    differentiated.
    """
    if method.implicit:
        return _implicit_step(method, field, t, q, h, still)
    unroll = q.shape[1] >= _UNROLLED_LANES
    stages: Any = _unrolled_stages if unroll else _looped_stages
    combined: Any = _combine if unroll else _contract
    K = stages(method, field, t, q, h)
    error = h * combined(np.array(method.error), K)
    slope = combined(np.array(method.b), K)
    end = q + h * slope
    f1 = field(t + h, end)
    weights = halfway(method)
    if weights is None:
        middle = halfway_cubic(q, end, K[0], f1, h)
    else:
        until = h * combined(weights.state, K)
        middle = q + until, combined(weights.rate, K)
    return Step(end, K[0], f1, error, error, *middle)


def _looped_stages(method, field, t, q, h) -> Float[Array, "stages n L"]:
    """The rates of all stages of an explicit method, by a loop, which compiles fast."""

    def stage(K, xs):
        row, c, k = xs
        y = q + h * jnp.tensordot(row, K, 1)
        rate = field(t + c * h, y)
        return K.at[k].set(rate), None

    stages = len(method.c)
    begin = jnp.zeros((stages, *q.shape), q.dtype)
    tableau = (
        jnp.asarray(method.a, q.dtype),
        jnp.asarray(method.c, q.dtype),
        jnp.arange(stages),
    )
    return jax.lax.scan(stage, begin, tableau)[0]


def looped_step(
    method: Method, field: LaneField, t: AnyTimes, q: States, h: AnyTimes
) -> tuple[States, States]:
    """The end of a step of an explicit method, and its estimated error; stages are not unrolled."""
    apart = jax.lax.optimization_barrier
    stages = len(method.c)
    a = jnp.asarray(method.a)
    c = jnp.asarray(method.c)

    def weighted(w, K):
        return jnp.sum(w[:, None, None] * K, axis=0)

    def stage(k, K):
        # (`apart` keeps state and rate from being fused: XLA would compute one again for each row
        # of the other.)
        y = apart(q + h * weighted(a[k], K))
        time = t + c[k] * h
        rate = apart(field(time, y))
        return jax.lax.dynamic_update_index_in_dim(K, rate, k, 0)

    nothing = jnp.zeros((stages, *q.shape), q.dtype)
    K = jax.lax.fori_loop(0, stages, stage, nothing)
    rate = weighted(jnp.asarray(method.b), K)
    error_rate = weighted(jnp.asarray(method.error), K)
    return q + h * rate, h * error_rate


def _unrolled_stages(method, field, t, q, h) -> list[States]:
    """The same one after the other, which runs faster."""
    K: list[jax.Array] = []
    for row, c in zip(method.a, method.c, strict=True):
        y = q + h * _combine(row, K)
        K.append(field(t + c * h, y))
    return K


def _combine(weights, K):
    """Sum of weights times the first stages, unrolled, so that XLA compiles it into one loop with
    the next stage."""
    total = 0.0
    for weight, stage in zip(weights, K, strict=False):
        if weight != 0:
            total = total + float(weight) * stage
    return total


def _contract(weights, K):
    """Sum of weights times stages, where the stages are rows of one array."""
    return jnp.tensordot(np.array(weights), K, 1)


def rounding_error(field: LaneField, t: AnyTimes, q: States, f: States) -> States:
    """The largest change of the field under rounding errors of time and states, where f is the
    field at (t, q); zero where it is not finite."""
    # Shifts of both signs, odd and even ones. Each state has another shift, since a common factor
    # might cancel.
    shifts = [np.roll([-3.1, 1.9, -0.8, 4.4], k) for k in range(len(q) + 1)]
    shifts = np.stack(shifts, axis=1)
    xp = namespace(q)
    tiny = xp.finfo(q.dtype).eps
    shifts = xp.asarray(shifts * tiny, dtype=q.dtype)

    def change(shift):
        of_time = 1 + shift[0]
        of_states = 1 + shift[1:, None]
        shifted = field(t * of_time, q * of_states)
        return xp.abs(shifted - f)

    changes = for_each_row(change, shifts)
    finite = xp.where(xp.isfinite(changes), changes, 0.0)
    return xp.max(finite, axis=0)


def short_step(
    field: LaneField, t: Times, q: States, f: States, h: Times
) -> tuple[States, States]:
    """A short step of the classical method of order 4, given the field f at its start.

    Its derivatives at h = 0 are right to order 4.

    **Returns:** the state at t + h, and the larger of its distances from two methods of order 2,
    which are of order h^3. (The distance from the midpoint rule vanishes if h is four times the
    decay time of a mode, the distance from the other method never.)
    """
    xp = namespace(q)
    half = 0.5 * h
    middle = t + half
    k2 = field(middle, q + half * f)
    k3 = field(middle, q + half * k2)
    k4 = field(t + h, q + h * k3)
    total = f + 2 * k2 + 2 * k3 + k4
    slope = total / 6
    by_k2 = xp.abs(slope - k2)
    by_k3 = xp.abs(slope - k3)
    error = h * xp.maximum(by_k2, by_k3)
    return q + h * slope, error


# Relative change at which increments are settled: a few rounding errors. Larger: steps have errors
# of this size. Smaller: iterations go on without an end.
_SETTLED = 4.0 * float(np.finfo(float).eps)

# Implicit methods. The increments w_i = h f(t + c_i h, q + sum_j a_ij w_j) of all stages are solved
# for together, by Newton's method with the Jacobian J of the field at the start of the step. Its
# linear systems (1 - h A x J) dw = r are decoupled as by E. Hairer and G. Wanner, Solving Ordinary
# Differential Equations II, section IV.8: with A = T R T^-1 and R triangular, they need inverses of
# 1 - h g J for the diagonal entries g of R only, real or complex. Lanes are eliminated together:
# LAPACK would be called once for each lane.


class _Decoupled(NamedTuple):
    """A matrix of stages as the real part of left @ R @ right, R lower triangular."""

    left: np.ndarray
    R: np.ndarray
    right: np.ndarray


@ft.lru_cache
def _decoupled(method: Method) -> _Decoupled:
    A = np.array(method.a)
    if not np.any(np.triu(A, 1)):
        unit = np.eye(len(A))
        return _Decoupled(unit, A, unit)
    values, T = np.linalg.eig(A)
    kept = np.imag(values) >= 0  # one of each conjugate pair, twice
    values = values[kept]
    times = np.where(np.imag(values) > 0, 2, 1)
    inverse_rows = np.linalg.inv(T)[kept]
    scaled = T[:, kept] * times
    return _Decoupled(scaled, np.diag(values), inverse_rows)


def _implicit_step(
    method: Method, field: LaneField, t, q, h, still: LaneField | None
) -> Step:
    """One step of an implicit method. The last change of Newton's iterations counts as an error.

    With `still`, two Newton corrections with the true Jacobian follow at the solution of the
    stages. They change the stages by rounding errors only, but give them their first and second
    derivatives (implicit function theorem).
    """
    start = jax.lax.stop_gradient((t, q, h))
    w, left, J = increments(method, still or field, *start)
    if still is not None:
        equations = StageEquations.at(method, still, *start, w)
        w, _ = with_derivatives(method, field, (t, q, h), equations, w)
    estimate, local = errors(method, w, left, J, start[2])
    change = _contract(method.b, w)
    end = q + change
    f0 = field(t, q)
    f1 = field(t + h, end)
    halves = halfway(method)
    if halves is None:
        middle = halfway_cubic(q, end, f0, f1, h)
    else:
        until = _contract(halves.state, w)
        positive = jnp.where(h == 0, 1.0, h)
        rate = _contract(halves.rate, w) / positive
        middle = q + until, rate
    return Step(end, f0, f1, estimate, local, *middle)


def step_along(
    method: Method, field: LaneField, t: AnyTimes, q: States, h: AnyTimes, along: States
) -> tuple[Step, States, States]:
    """A step of an implicit method, and the derivatives of its end and of its estimate along a
    direction of states."""

    def step(q):
        return take_step(method, field, t, q, h, still=field)

    value, tangent = jax.jvp(step, (q,), (along,))
    return value, tangent.q, tangent.estimate


def errors(
    method: Method, w: Float[Array, "s n L"], left: States, J, h: AnyTimes
) -> tuple[States, States]:
    """The embedded estimate of a step, and an estimate of its error that is also right if fast
    modes are hardly excited.

    **Arguments:** `w`: increments of the stages, with the error `left`. `J`: the Jacobian of the
    field at the start.
    """
    plain = _contract(method.error, w)
    coefficients = method.rough or np.zeros(len(method.b))
    rough = _contract(coefficients, w)
    estimate = plain
    if method.filter:
        shift = _shifted(J, method.filter * h)
        estimate = _apply(inverse(shift), plain)

    # Where the solution is smooth, the method has a higher order than the estimate: the estimate is
    # multiplied by the ratio of two estimates, which is small there. The ratio is 1 where a fast
    # mode was excited and dies out within the step, and the filtered estimate is large where a fast
    # mode follows the solution: in both cases the error is as large as the estimate.
    def divide(x):
        size = jnp.where(x == 0, 1.0, jnp.abs(x))
        return jnp.abs(estimate) / size

    larger = jnp.maximum(divide(rough), 1 - divide(plain))
    ratio = jnp.where(rough == 0, 1.0, larger)
    powers = round(method.order - method.order / method.gain)
    share = jnp.minimum(ratio, 1.0) ** powers
    local = jnp.abs(estimate) * share + left
    lower = estimate - left
    higher = estimate + left
    return jnp.where(estimate < 0, lower, higher), local


def increments(method, field, t, q, h, small: float = _SETTLED):
    """Increments (s, n, L) by Newton's method, their last change (n, L), and the Jacobian (n, n, L)
    at the start.

    **Arguments:** `small`: change at which a component is settled, relative to its size.
    """
    J = _jacobian(field, t, q)
    c = np.array(method.c)[:, None]
    left, R, right = _decoupled(method)
    factors = set(np.diag(R))
    solve = {g: inverse(_shifted(J, g * h)) for g in factors if g != 0}
    evaluate = jax.vmap(field)

    def correction(w):
        stages = q + _contract(method.a, w)
        rate = evaluate(t + c * h, stages)
        residual = h * rate - w
        solved = []
        for i, r in enumerate(_contract(right, residual)):
            # (R is lower triangular: row i needs the solutions of the rows before.)
            known = [g * x for g, x in zip(R[i], solved, strict=False) if g != 0]
            if known:
                r = r + h * _apply(J, sum(known, start=0.0))
            g = R[i, i]
            solved.append(_apply(solve[g], r) if g != 0 else r)
        return jnp.real(_contract(left, jnp.stack(solved)))

    def iterate(carry):
        w, last, _, i = carry
        change = correction(w)
        w = w + change
        now = jnp.max(jnp.abs(change), axis=0)
        largest_increment = jnp.max(jnp.abs(w), axis=0)
        size = jnp.abs(q) + largest_increment
        # A component is iterated while it changes by more than rounding errors, and converges.
        moves = now > small * size
        converges = (now < 0.5 * last) | (i < 2)
        going = (moves & converges).any()
        return w, now, going, i + 1

    nothing = jnp.zeros((len(c), *q.shape), q.dtype)
    first = h * field(t, q)
    w = nothing.at[0].set(first)
    unknown = jnp.full(q.shape, jnp.inf, q.dtype)
    begin = w, unknown, jnp.array(True), 0

    # A step that needs more iterations is rejected for its error.
    def unsettled(carry):
        return carry[2] & (carry[3] < 12)

    w, last, *_ = jax.lax.while_loop(unsettled, iterate, begin)
    return w, last, J


def with_derivatives(
    method: Method,
    field: LaneField,
    start: tuple[AnyTimes, States, AnyTimes],
    equations: "StageEquations",
    w: Float[Array, "s n L"],
) -> tuple[Float[Array, "s n L"], Float[Array, "s n L"]]:
    """The increments w after two Newton steps, as functions of the field and of the `start`
    (t, q, h) of the step, and their last change. The second step gives them their derivatives
    (implicit function theorem)."""
    t, q, h = start
    c = np.array(method.c)[:, None]
    change = w
    for _ in range(2):
        stages = q + _contract(method.a, w)
        residual = h * jax.vmap(field)(t + c * h, stages) - w
        change = equations.solve(residual)
        w = w + change
    return w, change


class StageEquations(NamedTuple):
    """The Jacobian of the equations of all stages together, factored by blocks of one stage each.

    Block (i, j) is 1 - h a_ii J_i on the diagonal, which is not singular in steps that resolve the
    field, and - h a_ij J_i beside it.
    """

    inverses: tuple[Float[Array, "n n L"], ...]
    """Inverses of the diagonal blocks, after elimination of the blocks before."""
    lower: dict[tuple[int, int], Float[Array, "n n L"]]
    """Factors with which earlier rows of blocks are subtracted from later rows."""
    upper: dict[tuple[int, int], Float[Array, "n n L"]]

    @classmethod
    def at(
        cls, method: Method, field: LaneField, t, q, h, w: Float[Array, "s n L"]
    ) -> "StageEquations":
        """The equations at the increments w of a step from (t, q) over h."""
        A = np.array(method.a)
        c = np.array(method.c)[:, None]
        times = t + c * h
        states = q + _contract(A, w)
        J = jax.vmap(ft.partial(_jacobian, field))(times, states)
        eye = jnp.eye(len(q))[..., None]
        blocks = {}
        for i, j in np.argwhere(A).tolist():
            coupling = -A[i, j] * h
            blocks[i, j] = coupling * J[i]
        for k in range(len(A)):
            added = blocks.get((k, k), 0.0)
            blocks[k, k] = eye + added
        return cls.factored(blocks, len(A))

    @classmethod
    def factored(
        cls, blocks: dict[tuple[int, int], Array], stages: int
    ) -> "StageEquations":
        """Factor a matrix with these blocks, by Gaussian elimination. Missing blocks are zero."""
        rest = dict(blocks)
        inverses = []
        lower: dict[tuple[int, int], Array] = {}
        for k in range(stages):
            inverses.append(inverse(rest[k, k]))
            later = range(k + 1, stages)
            below = [i for i in later if (i, k) in rest]
            beside = [j for j in later if (k, j) in rest]
            for i in below:
                lower[i, k] = _product(rest[i, k], inverses[k])
                for j in beside:
                    taken = _product(lower[i, k], rest[k, j])
                    present = rest.get((i, j), 0.0)
                    rest[i, j] = present - taken
        upper = {(k, j): block for (k, j), block in rest.items() if j > k}
        return cls(inverses=tuple(inverses), lower=lower, upper=upper)

    def solve(self, right: Float[Array, "s n L"]) -> Float[Array, "s n L"]:
        """The solution of the linear equations with this right side."""
        rows = list(right)
        for (i, k), factor in self.lower.items():
            rows[i] = rows[i] - _apply(factor, rows[k])
        for k in reversed(range(len(rows))):
            for j in range(k + 1, len(rows)):
                if (k, j) in self.upper:
                    known = _apply(self.upper[k, j], rows[j])
                    rows[k] = rows[k] - known
            rows[k] = _apply(self.inverses[k], rows[k])
        return jnp.stack(rows)


def _jacobian(field: LaneField, t, q) -> Float[Array, "n n L"]:
    """The derivatives of the field by the states, by forward mode."""

    def push(direction):
        along = jnp.broadcast_to(direction[:, None], q.shape)
        return jax.jvp(lambda q: field(t, q), (q,), (along,))[1]

    return jax.vmap(push, out_axes=1)(jnp.eye(len(q), dtype=q.dtype))


def _shifted(J, g):
    """1 - g J."""
    return jnp.eye(len(J))[..., None] - g * J


def _apply(
    matrix: Inexact[Array, "n m #L"], x: Inexact[Array, "m L"]
) -> Inexact[Array, "n L"]:
    return jnp.sum(matrix * x, axis=1)


def _product(
    matrix: Float[Array, "n m #L"], other: Float[Array, "m k #L"]
) -> Float[Array, "n k L"]:
    return jnp.sum(matrix[:, :, None] * other, axis=1)


def inverse(matrix: Inexact[Array, "n n L"]) -> Inexact[Array, "n n L"]:
    """Inverses of many small matrices, by Gauss-Jordan elimination with pivots."""
    n = len(matrix)
    rows = np.arange(n)[:, None]

    def eliminate(k, X):
        size = jnp.abs(X[:, k])
        candidates = jnp.where(rows >= k, size, -1.0)
        place = jnp.argmax(candidates, axis=0)
        is_pivot = (rows == place)[:, None]
        pivot = jnp.sum(jnp.where(is_pivot, X, 0.0), axis=0)
        X = jnp.where(is_pivot, X[k], X)
        pivot = pivot / pivot[k]
        column = X[:, k][:, None]
        is_row = (rows == k)[:, None]
        return jnp.where(is_row, pivot, X - column * pivot)

    unit = jnp.eye(n, dtype=matrix.dtype)[..., None]
    eye = jnp.broadcast_to(unit, matrix.shape)
    X = jnp.concatenate([matrix, eye], axis=1)
    return jax.lax.fori_loop(0, n, eliminate, X)[:, n:]
