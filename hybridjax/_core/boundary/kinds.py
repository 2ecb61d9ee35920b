"""The words with which public signatures say what they take, beside plain types and `Literal`.

Static type checkers see the plain type in each. What else is needed is written where it is needed:
`Annotated[float, Number("a number above 1", above=1)]`, `Annotated[Numbers, Reals("N d")]`.
"""

import os
from collections.abc import Mapping, Sequence
from typing import Annotated

from jax.typing import ArrayLike

from .. import limits
from ..arguments import Numbers
from .arrays import Reals
from .containers import Names
from .scalars import Number, Whole


# Whole numbers.
Count = Annotated[int, Whole(1, limits.COUNT)]
Index = Annotated[int, Whole(0, limits.COUNT)]
"""Also numbers that may be zero: samples to discard, lags of a lead."""
SectionCount = Annotated[int, Whole(1, limits.SECTIONS)]
PeriodCount = Annotated[int, Whole(1, limits.PERIODS)]
ExperimentCount = Annotated[int, Whole(1, limits.EXPERIMENTS)]
Order = Annotated[int, Whole(1, limits.ORDER)]
StepCount = Annotated[int, Whole(1, limits.STEPS)]
WorkerCount = Annotated[int, Whole(1, limits.WORKERS)]
Seed = Annotated[int, Whole(0)]

# Real numbers that have to be known. (`float` alone: any finite one.)
Positive = Annotated[float, Number("a positive number", above=0)]
NonNegative = Annotated[float, Number("a number that is not negative", low=0)]
Probability = Annotated[float, Number("a number between 0 and 1", above=0, below=1)]
Share = Annotated[float, Number("a number above 0, at most 1", above=0, high=1)]
Fraction = Annotated[float, Number("a number from 0 to 1", low=0, high=1)]

# The same, where one has an array of JAX at hand as often as a `float`.
Duration = Annotated[ArrayLike, Number("a positive number", above=0)]
Wait = Annotated[ArrayLike, Number("a number that is not negative", low=0)]

# Numbers that JAX may trace.
Scalar = Annotated[ArrayLike, Reals("")]
PositiveScalar = Annotated[ArrayLike, Reals("", sign="positive")]
NonNegativeScalar = Annotated[ArrayLike, Reals("", sign="nonnegative")]
Vector = Annotated[Numbers, Reals("n")]

# Words.
SignalNames = Annotated[str | Sequence[str], Names()]
"""One name, or several distinct ones; handed on as a tuple."""
OptionalNames = Annotated[str | Sequence[str], Names(empty=True)]
"""The same, or none: `()`."""
NewOptionalNames = Annotated[str | Sequence[str] | Mapping[str, str], Names(units=True, empty=True)]
NewNames = Annotated[str | Sequence[str] | Mapping[str, str], Names(units=True)]
"""Names that are given to something; or units by name, as in `{"yM": "m", "force": "N"}`."""
Path = str | os.PathLike[str]
