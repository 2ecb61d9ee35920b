"""Second derivatives of the maps between sections, and of outputs at the sections.

`hj.designs` calls `second_order` and asks the `Quadratic` for the nonlinear distortion of second
order that inputs cause: `Quadratic.second_order` for given inputs, `products` for all pairs of
cosines. Deviations have the order (t, q, u) everywhere: n = 1 + d numbers of time and state, and
then the inputs. This must stay so.

If both distortions are wrong, look at `_derivatives`, which differentiates the flow from section to
section twice; if only that of pairs is, at `_pairs` and `_steady`; if only expected values are, at
the factors in `Products`.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex, Float, Int

from .._core.compilation import quick_jit
from .._core.executor import from_host, to_host
from ..engine.replay import replay
from ..linear.time_response import monodromy, periodic_states
from ..orbits.cycle import LimitCycle
from ..systems.structure import Structure
from ..systems.system import Output
from .families import FamilyLike
from .place import as_placed
from .placed import PlacedSections, observe


# Number of complex numbers in the largest array of responses to pairs of cosines. More: more
# memory. Fewer: more loops.
_NUMBERS = 2**21


class Quadratic(NamedTuple):
    """Derivatives with respect to the m deviations (n of time and state, then those of inputs) at
    each of N sections."""

    step: Float[np.ndarray, "N n m"]
    """First derivatives of the states at the next section."""
    bend: Float[np.ndarray, "N n m m"]
    """Second derivatives of the states at the next section."""
    show: Float[np.ndarray, "N ny m"]
    """First derivatives of the outputs."""
    show_bend: Float[np.ndarray, "N ny m m"]
    """Second derivatives of the outputs."""

    @property
    def _states(self) -> Float[np.ndarray, "N n n"]:
        return self.step[:, :, : self.step.shape[1]]

    def second_order(
        self, u: Float[np.ndarray, "S time nu"]
    ) -> Float[np.ndarray, "S time ny"]:
        """The response of second order to inputs that repeat after a whole number of periods."""
        N, n, _ = self.step.shape
        S, steps, _ = u.shape
        A = self._states
        B = self.step[:, :, n:]
        by_period = (S, steps // N, N, -1)
        section = np.arange(steps) % N

        # Deviations of first order.
        start = np.asarray(periodic_states(A, B, u.reshape(by_period)))
        nothing = np.zeros((S, steps, n))
        states = self._run(start, nothing, u)
        deviations = np.concatenate([states, u], axis=2)

        # Their products force the deviations of second order.
        forcing = _bent(self.bend[section], deviations) / 2
        unit = np.tile(np.eye(n), (N, 1, 1))
        start = np.asarray(periodic_states(A, unit, forcing.reshape(by_period)))
        states = self._run(start, forcing, 0 * u)

        C = self.show[section][:, :, :n]
        linear = np.einsum("toi,sti->sto", C, states)
        bent = _bent(self.show_bend[section], deviations) / 2
        return linear + bent

    def _run(self, x, forcing, u) -> Float[np.ndarray, "S time n"]:
        """States from a start, with a forcing and inputs."""
        states = []
        for k in range(u.shape[1]):
            states.append(x)
            step = self.step[k % len(self.step)]
            with_inputs = np.concatenate([x, u[:, k]], axis=1)
            x = with_inputs @ step.T + forcing[:, k]
        return np.stack(states, axis=1)

    def waves(
        self, f: Float[np.ndarray, " K"], channel: Int[np.ndarray, " K"]
    ) -> Complex[np.ndarray, "N m K"]:
        """Linear responses to $e^{2 \\pi i f n/N}$ at an input, divided by it, with that input."""
        N, n, m = self.step.shape
        B = self.step[:, :, n:]
        index = np.arange(m - n)
        unit = (index[:, None] == channel).astype(complex)
        u = np.broadcast_to(unit, (N, *unit.shape))
        states = self._steady(B @ u, f)
        return np.concatenate([states, u], axis=1)

    def _steady(
        self, forcing: Complex[np.ndarray, "N n K"], f: Float[np.ndarray, " K"]
    ) -> Complex[np.ndarray, "N n K"]:
        """States for a periodic forcing times $e^{2 \\pi i f n/N}$, divided by it."""
        A = self._states
        angles = -2j * np.pi * f
        back = np.exp(angles / len(self.step))

        def ahead(x, section):
            return (A[section] @ x + forcing[section]) * back

        # The state after one period from zero.
        x = np.zeros(forcing.shape[1:], complex)
        for section in range(len(A)):
            x = ahead(x, section)

        # The periodic start.
        turns = -2j * np.pi * f
        back_a_period = np.exp(turns)[:, None, None]
        returned = back_a_period * monodromy(A)
        unit = np.eye(A.shape[-1])
        column = np.linalg.solve(unit - returned, x.T[:, :, None])
        x = column[:, :, 0].T

        states = []
        for section in range(len(A)):
            states.append(x)
            x = ahead(x, section)
        return np.stack(states)

    def products(
        self, f: Float[np.ndarray, " K"], channel: Int[np.ndarray, " K"]
    ) -> "Products":
        """Responses of second order to all pairs of cosines."""
        N, n, _ = self.step.shape
        K = len(f)
        ny = self.show.shape[1]
        w = self.waves(f, channel)
        squares = np.zeros((2, ny, K, K))
        mean = np.zeros((ny, N, K))
        numbers_of_row = 2 * N * max(n, ny, 1) * K
        rows = max(_NUMBERS // numbers_of_row, 1)
        for begin in range(0, K, rows):
            first = np.arange(begin, min(begin + rows, K))
            both = self._pairs_from(w, f, first)
            # A cosine with itself has a mean, at the difference of frequencies.
            row = np.arange(len(first))
            outputs_first = np.moveaxis(np.real(both), 0, 1)
            mean[:, :, first] = outputs_first[:, :, row, 1, row]
            square = np.mean(np.abs(both) ** 2, axis=0)
            square = np.moveaxis(square, 2, 0)
            squares[:, :, first, begin:] = square
            squares[:, :, begin:, first] = square.swapaxes(2, 3)
        return Products(squares[0], squares[1], mean)

    def _pairs_from(
        self,
        w: Complex[np.ndarray, "N m K"],
        f: Float[np.ndarray, " K"],
        first: Int[np.ndarray, " k"],
    ) -> Complex[np.ndarray, "N ny k 2 second"]:
        """Outputs at the sums and at the differences of frequencies, for pairs of a wave in `first`
        with itself or a later wave."""
        N, n, _ = self.step.shape
        C = self.show[:, :, :n]
        ny = C.shape[1]
        begin = first[0]
        f_first = f[first][:, None]
        f_second = f[begin:]
        sums = np.concatenate([f_first + f_second, f_first - f_second], axis=1)
        w_first = w[:, :, first]
        w_second = w[:, :, begin:]

        forcing = _pairs(self.bend, w_first, w_second)
        in_columns = forcing.reshape(N, n, -1)
        y = C @ self._steady(in_columns, sums.ravel())
        y = y.reshape(N, ny, *sums.shape)
        y = y + _pairs(self.show_bend, w_first, w_second)
        return y.reshape(N, ny, len(first), 2, -1)


class Products(NamedTuple):
    """Responses of second order to pairs of cosines, $F''(w_k, w_l)$ in place of an input."""

    sum: Float[np.ndarray, "ny K K"]
    """Mean squares over the sections of the response at the sum of the two frequencies."""
    difference: Float[np.ndarray, "ny K K"]
    """The same at the difference of the two frequencies."""
    mean: Float[np.ndarray, "ny N K"]
    """The response to the pair of a cosine with itself, at the difference of frequencies, which is
    zero."""

    def gaussian(self) -> Float[np.ndarray, "ny K K"]:
        """G: the mean square of the part of second order is $p^T G p$, for random inputs with
        powers p about the lines, or many lines with random phases."""
        return (self.sum + self.difference) / 4 + self._shift()

    def cosines(self) -> Float[np.ndarray, "ny K K"]:
        """The matrix G for cosines with random phases. It is smaller than for random inputs, since
        each cosine has a constant amplitude."""
        pairs = (self.sum + self.difference) / 4
        k = np.arange(pairs.shape[-1])
        pairs[:, k, k] = self.sum[:, k, k] / 8
        return pairs + self._shift()

    def _shift(self) -> Float[np.ndarray, "ny K K"]:
        """The part of the mean over time at each section."""
        return np.einsum("onk,onl->okl", self.mean, self.mean) / (
            4 * self.mean.shape[1]
        )


def _bent(bend, w):
    """Second derivatives (time, rows, m, m), along (S, time, m) twice."""
    return np.einsum("toij,sti,stj->sto", bend, w, w, optimize=True)


def _pairs(bend, first, second) -> Complex[np.ndarray, "N rows some both"]:
    """Second derivatives along pairs of waves (N, m, some). Each second wave is used twice: as it
    is, and conjugate."""
    along = np.einsum("noij,nis->nosj", bend, first, optimize=True)
    N, rows, count, m = along.shape
    along = along.reshape(N, rows * count, m)
    with_waves = along @ second
    with_conjugates = along @ second.conj()
    both = np.concatenate([with_waves, with_conjugates], axis=2)
    return both.reshape(N, rows, count, -1)


def second_order(
    cycle: LimitCycle,
    sections: FamilyLike,
    outputs: tuple[str, ...],
    inputs: tuple[str, ...],
) -> Quadratic:
    """First and second derivatives with respect to time and state at each section and to the inputs
    that are held from it on: exact, through all events.

    States are (t, q) in full, since no coordinates on a curved section are needed. Without a clock
    the derivatives with respect to time are zero.

    **Raises:** `DefinitionError` for an output that is not defined in a chart where a section
    lies, or an input that does not exist; `ComputationError` as `place_sections`.
    """
    placed = as_placed(cycle, sections)
    s = placed.structure()
    z = s.resolve_outputs(outputs)
    z.require(*np.unique(placed.lanes.chart).tolist())
    _, columns = s.inputs_among(inputs)
    derivatives = _derivatives(from_host(placed), tuple(z.items))
    first, second = to_host(derivatives)
    n = 1 + s.d
    kept = np.r_[:n, n + columns]
    first = first[:, :, kept]
    second = second[:, :, kept][..., kept]
    if not cycle.clocked:
        first[:, 0] = 0.0
        second[:, 0] = 0.0
    return Quadratic(
        step=first[:, :n],
        bend=second[:, :n],
        show=first[:, n:],
        show_bend=second[:, n:],
    )


@quick_jit
def _derivatives(placed: PlacedSections, items: tuple[str | Output, ...]):
    """First (N, rows, m) and second derivatives (N, rows, m, m) of (t, q) at the next section and
    of outputs at this one."""
    following, _, target = placed.onwards()
    s: Structure = placed.structure()
    z = s.resolve_outputs(items)
    lanes = placed.lanes
    n = 1 + s.d
    tape = placed.tape
    assert tape is not None

    def work(x):
        """(t, q) at the next section, and outputs at this one, for x = (t, q, u)."""
        u = x[n:]
        point = (x[0], x[1:n])
        begin = eqx.tree_at(lambda y: (y.t, y.q), lanes, point)
        t, q = replay(s, begin, u, target, tape)
        return jnp.concatenate([t[None], q, observe(s, z, begin, u)])

    u = jnp.zeros((s.nu, len(following)))
    x = jnp.concatenate([lanes.t[None], lanes.q, u])
    m = len(x)

    def along(direction):
        tangent = jnp.broadcast_to(direction[:, None], x.shape)
        return lambda x: jax.jvp(work, (x,), (tangent,))[1]

    def twice(first, second):
        tangent = jnp.broadcast_to(second[:, None], x.shape)
        return jax.jvp(along(first), (x,), (tangent,))

    # Second derivatives are symmetric: only pairs with i <= j are computed.
    i, j = np.triu_indices(m)
    unit = jnp.eye(m)
    first, second = jax.vmap(twice)(unit[i], unit[j])
    place = np.zeros((m, m), int)
    place[i, j] = np.arange(len(i))
    place[j, i] = np.arange(len(i))
    first = first[place[:, -1]]
    second = second[place]
    return first.transpose(2, 1, 0), second.transpose(3, 2, 0, 1)
