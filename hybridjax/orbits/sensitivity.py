"""The response of a cycle to a lasting change of a parameter: period, times of events, shape.

A parameter is an input of frequency 0. The change of the shape at equal phases is the infinitesimal
shape response curve, and the changes of the times between events are local timing responses (Y.
Wang, J. P. Gill, H. J. Chiel, P. J. Thomas, SIAM J. Appl. Dyn. Syst. 20, 2021).

`LimitCycle.sensitivity` calls `sensitivity`. `_sensitivity` drives the linear flow of the cycle
(`linear_flow.py`) with a constant input, and closes it over one period (`responses.closing`). Phase
0 must stay on the section of the cycle, or at the anchor's phase of the clock: times and shapes are
relative to it.

If the derivative of the period is wrong, look at `closing`, and with a clock at
`by_parameter_of_period`. If only those of times of events are, look at the delays of
`LinearFlow.driven`; if they are all off by the same number, at `section_delay`.
"""

from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Float

from .._core.boundary.checked import checked_methods
from .._core.compilation import at_ease, one_program
from .._core.executor import Array, is_traced, namespace, on_host, svdvals
from .._core.meaning import require_as_made
from .._core.showable import Showable
from .._core.text import number
from ..engine import kernels
from ..errors import ComputationError
from ..systems.quotient import check_symmetry
from ..systems.structure import Structure
from ..systems.system import name_of
from ..systems.varied import Varied
from .crossing import AtEvent, ListLevels
from .linear_flow import LinearFlow, Phases, by_name, linear_flow, with_inputs
from .responses import closing
from .return_map import SINGULAR, ReturnMap, with_derivatives
from .scale import in_sizes


@checked_methods
class Sensitivity(Showable, eqx.Module):
    """Derivatives of a cycle by a parameter (see `LimitCycle.sensitivity`).

    **Fields:**

    - `parameter`: its name. `period`: derivative of the period.
    - `events`: names of the events of one period, from phase 0 on. `times` (E,): derivatives of
      their times. (Times are those of the clock, or count from phase 0 if there is no clock.)
      `durations` (E,): derivatives of the time from each event to the next, and from the last to
      the first.
    """

    parameter: str = eqx.field(static=True)
    period: Float[Array, ""]
    events: tuple[str, ...] = eqx.field(static=True)
    times: Float[Array, " E"]
    durations: Float[Array, " E"]
    structure: Structure
    flow: LinearFlow
    duration: Float[Array, ""]
    """The period itself."""
    change: Float[Array, "P K d"]

    def shape(self, phase: Phases) -> dict[str, Float[Array, " p"]]:
        """Derivatives of the states at equal phases, by name; NaN in charts that lack the state."""
        require_as_made(self.structure.system, "these derivatives were computed")
        chart, states = self.flow.at(phase, self.duration, self.change)
        return by_name(self.structure, chart, states)

    def __repr__(self):
        name = name_of(self.structure.system)
        if is_traced(self):
            return f"Sensitivity({name} to {self.parameter}, traced)"
        after = [*self.events[1:], *self.events[:1]]
        rows = [
            f"\n  {a} to {b}  {number(x, 9)}"
            for a, b, x in zip(self.events, after, self.durations, strict=True)
        ]
        head = f"Sensitivity({name} to {self.parameter}: derivative of the period "
        return head + f"{number(self.period, 9)})" + "".join(rows)


def sensitivity(cycle: Any, parameter: str) -> Sensitivity:
    """Derivatives of a cycle by a parameter (see `LimitCycle.sensitivity`)."""
    check_symmetry(cycle.system, cycle.structure.sizes(cycle.settings.scale), parameter)
    flow = linear_flow(cycle, parameter=parameter)
    with at_ease():
        return _sensitivity(cycle, flow, Varied(cycle.system, parameter))


@one_program
def _sensitivity(cycle: Any, flow: LinearFlow, varied: Varied) -> Sensitivity:
    """The derivatives, from the linear flow with the parameter as its input."""
    map = cycle.return_map
    period = cycle.period
    events = cycle.event_sequence
    s = map.structure
    xp = namespace(flow.q)
    f0 = flow.field[0, 0]
    clocked = map.base is None
    # The parameter is an input of frequency 0; the other columns are those of the state at phase 0.
    constant = xp.ones((*flow.t.shape, 1))
    starts, late, total = (x[..., 0] for x in flow.driven(constant))
    # The derivative of the period: by the phase response Z, or that of the clock.
    both = map.valid[:, None] & map.valid
    whole = xp.where(both, total[:, 1:], 0.0)
    closed, Z = closing(map, whole, f0)
    longer = -(Z @ total[:, 0])
    if clocked:
        longer = map.multiplicity * kernels.by_parameter_of_period(varied)
        if on_host(whole) and svdvals(in_sizes(closed, map.sizes))[-1] < SINGULAR:
            raise ComputationError(
                "the cycle has a multiplier of 1, and no derivative by a parameter: follow its "
                "branch by `continuation`."
            )
    # The change of the state at phase 0 with which the turn closes; from there, the changes at the
    # nodes, and of the times of events.
    change_of_end = total[:, 0] + f0 * longer
    begin = xp.linalg.solve(closed, -change_of_end)
    starts = starts[..., 0] + starts[..., 1:] @ begin
    late = late[:, 0] + late[:, 1:] @ begin
    change = xp.einsum("pkab,pb->pka", flow.forward[0], starts)
    change = change + xp.sum(flow.pushed[..., 0, :], axis=-1)
    if not clocked:  # phase 0 stays on the section
        if isinstance(map.base, AtEvent):
            ahead = late[-1] - longer
        else:
            by_state, by_parameter = section_delay(map, f0, parameter=varied.parameter)
            ahead = by_state @ begin + by_parameter
        change = change + ahead * flow.field
        late = late - ahead
    # Changes at equal phases, in place of equal times.
    part = flow.after(map) / period * longer
    change = change + flow.field * part[..., None]
    # Pieces that end in events: these are as many as there are events.
    place = xp.argsort(flow.event < 0, stable=True)[: len(events)]
    times = late[place]
    next_times = xp.concatenate([times[1:], times[:1] + longer])
    wrapped = next_times - times
    names = tuple(s.transitions[g].name for g in events)
    return Sensitivity(
        varied.parameter, longer, names, times, wrapped, s, flow, period, change
    )


def section_delay(
    map: ReturnMap, f: Float[Array, " d"], parameter: str | None = None
) -> tuple[Float[Array, " d"], Array]:
    """Derivatives of the time of arrival at the section, by the state at phase 0 and by the first
    input."""
    assert map.base is not None
    levels = ListLevels((map.base,))
    index = np.zeros(1, np.int32)
    of = with_inputs(map.system, parameter)
    t, chart, q, *_ = map.anchor

    def level(a, t, q, u):
        return kernels.watched(of, a, levels, t, q, u, index)[-1:]

    derivatives = with_derivatives(of, level, chart, t, q, 1)
    by = derivatives[0, 2 : 3 + len(f), 0]
    by_state = by[:-1]
    rate = -(by_state @ f)
    return by_state / rate, by[-1] / rate
