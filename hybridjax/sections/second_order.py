"""Second derivatives of the maps between sections, and of outputs there."""

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


# Complex numbers in the largest array of responses to pairs of cosines. More: more memory. Fewer:
# more passes.
_NUMBERS = 2**21


class Quadratic(NamedTuple):
    """Derivatives with respect to the m deviations of states and inputs at each of N sections."""

    step: Float[np.ndarray, "N n m"]
    """First derivatives of the states at the next section."""
    bend: Float[np.ndarray, "N n m m"]
    """Their second derivatives."""
    show: Float[np.ndarray, "N ny m"]
    """First derivatives of the outputs."""
    show_bend: Float[np.ndarray, "N ny m m"]

    @property
    def _states(self) -> Float[np.ndarray, "N n n"]:
        return self.step[:, :, : self.step.shape[1]]

    def second_order(
        self, u: Float[np.ndarray, "S time nu"]
    ) -> Float[np.ndarray, "S time ny"]:
        """The response of second order to inputs that repeat after a whole number of periods."""
        N, n, _ = self.step.shape
        S, steps, _ = u.shape
        A, folded = self._states, (S, steps // N, N, -1)
        first = np.asarray(periodic_states(A, self.step[:, :, n:], u.reshape(folded)))
        w = np.concatenate([self._run(first, np.zeros((S, steps, n)), u), u], axis=2)
        section = np.arange(steps) % N
        forcing = _bent(self.bend[section], w) / 2
        unit = np.tile(np.eye(n), (N, 1, 1))
        second = np.asarray(periodic_states(A, unit, forcing.reshape(folded)))
        x = self._run(second, forcing, 0 * u)
        linear = np.einsum("toi,sti->sto", self.show[section][:, :, :n], x)
        return linear + _bent(self.show_bend[section], w) / 2

    def _run(self, x, forcing, u) -> Float[np.ndarray, "S time n"]:
        """States from a start, with a forcing and inputs."""
        states = []
        for k in range(u.shape[1]):
            states.append(x)
            step = self.step[k % len(self.step)]
            x = np.concatenate([x, u[:, k]], axis=1) @ step.T + forcing[:, k]
        return np.stack(states, axis=1)

    def waves(
        self, f: Float[np.ndarray, " K"], channel: Int[np.ndarray, " K"]
    ) -> Complex[np.ndarray, "N m K"]:
        """Linear responses to $e^{2 \\pi i f n/N}$ at an input, divided by it, with that input."""
        N, n, m = self.step.shape
        unit = (np.arange(m - n)[:, None] == channel).astype(complex)
        u = np.broadcast_to(unit, (N, *unit.shape))
        return np.concatenate([self._steady(self.step[:, :, n:] @ u, f), u], axis=1)

    def _steady(
        self, forcing: Complex[np.ndarray, "N n K"], f: Float[np.ndarray, " K"]
    ) -> Complex[np.ndarray, "N n K"]:
        """States for a periodic forcing times $e^{2 \\pi i f n/N}$, divided by it."""
        A, back = self._states, np.exp(-2j * np.pi * f / len(self.step))
        x = np.zeros(forcing.shape[1:], complex)
        for step, push in zip(A, forcing, strict=True):
            x = (step @ x + push) * back
        turn = np.exp(-2j * np.pi * f)[:, None, None] * monodromy(A)
        x = np.linalg.solve(np.eye(A.shape[-1]) - turn, x.T[:, :, None])[:, :, 0].T
        states = []
        for step, push in zip(A, forcing, strict=True):
            states.append(x)
            x = (step @ x + push) * back
        return np.stack(states)

    def products(
        self, f: Float[np.ndarray, " K"], channel: Int[np.ndarray, " K"]
    ) -> "Products":
        """Responses of second order to all pairs of cosines."""
        N, n, _ = self.step.shape
        K, ny = len(f), self.show.shape[1]
        w = self.waves(f, channel)
        squares, mean = np.zeros((2, ny, K, K)), np.zeros((ny, N, K))
        rows = max(_NUMBERS // (2 * N * max(n, ny, 1) * K), 1)
        for begin in range(0, K, rows):
            first = np.arange(begin, min(begin + rows, K))
            second = w[:, :, begin:]
            forcing = _pairs(self.bend, w[:, :, first], second)
            f_first, f_second = f[first][:, None], f[begin:]
            sums = np.concatenate([f_first + f_second, f_first - f_second], axis=1)
            y = self.show[:, :, :n] @ self._steady(
                forcing.reshape(N, n, -1), sums.ravel()
            )
            y = y.reshape(N, ny, *sums.shape) + _pairs(
                self.show_bend, w[:, :, first], second
            )
            both = y.reshape(N, ny, len(first), 2, -1)
            mean[:, :, first] = np.moveaxis(np.real(both), 0, 1)[
                :, :, np.arange(len(first)), 1, np.arange(len(first))
            ]
            size = np.moveaxis(np.mean(np.abs(both) ** 2, axis=0), 2, 0)
            squares[:, :, first, begin:] = size
            squares[:, :, begin:, first] = size.swapaxes(2, 3)
        return Products(squares[0], squares[1], mean)


class Products(NamedTuple):
    """Responses of second order to pairs of cosines, $F''(w_k, w_l)$ in place of an input."""

    sum: Float[np.ndarray, "ny K K"]
    """Mean squares over the sections, at the sum of their frequencies."""
    difference: Float[np.ndarray, "ny K K"]
    mean: Float[np.ndarray, "ny N K"]
    """The response to a cosine with itself, at the difference."""

    def gaussian(self) -> Float[np.ndarray, "ny K K"]:
        """G: the mean square of the part of second order is $p^T G p$, for random inputs with
        powers p about the lines, or many lines with random phases."""
        return (self.sum + self.difference) / 4 + self._shift()

    def cosines(self) -> Float[np.ndarray, "ny K K"]:
        """The same for cosines with random phases: less, since each has a constant amplitude."""
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
    """Second derivatives along pairs of waves (N, m, some), the second of which come twice: as
    they are, and conjugate."""
    along = np.einsum("noij,nis->nosj", bend, first, optimize=True)
    N, rows, count, m = along.shape
    along = along.reshape(N, rows * count, m)
    both = np.concatenate([along @ second, along @ second.conj()], axis=2)
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
    first, second = to_host(_derivatives(from_host(placed), tuple(z.items)))
    n = 1 + s.d
    kept = np.r_[:n, n + columns]
    first, second = first[:, :, kept], second[:, :, kept][..., kept]
    if not cycle.clocked:
        first[:, 0], second[:, 0] = 0.0, 0.0
    return Quadratic(first[:, :n], second[:, :n], first[:, n:], second[:, n:])


@quick_jit
def _derivatives(placed: PlacedSections, items: tuple[str | Output, ...]):
    """First (N, rows, m) and second derivatives (N, rows, m, m) of (t, q) at the next section and
    of outputs at this one."""
    following, _, target = placed.onwards()
    s: Structure = placed.structure()
    z, lanes, n = s.resolve_outputs(items), placed.lanes, 1 + s.d
    tape = placed.tape
    assert tape is not None

    def work(x):
        begin = eqx.tree_at(lambda y: (y.t, y.q), lanes, (x[0], x[1:n]))
        t, q = replay(s, begin, x[n:], target, tape)
        return jnp.concatenate([t[None], q, observe(s, z, begin, x[n:])])

    x = jnp.concatenate([lanes.t[None], lanes.q, jnp.zeros((s.nu, len(following)))])
    m = len(x)

    def along(direction):
        tangent = jnp.broadcast_to(direction[:, None], x.shape)
        return lambda x: jax.jvp(work, (x,), (tangent,))[1]

    def twice(first, second):
        return jax.jvp(
            along(first), (x,), (jnp.broadcast_to(second[:, None], x.shape),)
        )

    i, j = np.triu_indices(m)
    first, second = jax.vmap(twice)(jnp.eye(m)[i], jnp.eye(m)[j])
    place = np.zeros((m, m), int)
    place[i, j] = place[j, i] = np.arange(len(i))
    return first[place[:, -1]].transpose(2, 1, 0), second[place].transpose(3, 2, 0, 1)
