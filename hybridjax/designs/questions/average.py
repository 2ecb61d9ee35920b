"""A question about several models."""

import numpy as np
from jaxtyping import Float, Int

from .question import AbstractQuestion, Answer


class Average(AbstractQuestion):
    """Where any of the models may be true: the mean of what each says."""

    each: tuple[AbstractQuestion, ...]
    names: tuple[str, ...]

    def answer(self, power: Float[np.ndarray, " K"]) -> Answer:
        answers = [one.answer(power) for one in self.each]
        variances, sensitivity, criterion = zip(*answers, strict=True)
        return Answer(
            np.mean(variances, axis=0), np.mean(sensitivity, axis=0), float(np.mean(criterion))
        )

    def only(self, some: Int[np.ndarray, " k"]) -> "Average":
        return Average(tuple(one.only(some) for one in self.each), self.names)
