"""The first step of a piece of flow."""

from ..._core.executor import namespace
from ...systems.structure import Structure
from ..arrays import Inputs, Times
from ..lanes import Lanes, for_each_chart, only
from ..settings import Settings, size
from ..watch import chart_field
from .state import Stride


# The first step, as a part of the time in which the state changes by its size (for errors of 1e-2;
# the default method has order 7), and at most as a part of the time allowed. Higher: first steps
# are rejected. Lower: steps are taken until they have grown.
_FIRST_STEP, _FIRST_STEP_OF_SPAN = 0.1, 0.01
# Where sizes of states are not known, a state that begins near zero changes by its own size at
# once: the first step is no shorter than this part of the time allowed. Higher: stiff systems
# reject it. Lower: more steps until they have grown.
_SHORTEST = 1e-6


def stride(h: Times) -> Stride:
    """First steps h, without further knowledge of the way."""
    xp = namespace(h)
    return Stride(h, xp.zeros_like(h), xp.ones_like(h))


def initial_step(s: Structure, lanes: Lanes, u: Inputs, span: Times, settings: Settings) -> Times:
    """A cautious first step: a part of the time in which the state changes by its size."""

    def work(a, here, out):
        q = only(here, lanes.q[: s.dims[a]])
        f = chart_field(s, a, only(here, u))(only(here, lanes.t), q)
        scaled = settings.scale is not None
        rates = xp.abs(f) / (size(settings, a, q) if scaled else xp.abs(q))
        rate = xp.max(xp.where(xp.isfinite(rates), rates, 0.0), axis=0, initial=0.0)
        time = xp.where(rate > 0, 1 / rate, xp.inf)
        part = _FIRST_STEP * (rtol / 1e-2) ** (1 / 7)
        first = xp.minimum(part * time, _FIRST_STEP_OF_SPAN * span)
        first = first if scaled else xp.maximum(first, _SHORTEST * span)
        return xp.where(here, first, out)

    assert settings.rtol is not None
    xp, rtol = namespace(lanes.t), settings.rtol
    everywhere = xp.ones(lanes.t.shape[0], bool)
    return for_each_chart(s, lanes.chart, everywhere, work, _FIRST_STEP_OF_SPAN * span)
