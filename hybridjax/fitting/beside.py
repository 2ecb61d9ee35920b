"""Residuals of a fit and their Jacobian near a known limit cycle, as one compiled program without a
search.

`fit.py` makes a `Model` and calls it at each point of the parameters. The cycle at this point
follows the *route* of a known cycle, that is, its recorded sequence of steps and events
(`orbits/near.py`); its sections follow the *walk* of the known sections (`sections/walk.py`). If
the cycle leaves all known routes, a search finds it, and it becomes one more known cycle.

If residuals differ from those of a search, look at `_model`; if a Jacobian does, look at
`first_order_cycle`, which has first derivatives in forward mode alone, and at `walk_with`. If a fit
stays slow, `_can_repeat` and `_beside` say why it has no program: a further type of data whose
residuals need a search is named in `_can_repeat`. Walks must stay in the order of `_families`.
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


# Number of evaluations for one class of problems after which the program is compiled. (Compilation
# takes about as long as these.) Fewer: programs are compiled for few evaluations. More: many fits,
# as in a bootstrap, stay slow for longer.
WORTH_COMPILING = 24
# Largest number of directions of forward mode. More: models with more free parameters can use
# programs, whose memory grows with this number.
_MOST_DIRECTIONS = 64

# Largest number of known cycles of a fit. Fewer: fits in which events move across sections search
# each time. More: evaluations that leave the first route take longer.
_MOST_KNOWN = 4

_evaluations: collections.Counter = collections.Counter()
_shared = Recent(8)
"""Known cycles with their routes and walks, by the cycle from which fits begin and the families of
sections."""


class Beside(NamedTuple):
    """The route and the walks of a known cycle, which cycles near it follow."""

    known: LimitCycle
    route: Route
    walks: tuple[Walk, ...]
    """Walks to the sections of each family in the observations."""


Known = tuple[LimitCycle, Beside]
"""A known cycle as it was found, and what is repeated, as arrays of JAX."""


class Model:
    """Residuals and their Jacobian, by a program that follows known cycles.

    If the routes of all known cycles are left, a search finds the cycle, which becomes a further
    known cycle. The program does not change. Fits that begin from the same cycle share their known
    cycles.
    """

    def __init__(self, problem: FitProblem, system: HybridSystem, known: LimitCycle):
        """**Arguments:** `system`: system of the fit. Parameters that are not free have its values,
        even if those of a known cycle differ."""
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
        """Whether a program is worth its compilation, and would notice every cycle that leaves its
        route (see `has_route`)."""
        return self._can_repeat and _evaluations[self._class] > WORTH_COMPILING

    def _with_another(self, x: np.ndarray, guess: LimitCycle) -> "Evaluated | None":
        """The model at x by a further known cycle: the first one, or the cycle that a search finds
        at x."""
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
        """The model at x by a known cycle, which will be tried first the next time. None if all
        routes are left, or without a program."""
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
    """Route and walks of a known cycle; None if a cycle could leave them unnoticed."""
    route = route_near(known)
    if route is None:
        return None
    walks = [walk_of(known, family) for family in _families(problem.observations)]
    if any(walk is None for walk in walks):
        return None
    walks = (dataclasses.replace(w, forwards=True) for w in walks if w is not None)
    return Beside(known, with_numbers(route), tuple(walks))


def _families(observations: Any) -> list[AbstractSections]:
    """The families of sections in the observations, in the order of the leaves of their tree."""

    def is_family(x):
        return isinstance(x, AbstractSections)

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
    """The program that `_run` calls (`Model._evaluated` chooses the known cycle). Residuals are
    infinite if no cycle was found on the route."""

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
