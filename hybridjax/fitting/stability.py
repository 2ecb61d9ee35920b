"""`spectral_radius`: a smooth upper bound of the largest modulus of the multipliers, for use in
optimization.

The largest modulus itself has no derivative where multipliers coincide. `_smooth_radius` solves for
the bound by Newton's method, which must begin below it: from there it never passes the bound. The
equation in the docstring of `spectral_radius` is the contract; if the bound is wrong, compare it
with `excess`. No error is raised: matrices that are not finite give NaN, and so may a `smoothing`
below 1e-14, which rounding hides.
"""

import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Float

from .._core.boundary.checked import checked
from .._core.boundary.kinds import Probability
from ..linear.ldtp import LDTP
from ..linear.time_response import monodromy
from ..orbits.cycle import LimitCycle


@checked
def spectral_radius(
    model: LDTP | LimitCycle, smoothing: Probability = 1e-3
) -> Float[Array, ""]:
    r"""Return a smooth upper bound of the largest modulus of the Floquet multipliers.

    It is the number $\rho_\epsilon$ with

    $$\sum_{j \ge 0} \rho_\epsilon^{-2j}\, \lVert \Phi^j \rVert_F^2 = d / \epsilon$$

    for the monodromy matrix $\Phi$ (d, d) and the Frobenius norm. Multipliers have no derivative
    where two of them coincide, and their largest modulus has kinks. $\rho_\epsilon$ is smooth
    wherever $\Phi \ne 0$. ($\lVert\Phi^k\rVert^{1/k}$ is smooth, too, but for large k its
    derivatives do not converge to those of the spectral radius.) It is biased upwards:

    $$\rho / \sqrt{1 - \epsilon/d} \le \rho_\epsilon \le \rho / \sqrt{1 - \kappa^2 \epsilon}$$

    with the condition number $\kappa$ of the eigenvectors (the upper bound where $\kappa^2 \epsilon
    < 1$). Unlike the true spectral radius, it depends on the section and its coordinates. (J.
    Vanbiervliet, B. Vandereycken, W. Michiels, S. Vandewalle, M. Diehl, The smoothed spectral
    abscissa for robust stability optimization, SIAM J. Optim. 20, 2009; here for maps.)

    `LDTP.characteristic_polynomial` is smooth as well, and without bias: trace and determinant are
    $-c_1$ and $(-1)^d c_d$.

    **Arguments:** `model`: result of `linearize` or `find_limit_cycle`; for a batch use `jax.vmap`.
    `smoothing`: $\epsilon$, between 0 and 1; the larger, the
    smoother. Default: 0.001.

    **Returns:** a number.

    **Example:**

    ```python
    print(hj.fitting.spectral_radius(model), abs(model.multipliers).max())
    ```

    **Before:** `hj.find_limit_cycle` or `hj.linearize`. **After:** `jax.grad`.
    """
    if isinstance(model, LimitCycle):
        model.require_found()
    matrix = monodromy(model.A if isinstance(model, LDTP) else model.factors)
    return _smooth_radius(matrix, jnp.asarray(smoothing, float))


@jax.jit
def _smooth_radius(
    matrix: Float[Array, "d d"], smoothing: Float[Array, ""]
) -> Float[Array, ""]:
    d = matrix.shape[0]

    def excess(x, matrix):
        """Logarithm of the left side of the equation, at rho = e^x, minus that of the right side:
        convex and falling."""
        identity = jnp.eye(d)
        twice = jnp.kron(matrix, matrix)  # its powers map vec(I) to vec(P P^T)
        total = jnp.linalg.solve(
            jnp.eye(d * d) - jnp.exp(-2 * x) * twice, identity.ravel()
        )
        return jnp.log(identity.ravel() @ total) - jnp.log(d / smoothing)

    # From a lower bound, Newton's method increases and never passes the root. (The norm is for
    # nilpotent matrices, whose multipliers are zero.)
    fixed = jax.lax.stop_gradient(matrix)
    largest = jnp.max(jnp.abs(jnp.linalg.eigvals(fixed)))
    lower_bound = jnp.maximum(
        largest / jnp.sqrt(1 - smoothing / d), 1e-6 * jnp.linalg.norm(fixed)
    )
    solver: optx.Newton = optx.Newton(rtol=1e-12, atol=1e-12)
    begin = jnp.log(lower_bound)
    return jnp.exp(
        optx.root_find(excess, solver, begin, matrix, max_steps=64, throw=False).value
    )
