"""The exact harmonic transfer functions (HTFs) of an LDTP system, for the host and for XLA.

`LDTP.htf` calls `harmonic_transfer`, whose docstring has the formulas. The periodic states come
from `_states`: a sum over one period, and a linear system for the state at its beginning. Where
derivatives must come from the host, `_along` computes them by the same functions. It has the
derivatives of the formulas of `harmonic_transfer`, so that both must be changed together.
`check_harmonics` says which harmonics exist, also for other files.

If H is wrong at all harmonics, look at `_states`; if only derivatives that come from the host are,
at `_along`. If H_m and H_-m are exchanged, look at the index: harmonic m is at m mod N, the order
of the FFT.
"""

import functools as ft
from collections.abc import Callable, Iterable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex, Float

from .._core.boundary.kinds import Scalar, Vector
from .._core.compilation import host_first
from .._core.executor import Array, namespace, scan, solve
from .._core.host_derivatives import must_be_on_host
from ..errors import DefinitionError
from .time_response import monodromy


Frequencies = Vector | Scalar
"""Cycles per period: (F,), or one."""
Harmonics = int | Iterable[int]
"""m of H_m, or several: 2 is H_2 alone."""


def all_harmonics(n_sections: int) -> tuple[int, ...]:
    """The `N` harmonics that are distinct, ascending.

    `-N/2 .. N/2-1` for even `N`, `-(N-1)/2 .. (N-1)/2` for odd `N`.
    """
    return tuple(range(-(n_sections // 2), (n_sections + 1) // 2))


def check_harmonics(harmonics: Harmonics | None, n_sections: int) -> tuple[int, ...]:
    """`harmonics` as an ascending tuple; `None` means all of them. Without sections, in continuous
    time, there is a harmonic for every integer.

    **Raises:** `DefinitionError` for harmonics that are out of range, repeated, or none.
    """
    every = all_harmonics(n_sections)
    if harmonics is None:
        return every
    if isinstance(harmonics, Iterable):
        integers = tuple(sorted(harmonics))
    else:
        integers = (harmonics,)
    outside = [m for m in integers if n_sections and m not in every]
    if outside:
        raise DefinitionError(
            f"Harmonic {outside[0]} does not exist: with {n_sections} sections the harmonics are "
            f"{every[0]} to {every[-1]}."
        )
    if len(set(integers)) < len(integers) or not integers:
        raise DefinitionError(
            f"`harmonics` must be one or more different integers: {integers}."
        )
    return integers


def _derived(compiled: Callable) -> Callable:
    """`compiled`, whose derivatives in forward mode come from the host where they must."""
    derived = eqx.filter_custom_jvp(lambda *arguments: compiled(*arguments))

    @derived.def_jvp
    def rule(arguments, tangents):
        if not must_be_on_host():
            return eqx.filter_jvp(compiled, arguments, tangents)
        value = harmonic_transfer(*arguments)
        along = [
            jnp.zeros_like(x) if tangent is None else tangent
            for x, tangent in zip(arguments, tangents[:4], strict=False)
        ]
        shape = jax.ShapeDtypeStruct(value.shape, value.dtype)
        derivative = jax.pure_callback(
            _along, shape, *arguments, *along, vmap_method="broadcast_all"
        )
        return value, derivative

    return derived


def _along(*arrays: jax.Array) -> Complex[np.ndarray, "... N F ny nu"]:
    """Derivatives of `harmonic_transfer` along (A, B, C, D) on the host, with any leading axes, on
    which its arguments, which come first, do not depend."""
    lead = np.shape(arrays[0])[:-3]
    first = (0,) * len(lead)
    A, B, C, _, f = (np.asarray(x)[first] for x in arrays[:5])
    # Axes: directions, N, 1 (for frequencies), rows, columns.
    tangents = [np.asarray(x) for x in arrays[5:]]
    by_direction = [x.reshape(-1, *x.shape[-3:]) for x in tangents]
    dA, dB, dC, dD = (x[:, :, None] for x in by_direction)
    z = _unit_roots(A, f)
    X = _states(A, z * B[:, None], f)
    dX = _states_by_direction(A, dA @ X + z * dB, f)
    dG = (dC @ X + C[:, None] @ dX) / z + dD
    dH = np.fft.fft(dG, axis=1) / len(A)
    return dH.reshape(*lead, *dH.shape[1:])


def _states_by_direction(
    A: np.ndarray, forcing: Complex[np.ndarray, "P N F d nu"], f: np.ndarray
) -> Complex[np.ndarray, "P N F d nu"]:
    """The responses of the states to P forcings, which are further columns of one forcing."""
    P, N, F, d, nu = forcing.shape
    columns = np.moveaxis(forcing, 0, -2).reshape(N, F, d, P * nu)
    states = _states(A, columns, f).reshape(N, F, d, P, nu)
    return np.moveaxis(states, -2, 0)


def _unit_roots(A: Array, f: Array) -> Array:
    """z^n (N, F, 1, 1) at each section."""
    index = np.arange(len(A))[:, None, None, None]
    n = index / len(A)
    exponent = 2j * np.pi * n * f[:, None, None]
    return namespace(A).exp(exponent)


def _states(A: Array, forcing: Array, f: Array) -> Array:
    """The response (N, F, d, m) of the states to a forcing that is z^N-periodic."""
    xp = namespace(A)

    def advance(X, section):
        return section[0] @ X + section[1], X

    start = xp.zeros(forcing.shape[1:], forcing.dtype)
    forced, _ = scan(advance, start, (A, forcing))
    z_N = xp.exp(2j * np.pi * f)[:, None, None]
    shifted = z_N * np.eye(A.shape[-1])
    start = solve(shifted - monodromy(A), forced)
    return scan(advance, start, (A, forcing))[1]


@ft.partial(host_first, derived=_derived)
def harmonic_transfer(
    A: Float[Array, "N d d"],
    B: Float[Array, "N d nu"],
    C: Float[Array, "N ny d"],
    D: Float[Array, "N ny nu"],
    f: Float[Array, " F"],
) -> Complex[Array, "N F ny nu"]:
    r"""All harmonic transfer functions at the input frequencies `f` (cycles per period).

    With $z = e^{2 \pi i f / N}$, an input $u[n] = z^n$ has the response $x[n] = X_n$ where

    $v_0 = 0, \quad v_{n+1} = A[n] v_n + B[n] z^n, \quad X_0 = (z^N I - \Phi)^{-1} v_N, \quad
    X_{n+1} = A[n] X_n + B[n] z^n,$

    $G[n] = z^{-n} C[n] X_n + D[n]$ is periodic, and $H_m$ is its Fourier coefficient $m$.

    **Returns:** `H` with harmonic `m` at index `m mod N` (the order of the FFT).
    """
    z = _unit_roots(A, f)
    x = _states(A, z * B[:, None], f)
    by_state = C[:, None] @ x / z
    G = by_state + D[:, None]
    return namespace(A).fft.fft(G, axis=0) / len(A)
