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
from jaxtyping import Float
from scipy.optimize import linprog

from .limits.limits import PowerLimits
from .questions.question import AbstractQuestion, Answer


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
# The smallest multiple. (The criterion falls for sure at 1, but for the worst of several models and
# the choice of an order, which the sum only approximates.) Half of it: some of these end closer to
# the optimum.
_SHORTEST = 1 / 16
# Relative rise of the criterion that is left to rounding, and to weak cosines on their floor. Ten
# times more: of the worst of several models shorter steps are missed.
_RISE = 1e-6


class Certificate(NamedTuple):
    """How much better other powers within the limits can be."""

    excess: float
    """e: with none can the criterion be smaller than a part 1/e of what it is."""
    relative: Float[np.ndarray, " K"]
    """Sensitivities, relative to what a cosine's power costs: 1 on the average over the power, and
    e at most. NaN where no limit that is reached holds for a cosine."""


def certify(
    found: Answer,
    power: Float[np.ndarray, " K"],
    limits: PowerLimits,
    level: Float[np.ndarray, " O"] | float = 1.0,
) -> Certificate:
    """**Arguments:** `found`, the answer with these powers; `level`, as of `PowerLimits.at`."""
    # In units of the power that each cosine may have alone, since the solver's tolerances are
    # absolute.
    limits = limits.at(power, level)
    alone = 1 / np.abs(limits.cost).max(axis=0)
    gain = alone * found.sensitivity / (power @ found.sensitivity)
    best = linprog(-gain / gain.max(), limits.cost * alone, np.ones(len(limits.cost)))
    if best.x is None:  # a quadratic form may let some powers grow as far as it knows here
        return Certificate(np.inf, np.full(len(power), np.nan))
    price = -best.ineqlin.marginals @ (limits.cost * alone)
    relative = gain / gain.max() / np.where(price > 0, price, np.nan)
    return Certificate(float(-best.fun * gain.max()), -best.fun * relative)


class Allocation(NamedTuple):
    """Powers, and how good they are."""

    power: Float[np.ndarray, " K"]
    answer: Answer
    certificate: Certificate


def allocate(
    question: AbstractQuestion, limits: PowerLimits, start: Float[np.ndarray, " K"], max_steps: int
) -> Allocation:
    """The best powers within limits, from others.

    **Raises:** `DefinitionError` as `question.answer`.
    """
    power = limits.within(np.maximum(start, _FLOOR * start.max()))
    shares = len(limits.use(power))
    prices, longer = np.full(shares, 1 / shares), _LONGER
    now = question.answer(power)
    for step in range(max_steps + 1):
        if step % _LOOK == 0 or step == max_steps:
            certificate = certify(now, power, limits)
            if certificate.excess <= 1 + _ENOUGH or step == max_steps:
                break
        short, prices = _cheapest(power * np.sqrt(now.sensitivity), limits.at(power), prices)
        trial = _along(power, short, longer, limits)
        found = question.answer(trial)
        if found.criterion > now.criterion:
            surely = longer > 1
            longer = max(longer / 2, 1.0 if surely else _SHORTEST)
            trial = _along(power, short, 1.0 if surely else longer, limits)
            found = question.answer(trial)
        if found.criterion <= now.criterion * (1 + _RISE):
            power, now, longer = trial, found, longer * _LONGER
    return Allocation(power, now, certificate)


def _along(
    power: Float[np.ndarray, " K"],
    short: Float[np.ndarray, " K"],
    longer: float,
    limits: PowerLimits,
) -> Float[np.ndarray, " K"]:
    """Powers on the way to others, or beyond them, within limits."""
    short = limits.within(np.maximum(short, _FLOOR * short.max()))
    power = limits.within(power * (short / power) ** longer)
    return limits.within(np.maximum(power, _FLOOR * power.max()))


def _cheapest(
    a: Float[np.ndarray, " K"], limits: PowerLimits, prices: Float[np.ndarray, " L"]
) -> tuple[Float[np.ndarray, " K"], Float[np.ndarray, " L"]]:
    r"""The powers within limits that minimize $\sum a_k^2/p_k$: $a_k / \sqrt{(W^T \mu)_k}$, with
    prices $\mu$ of the limits, which rise where a limit is exceeded."""
    for _ in range(_PRICES):
        power = a / np.sqrt(limits.price(prices))
        prices = prices * limits.use(power) ** 2
    return limits.within(power), prices
