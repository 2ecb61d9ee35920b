"""Names for the types of arrays in `engine`. The last axis has one entry for each of L lanes (a
lane is one trajectory of many that are computed side by side).

These names stand in annotations only. Such an array may be one of NumPy or one of JAX.
"""

from typing import TYPE_CHECKING, Any

from jaxtyping import Bool, Float, Int

from .._core import executor


if TYPE_CHECKING:
    Array = Any  # no type says "an array of NumPy or of JAX" together with the methods of both
else:
    Array = executor.Array


Times = Float[Array, " L"]
"""One number for each lane: times, durations, errors."""
States = Float[Array, "n L"]
"""States of one chart."""
Padded = Float[Array, "d L"]
"""States of any chart, padded with zeros to the largest dimension d."""
Inputs = Float[Array, "nu L"]
Mask = Bool[Array, " L"]
Index = Int[Array, " L"]
"""A chart, a transition, a result code or a number of events for each lane."""
# Types of arrays whose last axis may also have a single entry, which then holds for all lanes.
AnyTimes = Float[Array, " #L"]
AnyInputs = Float[Array, "nu #L"]
