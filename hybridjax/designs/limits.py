r"""What an experiment may cost: powers p of the cosines with $W p \le 1$ and $p \le$ `largest`."""

from collections.abc import Mapping
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from .._core.boundary.kinds import Positive
from ..errors import DefinitionError


Limit = Literal["input", "output"] | Mapping[str, Positive]


class Limits(NamedTuple):
    """L limits of quantities that are sums over all cosines, and one of each cosine."""

    names: tuple[str, ...]
    """Of the signals that are limited."""
    cost: Float[np.ndarray, "L K"]
    """W: share of each limit that a unit of a cosine's power takes."""
    largest: Float[np.ndarray, " K"]
    """The largest power of each cosine; infinite where there is no such limit."""

    def use(self, power: Float[np.ndarray, " K"]) -> Float[np.ndarray, " L"]:
        """Share of each limit that is used."""
        return self.cost @ power

    def within(self, power: Float[np.ndarray, " K"]) -> Float[np.ndarray, " K"]:
        """The same proportions, as large as the limits allow."""
        return np.minimum(power / self.use(power).max(), self.largest)

    def only(self, some: Int[np.ndarray, " k"]) -> "Limits":
        """Where only these cosines are applied."""
        return self._replace(cost=self.cost[:, some], largest=self.largest[some])


def make_limits(
    limit: Limit,
    squares: dict[str, Float[np.ndarray, " K"]],
    inputs: tuple[str, ...],
    usual: Float[np.ndarray, " K"],
    largest: Float[np.ndarray, " K"],
) -> Limits:
    """**Arguments:**

    - `limit`: rms values by name, or what is to be no larger than with the `usual` powers.
    - `squares`: mean square of each signal per unit of each cosine's power.

    **Raises:** `DefinitionError` for names that do not exist, and limits that nothing satisfies, or
    that leave the power of some cosine unlimited.
    """
    if isinstance(limit, str):
        names = [n for n in squares if (n in inputs) == (limit == "input")]
        level = {n: float(np.sqrt(squares[n] @ usual)) for n in names}
    else:
        level = {str(n): float(rms) for n, rms in limit.items()}
    unknown = [n for n in level if n not in squares]
    if unknown or not level:
        what = f"limits '{unknown[0]}'" if unknown else "limits nothing"
        raise DefinitionError(
            f"`limit` {what}; what can be limited is the rms value of {', '.join(squares)}."
        )
    silent = [n for n, rms in level.items() if rms == 0]
    if silent:
        raise DefinitionError(f"the `design` does not move {silent[0]}, so it cannot be limited.")
    cost = np.stack([squares[n] / rms**2 for n, rms in level.items()])
    if not (largest > 0).any():
        raise DefinitionError("`largest` is zero at all frequencies: no cosine may be applied.")
    free = (cost.max(axis=0) == 0) & np.isinf(largest)
    if free.any():
        raise DefinitionError(
            f"no limit reaches cosine {int(np.argmax(free))} of the design: limit the input, too."
        )
    return Limits(tuple(level), cost, largest)
