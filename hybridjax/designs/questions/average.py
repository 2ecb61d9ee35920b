r"""A question about several models, any of which may be true.

The mean of the r-th powers of their criteria, $(\frac{1}{J} \sum_j \Psi_j^r)^{1/r}$, is convex in
the powers of the cosines and halved where these are doubled, as each of them is: the certificate
holds for any $r \ge 1$. With r = 1 it is the mean. With a large r it is hardly less than the
largest one, by a factor of $J^{-1/r}$ at most.
"""

import numpy as np
from jaxtyping import Float, Int

from .question import AbstractQuestion, Answer


class Average(AbstractQuestion):
    """The mean of what each model says."""

    each: tuple[AbstractQuestion, ...]
    names: tuple[str, ...]
    exponent: float
    """r."""

    def answer(self, power: Float[np.ndarray, " K"]) -> Answer:
        variances, sensitivities, criteria = map(
            np.array, zip(*(one.answer(power) for one in self.each), strict=True)
        )
        top = criteria.max()
        criterion = top * np.mean((criteria / top) ** self.exponent) ** (1 / self.exponent)
        share = (criteria / criterion) ** (self.exponent - 1) / len(criteria)
        return Answer(share @ variances / share.sum(), share @ sensitivities, float(criterion))

    def only(self, some: Int[np.ndarray, " k"]) -> "Average":
        return Average(tuple(one.only(some) for one in self.each), self.names, self.exponent)
