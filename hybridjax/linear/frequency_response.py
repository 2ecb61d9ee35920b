"""The exact harmonic transfer functions of an LDTP system, for the host and for XLA."""

from collections.abc import Iterable

import numpy as np
from jaxtyping import Complex, Float

from .._core.boundary.kinds import Scalar, Vector
from .._core.compilation import host_first
from .._core.executor import Array, namespace, scan
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
    integers = tuple(sorted(harmonics)) if isinstance(harmonics, Iterable) else (harmonics,)
    outside = [m for m in integers if m not in every] if n_sections else []
    if outside:
        raise DefinitionError(
            f"Harmonic {outside[0]} does not exist: with {n_sections} sections the harmonics are "
            f"{every[0]} to {every[-1]}."
        )
    if len(set(integers)) < len(integers) or not integers:
        raise DefinitionError(f"`harmonics` must be one or more different integers: {integers}.")
    return integers


@host_first
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
    xp, (n_sections, d, _) = namespace(A), A.shape
    z = xp.exp(2j * np.pi / n_sections * np.arange(n_sections)[:, None] * f)
    z_N = xp.exp(2j * np.pi * f)

    def advance(X, section):
        A, B, z = section
        return A @ X + z[:, None, None] * B, X

    start = xp.zeros((f.size, d, B.shape[-1]), z.dtype)
    forced, _ = scan(advance, start, (A, B, z))
    start = xp.linalg.solve(z_N[:, None, None] * np.eye(d) - monodromy(A), forced)
    _, X = scan(advance, start, (A, B, z))
    G = C[:, None] @ X / z[:, :, None, None] + D[:, None]
    return xp.fft.fft(G, axis=0) / n_sections
