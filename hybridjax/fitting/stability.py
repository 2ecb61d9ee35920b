"""A smooth stand-in for the largest modulus of the multipliers."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from .._core.errors import DefinitionError
from ..orbits.cycle import LimitCycle
from ..periodic.ldtp import LDTP
from ..periodic.response import monodromy


def spectral_radius(model: LDTP | LimitCycle, doublings: int = 6) -> Float[Array, ""]:
    r"""A smooth upper bound of the largest modulus of the Floquet multipliers.

    $$\rho_k = \lVert \Phi^k \rVert_F^{1/k}, \qquad k = 2^{doublings},$$

    with the monodromy matrix $\Phi$ and the Frobenius norm. Multipliers themselves have no
    derivative where two of them meet; $\rho_k$ does everywhere (except at $\Phi^k = 0$). It is
    biased: $\rho \le \rho_k \le (\kappa \sqrt d)^{1/k} \rho$ for d multipliers and the condition
    number $\kappa$ of the eigenvectors, and where multipliers coalesce the logarithm of the bias
    goes to zero like $(\log k)/k$ (Gelfand's formula; Horn and Johnson, *Matrix Analysis*, 5.6).
    It depends on the section and the coordinates, the true radius does not.

    `LDTP.characteristic_polynomial` is smooth as well, and without bias: trace and determinant are
    $-c_1$ and $(-1)^d c_d$.

    **Arguments:** `model`: from `linearize` or `find_limit_cycle`; of a batch, one at a time
    (`jax.vmap`). `doublings`: more make the bias smaller and the function less smooth: where
    multipliers meet, its second derivative is of order k.

    **Raises:** `DefinitionError` if `doublings` is negative.
    """
    if doublings < 0:
        raise DefinitionError(f"doublings must not be negative, but is {doublings}.")
    power = monodromy(model.A if isinstance(model, LDTP) else model.factors)
    size = jnp.zeros(())  # the logarithm of what the power was divided by
    for _ in range(doublings):
        norm = jnp.linalg.norm(power)
        power = (power / norm) @ (power / norm)
        size = 2 * (size + jnp.log(norm))
    return jnp.exp((size + jnp.log(jnp.linalg.norm(power))) / 2**doublings)
