"""How lanes set out on a piece of flow."""

from typing import NamedTuple

from jaxtyping import Float

from ..._core.executor import Array, namespace
from ...systems.structure import Structure
from ..lanes import Lanes, for_each_chart, only
from ..settings import Settings, size
from ..watch import chart_field


# The first step, as a part of the time in which the state changes by its size (for errors of
# _FIRST_RTOL; the method has order 7), and at most as a part of the time allowed. Twice as much: a
# few more first steps are too long and taken again; half: one more step until they have grown.
_FIRST_STEP, _FIRST_RTOL, _FIRST_STEP_OF_SPAN = 0.1, 1e-2, 0.01
# Where sizes of states are not known, a state that happens to begin near zero changes by its own at
# once: the first step is no shorter than this part of the time allowed. Twice as much: stiff
# systems try a first step more; half: hardly a difference.
_SHORTEST = 1e-6


class Stride(NamedTuple):
    """How lanes set out: what is known beforehand about their way."""

    h: Float[Array, " L"]
    """The first step."""
    lead: Float[Array, " L"]
    """Expected time to the target's level as a multiple of Newton's guess at the start; 0 if it is
    not known."""
    slack: Float[Array, " L"]
    """A step's error estimate may be this many times the tolerance."""


def stride(h: Float[Array, " L"]) -> Stride:
    """Set out with steps h, and no further knowledge."""
    xp = namespace(h)
    return Stride(h, xp.zeros_like(h), xp.ones_like(h))


def initial_step(
    s: Structure,
    lanes: Lanes,
    u: Float[Array, "nu L"],
    span: Float[Array, " L"],
    settings: Settings,
) -> Float[Array, " L"]:
    """A cautious first step: a part of the time in which the state changes by its size."""

    def work(a, here, out):
        q = only(here, lanes.q[: s.dims[a]])
        f = chart_field(s, a, only(here, u))(only(here, lanes.t), q)
        known = settings.scale is not None
        rates = xp.abs(f) / (size(settings, a, q) if known else xp.abs(q))
        rate = xp.max(xp.where(xp.isfinite(rates), rates, 0.0), axis=0, initial=0.0)
        time = xp.where(rate > 0, 1 / rate, xp.inf)
        part = _FIRST_STEP * (settings.rtol / _FIRST_RTOL) ** (1 / 7)
        first = xp.minimum(part * time, _FIRST_STEP_OF_SPAN * span)
        first = first if known else xp.maximum(first, _SHORTEST * span)
        return xp.where(here, first, out)

    xp = namespace(lanes.t)
    everywhere = xp.ones(lanes.t.shape[0], bool)
    return for_each_chart(s, lanes.chart, everywhere, work, _FIRST_STEP_OF_SPAN * span)
