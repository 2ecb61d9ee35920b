"""Periodic systems as time-invariant ones, for tools that know no periods.

| from | to | by |
|---|---|---|
| `LDTP`, N sections | one step for each period: signals of all sections are stacked | `to_lti` |
| the same | objects of python-control and scipy | `to_control`, `to_scipy` |
| `HTF` | frequency responses of python-control | `to_control` |
| `LimitCycle` | harmonics of states, inputs and outputs | `to_harmonic_state_space` |

Lifting is in Bittanti and Colaneri, *Periodic Systems*, 2009, sec. 6.2. The harmonic state space is
truncated, with an error that is measured against `LimitCycle.htf` (`_error_of`); the others are
exact.

The order of stacked signals must stay: section by section in `to_lti`, harmonic by harmonic in
`to_control` and `HarmonicStateSpace`, and within each the signals as the model has them. Matrices
and names are stacked in different places, by `reshape` and by `itertools.product`.

If a harmonic state space is inaccurate, look at its `error`, then at `_linearized` (nodes) and
`_toeplitz`; if signals of a lifted system are exchanged, at `_at_sections`.
"""

import itertools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex, Float

from .._core.arguments import package
from .._core.boundary.checked import checked
from .._core.boundary.kinds import Count, Positive, SignalNames
from .._core.boundary.members import leading_on
from .._core.executor import is_traced
from .._core.precision import require_x64
from .._core.signal import Signal, unit_of
from ..errors import ComputationError, DefinitionError
from ..linear.frequency_response import Frequencies
from ..linear.htf import HTF
from ..linear.ldtp import LDTP
from ..orbits.continuous_htf import asked, linear_outputs
from ..orbits.cycle import LimitCycle
from ..orbits.linear_flow import hosted, linear_flow, rule
from ..systems.system import OutputNames, name_of


# Orders that are tried, and frequencies of the comparison, in cycles per period. More:
# calls take longer. Fewer: an error between them is not seen.
_ORDERS = 2, 4, 8, 16, 32, 64
_TRIED = np.array([0.13, 0.37, 0.5])
# Deviations jump at an event if they change by more than this part of their sizes. Larger: jumps
# are left out. Smaller: rounding counts as a jump.
_NO_JUMP = 1e-9


@checked
def to_lti(model: LDTP) -> LDTP:
    r"""Return the same system with one sample for each period.

    Sample k of the result has the state at section 0 of period k, and the inputs `u[n]`, held from
    section n of that period on. Its outputs are `y[n]` at section n of the *same* period, before
    `u[n]` acts except through the feed-through D. So the outputs of a period depend on the inputs
    of the same period. The new A is the monodromy matrix. B is the map from each input to section 0
    of the next period, C the map from section 0 to each section. D holds the responses within a
    period (zero for later inputs). Names are `u[0]`, ..., `u[N-1]` for an input `u`; all inputs of
    section 0 come first, then the inputs of section 1.

    Its response G at $z = e^{2 \pi i f}$, f in cycles per period, holds all harmonics:
    $H_m(f) = \frac{1}{N} \sum_{n, r} G_{n r}\, e^{-2 \pi i (f + m) n / N} e^{2 \pi i f r / N}$.

    **Arguments:** `model`: an `LDTP` of N sections.

    **Returns:** an `LDTP` of one section, with the dimension of the state at section 0.

    **Raises:** `PrecisionError` in single precision.

    **Example:**

    ```python
    lifted = hj.convert.to_lti(model)
    print(lifted.multipliers, lifted.inputs)
    ```

    **Before:** `hj.linearize`, `hj.fit_ldtp`.
    """
    require_x64(model)
    A = model.A
    B = model.B
    C = model.C
    D = model.D
    d = model.A.shape[-1]
    ny = len(model.outputs)
    N, _, nu = B.shape

    def advance(carry, section):
        # The state at section n: from that at section 0 (d, d), and from the inputs of all N
        # sections (d, N, nu), zero for later ones.
        from_state, from_inputs = carry
        n, A, B, C, D = section
        outputs = jnp.einsum("ij,jkl->ikl", C, from_inputs)
        outputs = outputs.at[:, n].set(D)
        states = jnp.einsum("ij,jkl->ikl", A, from_inputs)
        states = states.at[:, n].set(B)
        return (A @ from_state, states), (C @ from_state, outputs)

    carry = jnp.eye(d), jnp.zeros((d, N, nu))
    sections = (jnp.arange(N), A, B, C, D)
    (A, B), (C, D) = jax.lax.scan(advance, carry, sections)
    first = d if is_traced(model.dims) else int(np.asarray(model.dims)[0])
    return LDTP(
        A[None, :first, :first],
        B.reshape(1, d, N * nu)[:, :first],
        C.reshape(1, N * ny, d)[:, :, :first],
        D.reshape(1, N * ny, N * nu),
        inputs=_at_sections(model.inputs, N),
        outputs=_at_sections(model.outputs, N),
        coordinates=None if model.coordinates is None else model.coordinates[:1],
    )


def _at_sections(names: tuple[str, ...], n_sections: int) -> tuple[str, ...]:
    pairs = itertools.product(range(n_sections), names)
    return tuple(Signal(f"{x}[{n}]", unit_of(x)) for n, x in pairs)


@checked
def to_control(thing: LDTP | HTF, *, period: Positive = 1.0) -> Any:
    """Return an object of python-control.

    - An `LDTP` becomes a `control.StateSpace` of its lifted system (`to_lti`), with dt = `period`.
    - An `HTF` becomes a `control.FrequencyResponseData` with an output `y[m]` for each output y and
      harmonic m: `H_m` at the *input* frequency. All outputs of the first harmonic come first.

    **Arguments:**

    - `thing`: an `LDTP` or an `HTF`.
    - `period`: the length of a period, in seconds for example. Default: 1, so that times are
      counted in periods.

    **Returns:** a `control.StateSpace` or `control.FrequencyResponseData`.

    **Raises:** `DefinitionError` where python-control is not installed.

    **Example:**

    ```python
    lifted = hj.convert.to_control(model, period=float(cycle.period))
    print(lifted.poles())
    ```

    **Before:** `hj.linearize`, `hj.fit_ldtp` or `hj.estimate_htf`.
    """
    if isinstance(thing, LDTP):
        lti = to_lti(thing)
        return package("control").StateSpace(
            *_matrices(lti),
            period,
            inputs=list(map(str, lti.inputs)),
            outputs=list(map(str, lti.outputs)),
        )
    pairs = itertools.product(thing.harmonics, thing.outputs)
    outputs = [f"{y}[{m}]" for m, y in pairs]
    inputs = list(map(str, thing.inputs))
    H = np.moveaxis(np.asarray(thing.H), 1, -1)
    H = H.reshape(len(outputs), len(inputs), -1)
    frequencies = 2 * np.pi * np.asarray(thing.frequencies) / period
    return package("control").FrequencyResponseData(
        H, frequencies, inputs=inputs, outputs=outputs, sysname="HTF"
    )


@leading_on
class HarmonicStateSpace(NamedTuple):
    """Constant matrices of the harmonics of states, inputs and outputs in dX/dt = A X + B U and
    Y = C X + D U, harmonic -order first, to order. Block (m, n) of B is that from U_n to X_m."""

    A: Complex[np.ndarray, "a a"]
    B: Complex[np.ndarray, "a b"]
    C: Complex[np.ndarray, "c a"]
    D: Complex[np.ndarray, "c b"]
    order: int
    error: float
    """The largest error of H_-1, H_0 and H_1, relative to the largest of them."""

    @checked
    def transfer(
        self, frequencies: Frequencies, period: Positive
    ) -> Complex[np.ndarray, "F M ny nu"]:
        """Responses of all harmonics to inputs of `frequencies` (F,) in cycles per period."""
        M = 2 * self.order + 1
        # (Inputs have the harmonic 0 only.)
        B = self.B.reshape(len(self.B), M, -1)[:, self.order]
        D = self.D.reshape(len(self.D), M, -1)[:, self.order]
        f = np.asarray(frequencies).reshape(-1, 1, 1)
        rates = 2j * np.pi * f / period
        resolvent = rates * np.eye(len(self.A)) - self.A
        states = np.linalg.solve(resolvent, B[None])
        H = self.C @ states + D
        ny = len(self.C) // M
        return H.reshape(len(rates), M, ny, D.shape[-1])


@checked
def to_harmonic_state_space(
    cycle: LimitCycle,
    order: Count | None = None,
    *,
    outputs: OutputNames | None = None,
    inputs: SignalNames | None = None,
    tolerance: Positive = 1e-6,
) -> HarmonicStateSpace:
    """Return the harmonic state space of a cycle: Toeplitz matrices of the Fourier coefficients of
    its linearization in continuous time, truncated at an order (see `HarmonicStateSpace`).

    `cycle.htf` gives the same responses without truncation.

    **Arguments:**

    - `cycle`: result of `hj.find_limit_cycle`.
    - `order`: the largest harmonic. Default: the first of 2, 4, ..., 64 whose `error`, compared
      with `cycle.htf`, is below `tolerance` (default: 1e-6).
    - `outputs`, `inputs`: as in `LimitCycle.htf`.

    **Returns:** a `HarmonicStateSpace` with the matrices `A` (a, a), `B` (a, b), `C` (c, a), `D`
    (c, b), where a = d (2 order + 1), and likewise b for inputs and c for outputs.

    **Raises:** `DefinitionError` for cycles with events at which deviations jump;
    `ComputationError` if no order is large enough.

    **Example:**

    ```python
    driven = hj.find_limit_cycle(hj.models.Duffing())
    print(hj.convert.to_harmonic_state_space(driven, order=4).A.shape)
    ```

    **Before:** `hj.find_limit_cycle`.
    """
    htf = cycle.htf(_TRIED, (-1, 0, 1), outputs, inputs)
    exact = np.asarray(htf.H).swapaxes(0, 1)
    linear = _linearized(cycle, order or _ORDERS[-1], outputs, inputs)
    orders = _ORDERS if order is None else (order,)
    for n in orders:
        space = _truncated(linear, n)
        error = _error_of(space, exact, linear.period)
        if order or error < tolerance:
            return space._replace(error=error)
    raise ComputationError(f"order {n} has the error {error:.1e}: set `order`.")


class _Linearized(NamedTuple):
    """The linearization of a cycle in continuous time, at k nodes in each of p pieces."""

    period: float
    angles: Float[np.ndarray, "p k"]
    """2 pi times the phases of the nodes."""
    weights: Float[np.ndarray, "p k"]
    """Weights of the nodes in a mean over the period."""
    A: Float[np.ndarray, "p k d d"]
    B: Float[np.ndarray, "p k d nu"]
    C: Float[np.ndarray, "p k ny d"]
    D: Float[np.ndarray, "p k ny nu"]


def _linearized(
    cycle: LimitCycle,
    order: int,
    outputs: OutputNames | None,
    inputs: SignalNames | None,
) -> _Linearized:
    """The linearization, at nodes that are dense enough for harmonics up to an order.

    **Raises:** `DefinitionError` for cycles with events at which deviations jump.
    """
    map = hosted(cycle).return_map
    s = map.structure
    z, _, columns = asked(s, cycle.event_sequence, outputs, inputs)
    flow = linear_flow(cycle, 0.25 / order)
    size_after = np.roll(flow.size, -1, axis=0)
    sizes = flow.size[:, None] / size_after[:, :, None]
    jumps = (flow.jumps.by_state - np.eye(s.d)) * sizes
    if np.abs(jumps).max() > _NO_JUMP or flow.jumps.by_input.any():
        raise DefinitionError(
            f"{name_of(s.system)} has events at which deviations jump, which no finite "
            "number of harmonics represents: use `cycle.htf` (exact)."
        )
    _, by_state, by_input = linear_outputs(s, flow, z)
    return _Linearized(
        period=map.expected,
        angles=2 * np.pi * flow.after(map) / map.expected,
        weights=flow.length[:, None] * rule().weights / map.expected,
        A=flow.by_state,
        B=flow.by_input[..., columns],
        C=by_state,
        D=by_input[..., columns],
    )


def _truncated(linear: _Linearized, order: int) -> HarmonicStateSpace:
    """The harmonic state space of an order, whose error is not known yet."""

    def blocks(x):
        return _toeplitz(x, order, linear.angles, linear.weights)

    m = np.arange(-order, order + 1)
    rotation = np.repeat(2j * np.pi * m / linear.period, linear.A.shape[-1])
    return HarmonicStateSpace(
        A=blocks(linear.A) - np.diag(rotation),
        B=blocks(linear.B),
        C=blocks(linear.C),
        D=blocks(linear.D),
        order=order,
        error=np.nan,
    )


def _error_of(
    space: HarmonicStateSpace, exact: Complex[np.ndarray, "F 3 ny nu"], period: float
) -> float:
    """The largest error of H_-1, H_0 and H_1, relative to the largest of them."""
    response = space.transfer(_TRIED, period)
    of_three = response[:, space.order - 1 : space.order + 2]
    return float(np.abs(of_three - exact).max() / np.abs(exact).max())


def _toeplitz(
    x: np.ndarray,
    order: int,
    angles: np.ndarray,
    weights: np.ndarray,
) -> Complex[np.ndarray, "rows columns"]:
    """The matrix with the Fourier coefficient m - n of x (p, k, i, j) in block (m, n), by a
    quadrature with these angles and weights (p, k)."""
    k = np.arange(-2 * order, 2 * order + 1)
    phasors = np.exp(-1j * k[:, None, None] * angles)
    waves = weights * phasors
    coefficients = np.einsum("mpk,pkij->mij", waves, x)
    m = np.arange(-order, order + 1)
    blocks = coefficients[m[:, None] - m + 2 * order]
    by_rows = blocks.swapaxes(1, 2)
    return by_rows.reshape(len(m) * x.shape[2], -1)


@checked
def to_scipy(model: LDTP, *, period: Positive = 1.0) -> Any:
    """Return the lifted system (`to_lti`) as `scipy.signal.dlti`, with dt = `period`.

    **Arguments:**

    - `model`: an `LDTP`.
    - `period`: the length of a period, in seconds for example. Default: 1, so that times are
      counted in periods.

    **Returns:** a discrete-time state space with one input for each input and section of the model,
    and likewise its outputs.

    **Raises:** `PrecisionError` in single precision.

    **Example:**

    ```python
    lifted = hj.convert.to_scipy(model, period=float(cycle.period))
    print(np.linalg.eigvals(lifted.A), lifted.dt)
    ```

    **Before:** `hj.linearize`, `hj.fit_ldtp`.
    """
    from scipy.signal import dlti

    return dlti(*_matrices(to_lti(model)), dt=period)


def _matrices(lti: LDTP) -> list[np.ndarray]:
    matrices = (lti.A, lti.B, lti.C, lti.D)
    return [np.asarray(x[0]) for x in matrices]
