"""Powers within limits, against closed forms and another optimizer."""

import numpy as np
import pytest
from scipy.optimize import minimize

import hybridjax as hj
from hybridjax.designs.allocation import allocate, certify
from hybridjax.designs.criterion import Channel, Criterion, LinearCriterion
from hybridjax.designs.limits import PowerLimits


pytestmark = pytest.mark.filterwarnings(
    "ignore:Values in x were outside bounds"
)  # older SLSQP


def criterion(slopes):
    """Return that of unknowns with these derivatives (d, K), one row for each cosine."""
    d, K = slopes.shape
    names = tuple(f"x{k}" for k in range(d))
    channels = (Channel(np.arange(K), slopes.T),)
    return Criterion(
        (LinearCriterion(names, names, channels, np.eye(d), np.arange(d)),)
    )


def limits(cost, curved=None):
    cost = np.atleast_2d(cost)
    n = cost.shape[1]
    empty = np.zeros((0, n, n))
    return PowerLimits(
        tuple("abc"[: len(cost)]), cost, empty if curved is None else curved
    )


@pytest.mark.parametrize("linear, quadratic", [(3, 0), (0, 2), (1, 2)])
def test_several_limits(linear, quadratic):
    """Against sequential quadratic programming, without majorization or linear limits around
    quadratic ones. The certificate bounds the distance from the optimum, also far from it."""
    rng = np.random.default_rng(3)
    slopes = rng.normal(size=(3, 14))
    factors = rng.uniform(0, 1, (quadratic, 14, 14))
    curved = np.einsum("oik,oil->okl", factors, factors)
    cost = rng.uniform(0.2, 2, (linear, 14))

    def value(p):
        information = slopes * p @ slopes.T
        return np.trace(np.linalg.inv(information))

    within = {"type": "ineq", "fun": lambda p: 1 - np.append(cost @ p, curved @ p @ p)}
    other = minimize(
        value,
        np.full(14, 0.01),
        method="SLSQP",
        bounds=[(1e-9, 9)] * 14,
        constraints=[within],
        options={"maxiter": 500, "ftol": 1e-10},
    )
    allowed = limits(cost, curved)
    result = allocate(criterion(slopes), allowed, np.ones(14))
    used = allowed.use(result.power)
    assert used.max() == pytest.approx(1)
    assert 1 - 1e-9 < result.certificate.excess < 1.021
    least = result.bound.criterion
    assert (
        other.fun * (1 - 1e-6)
        < least
        < other.fun * result.certificate.excess * (1 + 1e-6)
    )
    assert value(result.power) == pytest.approx(least)
    poor = allowed.scaled(np.ones(14))
    bound = criterion(slopes).bound(poor)
    excess = certify(bound, poor, allowed).excess
    lost = value(poor) / other.fun
    assert excess * (1 + 1e-6) > lost


def test_unidentifiable_unknowns_are_named():
    rows = np.array([[1.0, 2.0, 3.0], [2.0, 4.0, 6.0]])
    same = criterion(rows)
    with pytest.raises(
        hj.errors.DefinitionError, match=r"no response changes along .*x0 .*x1"
    ):
        allocate(same, limits(np.ones(3)), np.ones(3))
    with pytest.raises(hj.errors.DefinitionError, match="x1 changes no response"):
        allocate(
            criterion(np.array([[1.0, 2], [0, 0]])), limits(np.ones(2)), np.ones(2)
        )
