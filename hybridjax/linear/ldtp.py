"""`LDTP`: linear discrete-time periodic systems whose state dimension may vary over the period.

`linearize`, fits and users make it. The class checks arguments; the numbers come from
`frequency_response.py` (HTFs), `time_response.py` (responses, monodromy matrix), `multipliers.py`
and `algebra.py` (connections of systems). Matrices are padded with zeros to the largest dimension.
All algebra relies on these zeros: a method that returns an `LDTP` must keep them, and
`_check_padding` refuses others.

If multipliers are missing, look at `_RANK_TOLERANCE` and `multipliers.py`; if a response is refused
as unbounded, at `_refuse_resonance`; if a connection has wrong signs, at the matrices K, L, M of
`feedback`, `@` and `+`, which `algebra.connect` explains.
"""

from collections.abc import Sequence
from typing import Annotated, Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, Int

from .._core.arguments import Numbers, names, require_axes, require_equal, require_same
from .._core.boundary.checked import checked
from .._core.boundary.kinds import Count, NewNames, PeriodCount, Vector
from .._core.boundary.values import Integers, Reals
from .._core.executor import from_host, is_traced, namespace, to_host
from .._core.html import card, facts, multiplier_table, unit_circle
from .._core.memo import remembered
from .._core.precision import require_x64
from .._core.showable import WithMultipliers
from .._core.text import folded, how_many, listed
from ..errors import DefinitionError
from . import algebra, time_response
from .frequency_response import (
    Frequencies,
    Harmonics,
    check_harmonics,
    harmonic_transfer,
)
from .htf import HTF, require_chain
from .multipliers import product_eigenvalues, product_rank


Matrix = Annotated[Numbers, Reals("rows columns")]
Signals = Annotated[Numbers, Reals()]
Gain = Annotated[Numbers, Reals()]

# Singular values of a factor below this part of its largest one are zero. Smaller: rounding is
# taken for multipliers. Larger: multipliers of weak directions count as zero.
_RANK_TOLERANCE = 1e-12
# Distance of z^N from a multiplier at which a response is refused. Smaller: responses keep less
# than half of their digits. Larger: accurate ones are refused.
_RESONANCE = 1e-8


@checked
class LDTP(WithMultipliers, eqx.Module):
    r"""A linear discrete-time periodic system of period $N$ sections.

    $$x[n+1] = A[n]\,x[n] + B[n]\,u[n], \qquad y[n] = C[n]\,x[n] + D[n]\,u[n]$$

    The dimension of $x[n]$ may vary with $n$. The arrays are padded with zeros to the largest
    dimension: the valid block of `A[n]` is `[:dims[(n+1) % N], :dims[n]]`, and with zero padding
    all algebra may use the whole arrays. Every method works under `jit`, `vmap` and derivatives,
    except `multipliers` and `rank`, which work on the host.

    **Arguments:**

    - `A` (N, d, d), `B` (N, d, nu), `C` (N, ny, d): the matrices, padded with zeros.
    - `D` (N, ny, nu): feed-through; `None` means zero.
    - `dims` (N,): the true dimension of each `x[n]`, from 0 to d; `None` means `d` everywhere.
      Without any coordinate (d = 0) the arrays are padded to d = 1.
    - `inputs`, `outputs`: names, or units by name, as in `{"yM": "m"}`. Default: `u` and `y`, or
      `u0, u1, ...` for several.
    - `coordinates`: names of the coordinates at each section, for documentation.

    **Raises:** `DefinitionError` for shapes, names or dimensions that do not fit, for entries
    outside the valid blocks, for NaN and infinity; `PrecisionError` for single precision.

    **Example:**

    ```python
    decay = hj.linear.LDTP([[[0.5]]], [[[1.0]]], [[[1.0]]])
    print(decay.multipliers, decay.htf([0.1, 0.2]).H)
    ```

    **After:** `hj.experiments.simulate_experiments`, `hj.optimal_design`, `hj.convert.to_lti`.
    """

    A: Float[Array, "N d d"]
    B: Float[Array, "N d nu"]
    C: Float[Array, "N ny d"]
    D: Float[Array, "N ny nu"]
    dims: Int[Array, " N"]
    inputs: tuple[str, ...] = eqx.field(static=True)
    outputs: tuple[str, ...] = eqx.field(static=True)
    coordinates: tuple[tuple[str, ...], ...] | None = eqx.field(static=True)

    def __init__(
        self,
        A: Annotated[Numbers, Reals("sections states states")],
        B: Annotated[Numbers, Reals("sections states inputs")],
        C: Annotated[Numbers, Reals("sections outputs states")],
        D: Annotated[Numbers, Reals("sections outputs inputs")] | None = None,
        dims: Annotated[Numbers, Integers("sections")] | None = None,
        inputs: NewNames | None = None,
        outputs: NewNames | None = None,
        coordinates: Sequence[Sequence[str]] | None = None,
    ):
        require_x64()
        if A.shape[1] == 0 and dims is None:
            dims = np.zeros(len(A), int)
        A, B, C = from_host(_with_a_coordinate(A, B, C))
        n_sections, d = A.shape[:2]
        ny = C.shape[1]
        nu = B.shape[2]
        through = jnp.zeros((n_sections, ny, nu)) if D is None else from_host(D)
        matrices = {"A": A, "B": B, "C": C, "D": through}
        shapes = {
            "A": (d, d),
            "B": (d, nu),
            "C": (ny, d),
            "D": (ny, nu),
        }
        for name, array in matrices.items():
            shape = (n_sections, *shapes[name])
            if array.shape != shape or 0 in shape:
                raise DefinitionError(
                    f"`{name}` has shape {array.shape}, but with A {A.shape}, B {B.shape} and "
                    f"C {C.shape} it should be {shape}, without empty axes."
                )
        require_x64(matrices)
        if coordinates is not None:
            require_equal(
                "`A` and `coordinates`", "lengths", n_sections, len(coordinates)
            )
        self.A = A
        self.B = B
        self.C = C
        self.D = through
        self.dims = _dimensions(dims, n_sections, d)
        self.inputs = names("inputs", inputs, nu)
        self.outputs = names("outputs", outputs, ny)
        self.coordinates = (
            None if coordinates is None else tuple(map(tuple, coordinates))
        )
        _check_padding(self)

    @classmethod
    def from_blocks(
        cls,
        A: Sequence[Matrix],
        B: Sequence[Matrix],
        C: Sequence[Matrix],
        D: Sequence[Matrix] | None = None,
        inputs: NewNames | None = None,
        outputs: NewNames | None = None,
        coordinates: Sequence[Sequence[str]] | None = None,
    ) -> "LDTP":
        """An LDTP from matrices that each have their own dimensions.

        **Arguments:** one matrix per section: `A[n]` is `(d[n+1], d[n])`, `B[n]` `(d[n+1], nu)`,
        `C[n]` `(ny, d[n])`, `D[n]` `(ny, nu)`; the others as in the constructor.

        **Raises:** `DefinitionError`, naming the matrix that does not fit.
        """
        given = {"A": A, "B": B, "C": C}
        if D is not None:
            given["D"] = D
        for name, blocks in given.items():
            require_equal(
                f"`A` and `{name}`", "numbers of matrices", len(A) or 1, len(blocks)
            )
        dims = [np.shape(block)[1] for block in A]
        after = [*dims[1:], dims[0]]
        ny = np.shape(C[0])[0]
        nu = np.shape(B[0])[1]
        padded: dict[str, Any] = {}
        xp = jnp if is_traced(given) else np  # JAX compiles a program for each shape
        for name, blocks in given.items():
            rows = after if name in "AB" else [ny] * len(A)
            columns = dims if name in "AC" else [nu] * len(A)
            shapes = list(zip(rows, columns, strict=True))
            full = (max(rows), max(columns))
            parts = []
            for n, (shape, block) in enumerate(zip(shapes, blocks, strict=True)):
                array = xp.asarray(block)
                if array.shape != shape:
                    raise DefinitionError(
                        f"`{name}[{n}]` has shape {array.shape}, but x[{n}] has {dims[n]} and "
                        f"x[{(n + 1) % len(A)}] {after[n]} coordinates, with {nu} inputs and {ny} "
                        f"outputs: it should be {shape}."
                    )
                margins = [
                    (0, most - size) for most, size in zip(full, shape, strict=True)
                ]
                parts.append(xp.pad(array, margins))
            padded[name] = xp.stack(parts)
        return cls(
            **padded, dims=dims, inputs=inputs, outputs=outputs, coordinates=coordinates
        )

    @property
    def n_sections(self) -> int:
        """The number of sections in one period, `N`."""
        return self.A.shape[0]

    @property
    def is_stable(self) -> bool:
        """True if all multipliers lie inside the unit circle."""
        return bool((self.modulus < 1).all())

    def __repr__(self) -> str:
        ports = f"{listed(self.inputs)} -> {listed(self.outputs)}"
        sections = how_many(self.n_sections, "section", "sections")
        return folded(f"LDTP({sections}, dimension {self._dimension()}: {ports})")

    def _dimension(self) -> str:
        if is_traced(self.dims):
            return "traced"
        dims = np.asarray(self.dims)
        low = dims.min()
        high = dims.max()
        shown = f"{low}" if low == high else f"{low} to {high}"
        if self.A.ndim > 3 or is_traced(self):
            return shown
        lost = int(low) - self.rank()
        if lost:
            return f"{shown} (multipliers zero or below resolution: {lost})"
        return shown

    def _repr_html_(self) -> str | None:
        if is_traced(self):
            return None
        about = {
            "inputs": listed(self.inputs),
            "outputs": listed(self.outputs),
            "dimension": self._dimension(),
        }
        table = multiplier_table(self.multipliers)
        circle = unit_circle(self.multipliers)
        return card("LDTP", f"{self.n_sections} sections", facts(about), table, circle)

    def states(
        self, u: Signals, x0: Vector | None = None, first_section: int = 0
    ) -> Float[Array, "time d"]:
        """The states that an input leads to.

        **Arguments:** `u` (n, nu), or (n,) of a single input, from `first_section` on; `x0`, the
        state there, either padded (d,) or with its true dimension. Default: zero.

        **Returns:** (n + 1, d), padded with zeros, `x0` first.
        """
        return self._response(u, x0, first_section)[0]

    def simulate(
        self, u: Signals, x0: Vector | None = None, first_section: int = 0
    ) -> Float[Array, "time ny"]:
        """The outputs (n, ny) that an input leads to; arguments as in `states`."""
        return self._response(u, x0, first_section)[1]

    def impulse_response(self, n_lags: Count) -> Float[Array, "N lags ny nu"]:
        """The time-periodic impulse response (Markov parameters).

        **Arguments:** `n_lags`, the number of lags `r = 0 .. n_lags - 1`.

        **Returns:** at `[n, r]` the response at section `n` to a unit input `r` sections earlier:
        `D[n]` for `r = 0`, then `C[n] A[n-1] ... A[n-r+1] B[n-r]`.
        """
        require_x64(self)
        return time_response.impulse_response(self.matrices, n_lags)

    def htf(self, frequencies: Frequencies, harmonics: Harmonics | None = None) -> HTF:
        """The exact harmonic transfer functions.

        **Arguments:**

        - `frequencies` (F,): input frequencies in cycles per period.
        - `harmonics`: m of the H_m, one integer or several: 2 is H_2 alone, `range(-2, 3)` all
          up to it. Default: all `N`.

        **Raises:** `DefinitionError` if a harmonic does not exist, or a multiplier lies within
        `1e-8` of $e^{2 \\pi i f}$, where the response is unbounded. (Inside `jit` and other
        transformations values are not known, and the result there is infinite or meaningless.)
        """
        harmonics = check_harmonics(harmonics, self.n_sections)
        require_x64(self, frequencies)
        f = from_host(to_host(frequencies).reshape(-1))
        self._refuse_resonance(f)
        H = to_host(harmonic_transfer(*self.matrices[:4], f))
        H = H[np.array(harmonics) % self.n_sections]
        return HTF(f, H, harmonics, self.n_sections, self.inputs, self.outputs, "exact")

    def __matmul__(self, other: "LDTP") -> "LDTP":
        """This system after another, which acts first: the series `P @ Q`.

        **Raises:** `DefinitionError` if the outputs of `other` are not the inputs of this system,
        by name and unit, or the numbers of sections differ.
        """
        require_chain("@", other.outputs, self.inputs, self, other)
        ny, nu = np.shape(self.D)[1:]
        inner, nr = np.shape(other.D)[1:]
        K = np.zeros((nu + nr, ny + inner))
        L = np.zeros((nu + nr, nr))
        M = np.eye(ny, ny + inner)
        K[:nu, ny:] = np.eye(nu)
        L[nu:] = np.eye(nr)
        return self._connected(other.matrices, K, L, M, other.inputs, self.outputs)

    def __add__(self, other: "LDTP") -> "LDTP":
        """The sum of the outputs of two systems with the same inputs: parallel systems.

        **Raises:** `DefinitionError` if inputs, outputs or numbers of sections differ.
        """
        require_same("terms of a sum", self, other)
        ny, nu = np.shape(self.D)[1:]
        L = np.tile(np.eye(nu), (2, 1))
        M = np.tile(np.eye(ny), (1, 2))
        K = np.zeros((2 * nu, 2 * ny))
        return self._connected(other.matrices, K, L, M, self.inputs, self.outputs)

    def inverse(self) -> "LDTP":
        """The system that returns the inputs from the outputs.

        **Raises:** `DefinitionError` if D is not square and invertible at all sections: an inverse
        then has to know later outputs. The inverse of its HTFs needs no D.
        """
        ny, nu = self.D.shape[1:]
        regular = ny == nu
        if regular and not is_traced(self.D):
            regular = (np.linalg.matrix_rank(np.asarray(self.D)) == ny).all()
        if not regular:
            raise DefinitionError(
                "an inverse needs a square and invertible D at all sections, since it would have "
                "to know later outputs without: invert the HTFs, "
                "`model.htf(frequencies).inverse()`."
            )
        A, B, C, D = to_host(self.matrices[:4])
        D = namespace(D).linalg.inv(D)
        return LDTP(
            A - B @ D @ C, B @ D, -D @ C, D, self.dims, self.outputs, self.inputs
        )

    def feedback(self, controller: "LDTP | Gain") -> "LDTP":
        r"""The loop of this system and a controller, $u = r - F y$: $(I + P F)^{-1} P$.

        **Arguments:** `controller`: F, a system from the outputs to the inputs of this one, by name
        and unit, or a static gain, (nu, ny) or (N, nu, ny). F acts at the sections: u[n] answers
        the y[n] that is measured before u[n] acts.

        **Returns:** the system from r, which has the names of u, to y. Its states are the states of
        P, followed by the states of F. Its `multipliers` are the multipliers of the loop.

        **Raises:** `DefinitionError` if names, units or numbers of sections differ, or where direct
        feed-through of both makes a loop without a response.
        """
        ny, nu = self.D.shape[1:]
        if isinstance(controller, LDTP):
            require_chain("feedback", self.outputs, controller.inputs, self, controller)
            require_chain("feedback", controller.outputs, self.inputs, self, controller)
            F = controller.matrices
        else:
            F = algebra.static_gain(to_host(controller), self.n_sections, (nu, ny))
        algebra.require_well_posed(self.D, F.D)
        K = np.zeros((nu + ny, ny + nu))
        L = np.eye(nu + ny, nu)
        K[:nu, ny:] = -np.eye(nu)
        K[nu:, :ny] = np.eye(ny)
        selection = np.eye(ny, ny + nu)
        return self._connected(F, K, L, selection, self.inputs, self.outputs)

    @property
    def matrices(self) -> algebra.Matrices:
        """A, B, C, D and dims."""
        return algebra.Matrices(self.A, self.B, self.C, self.D, self.dims)

    def _connected(self, other, K, L, M, inputs, outputs) -> "LDTP":
        A, B, C, D, dims = algebra.connect(self.matrices, other, K, L, M)
        # Without common padding.
        d = A.shape[1] if is_traced(dims) else int(np.asarray(dims).max())
        return LDTP(
            A=A[:, :d, :d],
            B=B[:, :d],
            C=C[:, :, :d],
            D=D,
            dims=dims,
            inputs=inputs,
            outputs=outputs,
        )

    def monodromy(self, section: int = 0) -> Float[Array, "d d"]:
        """The padded product `A[i+N-1] ... A[i]` over one period from section `i`."""
        require_x64()
        return time_response.monodromy_from(self.A, section)

    def characteristic_polynomial(self) -> Float[Array, " coefficients"]:
        r"""Coefficients $1, c_1, \ldots, c_d$ of $\det(\lambda I - \Phi)$, highest power first.

        The coefficients are the same at every section. Unlike `multipliers`, they are
        differentiable, and they are smooth even where multipliers meet. They are
        computed from the product of the factors. Coefficients beyond the number of
        non-zero multipliers are zero up to rounding. Inside of JAX transformations,
        more of these zeros may follow than outside: count coefficients from the first,
        not from the last.
        """
        return time_response.characteristic_polynomial(self.monodromy())

    @remembered
    def multipliers(self) -> Complex[np.ndarray, " r"]:
        """The non-zero Floquet multipliers, computed on the host from the factors `A[n]`.

        The product of the factors is never formed, so that multipliers far below `1e-16` of the
        largest are accurate. The number of zero multipliers follows from the dimensions and the
        ranks of the factors (see `rank`), not from a threshold on multipliers. A direction that
        contracts to less than `1e-12` of the others between neighboring sections counts as a zero
        multiplier, and the printed model gives the number of these. To resolve it, use more
        sections, or `LimitCycle.multipliers`. Multipliers below 1e-308 are 0.

        **Returns:** (r,) by decreasing modulus, then imaginary part; conjugate pairs are exact.
        """
        return product_eigenvalues(self._blocks("multipliers"), _RANK_TOLERANCE)

    def rank(self, section: int = 0) -> int:
        """Rank of the monodromy matrix at a section, from the ranks of the factors (host side)."""
        blocks = self._blocks("rank")
        first = section % self.n_sections
        return product_rank([*blocks[first:], *blocks[:first]], _RANK_TOLERANCE)

    def periodic_state(self, u: Signals, periods: PeriodCount) -> Float[Array, " d"]:
        r"""The state at section 0 from which the response to a repeated input is periodic.

        $x_0 = (I - \Phi^P)^{-1} x_f$, with $x_f$ the state that `u` reaches from rest.

        **Arguments:** `u` (P N, nu), repeated for ever; `periods`, `P`.

        **Raises:** `DefinitionError` if `u` has another length, or a multiplier is a `P`-th root
        of one within `1e-8`: then no such state exists.
        """
        return self.periodic_states(self._input(u)[None], periods)[0]

    def periodic_states(
        self,
        u: Annotated[Numbers, Reals("experiments samples inputs")],
        periods: PeriodCount,
    ) -> Float[Array, "S d"]:
        """The states of `periodic_state` for S inputs (S, P N, nu)."""
        u = self._input(u)
        if u.shape[1] != periods * self.n_sections:
            raise DefinitionError(
                f"`u` must have the samples of {periods} periods of {self.n_sections} sections, "
                f"not {u.shape[1]}."
            )
        self._refuse_resonance(np.arange(periods) / periods)
        by_period = u.reshape(len(u), periods, self.n_sections, -1)
        return time_response.periodic_states(self.A, self.B, by_period)

    def _response(self, u, x0, first_section):
        u = self._input(u)
        if u.ndim > 2:
            raise DefinitionError(
                f"`u` must be one record of shape (n, {u.shape[-1]}), not of shape {u.shape}: use "
                "`jax.vmap` for several."
            )
        x0 = self._state(x0, first_section)
        sections = (first_section + np.arange(len(u))) % self.n_sections
        return time_response.response(self.matrices, u, x0, sections)

    def _input(self, u):
        require_x64()
        nu = len(self.inputs)
        if u.ndim == 1 and nu == 1:
            u = u[:, None]
        if u.ndim < 2 or u.shape[-1] != nu:
            raise DefinitionError(
                f"`u` must be of shape (n, {nu}), with a column for each input "
                f"({', '.join(self.inputs)}), not of shape {u.shape}."
            )
        return u

    def _state(self, x0, first_section):
        d = self.A.shape[-1]
        if x0 is None:
            return np.zeros(d)
        x0 = jnp.asarray(x0)
        n = first_section % self.n_sections
        true = d if is_traced(self.dims) else int(np.asarray(self.dims)[n])
        if x0.shape[0] not in (d, true):
            raise DefinitionError(
                f"`x0` has {x0.shape[0]} entries, but section {n} has {true} coordinates "
                f"({d} with padding)."
            )
        return jnp.pad(x0, (0, d - x0.shape[0]))

    def _blocks(self, method):
        """The factors without padding, as numpy arrays."""
        if is_traced(self.A, self.dims):
            raise DefinitionError(
                f"`{method}` works on the host, not inside jit, vmap or derivatives: call it "
                "outside, or use `characteristic_polynomial` or `monodromy` there."
            )
        if self.A.ndim != 3:
            raise DefinitionError(
                f"`{method}` takes one LDTP at a time, not a batch of them."
            )
        A = np.asarray(self.A)
        dims = np.asarray(self.dims)
        return [
            factor[:rows, :columns]
            for factor, rows, columns in zip(A, np.roll(dims, -1), dims, strict=True)
        ]

    def _refuse_resonance(self, f):
        if is_traced(self.A, self.dims, f):
            return
        multipliers = self.multipliers
        f = np.asarray(f)
        on_circle = np.exp(2j * np.pi * f)
        distance = np.abs(on_circle[:, None] - multipliers)
        if distance.size and distance.min() < _RESONANCE:
            line, index = np.unravel_index(np.argmin(distance), distance.shape)
            why = "Leave this frequency out."
            if abs(multipliers[index] - 1) < _RESONANCE:
                why = (
                    "Conserved quantities, and autonomous systems at clock sections, have the "
                    "multiplier 1: use sections that depend on the state, or leave whole f out."
                )
            raise DefinitionError(
                f"The response at f = {f[line]:g} cycles per period is unbounded: the multiplier "
                f"{multipliers[index]:.9g} lies on the unit circle there (z^N I - Phi is "
                f"singular). {why}"
            )


def _with_a_coordinate(A, B, C) -> tuple[Any, Any, Any]:
    """The matrices, padded to one coordinate if there is none: no axis of an array is empty."""
    has_states = 0 not in A.shape[1:]
    if has_states or A.shape[1] != A.shape[2]:
        return A, B, C
    xp = namespace(A)
    return (
        xp.pad(A, ((0, 0), (0, 1), (0, 1))),
        xp.pad(B, ((0, 0), (0, 1 - B.shape[1]), (0, 0))),
        xp.pad(C, ((0, 0), (0, 0), (0, 1 - C.shape[2]))),
    )


def _dimensions(dims, n_sections, d):
    if dims is None:
        return from_host(np.full(n_sections, d))
    require_axes("`dims`", dims, {"sections": n_sections})
    if not is_traced(dims):
        dims = np.asarray(dims)
        if np.any((dims < 0) | (dims > d)):
            raise DefinitionError(
                f"`dims` must lie between 0 and {d}, the size of `A[n]`: {dims}."
            )
    return from_host(dims)


def _check_padding(ldtp):
    if is_traced(ldtp.A, ldtp.B, ldtp.C, ldtp.dims):
        return
    dims = np.asarray(ldtp.dims)
    index = np.arange(ldtp.A.shape[-1])
    padding = index >= dims[:, None]
    after = np.roll(padding, -1, axis=0)
    outside = {
        "A": (ldtp.A, after[:, :, None] | padding[:, None, :]),
        "B": (ldtp.B, after[:, :, None]),
        "C": (ldtp.C, padding[:, None, :]),
    }
    for name, (array, mask) in outside.items():
        bad = np.argwhere((np.asarray(array) != 0) & mask)
        if len(bad):
            raise DefinitionError(
                f"`{name}[{bad[0][0]}]` has entries outside its valid block (`dims` is {dims}); "
                "they must be zero."
            )
