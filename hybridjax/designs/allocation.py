r"""The powers that give the smallest variance within limits.

For a given estimator the variance of a goal is $\sum_k a_k^2 / p_k$, with $a_k^2 = p_k^2 s_k$ at
the powers for which it is the best one, and sensitivities $s_k = -\partial \Psi / \partial p_k$.
For other powers the best estimator is better still, so that powers that make this sum small make
the variance $\Psi$ smaller (a majorization; with one limit it is the multiplicative algorithm of
Silvey, Titterington and Torsney 1978 with the square root, which Yu, Ann. Statist. 38, 2010, proved
to be monotone).

*Proof of optimality.* $\Psi$ is convex and $\Psi(tp) = \Psi(p)/t$, so that for every q within the
limits $\Psi(q) \ge \Psi(p) / e$ with $e = \max_q \sum_k q_k s_k / \sum_k p_k s_k$, a linear program
(the general equivalence theorem; Pronzato and Pazman, *Design of Experiments in Nonlinear Models*,
2013). With one limit e is the largest sensitivity per unit of what is limited, 1 at the optimum.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import linprog

from ..errors import DefinitionError
from .limits import Limits
from .sensitivities import Sensitivities


# Powers never fall below this part of the largest one while they are looked for, so that numerators
# stay defined at all lines. Ten times more: variances are larger by as little as it is.
_FLOOR = 1e-9
# Excess of the certificate at which powers are good enough. Doubled: strides may be 4 % more than
# necessary (in fact a tenth of that), in half of the time.
_ENOUGH = 0.02
# Steps between two looks at the certificate; of the iteration for several limits.
_LOOK, _PRICES = 5, 8
# Steps are tried at a multiple of their logarithm that grows by this factor, and halved where they
# raise the criterion. Larger: more steps are in vain.
_LONGER = 1.15
# An unknown is lost where an eigenvalue of the scaled information is below this. Ten times more:
# goals known that much less well count as unseen.
_SINGULAR = 1e-12


class Question(NamedTuple):
    """What is asked of the data."""

    sensitivities: Sensitivities
    wanted: Float[np.ndarray, "g d"]
    """Derivatives of the wanted quantities by the unknowns."""
    names: tuple[str, ...]
    """Of the wanted quantities."""
    unknowns: tuple[str, ...]
    criterion: str
    """"A", the sum of variances, or "D", the volume of the ellipsoid."""

    def only(self, some: Int[np.ndarray, " k"]) -> "Question":
        """Where only these cosines are applied."""
        return self._replace(sensitivities=self.sensitivities.only(some))


class Answer(NamedTuple):
    """What some powers tell."""

    covariance: Float[np.ndarray, "g g"]
    sensitivity: Float[np.ndarray, " K"]
    """By which an increase of the power of a cosine lowers the criterion."""
    criterion: float
    """In units of a variance."""


class Certificate(NamedTuple):
    """How much better other powers within the limits can be."""

    excess: float
    """e: with none can the criterion be smaller than a part 1/e of what it is."""
    relative: Float[np.ndarray, " K"]
    """Sensitivities, relative to what a cosine's power costs: 1 on the average over the power, and
    e at most where no limit of single cosines holds."""


def certify(found: Answer, power: Float[np.ndarray, " K"], limits: Limits) -> Certificate:
    """**Arguments:** `found`, the answer with these powers."""
    bounds = np.stack([np.zeros_like(power), limits.largest], axis=1)
    total = power @ found.sensitivity
    best = linprog(
        -found.sensitivity / total, limits.cost, np.ones(len(limits.cost)), bounds=bounds
    )
    price = -best.ineqlin.marginals @ limits.cost
    relative = found.sensitivity / total / np.where(price > 0, price, np.nan)
    return Certificate(float(-best.fun), -best.fun * relative)


def answer(question: Question, power: Float[np.ndarray, " K"]) -> Answer:
    """**Arguments:** `power`, all positive.

    **Raises:** `DefinitionError` that names what the data cannot see.
    """
    sensitivities = question.sensitivities
    rows = sensitivities.at(power)
    half = _root(rows @ rows.T, question)
    influence = question.wanted @ half @ (half.T @ rows)
    spread = question.wanted @ half
    covariance = spread @ spread.T
    if question.criterion == "D":
        influence = np.linalg.solve(np.linalg.cholesky(covariance), influence)
        criterion = float(np.exp(np.linalg.slogdet(covariance)[1] / len(covariance)))
    else:
        criterion = float(np.trace(covariance))
    squares = np.bincount(sensitivities.candidate, (influence**2).sum(axis=0), len(power))
    return Answer(covariance, squares / power, criterion)


def _root(information: Float[np.ndarray, "d d"], question: Question) -> Float[np.ndarray, "d d"]:
    """R with R R^T the inverse of the information."""
    size = np.sqrt(np.diag(information))
    unseen = np.flatnonzero(~(size > 0))
    if len(unseen):
        raise DefinitionError(f"the data cannot see {question.unknowns[unseen[0]]} at all.")
    values, vectors = np.linalg.eigh(information / size / size[:, None])
    if not values[0] > _SINGULAR:
        parts = [
            f"{x:+.2g} {name}"
            for x, name in zip(vectors[:, 0] / size, question.unknowns, strict=True)
            if abs(x) > 1e-3 * np.abs(vectors[:, 0] / size).max()
        ]
        raise DefinitionError(f"the data cannot see this combination: {' '.join(parts)}.")
    return vectors / np.sqrt(values) / size[:, None]


class Allocation(NamedTuple):
    """Powers, and how good they are."""

    power: Float[np.ndarray, " K"]
    answer: Answer
    certificate: Certificate


def allocate(
    question: Question, limits: Limits, start: Float[np.ndarray, " K"], max_steps: int
) -> Allocation:
    """The best powers within limits, from others.

    **Raises:** `DefinitionError` as `answer`.
    """
    prices = np.full(len(limits.cost), 1 / len(limits.cost))
    power = short = limits.within(np.maximum(start, _FLOOR * start.max()))
    last, longer = np.inf, _LONGER
    for step in range(max_steps + 1):
        now = answer(question, power)
        if now.criterion > last:
            power, longer = short, max(longer / 2, 1.0)
            now = answer(question, power)
        if step % _LOOK == 0 or step == max_steps:
            certificate = certify(now, power, limits)
            if certificate.excess <= 1 + _ENOUGH:
                break
        last, longer = now.criterion, longer * _LONGER
        short, prices = _cheapest(power * np.sqrt(now.sensitivity), limits, prices)
        short = limits.within(np.maximum(short, _FLOOR * short.max()))
        power = limits.within(power * (short / power) ** longer)
        power = limits.within(np.maximum(power, _FLOOR * power.max()))
    return Allocation(power, now, certificate)


def _cheapest(
    a: Float[np.ndarray, " K"], limits: Limits, prices: Float[np.ndarray, " L"]
) -> tuple[Float[np.ndarray, " K"], Float[np.ndarray, " L"]]:
    r"""The powers within limits that minimize $\sum a_k^2/p_k$: $a_k / \sqrt{(W^T \mu)_k}$, with
    prices $\mu$ of the limits, which rise where a limit is exceeded."""
    for _ in range(_PRICES):
        power = np.minimum(a / np.sqrt(prices @ limits.cost), limits.largest)
        use = limits.use(power)
        prices = prices * use**2
    return limits.within(power), prices
