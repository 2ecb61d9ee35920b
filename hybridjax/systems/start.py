"""Where a flow or a search begins, as users give it."""

from collections.abc import Mapping
from typing import Annotated, Any, TypeAlias

import jax
import numpy as np

from .._core.boundary.kinds import Numbers, Scalar
from .._core.boundary.values import Reals
from ..errors import DefinitionError
from .structure import Structure
from .system import Guess, HybridSystem


StateLike: TypeAlias = Mapping[str, Scalar] | Annotated[Numbers, Reals("n")]
"""The states of a chart: by name, or in order."""


def guess_of(s: Structure, state: StateLike, called: str, time: Any = 0.0) -> Guess:
    """Return the guess that a state means: in the only chart whose states these are.

    **Arguments:** `called`: how sentences begin, as "`start`".

    **Raises:** `DefinitionError` if the states fit no chart, or several.
    """
    fitting = [a for a in range(len(s.charts)) if _fits(s, a, state)]
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
    charts = "; ".join(
        f"'{name}' has {', '.join(chart.states)}"
        for name, chart in zip(s.names, s.charts, strict=True)
    )
    by_name = isinstance(state, Mapping)
    given = f"the states {', '.join(state)}" if by_name else f"{len(state)} numbers"
    raise DefinitionError(
        f"{called} has {given}, which are the states of no chart: {charts}."
    )


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
            f"{type(system).__name__} has no guess: pass `Guess(chart, state)`."
        )
    return guess


def _fits(s: Structure, a: int, state: StateLike) -> bool:
    states = s.charts[a].states
    if isinstance(state, Mapping):
        return set(state) == set(map(str, states))
    return len(state) == len(states)
