"""What moves, and where it begins, as users give it: a system or its field, a state or a guess.

`hj.simulate`, `hj.flow` and `hj.find_limit_cycle` call `system_of`, and `guess_of` for a given
start; `own_guess` has that of the model. A further form of a system or a start is a word in
`SystemLike` or `StateLike`, and a case in one of these functions. A state that knows its time must
begin there: at time 0 it would leave the cycle of a system with a clock.

If a function is refused as a field, look at `_is_field` and `_require_arguments`; if a state is
taken for one of another chart, at `_fits` and `guess_of`.
"""

from collections.abc import Callable, Mapping
from typing import Annotated, Any, TypeAlias

import jax
import numpy as np

from .._core.boundary.kinds import Numbers, Scalar
from .._core.boundary.values import Plain, Reals
from ..errors import DefinitionError
from .structure import ByName, Structure
from .system import Guess, HybridSystem, name_of, taken_by_position


def _is_field(value: Any) -> bool:
    """Test whether a value is a function of the user: no class, and nothing of this package."""
    of_package = type(value).__module__.partition(".")[0] == __name__.partition(".")[0]
    return callable(value) and not isinstance(value, type) and not of_package


SystemLike: TypeAlias = (
    HybridSystem | Annotated[Callable[..., Any], Plain("a function", _is_field)]
)
"""A system, or the field of one that has a single chart and no events."""

StateLike: TypeAlias = Mapping[str, Scalar] | Annotated[Numbers, Reals("n")]
"""The states of a chart: by name, or in order."""


def system_of(system: SystemLike, start: Any) -> HybridSystem:
    """Return a system: of a field (t, q) that of one chart, with the states `x0`, `x1`, ..., or `x`
    for a single one.

    **Raises:** `DefinitionError` for a field without a start, with states by name, or with other
    arguments.
    """
    if isinstance(system, HybridSystem):
        return system
    made = "`hj.HybridSystem.from_functions(('x', 'v'), field)`"
    if isinstance(start, Mapping):
        # (JAX sorts the names of a dictionary that it maps: their order has no meaning.)
        raise DefinitionError(
            f"a field takes its states in order: give numbers, (2.0, 0.0), or name them by {made}."
        )
    state = start.state if isinstance(start, Guess) else start
    if np.ndim(state) == 0:
        raise DefinitionError(
            "a function is the field of a system, and needs a state to begin with: give its "
            f"numbers, (2.0, 0.0), or make the system by {made}."
        )
    _require_arguments(system, made)
    n = np.shape(state)[-1]
    names = ("x",) if n == 1 else tuple(f"x{i}" for i in range(n))
    return HybridSystem.from_functions(names, system)


def _require_arguments(field: Callable, made: str) -> None:
    """**Raises:** `DefinitionError` for a field of other arguments than the time and the state."""
    names = taken_by_position(field)
    if names is None:
        return
    if len(names) > 2:
        raise DefinitionError(
            f"a field has the arguments (t, q), and not ({', '.join(names)}): inputs and "
            f"parameters are those of a system: {made}."
        )
    if len(names) == 2 and names[1] in ("t", "time"):
        raise DefinitionError(
            f"a field has the arguments (t, q), the time first, and not ({', '.join(names)})."
        )


def guess_of(
    s: Structure, state: StateLike, called: str, time: Any | None = None
) -> Guess:
    """Return the guess that a state means: in the only chart whose states these are; of a state
    that knows its chart and its time, there and then.

    **Arguments:** `called`: how sentences begin, as "`start`". `time`: Default: that of the state,
    or 0.

    **Raises:** `DefinitionError` if the states fit no chart, or several.
    """
    fitting = [a for a in range(len(s.charts)) if _fits(s, a, state)]
    known = state.as_guess() if isinstance(state, ByName) else None
    # (A system with other charts may have such states, too.)
    if known is not None and known.chart in s.names:
        time = known.time if time is None else time
        fitting = [a for a in fitting if s.names[a] == known.chart] or fitting
    time = 0.0 if time is None else time
    if len(fitting) == 1:
        (a,) = fitting
        values: Any = state
        if isinstance(state, Mapping):
            values = tuple(state[name] for name in s.charts[a].states)
        return Guess(s.names[a], values, time)
    if fitting:
        names = " and ".join(f"'{s.names[a]}'" for a in fitting)
        raise DefinitionError(
            f"the charts {names} have such states: say in which one {called} is, as "
            f"`hj.Guess('{s.names[fitting[0]]}', state)`."
        )
    raise DefinitionError(_no_such_states(s, state, called))


def _no_such_states(s: Structure, state: StateLike, called: str) -> str:
    charts = "; ".join(
        f"'{name}' has {', '.join(chart.states)}"
        for name, chart in zip(s.names, s.charts, strict=True)
    )
    by_name = isinstance(state, Mapping)
    given = f"the states {', '.join(state)}" if by_name else f"{len(state)} numbers"
    return f"{called} has {given}, which are the states of no chart: {charts}."


def own_guess(system: HybridSystem) -> Guess:
    """The guess of the model.

    **Raises:** `DefinitionError` if it has none.
    """

    def of_host(x):
        # (JAX would compile each operation on numbers of its own.)
        return np.asarray(x) if isinstance(x, jax.Array) and not x.ndim else x

    guess = jax.tree_util.tree_map(of_host, system).guess()
    if guess is None:
        raise DefinitionError(
            f"{name_of(system)} has no guess: pass `Guess(chart, state)`."
        )
    return guess


def _fits(s: Structure, a: int, state: StateLike) -> bool:
    """Test whether a state has the names, or else the number, of the states of chart a."""
    states = s.charts[a].states
    if isinstance(state, Mapping):
        return set(state) == set(map(str, states))
    return len(state) == len(states)
