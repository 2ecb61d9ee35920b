r"""The powers that give the smallest variance within limits, and their division into experiments.

For a fixed estimator the variance of a goal is $\sum_k a_k^2 / p_k$. If the estimator is the best
one for some powers p, then $a_k^2 = p_k^2 s_k$ with the sensitivities $s_k = -\partial \Psi /
\partial p_k$. For other powers another estimator is even better. So powers that reduce this sum
also reduce the variance $\Psi$ (a majorization; with one limit it is the multiplicative algorithm
of Silvey, Titterington and Torsney 1978 with the square root, which Yu, Ann. Statist. 38, 2010,
proved to be monotone).

*Proof of optimality.* $\Psi$ is convex and $\Psi(tp) = \Psi(p)/t$, so that for every q within the
limits $\Psi(q) \ge \Psi(p) / e$ with $e = \max_q \sum_k q_k s_k / \sum_k p_k s_k$, a linear program
(the general equivalence theorem; Pronzato and Pazman, *Design of Experiments in Nonlinear Models*,
2013). With one limit e is the largest sensitivity per unit of the limit, 1 at the optimum.

`optimize.py` calls `allocate` (the iteration over powers), `certify` (e), `worthwhile` (which
cosines matter) and `to_design` (their division into experiments). If designs are poor, look first
at the certificate: it is near 1 if `allocate` is right. If powers are right and experiments are
not, look at `worthwhile` (lines that are missing), at `_dealt`, or at `_balanced` (experiments of
different power). An experiment must keep at most one line of each class.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.optimize import linprog

from ..experiments.design.design import Design
from ..experiments.design.partition import line_class
from .candidates import Candidates, Kept, Powers
from .criterion import Bound, Criterion
from .limits import PowerLimits


# During the search, powers are at least this part of the largest one, so that numerators are
# determined at all lines. Larger: variances are larger by as little. Smaller: rounding errors.
_FLOOR = 1e-9
# Powers are accepted if the excess of the certificate is below this. Larger: more cycles than
# necessary (typically by a tenth of this). Smaller: many more steps for a gain that no experiment
# shows.
ENOUGH = 0.02
# Largest number of steps. Fewer: several limits end with a certificate above 1.02.
_MAX_STEPS = 300
# Number of steps between two certificates; and number of steps of the iteration for the prices of
# several limits. Fewer of the latter: the limits are not met, and the criterion may rise.
_CHECK = 5
_PRICES = 8
# Factor by which steps of log p grow. (A step that raises the criterion is halved.) Larger: more
# steps in vain. Smaller: more steps.
_LONGER = 1.15
# Sweeps by which experiments are brought to the same power. Fewer: they differ by more than 1e-6.
_SWEEPS = 100
# Weak cosines are left out as long as their part of the total gain is below this. Larger: lines are
# lost whose absence distortion of strong ones reveals. Smaller: lines without effect occupy
# experiments.
_NEGLIGIBLE = 1e-4
# The share of a cosine in an experiment is dropped if it is below this part of the cosine's largest
# share. Larger: experiments differ in power. Smaller: cosines without effect occupy experiments.
_WEAK = 1e-4


class Certificate(NamedTuple):
    """A bound of the improvement by other powers within the limits."""

    excess: float
    """e: no other powers can reduce the criterion by more than the factor 1/e."""
    relative: Powers
    """Sensitivities, relative to the price of a cosine's power: 1 on the average over the power,
    and e at most. NaN where no active limit applies to a cosine."""


def certify(
    bound: Bound,
    power: Powers,
    limits: PowerLimits,
    level: Float[np.ndarray, " O"] | float = 1.0,
) -> Certificate:
    """Return the certificate of powers with this bound.

    **Arguments:** `level`: as in `PowerLimits.tangent`.
    """
    # (In units of the power that each cosine may have alone, since tolerances of the solver are
    # absolute.)
    limits = limits.tangent(power, level)
    alone = 1 / np.abs(limits.cost).max(axis=0)
    gain = alone * bound.sensitivity / (power @ bound.sensitivity)
    one = np.ones(len(limits.cost))
    best = linprog(-gain / gain.max(), limits.cost * alone, one)
    if best.x is None:
        # The tangent of a quadratic limit may leave some powers unbounded.
        return Certificate(np.inf, np.full(len(power), np.nan))
    price = -best.ineqlin.marginals @ (limits.cost * alone)
    known_price = np.where(price > 0, price, np.nan)
    relative = gain / gain.max() / known_price
    return Certificate(float(-best.fun * gain.max()), -best.fun * relative)


class Allocation(NamedTuple):
    """Powers, with their bound and certificate."""

    power: Powers
    bound: Bound
    certificate: Certificate


def allocate(criterion: Criterion, limits: PowerLimits, start: Powers) -> Allocation:
    """Return the best powers within limits, starting from others.

    **Raises:** `DefinitionError` as `Criterion.bound`.
    """

    def floored(power: Powers) -> Powers:
        return limits.scaled(np.maximum(power, _FLOOR * power.max()))

    power = floored(start)
    shares = len(limits.use(power))
    prices = np.full(shares, 1 / shares)
    length = _LONGER
    now = criterion.bound(power)
    for step in range(_MAX_STEPS + 1):
        if step % _CHECK == 0:
            certificate = certify(now, power, limits)
            if certificate.excess <= 1 + ENOUGH:
                break
        target, prices = _cheapest(
            power * np.sqrt(now.sensitivity), limits.tangent(power), prices
        )
        trial = floored(limits.scaled(power * (floored(target) / power) ** length))
        bound = criterion.bound(trial)
        if bound.criterion <= now.criterion:
            power = trial
            now = bound
            length = length * _LONGER
        else:
            length = 1.0 if length > 1 else length / 2
    return Allocation(power, now, certificate)


def _cheapest(
    a: Powers, limits: PowerLimits, prices: Float[np.ndarray, " L"]
) -> tuple[Powers, Float[np.ndarray, " L"]]:
    r"""Return the powers within limits that minimize $\sum a_k^2/p_k$:
    $a_k / \sqrt{(W^T \mu)_k}$, with prices $\mu$ of the limits, which rise where a limit is
    exceeded."""
    for _ in range(_PRICES):
        power = a / np.sqrt(limits.price(prices))
        prices = prices * limits.use(power) ** 2
    return limits.scaled(power), prices


def worthwhile(cosines: Candidates, gain: Powers, experiments: int) -> Kept:
    """Return the cosines that matter and fit into `experiments` experiments. (An experiment can
    have one line of each class, so that the best lines of each class are kept.)

    **Arguments:** `gain` of each.
    """
    order = np.argsort(gain)
    kept = np.empty(len(gain), bool)
    kept[order] = np.cumsum(gain[order]) > _NEGLIGIBLE * gain.sum()
    classes = line_class(cosines.line, cosines.periods)
    for number in np.unique(classes):
        members = np.flatnonzero(kept & (classes == number))
        weakest_first = members[np.argsort(gain[members])]
        too_many = max(len(members) - experiments, 0)
        kept[weakest_first[:too_many]] = False
    return np.flatnonzero(kept)


def to_design(
    cosines: Candidates,
    power: Powers,
    use: Powers,
    experiments: int,
    usual: Design,
    seed: int,
) -> Design:
    """Return experiments in which the cosines have these powers on average. All experiments use the
    same share of the limits. Strong cosines occur in several experiments, weak cosines in one.

    **Arguments:** `use`: the share of the limits that each cosine takes.
    """
    rng = np.random.default_rng(seed)
    share = _balanced(_dealt(cosines, use, experiments, rng), use)
    member, experiment = np.nonzero(share)
    order = np.lexsort((cosines.channel[member], cosines.line[member], experiment))
    member = member[order]
    experiment = experiment[order]
    part = share[member, experiment] / share.sum(axis=1)[member]
    return Design(
        experiment=experiment,
        line=cosines.line[member],
        channel=cosines.channel[member],
        amplitude=np.sqrt(2 * experiments * power[member] * part),
        phase=rng.uniform(0, 2 * np.pi, len(member)),
        n_sections=cosines.n_sections,
        periods=cosines.periods,
        experiments=experiments,
        inputs=usual.inputs,
    )


def _dealt(
    cosines: Candidates, use: Powers, experiments: int, rng: np.random.Generator
) -> Float[np.ndarray, "K E"]:
    """Return the share of the limits that each cosine takes in each experiment. An experiment has
    at most one line of each class. Strong cosines get several experiments."""
    share = np.zeros((len(use), experiments))
    classes = line_class(cosines.line, cosines.periods)
    for number in np.unique(classes):
        members = np.flatnonzero(classes == number)
        count = np.ones(len(members), int)
        while count.sum() < experiments:
            count[np.argmax(use[members] / count)] += 1
        member = np.repeat(np.arange(len(members)), count)
        experiment = rng.permutation(experiments)
        share[members[member], experiment] = (use[members] / count)[member]
    return share


def _balanced(share: Float[np.ndarray, "K E"], use: Powers) -> Float[np.ndarray, "K E"]:
    """Return shares with the same sum for each experiment, and the given sum for each cosine,
    without negligible shares."""
    experiments = share.shape[1]
    for _ in range(_SWEEPS):
        of_experiment = use.sum() / experiments
        share = share * (of_experiment / share.sum(axis=0))
        share = share * (use / share.sum(axis=1))[:, None]
    largest = share.max(axis=1, keepdims=True)
    return np.where(share < _WEAK * largest, 0.0, share)
