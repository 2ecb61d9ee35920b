"""What a fit of physical parameters gives back."""

import operator
from collections.abc import Mapping

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import stats

from .._core.boundary.checked import checked
from .._core.boundary.kinds import Probability
from .._core.html import card, table, text
from .._core.results import Result
from ..errors import DefinitionError
from ..orbits.cycle import LimitCycle
from ..systems.system import HybridSystem, unit_of_parameter
from .problem import FitProblem, evaluate
from .sensitivity import Identifiability


class ParameterGuesses(eqx.Module):
    """What became of the S guesses of a fit, in the order in which they were tried.

    **Fields:** `values` (S, p), the guesses, and `fitted` (S, p), where they led; `cost`
    (S,) there; `steps` (S,), evaluations of the model with its derivatives; `result` (S,), codes.
    """

    values: Float[np.ndarray, "S p"]
    fitted: Float[np.ndarray, "S p"]
    cost: Float[np.ndarray, " S"]
    steps: Int[np.ndarray, " S"]
    result: Int[np.ndarray, " S"]

    def __len__(self) -> int:
        return len(self.result)

    @property
    def ok(self) -> Bool[np.ndarray, " S"]:
        """Which of them converged."""
        return self.result == Result.OK

    def __repr__(self) -> str:
        rows = [f"{'cost':>10}  {'steps':>5}  result"]
        for cost, steps, code in zip(self.cost, self.steps, self.result, strict=True):
            rows.append(f"{cost:10.4g}  {steps:5d}  {Result(int(code)).message}")
        return "\n".join(rows)


class ModelFit(eqx.Module):
    r"""A system whose parameters were fitted to data.

    **Fields:**

    - `system`: with the fitted parameters. `cycle`: its limit cycle.
    - `names`, `values` (p,): the free parameters.
    - `covariance` (p, p): of the values, $(J^T J)^+$ with the Jacobian J of the residuals in units
        of their standard deviations (where the data have none, what the misfit says); zero along
        combinations that the data do not see.
    - `residuals` (r,): weighted, those of all observations one after the other.
    - `cost`: sum of their squares. `freedom`: r less the number of combinations that are seen; the
        cost to be expected where all data came with their standard deviations.
    - `identifiability`: which combinations of parameters the data see.
    - `guesses`: what became of each guess. `result`: code of the best one.
    - `problem`: what was made small.
    """

    system: HybridSystem
    cycle: LimitCycle
    names: tuple[str, ...] = eqx.field(static=True)
    values: Float[np.ndarray, " p"]
    covariance: Float[np.ndarray, "p p"]
    residuals: Float[np.ndarray, " r"]
    cost: float = eqx.field(static=True)
    freedom: int = eqx.field(static=True)
    identifiability: Identifiability
    guesses: ParameterGuesses
    result: int = eqx.field(static=True)
    problem: FitProblem

    @property
    def weighted(self) -> bool:
        """Whether all data came with their standard deviations."""
        return self.problem.weighted

    @property
    def standard_errors(self) -> Float[np.ndarray, " p"]:
        """Of each value; infinite for a parameter that the data do not see by itself."""
        lost = np.any(self.identifiability.unseen != 0, axis=0)
        return np.where(lost, np.inf, np.sqrt(np.diag(self.covariance)))

    @checked
    def chi_square(self, true: HybridSystem | Mapping[str, float]) -> float:
        r"""How much worse other values explain the data: their cost less that of the fit.

        That of the truth has a chi square distribution with `identifiability.rank` degrees of
        freedom (Wilks 1938). Unlike $e^T J^T J e$ with the errors e of the values, it does not
        depend on how the parameters are written, and follows curved regions. Where the data have no
        standard deviations the unit is what the misfit says.

        **Arguments:** `true`: a system, or values by name.

        **Raises:** `DefinitionError` if a value is missing.
        """
        if isinstance(true, HybridSystem):
            true = {name: operator.attrgetter(name)(true) for name in self.names}
        missing = [name for name in self.names if name not in true]
        if missing:
            raise DefinitionError(f"there is no true value of '{missing[0]}'.")
        values = jnp.array([float(true[name]) for name in self.names])
        x = self.problem.parameters.encode(values)
        r = np.asarray(evaluate(self.problem, x, self.cycle).residuals)
        more = float(r @ r) - self.cost
        return more if self.weighted else more / (self.cost / self.freedom)

    @checked
    def contains(self, true: HybridSystem | Mapping[str, float], level: Probability = 0.95) -> bool:
        """Whether other values lie in the joint confidence region of all that the data see."""
        rank = self.identifiability.rank
        if self.weighted:
            return bool(self.chi_square(true) <= stats.chi2(rank).ppf(level))
        return bool(self.chi_square(true) <= rank * stats.f(rank, self.freedom).ppf(level))

    def __repr__(self) -> str:
        width = max(map(len, self.names))
        expected = f", expected {self.freedom}" if self.weighted else ""
        converged = int(np.sum(self.guesses.ok))
        lines = [
            f"ModelFit({type(self.system).__name__}: {Result(self.result).message})",
            f"  cost {self.cost:.6g}{expected}; {converged} of {len(self.guesses)} guesses "
            f"converged, {int(np.sum(self.guesses.steps))} evaluations",
        ]
        for name, value, error in zip(self.names, self.values, self.standard_errors, strict=True):
            shown = f"+- {error:.2g}" if np.isfinite(error) else "not seen by itself"
            lines.append(f"  {name:{width}}  {value:<14.9g} {shown}")
        lines += [f"  not seen: {text}" for text in self.identifiability.descriptions()]
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        rows = []
        for name, value, error in zip(self.names, self.values, self.standard_errors, strict=True):
            unit, seen = unit_of_parameter(self.system, name), np.isfinite(error)
            known = f"{1.96 * error:.2g}" if seen else "not seen by itself"
            rows.append((name, f"{value:.9g}", known, unit))
        head, cost, *_ = repr(self).splitlines()
        unseen = [f"not seen: {x}" for x in self.identifiability.descriptions()]
        of = head.removeprefix("ModelFit(").removesuffix(")")
        parameters = table(("parameter", "value", "± 95 %", "unit"), rows)
        return card("ModelFit", f"of {of}", parameters, text("\n".join([cost.strip(), *unseen])))
