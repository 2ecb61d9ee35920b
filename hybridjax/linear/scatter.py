"""How well variances of estimates are known, from the scatter of a few experiments."""

from typing import Annotated

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._core.arguments import Numbers
from .._core.boundary.arrays import Reals
from .._core.boundary.checked import checked
from .._core.boundary.kinds import Probability
from .._core.precision import require_x64
from .._core.tracing import is_traced
from ..errors import DefinitionError


# Of three realizations that scatter evenly, relative to the mean for normal errors.
_ROUNDEST = 3


@checked
class Scatter(eqx.Module):
    r"""What is known of the scatter that `HTF.variance` was estimated from.

    **Arguments:**

    - `freedom` (F,): complex degrees of freedom of the variance.
    - `roundness` (M, F, ny, nu): $1 - |\sum_j d_j^2|^2 / (\sum_j |d_j|^2)^2$ of the residuals d of
      the realizations, relative to its mean for normal errors: 0 where all lie on a line. None,
      and ones, are scatter that says nothing but its size.

    **Raises:** `DefinitionError` for freedom that is not positive, roundness beyond 0 to 3, or two
    numbers of frequencies.
    """

    freedom: Float[Array, " F"]
    roundness: Float[Array, "M F ny nu"] | None

    def __init__(
        self,
        freedom: Annotated[Numbers, Reals("F", sign="positive")],
        roundness: Annotated[Numbers, Reals("M F ny nu", sign="nonnegative")] | None = None,
    ):
        require_x64()
        self.freedom = jnp.asarray(freedom)
        self.roundness = None if roundness is None else jnp.asarray(roundness)
        if roundness is None:
            return
        if roundness.shape[1] != len(self.freedom):
            raise DefinitionError(
                f"`freedom` is of {len(self.freedom)} frequencies, `roundness` of "
                f"{roundness.shape[1]}."
            )
        if not is_traced(roundness) and np.max(roundness, initial=0) > _ROUNDEST:
            raise DefinitionError(f"`roundness` must be at most {_ROUNDEST}.")

    def quantile(self, level: Probability) -> Float[Array, "*M F ny nu"]:
        r"""How large $|\delta H|^2 / v$ is with this probability at most.

        $\nu (\alpha^{-1/\nu} - 1)$, Fisher's $F_{2, 2\nu}$, of $\alpha = (1 - p)(1 + p^2 (w - 1))$
        for the level p and the roundness w. Of normal errors the shape of the scatter says nothing
        about their mean (Basu, Sankhya 1955), so that discs hold as often as they say for any w
        whose mean is one. Errors of equal moduli and random phases lie on a circle around zero:
        where few of them have a large mean, they lie on an arc, nearly in line.
        """
        miss = 1 - level
        if self.roundness is not None:
            miss = miss * (1 + level**2 * (self.roundness - 1))
        freedom = self.freedom[:, None, None]
        return freedom * jnp.expm1(-jnp.log(miss) / freedom)
