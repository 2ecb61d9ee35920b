"""Types of arrays that have one entry for each of L lanes on their last axis.

Each may be an array of either executor, which share the array API.
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
# One entry for all lanes will do for these.
AnyTimes = Float[Array, " #L"]
AnyInputs = Float[Array, "nu #L"]
