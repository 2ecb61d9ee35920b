"""Residuals and their Jacobian beside a known cycle, as one program that nothing is searched in.

The cycle follows the route of the known one (`orbits/near.py`), and its sections the walk of the
known ones (`sections/walk.py`). Cycles that leave either have a result code.
"""

import collections
import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from .._core.compilation import identity, whole
from .._core.executor import on_the_cpu
from .._core.memo import Recent
from .._core.results import Result
from ..engine.arrays import Array
from ..orbits.cycle import LimitCycle
from ..orbits.find import find_limit_cycle
from ..orbits.near import first_order_cycle, route_near, with_numbers
from ..orbits.repeat import Route, on_device
from ..sections.families import AbstractSections
from ..sections.walk import Walk, walk_of, walk_with
from ..systems.system import HybridSystem
from .observations import ObservedHTF, ObservedSeries
from .problem import FitProblem, evaluate


# Evaluations of problems of a class after which they are compiled: compilation takes as long as so
# many. Fewer: a program is compiled that few evaluations use. More: many fits, as of a bootstrap,
# stay slow for longer.
WORTH_COMPILING = 24
# Directions that forward mode takes. More: a model with more free parameters needs no search, but
# the memory of programs grows with their number.
_MOST_DIRECTIONS = 64

# Known cycles of a fit. Fewer: fits whose events pass sections search anew each time. More: each
# evaluation that leaves the first takes longer.
_MOST_KNOWN = 4

_evaluations: collections.Counter = collections.Counter()
_shared = Recent(8)
"""Known cycles, with what is repeated beside them, by the cycle from which fits begin and the
families of sections."""


class Beside(NamedTuple):
    """A known cycle, and what cycles beside it repeat."""

    known: LimitCycle
    route: Route
    walks: tuple[Walk, ...]
    """To the sections of each family in the observations."""


Known = tuple[LimitCycle, Beside]
"""A known cycle as it was found, and what is repeated, as arrays of JAX."""


class Model:
    """Residuals and their Jacobian, by a program beside known cycles.

    Where the routes of all known cycles are left, the search finds the cycle, which becomes one
    more of these; the program stays the same. Fits that begin from the same cycle share them.
    """

    def __init__(self, problem: FitProblem, system: HybridSystem, known: LimitCycle):
        """**Arguments:** `system`: that of the fit. Numbers that are not free are its own, also
        where those of a known cycle differ."""
        self._problem, self._system, self._known = problem, system, known
        self._on_device = on_device((problem, system))
        self._class = identity((on_device(known.return_map), self._on_device))
        self._can_repeat = _can_repeat(problem)
        families = _families(problem.observations)
        shared: list[Known] | None = _shared.get(known, *families)
        self._shared = _shared.keep([], known, *families) if shared is None else shared
        # (Other threads may add to the shared ones.)
        self._besides = list(self._shared)

    def __call__(
        self, problem: FitProblem, x: np.ndarray, guess: LimitCycle
    ) -> tuple[Float[np.ndarray, " r"], Float[np.ndarray, "r p"], LimitCycle]:
        """As `evaluate`."""
        _evaluations[self._class] += 1
        found = self._evaluated(x, guess)
        if found is None:
            found = self._with_another(x, guess)
        if found is None:
            return evaluate(problem, x, guess)
        near = dataclasses.replace(guess, anchor=found.anchor, period=found.period)
        return found.residuals, found.jacobian, near

    @property
    def known(self) -> LimitCycle | None:
        """The cycle whose route the program has followed; None without a program."""
        return self._besides[0][0] if self._has_program and self._besides else None

    def is_beside(self, x: np.ndarray, guess: LimitCycle) -> bool:
        """Test whether the cycle with the parameters at x is found without a search."""
        return self._evaluated(x, guess) is not None

    @property
    def _has_program(self) -> bool:
        """Whether a program is worth its compilation, and its flags would tell all."""
        return self._can_repeat and _evaluations[self._class] > WORTH_COMPILING

    def _with_another(self, x: np.ndarray, guess: LimitCycle) -> "Evaluated | None":
        """The model by one known cycle more: the first, or one that a search finds at x."""
        if not self._has_program:
            return None
        cycle = self._cycle_at(x, guess) if self._besides else self._known
        if int(cycle.result) != Result.OK:
            return None
        beside = _beside(self._problem, cycle)
        if beside is None:
            return None
        known = cycle, on_device(beside)
        self._besides = [known, *self._besides[: _MOST_KNOWN - 1]]
        self._shared[:] = self._besides
        return self._evaluated(x, cycle)

    def _cycle_at(self, x: np.ndarray, guess: LimitCycle) -> LimitCycle:
        """The cycle with the parameters at x, converged or not, by a search."""
        parameters = self._problem.parameters
        values = parameters.decode(jnp.asarray(x))
        system = parameters.insert(self._system, values)
        return find_limit_cycle(system, guess, throw=False)

    def _evaluated(self, x: np.ndarray, guess: LimitCycle) -> "Evaluated | None":
        """The model by a known cycle, which becomes the first to be tried; None if it leaves the
        routes of all, or without a program."""
        if not self._has_program:
            return None
        problem, system = self._on_device
        q = np.asarray(guess.anchor.q)[:, 0]
        for known in self._besides:
            found = _run(problem, system, known[1], np.asarray(x), q)
            if int(found.result) == Result.OK and np.isfinite(found.residuals).all():
                others = [other for other in self._besides if other is not known]
                self._besides = [known, *others]
                return found
        return None


class Evaluated(NamedTuple):
    """A model at one point of the parameters."""

    residuals: Float[Array, " r"]
    jacobian: Float[Array, "r p"]
    anchor: Any
    period: Float[Array, ""]
    result: Int[Array, ""]


def _can_repeat(problem: FitProblem) -> bool:
    """Test whether the observations need no search, and forward mode can take all directions."""
    for observation in problem.observations:
        if isinstance(observation, ObservedSeries):
            return False
        if isinstance(observation, ObservedHTF) and observation.delay is not None:
            return False
    return len(problem.parameters.names) <= _MOST_DIRECTIONS


def _beside(problem: FitProblem, known: LimitCycle) -> Beside | None:
    """What a fit repeats; None where its flags would not tell all."""
    route = route_near(known)
    if route is None:
        return None
    walks = [walk_of(known, family) for family in _families(problem.observations)]
    if any(walk is None for walk in walks):
        return None
    walks = (dataclasses.replace(w, forwards=True) for w in walks if w is not None)
    return Beside(known, with_numbers(route), tuple(walks))


def _families(observations: Any) -> list[AbstractSections]:
    is_family = lambda x: isinstance(x, AbstractSections)  # noqa: E731
    leaves = jax.tree_util.tree_leaves(observations, is_leaf=is_family)
    return [x for x in leaves if is_family(x)]


def _run(
    problem: FitProblem,
    system: HybridSystem,
    beside: Beside,
    x: np.ndarray,
    q: np.ndarray,
) -> Evaluated:
    """Residuals and Jacobian at coordinates x, from a state q near the cycle's beginning."""
    with on_the_cpu():
        program = whole(_evaluated, (), (problem, system, beside), loops=True)
        return program(x, q)


def _evaluated(
    problem: FitProblem, system: HybridSystem, beside: Beside, x: Array, q: Array
) -> Evaluated:
    def at(x):
        cycle, observations = _model(problem, system, beside, x, q)
        parts = [observation.residuals(cycle) for observation in observations]
        r = jnp.concatenate(parts)
        well = (cycle.result == Result.OK) & jnp.isfinite(r).all()
        return jnp.where(well, r, jnp.inf), (cycle.anchor, cycle.period, cycle.result)

    def push(direction):
        return jax.jvp(at, (x,), (direction,), has_aux=True)

    directions = jnp.eye(x.shape[0])
    r, J, rest = jax.vmap(push, out_axes=(None, -1, None))(directions)
    return Evaluated(r, J, *rest)


def _model(
    problem: FitProblem, system: HybridSystem, beside: Beside, x: Array, q: Array
):
    """The cycle of a system with parameters at x, and the observations of it."""
    known, route, walks = beside
    values = problem.parameters.decode(x)
    changed = problem.parameters.insert(system, values)
    cycle = first_order_cycle(route, known.return_map.at_phase_of(changed), q)
    cycle = dataclasses.replace(
        cycle,
        pieces=cycle.pieces._replace(q=jnp.full_like(cycle.pieces.q, jnp.nan)),
        factors=jnp.full_like(cycle.factors, jnp.nan),
    )
    observations = problem.parameters.observed(problem.observations, values)
    for family, walk in zip(_families(observations), walks, strict=True):
        walk_with(cycle, family, walk)
    return cycle, observations
