"""Fits from several guesses of the parameters, one after the other or as pieces of work."""

import dataclasses
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from .._core.pieces.description import array_digest, digest_of, versions
from .._core.pieces.run import DaskClient, fill
from .._core.pieces.store import Blocks, Layout, Variable
from .._core.results import Result
from ..engine.describe import describe
from ..orbits.cycle import LimitCycle, rough
from ..orbits.find import find_limit_cycle
from ..systems.system import HybridSystem
from .observations import AbstractObservation
from .problem import FitProblem, levenberg_marquardt


class Tried(NamedTuple):
    """What became of S guesses."""

    fitted: Float[np.ndarray, "S p"]
    """Coordinates to which they led."""
    cost: Float[np.ndarray, " S"]
    """There; infinite where there is no limit cycle, or nothing to be observed on it."""
    residuals: Int[np.ndarray, " S"]
    """How many residuals there are."""
    steps: Int[np.ndarray, " S"]
    result: Int[np.ndarray, " S"]


@dataclasses.dataclass(frozen=True)
class Guesses:
    """**Fields:** `problem`; `given`, its observations as they came; `system`, whose parameters are
    replaced; `near`, a limit cycle to look around; coordinates `x` of each guess; `max_steps` from
    each."""

    problem: FitProblem
    given: tuple[AbstractObservation, ...]
    system: HybridSystem
    near: LimitCycle
    x: Float[np.ndarray, "S p"]
    max_steps: int

    def run(self, k: int, workers: int | None) -> dict[str, np.ndarray]:
        """The fit from guess k."""
        x = self.x[k]
        cycle = self.cycle(x, self.near)
        cost, count, steps, result = np.inf, 0, 0, int(cycle.result)
        if result == Result.OK:
            end = levenberg_marquardt(self.problem, jnp.asarray(x), cycle, self.max_steps)
            r, steps = np.asarray(end.residuals), int(end.steps)
            count = len(r)
            result = int(Result.NOT_CONVERGED)
            if np.isfinite(r).all():  # (else there is a cycle, but not what was observed on it)
                x, cost = np.asarray(end.x), float(r @ r)
                result = int(Result.OK) if end.converged else result
        found = zip(Tried._fields, (x, cost, count, steps, result), strict=True)
        return {name: np.asarray(value)[None] for name, value in found}

    def cycle(self, x: Float[np.ndarray, " p"], near: LimitCycle) -> LimitCycle:
        """That of the system with the parameters at x, found or not."""
        p = self.problem.parameters
        system = p.insert(self.system, p.decode(jnp.asarray(x)))
        return find_limit_cycle(system, near, throw=False)

    def all(self, store: Any, client: Any) -> Tried:
        """Return the results of all guesses, by workers or in a store; see `fit_model`."""
        data = fill(self, store, client).dataset()
        return Tried(*(data[name].values for name in Tried._fields))

    def begin(self, client: DaskClient | None) -> tuple["Guesses", Layout]:
        """Return the job, and the form of its results."""
        S, p = self.x.shape
        variables = {
            "fitted": Variable("<f8", ("parameter",), (p,)),
            "cost": Variable("<f8"),
            **dict.fromkeys(("residuals", "steps", "result"), Variable("<i8")),
        }
        constants = {"parameter": (("parameter",), np.array(self.problem.parameters.names), {})}
        blocks, about = Blocks((S,), (1,)), self.description
        return self, Layout(("guess",), blocks, variables, constants, ("parameter",), about)

    def arrays(self) -> list[np.ndarray]:
        """What was computed before the first guess was tried."""
        return [np.asarray(x) for x in jax.tree_util.tree_leaves(self._computed()[0])]

    def resume(self, layout: Layout, arrays: list[np.ndarray]) -> "Guesses":
        """With these numbers of another call."""
        own, rest = self._computed()
        own = jax.tree_util.tree_unflatten(jax.tree_util.tree_structure(own), arrays)
        problem, near = eqx.combine(jax.tree_util.tree_map(jnp.asarray, own), rest)
        return dataclasses.replace(self, problem=problem, near=near)

    def _computed(self) -> Any:
        return eqx.partition((self.problem, self.near), eqx.is_array)

    @property
    def description(self) -> dict[str, Any]:
        """JSON from which these fits can be told from others."""
        parameters = self.problem.parameters
        return {
            "kind": "guesses",
            "versions": versions(),
            "model": describe(self.system),
            "guess": rough(self.near),
            "free": list(parameters.names),
            "bounds": [array_digest(parameters.low), array_digest(parameters.high)],
            "data": [_digest(x) for x in self.given],
            "guesses": array_digest(self.x),
            "max_steps": self.max_steps,
        }


def _digest(data: AbstractObservation) -> str:
    leaves = jax.tree_util.tree_leaves(eqx.filter(data, eqx.is_array))
    return digest_of(type(data).__qualname__, *map(array_digest, leaves))
