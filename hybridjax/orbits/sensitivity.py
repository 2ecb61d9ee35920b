"""The response of a cycle to a lasting change of a parameter: period, times of events, shape.

A parameter is an input of frequency 0. The change of the shape at equal phases is the infinitesimal
shape response curve, and the changes of the times between events are local timing responses (Y.
Wang, J. P. Gill, H. J. Chiel, P. J. Thomas, SIAM J. Appl. Dyn. Syst. 20, 2021).
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from .._core.boundary.checked import checked_methods
from .._core.compilation import at_ease
from .._core.executor import Array, is_traced, namespace, on_host, scan, to_host
from .._core.text import number
from ..engine import kernels
from ..errors import ComputationError
from ..systems.structure import Structure
from ..systems.transition import Scheduled
from ..systems.varied import Varied
from .crossing import AtEvent, ListLevels
from .linear_flow import LinearFlow, by_name, linear_flow, with_inputs
from .responses import Phases, loop
from .return_map import SINGULAR, ReturnMap, derivative_at_zero, with_derivatives


@checked_methods
class Sensitivity(eqx.Module):
    """Derivatives of a cycle by a parameter (see `LimitCycle.sensitivity`).

    **Fields:**

    - `parameter`: its name. `period`: derivative of the period.
    - `events`: names of the events of one period. `times` (E,), derivatives of their times, after
        phase 0; `durations` (E,), of the time from each to the next, the last to the first.
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
        """Derivatives of the states at equal phases, by name; NaN in charts that lack one."""
        chart, states = self.flow.at(phase, self.duration, self.change)
        return by_name(self.structure, chart, states)

    def __repr__(self):
        name = type(self.structure.system).__name__
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
    varied = Varied(cycle.system, parameter)
    flow = linear_flow(cycle, parameter=parameter)
    cycle = to_host(cycle) if on_host(flow.q) else cycle
    with at_ease():
        return _sensitivity(cycle, flow, varied)


def _sensitivity(cycle: Any, flow: LinearFlow, varied: Varied) -> Sensitivity:
    map, period, events = cycle.return_map, cycle.period, cycle.event_sequence
    s, xp, jumps, f0 = map.structure, namespace(flow.q), flow.jumps, flow.field[0, 0]
    clocked, due = map.base is None, _due(flow, events, varied)
    free, forced = flow.forward
    force = flow.by_input[..., 0] * flow.length[:, None, None]
    pushed = xp.einsum("piakb,pkb->pia", forced, force)
    kick = jumps.by_input[..., 0] + jumps.slip * due[:, None]
    driven = xp.einsum("pab,pb->pa", jumps.by_state, pushed[:, -1]) + kick
    through = jumps.by_state @ free[:, -1]
    advance = lambda x, piece: (piece[0] @ x + piece[1], x)  # noqa: E731
    total, _ = scan(advance, xp.zeros_like(f0), (through, driven))
    whole = flow.monodromy(free, map.valid)
    if clocked:
        longer = map.multiplicity * _derivative(varied, lambda x: x.period())
        closed = whole - xp.eye(len(f0))
        if on_host(whole) and np.linalg.svd(closed, compute_uv=False)[-1] < SINGULAR:
            raise ComputationError(
                "the cycle has a multiplier of 1, and no derivative by a parameter: follow its "
                "branch by `continuation`."
            )
    else:
        closed, along = loop(map, whole, f0)
        longer = -(xp.linalg.solve(closed.T, along) @ total)
    begin = xp.linalg.solve(closed, -(total + f0 * longer))
    _, starts = scan(advance, begin, (through, driven))
    change = xp.einsum("pkab,pb->pka", free, starts) + pushed
    late = xp.einsum("pa,pa->p", jumps.delay_by_state, change[:, -1])
    late = late + jumps.delay_by_input[:, 0] + due
    if not clocked:  # phase 0 stays on the section
        if isinstance(map.base, AtEvent):
            ahead = late[-1] - longer
        else:
            by_state, by_parameter = to_section(map, f0, parameter=varied.parameter)
            ahead = by_state @ begin + by_parameter
        change, late = change + ahead * flow.field, late - ahead
    change = change + flow.field * (flow.after(map) / period * longer)[..., None]
    place = xp.argsort(flow.event < 0, stable=True)[: len(events)]
    times = late[place]
    wrapped = xp.concatenate([times[1:], times[:1] + longer]) - times
    names = tuple(s.transitions[g].name for g in events)
    return Sensitivity(varied.parameter, longer, names, times, wrapped, s, flow, period, change)


def _derivative(varied: Varied, value):
    """The derivative of a number of the system by the parameter."""
    return derivative_at_zero(lambda k: jnp.asarray(value(varied.at(k)), float))


def _due(flow: LinearFlow, events: tuple[int, ...], varied: Varied) -> Float[Array, " P"]:
    """Changes of the times of scheduled events, at the ends of pieces."""
    xp, end = namespace(flow.q), flow.t[:, -1]
    out = xp.zeros_like(end)
    for g in sorted(set(events)):
        guard = list(varied.transitions())[g].guard
        if isinstance(guard, Scheduled):
            schedule = lambda x, g=g: list(x.transitions())[g].guard  # noqa: E731
            offset = _derivative(varied, lambda x, of=schedule: of(x).offset)
            every = _derivative(varied, lambda x, of=schedule: of(x).period)
            count = xp.round((end - guard.offset) / guard.period)
            out = xp.where(flow.event == g, offset + count * every, out)
    return out


def to_section(
    map: ReturnMap, f: Float[Array, " d"], parameter: str | None = None
) -> tuple[Float[Array, " d"], Array]:
    """The time by which a changed state at phase 0 comes later to the section, per change of the
    state and of the first input."""
    assert map.base is not None
    levels = ListLevels((map.base,))
    of, (t, chart, q, *_) = with_inputs(map.system, parameter), map.anchor
    level = lambda a, *at: kernels.linear(of, _level, a, *at, levels)  # noqa: E731
    by = with_derivatives(of, level, chart, t, q, 1)[0, 2 : 3 + len(f), 0]
    return by[:-1] / -(by[:-1] @ f), by[-1] / -(by[:-1] @ f)


def _level(a: int, s: Structure, levels: ListLevels, t, q, u):
    of = Structure(s.system.at(u[0])) if isinstance(s.system, Varied) else s
    return levels.level(of, a, jnp.zeros((), int), t, q)[None]
