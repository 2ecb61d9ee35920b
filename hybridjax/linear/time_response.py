"""Time-domain computations with the padded matrices of an LDTP: responses, periodic states, and the
product of all A[n].

The methods of `LDTP` call them; cycles, sections and fits call `monodromy` and `periodic_states`,
too. All of them rely on the zeros of the padding, and on the order of sections: A[n] leads from
section n to n + 1, so that later factors stand on the left. Both must stay.

If a response is wrong, look at `response`, and at `LDTP._response` for the section where it begins;
if a periodic start leaves a transient, at `periodic_states`. The multipliers of an `LDTP` do not
come from here: see `multipliers.py`.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from .._core.compilation import host_first
from .._core.executor import Array, namespace, scan, solve
from .algebra import Matrices


def monodromy(A: Float[Array, "N *S d d"]) -> Float[Array, "*S d d"]:
    """The product `A[N-1] ... A[0]`, the padded monodromy matrix at section 0. (S are further
    axes.)"""
    identity = namespace(A).eye(A.shape[-1], dtype=A.dtype)
    start = namespace(A).zeros_like(A[0]) + identity
    product, _ = scan(_multiplied, start, A)
    return product


@functools.partial(jax.jit, static_argnames="section")
def monodromy_from(A: Float[Array, "N d d"], section: int) -> Float[Array, "d d"]:
    """The product of one period from a section. (A loop outside of a program is compiled anew at
    each of its derivatives.)"""
    return monodromy(jnp.roll(A, -section, axis=0))


def _multiplied(product, factor):
    return factor @ product, None


@jax.jit
def response(
    m: Matrices,
    u: Float[Array, "n nu"],
    x0: Float[Array, " d"],
    sections: Int[Array, " n"],
) -> tuple[Float[Array, "time d"], Float[Array, "n ny"]]:
    """The states (`x0`, then those after each input), and the outputs at the sections where inputs
    begin to act.

    **Arguments:** `u`: inputs, one after the other. `sections`: the section at which each begins to
    act.
    """

    def advance(x, step):
        n, u = step
        return m.A[n] @ x + m.B[n] @ u, x

    last, x = jax.lax.scan(advance, x0, (sections, u))
    C = m.C[sections]
    D = m.D[sections]
    y = jnp.einsum("nij,nj->ni", C, x) + jnp.einsum("nij,nj->ni", D, u)
    return jnp.concatenate([x, last[None]]), y


@functools.partial(jax.jit, static_argnames="n_lags")
def impulse_response(m: Matrices, n_lags: int) -> Float[Array, "N lags ny nu"]:
    """`D[n]`, then `C[n] A[n-1] ... A[n-r+1] B[n-r]` at `[n, r]`, for all sections at once."""

    def advance(x, _):
        return jnp.roll(m.A @ x, 1, axis=0), m.C @ x

    first = jnp.roll(m.B, 1, axis=0)
    _, later = jax.lax.scan(advance, first, length=n_lags - 1)
    return jnp.concatenate([m.D[None], later]).swapaxes(0, 1)


@host_first
def periodic_states(
    A: Float[Array, "N d d"], B: Float[Array, "N d nu"], u: Float[Array, "S P N nu"]
) -> Float[Array, "S d"]:
    r"""The states at section 0 from which responses to S inputs that repeat after P periods are
    periodic: $x_{p+1} = \Phi x_p + w_p$ with $x_P = x_0$.

    Solved by a Fourier transform over the periods $p$, since in $(I - \Phi^P)^{-1}$ the unstable
    part of an unstable system would drown the stable one.
    """
    xp = namespace(A)
    periods = u.shape[1]
    identity = np.eye(A.shape[-1])
    # What enters at a section reaches the end of the period through the factors after it.
    phi, after = scan(_extended, xp.asarray(identity), A[::-1])
    entering = after[::-1] @ B
    w = xp.tensordot(u, entering, ((2, 3), (0, 2)))
    z_N = np.exp(2j * np.pi * np.arange(periods) / periods)
    resolvent = z_N[:, None, None] * identity - phi
    spectra = xp.moveaxis(xp.fft.fft(w, axis=1), 0, -1)
    starts = solve(resolvent, spectra)
    return starts.mean(axis=0).real.T


def _extended(product, factor):
    return product @ factor, product


@jax.jit
def characteristic_polynomial(
    matrix: Float[Array, "d d"],
) -> Float[Array, " coefficients"]:
    """Coefficients of det(x I - matrix), highest power first (Faddeev-LeVerrier recursion)."""
    d = matrix.shape[0]
    identity = jnp.eye(d)
    coefficients = [jnp.ones(())]
    adjugate = identity
    for k in range(1, d + 1):
        step = matrix @ adjugate
        coefficients.append(-jnp.trace(step) / k)
        adjugate = step + coefficients[-1] * identity
    return jnp.stack(coefficients)
